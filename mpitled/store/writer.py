"""Parallel writing of results."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import checksum
from mpitled.errors import InputError
from mpitled.store.files import (
    check_free_space,
    collective,
    create,
    fsync,
    has_mpi,
    make,
    reserve,
    write_json,
    write_rows,
    writing,
)
from mpitled.store.partitions import CHUNK_ROWS, PartBlock, PartRows
from mpitled.store.results import (
    EFG_NODE,
    FINISHED,
    RESULT_LAYOUT,
    UNFINISHED,
    UNITS,
    Result,
    in_file_order,
    open_result,
    series_of,
)

_VTK_VERTEX = 1
#: Bytes in a result, of the mesh and of each frame: of a point (position, two numbers; two displacements), of a cell
#: (offset, type, number, material, kind, part; frames hold 8 for each component), and of a corner of a cell.
_POINT_BYTES, _CELL_BYTES, _CORNER_BYTES = (24 + 16, 48), 8 + 1 + 8 + 2 + 1 + 4, 8
#: Bytes of the tables of steps for each frame; of the deck and of HDF5 itself.
_FRAME_BYTES, _FIXED_BYTES = 537, 47_800


class _Section(NamedTuple):
    """Consecutive points or cells of the result, with the rows of this rank.

    Points: the nodes (no block), and the integration points of each mesh-free block. Cells: the blocks, and a vertex
    for each EFG node (no block).
    """

    block: PartBlock | None
    corners: int  # points per cell
    n_own: int  # on this rank
    most: int  # on any rank
    row: int  # first of this rank
    corner: int  # first corner of this rank in the connectivity
    data: int  # first row of this rank in the data of a frame


#: Datasets with a row for each cell, and their types.
_CELL_COLUMNS: dict[str, Any] = {
    "Types": np.uint8,
    "CellData/cell_id": np.int64,
    "CellData/material": np.int16,
    "CellData/kind": np.uint8,
    "CellData/part": np.int32,
}
#: Rows first to last of this rank in a section.
Rows = Callable[[_Section, int, int], NDArray[Any]]


def result_bytes(rows: PartRows, n_frames: int, cell_data: Mapping[str, int]) -> int:
    """Size of the whole model's result.vtkhdf with so many frames, within some kilobytes; see `ResultWriter`."""
    n_efg, meshfree = rows.n_nodes - rows.n_fe_nodes, sum(b.n_cells for b in rows.blocks if b.kind.meshfree)
    n_corners = n_efg + meshfree + sum(b.n_cells * b.n_nodes for b in rows.blocks if not b.kind.meshfree)
    size = sum(_POINT_BYTES[k] * (rows.n_nodes + meshfree) * n for k, n in enumerate((1, n_frames)))
    size += (_CELL_BYTES + 8 * sum(cell_data.values()) * n_frames) * (rows.n_cells + n_efg)
    return size + _CORNER_BYTES * n_corners + _FRAME_BYTES * n_frames + _FIXED_BYTES


class ResultWriter:
    """Writes `result.vtkhdf`: a VTKHDF unstructured grid with steps, one piece for the whole mesh, in parallel.

    Points are the owned nodes, then the integration points of each mesh-free block. Cells are the blocks with faces, a
    vertex for each EFG node, and a vertex for each integration point. Each of these sections holds the rows of rank 0,
    1, ... in turn. The mesh is written once, undeformed. Every method is collective. Until `close` the file is named
    `result.partial.vtkhdf`, and at any time it can be read with all complete frames.

    VTKHDF: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/vtkhdf_specifications.html
    """

    def __init__(
        self,
        directory: Path,
        comm: Any,
        part: PartRows,
        n_frames: int,
        metadata: Mapping[str, Any],
        *,
        point_data: Mapping[str, int] = MappingProxyType({"displacement": 3, "parameters": 3}),
        cell_data: Mapping[str, int] = MappingProxyType({"J": 1}),
        series: Sequence[str] = (),
        frames: int = 0,
    ) -> None:
        """Write the mesh and allocate space for at most `n_frames` frames, or continue an unfinished file.

        Continuing keeps the first `frames` frames of the unfinished file in the directory: in place where it was
        written for the same partition (the metadata's "partition"), else in a new file, by global numbers.
        `comm` is an MPI communicator with the parts as ranks, in order, or None. `metadata` is a value that JSON can
        hold; that of rank 0 is written. `point_data` and `cell_data` give the components of the data of each frame;
        `series` names the numbers of each frame. InputError, here and in all methods, if the file cannot be written.
        """
        if comm is not None and comm.size == 1:
            comm = None
        if comm is not None and not has_mpi():
            raise InputError("h5py: is built without MPI; build it against parallel HDF5, or run on one rank")
        self._comm, self._part, self._n_frames, self._frame = comm, part, n_frames, 0
        self._announced = {*point_data, *cell_data, *series}
        self._path = Path(directory) / FINISHED
        self._partial = Path(directory) / UNFINISHED
        self._transfer = collective(comm)
        self._shares: dict[str, int] = {}  # of this rank, to the checksums of what is written once
        self._count()
        with writing(self._partial):
            if self._leads:
                Path(directory).mkdir(parents=True, exist_ok=True)
            if comm is not None:
                comm.barrier()
            if not frames:
                self._begin(self._partial, point_data, cell_data, series, metadata)
                return
        with open_result(self._partial) as old:
            if old.n_frames < frames:
                raise InputError(
                    f"{self._partial}: holds {old.n_frames} frames of {frames}; begin anew, without --resume"
                )
            if old.metadata["partition"] != metadata["partition"]:
                new = self._partial.with_name(f".{self._partial.name}")
                with writing(new):
                    self._begin(new, point_data, cell_data, series, metadata)
                self._take_over(old, frames, series)
                if self._leads:
                    with writing(new):
                        fsync(new)
                        os.replace(new, self._partial)
                return
        if comm is not None:
            comm.barrier()
        with writing(self._partial):
            self._file = create(self._partial, comm, "r+")
            self._frame = frames
            if "figures" in self._file["mpitled"]:
                del self._file["mpitled/figures"]
            self._announce(frames)

    def _begin(
        self,
        path: Path,
        point_data: Mapping[str, int],
        cell_data: Mapping[str, int],
        series: Sequence[str],
        metadata: Mapping[str, Any],
    ) -> None:
        """A new file with the mesh, no frame, and space for all frames."""
        components = sum(point_data.values()) * self._n_points + sum(cell_data.values()) * self._n_cells
        if self._leads:
            path.unlink(missing_ok=True)
            fixed = 8 * self._n_corners + 40 * self._n_points + 28 * self._n_cells
            check_free_space(path, 8 * self._n_frames * components + fixed)
        if self._comm is not None:
            self._comm.barrier()
        self._file = create(path, self._comm)
        self._write_mesh()
        self._make_steps(point_data, cell_data, series)
        ours = self._file.create_group("mpitled")
        ours.attrs["layout"] = RESULT_LAYOUT
        for name in (*(f"PointData/{n}" for n in point_data), *(f"CellData/{n}" for n in cell_data), "series"):
            make(ours, f"checksums/{name}", (self._n_frames,), np.int64)
        blocks = [
            {"name": block.name, "kind": block.kind.name, "cells": block.n_cells, "nodes": block.n_nodes}
            for block in self._part.blocks
        ]
        write_json(ours, "blocks", blocks)  # the same on all ranks
        self._note("metadata", metadata)
        self._note("mesh_checksums", self._totals(self._shares))
        self._file.flush()
        if self._leads:
            reserve(path)

    def _take_over(self, old: Result, frames: int, series: Sequence[str]) -> None:
        """Write the first frames of a file that was written in other parts."""
        part = self._part
        nodes, in_nodes = old.find("node_id", part.nodes[part.owned])
        cells, in_cells = old.find("cell_id", part.read("cells"))
        rows = in_cells[cells]
        own = [rows[b.first_own : b.first_own + b.n_own] for b in part.blocks if b.kind.meshfree]
        points = old.point_rows(np.concatenate([rows[:0], *own]))
        order = np.argsort(points)
        back = np.argsort(order)
        for k in range(frames):
            point_data = {
                name: np.concatenate([
                    old.rows("Point", name, k, in_nodes)[nodes], old.rows("Point", name, k, points[order])[back]
                ])
                for name in old.names("Point")
            }  # fmt: skip
            cell_data = {name: old.rows("Cell", name, k, in_cells)[cells] for name in old.names("Cell")}
            numbers = {name: float(old.series[name][k]) for name in series}
            self.write_frame(float(old.times[k]), point_data, cell_data, numbers)

    @property
    def _leads(self) -> bool:
        return self._comm is None or self._comm.rank == 0

    def write_frame(
        self,
        time: float,
        point_data: Mapping[str, NDArray[np.float64]],
        cell_data: Mapping[str, NDArray[np.floating]],
        series: Mapping[str, float] | None = None,
    ) -> None:
        """Write one frame, and publish it to readers.

        Point data: (owned nodes + own integration points, components), nodes ascending, then the points of the
        mesh-free blocks in order. Cell data: (own cells, components) in the order of the part's "cells". Time (s) and
        series are those of rank 0.
        """
        if self._frame == self._n_frames:
            raise ValueError(f"{self._n_frames} frames were announced, and one more is written")
        if {*point_data, *cell_data, *(series or {})} != self._announced:
            raise ValueError(f"every frame holds {', '.join(sorted(self._announced))}")
        shares = {"series": checksum.share(series_of(time, series or {}), 0) if self._leads else 0}
        with writing(self._partial):
            for kind, data in (("Point", point_data), ("Cell", cell_data)):
                for name, values in data.items():
                    shares[f"{kind}Data/{name}"] = self._write_data(kind, name, values)
            totals = self._totals(shares)
            if self._leads:
                for name, value in (series or {}).items():
                    self._file[f"VTKHDF/FieldData/{name}"][self._frame] = value
                for name, total in totals.items():
                    self._file[f"mpitled/checksums/{name}"][self._frame] = total
            self._file.flush()
            self._frame += 1
            self._announce(self._frame, time)

    def _write_data(self, kind: str, name: str, values: NDArray[np.floating]) -> int:
        """Write "Point" or "Cell" data of the present frame; this rank's share of the checksum."""
        sections, n = (self._points, self._n_points) if kind == "Point" else (self._cells, self._n_cells)
        length = self._part.n_own_cells if kind == "Cell" else sum(section.n_own for section in sections)
        if len(values) != length:
            raise ValueError(f"{name}: {values.shape} values for {length} rows")

        def rows(section: _Section, first: int, last: int) -> NDArray[np.floating]:
            if kind == "Cell" and section.block is None:
                return np.full((last - first, *values.shape[1:]), np.nan)
            return values[section.data + first : section.data + last]

        return self._write_sections(self._file[f"VTKHDF/{kind}Data/{name}"], sections, rows, self._frame * n)

    def _announce(self, n_frames: int, time: float | None = None) -> None:
        """Publish so many frames to readers, and the time (s) of the last."""
        steps = self._file["VTKHDF/Steps"]
        # Both before the next flush: VTK allocates NSteps times and reads all times into them.
        steps.attrs.modify("NSteps", np.int64(n_frames))
        steps["Values"].resize((n_frames,))
        if self._leads and time is not None:
            steps["Values"][n_frames - 1] = time
        self._file.flush()

    def rewind(self, frames: int) -> None:
        """Continue after so many frames; later frames are overwritten."""
        with writing(self._partial):
            self._frame = frames
            self._announce(frames)

    def sync(self) -> None:
        """Flush the frames to disc."""
        with writing(self._partial):
            fsync(self._partial)

    def close(self, figures: Mapping[str, Any] | None = None) -> None:
        """Finish the file with rank 0's figures of the run (a value that JSON can hold) and rename it."""
        self.abandon(figures)
        if self._leads:
            with writing(self._partial):
                fsync(self._partial)
                os.replace(self._partial, self._path)
                fsync(self._path.parent)
        if self._comm is not None:
            self._comm.barrier()

    def abandon(self, figures: Mapping[str, Any] | None = None) -> None:
        """Close the file under the name of an unfinished result; it can be read."""
        with writing(self._partial):
            self._note("figures", figures or {})
            self._file.close()

    def _note(self, name: str, value: Mapping[str, Any]) -> None:
        # The same on all ranks: HDF5 requires this where a dataset is made.
        write_json(self._file["mpitled"], name, value if self._comm is None else self._comm.bcast(dict(value)))

    def _totals(self, shares: Mapping[str, int]) -> dict[str, int]:
        """The checksums, sums of the shares of all ranks."""
        rows = [list(shares.values())] if self._comm is None else self._comm.allgather(list(shares.values()))
        return {name: checksum.total(column) for name, column in zip(shares, zip(*rows, strict=True), strict=True)}

    def _count(self) -> None:
        """The sections of points and cells, and the rows of this rank in each."""
        part, meshfree = self._part, [block for block in self._part.blocks if block.kind.meshfree]
        n_owned, n_efg = int(part.owned.sum()), int((part.owned & (part.nodes >= part.n_fe_nodes)).sum())
        self._points, self._n_points, _ = self._sections([None, *meshfree], n_owned, True)
        self._cells, self._n_cells, self._n_corners = self._sections(in_file_order(part.blocks), n_efg, False)

    def _sections(
        self, blocks: Sequence[PartBlock | None], n_others: int, of_points: bool
    ) -> tuple[list[_Section], int, int]:
        """Sections in order, with n_others rows in that without a block, and their rows and corners. Collective."""
        n_own = np.array([[n_others if block is None else block.n_own for block in blocks]])
        table = n_own if self._comm is None else np.concatenate(self._comm.allgather(n_own))
        totals, before = table.sum(axis=0), table[: self._part.part].sum(axis=0)
        corners = np.array([1 if block is None or block.kind.meshfree else block.n_nodes for block in blocks])
        row = np.cumsum(totals) - totals + before
        corner = np.cumsum(corners * totals) + corners * (before - totals)
        # Data of points are in the order of the sections, data of cells in the order of the model.
        of_cells = [0 if block is None else block.first_own for block in blocks]
        data = np.cumsum(n_own[0]) - n_own[0] if of_points else of_cells
        columns = np.stack([corners, n_own[0], table.max(axis=0), row, corner, data], axis=1).tolist()
        sections = [_Section(block, *numbers) for block, numbers in zip(blocks, columns, strict=True)]
        return sections, int(totals.sum()), int((corners * totals).sum())

    def _write_mesh(self) -> None:
        grid = self._file.create_group("VTKHDF")
        grid.attrs["Version"] = np.array([2, 0])
        grid.attrs["Type"] = np.bytes_("UnstructuredGrid")
        self._table(grid, "NumberOfPoints", [self._n_points])
        self._table(grid, "NumberOfCells", [self._n_cells])
        self._table(grid, "NumberOfConnectivityIds", [self._n_corners])
        part = self._part
        self._owned = np.flatnonzero(part.owned)
        self._result_rows = part.read("rows")  # of this rank's nodes
        self._efg_rows = self._result_rows[part.owned & (part.nodes >= part.n_fe_nodes)]
        corners = [section._replace(row=section.corner) for section in self._cells]
        self._write_column(grid, "Connectivity", np.int64, (self._n_corners,), corners, self._connectivity)
        self._write_column(grid, "Offsets", np.int64, (self._n_cells + 1,), self._offset_sections(), _offsets)
        for name in ("Points", "PointData/node_id", "PointData/node_label"):
            dtype, shape = (np.float64, (3,)) if name == "Points" else (np.int64, ())
            rows = partial(self._point_rows, name.rpartition("/")[2])
            self._write_column(grid, name, dtype, (self._n_points, *shape), self._points, rows)
        for name, of_cells in _CELL_COLUMNS.items():
            rows = partial(self._cell_rows, name.rpartition("/")[2])
            self._write_column(grid, name, of_cells, (self._n_cells,), self._cells, rows)
        del self._owned, self._result_rows, self._efg_rows

    def _write_column(
        self, grid: h5py.Group, name: str, dtype: Any, shape: tuple[int, ...], sections: Sequence[_Section], rows: Rows
    ) -> None:
        made = _with_units(make(grid, name, shape, dtype))
        self._shares[name] = self._write_sections(made, sections, rows)

    def _connectivity(self, section: _Section, first: int, last: int) -> NDArray[np.int64]:
        """Points of cells."""
        part, block = self._part, section.block
        if block is None:
            return self._efg_rows[first:last]
        if block.kind.meshfree:
            first_point = next(points.row for points in self._points if points.block is block)
            return first_point + np.arange(first, last)
        return self._result_rows[part.local(block.read("nodes", first, last))].ravel()

    def _offset_sections(self) -> list[_Section]:
        """A first row with the start of the corners, and rows with the end of each cell's corners."""
        start = _Section(None, 0, int(self._leads), 1, 0, 0, 0)
        return [start, *(section._replace(row=section.row + 1) for section in self._cells)]

    def _point_rows(self, name: str, section: _Section, first: int, last: int) -> NDArray[Any]:
        if section.block is not None:
            return section.block.read("points", first, last) if name == "Points" else np.full(last - first, -1)
        own = self._owned[first:last]
        if name == "node_id" or not len(own):
            return self._part.nodes[own] if name != "Points" else np.empty((0, 3))
        column = "points" if name == "Points" else "node_ids"
        return self._part.read(column, int(own[0]), int(own[-1]) + 1)[own - own[0]]

    def _cell_rows(self, name: str, section: _Section, first: int, last: int) -> NDArray[Any]:
        block = section.block
        if block is not None and name in ("cell_id", "material"):
            return block.read("cells" if name == "cell_id" else name, first, last)
        constants = {"part": self._part.part, "Types": _VTK_VERTEX, "kind": EFG_NODE}
        if block is not None:
            constants |= {"Types": block.kind.vtk_type, "kind": block.kind.code}
        return np.full(last - first, constants.get(name, -1))

    def _make_steps(self, point_data: Mapping[str, int], cell_data: Mapping[str, int], series: Sequence[str]) -> None:
        n = self._n_frames
        grid = self._file["VTKHDF"]
        steps = grid.create_group("Steps")
        steps.attrs["NSteps"] = np.int64(0)
        # One row at first, so that its one chunk has its place in the file; later only the extent changes.
        values = _with_units(make(steps, "Values", (1,), np.float64, maxshape=(n,), chunks=(n,)))
        if self._leads:
            values[...] = 0.0
        self._table(steps, "NumberOfParts", np.ones(n))
        # The mesh and its data are the same in every step: all offsets into them are 0.
        for name, shape in (
            ("PartOffsets", n),
            ("PointOffsets", n),
            ("CellOffsets", (n, 1)),
            ("ConnectivityIdOffsets", (n, 1)),
        ):
            self._table(steps, name, np.zeros(shape))
        for kind, n_rows, components in (("Point", self._n_points, point_data), ("Cell", self._n_cells, cell_data)):
            data, offsets = grid[f"{kind}Data"], steps.create_group(f"{kind}DataOffsets")
            for name in data:
                self._table(offsets, name, np.zeros(n))
            for name, width in components.items():
                _with_units(make(data, name, (n * n_rows, width)[: 1 + (width > 1)], np.float64))
                self._table(offsets, name, n_rows * np.arange(n))
        for name in series:
            numbers = make(grid, f"FieldData/{name}", (n,), np.float64)
            if self._leads:
                numbers[...] = np.nan
            self._table(steps, f"FieldDataOffsets/{name}", np.arange(n))
            self._table(steps, f"FieldDataSizes/{name}", np.ones((n, 2)))

    def _table(self, group: h5py.Group, name: str, values: Any) -> None:
        """A small dataset of integers that all ranks make and the first writes."""
        dataset = make(group, name, np.shape(values), np.int64)
        values = np.asarray(values, np.int64)
        self._shares[dataset.name.removeprefix("/VTKHDF/")] = checksum.share(values, 0) if self._leads else 0
        if self._leads:
            dataset[...] = values

    def _write_sections(
        self, dataset: h5py.Dataset, sections: Sequence[_Section], rows: Rows, first_row: int = 0
    ) -> int:
        """Write the rows of each section in pieces; this rank's share of the checksum.

        All ranks make as many calls as the rank with most rows. A copy of a whole column would be among the largest
        arrays of a run.
        """
        share = 0
        for section in sections:
            row = section.row
            for begin in range(0, section.most, CHUNK_ROWS):
                values = rows(section, min(begin, section.n_own), min(begin + CHUNK_ROWS, section.n_own))
                share += write_rows(dataset, row, values, first_row, self._transfer)
                row += len(values)
        return share


def _with_units(dataset: h5py.Dataset) -> h5py.Dataset:
    """The dataset, with its unit as an attribute if there is one."""
    name = dataset.name.rpartition("/")[2]
    if name in UNITS:
        dataset.attrs["units"] = np.bytes_(UNITS[name])
    return dataset


def _offsets(section: _Section, first: int, last: int) -> NDArray[np.int64]:
    return section.corner + section.corners * np.arange(first + 1, last + 1)
