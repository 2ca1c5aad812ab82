"""From a deck to a result: model and partition by one rank, then the time loop on all, watched every few steps."""

from __future__ import annotations

import importlib.metadata
import logging
import math
import resource
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import partition
from mpitled import deck as decks
from mpitled import store
from mpitled.deck import Deck
from mpitled.errors import InputError, InterruptedRun, MpitledError, UnstableError
from mpitled.loading import sphere_radius
from mpitled.solver.halo import Halo, World
from mpitled.solver.march import March
from mpitled.solver.relaxation import Relaxation
from mpitled.solver.step import Term
from mpitled.solver.subdomain import Subdomain, cell_costs, localise
from mpitled.solver.watch import Watch

#: Looks from one state that recovery can go back to until the next, and how often a run may go back.
SAVED, RECOVERIES = 5, 5
#: What `solver.precision` means for the cells' arithmetic.
PRECISIONS: dict[str, type[np.floating]] = {"double": np.float64, "single": np.float32}

MODEL = "model.h5"

#: What ends a run in order. mpirun kills its ranks itself when it gets one of the first two; the third it passes on.
INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)


_log = logging.getLogger(__name__)


class Phases:
    """Wall time of each phase of a run, s."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        if name not in self.seconds:
            _log.info("%s", name)
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin


def build(deck: Deck, directory: Path) -> tuple[Path, bool]:
    """The model of a deck in directory/model.h5, and whether it had to be built: the same deck uses it again."""
    path = directory / MODEL
    key = decks.model_key(deck, included(deck))
    if store.model_key(path) == key:
        return path, False
    directory.mkdir(parents=True, exist_ok=True)
    from mpitled import preprocess  # only the rank that builds needs the meshers

    store.write_model(path, preprocess.build(deck), key, decks.canonical(deck))
    return path, True


def included(deck: Deck) -> list[Path]:
    """Files that those of the deck read in turn."""
    if not deck.mesh:
        return []
    from mpitled.readers import meshes

    return meshes.files(deck.mesh)


def divide(path: Path, n_parts: int, seed: int) -> str:
    """Partition a model in n_parts, stored in its file under that number; a table of the parts."""
    hexahedra, domains, places = store.read_cells(path)
    costs = cell_costs(store.read_points(path), hexahedra, domains)
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
        path = on_leader(world, lambda: build(deck, directory)[0])
    if world.leads and not quiet:
        for remark in store.read_remarks(path):
            print(f"note: {remark}", file=sys.stderr, flush=True)
    with phases("partition"):
        if world.size > 1:
            on_leader(world, lambda: ensure_partition(path, world.size, deck.partition.seed))
    with phases("read"):
        rows = store.read_part(path, world.size, world.rank)
        rule = deck.hexahedra.gradient
        sub = localise(
            rows, deck.hexahedra.hourglass, deck.support.stabilisation, rule, PRECISIONS[deck.solver.precision]
        )
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


def ensure_partition(path: Path, n_parts: int, seed: int) -> None:
    """Partition a model unless it is partitioned in as many parts."""
    if not store.has_partition(path, n_parts):
        divide(path, n_parts, seed)


def on_leader(world: World, work: Callable[[], Any]) -> Any:
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
        self.force_halo = self._halo(3, sub.precision)
        solver, frames = deck.solver, deck.output.frames
        self.method: March | Relaxation
        if solver.method == "dynamic-relaxation":
            self.method = self._relaxation()
        else:
            self.method = March(solver, frames, sub, world, self.force_halo, self._halo(1), model)
        self.progress = None if quiet or not world.leads else _Progress()
        self.interrupted = False
        self.term_seconds: dict[str, float] = {}
        self.distance = math.nan
        self.volume = model["volume_m3"]
        self.watch = Watch(world, sub, self.volume)
        self.recoveries = 0
        self.written = -math.inf  # time of the last frame
        # The displacements that were good at the last look, their frame's time, and what was seen of them.
        self.good, self.good_time, self.good_figures = np.zeros((3, sub.n_nodes)), 0.0, self.watch.figures

    def _halo(self, components: int, precision: type[np.floating] = np.float64) -> Halo | None:
        return Halo(self.world, self.sub.shared, components, precision) if self.world.size > 1 else None

    def _relaxation(self) -> Relaxation:
        deck, halo = self.deck, self._halo(6)
        return Relaxation(deck.solver, deck.output.frames, self.sub, self.world, self.force_halo, halo)

    # ------------------------------------------------------------ the loop

    def run(self) -> dict[str, Any]:
        with self.phases("compile"):
            self.warm_up()
        with self.phases("begin"), everywhere():
            self.method.begin()
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
        _log.info("loop")
        try:
            self._advance(writer)
            self.phases.seconds["loop"] = time.perf_counter() - begin - self.phases.seconds.get("output", 0.0)
            made = self._run_figures(self.phases.seconds["loop"])
            if isinstance(self.method, Relaxation):
                self.distance = self.method.best if self.method.stalled else self.method.distance
                with everywhere():
                    self._end_if_stalled(self.method)
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
            from mpitled.results import report

            return on_leader(self.world, lambda: report.write(self.directory, self.phases.seconds))

    def _advance(self, writer: store.ResultWriter | None) -> None:
        """Steps, a survey and decisions, and so on to the end of the method."""
        method, clock = self.method, time.perf_counter
        forces, motion = method.forces, method.motion
        reactions, update = motion[:-1], motion[-1:]
        seconds = self.term_seconds = dict.fromkeys((name for name, _ in (*forces, *motion)), 0.0)

        def take(terms: tuple[Term, ...]) -> None:
            state = method.state
            for name, term in terms:
                begin = clock()
                term(state)
                seconds[name] += clock() - begin

        step, last = (*update, *forces, *reactions), False
        saved: deque[dict[str, Any]] = deque(
            maxlen=2
        )  # to go back to the older of them; the younger may be ill already
        take((*forces, *reactions))
        for look in count():
            try:
                with everywhere():
                    self._look()
            except UnstableError:
                if not saved or self.recoveries == RECOVERIES:
                    self._write_last_good(writer)
                    raise
                self.recoveries += 1
                for name, value in deepcopy(saved[0]).items():
                    setattr(method, name, value)
                method.harden()
                continue
            due, last = method.decide(self.watch.figures)
            if due and writer is not None:
                with self.phases("output"):
                    self._write(writer, method.frame_time)
            if last:
                return
            if method.recovers and (due or look % SAVED == 0):
                if due:
                    saved.clear()  # what is written stays
                saved.append({name: deepcopy(getattr(method, name)) for name in method.REMEMBERED})
            for _ in range(method.between):
                take(step)

    def _look(self) -> None:
        method = self.method
        self.watch.look(method, self.interrupted)
        if self.progress:
            self.progress.show(method.progress, method.state.step, self.watch.figures)
        if self.watch.interrupted:
            share = method.state.share
            raise InterruptedRun(f"interrupted at {share:.1%} of the load; what was written is readable")
        self.good[:] = method.state.u[:, : self.sub.n_nodes]
        self.good_time, self.good_figures = method.frame_time, self.watch.figures

    def _write_last_good(self, writer: store.ResultWriter | None) -> None:
        """As one more frame of a run that cannot go on, unless it is there already."""
        if writer is None or self.good_time <= self.written:
            return
        self.method.state.place(self.good)
        self.method.survey.look(self.method.state, self.method.safety)
        self.watch.figures = self.good_figures
        self._write(writer, self.good_time)

    def _end_if_stalled(self, relaxation: Relaxation) -> None:
        if relaxation.stalled:
            raise UnstableError(
                f"the relaxation comes no nearer to the static solution than {1e3 * relaxation.best:.2g} mm, by its "
                f"own estimate; give solver.tolerance = {1.5e3 * relaxation.best:.2g} or more"
                + (", or solver.precision = double" if self.deck.solver.precision == "single" else "")
            )

    def _distance_to_static(self) -> float:
        """How far (m, the largest of all nodes) a ramp's end is from the static solution: found by going there."""
        ramp, watch, seconds = self.method, self.watch, self.term_seconds
        self.method = relaxation = self._relaxation()
        self.watch = Watch(self.world, self.sub, self.volume)
        relaxation.start_from(ramp.state, watch.own_energy)
        relaxation.begin()
        moved = math.nan
        try:
            self._advance(None)
            n = self.sub.n_nodes
            own = np.abs(relaxation.state.u[:, :n] - ramp.state.u[:, :n]).max()
            moved = float(self.world.gather([own]).max()) + min(relaxation.distance, relaxation.best)
        except UnstableError:
            pass  # the run itself is well; only the estimate is not to be had
        self.method, self.watch, self.term_seconds = ramp, watch, seconds
        return moved

    def warm_up(self) -> None:
        """Compile, or load from the disk's cache: rank 0 first, so that the others find its work there."""
        if not self.world.leads:
            self.world.barrier()
        self.method.warm_up()
        if self.world.leads:
            self.world.barrier()

    # ------------------------------------------------------------ what is watched

    def _interrupt(self, signum: int, frame: object) -> None:
        self.interrupted = True

    # ------------------------------------------------------------ what is written

    def _metadata(self) -> dict[str, Any]:
        tumour = self.deck.tumour
        return {
            "deck": decks.canonical(self.deck),
            "title": self.deck.title,
            "versions": {name: importlib.metadata.version(name) for name in ("mpitled", "numpy", "numba", "h5py")},
            "ranks": self.world.size,
            # A relaxation's frames are at shares of the load.
            "load_time_s": 1.0 if isinstance(self.method, Relaxation) else self.deck.solver.load_time,
            "tumour": tumour
            and {
                "centre_m": list(tumour.centre),
                "seed_radius_m": tumour.seed_radius,
                "radius_m": sphere_radius(tumour.volume),
            },
        }

    def _write(self, writer: store.ResultWriter, frame_time: float) -> None:
        rows, u = self.sub.rows, self.method.state.u[:, : self.sub.n_nodes]
        domains = np.searchsorted(rows.nodes, rows.domains)
        at_points = np.einsum("ga,cga->gc", rows.domain_shapes, u[:, domains])
        displacement = np.concatenate([u.T[rows.owned], at_points])
        field = np.concatenate([self._field(u, domains)[rows.owned], at_points])
        series = {name: self.watch.figures[name] for name in _SERIES}
        self.written = frame_time
        writer.write_frame(
            frame_time,
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
        figures = self.watch.figures or dict.fromkeys(_SERIES, float("nan"))
        return {
            "ranks": world.size,
            "steps": state.step,
            "time_step_s": state.time_step,
            "recoveries": self.recoveries,
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
                "largest_after_10_percent": self.watch.largest_kinetic_ratio,
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
