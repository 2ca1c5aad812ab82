"""Every command of the guide, jobs/README.md, as it stands there."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest
from conftest import ENVIRONMENT, ROOT, mpitled
from guide import GUIDE, PARTS, follow

from mpitled.deck import load_deck
from mpitled.preview import overview


def test_from_a_segmentation_to_a_table(segmentation):
    """The page that it makes is in test_page.py."""
    out, said = segmentation
    assert "ventricles, change" in said
    for name in ("table", "growth"):
        table = (out / name / "table.csv").read_text().splitlines()
        assert [line.split(",")[1] for line in table] == ["tumour.volume", "113.1", "268.1"]
        assert all(line.endswith(",") for line in table[1:])  # no case failed
    assert len(re.findall("^warning for tumour.volume=", said, re.MULTILINE)) == 2  # one of each


def test_the_labels_of_freesurfer_give_the_brain_that_they_were_made_of(tmp_path):
    """The shipped brain with FreeSurfer's numbers for its parts, each of them somewhere."""
    nibabel = pytest.importorskip("nibabel")
    (section,) = re.findall(r"^```toml\n(.*?)^```$", GUIDE, re.MULTILINE | re.DOTALL)
    deck = tmp_path / "head.toml"
    mpitled("new", "brain", deck)
    text = deck.read_text()
    coarse = ("labels.element_size=7", "cloud.growth=0.35")
    shipped = overview.figures(deck, coarse)
    image = nibabel.load(load_deck(deck).labels.image)
    begin = text.index("[labels]")
    deck.write_text(text[:begin] + section + text[text.index("\n\n", begin) :])
    (tmp_path / "aseg.mgz").touch()
    parts, aseg = np.asarray(image.dataobj), np.zeros(image.shape, np.int32)
    labels = load_deck(deck).labels
    for part, numbers in enumerate((labels.tissue, labels.left_ventricle, labels.right_ventricle), 1):
        voxels = np.flatnonzero(parts == part)
        aseg.flat[voxels] = np.resize(numbers, len(voxels))
    nibabel.save(nibabel.MGHImage(aseg, image.affine), tmp_path / "aseg.mgz")
    own = overview.figures(deck, coarse)
    assert own | {"run": None} == shipped | {"run": None}  # which is measured


def test_from_abaqus_decks(tmp_path):
    said = follow(tmp_path, PARTS["From Abaqus decks"])
    assert "C3D8R" in said
    errors = re.search(r"largest.*", said[said.rindex("written to out/again") :])
    assert errors, said


def test_on_a_cluster(tmp_path):
    said = follow(tmp_path, "mpitled new decks patient.toml\n" + PARTS["On a cluster"])
    assert "material.brain.poissons_ratio" in said
    assert not re.search("not computed|broken", said)
    assert said.count("written to out/patient") == 1
    assert said.count("left out:") == 2  # PBS's deck and key are good


def test_all_commands_are_of_a_part_that_runs():
    assert [part for part, commands in PARTS.items() if commands] == [
        "From a segmentation to a table", "From Abaqus decks", "On a cluster"
    ]  # fmt: skip


def test_a_picture_of_ones_own(tmp_path, segmentation):
    pytest.importorskip("pyvista")
    picture = tmp_path / "picture.png"
    words = [sys.executable, "jobs/pictures.py", str(segmentation[0] / "trial"), str(picture)]
    subprocess.run(words, env=ENVIRONMENT, cwd=ROOT, check=True, capture_output=True, timeout=120)
    assert picture.stat().st_size > 10_000
