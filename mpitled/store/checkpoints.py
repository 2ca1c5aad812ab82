"""The file layout of checkpoints."""

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
from mpitled.hdf5 import open_file
from mpitled.store.files import (
    AGAIN,
    attribute,
    check_free_space,
    collective,
    create,
    first_damaged,
    fsync,
    make,
    matching,
    read_json,
    read_rows,
    write_json,
    write_rows,
    writing,
)
from mpitled.store.partitions import PartRows

#: Checkpoints of another layout are refused.
CHECKPOINT_LAYOUT = 2
#: The last checkpoint of a run, and the one before it.
CHECKPOINTS = ("checkpoint.h5", "checkpoint.previous.h5")


def write_checkpoint(
    directory: Path,
    comm: Any,
    part: PartRows,
    metadata: Mapping[str, Any],
    nodal: Mapping[str, NDArray[np.floating]],
    own: Sequence[float],
) -> None:
    """Write a checkpoint. Once it is on disc it replaces the last one, which is renamed.

    Collective. metadata: a value that JSON can hold, of rank 0; nodal: (n owned nodes, components) by name; own:
    numbers of this rank. InputError if it cannot be written.
    """
    if comm is not None and comm.size == 1:
        comm = None
    path, previous = (Path(directory) / name for name in CHECKPOINTS)
    new = path.with_name(f".{path.name}")
    transfer, shares = collective(comm), dict[str, int]()
    with writing(path):
        if part.part == 0:
            components = sum(values.shape[1] for values in nodal.values())
            check_free_space(
                path, 8 * part.n_nodes * (1 + components) + 8 * part.n_parts * len(own) + len(str(metadata))
            )
        # The latest format has checksums of its own for metadata.
        with create(new, comm, libver="latest") as file:
            file.attrs["layout"] = CHECKPOINT_LAYOUT

            def write(name: str, n_rows: int, first: int, values: NDArray[Any]) -> None:
                made = make(file, name, (n_rows, *values.shape[1:]), values.dtype)
                shares[name] = write_rows(made, first, values, 0, transfer)

            write("node", part.n_nodes, part.first_row, part.nodes[part.owned])
            for name, values in nodal.items():
                write(f"nodal/{name}", part.n_nodes, part.first_row, values)
            write("own", part.n_parts, part.part, np.array([own], np.float64))
            every = [shares] if comm is None else comm.allgather(shares)
            for name in shares:
                file[name].attrs["checksum"] = checksum.total(of_rank[name] for of_rank in every)
            write_json(file, "metadata", dict(metadata) if comm is None else comm.bcast(dict(metadata)))
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
    """Whether the HDF5 file is a checkpoint, of any layout. InputError if it is not HDF5."""
    with open_file(path) as file, damaged(path, AGAIN):
        hdf5_validation.check_file(file, path, numbers=True)
        return "metadata" in file and "node" in file


def checkpoint_contents(path: Path) -> dict[str, Any]:
    """The metadata of a checkpoint. Reads all of it. InputError if it is damaged, or not of this layout."""
    with open_file(path) as file, damaged(path, AGAIN):
        hdf5_validation.check_file(file, path, numbers=True)
        layout = attribute(file, "layout") if "metadata" in file and "node" in file else None
        if layout == CHECKPOINT_LAYOUT and (name := first_damaged(file)) is None:
            return dict(read_json(file, "metadata"))
    if layout is None:
        raise InputError(f"{path}: is not a checkpoint of mpitled")
    if layout != CHECKPOINT_LAYOUT:
        raise InputError(f"{path}: has layout {layout}, this version reads {CHECKPOINT_LAYOUT}; begin anew")
    raise InputError(f"{path}: is damaged: {name} is not what was written")


def read_checkpoint(
    path: Path, nodes: NDArray[np.int64]
) -> tuple[dict[str, NDArray[np.floating]], NDArray[np.float64]]:
    """The nodal fields (n nodes, components) of a checkpoint by name, at nodes (ascending); the numbers of each rank.

    The file has to be one that `checkpoint_contents` has read.
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
    """Remove the checkpoints of a run, if there are any; whether there were."""
    paths = [Path(directory) / name for name in (f".{CHECKPOINTS[0]}", *CHECKPOINTS)]
    found = [path for path in paths if path.exists()]
    for path in found:
        with writing(path):
            path.unlink()
    return bool(found)
