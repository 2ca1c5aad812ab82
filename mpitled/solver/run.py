"""The run of one rank: the time loop, and the order of checks, rollback, output and checkpoints around it."""

from __future__ import annotations

import importlib.metadata
import logging
import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import deck as decks
from mpitled import resources, store
from mpitled.deck import Deck
from mpitled.errors import InputError, InterruptedRun, MpitledError, UnstableError, everywhere
from mpitled.model import ModelFigures
from mpitled.model.loading import sphere_radius
from mpitled.parallel.halo import Halo, World
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver import checkpoint
from mpitled.solver.dynamic_relaxation import DynamicRelaxation
from mpitled.solver.figures import run_figures
from mpitled.solver.integrator import Integrator
from mpitled.solver.integrators import make_integrator
from mpitled.solver.monitor import Monitor
from mpitled.solver.output import Output, cell_data
from mpitled.solver.progress import Interrupts, Phases, Progress
from mpitled.solver.rollback import MAX_ROLLBACKS, Rollback
from mpitled.terms import Scene, Term
from mpitled.terms.restart import Objects, Scope, nodal, replicated, restore, snapshot
from mpitled.terms.term import Method

#: A relaxation that stalls farther from the static solution than this share of the largest displacement has not found
#: it.
NO_SOLUTION = 0.02
#: Requests to a run at a check: a checkpoint, or a checkpoint and the end.
CHECKPOINT, END = 1, 2

_log = logging.getLogger(__name__)


@dataclass(init=False, eq=False, repr=False)
class Run:
    """The run of one rank.

    A quasi-static run continues, after its load, with a relaxation, to find its distance from the static solution.
    """

    figures_at_full_load: dict[str, Any] | None = replicated(control=True, default=None)
    u_full_load: NDArray[np.float64] | None = nodal(control=True, default=None)  # (3, n_nodes), m

    def __init__(
        self,
        deck: Deck,
        directory: Path,
        world: World,
        sub: Subdomain,
        model: ModelFigures,
        phases: Phases,
        quiet: bool,
        about: dict[str, Any],
        found: checkpoint.Found | None,
    ) -> None:
        """model: figures of the model; about: the identity of the run; found: the checkpoint to resume. Collective."""
        self.deck, self.directory, self.world, self.sub, self.model = deck, directory, world, sub, model
        self.phases, self.about, self.found = phases, about, found
        self.talks = world.leads and not quiet
        self.halos: list[Halo] = []
        self.force_halo = self._halo(3, sub.precision)
        anywhere = lambda fact: bool(world.gather([fact]).any())  # noqa: E731
        self._use(Scene(sub, deck.solver, self.force_halo, deck, anywhere))
        self.rollback = Rollback()
        self.output = Output(deck, sub, self.force_halo, self.monitor.ledger.series)
        self.progress: Progress | None = None
        self.interrupts = Interrupts(world)
        self.term_seconds: dict[str, float] = {}
        self.first_step, self.next_checkpoint = 0, math.inf

    def _halo(self, components: int, precision: type[np.floating]) -> Halo | None:
        if self.world.size == 1:
            return None
        self.halos.append(Halo(self.world, self.sub.shared, components, precision))
        return self.halos[-1]

    def _use(self, scene: Scene) -> None:
        """Make the integrator of a scene and its monitor."""
        self.integrator: Integrator = make_integrator(
            scene, self.deck.output.frames, self.world, self.model, self._halo
        )
        name = self.deck.path.name
        self.monitor = Monitor(self.world, self.integrator, self.model.volume_m3, name, _remedy(self.deck))

    def _use_relaxation(self) -> None:
        """Go on with a relaxation, whatever the method of the deck."""
        scene = self.integrator.scene
        self._use(replace(scene, solver=scene.solver.model_copy(update={"method": Method.RELAXATION.value})))

    def free(self) -> None:
        """Free the memory that ranks share, at the end of the run. Collective."""
        for halo in self.halos:
            halo.free()

    @property
    def output_bytes(self) -> int:
        """Size of the result."""
        return store.result_bytes(self.sub.rows, self.deck.output.frames + 1, cell_data(self.deck))

    @property
    def left_out(self) -> list[str]:
        """What the scene does without on this rank, each with the reason."""
        lines, materials = self.integrator.step.left_out(), self.sub.rows.materials
        if self.deck.tumour is None:
            lines.append("tumour: no [tumour]")
        if len(materials) == 1:
            lines.append(f"other materials: {materials[0].name} alone")
        return lines

    # ------------------------------------------------------------ from beginning to end

    def run(self, interrupts: Interrupts) -> dict[str, float]:
        """Compute the complete result; the seconds of each phase on this rank. Collective."""
        self.interrupts = interrupts
        self.world.on_leader(self._check_disc)
        with self.phases("compile"):
            self.warm_up()
        with self.phases("begin"), everywhere():
            self._begin()
        self.output.open(self.directory, self.world.comm, self._metadata())
        if self.force_halo is not None:  # the time before the loop does not count
            self.force_halo.seconds = dict.fromkeys(self.force_halo.seconds, 0.0)
        self._schedule_checkpoint()
        _log.info("loop")
        interrupts.at_checks = True
        with self._abandoned_on_error():
            if self.figures_at_full_load is None:
                self._advance_to_full_load()
            distance = self._static_distance()
        assert self.figures_at_full_load is not None
        figures = dict(self.figures_at_full_load)
        if math.isfinite(distance):
            figures["static_distance_mm"] = 1e3 * distance
        figures["seconds"] |= self.phases.seconds
        with self.phases("close"):
            self.output.writer.close(figures)
        return dict(figures["seconds"])

    def warm_up(self) -> None:
        """Compile the kernels, or load them from the cache on disk: rank 0 first, so that the others find its work."""
        if not self.world.leads:
            self.world.barrier()
        self.integrator.warm_up()
        if self.world.leads:
            self.world.barrier()

    def _check_disc(self) -> None:
        needed = self.output_bytes - store.unfinished_bytes(self.directory)
        frames = f"the result of {self.deck.output.frames + 1} frames"
        resources.check_disc(needed, self.directory, frames, "lower output.frames, or give another folder")

    def _begin(self) -> None:
        if self.found:
            self._resume(self.found)
            return
        try:
            self.integrator.begin()
        except InputError as error:  # of a key
            raise InputError(f"{self.deck.path}: {error}") from None
        if self.world.on_leader(lambda: store.discard_checkpoints(self.directory)):
            self._tell("a checkpoint that is damaged is discarded")
        if store.is_finished(self.directory):
            self._tell(
                "the result of an earlier run is there; this run replaces it and its page when it is complete, and "
                "leaves exported files as they are"
            )

    @contextmanager
    def _abandoned_on_error(self) -> Iterator[None]:
        """Close the unfinished result with the reason if all ranks meet an error."""
        begin = time.perf_counter()
        try:
            yield
        except MpitledError as error:
            if error.everywhere:  # else the other ranks do not know of it
                figures = self.figures_at_full_load or self._figures(time.perf_counter() - begin)
                self.output.writer.abandon(figures | {"stopped": str(error)})
            raise
        finally:
            self.interrupts.at_checks = False
            self.interrupts.when = "after the last step; 'mpitled report' makes what is missing"
            if self.progress:
                self.progress.close()

    def _advance_to_full_load(self) -> None:
        if self.talks:
            self.progress = Progress(self.integrator.progress, self.integrator.state.step)
        begin = time.perf_counter()
        self._advance()
        other = sum(self.phases.seconds.get(name, 0.0) for name in ("output", "checkpoints"))
        self.phases.seconds["loop"] = time.perf_counter() - begin - other
        self.figures_at_full_load = self._figures(self.phases.seconds["loop"])

    def _static_distance(self) -> float:
        """Distance (m, the largest of all nodes) of the result to the static solution; nan if it is unknown."""
        if Method(self.deck.solver.method) is Method.DYNAMIC:
            return math.nan
        if Method(self.deck.solver.method) is Method.QUASI_STATIC:
            with self.phases("static distance"):
                return self._distance_by_relaxation()
        if not self._relaxation.stalled:
            return self._relaxation.distance
        with everywhere():
            raise self._stalled(self._relaxation)

    def _distance_by_relaxation(self) -> float:
        n = self.sub.n_nodes
        if self.u_full_load is None:
            ramp, energy = self.integrator.state, self.monitor.own_energy
            self.u_full_load = ramp.u[:, :n].copy()
            self._use_relaxation()
            self._relaxation.start_from(ramp, energy)
            self.integrator.begin()
        try:
            self._advance()
        except UnstableError:
            return math.nan  # keep the result; report the distance as unknown
        own = np.abs(self.integrator.state.u[:, :n] - self.u_full_load).max()
        return float(self.world.gather([own]).max()) + min(self._relaxation.distance, self._relaxation.best)

    @property
    def _relaxation(self) -> DynamicRelaxation:
        assert isinstance(self.integrator, DynamicRelaxation)
        return self.integrator

    def _stalled(self, relaxation: DynamicRelaxation) -> UnstableError:
        """The error of a relaxation that has stalled. Collective."""
        largest = np.abs(relaxation.state.u[:, : self.sub.n_nodes]).max()
        largest = float(self.world.gather([largest]).max())
        remedy = f"give solver.tolerance = {3e3 * relaxation.best:.2g} or more"
        if self.sub.precision == np.float32:
            remedy += ", or solver.precision = double"
        if relaxation.best > NO_SOLUTION * largest:
            remedy = f"that is {relaxation.best / largest:.0%} of the largest displacement; {self.monitor.remedy}"
        return UnstableError(
            f"the relaxation comes no nearer to the static solution than {1e3 * relaxation.best:.2g} mm, by its own "
            f"estimate; {remedy}"
        )

    # ------------------------------------------------------------ the loop

    def _advance(self) -> None:
        """Steps and checks to the end of the integrator."""
        step = self.integrator.step
        self.term_seconds = dict.fromkeys((term.name for term in step.terms), 0.0)
        if self.found:
            self._apply(step.forces)
            self.found, ahead = None, True  # a checkpoint is written after its check
        else:
            self.rollback.clear()
            self._apply((*step.forces, *step.work))
            ahead = self._check_and_output()
        while ahead:
            for _ in range(self.integrator.between):
                self._apply(step.cycle)
            ahead = self._check_and_output()

    def _apply(self, terms: tuple[Term, ...]) -> None:
        state, seconds, clock = self.integrator.state, self.term_seconds, time.perf_counter
        for term in terms:
            begin = clock()
            term.apply(state)
            seconds[term.name] += clock() - begin

    def _check_and_output(self) -> bool:
        """Check the state, set the next steps, and write what is due; whether there are steps ahead. Collective."""
        integrator, monitor = self.integrator, self.monitor
        while True:
            try:
                with everywhere():
                    self._check()
                break
            except UnstableError:
                if not self._roll_back():
                    raise
        if integrator.state.step >= integrator.spectral_radius.next_step:
            self.output.free_stable()
        due, last = integrator.decide(monitor.figures)
        self.output.keep_stable(integrator, monitor.figures)
        if due and self.u_full_load is None:
            with self.phases("output"):
                self.output.write(integrator, monitor.figures, integrator.frame_time)
        if last:
            return False
        self.rollback.save(integrator, self._objects, monitor.figures["balance_error"])
        if monitor.request:
            with self.phases("checkpoints"):
                self._save_checkpoint()
        if monitor.request == END:
            with everywhere():
                where = f"at {integrator.progress:.1%} of the run"
                if self.u_full_load is not None:
                    where = "after the load, on the way to its distance from the static solution"
                raise InterruptedRun(f"interrupted {where}; the same command with --resume goes on")
        return True

    def _check(self) -> None:
        due = CHECKPOINT if time.perf_counter() >= self.next_checkpoint else 0
        self.monitor.update(END if self.interrupts.asked else due)
        if self.progress and self.u_full_load is None:
            self.progress.show(self.integrator.progress, self.integrator.state.step, self.monitor.figures)

    def _roll_back(self) -> bool:
        """Return to an earlier state; whether that was possible. If not, the last stable state is written."""
        if not self.rollback.possible:
            if self.u_full_load is None and self.output.write_last_stable(self.integrator):
                self.monitor.figures = self.output.stable_figures
            return False
        how = self.rollback.go_back(self.integrator, self._objects, may_restart=self.u_full_load is None)
        times = f"{self.rollback.n_rollbacks} of {MAX_ROLLBACKS} times"
        self._tell(f"the run was about to become unstable: {how} ({times})")
        self.output.writer.rewind(self.output.n_frames)
        self._apply(self.integrator.step.forces)
        return True

    def _tell(self, text: str) -> None:
        if self.talks:
            print(f"note: {text}", file=sys.stderr, flush=True)

    # ------------------------------------------------------------ checkpoints and figures

    @property
    def _objects(self) -> Objects:
        """All objects with restart fields."""
        return {
            "run": self,
            "rollback": self.rollback,
            "monitor": self.monitor,
            "output": self.output,
            **self.integrator.restart_objects,
        }

    def _save_checkpoint(self) -> None:
        """Collective."""
        self.output.writer.sync()  # the frames that the checkpoint counts on
        integrator, rollback, objects = self.integrator, self.rollback, self._objects
        about = self.about | {"step": integrator.state.step, "share": integrator.progress}
        about |= {"frames": self.output.n_frames, "seeks_distance": self.u_full_load is not None}
        snapshots = {"present": (Scope.CHECKPOINT, snapshot(objects, Scope.CHECKPOINT))}
        snapshots |= {"start": (Scope.NUMBERS, rollback.start)} if rollback.start else {}
        snapshots |= {f"saved{i}": (integrator.rollback_scope, s) for i, s in enumerate(rollback.snapshots)}
        checkpoint.save(self.directory, self.world, self.sub, about, objects, snapshots)
        self._schedule_checkpoint()

    def _schedule_checkpoint(self) -> None:
        minutes = self.deck.output.checkpoint_minutes
        self.next_checkpoint = time.perf_counter() + 60 * minutes if minutes else math.inf

    def _resume(self, found: checkpoint.Found) -> None:
        if found.contents["seeks_distance"]:
            self._use_relaxation()
        read, objects, rollback = checkpoint.load(found, self.sub), self._objects, self.rollback
        rollback.start = read("start", objects, Scope.NUMBERS) or {}
        scope = self.integrator.rollback_scope
        while (saved := read(f"saved{len(rollback.snapshots)}", objects, scope)) is not None:
            rollback.snapshots.append(saved)
        restore(objects, Scope.CHECKPOINT, read("present", objects, Scope.CHECKPOINT) or {})
        state = self.integrator.state
        state.sync_cell_copy()
        self.output.u_last_stable = state.u[:, : self.sub.n_nodes].astype(np.float32)
        self.first_step = state.step
        if self.u_full_load is None:
            self._tell(f"goes on from step {self.first_step:,} ({self.integrator.progress:.1%})")
        else:
            self._tell("goes on from the end of the load, to find its distance from the static solution")

    def _figures(self, loop_seconds: float) -> dict[str, Any]:
        """Collective."""
        return asdict(
            run_figures(
                self.integrator,
                self.monitor,
                self.force_halo,
                resumed_at_step=self.first_step,
                n_rollbacks=self.rollback.n_rollbacks,
                seconds=self.phases.seconds | {"loop": loop_seconds},
                term_seconds=self.term_seconds,
            )
        )

    def _metadata(self) -> dict[str, Any]:
        tumour, relaxes = self.deck.tumour, isinstance(self.integrator, DynamicRelaxation)
        return {
            "deck": decks.canonical(self.deck),
            "title": self.deck.title,
            "folder": str(Path.cwd()),  # relative paths of the deck start here
            "versions": {name: importlib.metadata.version(name) for name in ("mpitled", "numpy", "numba", "h5py")},
            "ranks": self.world.size,
            "partition": self.about["partition"],
            "left_out": self.left_out,
            "marks": {name: self.about[name] for name in ("version", "program", "deck", "model")},
            # Frames of a relaxation are at shares of the load.
            "load_time_s": 1.0 if relaxes else self.deck.solver.load_time,
            "tumour": tumour
            and {
                "centre_m": list(tumour.centre),
                "seed_radius_m": tumour.seed_radius,
                "radius_m": sphere_radius(tumour.volume),
            },
        }


def _remedy(deck: Deck) -> str:
    """How to keep such a scene stable."""
    relaxes = Method(deck.solver.method) is Method.RELAXATION
    slower = "more solver.load_steps" if relaxes else "a longer solver.load_time"
    if deck.solver.time_step != "auto":
        slower = f"leave solver.time_step to auto, or {slower}"
    finer = "refine the mesh or the cloud where cells deform most"
    if deck.tumour:
        return f"load more slowly ({slower}), {finer}, or enlarge tumour.seed_radius or cloud.radius"
    return f"load more slowly ({slower}), or {finer}"
