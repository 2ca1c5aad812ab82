"""What a run of a deck would do, without a step of it: how long, terms, kernels, arrays, what is left out and why."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mpitled import deck as decks
from mpitled import job, resources
from mpitled.deck import Deck
from mpitled.errors import everywhere
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import SHORTEST_RUN, Subdomain
from mpitled.preview import forecast
from mpitled.solver.central_difference import March
from mpitled.speed.witness import Call, distinct_bytes, witness


def dry_run(deck: Deck, directory: Path, world: World, *, verbose: bool = False) -> str:
    """Model, partition and composition as the run itself makes them, in words that are the same on all ranks.

    Every kernel is called a few times on the undeformed body, to see which it is, what it takes and how long. What
    matters most comes first; with `verbose` every array has its shape.
    """
    run = job.prepare(deck, directory, world)
    run.warm_up()
    with everywhere():
        run.method.begin()
    method, sub = run.method, run.sub
    terms = [(name, partial(act, method.state)) for name, act in (*method.forces, *method.motion)]
    calls, surveyed = witness(terms), witness([("survey", method.look)])
    seconds, survey = forecast.measure(method)
    step = sum(seconds.values())
    counts = [
        sub.rows.n_own("hexahedra"),
        sub.rows.n_own("support domains"),
        sub.n_nodes,
        sum(len(nodes) for _, nodes in sub.shared),
    ]
    sizes = [distinct_bytes(calls) / sub.n_cells, _held_bytes(method) / sub.n_cells]
    table = world.gather([*counts, *sizes, 1e3 * step, 1e3 * survey])
    lines = _forecast(run, table[:, -2].max() / 1e3, table[:, -1].max() / 1e3)
    lines += [
        f"{'rank':>4}{'hexahedra':>11}{'domains':>9}{'nodes':>9}{'shared':>8}{'step, bytes a cell':>20}"
        f"{'held, bytes a cell':>20}{'step, ms':>10}{'survey, ms':>12}"
    ]
    for rank, row in enumerate(table):
        numbers = [f"{value:{width}.0f}" for value, width in zip(row, (11, 9, 9, 8, 20, 20), strict=False)]
        lines.append(f"{rank:4}{''.join(numbers)}{row[-2]:10.3f}{row[-1]:12.3f}")
    lines += _told(calls, surveyed, seconds, verbose)
    own = _left_out(deck, sub, world.size, (*calls, *surveyed))
    left_out = [world.broadcast(own, rank) for rank in range(world.size)]
    lines.append("left out:")
    for what in dict.fromkeys(what for of_rank in left_out for what in of_rank):
        ranks = [str(rank) for rank, of_rank in enumerate(left_out) if what in of_rank]
        where = "" if len(ranks) == world.size else f" (on rank {', '.join(ranks)})"
        lines.append(f"  {what}{where}")
    if not verbose:
        lines.append("-v tells the shape and type of every array")
    return str(world.broadcast("\n".join(lines)))


def _told(calls: Sequence[Call], surveyed: Sequence[Call], seconds: dict[str, float], verbose: bool) -> list[str]:
    """Each term with its time, its kernels and their arrays, those of rank 0."""
    kernels = _in_full if verbose else _in_short
    lines = ["each step, on rank 0:"]
    for name, of_term in seconds.items():
        lines.append(f"  {name}, {1e3 * of_term:.3f} ms")
        lines += kernels([call for call in calls if call.term == name])
    lines.append("each survey, on rank 0:")
    if not verbose:
        known = {call.kernel for call in calls}
        again = Counter(call.kernel for call in surveyed if call.kernel in known)
        surveyed = [call for call in surveyed if call.kernel not in known]
        lines += [f"    as in a step: {', '.join(f'{name}{_times(n)}' for name, n in again.items())}"] if again else []
    return [*lines, *kernels(surveyed)]


def _times(n: int) -> str:
    return "" if n == 1 else f" {n} times"


def _in_short(calls: Sequence[Call]) -> list[str]:
    """A line for each kernel, however often it is called, with the names of its arrays."""
    kernels: dict[str, list[Call]] = {}
    for call in calls:
        kernels.setdefault(call.kernel, []).append(call)
    lines = []
    for name, of_kernel in kernels.items():
        arrays = dict.fromkeys(array for call in of_kernel for array in call.arrays)
        size = distinct_bytes(of_kernel) / 1e6
        lines.append(f"    {name}{_times(len(of_kernel))}, {size:.3g} MB: {' '.join(arrays)}")
    return lines


def _in_full(calls: Sequence[Call]) -> list[str]:
    """The calls that differ, with each array's shape and type."""
    told = Counter(
        f"{call.kernel}, {sum(a.nbytes for a in call.arrays.values()) / 1e6:.3g} MB: "
        + ", ".join(f"{name} {'x'.join(map(str, a.shape))} {a.dtype}" for name, a in call.arrays.items())
        for call in calls
    )
    lines = []
    for text, n in told.items():
        kernel, rest = text.split(",", 1)
        lines += textwrap.wrap(
            f"{kernel}{_times(n)},{rest}",
            118,
            initial_indent="    ",
            subsequent_indent="      ",
            break_on_hyphens=False,
        )
    return lines


def left_out(directory: Path, metadata: Mapping[str, Any]) -> list[str]:
    """What the run in a directory, whose result records this of it, did without on rank 0, as `dry_run` tells it."""
    deck, ranks = decks.recorded(metadata["deck"], directory), metadata["ranks"]
    sub, method = forecast.first_rank(deck, directory / job.MODEL, ranks)
    return _left_out(deck, sub, ranks, witness([("all", method.warm_up)]))


def _left_out(deck: Deck, sub: Subdomain, ranks: int, calls: Sequence[Call]) -> list[str]:
    """The kernels that are not called and the arguments that are not there, each with what spares them."""
    called = {call.kernel for call in calls}
    spared: dict[str, list[str]] = {}
    for kernel, why in reasons(deck, sub, ranks).items():
        if why and kernel not in called:
            spared.setdefault(why, []).append(kernel)
    absent: dict[str, list[str]] = {}
    for call in calls:
        for name in call.absent:
            absent.setdefault(name, []).append(call.kernel)
    for name, kernels in absent.items():
        spared.setdefault(_ABSENT[name](deck), []).append(f"{name} of {' and '.join(dict.fromkeys(kernels))}")
    for what, why in _scene(deck, sub):
        spared.setdefault(why, []).append(what)
    return [f"{', '.join(names)}: {why}" for why, names in spared.items()]


def reasons(deck: Deck, sub: Subdomain, ranks: int) -> dict[str, str]:
    """Why each kernel is not called, if it is not; "" where it may yet be, later in the run."""
    relaxes = deck.solver.method == "dynamic-relaxation"
    hexahedra = "no hexahedra" if sub.rows.n_own("hexahedra") == 0 else ""
    voxels = hexahedra or f"no {SHORTEST_RUN} equal boxes in a row"
    general = hexahedra or f"all hexahedra are boxes, {SHORTEST_RUN} or more in a row"
    domains = "no support domains"
    alone = "one rank" if ranks == 1 else "" if sub.shared else "no node is shared"
    method = f'solver.method = "{deck.solver.method}"'
    heavier = method if deck.solver.method != "quasi-static" else "solver.mass_scaling = false"
    return {
        "voxel_forces": voxels,
        "voxel_survey": voxels,
        "hexahedron_forces": general,
        "hexahedron_survey": general,
        "domain_forces": domains,
        "domain_survey": domains,
        "follow": "no node is turned",
        "react": "no node is moved" if ranks == 1 else "no node of this rank is moved",
        "update": method,
        "relax": method,
        "change_step": method if relaxes else "",
        "kinetic_energy": method,
        "raise_mass": heavier,
        "keep_masses": method,
        "invert_masses": method,
        "watch_relaxation": method,
        "gather": alone,
        "add": alone,
        "add_gathered": alone,
        "scatter": alone,
        **dict.fromkeys(("scramble", "perturb", "respond"), ""),
    }


#: Why an argument of a kernel is not there.
_ABSENT: dict[str, Callable[[Deck], str]] = {
    "position": lambda deck: f"support.stabilisation = {deck.support.stabilisation:g}",
    "inverse": lambda deck: f"support.stabilisation = {deck.support.stabilisation:g}",
    "mobility": lambda deck: "relaxation has no inertia where nodes are moved",
    "copied": lambda deck: f'solver.precision = "{deck.solver.precision}"',
    "tensor": lambda deck: f'solver.method = "{deck.solver.method}": masses are scalars',
}


def _scene(deck: Deck, sub: Subdomain) -> list[tuple[str, str]]:
    """What else a scene may do without."""
    lines = []
    if deck.tumour is None:
        lines.append(("tumour", "no [tumour]: no seed, no graded cloud, no volume balance"))
    if len(sub.rows.materials) == 1:
        lines.append(("materials", f"{sub.rows.materials[0].name} alone"))
    return lines


def _held_bytes(*roots: object) -> int:
    """Bytes of all arrays that can be reached from some objects, each once."""
    arrays: dict[int, int] = {}
    seen: set[int] = set()
    todo = list(roots)
    while todo:
        value: Any = todo.pop()
        if isinstance(value, np.ndarray):
            while isinstance(value.base, np.ndarray):
                value = value.base
            arrays[id(value)] = value.nbytes
        elif id(value) not in seen:
            seen.add(id(value))
            if is_dataclass(value):
                todo += [getattr(value, field.name) for field in fields(value)]
            elif isinstance(value, list | tuple):
                todo += value
            elif isinstance(value, dict):
                todo += value.values()
            elif type(value).__module__.startswith("mpitled"):
                todo += vars(value).values()
    return sum(arrays.values())


def _forecast(run: Any, step: float, survey: float) -> list[str]:
    """How many steps, and how long they take on the slowest rank by what was measured."""
    method, state = run.method, run.method.state
    if isinstance(method, March):
        length = f" of {state.time_step:.4g} s"
        more = "; the step may become shorter where cells need it, and longer again"
        if run.deck.solver.method == "quasi-static":
            more = "; then a relaxation to rest, to tell the distance to it"
    else:
        length = " of load"
        more = f"; then as many as come within {1e3 * method.tolerance:g} mm of rest, about as many again"
    expected = forecast.expect(method, step, survey, run.output_bytes)
    least = "at least " if expected.at_least else ""
    return [
        f"steps: {expected.steps}{length}, {expected.surveys} surveys{more}",
        f"loop: {least}{expected.loop_s:.3g} s on the slowest rank ({1e3 * step:.3g} ms a step, "
        f"{1e3 * survey:.3g} ms a survey: the fastest of {forecast.CALLS} calls on this machine)",
        f"output: {resources.format_bytes(run.output_bytes)} in {run.deck.output.frames + 1} frames",
    ]
