"""What packing cells for the kernels has in common: laws, lanes, and the cells at the border of a part."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mpitled.kernels.lanes import BATCH
from mpitled.laws import Law, Material


@dataclass(frozen=True, slots=True)
class LocalCells:
    """The cells of one kind on a rank, in local numbers and SI units, as packing takes them."""

    points: NDArray[np.float64]  # (n_nodes, 3), m
    nodes: NDArray[np.uint32]  # (n, k)
    first: int  # number of the first of them among the cells of the rank
    n_rank_cells: int  # cells of the rank, of all kinds
    material: NDArray[np.int16]  # (n,), index into `materials`
    materials: Sequence[Material]
    shared: NDArray[np.bool_]  # (n_nodes,), whether other ranks have the node
    precision: type[np.floating]  # of the forces' arithmetic
    column: Callable[[str], NDArray[Any]]  # what the model has of these cells beside nodes, by name

    def by_law(self) -> Iterator[tuple[type[Law], NDArray[np.int64]]]:
        """Each law that these cells have, and its cells (k,), ascending."""
        laws = [type(material.law) for material in self.materials]
        for law in dict.fromkeys(laws):
            of_law = np.array([other is law for other in laws])
            cells = np.flatnonzero(of_law[self.material])
            if len(cells):
                yield law, cells

    def moduli(self, cells: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """lambda and mu of the undeformed material of cells (k,), each (k,), Pa."""
        lam, mu = np.array([[m.lam, m.mu] for m in self.materials]).T
        return lam[self.material[cells]], mu[self.material[cells]]

    def coefficients(self, law: type[Law], cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Coefficients of the law (n_coefficients, k), Pa, in cells (k,) that have it."""
        none = (0.0,) * law.n_coefficients
        table = np.array([m.law.coefficients if type(m.law) is law else none for m in self.materials])
        return np.ascontiguousarray(table[self.material[cells]].T)


#: Adds the forces of cells at displacements u to f; the smallest J among them.
Forces = Callable[[NDArray[np.floating], NDArray[np.floating]], float]


class PackedCells(Protocol):
    """Cells of one kind and one law, packed as the kernels take them."""

    @property
    def name(self) -> str:
        """Name of the kind, for timers and dry runs."""

    @property
    def law(self) -> type[Law]:
        """The law of all of these cells."""

    @property
    def n_cells(self) -> int:
        """Number of cells."""

    @property
    def n_border(self) -> int:
        """So many batches or runs, the first, have nodes that other ranks have, too."""

    def __len__(self) -> int:
        """Number of batches or runs."""

    def forces(self, part: slice) -> Forces:
        """The function that adds the internal forces of some of the batches or runs."""

    def check(
        self,
        u: NDArray[np.floating],
        required: NDArray[np.float64],
        factor: float,
        jacobian: NDArray[np.float32],
        tensor: NDArray[np.float64] | None,
    ) -> dict[str, float]:
        """Energies (J) by the names of their lines in the ledger.

        Writes the J of each cell to jacobian (n_cells + 1,), and adds to required (n_nodes,), kg, the mass that each
        cell asks of its nodes: factor (s^2) times the bound of its largest eigenvalue. Kinds that ask for mass tensors
        add them to tensor (6, n_nodes: xx, xy, xz, yy, yz, zz) instead where that is given.
        """


def in_precision(packed: Any, precision: type[np.floating]) -> Any:
    """Packed cells with their floating-point arrays in this precision."""
    arrays = {f.name: getattr(packed, f.name) for f in fields(packed)}
    real = {
        name: a.astype(precision, copy=False)
        for name, a in arrays.items()
        if isinstance(a, np.ndarray) and a.dtype.kind == "f"
    }
    return replace(packed, **real)


def border_first(shared: NDArray[np.bool_], **arrays: Any) -> dict[str, Any]:
    """Arrays of batches, those with nodes that other ranks have before the others, and their number `n_border`."""
    at_border = shared[arrays["nodes"]].any(axis=(1, 2))
    if not at_border.all() and at_border.any():
        order = np.argsort(~at_border, kind="stable")
        arrays = {name: None if array is None else array[order] for name, array in arrays.items()}
    return arrays | {"n_border": int(np.count_nonzero(at_border))}


def symmetric(tensors: NDArray[np.float64]) -> NDArray[np.float64]:
    """xx, xy, xz, yy, yz, zz (n, 6) of symmetric tensors (n, 3, 3)."""
    return tensors.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]


def in_lanes(values: NDArray[Any], fill: float | None = None) -> NDArray[Any]:
    """(n, ...) -> (n_batches, numbers of a cell, lanes); lanes left over repeat the last cell, or hold `fill`."""
    flat = values.reshape(len(values), -1)
    missing = -len(flat) % BATCH
    if missing:
        last = flat[-1:] if fill is None else np.full_like(flat[-1:], fill)
        flat = np.concatenate([flat, np.repeat(last, missing, axis=0)])
    return np.ascontiguousarray(flat.reshape(-1, BATCH, flat.shape[1]).transpose(0, 2, 1))
