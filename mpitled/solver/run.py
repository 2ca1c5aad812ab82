"""The time loop of one rank, watched every few steps, and what is written, kept and counted around it."""

from __future__ import annotations

import importlib.metadata
import logging
import math
import resource
import sys
import time
from collections import deque
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
from mpitled.solver.cauchy_stress import cauchy
from mpitled.solver.central_difference import March
from mpitled.solver.dynamic_relaxation import Relaxation
from mpitled.solver.monitor import BALANCE_LIMIT, Watch
from mpitled.solver.progress import Interrupts, Phases, Progress
from mpitled.solver.restart import Kept, Memory, Parts, recall, remember
from mpitled.solver.step import State, Term

#: Looks from one state that recovery can go back to until the next; how often a run may go back; and which time a
#: relaxation begins its load anew, for what it went back to was spoilt if the load still fails.
SAVED, RECOVERIES, ANEW = 5, 5, 3
#: A state whose energies are farther out of balance, as a share of what ends a run, is ill already.
HEALTHY = 0.2
#: A relaxation that stalls farther from the static solution, as a share of the largest displacement, has none to offer.
NO_SOLUTION = 0.02
#: What a run is asked at a look: nothing, to keep a checkpoint, to keep one and end.
KEEP, END = 1, 2


_log = logging.getLogger(__name__)


class Run:
    """The time loop of one rank and what is watched, written and counted around it."""

    PASSING = Kept(alike=("frames", "written"))
    LASTING = Kept(nodes=("loaded",), alike=("made", "recoveries", "looks", "good_time", "good_figures"))

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
        """about: what tells the run from others; found: the checkpoint that it goes on from."""
        self.deck, self.directory, self.world, self.sub, self.phases = deck, directory, world, sub, phases
        self.halos: list[Halo] = []
        self.force_halo = self._halo(3, sub.precision)
        solver, frames = deck.solver, deck.output.frames
        self.method: March | Relaxation
        if solver.method == "dynamic-relaxation":
            self.method = self._relaxation()
        else:
            self.method = March(solver, frames, sub, world, self.force_halo, self._halo(1), model)
        self.tells = world.leads and not quiet
        self.progress: Progress | None = None  # made when the loop begins
        self.about, self.found, self.interrupts = about, found, Interrupts(world)
        self.term_seconds: dict[str, float] = {}
        self.distance = math.nan
        self.volume = model.volume_m3
        self.watch = self._watch()
        self.recoveries, self.looks = 0, 0
        self.frames, self.written = 0, -math.inf  # how many, and the time of the last
        # What a ramp came to, figures and displacements, from where its distance to the static solution is looked for.
        self.made: dict[str, Any] | None = None
        self.loaded: NDArray[np.float64] | None = None
        self.saved: deque[Memory] = deque(maxlen=2)  # to go back to the older of them; the younger may be ill already
        self.start: Memory = {}  # the numbers of the first, at no load
        self.first_step, self.next_checkpoint = 0, math.inf
        self.good_time, self.good_figures = 0.0, self.watch.figures  # of `State.good`: its frame's time, what was seen

    def _halo(self, components: int, precision: type[np.floating] = np.float64) -> Halo | None:
        if self.world.size == 1:
            return None
        self.halos.append(Halo(self.world, self.sub.shared, components, precision))
        return self.halos[-1]

    def _relaxation(self) -> Relaxation:
        deck, halo = self.deck, self._halo(Relaxation.components(self.sub))
        return Relaxation(deck.solver, deck.output.frames, self.sub, self.world, self.force_halo, halo)

    def _watch(self) -> Watch:
        return Watch(self.world, self.sub, self.volume, self.deck.path.name, _remedy(self.deck))

    def free(self) -> None:
        """Give back what ranks share. Collective; the run's end."""
        for halo in self.halos:
            halo.free()

    # ------------------------------------------------------------ the loop

    @property
    def output_bytes(self) -> int:
        """Size of the result."""
        return store.result_bytes(self.sub.rows, self.deck.output.frames + 1, cell_data(self.deck))

    def _check_disc(self) -> None:
        what = f"the result of {self.deck.output.frames + 1} frames"
        needed = self.output_bytes - store.unfinished_bytes(self.directory)
        resources.check_disc(needed, self.directory, what, "lower output.frames, or give another folder")

    def run(self, interrupts: Interrupts) -> dict[str, float]:
        """To the end, with a result that is whole; the seconds of each phase on this rank. Collective."""
        self.interrupts = interrupts
        self.world.on_leader(self._check_disc)
        with self.phases("compile"):
            self.warm_up()
        with self.phases("begin"), everywhere():
            if self.found:
                self._resume(self.found)
            else:
                self._begin()
                if self.world.on_leader(lambda: store.discard_checkpoints(self.directory)):
                    self._tell("a checkpoint that is damaged is discarded")
                if store.is_finished(self.directory):
                    self._tell(
                        "the result of an earlier run is there, and replaced with its page when this one is done; "
                        "what was exported of it stays"
                    )
        writer = store.ResultWriter(
            self.directory,
            self.world.comm,
            self.sub.rows,
            self.deck.output.frames + 1,
            self._metadata(),
            cell_data=cell_data(self.deck),
            series=list(_SERIES),
            frames=self.frames,
        )
        if self.force_halo is not None:  # what was spent before the loop is not the loop's
            self.force_halo.seconds = dict.fromkeys(self.force_halo.seconds, 0.0)
        begin = time.perf_counter()
        self._ask_again()
        _log.info("loop")
        interrupts.looked_for = True
        try:
            if self.made is None:
                if self.tells:
                    self.progress = Progress(self.method.progress, self.method.state.step)
                self._advance(writer)
                aside = sum(self.phases.seconds.get(name, 0.0) for name in ("output", "checkpoints"))
                self.phases.seconds["loop"] = time.perf_counter() - begin - aside
                self.made = self._run_figures(self.phases.seconds["loop"])
            if self.deck.solver.method == "quasi-static":
                with self.phases("static distance"):
                    self.distance = self._distance_to_static(writer)
            elif isinstance(self.method, Relaxation):
                self.distance = self.method.best if self.method.stalled else self.method.distance
                with everywhere():
                    self._end_if_stalled(self.method)
        except MpitledError as error:
            if error.everywhere:  # else the others do not know of it
                figures = self.made or self._run_figures(time.perf_counter() - begin)
                writer.abandon(figures | {"stopped": str(error)})
            raise
        finally:
            interrupts.looked_for, interrupts.when = (
                False,
                "after the last step; 'mpitled report' makes what is missing",
            )
            if self.progress:
                self.progress.close()
        if math.isfinite(self.distance):
            self.made["static_distance_mm"] = 1e3 * self.distance
        seconds = self.made["seconds"] | self.phases.seconds
        with self.phases("close"):
            writer.close(self.made | {"seconds": seconds})
        return seconds

    def _begin(self) -> None:
        try:
            self.method.begin()
        except InputError as error:  # of a key
            raise InputError(f"{self.deck.path}: {error}") from None

    def _tell(self, words: str) -> None:
        if self.tells:
            print(f"note: {words}", file=sys.stderr, flush=True)

    def _advance(self, writer: store.ResultWriter) -> None:
        """Steps, a survey and decisions, and so on to the end of the method."""
        method = self.method
        forces, motion = method.forces, method.motion
        reactions, update = motion[:-1], motion[-1:]
        self.term_seconds = dict.fromkeys((name for name, _ in (*forces, *motion)), 0.0)
        if self.found:
            self._take(forces)
            self.found, ahead = None, True  # it has been looked at where it goes on
        else:
            self.looks, self.start = 0, {}
            self.saved.clear()
            self._take((*forces, *reactions))
            ahead = self._ahead(writer)
        step = (*update, *forces, *reactions)
        while ahead:
            for _ in range(method.between):
                self._take(step)
            ahead = self._ahead(writer)

    def _take(self, terms: tuple[Term, ...]) -> None:
        state, seconds, clock = self.method.state, self.term_seconds, time.perf_counter
        for name, term in terms:
            begin = clock()
            term(state)
            seconds[name] += clock() - begin

    def _ahead(self, writer: store.ResultWriter) -> bool:
        """A survey, decisions, and what is written and kept between steps; whether there are steps ahead."""
        method = self.method
        while True:
            try:
                with everywhere():
                    self._look()
                break
            except UnstableError:
                if not self.saved or self.recoveries == RECOVERIES:
                    self._write_last_good(writer)
                    raise
                self.recoveries += 1
                anew = self.recoveries == ANEW and self.loaded is None
                how = "the load begins anew, more slowly" if anew else "it goes back a little and on more slowly"
                self._tell(f"the run was about to become unstable: {how} ({self.recoveries} of {RECOVERIES} times)")
                while len(self.saved) > 1:
                    self.saved.pop()
                if anew and isinstance(method, Relaxation):
                    method.state.rest()
                    recall(self._numbers, self.start)
                    self.saved.clear()
                    self.saved.append(remember(self._healthy))
                else:
                    recall(self._healthy, self.saved[0])
                writer.rewind(self.frames)
                method.state.show()
                method.harden(anew)
                self._take(method.forces)
        due, last = method.decide(self.watch.figures)
        method.state.good[:] = method.state.u[:, : self.sub.n_nodes]
        self.good_time, self.good_figures = method.frame_time, self.watch.figures
        if due and self.loaded is None:
            with self.phases("output"):
                self._write(writer, method.frame_time)
        if last:
            return False
        healthy = self.watch.figures["balance_error"] < HEALTHY * BALANCE_LIMIT
        if self.method.recovers and self.looks % SAVED == 0 and healthy:
            self.saved.append(remember(self._healthy))
            self.start = self.start or remember(self._numbers)
        self.looks += 1
        if self.watch.request:
            with self.phases("checkpoints"):
                self._keep(writer)
        if self.watch.request == END:
            with everywhere():
                where = f"at {self.method.progress:.1%} of the run"
                if self.loaded is not None:
                    where = "after the load, on the way to its distance from the static solution"
                raise InterruptedRun(f"interrupted {where}; the same command with --resume goes on")
        return True

    def _look(self) -> None:
        method = self.method
        asked = KEEP if time.perf_counter() >= self.next_checkpoint else 0
        self.watch.look(method, END if self.interrupts.asked else asked)
        if self.progress and self.loaded is None:
            self.progress.show(method.progress, method.state.step, self.watch.figures)

    def _write_last_good(self, writer: store.ResultWriter) -> None:
        """As one more frame of a run that cannot go on, unless it is there already."""
        if self.loaded is not None or self.good_time <= self.written:
            return
        self.method.state.place(self.method.state.good)
        self.method.survey.look(self.method.state, self.method.safety)
        self.watch.figures = self.good_figures
        self._write(writer, self.good_time)

    # ------------------------------------------------------------ what is kept

    @property
    def _passing(self) -> Parts:
        """What changes from step to step."""
        method = self.method
        return (("method", method, method.PASSING), ("state", method.state, State.KEPT), ("output", self, self.PASSING))

    @property
    def _healthy(self) -> Parts:
        """What of it an unstable run goes back to."""
        return tuple(
            (name, part, kept)
            for (name, part, _), kept in zip(self._passing, (*self.method.HEALTHY, self.PASSING), strict=True)
        )

    @property
    def _numbers(self) -> Parts:
        """What of that is no array."""
        return tuple((name, part, kept.numbers) for name, part, kept in self._healthy)

    @property
    def _lasting(self) -> Parts:
        """What has to be known beside it, to be continued."""
        method, watch = self.method, self.watch
        return (
            ("run", self, self.LASTING),
            ("watch", watch, watch.LASTING),
            ("method", method, method.LASTING),
            ("sharpness", method.sharpness, method.sharpness.LASTING),
        )

    def _keep(self, writer: store.ResultWriter) -> None:
        """Write a checkpoint. Collective."""
        writer.sync()  # the frames that it counts on
        about = self.about | {"step": self.method.state.step, "share": self.method.progress, "frames": self.frames}
        about["seeks_distance"] = self.loaded is not None
        memories = {"lasting": (self._lasting, remember(self._lasting))}
        memories |= {"start": (self._numbers, self.start)} if self.start else {}
        memories |= {f"saved{i}": (self._healthy, memory) for i, memory in enumerate(self.saved)}
        memories |= {"present": (self._passing, remember(self._passing))}
        checkpoint.save(self.directory, self.world, self.sub, about, memories)
        self._ask_again()

    def _ask_again(self) -> None:
        """Set the clock for the next checkpoint."""
        minutes = self.deck.output.checkpoint_minutes
        self.next_checkpoint = time.perf_counter() + 60 * minutes if minutes else math.inf

    def _resume(self, found: checkpoint.Found) -> None:
        """Put back what a checkpoint holds."""
        if found.told["seeks_distance"]:
            self.method = self._relaxation()
        read = checkpoint.load(found, self.sub)
        recall(self._lasting, read("lasting", self._lasting) or {})
        self.start = read("start", self._numbers) or {}
        while (healthy := read(f"saved{len(self.saved)}", self._healthy)) is not None:
            self.saved.append(healthy)
        recall(self._passing, read("present", self._passing) or {})
        self.method.state.show()
        self.method.state.good[:] = self.method.state.u[:, : self.sub.n_nodes]
        self.first_step = self.method.state.step
        if self.loaded is None:
            self._tell(f"goes on from step {self.first_step:,} ({self.method.progress:.1%})")
        else:
            self._tell("goes on from the end of the load, to find its distance from the static solution")

    def _end_if_stalled(self, relaxation: Relaxation) -> None:
        if relaxation.stalled:
            largest = np.abs(relaxation.state.u[:, : self.sub.n_nodes]).max()
            largest = float(self.world.gather([largest]).max())
            remedy = f"give solver.tolerance = {3e3 * relaxation.best:.2g} or more"
            if self.deck.solver.precision == "single":
                remedy += ", or solver.precision = double"
            if relaxation.best > NO_SOLUTION * largest:
                remedy = f"that is {relaxation.best / largest:.0%} of the largest displacement; {self.watch.remedy}"
            raise UnstableError(
                f"the relaxation comes no nearer to the static solution than {1e3 * relaxation.best:.2g} mm, by its "
                f"own estimate; {remedy}"
            )

    def _distance_to_static(self, writer: store.ResultWriter) -> float:
        """How far (m, the largest of all nodes) a ramp's end is from the static solution: found by going there."""
        n = self.sub.n_nodes
        if self.loaded is None:
            ramp, energy = self.method.state, self.watch.own_energy
            self.loaded = ramp.u[:, :n].copy()
            self.method, self.watch = self._relaxation(), self._watch()
            self.method.start_from(ramp, energy)
            self.method.begin()
        relaxation = self.method
        assert isinstance(relaxation, Relaxation)
        try:
            self._advance(writer)
        except UnstableError:
            return math.nan  # the run itself is well; only the estimate is not to be had
        own = np.abs(relaxation.state.u[:, :n] - self.loaded).max()
        return float(self.world.gather([own]).max()) + min(relaxation.distance, relaxation.best)

    def warm_up(self) -> None:
        """Compile, or load from the disk's cache: rank 0 first, so that the others find its work there."""
        if not self.world.leads:
            self.world.barrier()
        self.method.warm_up()
        if self.world.leads:
            self.world.barrier()

    # ------------------------------------------------------------ what is written

    def _metadata(self) -> dict[str, Any]:
        tumour = self.deck.tumour
        return {
            "deck": decks.canonical(self.deck),
            "title": self.deck.title,
            "folder": str(Path.cwd()),  # that paths of the deck are from, where they are not absolute
            "versions": {name: importlib.metadata.version(name) for name in ("mpitled", "numpy", "numba", "h5py")},
            "ranks": self.world.size,
            "partition": self.about["partition"],
            "marks": {name: self.about[name] for name in ("version", "program", "deck", "model")},
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
        sub, u = self.sub, self.method.state.u[:, : self.sub.n_nodes]
        at_points = np.einsum("ga,cga->gc", sub.domain_shapes, u[:, sub.domain_nodes])
        displacement = field = self._owned(u)
        if any(block.kind.meshfree for block in sub.rows.blocks):
            field = np.concatenate([self._owned(self._field(u)), at_points])
            displacement = np.concatenate([displacement, at_points])
        of_cells: dict[str, NDArray[np.floating]] = {"J": self.method.survey.jacobian[:-1]}
        if self.deck.output.stress:
            of_cells["stress"] = cauchy(sub.rows, u, self.deck.hexahedra.gradient)
        series = {name: self.watch.figures[key] for name, key in _SERIES.items()}
        self.frames, self.written = self.frames + 1, frame_time
        writer.write_frame(
            frame_time,
            {"parameters": displacement, "displacement": field},
            of_cells,
            series,
        )

    def _owned(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (n_owned, 3) of values (3, n_nodes)."""
        owned = self.sub.rows.owned
        return u.T if owned.all() else u.T[owned]

    def _field(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """u_h (3, n_nodes), m: the parameters of EFG nodes are not the field; one domain's MLS gives it there."""
        rows = self.sub.rows
        field = np.where(rows.owned & (rows.nodes < rows.n_fe_nodes), u, 0.0)
        field[:, rows.local(rows.field_nodes)] = np.einsum(
            "ga,cga->cg", rows.field_shapes, u[:, self.sub.field_domains]
        )
        if self.force_halo is not None:
            self.force_halo.sum(field)
        return field

    def _run_figures(self, loop_seconds: float) -> dict[str, Any]:
        """What the report says of the run itself. Collective."""
        state, rows, world = self.method.state, self.sub.rows, self.world
        halo_seconds = sum(self.force_halo.seconds.values()) if self.force_halo else 0.0
        computing = sum(
            self.term_seconds.get(name, 0.0) for name in ("voxel hexahedra", "hexahedra", "support domains")
        )
        table = world.gather(
            [
                rows.n_own("hexahedra"),
                rows.n_own("support domains"),
                halo_seconds / max(loop_seconds, 1e-9),
                computing,
                resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
            ]
        )
        hexahedra, domains, halo_share, computed, peak = table.T
        cells = hexahedra.sum() + domains.sum()
        figures = self.watch.figures or dict.fromkeys(_SERIES.values(), float("nan"))
        return {
            "ranks": world.size,
            "steps": state.step,
            "resumed_at_step": self.first_step,
            "time_step_s": state.time_step,
            "recoveries": self.recoveries,
            "seconds": dict(self.phases.seconds) | {"loop": loop_seconds},
            "term_seconds": self.term_seconds,
            "cells": {"hexahedra": int(hexahedra.sum()), "support_domains": int(domains.sum())},
            "nodes": rows.n_nodes,
            "cell_updates_per_second": cells * (state.step - self.first_step) / max(loop_seconds, 1e-9),
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


def cell_data(deck: Deck) -> dict[str, int]:
    """Components of what each frame holds of cells."""
    return {"J": 1} | ({"stress": 6} if deck.output.stress else {})


def _remedy(deck: Deck) -> str:
    """What keeps such a scene stable."""
    slower = "more solver.load_steps" if deck.solver.method == "dynamic-relaxation" else "a longer solver.load_time"
    if deck.solver.time_step != "auto":
        slower = f"leave solver.time_step to auto, or {slower}"
    finer = "refine the mesh or the cloud where cells deform most"
    if deck.tumour:
        return f"load more slowly ({slower}), {finer}, or enlarge tumour.seed_radius or cloud.radius"
    return f"load more slowly ({slower}), or {finer}"


#: Figures of a look that every frame has, by their names in the result; energies in J.
_SERIES = {
    "external_work": "external", "strain_energy": "strain", "hourglass_energy": "hourglass",
    "stabilisation_energy": "stabilisation", "kinetic_energy": "kinetic", "energy_of_added_mass": "added",
    "dissipated_energy": "dissipated", "added_mass": "added_mass", "min_jacobian": "min_jacobian",
    "step_ratio": "step_ratio", "balance_error": "balance_error", "kinetic_ratio": "kinetic_ratio",
}  # fmt: skip
