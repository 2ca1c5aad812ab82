"""Predicts how a model scales on a cluster: real partitions in many parts, and a simple model of the time of a step.

python jobs/bench/predict.py MODEL [--parts 64,16384] [--out DIR]   writes predict.csv and predict.png

The model is not changed. Options set the assumptions: --latency, --bandwidth, --rate and --fixed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench import whole_numbers
from matplotlib.figure import Figure

import partition
from mpitled import atomic, job, store
from mpitled.errors import InputError
from mpitled.parallel.subdomain import DOMAIN_NODE_COST, cell_costs


@dataclass(frozen=True, slots=True)
class Cluster:
    """The assumptions. Defaults: InfiniBand between the nodes of a cluster, and this program on one core of a Xeon."""

    latency: float = 1.5e-6  # s per message
    bandwidth: float = 10e9  # bytes/s of one rank, in each direction
    rate: float = 60e6  # boxes in runs per second on one core, with the update of the nodes
    fixed: float = 15e-6  # s per step, independent of size: Python, start of kernels and requests

    def __str__(self) -> str:
        return (
            f"{self.rate / 1e6:g} M boxes/s on a core (the node of a support domain costs {DOMAIN_NODE_COST:g} boxes), "
            f"{1e6 * self.fixed:g} us fixed per step,\n{1e6 * self.latency:g} us per message, "
            f"{self.bandwidth / 1e9:g} GB/s per rank; no contention in the network, no noise; the slowest rank counts"
        )


def predict(path: Path, counts: Sequence[int], cluster: Cluster, seed: int = 0) -> Iterator[dict[str, Any]]:
    """A row of the table for each number of parts of the model, the largest first. InputError for too few cells."""
    hexahedra, domains, places = store.read_cells(path)
    costs = cell_costs(store.read_points(path), hexahedra, domains)
    graph = partition.cell_graph(hexahedra, domains, places)
    fine = 0
    for n_parts in sorted(set(counts), reverse=True):
        # METIS bisects: a part of 2^k parts is the union of consecutive parts of 2^(k+1).
        if not fine or fine % n_parts or fine & (fine - 1) or n_parts & (n_parts - 1):
            print(f"{n_parts} parts: METIS", file=sys.stderr, flush=True)
            try:
                fine, parts = n_parts, partition.cut(graph, n_parts, costs, seed)
            except ValueError as error:
                raise InputError(f"{path}: {error}") from None
        tables = partition.tables(hexahedra, domains, parts // (fine // n_parts), n_parts)
        yield step_time(partition.figures(tables, costs, len(hexahedra)), cluster)


def step_time(figures: partition.PartFigures, cluster: Cluster) -> dict[str, Any]:
    """A row of the table: figures of the partition, and the step of the slowest rank in us.

    Computation takes cost / rate. The exchange takes a latency for each neighbour and the time of all bytes that leave
    (as many arrive at the same time). If both overlap, the longer of the two counts. Efficiency is the time of one core
    for all cells over the time of all cores; one core has no exchange.
    """
    compute, latency = figures.cost / cluster.rate, cluster.latency * figures.neighbours
    sent = 24.0 * figures.sent_nodes  # bytes: three components in double precision
    exchange = latency + sent / cluster.bandwidth
    step = compute + exchange + cluster.fixed
    overlapped = np.maximum(compute, exchange) + cluster.fixed
    slowest, n_parts = int(step.argmax()), len(figures.cost)
    one_core = figures.cost.sum() / cluster.rate + cluster.fixed
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
        "efficiency": one_core / (n_parts * step[slowest]),
        "efficiency_overlapped": one_core / (n_parts * overlapped.max()),
    }


def draw(rows: list[dict[str, Any]], title: str, path: Path) -> None:
    """Efficiency against the number of parts, and the limit that the balance of the partition sets."""
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axes = figure.add_subplot(xscale="log", ylim=(0, 105), xlabel="ranks", ylabel="predicted efficiency, %")
    parts = [row["parts"] for row in rows]
    axes.plot(parts, [100 / row["balance"] for row in rows], "o-", label="balance of the partition alone")
    for key, label in (("efficiency_overlapped", "exchange overlaps computation"), ("efficiency", "no overlap")):
        axes.plot(parts, [100 * row[key] for row in rows], "s-", label=label)
    for row in rows:
        text = f"{row['cells_mean']:,.0f} cells\n{row['step_us']:,.0f} \u00b5s per step"
        axes.annotate(text, (row["parts"], 100 * row["efficiency"]), fontsize=7, ha="right", va="top")
    axes.set_xticks(parts, [str(n) for n in parts])
    axes.minorticks_off()
    axes.margins(x=0.22)
    axes.grid(linewidth=0.3)
    axes.legend(fontsize=8, loc="lower left")
    axes.set_title(title, fontsize=8, loc="left")
    figure.savefig(path, dpi=150)


def main(words: Sequence[str] | None = None) -> None:
    """Write the table and the picture, and print the table."""
    parser = argparse.ArgumentParser(description="Predicted efficiency on a cluster, from real partitions.")
    parser.add_argument("model", type=Path, help="model.h5, or the folder that holds it")
    parser.add_argument("--parts", type=whole_numbers, default=[64, 256, 1024, 4096, 16384], metavar="N,...")
    parser.add_argument("--latency", type=float, default=1.5, metavar="US", help="us per message")
    parser.add_argument("--bandwidth", type=float, default=10.0, metavar="GB/S", help="of a rank, in each direction")
    parser.add_argument("--rate", type=float, default=60.0, metavar="M", help="million boxes per second on a core")
    parser.add_argument("--fixed", type=float, default=15.0, metavar="US", help="us per step, independent of size")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results (the model's)")
    options = parser.parse_args(words)
    model = options.model / job.MODEL if options.model.is_dir() else options.model
    out = options.out or model.parent
    numbers = (1e-6 * options.latency, 1e9 * options.bandwidth, 1e6 * options.rate, 1e-6 * options.fixed)
    if not all(0 < number < np.inf for number in numbers):
        parser.error("latency, bandwidth, rate and fixed must be numbers above 0")
    cluster = Cluster(*numbers)
    try:
        rows = [*predict(model, options.parts, cluster)][::-1]
        atomic.make_folder(out)
        text = [
            {key: str(value) if isinstance(value, int) else f"{value:.6g}" for key, value in row.items()}
            for row in rows
        ]
        atomic.write_csv(out / "predict.csv", tuple(rows[0]), text)
    except InputError as error:
        parser.error(str(error))
    cells = rows[0]["cells_mean"] * rows[0]["parts"]
    draw(rows, f"{cells / 1e6:.3g} M cells: {cluster}", out / "predict.png")
    shown = ("parts", "cells_mean", "balance", "halo_nodes_largest", "neighbours_largest", *list(rows[0])[9:])
    print(cluster, " ".join(shown), sep="\n")
    for row in text:
        print(" ".join(f"{row[name]:>{len(name)}}" for name in shown))
    print(f"written to {out}")


if __name__ == "__main__":
    main()
