"""The deck, one TOML file per scene: every key is declared once, with type, unit, default, limits and meaning."""

# ruff: noqa: RUF009  (key() is dataclasses.field with more to say)

from __future__ import annotations

import difflib
import functools
import hashlib
import json
import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from mpitled.errors import InputError
from mpitled.laws import Material, NeoHookean
from mpitled.mesh import METRES, Constraint, Rotation

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: A deck is larger than that by mistake, and so is a key of so many parts, for which parsers take the square of time.
_MOST_BYTES, _MOST_PARTS = 1 << 18, 100
#: Smaller sizes, and numbers larger than its reciprocal, are slips: ratios and their cubes have to stay floats.
_FINEST = 1e-30
#: What is between the dots of a key, and what else there is in TOML.
_TOKEN = re.compile(r'"(?:[^"\\\n]|\\.)*"?|\'[^\'\n]*\'?|[\w-]+|[ \t]+|.', re.DOTALL)
_DECIMAL_COMMA = re.compile(r"=\s*[-+]?\d+,\d+\s*(#|$)")
#: Names that meshes have, and decks never.
OF_MESHES = (".inp", ".k", ".key", ".dyn", ".msh", ".vtk", ".vtu", ".med", ".xdmf", ".mesh", ".bdf")
#: Units of the deck that are not SI: how many make one SI unit. Dividing by a power of ten rounds 5.1 mm to 0.0051 m.
_PER_SI = {"mm": 1e3, "mm3": 1e9, "degrees": 180 / math.pi}


class _Key(NamedTuple):
    """What the parser, the messages and the guide say of a key; its type is the annotation of its field."""

    meaning: str
    unit: str
    default: Any  # in the deck's unit; MISSING where the user must choose
    limits: str  # of each number, as an interval: "(0, 0.5]"
    empty: bool  # whether a list may be


def key(meaning: str, default: Any = MISSING, unit: str = "", limits: str = "", empty: bool = False) -> Any:
    """A field read from the deck in `unit` and kept in SI units; it must be given if it has no default."""
    metadata = {"key": _Key(meaning, unit, default, limits, empty)}
    return field(metadata=metadata) if default is MISSING else field(default=_si(default, unit), metadata=metadata)


def _si(value: Any, unit: str) -> Any:
    if isinstance(value, tuple):
        return tuple(_si(v, unit) for v in value)
    return value / _PER_SI[unit] if unit in _PER_SI and isinstance(value, float) else value


def _in_unit(value: Any, unit: str) -> Any:
    """The deck's value again: the shortest decimal that is read as the same SI value."""
    if isinstance(value, tuple):
        return [_in_unit(v, unit) for v in value]
    if unit not in _PER_SI or not isinstance(value, float):
        return value
    decimals = (float(f"{value * _PER_SI[unit]:.{digits}g}") for digits in (15, 16, 17))
    return next((v for v in decimals if _si(v, unit) == value), value * _PER_SI[unit])


# --- the sections --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Labels:
    """Geometry: hexahedra made from a label image (0 is outside)."""

    image: Path = key("label image (NIfTI or MGH); relative to the deck's folder")
    element_size: float = key("edge of a hexahedron", 4.0, "mm", "(0, inf)")
    tissue: tuple[int, ...] = key("labels of brain tissue", (1,), limits="[1, inf)")
    left_ventricle: tuple[int, ...] = key("labels of the left ventricle", (2,), limits="[1, inf)", empty=True)
    right_ventricle: tuple[int, ...] = key("labels of the right ventricle", (3,), limits="[1, inf)", empty=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """Geometry: a block of equal hexahedra."""

    corner: tuple[float, float, float] = key("its corner of least x, y, z", (0.0, 0.0, 0.0), "mm")
    size: tuple[float, float, float] = key("edges along x, y, z", unit="mm", limits="(0, inf)")
    elements: tuple[int, int, int] = key("hexahedra along x, y, z", limits="[1, inf)")
    cloud: Literal["none", "core", "all"] = key("what the cloud replaces: nothing, an inner block, everything", "none")
    core_share: float = key('share of each edge that `cloud = "core"` replaces', 0.5, limits="(0, 1)")
    fitted: str | None = key("name of a [sphere.NAME] that hexahedra follow; `elements` are then along the edges", None)


_Length = Literal["m", "cm", "mm"]
_Stress = Literal["Pa", "kPa", "MPa", "GPa"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Cylinder:
    """Geometry: a cylinder along z that stands on z = 0, around the origin."""

    radius: float = key("radius", unit="mm", limits="(0, inf)")
    height: float = key("height", unit="mm", limits="(0, inf)")
    element_size: float = key("edge of a hexahedron, in the mean", 5.0, "mm", "(0, inf)")
    cloud: Literal["none", "core", "all"] = key("what the cloud replaces: nothing, the inner part, everything", "none")
    core_share: float = key('share of radius and height that `cloud = "core"` replaces', 0.5, limits="(0, 1)")
    grading: float = key(
        'thickness of the layers at both ends and of the outermost ring as a share of the mean; 1 with `cloud = "all"`',
        0.15,
        limits="(0, 1]",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Ellipsoid:
    """Geometry: an ellipsoid around the origin."""

    semi_axes: tuple[float, float, float] = key("semi-axes along x, y, z", unit="mm", limits="(0, inf)")
    element_size: float = key("edge of a hexahedron, in the mean", 5.0, "mm", "(0, inf)")
    cloud: Literal["none", "core", "all"] = key("what the cloud replaces: nothing, the inner part, everything", "none")
    core_share: float = key('share of the semi-axes that `cloud = "core"` replaces', 0.5, limits="(0, 1)")
    grading: float = key(
        'size of elements beside the edges of patch and fixed as a share of the mean; 1 with `cloud = "all"`',
        1.0,
        limits="(0, 1]",
    )
    cavity: Literal["fitted", "moved"] = key(
        "seed without a cloud: shells around it, or one hexahedron whose nodes move (the paper)", "fitted"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshFiles:
    """Geometry: meshes made by other programs."""

    fe: Path | None = key(
        "nodes, hexahedra and sets (Abaqus, LS-DYNA, or what meshio reads); from the deck's folder", None
    )
    efg: Path | None = key("nodes of the cloud; those on the interface may be repeated", None)
    integration_points: Path | None = key("CSV or HDF5 with x, y, z, volume, and sets if need be", None)
    dropped: tuple[str, ...] = key("cell sets of `fe` whose hexahedra the cloud replaces", ())
    cuts: int = key(
        "without `integration_points`: parts of a dropped hexahedron along each edge; if none is dropped, the cells "
        "of `efg` are the integration cells",
        2,
        limits="[1, 16]",
    )
    surface_areas: Path | None = key(
        "CSV of node, x, y, z: the outer surface's share of constant stress at nodes on the cloud's boundary", None
    )
    unit: _Length = key("unit of length of `fe`, and of the others unless they have one", "m")
    efg_unit: _Length | None = key("unit of length of `efg`", None)
    integration_unit: _Length | None = key("unit of length of `integration_points`", None)
    stress_unit: _Stress = key("unit of stress of `fe`, and of `efg` unless it has one", "Pa")
    efg_stress_unit: _Stress | None = key("unit of stress of `efg`", None)
    density_unit: Literal["consistent", "kg/m3", "g/cm3", "kg/mm3", "t/mm3"] = key(
        "unit of density of both; consistent: that goes with length, stress and seconds, as t/mm3 with mm and MPa",
        "consistent",
    )
    repair: bool = key("put the nodes of hexahedra in order that are numbered inside out or crosswise", False)
    merge_tolerance: float = key("nodes of both meshes closer than this are one", 0.001, "mm", "[0, inf)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Tumour:
    """A sphere that grows from a seed (optional)."""

    centre: tuple[float, float, float] = key("centre of seed and tumour, in the image's coordinates", unit="mm")
    volume: float = key("volume of the whole sphere at full load", unit="mm3", limits="(0, inf)")
    seed_radius: float = key("radius of the sphere at the start", 2.0, "mm", "(0, inf)")
    surface_nodes: int = key("nodes on the seed's surface; fewer leave its hull short", 800, limits="[12, inf)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cloud:
    """EFG nodes and integration points in place of hexahedra."""

    radius: float = key("tissue hexahedra this near to the tumour's centre are replaced", 18.0, "mm", "(0, inf)")
    growth: float = key("node spacing as a share of the distance to the seed's centre", 0.2, limits="(0, inf)")
    spacing: float = key("largest node spacing; 0: the size of a hexahedron", 0.0, "mm", "[0, inf)")
    irregularity: float = key("random shift of nodes as a share of the spacing", 0.3, limits="[0, 0.5)")
    seed: int = key("seed of the random numbers", 0, limits="[0, inf)")
    points_per_spacing: float = key("integration cells per node spacing, in each direction", 1.1, limits="(0, inf)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Support:
    """Support domains of the integration points."""

    nodes: int = key("nodes in a support domain, n; the paper: 8", 20, limits="[4, inf)")
    basis: Literal[4, 10, 20] = key("monomials of the basis, m: linear, quadratic, cubic", 4)
    weight: Literal["equal", "quartic"] = key("weight of the moving least squares; the paper: equal", "quartic")
    max_fe_nodes: int = key("most FE nodes in a support domain; the paper: 7", 19, limits="[0, inf)")
    min_domains: int = key("every EFG node is in at least so many support domains", 3, limits="[1, inf)")
    stabilisation: float = key(
        "stiffness of modes that the gradient does not see; 0: the paper", 0.1, limits="[0, inf)"
    )
    consistency: bool = key("correct gradients so that a constant stress is in balance; false: the paper", True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hexahedra:
    """One-point hexahedra."""

    hourglass: float = key("hourglass stiffness, R_hg of the paper", 0.04 / 9, limits="[0, inf)")
    gradient: Literal["mean", "centre"] = key("mean over the volume, or at the centre as in the paper", "mean")


@dataclass(frozen=True, slots=True, kw_only=True)
class MaterialSection:
    """A neo-Hookean material and the cells it fills; NAME is free."""

    name: str
    youngs_modulus: float = key("Young's modulus, E", unit="Pa", limits="(0, inf)")
    poissons_ratio: float = key("Poisson's ratio, nu", limits="(-1, 0.5)")
    density: float = key("density", 1000.0, "kg/m3", "(0, inf)")
    cells: tuple[str, ...] = key("names of cell sets; all: what no other material names", ("all",))

    @property
    def material(self) -> Material:
        law = NeoHookean(youngs_modulus=self.youngs_modulus, poissons_ratio=self.poissons_ratio)
        return Material(self.name, law, self.density)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sphere:
    """Cells whose middle lies in a sphere make the cell set NAME, for a material's `cells`; NAME is free."""

    name: str
    centre: tuple[float, float, float] = key("its centre", unit="mm")
    radius: float = key("its radius", unit="mm", limits="(0, inf)")


_XYZ = Literal["x", "y", "z"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fixed:
    """Nodes that are held; any number of these."""

    nodes: str = key("name of a node set")
    directions: tuple[_XYZ, ...] = key("directions that are held", ("x", "y", "z"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Displaced:
    """Nodes that are moved along the loading curve; any number of these."""

    nodes: str = key("name of a node set")
    displacement: tuple[float, ...] | None = key("displacement at full load, one for each direction", None, "mm")
    field: Path | None = key(
        "instead: CSV of x, y, z, ux, uy, uz, places and their displacements, carried over to the nodes", None
    )
    field_unit: _Length | None = key("unit of length of `field`; mm unless given", None)
    directions: tuple[_XYZ, ...] = key("directions that are prescribed; the others stay free", ("x", "y", "z"))
    rotation: float = key("angle at full load, by which the nodes are turned as well", 0.0, "degrees", "[-360, 360]")
    axis: _XYZ = key("direction of the rotation's axis", "z")
    centre: tuple[float, float, float] = key("a point on the rotation's axis", (0.0, 0.0, 0.0), "mm")


@dataclass(frozen=True, slots=True, kw_only=True)
class Solver:
    """Explicit time integration."""

    method: Literal["quasi-static", "dynamic-relaxation", "dynamic"] = key(
        "slow loading; damped steps to the static solution; or waves, with the true masses", "dynamic-relaxation"
    )
    load_time: float = key("quasi-static, dynamic: duration of the load", 2.0, "s", "(0, inf)")
    hold_time: float = key("quasi-static, dynamic: duration after it, at full load", 0.0, "s", "[0, inf)")
    load_steps: Literal["auto"] | int = key(
        "dynamic-relaxation: steps of the load; auto: what cells beside moved nodes need, more if one inverts",
        "auto",
        limits="[1, inf)",
    )
    tolerance: float = key("dynamic-relaxation ends this near to the static solution", 0.01, "mm", "(0, inf)")
    time_step: Literal["auto"] | float = key(
        "time step, at most; auto: the longest stable one times safety", "auto", "s", "(0, inf)"
    )
    safety: float = key("share of the longest stable step, by power iteration, that is taken", 0.8, limits="(0, 1]")
    mass_scaling: bool = key("quasi-static: raise the mass of nodes that the step is too long for", True)
    on_inversion: Literal["stop", "recover"] = key(
        "an unstable run stops, or goes back a little and on with a stricter step (at most 5 times)", "stop"
    )
    precision: Literal["double", "single"] = key(
        "arithmetic of the cells' forces; nodes always move in double", "double"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Output:
    """What is written."""

    frames: int = key("frames over the load, the undeformed one not counted", 10, limits="[1, inf)")
    pictures: bool = key("draw the deformed body", True)
    stress: bool = key("also the Cauchy stress of every cell in every frame, in Pa: xx, yy, zz, xy, yz, xz", False)
    checkpoint_minutes: float = key(
        "time from one checkpoint to the next, for `run --resume`; 0: only when the run is interrupted", 10.0, "min",
        "[0, inf)",
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Partition:
    """How the mesh is divided among ranks."""

    seed: int = key("seed of METIS", 0, limits="[0, inf)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Deck:
    """A scene in SI units. Exactly one of the geometries is there."""

    title: str = key("what the scene is, in a few words", "")
    labels: Labels | None = None
    block: Block | None = None
    cylinder: Cylinder | None = None
    ellipsoid: Ellipsoid | None = None
    mesh: MeshFiles | None = None
    tumour: Tumour | None = None
    cloud: Cloud = field(default_factory=Cloud)
    support: Support = field(default_factory=Support)
    hexahedra: Hexahedra = field(default_factory=Hexahedra)
    spheres: tuple[Sphere, ...] = field(default=(), metadata={"section": "sphere"})
    materials: tuple[MaterialSection, ...] = field(default=(), metadata={"section": "material"})
    fixed: tuple[Fixed, ...] = ()
    displaced: tuple[Displaced, ...] = ()
    solver: Solver = field(default_factory=Solver)
    output: Output = field(default_factory=Output)
    partition: Partition = field(default_factory=Partition)
    path: Path  # of the deck, for messages

    def constraints(self) -> Iterator[Constraint]:
        """The held and the moved nodes, with the key that says so."""
        for i, held in enumerate(self.fixed):
            yield Constraint(held.nodes, _axes(held), (0.0,) * len(held.directions), f"{self.path}: fixed.{i}.nodes")
        for i, moved in enumerate(self.displaced):
            turn = Rotation(moved.rotation, "xyz".index(moved.axis), moved.centre)
            origin = f"{self.path}: displaced.{i}.nodes"
            axes, rotation = _axes(moved), turn if turn.angle else None
            displacement = moved.displacement or (0.0,) * len(axes)
            yield Constraint(
                moved.nodes, axes, displacement, origin, rotation, moved.field, METRES[moved.field_unit or "mm"]
            )


def _axes(section: Fixed | Displaced) -> tuple[int, ...]:
    return tuple("xyz".index(direction) for direction in section.directions)


# --- from TOML -----------------------------------------------------------------------------------------------------


def load_deck(
    path: str | Path, overrides: str | Sequence[str] = (), varied: Sequence[str] = (), place: str = "varied"
) -> Deck:
    """The scene of a TOML file, changed by one or more overrides "section.key=value"; InputError if anything is wrong.

    The right side of an override is a TOML value; quotes around a string may be left out. Entries of [[fixed]] and
    [[displaced]] count from 0: "fixed.0.nodes=skull". Files are relative to the deck's folder, also in overrides.
    Those of a case or variant, `varied`, come last; messages tell them apart by their `place`.
    """
    path = Path(path)
    table = _parse(path)
    overrides = [overrides] if isinstance(overrides, str) else overrides
    given = [*(("--set", text) for text in overrides), *((place, text) for text in varied)]
    source = _Source(path, {_override(table, text, option): option for option, text in given})
    deck: Deck = _section(Deck, table, "", source, {"path": path})
    _check(deck, source)
    return deck


class _Source(NamedTuple):
    """Where values come from, for messages."""

    path: Path
    overridden: Mapping[str, str]  # keys, and by what: --set, or varied

    def error(self, name: str, what: str, value: Any = MISSING) -> InputError:
        # An override of a part, or of the section around it, is to blame too.
        to_blame = (key for key in self.overridden if f"{name}.".startswith(f"{key}.") or key.startswith(f"{name}."))
        origin = self.overridden.get(next(to_blame, ""), self.path)
        try:
            shown = "" if value is MISSING else f" = {_show(value)}"
        except (RecursionError, ValueError):  # nested without end, or an integer of thousands of digits
            shown = ""
        name = _shorten(name)
        return InputError(_line(f"{origin}: {name}{shown}: {what}"))


def _parse(path: Path) -> dict[str, Any]:
    try:
        if not path.is_file() and not path.is_dir() and path.exists():
            raise InputError(f"{path}: is a device or a pipe; give the path of a deck (TOML)")
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give the path of a deck (TOML)") from None
    if path.suffix.lower() in OF_MESHES:
        what = f'is a mesh; check it by: mpitled check {path}; a deck computes it by: [mesh] fe = "{path.name}"'
        raise InputError(f"{path}: {what}")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError(f"{path}: line {line}: is not UTF-8 text; a deck is a TOML file in UTF-8") from None
    if len(content) > _MOST_BYTES or _most_parts(text) > _MOST_PARTS:
        raise InputError(f"{path}: is no deck; one has less than {_MOST_BYTES} bytes and keys of few parts")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: {_syntax(text, error)}") from None


def _most_parts(text: str) -> int:
    """Parts of the longest key."""
    most, parts, dot = 0, 0, True
    for token in _TOKEN.findall(text):
        if token == ".":
            parts, dot = (0 if dot else parts + 1), True
            most = max(most, parts)
        elif token.isspace() and token != "\n":
            continue
        elif len(token) > 1 or token.isalnum() or token in "_-":
            parts, dot = (parts if dot else 0), False
        else:
            parts, dot = 0, True
    return most


def _syntax(text: str, error: Exception) -> str:
    """The parser's message with the place in front and the line it stumbled over."""
    message, line = str(error), re.search(r"line (\d+)", str(error))
    if not line:
        return f"{message}; correct the TOML"
    shown = _shorten(_line(text.split("\n")[int(line[1]) - 1].strip()))
    what = message[: line.start()].removesuffix(" (at ")
    if _DECIMAL_COMMA.search(shown):
        what += " (decimals come after a point)"
    return f"line {line[1]}: {what}: {shown}; correct the TOML"


def _override(table: dict[str, Any], text: str, option: str) -> str:
    """Enter "section.key=value" into the table of the deck; the key's name."""
    name, equals, value = (part.strip() for part in text.partition("="))
    text = _line(text)
    steps = name.split(".")
    if not equals or not all(steps):
        raise InputError(f"{option} {text}: is not section.key=value; write for example --set tumour.volume=523.6")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):
        if value[:1] in {"", '"', "'", "[", "{"}:
            raise InputError(f"{option} {text}: the value is not TOML; check quotes and brackets") from None
        parsed = value
    place: Any = table
    for depth, step in enumerate(steps):
        within = ".".join(steps[:depth])
        if isinstance(place, list):
            if not step.isdecimal() or int(step) >= len(place):
                raise InputError(f"{option} {text}: the deck has {len(place)} [[{within}]]; count them from 0")
        elif not isinstance(place, dict):
            raise InputError(f"{option} {text}: {within} is a value, not a section; leave out .{step}")
        at: Any = int(step) if isinstance(place, list) else step
        if depth == len(steps) - 1:
            place[at] = parsed
        else:
            place = place[at] if isinstance(place, list) else place.setdefault(at, {})
    return name


def _keys(section: type) -> dict[str, tuple[Field[Any], Any]]:
    """Fields that a user can write, with their types, by their names in the deck."""
    hints = get_type_hints(section)
    return {
        f.metadata.get("section", f.name): (f, hints[f.name])
        for f in fields(section)
        if "key" in f.metadata or _sections(hints[f.name])
    }


def _sections(hint: Any) -> list[type]:
    """The section class in `Cloud`, `Tumour | None` or `tuple[Fixed, ...]`; nothing in the type of a value."""
    return [t for t in (hint, *get_args(hint)) if is_dataclass(t) and isinstance(t, type)]


def _named(section: type) -> bool:
    return any(f.name == "name" for f in fields(section))


def _section(cls: Any, table: Any, name: str, source: _Source, given: dict[str, Any] | None = None) -> Any:
    """The section `name` from its table; `given` has fields that are not keys."""
    if not isinstance(table, dict):
        raise source.error(name, f"is a value, not a section; write [{name}] above its keys", table)
    keys = _keys(cls)
    prefix = f"{name}." if name else ""
    for written in table:
        if written not in keys:
            raise source.error(prefix + written, f"{_unknown(written, list(keys), name)}", table[written])
    values = {}
    for written, (declared, hint) in keys.items():
        full = prefix + written
        if written not in table:
            if "key" in declared.metadata and declared.default is MISSING:
                about = declared.metadata["key"]
                raise source.error(full, f"is missing; give {_expected(hint, about)}: {about.meaning}")
        elif inner := _sections(hint):
            many = get_origin(hint) is tuple
            values[declared.name] = (_several if many else _section)(inner[0], table[written], full, source)
        else:
            values[declared.name] = _value(hint, table[written], declared.metadata["key"], full, source)
    return cls(**values, **(given or {}))


def _several(cls: type, entries: Any, name: str, source: _Source) -> tuple[Any, ...]:
    """Sections [name.NAME] in the order of the file if the class has a name, else [[name]]."""
    if _named(cls):
        if not isinstance(entries, dict):
            raise source.error(name, f"is not a section; write [{name}.NAME] above its keys", entries)
        for entry, table in entries.items():
            if entry in _keys(cls) and not isinstance(table, dict):
                what = f"belongs to one {name} by its name; write [{name}.NAME] above it"
                raise source.error(f"{name}.{entry}", what, table)
        return tuple(
            _section(cls, table, f"{name}.{entry}", source, {"name": entry}) for entry, table in entries.items()
        )
    if not isinstance(entries, list):
        raise source.error(name, f"there can be several; write [[{name}]] instead of [{name}]", entries)
    return tuple(_section(cls, table, f"{name}.{i}", source) for i, table in enumerate(entries))


def _unknown(written: str, valid: list[str], name: str) -> str:
    kind = "key" if name else "section or key"
    if near := difflib.get_close_matches(written[:100], valid, 1, 0.6):
        return f"unknown {kind}; did you mean {near[0]}?"
    homes = [home for home, _, about in _declared() if about and about[0] == written]
    if homes and (name or written != "title"):
        return f"unknown {kind}; {written} belongs to {' or '.join(homes)}"
    return f"unknown {kind}; there are {', '.join(valid)}"


# --- values --------------------------------------------------------------------------------------------------------


def _value(hint: Any, value: Any, about: _Key, name: str, source: _Source) -> Any:
    if about.empty and value == []:
        return ()
    try:
        converted = _convert(hint, value, about.limits)
    except ValueError as error:
        default = "" if about.default in (MISSING, None) else f" (default {_show(about.default)})"
        remedy = f"give {_expected(hint, about)}{default}"
        if get_origin(hint) is tuple and name in source.overridden and isinstance(value, str) and "," in value:
            remedy += f", in brackets: '{name}=[{', '.join(part.strip() for part in value.split(','))}]'"
        raise source.error(name, f"{error}; {remedy}", value) from None
    if isinstance(converted, Path):
        converted = source.path.parent / converted
        try:
            there = converted.is_file()
        except OSError:  # a name that is too long
            there = False
        if not there:
            raise source.error(name, f"there is no file {converted}; give a path relative to the deck's folder", value)
    return _si(converted, about.unit)


def _convert(hint: Any, value: Any, limits: str) -> Any:
    """The value as the type says, in the deck's unit; ValueError says what is wrong with it."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        *others, last = (t for t in args if t is not type(None))
        for option in others:
            try:
                return _convert(option, value, limits)
            except ValueError:
                continue
        return _convert(last, value, limits)
    if origin is Literal:
        if type(value) is not type(args[0]) or value not in args:
            known = [str(a) for a in args]
            near = difflib.get_close_matches(value[:100], known, 1) if isinstance(value, str) else ()
            raise ValueError(f"is not offered; did you mean {near[0]}?" if near else "is not offered")
        return value
    if origin is tuple:
        return _convert_list(args, value, limits)
    if hint is float and type(value) in (int, float):
        if abs(value) > sys.float_info.max or math.isnan(value):
            raise ValueError("is not a finite number")
        if abs(value) > 1 / _FINEST or (limits.startswith("(0") and 0 < value < _FINEST):
            raise ValueError(f"is not between {_FINEST:g} and {1 / _FINEST:g}")
        return _within(float(value), limits)
    if hint is int and type(value) is int:
        if abs(value) >= 2**31:
            raise ValueError("is too large an integer")
        return _within(value, limits)
    if hint in (str, Path) and type(value) is str:
        if not value.strip() and hint is Path:
            raise ValueError("is empty")
        return hint(value)
    if hint is bool and type(value) is bool:
        return value
    raise ValueError(f"is {_KINDS.get(type(value), 'a date or time')}")


_TYPES = {bool: "true or false", int: "an integer", float: "a number", str: "a string", Path: "a path"}
_KINDS = {**_TYPES, list: "a list", dict: "a section"}


def _convert_list(types: tuple[Any, ...], value: Any, limits: str) -> tuple[Any, ...]:
    if type(value) is not list:
        raise ValueError(f"is {_KINDS.get(type(value), 'a date or time')}, not a list")
    free = types[-1] is Ellipsis
    if (free and not value) or (not free and len(value) != len(types)):
        raise ValueError(f"has {len(value)} entries")
    converted = []
    for position, entry in enumerate(value):
        try:
            converted.append(_convert(types[0], entry, limits))
        except ValueError as error:
            raise ValueError(f"entry {position + 1} {error}") from None
    # Lists of free length other than of floats (labels, sets, directions) are sets.
    if free and types[0] is not float and len(set(converted)) < len(converted):
        raise ValueError("has an entry twice")
    return tuple(converted)


def _within(value: Any, limits: str) -> Any:
    for holds, words in _bounds(limits):
        if not holds(value):
            raise ValueError(f"is not {words}")
    return value


def _bounds(limits: str) -> Iterator[tuple[Any, str]]:
    """Test and words of each finite end of an interval such as "(0, 0.5]"."""
    if limits:
        low, high = limits[1:-1].split(", ")
        if low != "-inf":
            yield (float(low).__lt__, f"above {low}") if limits[0] == "(" else (float(low).__le__, f"at least {low}")
        if high != "inf":
            yield (
                (float(high).__ge__, f"at most {high}") if limits[-1] == "]" else (float(high).__gt__, f"below {high}")
            )


def _expected(hint: Any, about: _Key) -> str:
    """What to give for a key, in words: "3 numbers above 0, in mm"."""
    words = _type_words(hint)
    limits = " and ".join(words for _, words in _bounds(about.limits))
    words += (f" {limits}" if limits else "") + (f", in {about.unit}" if about.unit else "")
    return words + (", or [] for none" if about.empty else "")


def _type_words(hint: Any) -> str:
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return " or ".join(_type_words(t) for t in args if t is not type(None))
    if origin is Literal:
        return " or ".join(_show(choice) for choice in args)
    if origin is tuple:
        number = "" if args[-1] is Ellipsis else f"{len(args)} "
        several = {float: "numbers", int: "integers", str: "strings"}.get(args[0]) or _type_words(args[0])
        return f"a list of {number}{several}"
    return _TYPES[hint]


def _show(value: Any) -> str:
    """A value as TOML would have it, in one line."""
    if isinstance(value, str | bool):
        return _shorten(json.dumps(value, ensure_ascii=False))
    if isinstance(value, list | tuple):
        return _shorten(f"[{', '.join(_show(v) for v in value)}]")
    if isinstance(value, dict):
        return _shorten(f"{{{', '.join(f'{k} = {_show(v)}' for k, v in value.items())}}}")
    return f"{value:.10g}" if isinstance(value, float) else _shorten(str(value))


def _line(text: str) -> str:
    """Names and overrides can hold line breaks, messages must not."""
    return " ".join(text.splitlines())


def _shorten(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."


# --- what keys ask of each other -----------------------------------------------------------------------------------


GEOMETRIES = ("labels", "block", "cylinder", "ellipsoid", "mesh")
_OFFERED = "[labels], [block], [cylinder], [ellipsoid] and [mesh]"


def _check(deck: Deck, source: _Source) -> None:
    given = canonical(deck)
    geometries = [name for name in GEOMETRIES if name in given]
    if len(geometries) != 1:
        found = f"has {' and '.join(f'[{name}]' for name in geometries) or 'no geometry'}"
        raise InputError(f"{deck.path}: {found}; give exactly one of {_OFFERED}")
    if not deck.materials and not deck.mesh:
        raise InputError(f"{deck.path}: has no material; give at least one [material.NAME] with youngs_modulus")
    owner: dict[str, str] = {}
    for section in deck.materials:
        for cells in section.cells:
            if other := owner.get(cells):
                what = f"{cells} is filled by material.{other} already; give each set of cells one material"
                raise source.error(f"material.{section.name}.cells", what, section.cells)
            owner[cells] = section.name
    if deck.support.nodes < deck.support.basis:
        what = f"is fewer than the {deck.support.basis} monomials of support.basis; give at least as many"
        raise source.error("support.nodes", what, deck.support.nodes)
    if deck.labels:
        named: dict[int, str] = {}
        for name in ("tissue", "left_ventricle", "right_ventricle"):
            for label in getattr(deck.labels, name):
                if label in named:
                    remedy = "give each label one place"
                    if named[label] == "left_ventricle":
                        remedy = "give it to labels.left_ventricle and leave labels.right_ventricle = []"
                    what = f"label {label} is in labels.{named[label]} already; {remedy}"
                    raise source.error(f"labels.{name}", what, getattr(deck.labels, name))
                named[label] = name
    if deck.tumour:
        _check_tumour(deck, given, source)
    spheres = [sphere.name for sphere in deck.spheres]
    if deck.block and deck.block.fitted is not None and deck.block.fitted not in spheres:
        what = f"is none of the spheres ({', '.join(spheres) or 'there are none'}); add [sphere.{deck.block.fitted}]"
        raise source.error("block.fitted", what, deck.block.fitted)
    for i, moved in enumerate(deck.displaced):
        if moved.displacement is None and moved.field is None:
            what = "is missing; give a list of numbers, in mm, or displaced.field, a CSV of places and displacements"
            raise source.error(f"displaced.{i}.displacement", what)
        if moved.displacement and moved.field:
            raise source.error(f"displaced.{i}.field", "is there beside displacement; give one of the two")
        if moved.displacement and len(moved.displacement) != len(moved.directions):
            what = f"has not one number for each of {_show(moved.directions)}; give {len(moved.directions)}, in mm"
            raise source.error(f"displaced.{i}.displacement", what, given["displaced"][i]["displacement"])
        if moved.rotation and set("xyz") - {moved.axis} - set(moved.directions):
            what = f"turns nodes about {moved.axis} that are free in a direction across it; prescribe that too"
            raise source.error(f"displaced.{i}.directions", what, moved.directions)
    step = deck.solver.time_step
    if step != "auto" and step > deck.solver.load_time:
        what = f"is longer than solver.load_time; give less than {deck.solver.load_time:g} s"
        raise source.error("solver.time_step", what, step)


def _check_tumour(deck: Deck, given: dict[str, Any], source: _Source) -> None:
    assert deck.tumour is not None
    radius = given["tumour"]["seed_radius"]
    seed_volume = 4 / 3 * math.pi * radius * radius * radius  # a power of a slip raises OverflowError
    if given["tumour"]["volume"] < seed_volume:
        what = f"is less than the seed's {seed_volume:.4g} mm3; give more, or a smaller tumour.seed_radius"
        raise source.error("tumour.volume", what, given["tumour"]["volume"])
    if deck.cloud.radius <= deck.tumour.seed_radius and not deck.mesh:
        what = f"lies within the seed; give more than tumour.seed_radius = {given['tumour']['seed_radius']:g} mm"
        raise source.error("cloud.radius", what, given["cloud"]["radius"])
    for name, shape in (("block", deck.block), ("cylinder", deck.cylinder)):
        if shape and shape.cloud == "none":
            raise source.error(f"{name}.cloud", 'leaves a tumour no cloud to grow in; give "core" or "all"', "none")


# --- what others make of the deck ----------------------------------------------------------------------------------


def canonical(deck: Deck, *, paths: bool = True) -> dict[str, Any]:
    """Every value that took effect, defaults too, in the deck's layout and units; ready for JSON or TOML.

    Without paths: a file may have been moved, and be the same.
    """

    def plain(section: Any) -> dict[str, Any]:
        table: dict[str, Any] = {}
        for written, (declared, hint) in _keys(type(section)).items():
            value = getattr(section, declared.name)
            if inner := _sections(hint):
                if is_dataclass(value):
                    table[written] = plain(value)
                elif value and _named(inner[0]):
                    table[written] = {entry.name: plain(entry) for entry in value}
                elif value:
                    table[written] = [plain(entry) for entry in value]
            elif value is not None and (paths or not isinstance(value, Path)):
                plain_value = str(value) if isinstance(value, Path) else value
                table[written] = _in_unit(plain_value, declared.metadata["key"].unit)
        return table

    return plain(deck)


def recorded(table: Mapping[str, Any], path: Path) -> Deck:
    """The deck that `canonical` told so, without its geometry and its motion, whose files may be gone by now."""
    without = (*GEOMETRIES, "fixed", "displaced")
    kept = {name: section for name, section in table.items() if name not in without}
    deck: Deck = _section(Deck, kept, "", _Source(path, {}), {"path": path})
    return deck


def difference(deck: Deck, earlier: dict[str, Any]) -> str:
    """The first key that matters to the result and differs from what was `canonical` without paths; "" if none does."""
    now = json.loads(json.dumps(canonical(deck, paths=False)))
    first = next(differences(now, earlier), None)
    if first is None:
        return ""
    name, *values = first
    after, before = ("not there" if value is None else _show(value) for value in values)
    return f"{name} = {before}, and not {after}"


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Keys that matter to the result and differ between two decks, as JSON has what is `canonical`, and both values.

    A value that is not there is None.
    """
    first, second = dict(_flat(one)), dict(_flat(other))
    for name in dict.fromkeys([*second, *first]):
        if name not in _HARMLESS and first.get(name) != second.get(name):
            yield name, first.get(name), second.get(name)


def is_of_scene(name: str) -> bool:
    """Whether a key says what is computed, and not how: geometry, tumour, materials and motion."""
    return name.partition(".")[0] in (*GEOMETRIES, "tumour", "sphere", "material", "fixed", "displaced")


_HARMLESS = ("title", "output.pictures", "output.checkpoint_minutes")


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for part, inner in value.items():
            yield from _flat(inner, f"{name}.{part}" if name else part)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for i, inner in enumerate(value):
            yield from _flat(inner, f"{name}.{i}")
    else:
        yield name, value


_MODEL = (*GEOMETRIES, "tumour", "cloud", "support", "hexahedra", "spheres", "materials", "fixed", "displaced")


def model_key(deck: Deck, included: Sequence[Path] = ()) -> str:
    """What determines the model, as canonical JSON: this program, values in SI units, files by their SHA-256.

    `included` are files that those of the deck read in turn.
    """
    return _content(deck, _MODEL, included, program=program())


def scene_key(deck: Deck, included: Sequence[Path] = ()) -> str:
    """What determines the result, whatever the program: all sections, like `model_key`."""
    harmless = replace(deck, output=replace(deck.output, checkpoint_minutes=0.0))
    return _content(harmless, (f.name for f in fields(deck) if f.name not in ("title", "path")), included)


def _content(deck: Deck, names: Iterable[str], included: Sequence[Path], **more: str) -> str:
    sections = asdict(deck)
    content: dict[str, Any] = more | {name: sections[name] for name in names}
    if included:
        content["included"] = list(included)
    return json.dumps(content, sort_keys=True, separators=(",", ":"), default=_digest)


@functools.cache
def program() -> str:
    """This program by its sources: a model that others built may differ from what they would build."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return f"sha256:{digest.hexdigest()}"


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return f"sha256:{digest.hexdigest()}"


def keys(path: Path | None = None) -> dict[str, list[str]]:
    """Every "section.key" as `--set` takes it, with its values if they are few: of all sections that are there once; of
    a deck that can be read also those of which there are many, and none of other geometries.
    """
    try:
        table = _parse(path) if path else {}
    except InputError:
        table = {}
    found: dict[str, list[str]] = {}
    for home, _, about in _declared():
        section = home.strip("[]").partition(".")[0]
        if about is None or not home.startswith("[") or (table and section in GEOMETRIES and section not in table):
            continue
        of_deck = table.get(section, {})
        if home.startswith("[["):
            places = [f"{section}.{i}" for i in range(len(of_deck))]
        else:
            places = [f"{section}.{name}" for name in of_deck] if "." in home else [section]
        found |= {f"{place}.{about[0]}": _choices(about[1]) for place in places}
    return found


def _choices(hint: Any) -> list[str]:
    """Values as `--set` takes them."""
    if hint is bool:
        return ["true", "false"]
    if get_origin(hint) in (Union, UnionType):
        return [choice for of in get_args(hint) for choice in _choices(of)]
    return [str(choice) for choice in get_args(hint)] if get_origin(hint) is Literal else []


class Declared(NamedTuple):
    """What people are told of a key."""

    meaning: str
    expected: str  # "a number above 0, in mm"
    default: Any  # in the deck's unit; None where there is none


def declared(home: str) -> tuple[str, dict[str, Declared]]:
    """What a section is, written as "[labels]", "[material.NAME]" or "[[fixed]]", and its keys."""
    about, found = "", {}
    for of, section, entry in _declared():
        if of == home and entry:
            written, hint, key = entry
            default = None if key.default is MISSING else key.default
            found[written] = Declared(key.meaning, _expected(hint, key), default)
        elif of == home:
            about = (section.__doc__ or "").strip()
    return about, found


def unit_of(name: str) -> str:
    """Unit of the key "section.key" in a deck; "" if it has none, or there is no such key."""
    section, _, written = name.rpartition(".")
    home = section.partition(".")[0]
    declared = {(of.strip("[]").partition(".")[0], about[0]): about[2].unit for of, _, about in _declared() if about}
    return declared.get((home, written), "")


def markdown_table() -> str:
    """The table of all keys for the guide, jobs/README.md."""
    lines = ["| key | value | unit | default | meaning |", "|---|---|---|---|---|"]
    for home, section, entry in _declared():
        if entry:
            written, hint, about = entry
            value = _expected(hint, about._replace(unit="")).removeprefix("a list of ")
            default = {MISSING: "required", None: ""}.get(about.default, f"`{_show(about.default)}`")
            lines.append(f"| `{written}` | {value} | {about.unit} | {default} | {about.meaning} |")
        else:
            lines.append(f"| **`{home}`** | | | | {(section.__doc__ or '').strip()} |")
    return "\n".join(lines) + "\n"


def _declared() -> Iterator[tuple[str, type, tuple[str, Any, _Key] | None]]:
    """Every section as written, its class, and None for its heading, then name, type and declaration of each key."""
    for written, (declared, hint) in _keys(Deck).items():
        inner = _sections(hint)
        if not inner:
            yield "the top of the deck", Deck, (written, hint, declared.metadata["key"])
            continue
        many, named = get_origin(hint) is tuple, _named(inner[0])
        home = f"[{written}.NAME]" if named else f"[[{written}]]" if many else f"[{written}]"
        yield home, inner[0], None
        for name, (entry, entry_hint) in _keys(inner[0]).items():
            yield home, inner[0], (name, entry_hint, entry.metadata["key"])
