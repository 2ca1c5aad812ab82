"""HTML pages that are one file each: all text is escaped, pictures are embedded, and nothing is fetched or executed."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

#: Browsers enforce that a page is one file.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture in a page, with its description for readers who do not see it."""

    png: bytes
    alt: str
    caption: str = ""


def render(template: str, **context: Any) -> str:
    """The page that a template makes of its variables; the templates are in the folder `templates`."""
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
    """The heading with places after the dots of a deck's key where a line may break."""
    return Markup(re.sub(r"(?<=[a-z])\.(?=\w)|(?<=\w)\.(?=[a-z])", ".<wbr>", str(escape(heading))))


def _number_columns(rows: Sequence[Sequence[str]]) -> list[bool]:
    """Whether all cells of a column are numbers or empty; shorter rows do not count."""
    width = max(map(len, rows), default=0)
    return [all(map(_is_number, column)) for column in zip(*(row for row in rows if len(row) == width), strict=True)]


def _is_number(cell: str) -> bool:
    return not cell or cell[0].isdigit() or (cell[0] in "+-." and cell[1:2].isdigit())
