"""What a run will take: steps and surveys, the time of each, measured on the model itself, and room on the disc."""

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

#: Times that each term is called to tell how long it takes; the fastest counts, for others may use the machine too.
CALLS = 9


class Forecast(NamedTuple):
    """Steps and times of the loop, and the result's size; building, pictures and a ramp's way to rest come on top."""

    steps: int
    surveys: int
    at_least: bool  # whether the method goes on until it is at rest, which nobody knows beforehand
    step_s: float
    survey_s: float
    output_bytes: int

    @property
    def loop_s(self) -> float:
        return self.steps * self.step_s + self.surveys * self.survey_s

    def describe(self) -> str:
        """In a line."""
        least = "at least " if self.at_least else ""
        steps = f"{least}{self.steps} steps of {1e3 * self.step_s:.2g} ms, so {least}{self.loop_s:.2g} s of stepping"
        return f"{steps}, on one rank here; {resources.told(self.output_bytes)} of results"


def measure(method: Integrator) -> tuple[dict[str, float], float]:
    """Seconds that each term of a step takes on the state that the method has, and those of a survey."""
    seconds: dict[str, float] = dict.fromkeys((term.name for term in method.step.terms), math.inf)
    for _ in range(CALLS):
        step = dict.fromkeys(seconds, 0.0)
        for term in method.step.terms:  # in their order: the halo's end needs its beginning
            step[term.name] += _seconds(partial(term.apply, method.state))
        seconds = {name: min(least, step[name]) for name, least in seconds.items()}
    return seconds, min(_seconds(method.check) for _ in range(CALLS))


def expect(method: Integrator, step: float, survey: float, output_bytes: int) -> Forecast:
    """What a method that is ready to begin will take, at so many seconds a step and a survey."""
    at_least = method.scene.method is Method.RELAXATION
    return Forecast(method.expected_steps, method.expected_checks, at_least, step, survey, output_bytes)


def forecast(deck: Deck, model: Model) -> Forecast:
    """What a run takes on one rank of this machine. InputError if the deck's step is too long for the model."""
    with tempfile.TemporaryDirectory() as folder:  # ranks read their part from a file, and so does this one
        path = Path(folder) / "model.h5"
        store.write_model(path, model, "")
        method = first_rank(deck, path)
    method.warm_up()
    method.begin()
    seconds, survey = measure(method)
    size = store.result_bytes(method.sub.rows, deck.output.frames + 1, cell_data(deck))
    return expect(method, sum(seconds.values()), survey, size)


def first_rank(deck: Deck, path: Path, ranks: int = 1) -> Integrator:
    """The integrator of rank 0 at rest, of a model that is cut for so many ranks; it does without the others."""
    rows, figures = store.read_part(path, ranks, 0), store.read_figures(path)
    solver, frames, world = deck.solver, deck.output.frames, World()
    hourglass, rule, precision = deck.hexahedra.hourglass, deck.hexahedra.gradient, PRECISIONS[solver.precision]
    sub = localise(rows, hourglass, deck.support.stabilisation, rule, precision)
    return make_integrator(Scene(sub, solver, deck=deck), frames, world, figures)


def _seconds(act: Callable[[], object]) -> float:
    begin = time.perf_counter()
    act()
    return time.perf_counter() - begin
