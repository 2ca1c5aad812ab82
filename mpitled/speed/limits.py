"""What one core of this machine can do at best, by kernels made as ours are: memory's bandwidth and multiply-adds."""

from __future__ import annotations

import time

import numpy as np
from numba import njit
from numba import uint64 as U
from numpy.typing import DTypeLike

from mpitled.kernels.lanes import load, store, width

#: Bytes of the triad that is told as the machine's: beyond what a core has of caches.
LARGE = 3 << 27
#: Smallest working set, bytes: a kernel's call must not count.
_SMALL = 3 << 14
_CHAINS, _LINKS = 8, 8
_VALUES = 1 << 10  # stay in the first cache


def triad(n_bytes: int, repeats: int = 7) -> float:
    """Bytes a second of a = b + s c on arrays that together have so many bytes; the best of some repeats (STREAM)."""
    n = max(n_bytes, _SMALL) // 24
    a, b, c = np.zeros(n), np.ones(n), np.ones(n)
    rounds = max(1, int(2e8) // (24 * n))
    _triad(a[:8], b[:8], c[:8], 0.5, 1)
    return 24 * n * rounds / _best(lambda: _triad(a, b, c, 0.5, rounds), repeats)


def multiply_adds(dtype: DTypeLike, repeats: int = 7) -> float:
    """Multiply-adds a second in registers, in eight chains that need not wait for each other; the best of repeats."""
    values = np.linspace(0.5, 1.0, _VALUES).astype(dtype)
    addend = values.dtype.type(0.001)
    rounds = 400
    _chains(values, addend, 1)
    best = _best(lambda: _chains(values, addend, rounds), repeats)
    return _VALUES * _CHAINS * _LINKS * rounds / best


def _best(act, repeats: int) -> float:  # type: ignore[no-untyped-def]
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        act()
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


@njit(fastmath={"contract"}, cache=True)
def _triad(a, b, c, s, rounds):  # type: ignore[no-untyped-def]
    for _ in range(rounds):
        for i in range(U(a.size)):
            a[i] = b[i] + s * c[i]


@njit(fastmath={"contract"}, cache=True)
def _chains(values, d, rounds):  # type: ignore[no-untyped-def]
    # Squares: free association could do a chain of products with one factor in fewer steps.
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
            for _link in range(_LINKS):
                x0 = x0 * x0 + d
                x1 = x1 * x1 + d
                x2 = x2 * x2 + d
                x3 = x3 * x3 + d
                x4 = x4 * x4 + d
                x5 = x5 * x5 + d
                x6 = x6 * x6 + d
                x7 = x7 * x7 + d
            store(values, i, (((x0 + x1) + (x2 + x3)) + ((x4 + x5) + (x6 + x7))) * d)
