"""From a deck to a result: model and partition by one rank, then the time loop on all, watched every few steps."""

from __future__ import annotations

import importlib.metadata
import math
import resource
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import partition
from mpitled import deck as decks
from mpitled import store
from mpitled.deck import Deck
from mpitled.errors import InputError, InterruptedRun, MpitledError, UnstableError
from mpitled.halo import Halo, World
from mpitled.loading import sphere_radius
from mpitled.step import Survey, compose, start
from mpitled.subdomain import Subdomain, localise

#: Cost of a hexahedron and of a support domain in a step, measured with `pytest -m study tests/test_kernels.py`.
CELL_COSTS = (1.0, 3.0)
#: The cells are surveyed at least so many times in a run, and at least once in so many steps.
SURVEYS, LONGEST_UNWATCHED = 100, 50
#: The energy balance may be wrong by this share of the largest energy; beyond it the run is unstable.
BALANCE_LIMIT = 0.05
#: So many steps from rest the ledger is too coarse to judge by: its trapezoidal rule is wrong by about 8 over the steps
#: squared of what little energy there is.
LEDGER_STARTS = 50

MODEL = "model.h5"


class Phases:
    """Wall time of each phase of a run, s."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin


def build(deck: Deck, directory: Path) -> tuple[Path, bool]:
    """The model of a deck in directory/model.h5, and whether it had to be built: the same deck uses it again."""
    path = directory / MODEL
    key = decks.model_key(deck)
    if store.model_key(path) == key:
        return path, False
    directory.mkdir(parents=True, exist_ok=True)
    from mpitled import preprocess  # only the rank that builds needs the meshers

    store.write_model(path, preprocess.build(deck), key)
    return path, True


def divide(path: Path, n_parts: int, seed: int) -> str:
    """Partition a model in n_parts, stored in its file under that number; a table of the parts."""
    model = store.read_model(path)
    graph = partition.cell_graph(model.hexahedra, model.domains, model.domain_points)
    try:
        part = partition.cut(graph, n_parts, CELL_COSTS, seed)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    tables = partition.tables(model.hexahedra, model.domains, part, n_parts)
    store.write_partition(path, tables)
    return partition.figures(tables, CELL_COSTS, len(model.hexahedra), graph).describe()


def run(deck: Deck, directory: Path, world: World, *, quiet: bool = False) -> dict[str, Any]:
    """Compute a deck on all ranks; writes model.h5, result.vtkhdf, report.json and pictures into the directory.

    The report, on every rank. InputError, UnstableError or InterruptedRun alike on all ranks.
    """
    phases = Phases()
    with phases("model"):
        path = _on_leader(world, lambda: build(deck, directory)[0])
    with phases("partition"):
        if world.size > 1:
            _on_leader(world, lambda: _ensure_partition(path, world.size, deck.partition.seed))
    with phases("read"):
        rows = store.read_part(path, world.size, world.rank)
        rule = deck.hexahedra.gradient
        sub = localise(rows, deck.hexahedra.hourglass, deck.support.stabilisation, rule)
        critical = store.read_figures(path)
    return _Loop(deck, directory, world, sub, critical, phases, quiet).run()


@contextmanager
def everywhere() -> Iterator[None]:
    """What is raised inside is raised on every rank alike: the command need not abort the others."""
    try:
        yield
    except MpitledError as error:
        error.everywhere = True
        raise


def _ensure_partition(path: Path, n_parts: int, seed: int) -> None:
    if not store.has_partition(path, n_parts):
        divide(path, n_parts, seed)


def _on_leader(world: World, work: Any) -> Any:
    """The result of work, done by rank 0, on all ranks; its error likewise, before anything collective follows."""
    outcome: Any = None
    if world.leads:
        try:
            outcome = work()
        except MpitledError as error:
            outcome = error
    with everywhere():
        outcome = world.broadcast(outcome)
        if isinstance(outcome, MpitledError):
            raise outcome
    return outcome


def schedule(load_time: float, longest_step: float, frames: int) -> tuple[int, int, int]:
    """Steps of the run, steps between surveys, and surveys between frames, so that each falls on the next."""
    steps = math.ceil(load_time / longest_step * (1 - 1e-12))
    between = min(LONGEST_UNWATCHED, max(1, steps // SURVEYS))
    surveys = max(1, math.ceil(steps / (between * frames)))
    between = math.ceil(steps / (surveys * frames))
    return between * surveys * frames, between, surveys


class _Loop:
    """The time loop of one rank and what is watched, written and counted around it."""

    def __init__(
        self,
        deck: Deck,
        directory: Path,
        world: World,
        sub: Subdomain,
        critical: dict[str, float],
        phases: Phases,
        quiet: bool,
    ) -> None:
        self.deck, self.directory, self.world, self.sub, self.phases = deck, directory, world, sub, phases
        solver = deck.solver
        self.scales_mass = solver.mass_scaling
        if solver.time_step == "auto":
            longest = solver.safety * critical["critical_step_median_s" if self.scales_mass else "critical_step_min_s"]
        else:
            longest = float(solver.time_step)
        n_steps, self.between, self.surveys = schedule(solver.load_time, longest, deck.output.frames)
        self.halo = Halo(world, sub.shared, 3) if world.size > 1 else None
        self.terms = compose(sub, self.halo)
        self.survey = Survey(
            sub, Halo(world, sub.shared, 1) if world.size > 1 else None, self.scales_mass, solver.safety
        )
        self.state = start(sub, n_steps, solver.load_time / n_steps)
        self.progress = None if quiet or not world.leads else _Progress(n_steps)
        self.interrupted = 0
        self.term_seconds = dict.fromkeys((name for name, _ in self.terms), 0.0)
        self.largest_kinetic_ratio = 0.0
        self.largest_energy = 0.0
        # The strain energy of the undeformed body is no better than this, J: tr C - 3 and ln J are not quite 0.
        self.noise = 8 * np.finfo(float).eps * max(m.mu for m in sub.rows.materials) * critical["volume_m3"]
        self.figures: dict[str, float] = {}

    # ------------------------------------------------------------ the loop

    def run(self) -> dict[str, Any]:
        with self.phases("compile"):
            self._warm_up()
        previous = {s: signal.signal(s, self._interrupt) for s in (signal.SIGINT, signal.SIGTERM)}
        writer = store.ResultWriter(
            self.directory,
            self.world.comm,
            self.sub.rows,
            self.deck.output.frames + 1,
            self._metadata(),
            series=_SERIES,
        )
        begin = time.perf_counter()
        try:
            self._march(writer)
        except MpitledError:
            writer.abandon(self._run_figures(time.perf_counter() - begin))
            raise
        finally:
            for which, handler in previous.items():
                signal.signal(which, handler)
            if self.progress:
                self.progress.close()
        self.phases.seconds["loop"] = time.perf_counter() - begin - self.phases.seconds.get("output", 0.0)
        writer.close(self._run_figures(self.phases.seconds["loop"]))
        with self.phases("report"):
            from mpitled import report

            made = _on_leader(self.world, lambda: report.write(self.directory, self.phases.seconds))
        return made

    def _march(self, writer: store.ResultWriter) -> None:
        state, clock = self.state, time.perf_counter
        forces, update = self.terms[:-1], self.terms[-1][1]
        seconds, terms = self.term_seconds, self.terms
        while True:
            for name, term in forces:
                begin = clock()
                term(state)
                seconds[name] += clock() - begin
            with everywhere():
                self._watch()
            if state.step % (self.between * self.surveys) == 0:
                with self.phases("output"):
                    self._write(writer)
            if state.step == state.n_steps:
                return
            update(state)
            for _ in range(self.between - 1):
                for name, term in terms:
                    begin = clock()
                    term(state)
                    seconds[name] += clock() - begin

    def _warm_up(self) -> None:
        """Compile, or load from the disk's cache: rank 0 first, so that the others find its work there."""
        if not self.world.leads:
            self.world.barrier()
        scratch = start(self.sub, self.state.n_steps, self.state.time_step)
        for name, term in self.terms:
            if name != "halo":
                term(scratch)
        Survey(self.sub, None, True, 1.0).look(scratch)
        if self.world.leads:
            self.world.barrier()

    # ------------------------------------------------------------ what is watched

    def _watch(self) -> None:
        """Survey all ranks, keep the ledger, and end the run on all of them alike if it cannot go on."""
        state, world = self.state, self.world
        own = self.survey.look(state)
        table = world.gather([*own.values(), float(self.interrupted)])
        columns = dict(zip(own, table.T, strict=False))
        figures = {name: float(sum(columns[name])) for name in own}
        figures["min_jacobian"] = float(columns["min_jacobian"].min())
        figures["step_ratio"] = float(columns["step_ratio"].max())
        internal = figures["strain"] + figures["hourglass"] + figures["stabilisation"]
        supplied = figures["external"] + figures["added"]
        self.largest_energy = max(self.largest_energy, abs(supplied), internal, figures["kinetic"])
        figures["balance_error"] = abs(supplied - internal - figures["kinetic"]) / (self.largest_energy or 1.0)
        figures["kinetic_ratio"] = figures["kinetic"] / internal if internal > 0 else 0.0
        if state.share >= 0.1:
            self.largest_kinetic_ratio = max(self.largest_kinetic_ratio, figures["kinetic_ratio"])
        self.figures = figures
        if self.progress:
            self.progress.show(state.step, figures)
        finite = math.isfinite(internal + figures["kinetic"] + figures["external"])
        if not finite or figures["min_jacobian"] <= 0:
            worst = int(np.argmin(np.where(np.isnan(columns["min_jacobian"]), -np.inf, columns["min_jacobian"])))
            raise UnstableError(world.broadcast(self._inverted() if world.rank == worst else None, worst))
        wrong = figures["balance_error"] * self.largest_energy > BALANCE_LIMIT * self.largest_energy + self.noise
        if wrong and state.step >= LEDGER_STARTS:
            raise UnstableError(
                f"unstable at {state.share:.1%} of the load: the energy balance is wrong by "
                f"{figures['balance_error']:.1%} (external and added {supplied:.3g} J, internal {internal:.3g} J, "
                f"kinetic {figures['kinetic']:.3g} J); the step is {figures['step_ratio']:.2f} times the one proved "
                "stable: set solver.time_step smaller, or solver.mass_scaling = true, or solver.load_time longer"
            )
        if table[:, -1].any():
            raise InterruptedRun(f"interrupted at {state.share:.1%} of the load; what was written is readable")

    def _inverted(self) -> str:
        """What happened in the worst cell of this rank, in one line."""
        rows, jacobian = self.sub.rows, self.survey.jacobian[:-1]
        cell = int(np.argmin(np.where(np.isnan(jacobian), -np.inf, jacobian)))
        n_hexahedra = len(rows.hexahedra)
        hexahedron = cell < n_hexahedra
        place = (
            rows.points[np.searchsorted(rows.nodes, rows.hexahedra[cell])].mean(axis=0)
            if hexahedron
            else rows.domain_points[cell - n_hexahedra]
        )
        x, y, z = place * 1e3
        return (
            f"unstable at {self.state.share:.1%} of the load: {'hexahedron' if hexahedron else 'support domain'} "
            f"{rows.cells[cell]} ({rows.materials[rows.material[cell]].name}) at ({x:.1f}, {y:.1f}, {z:.1f}) mm on "
            f"rank {self.world.rank} is turned inside out (J = {jacobian[cell]:.3g}, smallest so far "
            f"{self.state.smallest_jacobian:.3g}); refine the cloud or the mesh there, enlarge cloud.radius, or load "
            "more slowly (solver.load_time)"
        )

    def _interrupt(self, signum: int, frame: object) -> None:
        self.interrupted = 1

    # ------------------------------------------------------------ what is written

    def _metadata(self) -> dict[str, Any]:
        tumour = self.deck.tumour
        return {
            "deck": decks.canonical(self.deck),
            "title": self.deck.title,
            "versions": {name: importlib.metadata.version(name) for name in ("mpitled", "numpy", "numba", "h5py")},
            "ranks": self.world.size,
            "load_time_s": self.deck.solver.load_time,
            "tumour": tumour
            and {
                "centre_m": list(tumour.centre),
                "seed_radius_m": tumour.seed_radius,
                "radius_m": sphere_radius(tumour.volume),
            },
        }

    def _write(self, writer: store.ResultWriter) -> None:
        rows, u = self.sub.rows, self.state.u[:, : self.sub.n_nodes]
        domains = np.searchsorted(rows.nodes, rows.domains)
        at_points = np.einsum("ga,cga->gc", rows.domain_shapes, u[:, domains])
        displacement = np.concatenate([u.T[rows.owned], at_points])
        field = np.concatenate([self._field(u, domains)[rows.owned], at_points])
        series = {name: self.figures[name] for name in _SERIES}
        writer.write_frame(
            self.state.step * self.state.time_step,
            {"displacement": displacement, "field_displacement": field},
            {"J": self.survey.jacobian[:-1]},
            series,
        )

    def _field(self, u: NDArray[np.float64], domains: NDArray[np.int64]) -> NDArray[np.float64]:
        """u_h (n_nodes, 3), m: the parameters of EFG nodes are not the field; one domain's MLS gives it there."""
        rows = self.sub.rows
        field = np.where(rows.owned & (rows.nodes < rows.n_fe_nodes), u, 0.0)
        first_domain = rows.cells[len(rows.hexahedra) :] - rows.n_hexahedra
        giving = domains[np.searchsorted(first_domain, rows.field_domains)]
        field[:, np.searchsorted(rows.nodes, rows.field_nodes)] = np.einsum(
            "ga,cga->cg", rows.field_shapes, u[:, giving]
        )
        if self.halo is not None:
            self.halo.sum(field)
        return field.T

    def _run_figures(self, loop_seconds: float) -> dict[str, Any]:
        """What the report says of the run itself. Collective."""
        state, rows, world = self.state, self.sub.rows, self.world
        halo_seconds = sum(self.halo.seconds.values()) if self.halo else 0.0
        computing = sum(
            self.term_seconds.get(name, 0.0) for name in ("voxel hexahedra", "hexahedra", "support domains")
        )
        table = world.gather(
            [
                len(rows.hexahedra),
                len(rows.domains),
                halo_seconds / max(loop_seconds, 1e-9),
                computing,
                resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
            ]
        )
        hexahedra, domains, halo_share, computed, peak = table.T
        cells = hexahedra.sum() + domains.sum()
        figures = self.figures or dict.fromkeys(_SERIES, float("nan"))
        return {
            "ranks": world.size,
            "steps": state.step,
            "time_step_s": state.time_step,
            "seconds": dict(self.phases.seconds) | {"loop": loop_seconds},
            "term_seconds": self.term_seconds,
            "cells": {"hexahedra": int(hexahedra.sum()), "support_domains": int(domains.sum())},
            "nodes": rows.n_nodes,
            "cell_updates_per_second": cells * state.step / max(loop_seconds, 1e-9),
            "halo_share": float(halo_share.max()),
            "imbalance": float(computed.max() / max(computed.mean(), 1e-9) - 1),
            "peak_memory_bytes": [int(p) for p in peak],
            "min_jacobian": figures["min_jacobian"],
            "added_mass_kg": figures["added_mass"],
            "energy_J": {
                "external": figures["external"],
                "internal": figures["strain"] + figures["hourglass"] + figures["stabilisation"],
                "strain": figures["strain"],
                "hourglass": figures["hourglass"],
                "stabilisation": figures["stabilisation"],
                "kinetic": figures["kinetic"],
                "added_mass": figures["added"],
                "balance_error": figures["balance_error"],
            },
            "kinetic_to_internal": {
                "largest_after_10_percent": self.largest_kinetic_ratio,
                "at_end": figures["kinetic_ratio"],
            },
        }


_SERIES = (
    "external", "strain", "hourglass", "stabilisation", "kinetic", "added", "added_mass", "min_jacobian", "step_ratio",
    "balance_error", "kinetic_ratio",
)  # fmt: skip


class _Progress:
    """How far the run is, on stderr: a bar on a terminal, a line every tenth elsewhere."""

    def __init__(self, n_steps: int) -> None:
        self.n_steps, self.begin, self.tenth, self.bar = n_steps, time.perf_counter(), 0, None
        if sys.stderr.isatty():
            try:
                from tqdm import tqdm
            except ImportError:
                return
            self.bar = tqdm(total=n_steps, unit="step", dynamic_ncols=True)

    def show(self, step: int, figures: dict[str, float]) -> None:
        state = f"kinetic/internal {figures['kinetic_ratio']:.1e}, min J {figures['min_jacobian']:.3f}"
        if self.bar is not None:
            self.bar.update(step - self.bar.n)
            self.bar.set_postfix_str(state)
        elif 10 * step // self.n_steps > self.tenth:
            self.tenth = 10 * step // self.n_steps
            rate = step / (time.perf_counter() - self.begin)
            left = (self.n_steps - step) / rate
            print(f"{step / self.n_steps:4.0%}  {rate:6.0f} steps/s  {left:5.0f} s left  {state}", file=sys.stderr)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()
