"""What an Abaqus deck defines, in its place: instances, sets by name, surfaces, sections and boundary conditions."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled.errors import InputError
from mpitled.mesh import Constraint
from mpitled.readers import meshfile
from mpitled.readers.inp import Keyword
from mpitled.readers.meshfile import Cells, FileMaterial, MeshFile, Numbering

#: Degrees of freedom by name.
_SYMBOLIC = {
    "ENCASTRE": (1, 2, 3), "PINNED": (1, 2, 3), "XSYMM": (1,), "YSYMM": (2,), "ZSYMM": (3,),
    "XASYMM": (2, 3), "YASYMM": (1, 3), "ZASYMM": (1, 2), "NOWARP": (), "NOOVAL": (), "NODEFORM": (),
}  # fmt: skip


@dataclass(slots=True)
class Entry:
    """What a line or a keyword adds to a set: numbers, a range (first, last, step), or another set."""

    kind: str  # "labels", "range", "set", or "cells": the nodes of an element set
    value: Any
    instance: str | None
    origin: str


@dataclass(slots=True)
class Set:
    """A set of nodes or elements as the deck gives it, bit by bit."""

    name: str  # as first written
    entries: list[Entry] = field(default_factory=list)


@dataclass(slots=True)
class Scope:
    """What a part, an instance or the rest of the deck defines. Names are looked up without regard to case."""

    name: str = ""
    ids: list[NDArray[np.int64]] = field(default_factory=list)
    points: list[NDArray[np.float64]] = field(default_factory=list)
    node_origins: list[tuple[int, str]] = field(default_factory=list)  # first row of each block, and where it is
    cells: list[Cells] = field(default_factory=list)  # with the file's numbers as nodes
    sets: dict[str, dict[str, Set]] = field(default_factory=lambda: {"node": {}, "cell": {}})
    surfaces: dict[str, tuple[str, list[tuple[str, list[str]]]]] = field(default_factory=dict)
    sections: list[tuple[str, str, str]] = field(default_factory=list)  # set, material or "", origin

    def add(self, kind: str, name: str, entry: Entry) -> None:
        self.sets[kind].setdefault(name.casefold(), Set(name)).entries.append(entry)

    def copy_from(self, part: Scope) -> None:
        """Take over what the part defines."""
        self.ids += part.ids
        self.points += part.points
        self.node_origins += part.node_origins
        self.cells += part.cells
        for kind in ("node", "cell"):
            for key, members in part.sets[kind].items():
                self.sets[kind][key] = Set(members.name, list(members.entries))
        self.surfaces |= part.surfaces
        self.sections += part.sections


@dataclass(slots=True)
class Placed:
    """A scope in its place in the model: where its nodes and elements start, and their numbers."""

    scope: Scope
    node_offset: int
    cell_offset: int
    nodes: Numbering
    cells: Numbering
    node_ids: NDArray[np.int64]


@dataclass(slots=True)
class Material:
    """What the options under *MATERIAL say."""

    name: str
    origin: str
    elastic: tuple[float, float] | None = None
    density: float | None = None
    unusable: str = ""  # why, if another law is asked for


@dataclass(slots=True)
class Definitions:
    """All that the keywords of a deck define."""

    path: Path
    root: Scope = field(default_factory=Scope)
    parts: dict[str, Scope] = field(default_factory=dict)
    instances: dict[str, Scope] = field(default_factory=dict)
    assembly: str = ""  # its name
    unended: str = ""  # the part or instance that the text ends in
    materials: dict[str, Material] = field(default_factory=dict)
    boundaries: list[tuple[int, Keyword]] = field(default_factory=list)  # with the step that each is in, from 1
    remarks: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


class Model:
    """The parts in their places, and all names looked up."""

    def __init__(self, given: Definitions) -> None:
        self.given = given
        self.remarks = given.remarks
        self.placed: dict[str, Placed] = {}
        points, ids, cells = [np.empty((0, 3))], [np.empty(0, np.int64)], []
        n_nodes = n_cells = 0
        for part in given.parts.values():  # its instances have them
            part.cells.clear()
            part.points.clear()
        for key, scope in {"": given.root, **given.instances}.items():
            own_ids = np.concatenate([np.empty(0, np.int64), *scope.ids])
            own_points = np.concatenate([np.empty((0, 3)), *scope.points])
            scope.points.clear()
            own_ids, own_points, remarks = meshfile.without_repeats(own_ids, own_points, scope.node_origins)
            self.remarks += [f"{given.path}: {remark}" for remark in remarks]
            numbering = Numbering(own_ids)
            meshfile.check_unique_cells(scope.cells, range(len(scope.cells)))
            own_cells = np.concatenate([np.empty(0, np.int64), *(block.ids for block in scope.cells)])
            self.placed[key] = Placed(scope, n_nodes, n_cells, numbering, Numbering(own_cells), own_ids)
            for at, block in enumerate(scope.cells):
                cells.append(self._with_rows(block, numbering, n_nodes))
                scope.cells[at] = cells[-1]  # frees the numbers
            points.append(own_points)
            ids.append(own_ids)
            n_nodes, n_cells = n_nodes + len(own_ids), n_cells + len(own_cells)
        unused = {part.name: sum(map(len, part.ids)) for part in given.parts.values() if not self._instanced(part)}
        unused = {name: n_nodes for name, n_nodes in unused.items() if n_nodes}
        ends = f"the file ends within {given.unended}: is it cut short?" if given.unended else ""
        if unused and not n_nodes:
            name, n = next(iter(unused.items()))
            raise InputError(f"{given.path}: part {name}, which has {n} nodes, has no *INSTANCE; {ends or 'add one'}")
        if unused:
            self.remarks.append(
                f"warning: {given.path}: part {meshfile.listed(unused)} is in no *INSTANCE, so not there"
            )
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
        self.cell_starts = np.cumsum([0, *(len(block.ids) for block in cells)])
        self._found: dict[tuple[str, str, str], NDArray[np.int64]] = {}

    def _instanced(self, part: Scope) -> bool:
        return any(part.ids and part.ids[0] is ids for scope in self.given.instances.values() for ids in scope.ids)

    @staticmethod
    def _with_rows(block: Cells, numbering: Numbering, offset: int) -> Cells:
        """Elements with rows of the whole file's nodes in place of numbers. Unknown ones only matter to solids."""
        if block.kind != "other":
            nodes = meshfile.resolved(block.nodes, numbering, block.ids, block.origin)
            nodes += offset
        else:
            rows, found = numbering.rows(block.nodes)
            nodes = np.where(found, rows + offset, -1)
        return Cells(block.kind, block.type, block.ids, nodes, block.origin)

    def file(self) -> MeshFile:
        mesh = self.mesh
        names: dict[tuple[str, str, str], str] = {}  # place, kind, set -> name in the result
        for kind, sets in (("node", mesh.node_sets), ("cell", mesh.cell_sets)):
            all_names = [key for place in self.placed.values() for key in place.scope.sets[kind]]
            for key, place in self.placed.items():
                for wanted, members in place.scope.sets[kind].items():
                    alone = key == "" or all_names.count(wanted) == 1
                    name = members.name if alone else f"{place.scope.name}.{members.name}"
                    names[key, kind, wanted] = meshfile.add_set(sets, name, self._members(key, kind, wanted, ()))
        for key, place in self.placed.items():
            for name, (kind, rows) in place.scope.surfaces.items():
                alone = key == "" or sum(name in other.scope.surfaces for other in self.placed.values()) == 1
                shown = name if alone else f"{place.scope.name}.{name}"
                shown = f"{shown}_surface" if shown in mesh.node_sets else shown
                meshfile.add_set(mesh.node_sets, shown, self._surface(key, kind, rows))
            for name, material, origin in place.scope.sections:
                self._section(names, key, name, material, origin)
        self._constrain(names)
        return mesh

    # Sets

    def _members(self, key: str, kind: str, name: str, within: tuple[tuple[str, str, str], ...]) -> NDArray[np.int64]:
        """Rows of a set, ascending; `name` is one of the scope's."""
        at = key, kind, name
        if at not in self._found:
            found = [np.empty(0, np.int64)]
            if at in within:
                entry = self.placed[key].scope.sets[kind][name].entries[0]
                raise InputError(f"{entry.origin}: set {name} is a part of itself; break the circle")
            for entry in self.placed[key].scope.sets[kind][name].entries:
                found.append(self._entry(key, kind, name, entry, (*within, at)))
            self._found[at] = np.unique(np.concatenate(found))
        return self._found[at]

    def _entry(
        self, key: str, kind: str, name: str, entry: Entry, within: tuple[tuple[str, str, str], ...]
    ) -> NDArray[np.int64]:
        if entry.instance is not None:
            key = entry.instance.casefold()
            if key not in self.placed or not key:
                raise InputError(f"{entry.origin}: there is no instance {entry.instance}; correct it")
        if entry.kind == "set":
            return self._refer(key, kind, entry.value, entry.origin, within)
        if entry.kind == "cells":
            return self._nodes_of(self._refer(key, "cell", entry.value, entry.origin, within))
        numbering, offset = self._numbering(key, kind)
        if entry.kind == "range":
            return offset + numbering.between(*entry.value)
        rows, found = numbering.rows(entry.value)
        if not found.all():
            unknown = entry.value[~found]
            self.remarks.append(
                f"warning: {entry.origin}: set {name} has {len(unknown)} {_NOUN[kind]}s that are not there, "
                f"the first {unknown[0]}; they are left out"
            )
        return offset + rows[found]

    def _numbering(self, key: str, kind: str) -> tuple[Numbering, int]:
        place = self.placed[key]
        return (place.nodes, place.node_offset) if kind == "node" else (place.cells, place.cell_offset)

    def _refer(
        self, key: str, kind: str, text: str, origin: str, within: tuple[tuple[str, str, str], ...] = ()
    ) -> NDArray[np.int64]:
        """Rows of what data name: a number, a set, or one of an instance, as in Part-1-1.Set-1."""
        place, _ = self._locate(key, kind, text)
        if place is None:
            sets = sorted(members.name for members in self.placed[key].scope.sets[kind].values())
            known = meshfile.listed(sets) or "none"
            raise InputError(f"{origin}: there is no {_NOUN[kind]} set {text}; sets: {known}")
        key, name = place
        if isinstance(name, str):
            return self._members(key, kind, name, within)
        meshfile.checked_ids(np.array([name]), kind, origin)
        numbering, offset = self._numbering(key, kind)
        rows, found = numbering.rows(np.array([name]))
        if not found.all():
            raise InputError(f"{origin}: there is no {_NOUN[kind]} {text}; correct it")
        return offset + rows

    def _locate(self, key: str, kind: str, text: str) -> tuple[tuple[str, str | int] | None, str]:
        """Scope and set or number that a name stands for, and the name without instances."""
        if text.isascii() and text.isdecimal() and len(text) <= 20:
            return (key, int(text)), text
        text = text.strip().strip('"')
        wanted = text.casefold()
        if wanted in self.placed[key].scope.sets[kind]:
            return (key, wanted), text
        if key == "":
            for dot in (at for at, letter in enumerate(text) if letter == "."):
                instance, rest = text[:dot].strip().strip('"').casefold(), text[dot + 1 :]
                if instance in self.given.instances:
                    return self._locate(instance, kind, rest)
                if instance == self.given.assembly.casefold():
                    return self._locate("", kind, rest)
            owners = [other for other, place in self.placed.items() if wanted in place.scope.sets[kind]]
            if len(owners) == 1:
                return (owners[0], wanted), text
        return None, text

    def _nodes_of(self, cells: NDArray[np.int64], face: int | None = None) -> NDArray[np.int64]:
        """Nodes of elements, or of one face of each; ascending."""
        found = [np.empty(0, np.int64)]
        for start, block in zip(self.cell_starts, self.mesh.cells, strict=False):
            rows = cells[(cells >= start) & (cells < start + len(block.ids))] - start
            if len(rows):
                nodes = block.nodes[rows]
                if face is not None and block.kind in meshfile.FACES:
                    faces = meshfile.FACES[block.kind]
                    nodes = nodes[:, [corner for corner in faces[min(face, len(faces) - 1)] if corner >= 0]]
                found.append(np.unique(nodes))
        nodes = np.unique(np.concatenate(found))
        return nodes[nodes >= 0]

    def _surface(self, key: str, kind: str, rows: list[tuple[str, list[str]]]) -> NDArray[np.int64]:
        """Nodes of a surface: of nodes, of elements' faces, or of all exterior faces of elements."""
        found, exterior = [np.empty(0, np.int64)], None
        by_face: dict[int | None, list[NDArray[np.int64]]] = {}
        for origin, fields in rows:
            if not fields[0]:
                raise InputError(f"{origin}: a surface of the whole model is not read; name an element set")
            if kind == "NODE":
                found.append(self._refer(key, "node", fields[0], origin))
                continue
            name = fields[1].upper() if len(fields) > 1 else ""
            face = int(name[1:]) - 1 if re.fullmatch(r"S[1-6]", name) else None
            cells = self._refer(key, "cell", fields[0], origin)
            if name or not any(block.kind in meshfile.FACES for block in self.mesh.cells):
                by_face.setdefault(face, []).append(cells)
                continue
            if exterior is None:
                exterior = meshfile.exterior_faces(self.mesh.cells)
            found.append(np.unique(exterior[0][np.isin(exterior[1], cells)]))
        found += [self._nodes_of(np.unique(np.concatenate(cells)), face) for face, cells in by_face.items()]
        nodes = np.unique(np.concatenate(found))
        return nodes[nodes >= 0]

    # Sections and boundary conditions

    def _section(self, names: dict[tuple[str, str, str], str], key: str, name: str, material: str, origin: str) -> None:
        place, _ = self._locate(key, "cell", f'"{name}"')
        if place is None or not isinstance(place[1], str):
            self._refer(key, "cell", f'"{name}"', origin)
            raise InputError(f"{origin}: a section takes an element set, not {name!r}; correct it")
        published = names[place[0], "cell", place[1]]
        self.mesh.structural.add(published)
        if not material:
            return
        if material.casefold() not in self.given.materials:
            known = [found.name for found in self.given.materials.values()]
            raise InputError(
                f"{origin}: there is no material {material!r}; materials: {meshfile.listed(known) or 'none'}"
            )
        law = self.given.materials[material.casefold()]
        unusable = law.unusable
        if not unusable and law.elastic is None:
            unusable = "has no *ELASTIC"
        elif not unusable and law.elastic and not (law.elastic[0] > 0 and -1 < law.elastic[1] < 0.5):
            unusable = f"has E = {law.elastic[0]:g} and nu = {law.elastic[1]:g}"
        if unusable or law.elastic is None:
            self.remarks.append(
                f"warning: {law.origin}: material {law.name} {unusable}, so it is not taken; give {published} a "
                "[material] in the deck"
            )
            return
        taken = FileMaterial(law.name, *law.elastic, law.density, law.origin)
        self.mesh.materials.append((published, taken))

    def _constrain(self, names: dict[tuple[str, str, str], str]) -> None:
        """The boundary conditions at the end of the last step: later steps take nodes over from earlier ones."""
        constraints: list[tuple[int, Constraint, NDArray[np.int64]]] = []
        for step, keyword in self.given.boundaries:
            constraints += [(step, *found) for found in self._boundary(names, keyword)]
        claimed = np.zeros((len(self.mesh.points), 3), bool)
        last = max((step for step, _, _ in constraints), default=0)
        kept: list[Constraint] = []
        taken_over = False
        for step in range(last, -1, -1):
            of_step = [(constraint, nodes) for at, constraint, nodes in constraints if at == step]
            for constraint, nodes in of_step:
                free = ~claimed[nodes][:, constraint.directions]
                if free.all():
                    kept.append(constraint)
                    continue
                taken_over = True
                for i, direction in enumerate(constraint.directions):
                    if free[:, i].any():
                        rest = nodes[free[:, i]]
                        name = self.mesh.own_set(rest, f"{constraint.node_set} before step {last}")
                        values = constraint.displacement[i]
                        if isinstance(values, np.ndarray):
                            values = values[free[:, i]]
                        kept.append(Constraint(name, (direction,), (values,), constraint.origin))
            for constraint, nodes in of_step:
                claimed[nodes[:, None], constraint.directions] = True
        if taken_over:
            self.remarks.append(f"{self.mesh.path}: boundary conditions of several steps; those at the end count")
        self.mesh.constraints = kept

    def _boundary(
        self, names: dict[tuple[str, str, str], str], keyword: Keyword
    ) -> Iterator[tuple[Constraint, NDArray[np.int64]]]:
        """Constraints of one keyword with their nodes: one of each set, and one of all nodes that are held alike."""
        of_sets: dict[tuple[str, str | int], list[tuple[int, float, str]]] = {}
        of_nodes: dict[int, tuple[list[NDArray[np.int64]], list[float]]] = {}
        for origin, fields in keyword.rows():
            directions, value = self._degrees(origin, fields, keyword)
            if not directions:
                continue
            place, _ = self._locate("", "node", fields[0])
            if place is not None and isinstance(place[1], str):
                of_sets.setdefault(place, []).extend((direction, value, origin) for direction in directions)
                continue
            node = self._refer("", "node", fields[0], origin)
            for direction in directions:
                nodes, values = of_nodes.setdefault(direction, ([], []))
                nodes.append(node)
                values.append(value)
        for (key, name), moved in of_sets.items():
            published = names[key, "node", str(name)]
            nodes_of_set = self.mesh.node_sets[published]
            for group in _without_clashes({(direction, value): origin for direction, value, origin in moved}):
                axes, moves = zip(*group, strict=True)
                yield Constraint(published, axes, moves, group[axes[0], moves[0]]), nodes_of_set
        alike: dict[bytes, tuple[NDArray[np.int64], dict[int, Any]]] = {}
        for direction, (nodes, values) in of_nodes.items():
            for rows, at in _once(np.concatenate(nodes), np.array(values)):
                uniform: Any = float(at[0]) if (at == at[0]).all() else at
                alike.setdefault(rows.tobytes(), (rows, {}))[1].setdefault(direction, uniform)
        for rows, by_direction in alike.values():
            name = self.mesh.own_set(rows, f"{keyword.path.name}:{keyword.line}")
            axes, moves = zip(*sorted(by_direction.items()), strict=True)
            yield Constraint(name, axes, moves, keyword.origin), rows

    def _degrees(self, origin: str, fields: list[str], keyword: Keyword) -> tuple[tuple[int, ...], float]:
        """Directions (0, 1, 2) and displacement of a line of *BOUNDARY; rotations and temperatures are left out."""
        if len(fields) < 2 or not fields[1]:
            raise InputError(f"{origin}: {keyword.shown} needs a node or set, and degrees of freedom; correct it")
        word = "".join(fields[1].split()).upper()
        if word in _SYMBOLIC:
            return tuple(degree - 1 for degree in _SYMBOLIC[word]), 0.0
        if not word[:1].isdecimal():
            raise InputError(f"{origin}: {fields[1]!r} is no degree of freedom; there are {', '.join(_SYMBOLIC)}")
        first = meshfile.integer(fields[1], origin)
        last = meshfile.integer(fields[2], origin) if len(fields) > 2 and fields[2] else first
        value = meshfile.real(fields[3], origin) if len(fields) > 3 and fields[3] else 0.0
        if last < first:
            raise InputError(f"{origin}: degrees of freedom {first} to {last} are none; correct them")
        return tuple(degree - 1 for degree in (1, 2, 3) if first <= degree <= last), value


_NOUN = {"node": "node", "cell": "element"}


def _without_clashes(moved: dict[tuple[int, float], str]) -> list[dict[tuple[int, float], str]]:
    """(direction, displacement) -> origin, all in one unless a direction has two displacements."""
    if len({direction for direction, _ in moved}) == len(moved):
        return [dict(sorted(moved.items()))]
    return [{key: origin} for key, origin in moved.items()]


def _once(
    rows: NDArray[np.int64], values: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Rows, ascending, with their values, each row once; rows with another value follow, for the caller to find out."""
    order = np.lexsort((values, rows))
    rows, values = rows[order], values[order]
    while len(rows):
        first = np.append(True, np.diff(rows) != 0)
        yield rows[first], values[first]
        # Of what is left, a repetition of the same value says nothing new.
        rest = ~first & np.append(False, np.diff(values) != 0)
        rows, values = rows[rest], values[rest]
