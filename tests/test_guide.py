"""Every command of the guide, jobs/README.md, as it stands there."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
from conftest import ENVIRONMENT, ROOT
from guide import PARTS, follow


def test_from_a_segmentation_to_a_table(segmentation):
    """The page that it makes is in test_page.py."""
    out, said = segmentation
    assert "ventricles, change" in said
    for name in ("table", "growth"):
        table = (out / name / "table.csv").read_text().splitlines()
        assert [line.split(",")[1] for line in table] == ["tumour.volume", "113.1", "268.1"]
        assert all(line.endswith(",") for line in table[1:])  # no case failed
    assert said.count("warning for tumour.volume = ") == 2  # one of each


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
