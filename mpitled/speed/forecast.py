"""What a run will take on one rank of this machine: its steps, and the time of one, measured on the model itself."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from mpitled import store
from mpitled.deck import Deck
from mpitled.model import Model
from mpitled.solver.halo import World
from mpitled.solver.march import March
from mpitled.solver.relaxation import Relaxation
from mpitled.solver.run import PRECISIONS
from mpitled.solver.subdomain import Subdomain, localise

_MEASURED = 0.3  # s of steps, and three of them at least


class Forecast(NamedTuple):
    """Steps and times of the loop; building, pictures and a ramp's distance to rest come on top."""

    steps: int
    at_least: bool  # whether the method goes on until it is at rest, which nobody knows beforehand
    step_s: float
    loop_s: float

    def describe(self) -> str:
        """In a line."""
        least = "at least " if self.at_least else ""
        return f"{least}{self.steps} steps of {1e3 * self.step_s:.2g} ms: {least}{self.loop_s:.2g} s on one rank here"


def forecast(deck: Deck, model: Model) -> Forecast:
    """Takes a few steps at rest. InputError if the deck's step is too long for the model."""
    with tempfile.TemporaryDirectory() as folder:  # ranks read their part from a file, and so does this one
        path = Path(folder) / "model.h5"
        store.write_model(path, model, "")
        _, method = first_rank(deck, path)
    method.warm_up()
    method.begin()
    steps = method.expected_steps
    taken, begin = 0, time.perf_counter()
    while taken < 3 or time.perf_counter() - begin < _MEASURED:
        for _, term in (*method.motion[-1:], *method.forces, *method.motion[:-1]):
            term(method.state)
        taken += 1
    each = (time.perf_counter() - begin) / taken
    return Forecast(steps, isinstance(method, Relaxation), each, steps * each)


def first_rank(deck: Deck, path: Path, ranks: int = 1) -> tuple[Subdomain, March | Relaxation]:
    """The part of rank 0 of a model that is cut for so many, and its method at rest, which does without the others."""
    rows, figures = store.read_part(path, ranks, 0), store.read_figures(path)
    solver, frames, world = deck.solver, deck.output.frames, World()
    hourglass, rule, precision = deck.hexahedra.hourglass, deck.hexahedra.gradient, PRECISIONS[solver.precision]
    sub = localise(rows, hourglass, deck.support.stabilisation, rule, precision)
    if solver.method == "dynamic-relaxation":
        return sub, Relaxation(solver, frames, sub, world, None, None)
    return sub, March(solver, frames, sub, world, None, None, figures)
