"""`mpitled report DIR --html`: all results of a run on one HTML page, which is one file."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import atomic, store, toml
from mpitled.deck import GEOMETRIES, unit_of
from mpitled.results import final_state, markup, report
from mpitled.results.figures import RELAXATION, Report, rows
from mpitled.results.final_state import FinalState
from mpitled.results.markup import Picture
from mpitled.results.report import LARGE, PAGE

_METHODS = {
    "quasi-static": "a quasi-static ramp",
    RELAXATION: "dynamic relaxation to the static solution",
    "dynamic": "dynamics, with the true masses",
}
_Rows = list[tuple[str, ...]]


def write(directory: Path, figures: Report) -> Path:
    """Write report.html for the run in a directory, complete or not, and return the path. InputError if this fails."""
    state = final_state.read(directory)
    with store.open_result(directory) as result:
        times, series = result.times, result.series
    deck, metadata = dict(state.metadata["deck"]), state.metadata
    pictures = _pictures(directory, state, figures, times, series)
    text = markup.render(
        "run.html",
        title=state.title,
        method=_METHODS[deck["solver"]["method"]],
        versions=metadata["versions"],
        ranks=metadata["ranks"],
        notes=_notes(figures, pictures["missing"]),
        cards=list(_cards(figures)),
        has_tumour="tumour" in deck,
        geometry=_geometry(deck),
        materials=_materials(state),
        motions=_motions(deck, metadata["tumour"]),
        deck_lines=list(toml.lines(deck)),
        counts=_counts(state),
        model_notes=state.model.notes,
        displacements=_displacements(figures),
        has_cloud=state.model.n_nodes > state.model.n_fe_nodes,
        ventricles=_ventricles(figures),
        balance_rows=_balance(figures),
        history_lines=_history(times, series, figures) if len(times) > 1 else [],
        seconds=figures.seconds,
        term_seconds=figures.other.get("term_seconds"),
        absent=metadata.get("left_out", ()),
        figure_rows=list(rows(figures.as_json())),
        **pictures,
    )
    atomic.write_text(directory / PAGE, text)
    return directory / PAGE


def _notes(figures: Report, missing: str) -> list[list[str]]:
    """The highlighted notes at the head of the page, as lists of lines."""
    incomplete = [] if figures.complete else [f"The run is {report.incomplete(figures.as_json())}."]
    warnings = [f"Warning: {warning}." for warning in figures.warnings]
    install = f"There are no pictures, because {missing} is missing: pip install 'mpitled[pictures]'."
    return [lines for lines in (incomplete, warnings, [install] if missing else []) if lines]


def _cards(figures: Report) -> Iterator[tuple[str, str]]:
    """Name and value of the most important figures."""
    if walls := figures.max_displacement_of_ventricle_wall_mm:
        yield "largest displacement of a ventricle's wall", f"{max(walls.values()):.2f} mm"
    else:
        yield "largest displacement", f"{figures.max_displacement_mm:.2f} mm"
    if (shift := figures.midline_shift_mm) is not None:
        yield f"shift of the midline, {_direction(shift)}", f"{abs(shift):.2f} mm"
    if change := figures.ventricle_volume_change_ml:
        yield "change of the ventricles", f"{change['total']:+.3f} ml"
    if volume := figures.tumour_volume_mm3:
        yield "tumour as reached", f"{volume:.1f} mm\u00b3"
    if (smallest := figures.min_jacobian) is not None and np.isfinite(smallest):
        yield "smallest J, a cell's volume over its undeformed volume", f"{smallest:.3f}"
    if (misfit := figures.cloud_misfit_mm) is not None:
        yield "uncertainty of the cloud, at its worst node", f"{misfit:.2f} mm"
    if (distance := figures.static_distance_mm) is not None:
        yield "estimated distance from the static solution", f"{distance:.2g} mm"


def _direction(shift: float) -> str:
    return "to the right" if shift > 0 else "to the left"


# --- tables: empty if the scene has nothing to list ----------------------------------------------------------------


def _geometry(deck: Mapping[str, Any]) -> _Rows:
    tables = (next(name for name in GEOMETRIES if name in deck), "tumour")
    entries = ((f"{name}.{key}", value) for name in tables for key, value in deck.get(name, {}).items())
    return [(key, f"{toml.value(value)} {unit_of(key)}".strip()) for key, value in entries]


def _materials(state: FinalState) -> _Rows:
    model, volumes = state.model, state.volumes
    return [
        (
            material.name, f"{material.youngs_modulus:g}", f"{material.poissons_ratio:g}", f"{material.density:g}",
            f"{np.count_nonzero(model.material == i):,}", f"{1e6 * volumes[model.material == i].sum():.2f}",
        )
        for i, material in enumerate(model.materials)
    ]  # fmt: skip


def _motions(deck: Mapping[str, Any], tumour: Mapping[str, Any] | None) -> _Rows:
    """Nodes, directions and motion of the prescribed nodes."""
    motions: _Rows = [(fixed["nodes"], ", ".join(fixed["directions"]), "fixed") for fixed in deck.get("fixed", ())]
    if tumour:
        seed, full = (f"{1e3 * tumour[name]:.3g}" for name in ("seed_radius_m", "radius_m"))
        motions.append(("tumour", "x, y, z", f"away from its centre, from a radius of {seed} mm to {full} mm"))
    for moved in deck.get("displaced", ()):
        motion = f"as in {moved['field']}" if "field" in moved else f"{toml.value(moved['displacement'])} mm"
        if moved["rotation"]:
            motion += f", rotated by {moved['rotation']:g} degrees about {moved['axis']}"
        motions.append((moved["nodes"], ", ".join(moved["directions"]), motion))
    return motions


def _counts(state: FinalState) -> _Rows:
    model = state.model
    counts = {
        "nodes": model.n_nodes, "EFG nodes (part of the nodes)": model.n_nodes - model.n_fe_nodes,
        "hexahedra": len(model.hexahedra), "support domains": len(model.domains),
    }  # fmt: skip
    return [(name, f"{count:,}") for name, count in counts.items()]


def _displacements(figures: Report) -> _Rows:
    table: _Rows = [("largest", f"{figures.max_displacement_mm:.2f} mm")]
    if (outside := figures.max_displacement_outside_first_ring_mm) is not None:
        table.append(("largest, outside the tumour's first ring of cells", f"{outside:.2f} mm"))
    for side, largest in (figures.max_displacement_of_ventricle_wall_mm or {}).items():
        table.append((f"largest, wall of the {side} ventricle", f"{largest:.2f} mm"))
    if (shift := figures.midline_shift_mm) is not None:
        table.append((f"midline, {_direction(shift)}", f"{abs(shift):.2f} mm"))
    shares = (figures.share_over_5mm or {}).items()
    return table + [(f"moved more than 5 mm, share of {name}", f"{share:.2%}") for name, share in shares]


def _ventricles(figures: Report) -> _Rows:
    change = figures.ventricle_volume_change_ml or {}
    return [
        (side, f"{ml:.3f}", f"{change[side]:+.3f}", f"{100 * change[side] / ml:+.2f}")
        for side, ml in (figures.ventricle_volume_ml or {}).items()
    ]


def _volume_parts(figures: Report) -> dict[str, float]:
    """The parts (mm^3) that account for the volume that the tumour added; empty without a balance or growth."""
    if not figures.volume_added_mm3 or figures.volume_added_mm3 <= 0:
        return {}
    assert figures.volume_pushed_mm3 is not None
    assert figures.volume_compressed_mm3 is not None
    return {
        "pushed through the interface": figures.volume_pushed_mm3,
        "compression of the cloud": figures.volume_compressed_mm3,
    }


def _balance(figures: Report) -> _Rows:
    if not (parts := _volume_parts(figures)):
        return []
    rest = figures.volume_unaccounted_mm3
    error = {"not accounted for": rest} if rest >= 0 else {"in excess of the added volume": -rest}
    volumes = {"added by the tumour": figures.volume_added_mm3} | parts | error
    return [(name, f"{volume:.1f}") for name, volume in volumes.items()]


def _time_label(figures: Report) -> str:
    return "share of the load (1)" if figures.method == RELAXATION else "time (s)"


def _history(times: NDArray[np.float64], series: Mapping[str, NDArray[np.float64]], figures: Report) -> list[str]:
    """The series at the frames as lines of text, with a column for each series."""
    columns = {_time_label(figures): times, **series}
    lines = [list(columns), *([f"{value:.4g}" for value in row] for row in zip(*columns.values(), strict=True))]
    widths = [max(11, len(name)) for name in columns]
    return ["  ".join(f"{cell:>{width}}" for cell, width in zip(line, widths, strict=True)) for line in lines]


# --- pictures ------------------------------------------------------------------------------------------------------


def _pictures(
    directory: Path,
    state: FinalState,
    figures: Report,
    times: NDArray[np.float64],
    series: Mapping[str, NDArray[np.float64]],
) -> dict[str, Any]:
    """The pictures of the page by their names in the template; "missing" is the name of a missing library, or ""."""
    names = ("mesh_picture", "views", "histogram", "balance_chart", "history_chart")
    pictures: dict[str, Any] = dict.fromkeys(names) | {"cuts": [], "no_views": "", "missing": ""}
    try:
        from mpitled.results import charts, cuts, solid
    except ImportError as error:
        return pictures | {"missing": str(error.name).partition(".")[0]}
    parts, mesh = _volume_parts(figures), solid.solid_of(state)
    where = "through the middle" if state.centre is None else "through the tumour's centre"
    pictures |= {
        "mesh_picture": Picture(
            _png(partial(cuts.mesh(state, mesh).savefig, dpi=110)),
            "Three cuts through the undeformed mesh: hexahedra by material, and the nodes of the mesh-free cloud",
            f"The undeformed mesh, cut {where}. Hexahedra are drawn with their edges; the cloud, whose support domains "
            "overlap, with its nodes near the cut.",
        ),
        "cuts": [
            Picture(
                png,
                f"Three cuts through the {name} body, coloured by displacement in mm",
                f"The {name} body, cut {where} and coloured by the displacement; both pictures have the same scale.",
            )
            for name, png in _cut_pictures(directory, figures, lambda: cuts.displacement_cuts(state, mesh))
        ],
    } | _views(directory, state)  # fmt: skip
    if figures.max_displacement_mm > 0:
        sizes = 1e3 * state.cell_displacements
        pictures["histogram"] = Picture(
            _png(partial(charts.draw_histogram, sizes, state.volumes, 1e3 * LARGE)),
            "Histogram: share of the body's volume in % against displacement in mm",
            "The share of the body's volume for each displacement, by cells.",
        )
    if parts:
        pictures["balance_chart"] = Picture(
            _png(partial(charts.draw_balance, figures.volume_added_mm3 or 0.0, parts)),
            f"Bars: {figures.volume_added_mm3:.0f} mm3 were added, {sum(parts.values()):.0f} mm3 are accounted for",
            "The added volume is pushed through the end of the cloud or compresses the cloud; the rest is error.",
        )
    if len(times) > 1:
        caption = f"At the {len(times)} frames that were written. J is the volume of a cell over its undeformed volume."
        if figures.method == RELAXATION:
            caption += (
                " In relaxation the masses are fictitious, and so is the kinetic energy. The masses are updated as the "
                "load grows, which adds or takes energy. The balance includes it; the internal energy may exceed the "
                "external work."
            )
        pictures["history_chart"] = Picture(
            _png(partial(charts.draw_history, times, series, _time_label(figures))),
            "Three charts over the run: energies, kinetic over internal energy in %, and the smallest J",
            caption,
        )
    return pictures


def _cut_pictures(directory: Path, figures: Report, draw: Callable[[], Iterator[Any]]) -> Iterator[tuple[str, bytes]]:
    """Name and PNG of the cuts: the files beside the result, or new pictures if there are no files."""
    if isinstance(figures.pictures, list):
        yield from ((Path(name).stem, (directory / name).read_bytes()) for name in figures.pictures)
    else:
        yield from ((name, _png(partial(figure.savefig, dpi=160))) for name, figure in draw())


def _views(directory: Path, state: FinalState) -> dict[str, Any]:
    from mpitled.results import views

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "views.png"
        if failure := views.draw(directory, path):
            return {"no_views": failure}
        png = path.read_bytes()
    parts = ", ".join(views.part_names(state)).capitalize()
    alt = f"{parts} seen at an angle and from above, before and after, tissue coloured by displacement"
    return {"views": Picture(png, alt, f"{parts} before and after, in parallel projection, drawn by PyVista.")}


def _png(draw: Callable[[io.BytesIO], Any]) -> bytes:
    buffer = io.BytesIO()
    draw(buffer)
    return buffer.getvalue()
