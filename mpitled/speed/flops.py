"""Counts the floating-point operations of a step's terms, by running the kernels on numbers that count."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mpitled import store
from mpitled.deck import Solver
from mpitled.kernels import BATCH_LANES
from mpitled.parallel.subdomain import localise
from mpitled.terms import Scene, State, Step

#: R_hg of the paper: any that is not 0.
HOURGLASS = 0.04 / 9


class Counting:
    """A number; additions, multiplications, divisions and roots are counted, a multiply-add as two operations."""

    operations = 0
    __slots__ = ("value",)

    def __init__(self, value: float) -> None:
        self.value = value

    def sqrt(self) -> Counting:
        """What np.sqrt asks for."""
        Counting.operations += 1
        return Counting(self.value**0.5)

    def __neg__(self) -> Counting:
        return Counting(-self.value)

    def __abs__(self) -> Counting:
        return Counting(abs(self.value))

    def __lt__(self, other: Any) -> bool:
        return bool(self.value < _plain(other))

    def __le__(self, other: Any) -> bool:
        return bool(self.value <= _plain(other))

    def __gt__(self, other: Any) -> bool:
        return bool(self.value > _plain(other))

    def __ge__(self, other: Any) -> bool:
        return bool(self.value >= _plain(other))


def _plain(number: Any) -> Any:
    return number.value if isinstance(number, Counting) else number


def _counted(operation: Callable[[Any, Any], Any]) -> Callable[[Counting, Any], Counting]:
    def act(self: Counting, other: Any) -> Counting:
        if isinstance(other, np.ndarray):
            return NotImplemented  # each of its numbers for itself
        Counting.operations += 1
        return Counting(operation(self.value, _plain(other)))

    return act


for _name, _operation in {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "truediv": lambda a, b: a / b,
}.items():
    setattr(Counting, f"__{_name}__", _counted(_operation))
    setattr(Counting, f"__r{_name}__", _counted(lambda a, b, do=_operation: do(b, a)))  # type: ignore[misc]


def of_terms(models: Sequence[Path], stabilisation: float) -> list[dict[str, float]]:
    """Operations of each term of each model, per cell of the term's kind, or per node for the terms that move nodes.

    In a process of its own, where numba compiles nothing: models of a few cells will do, in which runs are whole.
    """
    words = [
        sys.executable,
        "-c",
        "from mpitled.speed.flops import main; main()",
        repr(stabilisation),
        *map(str, models),
    ]
    done = subprocess.run(words, env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"operations cannot be counted: {done.stderr}")
    return list(json.loads(done.stdout))


def main() -> None:
    """The process of its own: STABILISATION MODEL ...; prints JSON."""
    print(json.dumps([_count(Path(path), float(sys.argv[1])) for path in sys.argv[2:]]))


def _count(path: Path, stabilisation: float) -> dict[str, float]:
    rows = store.read_part(path, 1, 0)
    whole = rows.n_own_domains // BATCH_LANES * BATCH_LANES  # lanes that fill the last batch are no work of cells
    n_hexahedra = rows.n_own_hexahedra
    sub = localise(replace(rows, n_own_domains=whole), HOURGLASS, stabilisation, "mean")
    in_runs = sum(cells.n_cells for cells in sub.packed if cells.name == "voxel hexahedra")
    work = {"voxel hexahedra": in_runs, "hexahedra": n_hexahedra - in_runs, "support domains": whole}
    sub, state = (with_values(part, _to_counting) for part in (sub, State.at_rest(sub, 1.0, 1e-6)))
    terms = Step(Scene(sub, Solver(method="quasi-static"))).terms
    return {term.name: _operations(term.apply, state) / (work.get(term.name) or sub.n_nodes) for term in terms}


def _operations(act: Callable[..., None], state: Any) -> int:
    before = Counting.operations
    act(state)
    return Counting.operations - before


def with_values(data: Any, convert: Callable[[Any], Any]) -> Any:
    """A copy of nested data classes in which `convert` has been at every array of floating-point numbers.

    The rows of the model stay as they are: no step reads them.
    """
    changed = {}
    for field in fields(data):
        value = getattr(data, field.name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            changed[field.name] = convert(value)
        elif is_dataclass(value) and not isinstance(value, store.PartRows):
            changed[field.name] = with_values(value, convert)
    return replace(data, **changed)


def _to_counting(values: Any) -> Any:
    return np.frompyfunc(Counting, 1, 1)(values)
