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
from mpitled.store import ResultWriter

BREAKS, AT = 2, 0.3  # the rank that does, and the share of the load at which


def step_too_long(run: Run, node: int) -> None:
    """As if the step were 100 times as long, on this rank."""
    run.method.state.mobility *= 1e4


def not_a_number(run: Run, node: int) -> None:
    """A displacement that is no number."""
    run.method.state.u[0, node] = np.nan


def inverted_cell(run: Run, node: int) -> None:
    """A node on the other side of its cells."""
    run.method.state.u[0, node] += np.ptp(run.sub.rows.read("points")[:, 0])


def main(deck: str, directory: Path, way: str) -> None:
    world, ends, watch, go_on = World(), {}, Run._look, Run._ahead

    def watched(run: Run) -> None:
        try:
            watch(run)
        except UnstableError:
            ends["detected"] = time.time()
            raise

    def broken(run: Run, writer: ResultWriter) -> bool:
        ahead = go_on(run, writer)  # with masses that are right, which it sees to
        if world.rank == BREAKS and run.method.state.share > AT and "broken" not in ends:
            ends["broken"] = time.time()
            lonely = np.ones(run.sub.n_nodes, bool)  # what no other rank has, and nothing prescribes
            for _, nodes in run.sub.shared:
                lonely[nodes] = False
            lonely[run.sub.rows.local(run.sub.rows.prescribed_dofs // 3)] = False
            globals()[way](run, int(np.flatnonzero(lonely)[0]))
        return ahead

    Run._look, Run._ahead = watched, broken  # type: ignore[method-assign]
    try:
        cli.main(["run", "-q", deck, "--out", str(directory)])
    except SystemExit as end:
        ends |= {"status": end.code, "ended": time.time()}
        (directory / f"rank_{world.rank}.json").write_text(json.dumps(ends))
        raise


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3])
