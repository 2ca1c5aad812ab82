"""Progress of many runs and tables of results: bars, colours and wrapped cells on a terminal, plain lines elsewhere."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Table
from rich.text import Text

#: Width of a table outside a terminal: its rows are not wrapped.
_UNLIMITED = 100_000
_HEADING = 16  # characters in a line of a heading


def share_done(log: Sequence[str]) -> float:
    """The last progress in the log of a run, from 0 to 1."""
    matches = (re.match(r" *(\d+)%  ", line) for line in reversed(log))
    return next((int(match[1]) / 100 for match in matches if match), 0.0)


class Screen:
    """Lines on stderr, on a terminal in colour and with progress bars below them; nothing if `quiet`."""

    def __init__(self, quiet: bool = False) -> None:
        self._console = Console(stderr=True, quiet=quiet, soft_wrap=True, highlight=False)
        self._bars = Progress(
            TaskProgressColumn(), BarColumn(), TextColumn("{task.description}", markup=False),
            console=self._console, transient=True, auto_refresh=False, disable=quiet or not self._console.is_terminal,
        )  # fmt: skip

    def print(self, text: str, style: str = "") -> None:
        """Print a line above the bars."""
        self._console.print(Text(text, style))

    def show(self, shares: Mapping[str, float], waiting: int) -> None:
        """Show a bar for each run (name: progress from 0 to 1), and the number of waiting runs."""
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
    """Print rows, each a list of cells and a remark ("": none). The first `n_texts` columns are aligned to the left."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for i, heading in enumerate(headings):
        table.add_column(
            Text(textwrap.fill(heading, _HEADING, break_long_words=False)), justify="left" if i < n_texts else "right"
        )
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
