"""Pictures of a run in three planes through the tumour: cuts, undeformed and deformed, and the mesh. All in mm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpitled.meshing.faces import FACES
from mpitled.model import Model
from mpitled.results.solid import Solid, cut_tetrahedra, cut_triangles, triangles_of

#: Perceptually uniform and legible to the colour-blind (Nunez et al. 2018; van der Walt and Smith 2015).
COLOURS = "magma_r"
#: Cosine of the angle between the normals of a face and of the plane up to which the face's line is drawn.
_STEEP = 0.8
_INK = "#222222"
_WALL: dict[str, Any] = {"color": "#0072b2", "linewidth": 1.6}
_TUMOUR: dict[str, Any] = {"color": "#222222", "linewidth": 1.8}
_INSIDE = "0.82"  # of the tumour
_INTERFACE: dict[str, Any] = {"color": "#009e73", "linewidth": 1.2}
#: Fills of materials in turn, of different lightness too, and the cloud's nodes.
_MATERIALS = ("#f5e6d3", "#9ecae1", "#d9a6c4", "#7fa36b", "#8c8c8c")
_NODES: dict[str, Any] = {"color": "#8a3800", "marker": "o", "markersize": 1.6, "linestyle": "none"}
#: Axis that each plane is normal to, and the axes that run right and up in its picture.
_PLANES = {"sagittal": (0, 1, 2), "coronal": (1, 0, 2), "axial": (2, 0, 1)}
_Plane = tuple[int, int, int]


def draw(directory: Path, solid: Solid, centre: NDArray[np.float64] | None, title: str) -> list[str]:
    """Write undeformed.png and deformed.png; their names.

    The tumour's centre (3,) is in m; without a tumour the cuts go through the middle.
    """
    names = []
    for name, figure in cuts(solid, centre, title):
        figure.savefig(directory / f"{name}.png", dpi=160)
        names.append(f"{name}.png")
    return names


def cuts(solid: Solid, centre: NDArray[np.float64] | None, title: str) -> Iterator[tuple[str, Figure]]:
    """The pictures of `draw`, by name."""
    largest = float(np.linalg.norm(solid.displacement, axis=1).max()) or 1.0
    norm, levels = Normalize(0.0, largest), _levels(largest)
    for name, share in (("undeformed", 0.0), ("deformed", 1.0)):

        def paint(axes: Axes, plane: _Plane, place: float, share: float = share) -> None:
            _panel(axes, solid, share, plane, place, norm, levels)

        both = np.concatenate([solid.points, solid.points + solid.displacement])
        figure = _in_three_planes(solid, both, centre, paint)
        bar = figure.colorbar(
            ScalarMappable(norm, COLOURS), ax=figure.axes, label="displacement (mm)", shrink=0.85, pad=0.01
        )
        for level in levels:
            bar.ax.axhline(level, color=_ink_on(norm(level)), linewidth=0.8)
        moved = f"{', '.join(f'{level:g}' for level in levels)} mm moved"
        _legend(figure, solid, [Line2D([], [], color=_INK, linewidth=0.8, label=moved)])
        # The same colours in both: where the tissue that moves so far was, and where it is then.
        figure.suptitle(f"{title}: {name}, coloured by how far tissue {'moves' if share else 'will move'}")
        yield name, figure


def mesh(model: Model, solid: Solid, centre: NDArray[np.float64] | None) -> Figure:
    """The undeformed mesh: hexahedra and cloud by their material, and the cloud's nodes near the planes."""
    of_hexahedra, of_domains = np.split(model.material, [len(model.hexahedra)])
    of_cloud, near = np.empty(0, np.int16), 0.0
    efg = np.arange(model.n_fe_nodes, model.n_nodes)
    if len(solid.cloud):
        middles = solid.points[solid.cloud].mean(axis=1)
        of_cloud = of_domains[cKDTree(1e3 * model.domain_points).query(middles)[1]]
        near = 0.5e3 * float(np.cbrt(model.domain_volumes.mean()))

    def paint(axes: Axes, plane: _Plane, place: float) -> None:
        normal, right, up = plane
        height = solid.points[:, normal] - place
        flat = solid.points[:, [right, up]]
        triangles, centres, of_cell = _around_centres(solid, height)
        for order, tetrahedra, material in (
            (1, solid.cloud, of_cloud),
            (3, np.column_stack([triangles, centres]), of_hexahedra[of_cell]),
        ):
            for i in np.unique(material):
                cut = cut_tetrahedra(flat, height, tetrahedra[material == i])
                fill = _MATERIALS[i % len(_MATERIALS)]
                # Edges of the same colour close the seams between pieces.
                axes.add_collection(
                    PolyCollection(list(cut), facecolors=fill, edgecolors=fill, linewidths=0.3, zorder=order)
                )
        _outlines(axes, solid, solid.points, height, plane, triangles, {"linewidths": 0.5, "alpha": 0.7})
        here = efg[np.abs(height[efg]) < near]
        axes.plot(*flat[here].T, **_NODES, zorder=8)

    figure = _in_three_planes(solid, solid.points, centre, paint)
    used = np.unique(model.material)
    shown: list[Any] = [
        Patch(facecolor=_MATERIALS[i % len(_MATERIALS)], edgecolor=_INK, label=model.materials[i].name) for i in used
    ]
    if len(efg):
        shown.append(Line2D([], [], **_NODES, label=f"EFG node within {near:.1f} mm of the plane"))
    _legend(figure, solid, shown)
    return figure


# --- what the pictures share ----------------------------------------------------------------------------------------


def _in_three_planes(
    solid: Solid,
    shown: NDArray[np.float64],
    centre: NDArray[np.float64] | None,
    paint: Callable[[Axes, _Plane, float], None],
) -> Figure:
    """A panel for each plane through the tumour's centre (3,), m, or the middle, framed around `shown` (n, 3), mm."""
    nodes = solid.points[: len(solid.points) - len(solid.centres)]
    at = (nodes.min(axis=0) + nodes.max(axis=0)) / 2 if centre is None else 1e3 * centre
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.05 * (high - low).max()
    low, high = low - margin, high + margin
    extent = high - low
    widths = [extent[right] for _, right, _ in _PLANES.values()]
    inches = 11.5 / sum(widths)  # a millimetre's
    figure = Figure(figsize=(15.0, max(inches * max(extent[1], extent[2]) + 1.5, 4.0)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 3, width_ratios=widths)
    for axes, (name, plane) in zip(panels, _PLANES.items(), strict=True):
        normal, right, up = plane
        paint(axes, plane, float(at[normal]))
        axes.set(
            aspect="equal",
            xlim=(low[right], high[right]),
            ylim=(low[up], high[up]),
            xlabel=f"{'xyz'[right]} (mm)",
            ylabel=f"{'xyz'[up]} (mm)",
            title=f"{name + ', ' if solid.sides else ''}{'xyz'[normal]} = {at[normal]:g} mm",
        )
        if right in solid.sides:
            name_sides(axes, solid.sides[right])
    return figure


def _legend(figure: Figure, solid: Solid, shown: list[Any]) -> None:
    """What is shown, and below it the lines that are there."""
    if len(solid.tumour):
        shown.append(Patch(facecolor=_INSIDE, edgecolor=_TUMOUR["color"], linewidth=1.2, label="tumour"))
    for lines, style, label in (
        (solid.walls, _WALL, "ventricle"),
        (solid.interface, _INTERFACE, "end of the support domains"),
    ):
        if len(lines):
            shown.append(Line2D([], [], **style, label=label))
    figure.legend(handles=shown, loc="outside lower center", ncols=len(shown), frameon=False)


def _ink_on(share: float) -> str:
    """What is seen on the colour of that share of the largest displacement."""
    return _INK if share < 0.5 else "white"


def _levels(largest: float) -> list[float]:
    """The four largest of ..., 0.5, 1, 2, 5, 10, ... below `largest`."""
    decade = int(np.floor(np.log10(largest)))
    steps = [step * 10.0**k for k in (decade - 2, decade - 1, decade) for step in (1, 2, 5)]
    return [level for level in steps if level < largest][-4:]


def _panel(
    axes: Axes, solid: Solid, share: float, plane: _Plane, place: float, norm: Normalize, levels: list[float]
) -> None:
    """Draw one cut with `share` of the displacement."""
    normal, right, up = plane
    places = solid.points + share * solid.displacement
    height = places[:, normal] - place
    vertices = np.column_stack([places[:, right], places[:, up], np.linalg.norm(solid.displacement, axis=1)])
    triangles, centres, _ = _around_centres(solid, height)
    # The cloud below: its tetrahedra reach a little into hollows of the interface, where hexahedra are.
    for order, tetrahedra in ((1, solid.cloud), (3, np.column_stack([triangles, centres]))):
        cut = cut_tetrahedra(vertices, height, tetrahedra).reshape(-1, 3)
        if len(cut) == 0:
            continue
        pieces = np.arange(len(cut)).reshape(-1, 3)
        axes.tripcolor(*cut.T, triangles=pieces, shading="gouraud", cmap=COLOURS, norm=norm, zorder=order)
        for level in levels:
            isoline = cut_triangles(cut, cut[:, 2] - level, pieces)[:, :, :2]
            ink = _ink_on(norm(level))
            axes.add_collection(LineCollection(list(isoline), colors=ink, linewidths=0.8, zorder=order + 1))
    _outlines(axes, solid, places, height, plane, triangles, {"linewidths": 0.3, "alpha": 0.25})


def _around_centres(
    solid: Solid, height: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Of hexahedra that the plane height = 0 meets: triangles (n, 3) of their faces, their centres, their numbers."""
    corners = height[solid.hexahedra]
    crossed = np.flatnonzero((corners.min(axis=1) < 0) & (corners.max(axis=1) >= 0))
    triangles = triangles_of(solid.hexahedra[crossed][:, FACES].reshape(-1, 4))
    cells = np.tile(np.repeat(crossed, len(FACES)), 2)
    return triangles, solid.centres[cells], cells


def _outlines(
    axes: Axes,
    solid: Solid,
    places: NDArray[np.float64],
    height: NDArray[np.float64],
    plane: _Plane,
    triangles: NDArray[np.int64],
    edges: dict[str, Any],
) -> None:
    """Where the plane meets the faces of hexahedra (their style is `edges`), interface, ventricles and tumour."""
    normal, right, up = plane
    vertices = places[:, [right, up]]

    def lines(of: NDArray[np.int64], **style: Any) -> None:
        axes.add_collection(LineCollection(list(cut_triangles(vertices, height, of)), **style))

    # Where a face that lies nearly in the plane crosses it is chance: no line of the mesh.
    sides = places[triangles[:, 1:]] - places[triangles[:, :1]]
    normals = np.cross(sides[:, 0], sides[:, 1])
    steep = triangles[np.abs(normals[:, normal]) < _STEEP * np.linalg.norm(normals, axis=1)]
    lines(np.unique(np.sort(steep, axis=1), axis=0), colors=_INK, **edges, zorder=4)
    lines(solid.interface, **_INTERFACE, zorder=5)
    for wall in solid.walls.values():
        lines(wall, **_WALL, zorder=6)
    lines(solid.tumour, **_TUMOUR, zorder=7)
    inside = cut_triangles(vertices, height, solid.tumour)[:, 0]
    if len(inside):
        around = inside - inside.mean(axis=0)
        outline = inside[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]
        axes.fill(*outline.T, color=_INSIDE, zorder=2)


def name_sides(axes: Any, letters: tuple[str, str]) -> None:
    """Letters of the body's sides at the left and the right of a picture."""
    for x, letter in zip((0.04, 0.96), letters, strict=True):
        axes.text(x, 0.97, letter, transform=axes.transAxes, ha="center", va="top", fontsize=14, fontweight="bold")
