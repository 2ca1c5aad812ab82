"""Charts of numbers, not of meshes: error against run time, and what else compares runs with one another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

#: Colours and marks of families of runs, told apart by the colour-blind (Okabe and Ito 2008).
_COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_MARKERS = "os^Dv<>P"
_INK = "#222222"


def _plain(value: float, _: Any) -> str:
    """A tick of a logarithmic axis as a plain number; of those between the powers of ten only some."""
    text = f"{value:g}"
    return text if text.strip("0.")[:1] in ("1", "2", "3", "5", "7") else ""


def draw_study(rows: list[dict[str, Any]], path: Path, error: str) -> None:
    """Error against loop time of the runs of a study, a line for each family, the best ringed (Pareto)."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    done = [row for row in rows if row["max_error_mm"] != ""]
    families = list(dict.fromkeys(row["family"] for row in done))
    for i, family in enumerate(families):
        points = [(row["loop_s"], row["max_error_mm"], row["value"]) for row in done if row["family"] == family]
        style: dict[str, Any] = {"color": _COLOURS[i % len(_COLOURS)], "marker": _MARKERS[i % len(_MARKERS)]}
        axes.plot([x for x, _, _ in points], [y for _, y, _ in points], label=family, linewidth=0.8, **style)
        for x, y, value in points:
            axes.annotate(value, (x, y), xytext=(5, 4), textcoords="offset points", fontsize=7, color=style["color"])
    best = sorted((row["loop_s"], row["max_error_mm"]) for row in done if row["pareto"])
    axes.plot(
        [x for x, _ in best], [y for _, y in best], color=_INK, linestyle="--", linewidth=1, marker="o", markersize=12,
        markerfacecolor="none", label="none is better in both (Pareto)",
    )  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="time of the loop, s", ylabel=error)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(_plain)
        axis.set_minor_formatter(_plain)
    axes.margins(0.12)
    axes.grid(True, which="both", linewidth=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=150)


def draw_prediction(rows: list[dict[str, Any]], subject: str, assumptions: str, path: Path) -> None:
    """Efficiency against the number of parts, as predicted, and what of it the balance alone would leave."""
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    parts = [row["parts"] for row in rows]
    lines = {
        "balance of the partition alone": [100 / row["balance"] for row in rows],
        "exchange overlapped with computing": [100 * row["efficiency_overlapped"] for row in rows],
        "exchange after computing": [100 * row["efficiency"] for row in rows],
    }
    for i, (label, values) in enumerate(lines.items()):
        axes.plot(parts, values, label=label, color=_COLOURS[i], marker=_MARKERS[i], linewidth=1.2)
    for row in rows:
        text = f"{row['cells_mean']:,.0f} cells\n{row['step_us']:,.0f} \u00b5s a step"
        place = (row["parts"], 100 * row["efficiency"])
        axes.annotate(text, place, xytext=(-8, -8), textcoords="offset points", fontsize=7, ha="right", va="top")
    axes.set(xscale="log", ylim=(0, 105), xlabel="ranks", ylabel="predicted efficiency, %")
    axes.set_xticks(parts, [str(n) for n in parts])
    axes.minorticks_off()
    axes.margins(x=0.15)
    axes.grid(True, linewidth=0.3)
    axes.legend(fontsize=8, loc="lower left")
    axes.set_title(f"{subject}: {assumptions}", fontsize=8, loc="left")
    figure.savefig(path, dpi=150)
