"""The scheduler scripts as plain shell, where there is no scheduler: they build, cut, run, and end before the limit."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import ENVIRONMENT, ROOT, ranks
from scenes import block, pulled

from mpitled.errors import InputError
from mpitled.store import open_result

SCRIPTS = ("slurm.sh", "pbs.sh")
SCENE = f"""{block((20, 20, 20), (6, 6, 6))}{pulled(0.1)}
[solver]
method = "dynamic"
load_time = 0.02
[output]
frames = 1
"""


def cluster(folder: Path, script: str, **more: str) -> tuple[list[str], dict[str, str]]:
    """The words that start a script in a folder that stands for a set-up clone, and the scheduler's variables."""
    ranks(2)  # skips where there is no mpirun
    (folder / "jobs").mkdir()
    (folder / "jobs" / "environment.sh").touch()
    (folder / "scene.toml").write_text(SCENE)
    (folder / "nodes").write_text("localhost\nlocalhost\n")
    given = {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "OMPI_MCA_rmaps_base_oversubscribe": "1",
        "OMPI_MCA_hwloc_base_binding_policy": "none",
        "SLURM_SUBMIT_DIR": str(folder),
        "PBS_O_WORKDIR": str(folder),
        "PBS_NODEFILE": str(folder / "nodes"),
        "SLURM_NTASKS": "2",
        "DECK": "scene.toml",
    }
    words = ["bash", str(ROOT / "jobs" / script), *(["scene.toml"] if script == "slurm.sh" else [])]
    return words, {**ENVIRONMENT, **given, **more}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """By script: the folder and the output of a job that came to its end, and the seconds that it took."""

    @functools.cache
    def run(script: str) -> tuple[Path, str, float]:
        folder = tmp_path_factory.mktemp("job")
        words, variables = cluster(folder, script)
        begin = time.monotonic()
        done = subprocess.run(words, env=variables, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr
        return folder, done.stdout, time.monotonic() - begin

    return run


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_job_builds_cuts_and_runs(whole, script):
    folder, printed, _ = whole(script)
    assert "2 parts: balance" in printed
    with open_result(folder / "out" / "scene") as result:
        assert result.complete
        assert result.metadata["ranks"] == 2


def begun(folder: Path) -> bool:
    """Whether a result can be read already, and not just its file is there."""
    try:
        with open_result(folder):
            return True
    except InputError:
        return False


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_job_ends_in_order_before_its_time_is_up(tmp_path, script):
    """SLURM sends a signal; PBS sends none in time, so that the script has a clock."""
    words, variables = cluster(tmp_path, script, RUN_SECONDS="10", SET="solver.load_time=5000.0")
    if script == "slurm.sh":
        words += ["--set", "solver.load_time=5000.0"]
    folder = tmp_path / "out" / "scene"
    with subprocess.Popen(words, env=variables, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.time() + 60
        while script == "slurm.sh" and not begun(folder) and time.time() < deadline:
            time.sleep(0.1)
        if script == "slurm.sh":
            process.send_signal(signal.SIGUSR1)
        _, errors = process.communicate(timeout=90)
    assert process.returncode == 4, errors
    assert "interrupted" in errors
    with open_result(tmp_path / "out" / "scene") as result:
        assert not result.complete
    assert (tmp_path / "out" / "scene" / "checkpoint.h5").exists()  # the same job would go on from it
