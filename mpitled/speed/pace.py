"""Times the composed step of scenes on the ranks of this process: what `mpitled bench` starts, apart from itself."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mpitled import store
from mpitled.deck import Solver
from mpitled.parallel.halo import Halo, World
from mpitled.parallel.subdomain import Subdomain, localise
from mpitled.solver.dynamic_relaxation import DynamicRelaxation
from mpitled.speed import limits
from mpitled.speed.witness import Call, distinct_bytes, witness
from mpitled.terms import Scene, State, Step, Term

PRECISIONS: dict[str, type[np.floating]] = {"float64": np.float64, "float32": np.float32}
#: How often a case is timed, and for how many seconds each time; the median counts.
REPEATS, SPAN = 9, 0.2
QUICK_REPEATS, QUICK_SPAN = 5, 0.05
# The state that is timed hardly moves: a step this short (s), at this share of the load time.
_TIME_STEP, _SHARE = 1e-8, 0.1
_STRAIN, _WAVES = 0.01, 3.0


@dataclass(slots=True)
class Pace:
    """A composed step of one rank, ready to be taken, and the ranks' halo."""

    sub: Subdomain
    state: State
    terms: tuple[Term, ...]
    halo: Halo | None

    def take(self, n: int) -> None:
        """So many steps."""
        state, terms = self.state, self.terms
        for _ in range(n):
            for term in terms:
                term.apply(state)

    def witnessed(self) -> list[Call]:
        """What a step calls. Collective."""
        return witness([(term.name, partial(term.apply, self.state)) for term in self.terms])

    def work(self) -> dict[str, int]:
        """Cells that the terms of forces have to do."""
        n_hexahedra = self.sub.rows.n_own_hexahedra
        in_runs = sum(cells.n_cells for cells in self.sub.packed if cells.name == "voxel hexahedra")
        return {
            "voxel hexahedra": in_runs,
            "hexahedra": n_hexahedra - in_runs,
            "support domains": self.sub.n_cells - n_hexahedra,
        }


def made(sub: Subdomain, world: World, relaxed: bool = False) -> Pace:
    """The step of a part, marching or in relaxation, in a state that is strained by about 1 %."""
    state = State.at_rest(sub, 1.0, _TIME_STEP)
    if relaxed:
        dt2_over_m, components = state.dt2_over_m, DynamicRelaxation.mass_components(sub)
        state.dt2_over_m = np.zeros((components, sub.n_nodes))
        state.dt2_over_m[[0] if components == 1 else [0, 3, 5]] = dt2_over_m
    points = sub.rows.read("points")
    x = points.T
    x = (x - x.mean(axis=1, keepdims=True)) / np.ptp(x)
    strained = _STRAIN * np.ptp(points) * (x[[1, 2, 0]] + np.sin(2 * np.pi * _WAVES * x) / (6 * _WAVES))
    state.set_displacement(strained)
    state.time = _SHARE * state.load_time
    halo = Halo(world, sub.shared, 3, sub.precision) if world.size > 1 else None
    solver = Solver(method="dynamic-relaxation" if relaxed else "quasi-static")
    return Pace(sub, state, Step(Scene(sub, solver, halo)).terms, halo)


def timed(acts: Mapping[str, Callable[[int], None]], world: World, repeats: int, span: float) -> dict[str, float]:
    """Seconds of one step of each, on the slowest rank: medians of repeats, taken in turn so that all meet alike."""
    steps = {}
    for name, act in acts.items():
        act(2)
        n = 2
        while True:
            begin = time.perf_counter()
            act(n)
            took = float(world.gather([time.perf_counter() - begin]).max())
            if took > span / 4:
                break
            n *= 4
        steps[name] = max(1, round(n * span / took))
    seconds: dict[str, list[float]] = {name: [] for name in acts}
    for _ in range(repeats):
        for name, act in acts.items():
            world.barrier()
            begin = time.perf_counter()
            act(steps[name])
            seconds[name].append((time.perf_counter() - begin) / steps[name])
    return {name: float(np.median(world.gather(all_).max(axis=0))) for name, all_ in seconds.items()}


def main() -> None:
    """The process of its own, or each of its ranks: JOB.json; rank 0 prints JSON."""
    job = json.loads(Path(sys.argv[1]).read_text())
    world = World()
    repeats, span = (QUICK_REPEATS, QUICK_SPAN) if job["quick"] else (REPEATS, SPAN)
    multiply_adds = {precision: limits.multiply_adds(precision) for precision in PRECISIONS}
    machine = {"triad_bytes_per_second": limits.triad(limits.LARGE), "multiply_adds_per_second": multiply_adds}
    cases = []
    for scene in job["scenes"]:
        if world.leads:
            print(
                f"{world.size} rank{'s' if world.size > 1 else ''}: {scene['scene']} {scene['size']}",
                file=sys.stderr,
                flush=True,
            )
        operations = job["operations"][scene["scene"]]
        cases += _cases(scene, operations, multiply_adds, world, repeats, span)
    if world.leads:
        print(json.dumps({"limits": machine, "cases": cases}))


def _cases(
    scene: dict[str, Any],
    operations: dict[str, float],
    multiply_adds: dict[str, float],
    world: World,
    repeats: int,
    span: float,
) -> list[dict[str, Any]]:
    """The case of each precision of a scene. Collective."""
    rows = store.read_part(Path(scene["model"]), world.size, world.rank)
    paces = {
        name: made(localise(rows, scene["hourglass"], scene["stabilisation"], "mean", precision), world)
        for name, precision in PRECISIONS.items()
    }
    calls = {precision: pace.witnessed() for precision, pace in paces.items()}
    loops = dict.fromkeys(PRECISIONS, 0.0)
    for pace in paces.values():
        if pace.halo:
            pace.halo.seconds = dict.fromkeys(pace.halo.seconds, 0.0)

    def take(precision: str, n: int) -> None:
        begin = time.perf_counter()
        paces[precision].take(n)
        loops[precision] += time.perf_counter() - begin

    seconds = timed({precision: partial(take, precision) for precision in PRECISIONS}, world, repeats, span)
    made_cases = []
    for precision, pace in paces.items():
        size = distinct_bytes(calls[precision])
        bound, by_memory = roofline(pace, calls[precision], operations, multiply_adds[precision], limits.triad(size, 3))
        waited = sum(pace.halo.seconds.values()) if pace.halo else 0.0
        table = world.gather([pace.sub.n_cells, size, waited / loops[precision], bound, by_memory])
        cells, sizes, halo_shares, bounds, memory = table.T
        made_cases.append(
            {
                "scene": scene["scene"],
                "cells": int(cells.sum()),
                "precision": precision,
                "ranks": world.size,
                "million_cell_updates_per_second_per_core": cells.sum() / seconds[precision] / world.size / 1e6,
                "bytes_per_cell": sizes.sum() / cells.sum(),
                "halo_share": halo_shares.max(),
                "roofline_share": bounds.max() / seconds[precision],
                "memory_share_of_bound": memory.sum() / bounds.sum(),
            }
        )
    return made_cases


def roofline(
    pace: Pace, calls: Sequence[Call], operations: Mapping[str, float], multiply_adds: float, bandwidth: float
) -> tuple[float, float]:
    """Seconds that a step takes at least, and those of them in terms that memory bounds; the halo's not counted.

    A term cannot be faster than its operations at two a multiply-add, nor than its arrays pass the memory at the
    bandwidth of as large a working set. Terms follow each other, so that their bounds add up.
    """
    work = pace.work()
    total = by_memory = 0.0
    for name in dict.fromkeys(term.name for term in pace.terms):
        if name not in operations:
            continue
        arithmetic = operations[name] * work.get(name, pace.sub.n_nodes) / (2 * multiply_adds)
        memory = sum(call.traffic for call in calls if call.term == name) / bandwidth
        total += max(arithmetic, memory)
        by_memory += memory if memory > arithmetic else 0.0
    return total, by_memory
