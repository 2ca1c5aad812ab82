"""Cylinders, ellipsoids and fitted blocks: surfaces, sets, convergent volumes, cell quality, and the patch test."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import ROOT

from mpitled import deck, kernels
from mpitled.cells import hexahedra
from mpitled.errors import InputError
from mpitled.mesh import Rotation
from mpitled.meshing import o_grid
from mpitled.meshing.block import block_mesh
from mpitled.meshing.faces import boundary_faces
from mpitled.meshing.phantoms import cylinder_mesh, ellipsoid_mesh
from mpitled.model import build as model_build
from mpitled.model import loading

CLOUD = deck.Cloud()
TUMOUR = deck.Tumour(centre=(0.015, 0.0, 0.008), volume=523.6e-9)
#: Its surface has no more nodes than the ellipsoid's.
COARSE_SEED = deck.Tumour(centre=(0.015, 0.0, 0.008), volume=523.6e-9, surface_nodes=12)
RADIUS, HEIGHT, AXES = 0.05, 0.1, np.array([0.08, 0.065, 0.06])
SEED_VOLUME = 4 / 3 * np.pi * 0.002**3
MATERIAL = "[material.brain]\nyoungs_modulus = 3000.0\npoissons_ratio = 0.49\n"
ROUND_OFF = 1e-14  # of coordinates of 0.1 m, and of their squares over the semi-axes'


def cylinder(size=0.01, tumour=None, **keys):
    return cylinder_mesh(deck.Cylinder(radius=RADIUS, height=HEIGHT, element_size=size, **keys), CLOUD, tumour)


def ellipsoid(size=0.008, tumour=None, axes=AXES, **keys):
    return ellipsoid_mesh(deck.Ellipsoid(semi_axes=tuple(axes), element_size=size, **keys), CLOUD, tumour)


def fe_volume(mesh):
    return hexahedra.volumes(mesh.points, mesh.hexahedra).sum()


@pytest.mark.parametrize(
    ("mesher", "sizes", "exact"),
    [
        (cylinder, (0.01, 0.005), np.pi * RADIUS**2 * HEIGHT),
        (ellipsoid, (0.008, 0.004), 4 / 3 * np.pi * AXES.prod()),
        (lambda size: ellipsoid(size, COARSE_SEED), (0.008, 0.004), 4 / 3 * np.pi * AXES.prod() - SEED_VOLUME),
    ],
    ids=["cylinder", "ellipsoid", "cavity"],
)
def test_volumes_converge_at_second_order(mesher, sizes, exact):
    """All numbers of elements double, so the error is a quarter, except for terms of fourth order."""
    coarse, fine = (mesher(size) for size in sizes)
    assert len(fine.node_sets["surface"]) - 2 == pytest.approx(4 * (len(coarse.node_sets["surface"]) - 2), rel=0.1)
    errors = [1 - fe_volume(mesh) / exact for mesh in (coarse, fine)]
    assert 0 < errors[1] < errors[0] < 0.03
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)


@pytest.mark.parametrize(("mesher", "centre"), [(cylinder, (0.1, 0.0, 0.05)), (ellipsoid, (0.0, 0.0, 0.11))])
def test_a_tumour_outside_the_body_is_refused(mesher, centre):
    """50 mm outside, where another radius of the cloud does not help."""
    with pytest.raises(InputError, match=r"^tumour.centre = .* outside the body, 50(\.\d)? mm from it; move it inside"):
        mesher(tumour=TUMOUR.model_copy(update={"centre": centre}), cloud="core")


def test_cylinder_has_its_nodes_on_its_surface():
    mesh = cylinder()
    r, z = np.hypot(*mesh.points[:, :2].T), mesh.points[:, 2]
    bottom, top, side = (mesh.node_sets[name] for name in ("bottom", "top", "side"))
    np.testing.assert_array_equal(bottom, np.flatnonzero(z == 0))
    np.testing.assert_array_equal(top, np.flatnonzero(z == HEIGHT))
    np.testing.assert_array_equal(side, np.flatnonzero(np.abs(r - RADIUS) < ROUND_OFF))
    assert r.max() < RADIUS + ROUND_OFF
    np.testing.assert_array_equal(mesh.node_sets["surface"], np.unique(boundary_faces(mesh.hexahedra)))
    np.testing.assert_array_equal(mesh.node_sets["surface"], np.unique(np.concatenate([bottom, top, side])))


@pytest.mark.parametrize("tumour", [None, TUMOUR], ids=["whole", "cavity"])
def test_ellipsoid_has_its_nodes_on_its_surface(tumour):
    """The sets patch and fixed end at nodes, so a tolerance in their definition changes nothing."""
    mesh = ellipsoid(tumour=tumour)
    p, q, r = (mesh.points / AXES).T
    surface = np.flatnonzero(np.abs(p * p + q * q + r * r - 1) < ROUND_OFF)
    np.testing.assert_array_equal(mesh.node_sets["surface"], surface)
    across, slope = np.maximum(np.abs(p), np.abs(q))[surface], np.tan(np.pi / 8)
    for tolerance in (1e-12, 1e-3):
        patch = surface[(across <= slope * r[surface] + tolerance) & (r[surface] > 0)]
        fixed = surface[(across <= -r[surface] + tolerance) & (r[surface] < 0)]
        np.testing.assert_array_equal(mesh.node_sets["patch"], patch)
        np.testing.assert_array_equal(mesh.node_sets["fixed"], fixed)
    boundary = np.unique(boundary_faces(mesh.hexahedra))
    if tumour:
        seed = mesh.node_sets["tumour"]
        assert np.abs(np.linalg.norm(mesh.points[seed] - TUMOUR.centre, axis=1) - 0.002).max() < ROUND_OFF
        assert len(seed) >= TUMOUR.surface_nodes
        surface = np.union1d(surface, seed)
    np.testing.assert_array_equal(boundary, surface)


@pytest.mark.parametrize("size", [0.02, 0.012, 0.008, 0.005])
def test_scaled_jacobians_are_good(size):
    """At least 0.5 in the shapes of the validation, and 0.3 in a flat or long ellipsoid."""
    lens, cigar = ellipsoid(size, axes=[0.08, 0.08, 0.03]), ellipsoid(size, axes=[0.08, 0.04, 0.04])
    for mesh in (lens, cigar):
        assert hexahedra.scaled_jacobian(mesh.points, mesh.hexahedra).min() > 0.3
    for mesh in (cylinder(size), ellipsoid(size), ellipsoid(size, TUMOUR), ellipsoid(size, axes=[0.06] * 3)):
        assert hexahedra.scaled_jacobian(mesh.points, mesh.hexahedra).min() > 0.5


@pytest.mark.parametrize("size", [0.008, 0.005, 0.003])
def test_elements_have_the_requested_size(size):
    """The mean within 10 %, and the largest edge less than twice the smallest."""
    for mesh in (cylinder(size, grading=1.0), ellipsoid(size)):
        edges = np.cbrt(hexahedra.volumes(mesh.points, mesh.hexahedra))
        assert np.cbrt((edges**3).mean()) == pytest.approx(size, rel=0.1)
        assert edges.max() < 2 * edges.min()


def test_graded_elements_are_thin_at_the_surface():
    """Number of elements and sets are those without grading; the thinnest layer has the requested share."""
    ball = 4 / 3 * np.pi * AXES.prod()
    for mesher, name, exact in ((cylinder, "bottom", np.pi * RADIUS**2 * HEIGHT), (ellipsoid, "patch", ball)):
        even, fine = mesher(0.005, grading=1.0), mesher(0.005, grading=0.25)
        assert len(fine.hexahedra) == len(even.hexahedra)
        np.testing.assert_array_equal(fine.node_sets[name], even.node_sets[name])
        reach = [np.abs(mesh.points[mesh.node_sets[name]]).max(axis=0) for mesh in (even, fine)]
        np.testing.assert_allclose(reach[0], reach[1], atol=ROUND_OFF)
        missing = [1 - fe_volume(mesh) / exact for mesh in (even, fine)]  # wider facets, larger sagittae
        assert 0 < missing[0] < missing[1] < 2 * missing[0]
        assert hexahedra.scaled_jacobian(fine.points, fine.hexahedra).min() > 0.4
    layers = np.diff(np.unique(cylinder(0.005, grading=0.25).points[:, 2])) / 0.005
    assert layers[0] == pytest.approx(layers[-1]) == layers.min()
    # The slope of the map is the share at the end, and differs by a term of second order half a layer inwards.
    for n in (20, 40):
        thinnest = n * (1 - o_grid.graded(n, 0.25)[-2])
        assert thinnest - 0.25 == pytest.approx(0.75 * np.pi**2 / 6 / n**2, rel=0.01)


@pytest.mark.parametrize("where", ["corner", "middle", "face"])
def test_block_is_fitted_to_a_sphere(where):
    """The volume of the ball converges at second order, and cells are valid on both sides of the sphere."""
    centre = {"corner": (0.0, 0.0, 0.0), "middle": (0.015, 0.014, 0.016), "face": (0.015, 0.015, 0.03)}[where]
    ball = 4 / 3 * np.pi * 0.008**3 / {"corner": 8, "middle": 1, "face": 2}[where]
    sphere = deck.Sphere(name="cyst", centre=centre, radius=0.008)
    errors = []
    for n in (4, 8):
        block = deck.Block(size=(0.03, 0.03, 0.03), elements=(n, n, n), fitted="cyst")
        mesh = block_mesh(block, CLOUD, None, sphere)
        assert fe_volume(mesh) == pytest.approx(0.03**3, rel=1e-12)
        assert hexahedra.scaled_jacobian(mesh.points, mesh.hexahedra).min() > 0.3
        inside = np.linalg.norm(mesh.points[mesh.hexahedra].mean(axis=1) - centre, axis=1) < sphere.radius
        errors.append(1 - hexahedra.volumes(mesh.points, mesh.hexahedra[inside]).sum() / ball)
        np.testing.assert_array_equal(mesh.node_sets["surface"], np.unique(boundary_faces(mesh.hexahedra)))
    assert 0 < errors[1] < errors[0] < 0.1
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    with pytest.raises(InputError, match=r"block.fitted: the sphere cyst .* does not lie in the block"):
        block_mesh(block, CLOUD, None, sphere.model_copy(update={"radius": 0.04}))


def test_sphere_of_cells(tmp_path):
    """A cell is in the sphere if the midpoint of its hexahedron, remaining or replaced, is in the sphere."""
    path = tmp_path / "scene.toml"
    text = '[block]\nsize = [40, 40, 40]\nelements = [8, 8, 8]\ncloud = "core"\n[[fixed]]\nnodes = "x0"\n' + MATERIAL
    cyst = "[sphere.cyst]\ncentre = [12, 20, 20]\nradius = 10\n"
    cyst += '[material.fluid]\nyoungs_modulus = 10\npoissons_ratio = 0.1\ncells = ["cyst"]\n'
    path.write_text(text + cyst)
    mesh, model = (of(deck.load_deck(path)) for of in (model_build.read_mesh, model_build.build))
    positions = np.concatenate([mesh.points[mesh.hexahedra].mean(axis=1), mesh.integration_points])
    midpoints = 0.005 * (np.floor(positions / 0.005) + 0.5)
    inside = np.linalg.norm(midpoints - [0.012, 0.02, 0.02], axis=1) <= 0.01
    assert 0 < inside[: len(mesh.hexahedra)].sum() < inside.sum() < len(midpoints)
    np.testing.assert_array_equal(np.flatnonzero(inside), mesh.cell_sets["cyst"])
    np.testing.assert_array_equal([model.materials[m].name for m in model.material], np.where(inside, "fluid", "brain"))
    # A sphere without a separate material does not divide the cloud; each integration point counts by its position.
    path.write_text(text + cyst.partition("[material")[0])
    undivided = model_build.read_mesh(deck.load_deck(path))
    assert len(undivided.parts) == 1 < len(mesh.parts)
    positions = np.concatenate([undivided.points[undivided.hexahedra].mean(axis=1), undivided.integration_points])
    inside = np.linalg.norm(positions - [0.012, 0.02, 0.02], axis=1) <= 0.01
    np.testing.assert_array_equal(np.flatnonzero(inside), undivided.cell_sets["cyst"])
    for before, after, message in (
        ("radius = 10", "radius = 0.1", r"sphere.cyst: no cell has its middle in it"),
        ("sphere.cyst", "sphere.all", r"sphere.all: there is a cell set of that name"),
    ):
        path.write_text(text + cyst.replace(before, after))
        with pytest.raises(InputError, match=message):
            model_build.read_mesh(deck.load_deck(path))
    path.write_text(text + cyst)
    with pytest.raises(InputError, match=r"block.fitted = .*is none of the spheres \(cyst\)"):
        deck.load_deck(path, ["block.fitted=cist"])


@pytest.mark.parametrize("tumour", [None, TUMOUR], ids=["whole", "tumour"])
@pytest.mark.parametrize("cloud", ["core", "all"])
def test_cloud_replaces_hexahedra(cloud, tumour):
    for mesher in (cylinder, ellipsoid):
        seed = tumour and deck.Tumour(centre=(0.005, 0.0, 0.05 if mesher is cylinder else 0.008), volume=523.6e-9)
        whole, mesh = mesher(0.007, grading=1.0), mesher(0.007, cloud=cloud, tumour=seed, grading=1.0)
        missing = SEED_VOLUME if seed else 0.0
        volume = mesh.integration_volumes.sum() + (fe_volume(mesh) if len(mesh.hexahedra) else 0.0)
        assert volume == pytest.approx(fe_volume(whole) - missing, rel=1e-12)
        assert (mesh.n_fe_nodes > 0) == (cloud == "core")
        assert (len(mesh.node_sets["interface"]) > 0) == (cloud == "core")
        for name, nodes in whole.node_sets.items():
            positions = {tuple(position) for position in mesh.points[mesh.node_sets[name]]}
            assert positions == {tuple(position) for position in whole.points[nodes]}


def test_core_ends_at_its_share_of_the_radius():
    """At a share of 0.5 the square core only; at larger shares also rings, without the outermost ring."""
    for share, reach in ((0.5, 0.5), (0.7, 0.7), (0.999, 0.8)):
        mesh = cylinder(0.005, cloud="core", core_share=share, grading=1.0)
        positions = mesh.points[mesh.node_sets["interface"]]
        r = np.hypot(*positions[:, :2].T).max() / RADIUS
        assert r == pytest.approx(reach, abs=0.13)
        assert r < 0.95
        margin = max(round((1 - share) / 2 * 20), 1) * 0.005
        assert (positions[:, 2].min(), positions[:, 2].max()) == pytest.approx((margin, HEIGHT - margin))


@pytest.mark.parametrize("shape", ["cylinder", "ellipsoid"])
@pytest.mark.parametrize("cloud", ["none", "core"])
def test_constant_stress_is_in_balance_at_inner_nodes(tmp_path, shape, cloud):
    """The patch test: gradients of affine fields are exact in each cell, and inner nodal forces are zero."""
    geometry = {
        "cylinder": "[cylinder]\nradius = 50\nheight = 100\nelement_size = 12.0\n",
        "ellipsoid": "[ellipsoid]\nsemi_axes = [80, 65, 60]\nelement_size = 12.0\n",
    }[shape]
    path = tmp_path / "scene.toml"
    path.write_text(f'{geometry}cloud = "{cloud}"\n{MATERIAL}[[fixed]]\nnodes = "surface"\n')
    model = model_build.build(deck.load_deck(path))
    B, V = hexahedra.geometry(model.points, model.hexahedra)
    if cloud == "core":
        assert len(model.domains) > 0
    for cells, gradients in ((model.hexahedra, B), (model.domains, model.domain_gradients)):
        slopes = np.einsum("nai,naj->nij", model.points[cells], gradients)
        # Round-off times the root of the largest accepted condition of a moment matrix.
        assert np.abs(slopes - np.eye(3)).max(initial=0) < 1e-12
    forces = hexahedra.nodal_sum(model.hexahedra, V[:, None, None] * B, model.n_nodes)
    if cloud == "core":
        of_cloud = model.domain_volumes[:, None, None] * model.domain_gradients
        forces += hexahedra.nodal_sum(model.domains, of_cloud, model.n_nodes)
    inner = np.setdiff1d(np.arange(model.n_nodes), model.node_sets["surface"])
    assert np.abs(forces[inner]).max() < 1e-11 * np.abs(forces).max()


def test_a_hexahedron_is_the_seed_of_the_papers_mesh():
    """Its middle is the tumour's centre, the surface does not move, and the other cells stay valid."""
    whole, mesh = ellipsoid(), ellipsoid(tumour=TUMOUR, cavity="moved")
    seed = mesh.points[mesh.node_sets["tumour"]]
    assert len(mesh.hexahedra) == len(whole.hexahedra) - 1
    assert seed.shape == (8, 3)
    assert np.abs(seed.mean(axis=0) - TUMOUR.centre).max() < ROUND_OFF
    surface = mesh.node_sets["surface"]
    assert np.abs(mesh.points[surface] - whole.points[surface]).max() < ROUND_OFF
    assert hexahedra.scaled_jacobian(mesh.points, mesh.hexahedra).min() > 0.4


def test_nodes_beside_the_seed_move_as_incompressible_tissue():
    """Nodes on the seed move to R; other nodes move so that each shell keeps its volume."""
    rng, centre, volume = np.random.default_rng(1), np.array(TUMOUR.centre), 523.6e-9
    direction = rng.normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = np.where(np.arange(200) % 2, 0.002, rng.uniform(0.001, 0.02, 200))
    points = centre + radius[:, None] * direction
    grown = points + loading.growth(points, centre, 0.002, volume) - centre
    after = np.linalg.norm(grown, axis=1)
    np.testing.assert_allclose(4 / 3 * np.pi * (after**3 - radius**3), volume - SEED_VOLUME, rtol=1e-9)
    np.testing.assert_allclose(grown / after[:, None], direction, atol=1e-12)
    np.testing.assert_allclose(after[1::2], loading.sphere_radius(volume), rtol=1e-12)


def test_a_seed_that_does_not_fit_is_refused():
    with pytest.raises(InputError, match=r"tumour.centre = \(75, 0, 8\) mm: the seed and an element's size"):
        ellipsoid(tumour=deck.Tumour(centre=(0.075, 0.0, 0.008), volume=523.6e-9))
    with pytest.raises(InputError, match=r'cylinder.cloud = "none"'):
        cylinder(tumour=TUMOUR)


@pytest.mark.parametrize("degrees", [90.0, 180.0])
def test_rotated_nodes_move_on_arcs(degrees):
    """At any share of the load the distance to the axis is constant, and the angle has that share."""
    rng = np.random.default_rng(0)
    points, centre = rng.uniform(-1, 1, (50, 3)), np.array([0.3, -0.2, 0.9])
    for axis in range(3):
        rotation = Rotation(np.radians(degrees), axis, tuple(centre))
        full, turns = loading.rotation_path(points, rotation)
        path, share = np.empty(full.size), 0.37
        kernels.rotate_prescribed(path, full.ravel(), turns.reshape(-1, 3), share)
        across = [(axis + 1) % 3, (axis + 2) % 3]
        before, after = ((p - centre)[:, across] @ [1, 1j] for p in (points, points + path.reshape(-1, 3)))
        np.testing.assert_allclose(after, before * np.exp(1j * share * rotation.angle), atol=1e-14)
        kernels.rotate_prescribed(path, full.ravel(), turns.reshape(-1, 3), 1.0)
        np.testing.assert_allclose(path, full.ravel(), rtol=0, atol=1e-15)


def test_rotation_in_the_deck(tmp_path):
    """In degrees, added to a displacement in millimetres; directions normal to the axis must be prescribed."""
    path = tmp_path / "scene.toml"
    text = "[block]\ncorner = [-10, -10, 0]\nsize = [20, 20, 40]\nelements = [2, 2, 4]\n" + MATERIAL
    text += '[[fixed]]\nnodes = "z0"\n[[displaced]]\nnodes = "z1"\ndisplacement = [0, 0, 4]\nrotation = 90\n'
    path.write_text(text)
    model = model_build.build(deck.load_deck(path))
    top = model.node_sets["z1"]
    u = np.zeros(3 * model.n_nodes)
    u[model.prescribed_dofs] = model.prescribed_displacements
    x, y, z = model.points[top].T
    np.testing.assert_allclose(u.reshape(-1, 3)[top], np.stack([-y - x, x - y, np.full_like(z, 0.004)], 1), atol=1e-17)
    path.write_text(text.replace("[0, 0, 4]", '[0, 4]\ndirections = ["x", "z"]'))
    with pytest.raises(InputError, match=r"displaced.0.directions = .*turns nodes about z"):
        deck.load_deck(path)


@pytest.mark.parametrize("path", sorted((ROOT / "jobs" / "validation").glob("*.toml")), ids=lambda path: path.stem)
def test_validation_decks_are_read(path):
    assert deck.load_deck(path).title
