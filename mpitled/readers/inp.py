"""The text of Abaqus decks: keywords with parameters and data, from the deck and all its includes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from mpitled.errors import InputError
from mpitled.readers.text import Block, KeywordLine, decode, read_text, real, where

COMMENT = "**"
_KIND = "an Abaqus deck (.inp)"
_WITH_FILE = ("NODE", "ELEMENT", "NSET", "ELSET", "SURFACE")  # keywords with data in the file INPUT=


@dataclass(slots=True)
class Keyword(KeywordLine):
    """A keyword line with its parameters, and the data below it."""

    text: str  # the keyword as written, with its asterisk
    parameters: dict[str, str]  # names in upper case, without blanks
    data: list[Block] = field(default_factory=list)

    @property
    def shown(self) -> str:
        """The keyword in messages."""
        return self.text

    def need(self, name: str) -> str:
        """The value of a parameter; InputError if it is missing or empty."""
        if not self.parameters.get(name):
            self.fail(f"has no {name}=; give it")
        return self.parameters[name]

    def rows(self) -> Iterator[tuple[str, list[str]]]:
        """Origin and fields of each line of data; a comma at the end of the line makes no field."""
        for block in self.data:
            for line, text in block.lines(COMMENT):
                yield where(block.path, line), fields(text.removesuffix(","))

    def numbers(self, most: int) -> list[tuple[str, list[float]]]:
        """Origin and numbers of the first `most` lines of data; an empty field is 0."""
        return [
            (origin, [real(entry, origin) if entry else 0.0 for entry in entries])
            for origin, entries in islice(self.rows(), most)
        ]


def collect(path: Path, home: Path, found: list[Keyword], within: tuple[Path, ...], opened: list[Path]) -> None:
    """Append the keywords of a file and its includes to `found`, in text order, and the files to `opened`."""
    text = read_text(path, _KIND)
    opened.append(path)
    within = (*within, path.resolve())
    line, at = 1, 0  # the first line that is not yet read
    for begin in _keyword_lines(text):
        if not found and any(True for _ in Block(path, 1, text, at, begin).lines(COMMENT)):
            raise InputError(f"{where(path, 1)}: is not an Abaqus deck; it has data before the first keyword")
        _add_data(found, path, line, text, at, begin)
        line += text.count(b"\n", at, begin)
        keyword, end = _keyword(path, line, text, begin)
        if keyword.name == "INCLUDE":
            included = keyword.include(keyword.need("INPUT"), (home,), within, len(opened))
            collect(included, home, found, within, opened)
        else:
            found.append(keyword)
            if keyword.name in _WITH_FILE and "INPUT" in keyword.parameters:
                named = keyword.include(keyword.need("INPUT"), (home,), within, len(opened))
                opened.append(named)
                keyword.data.append(Block.of(named, 1, read_text(named, _KIND)))
        line += text.count(b"\n", begin, end)
        at = end
    if not found:
        first = next((decode(raw).strip() for raw in text.split(b"\n", 100) if raw.strip()), "")
        raise InputError(
            f"{path}: is not an Abaqus deck; no line is a keyword such as *NODE (it begins {first[:40]!r})"
        )
    _add_data(found, path, line, text, at, len(text))


def _keyword_lines(text: bytes) -> Iterator[int]:
    """Starts of the lines with exactly one asterisk as their first character."""
    at = text.find(b"*")
    while at >= 0:
        begin = text.rfind(b"\n", 0, at) + 1
        if text[at + 1 : at + 2] != b"*" and not text[begin:at].strip():
            yield begin
        end = text.find(b"\n", at)
        at = text.find(b"*", end) if end >= 0 else -1


def _add_data(found: list[Keyword], path: Path, line: int, text: bytes, start: int, stop: int) -> None:
    if found and start < stop:
        found[-1].data.append(Block(path, line, text, start, stop))


def _keyword(path: Path, line: int, text: bytes, begin: int) -> tuple[Keyword, int]:
    """The keyword at text[begin:], and the start of its data. A comma at the end of a line continues the keyword."""
    end = text.find(b"\n", begin) + 1 or len(text)
    words = decode(text[begin:end]).strip()
    while words.endswith(","):
        after = text.find(b"\n", end) + 1 or len(text)
        following = decode(text[end:after]).strip()
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
    return Keyword("".join(name[1:].split()).upper(), path, line, " ".join(name.split()), parameters), end


def fields(text: str) -> list[str]:
    """Fields between commas, without blanks around them; commas in quotation marks do not separate."""
    if '"' not in text:
        return [entry.strip() for entry in text.split(",")]
    parts = text.split('"')
    parts[::2] = [outside.replace(",", "\n") for outside in parts[::2]]
    return [entry.strip() for entry in '"'.join(parts).split("\n")]
