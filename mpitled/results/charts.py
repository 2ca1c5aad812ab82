"""Charts of numbers, not of meshes: error against run time, and what else compares runs with one another."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, PercentFormatter
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

#: Colours and marks of families of runs, told apart by the colour-blind (Okabe and Ito 2008).
_COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_MARKERS = "os^Dv<>P"
_INK = "#222222"
_To = Path | BinaryIO


def _logarithmic(axes: Axes, x: str, y: str) -> None:
    """Both axes, labelled so, logarithmic, and a grid of which every line has its number.

    The more powers of ten there are, the fewer lines there are between them.
    """
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    axes.margins(0.12)
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        between = [2.0, 3.0, 5.0, 7.0] if high < 100 * low else [3.0]
        axis.set_minor_locator(LogLocator(subs=between, numticks=50))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}")
    axes.grid(True, which="both", linewidth=0.3)


@dataclass(frozen=True, slots=True)
class _Name:
    """Words beside a point of a chart."""

    x: float
    y: float
    text: str
    colour: str


#: Where a name may stand, from the point: how far (points), and in which direction first.
_FAR = (7.0, 14.0, 26.0, 40.0, 56.0, 74.0)
_ROUND = np.deg2rad([35, 145, -35, -145, 0, 180, 90, -90, 62, 118, -62, -118])


def _name_points(figure: Figure, axes: Axes, names: Sequence[_Name], size: int = 7) -> None:
    """Write each name as near to its point as no other name and no point is covered, with a line to it if it is far.

    For a figure that is done but for them: its layout must not change any more.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    frame = axes.get_window_extent()
    points = axes.transData.transform([(name.x, name.y) for name in names])
    pixels = figure.dpi / 72  # in a point
    taken = [Bbox.from_extents(*(point - 4 * pixels), *(point + 4 * pixels)) for point in points]
    for name, point in zip(names, points, strict=True):
        if not name.text:
            continue
        text = axes.text(0, 0, name.text, fontsize=size, color=name.colour, transform=None)
        box = text.get_window_extent()
        half = np.array([box.width, box.height]) / 2 + 0.5 * pixels
        best, least = (0.0, point, text.get_window_extent()), np.inf
        for far in _FAR:
            for angle in _ROUND:
                towards = np.array([np.cos(angle), np.sin(angle)])
                middle = point + far * pixels * towards + half * np.clip(1.5 * towards, -1, 1)
                place = Bbox.from_extents(*(middle - half), *(middle + half))
                overlap = sum(_overlap(place, other) for other in taken)
                overlap += place.width * place.height - _overlap(place, frame)
                if overlap < least:
                    best, least = (far, middle, place), overlap
            if least == 0:
                break
        far, middle, place = best
        text.remove()
        taken.append(place)
        side = (middle - point) / np.maximum(np.abs(middle - point), half)  # of the words that the line begins at
        line = {"arrowstyle": "-", "color": name.colour, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 2}
        line |= {"relpos": tuple(0.5 - 0.5 * side)}
        axes.annotate(
            name.text, (name.x, name.y), xytext=tuple((middle - point) / pixels), textcoords="offset points",
            fontsize=size, color=name.colour, ha="center", va="center", arrowprops=line if far > _FAR[0] else None,
        )  # fmt: skip


def _overlap(a: Bbox, b: Bbox) -> float:
    """Area that two boxes have in common."""
    across, down = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
    return max(across, 0.0) * max(down, 0.0)


def draw_study(rows: list[dict[str, Any]], path: Path, error: str) -> Figure:
    """Error against loop time of the runs of a study, a line for each family, the best ringed (Pareto)."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    done = [row for row in rows if row["max_error_mm"] != ""]
    families = list(dict.fromkeys(row["family"] for row in done))
    names = []
    for i, family in enumerate(families):
        points = [(row["loop_s"], row["max_error_mm"], row["value"]) for row in done if row["family"] == family]
        style: dict[str, Any] = {"color": _COLOURS[i % len(_COLOURS)], "marker": _MARKERS[i % len(_MARKERS)]}
        axes.plot([x for x, _, _ in points], [y for _, y, _ in points], label=family, linewidth=0.8, **style)
        names += [_Name(x, y, value, style["color"]) for x, y, value in points]
    best = sorted((row["loop_s"], row["max_error_mm"]) for row in done if row["pareto"])
    axes.plot(
        [x for x, _ in best], [y for _, y in best], color=_INK, linestyle="--", linewidth=1, marker="o", markersize=12,
        markerfacecolor="none", label="none is better in both (Pareto)",
    )  # fmt: skip
    _logarithmic(axes, "time of the loop, s", error)
    figure.legend(fontsize=8, loc="outside right upper", title="varied key; numbers: its values", title_fontsize=8)
    _name_points(figure, axes, names)
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
    """Each quantity (name: heading) of rows against their number under `key`, a line for each family of rows.

    Shares among them, `percentages`, are drawn in %. Rows that have "warnings" are ringed.
    """
    across = min(4, math.ceil(len(quantities) ** 0.5) + 1)
    down = math.ceil(len(quantities) / across)
    warned = [row for rows in families.values() for row in rows if row.get("warnings")]
    several = len(families) > 1
    figure = Figure(figsize=(3.4 * across, 2.7 * down + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    for i, (name, heading) in enumerate(quantities.items(), 1):
        axes = figure.add_subplot(down, across, i)
        for j, (family, rows) in enumerate(families.items()):
            points = sorted((row[key], row[name]) for row in rows if row.get(name, "") != "")
            if not points:
                continue
            axes.plot(
                [x for x, _ in points], [y for _, y in points], label=(family or "here") if several else None,
                linewidth=1, markersize=4, color=_COLOURS[j % len(_COLOURS)], marker=_MARKERS[j % len(_MARKERS)],
            )  # fmt: skip
        if warned:
            ringed = [(row[key], row[name]) for row in warned if row[name] != ""]
            axes.plot(
                [x for x, _ in ringed], [y for _, y in ringed], label="warned", linestyle="", marker="o",
                markersize=10, color=_INK, markerfacecolor="none",
            )  # fmt: skip
        axes.set(xlabel=label, ylabel=heading)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        if name in percentages:
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
            axes.set_ylim(bottom=0.0)
        axes.grid(True, linewidth=0.3)
    shown = {
        name: handle for axes in figure.axes for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if shown:
        figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=min(4, len(shown)), fontsize=8)
    figure.savefig(path, dpi=150)


def draw_cost(points: Sequence[tuple[float, float, str]], path: Path) -> None:
    """Distance (mm) from the static solution against the time of the loop (s) of runs, each with its name beside it."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for seconds, distance, _ in points:
        axes.plot(seconds, distance, color=_COLOURS[1], marker="o", linestyle="none")
    _logarithmic(axes, "time of the loop, s", "from the static solution, by its own estimate, mm")
    _name_points(figure, axes, [_Name(seconds, distance, name, _INK) for seconds, distance, name in points], size=8)
    figure.savefig(path, dpi=150)


#: Energies of a run's history by the names of its series; the hourglass's and the stabilisation's are one line.
_ENERGIES = {
    "external_work": "external work",
    "strain_energy": "strain energy",
    "artificial": "hourglass control and stabilisation",
    "kinetic_energy": "kinetic energy",
    "taken": "taken by damping, less what changed masses gave",
}


def draw_history(times: NDArray[np.float64], series: Mapping[str, NDArray[np.float64]], label: str, path: _To) -> None:
    """Energies, kinetic over internal energy, and the smallest J of a run at its frames; label: of the time's axis."""
    figure = Figure(figsize=(13, 4.3), layout="constrained")
    FigureCanvasAgg(figure)
    energies, ratio, smallest = figure.subplots(1, 3)
    values = dict(series) | {"artificial": series["hourglass_energy"] + series["stabilisation_energy"]}
    values["taken"] = series["dissipated_energy"] - series["energy_of_added_mass"]
    largest = max(float(np.abs(values[name]).max()) for name in _ENERGIES) or 1.0
    power = min(0, 3 * math.floor(math.log10(largest) / 3))
    scale, prefix = 10.0**-power, {0: "", -3: "m", -6: "\u00b5", -9: "n"}.get(power)
    unit = f"{prefix}J" if prefix is not None else f"1e{power} J"
    for i, (name, words) in enumerate(_ENERGIES.items(), 1):
        energies.plot(times, scale * values[name], label=words, color=_COLOURS[i], marker=_MARKERS[i], markersize=4)
    energies.set(xlabel=label, ylabel=f"energy ({unit})", title="energy")
    figure.legend(loc="outside lower left", ncols=len(_ENERGIES), fontsize=8, frameon=False)
    percent = 100 * series["kinetic_ratio"]
    ratio.plot(times[percent > 0], percent[percent > 0], color=_COLOURS[4], marker=_MARKERS[4], markersize=4)
    ratio.set(xlabel=label, ylabel="kinetic over internal energy (%)", title="rest", yscale="log")
    smallest.plot(times, series["min_jacobian"], color=_COLOURS[3], marker=_MARKERS[3], markersize=4)
    smallest.set(xlabel=label, ylabel="smallest J (1)", title="smallest J so far", ylim=(0, None))
    for axes in (energies, ratio, smallest):
        axes.grid(True, linewidth=0.3)
    figure.savefig(path, dpi=110)


def draw_histogram(size: NDArray[np.float64], volumes: NDArray[np.float64], mark: float, path: _To) -> None:
    """Share of the volume whose displacement (mm) is so large; a line at `mark` (mm)."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    share = 100 * volumes / volumes.sum()
    axes.hist(size, bins=40, range=(0, float(size.max()) or 1.0), weights=share, color=_COLOURS[1], edgecolor="white")
    axes.set(xlabel="displacement (mm)", ylabel="share of the volume (%)", yscale="log")
    if mark < size.max():
        beyond = share[size > mark].sum()
        label = f"{mark:g} mm: {beyond:.2g} % of the volume moved more"
        axes.axvline(mark, color=_COLOURS[2], linestyle="--", label=label)
        axes.legend()
    axes.grid(True, linewidth=0.3)
    figure.savefig(path, dpi=110)


def draw_balance(grown: float, found: Mapping[str, float], path: _To) -> None:
    """The volume that a tumour added (mm3), and below it where it was found, one piece after the other."""
    figure = Figure(figsize=(8, 2.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.barh(1, grown, color=_COLOURS[2], label="added by the tumour")
    begin = 0.0
    for i, (name, volume) in enumerate(found.items()):
        axes.barh(0, volume, left=begin, color=_COLOURS[(1, 6)[i]], label=name)
        begin += volume
    axes.set_yticks([0, 1], ["found", "added"])
    axes.set_xlabel("volume (mm\u00b3)")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=110)
