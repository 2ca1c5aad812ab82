"""First steps: decks to begin with, and what a person is told of a deck that is wrong."""

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
def test_a_new_deck_can_be_computed_as_it_is_and_tells_the_defaults(tmp_path, kind):
    """Every key behind # has the value that took effect without it."""
    path = tmp_path / "scene.toml"
    assert scaffold.write(kind, path)[0] == path
    said = overview.figures(path)
    assert said["hexahedra"] > 0
    assert said["run"]["steps"] >= 50  # those in which relaxation loads at least
    assert not [remark for remark in said["remarks"] if "warning" in remark]
    text = path.read_text()
    shown = re.sub(r"^# (\w+ = .)", r"\1", text, flags=re.MULTILINE)
    assert len(shown) < len(text) - 40
    path.write_text(shown)
    changed = canonical(load_deck(path))
    path.write_text(text)
    assert changed == canonical(load_deck(path))


def test_a_new_deck_spares_what_is_there(tmp_path):
    path = tmp_path / "cylinder.toml"
    mpitled("new", "cylinder", path)
    assert "exists already" in complaint(mpitled("new", "cylinder", path, status=2))
    done = mpitled("run", path, "-q", "-v", "--json", "--out", tmp_path / "out", "--set", "solver.load_time=0.2", n=2)
    # In so coarse a mesh a node below the top goes 0.01 mm farther.
    assert json.loads(done.stdout)["max_displacement_mm"] == pytest.approx(4, rel=0.01)
    for rank in (0, 1):
        assert f"rank {rank}: loop\n" in done.stderr


def test_a_new_deck_goes_to_standard_output(tmp_path):
    told = mpitled("new", "brain", "-").stdout
    assert "give a file" in complaint(mpitled("new", "decks", "-", status=2))
    assert not (ROOT / "-").exists()
    mpitled("new", "brain", tmp_path / "brain.toml")
    written = (tmp_path / "brain.toml").read_text().replace(os.path.relpath(ROOT, tmp_path) + "/", "")
    assert told == written


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

#: What a person writes instead of what is right, and what the message has to name and to advise.
MISTAKES = {
    "volume in m3": ("4188.8", "4.1888e-6", "tumour.volume", "mm3; give more"),
    "centre outside of the head": ("[-32.0, -20.0", "[-32.0, -170.0", "tumour.centre", "mm"),
    "seed in a ventricle": ("[-32.0, -20.0, 10.0]", "[-10.0, -20.0, 20.0]", "tumour.centre", "ventricle"),
    "missing file": ("{image}", "no.nii.gz", "labels.image", "give a path relative to the deck"),
    "element size in metres": ("element_size = 6.0", "element_size = 0.006", "element_size", "mm"),
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


def test_a_slip_of_the_unit_that_is_possible_is_a_warning(tmp_path):
    def said(old, new):
        return "\n".join(model_build.build(load_deck(wrong(tmp_path, old, new))).remarks)

    for old, new, word in (
        ("youngs_modulus = 3000.0", "youngs_modulus = 0.003", "material.brain.youngs_modulus = 0.003: is it in Pa?"),
        (
            "poissons_ratio = 0.1\n",
            "poissons_ratio = 0.1\ndensity = 1.0\n",
            "material.csf.density = 1: is it in kg/m3?",
        ),
    ):
        assert said(old, new).count(word) == 1
    assert "is it in" not in said("3000", "3000")


def test_a_wrong_deck_ends_the_command_with_status_2(tmp_path):
    message = complaint(mpitled("check", wrong(tmp_path, "4188.8", "-4188.8"), "--json", status=2))
    assert "tumour.volume = -4188.8: is not greater than 0; give a number above 0, in mm3" in message


def test_a_tumour_that_no_cloud_is_known_to_take_is_warned_of(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(TUMOUR)
    for keys, words in (
        ([], []),
        (["tumour.volume=7240"], ["12 mm, beyond the cloud's 11 mm; enlarge cloud.radius"]),
        (["tumour.volume=3054", "tumour.seed_radius=1.0"], ["9 mm, 9 times its seed's, .* enlarge tumour.seed_radius"]),
        (["tumour.seed_radius=4.0"], ["seed_radius = 4: 51% of tumour.volume is there at the start"]),
        (["material.brain.poissons_ratio=0.4995"], ["poissons_ratio = 0.4995: results are known up to 0.499"]),
    ):
        remarks = overview.figures(path, keys)["remarks"]
        assert len(remarks) == len(words), remarks
        for remark, word in zip(remarks, words, strict=True):
            assert re.search(word, remark)
    path.write_text(TUMOUR.replace('[[fixed]]\nnodes = "surface"\n', ""))
    (remark,) = overview.figures(path)["remarks"]
    assert re.search('no node but the tumour.s is held, .* with nodes = "surface"', remark)


def test_a_centre_that_looks_like_metres_is_said_so(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(TUMOUR.replace("[24.0, 20.0, 20.0]", "[0.024, 0.02, 0.02]"))
    line = complaint(mpitled("check", path, status=2))
    assert line.endswith("; it looks like metres: in mm it is (24, 20, 20)")
    # Where it is possible, it is a warning.
    path.write_text(TUMOUR)
    keys = ["block.corner=[-24,-20,-20]", "tumour.centre=[-0.003,0.002,0.001]"]
    (remark,) = overview.figures(path, keys)["remarks"]
    said = "tumour.centre = (-0.003, 0.002, 0.001) mm: it looks like metres: in mm it is (-3, 2, 1)"
    assert remark == f"warning: {said}"
    assert overview.figures(path, ["block.corner=[-24,-20,-20]", "tumour.centre=[0,0,0]"])["remarks"] == []


def test_a_tissue_too_soft_for_a_tumour_is_warned_of_by_runs_too(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(TUMOUR)
    said = "warning: material.brain.youngs_modulus = 3: is softer than any tissue that a tumour grows in; moduli are in"
    remarks = overview.figures(path, ["material.brain.youngs_modulus=3"])["remarks"]
    assert remarks == [f"{said} Pa"]
    assert remarks == list(model_build.build(load_deck(path, ["material.brain.youngs_modulus=3"])).remarks)  # of a run
    (remark,) = overview.figures(path, ["material.brain.youngs_modulus=0.003"])["remarks"]
    assert "youngs_modulus = 0.003" in remark


def test_a_tumour_that_can_never_fit_is_refused(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(TUMOUR)
    line = complaint(mpitled("check", path, "--set", "tumour.volume=3e6", status=2))
    said = (
        "tumour.volume = 3000000: its sphere of 89.5 mm radius reaches beyond the outer surface, which is fixed 20 mm"
    )
    assert line == f"mpitled: {path}: {said} from tumour.centre; lower it"
    # A surface that is free makes room.
    path.write_text(TUMOUR.replace('nodes = "surface"', 'nodes = "x0"'))
    keys = ["tumour.volume=40000", "tumour.centre=[28,20,20]"]  # 21.2 mm radius, 28 mm from what is fixed
    assert any("beyond the cloud" in remark for remark in overview.figures(path, keys)["remarks"])


def test_check_says_where_the_tumour_is_and_how_large(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(TUMOUR)
    figures = overview.figures(path)["tumour"]
    assert figures["centre_mm"] == pytest.approx([24, 20, 20])
    assert figures["radius_mm"] == pytest.approx(5, rel=1e-4)
    assert figures["distance_mm"] == {"surface": pytest.approx(20)}
    assert figures["side"] == ""  # nobody knows which side of a block is left
    line = "tumour           (24, 20, 20) mm; 523.6 mm3, 490.09 of it grown, radius 2 -> 5 mm; 20 mm from the surface"
    assert line in overview.check(path).splitlines()


def test_check_says_on_which_side_of_a_brain_the_tumour_is(tmp_path):
    pytest.importorskip("nibabel")
    path = tmp_path / "brain.toml"
    scaffold.write("brain", path)
    coarse = ["labels.element_size=8", "cloud.growth=0.4", "tumour.surface_nodes=300", "tumour.volume=2000"]
    figures = overview.figures(path, coarse)["tumour"]
    assert figures["side"] == "left"
    apart = figures["distance_mm"]
    assert apart["left_ventricle"] < apart["right_ventricle"]
    assert 10 < apart["skull"] < 60
    said = overview.check(path, coarse)
    near = r"\d+(\.\d)? mm from the left ventricle, \d+(\.\d)? mm from the skull"
    lies = re.escape(
        "tumour           (-32, -20, 10) mm, left of the middle; 2000 mm3, 1966.5 of it grown, radius 2 -> 7.82 mm; "
    )
    assert re.search(f"^{lies}{near}$", said, re.MULTILINE)


def test_a_tumour_in_the_wrong_place_is_said_with_the_deck(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(TUMOUR.replace("[24.0, 20.0, 20.0]", "[24.0, 20.0, 3.0]"))
    assert f"{path}: tumour.centre = (24, 20, 3) mm: is 3 mm from" in complaint(mpitled("check", path, status=2))
