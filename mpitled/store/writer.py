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

#: Rows first to last of a column.
Rows = Callable[[int, int], NDArray[Any]]


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

    @property
    def meshfree(self) -> bool:
        return self.block is not None and self.block.kind.meshfree


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
            for name, values in point_data.items():
                ends = np.cumsum([section.n_own for section in self._points])
                pieces = [partial(_rows_of, piece) for piece in np.split(values, ends[:-1])]
                shares[f"PointData/{name}"] = self._write_data(name, values, int(ends[-1]), self._points, pieces)
            for name, of_cells in cell_data.items():
                pieces = [
                    partial(_constant, np.nan, shape=of_cells.shape[1:])
                    if block is None
                    else partial(_rows_of, of_cells[block.first_own : block.first_own + block.n_own])
                    for block in (section.block for section in self._cells)
                ]
                n_own = self._part.n_own_cells
                shares[f"CellData/{name}"] = self._write_data(name, of_cells, n_own, self._cells, pieces)
            totals = self._totals(shares)
            if self._leads:
                for name, value in (series or {}).items():
                    self._file[f"VTKHDF/FieldData/{name}"][self._frame] = value
                for name, total in totals.items():
                    self._file[f"mpitled/checksums/{name}"][self._frame] = total
            self._file.flush()
            self._frame += 1
            self._announce(self._frame, time)

    def _write_data(
        self, name: str, values: NDArray[Any], length: int, sections: Sequence[_Section], rows: Sequence[Rows]
    ) -> int:
        """Write the data of the present frame; this rank's share of the checksum."""
        if len(values) != length:
            raise ValueError(f"{name}: {values.shape} values for {length} rows")
        kind, n = ("Point", self._n_points) if sections is self._points else ("Cell", self._n_cells)
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
        part = self._part
        self._efg = part.owned & (part.nodes >= part.n_fe_nodes)
        cells: list[PartBlock | None] = in_file_order(part.blocks)
        points = [None, *(block for block in part.blocks if block.kind.meshfree)]
        n_own = [int(part.owned.sum()), *(block.n_own for block in points if block is not None)]
        n_own += [int(self._efg.sum()) if block is None else block.n_own for block in cells]
        counts = np.array([[*n_own, len(part.nodes)]])
        table = counts if self._comm is None else np.concatenate(self._comm.allgather(counts))
        totals, before = table[:, :-1].sum(axis=0), table[: part.part, :-1].sum(axis=0)
        most = table.max(axis=0).tolist()
        self._most_nodes = most[-1]
        corners = [1 if block is None or block.kind.meshfree else block.n_nodes for block in (*points, *cells)]
        sections = []
        for own in (slice(0, len(points)), slice(len(points), len(totals))):
            row = np.cumsum([0, *totals[own][:-1]]) + before[own]
            corner = np.cumsum([0, *(corners[own] * totals[own])[:-1]]) + corners[own] * before[own]
            columns = (corners[own], n_own[own], most[own], row.tolist(), corner.tolist())
            sections.append(
                [_Section(block, *numbers) for block, *numbers in zip((*points, *cells)[own], *columns, strict=True)]
            )
        self._points, self._cells = sections
        self._n_points, self._n_cells = (int(totals[: len(points)].sum()), int(totals[len(points) :].sum()))
        self._n_corners = int((np.array(corners) * totals)[len(points) :].sum())

    def _write_mesh(self) -> None:
        grid = self._file.create_group("VTKHDF")
        grid.attrs["Version"] = np.array([2, 0])
        grid.attrs["Type"] = np.bytes_("UnstructuredGrid")
        self._table(grid, "NumberOfPoints", [self._n_points])
        self._table(grid, "NumberOfCells", [self._n_cells])
        self._table(grid, "NumberOfConnectivityIds", [self._n_corners])
        self._write_connectivity(make(grid, "Connectivity", (self._n_corners,), np.int64))
        self._write_offsets(make(grid, "Offsets", (self._n_cells + 1,), np.int64))
        self._write_point_columns(grid)
        self._write_cell_columns(grid)

    def _write_connectivity(self, made: h5py.Dataset) -> None:
        rows, share = self._part.read("rows"), 0
        points = iter(self._points[1:])
        for section in self._cells:
            if section.block is None:
                of_section: Rows = partial(_rows_of, rows[self._efg])
            elif section.meshfree:
                of_section = partial(_count_from, next(points).row, 1)
            else:
                of_section = partial(self._corners, rows, section.block)
            share += self._write_long(made, section.corner, section.n_own, section.most, of_section)
        self._shares["Connectivity"] = share

    def _corners(self, rows: NDArray[np.int64], block: PartBlock, first: int, last: int) -> NDArray[np.int64]:
        """Points of cells of a block; rows: of this rank's nodes in the file."""
        return rows[self._part.local(block.read("nodes", first, last))].ravel()

    def _write_offsets(self, made: h5py.Dataset) -> None:
        """The end of each cell's corners, after a first row with their start."""
        share = self._write(made, 0, np.zeros(int(self._leads), np.int64))
        for section in self._cells:
            ends = partial(_count_from, section.corner + section.corners, section.corners)
            share += self._write_long(made, section.row + 1, section.n_own, section.most, ends)
        self._shares["Offsets"] = share

    def _write_point_columns(self, grid: h5py.Group) -> None:
        part, owned = self._part, self._part.owned
        columns: list[tuple[str, Any, tuple[int, ...], Rows, str]] = [
            ("Points", np.float64, (3,), partial(part.read, "points"), "points"),
            ("PointData/node_id", np.int64, (), partial(_rows_of, part.nodes), ""),
            ("PointData/node_label", np.int64, (), partial(part.read, "node_ids"), ""),
        ]
        for name, dtype, shape, of_nodes, column in columns:
            made = _with_units(make(grid, name, (self._n_points, *shape), dtype))

            def of_owned(first: int, last: int, of_nodes: Rows = of_nodes) -> NDArray[Any]:
                return of_nodes(first, last)[owned[first:last]]

            share = self._write_long(made, self._points[0].row, len(part.nodes), self._most_nodes, of_owned)
            blocks = [section.block for section in self._points[1:] if section.block is not None]
            of_blocks = [partial(block.read, column) if column else partial(_constant, -1) for block in blocks]
            self._shares[name] = share + self._write_sections(made, self._points[1:], of_blocks)

    def _write_cell_columns(self, grid: h5py.Group) -> None:
        blocks = [section.block for section in self._cells]
        columns: list[tuple[str, Any, list[Rows]]] = [
            (
                f"CellData/{name}",
                dtype,
                [partial(_constant, -1) if b is None else partial(b.read, column) for b in blocks],
            )
            for name, dtype, column in (("cell_id", np.int64, "cells"), ("material", np.int16, "material"))
        ]
        for name, dtype, values in (
            ("Types", np.uint8, [_VTK_VERTEX if b is None else b.kind.vtk_type for b in blocks]),
            ("CellData/kind", np.uint8, [EFG_NODE if b is None else b.kind.code for b in blocks]),
            ("CellData/part", np.int32, [self._part.part] * len(blocks)),
        ):
            columns.append((name, dtype, [partial(_constant, value) for value in values]))
        for name, dtype, rows in columns:
            self._shares[name] = self._write_sections(make(grid, name, (self._n_cells,), dtype), self._cells, rows)

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

    def _write(self, dataset: h5py.Dataset, row: int, values: NDArray[Any], first_row: int = 0) -> int:
        return write_rows(dataset, row, values, first_row, self._transfer)

    def _write_long(
        self, dataset: h5py.Dataset, row: int, length: int, most: int, rows: Rows, first_row: int = 0
    ) -> int:
        """Write `rows` of a long column in pieces, from a row on; this rank's share of the checksum.

        All ranks make as many calls as the rank with `most` rows. A copy of the whole column would be among the largest
        arrays of a run.
        """
        share = 0
        for begin in range(0, most, CHUNK_ROWS):
            values = rows(min(begin, length), min(begin + CHUNK_ROWS, length))
            share += self._write(dataset, row, values, first_row)
            row += len(values)
        return share

    def _write_sections(
        self, dataset: h5py.Dataset, sections: Sequence[_Section], rows: Sequence[Rows], first_row: int = 0
    ) -> int:
        """Write the rows of each section; this rank's share of the checksum."""
        return sum(
            self._write_long(dataset, section.row, section.n_own, section.most, of_section, first_row)
            for section, of_section in zip(sections, rows, strict=True)
        )


def _with_units(dataset: h5py.Dataset) -> h5py.Dataset:
    """The dataset, with its unit as an attribute if there is one."""
    name = dataset.name.rpartition("/")[2]
    if name in UNITS:
        dataset.attrs["units"] = np.bytes_(UNITS[name])
    return dataset


def _rows_of(values: NDArray[Any], first: int, last: int) -> NDArray[Any]:
    return values[first:last]


def _constant(value: float, first: int, last: int, shape: tuple[int, ...] = ()) -> NDArray[Any]:
    return np.full((last - first, *shape), value)


def _count_from(start: int, step: int, first: int, last: int) -> NDArray[np.int64]:
    return start + step * np.arange(first, last)
