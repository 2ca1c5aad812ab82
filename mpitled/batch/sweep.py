"""Computing the cases of a sweep, longest first: as processes, in groups of ranks, or as a scheduler's array job."""

from __future__ import annotations

import os
import re
import secrets
import shlex
import shutil
import signal
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NoReturn

from mpitled import atomic, job, lock, store
from mpitled import deck as decks
from mpitled.batch import launch
from mpitled.batch.cases import MANIFEST, Case, Sweep, is_sweep
from mpitled.batch.screen import Screen, share_done
from mpitled.errors import InputError, InterruptedRun, MpitledError, everywhere
from mpitled.parallel.halo import World
from mpitled.solver import checkpoint

_WATCH = 0.2  # s between looks at what is at work
#: Folders of programs that are found anyway, and must not come before those of modules.
_SYSTEM = ("/bin", "/usr/bin", "/usr/local/bin")


def compute(
    sweep: Sweep, world: World, *, jobs: int = 1, retry: bool = False, only: int | None = None, quiet: bool = False
) -> None:
    """Compute what is not done yet; an error in one case does not end the others. Broken cases only with `retry`.

    On one rank `jobs` cases are at work at once, each on `sweep.ranks` ranks of its own. On many ranks groups of
    `sweep.ranks` take the cases. `only` is the number of the one case to compute, as array jobs do.
    InputError alike on all ranks if the numbers do not fit each other, or if a case is left to another process that is
    at work on it; InterruptedRun if it is ended from outside.
    """
    with everywhere():
        if world.size > 1 and world.size % sweep.ranks:
            raise InputError(f"--ranks {sweep.ranks}: {world.size} ranks are no whole groups of it; start a multiple")
        if only is not None and world.started and world.size != sweep.ranks:
            raise InputError(
                f"--only {only}: has {_count(sweep.ranks, 'rank')} a case, and {world.size} started; start as many, or "
                "write the array job anew with --scheduler"
            )
        if only is not None and not 0 < only <= len(sweep.cases):
            raise InputError(f"--only {only}: there are {len(sweep.cases)} cases; count them from 1")
    cases = [case for case in sweep.runs if only is None or case.number == only]
    with _alone(sweep, world, only):
        token = world.broadcast(secrets.token_hex(4))
        todo = world.on_leader(lambda: [case.number for case in _to_do(cases, retry)])
        todo = [case for case in cases if case.number in todo]
        todo.sort(key=lambda case: -case.work)
        first = {case.model: case for case in todo if case.shares and not _is_built(case, sweep.ranks)}
        models = [] if only else list(first.values())
        if world.leads and todo and not quiet:
            _begin(sweep, cases, len(todo), world.size // sweep.ranks if world.size > 1 else jobs)
        if world.size > 1:
            _in_groups(sweep, models, todo, world, sweep.folder / f".claims-{token}", Screen(quiet))
        else:
            _as_processes(sweep, models, todo, jobs, Screen(quiet))
        world.on_leader(lambda: _refuse_to_wait(todo))


def _refuse_to_wait(todo: Sequence[Case]) -> None:
    """InputError if a case was left to another process and is not done yet."""
    if left := [case for case in todo if case.failure is None]:
        raise InputError(f"{left[0].folder}: another run is at work there; give the command again when it has ended")


def _begin(sweep: Sweep, cases: Sequence[Case], n_open: int, at_once: int) -> None:
    """Say what is about to be computed, and where to look on."""
    before = f", {len(cases) - n_open} of them done before" if n_open < len(cases) else ""
    logs = sweep.folder / (cases[0].folder.name if len(cases) == 1 else "*") / launch.LOG
    plan = f"{_count(len(cases), 'case')}{before}, {min(at_once, n_open)} at a time"
    print(f"{plan}; logs in {logs}", file=sys.stderr, flush=True)


def _to_do(cases: Sequence[Case], retry: bool) -> list[Case]:
    """Cases that have not ended, or (retry) are broken: these are open again from now on."""
    todo = [case for case in cases if case.failure is None or (retry and case.failure)]
    for case in todo:
        if case.failure:
            with atomic.writing(case.folder / launch.DONE):
                (case.folder / launch.DONE).unlink()
    return todo


def _is_built(case: Case, ranks: int) -> bool:
    path = case.model / job.MODEL
    return path.exists() and store.has_partition(path, ranks)


@contextmanager
def _alone(sweep: Sweep, world: World, only: int | None) -> Iterator[None]:
    """The folder for this sweep alone, if its file system has locks; tasks of an array job are at work together."""
    with ExitStack() as alone:

        def begin() -> None:
            if only is not None and is_sweep(sweep.folder):
                return  # other tasks read the manifest
            alone.enter_context(lock.held(sweep.folder, lock.RUN, "sweep"))
            sweep.write_manifest()
            for stale in sweep.folder.glob(".claims-*"):
                shutil.rmtree(stale, ignore_errors=True)

        world.on_leader(begin)
        yield


# --- on a workstation ----------------------------------------------------------------------------------------------


def _as_processes(sweep: Sweep, models: Sequence[Case], todo: Sequence[Case], jobs: int, screen: Screen) -> None:
    """A process for each case, so many at once; first the models that several cases share."""
    working = dict[Case, launch.Process]()
    alone = {case: ExitStack() for case in todo}
    ends = (signal.SIGTERM, signal.SIGUSR1)
    previous = [signal.signal(which, signal.default_int_handler) for which in ends]
    try:
        for verb, cases in (("build", models), ("run", todo)):
            waiting = list(cases)
            while waiting or working:
                while waiting and len(working) < jobs:
                    case = waiting.pop(0)
                    if verb == "build":
                        launch.prepare(case.model)
                        working[case] = _start(sweep, case, verb, case.model)
                        screen.tell(f"model of case {case.number} and others")
                    elif (resume := _prepare(case, alone[case])) is not None:
                        working[case] = _start(sweep, case, verb, case.folder, resume)
                    else:
                        alone[case].close()
                for process in list(working.values())[:1]:
                    process.ended(_WATCH)
                for case in [case for case, process in working.items() if process.ended(0)]:
                    process = working.pop(case)
                    # What a model lacks is said by the cases that cannot build it either.
                    if verb == "run" and not process.failure.endswith(lock.REMEDY):
                        _end(sweep, case, process.failure, screen)
                    alone[case].close()
                shares = {case.words: share_done(launch.said(process.folder)) for case, process in working.items()}
                screen.show(shares, len(waiting))
    except KeyboardInterrupt:
        done = sum(case.failure is not None for case in sweep.runs)
        raise InterruptedRun(f"interrupted at {done} of {len(sweep.runs)} cases; the same command goes on") from None
    finally:
        for process in working.values():
            process.stop()
        for held in alone.values():
            held.close()
        for which, handler in zip(ends, previous, strict=True):
            signal.signal(which, handler)


def _start(sweep: Sweep, case: Case, verb: str, folder: Path, resume: bool = False) -> launch.Process:
    return launch.Process(launch.command(verb, sweep.deck, case.overrides, sweep.ranks, folder, resume), folder)


def _prepare(case: Case, alone: ExitStack) -> bool | None:
    """Make a case's folder ready, and its own until `alone` is closed; whether it goes on from a checkpoint in it.

    None if the case is another process's, which is at work on it or has ended by now.
    """
    try:
        alone.enter_context(lock.held(case.folder, lock.TASK))
        if case.failure is not None:
            return None
        try:
            if checkpoint.find(case.folder, case.deck, decks.model_key(case.deck, job.included(case.deck))):
                return True
        except InputError:  # of another program or model, or damaged: begun anew
            pass
        launch.prepare(case.folder, case.model / job.MODEL if case.shares else None)
    except lock.Taken:
        return None
    return False


def _end(sweep: Sweep, case: Case, failure: str, screen: Screen) -> None:
    launch.record(case.folder, failure, program=decks.program())
    done = sum(case.failure is not None for case in sweep.runs)  # of all groups
    broken = f": broken: {failure}" if failure else ""
    screen.tell(f"[{done} of {len(sweep.runs)} done] {case.words}{broken}", not failure)


# --- in groups of ranks --------------------------------------------------------------------------------------------


def _in_groups(
    sweep: Sweep, models: Sequence[Case], todo: Sequence[Case], world: World, claims: Path, screen: Screen
) -> None:
    """Each group takes the first case in the queue that no other has taken, until there is none."""
    group = world.split(sweep.ranks)
    world.on_leader(lambda: claims.mkdir())
    for case in models:
        if group.leads and _claim(claims / case.model.name):
            _build(sweep, case)
    world.barrier()
    for case in todo:
        with ExitStack() as alone:
            mine = group.leads and _claim(claims / case.folder.name)
            resume = group.broadcast(_prepare(case, alone) if mine else None)
            if resume is not None:
                _run(sweep, case, group, screen, world, resume)
    world.barrier()
    world.on_leader(lambda: shutil.rmtree(claims, ignore_errors=True))


def _claim(path: Path) -> bool:
    """Whether this group is the first that asks; where ranks share a disc, they share this too."""
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def _build(sweep: Sweep, case: Case) -> None:
    """The model that several cases share; what it lacks is said by the cases that cannot build it either."""
    try:
        path, _ = job.build(case.deck, case.model)
        job.ensure_partition(path, sweep.ranks, case.deck.partition.seed)
    except Exception:
        pass


def _run(sweep: Sweep, case: Case, group: World, screen: Screen, world: World, resume: bool) -> None:
    """Compute a case on a group's ranks; its error ends the case alone if all of the group know of it."""
    failure = ""
    with _logged(case.folder / launch.LOG if group.leads else Path(os.devnull)):
        try:
            job.run(case.deck, case.folder, group, resume=resume)
        except InterruptedRun as error:
            _abandon(world, error)
        except lock.Taken:
            return
        except Exception as error:
            if not isinstance(error, MpitledError):
                traceback.print_exc()
            failure = str(error) or type(error).__name__
            if group.size > 1 and not getattr(error, "everywhere", False):
                # The others of the group wait for this rank, and nothing brings them back: the sweep has to go on anew.
                launch.record(case.folder, f"rank {group.rank}: {failure}", program=decks.program())
                _abandon(world, error)
    if group.leads:
        _end(sweep, case, failure, screen)


def _abandon(world: World, error: Exception) -> NoReturn:
    os.write(2, f"mpitled: {error}; the same command goes on with the other cases\n".encode())
    world.abort(getattr(error, "status", 1))


@contextmanager
def _logged(path: Path) -> Iterator[None]:
    with path.open("w") as log, redirect_stdout(log), redirect_stderr(log):
        yield


# --- as a scheduler's array job ------------------------------------------------------------------------------------


def array_job(sweep: Sweep, scheduler: str) -> Path:
    """A script that computes each case as a task of an array job of SLURM or PBS; time and queue are the user's.

    InputError if the scheduler cannot be told of the sweep's folder.
    """
    n, ranks, folder = len(sweep.cases), sweep.ranks, sweep.folder.resolve()
    logs = _logs(folder, scheduler)
    manifest = sweep.folder / MANIFEST
    before = manifest.read_bytes() if manifest.exists() else b""
    sweep.write_manifest()
    with atomic.writing(folder):
        if manifest.read_bytes() != before:  # another scheduler's script is of other cases or ranks
            for path in (folder / "slurm.sh", folder / "pbs.sh"):
                path.unlink(missing_ok=True)
    name = re.sub("[^A-Za-z0-9]", "_", folder.name)[:15].lstrip("_0123456789") or "sweep"  # as PBS takes it
    words = f"mpitled sweep {shlex.quote(str(folder))} --only"
    if scheduler == "slurm":
        head = [
            f"#SBATCH --job-name={name}",
            f"#SBATCH --array=1-{n}",
            f"#SBATCH --ntasks={ranks}",
            "#SBATCH --cpus-per-task=1",
            "#SBATCH --hint=nomultithread",
            "#SBATCH --time=01:00:00",
            "#SBATCH --signal=B:USR1@120",
            logs,
        ]
        body = [
            "launch=(srun --mpi=pmix)",
            f"command -v srun >/dev/null || launch=(mpirun -n {ranks})",
            f'"${{launch[@]}}" {words} "$SLURM_ARRAY_TASK_ID" &',
            "job=$!",
            "trap 'kill -USR1 \"$job\"' USR1",
            "status=0",
            'wait "$job" || status=$?',
            '[ "$status" -le 128 ] || { status=0 && wait "$job" || status=$?; }',
            'exit "$status"',
        ]
    else:
        head = [f"#PBS -N {name}", "#PBS -j oe"]
        head += [f"#PBS -l select=1:ncpus={ranks}:mpiprocs={ranks}", "#PBS -l walltime=01:00:00", logs]
        head += [f"#PBS -J 1-{n}"] if n > 1 else []  # PBS refuses arrays of one
        body = [
            "# Two minutes less than the walltime, in seconds: PBS gives no notice.",
            'timeout --signal=USR1 --preserve-status "${RUN_SECONDS:-3480}" \\',
            f'    mpirun -n {ranks} {words} "${{PBS_ARRAY_INDEX:-1}}"',
        ]
    script = [
        "#!/usr/bin/env bash",
        *head,
        f"# {_count(n, 'case')}, each on {_count(ranks, 'rank')}; set the time that the longest takes, and your queue.",
        "# What its time cuts off goes on from its checkpoint when this is submitted again, and what is done stays.",
        f"# Afterwards: mpitled report {shlex.quote(str(folder))}",
        "set -euo pipefail",
        f"cd {shlex.quote(str(Path.cwd()))}",
        "# module load openmpi hdf5",
        *_environment(),
        "export OMP_NUM_THREADS=1",
        *body,
    ]
    path = sweep.folder / f"{scheduler}.sh"
    atomic.write_text(path, "\n".join(script) + "\n")
    with atomic.writing(path):
        path.chmod(0o755)
    return path


def _logs(folder: Path, scheduler: str) -> str:
    """The line that puts the tasks' logs into a folder; InputError if there is no way to write its path in one."""
    text = str(folder)
    if not re.fullmatch(r"[^\n\"'\\]+" if scheduler == "slurm" else r"[^\s\"'\\:,]+", text):
        raise InputError(
            f"{folder}: {scheduler} takes no such path for its logs; give an --out without blanks and quotes"
        )
    if scheduler == "pbs":
        return f"#PBS -o {text}"
    path = text.replace("%", "%%") + "/slurm-%A_%a.log"  # a job of its own when it is submitted again
    return f'#SBATCH --output="{path}"' if re.search(r"\s", text) else f"#SBATCH --output={path}"


def _environment() -> list[str]:
    """Lines that lead to this program: its clone's set-up if there is one, and its folder."""
    clones = (Path.cwd(), Path(sys.prefix).parent)
    setup = [path for clone in clones if (path := clone / "jobs" / "environment.sh").is_file()]
    here = Path(sys.executable).parent
    if not (here / "mpitled").exists() and (found := shutil.which("mpitled")):
        here = Path(found).resolve().parent
    lines = [f". {shlex.quote(str(path))}" for path in setup[:1]]
    return lines + ([f"export PATH={shlex.quote(str(here))}:$PATH"] if str(here) not in _SYSTEM else [])


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"
