"""The dry run against the run: the same terms on as many steps, and a reason for whatever is left out."""

from __future__ import annotations

import json
import re
import shutil

import pytest
from conftest import mpitled
from scenes import block, pulled

from mpitled.deck import load_deck
from mpitled.errors import InputError
from mpitled.job import prepare, run
from mpitled.parallel.halo import World
from mpitled.preview.kernel_trace import kernel_names
from mpitled.store import open_result
from mpitled.terms import TERMS, BorderCells, StartHalo

SCENE = (
    block((20, 20, 20), (8, 7, 7), "{cloud}")
    + pulled(0.1)
    + """
[support]
nodes = 12
[solver]
method = "quasi-static"
load_time = 0.1
[output]
frames = 1
"""
)


@pytest.mark.parametrize(("cloud", "ranks", "overrides"), [
    ("none", 1, ["hexahedra.hourglass=0.01"]),
    ("core", 2, ["solver.method=dynamic", "support.stabilisation=0", "solver.load_time=0.01"]),
    ("all", 1, ["solver.method=dynamic-relaxation", "solver.load_steps=500", "displaced.0.rotation=10"]),
])  # fmt: skip
def test_a_dry_run_tells_the_terms_that_the_run_takes_and_takes_no_step(tmp_path, cloud, ranks, overrides):
    deck, out = tmp_path / "scene.toml", tmp_path / "out"
    deck.write_text(SCENE.format(cloud=cloud))
    arguments = ["run", deck, "--out", out, *(word for override in overrides for word in ("--set", override))]
    told = mpitled(*arguments, "--dry", n=ranks).stdout
    assert [path.name for path in out.iterdir()] == ["model.h5"]
    mpitled(*arguments, "-q", n=ranks)
    report = json.loads((out / "report.json").read_text())
    assert re.findall(r"^  ([a-z ]+), [0-9.]+ ms$", told, re.M) == list(report["term_seconds"])
    lines = told.splitlines()
    assert [line.partition(":")[0] for line in lines[:3]] == [
        "steps",
        "loop",
        "output",
    ]  # what matters most comes first
    assert len(lines) < 45
    table = 1 + next(i for i, line in enumerate(lines) if line.startswith("rank "))
    rows = [line.split() for line in lines[table : table + ranks]]
    assert all(float(row[5]) > 50 and float(row[6]) > 50 for row in rows)  # bytes a cell, of a step and held
    assert sum(int(row[1]) for row in rows) == report["cells"]["hexahedra"]
    assert sum(int(row[2]) for row in rows) == report["cells"]["support_domains"]
    steps = int(re.search(r"^steps: (\d+)", told, re.M)[1])
    # Where surveys become rarer, the step is fitted to them anew.
    assert steps == 500 if cloud == "all" else steps <= report["steps"] <= 1.05 * steps
    size, unit, n = re.search(r"^output: ([0-9.]+) (kB|MB) in (\d+) frames$", told, re.M).groups()
    with open_result(out) as result:
        assert result.n_frames == int(n)
    assert float(size) * {"kB": 1e3, "MB": 1e6}[unit] == pytest.approx((out / "result.vtkhdf").stat().st_size, rel=0.01)
    assert ("stabilisation of support domains: support.stabilisation = 0" in told) == (cloud == "core")
    assert ("halo: one rank" in told) == (ranks == 1)
    assert ("rotation of prescribed nodes: no node is rotated" in told) == (cloud != "all")
    if ranks == 1:  # what the result tells of itself
        with open_result(out) as result:
            spared = result.metadata["left_out"]
        first = lines.index("left out:") + 1
        assert [f"  {what}" for what in spared] == lines[first : first + len(spared)]
        assert lines[first + len(spared)].startswith("-v ")
        long = mpitled(*arguments, "--dry", "-v").stdout
        for name in kernel_names():
            short, full = (re.search(rf"\b{name}\b", text.partition("left out:")[0]) for text in (told, long))
            assert bool(short) == bool(full)
        assert len(re.findall(r"\d+x\d+ (?:float|uint)", long)) > 10
        assert not re.search("float64|uint32", told)


def test_a_disc_without_room_for_the_result_is_found_before_the_run(tmp_path, monkeypatch):
    deck, out = tmp_path / "scene.toml", tmp_path / "out"
    deck.write_text(SCENE.format(cloud="none"))
    scene = load_deck(deck, ("output.frames=1000",))
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=10**6))
    with pytest.raises(
        InputError, match=r"the result of 1001 frames takes 31.5 MB, and 1 MB are free there; lower"
    ) as e:
        run(scene, out, World(), quiet=True)
    assert "\n" not in str(e.value)
    assert [path.name for path in out.iterdir()] == ["model.h5"]


def test_every_term_is_either_taken_or_left_out_for_a_reason(tmp_path):
    deck = tmp_path / "scene.toml"
    deck.write_text(SCENE.format(cloud="none"))
    step = prepare(load_deck(deck), tmp_path, World()).integrator.step
    present = {type(term) for term in step.terms}
    for cls in TERMS:
        reasons = [*cls.left_out(step.scene, cls in present)]
        assert cls in present or reasons or cls in (BorderCells, StartHalo)  # with `InteriorCells` and `FinishHalo`
        assert all(": " in reason for reason in reasons)
