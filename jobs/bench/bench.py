"""Speed of the composed step on fixed scenes, in cells per second, compared with the limits of the machine.

python jobs/bench/bench.py [--json FILE] [--compare OLD.json] [--ranks 1,2] [--quick] [--scaling | --ablation]
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import ablation
import models
import scaling
from flops import count_operations
from step_benchmark import RATE, start_workers

from mpitled import job

#: A case counts as slower below this share of its old speed. Medians on a quiet machine differ by 5 %.
SLOWER = 0.9


def whole_numbers(text: str) -> list[int]:
    """Numbers above 0 from "1,2"; the type of an argument."""
    numbers = [int(word) for word in text.split(",")]
    if min(numbers) < 1:
        raise ValueError
    return numbers


def load_old(path: str) -> dict[str, Any]:
    """The result in a file that --json wrote; the type of an argument."""
    try:
        old = json.loads(Path(path).read_text())
        if {(*_key(case), case[RATE]) for case in old["cases"]}:
            return old
    except OSError as error:
        raise argparse.ArgumentTypeError(f"{path}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        pass
    raise argparse.ArgumentTypeError(f"{path}: no result of a benchmark; give a file that --json wrote")


def measure(folder: Path, ranks: Sequence[int], quick: bool, old: dict[str, Any] | None) -> dict[str, Any]:
    """Build the scenes in a folder and time each case on each number of ranks.

    A case that is slower than in `old` is timed again, and the better result counts.
    """
    scenes = []
    for scene, sizes in models.SIZES.items():
        for size in sizes[:1] if quick else sizes:
            print(f"building {scene} {size}", file=sys.stderr, flush=True)
            scenes.append(models.build(folder / f"{scene}-{size}", scene, size))
            for n in ranks:
                if n > 1:
                    job.divide(Path(scenes[-1]["model"]), n, 0)
    task = {"scenes": scenes, "operations": count_operations(folder), "quick": quick}
    (result,) = start_workers(folder, task, ranks[0])
    for n in ranks[1:]:
        result["cases"] += start_workers(folder, task, n)[0]["cases"]
    for n in ranks:
        slower = {case["scene"] for case, ratio in ratios(result, old) if ratio < SLOWER and case["ranks"] == n}
        if slower:
            again = task | {"scenes": [scene for scene in scenes if scene["scene"] in slower]}
            better = {_key(case): case for case in start_workers(folder, again, n)[0]["cases"]}
            result["cases"] = [max(c, better.get(_key(c), c), key=lambda c: c[RATE]) for c in result["cases"]]
    return {"machine": _machine(), "commit": _commit(), **result}


def _key(case: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(case[name] for name in ("scene", "cells", "precision", "ranks"))


def ratios(new: dict[str, Any], old: dict[str, Any] | None) -> list[tuple[dict[str, Any], float]]:
    """The cases that both results have, with the new speed over the old."""
    known = {_key(case): case[RATE] for case in old["cases"]} if old else {}
    return [(case, case[RATE] / known[_key(case)]) for case in new["cases"] if _key(case) in known]


def table(result: dict[str, Any]) -> str:
    """The limits of the machine, then a line for each case."""
    limits = result["limits"]
    rates = ", ".join(f"{rate / 1e9:.1f} G/s ({name})" for name, rate in limits["multiply_adds_per_second"].items())
    lines = [
        f"one core: {limits['triad_bytes_per_second'] / 1e9:.1f} GB/s from memory (triad), multiply-adds {rates}",
        f"{'scene':11}{'cells':>8} {'precision':10}{'ranks':>6}{'M cells/s/core':>16}{'bytes/cell':>12}{'halo':>8}"
        f"{'roofline':>10}{'bound by memory':>17}",
    ]
    for case in result["cases"]:
        lines.append(
            f"{case['scene']:11}{case['cells']:8} {case['precision']:10}{case['ranks']:6}{case[RATE]:16.1f}"
            f"{case['bytes_per_cell']:12.0f}{case['halo_share']:8.1%}{case['roofline_share']:10.0%}"
            f"{case['memory_share_of_bound']:17.0%}"
        )
    return "\n".join(lines)


def compare(new: dict[str, Any], old: dict[str, Any]) -> bool:
    """Print the ratios of speeds; whether a case is slower."""
    print(f"{'scene':11}{'cells':>8} {'precision':10}{'ranks':>6}{'new/old':>9}")
    for case, ratio in ratios(new, old):
        mark = "  slower" if ratio < SLOWER else ""
        print(f"{case['scene']:11}{case['cells']:8} {case['precision']:10}{case['ranks']:6}{ratio:9.2f}{mark}")
    if new["machine"] != old.get("machine"):
        print("note: the old result is from another machine or other versions")
    return any(ratio < SLOWER for _, ratio in ratios(new, old))


def _machine() -> dict[str, Any]:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "numba", "llvmlite")}
    return {
        "processor": (*names, platform.processor(), platform.machine())[0],
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {"python": platform.python_version(), **versions},
    }


def _commit() -> str:
    """The commit of the program; "" outside of a clone."""
    command = ["git", "-C", str(Path(job.__file__).parent), "describe", "--always", "--abbrev=40", "--dirty"]
    done = subprocess.run([*command, "--exclude=*"], capture_output=True, text=True)
    return done.stdout.strip()


def main(words: Sequence[str] | None = None) -> int:
    """Exit status 1 if a case is slower than in --compare."""
    two = (os.cpu_count() or 1) > 1 and shutil.which("mpirun")
    parser = argparse.ArgumentParser(description="Speed of the step on fixed scenes.")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result")
    parser.add_argument("--compare", type=load_old, metavar="OLD.json", help="exit status 1 if a case is 10 %% slower")
    parser.add_argument(
        "--ranks", type=whole_numbers, default=[1, 2] if two else [1], metavar="N,...", help="numbers of ranks"
    )
    parser.add_argument("--quick", action="store_true", help="only the smallest size of each scene, in less time")
    other = parser.add_mutually_exclusive_group()
    other.add_argument("--scaling", action="store_true", help="instead: N ranks and N simultaneous runs of one rank")
    other.add_argument("--ablation", action="store_true", help="instead: the cost of each feature of a scene")
    options = parser.parse_args(words)
    with tempfile.TemporaryDirectory(prefix="mpitled-bench-") as name:
        if options.ablation:
            print(ablation.measure(Path(name), options.quick))
            return 0
        if options.scaling:
            print(scaling.measure(Path(name), options.ranks, options.quick))
            return 0
        result = measure(Path(name), options.ranks, options.quick, options.compare)
    print(table(result))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    if options.compare and not ratios(result, options.compare):
        parser.error("--compare: the results have no case in common; compare runs of the same scenes and ranks")
    return int(bool(options.compare) and compare(result, options.compare))


if __name__ == "__main__":
    sys.exit(main())
