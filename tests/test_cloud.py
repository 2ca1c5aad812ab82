"""Clouds that replace hexahedra, and blocks: exact volumes, even nodes, reproducible bits, errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mpitled import deck
from mpitled.errors import InputError
from mpitled.mesh import grid_points, structured_hexahedra
from mpitled.meshing.block import block_mesh
from mpitled.meshing.cloud import build_cloud
from mpitled.meshing.faces import boundary_faces
from mpitled.meshing.integration_cells import cut, subdivide, volumes_and_centroids
from mpitled.meshing.scatter import CLOSEST
from mpitled.meshing.spacing import Spacing

CLOUD = deck.Cloud(points_per_spacing=1.4, growth=0.3)
SEED_VOLUME = 4 / 3 * np.pi * 0.002**3


def tumour(centre, **keys):
    return deck.Tumour(centre=centre, volume=523.6e-9, **{"surface_nodes": 400, **keys})


def distorted_block(n=10, h=0.004):
    """Nodes and hexahedra of a bent, twisted and stretched block without plane faces."""
    points = grid_points((n, n, n), (n * h,) * 3)
    x, y, z = (points / (n * h)).T
    shift = np.stack([0.2 * np.sin(3 * y) * z, 0.15 * x * x + 0.1 * z, 0.2 * x * y * z], axis=1)
    return points + n * h * shift, structured_hexahedra((n, n, n))


def flux_volume(points, faces):
    """Volume inside bilinear faces by the divergence theorem, exact with 2 x 2 Gauss points."""
    p, total = points[faces], 0.0
    for s in (0.5 - 12**-0.5, 0.5 + 12**-0.5):
        for t in (0.5 - 12**-0.5, 0.5 + 12**-0.5):
            position = np.array([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t]) @ p
            along_s, along_t = np.array([t - 1, 1 - t, t, -t]) @ p, np.array([s - 1, -s, s, 1 - s]) @ p
            total += (position * np.cross(along_s, along_t)).sum() / 12
    return total


def test_parts_of_distorted_hexahedra_keep_volume_and_moments():
    points, hexahedra = distorted_block()
    whole, centroids = volumes_and_centroids(points[hexahedra])
    cuts = np.random.default_rng(1).integers(1, 4, (len(hexahedra), 3))
    parts, positions = volumes_and_centroids(subdivide(points[hexahedra], cuts))
    owner = np.repeat(np.arange(len(hexahedra)), cuts.prod(axis=1))
    # Round-off: sums of up to 27 parts.
    np.testing.assert_allclose(np.bincount(owner, parts), whole, rtol=1e-13)
    for i in range(3):
        np.testing.assert_allclose(np.bincount(owner, parts * positions[:, i]), whole * centroids[:, i], rtol=1e-12)
    assert whole.sum() == pytest.approx(flux_volume(points, boundary_faces(hexahedra)), rel=1e-12)


@pytest.mark.parametrize("per_spacing", [0.8, 1.0, 1.4, 2.0, 2.6])
def test_number_of_integration_cells_is_as_requested(per_spacing):
    points, hexahedra = grid_points((10, 10, 10), (0.04,) * 3), structured_hexahedra((10, 10, 10))
    cells = cut(points[hexahedra], Spacing(0.004), per_spacing, np.random.default_rng(0))
    wanted = max(per_spacing, 1.0) ** 3
    # Each hexahedron has one of two numbers that differ by less than the wanted number: four standard errors.
    assert len(cells) / 1000 == pytest.approx(wanted, abs=4 * 0.5 * wanted / 1000**0.5)


@pytest.mark.parametrize("shape", ["cubes", "distorted"])
def test_cloud_around_a_seed(shape):
    points, hexahedra = distorted_block()
    if shape == "cubes":
        points = grid_points((10, 10, 10), (0.04,) * 3)
    middle = points[hexahedra].mean(axis=1)
    centre = middle[555] + 0.0007
    dropped = np.linalg.norm(middle - centre, axis=1) < 0.014
    mesh, spacing = build_cloud(points, hexahedra, dropped, {}, CLOUD, tumour(tuple(centre)), 0.004)

    void = flux_volume(points, boundary_faces(hexahedra[dropped]))
    volumes = mesh.integration_volumes
    assert mesh.figures["void_volume_m3"] == pytest.approx(void, rel=1e-12)
    assert volumes.sum() == pytest.approx(void - SEED_VOLUME, rel=1e-12)
    assert volumes.min() > 0
    # Before rescaling, the sum has the sampling error of cut cells: below 0.1 % of the seed.
    sampled = mesh.figures["integration_volume_before_rescaling_m3"]
    assert abs(sampled - (void - SEED_VOLUME)) < 1e-3 * SEED_VOLUME
    # The first moments, relative to the seed's volume and radius.
    moments = volumes @ mesh.integration_points
    cells, centroids = volumes_and_centroids(points[hexahedra[dropped]])
    np.testing.assert_allclose(moments, cells @ centroids - SEED_VOLUME * centre, atol=0.01 * SEED_VOLUME * 0.002)
    distance = np.linalg.norm(mesh.integration_points - centre, axis=1)
    assert distance.min() >= 0.002 * (1 - 1e-12)
    assert 2.4 < mesh.figures["integration_points_per_efg_node"] < 4

    seed = mesh.points[mesh.node_sets["tumour"]]
    assert len(seed) == 400
    np.testing.assert_allclose(np.linalg.norm(seed - centre, axis=1), 0.002, rtol=1e-12)
    tree = cKDTree(mesh.points)
    inner = mesh.points[mesh.node_sets["tumour"][-1] + 1 :]
    assert np.linalg.norm(inner - centre, axis=1).min() > 0.002
    assert (tree.query(inner, k=2)[0][:, 1] >= CLOSEST * spacing(inner) * (1 - 1e-12)).all()
    # No holes: each point outside the seed has a node within 1.25 spacings (0.87 on a cubic grid, 1.1 measured).
    rng = np.random.default_rng(3)
    corners = points[hexahedra[dropped]]
    positions = (rng.dirichlet(np.ones(8), (40, len(corners)))[..., None] * corners).sum(axis=2).reshape(-1, 3)
    positions = positions[np.linalg.norm(positions - centre, axis=1) > 0.002]
    assert (tree.query(positions)[0] / spacing(positions)).max() < 1.25
    # The spacing at the seed is that of the surface nodes, and it grows by `growth`.
    at_surface = np.sqrt(4 * np.pi * 0.002**2 / 400)
    assert spacing(seed)[0] == pytest.approx(at_surface)
    assert spacing(centre[None] + (0.004, 0, 0))[0] == pytest.approx(at_surface + 0.3 * 0.002)


def test_remaining_hexahedra_keep_their_nodes_without_unused_nodes():
    points, hexahedra = distorted_block()
    dropped = np.linalg.norm(points[hexahedra].mean(axis=1) - points.mean(axis=0), axis=1) < 0.012
    gone = np.setdiff1d(np.unique(hexahedra[dropped]), np.unique(hexahedra[~dropped]))
    node_sets = {"boundary": np.unique(boundary_faces(hexahedra[dropped])), "gone": gone}
    mesh = build_cloud(points, hexahedra, dropped, node_sets, CLOUD, None, 0.004).mesh
    np.testing.assert_array_equal(mesh.points[mesh.hexahedra], points[hexahedra[~dropped]])
    np.testing.assert_array_equal(np.unique(mesh.hexahedra), np.arange(mesh.n_fe_nodes))
    np.testing.assert_array_equal(mesh.node_sets["interface"], mesh.node_sets["boundary"])
    assert (mesh.node_sets["interface"] < mesh.n_fe_nodes).all()
    assert len(mesh.node_sets["gone"]) == 0


def test_equal_seeds_give_equal_bits_and_another_seed_another_cloud():
    points, hexahedra = distorted_block()
    dropped = np.linalg.norm(points[hexahedra].mean(axis=1) - points.mean(axis=0), axis=1) < 0.012
    one, two, other = (
        build_cloud(
            points, hexahedra, dropped, {}, deck.Cloud(seed=seed), tumour(tuple(points.mean(axis=0))), 0.004
        ).mesh
        for seed in (0, 0, 1)
    )
    for name in ("points", "integration_points", "integration_volumes", "hexahedra"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()
    assert other.points.shape != one.points.shape or (other.points != one.points).any()


@pytest.mark.parametrize("kind", ["none", "core", "all"])
@pytest.mark.parametrize("with_tumour", [False, True])
def test_block(kind, with_tumour):
    size = (0.04, 0.05, 0.03)
    block = deck.Block(size=size, elements=(10, 12, 8), cloud=kind)
    seed = tumour((0.021, 0.024, 0.015)) if with_tumour else None
    cloud = deck.Cloud(radius=0.011)
    if kind == "none" and with_tumour:
        with pytest.raises(InputError, match="a tumour grows in a cloud"):
            block_mesh(block, cloud, seed)
        return
    mesh = block_mesh(block, cloud, seed)
    hexahedra = volumes_and_centroids(mesh.points[mesh.hexahedra])[0].sum()
    total = np.prod(size) - (SEED_VOLUME if with_tumour else 0)
    assert hexahedra + mesh.integration_volumes.sum() == pytest.approx(total, rel=1e-12)
    assert (mesh.n_fe_nodes == 0) == (kind == "all")
    for i, axis in enumerate("xyz"):
        for end, position in ((0, 0.0), (1, size[i])):
            on_face = np.flatnonzero(mesh.points[:, i] == position)
            np.testing.assert_array_equal(mesh.node_sets[f"{axis}{end}"], on_face)
            assert len(on_face) == {"x": 13 * 9, "y": 11 * 9, "z": 11 * 13}[axis]
    corners = np.array([[x, y, z] for x in (0, size[0]) for y in (0, size[1]) for z in (0, size[2])])
    assert cKDTree(mesh.points).query(corners)[0].max() == 0
    assert len(mesh.node_sets["surface"]) == 11 * 13 * 9 - 9 * 11 * 7
    n_hexahedra = len(mesh.hexahedra)
    np.testing.assert_array_equal(mesh.cell_sets["hexahedra"], np.arange(n_hexahedra))
    np.testing.assert_array_equal(mesh.cell_sets["cloud"], np.arange(n_hexahedra, mesh.n_cells))
    if kind == "core" and not with_tumour:
        assert n_hexahedra == 960 - 4 * 6 * 4
        assert len(mesh.node_sets["interface"]) == 5 * 7 * 5 - 3 * 5 * 3
    if with_tumour:
        assert len(mesh.node_sets["tumour"]) == 400


def test_cloud_of_a_block_is_irregular_and_follows_its_spacing():
    block = deck.Block(size=(0.04,) * 3, elements=(10,) * 3, cloud="all")
    mesh = block_mesh(block, deck.Cloud(spacing=0.005), None)
    assert len(mesh.node_sets["x0"]) == 9 * 9
    inner = np.setdiff1d(np.arange(mesh.n_nodes), mesh.node_sets["surface"])
    # About one node per cubed spacing, less near the boundary.
    assert len(inner) == pytest.approx(7**3, rel=0.1)
    assert len(np.unique(mesh.points[inner, 0])) == len(inner)
    assert len(np.unique(mesh.points[mesh.node_sets["x0"], 1])) > 7 * 9


@pytest.mark.parametrize(
    ("centre", "radius", "message"),
    [
        ((0.02, 0.02, 0.0202), 0.0001, "cloud: no hexahedron"),
        ((0.02, 0.02, 0.02), 0.006, "need 6 mm; enlarge cloud.radius, or make the hexahedra smaller"),
        ((0.021, 0.021, 0.003), 0.011, "is 3 mm from .* move it away from there, or make the hexahedra smaller"),
        ((0.021, 0.021, 0.0), 0.011, "is 0 mm from"),
        ((0.021, 0.021, -0.001), 0.01, "not inside the cloud, but 1 mm from it; move it"),
        ((0.02, 0.02, -0.05), 0.01, r"centre = \(20, 20, -50\) mm: is outside the body, 50 mm from it; move it inside"),
    ],
)
def test_a_seed_that_does_not_fit_is_refused(centre, radius, message):
    block = deck.Block(size=(0.04,) * 3, elements=(10,) * 3, cloud="core")
    with pytest.raises(InputError, match=message) as error:
        block_mesh(block, deck.Cloud(radius=radius), tumour(centre))
    assert "\n" not in str(error.value)
