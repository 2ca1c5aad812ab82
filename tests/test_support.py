"""Support domains: which nodes they take, what least squares reproduce, and constant stress in balance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from test_kernels import HOURGLASS, at, forces, part

from mpitled.cells import hexahedra
from mpitled.cells.hexahedra import nodal_sum
from mpitled.cells.support_domains import (
    FLATTEST,
    POWERS,
    field_at_nodes,
    linear_projector,
    moving_least_squares,
    worst_condition,
)
from mpitled.deck import load_deck
from mpitled.errors import InputError
from mpitled.mesh import CORNERS
from mpitled.model.build import build
from mpitled.model.domain_nodes import find_domains, repair
from mpitled.parallel.subdomain import localise

EPS = np.finfo(float).eps
AFFINE = np.array([[0.2, 0.05, 0.0], [0.0, -0.09, 0.03], [0.02, 0.0, -0.09]])


def scattered(n_nodes=400, n_domains=300, seed=0, far=0.1):
    """Nodes and integration points in a box of 10 mm that is `far` (m) from the origin."""
    rng = np.random.default_rng(seed)
    return far + rng.uniform(0, 0.01, (n_nodes, 3)), far + rng.uniform(0.001, 0.009, (n_domains, 3))


def distances(points, places):
    return np.linalg.norm(places[:, None] - points, axis=2)


# ------------------------------------------------------------ moving least squares


@pytest.mark.parametrize("weight", ["equal", "quartic"])
@pytest.mark.parametrize(("basis", "n"), [(4, 5), (4, 8), (4, 13), (10, 14), (10, 25), (20, 30), (20, 45)])
def test_polynomials_of_the_basis_are_exact(basis, n, weight):
    points, places = scattered()
    domains = find_domains(points, places, n, min_domains=0).domains
    values, gradients, condition = moving_least_squares(points[domains], places, basis, weight)
    # A random polynomial in coordinates of the domain's size, around the box's middle.
    scale = 0.002
    c = np.random.default_rng(1).normal(size=basis)
    powers = POWERS[:basis]

    def field(x):
        return np.prod(((x - 0.105) / scale)[..., None, :] ** powers, axis=-1) @ c

    def slope(x):
        x, out = (x - 0.105) / scale, []
        for i in range(3):
            lower = powers.copy()
            lower[:, i] = np.maximum(lower[:, i] - 1, 0)
            out.append(np.prod(x[..., None, :] ** lower, axis=-1) @ (c * powers[:, i]) / scale)
        return np.stack(out, axis=-1)

    nodal = field(points)[domains]
    largest = np.abs(nodal).max(axis=1)
    radius = np.linalg.norm(points[domains] - places[:, None], axis=2).max(axis=1)
    sound = condition <= worst_condition(basis)
    assert sound.mean() > 0.5
    # Sums of n products, after a fit that is the identity on the basis to round-off times the condition's root. The
    # box is 50 domains away from the origin: so much is lost in differences of coordinates.
    most = n * EPS * np.sqrt(condition) * largest * 50
    assert (np.abs((values * nodal).sum(axis=1) - field(places)) <= most)[sound].all()
    error = np.linalg.norm((gradients * nodal[..., None]).sum(axis=1) - slope(places), axis=1)
    assert (error * radius <= most)[sound].all()
    # Constants need no polynomial: partition of unity.
    assert np.abs(values.sum(axis=1) - 1)[sound].max() < n * EPS * np.sqrt(condition[sound].max())


@pytest.mark.parametrize("weight", ["equal", "quartic"])
@pytest.mark.parametrize(("basis", "n"), [(4, 8), (10, 20), (20, 40)])
def test_other_fields_get_the_weighted_least_squares_fit(basis, n, weight):
    points, places = scattered(far=0.0)
    domains = find_domains(points, places, n, min_domains=0).domains
    values, gradients, condition = moving_least_squares(points[domains], places, basis, weight)
    nodal = np.random.default_rng(2).normal(size=domains.shape)
    for g in np.flatnonzero(condition < worst_condition(basis))[:40]:
        offset = points[domains[g]] - places[g]
        distance = np.linalg.norm(offset, axis=1)
        q = distance / (1.2 * distance.max())
        root = np.sqrt(1 - 6 * q**2 + 8 * q**3 - 3 * q**4 if weight == "quartic" else np.ones(n))
        P = np.prod((offset / distance.max())[:, None] ** POWERS[:basis], axis=2)
        fit = np.linalg.lstsq(root[:, None] * P, root * nodal[g], rcond=None)[0]
        tolerance = 100 * EPS * condition[g] * np.linalg.norm(fit)
        assert values[g] @ nodal[g] == pytest.approx(fit[0], abs=tolerance)
        assert nodal[g] @ gradients[g] * distance.max() == pytest.approx(fit[1:4], abs=tolerance)


def test_equal_weights_have_full_derivatives():
    """The gradient of the fit is that of the values as the point moves: at fixed nodes the polynomial is one."""
    points, places = scattered(far=0.0)
    domains = find_domains(points, places, 16, min_domains=0).domains
    _, gradients, condition = moving_least_squares(points[domains], places, 10)
    sound = condition < 1e3
    h = 1e-7
    for i, step in enumerate(h * np.eye(3)):
        ahead, behind = (moving_least_squares(points[domains], places + s, 10)[0] for s in (step, -step))
        # Quadratic fits: central differences are exact but for rounding, eps / h.
        error = np.abs((ahead - behind) / (2 * h) - gradients[..., i])[sound].max()
        assert error < 1e3 * EPS / h * np.abs(ahead[sound]).max()


# ------------------------------------------------------------ which nodes


def test_domains_are_the_nearest_nodes():
    points, places = scattered()
    found = find_domains(points, places, 8, min_domains=0)
    expected = np.argsort(distances(points, places), axis=1)[:, :8]
    np.testing.assert_array_equal(found.domains, expected)
    assert (found.limited, found.added) == (0, 0)


@pytest.mark.parametrize("most", [0, 3, 7])
def test_limits_leave_the_nearest_that_they_allow(most):
    points, places = scattered()
    fe = points[:, 0] < 0.1055  # half of the nodes: domains reach far across
    seed = points[:, 1] < 0.102
    found = find_domains(points, places, 8, [(fe, most), (seed, 4)], min_domains=0)
    changed = 0
    for domain, order in zip(found.domains, np.argsort(distances(points, places), axis=1), strict=True):
        # One after the other, if neither kind is complete. Nodes beyond a limit are still counted, for they are
        # nearer than all that follow of their kind.
        kept = [a for i, a in enumerate(order) if all(not m[a] or m[order[: i + 1]].sum() <= k for m, k in
                                                      ((fe, most), (seed, 4)))][:8]  # fmt: skip
        np.testing.assert_array_equal(domain, kept)
        changed += kept != list(order[:8])
    assert found.limited == changed > 0


def test_every_wanted_node_is_in_enough_domains_and_limits_hold():
    points, places = scattered(n_nodes=500, n_domains=330)
    fe = points[:, 0] < 0.103
    limits = [(fe, 5), (points[:, 1] < 0.102, 4)]
    before = find_domains(points, places, 8, limits, np.zeros(500, bool))
    assert (np.bincount(before.domains.ravel(), minlength=500)[~fe] < 3).sum() > 20
    found = find_domains(points, places, 8, limits, ~fe, 3)
    counts = np.bincount(found.domains.ravel(), minlength=500)
    assert counts[~fe].min() >= 3
    for members, most in limits:
        assert members[found.domains].sum(axis=1).max() <= most
    assert (np.diff(np.sort(found.domains, axis=1)) > 0).all()  # no node twice
    exchanged = sum(len(set(a) - set(b)) for a, b in zip(found.domains, before.domains, strict=True))
    assert found.added == exchanged > 20


def test_a_node_that_no_domain_can_spare_a_place_for_stays_out():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [3, 3, 3], [2, 2, 2]]) * 1e-3
    place = np.full((1, 3), 0.25e-3)
    wanted = np.array([True, True, True, True, True, False])
    found = find_domains(points, place, 4, wanted=wanted, min_domains=1)
    assert (sorted(found.domains[0]), found.added) == ([0, 1, 2, 3], 0)
    # Where a node of the domain is not wanted, the farthest such makes room.
    wanted[[1, 3]] = False
    found = find_domains(points, place, 4, wanted=wanted, min_domains=1)
    assert sorted(found.domains[0]) == [0, 2, 3, 4]
    assert found.added == 1


def test_too_few_nodes_are_refused_with_the_keys_to_change():
    points, places = scattered(n_nodes=12)
    with pytest.raises(InputError, match=r"support\.nodes = 8: .* only 5 of the 12 nodes; .*support\.max_fe_nodes"):
        find_domains(points, places, 8, [(np.arange(12) < 9, 2)])


# ------------------------------------------------------------ flat domains


def layered(basis=4, n=14):
    """Dense planes of nodes (one for the linear basis, two for the quadratic), sparse ones above and below, and places.

    One plane determines no slope in z, two determine no curvature.
    """
    x, y = np.meshgrid(np.arange(n), np.arange(n))
    plane = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)
    plane[:, :2] += np.random.default_rng(0).uniform(-0.3, 0.3, (n * n, 2))
    above = plane[::5] + np.array([0.1, 0.2, 3.0])
    dense = [plane] if basis == 4 else [plane, plane[::-1] + np.array([0.2, 0.1, 1.0])]
    places = plane[5 * n : 7 * n].reshape(2, n, 3)[:, 4:-4].reshape(-1, 3) + np.array([0.1, 0.1, 0.4])
    return 1e-3 * np.concatenate([*dense, above, above * [1, 1, -1]]), 1e-3 * places


@pytest.mark.parametrize(("basis", "n", "weight"), [(4, 8, "equal"), (4, 8, "quartic"), (10, 20, "equal")])
def test_near_planar_domains_are_repaired_and_counted(basis, n, weight):
    points, places = layered(basis)
    domains = find_domains(points, places, n, min_domains=0).domains
    limits = [(np.arange(len(points)) % 2 == 0, n - 2)]
    before = domains.copy()
    condition = moving_least_squares(points[domains], places, basis, weight)[2]
    bad = condition > worst_condition(basis)
    assert bad.all()
    assert repair(points, places, domains, basis, weight, limits) == bad.sum()
    _, gradients, condition = moving_least_squares(points[domains], places, basis, weight)
    assert condition.max() <= worst_condition(basis)
    assert ((domains != before).any(axis=1) == bad).all()
    assert (np.diff(np.sort(domains, axis=1)) > 0).all()
    assert limits[0][0][domains[bad]].sum(axis=1).max() <= n - 2
    found = np.einsum("gai,gaj->gij", (points @ AFFINE.T)[domains], gradients)
    assert np.abs(found - AFFINE).max() < n * EPS * np.sqrt(condition.max()) * 20  # nodes 20 mm from the origin
    # Nothing more to do.
    assert repair(points, places, domains, basis, weight, limits) == 0


def test_a_domain_is_flat_below_the_stated_share_of_its_radius():
    """A cube's corners, its height h times its radius: moments 8 of the constant, 8 h^2 of z, so the condition h^-2."""
    for share, flat in ((FLATTEST * 0.999, True), (FLATTEST * 1.001, False)):
        height = share * np.sqrt(2 / (1 - share**2))  # of radius sqrt(2 + height^2)
        condition = moving_least_squares(CORNERS[None] * [1, 1, height], np.zeros((1, 3)))[2][0]
        assert condition == pytest.approx(share**-2, rel=1e-12)
        assert (condition > worst_condition(4)) == flat


def test_a_plane_of_nodes_is_refused_with_place_and_remedy():
    points, places = layered()
    plane = points[points[:, 2] == 0]
    domains = find_domains(plane, places, 8, min_domains=0).domains
    with pytest.raises(InputError, match=r"support\.basis = 4: .* mm lie in a plane .*; add nodes there") as error:
        repair(plane, places, domains, 4, "equal")
    assert "\n" not in str(error.value)


# ------------------------------------------------------------ what stabilises, and values at nodes


@pytest.mark.parametrize("n", [5, 8, 13])
def test_the_projector_is_symmetric_and_takes_affine_fields_out(n):
    points, places = scattered(far=0.0)
    nodes = points[find_domains(points, places, n, min_domains=0).domains]
    centred, inverse = linear_projector(nodes)
    Q = np.eye(n) - 1 / n - centred @ inverse @ np.swapaxes(centred, 1, 2)
    thick = np.linalg.cond(centred) < 100
    assert thick.mean() > 0.8
    roundoff = n * EPS * np.linalg.cond(centred)[:, None, None] ** 2
    assert (np.abs(Q - np.swapaxes(Q, 1, 2)) <= roundoff)[thick].all()
    assert (np.abs(Q @ Q - Q) <= roundoff)[thick].all()
    assert np.trace(Q, axis1=1, axis2=2)[thick] == pytest.approx(n - 4, abs=1e-9)
    affine = (nodes @ AFFINE.T + [1, 2, 3])[thick]
    assert np.abs(Q[thick] @ affine).max() < 1e4 * EPS * np.abs(affine).max()


def test_fields_at_nodes_are_exact_for_affine_ones():
    points, places = scattered()
    n_fe_nodes = 150
    domains = find_domains(points, places, 8, min_domains=2).domains
    repair(points, places, domains, 4, "quartic")
    held = np.unique(domains)
    points, domains, n_fe_nodes = points[held], np.searchsorted(held, domains), int((held < n_fe_nodes).sum())
    giving, shapes = field_at_nodes(points, n_fe_nodes, places, domains, 4, "quartic")
    assert len(giving) == len(shapes) == len(points) - n_fe_nodes
    u = points @ AFFINE.T + [0.01, -0.02, 0.03]
    at_nodes = np.einsum("ea,eai->ei", shapes, u[domains[giving]])
    assert np.abs(at_nodes - u[n_fe_nodes:]).max() < 8 * EPS * np.sqrt(worst_condition(4)) * np.abs(u).max()
    # It is the domain of the nearest point that holds the node.
    for node, domain in enumerate(giving, n_fe_nodes):
        holders = np.flatnonzero((domains == node).any(axis=1))
        assert domain == holders[cKDTree(places[holders]).query(points[node])[1]]


# ------------------------------------------------------------ constant stress in balance


BLOCK = """
[block]
size = [32.0, 28.0, 24.0]
elements = [8, 7, 6]
cloud = "{cloud}"
core_share = 0.6
[support]
{support}
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[fixed]]
nodes = "x0"
"""


def model_of(folder, support="", cloud="core", more=""):
    path = folder / "block.toml"
    path.write_text(BLOCK.format(cloud=cloud, support=support) + more)
    return build(load_deck(path))


def gradient_balance(model):
    """Sum (n_nodes, 3) of V B over all cells, relative to the largest sum of sizes, and which nodes are free."""
    B, V = hexahedra.geometry(model.points, model.hexahedra)
    total, size = (
        nodal_sum(model.hexahedra, f(V[:, None, None] * B), model.n_nodes)
        + nodal_sum(model.domains, f(model.domain_volumes[:, None, None] * model.domain_gradients), model.n_nodes)
        for f in (np.asarray, np.abs)
    )
    free = np.ones(model.n_nodes, bool)
    free[model.node_sets["surface"]] = False
    free[model.node_sets.get("tumour", [])] = False
    return total / size.max(), free


def patch_residual(model):
    """Largest force off the surface relative to the largest of all, under an affine stretch by 20 %."""
    rows = part(
        model.points, model.hexahedra, model.domains, model.domain_gradients, model.domain_volumes, model.material
    )
    sub = localise(rows, HOURGLASS, 0.1, "mean")
    f = forces(sub, at(sub, rows.read("points") @ AFFINE.T))
    inner = np.ones(model.n_nodes, bool)
    inner[model.node_sets["surface"]] = False
    return np.abs(f[inner]).max() / np.abs(f).max()


VARIANTS = ["", 'weight = "quartic"\nnodes = 12', "basis = 10\nnodes = 18", "max_fe_nodes = 5\nmin_domains = 4"]


@pytest.mark.parametrize("cloud", ["core", "all"])
@pytest.mark.parametrize("support", VARIANTS)
def test_consistency_balances_constant_stress_and_keeps_affine_fields(tmp_path, support, cloud):
    """The patch test of the mixed mesh: constant stress gives no force at any node off the surface.

    The paper's support domains (consistency = false) fail it.
    """
    plain = model_of(tmp_path, f"{support}\nconsistency = false", cloud)
    balance, free = gradient_balance(plain)
    assert np.abs(balance[free]).max() > 1e-3
    model = model_of(tmp_path, support, cloud)
    balance, free = gradient_balance(model)
    assert free.sum() > 100
    # Sums of some hundred products.
    assert np.abs(balance[free]).max() < 100 * EPS
    assert model.figures.consistency_after < 100 * EPS
    assert model.figures.consistency_before > 1e-3
    changed = model.domain_gradients - plain.domain_gradients
    change = np.sqrt((changed**2).sum() / (plain.domain_gradients**2).sum())
    assert model.figures.consistency_change == pytest.approx(change, rel=1e-9)
    # Gradients of a domain as flat as may be are 20 times those of a cube: n times 20 eps in F, and lambda = 49 mu
    # times as much in the stress.
    assert patch_residual(model) < 18 * 20 * EPS * 49
    assert patch_residual(plain) > 1e-2
    # Affine fields: gradients of both, and nothing but the correction differs.
    for each in (plain, model):
        found = np.einsum("gai,gaj->gij", (each.points @ AFFINE.T)[each.domains], each.domain_gradients)
        assert np.abs(found - AFFINE).max() < 1e3 * EPS * np.sqrt(worst_condition(4))
    np.testing.assert_array_equal(model.domains, plain.domains)
    np.testing.assert_array_equal(model.domain_shapes, plain.domain_shapes)
    np.testing.assert_array_equal(model.mass, plain.mass)


def test_consistency_around_a_seed(tmp_path):
    more = "[tumour]\ncentre = [16.0, 14.0, 12.0]\nvolume = 100.0\nseed_radius = 1.5\n[cloud]\nradius = 9.0\n"
    model = model_of(tmp_path, more=more)
    balance, free = gradient_balance(model)
    assert np.abs(balance[free]).max() < 100 * EPS
    seed = model.node_sets["tumour"]
    assert np.abs(balance[seed]).max() > 1e-3  # the seed presses there
    assert (np.isin(model.domains, seed).sum(axis=1) <= model.domains.shape[1] // 2).all()


def test_a_cloud_without_a_node_is_refused(tmp_path):
    path = tmp_path / "block.toml"
    path.write_text(BLOCK.replace("[8, 7, 6]", "[3, 3, 3]").format(cloud="core", support=""))
    with pytest.raises(InputError, match=r"cloud: no node fits into .* lower cloud\.spacing"):
        build(load_deck(path))


def test_orphans_are_removed_from_the_model_and_counted(tmp_path):
    text = BLOCK.replace("[8, 7, 6]", "[2, 2, 1]").format(cloud="all", support="nodes = 4\nmin_domains = 1")
    path = tmp_path / "block.toml"
    path.write_text(text + "[cloud]\npoints_per_spacing = 1.0\n")
    model = build(load_deck(path))
    orphans = model.figures.orphans_removed
    assert orphans > 0
    assert any(f"{orphans} EFG nodes" in remark for remark in model.remarks)
    np.testing.assert_array_equal(np.unique(model.domains), np.arange(model.n_nodes))
    assert model.mass.min() > 0
    volume = 32e-3 * 28e-3 * 24e-3
    assert model.mass.sum() == pytest.approx(1000 * volume, rel=1e-12)
    assert model.figures.volume_m3 == pytest.approx(volume, rel=1e-12)
    for axis, name in enumerate(("x0", "y0", "z0")):
        assert np.abs(model.points[model.node_sets[name], axis]).max() == 0
