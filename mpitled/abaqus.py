"""Abaqus decks (.inp), as Abaqus/CAE, HyperMesh, Cubit, gmsh and CalculiX write them.

Keywords that do not matter to an elastic solid with prescribed displacements are skipped and listed; those that
change its mechanics and cannot be computed are kept as `MeshFile.refused`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from mpitled import meshfile
from mpitled.errors import InputError
from mpitled.mesh import Constraint
from mpitled.meshfile import Block, Cells, FileMaterial, MeshFile, Numbering, decoded, where

COMMENT = "**"
WHAT = "an Abaqus deck (.inp)"
MOST_INCLUDES = 1000

_SOLID = re.compile(r"C3D(\d+)[A-Z]*")
#: Nodes in a row, and the kind of solid that its first nodes are; None where only the first nodes would be too few.
_SOLIDS: dict[int, tuple[str, ...]] = {
    4: ("tetrahedron",), 5: ("pyramid",), 6: ("wedge",), 8: ("hexahedron",), 10: ("tetrahedron",),
    15: (), 20: (), 27: (),
}  # fmt: skip

#: Degrees of freedom by name.
_SYMBOLIC = {
    "ENCASTRE": (1, 2, 3), "PINNED": (1, 2, 3), "XSYMM": (1,), "YSYMM": (2,), "ZSYMM": (3,),
    "XASYMM": (2, 3), "YASYMM": (1, 3), "ZASYMM": (1, 2), "NOWARP": (), "NOOVAL": (), "NODEFORM": (),
}  # fmt: skip

#: Keywords, without blanks, that tie, load or move parts in ways that are not computed; what begins with CONTACT too.
_REFUSED = {
    "TIE", "MPC", "EQUATION", "COUPLING", "KINEMATICCOUPLING", "DISTRIBUTINGCOUPLING", "RIGIDBODY", "EMBEDDEDELEMENT",
    "SHELLTOSOLIDCOUPLING", "TRANSFORM", "SPRING", "DASHPOT", "MASS", "ROTARYINERTIA", "CONNECTORSECTION",
    "MODELCHANGE", "SUBMODEL", "CYCLICSYMMETRYMODEL", "FASTENER", "PRE-TENSIONSECTION", "GAP", "JOINT", "RELEASE",
    "IMPERFECTION", "USERELEMENT", "MATRIXASSEMBLE", "BASEMOTION",
}  # fmt: skip
#: Keywords that make nodes or elements out of others.
_GENERATING = {
    "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYMMETRICMODELGENERATION", "IMPORT", "SUBSTRUCTUREPROPERTY",
}  # fmt: skip
#: Keywords of loads that are left out with a warning.
_LOADS = {
    "CLOAD", "DLOAD", "DSLOAD", "TEMPERATURE", "INITIALCONDITIONS", "FOUNDATION", "INERTIARELIEF", "CFLUX", "DFLUX",
}  # fmt: skip
#: Material options of other solids than elastic or neo-Hookean ones.
_INELASTIC = {
    "PLASTIC", "VISCOELASTIC", "HYPERFOAM", "MOHRCOULOMB", "DRUCKERPRAGER", "CREEP", "USERMATERIAL", "CONCRETE",
    "HYPOELASTIC", "CLAYPLASTICITY", "CAPPLASTICITY", "CRUSHABLEFOAM", "DAMAGEINITIATION", "POROUSELASTIC",
    "ANISOTROPICHYPERELASTIC", "EOS", "MULLINSEFFECT", "BRITTLECRACKING", "JOINTEDMATERIAL", "DEFORMATIONPLASTICITY",
    "LOWDENSITYFOAM", "CASTIRONPLASTICITY", "SUPERELASTIC", "ACOUSTICMEDIUM", "CONCRETEDAMAGEDPLASTICITY",
}  # fmt: skip


@dataclass(slots=True)
class _Keyword:
    name: str  # in capitals, without blanks
    shown: str  # with its asterisk, as messages have it
    parameters: dict[str, str]  # names in capitals, without blanks
    path: Path
    line: int
    data: list[Block] = field(default_factory=list)

    @property
    def origin(self) -> str:
        return where(self.path, self.line)

    def flag(self, name: str) -> bool:
        return name in self.parameters

    def need(self, name: str) -> str:
        if not self.parameters.get(name):
            self.fail(f"has no {name}=; give it")
        return self.parameters[name]

    def fail(self, what: str) -> NoReturn:
        raise InputError(f"{self.origin}: {self.shown} {what}")

    def rows(self) -> Iterator[tuple[str, list[str]]]:
        """Origin and fields of each line of data; a comma at the end of the line makes no field."""
        for block in self.data:
            for line, text in block.lines(COMMENT):
                yield where(block.path, line), _fields(text.removesuffix(","))

    def numbers(self, most: int) -> list[tuple[str, list[float]]]:
        """The first `most` lines of data as numbers; an empty field is 0."""
        found = []
        for origin, fields in self.rows():
            found.append((origin, [meshfile.real(entry, origin) if entry else 0.0 for entry in fields]))
            if len(found) == most:
                break
        return found


@dataclass(slots=True)
class _Entry:
    """What a line or a keyword adds to a set: numbers, a range (first, last, step), or another set."""

    kind: str  # "labels", "range", "set", or "cells": the nodes of an element set
    value: Any
    instance: str | None
    origin: str


@dataclass(slots=True)
class _Set:
    name: str  # as first written
    entries: list[_Entry] = field(default_factory=list)


@dataclass(slots=True)
class _Scope:
    """What a part, an instance or the rest of the deck defines. Names are looked up without regard to case."""

    name: str = ""
    ids: list[NDArray[np.int64]] = field(default_factory=list)
    points: list[NDArray[np.float64]] = field(default_factory=list)
    node_origins: list[tuple[int, str]] = field(default_factory=list)  # first row of each block, and where it is
    cells: list[Cells] = field(default_factory=list)  # with the file's numbers as nodes
    sets: dict[str, dict[str, _Set]] = field(default_factory=lambda: {"node": {}, "cell": {}})
    surfaces: dict[str, tuple[str, list[tuple[str, list[str]]]]] = field(default_factory=dict)
    sections: list[tuple[str, str, str]] = field(default_factory=list)  # set, material or "", origin

    def add(self, kind: str, name: str, entry: _Entry) -> None:
        self.sets[kind].setdefault(name.casefold(), _Set(name)).entries.append(entry)

    def copy_from(self, part: _Scope) -> None:
        """Take over what the part defines."""
        self.ids += part.ids
        self.points += part.points
        self.node_origins += part.node_origins
        self.cells += part.cells
        for kind in ("node", "cell"):
            for key, members in part.sets[kind].items():
                self.sets[kind][key] = _Set(members.name, list(members.entries))
        self.surfaces |= part.surfaces
        self.sections += part.sections


@dataclass(slots=True)
class _Placed:
    """A scope in its place in the model: where its nodes and elements start, and their numbers."""

    scope: _Scope
    node_offset: int
    cell_offset: int
    nodes: Numbering
    cells: Numbering
    node_ids: NDArray[np.int64]


def read(path: Path) -> MeshFile:
    """The mesh of an Abaqus deck. InputError, with file and line, for all that is wrong with it."""
    return _Reader(path).read()


def files(path: Path) -> list[Path]:
    """The deck and all files that it includes."""
    found: list[_Keyword] = []
    opened: list[Path] = []
    _collect(path, path.parent, found, (), opened)
    return opened


def is_solid(type_name: str) -> bool:
    """Whether an element of this type is a solid, even one that cannot be computed."""
    return bool(_SOLID.fullmatch(type_name.upper()))


# --- text ----------------------------------------------------------------------------------------------------------


def _collect(path: Path, home: Path, found: list[_Keyword], within: tuple[Path, ...], opened: list[Path]) -> None:
    """Append the keywords of a file and of those that it includes, in the order of the text."""
    text = meshfile.read_text(path, WHAT)
    opened.append(path)
    within = (*within, path.resolve())
    line, at = 1, 0  # the first line that is not dealt with
    for begin in _keyword_lines(text):
        if not found and text[at:begin].strip() and _data_line(text[at:begin]):
            raise InputError(f"{where(path, 1)}: is not an Abaqus deck; it has data before the first keyword")
        _add_data(found, path, line, text, at, begin)
        line += text.count(b"\n", at, begin)
        keyword, end = _keyword(path, line, text, begin)
        if keyword.name == "INCLUDE":
            included = _included(keyword, keyword.need("INPUT"), home, within, opened)
            _collect(included, home, found, within, opened)
        else:
            found.append(keyword)
            if keyword.name in ("NODE", "ELEMENT", "NSET", "ELSET", "SURFACE") and keyword.flag("INPUT"):
                named = _included(keyword, keyword.need("INPUT"), home, within, opened)
                opened.append(named)
                data = meshfile.read_text(named, WHAT)
                keyword.data.append(Block(named, 1, data, 0, len(data)))
        line += text.count(b"\n", begin, end)
        at = end
    if not found:
        first = next((decoded(raw).strip() for raw in text.split(b"\n", 100) if raw.strip()), "")
        raise InputError(
            f"{path}: is not an Abaqus deck; no line is a keyword such as *NODE (it begins {first[:40]!r})"
        )
    _add_data(found, path, line, text, at, len(text))


def _keyword_lines(text: bytes) -> Iterator[int]:
    """Where lines begin whose first character is one asterisk, not two."""
    at = text.find(b"*")
    while at >= 0:
        begin = text.rfind(b"\n", 0, at) + 1
        if text[at + 1 : at + 2] != b"*" and not text[begin:at].strip():
            yield begin
        end = text.find(b"\n", at)
        at = text.find(b"*", end) if end >= 0 else -1


def _data_line(text: bytes) -> bool:
    return any(line.strip() and not line.lstrip().startswith(COMMENT.encode()) for line in text.split(b"\n"))


def _add_data(found: list[_Keyword], path: Path, line: int, text: bytes, start: int, stop: int) -> None:
    if found and start < stop:
        found[-1].data.append(Block(path, line, text, start, stop))


def _keyword(path: Path, line: int, text: bytes, begin: int) -> tuple[_Keyword, int]:
    """The keyword whose line begins there, and where its data begin. A comma at the end continues it."""
    end = text.find(b"\n", begin) + 1 or len(text)
    words = decoded(text[begin:end]).strip()
    while words.endswith(","):
        after = text.find(b"\n", end) + 1 or len(text)
        following = decoded(text[end:after]).strip()
        if following.startswith(COMMENT):
            end = after
            continue
        if not re.match(r"[A-Za-z]", following):
            break
        words, end = words + following, after
    name, *fields = _fields(words)
    parameters = {}
    for entry in fields:
        key, _, value = entry.partition("=")
        parameters["".join(key.split()).upper()] = value.strip().strip('"').strip()
    shown = " ".join(name.split())
    return _Keyword("".join(name[1:].split()).upper(), shown, parameters, path, line), end


def _fields(text: str) -> list[str]:
    """Fields between commas, those in quotation marks apart, without blanks around them."""
    if '"' not in text:
        return [entry.strip() for entry in text.split(",")]
    found, start, quoted = [], 0, False
    for at, letter in enumerate(text):
        if letter == '"':
            quoted = not quoted
        elif letter == "," and not quoted:
            found.append(text[start:at].strip())
            start = at + 1
    return [*found, text[start:].strip()]


def _included(keyword: _Keyword, name: str, home: Path, within: tuple[Path, ...], opened: list[Path]) -> Path:
    """The file that a keyword names: beside the file that names it, or beside the deck."""
    if len(opened) > MOST_INCLUDES:
        keyword.fail(f"is one of more than {MOST_INCLUDES} files; join some")
    name = name.replace("\\", "/")
    try:
        for folder in (keyword.path.parent, home):
            if (folder / name).is_file():
                if (folder / name).resolve() in within:
                    keyword.fail(f"names {name}, which includes this file; break the circle")
                return folder / name
    except (OSError, ValueError):
        pass
    keyword.fail(f"names {name}, and there is no such file beside {keyword.path.name}; put it there")


# --- keywords ------------------------------------------------------------------------------------------------------


class _Reader:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.keywords: list[_Keyword] = []
        _collect(path, path.parent, self.keywords, (), [])
        self.root = _Scope()
        self.scope = self.root
        self.parts: dict[str, _Scope] = {}
        self.instances: dict[str, _Scope] = {}
        self.assembly = ""
        self.system: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None  # rotation, origin
        self.materials: dict[str, _Material] = {}
        self.material: _Material | None = None
        self.step = 0
        self.boundaries: list[tuple[int, _Keyword]] = []
        self.skipped: dict[str, None] = {}
        self.remarks: list[str] = []
        self.refused: list[str] = []

    def read(self) -> MeshFile:
        for keyword in self.keywords:
            self._take(keyword)
            if keyword.name in ("NODE", "ELEMENT"):
                keyword.data.clear()  # the text is not needed any more
        if self.skipped:
            self.remarks.append(f"{self.path}: skipped {meshfile.listed(self.skipped, 40)}")
        model = _Model(self)
        self.keywords.clear()
        return model.file()

    def _take(self, keyword: _Keyword) -> None:
        name = keyword.name
        handler = getattr(self, f"_{name.lower()}", None) if name in _HANDLED else None
        if handler:
            handler(keyword)
        elif name in _REFUSED or name.startswith(("CONTACT", "CONNECTOR")):
            self.refused.append(f"{keyword.origin}: {keyword.shown} changes the mechanics and cannot be computed")
        elif name in _GENERATING:
            keyword.fail("makes nodes or elements out of others; let the preprocessor write them out")
        elif name in _LOADS:
            self.remarks.append(f"warning: {keyword.origin}: {keyword.shown} is not applied; only displacements are")
        elif name in _INELASTIC:
            if self.material:
                self.material.unusable = self.material.unusable or f"has {keyword.shown} ({keyword.origin})"
        elif name.endswith("SECTION") and keyword.parameters.get("ELSET"):
            self.scope.sections.append((keyword.parameters["ELSET"], "", keyword.origin))
        else:
            self.skipped[keyword.shown.upper()] = None

    # Parts and instances

    def _part(self, keyword: _Keyword) -> None:
        self.scope = self.parts[keyword.need("NAME").casefold()] = _Scope(keyword.need("NAME"))

    def _endpart(self, keyword: _Keyword) -> None:
        self.scope, self.system = self.root, None

    def _assembly(self, keyword: _Keyword) -> None:
        self.scope, self.assembly = self.root, keyword.parameters.get("NAME", "")

    def _endassembly(self, keyword: _Keyword) -> None:
        self.scope = self.root

    def _instance(self, keyword: _Keyword) -> None:
        if keyword.flag("LIBRARY"):
            keyword.fail("takes its part from a library; write the part into the deck")
        part, name = keyword.need("PART"), keyword.need("NAME")
        if part.casefold() not in self.parts:
            keyword.fail(f"names part {part}, which the deck does not define")
        if name.casefold() in self.instances:
            keyword.fail(f"is a second one of the name {name}; rename one")
        self.scope = self.instances[name.casefold()] = _Scope(name)
        self.scope.copy_from(self.parts[part.casefold()])
        rows = keyword.numbers(2)
        keyword.data.clear()
        self.scope.points = [_moved(points, rows) for points in self.scope.points]

    def _endinstance(self, keyword: _Keyword) -> None:
        self.scope, self.system = self.root, None

    # Nodes, elements and sets

    def _system(self, keyword: _Keyword) -> None:
        rows = keyword.numbers(2)
        values = np.zeros(9)
        given = [value for _, row in rows for value in row][:9]
        values[: len(given)] = given
        origin, along, beside = values.reshape(3, 3)
        if not given:
            self.system = None
        elif len(given) <= 3:
            self.system = np.eye(3), origin
        else:
            first = along - origin
            third = np.cross(first, beside - origin) if len(given) > 6 else np.cross(first, [-first[1], first[0], 0])
            if not (first.any() and third.any()):
                keyword.fail("has its points in one line; correct them")
            first, third = first / np.linalg.norm(first), third / np.linalg.norm(third)
            self.system = np.stack([first, np.cross(third, first), third]), origin

    def _node(self, keyword: _Keyword) -> None:
        tables = []
        for block in keyword.data:
            values, counts = meshfile.separated(block, float, COMMENT.encode(), blank=0.0)
            tables.append(meshfile.table(values, counts, 4))
        rows = np.concatenate(tables) if tables else np.empty((0, 4))
        ids = meshfile.as_ids(rows[:, 0], "node", keyword.origin)
        points = _cartesian(rows[:, 1:], keyword)
        if self.system:
            points = points @ self.system[0] + self.system[1]
        scope = self.scope
        scope.node_origins.append((sum(map(len, scope.ids)), keyword.origin))
        scope.ids.append(ids)
        scope.points.append(points)
        if name := keyword.parameters.get("NSET"):
            scope.add("node", name, _Entry("labels", ids, None, keyword.origin))

    def _element(self, keyword: _Keyword) -> None:
        kind_name = keyword.need("TYPE")
        parts = [meshfile.separated(block, int, COMMENT.encode()) for block in keyword.data]
        values = np.concatenate([np.empty(0, np.int64), *(part[0] for part in parts)])
        counts = np.concatenate([np.empty(0, np.int64), *(part[1] for part in parts)])
        del parts
        match = _SOLID.fullmatch(kind_name.upper())
        n_nodes = int(match[1]) if match else 0
        if n_nodes in _SOLIDS:
            rows = _regular(values, counts, n_nodes + 1, keyword)
            kind = (*_SOLIDS[n_nodes], "other")[0]
            nodes = rows[:, 1 : 1 + meshfile.SOLIDS.get(kind, n_nodes)]
            if kind == "other" and len(rows):
                self.refused.append(
                    f"{keyword.origin}: {len(rows)} elements of type {kind_name}, with nodes between the corners, "
                    "cannot be computed; mesh with C3D8"
                )
        else:
            kind = "other"
            rows = meshfile.table(values, counts, int(counts.max(initial=1)), -1)
            nodes = rows[:, 1:]
        ids = meshfile.checked_ids(rows[:, 0], "element", keyword.origin).copy()
        self.scope.cells.append(Cells(kind, kind_name, ids, nodes, keyword.origin))
        if name := keyword.parameters.get("ELSET"):
            self.scope.add("cell", name, _Entry("labels", ids, None, keyword.origin))

    def _nset(self, keyword: _Keyword) -> None:
        self._any_set(keyword, "node", keyword.need("NSET"))
        if other := keyword.parameters.get("ELSET"):
            self.scope.add("node", keyword.need("NSET"), _Entry("cells", f'"{other}"', None, keyword.origin))

    def _elset(self, keyword: _Keyword) -> None:
        self._any_set(keyword, "cell", keyword.need("ELSET"))

    def _any_set(self, keyword: _Keyword, kind: str, name: str) -> None:
        instance = keyword.parameters.get("INSTANCE")
        self.scope.sets[kind].setdefault(name.casefold(), _Set(name))
        if keyword.flag("GENERATE"):
            for origin, fields in keyword.rows():
                first, last, step = (meshfile.integer(entry or "1", origin) for entry in [*fields, "", "", ""][:3])
                last = last if len(fields) > 1 else first
                if step < 1 or last < first:
                    raise InputError(f"{origin}: {first}, {last}, {step} is no range; give first, last, increment")
                meshfile.checked_ids(np.array([first, last]), kind, origin)
                self.scope.add(kind, name, _Entry("range", (first, last, step), instance, origin))
            return
        for block in keyword.data:
            for line, chunk in block.chunks():
                found = meshfile.numbers_at_once(chunk, int, COMMENT.encode())
                if found:
                    self.scope.add(kind, name, _Entry("labels", found[0], instance, keyword.origin))
                    continue
                part = Block(block.path, line, chunk, 0, len(chunk))
                for at, text in part.lines(COMMENT):
                    origin = where(block.path, at)
                    for entry in filter(None, _fields(text)):
                        if entry.isdecimal():
                            labels = np.array([meshfile.integer(entry, origin)])
                            meshfile.checked_ids(labels, kind, origin)
                            self.scope.add(kind, name, _Entry("labels", labels, instance, origin))
                        else:
                            self.scope.add(kind, name, _Entry("set", entry, instance, origin))

    def _surface(self, keyword: _Keyword) -> None:
        kind = keyword.parameters.get("TYPE", "ELEMENT").upper()
        if kind in ("ELEMENT", "NODE"):
            self.scope.surfaces[keyword.need("NAME")] = kind, list(keyword.rows())
        else:
            self.skipped[f"{keyword.shown.upper()}, TYPE={kind}"] = None

    # Materials and sections

    def _material(self, keyword: _Keyword) -> None:
        name = keyword.need("NAME")
        self.material = self.materials[name.casefold()] = _Material(name, keyword.origin)

    def _elastic(self, keyword: _Keyword) -> None:
        if not self.material:
            keyword.fail("belongs to no *MATERIAL; put that above it")
        if keyword.parameters.get("TYPE", "ISOTROPIC")[:3].upper() != "ISO":
            self.material.unusable = f"has {keyword.shown}, TYPE={keyword.parameters['TYPE']} ({keyword.origin})"
            return
        rows = keyword.numbers(2)
        if not rows:
            keyword.fail("has no line with Young's modulus and Poisson's ratio")
        if len(rows) > 1:
            self.remarks.append(f"warning: {keyword.origin}: only the first row of {keyword.shown} is taken")
        self.material.elastic = rows[0][1][0], (*rows[0][1], 0.0)[1]

    def _hyperelastic(self, keyword: _Keyword) -> None:
        if not self.material:
            keyword.fail("belongs to no *MATERIAL; put that above it")
        if not keyword.flag("NEOHOOKE") or keyword.flag("TESTDATAINPUT"):
            self.material.unusable = f"has {keyword.shown} other than NEO HOOKE with constants ({keyword.origin})"
            return
        rows = keyword.numbers(1)
        c10, d1 = ([*rows[0][1], 0.0, 0.0] if rows else [0.0, 0.0])[:2]
        if c10 <= 0 or d1 <= 0:
            what = "incompressible, D1 = 0" if c10 > 0 and d1 == 0 else f"C10 = {c10:g}, D1 = {d1:g}"
            self.material.unusable = f"is {what} ({keyword.origin})"
            return
        mu, bulk = 2 * c10, 2 / d1
        self.material.elastic = 9 * bulk * mu / (3 * bulk + mu), (3 * bulk - 2 * mu) / (6 * bulk + 2 * mu)
        self.remarks.append(
            f"{keyword.origin}: material {self.material.name} has E = {self.material.elastic[0]:.6g} and nu = "
            f"{self.material.elastic[1]:.6g} from C10 and D1, by mu = 2 C10 and K = 2/D1 at small strain"
        )

    def _density(self, keyword: _Keyword) -> None:
        rows = keyword.numbers(1)
        if self.material and rows:
            self.material.density = rows[0][1][0]

    def _solidsection(self, keyword: _Keyword) -> None:
        material = keyword.need("MATERIAL")
        self.scope.sections.append((keyword.need("ELSET"), material, keyword.origin))

    # Steps

    def _step(self, keyword: _Keyword) -> None:
        self.step += 1
        self.material = None

    def _boundary(self, keyword: _Keyword) -> None:
        kind = keyword.parameters.get("TYPE", "DISPLACEMENT").upper()
        if kind != "DISPLACEMENT" or keyword.flag("USER") or keyword.flag("SUBMODEL"):
            self.refused.append(
                f"{keyword.origin}: {keyword.shown} prescribes by {'TYPE=' + kind if keyword.flag('TYPE') else 'USER'}"
                "; only displacements can be prescribed"
            )
            return
        if keyword.parameters.get("OP", "").upper() == "NEW":
            self.boundaries = [(step, earlier) for step, earlier in self.boundaries if step == self.step]
        if amplitude := keyword.parameters.get("AMPLITUDE"):
            self.remarks.append(f"{keyword.origin}: amplitude {amplitude} is replaced by the loading curve")
        self.boundaries.append((self.step, keyword))


_HANDLED = {
    "PART", "ENDPART", "ASSEMBLY", "ENDASSEMBLY", "INSTANCE", "ENDINSTANCE", "SYSTEM", "NODE", "ELEMENT", "NSET",
    "ELSET", "SURFACE", "MATERIAL", "ELASTIC", "HYPERELASTIC", "DENSITY", "SOLIDSECTION", "STEP", "BOUNDARY",
}  # fmt: skip


@dataclass(slots=True)
class _Material:
    name: str
    origin: str
    elastic: tuple[float, float] | None = None
    density: float | None = None
    unusable: str = ""  # why, if another law is asked for


def _moved(points: NDArray[np.float64], rows: list[tuple[str, list[float]]]) -> NDArray[np.float64]:
    """Points of an instance: translated by its first line of data, then turned about an axis by its second."""
    if rows:
        points = points + np.array([*rows[0][1], 0.0, 0.0, 0.0])[:3]
    if len(rows) > 1:
        origin, values = rows[1]
        axis = np.array(values[3:6]) - np.array(values[:3]) if len(values) == 7 else np.zeros(3)
        if not axis.any():
            raise InputError(f"{origin}: a rotation has two points of its axis and an angle; correct it")
        x, y, z = axis / np.linalg.norm(axis)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angle = np.radians(values[6])
        turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        points = (points - values[:3]) @ turn.T + values[:3]
    return points


def _cartesian(points: NDArray[np.float64], keyword: _Keyword) -> NDArray[np.float64]:
    """Points of *NODE, SYSTEM=R, C (r, theta, z) or S (r, theta, phi; latitude), angles in degrees."""
    system = keyword.parameters.get("SYSTEM", "R").upper()
    if system == "R":
        return points
    r, theta, last = points.T
    theta = np.radians(theta)
    if system == "C":
        return np.stack([r * np.cos(theta), r * np.sin(theta), last], axis=1)
    if system == "S":
        phi = np.radians(last)
        return r[:, None] * np.stack([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], axis=1)
    keyword.fail(f"has SYSTEM={system}; there are R, C and S")


def _regular(values: NDArray[np.int64], counts: NDArray[np.int64], width: int, keyword: _Keyword) -> NDArray[np.int64]:
    """Rows (n, width) of elements, each on one or more lines of its own."""
    ends = np.cumsum(counts)
    at_end = ends % width == 0
    if len(values) % width or np.count_nonzero(at_end) * width != len(values):
        row_ends = np.arange(width, len(values) + width, width)
        bad = int(np.argmax(~np.isin(row_ends, ends)))
        keyword.fail(
            f"has rows that are not {width} numbers, an element and its {width - 1} nodes; "
            f"the first is that of element {values[bad * width]}"
        )
    return values.reshape(-1, width)


def _without_clashes(moved: dict[tuple[int, float], str]) -> list[dict[tuple[int, float], str]]:
    """(direction, displacement) -> origin, all in one unless a direction has two displacements."""
    if len({direction for direction, _ in moved}) == len(moved):
        return [moved]
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


# --- the model -----------------------------------------------------------------------------------------------------


class _Model:
    """The parts in their places, and all names looked up."""

    def __init__(self, reader: _Reader) -> None:
        self.reader = reader
        self.remarks = reader.remarks
        self.placed: dict[str, _Placed] = {}
        points, ids, cells = [np.empty((0, 3))], [np.empty(0, np.int64)], []
        n_nodes = n_cells = 0
        for part in reader.parts.values():  # its instances have them
            part.cells.clear()
            part.points.clear()
        for key, scope in {"": reader.root, **reader.instances}.items():
            own_ids = np.concatenate([np.empty(0, np.int64), *scope.ids])
            own_points = np.concatenate([np.empty((0, 3)), *scope.points])
            scope.points.clear()
            own_ids, own_points, remarks = meshfile.without_repeats(own_ids, own_points, scope.node_origins)
            self.remarks += [f"{reader.path}: {remark}" for remark in remarks]
            numbering = Numbering(own_ids)
            meshfile.check_unique_cells(scope.cells, range(len(scope.cells)))
            own_cells = np.concatenate([np.empty(0, np.int64), *(block.ids for block in scope.cells)])
            self.placed[key] = _Placed(scope, n_nodes, n_cells, numbering, Numbering(own_cells), own_ids)
            for at, block in enumerate(scope.cells):
                cells.append(self._with_rows(block, numbering, n_nodes))
                scope.cells[at] = cells[-1]  # frees the numbers
            points.append(own_points)
            ids.append(own_ids)
            n_nodes, n_cells = n_nodes + len(own_ids), n_cells + len(own_cells)
        unused = [part.name for key, part in reader.parts.items() if part.ids and not self._instanced(part)]
        if unused:
            self.remarks.append(
                f"warning: {reader.path}: part {meshfile.listed(unused)} is in no *INSTANCE, so not there"
            )
        self.mesh = MeshFile(
            path=reader.path,
            format="Abaqus",
            points=np.concatenate(points),
            node_ids=np.concatenate(ids),
            cells=cells,
            remarks=self.remarks,
            refused=reader.refused,
        )
        self.cell_starts = np.cumsum([0, *(len(block.ids) for block in cells)])
        self._found: dict[tuple[str, str, str], NDArray[np.int64]] = {}

    def _instanced(self, part: _Scope) -> bool:
        return any(part.ids[0] is ids for scope in self.reader.instances.values() for ids in scope.ids)

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
        self, key: str, kind: str, name: str, entry: _Entry, within: tuple[tuple[str, str, str], ...]
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
                if instance in self.reader.instances:
                    return self._locate(instance, kind, rest)
                if instance == self.reader.assembly.casefold():
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
        if material.casefold() not in self.reader.materials:
            known = [found.name for found in self.reader.materials.values()]
            raise InputError(
                f"{origin}: there is no material {material!r}; materials: {meshfile.listed(known) or 'none'}"
            )
        law = self.reader.materials[material.casefold()]
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
        if len({step for step, _ in self.reader.boundaries}) > 1:
            self.remarks.append(f"{self.mesh.path}: boundary conditions of several steps; those at the end count")
        constraints: list[tuple[int, Constraint, NDArray[np.int64]]] = []
        for step, keyword in self.reader.boundaries:
            constraints += [(step, *found) for found in self._boundary(names, keyword)]
        claimed = np.zeros((len(self.mesh.points), 3), bool)
        last = max((step for step, _, _ in constraints), default=0)
        kept: list[Constraint] = []
        for step in range(last, -1, -1):
            of_step = [(constraint, nodes) for at, constraint, nodes in constraints if at == step]
            for constraint, nodes in of_step:
                free = ~claimed[nodes][:, constraint.directions]
                if free.all():
                    kept.append(constraint)
                    continue
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
        self.mesh.constraints = kept

    def _boundary(
        self, names: dict[tuple[str, str, str], str], keyword: _Keyword
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
            yield Constraint(name, tuple(by_direction), tuple(by_direction.values()), keyword.origin), rows

    def _degrees(self, origin: str, fields: list[str], keyword: _Keyword) -> tuple[tuple[int, ...], float]:
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
