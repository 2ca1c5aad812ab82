"""How tests give commands and start ranks: one rank in the tests' process, more as a user starts them."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from mpitled import cli

ROOT = Path(__file__).parents[1]
# For mpirun in a container's or CI's root account, with more ranks than cores or beside other programs: a rank that
# waits gives way, else it keeps the one that it waits for from the core. Commands called here start ranks as well.
os.environ |= {
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_mpi_yield_when_idle": "1",
    "OMP_NUM_THREADS": "1",
}
ENVIRONMENT = {**os.environ}


def ranks(n: int) -> list[str]:
    """The words that start n ranks; none for one. Skips where there is no MPI."""
    if n == 1:
        return []
    if shutil.which("mpirun") is None:
        pytest.skip("no mpirun")
    return ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(n)]


def mpitled(
    *arguments: object, n: int = 1, status: int = 0, timeout: float | None = None, pictures: bool = False
) -> subprocess.CompletedProcess[str]:
    """Give the command on n ranks and see that it ends with this status; pictures take a run 1 s more.

    One rank is called in this process, for a start takes 1 s; with a timeout it has a process of its own as well.
    """
    words = [*map(str, arguments)]
    if "run" in words[:1] and not pictures:
        words += ["--set", "output.pictures=false"]
    if n == 1 and timeout is None:
        done = _called(words)
    else:
        command = [*ranks(n), str(Path(sys.executable).with_name("mpitled")), *words]
        done = subprocess.run(
            command, env=ENVIRONMENT, cwd=ROOT, timeout=timeout or 120, capture_output=True, text=True
        )
    assert done.returncode == status, f"{done.args} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    assert "Traceback" not in done.stderr
    return done


def ended(*arguments: object) -> int:
    """The exit status of the command, called in this process; what it prints goes where pytest has it."""
    with pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


def _called(words: list[str]) -> subprocess.CompletedProcess[str]:
    """As if a process had been started: what a command does to its own is undone."""
    printed, said, here = io.StringIO(), io.StringIO(), Path.cwd()
    handlers = {which: signal.getsignal(which) for which in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)}
    os.chdir(ROOT)
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(said):
            status = ended(*words)
    finally:
        os.chdir(here)
        for which, handler in handlers.items():
            signal.signal(which, handler)
    return subprocess.CompletedProcess(["mpitled", *words], status, printed.getvalue(), said.getvalue())


def script(name: str, *arguments: object, n: int, timeout: float = 120) -> str:
    """Run a script beside this file on n ranks; what it printed."""
    command = [*ranks(n), sys.executable, str(Path(__file__).with_name(name)), *map(str, arguments)]
    done = subprocess.run(command, env=ENVIRONMENT, cwd=ROOT, timeout=timeout, capture_output=True, text=True)
    assert done.returncode == 0, f"{command} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="session")
def segmentation(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """What the guide's way from a segmentation to a table wrote (out/trial, out/table) and said."""
    for library in ("nibabel", "matplotlib"):
        pytest.importorskip(library)
    from guide import PARTS, follow

    folder = tmp_path_factory.mktemp("guide")
    said = follow(folder, PARTS["From a segmentation to a table"])
    return folder / "out", said


def complaint(done: subprocess.CompletedProcess[str]) -> str:
    """The one line with which mpitled ended (mpirun adds words of its own)."""
    lines: Sequence[str] = [line for line in done.stderr.splitlines() if line.startswith("mpitled:")]
    assert len(lines) == 1, done.stderr
    return lines[0]
