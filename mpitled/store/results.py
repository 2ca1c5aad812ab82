"""The layout of results, VTKHDF with checksums beside it, as it is read."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import checksum, hdf5_validation
from mpitled.errors import InputError, damaged
from mpitled.store.files import AGAIN, attribute, checksum_of, first_broken, matching, open_file, read_json, read_rows

#: Results of another layout are refused.
RESULT_LAYOUT = 2
FINISHED, UNFINISHED = "result.vtkhdf", "result.partial.vtkhdf"
#: Of what is in a result, as the attribute "units" of its dataset says too; decks and reports are in mm.
UNITS = {"Points": "m", "displacement": "m", "parameters": "m", "stress": "Pa", "Values": "s"}
HEXAHEDRON, EFG_NODE, INTEGRATION_POINT = 0, 1, 2


def series_of(time: float, series: Mapping[str, float]) -> NDArray[np.float64]:
    """The time and the numbers of a frame, as their checksum has them."""
    return np.array([time, *(series[name] for name in sorted(series))], np.float64)


class Result:
    """The results of a run, read as they are asked for: the grid as it is in the file, or in the model's order.

    Use it `with damaged` where the file may come from others.
    """

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file, self._grid, self.path = file, file["VTKHDF"], path

    @cached_property
    def _of_mesh(self) -> dict[str, int]:
        """Checksums of what is the same in every frame."""
        return dict(read_json(self._file["mpitled"], "mesh_checksums"))

    def __enter__(self) -> Result:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def complete(self) -> bool:
        """Whether the run came to its end."""
        return ".partial" not in self.path.suffixes

    @property
    def metadata(self) -> dict[str, Any]:
        """What the run was started with."""
        return read_json(self._file["mpitled"], "metadata")

    @property
    def figures(self) -> dict[str, Any]:
        """What the run ended with; empty if it was killed."""
        return read_json(self._file["mpitled"], "figures") if "figures" in self._file["mpitled"] else {}

    def check(self) -> None:
        """Read all of the file; InputError names what does not have the checksum that it was written with."""
        broken = first_broken(self._file)
        for name, total in self._of_mesh.items():
            if checksum_of(self._grid[name]) != total:
                broken = broken or name
        for name in (*(f"PointData/{n}" for n in self.names("Point")), *(f"CellData/{n}" for n in self.names("Cell"))):
            n_rows = int(self._grid[f"NumberOf{name.partition('Data')[0]}s"][0])
            totals = self._file[f"mpitled/checksums/{name}"]
            for frame in range(self.n_frames):
                if checksum_of(self._grid[name], frame * n_rows, n_rows) != totals[frame]:
                    broken = broken or f"{name} of frame {frame}"
        if broken:
            raise self._broken(broken)
        _ = self._numbers

    def names(self, kind: str) -> list[str]:
        """What each frame holds for each "Point" or "Cell"."""
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
        """Numbers of each frame, (n_frames,), by name."""
        return self._numbers[1]

    @cached_property
    def _numbers(self) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
        n = self.n_frames
        times = self._grid["Steps/Values"][:n]
        series = {name: values[:n] for name, values in self._grid.get("FieldData", {}).items()}
        for frame, total in enumerate(self._file["mpitled/checksums/series"][:n]):
            numbers = series_of(times[frame], {name: values[frame] for name, values in series.items()})
            if checksum.total([checksum.share(numbers, 0)]) != total:
                raise self._broken(f"time and energies of frame {frame}")
        return times, series

    @property
    def points(self) -> NDArray[np.float64]:
        """(nodes + integration points, 3), m, undeformed."""
        return self._whole("Points", self._grid["Points"][...])

    @property
    def hexahedra(self) -> NDArray[np.int64]:
        """(n_hexahedra, 8), rows of `points`."""
        n_hexahedra = int(np.count_nonzero(self.cell_data("kind") == HEXAHEDRON))
        return self._whole("Connectivity", self._grid["Connectivity"][...])[: 8 * n_hexahedra].reshape(-1, 8)

    def point_data(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Values at `points` in a frame (negative: from the last); of what does not change in any."""
        return self._rows("Point", name, frame)

    def cell_data(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Values in cells: hexahedra, EFG nodes (nan or -1 where it is nothing of theirs), integration points."""
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
        cell_id = self.cell_data("cell_id")[self.cell_data("kind") == INTEGRATION_POINT]
        return self.point_data(name, frame)[self.point_data("node_id") < 0][np.argsort(cell_id)]

    def in_cells(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Cell data of hexahedra and support domains, in the order of the model."""
        return self.cell_data(name, frame)[_ascending(self.cell_data("cell_id"))]

    def find(self, numbers: str, wanted: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where wanted (ascending) "node_id" or "cell_id" are: rows (ascending), and whose turn each wanted one is."""
        kind = "Point" if numbers == "node_id" else "Cell"
        found, rows = matching(self._grid[f"{kind}Data/{numbers}"], wanted, 1)
        return np.argsort(found), rows

    def point_rows(self, cell_rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows of the integration points that are in these rows of the cells: both end with them, in the same order."""
        return cell_rows - int(self._grid["NumberOfCells"][0]) + int(self._grid["NumberOfPoints"][0])

    def rows(self, kind: str, name: str, frame: int, rows: NDArray[np.int64]) -> NDArray[Any]:
        """Some rows (ascending) of what a frame holds for each "Point" or "Cell"."""
        first = int(self._grid[f"Steps/{kind}DataOffsets/{name}"][frame])
        return read_rows(self._grid[f"{kind}Data/{name}"], first + rows)

    def _rows(self, kind: str, name: str, frame: int) -> NDArray[Any]:
        first = int(self._grid[f"Steps/{kind}DataOffsets/{name}"][: max(1, self.n_frames)][frame])
        values = self._grid[f"{kind}Data/{name}"][first : first + int(self._grid[f"NumberOf{kind}s"][0])]
        return self._whole(f"{kind}Data/{name}", values, frame)

    def _whole(self, name: str, values: NDArray[Any], frame: int = 0) -> NDArray[Any]:
        """Values that have the checksum that they were written with; InputError if they have not."""
        of_frames = self._file["mpitled/checksums"].get(name)
        if of_frames is None:
            expected, where = self._of_mesh[name], name
        else:
            frame %= self.n_frames
            expected, where = int(of_frames[frame]), f"{name} of frame {frame}"
        if checksum.total([checksum.share(values, 0)]) != expected:
            raise self._broken(where)
        return values

    def _broken(self, what: str) -> InputError:
        return InputError(f"{self.path}: is damaged: {what} is not what was written; run the deck again")


def _ascending(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the numbers from 0 on, in their order; -1 is no number."""
    rows = np.flatnonzero(numbers >= 0)
    return rows[np.argsort(numbers[rows])]


def unfinished_bytes(directory: Path) -> int:
    """Room that the unfinished results in a directory take, which a run there goes on with or writes anew."""
    path = Path(directory) / UNFINISHED
    return path.stat().st_size if path.exists() else 0


def is_unfinished(directory: Path) -> bool:
    """Whether a directory holds results of a run that did not come to its end."""
    return (Path(directory) / UNFINISHED).exists()


def is_finished(directory: Path) -> bool:
    """Whether a directory holds the result of a run that came to its end."""
    return (Path(directory) / FINISHED).exists()


def is_result(path: Path) -> bool:
    """Whether the HDF5 file is a result of ours, of whatever layout; InputError if it is no HDF5 file."""
    with open_file(path) as file, damaged(path, "give another file"):
        hdf5_validation.check_file(file, path)
        return "mpitled" in file and "VTKHDF" in file


def open_result(path: Path) -> Result:
    """Results in a file, or in a directory: there the unfinished ones, which are later than any finished, if any.

    InputError if there are none, or the file is not one of ours or cut short.
    """
    path = Path(path)
    if path.is_dir():
        there = [path / name for name in (UNFINISHED, FINISHED) if (path / name).exists()]
        if not there:
            raise InputError(f"{path}: holds no result; give the folder that 'mpitled run' wrote")
        path = there[0]
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
