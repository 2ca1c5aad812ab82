"""First decks, and messages about wrong decks."""

from __future__ import annotations

import json
import os
import re

import pytest
from conftest import ROOT, complaint, mpitled
from scenes import TUMOUR

from mpitled import scaffold
from mpitled.commands import KINDS
from mpitled.deck import canonical, load_deck
from mpitled.errors import InputError
from mpitled.model import build as model_build
from mpitled.preview import overview


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_deck_is_complete_and_shows_the_defaults(tmp_path, kind):
    """Every key after # has the value that takes effect without it."""
    path = tmp_path / "scene.toml"
    assert scaffold.write(kind, path)[0] == path
    figures = overview.figures(path)
    assert figures["hexahedra"] > 0
    assert figures["run"]["steps"] >= 50  # the smallest number of load steps of relaxation
    assert not [remark for remark in figures["remarks"] if "warning" in remark]
    text = path.read_text()
    shown = re.sub(r"^# (\w+ = .)", r"\1", text, flags=re.MULTILINE)
    assert len(shown) < len(text) - 40
    path.write_text(shown)
    changed = canonical(load_deck(path))
    path.write_text(text)
    assert changed == canonical(load_deck(path))


def test_a_new_deck_replaces_no_file_and_runs(tmp_path):
    path = tmp_path / "cylinder.toml"
    mpitled("new", "cylinder", path)
    assert "exists already" in complaint(mpitled("new", "cylinder", path, status=2))
    done = mpitled("run", path, "-q", "-v", "--json", "--out", tmp_path / "out", "--set", "solver.load_time=0.2", n=2)
    # In this coarse mesh a node below the top moves 0.01 mm farther.
    assert json.loads(done.stdout)["max_displacement_mm"] == pytest.approx(4, rel=0.01)
    for rank in (0, 1):
        assert f"rank {rank}: loop\n" in done.stderr


def test_a_new_deck_goes_to_standard_output(tmp_path):
    printed = mpitled("new", "brain", "-").stdout
    assert "give a file" in complaint(mpitled("new", "decks", "-", status=2))
    assert not (ROOT / "-").exists()
    mpitled("new", "brain", tmp_path / "brain.toml")
    written = (tmp_path / "brain.toml").read_text().replace(os.path.relpath(ROOT, tmp_path) + "/", "")
    assert printed == written


BRAIN = """
[labels]
image = "{image}"
element_size = 6.0
[tumour]
centre = [-32.0, -20.0, 10.0]
volume = 4188.8
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
cells = ["tissue"]
[material.csf]
youngs_modulus = 10.0
poissons_ratio = 0.1
cells = ["left_ventricle", "right_ventricle"]
[[fixed]]
nodes = "skull"
"""

#: Correct text, mistake, and the key and the remedy in the message.
MISTAKES = {
    "volume in m3": ("4188.8", "4.1888e-6", "tumour.volume", "mm3; give more"),
    "centre outside of the head": ("[-32.0, -20.0", "[-32.0, -170.0", "tumour.centre", "mm"),
    "seed in a ventricle": ("[-32.0, -20.0, 10.0]", "[-10.0, -20.0, 20.0]", "tumour.centre", "ventricle"),
    "missing file": ("{image}", "no.nii.gz", "labels.image", "give a path relative to the deck"),
    "element size in metres": ("element_size = 6.0", "element_size = 0.006", "element_size", "mm"),
    "negative volume": ("4188.8", "-4188.8", "tumour.volume = -4188.8", "give a number above 0, in mm3"),
    "cells without a material": (', "right_ventricle"]', "]", "the first in right_ventricle", "name their set"),
    "unknown set": ('nodes = "skull"', 'nodes = "skul"', "fixed.0.nodes", "skull"),
}  # fmt: skip


def wrong(tmp_path, old: str, new: str):
    image = ROOT / "jobs" / "data" / "mni152_labels_2mm.nii.gz"
    path = tmp_path / "wrong.toml"
    assert old in BRAIN
    path.write_text(BRAIN.replace(old, new, 1).replace("{image}", str(image)))
    return path


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_deck_gets_a_message_to_act_on(tmp_path, mistake):
    old, new, culprit, remedy = MISTAKES[mistake]
    with pytest.raises(InputError) as caught:
        overview.check(wrong(tmp_path, old, new))
    message = str(caught.value)
    assert culprit in message
    assert remedy in message
    assert "\n" not in message
    assert len(message) < 500


SHIFTED = ["block.corner=[-24,-20,-20]"]


@pytest.mark.parametrize(("keys", "words"), [
    ([], []),
    (["tumour.volume=7240"], ["12 mm, beyond the cloud's 11 mm; enlarge cloud.radius"]),
    (["tumour.volume=3054", "tumour.seed_radius=1.0"], ["9 mm, 9 times its seed's, .* enlarge tumour.seed_radius"]),
    (["tumour.seed_radius=4.0"], ["seed_radius = 4: 51% of tumour.volume is there at the start"]),
    (["material.brain.poissons_ratio=0.4995"], ["poissons_ratio = 0.4995: results are known up to 0.499"]),
    (["material.brain.youngs_modulus=3"], ["youngs_modulus = 3: is softer than any tissue .*; moduli are in Pa"]),
    (["material.brain.youngs_modulus=0.003"], ["youngs_modulus = 0.003: is it in Pa?"]),
    (["material.brain.density=1"], ["material.brain.density = 1: is it in kg/m3?"]),
    (["fixed=[]"], ['no node but the tumour.s is held, .* with nodes = "surface"']),
    ([*SHIFTED, "tumour.centre=[-0.003,0.002,0.001]"], ["it looks like metres: in mm it is .-3, 2, 1"]),
    ([*SHIFTED, "tumour.centre=[0,0,0]"], []),
])  # fmt: skip
def test_a_possible_mistake_is_a_warning(tmp_path, keys, words):
    path = tmp_path / "scene.toml"
    path.write_text(TUMOUR)
    remarks = overview.figures(path, keys)["remarks"]
    assert len(remarks) == len(words), remarks
    assert remarks == list(model_build.build(load_deck(path, keys)).remarks)  # of a run
    assert all(re.search(word, remark) for remark, word in zip(remarks, words, strict=True)), remarks


def test_a_tumour_that_can_never_fit_is_refused(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(TUMOUR)
    for key, reason in (
        ("tumour.volume=3e6", "tumour.volume = 3000000: its sphere of 89.5 mm radius reaches beyond the outer surface"),
        ("tumour.centre=[24,20,3]", "tumour.centre = (24, 20, 3) mm: is 3 mm from"),
        ("tumour.centre=[0.024,0.02,0.02]", "it looks like metres: in mm it is (24, 20, 20)"),
    ):
        line = complaint(mpitled("check", path, "--json", "--set", key, status=2))
        assert line.startswith(f"mpitled: {path}: ")
        assert reason in line
    # A free surface can move.
    path.write_text(TUMOUR.replace('nodes = "surface"', 'nodes = "x0"'))
    keys = ["tumour.volume=40000", "tumour.centre=[28,20,20]"]  # radius 21.2 mm, 28 mm from the fixed nodes
    assert any("beyond the cloud" in remark for remark in overview.figures(path, keys)["remarks"])


def test_check_gives_position_and_size_of_the_tumour(tmp_path):
    pytest.importorskip("nibabel")
    path, brain = tmp_path / "scene.toml", tmp_path / "brain.toml"
    path.write_text(TUMOUR)
    figures = overview.figures(path)["tumour"]
    assert figures["centre_mm"] == pytest.approx([24, 20, 20])
    assert figures["radius_mm"] == pytest.approx(5, rel=1e-4)
    assert figures["distance_mm"] == {"surface": pytest.approx(20)}
    assert figures["side"] == ""  # a block has no left side
    line = "tumour           (24, 20, 20) mm; 523.6 mm3, 490.09 of it grown, radius 2 -> 5 mm; 20 mm from the surface"
    assert line in overview.check(path).splitlines()

    scaffold.write("brain", brain)
    coarse = ["labels.element_size=8", "cloud.growth=0.4", "tumour.surface_nodes=300", "tumour.volume=2000"]
    figures = overview.figures(brain, coarse)["tumour"]
    assert figures["side"] == "left"
    assert figures["distance_mm"]["left_ventricle"] < figures["distance_mm"]["right_ventricle"]
    assert 10 < figures["distance_mm"]["skull"] < 60
