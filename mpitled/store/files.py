"""HDF5 as every layout here uses it: files that are whole or absent, checksums, rows by number, ranks together."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import checksum, hdf5_validation, resources
from mpitled.errors import InputError, damaged

#: Bytes that are read over rather than skipped: about what one more call of HDF5 costs (70 us at 3.5 GB/s).
_GAP_BYTES = 1 << 18
#: Bytes held at most at a time beside what is asked for; stays in the cache.
_BLOCK_BYTES = 1 << 22
#: Remedies.
REBUILD, AGAIN = "build the model anew", "run the deck again"


def hdf5_version() -> str:
    """Version of the HDF5 library that h5py was built on."""
    return str(h5py.version.hdf5_version)


def has_mpi() -> bool:
    """Whether several ranks can write one file."""
    return bool(h5py.get_config().mpi)


def check_hdf5(path: Path) -> None:
    """InputError if another library that is about to read a file would be led out of it, or told to take too much."""
    with open_file(path) as file, damaged(path, "write it anew"):
        hdf5_validation.check_file(file, path)


def open_file(path: Path) -> h5py.File:
    """An HDF5 file, to be read. InputError if there is none, or it is none."""
    # No locks: every rank reads the same file, and network file systems often refuse them.
    try:
        return h5py.File(path, "r", locking=False)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except OSError as error:
        reason = "it is cut short" if "truncated" in str(error) else str(error).splitlines()[0]
        raise InputError(f"{path}: cannot be read as HDF5 ({reason}); make it anew, or give another file") from None


def attribute(holder: h5py.Group, name: str) -> str | int | None:
    """A text or a whole number, if it is there as one: what else attributes can hold is never read."""
    if name not in holder.attrs:
        return None
    kind = holder.attrs.get_id(name)
    if kind.shape != () or (kind.dtype.kind not in "iuS" and not h5py.check_string_dtype(kind.dtype)):
        raise ValueError(f"attribute {name} is neither a number nor text")
    value = holder.attrs[name]
    return value if isinstance(value, str) else value.decode() if isinstance(value, bytes) else int(value)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its name, safe on disc, when the block ends well."""
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
    """What the disc refuses, as one line that names the file."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be written ({str(error).splitlines()[0]})") from None


def check_room(path: Path, size: int) -> None:
    """InputError if the disc has no room for so many bytes, some of HDF5's own added: HDF5 takes a full disc badly."""
    path = Path(path)
    resources.check_disc(size + size // 50 + (1 << 16), path.parent, path.name, "make room, or give another folder")


def reserve(path: Path) -> None:
    """Take the room that the file says it has from the disc, so that no write into it finds the disc full."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.posix_fallocate(descriptor, 0, os.fstat(descriptor).st_size)
    finally:
        os.close(descriptor)


def fsync(path: Path) -> None:
    """See that a file, or the names in a folder, are on the disc."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def put(group: h5py.Group, name: str, values: Any) -> None:
    """A dataset with its checksum."""
    dataset = group.create_dataset(name, data=values)
    dataset.attrs["checksum"] = checksum.total([checksum.share(np.asarray(values), 0)])


def write_json(group: h5py.Group, name: str, value: Any) -> None:
    """A dataset of what JSON can hold."""
    # numpy's numbers become Python's.
    text = json.dumps(value, default=lambda number: number.item()).encode()
    put(group, name, np.bytes_(text))


def read_json(group: h5py.Group, name: str) -> Any:
    """What `write_json` wrote; InputError if it is not that any more."""
    text = group[name]
    if text.attrs.get("checksum", checksum_of(text)) != checksum_of(text):
        raise InputError(f"{group.file.filename}: {text.name} is not what was written; the file is damaged")
    return json.loads(text[()])


def checksum_of(dataset: h5py.Dataset, first: int = 0, count: int | None = None) -> int:
    """Checksum of `count` rows, read block by block."""
    if not dataset.shape:
        return checksum.total([checksum.share(np.asarray(dataset[()]), 0)])
    last = len(dataset) if count is None else first + count
    entries = int(np.prod(dataset.shape[1:]))
    rows = max(1, _BLOCK_BYTES // max(1, entries * dataset.dtype.itemsize))
    return checksum.total(
        checksum.share(dataset[start : min(start + rows, last)], (start - first) * entries)
        for start in range(first, last, rows)
    )


def whole(dataset: h5py.Dataset) -> NDArray[Any]:
    """All of a dataset of a model; InputError if it does not have the checksum, if any, that it was written with."""
    values = dataset[...]
    if dataset.attrs.get("checksum", total := checksum.total([checksum.share(values, 0)])) != total:
        raise InputError(f"{dataset.file.filename}: is damaged: {dataset.name} is not what was written; {REBUILD}")
    return values


def first_broken(file: h5py.File) -> str | None:
    """The first dataset that has another checksum than it was written with."""

    def look(name: str, thing: h5py.Group | h5py.Dataset) -> str | None:
        there = isinstance(thing, h5py.Dataset) and "checksum" in thing.attrs
        return name if there and thing.attrs["checksum"] != checksum_of(thing) else None

    return file.visititems(look)


def read_rows(dataset: h5py.Dataset, rows: NDArray[np.int64]) -> NDArray[Any]:
    """Rows of a dataset, given as ascending numbers without repeats.

    Reads ranges and picks from them. A gap is read over where that is cheaper than another call, so that the
    time is that of reading the file once at worst; HDF5's own lists of points cost a search for every row.
    """
    values = np.empty((len(rows), *dataset.shape[1:]), dataset.dtype)
    if values.size == 0:
        return values
    row_bytes = values.itemsize * int(np.prod(dataset.shape[1:]))
    buffer = np.empty((max(1, _BLOCK_BYTES // row_bytes), *dataset.shape[1:]), dataset.dtype)
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
    """Values of a list whose quotient is among `wanted` (ascending), and their rows; read block by block."""
    values, rows = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    block = _BLOCK_BYTES // 8
    for start in range(0, len(dataset) if len(wanted) else 0, block):
        some = dataset[start : start + block]
        place = np.searchsorted(wanted, some // divisor).clip(max=len(wanted) - 1)
        here = np.flatnonzero(wanted[place] == some // divisor)
        values.append(some[here])
        rows.append(start + here)
    return np.concatenate(values), np.concatenate(rows)


Slabs = list[tuple[int, int]]


def collective(comm: Any) -> h5py.h5p.PropDXID | None:
    """What makes a transfer one of all ranks."""
    if comm is None:
        return None
    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    return transfer


def create(path: Path, comm: Any, mode: str = "w", **options: Any) -> h5py.File:
    """A file that all ranks write together."""
    if comm is None:
        return h5py.File(path, mode, locking=False, **options)
    return h5py.File(path, mode, driver="mpio", comm=comm, **options)


def make(group: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any, **options: Any) -> h5py.Dataset:
    """A dataset, contiguous unless told otherwise, with its room on disc from the start.

    A run that is killed then keeps what it wrote; resizable data were lost.
    """
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    return group.create_dataset(name, shape, dtype, dcpl=properties, **options)


def slabs_of(totals: NDArray[np.int64], before: NDArray[np.int64], counts: NDArray[np.int64]) -> Slabs:
    """First row and count of this rank in each of several lists that follow each other in one dataset."""
    firsts = np.cumsum([0, *totals[:-1]]) + before
    return list(zip(firsts.tolist(), counts.tolist(), strict=True))


def write_rows(
    dataset: h5py.Dataset,
    slabs: Slabs,
    pieces: Sequence[NDArray[Any]],
    first_row: int,
    transfer: h5py.h5p.PropDXID | None,
) -> int:
    """Write the rows of this rank, a piece for each slab, in one collective call, which a rank without any makes too.

    Its share of the checksum of the rows from first_row on.
    """
    shape = (sum(count for _, count in slabs), *dataset.shape[1:])
    for (_, count), piece in zip(slabs, pieces, strict=True):
        if piece.shape != (count, *shape[1:]):
            raise ValueError(f"{dataset.name}: {piece.shape} values for {count} rows of shape {shape[1:]}")
    some = [piece for piece in pieces if len(piece)] or pieces[:1]
    values = np.ascontiguousarray(some[0] if len(some) == 1 else np.concatenate(some), dataset.dtype)
    space, memory = dataset.id.get_space(), h5py.h5s.create_simple(shape)
    space.select_none()
    entries, done, shares = int(np.prod(shape[1:])), 0, 0
    for start, count in slabs:
        if count:
            start_of_slab = (first_row + start, *(0 for _ in shape[1:]))
            space.select_hyperslab(start_of_slab, (count, *shape[1:]), op=h5py.h5s.SELECT_OR)
        shares += checksum.share(values[done : done + count], start * entries)
        done += count
    if not values.size:
        memory.select_none()
    dataset.id.write(memory, space, values, dxpl=transfer)
    return shares
