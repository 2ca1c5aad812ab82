"""`mpitled report DIR --html`: all that a run has to say on one page that is one file, readable anywhere."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpitled import atomic, store, toml
from mpitled.cells import hexahedra
from mpitled.deck import GEOMETRIES, unit_of
from mpitled.results import markup, report
from mpitled.results.report import LARGE, Outcome
from mpitled.results.solid import Solid

PAGE = "report.html"
_NO_MATPLOTLIB = "There are no pictures here, for matplotlib is missing: pip install 'mpitled[pictures]'."


def write(directory: Path, made: Mapping[str, Any]) -> Path:
    """Write the page of the run in a directory, finished or not, whose report is made: report.html."""
    atomic.write_text(directory / PAGE, _page(directory, made))
    return directory / PAGE


class _Run(NamedTuple):
    """What the page is made from."""

    directory: Path
    outcome: Outcome
    report: Mapping[str, Any]
    times: NDArray[np.float64]  # (n_frames,), s, or shares of the load
    series: Mapping[str, NDArray[np.float64]]  # (n_frames,) each
    solid: Solid
    draws: bool  # whether there is matplotlib

    @property
    def deck(self) -> dict[str, Any]:
        """As it took effect, in its own units."""
        return dict(self.outcome.metadata["deck"])

    @property
    def relaxed(self) -> bool:
        """Whether times are shares of the load."""
        return bool(self.deck["solver"]["method"] == "dynamic-relaxation")


def _page(directory: Path, made: Mapping[str, Any]) -> str:
    outcome = report.read(directory)
    with store.open_result(directory) as result:
        times, series = result.times, result.series
    try:
        import matplotlib  # noqa: F401  (optional: the page has tables without)

        draws = True
    except ImportError:
        draws = False
    run = _Run(directory, outcome, made, times, series, outcome.solid, draws)
    sections = (
        ("Scene", _scene(run)),
        ("Mesh", _mesh(run)),
        ("Cross-sections", _cross_sections(run)),
        ("In three dimensions", _in_space(run)),
        ("Displacement", _displacement(run)),
        ("Volume balance", _balance(run)),
        ("Through the run", _history(run)),
        ("Run time", _time(run)),
        ("All figures", _figures(run)),
    )
    return markup.page(outcome.title, list(_head(run)), [(heading, list(parts)) for heading, parts in sections])


def _head(run: _Run) -> Iterator[str]:
    made, versions = run.report, run.outcome.metadata["versions"]
    method = {
        "quasi-static": "a quasi-static ramp",
        "dynamic-relaxation": "dynamic relaxation to the static solution",
        "dynamic": "dynamics, with the true masses",
    }[run.deck["solver"]["method"]]
    ranks = run.outcome.metadata["ranks"]
    yield markup.text(
        f"{method}, computed by mpitled {versions['mpitled']} on {ranks} rank{'s' if ranks > 1 else ''}", "faint"
    )
    if not made["complete"]:
        yield markup.note([f"The run is {report.incomplete(made)}."])
    if made["warnings"]:
        yield markup.note([f"Warning: {warning}." for warning in made["warnings"]])
    if not run.draws:
        yield markup.note([_NO_MATPLOTLIB])
    yield markup.cards(_cards(made))


def _cards(made: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    if walls := made.get("max_displacement_of_ventricle_wall_mm"):
        yield "largest displacement of a ventricle's wall", f"{max(walls.values()):.2f} mm"
    else:
        yield "largest displacement", f"{made['max_displacement_mm']:.2f} mm"
    if (shift := made.get("midline_shift_mm")) is not None:
        yield "shift of the midline, to the " + ("right" if shift > 0 else "left"), f"{abs(shift):.2f} mm"
    if change := made.get("ventricle_volume_change_ml"):
        yield "change of the ventricles", f"{change['total']:+.3f} ml"
    if volume := made.get("tumour_volume_mm3"):
        yield "tumour as reached", f"{volume:.1f} mm\u00b3"
    if (smallest := made.get("min_jacobian")) is not None:
        yield "smallest J, a cell's volume over its undeformed volume", f"{smallest:.3f}"
    if (misfit := made.get("cloud_misfit_mm")) is not None:
        yield "uncertainty of the cloud, at its worst node", f"{misfit:.2f} mm"
    if (distance := made.get("static_distance_mm")) is not None:
        yield "still to move to the static solution, by the run's own estimate", f"{distance:.2g} mm"


# --- the sections: HTML, part by part; nothing where a scene has nothing of it ---------------------------------------


def _scene(run: _Run) -> Iterator[str]:
    deck, model = run.deck, run.outcome.model
    geometry = next(name for name in GEOMETRIES if name in deck)
    chosen = [(geometry, key, value) for key, value in deck[geometry].items()]
    chosen += [("tumour", key, value) for key, value in deck.get("tumour", {}).items()]
    rows = [(f"{name}.{key}", f"{toml.value(value)} {unit_of(f'{name}.{key}')}".strip()) for name, key, value in chosen]
    yield markup.table([], rows, caption="Geometry" + (" and tumour" if "tumour" in deck else ""))
    volumes = np.concatenate([hexahedra.volumes(model.points, model.hexahedra), model.domain_volumes])
    yield markup.table(
        ["material", "Young's modulus, Pa", "Poisson's ratio", "density, kg/m\u00b3", "cells", "volume, ml"],
        [
            (
                material.name, f"{material.youngs_modulus:g}", f"{material.poissons_ratio:g}", f"{material.density:g}",
                f"{np.count_nonzero(model.material == i):,}", f"{1e6 * volumes[model.material == i].sum():.2f}",
            )
            for i, material in enumerate(model.materials)
        ],
        caption="Materials",
    )  # fmt: skip
    held = [(of["nodes"], ", ".join(of["directions"]), "fixed") for of in deck.get("fixed", ())]
    if tumour := run.outcome.metadata["tumour"]:
        seed, full = (f"{1e3 * tumour[name]:.3g}" for name in ("seed_radius_m", "radius_m"))
        held.append(("tumour", "x, y, z", f"away from its centre, from a radius of {seed} mm to {full} mm"))
    for of in deck.get("displaced", ()):
        moved = f"as in {of['field']}" if "field" in of else f"{toml.value(of['displacement'])} mm"
        turn = f", turned by {of['rotation']:g} degrees about {of['axis']}" if of["rotation"] else ""
        held.append((of["nodes"], ", ".join(of["directions"]), moved + turn))
    if held:
        yield markup.table(["nodes", "directions", "motion"], held, caption="Held and moved nodes")
    yield markup.folded("The deck: every value that took effect", markup.plain(toml.lines(deck)))


def _mesh(run: _Run) -> Iterator[str]:
    model = run.outcome.model
    counts = [
        ("nodes", model.n_nodes), ("of them EFG nodes", model.n_nodes - model.n_fe_nodes),
        ("hexahedra", len(model.hexahedra)), ("support domains", len(model.domains)),
    ]  # fmt: skip
    yield markup.table([], [(name, f"{count:,}") for name, count in counts])
    if model.notes:  # the warnings stand at the top
        yield markup.listed(model.notes)
    if run.draws:
        from mpitled.results import plot

        yield _picture(
            lambda to: plot.mesh(model, run.solid, run.outcome.centre).savefig(to, dpi=110),
            "Three cuts through the undeformed mesh: hexahedra by material, and the nodes of the mesh-free cloud",
            f"The undeformed mesh, cut {_where(run)}. Hexahedra are drawn with their edges; the cloud, which support "
            "domains overlap in, by its nodes near the cut.",
        )


def _cross_sections(run: _Run) -> Iterator[str]:
    if not run.draws:
        return
    if isinstance(run.report["pictures"], list):
        pictures = {Path(name).stem: (run.directory / name).read_bytes() for name in run.report["pictures"]}
    else:  # the deck wanted none beside the result
        from mpitled.results import plot

        drawn = plot.cuts(run.solid, run.outcome.centre, run.outcome.title)
        pictures = {name: _png(partial(figure.savefig, dpi=160)) for name, figure in drawn}
    for name, png in pictures.items():
        yield markup.picture(
            png,
            f"Three cuts through the {name} body, coloured by displacement in mm",
            f"The {name} body, cut {_where(run)} and coloured by how far tissue moves; both pictures have one scale.",
        )


def _in_space(run: _Run) -> Iterator[str]:
    if not run.draws:
        return
    from mpitled.results import views

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "views.png"
        by = views.draw(run.directory, path)
        shown = ", ".join(views.parts(run.solid))
        yield markup.picture(
            path.read_bytes(),
            f"{shown.capitalize()} seen at an angle and from above, before and after, tissue coloured by displacement",
            f"{shown.capitalize()} before and after, in parallel projection, drawn by {by}.",
        )


def _displacement(run: _Run) -> Iterator[str]:
    made, model = run.report, run.outcome.model
    rows = [("largest", f"{made['max_displacement_mm']:.2f} mm")]
    if (outside := made.get("max_displacement_outside_first_ring_mm")) is not None:
        rows.append(("largest, outside the tumour's first ring of cells", f"{outside:.2f} mm"))
    walls = made.get("max_displacement_of_ventricle_wall_mm", {})
    rows += [(f"largest, wall of the {side} ventricle", f"{moved:.2f} mm") for side, moved in walls.items()]
    if (shift := made.get("midline_shift_mm")) is not None:
        rows.append((f"midline, to the {'right' if shift > 0 else 'left'}", f"{abs(shift):.2f} mm"))
    rows += [(f"moved more than 5 mm, share of {of}", f"{share:.2%}") for of, share in made["share_over_5mm"].items()]
    yield markup.table([], rows)
    if model.n_nodes > model.n_fe_nodes:
        yield markup.text(
            "A cloud has most of its nodes beside the tumour: their share is of the mesh, the volume's of the tissue.",
            "faint",
        )
    if before := made.get("ventricle_volume_ml"):
        change = made["ventricle_volume_change_ml"]
        yield markup.table(
            ["ventricle", "undeformed, ml", "change, ml", "change, %"],
            [
                (side, f"{ml:.3f}", f"{change[side]:+.3f}", f"{100 * change[side] / ml:+.2f}")
                for side, ml in before.items()
            ],
            caption="Volume of the ventricles",
        )
    if run.draws and made["max_displacement_mm"] > 0:
        from mpitled.results import charts

        field = run.outcome.field
        size = np.linalg.norm(
            np.concatenate([field[model.hexahedra].mean(axis=1), run.outcome.domain_displacement]), axis=1
        )
        volumes = np.concatenate([hexahedra.volumes(model.points, model.hexahedra), model.domain_volumes])
        yield _picture(
            lambda to: charts.draw_histogram(1e3 * size, volumes, 1e3 * LARGE, to),
            "Histogram: share of the body's volume in % against displacement in mm",
            "How much of the body's volume moves how far, by cells.",
        )


def _balance(run: _Run) -> Iterator[str]:
    balance = run.report.get("volume_balance", {})
    if (grown := balance.get("tumour_added_mm3", 0.0)) <= 0:
        return
    found = {
        "pushed through the interface": balance["pushed_through_interface_mm3"],
        "compression of the cloud": balance["elastic_compression_mm3"],
    }
    rows = [("added by the tumour", f"{grown:.1f}")] + [(name, f"{volume:.1f}") for name, volume in found.items()]
    rest = report.unfound(balance)
    rows.append(("not found", f"{rest:.1f}") if rest >= 0 else ("found beyond what was added", f"{-rest:.1f}"))
    yield markup.table(["volume", "mm\u00b3"], rows)
    if run.draws:
        from mpitled.results import charts

        yield _picture(
            lambda to: charts.draw_balance(grown, found, to),
            f"Bars: of {grown:.0f} cubic millimetres added, {sum(found.values()):.0f} were found again",
            "What the tumour added is either pushed through the end of the cloud or compresses it; the rest is error.",
        )


def _history(run: _Run) -> Iterator[str]:
    """At the frames that were written: more of them with output.frames."""
    if len(run.times) < 2:
        yield markup.text("One frame was written, the undeformed body: there is nothing to show over time yet.")
        return
    label = "share of the load (1)" if run.relaxed else "time (s)"
    if run.draws:
        from mpitled.results import charts

        yield _picture(
            lambda to: charts.draw_history(run.times, run.series, label, to),
            "Three charts over the run: energies, kinetic over internal energy in %, and the smallest J",
            f"At the {len(run.times)} frames that were written. J is the volume of a cell over its undeformed volume."
            + " Masses are fictitious in relaxation, and so is kinetic energy. They are made anew as the load grows, "
            "which gives and takes energy: the balance counts it, and internal energy may be more than external work."
            * run.relaxed,
        )
    series = run.series
    yield markup.folded("The numbers, energies in J", markup.plain(_columns({label: run.times, **series})))


def _columns(series: Mapping[str, NDArray[np.float64]]) -> Iterator[str]:
    yield "  ".join(f"{name:>{max(11, len(name))}}" for name in series)
    for row in zip(*series.values(), strict=True):
        yield "  ".join(f"{value:{max(11, len(name))}.4g}" for name, value in zip(series, row, strict=True))


def _time(run: _Run) -> Iterator[str]:
    made = run.report
    yield markup.bars("Phases of the run", "s", list(made["seconds"].items()))
    if terms := made.get("term_seconds"):
        yield markup.folded("Terms of the loop's steps", markup.bars("On rank 0", "s", list(terms.items())))
    ranks = run.outcome.metadata["ranks"]
    where = ", here on rank 0:" if ranks > 1 else ":"
    yield markup.folded(
        "What the steps do without",
        markup.text(f"A term or an array that a scene does not need is not in its steps{where}"),
        markup.listed(run.outcome.metadata.get("left_out", ())),
    )


def _figures(run: _Run) -> Iterator[str]:
    yield markup.table([], report.rows(run.report))
    versions = run.outcome.metadata["versions"]
    yield markup.text("Versions: " + ", ".join(f"{name} {version}" for name, version in versions.items()), "faint")


# --- pictures ------------------------------------------------------------------------------------------------------


def _where(run: _Run) -> str:
    return "through the middle" if run.outcome.centre is None else "through the tumour's centre"


def _picture(draw: Callable[[io.BytesIO], Any], alt: str, caption: str) -> str:
    return markup.picture(_png(draw), alt, caption)


def _png(draw: Callable[[io.BytesIO], Any]) -> bytes:
    to = io.BytesIO()
    draw(to)
    return to.getvalue()
