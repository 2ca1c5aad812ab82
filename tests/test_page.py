"""The page of a run: in a real browser, with and without rendering, of a brain and of a shape that was stopped."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
from itertools import combinations
from typing import Any

import markupsafe
import numpy as np
import pytest
from browser import overlaps, shown
from conftest import ENVIRONMENT, ROOT, complaint, mpitled

from mpitled.results import final_state, page, report

pytest.importorskip("matplotlib")
pytest.importorskip("pyvista")
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
    """The folder of a run that became unstable, with its page, and every figure drawn in this process for it.

    The renderer fails, so the page has no views. The figure of the views is drawn with blank images instead.
    """
    from matplotlib.figure import Figure

    from mpitled.results import charts, views

    folder = tmp_path_factory.mktemp("stopped")
    (folder / "cylinder.toml").write_text(CYLINDER)
    mpitled("run", folder / "cylinder.toml", "-q", "--out", folder / "out", status=3)
    drawn, save = [], Figure.savefig
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda self, *to, **how: (drawn.append(self), save(self, *to, **how)))
        patch.setattr(sys, "executable", shutil.which("false"))  # the renderer's process, which then fails
        page.write(folder / "out", report.make(folder / "out"))
        patch.setattr(views, "_render", lambda *_: np.full((9, 9, 3), 255, np.uint8))
        views.figure(final_state.read(folder / "out")).savefig(io.BytesIO())
        found = {"pushed through the interface": 4008.5, "compression of the cloud": 95.4}  # it has no tumour
        charts.draw_balance(4155.3, found, io.BytesIO())
    return folder / "out", drawn


def sections(out):
    return set(re.findall(r"<h2>(.*?)</h2>", (out / report.PAGE).read_text()))


def test_a_page_has_what_the_scene_has(brain, stopped):
    assert sections(brain) == SECTIONS | {"Volume balance"}
    text, made = (brain / report.PAGE).read_text(), report.compute(final_state.read(brain))
    assert made.warnings
    values = [f"{made.ventricle_volume_change_ml['left']:+.3f}", f"{made.tumour_volume_mm3:.1f} mm", *made.warnings]
    for value in (*values, "away from its centre, from a radius of 2 mm to ", "drawn by PyVista"):
        assert str(markupsafe.escape(value)) in text

    out, _ = stopped
    assert sections(out) == SECTIONS
    text = (out / report.PAGE).read_text()
    assert "A cylinder &lt;squeezed&gt; &amp; more" in text
    assert re.search(r"not complete: the last frame is at [\d.]+% of the load; unstable at .*worst is", text)
    assert "There is no three-dimensional picture: PyVista cannot render on this machine." in text
    assert ": one rank" in text  # the exchange of nodal values is left out


@pytest.mark.parametrize("width", [1250, 600])
def test_a_browser_shows_it_all_and_asks_for_nothing(tmp_path, brain, stopped, width):
    for out, n_pictures in ((brain, 7), (stopped[0], 5)):
        answer = shown(out / report.PAGE, width, tmp_path)
        assert answer["said"] == answer["fetched"] == []
        assert len(answer["pictures"]) == n_pictures
        assert all(alt and across > 500 and down > 100 for alt, across, down in answer["pictures"])
        assert answer["width"][0] <= answer["width"][1]
        assert len(answer["boxes"]) > 100
        assert overlaps(answer) == []


def test_a_page_with_faults_is_found_out(tmp_path, stopped):
    """What the test above would not overlook."""
    text = (stopped[0] / report.PAGE).read_text()
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


def test_views_show_the_grown_tumour_and_which_side_is_which(tmp_path, monkeypatch, brain):
    """In the same scale before and after; only the outer surface of the body, of which the cloud's end is no part."""
    from matplotlib.image import imread

    from mpitled.results import solid, views

    state = final_state.read(brain)
    meshes = solid.solid_of(state)
    np.testing.assert_array_equal(np.unique(meshes.surface.regular_faces), state.model.node_sets["skull"])
    assert meshes.surface.volume > 0  # normals point outwards

    assert views.draw(brain, tmp_path / "views.png") == ""
    pixels = imread(tmp_path / "views.png")[:, :, :3]
    red, green, blue = np.moveaxis(pixels, 2, 0)
    orange = (red > 0.3) & (green < 0.55 * red) & (green > 0.35 * red) & (blue < 0.1 * red)
    half = len(pixels) // 2
    grown = state.metadata["tumour"]["radius_m"] / state.metadata["tumour"]["seed_radius_m"]
    for row in (orange[:half], orange[half : -half // 8]):  # without the legend
        left, right = (np.count_nonzero(side) for side in np.array_split(row, 2, axis=1))
        assert right / left == pytest.approx(grown**2, rel=0.25)

    monkeypatch.setattr(views, "_render", lambda *_: np.full((9, 9, 3), 255, np.uint8))
    figure = views.figure(state)
    for axes in figure.axes[:4]:
        at = {text.get_text(): text.get_position()[0] for text in axes.texts}
        assert at["L"] < at["R"]
    assert "surface of the body" in figure.legends[0].get_texts()[-1].get_text()


def test_what_holds_no_run_is_told_apart(tmp_path):
    deck = tmp_path / "scene.toml"
    deck.write_text(CYLINDER)
    for path, words in (
        (tmp_path / "nowhere", "is not a folder; give the folder that 'mpitled run' wrote"),
        (deck, "is not a folder"),
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
