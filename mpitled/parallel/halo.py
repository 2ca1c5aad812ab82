"""Ranks and the exchange of nodal values. Only this module imports mpi4py, and only with more than one rank."""

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
    """Name and version of the MPI library, without MPI_Init. ImportError or RuntimeError if there is no library."""
    import mpi4py

    mpi4py.rc.initialize = False
    from mpi4py import MPI

    return " ".join(MPI.Get_library_version().replace(",", " ").replace("\0", " ").split()[:3])


class World:
    """All ranks of the job, or a group of ranks. Every method except `abort` is collective."""

    def __init__(self, comm: Any = None) -> None:
        """comm: mpi4py communicator of a group, see `split`; None: all ranks of the job."""
        sizes = [int(os.environ[name]) for name in _SIZES if name in os.environ]
        if comm is None and max(sizes, default=1) > 1:
            from mpi4py import MPI

            comm = MPI.COMM_WORLD
        self.rank: int = 0 if comm is None else comm.rank
        self.size: int = 1 if comm is None else comm.size
        self.comm: Any = comm if self.size > 1 else None
        self.started = bool(sizes)  # whether a launcher such as mpirun started this process, possibly on one rank
        self._host: Any = None

    def split(self, size: int) -> World:
        """The group of this rank: groups of `size` consecutive ranks."""
        return World(self.comm.Split(self.rank // size, self.rank))

    def host(self) -> Any:
        """The communicator of the ranks that share memory with this rank."""
        if self._host is None:
            from mpi4py import MPI

            self._host = self.comm.Split_type(MPI.COMM_TYPE_SHARED)
        return self._host

    @property
    def leads(self) -> bool:
        """Whether this is rank 0."""
        return self.rank == 0

    def gather(self, values: Sequence[float]) -> NDArray[np.float64]:
        """The n values of every rank, (size, n), on every rank, so that all ranks make the same decisions."""
        row = np.asarray(values, np.float64)
        if self.comm is None:
            return row[None]
        table = np.empty((self.size, len(row)))
        self.comm.Allgather(row, table)
        return table

    def broadcast(self, value: Any, root: int = 0) -> Any:
        """The value of the root rank, on all ranks."""
        return value if self.comm is None else self.comm.bcast(value, root)

    def on_leader(self, work: Callable[[], Any]) -> Any:
        """Call `work` on rank 0 only. Returns its result, or raises its MpitledError, on all ranks."""
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
        """End all ranks. An exception on one rank does not end the other ranks, which would wait forever."""
        sys.stdout.flush()
        sys.stderr.flush()
        if self.comm is not None:
            self.comm.Abort(status)
        raise SystemExit(status)


class Halo:
    """Sums nodal values over the ranks that share a node, with the same bits on each of these ranks.

    Contributions are added in ascending order of ranks, because addition is not associative. Requests are persistent
    and buffers are allocated once, so that an exchange allocates nothing. Ranks of one host read buffers of each other
    in shared memory; their messages are empty and only signal that a buffer is complete. Each buffer exists twice, and
    exchanges alternate between the two: a rank overwrites a buffer two exchanges later, and then the message of the
    exchange between shows that the other rank has read the buffer.
    """

    def __init__(
        self,
        world: World,
        shared: Sequence[tuple[int, NDArray[np.uint32]]],
        components: int,
        precision: type[np.floating] = np.float64,
    ) -> None:
        """shared: (rank, ascending nodes shared with this rank), ascending ranks, the same on both ranks. Collective.

        components: number of values of a node; precision: type of the values.
        """
        self.seconds = {"pack": 0.0, "wait": 0.0, "unpack": 0.0}
        self._all = np.unique(np.concatenate([nodes for _, nodes in shared])) if shared else np.zeros(0, np.uint32)
        self._total = np.empty((components, len(self._all)), precision)
        buffers = {rank: np.empty((4, components, len(nodes)), precision) for rank, nodes in shared}
        self._window, on_host = _shared_buffers(world, buffers)
        self._turns = []
        for turn in (0, 1):
            sends: list[_Part] = []
            below: list[_Part] = []
            above: list[_Part] = []
            requests: list[Any] = []
            for rank, nodes in shared:
                out, back = on_host[rank][turn] if rank in on_host else (buffers[rank][turn], buffers[rank][2 + turn])
                sends.append((nodes, out))
                indices = np.searchsorted(self._all, nodes).astype(np.uint32)
                (below if rank < world.rank else above).append((indices, back))
                sent, received = (_EMPTY, _EMPTY) if rank in on_host else (out, back)
                requests += [world.comm.Recv_init(received, rank), world.comm.Send_init(sent, rank)]
            self._turns.append((sends, below, above, requests))
        # Processors other than x86 may show the writes of another rank in a different order.
        self._fence: Callable[[], None] = self._window.Sync if on_host else lambda: None
        self._start: Callable[[list[Any]], None] = lambda requests: None
        self._wait: Callable[[list[Any]], Any] = lambda requests: None
        if shared:
            from mpi4py import MPI

            self._start, self._wait = MPI.Prequest.Startall, MPI.Request.Waitall

    def start(self, values: NDArray[np.floating]) -> None:
        """Send values (components, n_nodes) at shared nodes; the values must not change until `finish`."""
        begin = time.perf_counter()
        sends, *_, requests = self._turns[0]
        for nodes, buffer in sends:
            kernels.gather(values, nodes, buffer)
        self._fence()
        self._start(requests)
        self.seconds["pack"] += time.perf_counter() - begin

    def finish(self, values: NDArray[np.floating]) -> None:
        """Replace values (components, n_nodes) at shared nodes by their sums over the ranks."""
        begin = time.perf_counter()
        _, below, above, requests = self._turns[0]
        self._turns.reverse()
        self._wait(requests)
        self._fence()
        waited = time.perf_counter()
        self._total[:] = 0
        for indices, buffer in below:
            kernels.add(buffer, indices, self._total)
        kernels.add_gathered(values, self._all, self._total)
        for indices, buffer in above:
            kernels.add(buffer, indices, self._total)
        kernels.scatter(self._total, self._all, values)
        self.seconds["wait"] += waited - begin
        self.seconds["unpack"] += time.perf_counter() - waited

    def sum(self, values: NDArray[np.floating]) -> None:
        """`start` and `finish`."""
        self.start(values)
        self.finish(values)

    def free(self) -> None:
        """Free requests and shared memory, because a process may compute many runs. Collective."""
        for *_, requests in self._turns:
            for request in requests:
                request.Free()
        self._turns.clear()
        if self._window is not None:
            self._window.Unlock_all()
            self._window.Free()


_EMPTY = np.empty(0)
#: Nodes, or their indices among all shared nodes, and the buffer of their values.
_Part = tuple[NDArray[np.uint32], NDArray[np.floating]]
_Pairs = tuple[tuple[NDArray[np.floating], NDArray[np.floating]], ...]


def _shared_buffers(world: World, buffers: dict[int, NDArray[np.floating]]) -> tuple[Any, dict[int, _Pairs]]:
    """A window of shared memory, and two pairs (written buffer, read buffer) for each neighbour on this host.

    buffers: arrays with the shapes of the buffers, by neighbour. Collective.
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

    own = world.rank
    pairs = {rank: tuple((buffer(own, rank, turn), buffer(rank, own, turn)) for turn in (0, 1)) for rank in begins}
    return window, pairs


#: Bytes. Each buffer starts at a page, so that two ranks never write to the same cache line.
_PAGE = 4096
