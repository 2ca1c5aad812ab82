"""Text of mesh files: blocks of lines, keywords with includes, and numbers read in bulk or line by line."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from mpitled import resources
from mpitled.errors import InputError
from mpitled.mesh import Ints

MAX_INCLUDES = 1000
_CHUNK = 1 << 22  # bytes of text at once; bounds the temporary memory
_SHOWN = 40  # characters of a wrong field that a message shows
_PLAIN = bytes.maketrans(b"\r\tDd", b"  EE")  # blanks and Fortran exponents
_INTEGER = re.compile(r"[+-]?\d{1,20}", re.ASCII)
#: Includes the Fortran forms 1.0D-3, 1.0-3 and .5.
_REAL = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:[eEdD]([+-]?\d{1,9})|([+-]\d{1,9}))?", re.ASCII)

Number = TypeVar("Number", int, float)


@dataclass(frozen=True, slots=True)
class Block:
    """Lines of data in a file: text[start:stop]; `line` is the number of the first line."""

    path: Path
    line: int
    text: bytes
    start: int
    stop: int

    @classmethod
    def of(cls, path: Path, line: int, text: bytes) -> Block:
        """A block with all of the text."""
        return cls(path, line, text, 0, len(text))

    def chunks(self) -> Iterator[tuple[int, bytes]]:
        """Chunks of complete lines, of some megabytes, and the number of each chunk's first line."""
        line, at = self.line, self.start
        while at < self.stop:
            end = min(at + _CHUNK, self.stop)
            if end < self.stop:
                end = self.text.rfind(b"\n", at, end) + 1 or self.text.find(b"\n", end, self.stop) + 1 or self.stop
            yield line, self.text[at:end]
            line += self.text.count(b"\n", at, end)
            at = end

    def lines(self, comment: str) -> Iterator[tuple[int, str]]:
        """Number and text of each line that is neither blank nor a comment."""
        for first, chunk in self.chunks():
            for line, raw in enumerate(chunk.split(b"\n"), first):
                text = decode(raw).rstrip()
                if text and not text.lstrip().startswith(comment):
                    yield line, text


@dataclass(slots=True)
class KeywordLine:
    """A line that begins with a keyword."""

    name: str  # in upper case, without asterisk and blanks
    path: Path
    line: int

    @property
    def origin(self) -> str:
        """File and line."""
        return where(self.path, self.line)

    @property
    def shown(self) -> str:
        """The keyword in messages."""
        return f"*{self.name}"

    def fail(self, problem: str) -> NoReturn:
        """Raise an InputError that begins with file, line and keyword."""
        raise InputError(f"{self.origin}: {self.shown} {problem}")

    def include(self, name: str, folders: Sequence[Path], within: Sequence[Path], n_files: int) -> Path:
        """Path of the included file, relative to the keyword's file or to one of the folders.

        `within` are the files from the deck down to the keyword's file. InputError if the file is missing, if it is one
        of `within`, or if there are too many files.
        """
        if n_files > MAX_INCLUDES:
            self.fail(f"is one of more than {MAX_INCLUDES} files; join some")
        name = name.replace("\\", "/")
        try:
            for folder in (self.path.parent, *folders):
                if (folder / name).is_file():
                    if (folder / name).resolve() in within:
                        self.fail(f"names {name}, which includes this file; break the circle")
                    return folder / name
        except (OSError, ValueError):
            pass
        self.fail(f"names {name}, which is not there; paths are relative to {self.path.name}")


def load_warning(keyword: KeywordLine) -> str:
    """Warning about a load."""
    return f"warning: {keyword.origin}: {keyword.shown} is not applied: loads are not supported"


def where(path: Path, line: int) -> str:
    """File and line, the beginning of a message."""
    return f"{path}: line {line}"


def decode(text: bytes) -> str:
    """Text from UTF-8, or else from Latin-1, where every byte is valid."""
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def check_file(path: Path, kind: str) -> None:
    """InputError if the path is a device or a pipe: its data may have no end."""
    if not path.is_file() and not path.is_dir() and path.exists():
        raise InputError(f"{path}: is a device or a pipe; give the path of {kind}")


def read_text(path: Path, kind: str) -> bytes:
    """The bytes of a text file, with lines that end in LF. InputError if it is missing, empty or not text."""
    try:
        check_file(path, kind)
        # The parsed numbers, nodes, cells and sets take more memory than the text.
        resources.check_memory(4 * path.stat().st_size, f"{path}: to read it", "use a machine with more")
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give the path of {kind}") from None
    text = text.removeprefix(b"\xef\xbb\xbf")
    if not text.strip():
        raise InputError(f"{path}: is empty; give {kind}")
    if b"\0" in text:
        raise InputError(f"{path}: is not a text file; give {kind}")
    return text if b"\n" in text else text.replace(b"\r", b"\n")


# --- single numbers ------------------------------------------------------------------------------------------------


def integer(text: str, origin: str) -> int:
    """The integer in a text; InputError if there is none."""
    if not _INTEGER.fullmatch(text.strip()):
        raise InputError(f"{origin}: {_shown(text)} is not an integer; correct it")
    return int(text.strip())


def real(text: str, origin: str) -> float:
    """The finite number in a text, in the notation of C or Fortran; InputError if there is none."""
    match = _REAL.fullmatch(text.strip())
    value = float(f"{match[1]}e{match[2] or match[3] or 0}") if match else np.nan
    if not np.isfinite(value):
        raise InputError(f"{origin}: {_shown(text)} is not a {'finite ' if match else ''}number; correct it")
    return value


def _shown(text: str) -> str:
    text = text.strip()
    return repr(text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "...")


# --- numbers in bulk -----------------------------------------------------------------------------------------------


def separated(
    block: Block, dtype: type[Number], comment: str, blank: Number | None = None
) -> tuple[NDArray[Any], Ints]:
    """Comma-separated numbers (n,), and the count of numbers in each line (n_lines,).

    `blank` is the value of an empty field between two commas; with None an empty field is an error. InputError, with
    file and line, if a field is no number.
    """
    parts = [(np.empty(0, dtype), np.empty(0, np.int64))]
    for line, chunk in block.chunks():
        in_bulk = parse(chunk, dtype, comment)
        parts.append(in_bulk or _parse_lines(Block.of(block.path, line, chunk), dtype, comment, blank))
    values, counts = zip(*parts, strict=True)
    return np.concatenate(values), np.concatenate(counts)


def parse(chunk: bytes, dtype: type[Number], comment: str) -> tuple[NDArray[Any], Ints] | None:
    """As `separated`, but in bulk; None if the chunk has anything except numbers, commas and blanks."""
    mark = comment.encode()
    if mark in chunk:
        chunk = re.sub(rb"(?m)^[ \t]*" + re.escape(mark) + rb".*\n?", b"", chunk)
    chunk = chunk.translate(_PLAIN).strip() + b"\n"
    for tidy in (False, True):
        if tidy:  # remove blank lines, and commas at the ends of lines
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
    """Comma-separated numbers, as exact as Python's float; None if the text has anything else."""
    if not _one_word_per_field(text):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy before 2.3 only warns about invalid text
        try:
            values = np.fromstring(text, np.dtype(dtype), sep=" ,")
        except (ValueError, DeprecationWarning):
            return None
    return values if dtype is int or np.isfinite(values).all() else None


def _one_word_per_field(text: bytes) -> bool:
    """Whether each field between commas is one word and no single sign: numpy reads other fields as 0 or -1."""
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


def _parse_lines(block: Block, dtype: type[Number], comment: str, blank: Number | None) -> tuple[NDArray[Any], Ints]:
    convert: Callable[[str, str], Any] = integer if dtype is int else real
    values: list[Number] = []
    counts = []
    for line, text in block.lines(comment):
        fields = text.rstrip().removesuffix(",").split(",")
        for entry in fields:
            is_blank = blank is not None and not entry.strip()
            values.append(blank if is_blank else convert(entry, where(block.path, line)))  # type: ignore[arg-type]
        counts.append(len(fields))
    return as_array(values, dtype, where(block.path, block.line)), np.array(counts, np.int64)


def as_array(values: Sequence[Any], dtype: type[Number], origin: str) -> NDArray[Any]:
    """Numbers as an array; InputError if one does not fit into 64 bits."""
    try:
        return np.array(values, dtype)
    except OverflowError:
        raise InputError(f"{origin}: a number below is too large; correct it") from None


def table(values: NDArray[Any], counts: Ints, width: int, fill: float = 0) -> NDArray[Any]:
    """(n_lines, width): the first `width` numbers of each line, and `fill` where a line has fewer."""
    first = np.cumsum(counts) - counts
    if len(counts) and (counts == counts[0]).all():
        rows = values.reshape(len(counts), -1)[:, :width]
        padding = np.full((len(rows), width - rows.shape[1]), fill, values.dtype)
        return np.concatenate([rows, padding], axis=1) if padding.size else rows
    rows = np.full((len(counts), width), fill, values.dtype)
    for column in range(width):
        present = counts > column
        rows[present, column] = values[first[present] + column]
    return rows


def columns(text: bytes, widths: list[list[int]], dtype: type[Number]) -> NDArray[Any] | None:
    """Numbers (n_rows, n_fields) in fixed columns; a row has a line for each list of widths. Blank fields are 0.

    `text` must have no comments and no empty lines. None if a field is not a number.
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
    tables = []
    for card, fields in enumerate(widths):
        start, length = starts[card::n_lines, None], (ends - starts)[card::n_lines, None]
        column = np.arange(sum(fields))
        line = np.where(column < length, characters[np.minimum(start + column, len(characters) - 1)], ord(" "))
        with_commas = np.full((len(line), sum(fields) + len(fields)), ord(","), np.uint8)
        first = 0
        for i, width in enumerate(fields):
            entry = line[:, first : first + width]
            entry[(entry == ord(" ")).all(axis=1), -1] = ord("0")
            with_commas[:, first + i : first + i + width] = entry
            first += width
        values = _scan(with_commas.tobytes()[:-1], dtype)
        if values is None or len(values) != len(line) * len(fields):
            return None
        tables.append(values.reshape(len(line), -1))
    return np.concatenate(tables, axis=1)
