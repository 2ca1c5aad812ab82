"""A term that is registered here alone: its lines of ledger, series and report, its restart fields, and its absence."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pytest
from conftest import mpitled
from numpy.typing import NDArray
from scenes import block, pulled

from mpitled import job, store, terms
from mpitled.deck import load_deck
from mpitled.errors import InterruptedRun
from mpitled.parallel.halo import World
from mpitled.solver.run import Run
from mpitled.terms.restart import nodal, reduced
from mpitled.terms.term import Scene, Side, StabilityBound, State, Term, energy

STIFFNESS = 2.0  # N/m, of the spring at each node
SCENE = (
    'title = "{title}"\n'
    + block((20, 20, 20), (4, 4, 4), "core")
    + pulled(2.0)
    + """
[support]
nodes = 12
[solver]
method = "{method}"
load_time = 0.1
tolerance = 0.05
[output]
frames = 2
pictures = false
"""
)


@dataclass(eq=False)
class Spring(Term):
    """Linear springs that pull the nodes of a plane back to their reference positions."""

    nodes: NDArray[np.int64]
    owned: NDArray[np.bool_]  # (n,), whether this rank counts the node
    u_last: NDArray[np.float64] = nodal()  # (3, n_nodes), m, at the last check
    path: float = reduced("sum", default=0.0)  # m, of the nodes from check to check

    name = "spring"
    figures = (energy("spring", Side.STORED),)
    absent = "the scene has no springs"

    @classmethod
    def from_scene(cls, scene: Scene) -> Iterator[Term]:
        assert scene.deck is not None
        if scene.deck.title == "springs":
            rows = scene.sub.rows
            nodes = np.flatnonzero(np.isclose(rows.read("points")[:, 0], 0.01))
            yield cls(nodes, rows.owned[nodes], np.zeros((3, scene.sub.n_nodes)))

    def apply(self, s: State) -> None:
        s.f[:, self.nodes] += STIFFNESS * s.u[:, self.nodes]

    def check(self, s: State, bound: StabilityBound) -> Mapping[str, float]:
        nodes = self.nodes[self.owned]
        bound.required[nodes] += bound.factor * STIFFNESS
        u = s.u[:, nodes]
        self.path += float(np.abs(u - self.u_last[:, nodes]).sum())
        self.u_last[:] = s.u[:, : self.u_last.shape[1]]
        return {"spring": 0.5 * STIFFNESS * float((u**2).sum())}


@pytest.fixture
def registered(monkeypatch):
    """The springs after the halo: every rank of a node adds the whole force."""
    after = terms.TERMS.index(terms.FinishHalo) + 1
    monkeypatch.setattr(terms, "TERMS", [*terms.TERMS[:after], Spring, *terms.TERMS[after:]])
    monkeypatch.setattr("mpitled.solver.monitor.TERMS", terms.TERMS)


def scene(folder, method, title="springs"):
    path = folder / "scene.toml"
    path.write_text(SCENE.format(title=title, method=method))
    return path


@pytest.mark.parametrize("method", ["dynamic", "quasi-static", "dynamic-relaxation"])
def test_a_new_term_is_in_ledger_series_and_report_and_survives_a_resume(tmp_path, monkeypatch, registered, method):
    deck, runs, checks, check = load_deck(scene(tmp_path, method)), [], 0, Run._check

    def counted(this):
        nonlocal checks
        checks += 1
        this.interrupts.asked = checks == stop_at
        check(this)
        runs.append(this)

    monkeypatch.setattr(Run, "_check", counted)
    stop_at = 0
    report = job.run(deck, tmp_path / "whole", World(), quiet=True)
    whole, total = runs[-1], checks
    checks, stop_at = 0, total // 3
    with pytest.raises(InterruptedRun):
        job.run(deck, tmp_path / "part", World(), quiet=True)
    stop_at = 0
    assert job.run(deck, tmp_path / "part", World(), quiet=True, resume=True)["resumed_at_step"] > 0
    springs = [next(t for t in r.integrator.step.terms if isinstance(t, Spring)) for r in (whole, runs[-1])]
    assert springs[0].path == springs[1].path > 0
    assert np.array_equal(springs[0].u_last, springs[1].u_last)
    assert report["energy_J"]["balance_error"] < 0.01
    with store.open_result(tmp_path / "whole") as result, store.open_result(tmp_path / "part") as resumed:
        u = result.at_nodes("parameters", -1)[np.isclose(result.node_points[:, 0], 0.01)]
        stored = 0.5 * STIFFNESS * (u**2).sum()
        assert result.series["spring_energy"][-1] == pytest.approx(stored, rel=1e-9)
        assert all(np.array_equal(result.series[name], resumed.series[name]) for name in result.series)
    assert report["energy_J"]["spring"] == pytest.approx(stored, rel=1e-9)
    parts = (report["energy_J"][name] for name in ("strain", "hourglass", "stabilisation", "spring"))
    assert sum(parts) == pytest.approx(report["energy_J"]["internal"])
    assert stored > 0.01 * report["energy_J"]["internal"]


def test_an_absent_term_is_nowhere_but_in_the_dry_run(tmp_path, registered):
    path = scene(tmp_path, "dynamic", title="none")
    assert "  spring: the scene has no springs\n" in mpitled("run", path, "--out", tmp_path / "out", "--dry").stdout
    mpitled("run", path, "-q", "--out", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert "spring" not in {*report["energy_J"], *report["term_seconds"]}
    with store.open_result(tmp_path / "out") as result:
        assert "spring_energy" not in result.series
