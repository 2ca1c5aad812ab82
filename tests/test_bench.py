"""The benchmark: operations as counted by hand, a sound outcome in the form that is promised, and its comparison."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import complaint, ended, mpitled, ranks

from mpitled.speed import bench, limits, omissions
from mpitled.speed.flops import Counting, of_terms

CASE = {"scene", "cells", "precision", "ranks", "million_cell_updates_per_second_per_core", "bytes_per_cell",
        "halo_share", "roofline_share"}  # fmt: skip
RATE = "million_cell_updates_per_second_per_core"


@pytest.fixture
def small(monkeypatch):
    """Scenes of a few hundred cells, the mixed one without the brain."""
    monkeypatch.setattr(bench, "SIZES", {"voxel": (8,), "distorted": (6,), "cloud": (6,), "mixed": (11.0,)})
    monkeypatch.setattr(bench, "_BRAIN", Path("no such file"))


def test_the_outcome_is_in_the_form_that_is_promised_and_can_be_compared(small, tmp_path, capfd, monkeypatch):
    ranks(2)  # skips where there is no mpirun
    path, counted, count = tmp_path / "new.json", [], bench.operations
    monkeypatch.setattr(bench, "operations", lambda folder: counted.append(count(folder)) or counted[0])
    assert ended("bench", "--quick", "--ranks", "1,2", "--json", path) == 0
    table = capfd.readouterr().out
    made = json.loads(path.read_text())
    assert set(made) == {"machine", "commit", "limits", "cases"}
    found = {(case["scene"], case["precision"], case["ranks"]) for case in made["cases"]}
    scenes, precisions = ("voxel", "distorted", "cloud", "mixed"), ("float64", "float32")
    assert found == {(s, p, n) for s in scenes for p in precisions for n in (1, 2)}
    assert len(table.splitlines()) == 2 + len(found)
    by_key = {}
    for case in made["cases"]:
        assert set(case) == CASE
        assert case[RATE] > 0
        assert 0 < case["roofline_share"] < 1
        assert (case["halo_share"] > 0) == (case["ranks"] == 2)
        by_key[case["scene"], case["precision"], case["ranks"]] = case
    for scene in scenes:
        assert len({by_key[scene, p, n]["cells"] for p in precisions for n in (1, 2)}) == 1
        # Node numbers keep their width and nodes move in double; forces, and what a cell has, are halved.
        assert 0.5 < by_key[scene, "float32", 1]["bytes_per_cell"] / by_key[scene, "float64", 1]["bytes_per_cell"] < 1
    assert by_key["voxel", "float64", 1]["cells"] == 512

    old = {**made, "cases": [{**made["cases"][0], RATE: 1e6 * made["cases"][0][RATE]}]}
    assert bench.comparison(made, made)[1] is False
    (tmp_path / "old.json").write_text(json.dumps(old))
    # Of two scenes, and with the operations as they were counted before: these are of small models of their own.
    monkeypatch.setattr(bench, "SIZES", {"voxel": (8,), "distorted": (6,)})
    monkeypatch.setattr(bench, "operations", lambda folder: counted[0])
    assert ended("bench", "--quick", "--ranks", "1", "--compare", tmp_path / "old.json") == 1
    out = capfd.readouterr()
    assert out.out.count("slower") == 1
    assert out.err.count("1 rank: voxel") == 2  # timed once more before it is said
    assert out.err.count("1 rank: distorted") == 1


def test_operations_are_counted_as_by_hand(tmp_path):
    a, b = np.frompyfunc(Counting, 1, 1)(np.array([2.0, 3.0]))
    before = Counting.operations
    assert (np.sqrt(abs(-a * b + 4.0)) / a).value == pytest.approx(2**0.5 / 2)
    assert Counting.operations - before == 4
    told = bench.scene(tmp_path / "voxel", "voxel", [32, 2, 2])
    (counted,) = of_terms([Path(told["model"])], told["stabilisation"])
    # u+ = (u - u_prev) + u - mobility f, in three directions, and a product where nodes of the upper face are moved.
    assert counted["update"] == pytest.approx(12 + 1 / 3)
    assert counted["voxel hexahedra"] > 66  # those of the stress alone


def test_the_machines_limits_are_those_of_a_machine():
    """Single precision has twice the lanes; what stays in the caches is no slower than what does not."""
    double, single = limits.multiply_adds("float64"), limits.multiply_adds("float32")
    assert 1e8 < double < single
    assert limits.triad(1 << 26, 3) > 1e8


def test_every_omission_is_left_out_of_the_step_with_everything_on(small, capfd):
    assert ended("bench", "--quick", "--omissions") == 0
    rows = capfd.readouterr().out.splitlines()[1:]
    names = [row[:26].strip() for row in rows]
    assert names == ["(everything on)", *omissions.OMISSIONS, "all of these"]
    gains = dict(zip(names, (float(row.split()[-1]) for row in rows), strict=True))
    assert gains["all of these"] > gains["(everything on)"] == 1


def test_ranks_are_held_against_as_many_runs_of_one(small, capfd):
    ranks(2)
    assert ended("bench", "--quick", "--scaling", "--ranks", "2") == 0
    rows = [row.split() for row in capfd.readouterr().out.splitlines()[1:]]
    assert [row[:3] for row in rows] == [["strong", "mixed", "2"], ["strong", "voxel", "2"], ["weak", "voxel", "2"]]
    assert [row[3] for row in rows[1:]] == ["512", "1024"]
    for *_, rate, apart, efficiency, halo in rows:
        assert min(float(rate), float(apart), float(efficiency[:-1])) > 0
        assert 0 < float(halo[:-1]) < 100


@pytest.mark.parametrize(("arguments", "words"), [
    (["--ranks", "0"], "whole numbers above 0"),
    (["--compare", "no.json"], "no.json"),
    (["--compare", __file__], "no outcome of a benchmark"),
])  # fmt: skip
def test_what_cannot_be_benchmarked_is_said_before_anything_runs(arguments, words):
    assert words in complaint(mpitled("bench", *arguments, status=2))
