"""`run --dry`: the expected time of a run, its terms, kernels and arrays, and the omitted terms, without a step."""

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
    """Build the model, its partition and the terms of a run, and return their description, the same on all ranks.

    The time of every kernel is measured in a few calls on the undeformed body. verbose: also the shape and type of
    every array. Collective.
    """
    run = job.prepare(deck, directory, world)
    run.warm_up()
    with everywhere():
        run.integrator.begin()
    integrator, sub = run.integrator, run.sub
    calls = trace_kernels([(term.name, partial(term.apply, integrator.state)) for term in integrator.step.terms])
    check_calls = trace_kernels([("stability check", integrator.check)])
    seconds, check = forecast.measure(integrator)
    step = sum(seconds.values())
    run.output.keep_stable(integrator, {})  # allocates the arrays of a run
    kinds = [sub.rows.n_own("hexahedra"), sub.rows.n_own("support domains")]
    counts = [*kinds, sub.n_nodes, sum(len(nodes) for _, nodes in sub.shared)]
    sizes = [distinct_bytes(calls) / sub.n_cells, _reachable_bytes(integrator, run.output) / sub.n_cells]
    table = world.gather([*counts, *sizes, 1e3 * step, 1e3 * check])
    lines = _duration(run, table[:, -2].max() / 1e3, table[:, -1].max() / 1e3)
    lines.append(
        f"{'rank':>4}{'hexahedra':>11}{'domains':>9}{'nodes':>9}{'shared':>8}{'step, bytes a cell':>20}"
        f"{'held, bytes a cell':>20}{'step, ms':>10}{'check, ms':>11}"
    )
    for rank, row in enumerate(table):
        numbers = [f"{value:{width}.0f}" for value, width in zip(row, (11, 9, 9, 8, 20, 20), strict=False)]
        lines.append(f"{rank:4}{''.join(numbers)}{row[-2]:10.3f}{row[-1]:11.3f}")
    lines.append("each step, on rank 0:")
    for name, value in seconds.items():
        lines.append(f"  {name}, {1e3 * value:.3f} ms")
        lines += _kernels([call for call in calls if call.term == name], verbose)
    lines.append("each stability check, on rank 0:")
    if not verbose:
        known = {call.kernel for call in calls}
        repeated = Counter(call.kernel for call in check_calls if call.kernel in known)
        check_calls = [call for call in check_calls if call.kernel not in known]
        lines += [f"    as in a step: {', '.join(f'{k}{_times(n)}' for k, n in repeated.items())}"] if repeated else []
    lines += _kernels(check_calls, verbose)
    left_out = [world.broadcast(run.left_out, rank) for rank in range(world.size)]
    lines.append("left out:")
    for text in dict.fromkeys(text for of_rank in left_out for text in of_rank):
        ranks = [str(rank) for rank, of_rank in enumerate(left_out) if text in of_rank]
        lines.append(f"  {text}" + ("" if len(ranks) == world.size else f" (on rank {', '.join(ranks)})"))
    if not verbose:
        lines.append("-v lists the shape and type of every array")
    return str(world.broadcast("\n".join(lines)))


def _duration(run: Any, step: float, check: float) -> list[str]:
    """Number of steps and their time on the slowest rank. step, check: their times, s."""
    integrator = run.integrator
    if integrator.scene.method is not Method.RELAXATION:
        length = f" of {integrator.state.time_step:.4g} s"
        more = "; the step becomes shorter when cells require it, then longer again"
        if integrator.scene.method is Method.QUASI_STATIC:
            more = "; then a relaxation to rest, for the distance to the static solution"
    else:
        length = " of load"
        more = f"; then, until {1e3 * integrator.tolerance:g} mm from rest, about the same number"
    expected = forecast.expect(integrator, step, check, run.output_bytes)
    least = "at least " if expected.at_least else ""
    return [
        f"steps: {expected.steps}{length}, {expected.checks} stability checks{more}",
        f"loop: {least}{expected.loop_s:.3g} s on the slowest rank ({1e3 * step:.3g} ms a step, "
        f"{1e3 * check:.3g} ms a check: the fastest of {forecast.CALLS} calls on this machine)",
        f"output: {resources.format_bytes(run.output_bytes)} in {run.deck.output.frames + 1} frames",
    ]


def _kernels(calls: Sequence[Call], verbose: bool) -> list[str]:
    """A line for each kernel with the names of its arrays; with `verbose`, for each distinct call, with shapes."""
    groups: dict[tuple[str, str], list[Call]] = {}
    for call in calls:
        arrays = (f"{name} {'x'.join(map(str, a.shape))} {a.dtype}" for name, a in call.arrays.items())
        groups.setdefault((call.kernel, ", ".join(arrays) if verbose else ""), []).append(call)
    lines = []
    for (kernel, shapes), group in groups.items():
        names = shapes or " ".join(dict.fromkeys(name for call in group for name in call.arrays))
        line = f"{kernel}{_times(len(group))}, {distinct_bytes(group) / 1e6:.3g} MB: {names}"
        lines += textwrap.wrap(line, 118, initial_indent="    ", subsequent_indent="      ", break_on_hyphens=False)
    return lines


def _times(n: int) -> str:
    return "" if n == 1 else f" {n} times"


def _reachable_bytes(*roots: object) -> int:
    """Bytes of all arrays reachable from objects of this package, each array counted once."""
    arrays: dict[int, int] = {}
    seen: set[int] = set()
    todo: list[Any] = list(roots)
    while todo:
        value = todo.pop()
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
