"""A checksum of arrays that is a sum: each rank computes the share of its part of an array.

The checksum is the multilinear hash of Carter and Wegman over words of 32 bits, modulo 2^64: the sum of each word times
the key of its position. The checksum detects every change of a single word and every swap of two words; the probability
that random damage passes is at most 2^-32.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: 2^64 divided by the golden ratio: its multiples are distributed evenly.
_GOLDEN = 0x9E3779B97F4A7C15
_BLOCK = 1 << 15  # words, which fit into the cache


def share(values: NDArray[Any], first: int) -> int:
    """The share of `values` (flattened) in the checksum of an array; first: index of the first value in the array."""
    values = np.ascontiguousarray(values).ravel()
    if values.itemsize % 4:  # one word for each small integer or character
        words, first_word = values.view(np.uint8 if values.dtype.kind == "S" else values.dtype).astype(np.uint32), first
    else:
        words, first_word = values.view(np.uint32), first * (values.itemsize // 4)
    total = 0
    for start in range(0, len(words), _BLOCK):
        block = words[start : start + _BLOCK]
        begin = (first_word + start + 1) * 2 * _GOLDEN % (1 << 64)
        keys = _STEPS[: len(block)] + np.uint64(begin)
        keys |= np.uint64(1)
        keys *= block
        total += int(keys.sum())
    return total % (1 << 64)


_STEPS = np.arange(_BLOCK, dtype=np.uint64) * np.uint64(2 * _GOLDEN % (1 << 64))


def total(shares: Iterable[int]) -> int:
    """The checksum of an array from all its shares, as a signed integer of 64 bits."""
    unsigned = sum(shares) % (1 << 64)
    return unsigned - (1 << 64) if unsigned >> 63 else unsigned
