"""The figures of a report, each declared once. Report.json, tables, pages and guide iterate over the declarations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, get_type_hints

RELAXATION = "dynamic-relaxation"


@dataclass(frozen=True, slots=True)
class Figure:
    """The declaration of a figure: one number, or one number for each part (side, phase, kind of cell, rank)."""

    label: str = ""  # in the table; a figure without a label is in report.json only
    unit: str = ""
    form: str = ""  # format specification of the number
    meaning: str = ""  # in the guide
    headline: bool = False  # whether the figure is in the short table at the end of a run
    limit: float | None = None  # the report warns of a larger value
    relaxation: bool | None = None  # True: dynamic relaxation only; False: all other methods only
    scale: float = 1.0  # factor from the value in report.json to the unit
    total: bool = False  # whether the table shows the sum of the parts
    key: str = ""  # in report.json, by default the field's name; "a.b" is the key b in the object a
    part: str = ""  # the part of the field that this line of the table shows; all parts if empty

    def text(self, value: Any) -> str:
        """The value as a table cell: named parts with their names, a list (of ranks) without names."""
        if isinstance(value, Mapping):
            if self.total:
                return self.text(sum(value.values()))
            parts = ((name.replace("_", " "), part) for name, part in value.items() if part is not None)
            return ", ".join(f"{self.text(part)} {name}" for name, part in parts)
        if isinstance(value, list):
            return ", ".join(map(self.text, value))
        return f"{self.scale * value if self.scale != 1 else value:{self.form}} {self.unit}".rstrip()


def look_up(report: Mapping[str, Any], key: str) -> Any:
    """The value of a key ("a.b") of report.json; None if there is no such key."""
    value: Any = report
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def rows(report: Mapping[str, Any], *, headlines: bool = False) -> Iterator[tuple[str, str]]:
    """Label and value of each figure that report.json has, or of its headlines only."""
    relaxed = report.get("method") == RELAXATION
    for figure in FIGURES:
        selected = (figure.headline or not headlines) and figure.relaxation in (None, relaxed)
        value = look_up(report, figure.key) if selected else None
        if value is not None and value != {}:  # a killed run has no phases
            yield figure.label, figure.text(value)


def guide_table() -> str:
    """The Markdown table of labels and meanings in the guide (jobs/README.md)."""
    lines = (f"| {figure.label} | {figure.meaning} |" for figure in FIGURES if figure.meaning)
    return "\n".join(["| figure | meaning |", "|---|---|", *lines])


# --- declarations --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LowestJacobian:
    """The cell with the smallest J in the last frame."""

    now: float
    cell: str
    material: str
    place_mm: list[float]  # (3,), undeformed


@dataclass(slots=True, kw_only=True)
class Report:
    """The figures of a run in the user's units, in the order of the table; None if the scene has no such figure."""

    title: str = ""
    complete: bool = False  # whether the run reached its end
    load_share: float = 0.0
    method: str | None = None
    stopped: str | None = None  # the reason why the run did not reach its end
    max_displacement_mm: Annotated[
        float,
        Figure("largest displacement", "mm", ".2f", headline=True,
               meaning="of all nodes; if a tumour grows, the node is usually on the tumour's surface"),
    ] = 0.0  # fmt: skip
    max_displacement_outside_first_ring_mm: Annotated[
        float | None,
        Figure("outside the tumour's first ring of cells", "mm", ".2f",
               meaning="largest displacement of the tissue beyond the cells that touch the tumour"),
    ] = None  # fmt: skip
    max_displacement_of_ventricle_wall_mm: Annotated[
        dict[str, float] | None, Figure("largest, ventricle walls", "mm", ".2f", headline=True)
    ] = None
    share_over_5mm: Annotated[dict[str, float] | None, Figure("moved more than 5 mm", "", ".2%")] = None
    midline_shift_mm: Annotated[
        float | None,
        Figure("shift of the midline between the ventricles", "mm (+: to the right)", "+.2f", headline=True,
               meaning="largest displacement of the tissue between the ventricles, across the plane half-way between "
               "them"),
    ] = None  # fmt: skip
    ventricle_volume_ml: Annotated[dict[str, float] | None, Figure("ventricles, undeformed", "ml", ".3f")] = None
    ventricle_volume_change_ml: Annotated[
        dict[str, float] | None, Figure("ventricles, change", "ml", "+.3f", headline=True)
    ] = None
    tumour_volume_mm3: Annotated[
        float | None,
        Figure("tumour as reached", "mm3", ".1f", headline=True,
               meaning="volume of the sphere through the tumour's nodes"),
    ] = None  # fmt: skip
    tumour_volume_by_field_mm3: Annotated[
        float | None,
        Figure("tumour by the field at its nodes", "mm3", ".1f",
               meaning="the same volume from the moving-least-squares field, which is a little smoother"),
    ] = None  # fmt: skip
    volume_added_mm3: Annotated[
        float | None, Figure("volume added by the tumour", "mm3", ".1f", key="volume_balance.tumour_added_mm3")
    ] = None
    volume_pushed_mm3: Annotated[
        float | None,
        Figure("pushed through the interface", "mm3", ".1f", key="volume_balance.pushed_through_interface_mm3"),
    ] = None
    volume_compressed_mm3: Annotated[
        float | None, Figure("compression of the cloud", "mm3", ".1f", key="volume_balance.elastic_compression_mm3")
    ] = None
    volume_error: Annotated[
        float | None,
        Figure("volume balance, error", "", ".2%", key="volume_balance.relative_error", headline=True, limit=0.05,
               meaning="share of the added volume that neither leaves the cloud through the interface nor compresses "
               "it; the report warns above 5 %"),
    ] = None  # fmt: skip
    cloud_misfit_mm: Annotated[
        float | None,
        Figure("uncertainty of the cloud, worst node", "mm", ".3f", headline=True, limit=0.5,
               meaning="largest residual of moving least squares at a node; the error of the field there is about as "
               "large; the report warns above 0.5 mm"),
    ] = None  # fmt: skip
    cloud_misfit_of_90_percent_mm: float | None = None
    static_distance_mm: Annotated[
        float | None,
        Figure("distance from the static solution, estimated", "mm", ".2g", headline=True, limit=0.5,
               meaning="how far the run ended from the static solution of its mesh: an error of iteration, not of the "
               "mesh; the report warns above 0.5 mm"),
    ] = None  # fmt: skip
    min_jacobian: Annotated[
        float | None,
        Figure("smallest J, a cell's volume over undeformed", "", ".4f", headline=True,
               meaning="of all cells and steps; single cells on a tumour's surface may lose most of their volume"),
    ] = None  # fmt: skip
    low_jacobian_mm3: Annotated[
        float | None,
        Figure("in cells below J = 0.5", "mm3", ".3g", key="crushed.volume_mm3", headline=True,
               meaning="volume of the cells that lost more than half of theirs; the report warns above 2 % of the "
               "tumour's"),
    ] = None  # fmt: skip
    low_jacobian_cells: Annotated[int | None, Figure(key="crushed.cells")] = None
    smallest_jacobian: LowestJacobian | None = None
    energy_J: Annotated[
        dict[str, float] | None,
        Figure("external work", "J", ".4g", part="external", meaning="work of the prescribed displacements"),
        Figure("internal energy", "J", ".4g", part="internal",
               meaning="strain energy, and energy of hourglass control and of stabilisation"),
        Figure("kinetic energy", "J", ".4g", part="kinetic"),
        Figure("energy of added mass", "J", ".4g", part="added_mass", relaxation=False,
               meaning="energy that mass scaling adds"),
        Figure("dissipated by damping and changes of mass", "J", ".4g", part="dissipated", relaxation=True,
               meaning="energy that damping takes, less the energy that updates of the fictitious masses add; it may "
               "be negative, and the internal energy may exceed the external work"),
        Figure("energy balance, error", "", ".2%", part="balance_error",
               meaning="share of the largest energy that the other energies do not explain"),
    ] = None  # fmt: skip
    kinetic_to_internal: Annotated[
        dict[str, float] | None,
        Figure("kinetic/internal, largest after 10 %", "", ".2%", part="largest_after_10_percent", relaxation=False,
               meaning="largest ratio of the energies after 10 % of the load; a ramp is slow enough if it is a few "
               "percent"),
        Figure("kinetic/internal, at the end", "", ".2%", part="at_end", meaning="0 at rest"),
    ] = None  # fmt: skip
    nodes: Annotated[int | None, Figure("nodes", "", ",")] = None
    cells: Annotated[dict[str, int] | None, Figure("cells", "", ",")] = None
    ranks: Annotated[int | None, Figure("ranks")] = None
    steps: Annotated[int | None, Figure("steps", "", ",", headline=True)] = None
    time_step_s: Annotated[float | None, Figure("time step", "s", ".3g", relaxation=False)] = None
    cell_updates_per_second: Annotated[float | None, Figure("cell updates a second", "", ".3g")] = None
    halo_share: Annotated[
        float | None,
        Figure("halo's share of the loop, worst rank", "", ".1%",
               meaning="share of the loop spent on exchange, waits included"),
    ] = None  # fmt: skip
    imbalance: Annotated[
        float | None,
        Figure("imbalance of computing", "", ".1%",
               meaning="by how much longer than the mean rank the busiest rank computes"),
    ] = None  # fmt: skip
    seconds: Annotated[
        dict[str, float],
        Figure("run time", "s", ".1f", headline=True, total=True),
        Figure("run time, by phase", "s", ".1f"),
    ] = field(default_factory=dict)
    peak_memory_bytes: Annotated[list[int] | None, Figure("peak memory of each rank", "MiB", ".0f", scale=2.0**-20)] = (
        None
    )
    warnings: list[str] = field(default_factory=list)
    pictures: list[str] | str = ""  # names of files, or the reason why there are none
    other: dict[str, Any] = field(default_factory=dict)  # figures of the solver that are not declared here

    def as_json(self) -> dict[str, Any]:
        """The content of report.json: absent figures are omitted, and numbers that are not finite are null."""
        content: dict[str, Any] = dict(self.other)
        for name, key in _KEYS.items():
            value = getattr(self, name)
            if value is not None:
                outer, _, inner = key.rpartition(".")
                parent = content.setdefault(outer, {}) if outer else content
                parent[inner] = asdict(value) if isinstance(value, LowestJacobian) else value
        return dict(_finite(content))

    def set_figures(self, figures: Mapping[str, Any]) -> None:
        """Set the figures that the solver recorded, by their top-level keys in report.json."""
        for name, value in figures.items():
            if name in _KEYS:
                setattr(self, name, value)
            else:
                self.other[name] = value

    @property
    def volume_unaccounted_mm3(self) -> float:
        """Added volume that neither left the cloud nor compressed it; the report must have a balance."""
        added, pushed, compressed = self.volume_added_mm3, self.volume_pushed_mm3, self.volume_compressed_mm3
        assert added is not None
        assert pushed is not None
        assert compressed is not None
        return added - pushed - compressed


def _finite(value: Any) -> Any:
    """The value with None instead of numbers that are not finite, which JSON does not have."""
    if isinstance(value, Mapping):
        return {name: _finite(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and value - value != 0 else value


#: Key of each field in report.json, and all declarations, in the order of the table.
_KEYS: dict[str, str] = {}
FIGURES: list[Figure] = []
for _name, _hint in get_type_hints(Report, include_extras=True).items():
    _declared = [entry for entry in getattr(_hint, "__metadata__", ()) if isinstance(entry, Figure)]
    _KEYS[_name] = next((figure.key for figure in _declared if figure.key), _name)
    FIGURES += [replace(one, key=f"{_KEYS[_name]}.{one.part}".removesuffix(".")) for one in _declared if one.label]
del _KEYS["other"]
#: The first declaration of each key.
BY_KEY = {figure.key: figure for figure in reversed(FIGURES)}
