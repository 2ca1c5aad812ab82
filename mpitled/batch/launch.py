"""A run of a deck as a process of its own, or as ranks of their own: what studies and sweeps are made of."""

from __future__ import annotations

import ctypes
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from mpitled import atomic, lock

#: Says in a run's folder that it ended, and how.
DONE = "done.json"
#: What a run says, in its folder.
LOG = "run.log"
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of Linux's prctl


def ranked(ranks: int) -> list[str]:
    """The words that start so many ranks; none for one."""
    return ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks)] if ranks > 1 else []


def command(
    verb: str, deck: Path, overrides: Sequence[str], ranks: int, folder: Path, resume: bool = False
) -> list[str]:
    """What runs or builds (verb) a deck with overrides ("section.key=value") into a folder, or goes on with a run."""
    words = [sys.executable, "-m", "mpitled", verb, str(deck), "--out", str(folder)]
    words += [word for override in overrides for word in ("--set", override)]
    if verb == "build":
        return [*words, "--ranks", str(ranks)]
    return [*ranked(ranks), *words, *(["--resume"] if resume else [])]


class Process:
    """A command at work in a folder of its own, where the log is what it says. It ends when this process is killed."""

    def __init__(self, words: Sequence[str], folder: Path, longest: int | None = None) -> None:
        """In a folder that is there. Computing for longer (s) than that, it is killed."""
        self.folder = folder
        # mpirun takes its ranks along when it is asked to end, and only then.
        last = signal.SIGTERM if words[0] == "mpirun" else signal.SIGKILL
        with atomic.writing(folder / LOG), (folder / LOG).open("wb") as log:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                preexec_fn=lambda: _prepare(last, longest),
            )

    def ended(self, seconds: float | None = None) -> bool:
        """Whether it ended, now or (None: however long it takes) within so many seconds."""
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        return True

    @property
    def status(self) -> int:
        """Its exit status, or minus the signal that killed it. It has to have ended."""
        return int(self._process.returncode)

    @property
    def failure(self) -> str:
        """Why it failed; "" if it did not. It has to have ended."""
        status = self._process.returncode
        if status == 0:
            return ""
        lines = [line for line in said(self.folder) if any(map(str.isalpha, line))]  # mpirun draws rules too
        named = [line.removeprefix("mpitled: ") for line in lines if line.startswith("mpitled: ")]
        if status < 0 and not named:
            killed = f"killed by {signal.Signals(-status).name}"
            if status == -signal.SIGXCPU:
                return f"{killed}: it was not done in the time that it may compute for"
            return killed + (": perhaps the memory was not enough" if status == -signal.SIGKILL else "")
        return (named or lines or ["no reason given"])[-1]

    def stop(self) -> None:
        """End it, as a person would who wants to keep what it wrote."""
        self._process.terminate()
        self._process.wait()


def _prepare(last: int, longest: int | None) -> None:
    """In the process to be: the signal that ends it with its parent, and the time that it may compute for."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, last)
    if longest is not None:
        resource.setrlimit(resource.RLIMIT_CPU, (longest, longest + 1))


def said(folder: Path) -> list[str]:
    """The lines of a run's log."""
    log = folder / LOG
    return log.read_text(errors="replace").splitlines() if log.exists() else []


def prepare(folder: Path, model: Path | None = None) -> None:
    """An empty folder for a run, with a model that is there already: it is not built if it is the deck's.

    lock.Taken if a run is at work there; only locks are left.
    """
    with lock.held(folder, lock.RUN):
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name not in (lock.RUN, lock.TASK):
                with suppress(OSError):
                    path.unlink()
        if model and model.exists():
            try:
                os.link(model, folder / model.name)
            except OSError:  # not every file system has links
                with atomic.writing(folder / model.name):
                    shutil.copyfile(model, folder / model.name)


def record(folder: Path, failure: str, **more: str) -> None:
    """Say in a run's folder that it ended: the reason of its failure, "" if it is done."""
    atomic.write_text(folder / DONE, json.dumps({"failure": failure, **more}))


def run_apart(deck: Path, overrides: Sequence[str], ranks: int, folder: Path, longest: int | None = None) -> str:
    """Compute a deck in its folder, emptied before; the reason of its failure, "" if it is done.

    If it computes for longer (s) than that it is killed. lock.Taken if another is at work there.
    """
    with lock.held(folder, lock.TASK):
        prepare(folder)
        process = Process(command("run", deck, overrides, ranks, folder), folder, longest)
        process.ended()
        record(folder, process.failure, status=str(process.status))
        return process.failure


def about(folder: Path) -> dict[str, str]:
    """What was recorded when the run in a folder ended; empty if it did not."""
    done = folder / DONE
    return dict(json.loads(done.read_text())) if done.exists() else {}


def outcome(folder: Path) -> str | None:
    """How a run ended in its folder: None if it did not, the reason of its failure, or "" for success."""
    return about(folder).get("failure")
