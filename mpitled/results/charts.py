"""Charts of the numbers of one run against time, and of several runs against each other."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, MaxNLocator, PercentFormatter
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

#: Colours and markers of families of runs, distinct to the colour-blind (Okabe and Ito 2008).
_COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_MARKERS = "os^Dv<>P"
_INK = "#222222"
_Target = Path | BinaryIO

#: Trial positions of a label relative to its point: distances (typographic points) and angles (degrees).
_DISTANCES = (7, 14, 26, 40, 56, 74)
_ANGLES = (35, 145, -35, -145, 0, 180, 90, -90, 62, 118, -62, -118)

#: A point of a chart with its label: x, y, text, colour.
Label = tuple[float, float, str, str]


def _logarithmic(axes: Axes, x: str, y: str) -> None:
    """Make both axes logarithmic, with labels x and y, and a grid with a number at each line."""
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    axes.margins(0.12)
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        multiples = [2.0, 3.0, 5.0, 7.0] if high < 100 * low else [3.0]
        axis.set_minor_locator(LogLocator(subs=multiples, numticks=50))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}")
    axes.grid(True, which="both", linewidth=0.3)


def _label_points(figure: Figure, axes: Axes, labels: Sequence[Label], size: int = 7) -> None:
    """Write each label near its point without covering other points and labels; a line joins a distant label.

    This function fixes the figure's layout. The figure must be complete apart from these labels.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    radius = 4 * figure.dpi / 72
    points = axes.transData.transform([label[:2] for label in labels])
    occupied = [Bbox.from_extents(*(point - radius), *(point + radius)) for point in points]
    frame = axes.get_window_extent()
    for x, y, text, colour in labels:
        for distance, angle in product(_DISTANCES, np.deg2rad(_ANGLES)) if text else ():
            right, up = np.cos(angle), np.sin(angle)
            line = {"arrowstyle": "-", "color": colour, "linewidth": 0.5} if distance > _DISTANCES[0] else None
            note = axes.annotate(
                text, (x, y), xytext=(distance * right, distance * up), textcoords="offset points", fontsize=size,
                color=colour, arrowprops=line, ha="center" if abs(right) < 0.5 else "left" if right > 0 else "right",
                va="center" if abs(up) < 0.5 else "bottom" if up > 0 else "top",
            )  # fmt: skip
            note.get_window_extent()  # computes the position of the text
            box = Text.get_window_extent(note)
            inside = np.all(box.min > frame.min) and np.all(box.max < frame.max)
            if inside and not box.count_overlaps(occupied):
                occupied.append(box)
                break
            note.remove()


def draw_study(rows: list[dict[str, Any]], path: Path, error: str) -> Figure:
    """Draw error against loop time for the runs of a study: a line for each family, rings around Pareto optima."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    axes = figure.add_subplot()
    finished = [row for row in rows if row["max_error_mm"] != ""]
    labels: list[Label] = []
    for i, family in enumerate(dict.fromkeys(row["family"] for row in finished)):
        points = [(row["loop_s"], row["max_error_mm"], row["value"]) for row in finished if row["family"] == family]
        colour, marker = _COLOURS[i % len(_COLOURS)], _MARKERS[i % len(_MARKERS)]
        x, y, _ = zip(*points, strict=True)
        axes.plot(x, y, label=family, linewidth=0.8, color=colour, marker=marker)
        labels += [(*point, colour) for point in points]
    best = sorted((row["loop_s"], row["max_error_mm"]) for row in finished if row["pareto"])
    axes.plot(
        *zip(*best, strict=True), color=_INK, linestyle="--", linewidth=1, marker="o", markersize=12,
        markerfacecolor="none", label="Pareto optimum: no run is better in both",
    )  # fmt: skip
    _logarithmic(axes, "time of the loop, s", error)
    figure.legend(fontsize=8, loc="outside right upper", title="varied key; numbers: its values", title_fontsize=8)
    _label_points(figure, axes, labels)
    figure.savefig(path, dpi=150)
    return figure


def draw_quantities(
    families: Mapping[str, Sequence[Mapping[str, Any]]],
    key: str,
    label: str,
    quantities: Mapping[str, str],
    percentages: Container[str],
    path: Path,
) -> None:
    """Draw each quantity (name: heading) against the value of `key`, with a line for each family of rows.

    `label` is that of the horizontal axis. Quantities in `percentages` are shares, drawn in %. Rows with "warnings" get
    a ring.
    """
    n_columns = min(4, math.ceil(len(quantities) ** 0.5) + 1)
    n_rows = math.ceil(len(quantities) / n_columns)
    figure = Figure(figsize=(3.4 * n_columns, 2.7 * n_rows + 0.5), layout="constrained")
    warned = [row for rows in families.values() for row in rows if row.get("warnings")]
    for i, (name, heading) in enumerate(quantities.items(), 1):
        axes = figure.add_subplot(n_rows, n_columns, i, xlabel=label, ylabel=heading)
        for j, (family, rows) in enumerate(families.items()):
            points = sorted((row[key], row[name]) for row in rows if row.get(name, "") != "")
            axes.plot(
                *_columns(points), label=(family or "this sweep") if len(families) > 1 and points else None,
                linewidth=1, markersize=4, color=_COLOURS[j % len(_COLOURS)], marker=_MARKERS[j % len(_MARKERS)],
            )  # fmt: skip
        if warned:
            axes.plot(
                *_columns([(row[key], row[name]) for row in warned if row[name] != ""]), label="with warnings",
                linestyle="", marker="o", markersize=10, color=_INK, markerfacecolor="none",
            )  # fmt: skip
        axes.xaxis.set_major_locator(MaxNLocator(5))
        if name in percentages:
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
            axes.set_ylim(bottom=0.0)
        axes.grid(True, linewidth=0.3)
    pairs = (pair for axes in figure.axes for pair in zip(*axes.get_legend_handles_labels(), strict=True))
    if handles := {name: handle for handle, name in pairs}:
        n_columns = min(4, len(handles))
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=n_columns, fontsize=8)
    figure.savefig(path, dpi=150)


def _columns(points: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def draw_cost(points: Sequence[tuple[float, float, str]], path: Path) -> None:
    """Draw distance from the static solution against loop time; `points` are time (s), distance (mm) and name."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(*zip(*(point[:2] for point in points), strict=True), color=_COLOURS[1], marker="o", linestyle="none")
    _logarithmic(axes, "time of the loop, s", "estimated distance from the static solution, mm")
    _label_points(figure, axes, [(*point, _INK) for point in points], size=8)
    figure.savefig(path, dpi=150)


#: Lines of the chart of energies: names in a run's series, and labels.
_ENERGIES = {
    "external_work": "external work",
    "strain_energy": "strain energy",
    "artificial": "hourglass control and stabilisation",
    "kinetic_energy": "kinetic energy",
    "dissipated": "dissipated by damping and changes of mass",
}


def draw_history(
    times: NDArray[np.float64], series: Mapping[str, NDArray[np.float64]], label: str, path: _Target
) -> None:
    """Draw energies, kinetic over internal energy, and the smallest J at the frames of a run.

    `times` and each of the `series` have the shape (n_frames,); `label` is that of the time axis.
    """
    figure = Figure(figsize=(13, 4.3), layout="constrained")
    energies, ratio, smallest = figure.subplots(1, 3)
    values = dict(series) | {"artificial": series["hourglass_energy"] + series["stabilisation_energy"]}
    values["dissipated"] = series["dissipated_energy"] - series["energy_of_added_mass"]
    largest = max(float(np.abs(values[name]).max()) for name in _ENERGIES) or 1.0
    power = min(0, 3 * math.floor(math.log10(largest) / 3))
    prefix = {0: "", -3: "m", -6: "\u00b5", -9: "n"}.get(power)
    unit = f"{prefix}J" if prefix is not None else f"1e{power} J"
    for i, (name, text) in enumerate(_ENERGIES.items(), 1):
        energies.plot(times, 10.0**-power * values[name], label=text, color=_COLOURS[i], marker=_MARKERS[i], ms=4)
    energies.set(xlabel=label, ylabel=f"energy ({unit})", title="energy")
    figure.legend(loc="outside lower left", ncols=len(_ENERGIES), fontsize=8, frameon=False)
    percent = 100 * series["kinetic_ratio"]
    ratio.plot(times[percent > 0], percent[percent > 0], color=_COLOURS[4], marker=_MARKERS[4], ms=4)
    ratio.set(xlabel=label, ylabel="kinetic over internal energy (%)", title="rest", yscale="log")
    smallest.plot(times, series["min_jacobian"], color=_COLOURS[3], marker=_MARKERS[3], ms=4)
    smallest.set(xlabel=label, ylabel="smallest J (1)", title="smallest J so far", ylim=(0, None))
    for axes in (energies, ratio, smallest):
        axes.grid(True, linewidth=0.3)
    figure.savefig(path, dpi=110)


def draw_histogram(size: NDArray[np.float64], volumes: NDArray[np.float64], mark: float, path: _Target) -> None:
    """Draw a histogram of displacements `size` (n_cells,), mm, weighted by volume, and a line at `mark` (mm)."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.add_subplot(xlabel="displacement (mm)", ylabel="share of the volume (%)", yscale="log")
    share = 100 * volumes / volumes.sum()
    axes.hist(size, bins=40, range=(0, float(size.max()) or 1.0), weights=share, color=_COLOURS[1], edgecolor="white")
    if mark < size.max():
        label = f"{mark:g} mm: {share[size > mark].sum():.2g} % of the volume moved more"
        axes.axvline(mark, color=_COLOURS[2], linestyle="--", label=label)
        axes.legend()
    axes.grid(True, linewidth=0.3)
    figure.savefig(path, dpi=110)


def draw_balance(added: float, parts: Mapping[str, float], path: _Target) -> None:
    """Draw the volume that a tumour added (mm3), and the parts (mm3) that account for it, one after the other."""
    figure = Figure(figsize=(8, 2.4), layout="constrained")
    axes = figure.add_subplot(xlabel="volume (mm\u00b3)")
    axes.barh(1, added, color=_COLOURS[2], label="added by the tumour")
    begin = 0.0
    for (name, volume), colour in zip(parts.items(), (_COLOURS[1], _COLOURS[6]), strict=True):
        axes.barh(0, volume, left=begin, color=colour, label=name)
        begin += volume
    axes.set_yticks([0, 1], ["accounted for", "added"])
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=110)
