"""Inject faults into runs: `python tests/faults.py [KILLS]` prints a Markdown table of the runs that survived.

After each fault all processes must end within seconds with a true message. No incomplete file may claim to be
complete. The run, continued with --resume, must end with the bits of an undisturbed run, or within 1e-8 of the largest
displacement if the number of ranks changes. KILLS (100) are distributed at random over ranks and phases; with
fewer than 20 kills, only kills are tried. The exit status is 1 if any run does not survive.
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
from conftest import ENVIRONMENT, ROOT, ranks
from numpy.typing import NDArray
from scenes import MIXED, pulled

from mpitled import store
from mpitled.errors import InputError

#: Phases in which a rank is killed, as `run -v` names them, and the longest time (s) from their start to the kill.
PHASES = {
    "model": 0.5, "partition": 0.1, "read": 0.05, "compile": 0.3, "begin": 0.1, "loop": 2.0, "output": 1.0,
    "checkpoints": 1.0, "static distance": 0.3, "close": 0.02, "report": 0.1,
}  # fmt: skip
KILLS_PER_RUN = 5
END_SECONDS = 10  # within which all processes must end after a fault
TOLERANCE = 1e-8  # of the largest displacement, between different numbers of ranks
COMMAND = [sys.executable, "-c", "from mpitled.cli import main; main()"]
SCENE = f"""{MIXED}{pulled(4.0)}
[solver]
method = "quasi-static"
load_time = 25.0
[output]
frames = 12
pictures = false
checkpoint_minutes = 0.002
"""
#: Library that shifts the system clock by -1, 0 or 1 day, and changes the shift at every seventh call.
CLOCK = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/time.h>
#include <time.h>
static long shift(void) { static long n; return (n++ / 7 % 3 - 1) * 86400; }
int clock_gettime(clockid_t which, struct timespec *t) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int failed = real(which, t);
    if (which == CLOCK_REALTIME) t->tv_sec += shift();
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


class Job:
    """A run on some ranks, and the lines of its standard error."""

    def __init__(self, folder: Path, n_ranks: int = 2, *options: str, resume: bool = True, **environment: str) -> None:
        arguments = ["run", "-v", str(folder.parent / "scene.toml"), "--out", str(folder), *["--resume"] * resume]
        environment = {"PYTHONPATH": str(ROOT), **environment}
        self.process = subprocess.Popen(
            [*ranks(n_ranks), *COMMAND, *arguments, *options], env=ENVIRONMENT | environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, errors="replace",
            cwd=folder.parent,
        )  # fmt: skip
        self.n_ranks, self.lines = n_ranks, list[str]()
        # A full pipe would stop the run.
        self._reader = threading.Thread(target=lambda: self.lines.extend(self.process.stderr or ()), daemon=True)
        self._reader.start()

    def reaches(self, phase: str, seconds: float = 120) -> bool:
        """Wait for a phase; False if the job ends before it."""
        deadline = time.monotonic() + seconds
        while not any(line.rstrip().endswith(f": {phase}") for line in [*self.lines]):
            if self.process.poll() is not None or time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True

    def process_ids(self) -> list[int]:
        """Process identifiers of the ranks, in order."""
        if self.n_ranks == 1:
            return [self.process.pid]
        with contextlib.suppress(OSError):
            return [*map(int, Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split())]
        return []

    def signal(self, rank: int, which: int) -> None:
        with contextlib.suppress(IndexError, ProcessLookupError):
            os.kill(self.process_ids()[rank], which)

    def kill(self, rank: int = 0) -> int:
        """Kill a rank; the exit status of the job. AssertionError if any rank does not end in time."""
        self.signal(rank, signal.SIGKILL)
        return self.end(END_SECONDS)

    def end(self, seconds: float = 300) -> int:
        """The exit status. AssertionError if any process still runs after this time."""
        ids = self.process_ids()
        try:
            status = self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            for number in [*ids, self.process.pid]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)
            raise AssertionError(f"runs after {seconds} s") from None
        deadline = time.monotonic() + END_SECONDS
        while any(_runs(number) for number in ids):
            assert time.monotonic() < deadline, "a rank runs after the end of the job"
            time.sleep(0.02)
        self._reader.join(END_SECONDS)
        assert not any("Traceback" in line for line in self.lines), "".join(self.lines)
        return status

    def finish(self) -> None:
        """Wait for the end of the job. AssertionError unless it succeeds."""
        assert self.end() == 0, "".join(self.lines[-8:])

    def refused(self, *reasons: str) -> None:
        """AssertionError unless the job ends with exit status 2 and a message with one of the reasons."""
        status, messages = self.end(60), [line for line in self.lines if line.startswith("mpitled: ")]
        assert status == 2, f"status {status}: {self.lines[-12:]}"
        assert any(reason in line for line in messages[-1:] for reason in reasons), messages


def _runs(process_id: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


class Faults:
    """A scene, its undisturbed runs, and the table of faults."""

    def __init__(self, top: Path, seed: int = 0) -> None:
        self.top, self.rng, self.table = top, random.Random(seed), list[tuple[str, str, int, int]]()
        (top / "scene.toml").write_text(SCENE)
        self.kills = 0
        self._references: dict[int, list[NDArray[np.float64]]] = {}

    def folder(self, name: str, n_parts: int | None = 2) -> Path:
        """A new folder; with n_parts it holds the model and its partition into so many parts."""
        folder = self.top / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        if n_parts is not None:
            self.reference(n_parts)
            shutil.copy(self.top / f"reference_{n_parts}" / "model.h5", folder)
        return folder

    def reference(self, n_ranks: int) -> list[NDArray[np.float64]]:
        """The result of an undisturbed run."""
        if n_ranks not in self._references:
            folder = self.top / f"reference_{n_ranks}"
            Job(folder, n_ranks).finish()
            self._references[n_ranks] = self.read(folder)
        return self._references[n_ranks]

    @staticmethod
    def read(folder: Path) -> list[NDArray[np.float64]]:
        """Displacements and J of each frame, then times, series and energies. Checks every checksum."""
        with store.open_result(folder) as result:
            assert result.complete, f"{folder} is not complete"
            result.check()
            fields = [f(name, k) for k in range(result.n_frames)
                      for f, name in ((result.at_nodes, "parameters"), (result.in_cells, "J"))]  # fmt: skip
            return [*fields, result.times, *result.series.values(), np.array([*result.figures["energy_J"].values()])]

    def check_files(self, folder: Path) -> None:
        """AssertionError or InputError if a file in the folder claims to be complete and is incomplete or damaged."""
        checkpoint = folder / store.CHECKPOINTS[0]
        if (folder / "result.vtkhdf").exists():
            self.read(folder)
        elif checkpoint.exists():
            n_frames = store.checkpoint_contents(checkpoint)["frames"]
            with store.open_result(folder) as result:
                assert not result.complete
                assert result.n_frames >= n_frames, "frames were lost"
                result.check()
        for name, check in (
            ("model.h5", store.check_model),
            *((c, store.checkpoint_contents) for c in store.CHECKPOINTS),
        ):
            if (folder / name).exists():
                check(folder / name)

    def resume(self, folder: Path, n_ranks: int = 2, same_bits: bool = True) -> None:
        """Continue to the end. AssertionError unless the result has the bits of the undisturbed run, or is close."""
        Job(folder, n_ranks).finish()
        result, expected = self.read(folder), self.reference(n_ranks if same_bits else 1)
        if same_bits:
            assert all(a.tobytes() == b.tobytes() for a, b in zip(result, expected, strict=True)), "other bits"
        else:
            pairs = [(a, b) for a, b in zip(result, expected, strict=True) if a.ndim == 2]
            difference = max(np.abs(a - b).max() for a, b in pairs) / max(np.abs(b).max() for _, b in pairs)
            assert difference < TOLERANCE, f"differs by {difference:.1e}"

    def count(self, fault: str, phases: str, attempts: Iterable[Callable[[], None]]) -> None:
        """Make all attempts, and add the number of survived attempts to the table."""
        survived = n = 0
        for n, attempt in enumerate(attempts, 1):  # noqa: B007
            try:
                attempt()
                survived += 1
            except (AssertionError, InputError) as error:
                print(f"{fault}, {phases}: {error}", file=sys.stderr)
        self.table.append((fault, phases, survived, n))
        print(f"{fault}, {phases}: {survived} of {n}", file=sys.stderr, flush=True)

    def kill_in_phases(self, phases: list[str], n_ranks: int = 2) -> None:
        """A run that is killed in each of the phases in turn and resumed each time."""
        folder = self.folder("killed", None if phases[0] in ("model", "partition") else n_ranks)
        for phase in phases:
            job = Job(folder, n_ranks)
            if not job.reaches(phase):
                job.finish()  # the checkpoint is of a later phase
                continue
            time.sleep(self.rng.uniform(0, PHASES[phase]))
            status = job.kill(self.rng.randrange(n_ranks))
            self.kills += status != 0  # 0: the job was complete before
            message = any("exited on signal 9" in line for line in job.lines)  # of mpirun
            assert status == 0 or message or n_ranks == 1, f"no true message: {job.lines[-5:]}"
            self.check_files(folder)
        self.resume(folder, n_ranks)

    def send(self, which: int, n_ranks: int = 2) -> None:
        """A signal to the launcher."""
        folder = self.folder("signal", n_ranks)
        job = Job(folder, n_ranks)
        assert job.reaches("loop")
        time.sleep(self.rng.uniform(0, 0.6))
        job.process.send_signal(which)
        status = job.end(END_SECONDS)
        if which == signal.SIGUSR1:
            complete = (folder / "result.vtkhdf").exists()  # the report may be missing
            assert status == 4 or (complete and status == 0), f"status {status}"
            if not complete:
                assert any("interrupted" in line for line in job.lines), job.lines[-5:]
                assert store.checkpoint_contents(folder / store.CHECKPOINTS[0])["ranks"] == n_ranks
        self.check_files(folder)
        self.resume(folder, n_ranks)

    def change_ranks(self, numbers: list[int]) -> None:
        """A run that is killed and resumed on each number of ranks in turn."""
        folder = self.folder("ranks", None)
        for n_ranks in numbers[:-1]:
            job = Job(folder, n_ranks)
            assert job.reaches("checkpoints"), "".join(job.lines[-8:])
            time.sleep(self.rng.uniform(0, 0.5))
            job.kill(self.rng.randrange(n_ranks))
            self.check_files(folder)
        self.resume(folder, numbers[-1], same_bits=False)

    def pause(self, rank: int, stopped: float, running: float, times: int) -> None:
        """A rank that is stopped and continued in turn, for so many seconds each."""
        folder = self.folder("slow")
        job = Job(folder)
        assert job.reaches("loop")
        for _ in range(times):
            job.signal(rank, signal.SIGSTOP)
            time.sleep(stopped)
            job.signal(rank, signal.SIGCONT)
            time.sleep(running)
        job.finish()
        self.resume(folder)

    def killed_run(self, name: str) -> Path:
        """The folder of a run that was killed after two checkpoints."""
        folder = self.folder(name)
        job = Job(folder)
        while not (folder / store.CHECKPOINTS[1]).exists():
            assert job.process.poll() is None, "".join(job.lines)
            time.sleep(0.02)
        job.kill()
        return folder

    def damage(self, harm: Callable[[Path], None], n_checkpoints: int = 1) -> None:
        """Damaged checkpoints: the last one, or both."""
        folder = self.killed_run("damaged")
        for name in store.CHECKPOINTS[:n_checkpoints]:
            harm(folder / name)
        if n_checkpoints > 1:
            Job(folder).refused("checkpoint")
            Job(folder, resume=False).finish()
        self.resume(folder)

    def flip_bits(self, path: Path) -> None:
        data = bytearray(path.read_bytes())
        for _ in range(100):
            data[self.rng.randrange(len(data))] ^= 1 << self.rng.randrange(8)
        path.write_bytes(data)

    def truncate(self, path: Path) -> None:
        os.truncate(path, self.rng.randrange(path.stat().st_size))

    def fill_disc(self, kilobytes: int, late: bool = False) -> None:
        """A disc of this size; late: other files fill the disc during the run."""
        with _tmpfs(self.top / "disc", f"{kilobytes}k") as disc:
            job = Job(disc / "out")
            if late:
                assert job.reaches("checkpoints"), job.lines[-5:]
                with contextlib.suppress(OSError), (disc / "filler").open("wb", buffering=0) as filler:
                    while True:
                        filler.write(bytes(4096))
            job.refused("cannot be written", "are free there")
            if (disc / "out").exists():
                self.check_files(disc / "out")
            _mount("remount,size=200m", disc)
            self.resume(disc / "out")

    def protect(self, late: bool) -> None:
        """A read-only folder, at the start or at the resumption."""
        with _tmpfs(self.top / "disc", "200m") as disc:
            if late:
                job = Job(disc / "out")
                assert job.reaches("checkpoints")
                job.kill()
            _mount("remount,ro", disc)
            Job(disc / "out").refused("cannot be")
            _mount("remount,rw", disc)
            self.resume(disc / "out")

    def block_library(self, library: str, n_ranks: int) -> None:
        """A library that cannot be loaded."""
        folder, blocked = self.folder("blocked", None), self.top / "libraries"
        shutil.rmtree(blocked, ignore_errors=True)
        (blocked / library).mkdir(parents=True)
        reason = f"lib{library}.so: cannot open shared object file"
        (blocked / library / "__init__.py").write_text(f"raise ImportError({reason!r})")
        Job(folder, n_ranks, PYTHONPATH=f"{blocked}{os.pathsep}{ROOT}").refused(library)
        self.resume(folder, n_ranks)

    def change_model(self, harm: Callable[[h5py.File], None]) -> None:
        """A model that differs from the model of the killed run."""
        folder = self.killed_run("model")
        with h5py.File(folder / "model.h5", "r+") as file:
            harm(file)
        self.resume(folder)

    def shift_clock(self) -> None:
        source, library = self.top / "clock.c", self.top / "clock.so"
        source.write_text(CLOCK)
        subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
        folder = self.folder("clock")
        job = Job(folder, LD_PRELOAD=str(library))
        assert job.reaches("checkpoints"), "".join(job.lines)
        job.kill(1)
        Job(folder, LD_PRELOAD=str(library)).finish()
        self.resume(folder)

    def change_environment(self, **environment: str) -> None:
        """A complete run, with its model, in another environment."""
        folder = self.folder("environment", None)
        Job(folder, **environment).finish()
        self.resume(folder)
        assert (folder / "model.h5").read_bytes() == (self.top / "reference_2" / "model.h5").read_bytes()

    def change_partition(self) -> None:
        """Another partition is refused; the original partition is accepted."""
        folder = self.killed_run("partition")
        original = store.partition_mark(folder / "model.h5", 2)

        def differs(seed: int) -> bool:
            arguments = ["partition", str(folder), "2", "--seed", str(seed)]
            subprocess.run([*COMMAND, *arguments], env=ENVIRONMENT, cwd=ROOT, check=True, capture_output=True)
            return store.partition_mark(folder / "model.h5", 2) != original

        assert any(map(differs, range(1, 20))), "no other partition"
        Job(folder).refused("partition")
        assert not differs(0)
        self.resume(folder)

    def change_deck(self) -> None:
        folder = self.killed_run("deck")
        Job(folder, 2, "--set", "solver.safety=0.7").refused("solver.safety")
        self.resume(folder)


def _mount(options: str, folder: Path, *more: str) -> None:
    """Mount; tries again while a killed process still has open files in the folder."""
    deadline = time.monotonic() + END_SECONDS
    while (done := subprocess.run(["mount", *more, "-o", options, folder], capture_output=True)).returncode:
        if more or time.monotonic() > deadline:
            raise OSError(done.stderr)
        time.sleep(0.1)


@contextlib.contextmanager
def _tmpfs(folder: Path, size: str) -> Iterator[Path]:
    """A small disc with the deck."""
    folder.mkdir(exist_ok=True)
    _mount(f"size={size}", folder, "-t", "tmpfs", "tmpfs")
    try:
        (folder / "scene.toml").write_text(SCENE)
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=False)


def can_mount() -> bool:
    """Whether this process may mount a disc: it needs to be root, and a container must permit it."""
    with tempfile.TemporaryDirectory() as top, contextlib.suppress(OSError), _tmpfs(Path(top) / "disc", "1m"):
        return True
    return False


def _remove_partition(file: h5py.File) -> None:
    del file["partitions"]


def _change_layout(file: h5py.File) -> None:
    file.attrs["layout"] = 1


def _change_number(file: h5py.File) -> None:
    file["blocks/1/gradients"][3, 2, 1] *= 1 + 1e-9


def inject(top: Path, n_kills: int = 100, seed: int = 0) -> Faults:
    """Inject so many kills; of 20 and more, every fault."""
    faults, order = Faults(top, seed), [*PHASES]

    def runs() -> Iterator[Callable[[], None]]:
        n = 0
        while faults.kills < n_kills:
            chosen = faults.rng.choices([*order, "loop", "output", "checkpoints"], k=KILLS_PER_RUN)
            yield partial(faults.kill_in_phases, sorted(chosen, key=order.index), 1 + (n % 3 > 0))
            n += 1

    faults.count(f"kill -9 of a rank, {n_kills} times, up to {KILLS_PER_RUN} times a run", "any", runs())
    numbers = [[1, 2, 3, 4], [4, 3, 2, 1], [2, 4, 1, 3]] if n_kills >= 20 else [[2, 1]]
    faults.count("killed, continued on other ranks", "loop", [partial(faults.change_ranks, n) for n in numbers])
    if n_kills < 20:
        return faults
    slow = [(rank, *times) for times in ((5, 0, 1), (0.09, 0.01, 50)) for rank in (0, 1)]
    threads = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    libraries = (("h5py", 1), ("h5py", 2), ("mpi4py", 2), ("pymetis", 2), ("numba", 2))
    table: list[tuple[str, str, list[Callable[[], None]]]] = [
        ("SIGUSR1", "loop", [partial(faults.send, signal.SIGUSR1, n) for n in (1, 2, 2)]),
        ("SIGTERM", "loop", [partial(faults.send, signal.SIGTERM, n) for n in (1, 2, 2)]),
        ("last checkpoint damaged", "resume", [partial(faults.damage, f) for f in (faults.flip_bits, faults.truncate)]),
        ("both checkpoints damaged", "resume", [partial(faults.damage, faults.flip_bits, 2)]),
        ("rank stopped for 5 s; slow by 10x", "loop", [partial(faults.pause, *times) for times in slow]),
        ("partition missing", "resume", [partial(faults.change_model, _remove_partition)]),
        ("model of another version", "resume", [partial(faults.change_model, _change_layout)]),
        ("model damaged", "resume", [partial(faults.change_model, _change_number)]),
        ("missing library", "start", [partial(faults.block_library, *library) for library in libraries]),
        ("another deck", "resume", [faults.change_deck]),
        ("another partition", "resume", [faults.change_partition]),
        ("two threads a rank", "always", [partial(faults.change_environment, **threads)]),
        ("new cache of kernels", "always", [partial(faults.change_environment, NUMBA_CACHE_DIR=str(top / "kernels"))]),
    ]  # fmt: skip
    if can_mount():
        full = [partial(faults.fill_disc, size) for size in (100, 300, 500, 700, 900, 1200)]
        full += [partial(faults.fill_disc, 5000, late=True)] * 4
        table.append(("disc full", "build, partition, start, checkpoint", [*full]))
        table.append(("read-only folder", "start, resume", [partial(faults.protect, late) for late in (False, True)]))
    if shutil.which("gcc"):
        table.append(("clock shifted by a day", "always", [faults.shift_clock]))
    for fault, phases, attempts in table:
        faults.count(fault, phases, attempts)
    return faults


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        rows = inject(Path(folder), int(sys.argv[1]) if len(sys.argv) > 1 else 100).table
    print("| fault | when | survived |\n|---|---|---|")
    print(*(f"| {fault} | {phases} | {survived} of {n} |" for fault, phases, survived, n in rows), sep="\n")
    sys.exit(any(survived < n for *_, survived, n in rows))
