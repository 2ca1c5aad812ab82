"""The forecast of a run: steps and stability checks, their times, measured on the model, and space on the disc."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from mpitled import resources, store
from mpitled.deck import Deck
from mpitled.model import Model
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import PRECISIONS, localise
from mpitled.solver.integrator import Integrator
from mpitled.solver.integrators import make_integrator
from mpitled.solver.output import cell_data
from mpitled.terms import Scene
from mpitled.terms.term import Method

#: Calls of each term. The fastest call counts, because other processes may use the machine too.
CALLS = 9


class Forecast(NamedTuple):
    """Steps and times of the loop, and the size of the result. Without the model's build, pictures and relaxation."""

    steps: int
    checks: int
    at_least: bool  # whether the method continues until it is at rest
    step_s: float
    check_s: float
    output_bytes: int

    @property
    def loop_s(self) -> float:
        """Time of the loop, s."""
        return self.steps * self.step_s + self.checks * self.check_s

    def describe(self) -> str:
        """One line of text."""
        least = "at least " if self.at_least else ""
        steps = f"{least}{self.steps} steps of {1e3 * self.step_s:.2g} ms, so {least}{self.loop_s:.2g} s of stepping"
        return f"{steps}, on one rank of this machine; {resources.format_bytes(self.output_bytes)} of results"


def measure(integrator: Integrator) -> tuple[dict[str, float], float]:
    """Seconds of each term of a step at the current state, and of a stability check."""
    seconds: dict[str, float] = dict.fromkeys((term.name for term in integrator.step.terms), math.inf)
    for _ in range(CALLS):
        step = dict.fromkeys(seconds, 0.0)
        for term in integrator.step.terms:  # in their order, because the exchange begins before it ends
            step[term.name] += _seconds(partial(term.apply, integrator.state))
        seconds = {name: min(least, step[name]) for name, least in seconds.items()}
    return seconds, min(_seconds(integrator.check) for _ in range(CALLS))


def expect(integrator: Integrator, step: float, check: float, output_bytes: int) -> Forecast:
    """The forecast for an integrator before its first step. step, check: their times, s."""
    at_least = integrator.scene.method is Method.RELAXATION
    return Forecast(integrator.expected_steps, integrator.expected_checks, at_least, step, check, output_bytes)


def forecast(deck: Deck, model: Model) -> Forecast:
    """The forecast for a run on one rank of this machine. InputError if the deck's time step is too long."""
    with tempfile.TemporaryDirectory() as folder:  # a rank reads its part of a model from a file
        path = Path(folder) / "model.h5"
        store.write_model(path, model, "")
        integrator = integrator_of(deck, path)
    integrator.warm_up()
    integrator.begin()
    seconds, check = measure(integrator)
    size = store.result_bytes(integrator.sub.rows, deck.output.frames + 1, cell_data(deck))
    return expect(integrator, sum(seconds.values()), check, size)


def integrator_of(deck: Deck, path: Path) -> Integrator:
    """The integrator of a deck on one rank, at rest, for the model in a file."""
    rows, figures = store.read_part(path, 1, 0), store.read_figures(path)
    hourglass, rule, precision = deck.hexahedra.hourglass, deck.hexahedra.gradient, PRECISIONS[deck.solver.precision]
    sub = localise(rows, hourglass, deck.support.stabilisation, rule, precision)
    return make_integrator(Scene(sub, deck.solver, deck=deck), deck.output.frames, World(), figures)


def _seconds(execute: Callable[[], object]) -> float:
    begin = time.perf_counter()
    execute()
    return time.perf_counter() - begin
