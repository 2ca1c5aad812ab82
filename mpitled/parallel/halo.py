"""Ranks and the exchange between them. The only module that imports mpi4py, and only with more than one rank."""

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

#: Environment variables with the number of ranks (OpenMPI, MPICH and Intel MPI, PMIx under SLURM).
_SIZES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_STEP_NUM_TASKS" if "PMIX_RANK" in os.environ else "PMI_SIZE")


def library_version() -> str:
    """Name and version of the MPI library, without starting it. ImportError or RuntimeError if there is none."""
    import mpi4py

    mpi4py.rc.initialize = False
    from mpi4py import MPI

    return " ".join(MPI.Get_library_version().replace(",", " ").replace("\0", " ").split()[:3])


class World:
    """All ranks of the job, or a group of them. Every method is collective: all ranks call it, or none."""

    def __init__(self, comm: Any = None) -> None:
        """comm: communicator of a group, see `split`; by default all ranks that were started."""
        sizes = [int(os.environ[name]) for name in _SIZES if name in os.environ]
        if comm is None and max(sizes, default=1) > 1:
            from mpi4py import MPI

            comm = MPI.COMM_WORLD
        self.rank: int = 0 if comm is None else comm.rank
        self.size: int = 1 if comm is None else comm.size
        self.comm: Any = comm if self.size > 1 else None
        self.started = bool(sizes)  # by a launcher, possibly on one rank
        self._host: Any = None

    def split(self, size: int) -> World:
        """The group of this rank, if ranks are grouped in order by so many."""
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
        """(size, n): the n values of every rank, on every rank, so that all take the same decisions."""
        mine = np.asarray(values, np.float64)
        if self.comm is None:
            return mine[None]
        table = np.empty((self.size, len(mine)))
        self.comm.Allgather(mine, table)
        return table

    def broadcast(self, value: Any, root: int = 0) -> Any:
        """A small object of the root rank, on all ranks."""
        return value if self.comm is None else self.comm.bcast(value, root)

    def on_leader(self, work: Callable[[], Any]) -> Any:
        """Do work on rank 0; its result, or its MpitledError, on all ranks."""
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
        """End every rank at once: an exception on one rank alone would leave the others waiting forever."""
        sys.stdout.flush()
        sys.stderr.flush()
        if self.comm is not None:
            self.comm.Abort(status)
        raise SystemExit(status)


class Halo:
    """Sums nodal values over the ranks that share a node, with the same bits on each of these ranks.

    Contributions are added in ascending order of rank, because addition is not associative. Requests are persistent and
    buffers are made once: an exchange allocates nothing. Ranks of one host read each other's buffers in shared memory;
    their messages are empty and only signal that a buffer is filled, so that no data moves while both compute. Each
    buffer exists twice, and the two are used in turn. No buffer is overwritten while another rank reads it, because a
    rank cannot be ahead by more than the message that follows the reading.
    """

    def __init__(
        self,
        world: World,
        shared: Sequence[tuple[int, NDArray[np.uint32]]],
        components: int,
        precision: type[np.floating] = np.float64,
    ) -> None:
        """shared: (rank, ascending nodes shared with it), ranks ascending, the same on both sides. Collective."""
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
        # Processors other than x86 may show the writes of another rank in a different order.
        self._fence: Callable[[], None] = self._window.Sync if close else lambda: None
        self._start: Callable[[list[Any]], None] = lambda requests: None
        self._wait: Callable[[list[Any]], Any] = lambda requests: None
        if shared:
            from mpi4py import MPI

            self._start, self._wait = MPI.Prequest.Startall, MPI.Request.Waitall

    def start(self, values: NDArray[np.floating]) -> None:
        """Send the values (components, n_nodes) of this rank at shared nodes; they must not change until `finish`."""
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
        """`start` and `finish`."""
        self.start(values)
        self.finish(values)

    def free(self) -> None:
        """Free the shared memory; the halo cannot be used afterwards. A process may compute many runs. Collective."""
        for *_, requests in self._turns:
            for request in requests:
                request.Free()
        self._turns.clear()
        if self._window is not None:
            self._window.Unlock_all()
            self._window.Free()


_NOTHING = np.empty(0)
#: Nodes, or their indices among all shared nodes, and a buffer for them.
_Part = tuple[NDArray[np.uint32], NDArray[np.floating]]
_Pairs = tuple[tuple[NDArray[np.floating], NDArray[np.floating]], ...]


def _shared_buffers(world: World, buffers: dict[int, NDArray[np.floating]]) -> tuple[Any, dict[int, _Pairs]]:
    """A window of shared memory, and for each neighbour on this host two pairs of buffers, written and read here.

    buffers: arrays of the sizes needed, by neighbour. Collective.
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
    window.Lock_all(MPI.MODE_NOCHECK)  # required by `Sync`; there is no other lock
    of_all = dict(zip(ranks, host.allgather(begins), strict=True))

    def buffer(writer: int, reader: int, turn: int) -> NDArray[np.floating]:
        memory: Any
        memory, _ = window.Shared_query(ranks.index(writer))
        like = buffers[reader if writer == world.rank else writer][0]
        return np.ndarray(like.shape, like.dtype, memory, of_all[writer][reader][turn])

    here = world.rank
    pairs = {rank: tuple((buffer(here, rank, turn), buffer(rank, here, turn)) for turn in (0, 1)) for rank in begins}
    return window, pairs


#: Bytes; buffers start at pages, so that ranks that write do not share a cache line.
_PAGE = 4096
