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
    OneRank,
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
#: Bytes of a point in the mesh (position, two numbers) and in each frame (two displacements); of a cell in the mesh
#: (offset, type, number, material, kind, part); and of a corner of a cell.
_POINT_BYTES, _CELL_BYTES, _CORNER_BYTES = (24 + 16, 48), 8 + 1 + 8 + 2 + 1 + 4, 8
#: Bytes of the tables of steps for each frame; bytes of the deck and of HDF5's metadata.
_FRAME_BYTES, _FIXED_BYTES = 537, 47_800


class _Section(NamedTuple):
    """Consecutive points or cells of the result, with the rows of this rank.

    Sections of points: the nodes (block None), and the integration points of each mesh-free block. Sections of cells:
    the blocks, and one vertex for each EFG node (block None).
    """

    block: PartBlock | None
    corners: int  # points per cell
    n_own: int  # rows of this rank
    max_own: int  # largest n_own of all ranks
    row: int  # first row of this rank in the file
    corner: int  # first corner of this rank in the connectivity
    data: int  # first row in this rank's data of a frame


#: Datasets with a row for each cell, and their types.
_CELL_COLUMNS: dict[str, Any] = {
    "Types": np.uint8,
    "CellData/cell_id": np.int64,
    "CellData/material": np.int16,
    "CellData/kind": np.uint8,
    "CellData/part": np.int32,
}
#: Function of (section, first, last): rows first to last of this rank in the section.
Rows = Callable[[_Section, int, int], NDArray[Any]]


def result_bytes(rows: PartRows, n_frames: int, cell_data: Mapping[str, int]) -> int:
    """Size in bytes of result.vtkhdf for all parts and n_frames frames, within a few kilobytes.

    cell_data: components of the cell data of each frame, by name.
    """
    n_efg, meshfree = rows.n_nodes - rows.n_fe_nodes, sum(b.n_cells for b in rows.blocks if b.kind.meshfree)
    n_corners = n_efg + meshfree + sum(b.n_cells * b.n_nodes for b in rows.blocks if not b.kind.meshfree)
    size = sum(_POINT_BYTES[k] * (rows.n_nodes + meshfree) * n for k, n in enumerate((1, n_frames)))
    size += (_CELL_BYTES + 8 * sum(cell_data.values()) * n_frames) * (rows.n_cells + n_efg)
    return size + _CORNER_BYTES * n_corners + _FRAME_BYTES * n_frames + _FIXED_BYTES


class ResultWriter:
    """Writes `result.vtkhdf` in parallel: a VTKHDF unstructured grid with time steps, in one piece.

    Points are the nodes, then the integration points of each mesh-free block. Cells are the blocks with faces, then a
    vertex for each EFG node, then a vertex for each integration point. Each section holds the rows of rank 0, rank 1,
    and so on. The undeformed mesh is written once. Every method is collective. Until `close`, the name of the file is
    `result.partial.vtkhdf`. Readers can read all complete frames at any time.

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
        """Write the mesh and allocate space for `n_frames` frames, or continue an unfinished file.

        comm: mpi4py communicator, rank i has part i; None for one rank.
        metadata: JSON value; the value of rank 0 is written.
        point_data, cell_data: number of components of the data of each frame, by name.
        series: names of the numbers of each frame.
        frames: frames of the unfinished file in the directory to keep. If the file has the same partition (see
            metadata "partition"), the writer continues it; otherwise the writer copies the frames into a new file.

        All methods raise InputError if the file cannot be written.
        """
        comm = comm or OneRank()
        if comm.size > 1 and not has_mpi():
            raise InputError("h5py: is built without MPI; build it against parallel HDF5, or run on one rank")
        self._comm, self._part, self._n_frames, self._frame = comm, part, n_frames, 0
        self._names = {*point_data, *cell_data, *series}
        self._path = Path(directory) / FINISHED
        self._partial = Path(directory) / UNFINISHED
        self._transfer = collective(comm)
        self._shares: dict[str, int] = {}  # this rank's shares of the checksums of the mesh
        self._count()
        with writing(self._partial):
            if self._leads:
                Path(directory).mkdir(parents=True, exist_ok=True)
            comm.barrier()
            if not frames:
                self._begin(self._partial, point_data, cell_data, series, metadata)
                return
        with open_result(self._partial) as old:
            if old.n_frames < frames:
                raise InputError(f"{self._partial}: holds {old.n_frames} of {frames} frames; run it without --resume")
            if old.metadata["partition"] != metadata["partition"]:
                new = self._partial.with_name(f".{self._partial.name}")
                with writing(new):
                    self._begin(new, point_data, cell_data, series, metadata)
                self._copy_frames(old, frames, series)
                if self._leads:
                    with writing(new):
                        fsync(new)
                        os.replace(new, self._partial)
                return
        comm.barrier()
        with writing(self._partial):
            self._file = create(self._partial, comm, "r+")
            self._frame = frames
            if "figures" in self._file["mpitled"]:
                del self._file["mpitled/figures"]
            self._publish(frames)

    def _begin(
        self,
        path: Path,
        point_data: Mapping[str, int],
        cell_data: Mapping[str, int],
        series: Sequence[str],
        metadata: Mapping[str, Any],
    ) -> None:
        """Create a file with the mesh, and space for all frames."""
        components = sum(point_data.values()) * self._n_points + sum(cell_data.values()) * self._n_cells
        if self._leads:
            path.unlink(missing_ok=True)
            fixed = 8 * self._n_corners + 40 * self._n_points + 28 * self._n_cells
            check_free_space(path, 8 * self._n_frames * components + fixed)
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
        self._write_json("metadata", metadata)
        self._write_json("mesh_checksums", self._totals(self._shares))
        self._file.flush()
        if self._leads:
            reserve(path)

    def _copy_frames(self, old: Result, frames: int, series: Sequence[str]) -> None:
        """Copy the first frames of a file with another partition, by global numbers of nodes and cells."""
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
        return bool(self._comm.rank == 0)

    def write_frame(
        self,
        time: float,
        point_data: Mapping[str, NDArray[np.float64]],
        cell_data: Mapping[str, NDArray[np.floating]],
        series: Mapping[str, float] | None = None,
    ) -> None:
        """Write one frame, and show it to readers.

        time: s, of rank 0; series: numbers by name, of rank 0; point_data: (owned nodes + integration points of this
        rank, components), nodes ascending, then the points of the mesh-free blocks in order; cell_data: (cells of this
        rank, components) in the order of the part's "cells". ValueError if names or lengths are wrong.
        """
        if self._frame == self._n_frames:
            raise ValueError(f"the file has space for {self._n_frames} frames only")
        if {*point_data, *cell_data, *(series or {})} != self._names:
            raise ValueError(f"every frame holds {', '.join(sorted(self._names))}")
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
            self._publish(self._frame, time)

    def _write_data(self, kind: str, name: str, values: NDArray[np.floating]) -> int:
        """Write "Point" or "Cell" data of the current frame; returns this rank's share of the checksum."""
        sections, n = (self._points, self._n_points) if kind == "Point" else (self._cells, self._n_cells)
        length = self._part.n_own_cells if kind == "Cell" else sum(section.n_own for section in sections)
        if len(values) != length:
            raise ValueError(f"{name}: {values.shape} values for {length} rows")

        def rows(section: _Section, first: int, last: int) -> NDArray[np.floating]:
            if kind == "Cell" and section.block is None:
                return np.full((last - first, *values.shape[1:]), np.nan)
            return values[section.data + first : section.data + last]

        return self._write_sections(self._file[f"VTKHDF/{kind}Data/{name}"], sections, rows, self._frame * n)

    def _publish(self, n_frames: int, time: float | None = None) -> None:
        """Show the first n_frames frames to readers; time: of the last frame, s."""
        steps = self._file["VTKHDF/Steps"]
        # Change both before the next flush: VTK allocates NSteps numbers and reads all values into them.
        steps.attrs.modify("NSteps", np.int64(n_frames))
        steps["Values"].resize((n_frames,))
        if self._leads and time is not None:
            steps["Values"][n_frames - 1] = time
        self._file.flush()

    def rewind(self, frames: int) -> None:
        """Continue after the first `frames` frames; the writer overwrites later frames."""
        with writing(self._partial):
            self._frame = frames
            self._publish(frames)

    def sync(self) -> None:
        """Flush the frames to disc."""
        with writing(self._partial):
            fsync(self._partial)

    def close(self, figures: Mapping[str, Any] | None = None) -> None:
        """Complete the file with the figures of the run (JSON value, of rank 0), and give the file its final name."""
        self.abandon(figures)
        if self._leads:
            with writing(self._partial):
                fsync(self._partial)
                os.replace(self._partial, self._path)
                fsync(self._path.parent)
        self._comm.barrier()

    def abandon(self, figures: Mapping[str, Any] | None = None) -> None:
        """Close the file under the name of an unfinished result."""
        with writing(self._partial):
            self._write_json("figures", figures or {})
            self._file.close()

    def _write_json(self, name: str, value: Mapping[str, Any]) -> None:
        # All ranks must create the same dataset.
        write_json(self._file["mpitled"], name, self._comm.bcast(dict(value)))

    def _totals(self, shares: Mapping[str, int]) -> dict[str, int]:
        """The checksums of arrays, by name, from the shares of all ranks."""
        of_ranks = self._comm.allgather(dict(shares))
        return {name: checksum.total(of_rank[name] for of_rank in of_ranks) for name in shares}

    def _count(self) -> None:
        """Set the sections of points and of cells. Collective."""
        part, meshfree = self._part, [block for block in self._part.blocks if block.kind.meshfree]
        n_owned, n_efg = int(part.owned.sum()), int((part.owned & (part.nodes >= part.n_fe_nodes)).sum())
        self._points, self._n_points, _ = self._sections([None, *meshfree], n_owned, True)
        self._cells, self._n_cells, self._n_corners = self._sections(in_file_order(part.blocks), n_efg, False)

    def _sections(
        self, blocks: Sequence[PartBlock | None], n_nodes: int, of_points: bool
    ) -> tuple[list[_Section], int, int]:
        """Sections, one for each block in order, and the total numbers of rows and corners. Collective.

        n_nodes: rows of this rank in the section without a block.
        """
        n_own = np.array([[n_nodes if block is None else block.n_own for block in blocks]])
        table = np.concatenate(self._comm.allgather(n_own))
        totals, before = table.sum(axis=0), table[: self._part.part].sum(axis=0)
        corners = np.array([1 if block is None or block.kind.meshfree else block.n_nodes for block in blocks])
        row = np.cumsum(totals) - totals + before
        corner = np.cumsum(corners * totals) + corners * (before - totals)
        # The data of points have the order of the sections, the data of cells have the order of the model.
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
        self._result_rows = part.read("rows")  # rows of this rank's nodes in the file
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
        self._shares[name] = self._write_sections(_with_units(make(grid, name, shape, dtype)), sections, rows)

    def _connectivity(self, section: _Section, first: int, last: int) -> NDArray[np.int64]:
        """Points of cells, one cell after another."""
        part, block = self._part, section.block
        if block is None:
            return self._efg_rows[first:last]
        if block.kind.meshfree:
            first_point = next(points.row for points in self._points if points.block is block)
            return first_point + np.arange(first, last)
        return self._result_rows[part.local(block.read("nodes", first, last))].ravel()

    def _offset_sections(self) -> list[_Section]:
        """Sections of the dataset Offsets: 0, then the end of each cell's corners."""
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
        # One row allocates the only chunk; later only the extent changes.
        values = _with_units(make(steps, "Values", (1,), np.float64, maxshape=(n,), chunks=(n,)))
        if self._leads:
            values[...] = 0.0
        self._table(steps, "NumberOfParts", np.ones(n))
        # The mesh and its data are the same in every step, so all their offsets are 0.
        for name in ("PartOffsets", "PointOffsets", "CellOffsets", "ConnectivityIdOffsets"):
            self._table(steps, name, np.zeros(n if name.startswith("P") else (n, 1)))
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
        """Write a small dataset of integers: all ranks create it, and rank 0 writes the values."""
        dataset = make(group, name, np.shape(values), np.int64)
        values = np.asarray(values, np.int64)
        self._shares[dataset.name.removeprefix("/VTKHDF/")] = checksum.share(values, 0) if self._leads else 0
        if self._leads:
            dataset[...] = values

    def _write_sections(
        self, dataset: h5py.Dataset, sections: Sequence[_Section], rows: Rows, first_row: int = 0
    ) -> int:
        """Write the rows of each section in pieces; returns this rank's share of the checksum.

        All ranks make as many calls as the rank with the most rows. Pieces, because a complete column would be one of
        the largest arrays of a run.
        """
        share = 0
        for section in sections:
            row = section.row
            for begin in range(0, section.max_own, CHUNK_ROWS):
                values = rows(section, min(begin, section.n_own), min(begin + CHUNK_ROWS, section.n_own))
                share += write_rows(dataset, row, values, first_row, self._transfer)
                row += len(values)
        return share


def _with_units(dataset: h5py.Dataset) -> h5py.Dataset:
    """Add the unit of the dataset as an attribute; returns the dataset."""
    name = dataset.name.rpartition("/")[2]
    if name in UNITS:
        dataset.attrs["units"] = np.bytes_(UNITS[name])
    return dataset


def _offsets(section: _Section, first: int, last: int) -> NDArray[np.int64]:
    return section.corner + section.corners * np.arange(first + 1, last + 1)
