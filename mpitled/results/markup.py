"""HTML pages in one file each: all text is escaped, pictures are embedded, and nothing is fetched or executed."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

#: With this policy browsers refuse everything that is not in the page itself.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture in a page; `alt` is the description for readers who cannot see the picture."""

    png: bytes
    alt: str
    caption: str = ""


def render(template: str, **context: Any) -> str:
    """The HTML text of a template in the folder `templates`, filled in with its variables."""
    environment = Environment(
        loader=PackageLoader("mpitled.results"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {
        "base64": _base64,
        "breakable": _breakable,
        "filled": _filled,
        "number_columns": _number_columns,
    }
    return environment.get_template(template).render(policy=Markup(POLICY), **context) + "\n"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _filled(sections: Sequence[tuple[str, Markup]]) -> list[tuple[str, Markup]]:
    """The sections (heading, body) that have a body."""
    return [section for section in sections if section[1].strip()]


def _breakable(heading: str) -> Markup:
    """The heading with a possible line break after each dot of a deck's key."""
    return Markup(re.sub(r"(?<=[a-z])\.(?=\w)|(?<=\w)\.(?=[a-z])", ".<wbr>", str(escape(heading))))


def _number_columns(rows: Sequence[Sequence[str]]) -> list[bool]:
    """Whether all cells of each column are numbers or empty; shorter rows are ignored."""
    width = max(map(len, rows), default=0)
    return [all(map(_is_number, column)) for column in zip(*(row for row in rows if len(row) == width), strict=True)]


def _is_number(cell: str) -> bool:
    return not cell or cell[0].isdigit() or (cell[0] in "+-." and cell[1:2].isdigit())
