"""The file layout of results: VTKHDF with checksums in a group of its own; and how to read results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import checksum, hdf5_validation
from mpitled.cells.kind import KINDS, CellKind
from mpitled.errors import InputError, damaged
from mpitled.hdf5 import open_file
from mpitled.store.files import AGAIN, attribute, checksum_of, first_damaged, matching, read_json, read_rows

#: Version of the layout. Results of another layout are refused.
RESULT_LAYOUT = 3
FINISHED, UNFINISHED = "result.vtkhdf", "result.partial.vtkhdf"
#: Units of the data, and values of the attribute "units" of the datasets.
UNITS = {"Points": "m", "displacement": "m", "parameters": "m", "stress": "Pa", "Values": "s"}
#: Cell data "kind" of the vertices of EFG nodes; blocks have `CellKind.code`.
EFG_NODE = 1


class ResultBlock(NamedTuple):
    """A block of cells in a result."""

    name: str
    kind: CellKind
    cells: int
    nodes: int  # per cell


def in_file_order(blocks: Sequence[Any]) -> list[Any]:
    """Blocks with faces, None for the vertices of EFG nodes, and mesh-free blocks."""
    return [*(b for b in blocks if not b.kind.meshfree), None, *(b for b in blocks if b.kind.meshfree)]


def series_of(time: float, series: Mapping[str, float]) -> NDArray[np.float64]:
    """The time and the numbers of a frame, in the order of their checksum."""
    return np.array([time, *(series[name] for name in sorted(series))], np.float64)


class Result:
    """The results of a run. Data are read on demand, in the order of the file or in the order of the model.

    Methods raise InputError if a checksum is wrong. Use `errors.damaged` for a file from an untrusted source.
    """

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file, self._grid, self.path = file, file["VTKHDF"], path

    @cached_property
    def _of_mesh(self) -> dict[str, int]:
        """Checksums of the datasets of the mesh, by name."""
        return dict(read_json(self._file["mpitled"], "mesh_checksums"))

    def __enter__(self) -> Result:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def complete(self) -> bool:
        """Whether the run finished."""
        return ".partial" not in self.path.suffixes

    @property
    def metadata(self) -> dict[str, Any]:
        """The metadata at the start of the run."""
        return read_json(self._file["mpitled"], "metadata")

    @property
    def figures(self) -> dict[str, Any]:
        """The figures of the run at its end; empty if the run was killed."""
        return read_json(self._file["mpitled"], "figures") if "figures" in self._file["mpitled"] else {}

    def check(self) -> None:
        """Check every checksum. InputError names the data with a wrong checksum."""
        if name := first_damaged(self._file):
            raise self._damaged(name)
        for name, total in self._of_mesh.items():
            if checksum_of(self._grid[name]) != total:
                raise self._damaged(name)
        for name in (*(f"PointData/{n}" for n in self.names("Point")), *(f"CellData/{n}" for n in self.names("Cell"))):
            n_rows = int(self._grid[f"NumberOf{name.partition('Data')[0]}s"][0])
            totals = self._file[f"mpitled/checksums/{name}"]
            for frame in range(self.n_frames):
                if checksum_of(self._grid[name], frame * n_rows, n_rows) != totals[frame]:
                    raise self._damaged(f"{name} of frame {frame}")
        _ = self._numbers

    def names(self, kind: str) -> list[str]:
        """Names of the "Point" or "Cell" data of each frame."""
        return list(self._file[f"mpitled/checksums/{kind}Data"])

    @property
    def n_frames(self) -> int:
        steps = self._grid["Steps"]
        return min(int(steps.attrs["NSteps"]), len(steps["Values"]))

    @property
    def times(self) -> NDArray[np.float64]:
        """(n_frames,), s."""
        return self._numbers[0]

    @property
    def series(self) -> dict[str, NDArray[np.float64]]:
        """Numbers of the frames, (n_frames,), by name."""
        return self._numbers[1]

    @cached_property
    def _numbers(self) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
        n = self.n_frames
        times = self._grid["Steps/Values"][:n]
        series = {name: values[:n] for name, values in self._grid.get("FieldData", {}).items()}
        for frame, total in enumerate(self._file["mpitled/checksums/series"][:n]):
            numbers = series_of(times[frame], {name: values[frame] for name, values in series.items()})
            if checksum.total([checksum.share(numbers, 0)]) != total:
                raise self._damaged(f"time and energies of frame {frame}")
        return times, series

    @property
    def points(self) -> NDArray[np.float64]:
        """(nodes + integration points, 3), m, undeformed."""
        return self._checked("Points", self._grid["Points"][...])

    @cached_property
    def blocks(self) -> tuple[ResultBlock, ...]:
        """The blocks of cells, in the order of the model."""
        return tuple(
            ResultBlock(str(b["name"]), KINDS[b["kind"]], int(b["cells"]), int(b["nodes"]))
            for b in read_json(self._file["mpitled"], "blocks")
        )

    def block_rows(self, name: str) -> slice:
        """Rows of a block in the cells of the file."""
        return self._block_ranges[name][0]

    def corners(self, name: str) -> NDArray[np.int64]:
        """Corners of a block's cells, (cells, corners), as rows of `points`, in the order of the file.

        A mesh-free cell has one corner: its integration point.
        """
        rows, corners = self._block_ranges[name]
        return self._connectivity[corners].reshape(rows.stop - rows.start, -1)

    @property
    def hexahedra(self) -> NDArray[np.int64]:
        """(n_hexahedra, 8), rows of `points`."""
        of_blocks = [self.corners(block.name) for block in self.blocks if block.kind.name == "hexahedra"]
        return np.concatenate([np.empty((0, 8), np.int64), *of_blocks])

    @cached_property
    def _block_ranges(self) -> dict[str, tuple[slice, slice]]:
        """Rows of the cells and of the connectivity of each block."""
        n_efg = int(self._grid["NumberOfCells"][0]) - sum(block.cells for block in self.blocks)
        cell = corner = 0
        ranges = {}
        for block in in_file_order(self.blocks):
            cells, k = (n_efg, 1) if block is None else (block.cells, 1 if block.kind.meshfree else block.nodes)
            ranges[block.name if block else ""] = slice(cell, cell + cells), slice(corner, corner + k * cells)
            cell, corner = cell + cells, corner + k * cells
        return ranges

    @property
    def _connectivity(self) -> NDArray[np.int64]:
        return self._checked("Connectivity", self._grid["Connectivity"][...])

    def point_data(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Values (n_points, ...) at `points` in a frame (negative: from the end); data of the mesh have no frame."""
        return self._rows("Point", name, frame)

    def cell_data(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Values (n_cells, ...) of blocks with faces, of EFG nodes (nan or -1: no value), of integration points."""
        return self._rows("Cell", name, frame)

    @property
    def node_points(self) -> NDArray[np.float64]:
        """(n_nodes, 3), m, undeformed, in the order of the model."""
        return self.points[_ascending(self.point_data("node_id"))]

    def at_nodes(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Point data of the nodes, in the order of the model."""
        return self.point_data(name, frame)[_ascending(self.point_data("node_id"))]

    def at_integration_points(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Point data of the integration points, in the order of the model."""
        at_points = self.point_data(name, frame)[self.point_data("node_id") < 0]
        cell_id = self.cell_data("cell_id")
        return at_points[np.argsort(cell_id[len(cell_id) - len(at_points) :])]

    def in_cells(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Cell data in the order of the model's cells."""
        return self.cell_data(name, frame)[_ascending(self.cell_data("cell_id"))]

    def find(self, numbers: str, wanted: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(order, rows) of the wanted "node_id" or "cell_id" (ascending): wanted[i] is in row rows[order[i]]."""
        kind = "Point" if numbers == "node_id" else "Cell"
        stored, rows = matching(self._grid[f"{kind}Data/{numbers}"], wanted, 1)
        return np.argsort(stored), rows

    def point_rows(self, cell_rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows of the integration points of mesh-free cells: points and cells end with these, in the same order."""
        return cell_rows - int(self._grid["NumberOfCells"][0]) + int(self._grid["NumberOfPoints"][0])

    def rows(self, kind: str, name: str, frame: int, rows: NDArray[np.int64]) -> NDArray[Any]:
        """Rows (ascending) of the "Point" or "Cell" data of a frame."""
        first = int(self._grid[f"Steps/{kind}DataOffsets/{name}"][frame])
        return read_rows(self._grid[f"{kind}Data/{name}"], first + rows)

    def _rows(self, kind: str, name: str, frame: int) -> NDArray[Any]:
        first = int(self._grid[f"Steps/{kind}DataOffsets/{name}"][: max(1, self.n_frames)][frame])
        values = self._grid[f"{kind}Data/{name}"][first : first + int(self._grid[f"NumberOf{kind}s"][0])]
        return self._checked(f"{kind}Data/{name}", values, frame)

    def _checked(self, name: str, values: NDArray[Any], frame: int = 0) -> NDArray[Any]:
        """Returns the values. InputError if their checksum is wrong."""
        of_frames = self._file["mpitled/checksums"].get(name)
        if of_frames is None:
            expected, label = self._of_mesh[name], name
        else:
            frame %= self.n_frames
            expected, label = int(of_frames[frame]), f"{name} of frame {frame}"
        if checksum.total([checksum.share(values, 0)]) != expected:
            raise self._damaged(label)
        return values

    def _damaged(self, name: str) -> InputError:
        return InputError(f"{self.path}: is damaged: {name} is not what was written; run the deck again")


def _ascending(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the numbers 0, 1, 2, ..., in this order; -1 is ignored."""
    rows = np.flatnonzero(numbers >= 0)
    return rows[np.argsort(numbers[rows])]


def unfinished_bytes(directory: Path) -> int:
    """Size in bytes of the unfinished result in a directory, or 0."""
    path = Path(directory) / UNFINISHED
    return path.stat().st_size if path.exists() else 0


def is_unfinished(directory: Path) -> bool:
    """Whether a directory holds an unfinished result."""
    return (Path(directory) / UNFINISHED).exists()


def is_finished(directory: Path) -> bool:
    """Whether a directory holds a finished result."""
    return (Path(directory) / FINISHED).exists()


def is_result(path: Path) -> bool:
    """Whether the HDF5 file is a result of mpitled, of any layout. InputError if it is not HDF5."""
    with open_file(path) as file, damaged(path, "give another file"):
        hdf5_validation.check_file(file, path)
        return "mpitled" in file and "VTKHDF" in file


def open_result(path: Path) -> Result:
    """Open the result in a file, or in a directory. An unfinished result is newer than a finished one and preferred.

    InputError if there is no result, or the file is damaged or has another layout.
    """
    path = Path(path)
    if path.is_dir():
        existing = [path / name for name in (UNFINISHED, FINISHED) if (path / name).exists()]
        if not existing:
            raise InputError(f"{path}: holds no result; give the folder that 'mpitled run' wrote")
        path = existing[0]
    file = open_file(path)
    try:
        with damaged(path, AGAIN):
            hdf5_validation.check_file(file, path, numbers=True)
            layout = attribute(file["mpitled"], "layout") if "mpitled" in file and "VTKHDF" in file else None
            if layout == RESULT_LAYOUT:
                return Result(file, path)
    except InputError:
        file.close()
        raise
    file.close()
    if layout is None:
        raise InputError(f"{path}: is not a result of mpitled; give a file that 'mpitled run' wrote")
    raise InputError(f"{path}: has layout {layout}, this version reads {RESULT_LAYOUT}; run the deck again")
