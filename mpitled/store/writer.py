"""Results as all ranks write them together."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import checksum
from mpitled.errors import InputError
from mpitled.store.files import (
    Slabs,
    check_room,
    collective,
    create,
    fsync,
    has_mpi,
    make,
    reserve,
    slabs_of,
    write_json,
    write_rows,
    writing,
)
from mpitled.store.partitions import BLOCK, PartRows
from mpitled.store.results import (
    EFG_NODE,
    FINISHED,
    HEXAHEDRON,
    INTEGRATION_POINT,
    RESULT_LAYOUT,
    UNFINISHED,
    UNITS,
    Result,
    open_result,
    series_of,
)

_VTK_VERTEX, _VTK_HEXAHEDRON = 1, 12
#: Bytes in a result, of the mesh and of each frame: of a point (place, two numbers; two displacements), of a cell
#: (offset, type, number, material, kind, part; what its frames hold is 8 for each component), and of a cell's corner.
_POINT_BYTES, _CELL_BYTES, _CORNER_BYTES = (24 + 16, 48), 8 + 1 + 8 + 2 + 1 + 4, 8
#: Of the tables of steps for each frame; and of the deck, and HDF5's own.
_FRAME_BYTES, _ON_TOP = 537, 47_800


def result_bytes(rows: PartRows, n_frames: int, cell_data: Mapping[str, int]) -> int:
    """Size of the whole model's result.vtkhdf with so many frames, to some kilobytes; see `ResultWriter`."""
    n_hexahedra, n_vertices = rows.n_hexahedra, rows.n_nodes - rows.n_fe_nodes + rows.n_domains
    n_points = rows.n_nodes + rows.n_domains
    size = sum(_POINT_BYTES[k] * n_points * n for k, n in enumerate((1, n_frames)))
    size += (_CELL_BYTES + 8 * sum(cell_data.values()) * n_frames) * (n_hexahedra + n_vertices)
    return size + _CORNER_BYTES * (8 * n_hexahedra + n_vertices) + _FRAME_BYTES * n_frames + _ON_TOP


#: Rows first to last of a column.
Rows = Callable[[int, int], NDArray[Any]]


class ResultWriter:
    """Writes `result.vtkhdf`: a VTKHDF unstructured grid with steps, one piece for the whole mesh, in parallel.

    Points are the owned nodes of rank 0, 1, ... and then the integration points of rank 0, 1, ...; cells are
    hexahedra, a vertex for each EFG node, and a vertex for each integration point, each kind by rank. The mesh is
    written once, undeformed. Every method is collective. Until `close` the file is named `result.partial.vtkhdf`,
    and at any time it can be read with all the frames that are finished.

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
        """Write the mesh and make room for `n_frames` frames at most, or go on with an unfinished file.

        Of the unfinished file in the directory so many `frames` are kept: as they are where it was written in the same
        parts, which the metadata's "partition" says, else in a new file, by global numbers.
        `comm` is an MPI communicator whose ranks are the parts in order, or None. `metadata` is what JSON can hold;
        rank 0's is kept. `point_data` and `cell_data` give the components of what each frame holds; `series` names
        the numbers of each frame. InputError, from here on, if the file cannot be written.
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
        """A new file with the mesh, no frame, and room for all."""
        components = sum(point_data.values()) * self._n_points + sum(cell_data.values()) * self._n_cells
        corners = int((np.array([8, 1, 1]) * self._all_counts[1:]).sum())
        if self._leads:
            path.unlink(missing_ok=True)
            check_room(path, 8 * (self._n_frames * components + corners) + 40 * self._n_points + 28 * self._n_cells)
        if self._comm is not None:
            self._comm.barrier()
        self._file = create(path, self._comm)
        self._write_mesh()
        self._make_steps(point_data, cell_data, series)
        ours = self._file.create_group("mpitled")
        ours.attrs["layout"] = RESULT_LAYOUT
        for name in (*(f"PointData/{n}" for n in point_data), *(f"CellData/{n}" for n in cell_data), "series"):
            make(ours, f"checksums/{name}", (self._n_frames,), np.int64)
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
        points = old.point_rows(in_cells[cells][part.n_own_hexahedra :])
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
        """Write one frame; it counts once it is on its way to the disc.

        Point data: (owned nodes + own support domains, components), nodes ascending, then integration points.
        Cell data: (own cells, components) in the order of the part's "cells". Rank 0's time (s) and series are kept.
        """
        if self._frame == self._n_frames:
            raise ValueError(f"{self._n_frames} frames were announced, and one more is written")
        if {*point_data, *cell_data, *(series or {})} != self._announced:
            raise ValueError(f"every frame holds {', '.join(sorted(self._announced))}")
        grid = self._file["VTKHDF"]
        point_row, cell_row = self._frame * self._n_points, self._frame * self._n_cells
        shares = {"series": checksum.share(series_of(time, series or {}), 0) if self._leads else 0}
        with writing(self._partial):
            for name, values in point_data.items():
                of_nodes, at_points = np.split(values, [self._n_owned])
                shares[f"PointData/{name}"] = self._write_points(
                    grid["PointData"][name], self._n_owned, partial(_rows_of, of_nodes), at_points, point_row
                )
            for name, of_cells in cell_data.items():
                of_hexahedra, of_domains = np.split(of_cells, [self._part.n_own_hexahedra])
                # No cells of the model are the vertices of EFG nodes.
                between = np.full((self._n_efg, *of_cells.shape[1:]), np.nan, of_cells.dtype)
                shares[f"CellData/{name}"] = self._write_cells(
                    grid["CellData"][name], partial(_rows_of, of_hexahedra), [between, of_domains], cell_row
                )
            totals = self._totals(shares)
            if self._leads:
                for name, value in (series or {}).items():
                    grid["FieldData"][name][self._frame] = value
                for name, total in totals.items():
                    self._file[f"mpitled/checksums/{name}"][self._frame] = total
            self._file.flush()
            self._frame += 1
            self._announce(self._frame, time)

    def _announce(self, n_frames: int, time: float | None = None) -> None:
        """Let readers know of so many frames, and of the time (s) of the last."""
        steps = self._file["VTKHDF/Steps"]
        # Together, and before the next flush: VTK reads all times into room for NSteps of them.
        steps.attrs.modify("NSteps", np.int64(n_frames))
        steps["Values"].resize((n_frames,))
        if self._leads and time is not None:
            steps["Values"][n_frames - 1] = time
        self._file.flush()

    def rewind(self, frames: int) -> None:
        """Go on after so many frames; those that follow are written over."""
        with writing(self._partial):
            self._frame = frames
            self._announce(frames)

    def sync(self) -> None:
        """See that the frames are on the disc."""
        with writing(self._partial):
            fsync(self._partial)

    def close(self, figures: Mapping[str, Any] | None = None) -> None:
        """End the file with rank 0's figures of the run (what JSON can hold) and give it its name."""
        self.abandon(figures)
        if self._leads:
            with writing(self._partial):
                fsync(self._partial)
                os.replace(self._partial, self._path)
                fsync(self._path.parent)
        if self._comm is not None:
            self._comm.barrier()

    def abandon(self, figures: Mapping[str, Any] | None = None) -> None:
        """End the file as it is; it keeps the name of an unfinished one and can be read."""
        with writing(self._partial):
            self._note("figures", figures or {})
            self._file.close()

    def _note(self, name: str, value: Mapping[str, Any]) -> None:
        # Made alike on all ranks, as HDF5 demands of whatever makes a dataset.
        write_json(self._file["mpitled"], name, value if self._comm is None else self._comm.bcast(dict(value)))

    def _totals(self, shares: Mapping[str, int]) -> dict[str, int]:
        """The checksums that all ranks' shares make."""
        rows = [list(shares.values())] if self._comm is None else self._comm.allgather(list(shares.values()))
        return {name: checksum.total(column) for name, column in zip(shares, zip(*rows, strict=True), strict=True)}

    def _count(self) -> None:
        """Where this rank's rows are."""
        part = self._part
        efg = part.owned & (part.nodes >= part.n_fe_nodes)
        counts = np.array([part.owned.sum(), part.n_own_hexahedra, efg.sum(), part.n_own_domains, len(part.nodes)])
        by_rank = np.array([counts] if self._comm is None else self._comm.allgather(counts))
        self._most_hexahedra, self._most_nodes = by_rank[:, [1, 4]].max(axis=0).tolist()
        counts, by_rank = counts[:4], by_rank[:, :4]
        totals, before = by_rank.sum(axis=0), by_rank[: part.part].sum(axis=0)
        self._counts, self._all_counts, self._counts_before = counts, totals, before
        self._n_owned, self._n_efg = int(counts[0]), int(counts[2])
        self._n_points, self._n_cells = int(totals[[0, 3]].sum()), int(totals[1:].sum())
        self._point_slabs = slabs_of(totals[[0, 3]], before[[0, 3]], counts[[0, 3]])
        self._cell_slabs = slabs_of(totals[1:], before[1:], counts[1:])

    def _write_mesh(self) -> None:
        corners = np.array([8, 1, 1])  # of each kind of cell
        totals, before, counts = (corners * n[1:] for n in (self._all_counts, self._counts_before, self._counts))
        corner_slabs, n_corners = slabs_of(totals, before, counts), int(totals.sum())
        grid = self._file.create_group("VTKHDF")
        grid.attrs["Version"] = np.array([2, 0])
        grid.attrs["Type"] = np.bytes_("UnstructuredGrid")
        self._table(grid, "NumberOfPoints", [self._n_points])
        self._table(grid, "NumberOfCells", [self._n_cells])
        self._table(grid, "NumberOfConnectivityIds", [n_corners])
        self._write_connectivity(make(grid, "Connectivity", (n_corners,), np.int64), corner_slabs)
        self._write_offsets(make(grid, "Offsets", (self._n_cells + 1,), np.int64), corner_slabs)
        self._write_point_columns(grid)
        self._write_cell_columns(grid)

    def _write_connectivity(self, made: h5py.Dataset, slabs: Slabs) -> None:
        part = self._part
        rows = part.read("rows")
        efg = part.owned & (part.nodes >= part.n_fe_nodes)
        at_points = self._all_counts[0] + self._counts_before[3] + np.arange(self._counts[3])
        (first_corner, _), *others = slabs

        def of_hexahedra(first: int, last: int) -> NDArray[np.int64]:
            return rows[part.local(part.read("hexahedra", first, last))].ravel()

        share = self._write(made, others, [rows[efg], at_points])
        length, most = part.n_own_hexahedra, self._most_hexahedra
        self._shares["Connectivity"] = share + self._write_long(made, first_corner, length, most, of_hexahedra)

    def _write_offsets(self, made: h5py.Dataset, slabs: Slabs) -> None:
        """Where each cell's corners end, after a first row that says where they begin."""
        begin = np.zeros(int(self._leads), np.int64)
        (first_corner, _), *others = slabs
        ends = [first + np.arange(1, n + 1) for first, n in others]

        def of_hexahedra(first: int, last: int) -> NDArray[np.int64]:
            return first_corner + 8 * np.arange(first + 1, last + 1)

        (row, length), *rows = ((row + 1, n) for row, n in self._cell_slabs)
        share = self._write(made, [(0, len(begin)), *rows], [begin, *ends])
        self._shares["Offsets"] = share + self._write_long(made, row, length, self._most_hexahedra, of_hexahedra)

    def _write_point_columns(self, grid: h5py.Group) -> None:
        part, owned = self._part, self._part.owned
        none = np.full(part.n_own_domains, -1)
        columns: list[tuple[str, Any, Rows, NDArray[Any]]] = [
            ("Points", np.float64, partial(part.read, "points"), part.read("domain_points")),
            ("PointData/node_id", np.int64, partial(_rows_of, part.nodes), none),
            ("PointData/node_label", np.int64, partial(part.read, "node_ids"), none),
        ]
        for name, dtype, of_nodes, at_points in columns:
            made = _with_units(make(grid, name, (self._n_points, *at_points.shape[1:]), dtype))

            def of_owned(first: int, last: int, of_nodes: Rows = of_nodes) -> NDArray[Any]:
                return of_nodes(first, last)[owned[first:last]]

            self._shares[name] = self._write_points(made, len(part.nodes), of_owned, at_points)

    def _write_cell_columns(self, grid: h5py.Group) -> None:
        part, none = self._part, np.full(self._n_efg, -1)
        columns: list[tuple[str, Any, Rows, list[NDArray[Any]]]] = [
            (f"CellData/{name}", dtype, partial(part.read, column), [none, part.read(column, part.n_own_hexahedra)])
            for name, dtype, column in (("cell_id", np.int64, "cells"), ("material", np.int16, "material"))
        ]
        for name, dtype, (of_hexahedra, *of_others) in (
            ("Types", np.uint8, (_VTK_HEXAHEDRON, _VTK_VERTEX, _VTK_VERTEX)),
            ("CellData/kind", np.uint8, (HEXAHEDRON, EFG_NODE, INTEGRATION_POINT)),
            ("CellData/part", np.int32, (part.part, part.part, part.part)),
        ):
            numbers = [np.full(n, value) for n, value in zip(self._counts[2:], of_others, strict=True)]
            columns.append((name, dtype, partial(_alike, of_hexahedra), numbers))
        for name, dtype, rows, others in columns:
            self._shares[name] = self._write_cells(make(grid, name, (self._n_cells,), dtype), rows, others)

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
        # The mesh, and what is said of it, is the same in every step: all offsets into it are 0.
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

    def _write(self, dataset: h5py.Dataset, slabs: Slabs, pieces: Sequence[NDArray[Any]], first_row: int = 0) -> int:
        return write_rows(dataset, slabs, pieces, first_row, self._transfer)

    def _write_long(
        self, dataset: h5py.Dataset, row: int, length: int, most: int, some: Rows, first_row: int = 0
    ) -> int:
        """Write what `some` gives of each block of a long column, from a row on; its share of the checksum.

        In as many calls on all ranks, of which the longest has `most`: a copy of the whole would be among the largest
        arrays of a run.
        """
        share = 0
        for begin in range(0, most, BLOCK):
            values = some(min(begin, length), min(begin + BLOCK, length))
            share += self._write(dataset, [(row, len(values))], [values], first_row)
            row += len(values)
        return share

    def _write_points(
        self, dataset: h5py.Dataset, length: int, of_nodes: Rows, at_points: NDArray[Any], first_row: int = 0
    ) -> int:
        """Rows of owned nodes, by blocks of so many in all, and of integration points; their share of the checksum."""
        (row, _), slab = self._point_slabs
        share = self._write(dataset, [slab], [at_points], first_row)
        return share + self._write_long(dataset, row, length, self._most_nodes, of_nodes, first_row)

    def _write_cells(
        self, dataset: h5py.Dataset, of_hexahedra: Rows, others: Sequence[NDArray[Any]], first_row: int = 0
    ) -> int:
        """Rows of own hexahedra, by blocks, and of EFG nodes and integration points; their share of the checksum."""
        (row, length), *slabs = self._cell_slabs
        share = self._write(dataset, slabs, others, first_row)
        return share + self._write_long(dataset, row, length, self._most_hexahedra, of_hexahedra, first_row)


def _with_units(dataset: h5py.Dataset) -> h5py.Dataset:
    """The same, which says what its numbers are in, if there is a unit."""
    name = dataset.name.rpartition("/")[2]
    if name in UNITS:
        dataset.attrs["units"] = np.bytes_(UNITS[name])
    return dataset


def _rows_of(values: NDArray[Any], first: int, last: int) -> NDArray[Any]:
    return values[first:last]


def _alike(value: int, first: int, last: int) -> NDArray[Any]:
    return np.full(last - first, value)
