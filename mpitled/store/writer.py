"""Results as all ranks write them together."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
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
#: (offset, type, number, material, kind, part; J), and of a corner of a cell.
_POINT_BYTES, _CELL_BYTES, _CORNER_BYTES = (24 + 16, 48), (8 + 1 + 8 + 2 + 1 + 4, 8), 8
#: Of the tables of steps for each frame; and of the deck, and HDF5's own.
_FRAME_BYTES, _ON_TOP = 537, 47_800


def result_bytes(rows: PartRows, n_frames: int) -> int:
    """Size of the whole model's result.vtkhdf with so many frames, to some kilobytes; see `ResultWriter`."""
    n_hexahedra, n_vertices = rows.n_hexahedra, rows.n_nodes - rows.n_fe_nodes + rows.n_domains
    n_points = rows.n_nodes + rows.n_domains
    size = sum(_POINT_BYTES[k] * n_points * n for k, n in enumerate((1, n_frames)))
    size += sum(_CELL_BYTES[k] * (n_hexahedra + n_vertices) * n for k, n in enumerate((1, n_frames)))
    return size + _CORNER_BYTES * (8 * n_hexahedra + n_vertices) + _FRAME_BYTES * n_frames + _ON_TOP


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
        point_data: Mapping[str, int] = MappingProxyType({"displacement": 3, "field_displacement": 3}),
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
        cell_data: Mapping[str, NDArray[np.float64]],
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
                pieces = np.split(values, [self._n_owned])
                shares[f"PointData/{name}"] = self._write(grid["PointData"][name], self._point_slabs, pieces, point_row)
            for name, values in cell_data.items():
                shares[f"CellData/{name}"] = self._write(
                    grid["CellData"][name], self._cell_slabs, self._with_efg(values, np.nan), cell_row
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
        part, counts, totals, before = self._part, self._counts, self._all_counts, self._counts_before
        owned = part.owned
        efg = owned & (part.nodes >= part.n_fe_nodes)
        sizes = np.array([8, 1, 1])
        corner_slabs = slabs_of(sizes * totals[1:], sizes * before[1:], sizes * counts[1:])
        integration_rows = totals[0] + before[3] + np.arange(counts[3])
        rows = part.read("rows")
        # Offsets say where each cell's corners end, after a first row that says where they begin.
        ends = [
            first + size * np.arange(1, n // size + 1) for (first, n), size in zip(corner_slabs, sizes, strict=True)
        ]
        end_slabs = [(first + 1, n) for first, n in self._cell_slabs]
        if part.part == 0:
            ends, end_slabs = [np.zeros(1, np.int64), *ends], [(0, 1), *end_slabs]

        grid = self._file.create_group("VTKHDF")
        grid.attrs["Version"] = np.array([2, 0])
        grid.attrs["Type"] = np.bytes_("UnstructuredGrid")
        n_corners = int((sizes * totals[1:]).sum())
        self._table(grid, "NumberOfPoints", [self._n_points])
        self._table(grid, "NumberOfCells", [self._n_cells])
        self._table(grid, "NumberOfConnectivityIds", [n_corners])

        def write(name: str, slabs: Slabs, n_rows: int, pieces: Sequence[NDArray[Any]]) -> None:
            made = make(grid, name, (n_rows, *pieces[0].shape[1:]), pieces[0].dtype)
            self._shares[name] = self._write(made, slabs, pieces)

        def of_kinds(values: Sequence[int], dtype: Any) -> list[NDArray[Any]]:
            return [np.full(n, value, dtype) for value, n in zip(values, counts[1:], strict=True)]

        # What is longest goes by blocks, as many on all ranks.
        made = _with_units(make(grid, "Points", (self._n_points, 3), np.float64))
        (row, _), of_domains = self._point_slabs
        share = self._write(made, [of_domains], [part.read("domain_points")])
        for first, last in _blocks(len(part.nodes), self._most_nodes):
            points = part.read("points", first, last)[owned[first:last]]
            share += self._write(made, [(row, len(points))], [points])
            row += len(points)
        self._shares["Points"] = share
        made = make(grid, "Connectivity", (n_corners,), np.int64)
        share = self._write(made, corner_slabs[1:], [rows[efg], integration_rows])
        for first, last in _blocks(part.n_own_hexahedra, self._most_hexahedra):
            corners = rows[np.searchsorted(part.nodes, part.read("hexahedra", first, last))].ravel()
            share += self._write(made, [(corner_slabs[0][0] + 8 * first, len(corners))], [corners])
        self._shares["Connectivity"] = share
        write("Offsets", end_slabs, self._n_cells + 1, ends)
        write("Types", self._cell_slabs, self._n_cells, of_kinds((_VTK_HEXAHEDRON, _VTK_VERTEX, _VTK_VERTEX), np.uint8))
        none = np.full(counts[3], -1)
        for name, of_nodes in (("node_id", part.nodes), ("node_label", part.read("node_ids"))):
            write(f"PointData/{name}", self._point_slabs, self._n_points, [of_nodes[owned], none])
        for name, of_cells in (
            ("cell_id", self._with_efg(part.read("cells"), -1)),
            ("material", self._with_efg(part.read("material"), -1)),
            ("kind", of_kinds((HEXAHEDRON, EFG_NODE, INTEGRATION_POINT), np.uint8)),
            ("part", of_kinds((part.part,) * 3, np.int32)),
        ):
            write(f"CellData/{name}", self._cell_slabs, self._n_cells, of_cells)

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

    def _with_efg(self, values: NDArray[Any], filler: float) -> list[NDArray[Any]]:
        """Values of own cells with `filler` for the vertices of EFG nodes, which are no cells of the model."""
        between = np.full((self._n_efg, *values.shape[1:]), filler, values.dtype)
        of_hexahedra, of_domains = np.split(values, [self._part.n_own_hexahedra])
        return [of_hexahedra, between, of_domains]

    def _table(self, group: h5py.Group, name: str, values: Any) -> None:
        """A small dataset of integers that all ranks make and the first writes."""
        dataset = make(group, name, np.shape(values), np.int64)
        values = np.asarray(values, np.int64)
        self._shares[dataset.name.removeprefix("/VTKHDF/")] = checksum.share(values, 0) if self._leads else 0
        if self._leads:
            dataset[...] = values

    def _write(self, dataset: h5py.Dataset, slabs: Slabs, pieces: Sequence[NDArray[Any]], first_row: int = 0) -> int:
        return write_rows(dataset, slabs, pieces, first_row, self._transfer)


def _with_units(dataset: h5py.Dataset) -> h5py.Dataset:
    """The same, which says what its numbers are in, if there is a unit."""
    name = dataset.name.rpartition("/")[2]
    if name in UNITS:
        dataset.attrs["units"] = np.bytes_(UNITS[name])
    return dataset


def _blocks(length: int, most: int) -> Iterator[tuple[int, int]]:
    """First and last row of blocks of so many rows; where that is less than most, empty ones follow."""
    for first in range(0, most, BLOCK):
        yield min(first, length), min(first + BLOCK, length)
