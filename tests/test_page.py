"""The page of a run: in a real browser, with and without PyVista, of a brain and of a shape that was stopped."""

from __future__ import annotations

import importlib.util
import io
import re
import shutil
import subprocess
import sys
from itertools import combinations
from typing import Any

import pytest
from browser import overlaps, shown
from conftest import ENVIRONMENT, ROOT, complaint, mpitled

from mpitled.results import page, report

pytest.importorskip("matplotlib")
pytest.importorskip("nibabel")

CYLINDER = """
title = "A cylinder <squeezed> & more"
[cylinder]
radius = 20.0
height = 40.0
cloud = "core"
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[fixed]]
nodes = "bottom"
[[displaced]]
nodes = "top"
displacement = [0.0, 0.0, -45.0] # through itself
[solver]
method = "quasi-static"
load_time = 0.02
[output]
frames = 10
pictures = false
"""
SECTIONS = {
    "Scene", "Mesh", "Cross-sections", "In three dimensions", "Displacement", "Through the run", "Run time",
    "All figures",
}  # fmt: skip


@pytest.fixture(scope="module")
def brain(segmentation):
    """The folder of a run with its page."""
    return segmentation[0] / "trial"


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """The folder of a run that cannot go on, with its page, and every figure that was drawn for it without PyVista."""
    from matplotlib.figure import Figure

    from mpitled.results import charts

    folder = tmp_path_factory.mktemp("stopped")
    (folder / "cylinder.toml").write_text(CYLINDER)
    mpitled("run", folder / "cylinder.toml", "-q", "--out", folder / "out", status=3)
    drawn, save = [], Figure.savefig
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda self, *to, **how: (drawn.append(self), save(self, *to, **how)))
        patch.setattr(sys, "executable", shutil.which("false"))  # PyVista's process, which then fails
        page.write(folder / "out", report.write(folder / "out"))
        found = {"pushed through the interface": 4008.5, "compression of the cloud": 95.4}  # it has no tumour
        charts.draw_balance(4155.3, found, io.BytesIO())
    return folder / "out", drawn


def sections(out):
    return set(re.findall(r"<h2>(.*?)</h2>", (out / page.PAGE).read_text()))


def test_a_page_has_what_the_scene_has(brain, stopped):
    assert sections(brain) == SECTIONS | {"Volume balance"}
    text, made = (brain / page.PAGE).read_text(), report.compute(report.read(brain))
    for value in (f"{made['ventricle_volume_change_ml']['left']:+.3f}", f"{made['tumour_volume_mm3']:.1f} mm"):
        assert value in text
    assert "away from its centre, from a radius of 2 mm to " in text
    assert made["warnings"]
    for warning in made["warnings"]:
        assert warning in text

    out, _ = stopped
    assert sections(out) == SECTIONS
    text = (out / page.PAGE).read_text()
    assert "A cylinder &lt;squeezed&gt; &amp; more" in text
    assert re.search(r"not complete: the last frame is at [\d.]+% of the load; unstable at .*worst is", text)
    assert "drawn by matplotlib (PyVista found no way to draw here)" in text
    assert "gather, add, add_gathered, scatter: one rank" in text


@pytest.mark.parametrize("width", [1250, 600])
def test_a_browser_shows_it_all_and_asks_for_nothing(tmp_path, brain, stopped, width):
    for out, n_pictures in ((brain, 7), (stopped[0], 6)):
        answer = shown(out / page.PAGE, width, tmp_path)
        assert answer["said"] == answer["fetched"] == []
        assert len(answer["pictures"]) == n_pictures
        assert all(alt and across > 500 and down > 100 for alt, across, down in answer["pictures"])
        assert answer["width"][0] <= answer["width"][1]
        assert len(answer["boxes"]) > 100
        assert overlaps(answer) == []


def test_a_page_with_faults_is_found_out(tmp_path, stopped):
    """What the test above would not overlook."""
    text = (stopped[0] / page.PAGE).read_text()
    bad = tmp_path / "bad.html"
    wrong = '<img alt="x" src="https://example.org/x.png"><p style="margin-top:-9rem; min-width:5000px">over it</p>'
    bad.write_text(text.replace("</figure>", "</figure>" + wrong, 1))
    answer = shown(bad, 1250, tmp_path)
    assert any("example.org" in words for words in answer["said"])
    assert answer["pictures"][1][1] == 0
    assert answer["width"][0] > answer["width"][1]
    assert any("over it" in pair for pair in overlaps(answer))


def test_words_in_the_pictures_do_not_overlap(monkeypatch, stopped):
    from matplotlib.text import Text

    _, drawn = stopped
    assert len(drawn) == 7
    for figure in drawn:
        boxes = []

        def draw(self: Text, renderer: Any, boxes: list[Any] = boxes) -> None:
            if self.get_visible() and self.get_text().strip():
                boxes.append((self.get_text(), self.get_window_extent(renderer)))

        with monkeypatch.context() as patch:
            patch.setattr(Text, "draw", draw)
            figure.draw_without_rendering()
        assert len(boxes) > 4
        for (one, a), (other, b) in combinations(boxes, 2):
            if one != other:
                across, down = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
                assert across < 1 or down < 1, f"{one} / {other}"
        labels = [label for axes in figure.axes for label in (axes.get_xlabel(), axes.get_ylabel()) if label]
        assert all(re.search(r"\(.+\)$", label) for label in labels), labels  # a unit on every axis


def test_pyvista_draws_what_matplotlib_draws(tmp_path, brain):
    """The same views: where one has the dark tumour, grown, so has the other."""
    if importlib.util.find_spec("pyvista") is None:
        pytest.skip("no pyvista")
    from matplotlib.image import imread

    from mpitled.results import views

    assert views.draw(brain, tmp_path / "pyvista.png") == "PyVista"
    views._draw(brain, tmp_path / "matplotlib.png", views._painter)
    dark = [imread(tmp_path / f"{name}.png")[:, :, :3].sum(axis=2) < 0.6 for name in ("pyvista", "matplotlib")]
    assert dark[0].shape == dark[1].shape
    assert dark[0].mean() == pytest.approx(dark[1].mean(), rel=0.1)


def test_views_show_the_body_alone_and_say_which_side_is_which(tmp_path, monkeypatch, brain):
    """The end of the cloud inside of it would look like a crater."""
    import numpy as np
    from matplotlib.figure import Figure

    from mpitled.results import views
    from mpitled.results.solid import solid_of

    outcome, drawn = report.read(brain), []
    solid = solid_of(outcome.model, outcome.moved)
    np.testing.assert_array_equal(np.unique(solid.surface), outcome.model.node_sets["skull"])
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: drawn.append(self))
    views._draw(brain, tmp_path / "views.png", views._painter)
    for axes in drawn[0].axes[:4]:
        at = {text.get_text(): text.get_position()[0] for text in axes.texts}
        assert at["L"] < at["R"]
    assert "surface of the body" in drawn[0].legends[0].get_texts()[-1].get_text()


def test_what_holds_no_run_is_told_apart(tmp_path):
    deck = tmp_path / "scene.toml"
    deck.write_text(CYLINDER)
    for path, words in (
        (tmp_path / "nowhere", "is no folder; give the one that 'mpitled run' wrote"),
        (deck, "is no folder"),
        (tmp_path, "holds no result; give the folder"),
    ):
        assert words in complaint(mpitled("report", path, "--html", status=2))
    for path, words in ((tmp_path / "nowhere", "there is no such file"), (tmp_path, "holds no result")):
        assert words in complaint(mpitled("view", path, status=2))


def test_a_window_needs_a_screen(brain):
    no_screen = ENVIRONMENT | {"DISPLAY": ":12345"}
    code = "from mpitled.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "view", str(brain)], env=no_screen, cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "--html" in complaint(done)
