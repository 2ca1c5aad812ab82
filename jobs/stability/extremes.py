"""The scenes of the stability matrix as data: an axis is a small deck, and values that take it to an extreme.

A value is a list of overrides (see `mpitled run --set`), separated by blanks. Overrides of "grid" make the mesh that
the deck reads (see `grid.write_grid`). "reference.tolerance=" sets a key of the solver only for the run that is the
reference. "0.95*critical" is a share of the model's critical time step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_MATERIAL = """
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
"""
_BLOCK = "[block]\nsize = [24.0, 24.0, 24.0]\nelements = [8, 8, 8]\n"
_GRID = '[mesh]\nfe = "grid.inp"\nunit = "mm"\n'
_SOLVER = "[solver]\nload_time = 0.5\n[output]\nframes = 1\npictures = false\n"


def _slides(*sets: str) -> str:
    """Faces that slide in their planes."""
    return "".join(f'[[fixed]]\nnodes = "{name}"\ndirections = ["{name[0]}"]\n' for name in sets)


_PULLED = '[[displaced]]\nnodes = "z1"\ndirections = ["z"]\ndisplacement = [4.8]\n'
_STRETCH = _slides("x0", "y0", "z0") + _PULLED + _SOLVER
_CONFINED = _slides("x0", "x1", "y0", "y1", "z0") + _PULLED + _SOLVER
_BONDED = '[[fixed]]\nnodes = "z0"\n[[displaced]]\nnodes = "z1"\ndisplacement = [0.0, 0.0, 4.8]\n' + _SOLVER
_TURNED = _BONDED.replace("4.8]", "0.0]\nrotation = 90.0")
_LEVELS = range(9)
_SHEARED = "".join(
    f'[[displaced]]\nnodes = "level{k}"\ndisplacement = [{3.0 * k}, 0.0, 0.0]\n' for k in _LEVELS
) + _SOLVER  # fmt: skip
_SPHERE = """[ellipsoid]
semi_axes = [30.0, 30.0, 30.0]
element_size = 5.0
[tumour]
centre = [0.0, 0.0, 0.0]
volume = 523.6
[[fixed]]
nodes = "surface"
[solver]
load_time = 0.5
[output]
frames = 1
pictures = false
"""
_OTHER = """
[material.other]
youngs_modulus = 3000.0
poissons_ratio = 0.49
cells = ["{}"]
"""
_UPPER, _INNER = _OTHER.format("upper"), _OTHER.format("inner")
_BAR = "[block]\nsize = [20.0, 20.0, 80.0]\nelements = [6, 6, 24]\n"


@dataclass(frozen=True, slots=True)
class Axis:
    """A scene and the values that take it to an extreme."""

    about: str  # the scene, and the meaning of the values
    deck: str
    values: dict[str, str]  # name -> overrides
    reference: str  # displacements: a closed form of `exact`, or another run, "relaxed" or "quarter"
    kinds: tuple[str, ...] = ("FE", "mixed", "EFG")
    methods: tuple[str, ...] = ("ramp", "relaxation")

    @property
    def geometry(self) -> str:
        """The deck's geometry, a key of KINDS."""
        return next(name for name in KINDS if f"[{name}]" in self.deck)


#: Overrides for hexahedra only, for a mixed model, and for support domains only, for each geometry.
KINDS = {
    "block": {"FE": "block.cloud=none", "mixed": "block.cloud=core", "EFG": "block.cloud=all"},
    "ellipsoid": {"FE": "ellipsoid.cloud=none", "mixed": "ellipsoid.cloud=core", "EFG": "ellipsoid.cloud=all"},
    "mesh": {
        "FE": "",
        "mixed": 'mesh.dropped=["inner"] mesh.efg=inner.inp',
        "EFG": 'mesh.dropped=["all_cells"] mesh.efg=all_cells.inp mesh.surface_areas=areas.csv',
    },
}
METHODS = {
    "ramp": "solver.method=quasi-static",
    "ramp, true mass": "solver.method=quasi-static solver.mass_scaling=false",
    "relaxation": "solver.method=dynamic-relaxation",
    "waves": "solver.method=dynamic",
}


def _brain(key: str, *values: float, time: float = 0.5) -> dict[str, str]:
    """Values of a key of the material; the load time (s) is scaled so that waves cross the body equally often."""
    usual = {"youngs_modulus": 3000.0, "density": 1000.0}.get(key)
    words = {}
    for value in values:
        ratio = value / usual if usual else 1.0
        scale = ratio ** (0.5 if key == "density" else -0.5)
        words[f"{value:g}"] = f"material.brain.{key}={value!r} solver.load_time={time * scale:.6g}"
    return words


def _pulled(*percent: int, at: str = "[{:g}]") -> dict[str, str]:
    """Displacements of the upper end in percent of the height."""
    return {f"{p} %": f"displaced.0.displacement={at.format(0.24 * p)}" for p in percent}


def _sheared(*amounts: float) -> dict[str, str]:
    """Shear: each level of surface nodes moves along x by the amount times its height."""
    return {
        f"{amount:g}": " ".join(f"displaced.{k}.displacement=[{3 * amount * k:g},0,0]" for k in _LEVELS)
        for amount in amounts
    }


def _tumours(*radii: tuple[float, float]) -> dict[str, str]:
    """Tumours that grow from one radius to another (mm), named by the ratio."""
    words = "tumour.seed_radius={} tumour.volume={:.8g}"
    return {f"{R / r:g}" + ("" if r == 2 else f" ({R:g} mm)"): words.format(r, 4 / 3 * np.pi * R**3) for r, R in radii}


_CONTRASTS = (1e2, 1e4, 1e6)
_COARSE = {1e6: " reference.tolerance=3e-3"}  # mm; round-off prevents less than 2e-3 at this contrast
_SHARES = (0.5, 0.95, 1.05, 2.0)
_FAST = 0.02  # s; a shear wave crosses the block in 24 ms
_TOGETHER = "[0,0,{:g}]"

AXES: dict[str, Axis] = {
    "poisson": Axis("stretch by 20 %, Poisson's ratio", _BLOCK + _MATERIAL + _STRETCH,
        _brain("poissons_ratio", 0.0, 0.3, 0.49, 0.499, 0.4999), "stretched"),
    "locking": Axis("growth to 2.5 times the seed, Poisson's ratio", _SPHERE + _MATERIAL,
        _brain("poissons_ratio", 0.0, 0.3, 0.49, 0.499, 0.4999), "shell", methods=("relaxation",)),
    "youngs": Axis("stretch by 20 %, Young's modulus in Pa", _BLOCK + _MATERIAL + _STRETCH,
        _brain("youngs_modulus", 10.0, 1e5, 1e9), "stretched"),
    "youngs-waves": Axis("stretch by 20 %, waves, Young's modulus in Pa", _BLOCK + _MATERIAL + _STRETCH,
        _brain("youngs_modulus", 10.0, 1e9, time=_FAST), "quarter", ("mixed",), ("waves",)),
    "density": Axis("stretch by 20 %, density in kg/m3", _BLOCK + _MATERIAL + _STRETCH,
        _brain("density", 1.0, 10.0, 1e5), "stretched", methods=("ramp",)),
    "density-waves": Axis("stretch by 20 %, waves, density in kg/m3", _BLOCK + _MATERIAL + _STRETCH,
        _brain("density", 1.0, 1e5, time=_FAST), "quarter", ("mixed",), ("waves",)),
    "layers": Axis("confined stretch by 20 %, upper half so many times stiffer", _GRID + _MATERIAL + _UPPER + _CONFINED,
        {f"{c:g}": f"material.other.youngs_modulus={3000 * c!r}" for c in (1e1, *_CONTRASTS)}, "layers", ("FE",)),
    "stiff": Axis("stretch by 20 %, core so many times stiffer", _GRID + _MATERIAL + _INNER + _BONDED,
        {f"{c:g}": f"material.other.youngs_modulus={3000 * c!r} material.other.poissons_ratio=0.3{_COARSE.get(c, '')}"
         for c in _CONTRASTS}, "relaxed"),
    "soft": Axis("stretch by 20 %, core so many times softer, as CSF", _GRID + _MATERIAL + _INNER + _BONDED,
        {f"{c:g}": f"material.other.youngs_modulus={3000 / c!r} material.other.poissons_ratio=0.1" for c in _CONTRASTS},
        "relaxed"),
    "growth": Axis("growth of a tumour, R/r0 (r0 = 2 mm)", _SPHERE + _MATERIAL,
        _tumours((2, 3), (2, 5), (2, 10), (2, 15), (1.5, 15), (0.75, 15)), "shell"),
    "compression": Axis("compression between frictionless platens", _BLOCK + _MATERIAL + _STRETCH,
        _pulled(-20, -40, -60, -80), "stretched"),
    "confined": Axis("compression in a mould", _BLOCK + _MATERIAL + _CONFINED, _pulled(-20, -40, -60, -80), "confined",
        ("mixed",)),
    "bonded": Axis("compression between bonded platens", _BLOCK + _MATERIAL + _BONDED,
        _pulled(-20, -40, -60, -80, at=_TOGETHER), "relaxed", ("FE", "mixed")),
    "extension": Axis("extension between frictionless platens", _BLOCK + _MATERIAL + _STRETCH,
        _pulled(50, 100, 200, 300), "stretched"),
    "torsion": Axis("torsion of a bar", _BAR + _MATERIAL + _TURNED,
        {f"{angle} deg": f"displaced.0.rotation={angle}" for angle in (90, 135, 180)}, "relaxed", ("FE", "mixed")),
    "shear": Axis("simple shear of the whole surface", _GRID + _MATERIAL + _SHEARED, _sheared(0.5, 1, 2), "sheared"),
    "skew": Axis("stretch by 20 %, smallest scaled Jacobian", _GRID + _MATERIAL + _STRETCH,
        {f"{q:g}": f"grid.skew={q}" for q in (0.5, 0.1, 0.01)}, "stretched"),
    "slivers": Axis("stretch by 20 %, a layer of flat cells, aspect", _GRID + _MATERIAL + _STRETCH,
        {f"1:{a}": f"grid.thin=1,1,{1 / a}" for a in (10, 100)}, "stretched"),
    "needles": Axis("stretch by 20 %, a row of needles, aspect", _GRID + _MATERIAL + _STRETCH,
        {f"1:{a}": f"grid.thin={1 / a},{1 / a},1" for a in (10, 100)}, "stretched"),
    "plates": Axis("stretch by 20 %, all cells flat, aspect", _GRID + _MATERIAL + _STRETCH,
        {f"1:{a}": f"grid.size=24,24,{24 / a} displaced.0.displacement=[{4.8 / a}] solver.tolerance={0.01 / a}"
         for a in (10, 100)}, "stretched", ("FE", "EFG")),
    "planes": Axis("stretch by 20 %, all cells needles, aspect", _GRID + _MATERIAL + _STRETCH,
        {f"1:{a}": f"grid.size={24 / a},{24 / a},24" for a in (10, 100)}, "stretched", ("FE", "EFG")),
    "few": Axis("stretch by 20 %, few cells", _GRID + _MATERIAL + _STRETCH,
        {"1": "grid.elements=1,1,1 support.nodes=8 mesh.cuts=1", "2": "grid.elements=1,1,2 support.nodes=8 mesh.cuts=1",
         "8": "grid.elements=2,2,2"}, "stretched", ("FE", "EFG")),
    "hasty": Axis("stretch by 20 %, load so many times faster", _BLOCK + _MATERIAL + _STRETCH,
        {f"{n}": f"solver.load_time={0.5 / n} solver.load_steps={500 // n}" for n in (10, 100)}, "stretched"),
    "step": Axis("stretch by 20 %, step over the critical one", _BLOCK + _MATERIAL + _STRETCH,
        {f"{share:g}": f"solver.time_step={share:g}*critical" for share in _SHARES}, "stretched",
        methods=("ramp", "ramp, true mass")),
    "step-waves": Axis("stretch by 20 %, waves, step over the critical one", _BLOCK + _MATERIAL + _STRETCH,
        {f"{share:g}": f"solver.time_step={share:g}*critical solver.load_time={_FAST}" for share in _SHARES},
        "quarter", methods=("waves",)),
    "flaws": Axis("stretch by 20 %, meshes with flaws", _GRID + _MATERIAL + _STRETCH, {
        "twin nodes": "grid.flaw=twins",
        "stray nodes": "grid.flaw=strays",
        "cell twice": "grid.flaw=repeated",
        "open layer": "grid.flaw=open",
        "cell inverted": "grid.flaw=inverted",
        "cell flat": "grid.flaw=flat",
    }, "stretched", methods=("relaxation",)),
    "slips": Axis("stretch by 20 %, decks written wrongly", _GRID + _MATERIAL + _STRETCH, {
        "nu 0.5": "material.brain.poissons_ratio=0.5",
        "E in MPa": "material.brain.youngs_modulus=3e-3",
        "rho in t/mm3": "material.brain.density=1e-9",
        "m for mm": "mesh.unit=m",
        "load in 1 us": "solver.load_time=1e-6",
        "no such set": "displaced.0.nodes=top",
    }, "stretched", ("mixed",)),
}  # fmt: skip
