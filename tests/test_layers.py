"""Clouds of several materials: a strain that jumps at the interface is exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import mpitled
from exact import layers
from test_kernels import HOURGLASS, at, forces, part

from mpitled import deck, store
from mpitled.errors import InputError
from mpitled.mesh import grid_points, structured_hexahedra
from mpitled.meshing.cloud import build_cloud
from mpitled.meshing.integration_cells import volumes_and_centroids
from mpitled.meshing.scatter import CLOSEST
from mpitled.model.build import build, discretise, read_mesh
from mpitled.parallel.subdomain import localise
from mpitled.results import field

EPS = np.finfo(float).eps
CONTRAST = 1000.0
#: The upper half has another material, inside a sphere so large that its surface is nearly plane.
LAYERS = """
[block]
size = [32.0, 28.0, 24.0]
elements = [8, 7, 6]
cloud = "{cloud}"
core_share = 0.7
[cloud]
irregularity = {irregularity} # 0 with cloud = "all": interface nodes on the surface must not move
[sphere.upper]
centre = [16.0, 14.0, 1012.0]
radius = 1000.0
[material.lower]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[material.upper]
youngs_modulus = {modulus}
poissons_ratio = 0.3
cells = ["upper"]
[[displaced]]
nodes = "z1"
directions = ["z"]
displacement = [2.4]
[solver]
tolerance = 1e-5
[output]
frames = 1
""" + "".join(f'[[fixed]]\nnodes = "{face}"\ndirections = ["{face[0]}"]\n' for face in ("x0", "x1", "y0", "y1", "z0"))


def text_of(cloud, contrast=CONTRAST):
    return LAYERS.format(cloud=cloud, modulus=3000.0 * contrast, irregularity=0.0 if cloud == "all" else 0.3)


def deck_of(folder, cloud, contrast=CONTRAST, more=""):
    path = folder / "layers.toml"
    path.write_text(text_of(cloud, contrast) + more)
    return path


def residual(model):
    """Largest inner nodal force in the exact deformation, relative to the largest force on the surface."""
    rows = part(
        model.points, model.hexahedra, model.domains, model.domain_gradients, model.domain_volumes, model.material
    )
    sub = localise(replace(rows, materials=model.materials), HOURGLASS, 0.1, "mean")
    f = forces(sub, at(sub, layers(model, model.points, 0.0)))
    inner = np.ones(model.n_nodes, bool)
    inner[model.node_sets["surface"]] = False
    assert inner.sum() > 100
    return np.abs(f[inner]).max() / np.abs(f).max()


@pytest.mark.parametrize("contrast", [CONTRAST, 1 / CONTRAST])
@pytest.mark.parametrize("cloud", ["none", "core", "all"])
@pytest.mark.parametrize("support", ["", "nodes = 12", "basis = 10\nnodes = 24"])
def test_layers_are_exact_to_round_off(tmp_path, cloud, contrast, support):
    """The strain is uniform in each layer, and inner nodes are in balance."""
    scene = deck.load_deck(deck_of(tmp_path, cloud, contrast, f"[support]\n{support}\n"))
    mesh = read_mesh(scene)
    model = discretise(scene, mesh)
    # The bound of the patch test (test_support) times the contrast, because of cancellation in the stiffer layer.
    assert residual(model) < 18 * 20 * EPS * 49 * CONTRAST
    if cloud != "none":
        assert model.figures.domains_across == 0
        assert model.figures.consistency_after < 100 * EPS
        smeared = discretise(scene, replace(mesh, parts=(), surface_areas=None))
        assert residual(smeared) > 1e-2


@pytest.mark.parametrize("cloud", ["core", "all"])
def test_domains_have_nodes_of_one_material(tmp_path, cloud):
    """Nodes of a domain are on its side or on the interface; interface nodes are in domains of both sides."""
    scene = deck.load_deck(deck_of(tmp_path, cloud))
    mesh = read_mesh(scene)
    model = discretise(scene, mesh)
    middle, z = 0.012, model.points[:, 2]
    upper = model.material[len(model.hexahedra) :] == 1
    np.testing.assert_array_equal(upper, model.domain_points[:, 2] > middle)
    assert z[model.domains[upper]].min() == middle == z[model.domains[~upper]].max()
    between = np.intersect1d(*(part.nodes for part in mesh.parts))
    assert len(between) == {"core": 7 * 6, "all": 9 * 8}[cloud]
    for side in (upper, ~upper):
        counts = np.bincount(model.domains[side].ravel(), minlength=model.n_nodes)
        assert counts[between].min() >= 3


def test_parts_of_a_cloud_have_their_surfaces(tmp_path):
    """Areas of a closed surface sum to zero, and their moments to the part's volume."""
    mesh = read_mesh(deck.load_deck(deck_of(tmp_path, "core")))
    assert [sorted(p.spheres) for p in mesh.parts] == [[], ["upper"]]
    for one in mesh.parts:
        size = np.abs(one.areas).sum()
        assert np.abs(one.areas.sum(axis=0)).max() < 10 * EPS * size
        volume = mesh.integration_volumes[one.integration_points].sum()
        np.testing.assert_allclose(mesh.points[one.nodes].T @ one.areas, volume * np.eye(3), atol=1e-12 * volume)
    points = np.concatenate([one.integration_points for one in mesh.parts])
    np.testing.assert_array_equal(np.sort(points), np.arange(len(mesh.integration_points)))
    shared = np.intersect1d(*(one.nodes for one in mesh.parts))
    np.testing.assert_array_equal(np.unique(mesh.points[shared, 2]), [0.012])
    assert np.isin(np.arange(mesh.n_fe_nodes, mesh.n_nodes), np.concatenate([p.nodes for p in mesh.parts])).all()


@pytest.mark.parametrize("n", [1, 2])
def test_layers_relax_to_the_exact_solution(tmp_path, n):
    path = deck_of(tmp_path, "core", 100.0)
    mpitled("run", path, "--out", tmp_path / "run", n=n)
    ours = field.open_field(tmp_path / "run")
    model = store.read_model(tmp_path / "run" / "model.h5")
    true = layers(model, model.points, 0.0)
    # The remaining error of the relaxation.
    assert np.abs(ours.at_nodes - true).max() < 1e-7
    midpoints = model.points[model.hexahedra].mean(axis=1)
    assert np.abs(ours.at(midpoints).displacement - layers(model, midpoints, 0.0)).max() < 1e-7


def test_an_export_notes_that_domains_differ(tmp_path):
    for cloud, expected in (("all", True), ("none", False)):
        mpitled("build", deck_of(tmp_path, cloud), "--out", tmp_path / cloud)
        mpitled("export", tmp_path / cloud, "--abaqus", "--out", tmp_path / "decks")
        text = (tmp_path / "decks" / "scene.toml").read_text()
        assert ("nodes of its own material only" in text) == expected
        assert deck.load_deck(tmp_path / "decks" / "scene.toml").mesh is not None


def test_domains_of_a_layer_with_too_few_nodes_take_nodes_of_the_whole_cloud(tmp_path):
    """A layer of two by two hexahedra has 18 nodes and perhaps an inner one, fewer than 24."""
    text = text_of("all", 0.01).replace("[8, 7, 6]", "[2, 2, 6]").replace("1012.0", "1020.0")
    path = tmp_path / "thin.toml"
    path.write_text(text + "[support]\nnodes = 24\nmax_fe_nodes = 24\n")
    model = build(deck.load_deck(path))
    upper = model.material == 1
    assert model.figures.domains_across == upper.sum() > 0
    assert model.points[model.domains[~upper]][..., 2].max() == 0.02
    assert (np.bincount(model.domains.ravel(), minlength=model.n_nodes) >= 2).all()
    path.write_text(text + "[support]\nnodes = 100\nmax_fe_nodes = 100\n")
    with pytest.raises(InputError, match=r"support\.nodes = 100: is more than the .* nodes that there are"):
        build(deck.load_deck(path))


def test_separate_spheres_are_parts(tmp_path):
    """One sphere in the middle of the cloud, and one in hexahedra and cloud."""
    more = "".join(
        f"[sphere.{name}]\ncentre = [{x}, 14, 6]\nradius = 4\n[material.{name}]\nyoungs_modulus = {modulus}\n"
        f'poissons_ratio = 0.1\ncells = ["{name}"]\n'
        for name, x, modulus in (("soft", 14, 30.0), ("hard", 24, 3e5))
    )
    path = deck_of(tmp_path, "core", more=more)
    mesh = read_mesh(deck.load_deck(path))
    model = build(deck.load_deck(path))
    assert sorted(one.spheres for one in mesh.parts) == [(), ("hard",), ("soft",), ("upper",)]
    names = np.array([material.name for material in model.materials])[model.material]
    for one in mesh.parts:
        inside = names[len(model.hexahedra) + one.integration_points]
        assert set(inside) == set(one.spheres or ("lower",))
    assert model.figures.consistency_after < 100 * EPS


def test_a_cloud_is_as_fine_as_the_interface():
    """Near the interface the spacing is the size of its faces, although the element size is larger."""
    points, hexahedra = grid_points((12, 12, 8), (0.024, 0.024, 0.032)), structured_hexahedra((12, 12, 8))
    sphere = deck.Sphere(name="upper", centre=(0.012, 0.012, 1.016), radius=1.0)
    dropped = np.ones(len(hexahedra), bool)
    (coarse, _), (fine, spacing) = (
        build_cloud(points, hexahedra, dropped, {}, deck.Cloud(), None, 0.004, spheres) for spheres in ((), (sphere,))
    )
    assert len(coarse.parts) == 1
    inside = [(np.abs(f.points - [0.012, 0.012, 0.016]) < [0.01, 0.01, 0.004]).all(axis=1) for f in (coarse, fine)]
    volume = 0.02 * 0.02 * 0.008
    assert inside[0].sum() < 0.5 * volume / 0.002**3
    assert inside[1].sum() == pytest.approx(volume / 0.002**3, rel=0.3)
    midpoints = (points[:12] + points[14:26]) / 2 + [0, 0, 0.016]
    np.testing.assert_allclose(spacing(midpoints), 0.002, rtol=1e-9)
    scattered = fine.points[-len(fine.points) // 4 :]
    away = np.linalg.norm(scattered[:, None] - scattered, axis=2) + np.eye(len(scattered))
    assert (away.min(axis=1) >= CLOSEST * spacing(scattered) * (1 - 1e-12)).all()
    assert fine.integration_volumes.sum() == pytest.approx(volumes_and_centroids(points[hexahedra])[0].sum(), rel=1e-12)
