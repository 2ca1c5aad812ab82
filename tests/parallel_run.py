"""Under mpirun: runs a deck and compares the bits of all copies of shared nodes. DECK DIRECTORY"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from mpitled import job
from mpitled.deck import load_deck
from mpitled.parallel.halo import World


def main(deck: Path, directory: Path) -> None:
    world = World()
    runs = []

    class Recorded(job.Run):
        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments)  # type: ignore[arg-type]
            runs.append(self)

    job.Run = Recorded  # type: ignore[misc]
    job.run(load_deck(deck), directory, world, quiet=True)
    state, shared = runs[0].integrator.state, runs[0].sub.shared
    compared = 0
    for values in (state.u, state.u_prev, np.atleast_2d(state.dt2_over_m)):
        sent = {rank: np.ascontiguousarray(values[:, nodes]) for rank, nodes in shared}
        received = {rank: np.empty_like(block) for rank, block in sent.items()}
        requests = [world.comm.Irecv(block, rank) for rank, block in received.items()]
        requests += [world.comm.Isend(block, rank) for rank, block in sent.items()]
        for request in requests:
            request.Wait()
        for rank, block in sent.items():
            assert block.tobytes() == received[rank].tobytes(), f"ranks {world.rank} and {rank} differ"
            compared += block.size
    total = int(world.gather([compared])[:, 0].sum())
    if world.leads:
        print(total)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
