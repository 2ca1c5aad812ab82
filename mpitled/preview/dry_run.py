"""What a run of a deck would do, without a step of it: how long, terms, kernels, arrays, what is left out and why."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mpitled import job, resources
from mpitled.deck import Deck
from mpitled.errors import everywhere
from mpitled.parallel.halo import World
from mpitled.preview import forecast
from mpitled.preview.kernel_trace import Call, distinct_bytes, trace_kernels
from mpitled.terms.term import Method


def dry_run(deck: Deck, directory: Path, world: World, *, verbose: bool = False) -> str:
    """Model, partition and composition as the run itself makes them, in words that are the same on all ranks.

    Every kernel is called a few times on the undeformed body, to see which it is, what it takes and how long. What
    matters most comes first; with `verbose` every array has its shape.
    """
    run = job.prepare(deck, directory, world)
    run.warm_up()
    with everywhere():
        run.integrator.begin()
    method, sub = run.integrator, run.sub
    terms = [(term.name, partial(term.apply, method.state)) for term in method.step.terms]
    calls, surveyed = trace_kernels(terms), trace_kernels([("check", method.check)])
    seconds, survey = forecast.measure(method)
    run.output.keep_stable(method, {})  # allocates what a run holds
    step = sum(seconds.values())
    counts = [
        sub.rows.n_own("hexahedra"),
        sub.rows.n_own("support domains"),
        sub.n_nodes,
        sum(len(nodes) for _, nodes in sub.shared),
    ]
    sizes = [distinct_bytes(calls) / sub.n_cells, _held_bytes(method, run.output) / sub.n_cells]
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
    left_out = [world.broadcast(run.left_out, rank) for rank in range(world.size)]
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
            if is_dataclass(value) and not hasattr(value, "__dict__"):
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
    method, state = run.integrator, run.integrator.state
    if method.scene.method is not Method.RELAXATION:
        length = f" of {state.time_step:.4g} s"
        more = "; the step may become shorter where cells need it, and longer again"
        if method.scene.method is Method.QUASI_STATIC:
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
