"""The stability matrix: scenes taken to extremes; each is right, stops with a reason, is warned of, or is wrong.

python jobs/stability/stability.py [--out out/stability] [--only AXIS,...] [--keep]   some 13 minutes on one core

Writes stability.csv and stability.png; --keep copies both to jobs/studies. Completed runs are not repeated. Exit status
1 if a case is wrong.

A run is right if its displacements differ from the reference by at most FACTOR times the known error: its own distance
to the static solution (at least its tolerance), the distance of a reference that is a run, and the interpolation error
of the cells for a closed form (which is zero except for the shell). Where there is no closed form, the reference is the
same mesh, relaxed to a hundredth of the tolerance with four times the load steps. Waves are compared with a run at a
quarter of the time step of "auto". The error of the central difference is of second order: it follows from the
difference to a third run at half the time step.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from exact import CLOSED_FORMS
from extremes import AXES, KINDS, METHODS, Axis
from grid import write_grid
from numpy.typing import NDArray
from picture import draw

from mpitled import atomic, store
from mpitled.batch import launch
from mpitled.cells import hexahedra
from mpitled.errors import MpitledError
from mpitled.laws import strain_energy
from mpitled.model import Model

#: Warned: the field is not the reference's, but the mesh or the result has a warning. Buckled: the field is not that of
#: an exact closed form, but it has less energy: the closed form is no stable equilibrium.
OUTCOMES = RIGHT, STOPPED, WARNED, BUCKLED, WRONG = "completed", "stopped", "warned", "buckled", "wrong"
COLUMNS = (
    "axis", "about", "value", "kind", "method", "outcome", "status", "error_mm", "allowed_mm", "reference",
    "static_distance_mm", "balance_error", "kinetic_ratio", "min_jacobian", "steps", "loop_s", "message",
)  # fmt: skip
#: Estimates of errors are correct within this factor.
FACTOR = 3.0
#: Errors below this share of the body's size are round-off of some thousand steps.
ROUND_OFF = 1e-9
#: Limit of processor time, s. Most runs take seconds, those that restart their load a minute.
TIME_LIMIT = 300
SAFETY = 0.8
#: Overrides of the runs that are references, and of the run that tells the critical time step.
OTHER_RUNS = {
    "relaxed": ("solver.method=dynamic-relaxation", "solver.tolerance=1e-4", "solver.load_steps=2000"),
    "quarter": ("solver.method=dynamic", "solver.time_step=0.2*critical"),
    "half": ("solver.method=dynamic", "solver.time_step=0.4*critical"),
    "critical": (
        "solver.method=dynamic", f"solver.safety={SAFETY}", "solver.time_step=auto", "displaced.0.displacement=[1e-6]",
    ),
}  # fmt: skip
#: By exit status, the message of a run that stopped: it names the cell or the key (or the file), and a remedy.
EXPLAINED = {
    2: re.compile(r"(\w+\.\w+( = [^:]+)?|\.inp: line \d+): .+[;,] "),
    3: re.compile(
        r"(hexahedron|support domain) \d+ \(.+\) at \(.+\) mm on rank \d+ .*; .*(solver|cloud)\.\w+"
        r"|comes no nearer to the static solution .*; .*solver\.\w+"
    ),
}


@dataclass(frozen=True, slots=True)
class Case:
    """One cell of the matrix, and its runs, which are computed only once."""

    name: str  # of the axis
    axis: Axis
    value: str
    kind: str
    method: str
    out: Path

    @property
    def words(self) -> list[str]:
        """The words of the value and the kind of cells."""
        return [*self.axis.values[self.value].split(), *KINDS[self.axis.geometry][self.kind].split()]

    @property
    def deck(self) -> Path:
        """The deck, in a folder of the value."""
        return self.out / f"{self.name}-{_plain(self.value)}" / "scene.toml"

    def write_deck(self) -> None:
        """Write the deck and the mesh that it reads; delete runs of another deck."""
        folder, text = self.deck.parent, f'title = "{self.axis.about}"\n{self.axis.deck}'
        if self.deck.exists() and self.deck.read_text() == text:
            return
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        if self.axis.geometry == "mesh":
            grid = [word.removeprefix("grid.").split("=", 1) for word in self.words if word.startswith("grid.")]
            write_grid(folder, dict(grid))
        self.deck.write_text(text)

    def run(self, name: str, *more: str) -> tuple[Path, str]:
        """The folder of a run with more overrides, and the reason of its failure ("" if it is done)."""
        words = [word for word in self.words if not word.startswith(("grid.", "reference."))]
        overrides = [*{word.partition("=")[0]: word for word in (*words, *more)}.values()]  # the last of each key
        digest = hashlib.sha256(json.dumps(overrides).encode()).hexdigest()[:8]
        folder = self.deck.parent / f"{self.kind}-{_plain(name)}-{digest}"
        failure = launch.outcome(folder)
        if failure is None:
            print(f"  {name}", file=sys.stderr, flush=True)
            overrides.sort(key=lambda word: word.endswith("*critical"))
            overrides = [self._in_seconds(word) if word.endswith("*critical") else word for word in overrides]
            failure = launch.run_apart(self.deck, overrides, 1, folder, TIME_LIMIT)
        return folder, failure

    def reference_run(self, name: str) -> Path:
        """The folder of a run that is a reference. MpitledError if it failed."""
        words = self.axis.values[self.value].split()
        more = [f"solver.{word.removeprefix('reference.')}" for word in words if word.startswith("reference.")]
        folder, failure = self.run(name, *OTHER_RUNS[name], *(more if name != "critical" else ()))
        if failure:
            raise MpitledError(f"there is no run {name}: {failure}")
        return folder

    def _in_seconds(self, word: str) -> str:
        key, share = word.removesuffix("*critical").split("=")
        return f"{key}={float(share) * _report(self.reference_run('critical'))['time_step_s'] / SAFETY:.9g}"


def cases(out: Path, only: Sequence[str] = ()) -> Iterator[Case]:
    """All cases of the matrix, or those of some axes."""
    for name in only or AXES:
        axis = AXES[name]
        for value in axis.values:
            for kind in axis.kinds:
                for method in axis.methods:
                    yield Case(name, axis, value, kind, method, out)


def matrix(out: Path, only: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Run the cases that have not been run yet, judge all of them, and write stability.csv and stability.png."""
    rows = []
    for case in cases(out, only):
        print(f"{case.name} {case.value}, {case.kind}, {case.method}", file=sys.stderr, flush=True)
        case.write_deck()
        rows.append(_judge(case))
    atomic.write_csv(out / "stability.csv", COLUMNS, rows)
    draw(rows, out / "stability.png")
    return rows


def _plain(text: str) -> str:
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in text)


def _judge(case: Case) -> dict[str, Any]:
    """A row of the table."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS, "") | {
        "axis": case.name, "about": case.axis.about, "value": case.value, "kind": case.kind, "method": case.method,
        "reference": case.axis.reference, "outcome": WRONG,
    }  # fmt: skip
    try:
        folder, failure = case.run(case.method, *METHODS[case.method].split())
        row |= {"status": int(launch.about(folder)["status"]), "message": failure.replace(f"{case.deck.parent}/", "")}
        if failure:
            pattern = EXPLAINED.get(row["status"])
            return row | ({"outcome": STOPPED} if pattern and pattern.search(failure) else {})
        report = _report(folder)
        row |= {
            "static_distance_mm": report.get("static_distance_mm", ""),
            "balance_error": report["energy_J"]["balance_error"],
            "kinetic_ratio": report["kinetic_to_internal"]["largest_after_10_percent"],
            "min_jacobian": report["min_jacobian"],
            "steps": report["steps"],
            "loop_s": report["seconds"]["loop"],
        }
        return row | _compare(case, folder, report)
    except MpitledError as problem:
        return row | {"message": str(problem)}


def _compare(case: Case, folder: Path, report: dict[str, Any]) -> dict[str, Any]:
    """The columns of a completed run that depend on the reference."""
    model, field, tolerance = _field(folder)
    reference, allowed = _reference(case, model, folder)
    distance, warnings = report.get("static_distance_mm"), report["warnings"]
    warned = {"outcome": WARNED, "message": " | ".join(warnings)}
    if distance is None and case.method != "waves":
        return warned if warnings else {"message": "does not say how far from the static solution it ended"}
    round_off = ROUND_OFF * 1e3 * float(np.ptp(model.points, axis=0).max())
    exact = case.axis.reference in CLOSED_FORMS and allowed < round_off
    allowed = FACTOR * (allowed + (0.0 if distance is None else max(distance, tolerance))) + round_off
    error = 1e3 * float(np.abs(field - reference).max())
    errors = {"error_mm": error, "allowed_mm": allowed}
    if error <= allowed:
        return errors | {"outcome": RIGHT}
    if warnings:
        return errors | warned
    energy = report["energy_J"]["internal"]
    if exact and (closed := _energy(model, reference)) > energy:
        message = f"has {energy:.3g} J, less than the closed form with {closed:.3g} J"
        return errors | {"outcome": BUCKLED, "message": message}
    return errors | {"message": "the field is farther from the reference than allowed"}


def _energy(model: Model, displacement: NDArray[np.float64]) -> float:
    """The strain energy, J, of nodal displacements (n_nodes, 3), m, without hourglass control and stabilisation."""
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
        energy += float((strain_energy(material.law, X[own]) * volumes[own]).sum())
    return energy


def _reference(case: Case, model: Model, folder: Path) -> tuple[NDArray[np.float64], float]:
    """Displacements (n_nodes, 3), m, that those of the run in a folder are compared with, and their own error, mm."""
    name = case.axis.reference
    if form := CLOSED_FORMS.get(name):
        with store.open_result(folder) as result:
            tumour = result.metadata["deck"].get("tumour")
        volume = 1e-9 * tumour["volume"] if tumour else 0.0
        exact = form(model, model.points, volume)
        at = np.concatenate([model.points[model.hexahedra].mean(axis=1), model.domain_points])
        at_domains = np.einsum("ga,gai->gi", model.domain_shapes, exact[model.domains])
        interpolated = np.concatenate([exact[model.hexahedra].mean(axis=1), at_domains])
        return exact, 1e3 * float(np.abs(interpolated - form(model, at, volume)).max())
    other = case.reference_run(name)
    reference = _field(other)[1]
    if name != "quarter":
        return reference, _report(other).get("static_distance_mm", 0.0)
    half = case.reference_run("half")
    own2, quarter2, half2 = (_report(each)["time_step_s"] ** 2 for each in (folder, other, half))
    difference = 1e3 * float(np.abs(_field(half)[1] - reference).max())
    return reference, difference * (own2 - quarter2) / (half2 - quarter2)


def _report(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "report.json").read_text())


def _field(folder: Path) -> tuple[Model, NDArray[np.float64], float]:
    """The model of a run, its last displacements (n_nodes, 3), m, and its tolerance, mm."""
    with store.open_result(folder) as result:
        tolerance = float(result.metadata["deck"]["solver"]["tolerance"])
        return store.read_model(folder / "model.h5"), result.at_nodes("displacement", -1), tolerance


def summary(rows: list[dict[str, Any]]) -> str:
    """The outcomes by axis as Markdown, then every wrong case."""
    lines = [
        f"| axis | cases | {' | '.join(OUTCOMES)} | largest error, mm | share of allowed | smallest J |",
        "|" + (5 + len(OUTCOMES)) * "---|",
    ]
    for name in (*dict.fromkeys(row["axis"] for row in rows), "all"):
        own = [row for row in rows if name in (row["axis"], "all")]
        counts = [str(sum(row["outcome"] == outcome for row in own)) for outcome in OUTCOMES]
        done = [row for row in own if row["outcome"] == RIGHT]
        numbers = ["", "", ""]
        if done:
            share = max(row["error_mm"] / row["allowed_mm"] for row in done)
            error, smallest = max(row["error_mm"] for row in done), min(row["min_jacobian"] for row in done)
            numbers = [f"{error:.2g}", f"{share:.0%}", f"{smallest:.2g}"]
        lines.append(f"| {' | '.join([name, str(len(own)), *counts, *numbers])} |")
    for row in rows:
        if row["outcome"] == WRONG:
            case = f"{row['axis']} {row['value']}, {row['kind']}, {row['method']}"
            lines.append(f"\nwrong: {case}: {row['message']}; error {row['error_mm']} mm of {row['allowed_mm']}")
    return "\n".join(lines)


def main() -> int:
    """Exit status 1 if a case is wrong."""
    parser = argparse.ArgumentParser(description="Scenes taken to extremes: which complete, and which stop.")
    parser.add_argument("--out", type=Path, default=Path("out/stability"), metavar="DIR", help="folder of the runs")
    parser.add_argument("--only", default="", metavar="AXIS,...", help=f"some of the axes: {', '.join(AXES)}")
    parser.add_argument("--keep", action="store_true", help="copy the table and the picture to jobs/studies")
    options = parser.parse_args()
    only = [name for name in options.only.split(",") if name]
    if unknown := set(only) - AXES.keys():
        parser.error(f"--only: there is no axis {', '.join(unknown)}; axes are {', '.join(AXES)}")
    rows = matrix(options.out, only)
    print(summary(rows))
    if options.keep:
        for name in ("stability.csv", "stability.png"):
            shutil.copy(options.out / name, Path(__file__).parents[1] / "studies" / name)
    return int(any(row["outcome"] == WRONG for row in rows))


if __name__ == "__main__":
    sys.exit(main())
