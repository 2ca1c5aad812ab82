"""The commands of the guide, jobs/README.md, and stand-ins for the schedulers, which start what they get."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from conftest import ENVIRONMENT, ROOT

GUIDE = (ROOT / "jobs" / "README.md").read_text(encoding="utf-8")
#: By the heading above them, the commands of each part of the guide.
PARTS = {
    part.partition("\n")[0]: "".join(re.findall(r"^```bash\n(.*?)^```$", part, re.MULTILINE | re.DOTALL))
    for part in GUIDE.split("\n## ")[1:]
}
#: SLURM's commands run a job on one rank, or a task after the other of an array; PBS's takes what it can be given.
#: tests/test_cluster.py runs both scripts on two ranks.
SBATCH = """#!/bin/bash
set -euo pipefail
while [ "${1#--}" != "$1" ]; do shift 2; done
tasks=$(sed -n 's/^#SBATCH --array=1-//p' "$1")
export SLURM_NTASKS=1
for task in $(seq "${tasks:-1}"); do SLURM_ARRAY_TASK_ID=$task bash "$@"; done
"""
SRUN = """#!/bin/bash
while [ "${1#--}" != "$1" ]; do shift; done
exec "$@"
"""
QSUB = """#!/bin/bash
set -euo pipefail
IFS=, read -ra given <<< "$2"
export "${given[@]}"
bash -n "$3"
exec mpitled run "$DECK" --dry --set "$SET"
"""


def follow(folder: Path, commands: str) -> str:
    """Run commands in a folder that stands for a set-up clone; what they print."""
    (folder / "jobs").mkdir(exist_ok=True)
    for path in (ROOT / "jobs").iterdir():
        if path.name != "environment.sh":
            (folder / "jobs" / path.name).symlink_to(path)
    (folder / "jobs" / "environment.sh").touch()
    tools = folder / "bin"
    tools.mkdir()
    for name, text in (("sbatch", SBATCH), ("srun", SRUN), ("qsub", QSUB)):
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)
    (folder / "nodes").write_text("localhost\n")
    here = {
        "PATH": os.pathsep.join([str(tools), str(Path(sys.executable).parent), ENVIRONMENT["PATH"]]),
        "SLURM_SUBMIT_DIR": str(folder),
        "PBS_O_WORKDIR": str(folder),
        "PBS_NODEFILE": str(folder / "nodes"),
        "OMPI_MCA_hwloc_base_binding_policy": "none",
    }
    done = subprocess.run(
        ["bash", "-euxo", "pipefail", "-c", commands],
        env=ENVIRONMENT | here, cwd=folder, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout
