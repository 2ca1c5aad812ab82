"""3-D views of a body before and after: by PyVista where it works, else by matplotlib; and a window to turn it in.

The only importer of PyVista. Where VTK finds no way to draw it may end the whole process, so that its pictures are made
in a process of their own.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import store
from mpitled.errors import InputError
from mpitled.results import report
from mpitled.results.solid import Solid, displaced

#: Of parts, told apart by the colour-blind (Okabe and Ito 2008), and the map of displacements, as in the cuts.
COLOURS = {"tumour": "#d55e00", "left ventricle": "#0072b2", "right ventricle": "#56b4e9", "body": "#d9d4cc"}
MAP = "magma_r"
#: Moves all alike, and so far that it would be black.
_PLAIN = {"tumour"}
_THIN = 0.4  # opacity of the body around the parts
_SCALARS = "displacement (mm)"
_LONGEST = 120  # s that PyVista may take for the pictures
_PIXELS = 900  # width of a panel
_NO_PYVISTA = 5  # exit status
_INSTALL = "PyVista is missing; install it: pip install 'mpitled[python]'"


@dataclass(frozen=True, slots=True)
class View:
    """Where the body is looked at from, in parallel projection, and what is seen of it; mm."""

    title: str
    labels: tuple[str, str]  # of the axes that run right and up
    right: NDArray[np.float64]  # (3,), unit vector
    up: NDArray[np.float64]  # (3,), unit vector
    low: NDArray[np.float64]  # (2,), limits of the picture, right and up
    high: NDArray[np.float64]

    @property
    def towards(self) -> NDArray[np.float64]:
        """(3,), unit vector towards the viewer."""
        return np.cross(self.right, self.up)

    def flat(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (..., 3) as (..., 2) in the picture."""
        return points @ np.stack([self.right, self.up], axis=1)


def parts(solid: Solid) -> dict[str, NDArray[np.int64]]:
    """Triangles (n, 3) by name: ventricles and tumour, or if there is neither the body."""
    found = {name.replace("_", " "): wall for name, wall in solid.walls.items()}
    if len(solid.tumour):
        found["tumour"] = solid.tumour
    return found or {"body": solid.surface}


def views(solid: Solid, centre: NDArray[np.float64] | None) -> list[View]:
    """At an angle, from the side of the tumour whose centre (3,), m, is given, and from above."""
    places = np.concatenate([solid.points, solid.points + solid.displacement])
    side = -1.0 if centre is not None and 1e3 * centre[0] < solid.points[:, 0].mean() else 1.0
    right = np.array([1.0, 0.8 * side, 0.0]) / np.hypot(1.0, 0.8)
    back = np.cross(np.array([0.0, 0.0, 1.0]), right)  # away from the viewer, level
    up = np.cos(0.35) * np.array([0.0, 0.0, 1.0]) + np.sin(0.35) * back
    made = []
    for title, labels, across, upwards in (
        ("at an angle", ("across (mm)", "up (mm)"), right, up),
        ("from above", ("x (mm)", "y (mm)"), np.eye(3)[0], np.eye(3)[1]),
    ):
        flat = places @ np.stack([across, upwards], axis=1)
        margin = 0.05 * np.ptp(flat, axis=0).max()
        made.append(View(title, labels, across, upwards, flat.min(axis=0) - margin, flat.max(axis=0) + margin))
    return made


def draw(directory: Path, path: Path) -> str:
    """Write a picture of the last frame of the run in a directory, before and after; what drew it, in words."""
    command = [sys.executable, "-c", "from mpitled.results.views import main; main()", str(directory), str(path)]
    why = "PyVista found no way to draw here"
    try:
        done = subprocess.run(command, capture_output=True, timeout=_LONGEST, check=False)
        if done.returncode == 0:
            return "PyVista"
        if done.returncode == _NO_PYVISTA:
            why = _INSTALL
    except subprocess.TimeoutExpired:
        why = f"PyVista took longer than {_LONGEST} s"
    _draw(directory, path, _painter)
    return f"matplotlib ({why})"


def main() -> None:
    """In a process of its own: the picture of sys.argv[1] into sys.argv[2] by PyVista."""
    try:
        pyvista()
    except InputError:
        sys.exit(_NO_PYVISTA)
    _draw(Path(sys.argv[1]), Path(sys.argv[2]), _renderer)


def pyvista() -> Any:
    """The library. InputError if it is missing."""
    try:
        import pyvista as library
    except ImportError:
        raise InputError(_INSTALL) from None
    return library


def grid(result: store.Result, frame: int) -> Any:
    """A frame as pyvista.UnstructuredGrid: see `mpitled.interface.RunResult.to_pyvista`. InputError without PyVista."""
    library, hexahedra = pyvista(), result.hexahedra
    numbers = result.point_data("node_id")
    rest = np.setdiff1d(np.arange(len(numbers)), hexahedra)
    cells = {library.CellType.HEXAHEDRON: hexahedra, library.CellType.VERTEX: rest[:, None]}
    made = library.UnstructuredGrid({kind: nodes for kind, nodes in cells.items() if len(nodes)}, result.points)
    made.point_data["displacement"] = result.point_data("displacement", frame)
    of_frames = ((name, result.cell_data(name, frame), np.nan) for name in result.names("Cell"))
    for name, values, none in (
        *of_frames,
        ("material", result.cell_data("material"), -1),
        ("kind", result.cell_data("kind"), store.EFG_NODE),
    ):
        # Of integration points, which are the last cells, in order.
        at_rows = np.full((len(numbers), *values.shape[1:]), none, values.dtype)
        at_rows[numbers < 0] = values[len(values) - np.count_nonzero(numbers < 0) :]
        made.cell_data[name] = np.concatenate([values[: len(hexahedra)], at_rows[rest]])
    return made


def show(path: Path) -> None:
    """Open a window with the frames of the run at a path, to turn and to slide through; back when it is closed.

    InputError if there is no result, no PyVista or no screen.
    """
    with store.open_result(path) as result:
        directory = result.path.parent
    outcome = report.read(directory)
    if not _has_screen():
        raise InputError(
            f"{path}: there is no screen here to show it on (DISPLAY is not set, or nobody answers); mpitled report "
            f"{directory} --html makes a page of pictures"
        )
    plotter = pyvista().Plotter(title=f"mpitled: {outcome.title}")
    with store.open_result(directory) as result:
        solid = outcome.solid
        times, n = result.times, result.n_frames
        largest = float(_norm(solid).vmax)

        def place(value: float) -> None:
            frame = round(value)
            field, displacement = (result.at_nodes(name, frame) for name in ("displacement", "parameters"))
            moved = replace(outcome, field=field, displacement=displacement).moved
            _add(plotter, displaced(solid, moved), 1.0, largest)
            plotter.add_text(f"time {times[frame]:.4g}", name="time", font_size=10)

        place(n - 1)
        if n > 1:
            plotter.add_slider_widget(place, (0, n - 1), value=n - 1, title="frame", fmt="%.0f")
        plotter.add_scalar_bar(_SCALARS)
        plotter.add_axes()
        plotter.show()


def _has_screen() -> bool:
    """Whether a window can open: VTK ends in silence where an X server is wanted and none answers."""
    if sys.platform != "linux":
        return True
    library = ctypes.util.find_library("X11")
    if not os.environ.get("DISPLAY") or library is None:
        return False
    connect = ctypes.CDLL(library).XOpenDisplay
    connect.restype = ctypes.c_void_p
    return connect(None) is not None


_Paint = Callable[[Any, View, float], None]  # of matplotlib's axes, with a share of the displacement


def _draw(directory: Path, path: Path, painter: Callable[[Solid], _Paint]) -> None:
    """A row for each view, before and after, with what the colours mean."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    from mpitled.results.plot import name_sides

    outcome = report.read(directory)
    solid = outcome.solid
    paint, chosen = painter(solid), views(solid, outcome.centre)
    shapes = [view.high - view.low for view in chosen]
    heights = [up / right for right, up in shapes]
    figure = Figure(figsize=(13.0, 5.6 * sum(heights) + 1.2), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(chosen), 2, height_ratios=heights)
    for row, view in zip(panels, chosen, strict=True):
        for axes, (when, share) in zip(row, (("before", 0.0), ("after", 1.0)), strict=True):
            paint(axes, view, share)
            axes.set(
                title=f"{when}, {view.title}", xlabel=view.labels[0], ylabel=view.labels[1], aspect="equal",
                xlim=(view.low[0], view.high[0]), ylim=(view.low[1], view.high[1]),
            )  # fmt: skip
            if 0 in solid.sides:
                name_sides(axes, solid.sides[0])
    if parts(solid).keys() - _PLAIN:
        figure.colorbar(
            ScalarMappable(_norm(solid), MAP), ax=panels[:, 1], label="after: displacement (mm)", shrink=0.6, pad=0.02
        )
    shown = [
        Patch(facecolor=COLOURS[name], label=name if name in _PLAIN else f"before: {name}") for name in parts(solid)
    ]
    if "body" not in parts(solid):
        shown.append(
            Patch(facecolor=COLOURS["body"], alpha=_THIN, label="before and after: surface of the body behind them")
        )
    figure.legend(handles=shown, loc="outside lower center", ncols=len(shown), frameon=False)
    figure.savefig(path, dpi=110)


def _norm(solid: Solid) -> Any:
    """Of the displacements (mm) of what is coloured by them."""
    from matplotlib.colors import Normalize

    coloured = [triangles.ravel() for name, triangles in parts(solid).items() if name not in _PLAIN]
    shown = np.concatenate(coloured) if coloured else slice(None)
    return Normalize(0.0, float(np.linalg.norm(solid.displacement[shown], axis=1).max()) or 1.0)


def _renderer(solid: Solid) -> _Paint:
    """PyVista's way."""
    library = pyvista()
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # of screens that are not there

    def paint(axes: Any, view: View, share: float) -> None:
        width, height = view.high - view.low
        plotter = library.Plotter(off_screen=True, window_size=(_PIXELS, round(_PIXELS * height / width)))
        plotter.enable_anti_aliasing("ssaa")
        _add(plotter, solid, share, float(_norm(solid).vmax))
        middle = view.low + (view.high - view.low) / 2
        at, far = view.right * middle[0] + view.up * middle[1], 4 * max(width, height)
        depth = float((solid.points @ view.towards).mean())
        plotter.camera.parallel_projection = True
        plotter.camera_position = [at + (depth + far) * view.towards, at + depth * view.towards, view.up]
        plotter.camera.parallel_scale = height / 2
        plotter.camera.clipping_range = (0.1 * far, 4 * far)
        image = plotter.screenshot(return_img=True)
        plotter.close()
        axes.imshow(image, extent=(view.low[0], view.high[0], view.low[1], view.high[1]))

    return paint


def _add(plotter: Any, solid: Solid, share: float, largest: float) -> None:
    """Put the parts with a share of the displacement into a plotter, and the body around them; largest is in mm."""
    shown = parts(solid)
    light = {"ambient": 0.4, "diffuse": 0.6, "show_scalar_bar": False}
    if "body" not in shown:
        # Its far side alone, which does not lie before the parts and change their colours.
        body = _surface(solid, solid.surface, share)
        plotter.add_mesh(body, color=COLOURS["body"], opacity=_THIN, culling="front", name="around", **light)
    for name, triangles in shown.items():
        moved = share and name not in _PLAIN
        paint = {"scalars": _SCALARS, "cmap": MAP, "clim": (0, largest)} if moved else {"color": COLOURS[name]}
        plotter.add_mesh(_surface(solid, triangles, share), name=name, **paint, **light)


def _surface(solid: Solid, triangles: NDArray[np.int64], share: float) -> Any:
    """pyvista.PolyData of triangles with a share of the displacement, mm."""
    nodes, corners = np.unique(triangles, return_inverse=True)
    mesh = pyvista().PolyData.from_regular_faces(
        (solid.points + share * solid.displacement)[nodes], corners.reshape(-1, 3)
    )
    mesh.point_data[_SCALARS] = np.linalg.norm(solid.displacement[nodes], axis=1)
    return mesh


def _painter(solid: Solid) -> _Paint:
    """Matplotlib's way: triangles from the farthest to the nearest, shaded by where they face."""
    from matplotlib import colormaps
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgb

    shown, norm = parts(solid), _norm(solid)
    triangles = np.concatenate(list(shown.values()))
    plain = np.repeat([to_rgb(COLOURS[name]) for name in shown], [len(of) for of in shown.values()], axis=0)
    size = np.linalg.norm(solid.displacement, axis=1)[triangles].mean(axis=1)
    moved = colormaps[MAP](norm(size))[:, :3]
    alike = np.repeat([name in _PLAIN for name in shown], [len(of) for of in shown.values()])
    moved[alike] = plain[alike]

    def paint(axes: Any, view: View, share: float) -> None:
        places = solid.points + share * solid.displacement
        if "body" not in shown:
            body = view.flat(places[solid.surface])
            axes.add_collection(PolyCollection(list(body), facecolors="#ece9e4", edgecolors="#ece9e4"))
        corners = places[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = np.abs(normals @ view.towards) / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
        fill = (moved if share else plain) * (0.55 + 0.45 * facing[:, None])
        order = np.argsort(corners.mean(axis=1) @ view.towards)
        axes.add_collection(
            PolyCollection(
                list(view.flat(corners)[order]), facecolors=fill[order], edgecolors=fill[order], linewidths=0.3
            )
        )

    return paint
