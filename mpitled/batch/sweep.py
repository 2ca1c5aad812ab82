"""Compute the cases of a sweep, longest first: a process for each case, or groups of the ranks of one MPI job."""

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
    """Compute the cases that are not completed; a broken case does not stop the sweep. Collective.

    On one rank `jobs` cases run at once, each in a process on `sweep.ranks` ranks. Several ranks form groups of
    `sweep.ranks`, and each group computes one case after another. retry: also compute broken cases again. only: number
    of the only case to compute. InputError on all ranks if ranks, `only` and the sweep do not fit each other, or if
    another process computes a case; InterruptedRun on a signal.
    """
    with everywhere():
        if world.size > 1 and world.size % sweep.ranks:
            raise InputError(f"--ranks {sweep.ranks}: {world.size} ranks are not a multiple; start a multiple")
        if only is not None and world.started and world.size != sweep.ranks:
            raise InputError(
                f"--only {only}: a case has {count(sweep.ranks, 'rank')}, and {world.size} started; start as many, or "
                "write the array job again with --scheduler"
            )
        if only is not None and not 0 < only <= len(sweep.cases):
            raise InputError(f"--only {only}: there are {len(sweep.cases)} cases; count them from 1")
    cases = [case for case in sweep.runs if only is None or case.number == only]
    with _locked(sweep, world, only):
        token = world.broadcast(secrets.token_hex(4))
        unfinished = world.on_leader(lambda: [case.number for case in _reopen(cases, retry)])
        queue = sorted((case for case in cases if case.number in unfinished), key=lambda case: -case.work)
        shared = {case.model: case for case in queue if case.shares_model and not _has_model(case, sweep.ranks)}
        models = [] if only else list(shared.values())
        screen = Screen(quiet)
        if world.leads and queue:
            before = f", {len(cases) - len(queue)} of them completed before" if len(queue) < len(cases) else ""
            at_once = min(world.size // sweep.ranks if world.size > 1 else jobs, len(queue))
            logs = sweep.folder / (cases[0].folder.name if len(cases) == 1 else "*") / launch.LOG
            screen.print(f"{count(len(cases), 'case')}{before}, {at_once} at a time; logs in {logs}")
        if world.size > 1:
            _in_groups(sweep, models, queue, world, sweep.folder / f".claims-{token}", screen)
        else:
            _in_processes(sweep, models, queue, jobs, screen)
        world.on_leader(lambda: _check_ended(queue))


def _check_ended(queue: Sequence[Case]) -> None:
    """InputError if another process computes a case."""
    if missing := [case for case in queue if case.failure is None]:
        raise InputError(f"{missing[0].folder}: another run is at work there; repeat the command after its end")


def _reopen(cases: Sequence[Case], retry: bool) -> list[Case]:
    """The cases that have not ended and, with `retry`, the broken cases, after their records are removed."""
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
    """Write the manifest and lock the folder. The tasks of an array job share the folder without a lock."""
    with ExitStack() as stack:

        def begin() -> None:
            if only is not None and is_sweep(sweep.folder):
                return  # because other tasks read the manifest
            stack.enter_context(lock.directory_lock(sweep.folder, lock.RUN, "sweep"))
            sweep.write_manifest()
            for stale in sweep.folder.glob(".claims-*"):
                shutil.rmtree(stale, ignore_errors=True)

        world.on_leader(begin)
        yield


def _prepare(case: Case, locks: ExitStack) -> bool | None:
    """Lock the folder of a case, and empty it unless it holds a checkpoint. Returns whether the run can resume.

    None if another process computes the case, or has completed it.
    """
    try:
        locks.enter_context(lock.directory_lock(case.folder, lock.TASK))
        if case.failure is not None:
            return None
        try:
            if checkpoint.find(case.folder, case.deck, decks.model_key(case.deck, job.included(case.deck))):
                return True
        except InputError:  # another version or model wrote the checkpoint, or it is damaged: start again
            pass
        launch.prepare(case.folder, case.model / job.MODEL if case.shares_model else None)
    except lock.LockError:
        return None
    return False


def _end(sweep: Sweep, case: Case, failure: str, screen: Screen) -> None:
    """Record and print the outcome of a case."""
    launch.record(case.folder, failure, program=decks.program())
    done = sum(case.failure is not None for case in sweep.runs)  # of all groups
    broken = f": broken: {failure}" if failure else ""
    screen.print(f"[{done} of {len(sweep.runs)} done] {case.label}{broken}", "red" if failure else "green")


# --- in processes --------------------------------------------------------------------------------------------------


def _in_processes(sweep: Sweep, models: Sequence[Case], queue: Sequence[Case], jobs: int, screen: Screen) -> None:
    """First build the models that several cases share, then run the cases, with at most `jobs` processes at once."""
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
                        screen.print(f"model of case {case.number} and further cases")
                    elif (resume := _prepare(case, locks[case])) is not None:
                        start(case, verb, case.folder, resume)
                    else:
                        locks[case].close()
                for process in list(running.values())[:1]:
                    process.ended(_POLL)
                for case in [case for case, process in running.items() if process.ended(0)]:
                    process = running.pop(case)
                    # An error in the model is reported by the run of the case.
                    if verb == "run" and not process.failure.endswith(lock.REMEDY):
                        _end(sweep, case, process.failure, screen)
                    locks[case].close()
                shares = {case.label: share_done(launch.log_lines(p.folder)) for case, p in running.items()}
                screen.show(shares, len(waiting))
    except KeyboardInterrupt:
        done = sum(case.failure is not None for case in sweep.runs)
        message = f"interrupted after {done} of {len(sweep.runs)} cases; repeat the command to resume"
        raise InterruptedRun(message) from None
    finally:
        screen.show({}, 0)
        for process in running.values():
            process.stop()
        for lock_of_case in locks.values():
            lock_of_case.close()
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
            except Exception:  # the run of the case reports the error
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
    """Whether this group is the first that creates the file. It needs no locks of the file system."""
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def _run(sweep: Sweep, case: Case, group: World, screen: Screen, world: World, resume: bool) -> None:
    """Run a case on the ranks of a group. An error on all ranks of the group ends this case only."""
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
                # The other ranks of the group wait for this rank: only an abort ends them.
                launch.record(case.folder, f"rank {group.rank}: {failure}", program=decks.program())
                _abort(world, error)
    if group.leads:
        _end(sweep, case, failure, screen)


def _abort(world: World, error: Exception) -> NoReturn:
    os.write(2, f"mpitled: {error}; repeat the command to compute the other cases\n".encode())
    world.abort(getattr(error, "status", 1))
