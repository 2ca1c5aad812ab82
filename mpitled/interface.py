"""The Python interface: decks, models and runs for notebooks, and results that are read as they are asked for.

Numbers of results are in SI units, those of reports in the units that their keys name.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
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
from mpitled.results import views

__all__ = ["Frames", "RunResult", "build_model", "load_deck", "open_result", "open_sweep", "run"]

#: More than this is no small thing to hold at once, bytes.
_LARGEST = 1 << 30


def build_model(deck: Deck | str | Path, overrides: str | Sequence[str] = ()) -> Model:
    """The discrete model of a deck, in memory. InputError if the mesh and the deck do not fit each other.

    Overrides, "section.key=value", are for a deck that is given as a path.
    """
    return model_build.build(_loaded(deck, overrides))


def run(
    deck: Deck | str | Path,
    directory: str | Path,
    overrides: str | Sequence[str] = (),
    *,
    quiet: bool = True,
    resume: bool = False,
) -> Any:
    """Compute a deck into a directory on this process, or on all ranks under mpirun; its report, as report.json has it.

    With `resume` it goes on from the last checkpoint in the directory, from the start where there is none.
    Overrides, "section.key=value", are for a deck that is given as a path. InputError, UnstableError or
    InterruptedRun, alike on all ranks.
    """
    return job.run(_loaded(deck, overrides), Path(directory), World(), quiet=quiet, resume=resume)


def _loaded(deck: Deck | str | Path, overrides: str | Sequence[str]) -> Deck:
    if not isinstance(deck, Deck):
        return load_deck(deck, overrides)
    if overrides:
        raise InputError("overrides: are for a deck given as a path; give them to load_deck")
    return deck


def open_result(path: str | Path) -> RunResult:
    """The result of a run: its folder, or the result.vtkhdf in it. InputError if there is none."""
    return RunResult(store.open_result(Path(path)))


def open_sweep(folder: str | Path) -> list[dict[str, Any]]:
    """A record for each case of a sweep, as pandas.DataFrame takes them. InputError if the folder holds no sweep."""
    return records(collect(cases.read_record(Path(folder))))


class Frames:
    """An array for each frame, read when it is asked for: `frames[-1]` is the last."""

    def __init__(self, read: Callable[[int], NDArray[Any]], n_frames: int) -> None:
        self._read, self._n_frames = read, n_frames

    def __len__(self) -> int:
        return self._n_frames

    @property
    def shape(self) -> tuple[int, ...]:
        """Of all frames together, (n_frames, ...), as `numpy.stack` makes them; a frame is read for it."""
        return (self._n_frames, *self[0].shape)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of each frame, one of which is read for it."""
        return self[0].dtype

    def __getitem__(self, frame: int) -> NDArray[Any]:
        if not -self._n_frames <= frame < self._n_frames:
            raise IndexError(f"there are {self._n_frames} frames, and no {frame}")
        return self._read(frame % self._n_frames)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return map(self._read, range(self._n_frames))


class RunResult:
    """What a run wrote. Nothing is read before it is asked for; nodes and cells are in the model's order."""

    def __init__(self, result: store.Result) -> None:
        self._open: store.Result | None = result
        self.path = result.path
        self.complete = result.complete  # whether the run came to its end

    def __enter__(self) -> RunResult:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        ended = "" if self.complete else ", unfinished"
        return f"<RunResult {self.path}: {f'{self._result.n_frames} frames' if self._open else 'closed'}{ended}>"

    def close(self) -> None:
        """Let go of the file."""
        if self._open:
            self._open.__exit__()
        self._open = None

    @property
    def _result(self) -> store.Result:
        if self._open is None:
            raise InputError(f"{self.path}: is closed; read it before the end of `with`, or open it again")
        return self._open

    @property
    def times(self) -> NDArray[np.float64]:
        """(n_frames,), s; of dynamic relaxation the share of the load."""
        return self._result.times

    @property
    def points(self) -> NDArray[np.float64]:
        """(n_nodes, 3), m, undeformed."""
        return self._result.node_points

    @property
    def displacement(self) -> Frames:
        """(n_nodes, 3), m, in each frame: the field u_h, at EFG nodes too."""
        return self._frames(lambda frame: self._result.at_nodes("displacement", frame))

    @property
    def jacobian(self) -> Frames:
        """(n_cells,), det F of hexahedra, then of support domains, in each frame."""
        return self._frames(lambda frame: self._result.in_cells("J", frame))

    @property
    def stress(self) -> Frames:
        """(n_cells, 6), Pa, in each frame: Cauchy's of hexahedra, then of support domains; xx, yy, zz, xy, yz, xz.

        Of single cells: where Poisson's ratio is near 0.5 their pressures alternate, and means of neighbours tell more.
        InputError if the run wrote none.
        """
        if "stress" not in self._result.names("Cell"):
            raise InputError(f"{self.path}: holds no stress; run the deck with output.stress = true")
        return self._frames(lambda frame: self._result.in_cells("stress", frame))

    @property
    def history(self) -> dict[str, NDArray[np.float64]]:
        """Energies (J) and other numbers, (n_frames,), by name, with "time": as pandas.DataFrame takes it."""
        return {"time": self.times, **self._result.series}

    @property
    def report(self) -> dict[str, Any]:
        """The figures of report.json. InputError if there is none."""
        path = self.path.parent / "report.json"
        try:
            return dict(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read ({error}); make it: mpitled report {path.parent}") from None

    def to_pyvista(self, frame: int = -1) -> Any:
        """A frame as pyvista.UnstructuredGrid, undeformed, in metres. InputError without PyVista.

        Points are nodes and integration points, with "displacement" (m), the field's. Cells are hexahedra, and vertices
        for the EFG nodes and, at their integration points, for the support domains: "kind" is 0, 1 and 2 of them. "J",
        and "stress" (Pa) if the run wrote it, is that of hexahedra and domains, nan of EFG nodes; "material" is the
        number of their material in the deck, from 0, or -1.
        """
        return self._frames(lambda frame: views.grid(self._result, frame))[frame]

    def to_xarray(self) -> Any:
        """All frames as xarray.Dataset. InputError if they are more than a gigabyte."""
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
