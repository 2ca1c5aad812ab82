"""The sections and keys of a deck. One declaration of each key gives its type, unit, default, limits and meaning.

Values of a deck are in mm, degrees and SI units; attributes of the sections are in SI units. Values in Python code,
such as `Cloud(radius=0.018)`, are in SI units too: only the values of a loaded deck are converted.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo, WithJsonSchema

from pydantic import InstanceOf, field_validator, model_validator  # isort: skip
from pydantic.json_schema import SkipJsonSchema
from pydantic_core import PydanticCustomError

from mpitled.laws import LAWS, Law, Material, NeoHookean
from mpitled.mesh import METRES, Constraint, Rotation

#: Number of the deck's units in one SI unit. The division by a power of ten rounds 5.1 mm to 0.0051 m.
_PER_SI = {"mm": 1e3, "mm3": 1e9, "degrees": 180 / math.pi}
#: Larger numbers are mistakes, and numbers below its inverse are zero, so that ratios and cubes of numbers are finite.
_LARGEST = 1e30
#: The law of a material without the key `law`.
DEFAULT_LAW = NeoHookean.name
#: The sections of which a deck has exactly one.
GEOMETRIES = ("labels", "block", "cylinder", "ellipsoid", "mesh")


def to_si(value: Any, unit: str) -> Any:
    """A value of a deck, or a tuple of values, in SI units."""
    if isinstance(value, tuple):
        return tuple(to_si(entry, unit) for entry in value)
    return value / _PER_SI[unit] if unit in _PER_SI and isinstance(value, float) else value


def from_si(value: Any, unit: str) -> Any:
    """A value in the deck's unit: the shortest decimal that `to_si` converts to the same SI value."""
    if unit not in _PER_SI or not isinstance(value, float):
        return value
    decimals = (float(f"{value * _PER_SI[unit]:.{digits}g}") for digits in (15, 16, 17))
    return next((decimal for decimal in decimals if to_si(decimal, unit) == value), value * _PER_SI[unit])


def _strict(value: Any) -> Any:
    """A TOML value with tuples instead of lists; tiny floats become 0, huge numbers infinite."""
    if isinstance(value, dict):
        return {name: _strict(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return tuple([_strict(inner) for inner in value])
    if isinstance(value, float) and 0 < abs(value) < 1 / _LARGEST:
        return 0.0
    return math.inf if isinstance(value, int | float) and abs(value) > _LARGEST else value


def key(meaning: str, default: Any = ..., unit: str = "", **limits: Any) -> Any:
    """A key of a section. `default` and `limits` (of pydantic) are in the deck's `unit`. Without default: required."""
    extra = {"unit": unit} | ({} if default in (..., None) else {"default": default})
    return Field(to_si(default, unit), description=meaning, json_schema_extra=extra, **limits)


def _check_distinct(values: tuple[Any, ...]) -> tuple[Any, ...]:
    if len(set(values)) < len(values):
        raise PydanticCustomError("distinct", "has an entry twice")
    return values


def _check_file(value: Any, info: ValidationInfo) -> Any:
    """The path of a file that a deck names; the context of the validation is the deck's folder."""
    if info.context is None or not isinstance(value, str):
        return value
    path = info.context / value
    try:
        exists = path.is_file()
    except (OSError, ValueError):  # a name that is too long, or has a null character
        exists = False
    if not exists:
        raise PydanticCustomError("file", "there is no file {path}", {"path": str(path)})
    return path


def _add_names(tables: Any) -> Any:
    if not isinstance(tables, dict):
        return tables
    return {name: table | {"[NAME]": name} if isinstance(table, dict) else table for name, table in tables.items()}


_T = TypeVar("_T")
_Distinct = Annotated[tuple[_T, ...], AfterValidator(_check_distinct)]
_Named = Annotated[dict[str, _T], BeforeValidator(_add_names)]  # sections [section.NAME]
_File = Annotated[Path, BeforeValidator(_check_file)]
_Positive = Annotated[float, Field(gt=0)]
_NotNegative = Annotated[float, Field(ge=0)]
_Fraction = Annotated[float, Field(gt=0, lt=1)]
_Share = Annotated[float, Field(gt=0, le=1)]
_Integer = Annotated[int, Field(lt=2**31)]
_Count = Annotated[_Integer, Field(ge=1)]
_Vector = tuple[float, float, float]
_Sizes = tuple[_Positive, _Positive, _Positive]
_Length = Literal["m", "cm", "mm"]
_Stress = Literal["Pa", "kPa", "MPa", "GPa"]
_Replaced = Literal["none", "core", "all"]
_Axis = Literal["x", "y", "z"]
_XYZ = ("x", "y", "z")


class Section(BaseModel):
    """A section of a deck: immutable, without conversion of types and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_by_name=True)

    @field_validator("*", mode="after")
    @classmethod
    def _convert(cls, value: Any, info: ValidationInfo) -> Any:
        return value if info.context is None else to_si(value, cls.unit_of(str(info.field_name)))

    @classmethod
    def unit_of(cls, name: str) -> str:
        """The unit of a field in a deck; "" if the field has none."""
        extra = cls.model_fields[name].json_schema_extra
        return str(extra.get("unit", "")) if isinstance(extra, dict) else ""


class Labels(Section):
    """Geometry: hexahedra made from a label image (0 is outside)."""

    image: _File = key("label image (NIfTI or MGH)")
    element_size: _Positive = key("edge of a hexahedron", 4.0, "mm")
    tissue: _Distinct[_Count] = key("labels of brain tissue", (1,), min_length=1)
    left_ventricle: _Distinct[_Count] = key("labels of the left ventricle", (2,))
    right_ventricle: _Distinct[_Count] = key("labels of the right ventricle", (3,))


class Block(Section):
    """Geometry: a block of equal hexahedra."""

    corner: _Vector = key("corner of least x, y, z", (0.0, 0.0, 0.0), "mm")
    size: _Sizes = key("edges along x, y, z", unit="mm")
    elements: tuple[_Count, _Count, _Count] = key("number of hexahedra along x, y, z")
    cloud: _Replaced = key("what the cloud replaces: nothing, an inner block, everything", "none")
    core_share: _Fraction = key('share of each edge that `cloud = "core"` replaces', 0.5)
    fitted: str | None = key("name of a [sphere.NAME] that hexahedra follow; `elements` are then along the edges", None)


class Cylinder(Section):
    """Geometry: a cylinder along z around the origin. Its base is at z = 0."""

    radius: _Positive = key("radius", unit="mm")
    height: _Positive = key("height", unit="mm")
    element_size: _Positive = key("mean edge of a hexahedron", 5.0, "mm")
    cloud: _Replaced = key("what the cloud replaces: nothing, the inner part, everything", "none")
    core_share: _Fraction = key('share of radius and height that `cloud = "core"` replaces', 0.5)
    grading: _Share = key('thickness of end layers and outermost ring in mean edges; 1 with `cloud = "all"`', 0.15)


class Ellipsoid(Section):
    """Geometry: an ellipsoid around the origin."""

    semi_axes: _Sizes = key("semi-axes along x, y, z", unit="mm")
    element_size: _Positive = key("mean edge of a hexahedron", 5.0, "mm")
    cloud: _Replaced = key("what the cloud replaces: nothing, the inner part, everything", "none")
    core_share: _Fraction = key('share of the semi-axes that `cloud = "core"` replaces', 0.5)
    grading: _Share = key('edges at the rims of patch and fixed in mean edges; 1 with `cloud = "all"`', 1.0)
    cavity: Literal["fitted", "moved"] = key("seed without a cloud: in shells, or one hexahedron (the paper)", "fitted")


class MeshFiles(Section):
    """Geometry: meshes made by other programs."""

    fe: _File | None = key("nodes, hexahedra and sets (Abaqus, LS-DYNA, or a format of meshio)", None)
    efg: _File | None = key("nodes of the cloud; nodes on the interface may be repeated", None)
    integration_points: _File | None = key("CSV or HDF5 with x, y, z, volume and, if needed, sets", None)
    dropped: _Distinct[str] = key("cell sets of `fe` whose hexahedra the cloud replaces", ())
    cuts: Annotated[int, Field(ge=1, le=16)] = key(
        "without `integration_points`: integration cells along each edge of a dropped hexahedron; if none is dropped, "
        "the cells of `efg` are the integration cells", 2
    )  # fmt: skip
    surface_areas: _File | None = key(
        "CSV of node, x, y, z: the outer surface's share of constant stress at nodes on the cloud's boundary", None
    )
    unit: _Length = key("unit of length of `fe`, and of the other files unless they have their own", "m")
    efg_unit: _Length | None = key("unit of length of `efg`", None)
    integration_unit: _Length | None = key("unit of length of `integration_points`", None)
    stress_unit: _Stress = key("unit of stress of `fe`, and of `efg` unless it has its own", "Pa")
    efg_stress_unit: _Stress | None = key("unit of stress of `efg`", None)
    density_unit: Literal["consistent", "kg/m3", "g/cm3", "kg/mm3", "t/mm3"] = key(
        "unit of density of both; consistent: it follows from length, stress and seconds, as t/mm3 from mm and MPa",
        "consistent",
    )
    repair: bool = key("reorder the nodes of hexahedra that are numbered inside out or crosswise", False)
    merge_tolerance: _NotNegative = key("nodes of both meshes closer than this are one", 0.001, "mm")


class Tumour(Section):
    """A sphere that grows from a seed (optional)."""

    centre: _Vector = key("centre of seed and tumour, in the image's coordinates", unit="mm")
    volume: _Positive = key("volume of the whole sphere at full load", unit="mm3")
    seed_radius: _Positive = key("radius of the sphere at the start", 2.0, "mm")
    surface_nodes: _Integer = key("nodes on the seed's surface; the fewer, the smaller is their hull", 800, ge=12)


class Cloud(Section):
    """EFG nodes and integration points in place of hexahedra."""

    radius: _Positive = key("tissue hexahedra this near to the tumour's centre are replaced", 18.0, "mm")
    growth: _Positive = key("node spacing as a share of the distance to the seed's centre", 0.2)
    spacing: _NotNegative = key("largest node spacing; 0: the size of a hexahedron", 0.0, "mm")
    irregularity: float = key("random shift of nodes as a share of the spacing", 0.3, ge=0, lt=0.5)
    seed: _Integer = key("seed of the random numbers", 0, ge=0)
    points_per_spacing: _Positive = key("integration cells per node spacing, in each direction", 1.1)


class Support(Section):
    """Support domains of the integration points."""

    nodes: _Integer = key("nodes in a support domain, n; the paper: 8", 20, ge=4)
    basis: Literal[4, 10, 20] = key("monomials of the basis, m: linear, quadratic, cubic", 4)
    weight: Literal["equal", "quartic"] = key("weight of the moving least squares; the paper: equal", "quartic")
    max_fe_nodes: _Integer = key("largest number of FE nodes in a support domain; the paper: 7", 19, ge=0)
    min_domains: _Count = key("smallest number of support domains that an EFG node is in", 3)
    stabilisation: _NotNegative = key("stiffness of modes that the gradient does not see; 0: the paper", 0.1)
    consistency: bool = key("correct gradients so that a constant stress is in balance; false: the paper", True)


class Hexahedra(Section):
    """One-point hexahedra."""

    hourglass: _NotNegative = key("hourglass stiffness, R_hg of the paper", 0.04 / 9)
    gradient: Literal["mean", "centre"] = key("mean over the volume, or at the centre as in the paper", "mean")


class Sphere(Section):
    """Cells whose centre lies in a sphere make the cell set NAME, for a material's `cells`; NAME is free."""

    name: SkipJsonSchema[str] = Field("", validation_alias="[NAME]")
    centre: _Vector = key("centre of the sphere", unit="mm")
    radius: _Positive = key("radius of the sphere", unit="mm")


class MaterialSection(Section):
    """A material and the cells that it fills; NAME is free."""

    name: SkipJsonSchema[str] = Field("", validation_alias="[NAME]")
    law: Annotated[InstanceOf[Law], WithJsonSchema({"enum": list(LAWS), "default": DEFAULT_LAW})] = key("material law")
    density: _Positive = key("density", 1000.0, "kg/m3")
    cells: _Distinct[str] = key("names of cell sets; all: cells that no other material names", ("all",), min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _make_law(cls, table: Any, info: ValidationInfo) -> Any:
        """The table of a deck with a law instead of the law's name and parameters."""
        if info.context is None or not isinstance(table, dict):
            return table
        common = {field.validation_alias or name for name, field in cls.model_fields.items()}
        keys = {name: value for name, value in table.items() if name in common}
        law = LAWS.get(str(table.get("law", DEFAULT_LAW)))
        return keys | ({"law": law.model_validate({k: v for k, v in table.items() if k not in common})} if law else {})

    @property
    def material(self) -> Material:
        """The material in SI units."""
        return Material(self.name, self.law, self.density)


class Fixed(Section):
    """Nodes that are held; any number of these sections."""

    nodes: str = key("name of a node set")
    directions: _Distinct[_Axis] = key("directions that are held", _XYZ, min_length=1)


class Displaced(Section):
    """Nodes that are moved along the loading curve; any number of these sections."""

    nodes: str = key("name of a node set")
    displacement: tuple[float, ...] | None = key("displacement at full load, by direction", None, "mm", min_length=1)
    field: _File | None = key("instead: CSV of x, y, z, ux, uy, uz, interpolated at the nodes", None)
    field_unit: _Length | None = key("unit of length of `field`; mm unless given", None)
    directions: _Distinct[_Axis] = key("directions that are prescribed; the others stay free", _XYZ, min_length=1)
    rotation: float = key("angle at full load by which the nodes are also rotated", 0.0, "degrees", ge=-360, le=360)
    axis: _Axis = key("direction of the axis of rotation", "z")
    centre: _Vector = key("a point on the axis of rotation", (0.0, 0.0, 0.0), "mm")


class Solver(Section):
    """Explicit time integration."""

    method: Literal["quasi-static", "dynamic-relaxation", "dynamic"] = key(
        "slow loading; damped steps to the static solution; or waves, with the true masses", "dynamic-relaxation"
    )
    load_time: _Positive = key("quasi-static, dynamic: duration of the load", 2.0, "s")
    hold_time: _NotNegative = key("quasi-static, dynamic: duration after the load, at full load", 0.0, "s")
    load_steps: Literal["auto"] | _Count = key(
        "dynamic-relaxation: steps of the load; auto: what cells beside moved nodes need, more if one inverts", "auto"
    )
    tolerance: _Positive = key("dynamic-relaxation stops at this distance from the static solution", 0.01, "mm")
    time_step: Literal["auto"] | _Positive = key("largest time step; auto: `safety` times the stable step", "auto", "s")
    safety: _Share = key("share of the longest stable step, by power iteration, that is taken", 0.8)
    mass_scaling: bool = key("quasi-static: raise the mass of nodes for which the step is too long", True)
    on_inversion: Literal["stop", "recover"] = key("stop, or restore a state and shorten the step, 5 times", "stop")
    precision: Literal["double", "single"] = key("precision of the cells' forces; the rest is double", "double")


class Output(Section):
    """What is written."""

    frames: _Count = key("frames over the load, without the undeformed one", 10)
    pictures: bool = key("draw the deformed body", True)
    stress: bool = key("also the Cauchy stress of every cell in every frame, in Pa: xx, yy, zz, xy, yz, xz", False)
    checkpoint_minutes: _NotNegative = key("time between checkpoints; 0: only of an interrupted run", 10.0, "min")


class Partition(Section):
    """How the mesh is divided among ranks."""

    seed: _Integer = key("seed of METIS", 0, ge=0)


class Deck(Section):
    """A scene in SI units, with exactly one geometry."""

    title: str = key("what the scene is, in a few words", "")
    labels: Labels | None = None
    block: Block | None = None
    cylinder: Cylinder | None = None
    ellipsoid: Ellipsoid | None = None
    mesh: MeshFiles | None = None
    tumour: Tumour | None = None
    cloud: Cloud = Cloud()
    support: Support = Support()
    hexahedra: Hexahedra = Hexahedra()
    sphere: _Named[Sphere] = {}
    material: _Named[MaterialSection] = {}
    fixed: tuple[Fixed, ...] = ()
    displaced: tuple[Displaced, ...] = ()
    solver: Solver = Solver()
    output: Output = Output()
    partition: Partition = Partition()
    path: SkipJsonSchema[Path] = Field(validation_alias="[path]")  # of the deck, for messages

    @property
    def spheres(self) -> tuple[Sphere, ...]:
        """In the order of the deck."""
        return tuple(self.sphere.values())

    @property
    def materials(self) -> tuple[MaterialSection, ...]:
        """In the order of the deck."""
        return tuple(self.material.values())

    @classmethod
    def from_table(cls, table: dict[str, Any], path: Path) -> Deck:
        """The deck of a TOML table. pydantic's ValidationError if the table is wrong."""
        return cls.model_validate(_strict(table) | {"[path]": path}, context=path.parent, by_alias=True, by_name=False)

    def constraints(self) -> Iterator[Constraint]:
        """The fixed and the displaced nodes, each with the key that prescribes them."""
        for i, fixed in enumerate(self.fixed):
            yield Constraint(fixed.nodes, _axes(fixed), (0.0,) * len(fixed.directions), f"{self.path}: fixed.{i}.nodes")
        for i, s in enumerate(self.displaced):
            axes, origin, unit = _axes(s), f"{self.path}: displaced.{i}.nodes", METRES[s.field_unit or "mm"]
            rotation = Rotation(s.rotation, "xyz".index(s.axis), s.centre) if s.rotation else None
            displacement = s.displacement or (0.0,) * len(axes)
            yield Constraint(s.nodes, axes, displacement, origin, rotation, s.field, unit)


def _axes(section: Fixed | Displaced) -> tuple[int, ...]:
    return tuple("xyz".index(direction) for direction in section.directions)
