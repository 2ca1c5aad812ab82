"""The pictures of the validation: deformed profiles beside references, and errors against run times of programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Profile:
    """A line on a body's surface in the plane y = 0, deformed by a reference and by runs; all (n, 3), mm."""

    title: str
    places: NDArray[np.float64]  # undeformed, in order; distant neighbours are not joined
    reference: NDArray[np.float64]  # displacements
    runs: dict[str, NDArray[np.float64]]  # label -> displacements


def draw_profiles(profiles: Sequence[Profile], path: Path) -> Figure:
    """Draw and save each deformed profile, and below it the distance of each run from the reference."""
    figure = Figure(figsize=(4.6 * len(profiles), 8), layout="constrained")
    panels = figure.subplots(2, len(profiles), squeeze=False, height_ratios=[2, 1])
    for (above, below), profile in zip(panels.T, profiles, strict=True):
        steps = np.linalg.norm(np.diff(profile.places, axis=0), axis=1)
        gaps = np.flatnonzero(steps > 4 * np.median(steps)) + 1
        steps[gaps - 1] = np.median(steps)
        along = np.insert(np.cumsum(np.insert(steps, 0, 0.0)), gaps, np.nan)
        undeformed = np.insert(profile.places, gaps, np.nan, axis=0)
        above.plot(undeformed[:, 0], undeformed[:, 2], "k:", linewidth=0.8, label="undeformed")
        reference = profile.places + profile.reference
        above.plot(reference[:, 0], reference[:, 2], "ko", markersize=5, markerfacecolor="none", label="reference")
        for label, displacement in profile.runs.items():
            deformed = undeformed + np.insert(displacement, gaps, np.nan, axis=0)
            (line,) = above.plot(deformed[:, 0], deformed[:, 2], linewidth=1.2, label=label)
            apart = np.linalg.norm(displacement - profile.reference, axis=1)
            below.plot(along, np.insert(apart, gaps, np.nan), linewidth=1.2, color=line.get_color())
        wide, high = np.ptp(reference[:, [0, 2]], axis=0)
        aspect = "equal" if wide > high / 4 else "auto"  # a single side shows nothing on equal scales
        above.set(title=profile.title, xlabel="x, mm", ylabel="z, mm", aspect=aspect)
        below.set(xlabel="along the undeformed line, mm", ylabel="distance from reference, mm", ylim=(0, None))
        below.grid(linewidth=0.3)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(path, dpi=120)
    return figure


def draw_programs(panels: dict[str, list[dict[str, Any]]], path: Path, time: str, errors: Sequence[str]) -> None:
    """Error against run time of programs ("family") that solve the same scenes: a panel each, a point for each mesh.

    Rows have "seconds", "max_error_mm" and "unknowns". `time` and, one for each panel, `errors` are labels.
    """
    figure = Figure(figsize=(6 * len(panels), 5.5), layout="constrained")
    every = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (title, rows), error in zip(every, panels.items(), errors, strict=True):
        axes.set(xscale="log", yscale="log", xlabel=time, ylabel=error, title=title)
        for marker, family in zip("os^Dv", dict.fromkeys(row["family"] for row in rows), strict=False):
            points = [row for row in rows if row["family"] == family]
            seconds, found = ([row[name] for row in points] for name in ("seconds", "max_error_mm"))
            (line,) = axes.plot(seconds, found, label=family, linewidth=1.2, marker=marker)
            for row in points:
                place = row["seconds"], row["max_error_mm"]
                axes.annotate(f" {row['unknowns']:,}", place, fontsize=7, color=line.get_color())
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
        axes.margins(0.12)
        axes.grid(which="both", linewidth=0.3)
    every[0].legend(fontsize=8, title="numbers: unknowns")
    figure.savefig(path, dpi=150)
