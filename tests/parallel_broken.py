"""Under mpirun: runs a deck, breaks the state of one rank, and records the times of events. DECK DIRECTORY FAULT"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from mpitled import cli
from mpitled.errors import UnstableError
from mpitled.parallel.halo import World
from mpitled.solver.run import Run

RANK, SHARE = 2, 0.3  # the rank with the fault, and the share of the load after which the fault is made


def break_state(run: Run, fault: str) -> None:
    """Make a fault; for two faults at a free node that no other rank has."""
    state, rows = run.integrator.state, run.sub.rows
    candidates = np.ones(run.sub.n_nodes, bool)
    for _, nodes in run.sub.shared:
        candidates[nodes] = False
    candidates[rows.local(rows.prescribed_dofs // 3)] = False
    node = int(np.argmax(candidates))
    if fault == "step_too_long":  # by a factor of 100
        state.dt2_over_m *= 1e4
    elif fault == "not_a_number":
        state.u[0, node] = np.nan
    else:  # inverted_cell
        state.u[0, node] += np.ptp(rows.read("points")[:, 0])


def main(deck: str, directory: Path, fault: str) -> None:
    world, events, check, check_and_output = World(), {}, Run._check, Run._check_and_output

    def recorded_check(run: Run) -> None:
        try:
            check(run)
        except UnstableError:
            events["detected"] = time.time()
            raise

    def broken(run: Run) -> bool:
        continues = check_and_output(run)  # sets the masses, which the fault changes
        if world.rank == RANK and run.integrator.state.share > SHARE and "broken" not in events:
            events["broken"] = time.time()
            break_state(run, fault)
        return continues

    Run._check, Run._check_and_output = recorded_check, broken  # type: ignore[method-assign]
    try:
        cli.main(["run", "-q", deck, "--out", str(directory)])
    except SystemExit as end:
        events |= {"status": end.code, "ended": time.time()}
        (directory / f"rank_{world.rank}.json").write_text(json.dumps(events))
        raise


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3])
