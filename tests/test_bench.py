"""The scripts in jobs/bench: operations as counted by hand, the result and its comparison, and predictions."""

from __future__ import annotations

import csv
import json

import bench
import flops
import limits
import models
import numpy as np
import predict
import pytest
import scaling
from conftest import ranks

import partition
from mpitled.mesh import structured_hexahedra


@pytest.fixture
def small(monkeypatch):
    """Blocks of a few hundred cells."""
    monkeypatch.setattr(models, "SIZES", {"voxel": (8,), "distorted": (6,), "cloud": (6,), "mixed": (7.0,)})
    monkeypatch.setattr(scaling, "STRONG", {"voxel": 8})


def test_the_result_has_every_case_and_a_slower_case_is_an_exit_status(small, tmp_path, capfd, monkeypatch):
    ranks(2)  # skips where there is no mpirun
    monkeypatch.delitem(models.SIZES, "mixed")
    path = tmp_path / "new.json"
    assert bench.main(["--quick", "--ranks", "1,2", "--json", str(path)]) == 0
    table = capfd.readouterr().out
    result = json.loads(path.read_text())
    assert set(result) == {"machine", "commit", "limits", "cases"}
    cases = {(case["scene"], case["precision"], case["ranks"]): case for case in result["cases"]}
    scenes, precisions = ("voxel", "distorted", "cloud"), ("float64", "float32")
    assert set(cases) == {(s, p, n) for s in scenes for p in precisions for n in (1, 2)}
    assert len(table.splitlines()) == 2 + len(cases)
    for (_, _, n), case in cases.items():
        assert case[bench.RATE] > 0
        assert 0 < case["roofline_share"] < 1
        assert (case["halo_share"] > 0) == (n == 2)
    for scene in scenes:
        assert len({cases[scene, p, n]["cells"] for p in precisions for n in (1, 2)}) == 1
        # Node numbers keep their width and nodes move in double precision; forces and the data of cells are halved.
        assert 0.5 < cases[scene, "float32", 1]["bytes_per_cell"] / cases[scene, "float64", 1]["bytes_per_cell"] < 1
    assert cases["voxel", "float64", 1]["cells"] == 512

    assert not bench.compare(result, result)
    (voxel,) = (case for key, case in cases.items() if key == ("voxel", "float64", 1))
    path.write_text(json.dumps(result | {"cases": [voxel | {bench.RATE: 1e6 * voxel[bench.RATE]}]}))
    monkeypatch.setattr(models, "SIZES", {"voxel": (8,), "distorted": (6,)})
    capfd.readouterr()
    assert bench.main(["--quick", "--ranks", "1", "--compare", str(path)]) == 1
    printed = capfd.readouterr()
    assert printed.out.count("slower") == 1
    assert printed.err.count("1 rank(s): voxel") == 2  # timed again before it is reported
    assert printed.err.count("1 rank(s): distorted") == 1


def test_operations_are_counted_as_by_hand(tmp_path):
    a, b = np.frompyfunc(flops.Counting, 1, 1)(np.array([2.0, 3.0]))
    before = flops.Counting.operations
    assert (np.sqrt(abs(-a * b + 4.0)) / a).value == pytest.approx(2**0.5 / 2)
    assert ((1.0 - a).value, a < b, a > 2.5) == (-1.0, True, False)
    assert flops.Counting.operations - before == 5
    counted = flops.count_operations(tmp_path)["voxel"]
    # u+ = (u - u_prev) + u - dt^2/m f, in three directions, and a product at the moving nodes of the upper face.
    assert counted["update"] == pytest.approx(12 + 1 / 3)
    assert counted["voxel hexahedra"] > 66  # those of the stress alone


def test_the_limits_are_those_of_a_machine():
    double, single = limits.multiply_adds("float64"), limits.multiply_adds("float32")
    assert 1e8 < double < single
    assert limits.triad(1 << 26, 3) > 1e8


def test_without_all_features_the_step_of_the_brain_is_faster(small, capsys):
    pytest.importorskip("nibabel")
    assert bench.main(["--quick", "--ablation"]) == 0
    gains = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines()[1:]]
    assert len(gains) == 10
    assert gains[-1] > gains[0] == 1


def test_scaling_compares_ranks_with_separate_runs(small, capsys):
    ranks(2)
    assert bench.main(["--quick", "--scaling", "--ranks", "2"]) == 0
    rows = [row.split() for row in capsys.readouterr().out.splitlines()[1:]]
    assert [row[:4] for row in rows] == [["strong", "voxel", "2", "512"], ["weak", "voxel", "2", "1024"]]
    assert all(float(cell.rstrip("%")) > 0 for row in rows for cell in row[4:])


@pytest.mark.parametrize(("arguments", "words"), [
    (["--ranks", "0"], "--ranks"),
    (["--compare", "no.json"], "no.json"),
    (["--compare", __file__], "no result of a benchmark"),
])  # fmt: skip
def test_bad_options_are_refused(arguments, words, capsys):
    with pytest.raises(SystemExit) as end:
        bench.main(arguments)
    assert end.value.code == 2
    assert words in capsys.readouterr().err


def test_the_predicted_time_of_a_step_is_that_of_the_slowest_rank():
    """A bar of 6 x 2 x 2 hexahedra, cut by hand into 1, 2 and 3 layers: 9 nodes between neighbours."""
    hexahedra = structured_hexahedra((6, 2, 2))
    part = np.array([0, 1, 1, 2, 2, 2], np.int32)[np.arange(24) % 6]
    tables = partition.tables(hexahedra, np.empty((0, 12), np.int64), part, 3)
    cluster = predict.Cluster(latency=5e-6, bandwidth=1e9, rate=1e6, fixed=2e-6)
    row = predict.step_time(partition.figures(tables, np.ones(24), 24), cluster)
    # Ranks have 4, 8, 12 cells of 1 us each, and 1, 2, 1 neighbours.
    transfer = 9 * 24 / 1e9 * 1e6
    steps = np.array([4 + 5 + transfer, 8 + 10 + 2 * transfer, 12 + 5 + transfer]) + 2
    assert row["step_us"] == pytest.approx(steps.max())
    assert (row["compute_us"], row["latency_us"]) == pytest.approx((8, 10))
    assert row["efficiency"] == pytest.approx((24 + 2) / (3 * steps.max()))
    assert row["efficiency_overlapped"] == pytest.approx((24 + 2) / (3 * (12 + 2)))
    assert (row["neighbours_largest"], row["halo_nodes_largest"], row["balance"]) == (2, 18, 12 / 8)


def test_predictions_rest_on_partitions_that_metis_makes(tmp_path, capsys):
    model = models.build(tmp_path / "block", "voxel", 24)["model"]
    predict.main([model, "--parts", "4,16,3,8", "--rate", "10", "--out", str(tmp_path)])
    assert capsys.readouterr().err.count("METIS") == 2  # 8 and 4 parts are unions of the 16
    with (tmp_path / "predict.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["parts"] for row in rows] == ["3", "4", "8", "16"]
    assert (tmp_path / "predict.png").stat().st_size > 10_000
    hexahedra, none = structured_hexahedra((24, 24, 24)), np.empty((0, 12), np.int64)
    graph = partition.cell_graph(hexahedra, none, np.empty((0, 3)))
    for row in rows:
        n = int(row["parts"])
        part = partition.cut(graph, n, np.ones(24**3))
        direct = partition.figures(partition.tables(hexahedra, none, part, n), np.ones(24**3), len(hexahedra))
        assert float(row["balance"]) == pytest.approx(direct.balance, abs=0.005)
        assert float(row["halo_nodes_mean"]) == pytest.approx(direct.halo_nodes.mean(), rel=0.1)
    for arguments, words in ((["--parts", "100000"], "13824 cells into 100000"), (["--latency", "-1"], "above 0")):
        with pytest.raises(SystemExit):
            predict.main([model, *arguments])
        assert words in capsys.readouterr().err
