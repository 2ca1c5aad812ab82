"""Inject faults: `python tests/faults.py [KILLS]` stops runs in every way it knows of and prints a Markdown table.

After each fault all processes have to be gone within seconds, with a message that is true; no file may claim to be
complete and not be; and the run, continued with --resume, has to end in the bits of the run that was never stopped, or
on another number of ranks within 1e-8 of the largest displacement. KILLS (100) are spread at random over ranks and
phases. Exit status 1 if anything falls short.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from scenes import MIXED, pulled

from mpitled import store
from mpitled.errors import InputError

ROOT = Path(__file__).parents[1]
ENVIRONMENT = {
    **os.environ, "OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMP_NUM_THREADS": "1",
    "OMPI_MCA_mpi_yield_when_idle": "1",
    "PYTHONPATH": str(ROOT),
}  # fmt: skip
#: Phases in which a rank is killed, as `run -v` names them, and how long (s) after their beginning at most.
PHASES = {
    "model": 0.5, "partition": 0.1, "read": 0.05, "compile": 0.3, "begin": 0.1, "loop": 2.0, "output": 1.0,
    "checkpoints": 1.0, "static distance": 0.3, "close": 0.02, "report": 0.1,
}  # fmt: skip
GONE = 10  # s, in which all processes have to be gone
TOLERANCE = 1e-8  # of the largest displacement, between numbers of ranks
SCENE = f"""{MIXED}{pulled(4.0)}
[solver]
method = "quasi-static"
load_time = 25.0
[output]
frames = 12
pictures = false
checkpoint_minutes = 0.002
"""


class Job:
    """The command at work on some ranks, and what it says."""

    def __init__(self, folder: Path, ranks: int = 2, *words: object, resume: bool = True, **variables: str) -> None:
        start = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks)] if ranks > 1 else []
        code = "from mpitled.cli import main; main()"
        words = (*(("--resume",) if resume else ()), *words)
        command = [
            *start,
            sys.executable,
            "-c",
            code,
            "run",
            "-v",
            folder.parent / "scene.toml",
            "--out",
            folder,
            *words,
        ]
        self.process = subprocess.Popen(
            [*map(str, command)], env=ENVIRONMENT | variables, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True, errors="replace", cwd=folder.parent,
        )  # fmt: skip
        self.ranks, self.lines = ranks, list[str]()
        self._said = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            with self._said:
                self.lines.append(line)
                self._said.notify_all()

    def reaches(self, phase: str, seconds: float = 120) -> bool:
        """Wait for a phase; False if the job ends before."""
        deadline = time.monotonic() + seconds
        with self._said:
            while not any(line.rstrip().endswith(f": {phase}") for line in self.lines):
                if self.process.poll() is not None or time.monotonic() > deadline:
                    return False
                self._said.wait(0.05)
        return True

    def pids(self) -> list[int]:
        """Of the ranks, in their order."""
        if self.ranks == 1:
            return [self.process.pid]
        with contextlib.suppress(OSError):
            children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text()
            return [int(pid) for pid in children.split()]
        return []

    def kill(self, rank: int, which: int = signal.SIGKILL) -> None:
        with contextlib.suppress(IndexError, ProcessLookupError):
            os.kill(self.pids()[rank], which)

    def end(self, seconds: float = 300) -> int:
        """The exit status; AssertionError if any process is left after so long."""
        pids = self.pids()
        try:
            status = self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            for pid in [*pids, self.process.pid]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            raise AssertionError(f"not gone after {seconds} s") from None
        deadline = time.monotonic() + GONE
        while any(_alive(pid) for pid in pids):
            assert time.monotonic() < deadline, "a rank outlived the job"
            time.sleep(0.02)
        self._reader.join(GONE)
        return status

    @property
    def message(self) -> str:
        """What the command said, or else the launcher, of the end."""
        ours = [line for line in self.lines if line.startswith("mpitled: ")]
        theirs = [line for line in self.lines if "signal" in line or "terminated" in line]
        assert not any("Traceback" in line for line in self.lines), "".join(self.lines)
        return (ours or theirs or [""])[-1].strip()


def _alive(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


class Faults:
    """A scene, the runs of it that were never stopped, and the table of what was tried."""

    def __init__(self, top: Path, seed: int = 0) -> None:
        self.top, self.rng, self.rows = top, random.Random(seed), list[tuple[str, str, int, int]]()
        (top / "scene.toml").write_text(SCENE)
        self.killed = 0
        self._whole: dict[int, tuple[np.ndarray, ...]] = {}
        self._models: dict[int, Path] = {}

    def folder(self, name: str, like: int | None = 2) -> Path:
        """A new folder, with the model and its partition in so many parts."""
        folder = self.top / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        if like is not None:
            self.whole(like)
            shutil.copy(self.top / f"whole_{like}" / "model.h5", folder)
        return folder

    def whole(self, ranks: int) -> tuple[np.ndarray, ...]:
        """Frames of the run that was never stopped."""
        if ranks not in self._whole:
            job = Job(self.top / f"whole_{ranks}", ranks)
            assert job.end() == 0, "".join(job.lines)
            self._whole[ranks] = self.frames(self.top / f"whole_{ranks}")
        return self._whole[ranks]

    @staticmethod
    def frames(folder: Path) -> tuple[np.ndarray, ...]:
        """All that a result holds of its frames, energies too, after its checksums were seen to be right."""
        with store.open_result(folder) as result:
            assert result.complete, f"{folder} is not complete"
            result.check()
            frames = [[result.at_nodes("parameters", k), result.in_cells("J", k)] for k in range(result.n_frames)]
            energies = result.figures["energy_J"]
            numbers = [result.times, *result.series.values(), np.array([*energies.values()])]
        return (*(array for frame in frames for array in frame), *numbers)

    def honest(self, folder: Path) -> None:
        """No file in the folder claims to be complete and is not."""
        if (folder / "result.vtkhdf").exists():
            self.frames(folder)
        elif (folder / store.CHECKPOINTS[0]).exists():
            counted = store.checkpoint_contents(folder / store.CHECKPOINTS[0])["frames"]
            with store.open_result(folder) as result:
                assert not result.complete
                assert result.n_frames >= counted, "frames were lost"
                result.check()
        for name in ("model.h5", *store.CHECKPOINTS):
            if (folder / name).exists():
                store.check_model(folder / name) if name == "model.h5" else store.checkpoint_contents(folder / name)

    def resumes(self, folder: Path, ranks: int = 2, bits_of: int | None = 2) -> None:
        """It goes on to the end, to the bits of a run on `bits_of` ranks that was not stopped, or close to it."""
        job = Job(folder, ranks)
        assert job.end() == 0, "".join(job.lines[-8:])
        found, right = self.frames(folder), self.whole(bits_of or 1)
        if bits_of:
            assert all(a.tobytes() == b.tobytes() for a, b in zip(found, right, strict=True)), "other bits"
        else:
            largest = max(np.abs(a).max() for a in right[:-2:2] if a.ndim == 2)
            apart = max(
                np.abs(a - b).max() for a, b in zip(found, right, strict=True) if a.ndim == 2 and a.shape[1] == 3
            )
            assert apart < TOLERANCE * largest, f"{apart / largest:.1e} apart"

    def tried(self, fault: str, phases: str, attempts: Iterable[Callable[[], None]]) -> None:
        """Try, and enter in the table how often it was survived."""
        survived = count = 0
        for attempt in attempts:
            count += 1
            try:
                attempt()
                survived += 1
            except (AssertionError, InputError) as error:
                print(f"{fault}, {phases}: {error}", file=sys.stderr)
        self.rows.append((fault, phases, survived, count))
        print(f"{fault}, {phases}: {survived} of {count}", file=sys.stderr, flush=True)

    def table(self) -> str:
        rows = [f"| {fault} | {phases} | {survived} of {tried} |" for fault, phases, survived, tried in self.rows]
        return "\n".join(["| fault | when | survived |", "|---|---|---|", *rows])

    @property
    def all_survived(self) -> bool:
        return all(survived == tried for _, _, survived, tried in self.rows)

    # ------------------------------------------------------------ the faults

    def kills(self, phases: list[str], ranks: int = 2) -> None:
        """One run, killed once in each of the phases as they come and continued each time, then to its end."""
        folder = self.folder("killed", None if phases[0] in ("model", "partition") else ranks)
        for phase in phases:
            job = Job(folder, ranks)
            if not job.reaches(phase):
                # It began beyond this phase, and is done.
                assert job.end() == 0, "".join(job.lines[-8:])
                continue
            time.sleep(self.rng.uniform(0, PHASES[phase]))
            job.kill(self.rng.randrange(ranks))
            begin = time.monotonic()
            status = job.end(60)
            self.killed += status != 0  # and not at its end before
            assert time.monotonic() - begin < GONE or status == 0, f"gone after {time.monotonic() - begin:.0f} s"
            said = any("exited on signal 9" in line for line in job.lines)  # by mpirun; alone a rank cannot
            assert status == 0 or said or ranks == 1, f"no true message: {job.lines[-5:]}"
            self.honest(folder)
        self.resumes(folder, ranks, ranks)

    def signalled(self, which: int, ranks: int = 2) -> None:
        folder = self.folder("signalled", ranks)
        job = Job(folder, ranks)
        assert job.reaches("loop")
        time.sleep(self.rng.uniform(0, 0.6))
        job.process.send_signal(which)
        status = job.end(GONE)
        if which == signal.SIGUSR1 and (folder / "result.vtkhdf").exists():
            assert status in (0, 4), f"status {status}"  # it was done, but for the report
        elif which == signal.SIGUSR1:
            assert status == 4, f"status {status}"
            assert "interrupted" in job.message, job.message
            assert store.checkpoint_contents(folder / store.CHECKPOINTS[0])["ranks"] == ranks
        self.honest(folder)
        self.resumes(folder, ranks, ranks)

    def other_ranks(self, ranks: list[int]) -> None:
        """Killed and continued on one number of ranks after the other."""
        folder = self.folder("ranks", None)
        for n in ranks[:-1]:
            job = Job(folder, n)
            assert job.reaches("checkpoints"), "".join(job.lines[-8:])
            time.sleep(self.rng.uniform(0, 0.5))
            job.kill(self.rng.randrange(n))
            job.end(60)
            self.honest(folder)
        self.resumes(folder, ranks[-1], None)

    def stopped(self, rank: int, pauses: list[tuple[float, float]]) -> None:
        """A rank that stands still for a while, as (s) stopped and (s) at work in turn."""
        folder = self.folder("slow")
        job = Job(folder)
        assert job.reaches("loop")
        for still, at_work in pauses:
            job.kill(rank, signal.SIGSTOP)
            time.sleep(still)
            job.kill(rank, signal.SIGCONT)
            time.sleep(at_work)
        assert job.end() == 0
        assert self.frames(folder)[0].tobytes() == self.whole(2)[0].tobytes()
        self.resumes(folder)

    def interrupted(self, name: str) -> Path:
        """A run that kept two checkpoints before it was killed."""
        folder = self.folder(name)
        job = Job(folder)
        while not (folder / store.CHECKPOINTS[1]).exists():
            assert job.process.poll() is None, "".join(job.lines)
            time.sleep(0.02)
        job.kill(0)
        job.end(60)
        return folder

    def damaged(self, harm: Callable[[Path], None], both: bool = False) -> None:
        folder = self.interrupted("damaged")
        for name in store.CHECKPOINTS[: 2 if both else 1]:
            if (folder / name).exists():
                harm(folder / name)
        if both:
            job = Job(folder)
            assert job.end(60) == 2, "went on from damaged checkpoints"
            assert "checkpoint" in job.message
            job = Job(folder, resume=False)
            assert job.end() == 0
        self.resumes(folder)

    def flip(self, path: Path) -> None:
        """Change one bit in a hundred places."""
        data = bytearray(path.read_bytes())
        for _ in range(100):
            data[self.rng.randrange(len(data))] ^= 1 << self.rng.randrange(8)
        path.write_bytes(data)

    def cut(self, path: Path) -> None:
        path.write_bytes(path.read_bytes()[: self.rng.randrange(path.stat().st_size)])

    def disc_full(self, kilobytes: int, late: bool = False) -> None:
        """A disc of that size; late: that others fill up while the run is at work."""
        with _tmpfs(self.top / "disc", f"{kilobytes}k") as disc:
            (disc / "scene.toml").write_text(SCENE)
            job = Job(disc / "out", 2)
            if late:
                assert job.reaches("checkpoints"), job.lines[-5:]
                with contextlib.suppress(OSError), (disc / "filler").open("wb") as filler:
                    while True:
                        filler.write(bytes(4096))
                        filler.flush()
            status = job.end(60)
            assert status == 2, f"status {status}: {job.lines[-12:]}"
            assert "cannot be written" in job.message or "are free there" in job.message, job.message
            if (disc / "out").exists():
                self.honest(disc / "out")
            _mount("remount,size=200m", disc)
            self.resumes(disc / "out")

    def read_only(self, late: bool) -> None:
        with _tmpfs(self.top / "disc", "200m") as disc:
            (disc / "scene.toml").write_text(SCENE)
            if late:
                job = Job(disc / "out", 2)
                assert job.reaches("checkpoints")
                job.kill(0)
                job.end(60)
            _mount_when_free("remount,ro", disc)
            job = Job(disc / "out", 2)
            assert (status := job.end(60)) == 2, f"status {status}: {job.lines[-12:]}"
            assert "cannot be" in job.message, job.message
            _mount("remount,rw", disc)
            self.resumes(disc / "out")

    def without(self, library: str, ranks: int) -> None:
        """A library that cannot be loaded."""
        folder, blocked = self.folder("without", None), self.top / "blocked"
        shutil.rmtree(blocked, ignore_errors=True)
        (blocked / library).mkdir(parents=True)
        (blocked / library / "__init__.py").write_text(
            f"raise ImportError('lib{library}.so: cannot open shared object file')"
        )
        job = Job(folder, ranks, PYTHONPATH=f"{blocked}{os.pathsep}{ROOT}")
        assert job.end(60) == 2, job.lines[-5:]
        assert library in job.message, job.message
        self.resumes(folder, ranks, ranks)

    def model(self, harm: Callable[[h5py.File], None]) -> None:
        """A model that is not what the run began with."""
        folder = self.interrupted("model")
        with h5py.File(folder / "model.h5", "r+") as file:
            harm(file)
        self.resumes(folder)

    def clock(self) -> None:
        """The machine's clock leaps by a day to and fro, every few looks at it."""
        source, library = self.top / "clock.c", self.top / "clock.so"
        source.write_text(_CLOCK)
        subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
        folder = self.folder("clock")
        job = Job(folder, LD_PRELOAD=str(library))
        assert job.reaches("checkpoints"), "".join(job.lines)
        job.kill(1)
        job.end(60)
        assert Job(folder, LD_PRELOAD=str(library)).end() == 0
        self.resumes(folder)

    def otherwise(self, **variables: str) -> None:
        """From the start, model and all, in another environment."""
        folder = self.folder("otherwise", None)
        assert Job(folder, 2, **variables).end() == 0
        self.resumes(folder)
        assert (folder / "model.h5").read_bytes() == (self.top / "whole_2" / "model.h5").read_bytes()

    def another_partition(self) -> None:
        """Cut anew with seeds until METIS cuts elsewhere, and at last with the one that it had."""
        folder = self.interrupted("partition")
        mark = store.partition_mark(folder / "model.h5", 2)

        def cut(seed: int) -> bool:
            code = f"from mpitled.cli import main; main(['partition', {str(folder)!r}, '2', '--seed', '{seed}'])"
            subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, check=True, capture_output=True)
            return store.partition_mark(folder / "model.h5", 2) != mark

        assert any(cut(seed) for seed in range(1, 20)), "no other partition"
        job = Job(folder)
        assert (status := job.end(60)) == 2, f"status {status}"
        assert "partition" in job.message, job.message
        assert not cut(0)
        self.resumes(folder)

    def refused(self, words: list[str], said: str) -> None:
        """What differs from the run that was stopped."""
        folder = self.interrupted("refused")
        job = Job(folder, 2, *words)
        assert job.end(60) == 2
        assert said in job.message, job.message
        self.resumes(folder)


_CLOCK = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/time.h>
#include <time.h>
static long leap(void) { static long n; return (n++ / 7 % 3 - 1) * 86400; }
int clock_gettime(clockid_t which, struct timespec *t) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int failed = real(which, t);
    if (which == CLOCK_REALTIME) t->tv_sec += leap();
    return failed;
}
time_t time(time_t *t) {
    struct timespec now; clock_gettime(CLOCK_REALTIME, &now);
    if (t) *t = now.tv_sec;
    return now.tv_sec;
}
int gettimeofday(struct timeval *t, void *zone) {
    struct timespec now; clock_gettime(CLOCK_REALTIME, &now);
    t->tv_sec = now.tv_sec; t->tv_usec = now.tv_nsec / 1000;
    return 0;
}
"""


def _mount(options: str, folder: Path, *more: str) -> None:
    subprocess.run(["mount", *more, "-o", options, folder], check=True, capture_output=True)


def _mount_when_free(options: str, folder: Path) -> None:
    """As soon as what was killed has let go of its files: it is busy for as long."""
    deadline = time.monotonic() + GONE
    while True:
        try:
            return _mount(options, folder)
        except subprocess.CalledProcessError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


@contextlib.contextmanager
def _tmpfs(folder: Path, size: str) -> Iterator[Path]:
    folder.mkdir(exist_ok=True)
    _mount(f"size={size}", folder, "-t", "tmpfs", "tmpfs")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=False)


def can_mount() -> bool:
    """Whether small discs can be made: as root, where the container permits it."""
    refusals = subprocess.CalledProcessError, OSError
    with tempfile.TemporaryDirectory() as top, contextlib.suppress(*refusals), _tmpfs(Path(top) / "disc", "1m"):
        return True
    return False


def _no_partition(file: h5py.File) -> None:
    del file["partitions"]


def _other_layout(file: h5py.File) -> None:
    file.attrs["layout"] = 1


def _damaged_model(file: h5py.File) -> None:
    file["blocks/1/gradients"][3, 2, 1] *= 1 + 1e-9


def inject(top: Path, n_kills: int = 100, seed: int = 0) -> Faults:
    """Every fault, and so many kills."""
    faults, few = Faults(top, seed), n_kills < 20
    likely, order, per_run = [*PHASES, "loop", "output", "checkpoints"], list(PHASES), 3 if few else 5

    def killing() -> Iterator[Callable[[], None]]:
        runs = 0
        while faults.killed < n_kills:
            phases = sorted((faults.rng.choice(likely) for _ in range(per_run)), key=order.index)
            ranks = 1 + (runs % 3 > 0)
            yield partial(faults.kills, phases, ranks)
            runs += 1

    faults.tried("kill -9 of a rank, several times a run", "any", killing())
    _, *ended = faults.rows.pop()
    faults.rows.append((f"kill -9 of a rank, {faults.killed} times in all, up to {per_run} times a run", *ended))
    orders = [[2, 1]] if few else [[1, 2, 3, 4], [4, 3, 2, 1], [2, 4, 1, 3]]
    faults.tried("killed, continued on other ranks", "loop", [lambda o=o: faults.other_ranks(o) for o in orders])
    if few:
        return faults
    for name, which in (("SIGUSR1", signal.SIGUSR1), ("SIGTERM", signal.SIGTERM)):
        faults.tried(name, "loop", [lambda n=n, which=which: faults.signalled(which, n) for n in (1, 2, 2)])
    harms = [faults.flip, faults.flip, faults.cut]
    faults.tried("last checkpoint damaged", "resume", [lambda harm=harm: faults.damaged(harm) for harm in harms])
    faults.tried("both checkpoints damaged", "resume", [lambda: faults.damaged(faults.flip, both=True)])
    faults.tried("rank stopped for 5 s", "loop", [lambda r=r: faults.stopped(r, [(5, 0)]) for r in (0, 1)])
    faults.tried("rank slow by 10x", "loop", [lambda r=r: faults.stopped(r, [(0.09, 0.01)] * 50) for r in (0, 1)])
    faults.tried("partition missing", "resume", [lambda: faults.model(_no_partition)])
    faults.tried("model of another version", "resume", [lambda: faults.model(_other_layout)])
    faults.tried("model damaged", "resume", [lambda: faults.model(_damaged_model)])
    faults.tried("missing library", "start", [
        lambda library=library, n=n: faults.without(library, n)
        for library, n in (("h5py", 1), ("h5py", 2), ("mpi4py", 2), ("pymetis", 2), ("numba", 2))
    ])  # fmt: skip
    faults.tried("another deck", "resume", [lambda: faults.refused(["--set", "solver.safety=0.7"], "solver.safety")])
    faults.tried("another partition", "resume", [faults.another_partition])
    if can_mount():
        full = [lambda k=k: faults.disc_full(k) for k in (100, 300, 500, 700, 900, 1200)]
        full += [lambda: faults.disc_full(5000, late=True)] * 4
        faults.tried("disc full", "build, partition, start, checkpoint", full)
        faults.tried(
            "read-only folder", "start, resume", [lambda late=late: faults.read_only(late) for late in (False, True)]
        )
    more = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    faults.tried("two threads a rank", "always", [lambda: faults.otherwise(**more)])
    faults.tried("kernels compiled anew", "always", [lambda: faults.otherwise(NUMBA_CACHE_DIR=str(top / "kernels"))])
    if shutil.which("gcc"):
        faults.tried("clock leaps by a day", "always", [faults.clock])
    return faults


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        made = inject(Path(folder), int(sys.argv[1]) if len(sys.argv) > 1 else 100)
    print(made.table())
    sys.exit(not made.all_survived)
