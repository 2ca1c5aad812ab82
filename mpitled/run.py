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
from mpitled.march import March
from mpitled.relaxation import Relaxation
from mpitled.step import Term
from mpitled.subdomain import Subdomain, localise

#: Cost in a step of a node of a support domain, in hexahedra, as `pytest -m study tests/test_kernels.py` measures it.
DOMAIN_NODE_COST = 0.3
#: The energy balance may be wrong by this share of the largest energy; beyond it the run is unstable.
BALANCE_LIMIT = 0.05
#: So many steps from rest the ledger is too coarse to judge by: its trapezoidal rule is wrong by about 8 over the steps
#: squared of what little energy there is.
LEDGER_STARTS = 50

MODEL = "model.h5"

#: What ends a run in order. mpirun kills its ranks itself when it gets one of the first two; the third it passes on.
INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)


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
    included: list[Path] = []
    if deck.mesh:
        from mpitled import meshes

        included = meshes.files(deck.mesh)
    key = decks.model_key(deck, included)
    if store.model_key(path) == key:
        return path, False
    directory.mkdir(parents=True, exist_ok=True)
    from mpitled import preprocess  # only the rank that builds needs the meshers

    store.write_model(path, preprocess.build(deck), key, decks.canonical(deck))
    return path, True


def divide(path: Path, n_parts: int, seed: int) -> str:
    """Partition a model in n_parts, stored in its file under that number; a table of the parts."""
    hexahedra, domains, places = store.read_cells(path)
    costs = (1.0, DOMAIN_NODE_COST * domains.shape[1])
    graph = partition.cell_graph(hexahedra, domains, places)
    try:
        part = partition.cut(graph, n_parts, costs, seed)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    tables = partition.tables(hexahedra, domains, part, n_parts)
    store.write_partition(path, tables)
    return partition.figures(tables, costs, len(hexahedra), graph).describe()


def run(deck: Deck, directory: Path, world: World, *, quiet: bool = False) -> dict[str, Any]:
    """Compute a deck on all ranks; writes model.h5, result.vtkhdf, report.json and pictures into the directory.

    The report, on every rank. InputError, UnstableError or InterruptedRun alike on all ranks.
    """
    return prepare(deck, directory, world, quiet=quiet).run()


def prepare(deck: Deck, directory: Path, world: World, *, quiet: bool = False) -> _Run:
    """All that is done before the first step of `run`: model, partition, this rank's part, and the composed step."""
    phases = Phases()
    with phases("model"):
        path = _on_leader(world, lambda: build(deck, directory)[0])
    if world.leads and not quiet:
        for remark in store.read_remarks(path):
            print(f"note: {remark}", file=sys.stderr, flush=True)
    with phases("partition"):
        if world.size > 1:
            _on_leader(world, lambda: _ensure_partition(path, world.size, deck.partition.seed))
    with phases("read"):
        rows = store.read_part(path, world.size, world.rank)
        rule = deck.hexahedra.gradient
        sub = localise(rows, deck.hexahedra.hourglass, deck.support.stabilisation, rule)
        figures = store.read_figures(path)
    with everywhere():  # each rank finds the same
        return _Run(deck, directory, world, sub, figures, phases, quiet)


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


#: What is not summed over the ranks.
_EXTREMES = {"min_jacobian": min, "step_ratio": max, "change": max, "residual": max}


class _Run:
    """The time loop of one rank and what is watched, written and counted around it."""

    def __init__(
        self,
        deck: Deck,
        directory: Path,
        world: World,
        sub: Subdomain,
        model: dict[str, float],
        phases: Phases,
        quiet: bool,
    ) -> None:
        self.deck, self.directory, self.world, self.sub, self.phases = deck, directory, world, sub, phases
        self.force_halo = self._halo(3)
        solver, frames = deck.solver, deck.output.frames
        self.method: March | Relaxation
        if solver.method == "dynamic-relaxation":
            self.method = self._relaxation()
        else:
            self.method = March(solver, frames, sub, self.force_halo, self._halo(1), model)
        self.progress = None if quiet or not world.leads else _Progress()
        self.interrupted = 0
        self.term_seconds: dict[str, float] = {}
        self.largest_kinetic_ratio = 0.0
        self.largest_energy = 0.0
        self.own_energy = 0.0  # J, in this rank's cells
        self.distance = math.nan
        # The strain energy of the undeformed body is no better than this, J: tr C - 3 and ln J are not quite 0.
        self.noise = 8 * np.finfo(float).eps * max(m.mu for m in sub.rows.materials) * model["volume_m3"]
        self.figures: dict[str, float] = {}

    def _halo(self, components: int) -> Halo | None:
        return Halo(self.world, self.sub.shared, components) if self.world.size > 1 else None

    def _relaxation(self) -> Relaxation:
        return Relaxation(self.deck.solver, self.deck.output.frames, self.sub, self.force_halo, self._halo(6))

    # ------------------------------------------------------------ the loop

    def run(self) -> dict[str, Any]:
        with self.phases("compile"):
            self.warm_up()
        previous = {s: signal.signal(s, self._interrupt) for s in INTERRUPTS}
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
            self._advance(writer)
            self.phases.seconds["loop"] = time.perf_counter() - begin - self.phases.seconds.get("output", 0.0)
            made = self._run_figures(self.phases.seconds["loop"])
            if isinstance(self.method, Relaxation):
                self.distance = self.method.distance
            elif self.deck.solver.method == "quasi-static":
                with self.phases("static distance"):
                    self.distance = self._distance_to_static()
        except MpitledError:
            writer.abandon(self._run_figures(time.perf_counter() - begin))
            raise
        finally:
            for which, handler in previous.items():
                signal.signal(which, handler)
            if self.progress:
                self.progress.close()
        if math.isfinite(self.distance):
            made["static_distance_mm"] = 1e3 * self.distance
        writer.close(made | {"seconds": dict(self.phases.seconds)})
        with self.phases("report"):
            from mpitled import report

            return _on_leader(self.world, lambda: report.write(self.directory, self.phases.seconds))

    def _advance(self, writer: store.ResultWriter | None) -> None:
        """Steps, a survey and decisions, and so on to the end of the method."""
        method, clock = self.method, time.perf_counter
        state, forces, motion = method.state, method.forces, method.motion
        reactions, update = motion[:-1], motion[-1:]
        seconds = self.term_seconds = dict.fromkeys((name for name, _ in (*forces, *motion)), 0.0)

        def take(terms: tuple[Term, ...]) -> None:
            for name, term in terms:
                begin = clock()
                term(state)
                seconds[name] += clock() - begin

        step, last = (*update, *forces, *reactions), False
        take((*forces, *reactions))
        while True:
            with everywhere():
                self._watch()
            due, last = method.decide(self.figures)
            if due and writer is not None:
                with self.phases("output"):
                    self._write(writer)
            if last:
                return
            for _ in range(method.between):
                take(step)

    def _distance_to_static(self) -> float:
        """How far (m, the largest of all nodes) a ramp's end is from the static solution: found by going there."""
        figures, seconds, end = self.figures, self.term_seconds, self.method.state
        self.method = relaxation = self._relaxation()
        relaxation.start_from(end, self.own_energy)
        moved = math.nan
        try:
            self._advance(None)
            n = self.sub.n_nodes
            own = np.abs(relaxation.state.u[:, :n] - end.u[:, :n]).max()
            moved = float(self.world.gather([own]).max()) + relaxation.distance
        except UnstableError:
            pass  # the run itself is well; only the estimate is not to be had
        self.figures, self.term_seconds = figures, seconds
        return moved

    def warm_up(self) -> None:
        """Compile, or load from the disk's cache: rank 0 first, so that the others find its work there."""
        if not self.world.leads:
            self.world.barrier()
        self.method.warm_up()
        if self.world.leads:
            self.world.barrier()

    # ------------------------------------------------------------ what is watched

    def _watch(self) -> None:
        """Survey all ranks, keep the ledger, and end the run on all of them alike if it cannot go on."""
        state, world = self.method.state, self.world
        own = self.method.look()
        self.own_energy = own["strain"] + own["hourglass"] + own["stabilisation"]
        table = world.gather([*own.values(), float(self.interrupted)])
        columns = dict(zip(own, table.T, strict=False))
        figures = {name: float(_EXTREMES.get(name, sum)(columns[name])) for name in own}
        internal = figures["strain"] + figures["hourglass"] + figures["stabilisation"]
        supplied = figures["external"] + figures["added"] - figures["dissipated"]
        self.largest_energy = max(self.largest_energy, abs(figures["external"]), internal, figures["kinetic"])
        figures["balance_error"] = abs(supplied - internal - figures["kinetic"]) / (self.largest_energy or 1.0)
        figures["kinetic_ratio"] = figures["kinetic"] / internal if internal > 0 else 0.0
        if state.share >= 0.1:
            self.largest_kinetic_ratio = max(self.largest_kinetic_ratio, figures["kinetic_ratio"])
        self.figures = figures
        if self.progress:
            self.progress.show(self.method.progress, state.step, figures)
        finite = math.isfinite(internal + figures["kinetic"] + figures["external"])
        balance = figures["balance_error"] * self.largest_energy
        if not finite or figures["min_jacobian"] <= 0:
            reason = "a cell is turned inside out"
        elif balance > BALANCE_LIMIT * self.largest_energy + self.noise and state.step >= LEDGER_STARTS:
            reason = (
                f"the energy balance is wrong by {figures['balance_error']:.1%} (supplied {supplied:.3g} J, internal "
                f"{internal:.3g} J, kinetic {figures['kinetic']:.3g} J)"
            )
        else:
            reason = ""
        if reason:
            worst = int(np.argmin(np.where(np.isnan(columns["min_jacobian"]), -np.inf, columns["min_jacobian"])))
            cell = world.broadcast(self._worst_cell() if world.rank == worst else None, worst)
            raise UnstableError(
                f"unstable at {state.share:.1%} of the load: {reason}; {cell}; the step is "
                f"{figures['step_ratio']:.2f} of the longest proved stable; load more slowly (solver.load_time, "
                "solver.load_steps), refine the mesh or the cloud there, or enlarge cloud.radius"
            )
        if table[:, -1].any():
            raise InterruptedRun(f"interrupted at {state.share:.1%} of the load; what was written is readable")

    def _worst_cell(self) -> str:
        """What and where the cell with the smallest J on this rank is, in a few words."""
        rows, jacobian = self.sub.rows, self.method.survey.jacobian[:-1]
        cell = int(np.argmin(np.where(np.isnan(jacobian), -np.inf, jacobian)))
        n_hexahedra = len(rows.hexahedra)
        hexahedron = cell < n_hexahedra
        nodes = rows.hexahedra[cell] if hexahedron else rows.domains[cell - n_hexahedra]
        local = np.searchsorted(rows.nodes, nodes)
        x, y, z = 1e3 * (rows.points[local].mean(axis=0) if hexahedron else rows.domain_points[cell - n_hexahedra])
        edges = rows.points[local] - rows.points[local].mean(axis=0)
        stretched = edges + self.method.state.u[:, local].T - self.method.state.u[:, local].T.mean(axis=0)
        stretch = np.linalg.norm(stretched, axis=1).max() / np.linalg.norm(edges, axis=1).max()
        return (
            f"worst is {'hexahedron' if hexahedron else 'support domain'} {rows.cells[cell]} "
            f"({rows.materials[rows.material[cell]].name}) at ({x:.1f}, {y:.1f}, {z:.1f}) mm on rank {self.world.rank} "
            f"with J = {jacobian[cell]:.3g} now, {self.method.state.smallest_jacobian:.3g} at its worst, and a stretch "
            f"of {stretch:.3g}"
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
        rows, u = self.sub.rows, self.method.state.u[:, : self.sub.n_nodes]
        domains = np.searchsorted(rows.nodes, rows.domains)
        at_points = np.einsum("ga,cga->gc", rows.domain_shapes, u[:, domains])
        displacement = np.concatenate([u.T[rows.owned], at_points])
        field = np.concatenate([self._field(u, domains)[rows.owned], at_points])
        series = {name: self.figures[name] for name in _SERIES}
        writer.write_frame(
            self.method.frame_time,
            {"displacement": displacement, "field_displacement": field},
            {"J": self.method.survey.jacobian[:-1]},
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
        if self.force_halo is not None:
            self.force_halo.sum(field)
        return field.T

    def _run_figures(self, loop_seconds: float) -> dict[str, Any]:
        """What the report says of the run itself. Collective."""
        state, rows, world = self.method.state, self.sub.rows, self.world
        halo_seconds = sum(self.force_halo.seconds.values()) if self.force_halo else 0.0
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
                "dissipated": figures["dissipated"],
                "balance_error": figures["balance_error"],
            },
            "kinetic_to_internal": {
                "largest_after_10_percent": self.largest_kinetic_ratio,
                "at_end": figures["kinetic_ratio"],
            },
        }


_SERIES = (
    "external", "strain", "hourglass", "stabilisation", "kinetic", "added", "added_mass", "dissipated", "min_jacobian",
    "step_ratio", "balance_error", "kinetic_ratio",
)  # fmt: skip


class _Progress:
    """How far the run is, on stderr: a bar on a terminal, a line every tenth elsewhere."""

    def __init__(self) -> None:
        self.begin, self.tenth, self.bar = time.perf_counter(), 0, None
        if sys.stderr.isatty():
            try:
                from tqdm import tqdm
            except ImportError:
                return
            self.bar = tqdm(total=1.0, bar_format="{percentage:3.0f}%|{bar}| {remaining} left{postfix}")

    def show(self, done: float, step: int, figures: dict[str, float]) -> None:
        rate = step / max(time.perf_counter() - self.begin, 1e-9)
        state = (
            f"{rate:.0f} steps/s, kinetic/internal {figures['kinetic_ratio']:.1e}, min J {figures['min_jacobian']:.3f}"
        )
        if self.bar is not None:
            self.bar.set_postfix_str(state, refresh=False)
            self.bar.update(max(0.0, done - self.bar.n))
        elif int(10 * done) > self.tenth:
            self.tenth = int(10 * done)
            left = (1 - done) / done * (time.perf_counter() - self.begin)
            print(f"{done:4.0%}  {left:5.0f} s left  {state}", file=sys.stderr, flush=True)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()
