"""Parallel scaling on one machine: N ranks, and N simultaneous runs of one rank, which share the memory as well."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import models
from flops import count_operations
from step_benchmark import RATE, start_workers

from mpitled import job

#: Sizes of the scenes of strong scaling, and the elements along each edge of a rank's block in weak scaling.
STRONG: dict[str, Any] = {"mixed": 4.0, "voxel": 100}
WEAK = 64


def measure(folder: Path, ranks: Sequence[int], quick: bool) -> str:
    """A table: cells per second and core on N ranks, and their ratio to those of N separate runs of one rank."""
    task = {"operations": count_operations(folder), "quick": quick}
    strong = {scene: models.SIZES[scene][0] for scene in STRONG} if quick else STRONG
    edge = models.SIZES["voxel"][0] if quick else WEAK
    whole = {scene: models.build(folder / scene, scene, size) for scene, size in strong.items()}
    one = models.build(folder / "weak-1", "voxel", edge)
    lines = [
        f"{'scaling':9}{'scene':9}{'ranks':>6}{'cells':>9}{'M cells/s/core':>16}{'separate':>10}{'efficiency':>12}"
        f"{'halo':>7}"
    ]
    for n in ranks:
        pairs = [("strong", scene, scene) for scene in whole.values()]
        pairs.append(("weak", models.build(folder / f"weak-{n}-ranks", "voxel", [n * edge, edge, edge]), one))
        for kind, together, separate in pairs:
            if n > 1:
                job.divide(Path(together["model"]), n, 0)
            (case,) = _double(start_workers(folder, task | {"scenes": [together]}, n))
            alone = _double(start_workers(folder, task | {"scenes": [separate]}, 1, n))
            rate = sum(each[RATE] for each in alone) / n
            lines.append(
                f"{kind:9}{case['scene']:9}{n:6}{case['cells']:9}{case[RATE]:16.1f}{rate:10.1f}"
                f"{case[RATE] / rate:12.1%}{case['halo_share']:7.1%}"
            )
    return "\n".join(lines)


def _double(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The cases in double precision."""
    return [case for result in results for case in result["cases"] if case["precision"] == "float64"]
