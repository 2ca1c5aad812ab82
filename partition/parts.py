"""The contents of each part: cells, nodes, neighbours and shared nodes; and figures of a partition's quality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from partition.graph import Block, CellGraph, connectivity


@dataclass(frozen=True, slots=True)
class PartTables:
    """All parts one after another; offsets say where each begins. Global node and cell numbers.

    A cell is in one part. A node is in each part whose cells touch it; the lowest of these owns it.
    """

    n_parts: int
    cells: NDArray[np.int64]  # (n_cells,), by part, ascending in each
    cell_offsets: NDArray[np.int64]  # (n_parts + 1,), into cells
    nodes: NDArray[np.int64]  # (sum of nodes,), by part, ascending in each
    node_offsets: NDArray[np.int64]  # (n_parts + 1,), into nodes
    owned_offsets: NDArray[np.int64]  # (n_parts + 1,), running number of nodes that the parts own
    neighbours: NDArray[np.int32]  # (sum of neighbours,), parts, by part, ascending in each
    neighbour_offsets: NDArray[np.int64]  # (n_parts + 1,), into neighbours
    shared: NDArray[np.int64]  # (sum of shared nodes,), by part and neighbour, ascending in each
    shared_offsets: NDArray[np.int64]  # (len(neighbours) + 1,), into shared


def tables(blocks: Sequence[Block], part: NDArray[np.int32], n_parts: int) -> PartTables:
    """The tables of a partition `part` (n_cells,) of the cells of all blocks. Nodes without a cell are in no part."""
    offsets, cell_nodes, n_nodes = connectivity(blocks)
    cells = np.argsort(part, kind="stable")
    cell_offsets = _offsets(np.bincount(part, minlength=n_parts))
    counts = _touched_nodes(offsets, cell_nodes, cells, cell_offsets, n_nodes, np.empty(0, np.int64))
    node_offsets = _offsets(counts)
    nodes = np.empty(node_offsets[-1], np.int64)
    _touched_nodes(offsets, cell_nodes, cells, cell_offsets, n_nodes, nodes)
    for p in range(n_parts):
        nodes[node_offsets[p] : node_offsets[p + 1]].sort()

    n_touching = np.bincount(nodes, minlength=n_nodes)
    at_border = n_touching[nodes] > 1
    border_nodes = nodes[at_border]
    border_parts = np.repeat(np.arange(n_parts), counts)[at_border]
    order = np.argsort(border_nodes, kind="stable")
    border_nodes, border_parts = border_nodes[order], border_parts[order]
    first = _firsts(border_nodes)
    owned = np.bincount(border_parts[first], minlength=n_parts) + counts
    owned -= np.bincount(border_parts, minlength=n_parts)

    # Each copy of a border node meets all copies of that node, which lie side by side.
    copies = n_touching[border_nodes]
    me = np.repeat(np.arange(len(border_nodes)), copies)
    start = np.maximum.accumulate(np.where(first, np.arange(len(border_nodes)), 0))
    other = start[me] + np.arange(len(me)) - _offsets(copies)[me]
    me, other = me[me != other], other[me != other]
    link = border_parts[me] * n_parts + border_parts[other]
    order = np.argsort(link, kind="stable")
    link_starts = np.flatnonzero(_firsts(link[order]))
    links = link[order][link_starts]
    return PartTables(
        n_parts=n_parts,
        cells=cells,
        cell_offsets=cell_offsets,
        nodes=nodes,
        node_offsets=node_offsets,
        owned_offsets=_offsets(owned),
        neighbours=(links % n_parts).astype(np.int32),
        neighbour_offsets=_offsets(np.bincount(links // n_parts, minlength=n_parts)),
        shared=border_nodes[me[order]],
        shared_offsets=np.append(link_starts, len(link)),
    )


def _firsts(ascending: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Where a value differs from the one before it."""
    return np.concatenate([[True], ascending[1:] != ascending[:-1]])[: len(ascending)]


def _offsets(counts: NDArray[np.integer]) -> NDArray[np.int64]:
    """Where each of so many items begins, and the last ends: (len(counts) + 1,)."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


@njit(cache=True)
def _touched_nodes(offsets, cell_nodes, cells, cell_offsets, n_nodes, nodes):  # type: ignore[no-untyped-def]
    """The number of nodes that each part's cells touch; fills `nodes` with them by part, unless it is empty."""
    last = np.full(n_nodes, -1)
    counts = np.zeros(len(cell_offsets) - 1, np.int64)
    n = 0
    for p in range(len(counts)):
        for c in cells[cell_offsets[p] : cell_offsets[p + 1]]:
            for node in cell_nodes[offsets[c] : offsets[c + 1]]:
                if last[node] != p:
                    last[node] = p
                    if len(nodes):
                        nodes[n] = node
                    n += 1
                    counts[p] += 1
    return counts


@dataclass(frozen=True, slots=True)
class PartFigures:
    """How good a partition is, part by part."""

    cells_of: Mapping[str, NDArray[np.int64]]  # cells (n_parts,) of each block, by the block's name
    cost: NDArray[np.float64]  # (n_parts,), in the unit of the cells' costs
    nodes: NDArray[np.int64]  # (n_parts,), shared ones included
    halo_nodes: NDArray[np.int64]  # (n_parts,), nodes that other parts touch too
    sent_nodes: NDArray[np.int64]  # (n_parts,), sent in an exchange: halo nodes, once to each part that has them
    neighbours: NDArray[np.int64]  # (n_parts,)
    cut: NDArray[np.int64] | None  # (n_parts,), edges of the graph that leave the part

    @property
    def cells(self) -> NDArray[np.int64]:
        """Cells of each part, (n_parts,)."""
        return np.sum([*self.cells_of.values()], axis=0)

    @property
    def balance(self) -> float:
        """Cost of the dearest part over the mean: the time of a step over that of a perfect partition."""
        return float(self.cost.max() / self.cost.mean())

    def describe(self, most: int = 32) -> str:
        """A table with a line for each part, for at most `most` parts, then the mean and the largest, and a summary."""
        columns = {
            "cells": self.cells,
            **self.cells_of,
            "cost/mean": self.cost / self.cost.mean(),
            "nodes": self.nodes,
            "halo nodes": self.halo_nodes,
            "neighbours": self.neighbours,
        }
        if self.cut is not None:
            columns["cut edges"] = self.cut
        n_parts = len(self.cost)
        rows = {str(p): [values[p] for values in columns.values()] for p in range(n_parts if n_parts <= most else 0)}
        rows["mean"] = [values.mean() for values in columns.values()]
        rows["largest"] = [values.max() for values in columns.values()]
        widths = [max(12, len(name) + 2) for name in columns]
        lines = ["part".rjust(8) + "".join(map(str.rjust, columns, widths))]
        for label, row in rows.items():
            texts = [f"{x:.4f}" if name == "cost/mean" else f"{x:.0f}" for name, x in zip(columns, row, strict=True)]
            lines.append(label.rjust(8) + "".join(map(str.rjust, texts, widths)))
        summary = f"{n_parts} parts: balance {self.balance:.4f} (largest/mean cost)"
        if self.cut is not None:
            summary += f", {self.cut.sum() // 2} edges cut"
        return "\n".join([*lines, summary])


def figures(
    tables: PartTables, costs: NDArray[np.float64], sizes: Mapping[str, int], graph: CellGraph | None = None
) -> PartFigures:
    """Figures of a partition whose cells cost `costs` (n_cells,); cut edges with the graph.

    `sizes` are the numbers of cells of the blocks, by name, in order.
    """
    part = np.empty(len(tables.cells), dtype=np.int32)
    part[tables.cells] = np.repeat(np.arange(tables.n_parts, dtype=np.int32), np.diff(tables.cell_offsets))
    of_blocks = np.split(part, np.cumsum([*sizes.values()])[:-1])
    n_touching = np.bincount(tables.nodes)
    of_node = np.repeat(np.arange(tables.n_parts), np.diff(tables.node_offsets))
    cut = None
    if graph is not None:
        crossing = np.repeat(part, np.diff(graph.xadj))
        cut = np.bincount(crossing[crossing != part[graph.adjncy]], minlength=tables.n_parts)
    return PartFigures(
        cells_of={name: np.bincount(own, minlength=tables.n_parts) for name, own in zip(sizes, of_blocks, strict=True)},
        cost=np.bincount(part, costs, tables.n_parts).astype(np.float64, copy=False),
        nodes=np.diff(tables.node_offsets),
        halo_nodes=np.bincount(of_node[n_touching[tables.nodes] > 1], minlength=tables.n_parts),
        sent_nodes=np.diff(tables.shared_offsets[tables.neighbour_offsets]),
        neighbours=np.diff(tables.neighbour_offsets),
        cut=cut,
    )
