"""The comparison with an implicit code: FElupe where it is installed, and what to do where it is not."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import pytest
from conftest import ENVIRONMENT, ROOT

MISSING = [name for name in ("felupe", "pypardiso") if importlib.util.find_spec(name) is None]
CYLINDER = "cylinder, 20 % extension"


def script(folder, *arguments):
    command = [sys.executable, str(ROOT / "jobs" / "validation" / "implicit.py"), *arguments]
    return subprocess.run(command, env=ENVIRONMENT, cwd=folder, capture_output=True, text=True, timeout=300)


@pytest.mark.skipif(not MISSING, reason="FElupe is there")
def test_it_says_how_to_install_what_is_missing(tmp_path):
    done = script(tmp_path)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        f"implicit.py: {MISSING[0]} is missing; install it with: pip install -e '.[implicit]'"
    ]


@pytest.mark.skipif(bool(MISSING), reason="pip install -e '.[implicit]' first")
def test_both_codes_solve_the_same_problem(tmp_path):
    """On one mesh they differ by how the cells resist hourglassing, a part of the error of either; Q2 comes nearer."""
    found = {}
    for family in ("mpitled, one-point hexahedra", "FElupe, Q1P0 hexahedra", "FElupe, Q2Q1 hexahedra"):
        done = script(tmp_path, CYLINDER, family, "cylinder.element_size=20")
        assert done.returncode == 0, done.stderr
        found[family] = json.loads(done.stdout.splitlines()[-1])
    ours, linear, quadratic = found.values()
    assert ours["unknowns"] == linear["unknowns"] < quadratic["unknowns"]
    assert ours["rms_error_mm"] == pytest.approx(linear["rms_error_mm"], rel=0.1)
    assert quadratic["rms_error_mm"] < 0.5 * linear["rms_error_mm"]
