"""The speed of the composed step on fixed scenes, in cells a second, against what the machine could do at best."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mpitled import job, store
from mpitled.batch import launch
from mpitled.deck import Deck, Support, load_deck
from mpitled.errors import InputError
from mpitled.model import build as model_build
from mpitled.parallel.halo import World
from mpitled.speed import flops

#: A case is slower than it was below this share of its speed. Medians of two runs on a quiet machine differ by 5 %.
SLOWER = 0.9
RATE = "million_cell_updates_per_second_per_core"
#: What is written of each case.
COLUMNS = ("scene", "cells", "precision", "ranks", RATE, "bytes_per_cell", "halo_share", "roofline_share")
#: Nodes of a support domain in the cloud: the paper's.
DOMAIN_NODES = 8
#: What makes two cases the same.
SAME = ("scene", "cells", "precision", "ranks")

_BLOCK = """
[block]
size = [96.0, 96.0, 96.0]
elements = {elements}
cloud = "{cloud}"
[support]
nodes = {nodes}
consistency = false
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[fixed]]
nodes = "z0"
[[displaced]]
nodes = "z1"
directions = ["z"]
displacement = [-1.0]
"""
_HEAD = """
[ellipsoid]
semi_axes = [90.0, 70.0, 65.0]
element_size = 4.0
cloud = "core"
[tumour]
centre = [0.0, 0.0, 0.0]
volume = 4188.8
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[fixed]]
nodes = "surface"
"""
#: The repository's own brain, where this is a clone of it.
_BRAIN = Path(__file__).parents[2] / "jobs" / "brain_tumour.toml"
#: What each kind of scene is built from.
SIZES: dict[str, tuple[Any, ...]] = {
    "voxel": (20, 40, 80),  # elements along each edge
    "distorted": (20, 40, 80),
    "cloud": (16, 28, 48),
    "mixed": (6.0, 4.0, 2.0),  # mm, edge of a hexahedron
}
#: Small models in which the operations of each kind of cell are counted: whole runs, whole batches.
_COUNTED = {"voxel": [32, 2, 2], "distorted": [4, 4, 2], "cloud": [6, 6, 6]}
#: Shift of a distorted block's inner nodes at random, as a share of the edge.
_DISTORTION = 0.15


def default_ranks() -> list[int]:
    """One, and two where there are the cores and the MPI for it."""
    return [1, 2] if (os.cpu_count() or 1) > 1 and shutil.which("mpirun") else [1]


def check_ranks(ranks: Sequence[int]) -> None:
    """InputError unless so many ranks can be started here."""
    if World().size > 1:
        raise InputError("bench: starts ranks of its own; run it without mpirun, with --ranks 1,2")
    if max(ranks) > 1 and shutil.which("mpirun") is None:
        raise InputError("bench: there is no mpirun for more than one rank; give --ranks 1")


def bench(ranks: Sequence[int], quick: bool, old: dict[str, Any] | None = None) -> dict[str, Any]:
    """Build the scenes and time every case on each number of ranks: what is written as JSON.

    Cases that look slower than in an `old` outcome are timed once more, and the better counts.
    """
    with tempfile.TemporaryDirectory(prefix="mpitled-bench-") as name:
        folder = Path(name)
        scenes = []
        for kind, sizes in SIZES.items():
            for size in sizes[:1] if quick else sizes:
                _say(f"building {kind} {size}")
                scenes.append(scene(folder / f"{kind}-{size}", kind, size))
                for n in ranks:
                    if n > 1:
                        job.divide(Path(scenes[-1]["model"]), n, 0)
        task = {"scenes": scenes, "operations": operations(folder), "quick": quick}
        outcomes = [timed(folder, task, n)[0] for n in ranks]
        result = {
            "machine": _machine(),
            "commit": _commit(),
            "limits": outcomes[0]["limits"],
            "cases": [case for outcome in outcomes for case in outcome["cases"]],
        }
        for n in ranks:
            slower = {case["scene"] for case, ratio in compared(result, old) if ratio < SLOWER and case["ranks"] == n}
            if slower:
                task["scenes"] = [each for each in scenes if each["scene"] in slower]
                _keep_better(result["cases"], timed(folder, task, n)[0]["cases"])
        return result


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def timed(folder: Path, task: dict[str, Any], ranks: int, copies: int = 1) -> list[dict[str, Any]]:
    """What each of some copies at once of a program on so many ranks finds of its scenes: see `pace.main`."""
    path = folder / "task.json"
    path.write_text(json.dumps(task))
    words = [*launch.ranked(ranks), sys.executable, "-c", "from mpitled.speed.pace import main; main()", str(path)]
    started = [subprocess.Popen(words, stdout=subprocess.PIPE, text=True) for _ in range(copies)]
    said = [process.communicate()[0] for process in started]
    if failed := [process.returncode for process in started if process.returncode]:
        raise RuntimeError(f"bench: {ranks} ranks ended with {failed[0]}")
    return [dict(json.loads(text)) for text in said]


def _key(case: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(case[name] for name in SAME)


def _keep_better(cases: list[dict[str, Any]], again: list[dict[str, Any]]) -> None:
    for case in again:
        i = [_key(known) for known in cases].index(_key(case))
        cases[i] = max(cases[i], case, key=lambda known: known[RATE])


def compared(new: dict[str, Any], old: dict[str, Any] | None) -> list[tuple[dict[str, Any], float]]:
    """The cases that both outcomes have, with their speed over what it was."""
    known = {_key(case): case[RATE] for case in (old or {"cases": ()})["cases"]}
    return [(case, case[RATE] / known[_key(case)]) for case in new["cases"] if _key(case) in known]


def load(path: Path) -> dict[str, Any]:
    """An outcome that `write` wrote. InputError if it is none."""
    try:
        outcome = json.loads(path.read_text())
        if {(*_key(case), case[RATE]) for case in outcome["cases"]}:
            return dict(outcome)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give what 'mpitled bench --json FILE' wrote") from None
    except (ValueError, KeyError, TypeError):
        pass
    raise InputError(f"{path}: is no outcome of a benchmark; give what 'mpitled bench --json FILE' wrote")


def write(outcome: dict[str, Any], path: Path) -> None:
    """The outcome as JSON; of each case no more than `COLUMNS`. InputError if it cannot be written."""
    cases = [{name: case[name] for name in COLUMNS} for case in outcome["cases"]]
    try:
        path.write_text(json.dumps(outcome | {"cases": cases}, indent=1) + "\n")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give a file that can be written") from None


def table(outcome: dict[str, Any]) -> str:
    """The limits of the machine, then a line for each case, for the terminal."""
    limits = outcome["limits"]
    rates = ", ".join(f"{rate / 1e9:.1f} G/s ({name})" for name, rate in limits["multiply_adds_per_second"].items())
    lines = [
        f"one core: {limits['triad_bytes_per_second'] / 1e9:.1f} GB/s from memory (triad), multiply-adds {rates}",
        f"{'scene':11}{'cells':>8} {'precision':10}{'ranks':>6}{'M cells/s/core':>16}{'bytes/cell':>12}{'halo':>8}"
        f"{'roofline':>10}  bound by",
    ]
    for case in outcome["cases"]:
        memory = case["memory_share_of_bound"]
        bound = "memory" if memory > 0.9 else "arithmetic" if memory < 0.1 else f"memory {memory:.0%}, arithmetic"
        lines.append(
            f"{case['scene']:11}{case['cells']:8} {case['precision']:10}{case['ranks']:6}"
            f"{case[RATE]:16.1f}{case['bytes_per_cell']:12.0f}{case['halo_share']:8.1%}"
            f"{case['roofline_share']:10.0%}  {bound}"
        )
    return "\n".join(lines)


def comparison(new: dict[str, Any], old: dict[str, Any]) -> tuple[str, bool]:
    """A line for each case that both have, and whether any is slower than `SLOWER` of what it was."""
    pairs = compared(new, old)
    if not pairs:
        raise InputError("bench: has no case in common with what it is compared with; compare runs of the same scenes")
    lines = [f"{'scene':11}{'cells':>8} {'precision':10}{'ranks':>6}{'new/old':>9}"]
    for case, ratio in pairs:
        mark = "  slower" if ratio < SLOWER else ""
        lines.append(f"{case['scene']:11}{case['cells']:8} {case['precision']:10}{case['ranks']:6}{ratio:9.2f}{mark}")
    if new["machine"] != old.get("machine"):
        lines.append("note: another machine, or other versions, than before")
    return "\n".join(lines), any(ratio < SLOWER for _, ratio in pairs)


def _machine() -> dict[str, Any]:
    processor = platform.processor() or platform.machine()
    try:
        told = Path("/proc/cpuinfo").read_text()
        processor = next(line.partition(":")[2].strip() for line in told.splitlines() if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "numba", "llvmlite")}
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {"python": platform.python_version(), **versions},
    }


def _commit() -> str:
    """The commit that this program is at, "" if it is no clone."""
    words = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def scene(folder: Path, kind: str, size: Any, nodes: int = DOMAIN_NODES) -> dict[str, Any]:
    """Build one scene in a folder of its own, and say what a process needs to know of it."""
    folder.mkdir()
    deck = _deck(folder, kind, size, nodes)
    model = folder / job.MODEL
    mesh = model_build.read_mesh(deck)
    if kind == "distorted":
        assert deck.block is not None
        inner = np.setdiff1d(np.arange(mesh.n_nodes), mesh.node_sets["surface"])
        points = mesh.points.copy()
        edge = np.array(deck.block.size) / deck.block.elements
        points[inner] += np.random.default_rng(0).uniform(-_DISTORTION, _DISTORTION, (len(inner), 3)) * edge
        mesh = replace(mesh, points=points)
    store.write_model(model, model_build.discretise(deck, mesh), "bench")
    return {
        "scene": kind,
        "size": size,
        "model": str(model),
        "hourglass": deck.hexahedra.hourglass,
        "stabilisation": deck.support.stabilisation,
    }


def _deck(folder: Path, scene: str, size: Any, nodes: int) -> Deck:
    if scene == "mixed" and _BRAIN.exists():
        return load_deck(_BRAIN, [f"labels.element_size={size}"])
    path = folder / "scene.toml"
    if scene == "mixed":
        path.write_text(_HEAD)
        return load_deck(path, [f"ellipsoid.element_size={size}"])
    elements = size if isinstance(size, list) else [size] * 3
    path.write_text(_BLOCK.format(elements=elements, cloud="all" if scene == "cloud" else "none", nodes=nodes))
    return load_deck(path)


def operations(folder: Path) -> dict[str, dict[str, float]]:
    """Floating-point operations of each term, per cell or node, by scene."""
    scenes = [scene(folder / f"count-{kind}", kind, size) for kind, size in _COUNTED.items()]
    default = scene(folder / "count-mixed", "cloud", _COUNTED["cloud"], Support().nodes)
    models = [Path(each["model"]) for each in (*scenes, default)]
    counted = flops.of_terms(models, scenes[0]["stabilisation"])
    voxel, distorted, cloud, mixed = counted
    return {"voxel": voxel, "distorted": distorted, "cloud": cloud, "mixed": {**voxel, **distorted, **mixed}}
