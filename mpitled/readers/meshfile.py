"""The contents of a mesh file in its own numbers and units: nodes, elements, sets, constraints and materials."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mpitled.errors import InputError
from mpitled.mesh import Bools, Constraint, Floats, Ints
from mpitled.meshing.faces import unshared

#: Largest number of a node or element: programs that write decks store these numbers in 32 bits.
MAX_ID = 2**31 - 1
#: Limit of coordinates in the file's unit, so that volumes and their products are finite.
MAX_COORDINATE = 1e12
#: Number of corners of the supported solids; all other elements have the kind "other".
SOLIDS = {"hexahedron": 8, "wedge": 6, "pyramid": 5, "tetrahedron": 4}
#: Corners of the faces S1, S2, ... of Abaqus's solids, clockwise seen from outside; -1 pads triangles.
FACES = {
    "hexahedron": [[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]],
    "wedge": [[0, 1, 2, -1], [3, 5, 4, -1], [0, 3, 4, 1], [1, 4, 5, 2], [2, 5, 3, 0]],
    "pyramid": [[0, 1, 2, 3], [0, 4, 1, -1], [1, 4, 2, -1], [2, 4, 3, -1], [3, 4, 0, -1]],
    "tetrahedron": [[0, 1, 2, -1], [0, 3, 1, -1], [1, 3, 2, -1], [2, 3, 0, -1]],
}


@dataclass(frozen=True, slots=True)
class Cells:
    """Elements of one type."""

    kind: str  # a key of SOLIDS, or "other"
    type: str  # the file's name of the type
    ids: Ints  # (n,), the file's numbers
    nodes: Ints  # (n, k), rows of the file's nodes: corners in the Abaqus order; -1 pads rows of kind "other"
    origin: str  # file and line


@dataclass(frozen=True, slots=True)
class FileMaterial:
    """A linear elastic or neo-Hookean solid in the file's units."""

    name: str
    youngs_modulus: float
    poissons_ratio: float
    density: float | None  # None if the file gives no density
    origin: str


@dataclass(slots=True)
class MeshFile:
    """Nodes, elements, sets, constraints and materials of one file and its includes.

    Cell sets number the elements of all `cells` consecutively. `refused` has one line for each unsupported part of the
    file that changes the mechanics.
    """

    path: Path
    format: str
    points: Floats  # (n_nodes, 3)
    node_ids: Ints  # (n_nodes,), the file's numbers
    cells: list[Cells] = field(default_factory=list)
    node_sets: dict[str, Ints] = field(default_factory=dict)  # ascending
    cell_sets: dict[str, Ints] = field(default_factory=dict)  # ascending
    constraints: list[Constraint] = field(default_factory=list)  # displacements in the file's unit
    materials: list[tuple[str, FileMaterial]] = field(default_factory=list)  # cell set, material
    structural: set[str] = field(default_factory=set)  # cell sets with a section
    remarks: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    @property
    def n_cells(self) -> int:
        """Number of elements of all kinds."""
        return sum(len(block.ids) for block in self.cells)

    def blocks(self, *kinds: str) -> Iterator[tuple[Cells, Ints]]:
        """Non-empty blocks of these kinds (default: all kinds), and the rows of their elements."""
        first = 0
        for block in self.cells:
            if (not kinds or block.kind in kinds) and len(block.ids):
                yield block, first + np.arange(len(block.ids))
            first += len(block.ids)

    def element(self, row: int) -> tuple[Cells, int]:
        """The block of an element, and its number in the file."""
        block, rows = next((block, rows) for block, rows in self.blocks() if rows[0] <= row <= rows[-1])
        return block, int(block.ids[row - rows[0]])

    def nodes_of(self, rows: Ints, face: int | None = None) -> Ints:
        """Nodes, ascending, of elements (ascending), or of one face of each element: 0 is S1."""
        parts = []
        for block, block_rows in self.blocks():
            first, last = block_rows[0], block_rows[-1]
            nodes = block.nodes[rows[(rows >= first) & (rows <= last)] - first]
            if face is not None and block.kind in FACES:
                faces = FACES[block.kind]
                nodes = nodes[:, [corner for corner in faces[min(face, len(faces) - 1)] if corner >= 0]]
            parts.append(np.unique(nodes))
        nodes = union(parts)
        return nodes[nodes >= 0]

    def set_of(self, nodes: Ints, name: str) -> str:
        """The name of the node set with exactly these nodes (ascending); if it is missing, it is added as `name`."""
        for existing, members in self.node_sets.items():
            if len(members) == len(nodes) and (members == nodes).all():
                return existing
        return add_set(self.node_sets, name, nodes)


class Numbering:
    """Map from a file's numbers to rows of its arrays, without memory for gaps in the numbers."""

    def __init__(self, ids: Ints) -> None:
        ascending = bool((np.diff(ids) > 0).all())
        self.order = None if ascending else np.argsort(ids, kind="stable")
        self.ids = ids if self.order is None else ids[self.order]
        self._dense = len(ids) > 0 and int(self.ids[-1]) - int(self.ids[0]) == len(ids) - 1

    def rows(self, labels: Ints) -> tuple[Ints, Bools]:
        """Rows of the numbers `labels`, and a mask of existing numbers; the row of a missing number is arbitrary."""
        if len(self.ids) == 0:
            return np.zeros(labels.shape, np.int64), np.zeros(labels.shape, bool)
        place = labels - self.ids[0] if self._dense else np.searchsorted(self.ids, labels)
        place = np.clip(place, 0, len(self.ids) - 1)
        found = self.ids[place] == labels
        return (place if self.order is None else self.order[place]), found

    def between(self, first: int, last: int, step: int) -> Ints:
        """Rows of the existing numbers among first, first + step, ..., last."""
        start, stop = np.searchsorted(self.ids, [first, last + 1])
        place = start + np.flatnonzero((self.ids[start:stop] - first) % step == 0)
        return place if self.order is None else self.order[place]

    def members(self, labels: Ints, kind: str, name: str, origin: str, remarks: list[str]) -> Ints:
        """Rows of a set's members; missing members are ignored with a warning in `remarks`."""
        rows, found = self.rows(labels)
        if not found.all():
            missing = labels[~found]
            remarks.append(
                f"warning: {origin}: set {name} has {len(missing)} {kind}s that are not there, the first {missing[0]}; "
                "they are left out"
            )
        return rows[found]

    def resolve(self, labels: Ints, ids: Ints, origin: str) -> Ints:
        """Rows (n, k) of the nodes of elements (n,); InputError if the file does not define one of the nodes."""
        rows, missing = np.empty(labels.shape, np.int64), np.zeros(len(labels), bool)
        for first in range(0, len(labels), 1 << 16):
            chunk = slice(first, first + (1 << 16))
            rows[chunk], exists = self.rows(labels[chunk])
            missing[chunk] = ~exists.all(axis=1)
        if missing.any():
            element = int(np.argmax(missing))
            unknown = labels[element][~self.rows(labels[element])[1]]
            raise InputError(
                f"{origin}: element {ids[element]} has node {unknown[0]}, which the file does not define "
                f"({np.count_nonzero(missing)} such elements)"
            )
        return rows


@dataclass(slots=True)
class NodeTable:
    """Nodes in blocks, as a file defines them."""

    ids: list[Ints] = field(default_factory=list)
    points: list[Floats] = field(default_factory=list)
    origins: list[str] = field(default_factory=list)

    def add(self, ids: Ints, points: Floats, origin: str) -> None:
        """Append a block."""
        self.ids.append(ids)
        self.points.append(points)
        self.origins.append(origin)

    def merged(self, path: Path, remarks: list[str]) -> tuple[Ints, Floats]:
        """Numbers and points of all nodes; InputError if a number has two points. Repeated nodes are merged."""
        ids, points = joined(self.ids), np.concatenate([np.empty((0, 3)), *self.points])
        numbering = Numbering(ids)
        if numbering.order is None:
            return ids, points
        twice = numbering.order[1:][np.diff(numbering.ids) == 0]
        if not len(twice):
            return ids, points
        first = numbering.rows(ids[twice])[0]  # the first of equal numbers, because the sort is stable
        apart = np.flatnonzero((points[first] != points[twice]).any(axis=1))
        if len(apart):
            row = int(twice[apart[0]])
            origin = self.origins[int(np.searchsorted(np.cumsum([*map(len, self.ids)]), row, side="right"))]
            raise InputError(f"{origin}: node {ids[row]} is defined twice, at different points ({len(apart)} such)")
        keep = np.ones(len(ids), bool)
        keep[twice] = False
        remarks.append(f"{path}: {len(twice)} nodes that are given twice at the same point are merged")
        return ids[keep], points[keep]


def joined(arrays: Iterable[Ints]) -> Ints:
    """The concatenated arrays; empty without arrays."""
    return np.concatenate([np.empty(0, np.int64), *arrays])


def union(arrays: Iterable[Ints]) -> Ints:
    """The distinct members of the arrays, ascending."""
    return np.unique(joined(arrays))


def add_set(sets: dict[str, Ints], name: str, members: Ints) -> str:
    """Add a set under the name, or with a number appended if the name exists. Returns the name."""
    free, n = name, 2
    while free in sets:
        free, n = f"{name}_{n}", n + 1
    sets[free] = members
    return free


def extend_set(sets: dict[str, Ints], name: str, members: Ints) -> None:
    """Add members (ascending) to the set of that name, which may be new."""
    sets[name] = np.union1d(sets[name], members) if name in sets else members


def listed(items: Iterable[object], most: int = 8) -> str:
    """The first items, separated by commas; "none" without items."""
    texts = [str(item) for item in items]
    return ", ".join(texts[:most]) + (f" and {len(texts) - most} more" if len(texts) > most else "") or "none"


def checked_ids(ids: Ints, kind: str, origin: str) -> Ints:
    """Numbers of nodes or elements; InputError if one is not between 1 and MAX_ID."""
    if len(ids) and (ids.min() < 1 or ids.max() > MAX_ID):
        bad = ids[(ids < 1) | (ids > MAX_ID)]
        raise InputError(f"{origin}: {kind} number {bad[0]} is not between 1 and {MAX_ID} ({len(bad)} such)")
    return ids


def as_ids(values: Floats, kind: str, origin: str) -> Ints:
    """Numbers of nodes in a column of reals; errors as `checked_ids`."""
    if (values != np.rint(values)).any():
        bad = values[values != np.rint(values)]
        raise InputError(f"{origin}: {kind} number {bad[0]:g} is not an integer ({len(bad)} such)")
    return checked_ids(np.clip(values, -1, 2.0**53).astype(np.int64), kind, origin)


def check_unique_cells(cells: list[Cells]) -> None:
    """InputError if two elements have the same number."""
    ids = joined(block.ids for block in cells)
    numbering = Numbering(ids)
    if numbering.order is not None and (repeated := np.diff(numbering.ids) == 0).any():
        row = int(numbering.order[1:][repeated].min())
        ends = np.cumsum([len(block.ids) for block in cells])
        block = cells[int(np.searchsorted(ends, row, side="right"))]
        raise InputError(
            f"{block.origin}: element {ids[row]} is defined twice ({np.count_nonzero(repeated)} such); renumber one"
        )


def invalid_moduli(youngs_modulus: float, poissons_ratio: float) -> str:
    """The reason why the moduli are invalid for an elastic solid; "" if they are valid."""
    valid = youngs_modulus > 0 and -1 < poissons_ratio < 0.5
    return "" if valid else f"has E = {youngs_modulus:g} and nu = {poissons_ratio:g}"


def unused_material(origin: str, material: str, reason: str, cell_set: str) -> str:
    """Warning about a material that cannot be used."""
    return (
        f"warning: {origin}: material {material} {reason}; it is not used: give '{cell_set}' a [material] in the deck"
    )


def exterior_faces(cells: Iterable[Cells]) -> tuple[Ints, Ints]:
    """Nodes (m, 4) of faces that belong to one solid only (-1 pads triangles), and the rows of these solids."""
    faces, owners, first = [np.empty((0, 4), np.int64)], [np.empty(0, np.int64)], 0
    for block in cells:
        for corners in FACES.get(block.kind, ()):
            nodes = block.nodes[:, corners]
            nodes[:, np.array(corners) < 0] = -1
            faces.append(nodes)
            owners.append(first + np.arange(len(nodes)))
        first += len(block.ids)
    face, owner = np.concatenate(faces), np.concatenate(owners)
    chosen = unshared(face)
    return face[chosen], owner[chosen]
