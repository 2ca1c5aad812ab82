"""Runs of decks in separate processes, and records of their ends: the basis of sweeps and studies."""

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

#: Record of the end of a run, and its log, in the folder of the run.
DONE, LOG = "done.json", "run.log"
_PR_SET_PDEATHSIG = 1  # of Linux's prctl


def ranked(ranks: int) -> list[str]:
    """The launcher and its arguments for several ranks; an empty list for one rank."""
    return ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks)] if ranks > 1 else []


def command(
    verb: str, deck: Path, overrides: Sequence[str], ranks: int, folder: Path, resume: bool = False
) -> list[str]:
    """The command that runs or builds (verb) a deck with overrides "section.key=value" into a folder."""
    words = [sys.executable, "-m", "mpitled", verb, str(deck), "--out", str(folder)]
    words += [word for override in overrides for word in ("--set", override)]
    if verb == "build":
        return [*words, "--ranks", str(ranks)]
    return [*ranked(ranks), *words, *(["--resume"] if resume else [])]


class Process:
    """A process that writes its log into a folder. The kernel kills it when its parent ends."""

    def __init__(self, words: Sequence[str], folder: Path, cpu_limit: int | None = None) -> None:
        """Start a command for an existing folder; the process is killed after `cpu_limit` seconds of CPU time."""
        self.folder = folder
        # mpirun ends its ranks on SIGTERM, and cannot do so on SIGKILL.
        death_signal = signal.SIGTERM if words[0] == "mpirun" else signal.SIGKILL

        def in_child() -> None:
            if sys.platform == "linux":
                ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, death_signal)
            if cpu_limit is not None:
                resource.setrlimit(resource.RLIMIT_CPU, (cpu_limit, cpu_limit + 1))

        with atomic.writing(folder / LOG), (folder / LOG).open("wb") as log:
            self._process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, preexec_fn=in_child
            )

    def ended(self, seconds: float | None = None) -> bool:
        """Whether the process ends within the given time, s; None: wait for its end."""
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        return True

    @property
    def status(self) -> int:
        """Exit status of the ended process, or the negative number of the signal that killed it."""
        return int(self._process.returncode)

    @property
    def failure(self) -> str:
        """Reason of the failure of the ended process; "" if it succeeded."""
        if self.status == 0:
            return ""
        lines = [line for line in log_lines(self.folder) if any(map(str.isalpha, line))]  # no ruled lines
        messages = [line.removeprefix("mpitled: ") for line in lines if line.startswith("mpitled: ")]
        if self.status < 0 and not messages:
            killed = f"killed by {signal.Signals(-self.status).name}"
            if self.status == -signal.SIGXCPU:
                return f"{killed}: the limit of CPU time was reached"
            return killed + (": the memory may be too small" if self.status == -signal.SIGKILL else "")
        return (messages or lines or ["no reason given"])[-1]

    def stop(self) -> None:
        """Interrupt the process, so that it writes a checkpoint, and wait for its end."""
        self._process.terminate()
        self._process.wait()


def log_lines(folder: Path) -> list[str]:
    """The lines of a run's log."""
    log = folder / LOG
    return log.read_text(errors="replace").splitlines() if log.exists() else []


def prepare(folder: Path, model: Path | None = None) -> None:
    """Empty a folder for a run, except for locks, and link a model file into it.

    The run uses the model if it fits the run's deck. LockError if another run uses the folder.
    """
    with lock.directory_lock(folder, lock.RUN):
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name not in (lock.RUN, lock.TASK):
                with suppress(OSError):
                    path.unlink()
        if model and model.exists():
            try:
                os.link(model, folder / model.name)
            except OSError:  # the file system has no hard links
                with atomic.writing(folder / model.name):
                    shutil.copyfile(model, folder / model.name)


def record(folder: Path, failure: str, **entries: str) -> None:
    """Record in its folder that a run ended, and the reason of its failure or ""."""
    atomic.write_text(folder / DONE, json.dumps({"failure": failure, **entries}))


def run_apart(deck: Path, overrides: Sequence[str], ranks: int, folder: Path, cpu_limit: int | None = None) -> str:
    """Empty a folder and run a deck in it. Returns the reason of the failure, or "".

    The run is killed after `cpu_limit` seconds of CPU time. LockError if another process uses the folder.
    """
    with lock.directory_lock(folder, lock.TASK):
        prepare(folder)
        process = Process(command("run", deck, overrides, ranks, folder), folder, cpu_limit)
        process.ended()
        record(folder, process.failure, status=str(process.status))
        return process.failure


def about(folder: Path) -> dict[str, str]:
    """The entries that `record` wrote into a folder; empty if no run has ended there."""
    done = folder / DONE
    return dict(json.loads(done.read_text())) if done.exists() else {}


def outcome(folder: Path) -> str | None:
    """The outcome of the run in a folder: None if it has not ended, "" for success, or the reason of its failure."""
    return about(folder).get("failure")
