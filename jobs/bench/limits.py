"""The limits of one core: memory bandwidth and multiply-adds per second, with kernels built like those of the step."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numba import njit
from numba import uint64 as U
from numpy.typing import DTypeLike

from mpitled.kernels.lanes import load, store, width

#: Bytes of the triad that stands for the machine: more than a core's caches hold.
LARGE = 3 << 27
#: Smallest working set, bytes, and the values of the chains, which stay in the first cache.
SMALL, VALUES = 3 << 14, 1 << 10
CHAINS, LINKS = 8, 8


def triad(n_bytes: int, repeats: int = 7) -> float:
    """Bytes per second of a = b + s c on arrays of n_bytes in all; the best of some repeats (STREAM)."""
    n = max(n_bytes, SMALL) // 24
    a, b, c = np.zeros(n), np.ones(n), np.ones(n)
    rounds = max(1, int(2e8) // (24 * n))
    _triad(a[:8], b[:8], c[:8], 0.5, 1)
    return 24 * n * rounds / _best(lambda: _triad(a, b, c, 0.5, rounds), repeats)


def multiply_adds(dtype: DTypeLike, repeats: int = 7) -> float:
    """Multiply-adds per second in registers, in eight independent chains; the best of some repeats."""
    values = np.linspace(0.5, 1.0, VALUES).astype(dtype)
    addend, rounds = values.dtype.type(0.001), 400
    _chains(values, addend, 1)
    return VALUES * CHAINS * LINKS * rounds / _best(lambda: _chains(values, addend, rounds), repeats)


def _best(execute: Callable[[], object], repeats: int) -> float:
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        execute()
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


@njit(fastmath={"contract"}, cache=True)
def _triad(a, b, c, s, rounds):
    for _ in range(rounds):
        for i in range(U(a.size)):
            a[i] = b[i] + s * c[i]


@njit(fastmath={"contract"}, cache=True)
def _chains(values, d, rounds):
    # Squares: the compiler could shorten a chain of products with a constant factor.
    for _ in range(rounds):
        for i in range(U(0), U(values.size), width(values)):
            x0 = load(values, i)
            x1 = x0 + d
            x2 = x1 + d
            x3 = x2 + d
            x4 = x3 + d
            x5 = x4 + d
            x6 = x5 + d
            x7 = x6 + d
            for _link in range(LINKS):
                x0 = x0 * x0 + d
                x1 = x1 * x1 + d
                x2 = x2 * x2 + d
                x3 = x3 * x3 + d
                x4 = x4 * x4 + d
                x5 = x5 * x5 + d
                x6 = x6 * x6 + d
                x7 = x7 * x7 + d
            store(values, i, (((x0 + x1) + (x2 + x3)) + ((x4 + x5) + (x6 + x7))) * d)
