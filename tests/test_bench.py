"""The benchmark: operations as counted by hand, a sound outcome in the form that is promised, and its comparison."""

from __future__ import annotations

import json

import pytest
from conftest import mpitled

CASE = {"scene", "cells", "precision", "ranks", "million_cell_updates_per_second_per_core", "bytes_per_cell",
        "halo_share", "roofline_share"}  # fmt: skip


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    path = tmp_path_factory.mktemp("bench") / "new.json"
    done = mpitled("bench", "--quick", "--ranks", "1,2", "--json", path, timeout=600)
    return path, json.loads(path.read_text()), done.stdout


def test_the_outcome_has_every_case_in_the_form_that_is_promised(outcome):
    _, made, table = outcome
    assert set(made) == {"machine", "commit", "limits", "cases"}
    found = {(case["scene"], case["precision"], case["ranks"]) for case in made["cases"]}
    scenes, precisions = ("voxel", "distorted", "cloud", "mixed"), ("float64", "float32")
    assert found == {(s, p, n) for s in scenes for p in precisions for n in (1, 2)}
    assert len(table.splitlines()) == 2 + len(found)
    cells = {}
    for case in made["cases"]:
        assert set(case) == CASE
        assert case["million_cell_updates_per_second_per_core"] > 0
        assert 0 < case["roofline_share"] < 1
        assert (case["halo_share"] > 0) == (case["ranks"] == 2)
        assert 0 <= case["halo_share"] < 1
        cells.setdefault(case["scene"], set()).add(case["cells"])
    assert all(len(sizes) == 1 for sizes in cells.values())  # whatever the ranks and the precision
    assert cells["voxel"] == cells["distorted"] == {8000}
