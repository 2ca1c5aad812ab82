"""The stability matrix: scenes taken to extremes; each is right, stops with a reason, was warned of, or is wrong.

A run is right if its displacements differ from the reference by no more than TRUE_TO times what is known of it: its own
distance to the static solution (or the tolerance to which that is found, if it is more), that of a reference that is a
run too, and the error with which the cells interpolate a reference that is a closed form, which is none but for the
shell. Without a closed form the reference is the same mesh relaxed to a hundredth of the tolerance with four times the
load steps. Waves are compared with themselves at a quarter of the step of "auto": of the second order, as the central
difference is, their error is as many times that of a run at half that step as the squares of the steps say.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import atomic, store
from mpitled.batch import launch
from mpitled.batch.exact import CLOSED_FORMS
from mpitled.batch.extremes import AXES, KINDS, METHODS, Axis, write_grid
from mpitled.cells import hexahedra
from mpitled.errors import InputError, MpitledError
from mpitled.material import strain_energy
from mpitled.model import Model

#: Warned: the field is not that of the reference, but the mesh was warned of when it was read, or the result when it
#: was there. Buckled: it is not that of a closed form which the mesh has exactly, but it holds less energy: the closed
#: form is no stable equilibrium.
OUTCOMES = RIGHT, STOPPED, WARNED, BUCKLED, WRONG = "completed", "stopped", "warned", "buckled", "wrong"
COLUMNS = (
    "axis", "about", "value", "kind", "method", "outcome", "status", "error_mm", "allowed_mm", "reference",
    "static_distance_mm", "balance_error", "kinetic_ratio", "min_jacobian", "steps", "loop_s", "message",
)  # fmt: skip
#: Estimates are true to this factor.
TRUE_TO = 3.0
#: Errors below this share of the body's size are round-off of some thousand steps.
ROUND_OFF = 1e-9
#: s of computing, after which a run hangs: most take seconds, those whose load is begun anew a minute.
HANGS = 300
#: What makes the references that are runs.
_OTHERWISE = {
    "relaxed": ("solver.method=dynamic-relaxation", "solver.tolerance=1e-4", "solver.load_steps=2000"),
    "quarter": ("solver.method=dynamic", "solver.time_step=0.2*critical"),
    "half": ("solver.method=dynamic", "solver.time_step=0.4*critical"),
}
#: A run that takes the critical step times SAFETY. Whole surveys fill the load time, which takes 1 % of it at most.
SAFETY = 0.8
_CRITICAL = (
    "solver.method=dynamic", f"solver.safety={SAFETY}", "solver.time_step=auto", "displaced.0.displacement=[1e-6]"
)  # fmt: skip
#: A stop names the cell or the key (or the file), and what to do.
_UNSTABLE = re.compile(
    r"(hexahedron|support domain) \d+ \(.+\) at \(.+\) mm on rank \d+ .*; .*(solver|cloud)\.\w+|; give solver\.\w+ = "
)
_REFUSED = re.compile(r"(\w+\.\w+( = [^:]+)?|\.inp: line \d+): .+[;,] ")


@dataclass(frozen=True, slots=True)
class Case:
    """One cell of the matrix."""

    name: str  # the axis, a key of AXES
    axis: Axis
    value: str
    kind: str
    method: str

    @property
    def words(self) -> list[str]:
        """What `--set` takes, shares of the critical step not yet worked out, and words of the grid."""
        words = [*self.axis.values[self.value].split(), *KINDS[self.axis.geometry][self.kind].split()]
        return [word for word in words if not word.startswith("reference.")]

    @property
    def reference_words(self) -> list[str]:
        """What `--set` takes besides for the run that is the reference."""
        words = self.axis.values[self.value].split()
        return [f"solver.{word.removeprefix('reference.')}" for word in words if word.startswith("reference.")]


def cases(only: Sequence[str] = ()) -> Iterator[Case]:
    """All cells of the matrix, or those of some axes. InputError if there is no such axis."""
    for name in only:
        if name not in AXES:
            raise InputError(f"--only {name}: there is no such axis; axes are {', '.join(AXES)}")
    for name in only or AXES:
        axis = AXES[name]
        for value in axis.values:
            for kind in axis.kinds:
                for method in axis.methods:
                    yield Case(name, axis, value, kind, method)


def matrix(out: Path, only: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Run what has not been run yet, one after the other, and judge all of it: stability.csv and stability.png."""
    todo = list(cases(only))
    rows = []
    for i, case in enumerate(todo, 1):
        folder = out / f"{case.name}-{_plain(case.value)}"
        deck = _write_deck(folder, case)
        run = _Runs(deck, case, f"{i}/{len(todo)}")
        rows.append(_judge(case, run))
    atomic.write_csv(out / "stability.csv", COLUMNS, rows)
    try:
        from mpitled.results import charts
    except ImportError:
        print(f"{out}: no picture, for matplotlib is missing", file=sys.stderr)
    else:
        charts.draw_matrix(rows, out / "stability.png")
    return rows


def _plain(text: str) -> str:
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in text)


def _write_deck(folder: Path, case: Case) -> Path:
    """The deck of an axis in the folder of a value, and the mesh it reads; what was run with another is thrown away."""
    deck, wanted = folder / "scene.toml", f'title = "{case.axis.about}"\n{case.axis.deck}'
    if deck.exists() and deck.read_text() != wanted:
        shutil.rmtree(folder)
    if not deck.exists():
        folder.mkdir(parents=True, exist_ok=True)
        if case.axis.geometry == "mesh":
            grid = [word.removeprefix("grid.") for word in case.words if word.startswith("grid.")]
            write_grid(folder, dict(word.split("=", 1) for word in grid))
        deck.write_text(wanted)
    return deck


class _Runs:
    """The runs of a case: its own, and those it is compared with."""

    def __init__(self, deck: Path, case: Case, label: str) -> None:
        self.deck, self.case, self.label = deck, case, label

    def run(self, name: str, *words: str) -> tuple[Path, str]:
        """The folder of a run under that name, and the reason of its failure; it is run unless it has been."""
        case = self.case
        last = {word.partition("=")[0]: word for word in (*case.words, *words)}
        every = [word for key, word in last.items() if not key.startswith("grid.")]
        digest = hashlib.sha256(json.dumps(every).encode()).hexdigest()[:8]
        folder = self.deck.parent / f"{case.kind}-{_plain(name)}-{digest}"
        if (failure := launch.outcome(folder)) is None:
            print(f"{self.label}: {case.name} {case.value}, {case.kind}, {name}", file=sys.stderr, flush=True)
            failure = launch.run_apart(self.deck, self._worked_out(every), 1, folder, HANGS)
        return folder, failure

    def _worked_out(self, words: list[str]) -> list[str]:
        """The words with shares of the critical step as seconds: that of the undeformed body, as the program has it."""
        shares = [word for word in words if word.endswith("*critical")]
        done = [word for word in words if word not in shares]
        for word in shares:
            key, share = word.removesuffix("*critical").split("=")
            folder, failure = self.run("critical", *_CRITICAL)
            if failure:
                raise MpitledError(f"there is no critical step: {failure}")
            critical = _figures(folder)["time_step_s"] / SAFETY
            done.append(f"{key}={float(share) * critical:.9g}")
        return done


def _judge(case: Case, runs: _Runs) -> dict[str, Any]:
    """A row of the table: what became of the case."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS, "") | {
        "axis": case.name, "about": case.axis.about, "value": case.value, "kind": case.kind, "method": case.method,
        "reference": case.axis.reference, "outcome": WRONG,
    }  # fmt: skip
    try:
        folder, failure = runs.run(case.method, *METHODS[case.method].split())
    except MpitledError as problem:
        return row | {"message": str(problem)}
    status = int(launch.about(folder)["status"])
    row |= {"status": status, "message": failure.replace(f"{runs.deck.parent}{os.sep}", "")}
    if status:
        explained = {2: _REFUSED, 3: _UNSTABLE}.get(status)
        row["outcome"] = STOPPED if explained and explained.search(failure) else WRONG
        return row
    report = _figures(folder)
    row |= {
        "static_distance_mm": report.get("static_distance_mm", ""),
        "balance_error": report["energy_J"]["balance_error"],
        "kinetic_ratio": report["kinetic_to_internal"]["largest_after_10_percent"],
        "min_jacobian": report["min_jacobian"],
        "steps": report["steps"],
        "loop_s": report["seconds"]["loop"],
    }
    try:
        reference, allowed = _reference(case, runs, folder)
    except MpitledError as problem:
        return row | {"message": str(problem)}
    own = report.get("static_distance_mm")
    model, field, tolerance = _field(folder)
    warnings = report["warnings"]
    if own is None and case.method != "waves":
        if warnings:
            return row | {"outcome": WARNED, "message": " | ".join(warnings)}
        return row | {"message": "does not say how far from the static solution it ended"}
    round_off = ROUND_OFF * 1e3 * float(np.ptp(model.points, axis=0).max())
    exact = case.axis.reference in CLOSED_FORMS and allowed < round_off
    if own is not None:
        allowed += max(own, tolerance)
    allowed = TRUE_TO * allowed + round_off
    error = 1e3 * float(np.abs(field - reference).max())
    row |= {"error_mm": error, "allowed_mm": allowed}
    if error <= allowed:
        return row | {"outcome": RIGHT}
    if warnings:
        return row | {"outcome": WARNED, "message": " | ".join(warnings)}
    if exact and (energy := _energy(model, reference)) > report["energy_J"]["internal"]:
        words = f"holds {report['energy_J']['internal']:.3g} J, less than the closed form with {energy:.3g} J"
        return row | {"outcome": BUCKLED, "message": words}
    return row | {"message": "the field is farther from the reference than it may be"}


def _energy(model: Model, displacement: NDArray[np.float64]) -> float:
    """The strain energy (J) of nodal displacements (n_nodes, 3), m, without hourglass and stabilisation."""
    gradients, volumes = hexahedra.geometry(model.points, model.hexahedra)
    X = np.eye(3) + np.concatenate(
        [
            np.einsum("eai,eaj->eij", displacement[model.hexahedra], gradients),
            np.einsum("gai,gaj->gij", displacement[model.domains], model.domain_gradients),
        ]
    )
    volumes = np.concatenate([volumes, model.domain_volumes])
    energy = 0.0
    for i, material in enumerate(model.materials):
        own = model.material == i
        energy += float((strain_energy(X[own], material.lam, material.mu) * volumes[own]).sum())
    return energy


def _reference(case: Case, runs: _Runs, folder: Path) -> tuple[NDArray[np.float64], float]:
    """Displacements (n_nodes, 3), m, that the run's are compared with, and how far they may be wrong themselves, mm."""
    name = case.axis.reference
    if name in CLOSED_FORMS:
        with store.open_result(folder) as result:
            tumour = result.metadata["deck"].get("tumour")
        model, volume = store.read_model(folder / "model.h5"), 1e-9 * tumour["volume"] if tumour else 0.0
        exact = CLOSED_FORMS[name](model, model.points, volume)
        at = np.concatenate([model.points[model.hexahedra].mean(axis=1), model.domain_points])
        at_domains = np.einsum("ga,gai->gi", model.domain_shapes, exact[model.domains])
        interpolated = np.concatenate([exact[model.hexahedra].mean(axis=1), at_domains])
        return exact, 1e3 * float(np.abs(interpolated - CLOSED_FORMS[name](model, at, volume)).max())
    fields, steps, distance = [], [_figures(folder).get("time_step_s", np.nan)], 0.0
    for other in (name, "half") if name == "quarter" else (name,):
        found, failure = runs.run(other, *_OTHERWISE[other], *case.reference_words)
        if failure:
            raise MpitledError(f"there is no reference: {failure}")
        figures = _figures(found)
        fields.append(_field(found)[1])
        steps.append(figures.get("time_step_s", np.nan))
        distance = figures.get("static_distance_mm", 0.0)
    if name == "quarter":
        own, quarter, half = (step**2 for step in steps)
        distance = 1e3 * float(np.abs(fields[1] - fields[0]).max()) * (own - quarter) / (half - quarter)
    return fields[0], distance


def _figures(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "report.json").read_text()))


def _field(folder: Path) -> tuple[Model, NDArray[np.float64], float]:
    """The model of a run, the displacement field (n_nodes, 3), m, at its end, and its tolerance, mm."""
    with store.open_result(folder) as result:
        tolerance = float(result.metadata["deck"]["solver"]["tolerance"])
        return store.read_model(folder / "model.h5"), result.at_nodes("displacement", -1), tolerance


def summary(rows: list[dict[str, Any]]) -> str:
    """The outcomes by axis in Markdown, then every wrong one."""
    lines = [
        f"| axis | cells | {' | '.join(OUTCOMES)} | largest error, mm | of what it may be | smallest J |",
        "|" + (5 + len(OUTCOMES)) * "---|",
    ]
    names = list(dict.fromkeys(row["axis"] for row in rows))
    for name in (*names, "all"):
        own = [row for row in rows if name in (row["axis"], "all")]
        counts = [sum(row["outcome"] == outcome for row in own) for outcome in OUTCOMES]
        done = [row for row in own if row["outcome"] == RIGHT]
        worst = max(done, key=lambda row: float(row["error_mm"]) / float(row["allowed_mm"]), default=None)
        numbers = ["", "", ""]
        if worst:
            numbers = [
                f"{max(float(row['error_mm']) for row in done):.2g}",
                f"{float(worst['error_mm']) / float(worst['allowed_mm']):.0%}",
                f"{min(float(row['min_jacobian']) for row in done):.2g}",
            ]
        lines.append(f"| {name} | {len(own)} | {' | '.join(map(str, counts))} | {' | '.join(numbers)} |")
    for row in rows:
        if row["outcome"] == WRONG:
            place = f"{row['axis']} {row['value']}, {row['kind']}, {row['method']}"
            lines.append(f"\nwrong: {place}: {row['message']}; error {row['error_mm']} mm of {row['allowed_mm']}")
    return "\n".join(lines)
