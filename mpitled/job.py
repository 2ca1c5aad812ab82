"""From a deck to a result: rank 0 builds and partitions the model, then all ranks run it."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import partition
from mpitled import atomic, lock, store
from mpitled import deck as decks
from mpitled.deck import Deck
from mpitled.errors import InputError, MpitledError, UnstableError, everywhere
from mpitled.model import WARNING
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import PRECISIONS, cell_costs, localise
from mpitled.solver import checkpoint
from mpitled.solver.progress import Interrupts, Phases
from mpitled.solver.run import Run

MODEL = "model.h5"
#: State of a run whose result is complete.
DONE = "done"


def build(deck: Deck, directory: Path, quiet: bool = True) -> tuple[Path, bool]:
    """The model of a deck in directory/model.h5, which the same deck reuses; whether it had to be built."""
    path = directory / MODEL
    key = decks.model_key(deck, included(deck))
    if store.model_key(path) == key:
        try:
            store.check_model(path)
            return path, False
        except InputError as error:
            print(f"note: {error}; it is built anew", file=sys.stderr, flush=True)
    atomic.make_folder(directory)
    from mpitled.model import build as model_build  # only the rank that builds needs the mesh generators

    if not quiet:
        print("note: building the model", file=sys.stderr, flush=True)
    store.write_model(path, model_build.build(deck), key, decks.canonical(deck))
    return path, True


def included(deck: Deck) -> list[Path]:
    """Files that the files of the deck include."""
    if not deck.mesh:
        return []
    from mpitled.readers import meshes

    return meshes.files(deck.mesh)


def divide(path: Path, n_parts: int, seed: int) -> str:
    """Partition a model into n_parts, stored in its file under that number; a table of the parts."""
    cells = store.read_blocks(path)
    costs = cell_costs(store.read_points(path), cells)
    blocks = [partition.Block(block.nodes, block.kind.faces, block.columns.get("points")) for block in cells]
    graph = partition.cell_graph(blocks)
    try:
        part = partition.cut(graph, n_parts, costs, seed)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    tables = partition.tables(blocks, part, n_parts)
    store.write_partition(path, tables)
    return partition.figures(tables, costs, {block.name: len(block) for block in cells}, graph).describe()


def run(deck: Deck, directory: Path, world: World, *, quiet: bool = False, resume: bool = False) -> dict[str, Any]:
    """Compute a deck on all ranks; writes model.h5, result.vtkhdf, report.json and pictures into the directory.

    With `resume` the run continues from the last checkpoint in the directory, on any number of ranks. If the result is
    complete, only its report is made; if there is neither, the run starts from the beginning. Without `resume` the run
    refuses to overwrite a checkpoint, of this run or another, because it may hold days of work. It also refuses a
    directory in which another run is active.

    The report, on every rank. InputError, UnstableError or InterruptedRun alike on all ranks.
    """
    with Interrupts(world) as interrupts, ExitStack() as alone:
        world.on_leader(lambda: alone.enter_context(lock.directory_lock(directory, lock.RUN)))
        found = world.on_leader(lambda: _resumable(deck, directory) if resume else _refuse_to_lose(deck, directory))
        if found == DONE:
            if world.leads and not quiet:
                text = "is complete already, and only its report is made; without --resume it is computed anew"
                print(f"note: {directory}: {text}", file=sys.stderr, flush=True)
            return _report(directory, world)
        run = prepare(deck, directory, world, quiet=quiet, found=found)
        try:
            seconds = run.run(interrupts)
        except MpitledError as error:
            if error.everywhere:
                run.free()
                if isinstance(error, UnstableError):  # a resumed run would fail again
                    world.on_leader(lambda: store.discard_checkpoints(directory))
            raise
        run.free()
        with run.phases("report"):
            return _report(directory, world, seconds)


def _report(directory: Path, world: World, seconds: Mapping[str, float] | None = None) -> dict[str, Any]:
    """The report of a complete run; removes its checkpoints."""
    from mpitled.results import report

    def write() -> dict[str, Any]:
        store.discard_checkpoints(directory)
        if seconds is not None:  # the result replaced another one
            with atomic.writing(directory / report.PAGE):
                (directory / report.PAGE).unlink(missing_ok=True)
        return report.write(directory, seconds)

    return dict(world.on_leader(write))


def _resumable(deck: Deck, directory: Path) -> checkpoint.Found | str | None:
    """The checkpoint to resume; DONE if only the report may be missing; None for a new run. Prints notes."""
    key = decks.model_key(deck, included(deck))
    if checkpoint.is_done(directory, deck, key):
        return DONE
    found = checkpoint.find(directory, deck, key)
    if found is None:
        print(f"note: {directory}: holds no checkpoint; the run begins at the start", file=sys.stderr, flush=True)
    elif found.damaged:
        print(f"note: {found.damaged}; the run goes on from {found.path.name}", file=sys.stderr, flush=True)
    return found


def _refuse_to_lose(deck: Deck, directory: Path) -> None:
    """InputError if the directory has a checkpoint, of this run or another."""
    found = checkpoint.newest(directory)
    if found is None:
        return
    if other := checkpoint.other(found.contents, deck, decks.model_key(deck, included(deck))):
        raise InputError(
            f"{found.path}: holds a run {checkpoint.reached(found.contents)} that {other}; give this one another "
            "folder with --out, or remove the file"
        )
    raise InputError(
        f"{found.path}: holds this very run {checkpoint.reached(found.contents)}; go on from there with --resume, or "
        "remove the file to begin anew"
    )


def prepare(
    deck: Deck, directory: Path, world: World, *, quiet: bool = False, found: checkpoint.Found | None = None
) -> Run:
    """Everything before the first step of `run`: model, partition, the part of this rank, and the composed step."""
    phases = Phases()
    with phases("model"):
        path = world.on_leader(lambda: build(deck, directory, quiet)[0])
    if world.leads and not quiet:
        for remark in store.read_remarks(path):
            print(remark if remark.startswith(WARNING) else f"note: {remark}", file=sys.stderr, flush=True)
    with phases("partition"):
        if world.size > 1:
            world.on_leader(lambda: ensure_partition(path, world.size, deck.partition.seed, quiet))
        mark = world.on_leader(lambda: store.partition_mark(path, world.size))
    with everywhere():
        if found and found.contents["ranks"] == world.size and found.contents["partition"] != mark:
            raise InputError(
                f"{found.path}: was written for another partition in {world.size} parts; partition the model with the "
                "seed that it had, go on with another number of ranks, or begin anew without --resume"
            )
    with phases("read"):
        rows = store.read_part(path, world.size, world.rank)
        rule = deck.hexahedra.gradient
        sub = localise(
            rows, deck.hexahedra.hourglass, deck.support.stabilisation, rule, PRECISIONS[deck.solver.precision]
        )
        figures = store.read_figures(path)
    with everywhere():
        about = checkpoint.marks(deck, store.model_key(path) or "") | {"ranks": world.size, "partition": mark}
        return Run(deck, directory, world, sub, figures, phases, quiet, about, found)


def ensure_partition(path: Path, n_parts: int, seed: int, quiet: bool = True) -> None:
    """Partition a model unless it has a partition into so many parts."""
    if not store.has_partition(path, n_parts):
        divide(path, n_parts, seed)
        if not quiet:
            print(f"note: the model is cut in {n_parts} parts", file=sys.stderr, flush=True)
