"""Compute the cases of a sweep, longest first: in a process each, or in groups of the ranks of one MPI job."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NoReturn

from mpitled import atomic, job, lock, store
from mpitled import deck as decks
from mpitled.batch import launch
from mpitled.batch.array_job import count
from mpitled.batch.cases import Case, Sweep, is_sweep
from mpitled.batch.terminal import Screen, share_done
from mpitled.errors import InputError, InterruptedRun, MpitledError, everywhere
from mpitled.parallel.halo import World
from mpitled.solver import checkpoint

_POLL = 0.2  # s between two checks of the running processes


def compute(
    sweep: Sweep, world: World, *, jobs: int = 1, retry: bool = False, only: int | None = None, quiet: bool = False
) -> None:
    """Compute the cases that are not completed; a broken case, which `retry` computes again, does not end the others.

    On one rank `jobs` cases run at once, each on `sweep.ranks` ranks of its own. Several ranks form groups of
    `sweep.ranks`, which take the cases in turn. `only` is the number of the one case to compute.
    InputError on all ranks if the numbers do not fit each other, or if another process is at work on a case;
    InterruptedRun on a signal.
    """
    with everywhere():
        if world.size > 1 and world.size % sweep.ranks:
            raise InputError(f"--ranks {sweep.ranks}: {world.size} ranks are no multiple of it; start a multiple")
        if only is not None and world.started and world.size != sweep.ranks:
            raise InputError(
                f"--only {only}: has {count(sweep.ranks, 'rank')} a case, and {world.size} started; start as many, or "
                "write the array job anew with --scheduler"
            )
        if only is not None and not 0 < only <= len(sweep.cases):
            raise InputError(f"--only {only}: there are {len(sweep.cases)} cases; count them from 1")
    cases = [case for case in sweep.runs if only is None or case.number == only]
    with _locked(sweep, world, only):
        token = world.broadcast(secrets.token_hex(4))
        unfinished = world.on_leader(lambda: [case.number for case in _reopen(cases, retry)])
        queue = sorted((case for case in cases if case.number in unfinished), key=lambda case: -case.work)
        first = {case.model: case for case in queue if case.shares_model and not _has_model(case, sweep.ranks)}
        models = [] if only else list(first.values())
        screen = Screen(quiet)
        if world.leads and queue:
            before = f", {len(cases) - len(queue)} of them done before" if len(queue) < len(cases) else ""
            at_once = min(world.size // sweep.ranks if world.size > 1 else jobs, len(queue))
            logs = sweep.folder / (cases[0].folder.name if len(cases) == 1 else "*") / launch.LOG
            screen.print(f"{count(len(cases), 'case')}{before}, {at_once} at a time; logs in {logs}")
        if world.size > 1:
            _in_groups(sweep, models, queue, world, sweep.folder / f".claims-{token}", screen)
        else:
            _in_processes(sweep, models, queue, jobs, screen)
        world.on_leader(lambda: _check_ended(queue))


def _check_ended(queue: Sequence[Case]) -> None:
    """InputError if another process is at work on a case."""
    if missing := [case for case in queue if case.failure is None]:
        raise InputError(f"{missing[0].folder}: another run is at work there; give the command again when it has ended")


def _reopen(cases: Sequence[Case], retry: bool) -> list[Case]:
    """The cases that have not ended, and with `retry` the broken ones, whose records are removed."""
    queue = [case for case in cases if case.failure is None or (retry and case.failure)]
    for case in queue:
        done = case.folder / launch.DONE
        with atomic.writing(done):
            done.unlink(missing_ok=True)
    return queue


def _has_model(case: Case, ranks: int) -> bool:
    path = case.model / job.MODEL
    return path.exists() and store.has_partition(path, ranks)


@contextmanager
def _locked(sweep: Sweep, world: World, only: int | None) -> Iterator[None]:
    """Write the manifest and lock the folder; the tasks of an array job share the folder instead."""
    with ExitStack() as stack:

        def begin() -> None:
            if only is not None and is_sweep(sweep.folder):
                return  # other tasks read the manifest
            stack.enter_context(lock.directory_lock(sweep.folder, lock.RUN, "sweep"))
            sweep.write_manifest()
            for stale in sweep.folder.glob(".claims-*"):
                shutil.rmtree(stale, ignore_errors=True)

        world.on_leader(begin)
        yield


def _prepare(case: Case, locks: ExitStack) -> bool | None:
    """Lock and empty the folder of a case, unless it holds a checkpoint; whether the run resumes from a checkpoint.

    None if another process is at work on the case, or has completed the case.
    """
    try:
        locks.enter_context(lock.directory_lock(case.folder, lock.TASK))
        if case.failure is not None:
            return None
        try:
            if checkpoint.find(case.folder, case.deck, decks.model_key(case.deck, job.included(case.deck))):
                return True
        except InputError:  # the checkpoint is of another program or model, or damaged: start again
            pass
        launch.prepare(case.folder, case.model / job.MODEL if case.shares_model else None)
    except lock.LockError:
        return None
    return False


def _end(sweep: Sweep, case: Case, failure: str, screen: Screen) -> None:
    """Record and print how a case ended."""
    launch.record(case.folder, failure, program=decks.program())
    done = sum(case.failure is not None for case in sweep.runs)  # by all groups
    broken = f": broken: {failure}" if failure else ""
    screen.print(f"[{done} of {len(sweep.runs)} done] {case.label}{broken}", "red" if failure else "green")


# --- in processes --------------------------------------------------------------------------------------------------


def _in_processes(sweep: Sweep, models: Sequence[Case], queue: Sequence[Case], jobs: int, screen: Screen) -> None:
    """First build the models that several cases share, then run the cases; `jobs` processes at once."""
    running = dict[Case, launch.Process]()
    locks = {case: ExitStack() for case in queue}
    signals = (signal.SIGTERM, signal.SIGUSR1)
    previous = [signal.signal(which, signal.default_int_handler) for which in signals]

    def start(case: Case, verb: str, folder: Path, resume: bool = False) -> None:
        words = launch.command(verb, sweep.deck, case.overrides, sweep.ranks, folder, resume)
        running[case] = launch.Process(words, folder)

    try:
        for verb, cases in (("build", models), ("run", queue)):
            waiting = list(cases)
            while waiting or running:
                while waiting and len(running) < jobs:
                    case = waiting.pop(0)
                    if verb == "build":
                        launch.prepare(case.model)
                        start(case, verb, case.model)
                        screen.print(f"model of case {case.number} and others")
                    elif (resume := _prepare(case, locks[case])) is not None:
                        start(case, verb, case.folder, resume)
                    else:
                        locks[case].close()
                for process in list(running.values())[:1]:
                    process.ended(_POLL)
                for case in [case for case, process in running.items() if process.ended(0)]:
                    process = running.pop(case)
                    # The run of a case reports an error of its model again.
                    if verb == "run" and not process.failure.endswith(lock.REMEDY):
                        _end(sweep, case, process.failure, screen)
                    locks[case].close()
                shares = {case.label: share_done(launch.log_lines(p.folder)) for case, p in running.items()}
                screen.show(shares, len(waiting))
    except KeyboardInterrupt:
        done = sum(case.failure is not None for case in sweep.runs)
        message = f"interrupted at {done} of {len(sweep.runs)} cases; give the same command to resume"
        raise InterruptedRun(message) from None
    finally:
        screen.show({}, 0)
        for process in running.values():
            process.stop()
        for held in locks.values():
            held.close()
        for which, handler in zip(signals, previous, strict=True):
            signal.signal(which, handler)


# --- in groups of ranks --------------------------------------------------------------------------------------------


def _in_groups(
    sweep: Sweep, models: Sequence[Case], queue: Sequence[Case], world: World, claims: Path, screen: Screen
) -> None:
    """Each group of ranks computes the next case that no other group has claimed."""
    group = world.split(sweep.ranks)
    world.on_leader(lambda: claims.mkdir())
    for case in models:
        if group.leads and _claim(claims / case.model.name):
            try:
                path, _ = job.build(case.deck, case.model)
                job.ensure_partition(path, sweep.ranks, case.deck.partition.seed)
            except Exception:  # the run of a case reports the error again
                pass
    world.barrier()
    for case in queue:
        with ExitStack() as locks:
            claimed = group.leads and _claim(claims / case.folder.name)
            resume = group.broadcast(_prepare(case, locks) if claimed else None)
            if resume is not None:
                _run(sweep, case, group, screen, world, resume)
    world.barrier()
    world.on_leader(lambda: shutil.rmtree(claims, ignore_errors=True))


def _claim(path: Path) -> bool:
    """Whether this group is the first to create the file, also on file systems without locks."""
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def _run(sweep: Sweep, case: Case, group: World, screen: Screen, world: World, resume: bool) -> None:
    """Run a case on the ranks of a group. An error that all ranks of the group raise ends this case only."""
    failure = ""
    path = case.folder / launch.LOG if group.leads else Path(os.devnull)
    with path.open("w") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            job.run(case.deck, case.folder, group, resume=resume)
        except InterruptedRun as error:
            _abort(world, error)
        except lock.LockError:
            return
        except Exception as error:
            if not isinstance(error, MpitledError):
                traceback.print_exc()
            failure = str(error) or type(error).__name__
            if group.size > 1 and not getattr(error, "everywhere", False):
                # The other ranks of the group wait for this one: only an abort ends them.
                launch.record(case.folder, f"rank {group.rank}: {failure}", program=decks.program())
                _abort(world, error)
    if group.leads:
        _end(sweep, case, failure, screen)


def _abort(world: World, error: Exception) -> NoReturn:
    os.write(2, f"mpitled: {error}; give the same command to compute the other cases\n".encode())
    world.abort(getattr(error, "status", 1))
