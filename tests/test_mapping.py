"""Displacements interpolated from scattered points to nodes: exact quadratic fields, and third-order convergence."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import ROOT

from mpitled import deck
from mpitled.errors import InputError
from mpitled.meshing.scatter import fibonacci_sphere
from mpitled.model import build as model_build
from mpitled.model import mapping

SCENE = """
[ellipsoid]
semi_axes = [50, 50, 50]
element_size = 12
[material.brain]
youngs_modulus = 3000
poissons_ratio = 0.49
[[displaced]]
nodes = "surface"
field = "field.csv"
"""


def write(path, points, values):
    rows = np.hstack([points, values])
    np.savetxt(path, rows, "%.17g", ",", header="x,y,z,ux,uy,uz", comments="")
    return path


def smooth(x):
    """A field with waves of 100 mm; x in mm."""
    k = 2 * np.pi / 100
    return np.stack([np.sin(k * x[:, 0]), np.cos(k * x[:, 1]) * x[:, 2] / 50, np.sin(k * (x[:, 2] + x[:, 0]))], axis=1)


def test_error_on_a_surface_falls_with_the_cube_of_the_distance(tmp_path):
    """Nodes lie between the points."""
    nodes = 50 * fibonacci_sphere(701)
    errors = []
    for n in (2000, 8000):
        points = 50 * fibonacci_sphere(n)
        path = write(tmp_path / f"{n}.csv", points, smooth(points))
        found = mapping.carry_over(path, 1e-3, 1e-3 * nodes, "here")
        errors.append(np.abs(1e3 * found - smooth(nodes)).max())
    assert errors[0] < 0.02  # mm, of 1
    assert errors[0] / errors[1] > 2**3 / 1.3


def test_quadratic_fields_are_exact_in_a_volume_and_in_a_plane(tmp_path):
    """In a plane the points do not determine slopes across it. A node at a point has exactly the point's value."""
    rng = np.random.default_rng(2)
    terms = rng.normal(size=(10, 3))
    for flat in (1.0, 0.0):
        points, nodes = (rng.uniform(-20, 20, (n, 3)) * [1, 1, flat] for n in (900, 50))

        def field(x):
            x, y, z = x.T
            return np.stack([1 + 0 * x, x, y, z, x * x, y * y, z * z, x * y, y * z, x * z], axis=1) @ terms

        path = write(tmp_path / "f.csv", points, field(points))
        found = 1e3 * mapping.carry_over(path, 1e-3, 1e-3 * nodes, "here")
        np.testing.assert_allclose(found, field(nodes), atol=1e-9 * np.abs(field(points)).max())
    noise = rng.normal(size=points.shape)
    found = mapping.carry_over(write(tmp_path / "f.csv", points, noise), 1e-2, 1e-2 * points[::9], "here")
    np.testing.assert_array_equal(found, 1e-2 * noise[::9])


def test_field_in_the_deck(tmp_path):
    """In the directions and the unit of the deck."""
    points = 50 * fibonacci_sphere(1500)
    write(tmp_path / "field.csv", points / 10, smooth(points) / 10)
    path = tmp_path / "scene.toml"
    path.write_text(SCENE + 'field_unit = "cm"\ndirections = ["x", "z"]\n')
    model = model_build.build(deck.load_deck(path))
    nodes, direction = model.prescribed_dofs // 3, model.prescribed_dofs % 3
    assert set(direction) == {0, 2}
    np.testing.assert_array_equal(np.unique(nodes), model.node_sets["surface"])
    wanted = smooth(1e3 * model.points[nodes])[np.arange(len(nodes)), direction]
    assert np.abs(1e3 * model.prescribed_displacements - wanted).max() < 0.03


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[:19], r"field.csv: has 19 points; give at least 20"),
        (
            lambda rows: rows[rows[:, 0] < 0],
            r"scene.toml: displaced.0.field: the node at \(50, .* from the nearest point",
        ),
        (lambda rows: 10 * rows, r"displaced.0.field: the node at .* or check the unit"),
        (lambda rows: np.concatenate([rows, rows[:1]]), r"line 2: the same point is given twice"),
        (lambda rows: rows[:, :5], r"line 1.*|line 2: has 5 numbers; give x, y, z, ux, uy, uz"),
        (lambda rows: np.where(rows == rows[3, 5], 1e99, rows), r"line 5: a number is beyond"),
    ],
)
def test_invalid_fields_are_refused(tmp_path, change, message):
    points = 50 * fibonacci_sphere(1500)
    rows = change(np.hstack([points, smooth(points)]))
    np.savetxt(tmp_path / "field.csv", rows, "%.17g", ",", header="x,y,z,ux,uy,uz", comments="")
    (tmp_path / "scene.toml").write_text(SCENE)
    with pytest.raises(InputError, match=message) as caught:
        model_build.build(deck.load_deck(tmp_path / "scene.toml"))
    assert "\n" not in str(caught.value)


def test_the_bump_of_the_validation_is_known_exactly():
    """The table gives the bump of 10 mm to 0.003 mm at the nodes of its deck, less than errors of the solution."""
    scene = deck.load_deck(ROOT / "jobs" / "validation" / "bump.toml", ["ellipsoid.cloud=none"])
    mesh = model_build.read_mesh(scene)
    nodes = mesh.points[mesh.node_sets["surface"]]
    found = 1e3 * mapping.carry_over(scene.displaced[0].field, 1e-3, nodes, "here")
    x, y, z = 1e3 * nodes.T
    exact = np.where(z > 0, -10 * np.maximum(1 - (x * x + y * y) / 40**2, 0) ** 3, 0)
    np.testing.assert_allclose(found, exact[:, None] * [0, 0, 1], atol=0.003)
