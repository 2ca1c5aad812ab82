"""How speed goes with ranks on this machine: N ranks beside N runs of one rank at once, which share memory alike."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mpitled import job
from mpitled.speed import bench

#: Scenes of strong scaling, and the elements along each edge of the block that each rank has in weak scaling.
STRONG: dict[str, Any] = {"mixed": 4.0, "voxel": 100}
WEAK = 64
PRECISION = "float64"


def measure(ranks: Sequence[int], quick: bool) -> str:
    """A table: cells a second and core on N ranks, over those of N runs of one rank side by side."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="mpitled-bench-") as made:
        folder = Path(made)
        task = {"operations": bench.operations(folder), "quick": quick}
        strong = {kind: size if not quick else bench.SIZES[kind][0] for kind, size in STRONG.items()}
        edge = WEAK if not quick else bench.SIZES["voxel"][0]
        alone = {kind: bench.scene(folder / kind, kind, size) for kind, size in strong.items()}
        one = bench.scene(folder / "weak-1", "voxel", edge)
        for n in ranks:
            for kind, scene in alone.items():
                rows.append(("strong", kind, n, *_compared(folder, task, scene, scene, n)))
            many = bench.scene(folder / f"weak-{n}-ranks", "voxel", [n * edge, edge, edge])
            rows.append(("weak", "voxel", n, *_compared(folder, task, many, one, n)))
    head = ("scaling", "scene", "ranks", "cells", "M cells/s/core", "apart", "efficiency", "halo")
    lines = ["{:9}{:9}{:>6}{:>9}{:>16}{:>8}{:>12}{:>7}".format(*head)]
    for kind, name, n, cells, rate, apart, halo in rows:
        lines.append(f"{kind:9}{name:9}{n:6}{cells:9}{rate:16.1f}{apart:8.1f}{rate / apart:12.1%}{halo:7.1%}")
    return "\n".join(lines)


def _compared(
    folder: Path, task: dict[str, Any], together: dict[str, Any], apart: dict[str, Any], n: int
) -> tuple[int, float, float, float]:
    """Cells of a scene, their rate on n ranks, that of n runs of one rank at once on another scene, and halo share."""
    if n > 1:
        job.divide(Path(together["model"]), n, 0)
    (of_ranks,) = bench.timed(folder, task | {"scenes": [together]}, n)
    of_runs = bench.timed(folder, task | {"scenes": [apart]}, 1, copies=n)
    (made,) = (case for case in of_ranks["cases"] if case["precision"] == PRECISION)
    rates = [case[bench.RATE] for run in of_runs for case in run["cases"] if case["precision"] == PRECISION]
    return made["cells"], made[bench.RATE], sum(rates) / n, made["halo_share"]
