"""The Python interface for notebooks: decks, models, runs, and results, which are read on access.

Results are in SI units. The keys of reports name their units.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import job, store
from mpitled.batch import cases
from mpitled.batch.summary import collect, records
from mpitled.deck import Deck, load_deck
from mpitled.errors import InputError
from mpitled.model import Model
from mpitled.model import build as model_build
from mpitled.parallel.halo import World

__all__ = ["Frames", "RunResult", "build_model", "load_deck", "open_result", "open_sweep", "run"]

#: Largest dataset that `to_xarray` reads into memory, bytes.
_LARGEST = 1 << 30


def build_model(deck: Deck | str | Path, overrides: str | Sequence[str] = ()) -> Model:
    """The discrete model of a deck, in memory. Overrides, "section.key=value", need a deck that is given as a path.

    InputError if the mesh and the deck do not fit each other.
    """
    return model_build.build(_load(deck, overrides))


def run(
    deck: Deck | str | Path,
    directory: str | Path,
    overrides: str | Sequence[str] = (),
    *,
    quiet: bool = True,
    resume: bool = False,
) -> Any:
    """Compute a deck into a directory on this process, or on all ranks of mpirun. Returns the content of report.json.

    `resume` continues from the last checkpoint in the directory, if there is one. Overrides, "section.key=value",
    need a deck that is given as a path. InputError, UnstableError or InterruptedRun on all ranks.
    """
    return job.run(_load(deck, overrides), Path(directory), World(), quiet=quiet, resume=resume)


def _load(deck: Deck | str | Path, overrides: str | Sequence[str]) -> Deck:
    if not isinstance(deck, Deck):
        return load_deck(deck, overrides)
    if overrides:
        raise InputError("overrides: need the path of a deck; give them to load_deck")
    return deck


def open_result(path: str | Path) -> RunResult:
    """The result in the folder of a run or in a result.vtkhdf. InputError if the file is absent or damaged."""
    return RunResult(store.open_result(Path(path)))


def open_sweep(folder: str | Path) -> list[dict[str, Any]]:
    """A record for each case of a sweep, for pandas.DataFrame. InputError if the folder holds no sweep."""
    return records(collect(cases.read_record(Path(folder))))


class Frames(Sequence[NDArray[Any]]):
    """An array for each frame, read on access: `frames[-1]` is the last frame."""

    def __init__(self, read: Callable[[int], NDArray[Any]], n_frames: int) -> None:
        self._read, self._n_frames = read, n_frames

    def __len__(self) -> int:
        return self._n_frames

    @property
    def shape(self) -> tuple[int, ...]:
        """(n_frames, ...), the shape of all frames in one array; reads the first frame."""
        return (self._n_frames, *self[0].shape)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of each frame; reads the first frame."""
        return self[0].dtype

    def __getitem__(self, frame: Any) -> Any:
        if not -self._n_frames <= frame < self._n_frames:
            raise IndexError(f"there are {self._n_frames} frames, but no frame {frame}")
        return self._read(frame % self._n_frames)


class RunResult:
    """The result of a run, read on access. Nodes and cells are in the model's order."""

    def __init__(self, result: store.Result) -> None:
        self._open: store.Result | None = result
        self.path = result.path
        self.complete = result.complete

    def __enter__(self) -> RunResult:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        ended = "" if self.complete else ", unfinished"
        return f"<RunResult {self.path}: {f'{self._result.n_frames} frames' if self._open else 'closed'}{ended}>"

    def close(self) -> None:
        """Close the file."""
        if self._open:
            self._open.__exit__()
        self._open = None

    @property
    def _result(self) -> store.Result:
        if self._open is None:
            raise InputError(f"{self.path}: is closed; read it inside `with`, or open it again")
        return self._open

    @property
    def times(self) -> NDArray[np.float64]:
        """(n_frames,), s; for dynamic relaxation the share of the load."""
        return self._result.times

    @property
    def points(self) -> NDArray[np.float64]:
        """(n_nodes, 3), m, undeformed."""
        return self._result.node_points

    @property
    def displacement(self) -> Frames:
        """(n_nodes, 3), m, in each frame: the field u_h, also at EFG nodes."""
        return self._frames(lambda frame: self._result.at_nodes("displacement", frame))

    @property
    def jacobian(self) -> Frames:
        """(n_cells,), 1, in each frame: det F of hexahedra, then of support domains."""
        return self._frames(lambda frame: self._result.in_cells("J", frame))

    @property
    def stress(self) -> Frames:
        """(n_cells, 6), Pa, in each frame: Cauchy stress xx, yy, zz, xy, yz, xz of hexahedra, then of support domains.

        If Poisson's ratio is near 0.5, pressures alternate between neighbouring cells (checkerboard): average over
        neighbours. InputError if the run wrote no stress.
        """
        if "stress" not in self._result.names("Cell"):
            raise InputError(f"{self.path}: holds no stress; run the deck with output.stress = true")
        return self._frames(lambda frame: self._result.in_cells("stress", frame))

    @property
    def history(self) -> dict[str, NDArray[np.float64]]:
        """Energies (J) and further series, each (n_frames,), by name, with "time"; for pandas.DataFrame."""
        return {"time": self.times, **self._result.series}

    @property
    def report(self) -> dict[str, Any]:
        """The content of report.json. InputError if there is none."""
        path = self.path.parent / "report.json"
        try:
            return dict(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read ({error}); write it: mpitled report {path.parent}") from None

    def to_pyvista(self, frame: int = -1) -> Any:
        """A frame as an undeformed pyvista.UnstructuredGrid, in metres. InputError without PyVista.

        Points are nodes and integration points, with their "displacement" (m). Cells are hexahedra (kind 0), a vertex
        for each EFG node (kind 1), and a vertex at the integration point of each support domain (kind 2). "J", and
        "stress" (Pa) if the run wrote it, are nan at EFG nodes. "material" is the index of the material in the deck, -1
        at EFG nodes.
        """
        try:
            from mpitled.results import solid
        except ImportError as error:
            raise InputError(
                f"to_pyvista: {error.name} is missing; install it: pip install 'mpitled[pictures]'"
            ) from None
        return self._frames(lambda frame: solid.frame_grid(self._result, frame))[frame]

    def to_xarray(self) -> Any:
        """All frames as xarray.Dataset. InputError without xarray, and if the frames are larger than 1 GiB."""
        try:
            import xarray
        except ImportError:
            raise InputError("to_xarray: xarray is missing; install it: pip install 'mpitled[python]'") from None
        points, n_frames = self.points, len(self.times)
        size = n_frames * (points.nbytes + self.jacobian[0].nbytes)
        if size > _LARGEST:
            raise InputError(f"to_xarray: {self.path} would take {size / 2**30:.1f} GiB; read single frames")
        return xarray.Dataset(
            {
                "displacement": (("frame", "node", "axis"), np.stack(list(self.displacement)), {"units": "m"}),
                "J": (("frame", "cell"), np.stack(list(self.jacobian))),
                "points": (("node", "axis"), points, {"units": "m"}),
                **{name: ("frame", values) for name, values in self._result.series.items()},
            },
            coords={"time": ("frame", self.times), "axis": list("xyz")},
            attrs={"title": self._result.metadata["title"], "path": os.fspath(self.path)},
        )

    def _frames(self, read: Callable[[int], NDArray[Any]]) -> Frames:
        return Frames(read, self._result.n_frames)
