"""The stability matrix, jobs/stability: its closed forms and meshes, every outcome, and that no run is repeated."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
import sys

import extremes
import grid
import numpy as np
import pytest
import stability
from conftest import ENVIRONMENT, ROOT
from exact import shell

from mpitled.cells import hexahedra
from mpitled.deck import MeshFiles
from mpitled.laws import Material, NeoHookean
from mpitled.model import Model
from mpitled.readers import meshes

FEW = extremes.AXES["few"]


def test_the_shell_is_that_of_an_independent_integration():
    """Places on a line, as nodes of a model that has nothing else; R up to five times the seed's."""
    with np.load(ROOT / "tests" / "data" / "C_shell_ode.npz") as data:
        rho, material = (
            data["rho"],
            Material("tissue", NeoHookean(youngs_modulus=float(data["E"]), poissons_ratio=float(data["nu"])), 1000.0),
        )
        for R, u in zip(data["R"], data["u"], strict=True):
            fields = dict.fromkeys(field.name for field in dataclasses.fields(Model))
            points = np.outer(rho, [0.6, 0.0, 0.8])
            fields |= {"points": points, "materials": (material,), "node_sets": {"tumour": np.array([0])}}
            found = shell(Model(**fields), points, 4 / 3 * np.pi * R**3)
            assert np.abs(found - np.outer(u, [0.6, 0.0, 0.8])).max() < 1e-9  # m, what both promise


def test_grids_are_as_bad_as_they_are_asked_to_be(tmp_path):
    grid.write_grid(tmp_path, {"skew": "0.01"})
    mesh = meshes.read_mesh(MeshFiles(fe=tmp_path / "grid.inp"))
    assert hexahedra.scaled_jacobian(mesh.points, mesh.hexahedra).min() == pytest.approx(0.01, abs=1e-6)
    assert hexahedra.volumes(mesh.points, mesh.hexahedra).sum() == pytest.approx(24**3)
    grid.write_grid(tmp_path, {"thin": "0.01,0.01,1"})
    mesh = meshes.read_mesh(MeshFiles(fe=tmp_path / "grid.inp"))
    # The row that is 1/100 of a cell wide has a neighbour that is 199/100 wide.
    assert hexahedra.aspect(mesh.points, mesh.hexahedra).max() == pytest.approx(199)


def test_every_outcome_is_told_and_nothing_runs_twice(tmp_path, monkeypatch, capsys):
    """Two cells pulled are homogeneous, pressed through themselves they stop, nu = 0.5 is refused."""
    two = "grid.elements=1,1,2"
    values = {
        "pulled": two, "through itself": f"{two} displaced.0.displacement=[-45] solver.load_steps=50",
        "incompressible": f"{two} material.brain.poissons_ratio=0.5", "open": f"{two} grid.flaw=open",
    }  # fmt: skip
    axis = dataclasses.replace(FEW, values=values, kinds=("FE",), methods=("relaxation",))
    monkeypatch.setitem(extremes.AXES, "two", axis)
    # A false closed form without energy: with more energy than the run's, the run would have buckled.
    monkeypatch.setitem(stability.CLOSED_FORMS, "none", lambda model, points, volume: np.zeros_like(points))
    monkeypatch.setitem(extremes.AXES, "false", dataclasses.replace(axis, values={"pulled": two}, reference="none"))
    for runs in (5, 1):
        rows = stability.matrix(tmp_path, ["two", "false"])
        assert capsys.readouterr().err.count("\n  relaxation\n") == runs
        assert [row["outcome"] for row in rows] == ["completed", "stopped", "stopped", "warned", "wrong"]
        shutil.rmtree(next((tmp_path / "two-pulled").glob("FE-relaxation-*")))
    assert rows[0]["error_mm"] < rows[0]["allowed_mm"] < 0.04
    assert "hexahedron" in rows[1]["message"]
    assert "poissons_ratio" in rows[2]["message"]
    assert "nodes lie where another one does" in rows[3]["message"]
    assert rows[4]["error_mm"] == pytest.approx(4.8)
    table = stability.summary(rows)
    assert "| two | 4 | 1 | 2 | 1 | 0 | 0 |" in table
    assert "wrong: false pulled, FE, relaxation" in table
    assert (tmp_path / "stability.csv").read_text().count("\n") == 6
    assert (tmp_path / "stability.png").stat().st_size > 5_000


@pytest.mark.parametrize(("name", "value", "kind"), [("confined", "-20 %", "mixed"), ("stiff", "1e+06", "FE")])
def test_slow_modes_that_appear_late_are_waited_for(tmp_path, monkeypatch, name, value, kind):
    """Under ten shear moduli of pressure a cloud is soft, which shows after the fast modes have died; a core a million
    times stiffer follows in ten thousand steps, in which first estimates come to nothing. The cloud is so near to
    instability that the last bits of its coordinates decide: then there is a warning.
    """
    axis = extremes.AXES[name]
    axis = dataclasses.replace(axis, values={value: axis.values[value]}, kinds=(kind,), methods=("relaxation",))
    monkeypatch.setitem(extremes.AXES, name, axis)
    (row,) = stability.matrix(tmp_path, [name])
    assert row["outcome"] in ("completed", "warned" if kind == "mixed" else ""), row["message"]
    assert row["outcome"] == "warned" or row["error_mm"] < 0.03


def script(*arguments: object, timeout: float = 60) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "jobs/stability/stability.py", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, env=ENVIRONMENT, timeout=timeout, capture_output=True, text=True)


def test_unknown_axes_are_refused_before_anything_runs(tmp_path):
    done = script("--out", tmp_path / "out", "--only", "poisson,poison")
    assert done.returncode == 2
    assert "no axis poison;" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.study
def test_no_case_of_the_matrix_is_wrong(tmp_path):
    done = script("--out", tmp_path, timeout=3600)
    assert done.returncode == 0, done.stdout
