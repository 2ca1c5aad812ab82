"""Restart fields: what a run needs to continue from a snapshot, declared where the attribute itself is declared.

An attribute of a dataclass becomes a restart field by its declaration: `nodal()`, `owned_dofs()`, `reduced("sum")` or
`replicated()` in place of `dataclasses.field()`. Snapshots for rollback and checkpoints follow from the declarations.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mpitled.parallel.subdomain import Subdomain


class Kind(Enum):
    """How the values of a restart field are distributed over the ranks."""

    NODAL = "nodal"  # array (..., n_nodes or more), the same on all ranks that share the node; or None
    OWNED_DOFS = "owned dofs"  # array (n owned moving dofs,)
    SUM = "sum"  # a number of each rank; only the sum over the ranks has a meaning
    MIN = "min"  # a number of each rank; only the minimum over the ranks has a meaning
    REPLICATED = "replicated"  # JSON data, the same on all ranks

    @property
    def is_array(self) -> bool:
        """Whether the values are an array."""
        return self in (Kind.NODAL, Kind.OWNED_DOFS)


@dataclass(frozen=True, slots=True)
class RestartField:
    """Declaration of a restart field, stored in the metadata of a dataclass field."""

    kind: Kind
    control: bool = False  # belongs to the control of the run: a checkpoint has it, a rollback leaves it as it is
    single_precision: bool = False  # a rollback to rest restores this array, from single precision


def nodal(*, control: bool = False, single_precision: bool = False, **options: Any) -> Any:
    """A nodal array; options go to `dataclasses.field`."""
    return _declare(RestartField(Kind.NODAL, control, single_precision), options)


def owned_dofs(**options: Any) -> Any:
    """An array with one number for each moving dof that the rank owns."""
    return _declare(RestartField(Kind.OWNED_DOFS), options)


def reduced(how: Literal["sum", "min"], *, control: bool = False, **options: Any) -> Any:
    """A number of each rank, whose sum or minimum over the ranks has a meaning."""
    return _declare(RestartField(Kind(how), control), options)


def replicated(*, control: bool = False, **options: Any) -> Any:
    """JSON data that is the same on all ranks."""
    return _declare(RestartField(Kind.REPLICATED, control), options)


def _declare(declaration: RestartField, options: dict[str, Any]) -> Any:
    return field(metadata={"restart": declaration}, **options)


class Scope(Enum):
    """Which restart fields a snapshot has."""

    CHECKPOINT = "checkpoint"  # all
    ROLLBACK = "rollback"  # all but controls
    ROLLBACK_TO_REST = "rollback to rest"  # numbers, and arrays of which single precision is enough
    NUMBERS = "numbers"  # no arrays

    def has(self, declared: RestartField) -> bool:
        """Whether a snapshot of this scope has the field."""
        if self is Scope.CHECKPOINT or declared.control:
            return self is Scope.CHECKPOINT
        return not declared.kind.is_array or self is Scope.ROLLBACK or (self.to_rest and declared.single_precision)

    @property
    def to_rest(self) -> bool:
        """Whether arrays are stored in single precision."""
        return self is Scope.ROLLBACK_TO_REST


#: Objects with restart fields, by name.
Objects = Mapping[str, Any]
#: Copies of restart fields, by "object.attribute".
Snapshot = dict[str, Any]


def declared(thing: Any) -> list[tuple[str, RestartField]]:
    """Restart fields of an object or a class: attribute and declaration."""
    own = fields(thing) if is_dataclass(thing) else ()
    return [(f.name, f.metadata["restart"]) for f in own if "restart" in f.metadata]


def _selected(objects: Objects, scope: Scope) -> Iterator[tuple[str, Any, str, Kind]]:
    """Key, object, attribute and kind of each restart field in a scope."""
    for name, thing in objects.items():
        for attribute, declaration in declared(thing):
            if scope.has(declaration):
                yield f"{name}.{attribute}", thing, attribute, declaration.kind


def snapshot(objects: Objects, scope: Scope) -> Snapshot:
    """Copies of all restart fields in a scope."""
    copies = {}
    for key, thing, attribute, kind in _selected(objects, scope):
        value = getattr(thing, attribute)
        copies[key] = value.astype(np.float32) if scope.to_rest and kind.is_array else deepcopy(value)
    return copies


def restore(objects: Objects, scope: Scope, values: Snapshot) -> None:
    """Set the restart fields in a scope to the values of a snapshot; existing arrays are filled in place."""
    for key, thing, attribute, _ in _selected(objects, scope):
        value, present = values[key], getattr(thing, attribute)
        if isinstance(present, np.ndarray):
            present[..., : value.shape[-1]] = value
        else:
            setattr(thing, attribute, deepcopy(value))


# --- snapshots in a checkpoint, which any number of ranks can read ----------------------------------------------------


@dataclass(frozen=True, slots=True)
class Packed:
    """A snapshot in the layout of a checkpoint file."""

    nodal: dict[str, NDArray[np.floating]]  # (n owned nodes, components); after reading, of all nodes of the rank
    reduced: dict[str, float]  # numbers of this rank
    replicated: dict[str, Any]


def pack(objects: Objects, scope: Scope, values: Snapshot, sub: Subdomain) -> Packed:
    """This rank's share of a snapshot."""
    packed, owned = Packed({}, {}, {}), np.flatnonzero(sub.rows.owned)
    for key, _, _, kind in _selected(objects, scope):
        value = values[key]
        if kind is Kind.OWNED_DOFS:
            dofs, of_dofs, value = _owned_moving(sub), value, np.zeros((3, sub.n_nodes))
            value[dofs % 3, dofs // 3] = of_dofs
        if kind in (Kind.SUM, Kind.MIN):
            packed.reduced[key] = value
        elif kind is Kind.REPLICATED:
            packed.replicated[key] = value
        elif value is not None:
            packed.nodal[key] = np.ascontiguousarray(np.atleast_2d(value)[:, owned].T)
    return packed


def unpack(
    objects: Objects, scope: Scope, packed: Packed, table: Mapping[str, NDArray[np.float64]], sub: Subdomain
) -> Snapshot:
    """The snapshot of this rank. table: the reduced numbers of each rank that wrote the checkpoint, (n ranks,), by key.

    On another number of ranks rank 0 takes the whole of each sum.
    """
    values: Snapshot = {}
    for key, _, _, kind in _selected(objects, scope):
        if kind is Kind.REPLICATED:
            values[key] = packed.replicated[key]
        elif not kind.is_array:
            numbers = table[key]
            if len(numbers) == sub.rows.n_parts:
                values[key] = float(numbers[sub.rows.part])
            elif kind is Kind.MIN:
                values[key] = float(numbers.min())
            else:
                values[key] = float(numbers.sum()) if sub.rows.part == 0 else 0.0
        elif key not in packed.nodal:
            values[key] = None
        else:
            value, dofs = packed.nodal[key].T, _owned_moving(sub)
            if kind is Kind.OWNED_DOFS:
                values[key] = value[dofs % 3, dofs // 3]
            else:
                values[key] = value[0] if len(value) == 1 else value  # `atleast_2d` made one component of a vector
    return values


def _owned_moving(sub: Subdomain) -> NDArray[np.uint32]:
    return sub.moving[sub.rows.owned[sub.moving // 3]]
