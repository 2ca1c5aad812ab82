"""Studies: every run once, errors against a reference, Pareto optima, and failures."""

from __future__ import annotations

import csv
import json
import shutil
from itertools import combinations

from conftest import ROOT, complaint, mpitled
from matplotlib.text import Text
from scenes import TUMOUR

from mpitled.results import charts

CUBE = ROOT / "jobs" / "validation" / "cube.toml"
REFERENCE = ROOT / "tests" / "data" / "E3_cube_stress_50.npz"


def rows(out):
    with (out / "study.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_study_resumes_and_has_errors_and_failures(tmp_path):
    """The compression is homogeneous: every mesh has the exact solution within the tolerance of relaxation."""
    out = tmp_path / "study"
    arguments = [
        "study", CUBE, "--out", out, "--reference", REFERENCE, "--set", "solver.method=dynamic-relaxation",
        "--set", "block.elements=[4,4,4]", "--vary", "solver.tolerance=0.1,0.001",
        "--vary", "block.elements=[4,4,4],[2,2,2]+ranks=2,1", "--vary", "solver.load_steps=1",
    ]  # fmt: skip
    first = mpitled(*arguments)
    assert first.stderr.count("/6: ") == 6
    assert "1/6: as it is\n" in first.stderr
    table = rows(out)
    assert [(row["family"], row["value"], row["ranks"]) for row in table] == [
        ("as it is", "", "1"),
        ("solver.tolerance", "0.1", "1"),
        ("solver.tolerance", "0.001", "1"),
        ("block.elements+ranks", "[4,4,4] 2", "2"),
        ("block.elements+ranks", "[2,2,2] 1", "1"),
        ("solver.load_steps", "1", "1"),
    ]
    done, failed = table[:-1], table[-1]
    assert "unstable" in failed["failure"]  # half the height in one step
    assert failed["max_error_mm"] == ""
    for row in done:
        assert float(row["max_error_mm"]) < 3 * float(row["static_distance_mm"])
        assert int(row["cell_updates"]) == int(row["cells"]) * int(row["steps"])
    assert [int(row["cells"]) for row in done[-2:]] == [64, 8]
    assert int(done[1]["steps"]) < int(done[2]["steps"])
    errors = [(float(row["max_error_mm"]), float(row["loop_s"])) for row in done]
    for row, (error, seconds) in zip(done, errors, strict=True):
        beaten = any(e <= error and s <= seconds and (e, s) != (error, seconds) for e, s in errors)
        assert row["pareto"] == str(not beaten)
    assert (out / "study.png").stat().st_size > 10_000

    removed = next(out.glob("solver.tolerance-0.1-*"))
    shutil.rmtree(removed)
    again = mpitled(*arguments, "--json")
    assert "1/6: " not in again.stderr
    assert again.stderr.count("/6: solver.tolerance 0.1\n") == 1
    assert removed.exists()
    records = json.loads(again.stdout)
    assert [row["max_error_mm"] is None for row in records] == [row["max_error_mm"] == "" for row in table]
    quiet = mpitled(*arguments, "-q")
    assert (quiet.stdout, quiet.stderr) == ("", "")


def test_names_in_the_picture_do_not_overlap(tmp_path):
    """In the study of jobs/studies, half of the runs are close to each other."""
    with (ROOT / "jobs" / "studies" / "tumour.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    for row in table:
        row |= {"loop_s": float(row["loop_s"]), "max_error_mm": float(row["max_error_mm"])}
        row["pareto"] = row["pareto"] == "True"
    figure = charts.draw_study(table, tmp_path / "study.png", "largest error, mm")
    figure.draw_without_rendering()
    axes = figure.axes[0]
    assert sorted(text.get_text() for text in axes.texts) == sorted(row["value"] for row in table if row["value"])
    boxes = [Text.get_window_extent(text) for text in axes.texts]  # without the lines to their points
    for one, other in combinations(boxes, 2):
        assert not one.overlaps(other)
    for box in boxes:
        assert axes.bbox.x0 < box.x0 < box.x1 < axes.bbox.x1
        assert axes.bbox.y0 < box.y0 < box.y1 < axes.bbox.y1


def test_without_a_reference_runs_are_compared_with_the_run_of_most_work(tmp_path):
    """Each run ends within 0.01 mm of rest, although the coarse cloud has a larger error."""
    deck, out = tmp_path / "scene.toml", tmp_path / "study"
    deck.write_text(TUMOUR)
    keys = ["solver.method=dynamic-relaxation", "output.pictures=false"]
    base = [word for key in keys for word in ("--set", key)]
    done = mpitled("study", deck, *base, "--vary", "cloud.growth=1.0,0.3", "--out", out)
    table = rows(out)
    (finest,) = [row for row in table if row["is_reference"]]
    assert finest["value"] == "0.3"
    assert finest["max_error_mm"] == ""
    unvaried, coarse, _ = table
    assert 0.05 < float(unvaried["max_error_mm"]) < float(coarse["max_error_mm"])
    assert "difference" in done.stdout
    assert "reference" in done.stdout
    report = json.loads(next(out.glob("cloud.growth-1.0-*/report.json")).read_text())
    assert float(coarse["cloud_misfit_mm"]) == report["cloud_misfit_mm"]
    assert coarse["warnings"] == "; ".join(report["warnings"]) != ""
    line = next(line for line in done.stdout.splitlines() if " 1.0 " in line)
    assert "!" in line[:3]
    alone = mpitled("study", deck, *base, "--out", tmp_path / "alone")
    assert "no picture" in alone.stderr
    assert "reference" in alone.stdout


def test_bad_values_end_a_study_before_its_first_run(tmp_path):
    for vary, word in (
        ("solver.load_step=1,2", "solver.load_step"),
        ("solver.tolerance", "key=value"),
        ("a=1,2+b=3", "equally many values"),
        ("ranks=0", "ranks = 0"),
    ):
        line = complaint(mpitled("study", CUBE, "--out", tmp_path / "study", "--vary", vary, status=2))
        assert word in line
        assert not (tmp_path / "study").exists()
