"""Pages of HTML that are one file: text is escaped, pictures are inside, nothing is fetched and nothing runs."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Sequence
from html import escape

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>
{style}
</style>
</head>
<body>
{body}
</body>
</html>
"""
#: Browsers see to it that a page is one file.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_STYLE = """\
:root { --ink: #1f2328; --faint: #57606a; --line: #d0d7de; --ground: #f6f8fa; --accent: #0b5cad; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 76rem; padding: 1.5rem; color: var(--ink); background: #fff;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.8rem; line-height: 1.25; margin: 0.5rem 0; overflow-wrap: anywhere; }
h2 { font-size: 1.3rem; margin: 0 0 0.8rem; }
section { border-top: 1px solid var(--line); margin-top: 2rem; padding-top: 1.5rem; }
nav { display: flex; flex-wrap: wrap; gap: 0.3rem 1.2rem; margin-top: 1rem; }
a { color: var(--accent); }
p { max-width: 60rem; margin: 0 0 1rem; }
.faint { color: var(--faint); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.4rem, 1fr)); gap: 0.8rem; margin: 1.2rem 0; }
.card { border: 1px solid var(--line); border-radius: 6px; padding: 0.6rem 0.9rem; background: var(--ground); }
.card b { display: block; font-size: 1.35rem; font-variant-numeric: tabular-nums; }
.card span { color: var(--faint); font-size: 0.88rem; }
.note { border-left: 5px solid #b35900; background: #fff4e5; padding: 0.7rem 1rem; margin: 1rem 0; }
.note p { margin: 0.2rem 0; }
.wide { overflow-x: auto; margin: 0 0 1.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding: 0.3rem 0; }
th, td { padding: 0.3rem 0.9rem 0.3rem 0; text-align: left; border-bottom: 1px solid var(--line); vertical-align: top; }
table.dense { font-size: 0.86rem; }
.dense th, .dense td { padding-right: 0.55rem; }
td.number, th.number { text-align: right; }
td.bar { width: 20rem; min-width: 8rem; }
td.bar div { height: 0.9rem; margin-top: 0.3rem; background: var(--accent); }
figure { margin: 0 0 1.5rem; }
figure img { display: block; max-width: 100%; height: auto; padding: 0.6rem; border: 1px solid var(--line); }
figcaption { color: var(--faint); font-size: 0.92rem; margin-top: 0.4rem; max-width: 60rem; }
details { margin: 0 0 1.2rem; }
summary { cursor: pointer; color: var(--accent); margin-bottom: 0.4rem; }
pre { overflow-x: auto; background: var(--ground); border: 1px solid var(--line); padding: 0.8rem; font-size: 0.85rem; }
@media print { section { break-inside: avoid; } nav { display: none; } }"""


#: A table of more columns is set close, so that all of them are seen at once.
_MANY = 8


def page(title: str, head: Sequence[str], sections: Sequence[tuple[str, Sequence[str]]]) -> str:
    """A page: its title, what is above all sections, and the sections by their headings; an empty one is left out.

    Parts are HTML, as the other functions make it; title and headings are text.
    """
    filled = [(heading, parts) for heading, parts in sections if parts]
    links = [f'<a href="#s{i}">{escape(heading)}</a>' for i, (heading, _) in enumerate(filled)]
    body = [f"<header><h1>{escape(title)}</h1>", *head]
    if links:
        body += ['<nav aria-label="Sections">', *links, "</nav>"]
    body.append("</header>")
    for i, (heading, parts) in enumerate(filled):
        body += [f'<section id="s{i}"><h2>{escape(heading)}</h2>', *parts, "</section>"]
    return _PAGE.format(title=escape(title), policy=POLICY, style=_STYLE, body="\n".join(body))


def text(words: str, kind: str = "") -> str:
    """A paragraph."""
    return f"<p{_class(kind)}>{escape(words)}</p>"


def note(lines: Iterable[str]) -> str:
    """What must not be overlooked."""
    return f'<div class="note" role="note">{"".join(text(line) for line in lines)}</div>'


def cards(figures: Iterable[tuple[str, str]]) -> str:
    """The few figures that matter, with their names."""
    made = (f'<div class="card"><b>{escape(value)}</b><span>{escape(name)}</span></div>' for name, value in figures)
    return f'<div class="cards">{"".join(made)}</div>'


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], *, caption: str = "") -> str:
    """A table; columns whose cells are all numbers are set to the right. Without headings the first cell is one.

    The last cell of a row that is shorter than the others goes across what it lacks.
    """
    cells = [list(row) for row in rows]
    width = max(map(len, cells), default=0)
    whole = [row for row in cells if len(row) == width]
    kinds = ["number" * all(map(_is_number, column)) for column in zip(*whole, strict=True)]
    made = [f"<caption>{escape(caption)}</caption>"] if caption else []
    if headings:
        made.append(
            _row(
                f'<th scope="col"{_class(kind)}>{_breakable(of)}</th>' for of, kind in zip(headings, kinds, strict=True)
            )
        )
    for first, *others in cells:
        tag = "td" if headings else 'th scope="row"'
        tags = [f"<{tag}{_class(kinds[0])}>{escape(first)}</{tag[:2]}>"]
        if lacks := width - 1 - len(others):
            *others, last = others
        tags += [f"<td{_class(kind)}>{escape(cell)}</td>" for cell, kind in zip(others, kinds[1:], strict=False)]
        tags += [f'<td colspan="{1 + lacks}">{escape(last)}</td>'] if lacks else []
        made.append(_row(tags))
    kind = "dense" * (width > _MANY)
    return f'<div class="wide"><table{_class(kind)}>{"".join(made)}</table></div>'


def bars(caption: str, unit: str, values: Sequence[tuple[str, float]]) -> str:
    """Values with a bar for each, as a table."""
    largest = max((value for _, value in values), default=0.0) or 1.0
    rows = [f"<caption>{escape(caption)}</caption>"]
    for name, value in values:
        number = f"{value if value >= 1e-3 else 0:.3g} {escape(unit)}"
        bar = f'<div style="width:{100 * value / largest:.1f}%"></div>'
        cells = (
            f'<th scope="row">{escape(name)}</th>',
            f'<td class="number">{number}</td>',
            f'<td class="bar">{bar}</td>',
        )
        rows.append(_row(cells))
    return f'<div class="wide"><table>{"".join(rows)}</table></div>'


def picture(png: bytes, alt: str, caption: str = "") -> str:
    """A picture inside of the page, and in words for who does not see it."""
    data = base64.b64encode(png).decode("ascii")
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img src="data:image/png;base64,{data}" alt="{escape(alt)}">{below}</figure>'


def listed(items: Iterable[str]) -> str:
    """A list."""
    return f"<ul>{''.join(f'<li>{escape(item)}</li>' for item in items)}</ul>"


def plain(lines: Iterable[str]) -> str:
    """Lines as they are, such as a file's."""
    return f"<pre>{escape(chr(10).join(lines))}</pre>"


def folded(summary: str, *parts: str) -> str:
    """Parts that are shown when they are asked for."""
    return f"<details><summary>{escape(summary)}</summary>{''.join(parts)}</details>"


def _row(cells: Iterable[str]) -> str:
    return f"<tr>{''.join(cells)}</tr>"


def _breakable(heading: str) -> str:
    """Escaped, so that a long key of a deck may go on in another line after its dots."""
    return re.sub(r"(?<=[a-z])\.(?=\w)|(?<=\w)\.(?=[a-z])", ".<wbr>", escape(heading))


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""


def _is_number(cell: str) -> bool:
    return not cell or cell[0].isdigit() or (cell[0] in "+-." and cell[1:2].isdigit())
