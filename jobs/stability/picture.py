"""The picture of the stability matrix: a panel for each axis, kinds and methods down, values across."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

#: Fill and text colours of the outcomes; they differ in lightness too.
COLOURS = {
    "completed": ("#cbe7f8", "#222222"),
    "stopped": ("#f0c75e", "#222222"),
    "warned": ("#b8b8b8", "#222222"),
    "buckled": ("#7a9a8f", "#222222"),
    "wrong": ("#5a1f00", "#ffffff"),
}
LEGEND = (
    "number: largest difference from the reference (a closed form or another run), mm; percentage: share of the load",
    "completed: the difference is at most 3 times the error that the run and the reference report, above all their",
    "distance from rest; a ramp that is millimetres off completes if it reports that",
    "warned: it is larger, and there is a warning; buckled: larger, with less energy than the closed form; wrong: else",
)
CELL = (0.82, 0.2)  # inches
LEFT, HEAD, WIDTH = 1.5, 0.62, 6.6  # inches left of the cells of a panel, above them, and of a panel
PANELS = 3  # side by side


def draw(rows: list[dict[str, Any]], path: Path) -> Figure:
    """Draw and save rows of the table; their values may also be text, as a CSV reader gives them."""
    panels: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        panels.setdefault(row["axis"], []).append(row)
    filled = [0.4 + 0.16 * len(LEGEND)] * PANELS  # inches from the top in each column of panels
    corners = {}
    for name, cells in panels.items():
        column = filled.index(min(filled))
        corners[name] = column * WIDTH + LEFT, filled[column] + HEAD
        filled[column] += HEAD + CELL[1] * len({(cell["kind"], cell["method"]) for cell in cells})
    width, height = WIDTH * min(PANELS, len(panels)), max(filled) + 0.1
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    axes.axis("off")

    def write(x: float, y: float, text: str, **style: Any) -> None:
        axes.text(x, y, text, **{"fontsize": 7, "va": "center", "color": "#222222", **style})

    def fill(x: float, y: float, text: str, outcome: str) -> None:
        colour, ink = COLOURS[outcome]
        axes.fill_between([x, x + CELL[0]], y, y + CELL[1], facecolor=colour, edgecolor="white", linewidth=0.8)
        write(x + 0.5 * CELL[0], y + 0.5 * CELL[1], text, ha="center", color=ink)

    for i, outcome in enumerate(COLOURS):
        fill(0.1 + 1.2 * i * CELL[0], 0.1, outcome, outcome)
    for i, words in enumerate(LEGEND):
        write(0.1, 0.42 + 0.16 * i, words)
    for name, (left, top) in corners.items():
        cells = panels[name]
        values = list(dict.fromkeys(cell["value"] for cell in cells))
        runs = list(dict.fromkeys((cell["kind"], cell["method"]) for cell in cells))
        write(left - LEFT + 0.1, top - 0.37, f"{name}: {cells[0]['about']}", fontsize=8, fontweight="bold")
        for i, value in enumerate(values):
            write(left + (i + 0.5) * CELL[0], top - 0.1, value, ha="center")
        for j, run in enumerate(runs):
            write(left - 0.08, top + (j + 0.5) * CELL[1], ", ".join(run), ha="right")
        for cell in cells:
            i, j = values.index(cell["value"]), runs.index((cell["kind"], cell["method"]))
            fill(left + i * CELL[0], top + j * CELL[1], _words(cell), cell["outcome"])
    figure.savefig(path, dpi=150)
    return figure


def _words(cell: dict[str, Any]) -> str:
    """The error, mm, or the share of the load at which the run stopped, or how it ended."""
    if cell["error_mm"] != "":
        return f"{float(cell['error_mm']):.2g}"
    reached = re.search(r"unstable at ([\d.]+%)", cell["message"])
    endings = {"3": "stalled", "2": "refused", "0": "no estimate"}
    return reached[1] if reached else endings.get(str(cell["status"]), "killed")
