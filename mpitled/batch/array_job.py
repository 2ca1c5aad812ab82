"""Array jobs of SLURM or PBS that compute the cases of a sweep, one task for each case."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from mpitled import atomic
from mpitled.batch.cases import MANIFEST, Sweep
from mpitled.errors import InputError

#: Folders in the PATH of every shell. They must not precede the folders of loaded modules.
_SYSTEM = ("/bin", "/usr/bin", "/usr/local/bin")


def _slurm(name: str, n: int, ranks: int, folder: str, command: str) -> tuple[str, str]:
    """Directives, and the commands that start a task. SLURM sends a signal before the time limit."""
    if not re.fullmatch(r"[^\n\"'\\]+", folder):
        raise InputError(f"{folder}: slurm refuses this path for its logs; give an --out without quotes")
    log = folder.replace("%", "%%") + "/slurm-%A_%a.log"  # %A: each submission has its own log
    log = f'"{log}"' if re.search(r"\s", log) else log
    head = f"""\
#SBATCH --job-name={name}
#SBATCH --array=1-{n}
#SBATCH --ntasks={ranks}
#SBATCH --cpus-per-task=1
#SBATCH --hint=nomultithread
#SBATCH --time=01:00:00
#SBATCH --signal=B:USR1@120
#SBATCH --output={log}
"""
    body = f"""\
launch=(srun --mpi=pmix)
command -v srun >/dev/null || launch=(mpirun -n {ranks})
"${{launch[@]}}" {command} "$SLURM_ARRAY_TASK_ID" &
job=$!
trap 'kill -USR1 "$job"' USR1
status=0
wait "$job" || status=$?
[ "$status" -le 128 ] || {{ status=0 && wait "$job" || status=$?; }}
exit "$status"
"""
    return head, body


def _pbs(name: str, n: int, ranks: int, folder: str, command: str) -> tuple[str, str]:
    """Directives, and the commands that start a task. PBS sends no signal early enough: `timeout` sends it."""
    if not re.fullmatch(r"[^\s\"'\\:,]+", folder):
        raise InputError(f"{folder}: pbs refuses this path for its logs; give an --out without blanks and quotes")
    head = f"""\
#PBS -N {name}
#PBS -j oe
#PBS -l select=1:ncpus={ranks}:mpiprocs={ranks}
#PBS -l walltime=01:00:00
#PBS -o {folder}
"""
    head += f"#PBS -J 1-{n}\n" if n > 1 else ""  # PBS refuses an array of one task
    body = f"""\
# Two minutes less than the walltime, in seconds.
timeout --signal=USR1 --preserve-status "${{RUN_SECONDS:-3480}}" \\
    mpirun -n {ranks} {command} "${{PBS_ARRAY_INDEX:-1}}"
"""
    return head, body


SCHEDULERS: dict[str, Callable[[str, int, int, str, str], tuple[str, str]]] = {"slurm": _slurm, "pbs": _pbs}


def write(sweep: Sweep, scheduler: str) -> Path:
    """Write the manifest and the script of a scheduler, in which the user sets the time limit and the queue.

    Returns the path of the script. InputError if the scheduler does not accept the path of the sweep's folder.
    """
    n, ranks, folder = len(sweep.cases), sweep.ranks, sweep.folder.resolve()
    name = re.sub("[^A-Za-z0-9]", "_", folder.name)[:15].lstrip("_0123456789") or "sweep"  # as PBS requires
    quoted = shlex.quote(str(folder))
    head, body = SCHEDULERS[scheduler](name, n, ranks, str(folder), f"mpitled sweep {quoted} --only")
    manifest = sweep.folder / MANIFEST
    before = manifest.read_bytes() if manifest.exists() else b""
    sweep.write_manifest()
    if manifest.read_bytes() != before:  # an existing script is for other cases or ranks
        with atomic.writing(folder):
            for existing in SCHEDULERS:
                (folder / f"{existing}.sh").unlink(missing_ok=True)
    path = sweep.folder / f"{scheduler}.sh"
    text = f"""\
#!/usr/bin/env bash
{head}# {count(n, "case")}, each on {count(ranks, "rank")}; set the time of the longest case, and your queue.
# Submit the script again to resume unfinished cases from their checkpoints; completed cases are not repeated.
# Afterwards: mpitled report {quoted}
set -euo pipefail
cd {shlex.quote(str(Path.cwd()))}
# module load openmpi hdf5
{_environment()}export OMP_NUM_THREADS=1
{body}"""
    atomic.write_text(path, text)
    with atomic.writing(path):
        path.chmod(0o755)
    return path


def _environment() -> str:
    """Lines that set up the environment of the clone, if there is one, and add the program's folder to PATH."""
    clones = (Path.cwd(), Path(sys.prefix).parent)
    setup = [path for clone in clones if (path := clone / "jobs" / "environment.sh").is_file()]
    program = Path(sys.executable).parent
    if not (program / "mpitled").exists() and (command := shutil.which("mpitled")):
        program = Path(command).resolve().parent
    lines = [f". {shlex.quote(str(path))}\n" for path in setup[:1]]
    lines += [f"export PATH={shlex.quote(str(program))}:$PATH\n"] if str(program) not in _SYSTEM else []
    return "".join(lines)


def count(n: int, noun: str) -> str:
    """A number with its noun in the singular or plural."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
