"""The text of Abaqus decks: keywords with their parameters and data, through all files that they include."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

from mpitled.errors import InputError
from mpitled.readers import meshfile
from mpitled.readers.meshfile import Block, decoded, where

COMMENT = "**"
WHAT = "an Abaqus deck (.inp)"
MOST_INCLUDES = 1000


@dataclass(slots=True)
class Keyword:
    """A keyword line with its parameters, and the data below it."""

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
                yield where(block.path, line), fields(text.removesuffix(","))

    def numbers(self, most: int) -> list[tuple[str, list[float]]]:
        """The first `most` lines of data as numbers; an empty field is 0."""
        found = []
        for origin, fields in self.rows():
            found.append((origin, [meshfile.real(entry, origin) if entry else 0.0 for entry in fields]))
            if len(found) == most:
                break
        return found


def collect(path: Path, home: Path, found: list[Keyword], within: tuple[Path, ...], opened: list[Path]) -> None:
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
            collect(included, home, found, within, opened)
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


def _add_data(found: list[Keyword], path: Path, line: int, text: bytes, start: int, stop: int) -> None:
    if found and start < stop:
        found[-1].data.append(Block(path, line, text, start, stop))


def _keyword(path: Path, line: int, text: bytes, begin: int) -> tuple[Keyword, int]:
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
    name, *entries = fields(words)
    parameters = {}
    for entry in entries:
        key, _, value = entry.partition("=")
        parameters["".join(key.split()).upper()] = value.strip().strip('"').strip()
    shown = " ".join(name.split())
    return Keyword("".join(name[1:].split()).upper(), shown, parameters, path, line), end


def fields(text: str) -> list[str]:
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


def _included(keyword: Keyword, name: str, home: Path, within: tuple[Path, ...], opened: list[Path]) -> Path:
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
    keyword.fail(f"names {name}, which is not there; paths are relative to {keyword.path.name}")
