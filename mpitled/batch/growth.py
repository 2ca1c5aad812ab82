"""A sweep over tumour volumes as one run: the largest tumour passes through the volumes of the others as it grows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import atomic, store
from mpitled import deck as decks
from mpitled.batch import launch
from mpitled.batch.cases import Case, Sweep
from mpitled.errors import InputError
from mpitled.model.loading import loading_curve, sphere_radius
from mpitled.results import final_state, report
from mpitled.results.final_state import FinalState


def tell(sweep: Sweep) -> None:
    """Write the reports of the cases that the run of the largest tumour, ended or broken, passed through.

    Between two frames the field is interpolated by the share of the growth, by which the tumour's surface moves
    exactly so. What is known of the distance from a run of its own goes into the case's distance from the static
    solution: that of the whole run at its end, and how far the interpolation may be wrong.
    """
    (run,) = sweep.runs
    todo = [case for case in sweep.cases if case is not run and case.failure != ""]
    if run.failure is None or not todo:
        return
    try:
        outcome = final_state.read(run.folder)
    except InputError as error:
        outcome = None
        failure = run.failure or str(error)
    for case in todo:
        atomic.make_folder(case.folder)
        if outcome is not None:
            failure = _tell(case, run, outcome)
        launch.record(case.folder, failure, program=decks.program())


def _tell(case: Case, run: Case, outcome: FinalState) -> str:
    """Write the report of one case; the reason if the run did not come so far, or ""."""
    tumour, last = case.deck.tumour, run.deck.tumour
    assert tumour is not None  # `plan` sees to it
    assert last is not None
    full = sphere_radius(last.volume) - last.seed_radius
    share = (sphere_radius(tumour.volume) - tumour.seed_radius) / full if full else 1.0
    with store.open_result(run.folder) as result:
        grown = np.array([loading_curve(time / outcome.metadata["load_time_s"]) for time in result.times])
        if share > grown[-1]:
            return run.failure or "the run ended before"
        after = int(np.searchsorted(grown, share))
        frames = (max(after - 1, 0), max(after, 1))
        # With every other frame the error of linear interpolation is four times as large.
        first = min(frames[0] - frames[0] % 2, len(grown) - 3)
        wide = (first, first + 2)

        def field(name: str, pair: tuple[int, int], read: Any) -> NDArray[np.float64]:
            before, behind = pair
            weight = (share - grown[before]) / (grown[behind] - grown[before])
            between: NDArray[np.float64] = (1 - weight) * read(name, before) + weight * read(name, behind)
            return between

        here = replace(
            outcome,
            field=field("displacement", frames, result.at_nodes),
            displacement=field("parameters", frames, result.at_nodes),
            domain_displacement=field("displacement", frames, result.at_integration_points),
            jacobian=field("J", frames, result.in_cells),
            time=float(result.times[frames[1]]),
            figures={},
        )
        off = np.linalg.norm(here.field - field("displacement", wide, result.at_nodes), axis=1).max() / 3
    _write(case, run, here, outcome.figures, 1e3 * float(off))
    return ""


def _write(case: Case, run: Case, here: FinalState, of_run: Mapping[str, Any], off: float) -> None:
    """off: how far (mm) the interpolation may be wrong."""
    kept = {name: of_run[name] for name in ("ranks", "nodes", "cells") if name in of_run}
    distance = {"static_distance_mm": of_run["static_distance_mm"] + off} if "static_distance_mm" in of_run else {}
    figures = kept | {"min_jacobian": float(here.jacobian.min()), "interpolation_mm": off} | distance
    made = report.compute(replace(here, figures=figures, complete=True)).as_json()
    made |= {"of_run": run.folder.name, "pictures": "none, for this case is part of another's run"}
    atomic.write_text(case.folder / report.REPORT, json.dumps(made, indent=2) + "\n")
