"""What a run says of its distance to the static solution, against that distance, in scenes of every kind."""

from __future__ import annotations

import numpy as np
import pytest
from exact import shell

from mpitled import job
from mpitled.deck import load_deck
from mpitled.parallel.halo import World
from mpitled.store import open_result, read_model

BRAIN = """
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
"""
CLAMPED = """
[block]
size = [50.0, 50.0, 50.0]
elements = [8, 8, 8]
cloud = "{cloud}"
[[fixed]]
nodes = "z0"
[[displaced]]
nodes = "z1"
displacement = [0.0, 0.0, -8.0]
"""
CYLINDER = """
[cylinder]
radius = 50.0
height = 100.0
element_size = 12.0
[[fixed]]
nodes = "bottom"
[[displaced]]
nodes = "top"
displacement = [0.0, 0.0, 20.0]
"""
TORSION = """
[block]
corner = [-10.0, -10.0, 0.0]
size = [20.0, 20.0, 80.0]
elements = [4, 4, 16]
[[fixed]]
nodes = "z0"
[[displaced]]
nodes = "z1"
displacement = [0.0, 0.0, 0.0]
rotation = 90.0
"""
TUMOUR = """
[ellipsoid]
semi_axes = [32.0, 26.0, 24.0]
element_size = 6.0
cloud = "core"
[tumour]
centre = [6.0, 0.0, 3.0]
volume = 113.1
surface_nodes = 200
[cloud]
radius = 12.0
growth = 0.3
[[fixed]]
nodes = "surface"
"""
SPHERE = """
[ellipsoid]
semi_axes = [30.0, 30.0, 30.0]
element_size = 5.0
cloud = "core"
[tumour]
centre = [0.0, 0.0, 0.0]
volume = {volume}
[[fixed]]
nodes = "surface"
"""
RELAXED = "solver.method=dynamic-relaxation"
#: Name -> deck, and the shortest load, s, that the scene stands in a ramp.
SCENES = {
    "compressed block of hexahedra": (CLAMPED.format(cloud="none"), 0.15),
    "compressed block with a cloud": (CLAMPED.format(cloud="core"), 0.15),
    "cylinder in extension": (CYLINDER, 0.4),
    "bar in torsion": (TORSION, 0.4),
    "tumour in an ellipsoid": (TUMOUR, 0.1),
}


@pytest.fixture
def compute(tmp_path):
    """Runs a scene's text with overrides: its report, and displacements (n, 3), mm."""

    def compute(text, *overrides):
        path = tmp_path / "scene.toml"
        path.write_text(text + BRAIN)
        made = job.run(load_deck(path, ("output.pictures=false", *overrides)), tmp_path / "out", World(), quiet=True)
        with open_result(tmp_path / "out") as result:
            return made, 1e3 * result.at_nodes("parameters", -1)

    return compute


def distance(u, v):
    return np.linalg.norm(u - v, axis=1).max()


@pytest.mark.parametrize("name", SCENES)
def test_a_run_knows_its_distance_to_the_static_solution(compute, name):
    """Within a factor of 3, of ramps that end moving and of relaxations that stop early."""
    text, load_time = SCENES[name]
    _, static = compute(text, RELAXED, "solver.tolerance=1e-6")
    for overrides in (
        ("solver.method=quasi-static", f"solver.load_time={load_time}"),
        ("solver.method=quasi-static", f"solver.load_time={2 * load_time}"),
        (RELAXED, "solver.tolerance=0.1"),
        (RELAXED, "solver.tolerance=0.03"),
    ):
        made, u = compute(text, *overrides)
        true, told = distance(u, static), made["static_distance_mm"]
        print(f"{name}, {overrides[-1]}: {made['steps']} steps, {told:.4f} mm told, {true:.4f} mm true")
        assert true / 3 < told < 3 * true


@pytest.mark.parametrize("name", ["cylinder in extension", "bar in torsion"])
def test_a_ramp_of_twice_the_steps_of_a_relaxation_is_farther_from_static(compute, name):
    """The relaxation is within 0.01 mm; the ramp still swings by more."""
    text, load_time = SCENES[name]
    _, static = compute(text, RELAXED, "solver.tolerance=1e-6")
    relaxation, u = compute(text, RELAXED, "solver.tolerance=0.01")
    assert distance(u, static) < 0.01
    ramped = "solver.method=quasi-static"
    ramp, _ = compute(text, ramped, f"solver.load_time={load_time}")
    ramp, u = compute(text, ramped, f"solver.load_time={2 * load_time * relaxation['steps'] / ramp['steps']}")
    assert ramp["steps"] > 1.9 * relaxation["steps"]
    assert distance(u, static) > 0.01


@pytest.mark.parametrize(("radius", "warned"), [(5.0, False), (10.0, True)])
def test_what_a_cloud_is_wrong_by_is_told(compute, tmp_path, radius, warned):
    """Its misfit is true to a factor of 3, and warned of where it is large."""
    volume = 4e-9 / 3 * np.pi * radius**3
    made, _ = compute(SPHERE.format(volume=1e9 * volume), RELAXED)
    with open_result(tmp_path / "out") as result:
        field, model = result.at_nodes("displacement", -1), read_model(tmp_path / "out" / "model.h5")
    error = 1e3 * distance(field, shell(model, model.points, volume))
    print(f"{radius} mm: {made['cloud_misfit_mm']:.3f} mm told, {error:.3f} mm true")
    assert error / 3 < made["cloud_misfit_mm"] < 3 * error
    assert any("too coarse for its field" in warning for warning in made["warnings"]) == warned
