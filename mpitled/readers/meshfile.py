"""What a mesh file says, in its own numbers and units, and how numbers are read from text at once or line by line."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mpitled import resources
from mpitled.errors import InputError
from mpitled.mesh import Constraint

#: Larger numbers of nodes and elements are slips: programs that write decks keep them in 32 bits.
LARGEST_ID = 2**31 - 1
#: Coordinates are smaller, in the file's unit: volumes and their products must stay floats.
FARTHEST = 1e12
#: Corners of the solids that can be read; all other elements are of kind "other".
SOLIDS = {"hexahedron": 8, "wedge": 6, "pyramid": 5, "tetrahedron": 4}

_CHUNK = 1 << 22  # bytes of text at once, so that the temporaries stay small
_SHOWN = 40  # characters of a bad field that a message shows
_PLAIN = bytes.maketrans(b"\r\tDd", b"  EE")  # blanks, and the exponents of Fortran
_INTEGER = re.compile(r"[+-]?\d{1,20}", re.ASCII)
#: Also 1.0D-3, 1.0-3 and .5, which Fortran reads.
_REAL = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:[eEdD]([+-]?\d{1,9})|([+-]\d{1,9}))?", re.ASCII)

Number = TypeVar("Number", int, float)


@dataclass(frozen=True, slots=True)
class Cells:
    """Elements of one type."""

    kind: str  # a key of SOLIDS, or "other"
    type: str  # as the file calls it
    ids: NDArray[np.int64]  # (n,), the file's numbers
    nodes: NDArray[np.int64]  # (n, k), rows of the file's nodes: corners in the Abaqus order; -1 fills up "other"
    origin: str  # file and line


@dataclass(frozen=True, slots=True)
class FileMaterial:
    """A linear elastic or neo-Hookean solid in the file's units."""

    name: str
    youngs_modulus: float
    poissons_ratio: float
    density: float | None  # None where the file says nothing
    origin: str


@dataclass(slots=True)
class MeshFile:
    """Nodes, elements, sets, constraints and materials of one file with all that it includes.

    Elements are numbered through `cells` in turn: cell sets index into that list. `refused` says which parts of the
    file change the mechanics and cannot be computed, a line each.
    """

    path: Path
    format: str
    points: NDArray[np.float64]  # (n_nodes, 3)
    node_ids: NDArray[np.int64]  # (n_nodes,), the file's numbers
    cells: list[Cells] = field(default_factory=list)
    node_sets: dict[str, NDArray[np.int64]] = field(default_factory=dict)  # ascending
    cell_sets: dict[str, NDArray[np.int64]] = field(default_factory=dict)  # ascending
    constraints: list[Constraint] = field(default_factory=list)  # displacements in the file's unit
    materials: list[tuple[str, FileMaterial]] = field(default_factory=list)  # cell set, material
    structural: set[str] = field(default_factory=set)  # cell sets to which the file gives a section
    remarks: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    @property
    def n_cells(self) -> int:
        return sum(len(block.ids) for block in self.cells)

    def own_set(self, nodes: NDArray[np.int64], name: str) -> str:
        """The name of a node set of just these nodes (ascending): one that there is, or a new one called `name`."""
        for existing, members in self.node_sets.items():
            if len(members) == len(nodes) and (members == nodes).all():
                return existing
        return add_set(self.node_sets, name, nodes)


class Numbering:
    """From the numbers of a file to rows of its arrays, without room for the numbers in between."""

    def __init__(self, ids: NDArray[np.int64]) -> None:
        ascending = bool((np.diff(ids) > 0).all())
        self.order = None if ascending else np.argsort(ids, kind="stable")
        self.ids = ids if self.order is None else ids[self.order]
        self._dense = len(ids) > 0 and int(self.ids[-1]) - int(self.ids[0]) == len(ids) - 1

    def rows(self, labels: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Rows of the labels, and which of them there are; the rows of others mean nothing."""
        if len(self.ids) == 0:
            return np.zeros(labels.shape, np.int64), np.zeros(labels.shape, bool)
        place = labels - self.ids[0] if self._dense else np.searchsorted(self.ids, labels)
        place = np.clip(place, 0, len(self.ids) - 1)
        found = self.ids[place] == labels
        return (place if self.order is None else self.order[place]), found

    def between(self, first: int, last: int, step: int) -> NDArray[np.int64]:
        """Rows of the numbers first, first + step, ... up to last that there are."""
        start, stop = np.searchsorted(self.ids, [first, last + 1])
        place = start + np.flatnonzero((self.ids[start:stop] - first) % step == 0)
        return place if self.order is None else self.order[place]


@dataclass(frozen=True, slots=True)
class Block:
    """Lines of data as they stand in a file: text[start:stop], the first of which is line `line`."""

    path: Path
    line: int
    text: bytes
    start: int
    stop: int

    def chunks(self) -> Iterator[tuple[int, bytes]]:
        """Whole lines, some megabytes at a time, and the number of the first."""
        line, at = self.line, self.start
        while at < self.stop:
            end = min(at + _CHUNK, self.stop)
            if end < self.stop:
                end = self.text.rfind(b"\n", at, end) + 1 or self.text.find(b"\n", end, self.stop) + 1 or self.stop
            yield line, self.text[at:end]
            line += self.text.count(b"\n", at, end)
            at = end

    def lines(self, comment: str) -> Iterator[tuple[int, str]]:
        """Number and text of each line that is neither blank nor a comment, one at a time."""
        for first, chunk in self.chunks():
            for line, raw in enumerate(chunk.split(b"\n"), first):
                text = decoded(raw).rstrip()
                if text and not text.lstrip().startswith(comment):
                    yield line, text


def where(path: Path, line: int) -> str:
    """File and line, as messages begin."""
    return f"{path}: line {line}"


def decoded(text: bytes) -> str:
    """UTF-8, or else Latin-1, which every byte is a letter of."""
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def check_file(path: Path, what: str) -> None:
    """InputError if it is a device or a pipe, which may have no end."""
    if not path.is_file() and not path.is_dir() and path.exists():
        raise InputError(f"{path}: is a device or a pipe; give the path of {what}")


def read_text(path: Path, what: str) -> bytes:
    """The bytes of a text file with lines that end in LF. InputError if it is missing, empty or not text."""
    try:
        check_file(path, what)
        # A text's numbers, nodes, cells and sets take more than the text itself.
        resources.check_memory(4 * path.stat().st_size, f"{path}: to read it", "use a machine with more")
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give the path of {what}") from None
    text = text.removeprefix(b"\xef\xbb\xbf")
    if not text.strip():
        raise InputError(f"{path}: is empty; give {what}")
    if b"\0" in text:
        raise InputError(f"{path}: is not a text file; give {what}")
    return text if b"\n" in text else text.replace(b"\r", b"\n")


def add_set(sets: dict[str, NDArray[np.int64]], name: str, members: NDArray[np.int64]) -> str:
    """Enter a set under its name, or the name with a number if another has it already; the name."""
    free, n = name, 2
    while free in sets:
        free, n = f"{name}_{n}", n + 1
    sets[free] = members
    return free


def listed(items: Iterable[object], most: int = 8) -> str:
    """Items in words, the first few of them."""
    texts = [str(item) for item in items]
    return ", ".join(texts[:most]) + (f" and {len(texts) - most} more" if len(texts) > most else "")


def integer(text: str, origin: str) -> int:
    """An integer; InputError if the text is none."""
    if not _INTEGER.fullmatch(text.strip()):
        raise InputError(f"{origin}: {_shown(text)} is not an integer; correct it")
    return int(text.strip())


def real(text: str, origin: str) -> float:
    """A finite number, as C or Fortran writes it; InputError if the text is none."""
    match = _REAL.fullmatch(text.strip())
    value = float(f"{match[1]}e{match[2] or match[3] or 0}") if match else np.nan
    if not np.isfinite(value):
        raise InputError(f"{origin}: {_shown(text)} is not a {'finite ' if match else ''}number; correct it")
    return value


def _shown(text: str) -> str:
    text = text.strip()
    return repr(text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "...")


def separated(
    block: Block, dtype: type[Number], comment: bytes, blank: Number | None = None
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Numbers (n,) of lines with commas between them, and how many of them each line has (n_lines,).

    `blank` stands for a field between two commas that is empty; if it is None that is an error, as is all else that
    is no number: an InputError with file and line.
    """
    values, counts = [np.empty(0, dtype)], [np.empty(0, np.int64)]
    for line, chunk in block.chunks():
        found = numbers_at_once(chunk, dtype, comment)
        if found is None:
            part = Block(block.path, line, chunk, 0, len(chunk))
            found = _separated_line_by_line(part, dtype, decoded(comment), blank)
        values.append(found[0])
        counts.append(found[1])
    return np.concatenate(values), np.concatenate(counts)


def numbers_at_once(chunk: bytes, dtype: type[Number], comment: bytes) -> tuple[NDArray[Any], NDArray[np.int64]] | None:
    """None if the chunk is not plainly numbers, commas and blanks: then it is to be read line by line."""
    if comment in chunk:
        chunk = re.sub(rb"(?m)^[ \t]*" + re.escape(comment) + rb".*\n?", b"", chunk)
    chunk = chunk.translate(_PLAIN).strip() + b"\n"
    for tidy in (False, True):
        if tidy:  # blank lines, and a comma at the end of lines
            chunk = re.sub(rb",? *\n[ \n]*", b"\n", chunk)
        if chunk == b"\n":
            return np.empty(0, dtype), np.empty(0, np.int64)
        values = _scan(chunk[:-1].replace(b"\n", b","), dtype)
        if values is not None:
            characters = np.frombuffer(chunk, np.uint8)
            commas, ends = np.flatnonzero(characters == ord(",")), np.flatnonzero(characters == ord("\n"))
            return values, np.diff(np.searchsorted(commas, ends), prepend=0) + 1
    return None


def _scan(text: bytes, dtype: type[Number]) -> NDArray[Any] | None:
    """Numbers with commas between them; None if anything else is there. As exact as Python's float."""
    if not _one_in_each_field(text):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy before 2.3 only warns of what it cannot read
        try:
            values = np.fromstring(text, np.dtype(dtype), sep=" ,")
        except (ValueError, DeprecationWarning):
            return None
    return values if dtype is int or np.isfinite(values).all() else None


def _one_in_each_field(text: bytes) -> bool:
    """Whether each field between commas holds one word that is more than a sign: numpy reads others as 0 or -1."""
    characters = np.frombuffer(text, np.uint8)
    comma = characters == ord(",")
    solid = ~comma & (characters != ord(" "))
    first = np.flatnonzero(solid[1:] & ~solid[:-1]) + 1
    if solid[:1].any():
        first = np.append(0, first)
    commas = np.flatnonzero(comma)
    if len(first) != len(commas) + 1 or (first[1:] < commas).any() or (first[:-1] > commas).any():
        return False
    signed = first[(characters[first] == ord("+")) | (characters[first] == ord("-"))]
    return len(signed) == 0 or bool(signed[-1] + 1 < len(solid) and solid[signed + 1].all())


def _separated_line_by_line(
    block: Block, dtype: type[Number], comment: str, blank: Number | None
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    convert: Callable[[str, str], Any] = integer if dtype is int else real
    values: list[Number] = []
    counts = []
    for line, text in block.lines(comment):
        origin = where(block.path, line)
        fields = text.rstrip().removesuffix(",").split(",")
        for entry in fields:
            if blank is not None and not entry.strip():
                values.append(blank)
            else:
                values.append(convert(entry, origin))
        counts.append(len(fields))
    try:
        return np.array(values, dtype), np.array(counts, np.int64)
    except OverflowError:
        raise InputError(f"{where(block.path, block.line)}: a number below is too large; correct it") from None


def table(values: NDArray[Any], counts: NDArray[np.int64], width: int, fill: float = 0) -> NDArray[Any]:
    """(n_lines, width): the first `width` numbers of each line; `fill` where a line has fewer."""
    first = np.cumsum(counts) - counts
    if len(counts) and (counts == counts[0]).all():
        rows = values.reshape(len(counts), -1)[:, :width]
        padding = np.full((len(rows), width - rows.shape[1]), fill, values.dtype)
        return np.concatenate([rows, padding], axis=1) if padding.size else rows
    rows = np.full((len(counts), width), fill, values.dtype)
    for column in range(width):
        there = counts > column
        rows[there, column] = values[first[there] + column]
    return rows


def columns(text: bytes, widths: list[list[int]], dtype: type[Number]) -> NDArray[Any] | None:
    """Numbers (n_rows, n_fields) in fixed columns; a row has a line for each list of widths. Blank fields are 0.

    `text` has no comments and no empty lines. None if any field is not plainly a number.
    """
    text = text.translate(_PLAIN)
    characters = np.frombuffer(text, np.uint8)
    ends = np.flatnonzero(characters == ord("\n"))
    if len(ends) == 0 or text[-1:] != b"\n":
        ends = np.append(ends, len(characters))
    starts = np.append(0, ends[:-1] + 1)
    n_lines = len(widths)
    if len(ends) % n_lines:
        return None
    found = []
    for card, fields in enumerate(widths):
        start, length = starts[card::n_lines, None], (ends - starts)[card::n_lines, None]
        at = np.arange(sum(fields))
        line = np.where(at < length, characters[np.minimum(start + at, len(characters) - 1)], ord(" "))
        spread = np.full((len(line), sum(fields) + len(fields)), ord(","), np.uint8)
        first = 0
        for i, width in enumerate(fields):
            entry = line[:, first : first + width]
            entry[(entry == ord(" ")).all(axis=1), -1] = ord("0")
            spread[:, first + i : first + i + width] = entry
            first += width
        values = _scan(spread.tobytes()[:-1], dtype)
        if values is None or len(values) != len(line) * len(fields):
            return None
        found.append(values.reshape(len(line), -1))
    return np.concatenate(found, axis=1)


def checked_ids(ids: NDArray[np.int64], what: str, origin: str) -> NDArray[np.int64]:
    """Numbers of nodes or elements; InputError if one is not between 1 and LARGEST_ID."""
    if len(ids) and (ids.min() < 1 or ids.max() > LARGEST_ID):
        bad = ids[(ids < 1) | (ids > LARGEST_ID)]
        raise InputError(f"{origin}: {what} number {bad[0]} is not between 1 and {LARGEST_ID} ({len(bad)} such)")
    return ids


def as_ids(values: NDArray[np.float64], what: str, origin: str) -> NDArray[np.int64]:
    """Numbers of nodes that were read among reals."""
    if (values != np.rint(values)).any():
        bad = values[values != np.rint(values)]
        raise InputError(f"{origin}: {what} number {bad[0]:g} is not an integer ({len(bad)} such)")
    return checked_ids(np.clip(values, -1, 2.0**53).astype(np.int64), what, origin)


def without_repeats(
    ids: NDArray[np.int64], points: NDArray[np.float64], origins: list[tuple[int, str]]
) -> tuple[NDArray[np.int64], NDArray[np.float64], list[str]]:
    """Nodes that the file gives twice at the same place, once; InputError if the places differ.

    `origins` has the first row and the origin of each block.
    """
    numbering = Numbering(ids)
    if numbering.order is None:
        return ids, points, []
    twice = numbering.order[1:][np.diff(numbering.ids) == 0]
    if not len(twice):
        return ids, points, []
    first = numbering.rows(ids[twice])[0]  # the first of equals, for the order is stable
    apart = np.flatnonzero((points[first] != points[twice]).any(axis=1))
    if len(apart):
        row = int(twice[apart[0]])
        origin = [text for start, text in origins if start <= row][-1]
        raise InputError(f"{origin}: node {ids[row]} is defined twice, at different places ({len(apart)} such)")
    keep = np.ones(len(ids), bool)
    keep[twice] = False
    return ids[keep], points[keep], [f"{len(twice)} nodes that are given twice at the same place are taken once"]


def check_unique_cells(cells: list[Cells], scope: Iterable[int]) -> None:
    """InputError if two elements of the chosen blocks have the same number."""
    chosen = [cells[i] for i in scope]
    ids = np.concatenate([np.empty(0, np.int64), *(block.ids for block in chosen)])
    numbering = Numbering(ids)
    if numbering.order is not None and (repeated := np.diff(numbering.ids) == 0).any():
        row = int(numbering.order[1:][repeated].min())
        ends = np.cumsum([len(block.ids) for block in chosen])
        block = chosen[int(np.searchsorted(ends, row, side="right"))]
        raise InputError(
            f"{block.origin}: element {ids[row]} is defined twice ({np.count_nonzero(repeated)} such); renumber one"
        )


def resolved(labels: NDArray[np.int64], numbering: Numbering, ids: NDArray[np.int64], origin: str) -> NDArray[np.int64]:
    """Rows (n, k) of the nodes that elements (n,) name; InputError if the file does not define one of them."""
    rows, unknown = np.empty(labels.shape, np.int64), np.zeros(len(labels), bool)
    for first in range(0, len(labels), 1 << 16):
        some = slice(first, first + (1 << 16))
        rows[some], found = numbering.rows(labels[some])
        unknown[some] = ~found.all(axis=1)
    if unknown.any():
        element = int(np.argmax(unknown))
        missing = labels[element][~numbering.rows(labels[element])[1]]
        raise InputError(
            f"{origin}: element {ids[element]} has node {missing[0]}, which the file does not define "
            f"({np.count_nonzero(unknown)} such elements)"
        )
    return rows


#: Corners of the faces S1, S2, ... of Abaqus's solids, clockwise seen from outside; -1 fills up triangles.
FACES = {
    "hexahedron": [[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]],
    "wedge": [[0, 1, 2, -1], [3, 5, 4, -1], [0, 3, 4, 1], [1, 4, 5, 2], [2, 5, 3, 0]],
    "pyramid": [[0, 1, 2, 3], [0, 4, 1, -1], [1, 4, 2, -1], [2, 4, 3, -1], [3, 4, 0, -1]],
    "tetrahedron": [[0, 1, 2, -1], [0, 3, 1, -1], [1, 3, 2, -1], [2, 3, 0, -1]],
}


def exterior_faces(cells: Iterable[Cells]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Nodes (m, 4) of the faces that only one solid has (-1 fills up triangles), and the rows of these solids."""
    faces, owners, first = [np.empty((0, 4), np.int64)], [np.empty(0, np.int64)], 0
    for block in cells:
        for corners in FACES.get(block.kind, ()):
            nodes = block.nodes[:, corners]
            nodes[:, np.array(corners) < 0] = -1
            faces.append(nodes)
            owners.append(first + np.arange(len(nodes)))
        first += len(block.ids)
    face, owner = np.concatenate(faces), np.concatenate(owners)
    key = np.sort(face, axis=1) + 1
    pairs = (key[:, 0] << 32 | key[:, 1]), (key[:, 2] << 32 | key[:, 3])
    order = np.lexsort(pairs)
    same = np.all([pair[order][1:] == pair[order][:-1] for pair in pairs], axis=0)
    single = ~(np.append(False, same) | np.append(same, False))[: len(order)]
    chosen = np.sort(order[single])
    return face[chosen], owner[chosen]
