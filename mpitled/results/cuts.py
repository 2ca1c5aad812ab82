"""Cross-sections of a body in three planes through the tumour: PyVista cuts the meshes, matplotlib draws. All in mm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyvista
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from mpitled.results.final_state import FinalState
from mpitled.results.solid import SIZE, Solid, deformed, solid_of

#: Perceptually uniform and legible to the colour-blind (Nunez et al. 2018; van der Walt and Smith 2015).
MAP = "magma_r"
#: A face's line is drawn if the cosine of the angle between the normals of face and plane is below this value. The line
#: of a face that is nearly parallel to the plane would be arbitrary.
_MAX_COSINE = 0.8
_INK = "#222222"
_WALL: dict[str, Any] = {"color": "#0072b2", "linewidth": 1.6}
_TUMOUR: dict[str, Any] = {"color": _INK, "linewidth": 1.8}
_INSIDE = "0.82"  # fill of the tumour
_INTERFACE: dict[str, Any] = {"color": "#009e73", "linewidth": 1.2}
#: Fill colours of the materials, which also differ in lightness, and the style of the cloud's nodes.
_MATERIALS = ("#f5e6d3", "#9ecae1", "#d9a6c4", "#7fa36b", "#8c8c8c")
_NODES: dict[str, Any] = {"color": "#8a3800", "marker": "o", "markersize": 1.6, "linestyle": "none"}
#: Axis normal to each plane, and the axes that point right and up in its picture.
_PLANES = {"sagittal": (0, 1, 2), "coronal": (1, 0, 2), "axial": (2, 0, 1)}
_Plane = tuple[int, int, int]
#: Draws the plane at a position (mm) along its normal.
_Painter = Callable[[Axes, _Plane, float], None]


def draw(directory: Path, state: FinalState) -> list[str]:
    """Write undeformed.png and deformed.png into a directory; return the names. OSError if a file cannot be written."""
    names = []
    for name, figure in displacement_cuts(state, solid_of(state)):
        figure.savefig(directory / f"{name}.png", dpi=160)
        names.append(f"{name}.png")
    return names


def displacement_cuts(state: FinalState, solid: Solid) -> Iterator[tuple[str, Figure]]:
    """Yield name and picture of the undeformed and the deformed body, with one colour scale for displacements."""
    largest = float(solid.hexahedra.point_data[SIZE].max()) or 1.0
    norm, levels = Normalize(0.0, largest), _levels(largest)
    for name, share in (("undeformed", 0.0), ("deformed", 1.0)):

        def paint(axes: Axes, plane: _Plane, position: float, share: float = share) -> None:
            # The cloud is drawn first, because its tetrahedra may extend into hexahedra.
            for order, mesh in ((1, solid.cloud), (3, solid.hexahedra)):
                cut = _cut(deformed(mesh, share), plane, position, triangles=True)
                if cut.n_cells == 0:
                    continue
                x, y = _flat(cut.points, plane).T
                axes.tripcolor(
                    x, y, np.asarray(cut.point_data[SIZE]), triangles=cut.regular_faces,
                    shading="gouraud", cmap=MAP, norm=norm, zorder=order,
                )  # fmt: skip
                for level in levels:
                    lines = cut.contour([level], scalars=SIZE)
                    _draw_lines(axes, lines, plane, color=_ink_on(norm(level)), linewidth=0.8, zorder=order + 1)
            _draw_outlines(axes, solid, share, plane, position, {"linewidth": 0.3, "alpha": 0.25})

        both = np.concatenate([solid.points, solid.points + solid.displacement])
        figure = _in_three_planes(state, solid, both, paint)
        mappable = ScalarMappable(norm, MAP)
        bar = figure.colorbar(mappable, ax=figure.axes, label=SIZE, shrink=0.85, pad=0.01)
        for level in levels:
            bar.ax.axhline(level, color=_ink_on(norm(level)), linewidth=0.8)
        isolines = f"displacement of {', '.join(f'{level:g}' for level in levels)} mm"
        _legend(figure, solid, [Line2D([], [], color=_INK, linewidth=0.8, label=isolines)])
        when = "" if share else "later "
        figure.suptitle(f"{state.title}: {name}, coloured by the {when}displacement of the tissue")
        yield name, figure


def mesh(state: FinalState, solid: Solid) -> Figure:
    """Draw the undeformed mesh: hexahedra and cloud, coloured by material, and the cloud's nodes near the planes."""
    model = state.model
    efg = np.arange(model.n_fe_nodes, model.n_nodes)
    near = 0.5e3 * float(np.cbrt(model.domain_volumes.mean())) if len(efg) else 0.0

    def paint(axes: Axes, plane: _Plane, position: float) -> None:
        for order, mesh in ((1, solid.cloud), (3, solid.hexahedra)):
            cut = _cut(mesh, plane, position, triangles=True)
            if cut.n_cells == 0:
                continue
            fill = [_MATERIALS[i % len(_MATERIALS)] for i in cut.cell_data["material"]]
            triangles = list(_flat(cut.points, plane)[cut.regular_faces])
            # Edges of the same colour close the gaps between triangles.
            style: dict[str, Any] = {"facecolors": fill, "edgecolors": fill, "linewidths": 0.3}
            axes.add_collection(PolyCollection(triangles, **style, zorder=order))
        _draw_outlines(axes, solid, 0.0, plane, position, {"linewidth": 0.5, "alpha": 0.7})
        nodes = solid.points[efg]
        axes.plot(*_flat(nodes[np.abs(nodes[:, plane[0]] - position) < near], plane).T, **_NODES, zorder=8)

    figure = _in_three_planes(state, solid, solid.points, paint)
    handles: list[Any] = [
        Patch(facecolor=_MATERIALS[i % len(_MATERIALS)], edgecolor=_INK, label=model.materials[i].name)
        for i in np.unique(model.material)
    ]
    if len(efg):
        handles.append(Line2D([], [], **_NODES, label=f"EFG node within {near:.1f} mm of the plane"))
    _legend(figure, solid, handles)
    return figure


def name_sides(axes: Any, letters: tuple[str, str]) -> None:
    """Write the letters of the body's sides (such as L and R) at the left and the right of a picture."""
    for x, letter in zip((0.04, 0.96), letters, strict=True):
        axes.text(x, 0.97, letter, transform=axes.transAxes, ha="center", va="top", fontsize=14, fontweight="bold")


# --- common parts --------------------------------------------------------------------------------------------------


def _in_three_planes(state: FinalState, solid: Solid, points: NDArray[np.float64], paint: _Painter) -> Figure:
    """A panel for each plane through the tumour's centre, or the body's; the frame contains `points` (n, 3), mm."""
    nodes = solid.points
    centre = (nodes.min(axis=0) + nodes.max(axis=0)) / 2 if state.centre is None else 1e3 * state.centre
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.05 * (high - low).max()
    low, high = low - margin, high + margin
    extent = high - low
    widths = [extent[right] for _, right, _ in _PLANES.values()]
    inches_per_mm = 11.5 / sum(widths)
    height = max(inches_per_mm * max(extent[1], extent[2]) + 1.5, 4.0)
    figure = Figure(figsize=(15.0, height), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, plane) in zip(figure.subplots(1, 3, width_ratios=widths), _PLANES.items(), strict=True):
        normal, right, up = plane
        paint(axes, plane, float(centre[normal]))
        axes.set(
            aspect="equal", xlim=(low[right], high[right]), ylim=(low[up], high[up]),
            xlabel=f"{'xyz'[right]} (mm)", ylabel=f"{'xyz'[up]} (mm)",
            title=f"{name + ', ' if solid.sides else ''}{'xyz'[normal]} = {centre[normal]:g} mm",
        )  # fmt: skip
        if right in solid.sides:
            name_sides(axes, solid.sides[right])
    return figure


def _legend(figure: Figure, solid: Solid, handles: list[Any]) -> None:
    """Add a legend of the handles, and of the tumour, the ventricles and the interface if they exist."""
    if solid.tumour.n_cells:
        handles.append(Patch(facecolor=_INSIDE, edgecolor=_TUMOUR["color"], linewidth=1.2, label="tumour"))
    if solid.walls:
        handles.append(Line2D([], [], **_WALL, label="ventricle"))
    if solid.interface.n_cells:
        handles.append(Line2D([], [], **_INTERFACE, label="end of the support domains"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)


def _ink_on(share: float) -> str:
    """A colour that contrasts with the colour of a share of the largest displacement."""
    return _INK if share < 0.5 else "white"


def _levels(largest: float) -> list[float]:
    """The four largest values of the series ..., 0.5, 1, 2, 5, 10, ... below `largest`."""
    decade = int(np.floor(np.log10(largest)))
    steps = [step * 10.0**k for k in (decade - 2, decade - 1, decade) for step in (1, 2, 5)]
    return [level for level in steps if level < largest][-4:]


def _cut(mesh: Any, plane: _Plane, position: float, *, triangles: bool = False) -> pyvista.PolyData:
    """The section of a mesh with the plane at a position (mm) along its normal."""
    return mesh.slice(np.eye(3)[plane[0]], origin=position * np.eye(3)[plane[0]], generate_triangles=triangles)


def _flat(points: Any, plane: _Plane) -> NDArray[np.float64]:
    """The coordinates (n, 2) of points (n, 3) in the picture of a plane."""
    return np.asarray(points)[:, plane[1:]]


def _draw_lines(axes: Axes, lines: pyvista.PolyData, plane: _Plane, **style: Any) -> None:
    """Draw the line segments of a mesh."""
    if lines.n_lines:
        segments = lines.lines.reshape(-1, 3)[:, 1:]
        axes.add_collection(LineCollection(list(_flat(lines.points, plane)[segments]), **style))


def _draw_outlines(
    axes: Axes, solid: Solid, share: float, plane: _Plane, position: float, edges: dict[str, Any]
) -> None:
    """Draw the sections of hexahedron faces (in the style `edges`), interface, ventricles and tumour with a plane."""
    faces = deformed(solid.faces, share)
    points, nodes = np.asarray(faces.points), faces.regular_faces.reshape(-1, 4)
    height = points[nodes, plane[0]]
    nodes = nodes[(height.min(axis=1) < position) & (height.max(axis=1) >= position)]
    corners = points[nodes]
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    steep = np.abs(normals[:, plane[0]]) < _MAX_COSINE * np.linalg.norm(normals, axis=1)
    grid = pyvista.PolyData.from_regular_faces(points, nodes[steep])
    _draw_lines(axes, _cut(grid, plane, position), plane, color=_INK, **edges, zorder=4)
    lines = [(solid.interface, _INTERFACE, 5), *((wall, _WALL, 6) for wall in solid.walls.values())]
    for surface, style, order in (*lines, (solid.tumour, _TUMOUR, 7)):
        cut = _cut(deformed(surface, share), plane, position)
        _draw_lines(axes, cut, plane, **style, zorder=order)
    if cut.n_lines:  # of the tumour, which remains convex
        outline = _flat(cut.points, plane)
        axes.fill(*outline[ConvexHull(outline).vertices].T, color=_INSIDE, zorder=2)
