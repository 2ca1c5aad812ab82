"""The table of the validation: resumable, its figures those of the runs, and what misses a goal stands out."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest
from conftest import ROOT
from test_compare import CYLINDER, SLOPE, synthetic

from mpitled import charts


@pytest.fixture(scope="module")
def table():
    spec = importlib.util.spec_from_file_location("table", ROOT / "jobs" / "validation" / "table.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["table"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_a_scene_in_the_table(table, tmp_path, monkeypatch, capsys):
    """The cube's compression is homogeneous, so that every mesh and kind has it to what relaxation leaves."""
    cube = table.Scene(
        "cube", "cube", "E3_cube_stress_50", 0, 0.02, ("block.elements=[4,4,4]",), (1.0, 2.0, 3.0), "block",
        "block.elements=[5,5,5]",
    )  # fmt: skip
    monkeypatch.setattr(table, "SCENES", (cube,))
    rows = list(table.table_61(tmp_path, ["deck's", "finest"]))
    assert [(row["kind"], row["mesh"]) for row in rows] == [
        (kind, mesh) for mesh in ("deck's", "finest") for kind in ("FE", "EFG", "mixed")
    ]
    assert [row["failure"] for row in rows] == 6 * [""]
    assert (rows[0]["cells"], rows[3]["cells"]) == (64, 125)
    for row in rows:
        assert row["all_norm"] < 3 * row["static_distance_mm"] < 3 * 0.002
    assert capsys.readouterr().err.count("E3_cube_stress_50") == 6
    rows[3]["beyond_z"] = 0.021
    text = table.markdown(list(table.table_61(tmp_path, ["deck's", "finest"]))[:3] + rows[3:], [])
    assert capsys.readouterr().err == ""  # nothing ran again
    assert text.count("| 1.000 / 2.000 / 3.000 |") == 6
    bold = [line for line in text.splitlines() if "/" in line and line.count("**") == 2]
    assert len(bold) == 1
    assert "/ 0.021** | 0.020 |" in bold[0]


def test_distortion_of_an_affine_field(table, tmp_path):
    """Every corner has the determinant of the gradient, and its least stretch is the compression."""
    found = table.distortion(synthetic(tmp_path / "run", CYLINDER.format(cloud="none")))
    gradient = np.eye(3) + SLOPE
    assert found["corner_J"] == pytest.approx(np.linalg.det(gradient), rel=1e-9)
    assert found["compression"] == pytest.approx(1 - np.linalg.svd(gradient, compute_uv=False).min(), rel=1e-9)


def test_profiles_are_drawn(tmp_path):
    """Two sides with a gap between them, and a run that is 0.3, 0.4 mm off."""
    z = np.linspace(0, 100, 11)
    side = np.stack([np.full(11, 50.0), 0 * z, z], axis=1)
    places = np.concatenate([side, side * [-1, 1, 1]])
    true = places * [0.1, 0, 0.2]
    profile = charts.Profile("cylinder", places, true, {"FE": true + np.array([0.3, 0, 0.4])})
    _, below = charts.draw_profiles([profile], tmp_path / "p.png").axes
    along, apart = below.lines[0].get_data()
    np.testing.assert_allclose(apart[~np.isnan(apart)], 0.5)
    assert np.isnan(along).sum() == 1
    assert (tmp_path / "p.png").stat().st_size > 10_000
