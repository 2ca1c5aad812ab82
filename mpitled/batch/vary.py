"""What studies and sweeps vary: values of the deck's keys, from words of the command line or from a table."""

from __future__ import annotations

import csv
import hashlib
import re
from collections.abc import Container, Sequence
from itertools import product
from pathlib import Path

from mpitled.errors import InputError

Values = dict[str, str]  # by key, as they are written after "="


class Line(Values):
    """The values of a line of a table."""

    def __init__(self, place: str, values: Values) -> None:
        super().__init__(values)
        self.place = place  # for messages


def family(text: str) -> list[Values]:
    """The values of "key=a,b,c" in turn.

    A list is a value: "block.elements=[4,4,4],[8,8,8]". Keys that go together are joined by "+": "a=1,2+b=3,4" is
    a = 1, b = 3, then a = 2, b = 4.
    """
    keys, columns = [], []
    for part in text.split("+"):
        key, equals, values = (word.strip() for word in part.partition("="))
        column = [value.strip() for value in re.split(r",(?![^\[]*\])", values)]
        if not equals or not key or not all(column):
            raise InputError(f"--vary {text}: is not key=value,value,...; write for example cloud.growth=0.15,0.2")
        keys.append(key)
        columns.append(column)
    if len({len(column) for column in columns}) > 1:
        raise InputError(f"--vary {text}: keys that go together need as many values each")
    return [dict(zip(keys, chosen, strict=True)) for chosen in zip(*columns, strict=True)]


def grid(vary: Sequence[str]) -> list[Values]:
    """Every value of each family with every value of the others; the last family runs fastest."""
    families = [family(text) for text in vary]
    keys = [key for some in families for key in some[0]]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise InputError(f"--vary {twice[0]}: is varied twice; give all of its values at once")
    return [{key: value for some in chosen for key, value in some.items()} for chosen in product(*families)]


def table(path: Path, results: Container[str] = ()) -> list[Line]:
    """The cases of a CSV file: keys in its first line, then the values of a case in each; an empty one leaves it.

    Lines that begin with # are not read, nor columns of `results` or of the number of the case: a sweep's own table
    is good as well.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(row)]
        lines = [(number, row) for number, row in lines if not row[0].startswith("#")]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV ({error}); give keys, and below them values") from None
    if lines and len(lines[0][1]) == 1 and ";" in lines[0][1][0]:
        raise InputError(f"{path}: line {lines[0][0]}: separate by commas, not semicolons, and decimals by points")
    if len(lines) < 2:
        raise InputError(f"{path}: has no cases; give keys in the first line, and a line of values for each case")
    (first, keys), *rows = lines
    if len(set(keys)) < len(keys) or not all(keys):
        raise InputError(f"{path}: line {first}: has a key twice or an empty one; name each column by its key")
    for number, row in rows:
        if len(row) != len(keys):
            raise InputError(f"{path}: line {number}: has {len(row)} values for {len(keys)} keys")
    own = "case" in keys  # where every number is written as 5.0
    cases = []
    for number, row in rows:
        cells = [re.sub(r"\.0$", "", value) if own else value for value in row]
        given = {key: v for key, v in zip(keys, cells, strict=True) if v and key != "case" and key not in results}
        cases.append(Line(f"{path}: line {number}", given))
    return cases


def overrides(base: Sequence[str], values: Values) -> tuple[str, ...]:
    """What a run takes for these values, after what is for all."""
    return (*base, *words(values))


def words(values: Values) -> list[str]:
    """The values as overrides, "key=value"."""
    return [f"{key}={value}" for key, value in values.items()]


def folder(words: str, content: str) -> str:
    """A folder's name that a person can read, and no other content has."""
    readable = "".join(c if c.isalnum() or c in "._-" else "-" for c in words)
    return f"{readable[:60]}-{hashlib.sha256(content.encode()).hexdigest()[:8]}"
