"""How a model would scale on a cluster: real partitions in many parts, put into a stated model of a step's time."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import partition
from mpitled import atomic, store
from mpitled.cells.kind import SUPPORT_DOMAINS
from mpitled.errors import InputError
from mpitled.parallel.subdomain import cell_costs

COLUMNS = (
    "parts", "cells_mean", "cells_largest", "balance", "halo_nodes_mean", "halo_nodes_largest", "neighbours_mean",
    "neighbours_largest", "sent_kB_largest", "compute_us", "latency_us", "transfer_us", "fixed_us", "step_us",
    "efficiency", "efficiency_overlapped",
)  # fmt: skip


_DOMAIN_COST = SUPPORT_DOMAINS.node_cost


@dataclass(frozen=True, slots=True)
class Cluster:
    """What a step's time is made of. Defaults: InfiniBand between nodes, and this program on one core of a Xeon."""

    latency: float = 1.5e-6  # s, of one message
    bandwidth: float = 10e9  # bytes/s, of one rank, in each direction
    rate: float = 60e6  # boxes in runs a second on one core, the nodes' update in it
    fixed: float = 15e-6  # s a step that depend on no size: Python, and the start of kernels and requests

    def assumptions(self) -> str:
        """All of them in two lines."""
        return (
            f"{self.rate / 1e6:g} M boxes a second a core (a support domain's node costs {_DOMAIN_COST:g}), "
            f"{1e6 * self.fixed:g} us a step whatever the size,\n{1e6 * self.latency:g} us a message, "
            f"{self.bandwidth / 1e9:g} GB/s a rank; no contention in the network, no noise; the slowest rank counts"
        )


def predict(path: Path, counts: Sequence[int], cluster: Cluster, out: Path, seed: int = 0) -> list[dict[str, Any]]:
    """Partition a model in each number of parts and tell what a step would take: predict.csv and predict.png in `out`.

    The model is not changed. InputError if it has fewer cells than parts.
    """
    cells = store.read_blocks(path)
    costs = cell_costs(store.read_points(path), cells)
    _say(f"{', '.join(f'{len(block)} {block.name}' for block in cells)}: graph")
    blocks = [partition.Block(block.nodes, block.kind.faces, block.columns.get("points")) for block in cells]
    sizes = {block.name: len(block) for block in cells}
    graph = partition.cell_graph(blocks)
    rows: list[dict[str, Any]] = []
    finer: tuple[int, NDArray[np.int32]] | None = None
    for n_parts in sorted(set(counts), reverse=True):
        if finer is None or not _halves(n_parts, finer[0]):
            _say(f"{n_parts} parts: METIS")
            try:
                finer = n_parts, partition.cut(graph, n_parts, costs, seed)
            except ValueError as error:
                raise InputError(f"{path}: {error}") from None
        _say(f"{n_parts} parts: figures")
        # METIS bisects: each of its earlier parts is what the finer parts in a row make up.
        tables = partition.tables(blocks, finer[1] // (finer[0] // n_parts), n_parts)
        rows.insert(0, step_time(partition.figures(tables, costs, sizes), cluster))
    atomic.make_folder(out)
    written = [{k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows]
    atomic.write_csv(out / "predict.csv", COLUMNS, written)
    try:
        from mpitled.results import charts
    except ImportError:
        _say(f"{out}: no picture, for matplotlib is missing")
    else:
        n_cells = len(costs)
        path = out / "predict.png"
        with atomic.writing(path):
            charts.draw_prediction(rows, f"{n_cells / 1e6:.3g} M cells", cluster.assumptions(), path)
    return rows


def _halves(n_parts: int, finer: int) -> bool:
    """Whether bisection comes through so many parts on its way to the finer ones."""
    return finer % n_parts == 0 and n_parts & (n_parts - 1) == 0 and finer & (finer - 1) == 0


def step_time(figures: partition.PartFigures, cluster: Cluster) -> dict[str, Any]:
    """A row of the table: the partition's figures, and the step of the rank that needs longest, in us.

    Computing takes cost / rate; the exchange takes a latency for each neighbour and the time of all bytes that leave
    (as many come in at once). Where it is overlapped the longer of computing and exchange counts. Efficiency is one
    core's time for all cells over the time of all cores; one core has no exchange.
    """
    compute = figures.cost / cluster.rate
    latency = cluster.latency * figures.neighbours
    sent = 24.0 * figures.sent_nodes  # three components in double precision
    exchange = latency + sent / cluster.bandwidth
    step = compute + exchange + cluster.fixed
    overlapped = np.maximum(compute, exchange) + cluster.fixed
    slowest = int(step.argmax())
    alone = figures.cost.sum() / cluster.rate + cluster.fixed
    n_parts = len(figures.cost)
    return {
        "parts": n_parts,
        "cells_mean": figures.cells.mean(),
        "cells_largest": int(figures.cells.max()),
        "balance": figures.balance,
        "halo_nodes_mean": figures.halo_nodes.mean(),
        "halo_nodes_largest": int(figures.halo_nodes.max()),
        "neighbours_mean": figures.neighbours.mean(),
        "neighbours_largest": int(figures.neighbours.max()),
        "sent_kB_largest": sent.max() / 1e3,
        "compute_us": 1e6 * compute[slowest],
        "latency_us": 1e6 * latency[slowest],
        "transfer_us": 1e6 * sent[slowest] / cluster.bandwidth,
        "fixed_us": 1e6 * cluster.fixed,
        "step_us": 1e6 * step[slowest],
        "efficiency": alone / (n_parts * step[slowest]),
        "efficiency_overlapped": alone / (n_parts * overlapped.max()),
    }


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def table(rows: Sequence[dict[str, Any]], cluster: Cluster) -> str:
    """The assumptions and a line for each number of parts, for the terminal."""
    lines = [
        cluster.assumptions(),
        f"{'parts':>7}{'cells':>10}{'balance':>9}{'halo nodes':>12}{'neighbours':>12}{'compute':>10}{'latency':>9}"
        f"{'transfer':>10}{'step, us':>10}{'efficiency':>12}{'overlapped':>12}",
    ]
    for row in rows:
        lines.append(
            f"{row['parts']:7}{row['cells_mean']:10.0f}{row['balance']:9.4f}{row['halo_nodes_largest']:12}"
            f"{row['neighbours_largest']:12}{row['compute_us']:10.1f}{row['latency_us']:9.1f}{row['transfer_us']:10.1f}"
            f"{row['step_us']:10.1f}{row['efficiency']:12.1%}{row['efficiency_overlapped']:12.1%}"
        )
    return "\n".join(lines)
