"""Times the composed step of models on the ranks of this process: the worker process that bench.py starts."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import limits
import numpy as np

from mpitled import store
from mpitled.batch import launch
from mpitled.deck import Solver
from mpitled.parallel.halo import Halo, World
from mpitled.parallel.subdomain import Subdomain, localise
from mpitled.preview.kernel_trace import Call, distinct_bytes, trace_kernels
from mpitled.solver.dynamic_relaxation import DynamicRelaxation
from mpitled.terms import Scene, State, Step, Term

PRECISIONS = {"float64": np.float64, "float32": np.float32}
RATE = "million_cell_updates_per_second_per_core"


@dataclass(slots=True)
class StepBenchmark:
    """The composed step of one rank, in a state with strains of about 1 %."""

    sub: Subdomain
    state: State
    terms: tuple[Term, ...]
    halo: Halo | None
    seconds: float = 0.0  # of all steps so far

    def run(self, n: int) -> float:
        """Execute n steps and return their seconds."""
        state, terms, begin = self.state, self.terms, time.perf_counter()
        for _ in range(n):
            for term in terms:
                term.apply(state)
        elapsed = time.perf_counter() - begin
        self.seconds += elapsed
        return elapsed

    def trace(self) -> list[Call]:
        """The kernel calls of a step. Collective."""
        return trace_kernels([(term.name, partial(term.apply, self.state)) for term in self.terms])

    def roofline(self, calls: list[Call], operations: Mapping[str, float], multiply_adds: float) -> tuple[float, float]:
        """Least seconds of a step, and the seconds of them in terms that memory bounds; the halo is not counted.

        A term takes at least the time of its operations (two in each multiply-add) and the time of its arrays at the
        memory bandwidth of an equally large working set. Terms follow each other: their bounds are added.
        """
        bandwidth = limits.triad(distinct_bytes(calls), 3)
        cells = {packed.name: packed.n_cells for packed in self.sub.packed}
        total = by_memory = 0.0
        for name in dict.fromkeys(name for name in (term.name for term in self.terms) if name in operations):
            arithmetic = operations[name] * cells.get(name, self.sub.n_nodes) / (2 * multiply_adds)
            memory = sum(call.traffic for call in calls if call.term == name) / bandwidth
            total += max(arithmetic, memory)
            by_memory += memory if memory > arithmetic else 0.0
        return total, by_memory


def compose(sub: Subdomain, world: World, relaxation: bool = False) -> StepBenchmark:
    """The step of central difference or dynamic relaxation; the time step is so short that the state hardly moves."""
    state = State.at_rest(sub, 1.0, 1e-8)
    if relaxation:
        dt2_over_m, components = state.dt2_over_m, DynamicRelaxation.mass_components(sub)
        state.dt2_over_m = np.zeros((components, sub.n_nodes))
        state.dt2_over_m[[0] if components == 1 else [0, 3, 5]] = dt2_over_m
    points = sub.rows.read("points")
    x = (points - points.mean(axis=0)).T / np.ptp(points)
    state.set_displacement(0.01 * np.ptp(points) * (x[[1, 2, 0]] + np.sin(6 * np.pi * x) / 18))
    state.time = 0.1 * state.load_time
    halo = Halo(world, sub.shared, 3, sub.precision) if world.size > 1 else None
    solver = Solver(method="dynamic-relaxation" if relaxation else "quasi-static")
    return StepBenchmark(sub, state, Step(Scene(sub, solver, halo)).terms, halo)


def time_steps(benchmarks: Mapping[str, StepBenchmark], world: World, quick: bool) -> dict[str, float]:
    """Seconds of a step of each benchmark on the slowest rank: medians of repeats, in which all take turns."""
    repeats, span = (5, 0.05) if quick else (9, 0.2)  # s of each repeat
    steps = {}
    for name, benchmark in benchmarks.items():
        benchmark.run(2)
        n = 2
        while (took := float(world.gather([benchmark.run(n)]).max())) <= span / 4:
            n *= 4
        steps[name] = max(1, round(n * span / took))
    seconds: dict[str, list[float]] = {name: [] for name in benchmarks}
    for _ in range(repeats):
        for name, benchmark in benchmarks.items():
            world.barrier()
            seconds[name].append(benchmark.run(steps[name]) / steps[name])
    return {name: float(np.median(world.gather(each).max(axis=0))) for name, each in seconds.items()}


def start_workers(folder: Path, task: dict[str, Any], ranks: int, copies: int = 1) -> list[dict[str, Any]]:
    """The results of some simultaneous copies of `main` on `ranks` ranks each: {"limits": ..., "cases": [...]}."""
    path = folder / "task.json"
    path.write_text(json.dumps(task))
    command = [*launch.ranked(ranks), sys.executable, __file__, str(path)]
    workers = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(copies)]
    printed = [worker.communicate()[0] for worker in workers]
    if any(worker.returncode for worker in workers):
        raise RuntimeError(f"a benchmark on {ranks} ranks failed")
    return [json.loads(text) for text in printed]


def main() -> None:
    """step_benchmark.py TASK.json on each rank; rank 0 prints the result as JSON."""
    task, world = json.loads(Path(sys.argv[1]).read_text()), World()
    multiply_adds = {precision: limits.multiply_adds(precision) for precision in PRECISIONS}
    machine = {"triad_bytes_per_second": limits.triad(limits.LARGE), "multiply_adds_per_second": multiply_adds}
    cases = []
    for scene in task["scenes"]:
        if world.leads:
            print(f"{world.size} rank(s): {scene['scene']} {scene['size']}", file=sys.stderr, flush=True)
        cases += _cases(scene, task["operations"][scene["scene"]], multiply_adds, world, task["quick"])
    if world.leads:
        print(json.dumps({"limits": machine, "cases": cases}))


def _cases(
    scene: dict[str, Any], operations: dict[str, float], multiply_adds: dict[str, float], world: World, quick: bool
) -> list[dict[str, Any]]:
    """The case of each precision of a scene. Collective."""
    rows = store.read_part(Path(scene["model"]), world.size, world.rank)
    benchmarks = {
        name: compose(localise(rows, scene["hourglass"], scene["stabilisation"], "mean", precision), world)
        for name, precision in PRECISIONS.items()
    }
    calls = {name: benchmark.trace() for name, benchmark in benchmarks.items()}
    for benchmark in benchmarks.values():
        if benchmark.halo:
            benchmark.halo.seconds = dict.fromkeys(benchmark.halo.seconds, 0.0)
    seconds = time_steps(benchmarks, world, quick)
    cases = []
    for name, benchmark in benchmarks.items():
        halo = sum(benchmark.halo.seconds.values()) / benchmark.seconds if benchmark.halo else 0.0
        bounds = benchmark.roofline(calls[name], operations, multiply_adds[name])
        table = world.gather([benchmark.sub.n_cells, distinct_bytes(calls[name]), halo, *bounds])
        cells, sizes, halos, bound, by_memory = table.T
        cases.append(
            {
                "scene": scene["scene"],
                "cells": int(cells.sum()),
                "precision": name,
                "ranks": world.size,
                RATE: cells.sum() / seconds[name] / world.size / 1e6,
                "bytes_per_cell": sizes.sum() / cells.sum(),
                "halo_share": halos.max(),
                "roofline_share": bound.max() / seconds[name],
                "memory_share_of_bound": by_memory.sum() / bound.sum(),
            }
        )
    return cases


if __name__ == "__main__":
    main()
