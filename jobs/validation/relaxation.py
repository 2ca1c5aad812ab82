"""Steps of dynamic relaxation beside those of the shortest ramp that ends as near to the static solution.

Of relaxation both are counted: the steps until it knows that it is near, which is where it ends, and those until it is
near for good, which only who knows the solution can tell.

python jobs/validation/relaxation.py [FOLDER]   (out/relaxation)

Relaxation ends by its own estimate, 0.01 mm. For the ramp `solver.load_time` is doubled or halved from a second until
its distance from rest (`static_distance_mm`, which the run goes on to find) passes 0.01 mm, and then bisected. Runs
what has not been run yet, one after the other on one rank; goes on where it was stopped. Writes relaxation.csv in
jobs/studies, and prints it as a table.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mpitled.batch import launch
from mpitled.deck import load_deck
from mpitled.preview import forecast
from mpitled.results import field
from mpitled.solver.dynamic_relaxation import DynamicRelaxation
from mpitled.terms import apply

HERE = Path(__file__).parent
STUDIES = HERE.parent / "studies"
#: Deck, from here, and overrides.
SCENES: dict[str, tuple[str, tuple[str, ...]]] = {
    "cylinder, 20 % extension": ("cylinder", ()),
    "tumour of 523.6 mm3": ("tumour", ()),
    "tumour of 3053.6 mm3": ("tumour", ("tumour.volume=3053.6",)),
    "tumour of 4188.8 mm3 in the brain": ("../brain_tumour", ()),
}
NEAR = 0.01  # mm from the static solution
AT_REST = 1e-5  # mm: a solution that is known so well is the static one
RELAXING = "solver.method=dynamic-relaxation"
ALWAYS = ("output.frames=1", "output.pictures=false")
#: Load times are found to this factor, and no longer ones than this (s) are tried.
CLOSE, LONGEST = 1.05, 16.0


def solved(folder: Path, deck: str, overrides: Sequence[str]) -> dict[str, Any]:
    """The report of a run, which is made if it is not there yet; empty if it failed."""
    if (failure := launch.outcome(folder)) is None:
        print(folder.name, file=sys.stderr, flush=True)
        failure = launch.run_apart(HERE / f"{deck}.toml", (*ALWAYS, *overrides), 1, folder)
    return {} if failure else dict(json.loads((folder / "report.json").read_text()))


def shortest_ramp(out: Path, deck: str, overrides: Sequence[str]) -> tuple[float, Path | None, Path | None]:
    """Load time (s) of the shortest ramp that ends near, its folder, and that of the next shorter one tried."""
    tried: dict[float, Path] = {}

    def near(load_time: float) -> bool:
        tried[load_time] = out / f"ramp-{load_time:.4g}"
        ramp = ("solver.method=quasi-static", f"solver.load_time={load_time:.4g}")
        return solved(tried[load_time], deck, (*overrides, *ramp)).get("static_distance_mm", np.inf) <= NEAR

    high = 1.0
    if near(high):
        while near(high / 2):
            high /= 2
    else:
        while not near(high := 2 * high):
            if high >= LONGEST:
                return high, None, tried[high]
    low = high / 2
    while high / low > CLOSE:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if near(middle) else (middle, high)
    return high, tried[high], tried[low]


def reached(out: Path, deck: str, overrides: Sequence[str]) -> int:
    """Steps from which on a relaxation is near the static solution at every node: one is run here, on the model of
    another that goes on to rest.
    """
    solved(out / "rest", deck, (*overrides, RELAXING, f"solver.tolerance={AT_REST}"))
    rest = field.open_field(out / "rest").parameters.T
    keys = (*ALWAYS, *overrides, RELAXING, f"solver.tolerance={NEAR}")
    relaxation = forecast.integrator_of(load_deck(HERE / f"{deck}.toml", keys), out / "rest" / "model.h5")
    assert isinstance(relaxation, DynamicRelaxation)
    s, near, ended = relaxation.state, 0, False
    relaxation.begin()
    apply(s, (*relaxation.step.forces, *relaxation.step.work))
    while not ended:
        distance = 1e3 * np.linalg.norm(s.u[:, : rest.shape[1]] - rest, axis=0).max()
        near = (near or s.step) if s.share >= 1 and distance <= NEAR else 0
        _, ended = relaxation.decide(relaxation.check())
        for _ in range(0 if ended else relaxation.between):
            apply(s, relaxation.step.cycle)
    return near


def row(name: str, out: Path) -> dict[str, Any]:
    """What relaxation and the ramp of a scene took, and how far apart they are at the nodes."""
    deck, overrides = SCENES[name]
    relaxed = solved(out / "relaxation", deck, (*overrides, RELAXING, f"solver.tolerance={NEAR}"))
    load_time, ramp, shorter = shortest_ramp(out, deck, overrides)
    found: dict[str, Any] = {
        "scene": name,
        "reached_steps": reached(out, deck, overrides),
        "steps": relaxed["steps"],
        "static_distance_mm": relaxed["static_distance_mm"],
        "ramp_load_time_s": load_time,
    }
    if ramp is not None:
        report = solved(ramp, deck, ())
        found |= {"ramp_steps": report["steps"], "ramp_static_distance_mm": report["static_distance_mm"]}
        ours, theirs = (field.open_field(folder).at_nodes for folder in (out / "relaxation", ramp))
        found |= {
            "share_of_steps": relaxed["steps"] / report["steps"],
            "reached_share_of_steps": found["reached_steps"] / report["steps"],
            "apart_mm": 1e3 * float(np.linalg.norm(ours - theirs, axis=1).max()),
        }
    if shorter is not None:
        less = solved(shorter, deck, ())
        found |= {"shorter_steps": less.get("steps"), "shorter_static_distance_mm": less.get("static_distance_mm")}
    return found


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """The table; a ramp that fails or is too far from rest at the longest load has no steps."""
    lines = [
        "| scene | relaxation: near after | ends after | from rest, mm | ramp: ends after | from rest, mm | shares |"
        " apart, mm |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for found in rows:
        head = f"| {found['scene']} | {found['reached_steps']:,} | {found['steps']:,} "
        head += f"| {found['static_distance_mm']:.4f} |"
        if "ramp_steps" in found:
            lines.append(
                f"{head} {found['ramp_steps']:,} | {found['ramp_static_distance_mm']:.4f} | "
                f"{found['reached_share_of_steps']:.2f}, {found['share_of_steps']:.2f} | {found['apart_mm']:.4f} |"
            )
        else:
            steps, distance = found.get("shorter_steps"), found.get("shorter_static_distance_mm")
            tried = f"more than {steps:,} | {distance:.4f}" if steps and distance else "none | "
            lines.append(f"{head} {tried} | | |")
    return "\n".join(lines)


def main() -> None:
    """Every scene; the table after each."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/relaxation")
    rows: list[dict[str, Any]] = []
    for name in SCENES:
        rows.append(row(name, out / "".join(c if c.isalnum() or c == "." else "-" for c in name)))
        columns = list(dict.fromkeys(column for found in rows for column in found))
        with (STUDIES / "relaxation.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(
                {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in found.items()}
                for found in rows
            )
        print(markdown(rows), flush=True)


if __name__ == "__main__":
    main()
