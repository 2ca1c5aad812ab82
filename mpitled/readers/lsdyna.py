"""LS-DYNA decks (.k), in fixed columns (also long and I10) and with commas, as LS-PrePost and HyperMesh write them.

Keywords without influence on an elastic solid with prescribed displacements are skipped and listed in a remark.
Keywords that change the mechanics and cannot be computed are entered in `MeshFile.refused`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mpitled.errors import InputError
from mpitled.mesh import Constraint, Ints
from mpitled.readers import meshfile, text
from mpitled.readers.meshfile import Cells, FileMaterial, MeshFile, NodeTable, Numbering
from mpitled.readers.text import Block, KeywordLine, decode, where

COMMENT = "$"
_KIND = "an LS-DYNA deck (.k)"

#: Columns of a card of eight fields, of *NODE and of *ELEMENT_SOLID, by the format of the deck.
_CARD = {"standard": [10] * 8, "i10": [10] * 8, "long": [20] * 8}
_NODE = {"standard": [8, 16, 16, 16, 8, 8], "i10": [10, 16, 16, 16, 10, 10], "long": [20] * 6}
_SOLID = {"standard": [8] * 10, "i10": [10] * 10, "long": [20] * 10}
_FORMAT = {"+": "long", "-": "standard", "%": "i10"}

#: Directions that the code TC of *NODE fixes.
_FIXED = {1: (0,), 2: (1,), 3: (2,), 4: (0, 1), 5: (1, 2), 6: (0, 2), 7: (0, 1, 2)}

#: Keywords that tie, load or move parts in ways that cannot be computed.
_REFUSED = (
    "CONTACT", "CONSTRAINED", "RIGIDWALL", "AIRBAG", "ELEMENT_DISCRETE", "ELEMENT_MASS", "ELEMENT_SEATBELT",
    "ELEMENT_INERTIA", "DEFORMABLE_TO_RIGID", "BOUNDARY_CYCLIC", "BOUNDARY_SLIDING_PLANE", "BOUNDARY_NON_REFLECTING",
    "BOUNDARY_SPC_SYMMETRY_PLANE", "EF_", "ALE_", "INITIAL_VOLUME", "CESE", "ICFD", "EM_",
)  # fmt: skip
_LOADS = ("LOAD_", "INITIAL_", "BOUNDARY_TEMPERATURE", "BOUNDARY_FLUX", "BOUNDARY_CONVECTION", "BOUNDARY_ACOUSTIC")
_GENERATING = (
    "INCLUDE_TRANSFORM", "INCLUDE_STAMPED", "INCLUDE_BINARY", "NODE_TRANSFORM", "ELEMENT_SOLID_", "ELEMENT_GENERATE",
)  # fmt: skip
_ELASTIC = re.compile(r"MAT_(ELASTIC|0*1)(_TITLE)?")


@dataclass(slots=True)
class _Keyword(KeywordLine):
    format: str
    data: Block

    def lines(self) -> list[tuple[int, str]]:
        return list(self.data.lines(COMMENT))

    def split_title(self) -> tuple[str, list[tuple[int, str]]]:
        """The title ("" without the option TITLE) and the lines below it; InputError without lines."""
        lines = self.lines()
        title = lines.pop(0)[1].strip() if "_TITLE" in self.name and lines else ""
        if not lines:
            self.fail("has no card; give it")
        return title, lines

    def without(self, *options: str) -> tuple[str, set[str]]:
        """The name without these options at its end, and the removed options."""
        name, removed = self.name, set()
        while (option := name.rpartition("_")[2]) in options:
            name = name.removesuffix(f"_{option}")
            removed.add(option)
        return name, removed


@dataclass(slots=True)
class _Card:
    """Fields of one line, separated by commas or in columns."""

    fields: list[str]
    origin: str
    parameters: dict[str, str]

    def text(self, i: int) -> str:
        entry = self.fields[i].strip() if i < len(self.fields) else ""
        match = re.fullmatch(r"([+-]?)&(\w+)", entry)
        if not match:
            return entry
        value = self.parameters.get(match[2].casefold())
        if value is None:
            raise InputError(f"{self.origin}: there is no parameter {entry}; define it in *PARAMETER")
        return value if match[1] != "-" else value[1:] if value.startswith("-") else f"-{value}"

    def integer(self, i: int) -> int:
        entry = self.text(i)
        return text.integer(entry, self.origin) if entry else 0

    def real(self, i: int, default: float = 0.0) -> float:
        entry = self.text(i)
        return text.real(entry, self.origin) if entry else default


@dataclass(slots=True)
class _Set:
    name: str
    origin: str
    labels: list[Ints] = field(default_factory=list)
    ranges: list[tuple[int, int, int]] = field(default_factory=list)
    parts: list[int] = field(default_factory=list)
    sets: list[int] = field(default_factory=list)
    everything: bool = False


def read(path: Path) -> MeshFile:
    """The mesh of an LS-DYNA deck. InputError, with file and line, if the deck is wrong."""
    return _Reader(path).read()


def files(path: Path) -> list[Path]:
    """The deck and all files that it includes."""
    opened: list[Path] = []
    for _ in _keywords(path, (path.parent,), (), opened, "standard"):
        pass
    return opened


# --- text ----------------------------------------------------------------------------------------------------------


def _keywords(
    path: Path, folders: tuple[Path, ...], within: tuple[Path, ...], opened: list[Path], layout: str
) -> Iterator[_Keyword]:
    """Keywords of a file and its includes, in the order of the text, up to *END."""
    data = text.read_text(path, _KIND)
    opened.append(path)
    within = (*within, path.resolve())
    begins = [*(match.start() for match in re.finditer(rb"(?m)^\*", data)), len(data)]
    first = next((raw for raw in data[: begins[0]].split(b"\n") if raw.strip() and raw[:1] != b"$"), None)
    if first is not None and len(within) == 1:
        raise InputError(
            f"{path}: is not an LS-DYNA deck; it begins {decode(first).strip()[:40]!r}, not with a keyword"
        )
    line = 1 + data.count(b"\n", 0, begins[0])
    for begin, stop in pairwise(begins):
        end = min(data.find(b"\n", begin) + 1 or len(data), stop)
        words = decode(data[begin + 1 : end]).split()
        name = words[0].upper() if words else ""
        keyword_format = layout
        if name[-1:] in _FORMAT or (len(words) > 1 and words[1] in _FORMAT):
            keyword_format = _FORMAT[name[-1] if name[-1] in _FORMAT else words[1]]
            name = name.rstrip("+-%")
        if name.startswith("KEYWORD"):
            options = "".join(words).upper()
            layout = "long" if "LONG=Y" in options else "i10" if "I10=Y" in options else layout
        keyword = _Keyword(name, path, line, keyword_format, Block(path, line + 1, data, end, stop))
        if name == "END":
            return
        if name in ("INCLUDE_PATH", "INCLUDE_PATH_RELATIVE"):
            folders = (*folders, *(path.parent / folder for folder in _file_names(keyword)))
        elif name == "INCLUDE":
            for included in _file_names(keyword):
                other = keyword.include(included, folders, within, len(opened))
                yield from _keywords(other, folders, within, opened, layout)
        else:
            yield keyword
        line += data.count(b"\n", begin, stop)


def _file_names(keyword: _Keyword) -> list[str]:
    """File names, one per line; " +" at the end of a line continues the name."""
    names, start = [], ""
    for _, words in keyword.lines():
        name = start + words.strip()
        start = name[:-1].strip() if name.endswith(" +") else ""
        if not start:
            names.append(name)
    if not names:
        keyword.fail("names no file")
    return names


# --- keywords ------------------------------------------------------------------------------------------------------


class _Reader:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.parameters: dict[str, str] = {}
        self.nodes = NodeTable()
        self.fixed: list[tuple[Ints, int, str]] = []  # nodes, code TC, origin
        self.solids: list[tuple[Ints, Ints, str]] = []  # rows (n, 10), parts (n,), origin
        self.others: list[tuple[str, Ints, str]] = []  # keyword, rows, origin
        self.sets: dict[str, dict[int, _Set]] = {"node": {}, "cell": {}, "part": {}}
        self.parts: dict[int, tuple[str, int]] = {}  # title and material
        self.materials: dict[int, FileMaterial] = {}
        self.unusable: dict[int, str] = {}
        self.curves: dict[int, tuple[list[float], str]] = {}
        self.prescribed: list[tuple[_Keyword, _Card, bool]] = []  # True if the card names a node, not a set
        self.skipped: dict[str, None] = {}
        self.remarks: list[str] = []
        self.refused: list[str] = []

    def read(self) -> MeshFile:
        any_keyword = False
        for keyword in _keywords(self.path, (self.path.parent,), (), [], "standard"):
            any_keyword = True
            self._handle(keyword)
        if not any_keyword:
            raise InputError(f"{self.path}: is not an LS-DYNA deck; no line is a keyword such as *NODE")
        if self.skipped:
            skipped = meshfile.listed(self.skipped, 40)
            self.remarks.append(f"{self.path}: skipped, because the results do not depend on it: {skipped}")
        return self._file()

    def _handle(self, keyword: _Keyword) -> None:
        name = keyword.name
        handler = next((handler for pattern, handler in _HANDLERS.items() if re.fullmatch(pattern, name)), None)
        if handler:
            handler(self, keyword)
        elif name.startswith(_REFUSED):
            self.refused.append(f"{keyword.origin}: *{name} changes the mechanics and cannot be computed")
        elif name.startswith(_GENERATING):
            keyword.fail("is not read; let the preprocessor write out plain nodes and solids")
        elif name.startswith(_LOADS):
            self.remarks.append(text.load_warning(keyword))
        elif not name.startswith(("KEYWORD", "TITLE", "COMMENT", "END", "DATABASE_", "CONTROL_TERMINATION")):
            self.skipped[f"*{name}"] = None

    def _cards(self, keyword: _Keyword) -> Iterator[_Card]:
        for line, words in keyword.lines():
            yield self._card(keyword, line, words)

    def _card(self, keyword: _Keyword, line: int, words: str, widths: list[int] | None = None) -> _Card:
        origin = where(keyword.path, line)
        if "," in words:
            return _Card(words.removesuffix(",").split(","), origin, self.parameters)
        words, fields, first = words.expandtabs(), [], 0
        for width in widths or _CARD[keyword.format]:
            fields.append(words[first : first + width])
            first += width
        while fields and not fields[-1].strip():
            fields.pop()
        return _Card(fields, origin, self.parameters)

    def _rows(self, keyword: _Keyword, widths: list[list[int]], dtype: type[int] | type[float]) -> NDArray[np.float64]:
        """Numbers (n_rows, n_fields) of all lines; a row has a line for each list of widths, and blanks are 0."""
        parts = [np.empty((0, sum(map(len, widths))), dtype)]
        pending: list[_Card] = []
        for line, chunk in keyword.data.chunks():
            plain = re.sub(rb"(?m)^(\$.*|[ \t\r]*)\n", b"", chunk) if b"$" in chunk or b"\n\n" in chunk else chunk
            if not pending and plain.strip() and not any(mark in plain for mark in (b",", b"&", b"\t")):
                in_bulk = text.columns(plain, widths, dtype)
                if in_bulk is not None:
                    parts.append(in_bulk)
                    continue
            rows: list[list[float]] = []
            for at, words in Block.of(keyword.path, line, chunk).lines(COMMENT):
                pending.append(self._card(keyword, at, words, widths[len(pending)]))
                if len(pending) == len(widths):
                    row: list[float] = []
                    for card, fields in zip(pending, widths, strict=True):
                        convert = card.integer if dtype is int else card.real
                        row += [convert(i) for i in range(len(fields))]
                    rows.append(row)
                    pending = []
            if rows:
                parts.append(text.as_array(rows, dtype, where(keyword.path, line)))
        if pending:
            raise InputError(f"{pending[0].origin}: the last row of *{keyword.name} is not complete")
        return np.concatenate(parts)

    def _node(self, keyword: _Keyword) -> None:
        rows = self._rows(keyword, [_NODE[keyword.format]], float)
        ids = meshfile.as_ids(rows[:, 0], "node", keyword.origin)
        self.nodes.add(ids, rows[:, 1:4].copy(), keyword.origin)
        for code in np.unique(rows[:, 4]):
            if code in _FIXED:
                self.fixed.append((ids[rows[:, 4] == code], int(code), keyword.origin))
            elif code:
                keyword.fail(f"has code {code:g} in the column TC; give 0 to 7")

    def _solid(self, keyword: _Keyword) -> None:
        first = next(keyword.data.lines(COMMENT), None)
        if first is None:
            return
        widths = _SOLID[keyword.format]
        card = self._card(keyword, *first, widths)
        # In the newer format the element and its part have a separate line.
        cards = [widths[:2], widths] if len(card.fields) <= 2 else [widths]
        rows = self._rows(keyword, cards, int).astype(np.int64, copy=False)
        meshfile.checked_ids(rows[:, 0], "element", keyword.origin)
        nodes = rows[:, 2:]
        if len(cards) == 2 and nodes[:, 8:].any():
            self.refused.append(
                f"{keyword.origin}: {np.count_nonzero(nodes[:, 8:].any(axis=1))} solids with ten nodes cannot be "
                "computed; mesh with eight"
            )
        self.solids.append((np.concatenate([rows[:, :1], nodes[:, :8]], axis=1), rows[:, 1].copy(), keyword.origin))

    def _other(self, keyword: _Keyword) -> None:
        """Shells and beams: only their nodes are read. Additional cards of options are no integers and are skipped."""
        width = _SOLID[keyword.format]
        rows = []
        for line, words in keyword.lines():
            try:
                card = self._card(keyword, line, words, width)
                rows.append(([card.integer(i) for i in range(len(card.fields))] + [0] * 10)[:6])
            except InputError:
                continue
        if rows:
            self.others.append((keyword.name, np.array(rows).clip(-1, meshfile.MAX_ID + 1), keyword.origin))

    def _set(self, keyword: _Keyword) -> None:
        name, _ = keyword.without("TITLE", "COLLECT")
        kind = {"NODE": "node", "SOLI": "cell", "PART": "part"}[name[4:8]]
        set_option = name.split("_", 2)[2].removeprefix("LIST_") if name.count("_") > 1 else "LIST"
        general = set_option == "GENERAL"  # each card has its own option in the first field
        title, lines = keyword.split_title()
        card = self._card(keyword, *lines[0])
        number = card.integer(0)
        if not 0 < number <= meshfile.MAX_ID:
            raise InputError(f"{card.origin}: {number} is not a valid number of a set; correct it")
        members = self.sets[kind].setdefault(number, _Set(title or str(number), keyword.origin))
        for line, words in lines[1:]:
            card = self._card(keyword, line, words)
            option = card.text(0).upper() if general else set_option
            if general and option == "ALL":
                members.everything = True
                continue
            values = [card.integer(i) for i in range(general, len(card.fields))]
            if option in ("LIST", "COLUMN", "SMOOTH", "NODE", "ELEM"):
                members.labels.append(_labels(values[: 1 if option == "COLUMN" else None], card))
            elif option == "GENERATE":
                for first, last in zip(values[0::2], values[1::2], strict=False):
                    self._range(card, members, first, last, 1)
            elif option == "GENERATE_INCREMENT":
                self._range(card, members, *[*values, 0, 0, 1][:3])
            elif option == "PART":
                members.parts += [value for value in values if value]
            elif option in ("ADD", "SET_NODE", "SET_SOLID", "SET"):
                members.sets += [value for value in values if value]
            else:
                self.remarks.append(
                    f"warning: {keyword.origin}: *{keyword.name} selects by {option}, which is not read; set "
                    f"{members.name} may lack members"
                )
                if not general:
                    return

    @staticmethod
    def _range(card: _Card, members: _Set, first: int, last: int, step: int) -> None:
        if first == last == 0:
            return
        if not 0 < first <= last <= meshfile.MAX_ID or step < 1:
            raise InputError(f"{card.origin}: {first} to {last} by {step} is no range of numbers; correct it")
        members.ranges.append((first, last, step))

    def _part(self, keyword: _Keyword) -> None:
        """Title and numbers of each part. If options add cards, only the first part is read."""
        lines = keyword.lines()
        if len(lines) < 2:
            # `lines` skips an empty title as a blank line.
            lines = [(keyword.line + 1, ""), *lines]
        pairs = zip(lines[0::2], lines[1::2], strict=False) if keyword.name == "PART" else [(lines[0], lines[1])]
        for title, numbers in pairs:
            card = self._card(keyword, *numbers)
            self.parts[card.integer(0)] = title[1].strip(), card.integer(2)

    def _material(self, keyword: _Keyword) -> None:
        title, lines = keyword.split_title()
        card = self._card(keyword, *lines[0])
        number = card.integer(0)
        if not _ELASTIC.fullmatch(keyword.name):
            self.unusable[number] = f"is *{keyword.name}"
            return
        density, modulus, ratio = (card.real(i) for i in (1, 2, 3))
        if reason := meshfile.invalid_moduli(modulus, ratio):
            self.unusable[number] = reason
            return
        name = title if "_TITLE" in keyword.name else f"material {number}"
        self.materials[number] = FileMaterial(name, modulus, ratio, density or None, keyword.origin)

    # Constraints

    def _prescribed(self, keyword: _Keyword) -> None:
        name, options = keyword.without("ID")
        stem = "BOUNDARY_SPC" if name.startswith("BOUNDARY_SPC") else "BOUNDARY_PRESCRIBED_MOTION"
        if name not in (f"{stem}_SET", f"{stem}_NODE"):
            self.refused.append(f"{keyword.origin}: *{keyword.name} is not read; use *{stem}_SET")
            return
        for i, card in enumerate(self._cards(keyword)):
            # With the option ID, cards with a number and a heading precede the data.
            heading = len(card.fields) > 1 and not re.fullmatch(r"[\s\d+.&-]*", card.fields[1])
            if not ("ID" in options and (i == 0 or heading or len(card.fields) < 2)):
                self.prescribed.append((keyword, card, name.endswith("NODE")))

    def _curve(self, keyword: _Keyword) -> None:
        _, lines = keyword.split_title()
        head = self._card(keyword, *lines[0])
        scale, offset = head.real(3, 1.0) or 1.0, head.real(5)
        ordinates = [scale * (self._card(keyword, *line, [20, 20]).real(1) + offset) for line in lines[1:]]
        self.curves[head.integer(0)] = ordinates, keyword.origin

    def _parameters(self, keyword: _Keyword) -> None:
        """Pairs of a name, after R or I for its type, and a value."""
        for card in self._cards(keyword):
            for name, value in zip(card.fields[0::2], card.fields[1::2], strict=False):
                match = re.fullmatch(r"\s*([RIC])\s*(\w+)\s*", name, re.IGNORECASE)
                if not match:
                    raise InputError(f"{card.origin}: {name.strip()!r} is no parameter; write R or I, and the name")
                if match[1].upper() == "R":
                    text.real(value, card.origin)
                elif match[1].upper() == "I":
                    text.integer(value, card.origin)
                self.parameters[match[2].casefold()] = value.strip()

    # The model

    def _file(self) -> MeshFile:
        ids, points = self.nodes.merged(self.path, self.remarks)
        mesh = MeshFile(self.path, "LS-DYNA", points, ids, remarks=self.remarks, refused=self.refused)
        self.mesh, self.numbering = mesh, {"node": Numbering(ids)}
        self.part_of = self._elements(mesh)
        self.numbering["cell"] = Numbering(meshfile.joined(b.ids for b in mesh.cells if b.kind != "other"))
        self._name_sets()
        for nodes, code, origin in self.fixed:
            rows = np.unique(self.numbering["node"].rows(nodes)[0])
            name = mesh.set_of(rows, f"nodes with TC {code}")
            mesh.constraints.append(Constraint(name, _FIXED[code], (0.0,) * len(_FIXED[code]), origin))
        for keyword, card, of_node in self.prescribed:
            self._constrain(keyword, card, of_node)
        return mesh

    def _elements(self, mesh: MeshFile) -> Ints:
        """Enter the solids by kind, then all other elements; returns the part of each solid."""
        parts: list[Ints] = []
        for rows, part, origin in self.solids:
            nodes, kinds = rows[:, 1:], _kinds(rows[:, 1:])
            for row, (kind, corners) in enumerate(_CORNERS.items()):
                of_kind = kinds == row
                if of_kind.any():
                    # A slice makes a view instead of a copy if all solids are of one kind.
                    chosen = slice(None) if of_kind.all() else of_kind
                    labels = nodes[chosen] if kind == "hexahedron" else nodes[chosen][:, corners]
                    numbers = rows[chosen, 0].copy()
                    resolved = self.numbering["node"].resolve(labels, numbers, origin)
                    mesh.cells.append(Cells(kind, f"SOLID, {len(corners)} nodes", numbers, resolved, origin))
                    parts.append(part[chosen])
        self.solids.clear()
        meshfile.check_unique_cells(mesh.cells)
        part_of = meshfile.joined(parts)
        for name, rows, origin in self.others:
            nodes, exists = self.numbering["node"].rows(rows[:, 2:])
            members = mesh.n_cells + np.arange(len(rows))
            mesh.cells.append(Cells("other", name, rows[:, 0], np.where(exists, nodes, -1), origin))
            if np.isin(rows[:, 1], list(self.parts)).any():
                mesh.structural.add(meshfile.add_set(mesh.cell_sets, name.lower(), members))
        return part_of

    def _name_sets(self) -> None:
        mesh = self.mesh
        for kind, sets in (("node", mesh.node_sets), ("cell", mesh.cell_sets)):
            for number, chosen in self.sets[kind].items():
                chosen.name = meshfile.add_set(sets, chosen.name, self._members(kind, number, ()))
        for number in np.unique(self.part_of).tolist():
            title, material = self.parts.get(number, ("", 0))
            cells = np.flatnonzero(self.part_of == number)
            name = meshfile.add_set(mesh.cell_sets, title or f"part {number}", cells)
            if material in self.materials:
                mesh.materials.append((name, self.materials[material]))
            elif material:
                reason = self.unusable.get(material, "is not in the deck")
                named = f"{material} of part {number}"
                self.remarks.append(meshfile.unused_material(str(self.path), named, reason, name))
        for number, chosen in self.sets["part"].items():
            members = [np.flatnonzero(self.part_of == part) for labels in chosen.labels for part in labels]
            if members:
                meshfile.add_set(mesh.cell_sets, f"parts {number}", meshfile.union(members))

    def _members(self, kind: str, number: int, within: tuple[int, ...]) -> Ints:
        """Rows, ascending, of a set; `within` are the sets that refer to it."""
        chosen, numbering = self.sets[kind][number], self.numbering[kind]
        if number in within:
            raise InputError(f"{chosen.origin}: set {number} is a part of itself; break the circle")
        if chosen.everything:
            return np.arange(len(numbering.ids))
        noun = "node" if kind == "node" else "solid"
        labels = meshfile.joined(chosen.labels)
        rows = numbering.members(labels, noun, chosen.name, chosen.origin, self.remarks)
        found = [rows, *(numbering.between(*limits) for limits in chosen.ranges)]
        for part in chosen.parts:
            cells = np.flatnonzero(self.part_of == part)
            found.append(self.mesh.nodes_of(cells) if kind == "node" else cells)
        for other in chosen.sets:
            if other not in self.sets[kind]:
                raise InputError(f"{chosen.origin}: there is no set {other}; correct it")
            found.append(self._members(kind, other, (*within, number)))
        return meshfile.union(found)

    def _constrain(self, keyword: _Keyword, card: _Card, of_node: bool) -> None:
        target = card.integer(0)
        if of_node:
            rows, found = self.numbering["node"].rows(np.array([np.clip(target, 0, meshfile.MAX_ID)]))
            if not found[0]:
                raise InputError(f"{card.origin}: there is no node {target}; correct it")
            name = self.mesh.set_of(rows, f"node {target}")
        elif target in self.sets["node"]:
            name = self.sets["node"][target].name
        else:
            known = meshfile.listed(sorted(self.sets["node"]))
            raise InputError(f"{card.origin}: there is no node set {target}; sets: {known}")
        if keyword.name.startswith("BOUNDARY_SPC"):
            if card.integer(1):
                raise InputError(f"{card.origin}: *{keyword.name} in a local system is not read; use the global one")
            fixed = tuple(i for i in range(3) if card.integer(2 + i))
            if fixed:
                self.mesh.constraints.append(Constraint(name, fixed, (0.0,) * len(fixed), card.origin))
            return
        degree, kind, curve = card.integer(1), card.integer(2), card.integer(3)
        if degree not in (1, 2, 3) or kind != 2:
            self.refused.append(
                f"{card.origin}: *{keyword.name} with DOF {degree} and VAD {kind}; only displacements (VAD 2) along "
                "x, y or z (DOF 1 to 3) can be prescribed"
            )
            return
        if curve not in self.curves or not self.curves[curve][0]:
            raise InputError(f"{card.origin}: there is no curve {curve} with points; define it in *DEFINE_CURVE")
        ordinates, origin = self.curves[curve]
        if abs(ordinates[-1]) < max(map(abs, ordinates)):
            self.remarks.append(
                f"warning: {origin}: curve {curve} ends below its largest value; its last value is used"
            )
        moved = ordinates[-1] * (card.real(4, 1.0) or 1.0)
        self.mesh.constraints.append(Constraint(name, (degree - 1,), (moved,), card.origin))
        self.remarks.append(f"{card.origin}: curve {curve} is replaced by the loading curve, up to its last value")


#: Methods by the pattern of the keyword's name; the first match counts.
_HANDLERS: dict[str, Callable[[_Reader, _Keyword], None]] = {
    "NODE": _Reader._node,
    "ELEMENT_SOLID": _Reader._solid,
    "ELEMENT_(SHELL|BEAM|TSHELL).*": _Reader._other,
    "SET_(NODE|SOLID|PART).*": _Reader._set,
    "PART(_.*)?": _Reader._part,
    "MAT_.*": _Reader._material,
    "BOUNDARY_SPC_(?!.*SYMMETRY).*": _Reader._prescribed,
    "BOUNDARY_PRESCRIBED_MOTION_.*": _Reader._prescribed,
    "DEFINE_CURVE(_TITLE)?": _Reader._curve,
    "PARAMETER(_LOCAL)?": _Reader._parameters,
}


def _labels(values: list[int], card: _Card) -> Ints:
    """Numbers of nodes, solids or parts, without zeros, which are empty fields."""
    labels = [value for value in values if value]
    if any(not 0 < value <= meshfile.MAX_ID for value in labels):
        raise InputError(f"{card.origin}: a number is not between 1 and {meshfile.MAX_ID}; correct it")
    return np.array(labels, np.int64)


#: Rows of the corners among the eight nodes; the other nodes repeat one of them.
_CORNERS = {
    "hexahedron": [0, 1, 2, 3, 4, 5, 6, 7],
    "tetrahedron": [0, 1, 2, 3],
    "pyramid": [0, 1, 2, 3, 4],
    "wedge": [0, 4, 1, 3, 6, 2],
}


def _kinds(nodes: Ints) -> NDArray[np.int8]:
    """Kind (n,), a row of _CORNERS, of solids with eight nodes (n, 8); the last nodes may be equal or 0."""
    last = nodes[:, 4:]
    kinds = np.zeros(len(nodes), np.int8)
    kinds[(last == last[:, :1]).all(axis=1)] = 2
    kinds[((last == nodes[:, 3:4]) | (last == 0)).all(axis=1)] = 1
    kinds[(nodes[:, 4] == nodes[:, 5]) & (nodes[:, 6] == nodes[:, 7]) & (nodes[:, 4] != nodes[:, 6])] = 3
    return kinds
