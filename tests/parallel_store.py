"""Under mpirun: writes results. MODEL DIRECTORY END

END is "close", "abandon" or "kill" (SIGKILL to rank 0 in the middle of the third of four frames).
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np

from mpitled.store import PartRows, ResultWriter, read_part

N_FRAMES = 4


def frame(part: PartRows, k: int) -> tuple[dict[str, Any], dict[str, Any], dict[str, float]]:
    """Point data, cell data and series of frame k, as functions of global numbers and positions."""
    nodes, points = part.nodes[part.owned], part.read("points")[part.owned]
    cloud = part.blocks[1]
    points = np.concatenate([points, cloud.read("points")])
    displacement = np.concatenate([np.outer(nodes, [1.0, 10.0, 100.0]), np.zeros((cloud.n_own, 3))])
    point_data = {"parameters": displacement + k, "displacement": points * k}
    return point_data, {"J": 1 + 1e-3 * part.read("cells") + k}, {"energy": 0.5 * k, "step": 10.0 * k}


def write(model: Path, directory: Path, end: str, comm: Any) -> None:
    rank, size = (0, 1) if comm is None else (comm.rank, comm.size)
    part = read_part(model, size, rank)
    metadata = {"deck": "title = 'é'\n" * 10_000, "ranks": size, "share": 0.1, "rank": rank}
    writer = ResultWriter(directory, comm, part, N_FRAMES, metadata, series=("energy", "step"))
    for k in range(N_FRAMES if end == "close" else 2):
        writer.write_frame(0.25 * k, *frame(part, k))
    if end == "kill":
        if rank == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        writer.write_frame(0.75, *frame(part, 2))
    {"close": writer.close, "abandon": writer.abandon}[end]({"rank": rank, "steps": 7})


if __name__ == "__main__":
    from mpi4py import MPI

    write(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], MPI.COMM_WORLD)
