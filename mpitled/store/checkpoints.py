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
    OneRank,
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

#: Version of the layout. Checkpoints of another layout are refused.
CHECKPOINT_LAYOUT = 2
#: File names of the last checkpoint of a run and of the previous checkpoint.
CHECKPOINTS = ("checkpoint.h5", "checkpoint.previous.h5")


def write_checkpoint(
    directory: Path,
    comm: Any,
    part: PartRows,
    metadata: Mapping[str, Any],
    nodal: Mapping[str, NDArray[np.floating]],
    rank_numbers: Sequence[float],
) -> None:
    """Write a checkpoint to disc, rename the last checkpoint, and give the new checkpoint its name. Collective.

    comm: mpi4py communicator, or None for one rank; metadata: JSON value, of rank 0; nodal: arrays (n_owned_nodes,
    components) by name; rank_numbers: numbers of this rank, equally many on all ranks. InputError if writing fails.
    """
    comm = comm or OneRank()
    path, previous = (Path(directory) / name for name in CHECKPOINTS)
    new = path.with_name(f".{path.name}")
    transfer, shares = collective(comm), dict[str, int]()
    with writing(path):
        if part.part == 0:
            components = sum(values.shape[1] for values in nodal.values())
            size = 8 * part.n_nodes * (1 + components) + 8 * part.n_parts * len(rank_numbers) + len(str(metadata))
            check_free_space(path, size)
        # The latest format of HDF5 has checksums of its metadata.
        with create(new, comm, libver="latest") as file:
            file.attrs["layout"] = CHECKPOINT_LAYOUT

            def write(name: str, n_rows: int, first: int, values: NDArray[Any]) -> None:
                dataset = make(file, name, (n_rows, *values.shape[1:]), values.dtype)
                shares[name] = write_rows(dataset, first, values, 0, transfer)

            write("node", part.n_nodes, part.first_row, part.nodes[part.owned])
            for name, values in nodal.items():
                write(f"nodal/{name}", part.n_nodes, part.first_row, values)
            write("own", part.n_parts, part.part, np.array([rank_numbers], np.float64))
            rank_shares = comm.allgather(shares)
            for name in shares:
                file[name].attrs["checksum"] = checksum.total(of_rank[name] for of_rank in rank_shares)
            write_json(file, "metadata", comm.bcast(dict(metadata)))
            file.flush()
        fsync(new)
        comm.barrier()
        if part.part == 0:
            if path.exists():
                os.replace(path, previous)
            os.replace(new, path)
            fsync(path.parent)
        comm.barrier()


def is_checkpoint(path: Path) -> bool:
    """Whether the HDF5 file is a checkpoint, of any layout. InputError if it is not HDF5."""
    with open_file(path) as file, damaged(path, AGAIN):
        hdf5_validation.check_file(file, path, numbers=True)
        return "metadata" in file and "node" in file


def checkpoint_contents(path: Path) -> dict[str, Any]:
    """The metadata of a checkpoint. Checks every checksum.

    InputError if the file is damaged, no checkpoint, or a checkpoint of another layout.
    """
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
    """The nodal fields of a checkpoint by name, (len(nodes), components), and the numbers of each rank, (n_ranks, n).

    nodes: (n,) ascending global numbers. `checkpoint_contents` must have checked the file. InputError if the file is
    damaged or lacks any of the nodes.
    """
    with open_file(path) as file, damaged(path, AGAIN):
        hdf5_validation.check_file(file, path, numbers=True)
        stored, rows = matching(file["node"], nodes, 1)
        order = np.argsort(stored)
        if not np.array_equal(stored[order], nodes):
            raise ValueError("the checkpoint lacks nodes of this part")
        names: list[str] = []
        file["nodal"].visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        return {name: read_rows(file["nodal"][name], rows)[order] for name in names}, file["own"][...]


def discard_checkpoints(directory: Path) -> bool:
    """Remove the checkpoints of a run; False if there are none. InputError if a file cannot be removed."""
    paths = [Path(directory) / name for name in (f".{CHECKPOINTS[0]}", *CHECKPOINTS)]
    existing = [path for path in paths if path.exists()]
    for path in existing:
        with writing(path):
            path.unlink()
    return bool(existing)
