"""Charts of numbers: of one run through time, and of runs compared with one another."""

from __future__ import annotations

import math
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, MaxNLocator, PercentFormatter
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

#: Colours and markers of families of runs, distinct to the colour-blind (Okabe and Ito 2008).
_COLOURS = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_MARKERS = "os^Dv<>P"
_INK = "#222222"
_To = Path | BinaryIO


#: Positions of a label relative to its point: distances (points), and at each distance these angles (degrees).
_DISTANCES = (7, 14, 26, 40, 56, 74)
_ANGLES = (35, 145, -35, -145, 0, 180, 90, -90, 62, 118, -62, -118)

#: A point of a chart with its label: x, y, text, colour.
Label = tuple[float, float, str, str]


def _logarithmic(axes: Axes, x: str, y: str) -> None:
    """Make both axes logarithmic, with these labels, and a grid whose lines all have numbers."""
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    axes.margins(0.12)
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        # More powers of ten have fewer lines between them.
        between = [2.0, 3.0, 5.0, 7.0] if high < 100 * low else [3.0]
        axis.set_minor_locator(LogLocator(subs=between, numticks=50))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}")
    axes.grid(True, which="both", linewidth=0.3)


def _label_points(figure: Figure, axes: Axes, labels: Sequence[Label], size: int = 7) -> None:
    """Write each label near its point where it covers no point and no label; a line joins distant labels to points.

    The figure must be complete apart from these labels, because its layout is fixed here.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    around = 4 * figure.dpi / 72
    points = axes.transData.transform([label[:2] for label in labels])
    taken = [Bbox.from_extents(*(point - around), *(point + around)) for point in points]
    frame = axes.get_window_extent()
    for x, y, text, colour in labels:
        for far, angle in product(_DISTANCES, np.deg2rad(_ANGLES)) if text else ():
            right, up = np.cos(angle), np.sin(angle)
            note = axes.annotate(
                text, (x, y), xytext=(far * right, far * up), textcoords="offset points", fontsize=size, color=colour,
                ha="center" if abs(right) < 0.5 else "left" if right > 0 else "right",
                va="center" if abs(up) < 0.5 else "bottom" if up > 0 else "top",
                arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5} if far > _DISTANCES[0] else None,
            )  # fmt: skip
            note.get_window_extent()  # places the text
            box = Text.get_window_extent(note)
            inside = np.all(box.min > frame.min) and np.all(box.max < frame.max)
            if inside and not box.count_overlaps(taken):
                taken.append(box)
                break
            note.remove()


def draw_study(rows: list[dict[str, Any]], path: Path, error: str) -> Figure:
    """Error against loop time of the runs of a study: a line for each family, and a ring around each Pareto optimum."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    axes = figure.add_subplot()
    done = [row for row in rows if row["max_error_mm"] != ""]
    labels: list[Label] = []
    for i, family in enumerate(dict.fromkeys(row["family"] for row in done)):
        points = [(row["loop_s"], row["max_error_mm"], row["value"]) for row in done if row["family"] == family]
        colour, marker = _COLOURS[i % len(_COLOURS)], _MARKERS[i % len(_MARKERS)]
        x, y, _ = zip(*points, strict=True)
        axes.plot(x, y, label=family, linewidth=0.8, color=colour, marker=marker)
        labels += [(*point, colour) for point in points]
    best = sorted((row["loop_s"], row["max_error_mm"]) for row in done if row["pareto"])
    axes.plot(
        *zip(*best, strict=True), color=_INK, linestyle="--", linewidth=1, marker="o", markersize=12,
        markerfacecolor="none", label="none is better in both (Pareto)",
    )  # fmt: skip
    _logarithmic(axes, "time of the loop, s", error)
    figure.legend(fontsize=8, loc="outside right upper", title="varied key; numbers: its values", title_fontsize=8)
    _label_points(figure, axes, labels)
    figure.savefig(path, dpi=150)
    return figure


@dataclass(frozen=True, slots=True)
class Profile:
    """A line on a body's surface in the plane y = 0, deformed as a reference and as runs have it; all (n, 3), mm."""

    title: str
    places: NDArray[np.float64]  # undeformed, in order; a gap where they are far apart
    reference: NDArray[np.float64]  # displacements
    runs: dict[str, NDArray[np.float64]]  # label -> displacements


def draw_profiles(profiles: Sequence[Profile], path: Path) -> Figure:
    """Draw and save each profile as it is deformed, and below it how far each run is from the reference along it."""
    figure = Figure(figsize=(4.6 * len(profiles), 8), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(profiles), squeeze=False, height_ratios=[2, 1])
    for (above, below), profile in zip(panels.T, profiles, strict=True):
        steps = np.linalg.norm(np.diff(profile.places, axis=0), axis=1)
        gaps = np.flatnonzero(steps > 4 * np.median(steps)) + 1
        steps[gaps - 1] = np.median(steps)
        along = np.insert(np.cumsum(np.insert(steps, 0, 0.0)), gaps, np.nan)

        def line(displacement: NDArray[np.float64] | float, profile: Profile = profile, gaps: Any = gaps) -> Any:
            return np.insert(profile.places + displacement, gaps, np.nan, axis=0)[:, [0, 2]].T

        above.plot(*line(0.0), color=_INK, linewidth=0.8, linestyle=":", label="undeformed")
        above.plot(
            *line(profile.reference), color=_INK, linestyle="", marker="o", markersize=5, markerfacecolor="none",
            label="reference",
        )  # fmt: skip
        for i, (label, displacement) in enumerate(profile.runs.items(), 1):
            style: dict[str, Any] = {"color": _COLOURS[i], "linestyle": ("--", "-", "-.")[i % 3], "linewidth": 1.2}
            above.plot(*line(displacement), label=label, **style)
            apart = np.linalg.norm(displacement - profile.reference, axis=1)
            below.plot(along, np.insert(apart, gaps, np.nan), label=label, **style)
        wide, high = np.ptp((profile.places + profile.reference)[:, [0, 2]], axis=0)
        aspect = "equal" if wide > high / 4 else "auto"  # one side alone shows nothing on equal scales
        above.set(title=profile.title, xlabel="x, mm", ylabel="z, mm", aspect=aspect)
        below.set(xlabel="along the undeformed line, mm", ylabel="distance from reference, mm", ylim=(0, None))
        below.grid(True, linewidth=0.3)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(path, dpi=120)
    return figure


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
    axes.margins(x=0.22)
    axes.grid(True, linewidth=0.3)
    axes.legend(fontsize=8, loc="lower left")
    axes.set_title(f"{subject}: {assumptions}", fontsize=8, loc="left")
    figure.savefig(path, dpi=150)


def draw_quantities(
    families: Mapping[str, Sequence[Mapping[str, Any]]],
    key: str,
    label: str,
    quantities: Mapping[str, str],
    percentages: Container[str],
    path: Path,
) -> None:
    """Draw each quantity (name: heading) of rows against their number under `key`, a line for each family of rows.

    Quantities in `percentages` are shares, drawn in %. Rows with "warnings" have a ring.
    """
    across = min(4, math.ceil(len(quantities) ** 0.5) + 1)
    down = math.ceil(len(quantities) / across)
    figure = Figure(figsize=(3.4 * across, 2.7 * down + 0.5), layout="constrained")
    warned = [row for rows in families.values() for row in rows if row.get("warnings")]
    for i, (name, heading) in enumerate(quantities.items(), 1):
        axes = figure.add_subplot(down, across, i, xlabel=label, ylabel=heading)
        for j, (family, rows) in enumerate(families.items()):
            points = sorted((row[key], row[name]) for row in rows if row.get(name, "") != "")
            axes.plot(
                [x for x, _ in points], [y for _, y in points],
                label=(family or "here") if len(families) > 1 and points else None, linewidth=1, markersize=4,
                color=_COLOURS[j % len(_COLOURS)], marker=_MARKERS[j % len(_MARKERS)],
            )  # fmt: skip
        if warned:
            ringed = [(row[key], row[name]) for row in warned if row[name] != ""]
            axes.plot(
                [x for x, _ in ringed], [y for _, y in ringed], label="warned", linestyle="", marker="o",
                markersize=10, color=_INK, markerfacecolor="none",
            )  # fmt: skip
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
    """Draw distance from the static solution (mm) against loop time (s) of runs, each with its name."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(*zip(*(point[:2] for point in points), strict=True), color=_COLOURS[1], marker="o", linestyle="none")
    _logarithmic(axes, "time of the loop, s", "from the static solution, by its own estimate, mm")
    _label_points(figure, axes, [(*point, _INK) for point in points], size=8)
    figure.savefig(path, dpi=150)


def draw_rivals(panels: dict[str, list[dict[str, Any]]], path: Path, time: str, errors: Sequence[str]) -> None:
    """Error against run time of programs ("family") that solve the same scenes: a panel each, a point for each mesh.

    The panels' rows hold "seconds", "max_error_mm" and "unknowns"; `time` and, one for each panel, `errors` are labels.
    """
    figure = Figure(figsize=(6 * len(panels), 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    every = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (title, rows), error in zip(every, panels.items(), errors, strict=True):
        for i, family in enumerate(dict.fromkeys(row["family"] for row in rows)):
            points = [row for row in rows if row["family"] == family]
            seconds, found = ([row[name] for row in points] for name in ("seconds", "max_error_mm"))
            colour = _COLOURS[i + 1]
            beside = {
                "textcoords": "offset points",
                "xytext": ((5, 4), (-5, -9))[i % 2],
                "ha": ("left", "right")[i % 2],
            }
            axes.plot(seconds, found, label=family, linewidth=1.2, color=colour, marker=_MARKERS[i])
            for x, y, row in zip(seconds, found, points, strict=True):
                axes.annotate(f"{row['unknowns']:,}", (x, y), fontsize=7, color=colour, **beside)
        _logarithmic(axes, time, error)
        axes.set_title(title)
    every[0].legend(fontsize=8, title="numbers: unknowns")
    figure.savefig(path, dpi=150)


#: Lines of the chart of energies, by the names of a run's series.
_ENERGIES = {
    "external_work": "external work",
    "strain_energy": "strain energy",
    "artificial": "hourglass control and stabilisation",
    "kinetic_energy": "kinetic energy",
    "dissipated": "dissipated by damping and changes of mass",
}


def draw_history(times: NDArray[np.float64], series: Mapping[str, NDArray[np.float64]], label: str, path: _To) -> None:
    """Draw energies, kinetic over internal energy, and the smallest J at the frames of a run; label: the time axis."""
    figure = Figure(figsize=(13, 4.3), layout="constrained")
    energies, ratio, smallest = figure.subplots(1, 3)
    values = dict(series) | {"artificial": series["hourglass_energy"] + series["stabilisation_energy"]}
    values["dissipated"] = series["dissipated_energy"] - series["energy_of_added_mass"]
    largest = max(float(np.abs(values[name]).max()) for name in _ENERGIES) or 1.0
    power = min(0, 3 * math.floor(math.log10(largest) / 3))
    prefix = {0: "", -3: "m", -6: "\u00b5", -9: "n"}.get(power)
    unit = f"{prefix}J" if prefix is not None else f"1e{power} J"
    for i, (name, words) in enumerate(_ENERGIES.items(), 1):
        energies.plot(times, 10.0**-power * values[name], label=words, color=_COLOURS[i], marker=_MARKERS[i], ms=4)
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


def draw_histogram(size: NDArray[np.float64], volumes: NDArray[np.float64], mark: float, path: _To) -> None:
    """Draw the share of the volume for each displacement (mm), and a line at `mark` (mm)."""
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


def draw_balance(grown: float, found: Mapping[str, float], path: _To) -> None:
    """Draw the volume that a tumour added (mm3), and below it the volumes where it was found, one after the other."""
    figure = Figure(figsize=(8, 2.4), layout="constrained")
    axes = figure.add_subplot(xlabel="volume (mm\u00b3)")
    axes.barh(1, grown, color=_COLOURS[2], label="added by the tumour")
    begin = 0.0
    for (name, volume), colour in zip(found.items(), (_COLOURS[1], _COLOURS[6]), strict=True):
        axes.barh(0, volume, left=begin, color=colour, label=name)
        begin += volume
    axes.set_yticks([0, 1], ["found", "added"])
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=110)


#: Outcomes of the stability matrix as colours of fill and text, of different lightness too.
_OUTCOMES = {
    "completed": ("#cbe7f8", _INK),
    "stopped": ("#f0c75e", _INK),
    "warned": ("#b8b8b8", _INK),
    "buckled": ("#7a9a8f", _INK),
    "wrong": ("#5a1f00", "#ffffff"),
}
_CELL = (0.82, 0.2)  # inches
_MARGIN, _HEAD, _WIDTH = 1.5, 0.62, 6.6  # inches left of a panel's cells, above them, and of a panel with both
_PANELS = 3  # beside one another
#: What the words of a cell mean.
_SAID = (
    "number: largest difference from the reference (a closed form or another run), mm; percentage: share of the load",
    "completed: it is at most 3 times what run and reference say of themselves, above all how far from rest they are;",
    "a ramp that is millimetres off completes if it says that it is",
    "warned: it is more, and was warned of; buckled: more, with less energy than the closed form; wrong: none of these",
)


def draw_matrix(rows: list[dict[str, Any]], path: Path) -> Figure:
    """The stability matrix: a panel for each axis, kinds and methods down, values across, what became of it in words.

    Completed runs have their error in mm, stopped ones the share of the load that they had, or that they were refused.
    Rows may be those of the table, all of whose values are text.
    """
    panels: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        panels.setdefault(row["axis"], []).append(row)
    filled = [0.4 + 0.16 * len(_SAID)] * _PANELS  # inches from the top, for the legend first
    places = {}
    for name, cells in panels.items():
        column = filled.index(min(filled))
        runs = list(dict.fromkeys((cell["kind"], cell["method"]) for cell in cells))
        places[name] = column, filled[column], runs
        filled[column] += _HEAD + _CELL[1] * len(runs)
    width, height = _WIDTH * min(_PANELS, len(panels)), max(filled) + 0.1
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    for i, (outcome, (colour, ink)) in enumerate(_OUTCOMES.items()):
        _cell(axes, 0.1 + i * 1.2 * _CELL[0], 0.1, outcome, colour, ink)
    for i, words in enumerate(_SAID):
        axes.text(0.1, 0.42 + 0.16 * i, words, fontsize=7, va="center", color=_INK)
    for name, (column, top, runs) in places.items():
        left, top = column * _WIDTH + _MARGIN, top + _HEAD
        values = list(dict.fromkeys(cell["value"] for cell in panels[name]))
        title = f"{name}: {panels[name][0]['about']}"
        axes.text(left - _MARGIN + 0.1, top - 0.32, title, fontsize=8, fontweight="bold", color=_INK)
        for i, value in enumerate(values):
            axes.text(left + (i + 0.5) * _CELL[0], top - 0.05, value, fontsize=7, ha="center", color=_INK)
        for j, (kind, method) in enumerate(runs):
            y = top + (j + 0.5) * _CELL[1]
            axes.text(left - 0.08, y, f"{kind}, {method}", fontsize=7, ha="right", va="center", color=_INK)
        for cell in panels[name]:
            i, j = values.index(cell["value"]), runs.index((cell["kind"], cell["method"]))
            colours = _OUTCOMES[cell["outcome"]]
            _cell(axes, left + i * _CELL[0], top + j * _CELL[1], _words(cell), *colours)
    figure.savefig(path, dpi=150)
    return figure


def _cell(axes: Any, x: float, y: float, text: str, colour: str, ink: str) -> None:
    axes.add_patch(Rectangle((x, y), *_CELL, facecolor=colour, edgecolor="#ffffff", linewidth=0.8))
    middle = x + 0.5 * _CELL[0], y + 0.5 * _CELL[1]
    axes.text(*middle, text, fontsize=7, ha="center", va="center", color=ink)


def _words(cell: dict[str, Any]) -> str:
    """What a cell of the matrix has to say."""
    if cell["error_mm"] != "":
        return f"{float(cell['error_mm']):.2g}"
    reached = re.search(r"unstable at ([\d.]+%)", cell["message"])
    ended = {"3": "stalled", "2": "refused", "0": "error unsaid"}
    return reached[1] if reached else ended.get(str(cell["status"]), "no end")
