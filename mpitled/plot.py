"""Pictures of a run: cuts through the tumour in three planes, undeformed and deformed, coloured by displacement.

The cuts are exact for the piecewise linear solid that is drawn: each hexahedron as twelve tetrahedra around its centre,
whose faces neighbours share, and the cloud as the Delaunay tetrahedra of its nodes (its support domains overlap and
have no shape of their own). All in mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, cKDTree

from mpitled.cloud import FACES, boundary_faces

if TYPE_CHECKING:
    from mpitled.report import Outcome

#: Perceptually uniform and legible to the colour-blind (Nunez et al. 2018; van der Walt and Smith 2015).
COLOURS = "viridis"
#: A place of the cloud has an integration point this near, in cube roots of that point's volume; a hollow has none.
_REACH = 1.5
_INK = "#222222"
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
    cloud_nodes: NDArray[np.int64]  # EFG nodes
    walls: dict[str, NDArray[np.int64]]  # ventricle -> triangles (k, 3) around it
    tumour: NDArray[np.int64]  # (k, 3), triangles around it


def draw(outcome: Outcome, directory: Path) -> list[str]:
    """Write undeformed.png and deformed.png; their names."""
    solid = _solid(outcome)
    centre = outcome.centre
    nodes = 1e3 * outcome.model.points
    at = (nodes.min(axis=0) + nodes.max(axis=0)) / 2 if centre is None else 1e3 * centre
    title = outcome.metadata.get("title") or "mpitled"
    names = []
    for name, share in (("undeformed", 0.0), ("deformed", 1.0)):
        figure = _picture(solid, share, at, f"{title}: {name}")
        figure.savefig(directory / f"{name}.png", dpi=160)
        names.append(f"{name}.png")
    return names


# --- the solid -----------------------------------------------------------------------------------------------------


def _solid(outcome: Outcome) -> Solid:
    model, field = outcome.model, 1e3 * outcome.field
    field[outcome.seed] = 1e3 * outcome.displacement[outcome.seed]
    points, n = 1e3 * model.points, model.n_nodes
    walls = {}
    for name in ("left_ventricle", "right_ventricle"):
        cells = model.cell_sets.get(name, np.empty(0, np.int64))
        cells = cells[cells < len(model.hexahedra)]
        if len(cells):
            walls[name] = _triangles(boundary_faces(model.hexahedra[cells]))
    seed = outcome.seed
    return Solid(
        points=np.concatenate([points, points[model.hexahedra].mean(axis=1)]),
        displacement=np.concatenate([field, field[model.hexahedra].mean(axis=1)]),
        hexahedra=model.hexahedra,
        centres=np.arange(n, n + len(model.hexahedra)),
        cloud=_cloud(outcome, points),
        cloud_nodes=np.arange(model.n_fe_nodes, n),
        walls=walls,
        tumour=seed[ConvexHull(points[seed]).simplices] if len(seed) else np.empty((0, 3), np.int64),
    )


def _cloud(outcome: Outcome, points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Delaunay tetrahedra (n, 4) of the nodes in support domains, without those in the tumour or where no cloud is."""
    model = outcome.model
    if len(model.domains) == 0:
        return np.empty((0, 4), np.int64)
    nodes = np.union1d(np.unique(model.domains), model.node_sets.get("interface", []))
    tetrahedra = nodes[Delaunay(points[nodes]).simplices]
    in_tumour = np.isin(tetrahedra, outcome.seed).all(axis=1)
    distance, nearest = cKDTree(1e3 * model.domain_points).query(points[tetrahedra].mean(axis=1))
    filled = distance < _REACH * 1e3 * np.cbrt(model.domain_volumes[nearest])
    return tetrahedra[filled & ~in_tumour]


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
    """Three cuts through `at` (3,), mm, with `share` of the displacement, all of one scale."""
    both = np.concatenate([solid.points, solid.points + solid.displacement])
    low, high = both.min(axis=0), both.max(axis=0)
    margin = 0.04 * (high - low).max()
    low, high = low - margin, high + margin
    extent = high - low
    tallest = max(extent[2], extent[1])
    widths = [extent[right] for _, right, _ in _PLANES.values()]
    scale = 13.0 / sum(widths)
    figure = Figure(figsize=(15.5, max(scale * tallest + 1.3, 3.0)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 3, width_ratios=widths)
    largest = float(np.linalg.norm(solid.displacement, axis=1).max())
    colours = None
    for axes, (name, (normal, right, up)) in zip(panels, _PLANES.items(), strict=True):
        colours = _panel(axes, solid, share, (normal, right, up), float(at[normal]), largest)
        middle = (low[up] + high[up]) / 2
        axes.set(
            aspect="equal",
            xlim=(low[right], high[right]),
            ylim=(middle - tallest / 2, middle + tallest / 2),
            xlabel=f"{'xyz'[right]} (mm)",
            ylabel=f"{'xyz'[up]} (mm)",
            title=f"{name + ', ' if solid.walls else ''}{'xyz'[normal]} = {at[normal]:g} mm",
        )
        if right == 0:
            _sides(axes, solid)
    figure.colorbar(colours, ax=panels, label="displacement (mm)", shrink=0.85, pad=0.01)
    figure.suptitle(title)
    return figure


def _panel(axes: Any, solid: Solid, share: float, plane: tuple[int, int, int], place: float, largest: float) -> Any:
    """Draw one cut; what its colours mean."""
    normal, right, up = plane
    places = solid.points + share * solid.displacement
    height = places[:, normal] - place
    size = np.linalg.norm(solid.displacement, axis=1)
    vertices = np.column_stack([places[:, right], places[:, up], size])

    corners = height[solid.hexahedra]
    crossed = (corners.min(axis=1) < 0) & (corners.max(axis=1) >= 0)
    faces = solid.hexahedra[crossed][:, FACES].reshape(-1, 4)
    triangles = _triangles(faces)
    centres = np.tile(np.repeat(solid.centres[crossed], 6), 2)
    fe = cut_tetrahedra(vertices, height, np.column_stack([triangles, centres]))
    cloud = cut_tetrahedra(vertices, height, solid.cloud)
    # The cloud first: Delaunay tetrahedra reach a little into hollows of the interface, where hexahedra are.
    colours = None
    for order, pieces in enumerate((cloud, fe)):
        if len(pieces):
            flat = pieces.reshape(-1, 3)
            colours = axes.tripcolor(
                flat[:, 0], flat[:, 1], flat[:, 2], triangles=np.arange(len(flat)).reshape(-1, 3),
                shading="gouraud", cmap=COLOURS, vmin=0.0, vmax=largest or 1.0, zorder=1 + order,
            )  # fmt: skip

    def lines(of: NDArray[np.int64], **style: Any) -> None:
        axes.add_collection(LineCollection(cut_triangles(vertices, height, of)[:, :, :2], **style))

    lines(_triangles(np.unique(np.sort(faces, axis=1), axis=0)), colors="white", linewidths=0.25, alpha=0.35, zorder=3)
    for wall in solid.walls.values():
        lines(wall, colors="white", linewidths=1.6, zorder=5)
    lines(solid.tumour, colors="white", linewidths=1.6, zorder=6)
    return colours


def _sides(axes: Any, solid: Solid) -> None:
    """L and R where x runs to the right, from where the ventricles lie."""
    if len(solid.walls) < 2:
        return
    left, right = (solid.points[solid.walls[f"{side}_ventricle"], 0].mean() for side in ("left", "right"))
    for x, letter in ((0.03, "L" if left < right else "R"), (0.97, "R" if left < right else "L")):
        axes.text(
            x, 0.97, letter, transform=axes.transAxes, ha="center", va="top", fontsize=14, fontweight="bold",
            color=_INK, path_effects=[withStroke(linewidth=2, foreground="white")],
        )  # fmt: skip
