"""How tests start commands and ranks: the installed command, as a user does."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: For mpirun in a container's or CI's root account, with more ranks than cores.
ENVIRONMENT = {
    **os.environ,
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMP_NUM_THREADS": "1",
}


def ranks(n: int) -> list[str]:
    """The words that start n ranks; none for one. Skips where there is no MPI."""
    if n == 1:
        return []
    if shutil.which("mpirun") is None:
        pytest.skip("no mpirun")
    return ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(n)]


def mpitled(
    *arguments: object, n: int = 1, status: int = 0, timeout: float = 120, pictures: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run the command on n ranks and see that it ends with this status; pictures take a run 1 s more."""
    command = [*ranks(n), str(Path(sys.executable).with_name("mpitled")), *map(str, arguments)]
    if "run" in arguments[:1] and not pictures:
        command += ["--set", "output.pictures=false"]
    done = subprocess.run(command, env=ENVIRONMENT, cwd=ROOT, timeout=timeout, capture_output=True, text=True)
    assert done.returncode == status, f"{command} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    assert "Traceback" not in done.stderr
    return done


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
