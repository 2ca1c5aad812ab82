"""Compares the kernels of two source trees: runs the benchmark of each in turn and prints the ratio of their speeds.

python jobs/bench/paired.py OLD_TREE NEW_TREE [--pairs 5] [-- OPTIONS OF bench.py]   (default: --quick --ranks 1)

A tree is a worktree or clone. Each one is measured by its own bench.py, or by `mpitled bench` in commits before it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

RATE = "million_cell_updates_per_second_per_core"


def measure(tree: Path, options: list[str]) -> dict[tuple[Any, ...], float]:
    """Million cells per second and core of each case (scene, cells, precision, ranks) of a tree."""
    script = tree / "jobs" / "bench" / "bench.py"
    command = [sys.executable, *([str(script)] if script.exists() else ["-m", "mpitled", "bench"])]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.json"
        environment = os.environ | {"PYTHONPATH": str(tree)}
        command += [*options, "--json", str(path)]
        subprocess.run(command, env=environment, cwd=tree, stdout=subprocess.DEVNULL, check=True)
        cases = json.loads(path.read_text())["cases"]
    return {(case["scene"], case["cells"], case["precision"], case["ranks"]): case[RATE] for case in cases}


def main() -> None:
    """Print a line for each case: medians of both trees, and the median, lowest and highest ratio of the pairs."""
    parser = argparse.ArgumentParser(description="Speed of the kernels of a new source tree over an old one.")
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("options", nargs="*", help="options of bench.py, after --")
    arguments = parser.parse_args()
    pairs = []
    for i in range(arguments.pairs):
        order = slice(None, None, 1 if i % 2 == 0 else -1)  # the new tree is first in every second pair
        trees = [arguments.old.resolve(), arguments.new.resolve()][order]
        results = [measure(tree, arguments.options or ["--quick", "--ranks", "1"]) for tree in trees]
        pairs.append(results[order])
    print("scene         cells precision  ranks      old      new  new/old   from     to")
    for case in [case for case in pairs[0][0] if case in pairs[0][1]]:
        old, new = ([pair[i][case] for pair in pairs] for i in (0, 1))
        ratios = [b / a for a, b in zip(old, new, strict=True)]
        scene, cells, precision, ranks = case
        print(
            f"{scene:11}{cells:8} {precision:10}{ranks:6}{statistics.median(old):9.1f}{statistics.median(new):9.1f}"
            f"{statistics.median(ratios):9.3f}{min(ratios):7.3f}{max(ratios):7.3f}"
        )


if __name__ == "__main__":
    main()
