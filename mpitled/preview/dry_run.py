"""`run --dry`: the time that a run would take, its terms, kernels and arrays, and what it omits; no step is taken."""

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
from mpitled.cells.voxel_runs import SHORTEST_RUN
from mpitled.deck import Deck
from mpitled.errors import everywhere
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import Subdomain
from mpitled.preview import forecast
from mpitled.solver.central_difference import March
from mpitled.speed.witness import Call, distinct_bytes, witness


def dry_run(deck: Deck, directory: Path, world: World, *, verbose: bool = False) -> str:
    """Build the model, its partition and the terms as the run does, and describe them; the same text on all ranks.

    Every kernel is called a few times on the undeformed body to measure its time. `verbose` gives the shape and type
    of every array. Collective.
    """
    run = job.prepare(deck, directory, world)
    run.warm_up()
    with everywhere():
        run.method.begin()
    method, sub = run.method, run.sub
    calls = witness([(name, partial(act, method.state)) for name, act in (*method.forces, *method.motion)])
    check_calls = witness([("stability check", method.look)])
    seconds, check = forecast.measure(method)
    step = sum(seconds.values())
    counts = [sub.rows.n_own_hexahedra, sub.rows.n_own_domains, sub.n_nodes, sum(len(nodes) for _, nodes in sub.shared)]
    sizes = [distinct_bytes(calls) / sub.n_cells, _reachable_bytes(method) / sub.n_cells]
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
    for name, of_term in seconds.items():
        lines.append(f"  {name}, {1e3 * of_term:.3f} ms")
        lines += _kernels([call for call in calls if call.term == name], verbose)
    lines.append("each stability check, on rank 0:")
    if not verbose:
        known = {call.kernel for call in calls}
        again = Counter(call.kernel for call in check_calls if call.kernel in known)
        check_calls = [call for call in check_calls if call.kernel not in known]
        lines += [f"    as in a step: {', '.join(f'{k}{_times(n)}' for k, n in again.items())}"] if again else []
    lines += _kernels(check_calls, verbose)
    lines += _omitted_by_ranks(omissions(deck, sub, world.size, (*calls, *check_calls)), world)
    if not verbose:
        lines.append("-v lists the shape and type of every array")
    return str(world.broadcast("\n".join(lines)))


def _duration(run: Any, step: float, check: float) -> list[str]:
    """Number of steps and their time on the slowest rank; step and check in s."""
    method, state = run.method, run.method.state
    if isinstance(method, March):
        length = f" of {state.time_step:.4g} s"
        more = "; the step becomes shorter where cells require it, and longer again"
        if run.deck.solver.method == "quasi-static":
            more = "; then a relaxation to rest, which gives the distance to the static solution"
    else:
        length = " of load"
        more = f"; then as many as come within {1e3 * method.tolerance:g} mm of rest, about as many again"
    expected = forecast.expect(method, step, check, run.output_bytes)
    least = "at least " if expected.at_least else ""
    return [
        f"steps: {expected.steps}{length}, {expected.checks} stability checks{more}",
        f"loop: {least}{expected.loop_s:.3g} s on the slowest rank ({1e3 * step:.3g} ms a step, "
        f"{1e3 * check:.3g} ms a check: the fastest of {forecast.CALLS} calls on this machine)",
        f"output: {resources.told(run.output_bytes)} in {run.deck.output.frames + 1} frames",
    ]


def _kernels(calls: Sequence[Call], verbose: bool) -> list[str]:
    """A line for each kernel with the names of its arrays; with `verbose`, for each call that differs, with shapes."""
    groups: dict[tuple[str, str], list[Call]] = {}
    for call in calls:
        arrays = (f"{name} {'x'.join(map(str, a.shape))} {a.dtype}" for name, a in call.arrays.items())
        groups.setdefault((call.kernel, ", ".join(arrays) if verbose else ""), []).append(call)
    lines = []
    for (kernel, shapes), of_kernel in groups.items():
        names = shapes or " ".join(dict.fromkeys(name for call in of_kernel for name in call.arrays))
        line = f"{kernel}{_times(len(of_kernel))}, {distinct_bytes(of_kernel) / 1e6:.3g} MB: {names}"
        lines += textwrap.wrap(
            line, 118, initial_indent=4 * " ", subsequent_indent=6 * " ", break_on_hyphens=False
        )  # fmt: skip
    return lines


def _times(n: int) -> str:
    return "" if n == 1 else f" {n} times"


def _reachable_bytes(*roots: object) -> int:
    """Bytes of all arrays that objects of this package hold, each array counted once."""
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
            if is_dataclass(value):
                todo += [getattr(value, field.name) for field in fields(value)]
            elif isinstance(value, list | tuple):
                todo += value
            elif isinstance(value, dict):
                todo += value.values()
            elif type(value).__module__.startswith("mpitled"):
                todo += vars(value).values()
    return sum(arrays.values())


# --- what a run omits ----------------------------------------------------------------------------------------------
# Terms will say themselves why they are absent: then `omissions` iterates over the terms, and the tables go.


def _omitted_by_ranks(own: list[str], world: World) -> list[str]:
    """The omissions of all ranks; collective."""
    by_rank = [world.broadcast(own, rank) for rank in range(world.size)]
    lines = ["left out:"]
    for text in dict.fromkeys(text for omitted in by_rank for text in omitted):
        ranks = [str(rank) for rank, omitted in enumerate(by_rank) if text in omitted]
        lines.append(f"  {text}" + ("" if len(ranks) == world.size else f" (on rank {', '.join(ranks)})"))
    return lines


def left_out(directory: Path, metadata: Mapping[str, Any]) -> list[str]:
    """What the run in a directory omitted on rank 0, from the metadata of its result; as `dry_run` lists it."""
    deck, ranks = decks.recorded(metadata["deck"], directory), metadata["ranks"]
    sub, method = forecast.first_rank(deck, directory / job.MODEL, ranks)
    return omissions(deck, sub, ranks, witness([("all", method.warm_up)]))


def omissions(deck: Deck, sub: Subdomain, ranks: int, calls: Sequence[Call]) -> list[str]:
    """The kernels that this rank does not call and the arguments that it does not pass, each with the reason."""
    called = {call.kernel for call in calls}
    omitted: dict[str, list[str]] = {}
    for kernel, why in reasons(deck, sub, ranks).items():
        if why and kernel not in called:
            omitted.setdefault(why, []).append(kernel)
    absent: dict[str, list[str]] = {}
    for call in calls:
        for name in call.absent:
            absent.setdefault(name, []).append(call.kernel)
    for name, kernels in absent.items():
        omitted.setdefault(_ABSENT[name](deck), []).append(f"{name} of {' and '.join(dict.fromkeys(kernels))}")
    if deck.tumour is None:
        omitted.setdefault("no [tumour]: no seed, no graded cloud, no volume balance", []).append("tumour")
    if len(sub.rows.materials) == 1:
        omitted.setdefault(f"{sub.rows.materials[0].name} alone", []).append("materials")
    return [f"{', '.join(names)}: {why}" for why, names in omitted.items()]


def reasons(deck: Deck, sub: Subdomain, ranks: int) -> dict[str, str]:
    """Why each kernel is not called; "" where it may be called later in the run."""
    solver = deck.solver
    hexahedra = "no hexahedra" if sub.rows.n_own_hexahedra == 0 else ""
    voxels = hexahedra or f"no {SHORTEST_RUN} equal boxes in a row"
    general = hexahedra or f"all hexahedra are boxes, {SHORTEST_RUN} or more in a row"
    domains = "no support domains"
    alone = "one rank" if ranks == 1 else "" if sub.shared else "no node is shared"
    method = f'solver.method = "{solver.method}"'
    return {
        "voxel_forces": voxels,
        "voxel_survey": voxels,
        "hexahedron_forces": general,
        "hexahedron_survey": general,
        "domain_forces": domains,
        "domain_survey": domains,
        "follow": "no node is turned",
        "react": "no node is moved" if ranks == 1 else "no node of this rank is moved",
        "change_step": method if solver.method == "dynamic-relaxation" else "",
        "raise_mass": method if solver.method != "quasi-static" else "solver.mass_scaling = false",
        **dict.fromkeys(("update", "relax", "kinetic_energy", "keep_masses"), method),
        **dict.fromkeys(("invert_masses", "watch_relaxation"), method),
        **dict.fromkeys(("gather", "add", "add_gathered", "scatter"), alone),
        **dict.fromkeys(("scramble", "perturb", "respond"), ""),
    }


#: Why an argument of a kernel is None.
_ABSENT: dict[str, Callable[[Deck], str]] = {
    "position": lambda deck: f"support.stabilisation = {deck.support.stabilisation:g}",
    "inverse": lambda deck: f"support.stabilisation = {deck.support.stabilisation:g}",
    "mobility": lambda deck: "relaxation has no inertia where nodes are moved",
    "copied": lambda deck: f'solver.precision = "{deck.solver.precision}"',
    "tensor": lambda deck: f'solver.method = "{deck.solver.method}": masses are scalars',
}
