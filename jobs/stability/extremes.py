"""The scenes of the stability matrix: small decks taken to extremes, an axis for each way there, as data.

An axis is a deck and values; a value is what `--set` takes, words apart by blanks. Words that begin with "grid." make
the mesh that the deck reads (see `write_grid`), "reference.tolerance=" sets a key of the solver for the run that is the
reference alone, and "0.95*critical" is that share of the model's critical step.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mpitled.cells import hexahedra
from mpitled.mesh import grid_points, structured_hexahedra

_MATERIAL = """
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
"""
_BLOCK = "[block]\nsize = [24.0, 24.0, 24.0]\nelements = [8, 8, 8]\n"
_GRID = '[mesh]\nfe = "grid.inp"\nunit = "mm"\n'
_SOLVER = "[solver]\nload_time = 0.5\n[output]\nframes = 1\npictures = false\n"


def _slides(*sets: str) -> str:
    """Faces that stay in their planes."""
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
    """A way to an extreme."""

    about: str  # what is computed, and what the values are
    deck: str
    values: dict[str, str]  # as they are called -> what they set
    reference: str  # of displacements: a closed form of `exact`, or another run: "relaxed" or "quarter"
    kinds: tuple[str, ...] = ("FE", "mixed", "EFG")
    methods: tuple[str, ...] = ("ramp", "relaxation")

    @property
    def geometry(self) -> str:
        """The deck's geometry, a key of KINDS."""
        return next(name for name in KINDS if f"[{name}]" in self.deck)


#: What makes the same scene of hexahedra, of both, or of support domains, for each geometry.
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
    """Values of the one material's key, with as many transits of waves as there are in that load time, s, without."""
    faster = {"youngs_modulus": 3000.0, "density": 1000.0}.get(key)
    words = {}
    for value in values:
        ratio = value / faster if faster else 1.0
        scale = ratio ** (0.5 if key == "density" else -0.5)
        words[f"{value:g}"] = f"material.brain.{key}={value!r} solver.load_time={time * scale:.6g}"
    return words


def _pulled(*percent: int, at: str = "[{:g}]") -> dict[str, str]:
    """The upper end moved by percents of the height."""
    return {f"{p} %": f"displaced.0.displacement={at.format(0.24 * p)}" for p in percent}


def _sheared(*amounts: float) -> dict[str, str]:
    """Every level of nodes on the surface moved along x by that many times its height."""
    return {
        f"{amount:g}": " ".join(f"displaced.{k}.displacement=[{3 * amount * k:g},0,0]" for k in _LEVELS)
        for amount in amounts
    }


def _tumours(*radii: tuple[float, float]) -> dict[str, str]:
    """Tumours that grow from a radius to another (mm), by the ratio of both."""
    words = "tumour.seed_radius={} tumour.volume={:.8g}"
    return {f"{R / r:g}" + ("" if r == 2 else f" ({R:g} mm)"): words.format(r, 4 / 3 * np.pi * R**3) for r, R in radii}


_CONTRASTS = (1e2, 1e4, 1e6)
_COARSE = {1e6: " reference.tolerance=3e-3"}  # mm: at such a contrast round-off comes no nearer than 2e-3
_SHARES = (0.5, 0.95, 1.05, 2.0)
_FAST = 0.02  # s, of which a shear wave takes 24 ms to cross the block
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


def write_grid(folder: Path, words: dict[str, str]) -> None:
    """Abaqus decks, in mm: grid.inp of a box of hexahedra, and inner.inp and all_cells.inp of the cloud's nodes.

    areas.csv has the outer surface's areas at its nodes. Node sets are x0 to z1, surface and level0, level1, ... (what
    of it is so many cells above z = 0); cell sets all_cells, inner (4 x 4 x 4 in the middle) and upper (half). Words:
    elements and size along x, y, z; thin, the share of a cell's thickness that the middle one has along x, y, z; skew,
    the smallest scaled Jacobian that inner nodes are moved to; flaw, of those that people make.
    """
    nx, ny, nz = shape = [int(n) for n in words.get("elements", "8,8,8").split(",")]
    size = [float(length) for length in words.get("size", "24,24,24").split(",")]
    points, cells = grid_points((nx, ny, nz), (size[0], size[1], size[2])), structured_hexahedra((nx, ny, nz))
    index = np.rint(points / size * shape).astype(int)
    for axis, ratio in enumerate(map(float, words.get("thin", "1,1,1").split(","))):
        # The plane after the middle is drawn near to it; the layer beyond has what this one loses.
        cell = size[axis] / shape[axis]
        points[index[:, axis] == shape[axis] // 2 + 1, axis] -= (1 - ratio) * cell if ratio < 1 else 0.0
    inside = np.asarray(np.logical_and(index > 0, index < shape).all(axis=1))
    if "skew" in words:
        points = _skewed(points, cells, inside, float(words["skew"]))
    gradients, volumes = hexahedra.geometry(points, cells)
    areas = hexahedra.nodal_sum(cells, volumes[:, None, None] * gradients, len(points))
    table = (f"{i + 1},{','.join(map(repr, areas[i].tolist()))}\n" for i in np.flatnonzero(~inside))
    (folder / "areas.csv").write_text("node,x,y,z\n" + "".join(table))
    sets = {f"{a}{end}": index[:, i] == end * shape[i] for i, a in enumerate("xyz") for end in (0, 1)}
    sets |= {"surface": ~inside} | {f"level{k}": ~inside & (index[:, 2] == k) for k in range(shape[2] + 1)}
    middle = index[cells].mean(axis=1) / shape
    parts = {
        "all_cells": np.ones(len(cells), bool),
        "inner": (np.abs(middle - 0.5) < 0.25).all(axis=1),
        "upper": middle[:, 2] > 0.5,
    }
    first, flaw = int(np.flatnonzero(parts["inner"])[0]) if parts["inner"].any() else 0, words.get("flaw", "")
    if flaw == "repeated":
        cells = np.concatenate([cells, cells[first : first + 1]])
        parts = {name: np.append(chosen, chosen[first]) for name, chosen in parts.items()}
    elif flaw == "inverted":
        cells[first] = cells[first, [4, 5, 6, 7, 0, 1, 2, 3]]
    elif flaw == "flat":
        points[cells[first, 4:]] = points[cells[first, :4]]
    more = np.empty(0, np.int64)  # nodes whose places are taken by more nodes
    if flaw in ("twins", "open"):
        more = np.flatnonzero(index[:, 2] == shape[2] // 2)
    elif flaw == "strays":
        more = np.arange(9)
    points = np.concatenate([points, points[more] + (100.0 if flaw == "strays" else 0.0)])
    sets = {name: np.concatenate([chosen, chosen[more] & (flaw == "open")]) for name, chosen in sets.items()}
    if flaw == "open":
        other = np.arange(len(points) - len(more))
        other[more] = len(other) + np.arange(len(more))
        cells = np.where(parts["upper"][:, None], other[cells], cells)
    text = "*NODE\n" + _rows(np.arange(len(points)), points) + "*ELEMENT, TYPE=C3D8R\n"
    text += _rows(np.arange(len(cells)), cells + 1)
    text += "".join(f"*ELSET, ELSET={name}\n{_numbers(chosen)}" for name, chosen in parts.items())
    (folder / "grid.inp").write_text(text + _node_sets(sets))
    for name in ("all_cells", "inner"):
        own = np.zeros(len(points), bool)
        own[cells[parts[name]]] = True
        own[len(index) :] = flaw != ""
        text = "*NODE\n" + _rows(np.flatnonzero(own), points[own])
        (folder / f"{name}.inp").write_text(text + _node_sets({key: chosen & own for key, chosen in sets.items()}))


def _rows(numbers: NDArray[np.int64], table: NDArray[np.generic]) -> str:
    pairs = zip(numbers.tolist(), table.tolist(), strict=True)
    return "".join(f"{number + 1}, {', '.join(map(repr, row))}\n" for number, row in pairs)


def _numbers(chosen: NDArray[np.bool_]) -> str:
    return "".join(f"{i + 1}\n" for i in np.flatnonzero(chosen))


def _node_sets(sets: dict[str, NDArray[np.bool_]]) -> str:
    return "".join(f"*NSET, NSET={name}\n{_numbers(chosen)}" for name, chosen in sets.items() if chosen.any())


def _skewed(
    points: NDArray[np.float64], cells: NDArray[np.int64], inside: NDArray[np.bool_], worst: float
) -> NDArray[np.float64]:
    """Points whose inner ones are moved at random, just as far as makes the smallest scaled Jacobian `worst`."""
    shift = np.where(inside[:, None], np.random.default_rng(0).uniform(-1, 1, points.shape), 0.0)
    low, high = 0.0, float(np.linalg.norm(points[cells[0, 1]] - points[cells[0, 0]]))
    for _ in range(50):
        middle = 0.5 * (low + high)
        sound = hexahedra.scaled_jacobian(points + middle * shift, cells).min() > worst
        low, high = (middle, high) if sound else (low, middle)
    return points + low * shift
