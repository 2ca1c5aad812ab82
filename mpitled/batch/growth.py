"""A sweep over tumour volumes in one run: the growth of the largest tumour passes through the smaller volumes."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import atomic, store
from mpitled import deck as decks
from mpitled.batch import launch
from mpitled.batch.cases import Case, Sweep
from mpitled.deck import Tumour
from mpitled.errors import InputError
from mpitled.model.loading import loading_curve, sphere_radius
from mpitled.results import final_state, report
from mpitled.results.final_state import FinalState


def write_reports(sweep: Sweep) -> None:
    """Write the reports of all cases from the run of the largest tumour, which may be completed or broken.

    The field between two frames is interpolated linearly in the share of the growth, which is exact on the tumour's
    surface. A case's distance from the static solution is the distance of the run at its end plus the estimated error
    of the interpolation.
    """
    (run,) = sweep.runs
    cases = [case for case in sweep.cases if case is not run and case.failure != ""]
    if run.failure is None or not cases:
        return
    try:
        outcome = final_state.read(run.folder)
    except InputError as error:
        outcome = None
        failure = run.failure or str(error)
    for case in cases:
        atomic.make_folder(case.folder)
        if outcome is not None:
            failure = _write_report(case, run, outcome)
        launch.record(case.folder, failure, program=decks.program())


def _growth(tumour: Tumour | None) -> float:
    """Growth of the radius at full load, m."""
    assert tumour is not None  # `cases.plan` checks this
    return sphere_radius(tumour.volume) - tumour.seed_radius


def _write_report(case: Case, run: Case, outcome: FinalState) -> str:
    """Write the report of one case. Returns "", or the reason why the run did not reach its volume."""
    full = _growth(run.deck.tumour)
    share = _growth(case.deck.tumour) / full if full else 1.0
    with store.open_result(run.folder) as result:
        grown = np.array([loading_curve(time / outcome.metadata["load_time_s"]) for time in result.times])
        if share > grown[-1]:
            return run.failure or "the run ended before this volume"
        after = int(np.searchsorted(grown, share))
        frames = (max(after - 1, 0), max(after, 1))
        # The error of linear interpolation over twice the interval is four times as large.
        first = min(frames[0] - frames[0] % 2, len(grown) - 3)

        def interpolate(name: str, pair: tuple[int, int], read: Any) -> NDArray[np.float64]:
            before, after = pair
            weight = (share - grown[before]) / (grown[after] - grown[before])
            return np.asarray((1 - weight) * read(name, before) + weight * read(name, after))

        field = interpolate("displacement", frames, result.at_nodes)
        coarse = interpolate("displacement", (first, first + 2), result.at_nodes)
        error = 1e3 * float(np.linalg.norm(field - coarse, axis=1).max() / 3)
        jacobian = interpolate("J", frames, result.in_cells)
        known = outcome.figures
        figures: dict[str, Any] = {name: known[name] for name in ("ranks", "nodes", "cells") if name in known}
        figures |= {"min_jacobian": float(jacobian.min()), "interpolation_mm": error}
        if "static_distance_mm" in known:
            figures["static_distance_mm"] = known["static_distance_mm"] + error
        state = replace(
            outcome,
            field=field,
            displacement=interpolate("parameters", frames, result.at_nodes),
            domain_displacement=interpolate("displacement", frames, result.at_integration_points),
            jacobian=jacobian,
            time=float(result.times[frames[1]]),
            figures=figures,
            complete=True,
        )
    content = report.compute(state).as_json()
    content |= {"of_run": run.folder.name, "pictures": "none, because this case is part of another case's run"}
    atomic.write_text(case.folder / report.REPORT, json.dumps(content, indent=2) + "\n")
    return ""
