"""Counts the floating-point operations of a step's terms: the kernels, uncompiled, compute with numbers that count."""

from __future__ import annotations

import json
import math
import operator
import os
import subprocess
import sys
from dataclasses import fields, is_dataclass, replace
from functools import partialmethod
from pathlib import Path
from typing import Any

import models
import numpy as np

from mpitled import store
from mpitled.deck import Solver, Support
from mpitled.kernels import BATCH_LANES
from mpitled.parallel.subdomain import localise
from mpitled.terms import Scene, State, Step

#: R_hg of the paper. Any value but 0 has the same operations.
HOURGLASS = 0.04 / 9
#: Small models in which operations are counted: their runs and batches are full.
COUNTED = {"voxel": [32, 2, 2], "distorted": [4, 4, 2], "cloud": [6, 6, 6]}


class Counting:
    """A number that counts additions, multiplications, divisions and roots; a multiply-add counts as two."""

    operations = 0
    __slots__ = ("value",)

    def __init__(self, value: float) -> None:
        self.value = value

    def sqrt(self) -> Counting:
        """What np.sqrt calls."""
        Counting.operations += 1
        return Counting(self.value**0.5)

    def log(self) -> Counting:
        """What np.log calls."""
        Counting.operations += 1
        return Counting(math.log(self.value))

    def __neg__(self) -> Counting:
        return Counting(-self.value)

    def __abs__(self) -> Counting:
        return Counting(abs(self.value))


def _define(name: str, function: Any, arithmetic: bool) -> None:
    def operate(self: Counting, other: Any, *, reflected: bool = False) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented  # numpy calls this for each number
        value = other.value if isinstance(other, Counting) else other
        result = function(value, self.value) if reflected else function(self.value, value)
        Counting.operations += arithmetic
        return Counting(result) if arithmetic else bool(result)

    setattr(Counting, f"__{name}__", operate)
    if arithmetic:
        setattr(Counting, f"__r{name}__", partialmethod(operate, reflected=True))


for _name in ("add", "sub", "mul", "truediv"):
    _define(_name, getattr(operator, _name), True)
for _name in ("lt", "le", "gt", "ge"):
    _define(_name, getattr(operator, _name), False)


def count_operations(folder: Path) -> dict[str, dict[str, float]]:
    """Operations of each term by scene: per cell, or per node for the terms that move nodes. Builds models in folder.

    They are counted in a separate process in which numba compiles nothing.
    """
    scenes = [models.build(folder / f"count-{scene}", scene, size) for scene, size in COUNTED.items()]
    scenes.append(models.build(folder / "count-mixed", "cloud", COUNTED["cloud"], Support().nodes))
    command = [sys.executable, __file__, str(scenes[0]["stabilisation"]), *(scene["model"] for scene in scenes)]
    done = subprocess.run(command, env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, stdout=subprocess.PIPE, check=True)
    voxel, distorted, cloud, mixed = json.loads(done.stdout)
    return {"voxel": voxel, "distorted": distorted, "cloud": cloud, "mixed": {**voxel, **distorted, **mixed}}


def _count(path: Path, stabilisation: float) -> dict[str, float]:
    rows = store.read_part(path, 1, 0)
    # Without the last batch of support domains, which is partly empty.
    full = lambda block: block.n_own // BATCH_LANES * BATCH_LANES if block.kind.meshfree else block.n_own  # noqa: E731
    rows = replace(rows, field_block="", blocks=tuple(replace(block, n_own=full(block)) for block in rows.blocks))
    sub = localise(rows, HOURGLASS, stabilisation, "mean")
    cells = {packed.name: packed.n_cells for packed in sub.packed}
    sub, state = _to_counting(sub), _to_counting(State.at_rest(sub, 1.0, 1e-6))
    counts = {}
    for term in Step(Scene(sub, Solver(method="quasi-static"))).terms:
        for field in fields(term) if is_dataclass(term) else ():
            value = getattr(term, field.name)
            if isinstance(value, np.ndarray) and value.dtype.kind == "f":
                setattr(term, field.name, np.frompyfunc(Counting, 1, 1)(value))
        before = Counting.operations
        term.apply(state)
        counts[term.name] = (Counting.operations - before) / cells.get(term.name, sub.n_nodes)
    return counts


def _to_counting(data: Any) -> Any:
    """A copy of nested dataclasses whose floating-point arrays count. The model's rows, which no step reads, stay."""
    if isinstance(data, tuple):
        return tuple(_to_counting(value) if is_dataclass(value) else value for value in data)
    changed: dict[str, Any] = {}
    for field in fields(data):
        value = getattr(data, field.name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            changed[field.name] = np.frompyfunc(Counting, 1, 1)(value)
        elif (is_dataclass(value) or isinstance(value, tuple)) and not isinstance(value, store.PartRows):
            changed[field.name] = _to_counting(value)
    return replace(data, **changed)


if __name__ == "__main__":
    print(json.dumps([_count(Path(path), float(sys.argv[1])) for path in sys.argv[2:]]))
