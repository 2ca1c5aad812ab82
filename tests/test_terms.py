"""A term that is registered here alone: its lines of ledger, series and report, its restart fields, and its absence."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import SimpleNamespace

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
from mpitled.terms.restart import Packed, Scope, nodal, owned_dofs, reduced, replicated, restore, snapshot
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


@dataclass
class Fields:
    """One restart field of each kind."""

    u: NDArray[np.float64] = nodal(single_precision=True)
    mass: NDArray[np.float64] = nodal()
    absent: NDArray[np.float64] | None = nodal()
    reaction: NDArray[np.float64] = owned_dofs()
    work: float = reduced("sum")
    smallest: float = reduced("min")
    time: float = replicated()
    safety: float = replicated(control=True)


def part(nodes, owned, n_parts, number):
    """As much of a subdomain as restart fields need; dof 3 node + 1 of the global nodes 0 and 3 moves."""
    moving = np.array([3 * k + 1 for k, node in enumerate(nodes) if node in (0, 3)], np.uint32)
    rows = SimpleNamespace(owned=np.array(owned), n_parts=n_parts, part=number)
    return SimpleNamespace(n_nodes=len(nodes), moving=moving, rows=rows)


def test_any_number_of_ranks_reads_a_checkpoint():
    """Nodes 0, 1, 2 and 2, 3 on two ranks, and all on one: sums are kept, and the smallest is the smallest of all."""
    two = [([0, 1, 2], part([0, 1, 2], [True] * 3, 2, 0)), ([2, 3], part([2, 3], [False, True], 2, 1))]
    one = [([0, 1, 2, 3], part([0, 1, 2, 3], [True] * 4, 1, 0))]
    mass = np.array([2.0, 3.0, 5.0, 7.0])
    u = np.arange(12.0).reshape(3, 4)

    def fields(nodes, sub, work, smallest):
        moving = [n for n, owned in zip(nodes, sub.rows.owned, strict=True) if owned and n in (0, 3)]
        reaction = np.array([10.0 + n for n in moving])
        return Fields(u[:, nodes], mass[nodes], None, reaction, work, smallest, 0.5, 0.8)

    numbers = {1: [(3.0, 0.25)], 2: [(1.0, 0.5), (2.0, 0.25)]}
    for writers, readers in ((two, one), (one, two), (two, two)):
        wrote, table = [], numbers[len(writers)]
        for (nodes, sub), (work, smallest) in zip(writers, table, strict=True):
            things = {"things": fields(nodes, sub, work, smallest)}
            packed = Packed()
            packed.add("now", things, Scope.CHECKPOINT, snapshot(things, Scope.CHECKPOINT), sub)
            wrote.append(packed)
        rows = {key: np.concatenate([p.nodal[key] for p in wrote]) for key in wrote[0].nodal}
        reduced_numbers = {key: np.array([p.reduced[key] for p in wrote]) for key in wrote[0].reduced}
        read = []
        for nodes, sub in readers:
            blank = {
                "things": Fields(*(np.zeros_like(a[..., nodes]) for a in (u, mass)), None, np.zeros(0), 0, 1, 0, 0)
            }
            of_rank = Packed({k: v[nodes] for k, v in rows.items()}, reduced_numbers, wrote[0].replicated)
            blank["things"].reaction = fields(nodes, sub, 0, 0).reaction * 0
            restore(blank, Scope.CHECKPOINT, of_rank.snapshot("now", blank, Scope.CHECKPOINT, sub))
            expected = fields(nodes, sub, 0, 0)
            for name in ("u", "mass", "reaction", "absent", "time", "safety"):
                assert np.array_equal(getattr(blank["things"], name), getattr(expected, name)), name
            read.append(blank["things"])
        assert sum(f.work for f in read) == 3.0
        assert min(f.smallest for f in read) == 0.25
        if len(readers) == len(writers):
            assert [(f.work, f.smallest) for f in read] == table


def test_a_rollback_leaves_controls_and_takes_as_much_as_its_scope():
    full = Fields(np.ones((3, 2)), np.ones(2), None, np.ones(1), 1.0, 1.0, 1.0, 1.0)
    for scope, restored in {
        Scope.ROLLBACK: {"u", "mass", "reaction", "work", "smallest", "time"},
        Scope.ROLLBACK_TO_REST: {"u", "work", "smallest", "time"},
        Scope.NUMBERS: {"work", "smallest", "time"},
    }.items():
        now = Fields(np.zeros((3, 2)), np.zeros(2), None, np.zeros(1), 0.0, 0.0, 0.0, 0.0)
        restore({"x": now}, scope, snapshot({"x": full}, scope))
        changed = {name for name in vars(now) if getattr(now, name) is not None and np.any(getattr(now, name))}
        assert changed == restored


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
