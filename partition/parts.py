"""Tables of the parts (cells, nodes, neighbours, shared nodes), and figures of the quality of a partition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from partition.graph import Block, CellGraph, connectivity


@dataclass(frozen=True, slots=True)
class PartTables:
    """Tables of all parts, part after part, in global numbers; offsets are the starts of the parts.

    A cell is in one part. A node is in each part with a cell that touches the node; the lowest of these parts owns the
    node.
    """

    n_parts: int
    cells: NDArray[np.int64]  # (n_cells,), by part, ascending in each
    cell_offsets: NDArray[np.int64]  # (n_parts + 1,), into cells
    nodes: NDArray[np.int64]  # (sum of nodes,), by part, ascending in each
    node_offsets: NDArray[np.int64]  # (n_parts + 1,), into nodes
    owned_offsets: NDArray[np.int64]  # (n_parts + 1,), cumulative number of owned nodes
    neighbours: NDArray[np.int32]  # (sum of neighbours,), parts, by part, ascending in each
    neighbour_offsets: NDArray[np.int64]  # (n_parts + 1,), into neighbours
    shared: NDArray[np.int64]  # (sum of shared nodes,), by part and neighbour, ascending in each
    shared_offsets: NDArray[np.int64]  # (len(neighbours) + 1,), into shared


def tables(blocks: Sequence[Block], part: NDArray[np.int32], n_parts: int) -> PartTables:
    """The tables of a partition; part: (n_cells,) part of each cell. Nodes without a cell are in no part."""
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

    # Pair each copy of a border node with all copies of the same node, which are adjacent after sorting.
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
    """Whether each value differs from the previous value."""
    return np.concatenate([[True], ascending[1:] != ascending[:-1]])[: len(ascending)]


def _offsets(counts: NDArray[np.integer]) -> NDArray[np.int64]:
    """Cumulative sums of the counts, from 0: (len(counts) + 1,)."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


@njit(cache=True)
def _touched_nodes(offsets, cell_nodes, cells, cell_offsets, n_nodes, nodes):  # type: ignore[no-untyped-def]
    """The number of nodes of each part; fills `nodes` with these nodes, part after part, unless `nodes` is empty."""
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
    """Figures of the quality of a partition, (n_parts,) each."""

    cells_of: Mapping[str, NDArray[np.int64]]  # cells of each block, by the name of the block
    cost: NDArray[np.float64]  # in the unit of the costs of the cells
    nodes: NDArray[np.int64]  # including shared nodes
    halo_nodes: NDArray[np.int64]  # nodes that are also in other parts
    sent_nodes: NDArray[np.int64]  # sum over the neighbours of the nodes sent to each
    neighbours: NDArray[np.int64]
    cut: NDArray[np.int64] | None  # edges of the graph between the part and other parts

    @property
    def cells(self) -> NDArray[np.int64]:
        """Cells of each part, (n_parts,)."""
        return np.sum([*self.cells_of.values()], axis=0)

    @property
    def balance(self) -> float:
        """Largest cost over mean cost: the time of a step relative to the time with equal costs."""
        return float(self.cost.max() / self.cost.mean())

    def describe(self, most: int = 32) -> str:
        """A table with one line for each part (unless there are more than `most`), mean, maximum, and a summary."""
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
    """Figures of a partition; with cut edges if the graph is given.

    costs: (n_cells,), costs of the cells; sizes: number of cells of each block, by name, in the order of the blocks.
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
