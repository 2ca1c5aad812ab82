"""Progress of many runs and tables of results: with bars, colours and wrapped cells on a terminal, else plain lines."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Table
from rich.text import Text

#: Columns of a plain table, which is not wrapped.
_UNLIMITED = 100_000


def share_done(log: Sequence[str]) -> float:
    """The progress that the log of a run reports, from 0 to 1."""
    found = (re.match(r" *(\d+)%  ", line) for line in reversed(log))
    return next((int(match[1]) / 100 for match in found if match), 0.0)


class Screen:
    """Lines on stderr; in colour and with bars below them on a terminal only; nothing if `quiet`."""

    def __init__(self, quiet: bool = False) -> None:
        self._console = Console(stderr=True, quiet=quiet, soft_wrap=True, highlight=False)
        self._bars = Progress(
            TaskProgressColumn(), BarColumn(), TextColumn("{task.description}", markup=False),
            console=self._console, transient=True, auto_refresh=False, disable=quiet or not self._console.is_terminal,
        )  # fmt: skip

    def print(self, text: str, style: str = "") -> None:
        """Print a line that stays."""
        self._console.print(Text(text, style))

    def show(self, shares: Mapping[str, float], waiting: int) -> None:
        """Replace the bars by these of the named runs."""
        for task in self._bars.task_ids:
            self._bars.remove_task(task)
        for name, share in shares.items():
            self._bars.add_task(name, total=100, completed=round(100 * share))
        self._bars.add_task(f"{waiting} waiting", total=None, visible=waiting > 0)
        if shares:
            self._bars.start()
            self._bars.refresh()
        else:
            self._bars.stop()


def print_table(headings: Sequence[str], rows: Sequence[tuple[Sequence[str], str]], *, n_texts: int = 0) -> None:
    """Print rows of cells, each with a remark or "" at its end; the parts of a heading "name, unit" are stacked.

    The first `n_texts` columns are aligned to the left.
    """
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for i, heading in enumerate(headings):
        table.add_column(Text(heading.replace(", ", "\n")), justify="left" if i < n_texts else "right")
    if any(remark for _, remark in rows):
        table.add_column()
    for cells, remark in rows:
        table.add_row(*(Text(cell) for cell in [*cells, *[""] * (len(headings) - len(cells)), remark]))
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _UNLIMITED
    with console.capture() as capture:
        console.print(table)
    print(*(line.rstrip() for line in capture.get().splitlines()), sep="\n")
