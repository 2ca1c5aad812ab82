"""Resolve the definitions of an Abaqus deck: instances, sets, surfaces, sections and boundary conditions."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mpitled.errors import InputError
from mpitled.mesh import Constraint, Floats, Ints
from mpitled.readers import meshfile
from mpitled.readers.inp import Keyword
from mpitled.readers.meshfile import Cells, FileMaterial, MeshFile, NodeTable, Numbering
from mpitled.readers.text import integer, real

#: Degrees of freedom of named boundary conditions.
_SYMBOLIC = {
    "ENCASTRE": (1, 2, 3), "PINNED": (1, 2, 3), "XSYMM": (1,), "YSYMM": (2,), "ZSYMM": (3,),
    "XASYMM": (2, 3), "YASYMM": (1, 3), "ZASYMM": (1, 2), "NOWARP": (), "NOOVAL": (), "NODEFORM": (),
}  # fmt: skip
_NOUN = {"node": "node", "cell": "element"}
#: Scope, kind ("node" or "cell") and name of a set.
_Key = tuple[str, str, str]


@dataclass(slots=True)
class Entry:
    """An addition to a set: numbers, a range (first, last, step), or another set."""

    kind: str  # "labels", "range", "set", or "cells": the nodes of an element set
    value: Any
    instance: str | None
    origin: str


@dataclass(slots=True)
class Set:
    """Entries of a set of nodes or elements."""

    name: str  # as first written
    entries: list[Entry] = field(default_factory=list)


@dataclass(slots=True)
class Scope:
    """The definitions of a part, of an instance, or of the rest of the deck. Names ignore case."""

    name: str = ""
    nodes: NodeTable = field(default_factory=NodeTable)
    cells: list[Cells] = field(default_factory=list)  # their nodes are numbers in the file
    sets: dict[str, dict[str, Set]] = field(default_factory=lambda: {"node": {}, "cell": {}})
    surfaces: dict[str, tuple[str, list[tuple[str, list[str]]]]] = field(default_factory=dict)
    sections: list[tuple[str, str, str]] = field(default_factory=list)  # set, material or "", origin

    def add(self, kind: str, name: str, entry: Entry) -> None:
        """Add an entry to a set."""
        self.sets[kind].setdefault(name.casefold(), Set(name)).entries.append(entry)

    def copy(self, name: str) -> Scope:
        """An instance of this part."""
        nodes = NodeTable(list(self.nodes.ids), list(self.nodes.points), list(self.nodes.origins))
        sets = {
            kind: {key: Set(members.name, list(members.entries)) for key, members in of_kind.items()}
            for kind, of_kind in self.sets.items()
        }
        return Scope(name, nodes, list(self.cells), sets, dict(self.surfaces), list(self.sections))


@dataclass(slots=True)
class Placed:
    """A scope in the model: rows of its first node and element, and the maps from numbers to rows."""

    scope: Scope
    node_offset: int
    cell_offset: int
    nodes: Numbering
    cells: Numbering


@dataclass(slots=True)
class Material:
    """The options under *MATERIAL."""

    name: str
    origin: str
    elastic: tuple[float, float] | None = None
    density: float | None = None
    unusable: str = ""  # the reason, if the law is not supported


@dataclass(slots=True)
class Definitions:
    """All definitions of a deck."""

    path: Path
    root: Scope = field(default_factory=Scope)
    parts: dict[str, Scope] = field(default_factory=dict)
    instances: dict[str, Scope] = field(default_factory=dict)
    instanced: set[str] = field(default_factory=set)  # parts with an instance
    assembly: str = ""  # its name
    unended: str = ""  # the part or instance without an end
    materials: dict[str, Material] = field(default_factory=dict)
    boundaries: list[tuple[int, Keyword]] = field(default_factory=list)  # step from 1, *BOUNDARY
    remarks: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


def _with_rows(block: Cells, numbering: Numbering, offset: int) -> Cells:
    """Elements with rows of the model's nodes instead of numbers; InputError if a node of a solid is missing."""
    if block.kind != "other":
        nodes = numbering.resolve(block.nodes, block.ids, block.origin)
        nodes += offset
    else:
        rows, exists = numbering.rows(block.nodes)
        nodes = np.where(exists, rows + offset, -1)
    return Cells(block.kind, block.type, block.ids, nodes, block.origin)


class Model:
    """The instances of all parts, with resolved names."""

    def __init__(self, given: Definitions) -> None:
        self.given = given
        self.remarks = given.remarks
        self.placed: dict[str, Placed] = {}
        points, ids, cells = [np.empty((0, 3))], [np.empty(0, np.int64)], []
        n_nodes = n_cells = 0
        unused = {
            part.name: sum(map(len, part.nodes.ids))
            for key, part in given.parts.items()
            if part.nodes.ids and key not in given.instanced
        }
        given.parts.clear()  # the instances have copies
        for key, scope in {"": given.root, **given.instances}.items():
            scope_ids, scope_points = scope.nodes.merged(given.path, self.remarks)
            scope.nodes = NodeTable()  # frees memory
            meshfile.check_unique_cells(scope.cells)
            cell_ids = meshfile.joined(block.ids for block in scope.cells)
            placed = Placed(scope, n_nodes, n_cells, Numbering(scope_ids), Numbering(cell_ids))
            self.placed[key] = placed
            for at, block in enumerate(scope.cells):
                cells.append(_with_rows(block, placed.nodes, n_nodes))
                scope.cells[at] = cells[-1]  # frees the numbers
            points.append(scope_points)
            ids.append(scope_ids)
            n_nodes, n_cells = n_nodes + len(scope_ids), n_cells + len(cell_ids)
        unused = {name: n for name, n in unused.items() if n}
        ends = f"the file ends within {given.unended}: is it cut short?" if given.unended else ""
        if unused and not n_nodes:
            name, n = next(iter(unused.items()))
            raise InputError(f"{given.path}: part {name}, which has {n} nodes, has no *INSTANCE; {ends or 'add one'}")
        if unused:
            names = meshfile.listed(unused)
            self.remarks.append(f"warning: {given.path}: part {names} has no *INSTANCE and is left out")
        if ends:
            self.remarks.append(f"warning: {given.path}: {ends}")
        self.mesh = MeshFile(
            path=given.path,
            format="Abaqus",
            points=np.concatenate(points),
            node_ids=np.concatenate(ids),
            cells=cells,
            remarks=self.remarks,
            refused=given.refused,
        )
        self._resolved: dict[_Key, Ints] = {}

    def file(self) -> MeshFile:
        """The mesh with all sets, materials and constraints."""
        mesh = self.mesh
        names: dict[_Key, str] = {}  # names of sets in the result
        for kind, sets in (("node", mesh.node_sets), ("cell", mesh.cell_sets)):
            all_names = [key for placed in self.placed.values() for key in placed.scope.sets[kind]]
            for key, placed in self.placed.items():
                for set_key, members in placed.scope.sets[kind].items():
                    unique = key == "" or all_names.count(set_key) == 1
                    name = members.name if unique else f"{placed.scope.name}.{members.name}"
                    names[key, kind, set_key] = meshfile.add_set(sets, name, self._members(key, kind, set_key, ()))
        for key, placed in self.placed.items():
            for name, (kind, rows) in placed.scope.surfaces.items():
                unique = key == "" or sum(name in other.scope.surfaces for other in self.placed.values()) == 1
                name = name if unique else f"{placed.scope.name}.{name}"
                name = f"{name}_surface" if name in mesh.node_sets else name
                meshfile.add_set(mesh.node_sets, name, self._surface(key, kind, rows))
            for name, material, origin in placed.scope.sections:
                self._section(names, key, name, material, origin)
        self._constrain(names)
        return mesh

    # Sets

    def _members(self, key: str, kind: str, name: str, within: tuple[_Key, ...]) -> Ints:
        """Rows, ascending, of the set `name` of a scope; `within` are the sets that refer to it."""
        set_key = key, kind, name
        if set_key not in self._resolved:
            entries = self.placed[key].scope.sets[kind][name].entries
            if set_key in within:
                raise InputError(f"{entries[0].origin}: set {name} is a part of itself; break the circle")
            within = (*within, set_key)
            self._resolved[set_key] = meshfile.union(self._entry(key, kind, name, entry, within) for entry in entries)
        return self._resolved[set_key]

    def _entry(self, key: str, kind: str, name: str, entry: Entry, within: tuple[_Key, ...]) -> Ints:
        if entry.instance is not None:
            key = entry.instance.casefold()
            if key not in self.placed or not key:
                raise InputError(f"{entry.origin}: there is no instance {entry.instance}; correct it")
        if entry.kind == "set":
            return self._refer(key, kind, entry.value, entry.origin, within)
        if entry.kind == "cells":
            return self.mesh.nodes_of(self._refer(key, "cell", entry.value, entry.origin, within))
        numbering, offset = self._numbering(key, kind)
        if entry.kind == "range":
            return offset + numbering.between(*entry.value)
        return offset + numbering.members(entry.value, _NOUN[kind], name, entry.origin, self.remarks)

    def _numbering(self, key: str, kind: str) -> tuple[Numbering, int]:
        placed = self.placed[key]
        return (placed.nodes, placed.node_offset) if kind == "node" else (placed.cells, placed.cell_offset)

    def _refer(self, key: str, kind: str, text: str, origin: str, within: tuple[_Key, ...] = ()) -> Ints:
        """Rows of a number or a set in a line of data, also of an instance's set, for example Part-1-1.Set-1."""
        located = self._locate(key, kind, text)
        if located is None:
            sets = sorted(members.name for members in self.placed[key].scope.sets[kind].values())
            raise InputError(f"{origin}: there is no {_NOUN[kind]} set {text}; sets: {meshfile.listed(sets)}")
        key, name = located
        if isinstance(name, str):
            return self._members(key, kind, name, within)
        meshfile.checked_ids(np.array([name]), kind, origin)
        numbering, offset = self._numbering(key, kind)
        rows, exists = numbering.rows(np.array([name]))
        if not exists.all():
            raise InputError(f"{origin}: there is no {_NOUN[kind]} {text}; correct it")
        return offset + rows

    def _locate(self, key: str, kind: str, text: str) -> tuple[str, str | int] | None:
        """Scope, and set or number, of a name; None if there is no such set."""
        if text.isascii() and text.isdecimal() and len(text) <= 20:
            return key, int(text)
        text = text.strip().strip('"')
        set_key = text.casefold()
        if set_key in self.placed[key].scope.sets[kind]:
            return key, set_key
        if key == "":
            for dot in (at for at, letter in enumerate(text) if letter == "."):
                instance, rest = text[:dot].strip().strip('"').casefold(), text[dot + 1 :]
                if instance in self.given.instances:
                    return self._locate(instance, kind, rest)
                if instance == self.given.assembly.casefold():
                    return self._locate("", kind, rest)
            owners = [other for other, placed in self.placed.items() if set_key in placed.scope.sets[kind]]
            if len(owners) == 1:
                return owners[0], set_key
        return None

    def _surface(self, key: str, kind: str, rows: list[tuple[str, list[str]]]) -> Ints:
        """Nodes of a surface: of nodes, of elements' faces, or of all exterior faces of elements."""
        parts: list[Ints] = []
        exterior = None
        by_face: dict[int | None, list[Ints]] = {}
        for origin, fields in rows:
            if not fields[0]:
                raise InputError(f"{origin}: a surface of the whole model is not read; name an element set")
            if kind == "NODE":
                parts.append(self._refer(key, "node", fields[0], origin))
                continue
            name = fields[1].upper() if len(fields) > 1 else ""
            face = int(name[1:]) - 1 if re.fullmatch(r"S[1-6]", name) else None
            cells = self._refer(key, "cell", fields[0], origin)
            if name or not any(block.kind in meshfile.FACES for block in self.mesh.cells):
                by_face.setdefault(face, []).append(cells)
                continue
            if exterior is None:
                exterior = meshfile.exterior_faces(self.mesh.cells)
            parts.append(np.unique(exterior[0][np.isin(exterior[1], cells)]))
        parts += [self.mesh.nodes_of(meshfile.union(cells), face) for face, cells in by_face.items()]
        nodes = meshfile.union(parts)
        return nodes[nodes >= 0]

    # Sections and boundary conditions

    def _section(self, names: dict[_Key, str], key: str, name: str, material: str, origin: str) -> None:
        located = self._locate(key, "cell", f'"{name}"')
        if located is None or not isinstance(located[1], str):
            self._refer(key, "cell", f'"{name}"', origin)
            raise InputError(f"{origin}: a section needs an element set, not {name!r}; correct it")
        cell_set = names[located[0], "cell", located[1]]
        self.mesh.structural.add(cell_set)
        if not material:
            return
        if material.casefold() not in self.given.materials:
            known = meshfile.listed(law.name for law in self.given.materials.values())
            raise InputError(f"{origin}: there is no material {material!r}; materials: {known}")
        law = self.given.materials[material.casefold()]
        reason = law.unusable or (meshfile.invalid_moduli(*law.elastic) if law.elastic else "has no *ELASTIC")
        if reason or law.elastic is None:
            self.remarks.append(meshfile.unused_material(law.origin, law.name, reason, cell_set))
            return
        self.mesh.materials.append((cell_set, FileMaterial(law.name, *law.elastic, law.density, law.origin)))

    def _constrain(self, names: dict[_Key, str]) -> None:
        """Boundary conditions at the end of the last step: later steps replace earlier steps node by node."""
        constraints: list[tuple[int, Constraint, Ints]] = []
        for step, keyword in self.given.boundaries:
            constraints += [(step, constraint, nodes) for constraint, nodes in self._boundary(names, keyword)]
        claimed = np.zeros((len(self.mesh.points), 3), bool)
        last = max((step for step, _, _ in constraints), default=0)
        kept: list[Constraint] = []
        replaced = False
        for step in range(last, -1, -1):
            of_step = [(constraint, nodes) for at, constraint, nodes in constraints if at == step]
            for constraint, nodes in of_step:
                free = ~claimed[nodes][:, constraint.directions]
                if free.all():
                    kept.append(constraint)
                    continue
                replaced = True
                for i, direction in enumerate(constraint.directions):
                    if free[:, i].any():
                        name = self.mesh.set_of(nodes[free[:, i]], f"{constraint.node_set} before step {last}")
                        values = constraint.displacement[i]
                        if isinstance(values, np.ndarray):
                            values = values[free[:, i]]
                        kept.append(Constraint(name, (direction,), (values,), constraint.origin))
            for constraint, nodes in of_step:
                claimed[nodes[:, None], constraint.directions] = True
        if replaced:
            self.remarks.append(f"{self.mesh.path}: boundary conditions of several steps; those of the last step count")
        self.mesh.constraints = kept

    def _boundary(self, names: dict[_Key, str], keyword: Keyword) -> Iterator[tuple[Constraint, Ints]]:
        """Constraints of one keyword with their nodes: one per set, and one for all single nodes with the same dofs."""
        of_sets: dict[tuple[str, str | int], list[tuple[int, float, str]]] = {}
        of_nodes: dict[int, tuple[list[Ints], list[float]]] = {}
        for origin, fields in keyword.rows():
            directions, value = self._degrees(origin, fields, keyword)
            if not directions:
                continue
            located = self._locate("", "node", fields[0])
            if located is not None and isinstance(located[1], str):
                of_sets.setdefault(located, []).extend((direction, value, origin) for direction in directions)
                continue
            node = self._refer("", "node", fields[0], origin)
            for direction in directions:
                nodes, values = of_nodes.setdefault(direction, ([], []))
                nodes.append(node)
                values.append(value)
        for (key, name), moved in of_sets.items():
            node_set = names[key, "node", str(name)]
            for group in _without_clashes({(direction, value): origin for direction, value, origin in moved}):
                axes, moves = zip(*group, strict=True)
                yield Constraint(node_set, axes, moves, group[axes[0], moves[0]]), self.mesh.node_sets[node_set]
        grouped: dict[bytes, tuple[Ints, dict[int, Any]]] = {}
        for direction, (nodes, values) in of_nodes.items():
            for rows, at in _distinct(np.concatenate(nodes), np.array(values)):
                uniform: Any = float(at[0]) if (at == at[0]).all() else at
                grouped.setdefault(rows.tobytes(), (rows, {}))[1].setdefault(direction, uniform)
        for rows, by_direction in grouped.values():
            name = self.mesh.set_of(rows, f"{keyword.path.name}:{keyword.line}")
            axes, moves = zip(*sorted(by_direction.items()), strict=True)
            yield Constraint(name, axes, moves, keyword.origin), rows

    def _degrees(self, origin: str, fields: list[str], keyword: Keyword) -> tuple[tuple[int, ...], float]:
        """Directions (0, 1, 2) and displacement in a line of *BOUNDARY, without rotations and temperatures."""
        if len(fields) < 2 or not fields[1]:
            raise InputError(f"{origin}: {keyword.shown} needs a node or set, and degrees of freedom; correct it")
        word = "".join(fields[1].split()).upper()
        if word in _SYMBOLIC:
            return tuple(degree - 1 for degree in _SYMBOLIC[word]), 0.0
        if not word[:1].isdecimal():
            raise InputError(f"{origin}: {fields[1]!r} is no degree of freedom; there are {', '.join(_SYMBOLIC)}")
        first = integer(fields[1], origin)
        last = integer(fields[2], origin) if len(fields) > 2 and fields[2] else first
        value = real(fields[3], origin) if len(fields) > 3 and fields[3] else 0.0
        if last < first:
            raise InputError(f"{origin}: degrees of freedom {first} to {last} are none; correct them")
        return tuple(degree - 1 for degree in (1, 2, 3) if first <= degree <= last), value


def _without_clashes(moved: dict[tuple[int, float], str]) -> list[dict[tuple[int, float], str]]:
    """(direction, displacement) -> origin, in one group unless a direction has two displacements."""
    if len({direction for direction, _ in moved}) == len(moved):
        return [dict(sorted(moved.items()))]
    return [{key: origin} for key, origin in moved.items()]


def _distinct(rows: Ints, values: Floats) -> Iterator[tuple[Ints, Floats]]:
    """Distinct rows, ascending, with their values; rows with a second value follow as a separate pair."""
    order = np.lexsort((values, rows))
    rows, values = rows[order], values[order]
    while len(rows):
        first = np.append(True, np.diff(rows) != 0)
        yield rows[first], values[first]
        # Repetitions of the same value are dropped.
        rest = ~first & np.append(False, np.diff(values) != 0)
        rows, values = rows[rest], values[rest]
