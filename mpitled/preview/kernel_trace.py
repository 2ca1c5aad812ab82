"""Trace the kernel calls of the terms of a step, with their arrays."""

from __future__ import annotations

import inspect
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.kernels.templates import CompiledKernel


@dataclass(frozen=True, slots=True)
class Call:
    """One call of a kernel, with its arguments by parameter name."""

    term: str
    kernel: str
    arrays: dict[str, NDArray[Any]]
    absent: tuple[str, ...]  # arguments that are None: numba omits their branches
    written: tuple[str, ...]  # arrays that the kernel changed

    @property
    def traffic(self) -> int:
        """Minimal bytes between memory and core: each array is read once and, if it was changed, written once."""
        return sum(array.nbytes * (1 + (name in self.written)) for name, array in self.arrays.items())


def kernel_names() -> tuple[str, ...]:
    """The names of all kernels that a term can call."""
    return tuple(name for name, value in vars(kernels).items() if isinstance(value, Dispatcher) and name[0] != "_")


def trace_kernels(terms: Sequence[tuple[str, Callable[[], object]]]) -> list[Call]:
    """Execute each (name, term) once and return the calls of kernels in order."""
    calls: list[Call] = []
    term = ""

    def traced(name: str, kernel: Dispatcher) -> Callable[..., Any]:
        parameters = tuple(inspect.signature(kernel.py_func).parameters)

        def call(*arguments: Any) -> Any:
            given = dict(zip(parameters, arguments, strict=True))
            arrays = {k: v for k, v in given.items() if isinstance(v, np.ndarray)}
            before = {k: _checksum(v) for k, v in arrays.items()}
            result = kernel(*arguments)
            written = tuple(k for k, v in arrays.items() if _checksum(v) != before[k])
            calls.append(Call(term, name, arrays, tuple(k for k, v in given.items() if v is None), written))
            return result

        return call

    def call_of_cells(compiled: CompiledKernel, *arguments: Any) -> Any:
        function = compiled.function.py_func
        cells = function.__module__.rpartition(".")[2]
        return traced(f"{cells}.{function.__name__.removesuffix('_template')}", compiled.function)(*arguments)

    originals = {name: getattr(kernels, name) for name in kernel_names()}
    original_call: Any = CompiledKernel.__call__
    try:
        CompiledKernel.__call__ = call_of_cells  # type: ignore[assignment, method-assign]
        for name, kernel in originals.items():
            setattr(kernels, name, traced(name, kernel))
        for current, execute in terms:
            term = current
            execute()
    finally:
        CompiledKernel.__call__ = original_call  # type: ignore[method-assign]
        for name, kernel in originals.items():
            setattr(kernels, name, kernel)
    return calls


def distinct_bytes(calls: Sequence[Call]) -> int:
    """Bytes of all arrays of the calls, each array counted once."""
    arrays = {array.__array_interface__["data"][0]: array.nbytes for call in calls for array in call.arrays.values()}
    return sum(arrays.values())


def _checksum(array: NDArray[Any]) -> int:
    return zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data)
