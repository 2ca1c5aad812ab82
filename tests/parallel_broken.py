"""Under mpirun: runs a deck that one rank breaks on its way, and notes when each rank ends. DECK DIR WAY"""

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

BREAKS, AT = 2, 0.3  # the rank that does, and the share of the load at which


def step_too_long(run: Run, node: int) -> None:
    """As if the step were 100 times as long, on this rank."""
    run.integrator.state.dt2_over_m *= 1e4


def not_a_number(run: Run, node: int) -> None:
    """A displacement that is no number."""
    run.integrator.state.u[0, node] = np.nan


def inverted_cell(run: Run, node: int) -> None:
    """A node on the other side of its cells."""
    run.integrator.state.u[0, node] += np.ptp(run.sub.rows.read("points")[:, 0])


def main(deck: str, directory: Path, way: str) -> None:
    world, ends, check, check_and_output = World(), {}, Run._check, Run._check_and_output

    def watched(run: Run) -> None:
        try:
            check(run)
        except UnstableError:
            ends["detected"] = time.time()
            raise

    def broken(run: Run) -> bool:
        ahead = check_and_output(run)  # sets the right masses
        if world.rank == BREAKS and run.integrator.state.share > AT and "broken" not in ends:
            ends["broken"] = time.time()
            lonely = np.ones(run.sub.n_nodes, bool)  # what no other rank has, and nothing prescribes
            for _, nodes in run.sub.shared:
                lonely[nodes] = False
            lonely[run.sub.rows.local(run.sub.rows.prescribed_dofs // 3)] = False
            globals()[way](run, int(np.flatnonzero(lonely)[0]))
        return ahead

    Run._check, Run._check_and_output = watched, broken  # type: ignore[method-assign]
    try:
        cli.main(["run", "-q", deck, "--out", str(directory)])
    except SystemExit as end:
        ends |= {"status": end.code, "ended": time.time()}
        (directory / f"rank_{world.rank}.json").write_text(json.dumps(ends))
        raise


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3])
