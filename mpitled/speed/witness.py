"""What a step does, seen at its kernels: which of them each term calls, and with which arrays."""

from __future__ import annotations

import inspect
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from mpitled import kernels


@dataclass(frozen=True, slots=True)
class Call:
    """One call of a kernel; arguments by the names that the kernel gives them."""

    term: str
    kernel: str
    arrays: dict[str, NDArray[Any]]
    absent: tuple[str, ...]  # arguments that are None, whose branches numba leaves out
    written: tuple[str, ...]  # arrays whose bits changed

    @property
    def traffic(self) -> int:
        """Bytes that have to pass between memory and core at least: each array once in, and once out if changed."""
        return sum(array.nbytes * (1 + (name in self.written)) for name, array in self.arrays.items())


def kernel_names() -> tuple[str, ...]:
    """All kernels that a term can call."""
    return tuple(name for name, value in vars(kernels).items() if _is_kernel(name, value))


def witness(terms: Sequence[tuple[str, Callable[[], object]]]) -> list[Call]:
    """Do each of the named terms once, and tell every call of a kernel, in order."""
    calls: list[Call] = []
    with _watched(calls) as now:
        for name, act in terms:
            now[0] = name
            act()
    return calls


def distinct_bytes(calls: Sequence[Call]) -> int:
    """Bytes of all arrays of the calls, each counted once."""
    arrays = {array.__array_interface__["data"][0]: array.nbytes for call in calls for array in call.arrays.values()}
    return sum(arrays.values())


def _is_kernel(name: str, value: object) -> bool:
    return isinstance(value, Dispatcher) and not name.startswith("_")


def _print(array: NDArray[Any]) -> int:
    return zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data)


@contextmanager
def _watched(calls: list[Call]) -> Iterator[list[str]]:
    """Every kernel tells of its calls until the block ends; yields a list of one, the term that is being done."""
    now = [""]

    def watch(name: str, kernel: Dispatcher) -> Callable[..., Any]:
        names = tuple(inspect.signature(kernel.py_func).parameters)

        def watched(*arguments: Any) -> Any:
            given = dict(zip(names, arguments, strict=True))
            arrays = {k: v for k, v in given.items() if isinstance(v, np.ndarray)}
            before = {k: _print(v) for k, v in arrays.items()}
            result = kernel(*arguments)
            written = tuple(k for k, v in arrays.items() if _print(v) != before[k])
            calls.append(Call(now[0], name, arrays, tuple(k for k, v in given.items() if v is None), written))
            return result

        return watched

    originals = {name: value for name, value in vars(kernels).items() if _is_kernel(name, value)}
    try:
        for name, kernel in originals.items():
            setattr(kernels, name, watch(name, kernel))
        yield now
    finally:
        for name, kernel in originals.items():
            setattr(kernels, name, kernel)
