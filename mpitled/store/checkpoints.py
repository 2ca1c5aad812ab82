"""The layout of checkpoints."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import checksum, hdf5_validation
from mpitled.errors import InputError, damaged
from mpitled.store.files import (
    AGAIN,
    Slabs,
    attribute,
    check_room,
    collective,
    create,
    first_broken,
    fsync,
    make,
    matching,
    open_file,
    read_json,
    read_rows,
    write_json,
    write_rows,
    writing,
)
from mpitled.store.partitions import PartRows

#: Checkpoints of another layout are refused.
CHECKPOINT_LAYOUT = 1
#: The last checkpoint of a run, and the one before it.
CHECKPOINTS = ("checkpoint.h5", "checkpoint.previous.h5")


def write_checkpoint(
    directory: Path,
    comm: Any,
    part: PartRows,
    told: Mapping[str, Any],
    nodal: Mapping[str, NDArray[np.floating]],
    own: Sequence[float],
) -> None:
    """Write a checkpoint, whole and on the disc before it takes the place of the last, which becomes the one before.

    Collective. told: what JSON can hold, rank 0's; nodal: (n owned nodes, components) by name; own: numbers of this
    rank. InputError if it cannot be written.
    """
    if comm is not None and comm.size == 1:
        comm = None
    path, previous = (Path(directory) / name for name in CHECKPOINTS)
    new = path.with_name(f".{path.name}")
    slabs, transfer, shares = [(part.first_row, int(part.owned.sum()))], collective(comm), {}
    with writing(path):
        if part.part == 0:
            components = sum(values.shape[1] for values in nodal.values())
            check_room(path, 8 * part.n_nodes * (1 + components) + 8 * part.n_parts * len(own) + len(str(told)))
        # The latest format has checksums of its own for what is not data.
        with create(new, comm, libver="latest") as file:
            file.attrs["layout"] = CHECKPOINT_LAYOUT

            def write(name: str, n_rows: int, slabs: Slabs, values: NDArray[Any]) -> None:
                made = make(file, name, (n_rows, *values.shape[1:]), values.dtype)
                shares[name] = write_rows(made, slabs, [values], 0, transfer)

            write("node", part.n_nodes, slabs, part.nodes[part.owned])
            for name, values in nodal.items():
                write(f"nodal/{name}", part.n_nodes, slabs, values)
            write("own", part.n_parts, [(part.part, 1)], np.array([own], np.float64))
            every = [shares] if comm is None else comm.allgather(shares)
            for name in shares:
                file[name].attrs["checksum"] = checksum.total(of_rank[name] for of_rank in every)
            write_json(file, "told", dict(told) if comm is None else comm.bcast(dict(told)))
            file.flush()
        fsync(new)
        if comm is not None:
            comm.barrier()
        if part.part == 0:
            if path.exists():
                os.replace(path, previous)
            os.replace(new, path)
            fsync(path.parent)
        if comm is not None:
            comm.barrier()


def is_checkpoint(path: Path) -> bool:
    """Whether the HDF5 file is a checkpoint, of whatever layout; InputError if it is no HDF5 file."""
    with open_file(path) as file, damaged(path, AGAIN):
        hdf5_validation.check_file(file, path, numbers=True)
        return "told" in file and "node" in file


def checkpoint_contents(path: Path) -> dict[str, Any]:
    """What a checkpoint tells. Reads all of it; InputError if it is none of this layout, or not what was written."""
    with open_file(path) as file, damaged(path, AGAIN):
        hdf5_validation.check_file(file, path, numbers=True)
        layout = attribute(file, "layout") if "told" in file and "node" in file else None
        if layout == CHECKPOINT_LAYOUT and (broken := first_broken(file)) is None:
            return dict(read_json(file, "told"))
    if layout is None:
        raise InputError(f"{path}: is not a checkpoint of mpitled")
    if layout != CHECKPOINT_LAYOUT:
        raise InputError(f"{path}: has layout {layout}, this version reads {CHECKPOINT_LAYOUT}; begin anew")
    raise InputError(f"{path}: is damaged: {broken} is not what was written")


def read_checkpoint(
    path: Path, nodes: NDArray[np.int64]
) -> tuple[dict[str, NDArray[np.floating]], NDArray[np.float64]]:
    """What a checkpoint holds of the nodes (ascending), (n nodes, components) by name; the numbers of each rank.

    Of a file that `checkpoint_contents` has read.
    """
    with open_file(path) as file, damaged(path, AGAIN):
        hdf5_validation.check_file(file, path, numbers=True)
        found, rows = matching(file["node"], nodes, 1)
        order = np.argsort(found)
        if not np.array_equal(found[order], nodes):
            raise ValueError("it is of other nodes")
        names: list[str] = []
        file["nodal"].visititems(lambda name, thing: names.append(name) if isinstance(thing, h5py.Dataset) else None)
        return {name: read_rows(file["nodal"][name], rows)[order] for name in names}, file["own"][...]


def discard_checkpoints(directory: Path) -> bool:
    """Remove the checkpoints of a run, if there are any: whether there were."""
    paths = [Path(directory) / name for name in (f".{CHECKPOINTS[0]}", *CHECKPOINTS)]
    there = [path for path in paths if path.exists()]
    for path in there:
        with writing(path):
            path.unlink()
    return bool(there)
