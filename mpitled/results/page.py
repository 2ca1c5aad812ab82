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


def write(directory: Path, made: Report) -> Path:
    """Write report.html for the run in a directory, finished or not, from its report; the path of the page."""
    state = final_state.read(directory)
    with store.open_result(directory) as result:
        times, series = result.times, result.series
    deck, metadata = dict(state.metadata["deck"]), state.metadata
    pictures = _pictures(directory, state, made, times, series)
    text = markup.render(
        "run.html",
        title=state.title,
        method=_METHODS[deck["solver"]["method"]],
        versions=metadata["versions"],
        ranks=metadata["ranks"],
        notes=_notes(made, pictures["missing"]),
        cards=list(_cards(made)),
        has_tumour="tumour" in deck,
        geometry=_geometry(deck),
        materials=_materials(state),
        motions=_motions(deck, metadata["tumour"]),
        deck_lines=list(toml.lines(deck)),
        counts=_counts(state),
        model_notes=state.model.notes,
        displacements=_displacements(made),
        has_cloud=state.model.n_nodes > state.model.n_fe_nodes,
        ventricles=_ventricles(made),
        balance_rows=_balance(made),
        history_lines=_history(times, series, made) if len(times) > 1 else [],
        seconds=made.seconds,
        term_seconds=made.other.get("term_seconds"),
        absent=metadata.get("left_out", ()),
        figure_rows=list(rows(made.as_json())),
        **pictures,
    )
    atomic.write_text(directory / PAGE, text)
    return directory / PAGE


def _notes(made: Report, missing: str) -> list[list[str]]:
    """The highlighted notes at the head of the page, a list of lines each."""
    incomplete = [] if made.complete else [f"The run is {report.incomplete(made.as_json())}."]
    warnings = [f"Warning: {warning}." for warning in made.warnings]
    install = f"There are no pictures, because {missing} is missing: pip install 'mpitled[pictures]'."
    return [lines for lines in (incomplete, warnings, [install] if missing else []) if lines]


def _cards(made: Report) -> Iterator[tuple[str, str]]:
    """Name and value of the most important figures."""
    if walls := made.max_displacement_of_ventricle_wall_mm:
        yield "largest displacement of a ventricle's wall", f"{max(walls.values()):.2f} mm"
    else:
        yield "largest displacement", f"{made.max_displacement_mm:.2f} mm"
    if (shift := made.midline_shift_mm) is not None:
        yield "shift of the midline, to the " + ("right" if shift > 0 else "left"), f"{abs(shift):.2f} mm"
    if change := made.ventricle_volume_change_ml:
        yield "change of the ventricles", f"{change['total']:+.3f} ml"
    if volume := made.tumour_volume_mm3:
        yield "tumour as reached", f"{volume:.1f} mm\u00b3"
    if (smallest := made.min_jacobian) is not None and np.isfinite(smallest):
        yield "smallest J, a cell's volume over its undeformed volume", f"{smallest:.3f}"
    if (misfit := made.cloud_misfit_mm) is not None:
        yield "uncertainty of the cloud, at its worst node", f"{misfit:.2f} mm"
    if (distance := made.static_distance_mm) is not None:
        yield "distance from the static solution, by the run's own estimate", f"{distance:.2g} mm"


# --- tables: empty where the scene has nothing of it ---------------------------------------------------------------


def _geometry(deck: Mapping[str, Any]) -> _Rows:
    names = (next(name for name in GEOMETRIES if name in deck), "tumour")
    keys = [(f"{name}.{key}", value) for name in names for key, value in deck.get(name, {}).items()]
    return [(key, f"{toml.value(value)} {unit_of(key)}".strip()) for key, value in keys]


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
    motions: _Rows = [(of["nodes"], ", ".join(of["directions"]), "fixed") for of in deck.get("fixed", ())]
    if tumour:
        seed, full = (f"{1e3 * tumour[name]:.3g}" for name in ("seed_radius_m", "radius_m"))
        motions.append(("tumour", "x, y, z", f"away from its centre, from a radius of {seed} mm to {full} mm"))
    for of in deck.get("displaced", ()):
        moved = f"as in {of['field']}" if "field" in of else f"{toml.value(of['displacement'])} mm"
        turn = f", turned by {of['rotation']:g} degrees about {of['axis']}" if of["rotation"] else ""
        motions.append((of["nodes"], ", ".join(of["directions"]), moved + turn))
    return motions


def _counts(state: FinalState) -> _Rows:
    model = state.model
    counts = {
        "nodes": model.n_nodes, "of them EFG nodes": model.n_nodes - model.n_fe_nodes,
        "hexahedra": len(model.hexahedra), "support domains": len(model.domains),
    }  # fmt: skip
    return [(name, f"{count:,}") for name, count in counts.items()]


def _displacements(made: Report) -> _Rows:
    found: _Rows = [("largest", f"{made.max_displacement_mm:.2f} mm")]
    if (outside := made.max_displacement_outside_first_ring_mm) is not None:
        found.append(("largest, outside the tumour's first ring of cells", f"{outside:.2f} mm"))
    for side, moved in (made.max_displacement_of_ventricle_wall_mm or {}).items():
        found.append((f"largest, wall of the {side} ventricle", f"{moved:.2f} mm"))
    if (shift := made.midline_shift_mm) is not None:
        found.append((f"midline, to the {'right' if shift > 0 else 'left'}", f"{abs(shift):.2f} mm"))
    shares = (made.share_over_5mm or {}).items()
    return found + [(f"moved more than 5 mm, share of {of}", f"{share:.2%}") for of, share in shares]


def _ventricles(made: Report) -> _Rows:
    change = made.ventricle_volume_change_ml or {}
    return [
        (side, f"{ml:.3f}", f"{change[side]:+.3f}", f"{100 * change[side] / ml:+.2f}")
        for side, ml in (made.ventricle_volume_ml or {}).items()
    ]


def _found_volumes(made: Report) -> dict[str, float]:
    """Where the volume that the tumour added was found, mm^3; empty without a balance or growth."""
    if not made.volume_added_mm3 or made.volume_added_mm3 <= 0:
        return {}
    assert made.volume_pushed_mm3 is not None
    assert made.volume_compressed_mm3 is not None
    return {
        "pushed through the interface": made.volume_pushed_mm3, "compression of the cloud": made.volume_compressed_mm3
    }  # fmt: skip


def _balance(made: Report) -> _Rows:
    if not (found := _found_volumes(made)):
        return []
    rest = made.volume_unaccounted_mm3
    ends = {"not found": rest} if rest >= 0 else {"found beyond what was added": -rest}
    volumes = {"added by the tumour": made.volume_added_mm3} | found | ends
    return [(name, f"{volume:.1f}") for name, volume in volumes.items()]


def _time_label(made: Report) -> str:
    return "share of the load (1)" if made.method == RELAXATION else "time (s)"


def _history(times: NDArray[np.float64], series: Mapping[str, NDArray[np.float64]], made: Report) -> list[str]:
    """The series at the frames, in columns of text."""
    columns = {_time_label(made): times, **series}
    widths = [max(11, len(name)) for name in columns]
    lines = [zip(columns, widths, strict=True)]
    lines += [
        zip((f"{value:.4g}" for value in row), widths, strict=True) for row in zip(*columns.values(), strict=True)
    ]
    return ["  ".join(f"{cell:>{width}}" for cell, width in line) for line in lines]


# --- pictures ------------------------------------------------------------------------------------------------------


def _pictures(
    directory: Path,
    state: FinalState,
    made: Report,
    times: NDArray[np.float64],
    series: Mapping[str, NDArray[np.float64]],
) -> dict[str, Any]:
    """The pictures of the page by their names in the template, and "missing", a library or ""."""
    none: dict[str, Any] = {
        "mesh_picture": None,
        "cuts": [],
        "views": None,
        "no_views": "",
        "histogram": None,
        "balance_chart": None,
    }
    none |= {"history_chart": None}
    try:
        from mpitled.results import charts, cuts, solid
    except ImportError as error:
        return none | {"missing": str(error.name).partition(".")[0]}
    found, mesh = _found_volumes(made), solid.solid_of(state)
    where = "through the middle" if state.centre is None else "through the tumour's centre"
    pictures = none | {
        "missing": "",
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
            for name, png in _cut_pictures(directory, made, lambda: cuts.displacement_cuts(state, mesh))
        ],
    } | _views(directory, state)  # fmt: skip
    if made.max_displacement_mm > 0:
        sizes = 1e3 * state.cell_displacements
        pictures["histogram"] = Picture(
            _png(partial(charts.draw_histogram, sizes, state.volumes, 1e3 * LARGE)),
            "Histogram: share of the body's volume in % against displacement in mm",
            "The share of the body's volume for each displacement, by cells.",
        )
    if found:
        pictures["balance_chart"] = Picture(
            _png(partial(charts.draw_balance, made.volume_added_mm3 or 0.0, found)),
            f"Bars: of {made.volume_added_mm3:.0f} mm3 added, {sum(found.values()):.0f} mm3 were found again",
            "The added volume is pushed through the end of the cloud or compresses the cloud; the rest is error.",
        )
    if len(times) > 1:
        caption = f"At the {len(times)} frames that were written. J is the volume of a cell over its undeformed volume."
        if made.method == RELAXATION:
            caption += (
                " In relaxation the masses are fictitious, and so is the kinetic energy. The masses are updated as the "
                "load grows, which adds or takes energy. The balance includes it; the internal energy may exceed the "
                "external work."
            )
        pictures["history_chart"] = Picture(
            _png(partial(charts.draw_history, times, series, _time_label(made))),
            "Three charts over the run: energies, kinetic over internal energy in %, and the smallest J",
            caption,
        )
    return pictures


def _cut_pictures(directory: Path, made: Report, draw: Callable[[], Iterator[Any]]) -> Iterator[tuple[str, bytes]]:
    """Name and PNG of the cuts: those beside the result, or new ones if the deck turned them off."""
    if isinstance(made.pictures, list):
        yield from ((Path(name).stem, (directory / name).read_bytes()) for name in made.pictures)
    else:
        yield from ((name, _png(partial(figure.savefig, dpi=160))) for name, figure in draw())


def _views(directory: Path, state: FinalState) -> dict[str, Any]:
    from mpitled.results import views

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "views.png"
        if failure := views.draw(directory, path):
            return {"no_views": failure}
        png = path.read_bytes()
    shown = ", ".join(views.part_names(state)).capitalize()
    alt = f"{shown} seen at an angle and from above, before and after, tissue coloured by displacement"
    return {"views": Picture(png, alt, f"{shown} before and after, in parallel projection, drawn by PyVista.")}


def _png(draw: Callable[[io.BytesIO], Any]) -> bytes:
    to = io.BytesIO()
    draw(to)
    return to.getvalue()
