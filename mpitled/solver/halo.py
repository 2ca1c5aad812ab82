"""Ranks and what they exchange: the only importer of mpi4py, and that only where there is more than one rank."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from mpitled.errors import MpitledError, everywhere
from mpitled.solver import kernels

#: What launchers tell each process of the number of ranks (OpenMPI, MPICH and Intel MPI, PMIx under SLURM).
_SIZES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_STEP_NUM_TASKS" if "PMIX_RANK" in os.environ else "PMI_SIZE")


def library_version() -> str:
    """Name and version of the MPI library, which is not started. ImportError or RuntimeError if there is none."""
    import mpi4py

    mpi4py.rc.initialize = False
    from mpi4py import MPI

    return " ".join(MPI.Get_library_version().replace(",", " ").replace("\0", " ").split()[:3])


class World:
    """All ranks of the job, or a group of them. Every method is collective: reached by every rank or by none."""

    def __init__(self, comm: Any = None) -> None:
        """comm: of a group, see `split`; without it all ranks that were started."""
        if comm is None and any(int(os.environ.get(name, "1")) > 1 for name in _SIZES):
            from mpi4py import MPI

            comm = MPI.COMM_WORLD
        self.rank: int = 0 if comm is None else comm.rank
        self.size: int = 1 if comm is None else comm.size
        self.comm: Any = comm if self.size > 1 else None

    def split(self, size: int) -> World:
        """This rank's group, where so many ranks in turn make one."""
        return World(self.comm.Split(self.rank // size, self.rank))

    @property
    def leads(self) -> bool:
        return self.rank == 0

    def gather(self, values: Sequence[float]) -> NDArray[np.float64]:
        """(size, n): every rank's n values, on every rank, so that all take the same decision from the same bits."""
        mine = np.asarray(values, np.float64)
        if self.comm is None:
            return mine[None]
        table = np.empty((self.size, len(mine)))
        self.comm.Allgather(mine, table)
        return table

    def broadcast(self, value: Any, root: int = 0) -> Any:
        """A small object of one rank, on all."""
        return value if self.comm is None else self.comm.bcast(value, root)

    def on_leader(self, work: Callable[[], Any]) -> Any:
        """The result of work, done by rank 0, on all ranks; its error likewise, before anything collective follows."""
        outcome: Any = None
        if self.leads:
            try:
                outcome = work()
            except MpitledError as error:
                outcome = error
        with everywhere():
            outcome = self.broadcast(outcome)
            if isinstance(outcome, MpitledError):
                raise outcome
        return outcome

    def barrier(self) -> None:
        if self.comm is not None:
            self.comm.Barrier()

    def abort(self, status: int) -> NoReturn:
        """End every rank at once: an exception on one alone would leave the others waiting for ever."""
        sys.stdout.flush()
        sys.stderr.flush()
        if self.comm is not None:
            self.comm.Abort(status)
        raise SystemExit(status)


class Halo:
    """Sums of nodal values over the ranks that share a node, the same bits on each of them.

    Contributions are added in ascending order of rank, the own one in its turn (addition does not associate).
    Requests are persistent and the buffers are made once: nothing is allocated in an exchange.
    """

    def __init__(
        self,
        world: World,
        shared: Sequence[tuple[int, NDArray[np.uint32]]],
        components: int,
        precision: type[np.floating] = np.float64,
    ) -> None:
        """shared: (rank, nodes shared with it) in ascending order of rank; both sides list the same nodes."""
        self.components = components
        self.seconds = {"pack": 0.0, "wait": 0.0, "unpack": 0.0}
        self._all = np.unique(np.concatenate([nodes for _, nodes in shared])) if shared else np.zeros(0, np.uint32)
        own = np.empty((components, len(self._all)), precision)
        self._own = own
        sends = [np.empty((components, len(nodes)), precision) for _, nodes in shared]
        receives = [np.empty((components, len(nodes)), precision) for _, nodes in shared]
        self._packs = [(nodes, buffer) for (_, nodes), buffer in zip(shared, sends, strict=True)]
        turns = [(rank, nodes, buffer) for (rank, nodes), buffer in zip(shared, receives, strict=True)]
        turns.append((world.rank, self._all, own))
        self._turns = [(nodes, buffer) for _, nodes, buffer in sorted(turns, key=lambda turn: turn[0])]
        self._requests: list[Any] = []
        self._start: Callable[[list[Any]], None] = lambda requests: None
        self._wait: Callable[[list[Any]], Any] = lambda requests: None
        if shared:
            from mpi4py import MPI

            comm = world.comm
            self._requests = [comm.Recv_init(b, rank) for (rank, _), b in zip(shared, receives, strict=True)]
            self._requests += [comm.Send_init(b, rank) for (rank, _), b in zip(shared, sends, strict=True)]
            self._start, self._wait = MPI.Prequest.Startall, MPI.Request.Waitall

    def sum(self, values: NDArray[np.floating]) -> None:
        """values (components, n_nodes) at shared nodes <- the sum over the ranks that share them."""
        clock = time.perf_counter
        begin = clock()
        kernels.pack(values, self._all, self._own)
        for nodes, buffer in self._packs:
            kernels.pack(values, nodes, buffer)
        packed = clock()
        self._start(self._requests)
        self._wait(self._requests)
        waited = clock()
        kernels.clear(values, self._all)
        for nodes, buffer in self._turns:
            kernels.unpack(values, nodes, buffer)
        self.seconds["pack"] += packed - begin
        self.seconds["wait"] += waited - packed
        self.seconds["unpack"] += clock() - waited
