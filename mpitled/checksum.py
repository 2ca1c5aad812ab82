"""A checksum of arrays that ranks can add up: whoever has a part of an array computes that part's share.

The multilinear hash of Carter and Wegman over words of 32 bits, modulo 2^64: each word times a key of its place. One
wrong word, or two that changed places, never pass; random damage passes once in 2^32 times or less.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: The golden ratio of 2^64, whose multiples are keys far from each other; odd, so that every key can be odd.
_GOLDEN = 0x9E3779B97F4A7C15
_BLOCK = 1 << 15  # words at a time, which stay in the cache


def share(values: NDArray[Any], first: int) -> int:
    """What the entries of an array (flattened) from number `first` on give to its checksum."""
    values = np.ascontiguousarray(values).ravel()
    if values.itemsize % 4:  # small integers and text: a word each
        words, first_word = values.view(np.uint8 if values.dtype.kind == "S" else values.dtype).astype(np.uint32), first
    else:
        words, first_word = values.view(np.uint32), first * (values.itemsize // 4)
    total = 0
    for start in range(0, len(words), _BLOCK):
        some = words[start : start + _BLOCK]
        begin = (first_word + start + 1) * 2 * _GOLDEN % (1 << 64)
        keys = _STEPS[: len(some)] + np.uint64(begin)
        keys |= np.uint64(1)
        keys *= some
        total += int(keys.sum())
    return total % (1 << 64)


_STEPS = np.arange(_BLOCK, dtype=np.uint64) * np.uint64(2 * _GOLDEN % (1 << 64))


def total(shares: Iterable[int]) -> int:
    """The checksum of an array from all of its shares, as a signed number of 64 bits."""
    whole = sum(shares) % (1 << 64)
    return whole - (1 << 64) if whole >> 63 else whole
