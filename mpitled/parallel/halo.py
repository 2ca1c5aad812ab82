"""Ranks and what they exchange: the only importer of mpi4py, and that only where there is more than one rank."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.errors import MpitledError, everywhere

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
        sizes = [int(os.environ[name]) for name in _SIZES if name in os.environ]
        if comm is None and max(sizes, default=1) > 1:
            from mpi4py import MPI

            comm = MPI.COMM_WORLD
        self.rank: int = 0 if comm is None else comm.rank
        self.size: int = 1 if comm is None else comm.size
        self.comm: Any = comm if self.size > 1 else None
        self.started = bool(sizes)  # by a launcher, be it on one rank
        self._host: Any = None

    def split(self, size: int) -> World:
        """This rank's group, where so many ranks in turn make one."""
        return World(self.comm.Split(self.rank // size, self.rank))

    def host(self) -> Any:
        """The communicator of the ranks that share memory with this one. Collective."""
        if self._host is None:
            from mpi4py import MPI

            self._host = self.comm.Split_type(MPI.COMM_TYPE_SHARED)
        return self._host

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
    Requests are persistent and the buffers are made once: nothing is allocated in an exchange. Ranks of one host read
    each other's buffers where they are, in memory that they share; their messages are empty and say that a buffer is
    filled, so that nothing has to be moved while both compute. There are two buffers of each, used in turn: none is
    written over while the other reads it, for a rank cannot be farther ahead than a message that follows the reading.
    """

    def __init__(
        self,
        world: World,
        shared: Sequence[tuple[int, NDArray[np.uint32]]],
        components: int,
        precision: type[np.floating] = np.float64,
    ) -> None:
        """shared: (rank, ascending nodes shared with it), ranks ascending, alike on both sides. Collective."""
        self.seconds = {"pack": 0.0, "wait": 0.0, "unpack": 0.0}
        self._all = np.unique(np.concatenate([nodes for _, nodes in shared])) if shared else np.zeros(0, np.uint32)
        self._total = np.empty((components, len(self._all)), precision)
        buffers = {rank: np.empty((4, components, len(nodes)), precision) for rank, nodes in shared}
        self._window, close = _shared_buffers(world, buffers)
        self._turns = []
        for turn in (0, 1):
            sends: list[_Part] = []
            below: list[_Part] = []
            above: list[_Part] = []
            requests: list[Any] = []
            for rank, nodes in shared:
                out, back = close[rank][turn] if rank in close else (buffers[rank][turn], buffers[rank][2 + turn])
                sends.append((nodes, out))
                places = np.searchsorted(self._all, nodes).astype(np.uint32)
                (below if rank < world.rank else above).append((places, back))
                message, answer = (_NOTHING, _NOTHING) if rank in close else (out, back)
                requests += [world.comm.Recv_init(answer, rank), world.comm.Send_init(message, rank)]
            self._turns.append((sends, below, above, requests))
        # Other processors than x86 may show another rank's writes in another order than they were made.
        self._fence: Callable[[], None] = self._window.Sync if close else lambda: None
        self._start: Callable[[list[Any]], None] = lambda requests: None
        self._wait: Callable[[list[Any]], Any] = lambda requests: None
        if shared:
            from mpi4py import MPI

            self._start, self._wait = MPI.Prequest.Startall, MPI.Request.Waitall

    def start(self, values: NDArray[np.floating]) -> None:
        """Send what this rank has at shared nodes of values (components, n_nodes), which stays there until `finish`."""
        begin = time.perf_counter()
        sends, *_, requests = self._turns[0]
        for nodes, buffer in sends:
            kernels.gather(values, nodes, buffer)
        self._fence()
        self._start(requests)
        self.seconds["pack"] += time.perf_counter() - begin

    def finish(self, values: NDArray[np.floating]) -> None:
        """values (components, n_nodes) at shared nodes <- the sum over the ranks that share them."""
        begin = time.perf_counter()
        _, below, above, requests = self._turns[0]
        self._turns.reverse()
        self._wait(requests)
        self._fence()
        waited = time.perf_counter()
        self._total[:] = 0
        for places, buffer in below:
            kernels.add(buffer, places, self._total)
        kernels.add_gathered(values, self._all, self._total)
        for places, buffer in above:
            kernels.add(buffer, places, self._total)
        kernels.scatter(self._total, self._all, values)
        self.seconds["wait"] += waited - begin
        self.seconds["unpack"] += time.perf_counter() - waited

    def sum(self, values: NDArray[np.floating]) -> None:
        """Both at once."""
        self.start(values)
        self.finish(values)

    def free(self) -> None:
        """Give the memory back that is shared: a process may compute many runs. Collective; the halo's end."""
        for *_, requests in self._turns:
            for request in requests:
                request.Free()
        self._turns.clear()
        if self._window is not None:
            self._window.Unlock_all()
            self._window.Free()


_NOTHING = np.empty(0)
#: Nodes, or their places among all that are shared, and a buffer for them.
_Part = tuple[NDArray[np.uint32], NDArray[np.floating]]
_Pairs = tuple[tuple[NDArray[np.floating], NDArray[np.floating]], ...]


def _shared_buffers(world: World, buffers: dict[int, NDArray[np.floating]]) -> tuple[Any, dict[int, _Pairs]]:
    """Shared memory, and by neighbour on this host for each of two turns the buffers written and read here.

    buffers: as large as they have to be, by neighbour. Collective.
    """
    if world.comm is None:
        return None, {}
    from mpi4py import MPI

    host = world.host()
    ranks = host.allgather(world.rank)
    begins: dict[int, list[int]] = {}
    end = 0
    for rank in buffers:
        if rank in ranks:
            size = -(-buffers[rank][0].nbytes // _PAGE) * _PAGE
            begins[rank] = [end, end + size]
            end += 2 * size
    window = MPI.Win.Allocate_shared(end, 1, comm=host)
    window.Lock_all(MPI.MODE_NOCHECK)  # which `Sync` asks for; nobody locks it otherwise
    of_all = dict(zip(ranks, host.allgather(begins), strict=True))

    def buffer(writer: int, reader: int, turn: int) -> NDArray[np.floating]:
        memory: Any
        memory, _ = window.Shared_query(ranks.index(writer))
        like = buffers[reader if writer == world.rank else writer][0]
        return np.ndarray(like.shape, like.dtype, memory, of_all[writer][reader][turn])

    here = world.rank
    pairs = {rank: tuple((buffer(here, rank, turn), buffer(rank, here, turn)) for turn in (0, 1)) for rank in begins}
    return window, pairs


#: Buffers begin at pages: ranks that write do not share a line of a cache.
_PAGE = 4096
