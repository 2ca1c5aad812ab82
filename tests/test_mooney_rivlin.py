"""The Mooney-Rivlin solid against closed forms, with every kind of cell, on one and two ranks, and after a restart."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import complaint, mpitled
from scenes import block
from scipy.optimize import fsolve
from test_resume import run

from mpitled.store import open_result

C10, C01, NU, EDGE = 300.0, 200.0, 0.45, 20.0  # Pa, Pa, 1, mm
MU = 2 * (C10 + C01)
VOLUMETRIC = 2 * MU * NU / (1 - 2 * NU) - 4 * C01
LAW = f'law = "mooney-rivlin"\nc10 = {C10}\nc01 = {C01}\npoissons_ratio = {NU}\n'
SYMMETRY = "".join(f'[[fixed]]\nnodes = "{axis}0"\ndirections = ["{axis}"]\n' for axis in "xyz")
# The stabilisation and the hourglass control see no affine field.
SOLVER = "[solver]\ntolerance = 1e-4\n[output]\nframes = 1\nstress = true\n"


def scene(cloud: str, motion: str) -> str:
    head, _, _ = block((EDGE,) * 3, (4, 4, 4), cloud).partition("youngs_modulus")
    return head + LAW + motion + SOLVER


def cauchy(F: np.ndarray) -> np.ndarray:
    """From the invariants of B: 2/J ((W1 + I1 W2) B - W2 B^2) + dW/dJ I, where W2 knows I2 of B itself."""
    J, B = np.linalg.det(F), F @ F.T
    slope = VOLUMETRIC * (J - 1) - 2 * (C10 + 2 * C01) / J
    return 2 / J * ((C10 + np.trace(B) * C01) * B - C01 * B @ B) + slope * np.eye(3)


def principal(stretches: list[float]) -> np.ndarray:
    return np.diag(cauchy(np.diag(stretches)))


def pull(axes: str, millimetres: float) -> str:
    faces = "".join(
        f'[[displaced]]\nnodes = "{axis}1"\ndirections = ["{axis}"]\ndisplacement = [{millimetres}]\n' for axis in axes
    )
    return SYMMETRY + faces


def compare(folder, F: np.ndarray) -> None:
    """Displacements are those of F within the tolerance of the solver, and the stress is that of the formula."""
    with open_result(folder) as result:
        moved, stress = result.at_nodes("displacement", -1), result.in_cells("stress", -1)
        expected = result.node_points @ (F - np.eye(3)).T
    # The solver ends within 1e-4 mm by its own estimate, which is right within a factor of 3.
    assert np.abs(moved - expected).max() < 3e-7
    exact = cauchy(F)[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]]
    # Twice that error over a cell of 5 mm is an error of strain, whose stiffness is lambda + 2 mu at most.
    assert np.abs(stress - exact).max() < 10 * 3e-7 / 5e-3 * (VOLUMETRIC + 4 * C01 + 2 * MU)


@pytest.mark.parametrize(("cloud", "ranks"), [("none", 1), ("core", 2), ("all", 1)])
@pytest.mark.parametrize("stretch", [1.3, 0.8])
def test_simple_tension(tmp_path, cloud, ranks, stretch):
    (width,) = fsolve(lambda t: principal([stretch, t[0], t[0]])[1], [stretch**-0.5], xtol=1e-12)
    (tmp_path / "scene.toml").write_text(scene(cloud, pull("x", EDGE * (stretch - 1))))
    mpitled("run", tmp_path / "scene.toml", "--out", tmp_path / "out", n=ranks)
    compare(tmp_path / "out", np.diag([stretch, width, width]))


@pytest.mark.parametrize(("cloud", "ranks"), [("none", 2), ("core", 1), ("all", 1)])
def test_equibiaxial_tension(tmp_path, cloud, ranks):
    stretch = 1.25
    (width,) = fsolve(lambda t: principal([stretch, stretch, t[0]])[2], [stretch**-2], xtol=1e-12)
    (tmp_path / "scene.toml").write_text(scene(cloud, pull("xy", EDGE * (stretch - 1))))
    mpitled("run", tmp_path / "scene.toml", "--out", tmp_path / "out", n=ranks)
    compare(tmp_path / "out", np.diag([stretch, stretch, width]))


@pytest.mark.parametrize(("cloud", "ranks"), [("none", 1), ("core", 1), ("all", 2)])
def test_simple_shear(tmp_path, cloud, ranks):
    """The second invariant shows in the difference of normal stresses: s_zz - s_yy = -2 c01 g^2, 0 for neo-Hookean."""
    shear = 0.4
    F = np.eye(3) + shear * np.outer([1, 0, 0], [0, 0, 1])
    grid = np.stack(np.meshgrid(*[np.linspace(0, EDGE, 5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    table = np.concatenate([grid, grid @ (F - np.eye(3)).T], axis=1)
    np.savetxt(tmp_path / "moved.csv", table, "%.17g", ",", header="x,y,z,ux,uy,uz", comments="")
    motion = '[[displaced]]\nnodes = "surface"\nfield = "moved.csv"\n'
    (tmp_path / "scene.toml").write_text(scene(cloud, motion))
    mpitled("run", tmp_path / "scene.toml", "--out", tmp_path / "out", n=ranks)
    compare(tmp_path / "out", F)
    stress = cauchy(F)
    assert stress[2, 2] - stress[1, 1] == pytest.approx(-2 * C01 * shear**2)


def test_a_restarted_run_has_the_bits_of_one_that_was_not_stopped(tmp_path, monkeypatch):
    deck = tmp_path / "scene.toml"
    deck.write_text(scene("core", pull("x", 4.0)))
    mpitled("run", deck, "--out", tmp_path / "whole")
    run(deck, tmp_path / "part", monkeypatch, stop_at=4)
    assert run(deck, tmp_path / "part", monkeypatch, resume=True)["resumed_at_step"] > 0
    with open_result(tmp_path / "whole") as whole, open_result(tmp_path / "part") as part:
        assert np.array_equal(whole.at_nodes("displacement", -1), part.at_nodes("displacement", -1))


def test_a_poissons_ratio_that_makes_the_volumetric_term_negative_is_refused(tmp_path):
    (tmp_path / "scene.toml").write_text(scene("none", pull("x", 1.0)).replace(str(NU), "0.1"))
    done = mpitled("check", tmp_path / "scene.toml", status=2)
    assert "material.brain" in complaint(done)
    assert "poissons_ratio is too small for this c01; give at least 0.222" in complaint(done)
