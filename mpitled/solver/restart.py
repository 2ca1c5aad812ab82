"""What a run remembers: to go back a little when it became unstable, and, in a checkpoint, to be continued.

Each object that changes as the run goes on says what of it has to be known (`Kept`); what is not named follows from
that. The same copies serve both ends, so that a run which was stopped and continued is the run that never stopped.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled.parallel.subdomain import Subdomain


@dataclass(frozen=True, slots=True)
class Kept:
    """The attributes of an object that have to be known to go on from where it is."""

    nodes: tuple[str, ...] = ()  # arrays (..., n_nodes or more), float64, alike on all ranks with the node; or None
    rough: tuple[str, ...] = ()  # the like, of which single precision is enough
    moving: tuple[str, ...] = ()  # arrays (n owned moving dofs,), float64
    sums: tuple[str, ...] = ()  # numbers of each rank, whose sum over the ranks counts
    least: tuple[str, ...] = ()  # numbers of each rank, of which the least counts
    alike: tuple[str, ...] = ()  # what JSON can hold, alike on all ranks

    @property
    def numbers(self) -> Kept:
        """The same, without arrays."""
        return Kept(sums=self.sums, least=self.least, alike=self.alike)

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.nodes, *self.rough, *self.moving, *self.sums, *self.least, *self.alike)


#: Objects by name, each with what is kept of it.
Parts = Sequence[tuple[str, Any, Kept]]
#: Copies of what is kept, by "object.attribute".
Memory = dict[str, Any]


def remember(parts: Parts) -> Memory:
    """Copies of all that is kept of the parts."""
    return {
        f"{name}.{a}": getattr(thing, a).astype(np.float32) if a in kept.rough else deepcopy(getattr(thing, a))
        for name, thing, kept in parts
        for a in kept.names
    }


def recall(parts: Parts, memory: Mapping[str, Any]) -> None:
    """Put back what `remember` gave, into the arrays that are there."""
    for name, thing, kept in parts:
        for attribute in kept.names:
            value, there = memory[f"{name}.{attribute}"], getattr(thing, attribute)
            if isinstance(there, np.ndarray):
                there[..., : value.shape[-1]] = value
            else:
                setattr(thing, attribute, deepcopy(value))


# --- as a checkpoint has it ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Packed:
    """A memory in the form of a file that any number of ranks can read."""

    nodal: dict[str, NDArray[np.floating]]  # (n owned nodes, components); of all nodes of the rank when it is read
    own: dict[str, float]  # of each rank
    alike: dict[str, Any]


def pack(parts: Parts, memory: Memory, sub: Subdomain) -> Packed:
    """This rank's share of a memory."""
    packed, owned = Packed({}, {}, {}), np.flatnonzero(sub.rows.owned)
    for key, kind in _kinds(parts):
        value = memory[key]
        if kind == "moving":
            value, on_dofs = np.zeros((3, sub.n_nodes)), value
            dofs = _owned_moving(sub)
            value[dofs % 3, dofs // 3] = on_dofs
        if kind in ("sums", "least"):
            packed.own[key] = value
        elif kind == "alike":
            packed.alike[key] = value
        elif value is not None:
            packed.nodal[key] = np.ascontiguousarray(np.atleast_2d(value)[:, owned].T)
    return packed


def unpack(parts: Parts, packed: Packed, table: Mapping[str, NDArray[np.float64]], sub: Subdomain) -> Memory:
    """The memory of this rank; table has the numbers of each rank that wrote, (n ranks,), by key.

    On another number of ranks than wrote it the first has all of the sums.
    """
    memory: Memory = {}
    for key, kind in _kinds(parts):
        if kind == "alike":
            memory[key] = packed.alike[key]
        elif kind in ("sums", "least"):
            numbers = table[key]
            if len(numbers) == sub.rows.n_parts:
                memory[key] = float(numbers[sub.rows.part])
            elif kind == "least":
                memory[key] = float(numbers.min())
            else:
                memory[key] = float(numbers.sum()) if sub.rows.part == 0 else 0.0
        elif key not in packed.nodal:
            memory[key] = None
        else:
            value = packed.nodal[key].T
            dofs = _owned_moving(sub)
            # A list of numbers has become one component.
            memory[key] = value[dofs % 3, dofs // 3] if kind == "moving" else value[0] if len(value) == 1 else value
    return memory


def _kinds(parts: Parts) -> Iterator[tuple[str, str]]:
    for name, _, kept in parts:
        for kind in ("nodes", "rough", "moving", "sums", "least", "alike"):
            for attribute in getattr(kept, kind):
                yield f"{name}.{attribute}", kind


def _owned_moving(sub: Subdomain) -> NDArray[np.uint32]:
    return sub.moving[sub.rows.owned[sub.moving // 3]]
