"""Writes the mesh of a scene of the stability matrix: a box of hexahedra, as regular or as bad as it is asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mpitled.cells import hexahedra
from mpitled.mesh import grid_points, structured_hexahedra


def write_grid(folder: Path, options: dict[str, str]) -> None:
    """Write Abaqus decks in mm: grid.inp (hexahedra), and inner.inp and all_cells.inp (the nodes of clouds).

    areas.csv has the areas of the outer surface at its nodes. Node sets: x0 to z1, surface, and level0, level1, ...
    (surface nodes, by the number of cells below them). Cell sets: all_cells, inner (4 x 4 x 4 in the middle), upper.

    Options: elements and size along x, y, z; thin, the thickness of the middle layer along x, y, z as a share of a
    cell; skew, the smallest scaled Jacobian, reached by moving inner nodes; flaw, a common mistake in a mesh.
    """
    shape = nx, ny, nz = [int(n) for n in options.get("elements", "8,8,8").split(",")]
    lx, ly, lz = size = [float(length) for length in options.get("size", "24,24,24").split(",")]
    points, cells = grid_points((nx, ny, nz), (lx, ly, lz)), structured_hexahedra((nx, ny, nz))
    index = np.rint(points / size * shape).astype(int)
    for axis, ratio in enumerate(map(float, options.get("thin", "1,1,1").split(","))):
        if ratio < 1:  # one plane moves: the layer beyond it becomes thicker
            points[index[:, axis] == shape[axis] // 2 + 1, axis] -= (1 - ratio) * size[axis] / shape[axis]
    inside = np.logical_and(index > 0, index < shape).all(axis=1)
    if "skew" in options:
        points = _skewed(points, cells, inside, float(options["skew"]))
    gradients, volumes = hexahedra.geometry(points, cells)
    areas = hexahedra.nodal_sum(cells, volumes[:, None, None] * gradients, len(points))
    table = (f"{i + 1},{','.join(map(repr, areas[i].tolist()))}\n" for i in np.flatnonzero(~inside))
    (folder / "areas.csv").write_text("node,x,y,z\n" + "".join(table))
    node_sets = {f"{a}{end}": index[:, i] == end * shape[i] for i, a in enumerate("xyz") for end in (0, 1)}
    node_sets |= {"surface": ~inside} | {f"level{k}": ~inside & (index[:, 2] == k) for k in range(nz + 1)}
    centres = index[cells].mean(axis=1) / shape
    cell_sets = {
        "all_cells": np.ones(len(cells), bool),
        "inner": (np.abs(centres - 0.5) < 0.25).all(axis=1),
        "upper": centres[:, 2] > 0.5,
    }
    flaw = options.get("flaw", "")
    first = int(cell_sets["inner"].argmax())
    copied = np.empty(0, np.int64)  # nodes that get a copy
    if flaw == "repeated":
        cells = np.concatenate([cells, cells[first : first + 1]])
        cell_sets = {name: np.append(chosen, chosen[first]) for name, chosen in cell_sets.items()}
    elif flaw == "inverted":
        cells[first] = cells[first, [4, 5, 6, 7, 0, 1, 2, 3]]
    elif flaw == "flat":
        points[cells[first, 4:]] = points[cells[first, :4]]
    elif flaw in ("twins", "open"):
        copied = np.flatnonzero(index[:, 2] == nz // 2)
    elif flaw == "strays":
        copied = np.arange(9)
    points = np.concatenate([points, points[copied] + (100.0 if flaw == "strays" else 0.0)])
    node_sets = {name: np.concatenate([own, own[copied] & (flaw == "open")]) for name, own in node_sets.items()}
    if flaw == "open":  # the upper cells have the copies
        other = np.arange(len(index))
        other[copied] = len(index) + np.arange(len(copied))
        cells = np.where(cell_sets["upper"][:, None], other[cells], cells)
    elements = "*ELEMENT, TYPE=C3D8R\n" + _lines(np.arange(len(cells)), cells + 1) + _sets("EL", cell_sets)
    everything = np.ones(len(points), bool)
    (folder / "grid.inp").write_text(_nodes(points, everything) + elements + _sets("N", node_sets))
    for name in ("all_cells", "inner"):
        own = np.isin(np.arange(len(points)), cells[cell_sets[name]])
        own[len(index) :] = True
        sets = {key: chosen & own for key, chosen in node_sets.items()}
        (folder / f"{name}.inp").write_text(_nodes(points, own) + _sets("N", sets))


def _nodes(points: NDArray[np.float64], chosen: NDArray[np.bool_]) -> str:
    return "*NODE\n" + _lines(np.flatnonzero(chosen), points[chosen])


def _lines(numbers: NDArray[np.int64], table: NDArray[np.generic]) -> str:
    pairs = zip(numbers.tolist(), table.tolist(), strict=True)
    return "".join(f"{number + 1}, {', '.join(map(repr, row))}\n" for number, row in pairs)


def _sets(kind: str, sets: dict[str, NDArray[np.bool_]]) -> str:
    numbers = {name: "".join(f"{i + 1}\n" for i in np.flatnonzero(chosen)) for name, chosen in sets.items()}
    return "".join(f"*{kind}SET, {kind}SET={name}\n{text}" for name, text in numbers.items() if text)


def _skewed(
    points: NDArray[np.float64], cells: NDArray[np.int64], inside: NDArray[np.bool_], worst: float
) -> NDArray[np.float64]:
    """Points with random shifts of the inner ones, as large as a smallest scaled Jacobian of `worst` allows."""
    shift = np.where(inside[:, None], np.random.default_rng(0).uniform(-1, 1, points.shape), 0.0)
    low, high = 0.0, float(np.linalg.norm(points[cells[0, 1]] - points[cells[0, 0]]))
    for _ in range(50):
        middle = 0.5 * (low + high)
        valid = hexahedra.scaled_jacobian(points + middle * shift, cells).min() > worst
        low, high = (middle, high) if valid else (low, middle)
    return points + low * shift
