"""Views of a body in three dimensions by PyVista, before and after the deformation, and a window to rotate the body.

VTK may end the whole process if it cannot render. The pictures are therefore drawn in a child process.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import store
from mpitled.errors import InputError
from mpitled.results import final_state
from mpitled.results.final_state import FinalState

#: Colours of parts, distinct to the colour-blind (Okabe and Ito 2008).
COLOURS = {"tumour": "#d55e00", "left ventricle": "#0072b2", "right ventricle": "#56b4e9", "body": "#d9d4cc"}
#: Parts that are not coloured by displacement. The tumour's surface has one, large displacement: it would be black.
_UNIFORM = {"tumour"}
_OPACITY = 0.4  # of the body around the parts
_TIMEOUT = 120  # s, for the pictures
_PIXELS = 900  # width of a panel
_LIGHT = {"ambient": 0.4, "diffuse": 0.6, "show_scalar_bar": False}
_INSTALL = "PyVista is missing; install it: pip install 'mpitled[pictures]'"


def draw(directory: Path, path: Path) -> str:
    """Write a picture of the run in a directory, undeformed and at the last frame. Returns "" or the problem."""
    command = [sys.executable, "-c", "from mpitled.results.views import main; main()", str(directory), str(path)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return f"PyVista took longer than {_TIMEOUT} s"
    return "" if done.returncode == 0 else "PyVista cannot render on this machine"


def main() -> None:
    """Draw the run in the folder sys.argv[1] into the picture sys.argv[2]; the main function of the child process."""
    import pyvista

    pyvista.vtk_verbosity("off")  # VTK reports a missing screen, and then renders without one
    figure(final_state.read(Path(sys.argv[1]))).savefig(sys.argv[2], dpi=110)


def show(path: Path) -> None:
    """Open a window that shows the frames of the run at a path, and return when the window is closed.

    InputError if there is no result, no PyVista or no screen.
    """
    with store.open_result(path) as result:
        directory = result.path.parent
    state = final_state.read(directory)
    if not _has_screen():
        raise InputError(
            f"{path}: a window needs a screen (DISPLAY is not set, or no X server answers); mpitled report "
            f"{directory} --html writes a page with pictures"
        )
    try:
        import pyvista
    except ImportError:
        raise InputError(_INSTALL) from None
    from mpitled.results import solid as meshes

    solid = meshes.solid_of(state)
    largest = _largest(solid)
    plotter: Any = pyvista.Plotter(title=f"mpitled: {state.title}")
    with store.open_result(directory) as result:
        times, n = result.times, result.n_frames

        def show_frame(value: float) -> None:
            frame = round(value)
            field, parameters = (result.at_nodes(name, frame) for name in ("displacement", "parameters"))
            displacement = 1e3 * replace(state, field=field, displacement=parameters).shown_displacement
            for mesh in (solid.surface, *_parts(solid).values()):
                meshes.with_displacement(mesh, displacement)
            _add_meshes(plotter, solid, 1.0, largest)
            plotter.add_text(f"time {times[frame]:.4g}", name="time", font_size=10)

        show_frame(n - 1)
        if n > 1:
            plotter.add_slider_widget(show_frame, (0, n - 1), value=n - 1, title="frame", fmt="%.0f")
        plotter.add_scalar_bar(meshes.SIZE)
        plotter.add_axes()
        plotter.show()


def _has_screen() -> bool:
    """Whether a window can open. VTK ends the process silently if no X server answers."""
    if sys.platform != "linux":
        return True
    library = ctypes.util.find_library("X11")
    if not os.environ.get("DISPLAY") or library is None:
        return False
    connect = ctypes.CDLL(library).XOpenDisplay
    connect.restype = ctypes.c_void_p
    return connect(None) is not None


# --- pictures ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _View:
    """A direction of view in parallel projection, and the limits of the picture in mm."""

    title: str
    labels: tuple[str, str]  # of the axes that point right and up
    axes: NDArray[np.float64]  # (2, 3), unit vectors to the right and up
    low: NDArray[np.float64]  # (2,)
    high: NDArray[np.float64]  # (2,)


def _views(state: FinalState, solid: Any) -> list[_View]:
    """The views at an angle, from the side of the tumour, and from above."""
    points = np.concatenate([solid.points, solid.points + solid.displacement])
    side = -1.0 if state.centre is not None and 1e3 * state.centre[0] < solid.points[:, 0].mean() else 1.0
    right = np.array([1.0, 0.8 * side, 0.0]) / np.hypot(1.0, 0.8)
    back = np.cross([0.0, 0.0, 1.0], right)  # horizontal, away from the viewer
    up = np.cos(0.35) * np.array([0.0, 0.0, 1.0]) + np.sin(0.35) * back
    views = []
    for title, labels, axes in (
        ("at an angle", ("across (mm)", "up (mm)"), np.stack([right, up])),
        ("from above", ("x (mm)", "y (mm)"), np.eye(3)[:2]),
    ):
        projected = points @ axes.T
        margin = 0.05 * np.ptp(projected, axis=0).max()
        views.append(_View(title, labels, axes, projected.min(axis=0) - margin, projected.max(axis=0) + margin))
    return views


def part_names(state: FinalState) -> list[str]:
    """Names of the parts in the pictures: ventricles and tumour, or the body if there is neither."""
    tumour = ["tumour"] if len(state.seed) else []
    return [*(f"{side} ventricle" for side in state.ventricles), *tumour] or ["body"]


def _parts(solid: Any) -> dict[str, Any]:
    """The meshes of the parts in the pictures, by name."""
    walls = {f"{side} ventricle": wall for side, wall in solid.walls.items()}
    return walls | ({"tumour": solid.tumour} if solid.tumour.n_cells else {}) or {"body": solid.surface}


def _largest(solid: Any) -> float:
    """Largest displacement (mm) of the parts that are coloured by it."""
    from mpitled.results.solid import SIZE

    coloured = [mesh for name, mesh in _parts(solid).items() if name not in _UNIFORM]
    nodes = [mesh.point_data[SIZE][mesh.regular_faces.ravel()].max() for mesh in coloured]
    return float(max(nodes, default=0.0)) or 1.0


def figure(state: FinalState) -> Any:
    """A matplotlib Figure with a row for each view, a column before and one after the deformation, and a legend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    from mpitled.results.cuts import MAP, name_sides
    from mpitled.results.solid import SIZE, solid_of

    solid = solid_of(state)
    views, names, largest = _views(state, solid), part_names(state), _largest(solid)
    heights = [up / right for right, up in (view.high - view.low for view in views)]
    drawing = Figure(figsize=(13.0, 5.6 * sum(heights) + 1.2), layout="constrained")
    FigureCanvasAgg(drawing)
    panels = drawing.subplots(len(views), 2, height_ratios=heights)
    for row, view in zip(panels, views, strict=True):
        for axes, (when, share) in zip(row, (("before", 0.0), ("after", 1.0)), strict=True):
            extent = (view.low[0], view.high[0], view.low[1], view.high[1])
            axes.imshow(_render(solid, view, share, largest), extent=extent)
            axes.set(title=f"{when}, {view.title}", xlabel=view.labels[0], ylabel=view.labels[1])
            if 0 in solid.sides:
                name_sides(axes, solid.sides[0])
    if set(names) - _UNIFORM:
        mappable = ScalarMappable(Normalize(0.0, largest), MAP)
        drawing.colorbar(mappable, ax=panels[:, 1], label=f"after: {SIZE}", shrink=0.6, pad=0.02)
    legend = [Patch(facecolor=COLOURS[name], label=name if name in _UNIFORM else f"before: {name}") for name in names]
    if "body" not in names:
        label = "before and after: far side of the surface of the body"
        legend.append(Patch(facecolor=COLOURS["body"], alpha=_OPACITY, label=label))
    drawing.legend(handles=legend, loc="outside lower center", ncols=len(legend), frameon=False)
    return drawing


def _render(solid: Any, view: _View, share: float, largest: float) -> NDArray[np.uint8]:
    """A picture (height, width, 3) of the body with a share of the displacements; `largest` (mm) ends the colours."""
    import pyvista

    width, height = view.high - view.low
    plotter = pyvista.Plotter(off_screen=True, window_size=[_PIXELS, round(_PIXELS * height / width)])
    plotter.enable_anti_aliasing("ssaa")
    _add_meshes(plotter, solid, share, largest)
    to_viewer = np.cross(*view.axes)
    depth, distance = float((solid.points @ to_viewer).mean()), 4 * max(width, height)
    focus = (view.low + view.high) / 2 @ view.axes + depth * to_viewer
    plotter.camera.parallel_projection = True
    plotter.camera_position = [focus + distance * to_viewer, focus, view.axes[1]]
    plotter.camera.parallel_scale = height / 2
    plotter.camera.clipping_range = (0.1 * distance, 4 * distance)
    image = plotter.screenshot(return_img=True)
    plotter.close()
    return np.asarray(image)


def _add_meshes(plotter: Any, solid: Any, share: float, largest: float) -> None:
    """Add the parts, with a share of the displacements, to a plotter, and the body around the parts."""
    from mpitled.results.cuts import MAP
    from mpitled.results.solid import SIZE, deformed

    parts = _parts(solid)
    if "body" not in parts:
        # Only the far side of the body, because the near side would change the colours of the parts.
        body = deformed(solid.surface, share)
        plotter.add_mesh(body, color=COLOURS["body"], opacity=_OPACITY, culling="front", name="around", **_LIGHT)
    coloured = {"scalars": SIZE, "cmap": MAP, "clim": (0, largest)}
    for name, mesh in parts.items():
        style = coloured if share and name not in _UNIFORM else {"color": COLOURS[name]}
        plotter.add_mesh(deformed(mesh, share), name=name, **style, **_LIGHT)
