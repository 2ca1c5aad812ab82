"""HDF5 for all layouts: atomic files, checksums, reading of selected rows, parallel writing."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import checksum, resources
from mpitled.errors import InputError

#: Gap between rows, bytes, that takes as long to read as one more call of HDF5 (70 us at 3.5 GB/s).
_GAP_BYTES = 1 << 18
#: Size of a temporary buffer in bytes: it fits into the cache.
_BUFFER_BYTES = 1 << 22
#: Remedies for damaged files.
REBUILD, AGAIN = "build the model anew", "run the deck again"


class OneRank:
    """The communicator of a run without MPI: methods of mpi4py's `Comm` for one rank."""

    rank, size = 0, 1

    def barrier(self) -> None: ...

    def bcast(self, value: Any) -> Any:
        return value

    def allgather(self, value: Any) -> list[Any]:
        return [value]


def hdf5_version() -> str:
    """Version of the HDF5 library that h5py was built on."""
    return str(h5py.version.hdf5_version)


def has_mpi() -> bool:
    """Whether several ranks can write one file."""
    return bool(h5py.get_config().mpi)


def attribute(holder: h5py.Group, name: str) -> str | int | None:
    """A text or an integer attribute, or None. ValueError if it is of another type: that is never read."""
    if name not in holder.attrs:
        return None
    kind = holder.attrs.get_id(name)
    if kind.shape != () or (kind.dtype.kind not in "iuS" and not h5py.check_string_dtype(kind.dtype)):
        raise ValueError(f"attribute {name} is neither a number nor text")
    value = holder.attrs[name]
    return value if isinstance(value, str) else value.decode() if isinstance(value, bytes) else int(value)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`. It replaces `path`, flushed to disc, if the block raises nothing."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    with writing(path):
        try:
            yield temporary
            fsync(temporary)
            os.replace(temporary, path)
            fsync(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn errors of the file system into an InputError that names the file."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be written ({str(error).splitlines()[0]})") from None


def check_free_space(path: Path, size: int) -> None:
    """InputError if the disc has no space for `size` bytes of data and HDF5's metadata.

    HDF5 may crash on a full disc.
    """
    path = Path(path)
    resources.check_disc(
        size + size // 50 + (1 << 16), path.parent, path.name, "free some space, or give another folder"
    )


def reserve(path: Path) -> None:
    """Allocate the blocks of a file on disc, so that no later write into the file fails on a full disc."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.posix_fallocate(descriptor, 0, os.fstat(descriptor).st_size)
    finally:
        os.close(descriptor)


def fsync(path: Path) -> None:
    """Flush a file, or the directory entries of a folder, to disc."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def put(group: h5py.Group, name: str, values: Any) -> None:
    """Write a dataset with its checksum as an attribute."""
    dataset = group.create_dataset(name, data=values)
    dataset.attrs["checksum"] = checksum.total([checksum.share(np.asarray(values), 0)])


def write_json(group: h5py.Group, name: str, value: Any) -> None:
    """Write a value as JSON text into a dataset; numpy scalars become Python numbers."""
    put(group, name, np.bytes_(json.dumps(value, default=lambda number: number.item()).encode()))


def read_json(group: h5py.Group, name: str) -> Any:
    """The value that `write_json` wrote. InputError if its checksum is wrong."""
    text = group[name]
    if text.attrs.get("checksum", checksum_of(text)) != checksum_of(text):
        raise InputError(f"{group.file.filename}: {text.name} is not what was written; the file is damaged")
    return json.loads(text[()])


def checksum_of(dataset: h5py.Dataset, first: int = 0, count: int | None = None) -> int:
    """Checksum of `count` rows (default: all rows from `first` on), read in pieces."""
    if not dataset.shape:
        return checksum.total([checksum.share(np.asarray(dataset[()]), 0)])
    last = len(dataset) if count is None else first + count
    entries = int(np.prod(dataset.shape[1:]))
    rows = max(1, _BUFFER_BYTES // max(1, entries * dataset.dtype.itemsize))
    return checksum.total(
        checksum.share(dataset[start : min(start + rows, last)], (start - first) * entries)
        for start in range(first, last, rows)
    )


def read_checked(dataset: h5py.Dataset) -> NDArray[Any]:
    """A dataset of a model. InputError if the dataset has a checksum and the checksum is wrong."""
    values = dataset[...]
    if dataset.attrs.get("checksum", total := checksum.total([checksum.share(values, 0)])) != total:
        raise InputError(f"{dataset.file.filename}: is damaged: {dataset.name} is not what was written; {REBUILD}")
    return values


def first_damaged(file: h5py.File) -> str | None:
    """The name of the first dataset with a wrong checksum, or None."""

    def check(name: str, item: h5py.Group | h5py.Dataset) -> str | None:
        has_checksum = isinstance(item, h5py.Dataset) and "checksum" in item.attrs
        return name if has_checksum and item.attrs["checksum"] != checksum_of(item) else None

    return file.visititems(check)


def read_rows(dataset: h5py.Dataset, rows: NDArray[np.int64]) -> NDArray[Any]:
    """Rows of a dataset; `rows` (n,) ascend without repetition.

    The function reads ranges and selects rows from them. It also reads short gaps, so that the time is at most the time
    to read the whole dataset. Point selections of HDF5 need a search for every row.
    """
    values = np.empty((len(rows), *dataset.shape[1:]), dataset.dtype)
    if values.size == 0:
        return values
    row_bytes = values.itemsize * int(np.prod(dataset.shape[1:]))
    buffer = np.empty((max(1, _BUFFER_BYTES // row_bytes), *dataset.shape[1:]), dataset.dtype)
    block = rows // len(buffer)
    breaks = np.flatnonzero((np.diff(rows) > _GAP_BYTES // row_bytes + 1) | (np.diff(block) > 0)) + 1
    for first, last in zip([0, *breaks], [*breaks, len(rows)], strict=True):
        start, stop = int(rows[first]), int(rows[last - 1]) + 1
        if stop - start == last - first:
            dataset.read_direct(values, np.s_[start:stop], np.s_[first:last])
        else:
            dataset.read_direct(buffer, np.s_[start:stop], np.s_[: stop - start])
            # A mode other than "raise" lets numpy write into `out` without a copy.
            np.take(buffer, rows[first:last] - start, axis=0, out=values[first:last], mode="clip")
    return values


def matching(
    dataset: h5py.Dataset, wanted: NDArray[np.int64], divisor: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Values of a 1D dataset for which value // divisor is in `wanted` (ascending), and their rows; read in pieces."""
    values, rows = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    block = _BUFFER_BYTES // 8
    for start in range(0, len(dataset) if len(wanted) else 0, block):
        piece = dataset[start : start + block]
        nearest = np.searchsorted(wanted, piece // divisor).clip(max=len(wanted) - 1)
        matches = np.flatnonzero(wanted[nearest] == piece // divisor)
        values.append(piece[matches])
        rows.append(start + matches)
    return np.concatenate(values), np.concatenate(rows)


def collective(comm: Any) -> h5py.h5p.PropDXID | None:
    """The property list of a collective transfer; None on one rank."""
    if comm.size == 1:
        return None
    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    return transfer


def create(path: Path, comm: Any, mode: str = "w", **options: Any) -> h5py.File:
    """Open a file that all ranks write. Collective."""
    if comm.size == 1:
        return h5py.File(path, mode, locking=False, **options)
    return h5py.File(path, mode, driver="mpio", comm=comm, **options)


def make(group: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any, **options: Any) -> h5py.Dataset:
    """Create a dataset, contiguous by default. Its space is allocated at once, so that the data survive a kill."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    return group.create_dataset(name, shape, dtype, dcpl=properties, **options)


def write_rows(
    dataset: h5py.Dataset,
    start: int,
    values: NDArray[Any],
    first_row: int,
    transfer: h5py.h5p.PropDXID | None,
) -> int:
    """Write this rank's rows from row first_row + start on, in one collective call; a rank may have no rows.

    Returns this rank's share of the checksum of all rows from first_row on.
    """
    shape = dataset.shape[1:]
    if values.shape[1:] != shape:
        raise ValueError(f"{dataset.name}: {values.shape} values for rows of shape {shape}")
    values = np.ascontiguousarray(values, dataset.dtype)
    space, memory = dataset.id.get_space(), h5py.h5s.create_simple(values.shape)
    space.select_none()
    if values.size:
        space.select_hyperslab((first_row + start, *(0 for _ in shape)), values.shape)
    else:
        memory.select_none()
    dataset.id.write(memory, space, values, dxpl=transfer)
    return checksum.share(values, start * int(np.prod(shape)))
