"""The scheduler scripts as plain shell, where there is no scheduler: they build, cut, run, and end before the limit."""

from __future__ import annotations

import os
import re
import shutil
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


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_job_builds_partitions_and_runs(tmp_path, script):
    words, variables = cluster(tmp_path, script)
    done = subprocess.run(words, env=variables, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 parts: balance" in done.stdout
    with open_result(tmp_path / "out" / "scene") as result:
        assert result.complete
        assert result.metadata["ranks"] == 2


def begun(folder: Path) -> bool:
    """Whether the result can be read, not only its file exists."""
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


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_job_without_a_deck_says_how_to_give_one(tmp_path, script):
    variables = {name: value for name, value in ENVIRONMENT.items() if name != "DECK"}
    done = subprocess.run(["bash", ROOT / "jobs" / script], env=variables, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert re.fullmatch(r"usage: .*DECK.*\n", done.stderr)


def sourced(clone: Path, words: str, path: str) -> subprocess.CompletedProcess[str]:
    """A shell in another folder that sources a clone's set-up, then goes on."""
    (clone.parent / "elsewhere").mkdir(exist_ok=True)
    return subprocess.run(
        ["bash", "-c", f"{words}. {clone}/jobs/environment.sh; echo $? $PWD; command -v mpitled"],
        env={"PATH": path}, cwd=clone.parent / "elsewhere", capture_output=True, text=True, timeout=60,
    )  # fmt: skip


def test_the_set_up_leaves_a_shell_open_and_where_it_was(tmp_path):
    """Done before, and where nothing can be set up, for there is no Python."""
    clone, tools = tmp_path / "clone", tmp_path / "tools"
    (clone / "jobs").mkdir(parents=True)
    (clone / "pyproject.toml").touch()
    shutil.copy(ROOT / "jobs" / "environment.sh", clone / "jobs")
    tools.mkdir()
    for tool in ("cat", "cksum", "dirname", "bash"):
        (tools / tool).symlink_to(str(shutil.which(tool)))
    done = sourced(clone, "", str(tools))
    assert done.stdout == f"2 {tmp_path}/elsewhere\n"
    assert done.stderr == "mpitled set-up: no Python 3.10 or newer: install one, and try again\n"
    done = sourced(clone, "set -euo pipefail; ", str(tools))  # as scripts do
    assert (done.returncode, done.stdout) == (2, "")

    made = clone / ".venv" / "bin" / "mpitled"
    made.parent.mkdir(parents=True)
    made.touch(0o755)
    stamp = "cat pyproject.toml jobs/environment.sh | cksum > .venv/made-from"
    subprocess.run(["bash", "-c", stamp], cwd=clone, check=True)
    for words in ("", "set -euo pipefail; "):
        assert sourced(clone, words, str(tools)).stdout == f"0 {tmp_path}/elsewhere\n{made}\n"
