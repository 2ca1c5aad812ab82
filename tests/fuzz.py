"""Fuzz every reader: `python tests/fuzz.py` changes valid files at random, reads them and prints a table.

The table has, for each reader, the number of inputs, results, one-line errors, crashes (other exceptions) and hangs
(more than 15 s), and the largest memory. Exit status 1 after a crash or a hang. Each reader works in a separate process
with at most 1 GiB. The engine "hypothesis" chooses the changes by hypothesis, "atheris" by the coverage of the program
(pip install atheris).
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import os
import random
import resource
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hostile import Reader

ENGINES = ("random", "hypothesis", "atheris")
LONGEST_S, MOST_BYTES = 15, 1 << 30
#: Number of inputs of slow readers over the number of other readers.
SHARES = {"deck, with the time it takes": 0.1, "decks of a mixed mesh": 0.2, "model.h5": 0.5, "result.vtkhdf": 0.5}


# --- the worker process --------------------------------------------------------------------------------------------


def work(reader: Reader, engine: str, first: int, count: int, report: int, folder: Path) -> None:
    """Try inputs from number `first` on, and write the begin and the end of each to the descriptor `report`."""
    from hostile import attempt

    def write(word: str) -> None:
        os.write(report, word.encode() + b"\n")

    def one(rng: random.Random, name: object) -> None:
        write(f"begin {name}")
        signal.setitimer(signal.ITIMER_PROF, LONGEST_S)  # CPU time: other processes may use the machine
        try:
            write(attempt(reader, folder, rng))
        except TimeoutError:
            write("hang")
            traceback.print_exc()
        except (Exception, SystemExit):
            write("crash")
            traceback.print_exc()
        except BaseException:  # hypothesis ends an input in this way
            write("over")
            raise
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        write(f"memory {_peak()}")

    numbers = iter(range(first, first + count))
    if engine == "random":
        for number in numbers:
            one(random.Random(number), number)
    elif engine == "hypothesis":
        import hypothesis
        from hypothesis import strategies

        @hypothesis.seed(first)
        @hypothesis.settings(
            max_examples=count, database=None, deadline=None, phases=[hypothesis.Phase.generate],
            suppress_health_check=list(hypothesis.HealthCheck),
        )  # fmt: skip
        @hypothesis.given(strategies.randoms(use_true_random=False))
        def search(rng: random.Random) -> None:
            one(rng, next(numbers, "last"))

        search()
    else:
        import atheris

        class Directed(random.Random):
            """Random bits from the bytes of atheris, then zeros."""

            def __init__(self, data: bytes) -> None:
                self._data = atheris.FuzzedDataProvider(data)

            def random(self) -> float:
                return self.getrandbits(53) / (1 << 53)

            def getrandbits(self, k: int) -> int:
                return int.from_bytes(self._data.ConsumeBytes(-(-k // 8)), "little") & ((1 << k) - 1)

        limits = ["-max_len=512", "-rss_limit_mb=0", "-verbosity=0"]
        arguments = [sys.argv[0], f"-runs={count}", f"-seed={first + 1}", *limits]
        atheris.Setup(arguments, lambda data: one(Directed(data), next(numbers, "last")))
        atheris.Fuzz()


def _instrumented(engine: str) -> contextlib.AbstractContextManager[object]:
    """Imports with coverage instrumentation for atheris."""
    if engine != "atheris":
        return contextlib.nullcontext()
    import atheris

    return atheris.instrument_imports(include=["mpitled"])  # type: ignore[no-any-return]


def _too_long(*_: object) -> None:
    raise TimeoutError(f"took more than {LONGEST_S} s")


def _worker(name: str, engine: str, first: int, count: int, scratch: Path) -> None:
    report = os.dup(1)
    os.dup2(2, 1)  # output of libraries goes to the log
    faulthandler.enable()
    with _instrumented(engine):
        from hostile import readers

        reader = readers(scratch)[name]
    warnings.simplefilter("ignore", ResourceWarning)
    signal.signal(signal.SIGPROF, _too_long)
    most = MOST_BYTES + resource.getpagesize() * int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 30, 1 << 30))
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.suppress(FileNotFoundError):
            Path("/proc/self/clear_refs").write_text("5")  # resets the peak memory
        work(reader, engine, first, count, report, Path(folder))


def _peak() -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


# --- the table -----------------------------------------------------------------------------------------------------


def fuzz(name: str, count: int, engine: str, first: int, scratch: Path, log: Path) -> Counter[str]:
    """Counts of the ends of a reader's inputs, and "memory" in bytes; a dead worker is replaced."""
    ends: Counter[str] = Counter()
    with log.open("ab") as errors:
        while ends["tried"] < count:
            begun = first + ends["tried"]
            words = [sys.executable, __file__, "--worker", name, "--engine", engine, "--scratch", str(scratch)]
            words += ["--first", str(begun), "--count", str(count - ends["tried"])]
            process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=errors, stdin=subprocess.DEVNULL)
            before, died = ends["tried"], _follow(process, ends)
            if died and ends["tried"] == before:
                raise RuntimeError(f"{name}: its process ended with {process.returncode} before any input; see {log}")
            if not died:
                break
    return ends


def _follow(process: subprocess.Popen[bytes], ends: Counter[str]) -> bool:
    """Count the reports of a worker. True if the worker died, which counts as a crash or a hang."""
    assert process.stdout is not None
    at_work = False
    with process, selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while True:
            # The worker's timer, which counts CPU time only, normally comes first.
            if not selector.select(8 * LONGEST_S):
                process.kill()
                ends["hang"] += 1
                return True
            line = process.stdout.readline().decode().split()
            if not line:
                process.wait()
                ends["crash"] += at_work
                return at_work or process.returncode not in (0, None)
            at_work = line[0] == "begin"
            if at_work or line[0] == "over":
                ends["tried"] += 1 if at_work else -1
            elif line[0] == "memory":
                ends["memory"] = max(ends["memory"], int(line[1]))
            else:
                ends[line[0]] += 1


def table(rows: dict[str, Counter[str]]) -> str:
    """A Markdown table with a line for each reader."""
    lines = ["| reader | inputs | result | one line | crashes | hangs | largest memory |", "|" + 7 * "---|"]
    for name, ends in rows.items():
        counts = [ends[end] for end in ("tried", "result", "error", "crash", "hang")]
        memory = f"{ends['memory'] / 2**20:.0f} MiB" if ends["memory"] else "-"
        lines.append(f"| {name} | {' | '.join(f'{n:,}' for n in counts)} | {memory} |")
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=2000, help="inputs for each reader (%(default)s)")
    parser.add_argument("--engine", choices=ENGINES, default="random")
    parser.add_argument("--first", type=int, default=0, help="number of the first input (0)")
    parser.add_argument("--only", default="", help="readers whose names contain this")
    parser.add_argument("--log", type=Path, default=Path("fuzz.log"), help="log of errors (%(default)s)")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--scratch", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--count", type=int, dest="of_worker", help=argparse.SUPPRESS)
    options = parser.parse_args(words)
    if options.worker:
        _worker(options.worker, options.engine, options.first, options.of_worker, options.scratch)
        return 0
    from hostile import readers

    rows: dict[str, Counter[str]] = {}
    scratch, begin = Path(tempfile.mkdtemp()), time.perf_counter()
    try:
        for name in readers(scratch):
            if options.only.casefold() in name.casefold():
                count = max(1, round(options.count * SHARES.get(name, 1)))
                rows[name] = fuzz(name, count, options.engine, options.first, scratch, options.log)
                print(table({name: rows[name]}).splitlines()[-1], file=sys.stderr, flush=True)
    finally:
        shutil.rmtree(scratch)
    total = sum(ends["tried"] for ends in rows.values())
    wrong = sum(ends["crash"] + ends["hang"] for ends in rows.values())
    print(table(rows))
    print(f"{total:,} inputs in {time.perf_counter() - begin:.0f} s; {wrong} crashes and hangs")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
