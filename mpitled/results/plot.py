"""Pictures of a run: cuts through the tumour in three planes, undeformed and deformed, coloured by displacement.

The cuts are exact for the piecewise linear solid that is drawn: each hexahedron as twelve tetrahedra around its centre,
whose faces neighbours share, and the cloud as the Delaunay tetrahedra of its nodes (its support domains overlap and
have no shape of their own). All in mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, cKDTree

from mpitled.meshing.cloud import FACES, boundary_faces, interface_faces
from mpitled.model import Model

#: Perceptually uniform and legible to the colour-blind (Nunez et al. 2018; van der Walt and Smith 2015).
COLOURS = "magma_r"
#: A place of the cloud has an integration point this near, in cube roots of that point's volume; a hollow has none.
_REACH = 1.5
#: Cosine of the angle between the normals of a face and of the plane up to which the face's line is drawn.
_STEEP = 0.8
_INK = "#222222"
_WALL: dict[str, Any] = {"color": "#0072b2", "linewidth": 1.6}
_TUMOUR: dict[str, Any] = {"color": "#222222", "linewidth": 1.8}
_INTERFACE: dict[str, Any] = {"color": "#009e73", "linewidth": 1.2}
#: Axis that each plane is normal to, and the axes that run right and up in its picture.
_PLANES = {"sagittal": (0, 1, 2), "coronal": (1, 0, 2), "axial": (2, 0, 1)}


@dataclass(frozen=True, slots=True)
class Solid:
    """What is cut, with the displacement of each vertex."""

    points: NDArray[np.float64]  # (n, 3), mm, undeformed: nodes, then the hexahedra's centres
    displacement: NDArray[np.float64]  # (n, 3), mm
    hexahedra: NDArray[np.int64]  # (m, 8)
    centres: NDArray[np.int64]  # (m,), vertex in the middle of each hexahedron
    cloud: NDArray[np.int64]  # (k, 4), tetrahedra
    interface: NDArray[np.int64]  # (k, 3), triangles between hexahedra and cloud
    walls: dict[str, NDArray[np.int64]]  # ventricle -> triangles (k, 3) around it
    tumour: NDArray[np.int64]  # (k, 3), triangles around it


def draw(
    directory: Path,
    model: Model,
    displacement: NDArray[np.float64],
    centre: NDArray[np.float64] | None,
    title: str,
) -> list[str]:
    """Write undeformed.png and deformed.png; their names.

    displacement (n_nodes, 3) and the tumour's centre (3,) are in m; without a tumour the cuts go through the middle.
    """
    solid = _solid(model, 1e3 * displacement)
    nodes = 1e3 * model.points
    at = (nodes.min(axis=0) + nodes.max(axis=0)) / 2 if centre is None else 1e3 * centre
    names = []
    for name, share in (("undeformed", 0.0), ("deformed", 1.0)):
        figure = _picture(solid, share, at, f"{title}: {name}")
        figure.savefig(directory / f"{name}.png", dpi=160)
        names.append(f"{name}.png")
    return names


# --- the solid -----------------------------------------------------------------------------------------------------


def _solid(model: Model, displacement: NDArray[np.float64]) -> Solid:
    points, n, none = 1e3 * model.points, model.n_nodes, np.empty(0, np.int64)
    cells = model.hexahedra
    walls = {}
    for name in ("left_ventricle", "right_ventricle"):
        ventricle = model.cell_sets.get(name, none)
        ventricle = ventricle[ventricle < len(cells)]
        if len(ventricle):
            walls[name] = _triangles(boundary_faces(cells[ventricle]))
    seed, interface = (model.node_sets.get(name, none) for name in ("tumour", "interface"))
    return Solid(
        points=np.concatenate([points, points[cells].mean(axis=1)]),
        displacement=np.concatenate([displacement, displacement[cells].mean(axis=1)]),
        hexahedra=cells,
        centres=np.arange(n, n + len(cells)),
        cloud=_cloud(model, points, seed, interface),
        interface=_triangles(interface_faces(model.points, cells, interface, model.domain_points)),
        walls=walls,
        tumour=seed[ConvexHull(points[seed]).simplices] if len(seed) else np.empty((0, 3), np.int64),
    )


def _cloud(
    model: Model, points: NDArray[np.float64], seed: NDArray[np.int64], interface: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Delaunay tetrahedra (n, 4) of the nodes in support domains, without those in the tumour or where no cloud is."""
    if len(model.domains) == 0:
        return np.empty((0, 4), np.int64)
    nodes = np.union1d(model.domains, interface)
    tetrahedra = nodes[Delaunay(points[nodes]).simplices]
    distance, nearest = cKDTree(1e3 * model.domain_points).query(points[tetrahedra].mean(axis=1))
    filled = distance < _REACH * 1e3 * np.cbrt(model.domain_volumes[nearest])
    return tetrahedra[filled & ~np.isin(tetrahedra, seed).all(axis=1)]


def _triangles(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles (2 n, 3) of each face (n, 4), cut from its lowest node on, so that neighbours cut alike."""
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(4)) % 4, axis=1)
    return np.concatenate([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]])


# --- the cuts ------------------------------------------------------------------------------------------------------

Points = NDArray[np.float64]


def _crossed(height: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """The cells (n, k) that have vertices on both sides of the plane height = 0."""
    above = height[cells] >= 0
    return cells[above.any(axis=1) & ~above.all(axis=1)]


def _on_edges(vertices: Points, height: NDArray[np.float64], a: NDArray[np.int64], b: NDArray[np.int64]) -> Points:
    """Where the edges from a (n,) to b (n,) cross the plane: rows of `vertices`, interpolated."""
    t = (height[a] / (height[a] - height[b]))[:, None]
    return (1 - t) * vertices[a] + t * vertices[b]


def cut_tetrahedra(vertices: Points, height: NDArray[np.float64], tetrahedra: NDArray[np.int64]) -> Points:
    """Triangles (n, 3, k) in which the plane height = 0 cuts tetrahedra (m, 4) of vertices (n_vertices, k)."""
    cells = _crossed(height, tetrahedra)
    above = height[cells] >= 0
    cells = np.take_along_axis(cells, np.argsort(above, axis=1, kind="stable"), axis=1)
    n_above = above.sum(axis=1)
    pieces = []
    for n, triangles in (
        (1, [[(3, 0), (3, 1), (3, 2)]]),
        (3, [[(0, 1), (0, 2), (0, 3)]]),
        (2, [[(0, 2), (0, 3), (1, 3)], [(0, 2), (1, 3), (1, 2)]]),
    ):
        some = cells[n_above == n]
        for edges in triangles:
            pieces.append(np.stack([_on_edges(vertices, height, some[:, a], some[:, b]) for a, b in edges], axis=1))
    return np.concatenate(pieces)


def cut_triangles(vertices: Points, height: NDArray[np.float64], triangles: NDArray[np.int64]) -> Points:
    """Segments (n, 2, k) in which the plane height = 0 cuts triangles (m, 3) of vertices (n_vertices, k)."""
    cells = _crossed(height, triangles)
    above = height[cells] >= 0
    alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), above.argmin(axis=1))
    cells = np.take_along_axis(cells, (alone[:, None] + np.arange(3)) % 3, axis=1)
    return np.stack([_on_edges(vertices, height, cells[:, 0], cells[:, i]) for i in (1, 2)], axis=1)


# --- the picture ---------------------------------------------------------------------------------------------------


def _picture(solid: Solid, share: float, at: NDArray[np.float64], title: str) -> Figure:
    """Three cuts through `at` (3,), mm, with `share` of the displacement; frames and colours are those of any share."""
    both = np.concatenate([solid.points, solid.points + solid.displacement])
    low, high = both.min(axis=0), both.max(axis=0)
    margin = 0.05 * (high - low).max()
    low, high = low - margin, high + margin
    extent = high - low
    widths = [extent[right] for _, right, _ in _PLANES.values()]
    inches = 11.5 / sum(widths)  # a millimetre's
    figure = Figure(figsize=(15.0, max(inches * max(extent[1], extent[2]) + 1.5, 4.0)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 3, width_ratios=widths)
    largest = float(np.linalg.norm(solid.displacement, axis=1).max()) or 1.0
    norm, levels = Normalize(0.0, largest), _levels(largest)
    for axes, (name, (normal, right, up)) in zip(panels, _PLANES.items(), strict=True):
        _panel(axes, solid, share, (normal, right, up), float(at[normal]), norm, levels)
        axes.set(
            aspect="equal",
            xlim=(low[right], high[right]),
            ylim=(low[up], high[up]),
            xlabel=f"{'xyz'[right]} (mm)",
            ylabel=f"{'xyz'[up]} (mm)",
            title=f"{name + ', ' if solid.walls else ''}{'xyz'[normal]} = {at[normal]:g} mm",
        )
        if right == 0:
            _sides(axes, solid)
    bar = figure.colorbar(ScalarMappable(norm, COLOURS), ax=panels, label="displacement (mm)", shrink=0.85, pad=0.01)
    for level in levels:
        bar.ax.axhline(level, color=_ink_on(norm(level)), linewidth=0.8)
    shown = [Line2D([], [], color=_INK, linewidth=0.8, label=f"{', '.join(f'{level:g}' for level in levels)} mm moved")]
    for lines, style, label in (
        (solid.tumour, _TUMOUR, "tumour"),
        (solid.walls, _WALL, "ventricle"),
        (solid.interface, _INTERFACE, "end of the support domains"),
    ):
        if len(lines):
            shown.append(Line2D([], [], **style, label=label))
    figure.legend(handles=shown, loc="outside lower center", ncols=len(shown), frameon=False)
    figure.suptitle(title)
    return figure


def _ink_on(share: float) -> str:
    """What is seen on the colour of that share of the largest displacement."""
    return _INK if share < 0.5 else "white"


def _levels(largest: float) -> list[float]:
    """The four largest of ..., 0.5, 1, 2, 5, 10, ... below `largest`."""
    decade = int(np.floor(np.log10(largest)))
    steps = [step * 10.0**k for k in (decade - 2, decade - 1, decade) for step in (1, 2, 5)]
    return [level for level in steps if level < largest][-4:]


def _panel(
    axes: Any,
    solid: Solid,
    share: float,
    plane: tuple[int, int, int],
    place: float,
    norm: Normalize,
    levels: list[float],
) -> None:
    """Draw one cut."""
    normal, right, up = plane
    places = solid.points + share * solid.displacement
    height = places[:, normal] - place
    vertices = np.column_stack([places[:, right], places[:, up], np.linalg.norm(solid.displacement, axis=1)])

    corners = height[solid.hexahedra]
    crossed = (corners.min(axis=1) < 0) & (corners.max(axis=1) >= 0)
    faces = solid.hexahedra[crossed][:, FACES].reshape(-1, 4)
    triangles = _triangles(faces)
    centres = np.tile(np.repeat(solid.centres[crossed], len(FACES)), 2)
    parts = (solid.cloud, np.column_stack([triangles, centres]))
    # The cloud below: its tetrahedra reach a little into hollows of the interface, where hexahedra are.
    for order, tetrahedra in zip((1, 3), parts, strict=True):
        cut = cut_tetrahedra(vertices, height, tetrahedra).reshape(-1, 3)
        if len(cut) == 0:
            continue
        pieces = np.arange(len(cut)).reshape(-1, 3)
        axes.tripcolor(*cut.T, triangles=pieces, shading="gouraud", cmap=COLOURS, norm=norm, zorder=order)
        for level in levels:
            isoline = cut_triangles(cut, cut[:, 2] - level, pieces)[:, :, :2]
            ink = _ink_on(norm(level))
            axes.add_collection(LineCollection(list(isoline), colors=ink, linewidths=0.8, zorder=order + 1))

    def lines(of: NDArray[np.int64], **style: Any) -> None:
        axes.add_collection(LineCollection(list(cut_triangles(vertices, height, of)[:, :, :2]), **style))

    # Where a face that lies nearly in the plane crosses it is chance: no line of the mesh.
    sides = places[triangles[:, 1:]] - places[triangles[:, :1]]
    normals = np.cross(sides[:, 0], sides[:, 1])
    steep = triangles[np.abs(normals[:, normal]) < _STEEP * np.linalg.norm(normals, axis=1)]
    lines(np.unique(np.sort(steep, axis=1), axis=0), colors=_INK, linewidths=0.3, alpha=0.25, zorder=4)
    lines(solid.interface, **_INTERFACE, zorder=5)
    for wall in solid.walls.values():
        lines(wall, **_WALL, zorder=6)
    lines(solid.tumour, **_TUMOUR, zorder=7)
    inside = cut_triangles(vertices, height, solid.tumour)[:, 0, :2]
    if len(inside):
        around = inside - inside.mean(axis=0)
        outline = inside[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]
        axes.fill(*outline.T, color="0.82", zorder=2)


def _sides(axes: Any, solid: Solid) -> None:
    """L and R where x runs to the right, from where the ventricles lie."""
    if len(solid.walls) < 2:
        return
    left, right = (solid.points[solid.walls[f"{side}_ventricle"], 0].mean() for side in ("left", "right"))
    for x, letter in ((0.04, "L" if left < right else "R"), (0.96, "R" if left < right else "L")):
        axes.text(x, 0.97, letter, transform=axes.transAxes, ha="center", va="top", fontsize=14, fontweight="bold")
