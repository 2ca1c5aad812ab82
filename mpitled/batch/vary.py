"""The values of deck keys that studies and sweeps vary, from the command line or from a CSV table."""

from __future__ import annotations

import csv
import hashlib
import re
from collections.abc import Container, Sequence
from itertools import product
from pathlib import Path

from mpitled.errors import InputError


class Values(dict[str, str]):
    """The value of each varied key as the text of an override."""

    def __init__(self, values: dict[str, str], source: str = "") -> None:
        super().__init__(values)
        self.source = source  # file and line of the values, for messages

    @property
    def overrides(self) -> list[str]:
        """The values as overrides, "key=value"."""
        return [f"{key}={value}" for key, value in self.items()]


def family(text: str) -> list[Values]:
    """The values of "key=a,b,c". InputError for other texts.

    A list is one value: "block.elements=[4,4,4],[8,8,8]". Keys that vary together are joined by "+": "a=1,2+b=3,4" is
    a = 1, b = 3, then a = 2, b = 4.
    """
    columns: dict[str, list[str]] = {}
    for part in text.split("+"):
        key, equals, values = (word.strip() for word in part.partition("="))
        column = [value.strip() for value in re.split(r",(?![^\[]*\])", values)]
        if not equals or not key or not all(column):
            raise InputError(f"--vary {text}: is not key=value,value,...; write for example cloud.growth=0.15,0.2")
        columns[key] = column
    if len({len(column) for column in columns.values()}) > 1:
        raise InputError(f"--vary {text}: keys that vary together need equally many values")
    return [Values(dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]


def grid(vary: Sequence[str]) -> list[Values]:
    """All combinations of the values of the families; the last family varies fastest."""
    families = [family(text) for text in vary]
    keys = [key for members in families for key in members[0]]
    if repeated := [key for key in keys if keys.count(key) > 1]:
        raise InputError(f"--vary {repeated[0]}: is varied twice; give all of its values at once")
    return [Values({k: v for values in row for k, v in values.items()}) for row in product(*families)]


def read_csv(path: Path, needed: str) -> list[tuple[int, list[str]]]:
    """The cells of each line of a CSV file with its number, without empty lines and comments (#).

    InputError, with the remedy `needed`, if the file is no CSV.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV ({error}); {needed}") from None
    return [(number, row) for number, row in lines if not row[0].startswith("#")]


def table(path: Path, results: Container[str] = ()) -> list[Values]:
    """The cases of a CSV file: keys in the first line, then a line of values for each case; empty cells are skipped.

    The columns "case" and `results` are ignored, so that the table of a sweep can be given unchanged.
    """
    lines = read_csv(path, "give keys in the first line, and a line of values for each case")
    if lines and len(lines[0][1]) == 1 and ";" in lines[0][1][0]:
        raise InputError(f"{path}: line {lines[0][0]}: separate by commas, not semicolons, and decimals by points")
    if len(lines) < 2:
        raise InputError(f"{path}: has no cases; give keys in the first line, and a line of values for each case")
    (first, keys), *rows = lines
    if len(set(keys)) < len(keys) or not all(keys):
        raise InputError(f"{path}: line {first}: has a key twice or an empty one; name each column by its key")
    cases = []
    for number, row in rows:
        if len(row) != len(keys):
            raise InputError(f"{path}: line {number}: has {len(row)} values for {len(keys)} keys")
        if "case" in keys:  # the table of a sweep has 5.0 for 5
            row = [re.sub(r"\.0$", "", value) for value in row]
        values = {k: v for k, v in zip(keys, row, strict=True) if v and k != "case" and k not in results}
        cases.append(Values(values, f"{path}: line {number}"))
    return cases


def folder_name(label: str, content: str) -> str:
    """A readable name with a hash of the content."""
    readable = "".join(c if c.isalnum() or c in "._-" else "-" for c in label)
    return f"{readable[:60]}-{hashlib.sha256(content.encode()).hexdigest()[:8]}"
