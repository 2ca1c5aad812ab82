"""The prediction: its arithmetic by hand, and partitions that are what METIS would make of each number of parts."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from conftest import complaint, mpitled
from mpitled.speed.predict import COLUMNS, Cluster, step_time

import partition
from mpitled.cells.kind import HEXAHEDRA
from mpitled.mesh import structured_hexahedra

SCENE = """
[block]
size = [24.0, 24.0, 24.0]
elements = [24, 24, 24]
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.3
[[fixed]]
nodes = "x0"
"""


def test_a_steps_time_is_that_of_the_slowest_rank():
    """A bar of 6 x 2 x 2 hexahedra, cut by hand in 1, 2 and 3 layers: 9 nodes between neighbours."""
    hexahedra = structured_hexahedra((6, 2, 2))
    part = np.array([0, 1, 1, 2, 2, 2], np.int32)[np.arange(24) % 6]
    tables = partition.tables([partition.Block(hexahedra)], part, 3)
    row = step_time(
        partition.figures(tables, np.ones(24), {"hexahedra": 24}),
        Cluster(latency=5e-6, bandwidth=1e9, rate=1e6, fixed=2e-6),
    )
    # Ranks have 4, 8, 12 cells, a us each, and 1, 2, 1 neighbours.
    transfer = 9 * 24 / 1e9 * 1e6
    steps = np.array([4 + 5 + transfer, 8 + 10 + 2 * transfer, 12 + 5 + transfer]) + 2
    assert row["step_us"] == pytest.approx(steps.max())
    assert (row["compute_us"], row["latency_us"]) == pytest.approx((8, 10))
    assert row["efficiency"] == pytest.approx((24 + 2) / (3 * steps.max()))
    assert row["efficiency_overlapped"] == pytest.approx((24 + 2) / (3 * (12 + 2)))
    assert (row["neighbours_largest"], row["halo_nodes_largest"], row["balance"]) == (2, 18, 12 / 8)


def test_every_number_of_parts_is_cut_as_metis_cuts_it(tmp_path):
    deck = tmp_path / "scene.toml"
    deck.write_text(SCENE)
    mpitled("build", deck, "--out", tmp_path)
    told = mpitled("predict", tmp_path, "--parts", "4,16,3,8", "--rate", "10", "--out", tmp_path / "p", "--json")
    with (tmp_path / "p" / "predict.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert [row["parts"] for row in json.loads(told.stdout)] == [3, 4, 8, 16]
    assert [int(row["parts"]) for row in rows] == [3, 4, 8, 16]
    assert told.stderr.count("METIS") == 2  # 8 and 4 lie on the way to 16
    assert (tmp_path / "p" / "predict.png").stat().st_size > 10_000
    blocks = [partition.Block(structured_hexahedra((24, 24, 24)), HEXAHEDRA.faces)]
    graph = partition.cell_graph(blocks)
    for row in rows:
        n = int(row["parts"])
        part = partition.cut(graph, n, np.ones(24**3))
        direct = partition.figures(partition.tables(blocks, part, n), np.ones(24**3), {"hexahedra": 24**3})
        assert float(row["balance"]) == pytest.approx(direct.balance, abs=0.005)
        assert float(row["halo_nodes_mean"]) == pytest.approx(direct.halo_nodes.mean(), rel=0.1)  # another chance


@pytest.mark.parametrize(("arguments", "words"), [
    (["--parts", "4,x"], "whole numbers above 0"),
    (["--parts", "100000"], "13824 cells into 100000 parts"),
    (["--latency", "-1"], "--latency -1"),
])  # fmt: skip
def test_what_cannot_be_predicted_is_said(tmp_path, arguments, words):
    deck = tmp_path / "scene.toml"
    deck.write_text(SCENE)
    mpitled("build", deck, "--out", tmp_path)
    assert words in complaint(mpitled("predict", tmp_path, *arguments, status=2))
