"""The bound of a cell's stiffness, on which step and masses rest, against the exact tangent of thousands of cells.

The tangent is that of the plain formulas in numpy, differentiated to round-off by complex steps. Half of the materials
are neo-Hookean and half are Mooney-Rivlin. No cell shares a node with another, except boxes of one run.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
import pytest
from scenes import step_of
from test_kernels import MODES, at, forces, no_domains, part

from mpitled.cells import hexahedra
from mpitled.laws import Law, Material, MooneyRivlin, NeoHookean
from mpitled.mesh import CORNERS, grid_points, structured_hexahedra
from mpitled.parallel.subdomain import Subdomain, localise
from mpitled.solver.stability_check import StabilityCheck

N, RUN = 3000, 4  # cells of each scene, and boxes of a run
N_MATERIALS = 60
#: Hourglass control is a share of lambda + 2 mu, but of no more than this many shear moduli.
LIMIT = 102.0


@dataclass(frozen=True)
class Cells:
    """Cells of one kind, and what the plain formulas need of them."""

    sub: Subdomain
    points: np.ndarray  # (n_nodes, 3), m
    nodes: np.ndarray  # (n, k)
    gradients: np.ndarray  # (n, k, 3), 1/m
    volumes: np.ndarray  # (n,), m^3
    law: tuple[np.ndarray, np.ndarray, np.ndarray]  # coefficients (n,) of the Mooney-Rivlin solid, Pa
    modes: np.ndarray  # (n, k, k), N/m: stiffness of hourglass control or stabilisation


# --- the code under test ---------------------------------------------------------------------------------------------


def pack(points, hexahedra, domains, material, materials, hourglass, stabilisation):
    """The subdomain that the kernels read; domains: their nodes, gradients and volumes."""
    return localise(part(points, hexahedra, *domains, material, materials=materials), hourglass, stabilisation, "mean")


def required(cells, u, tensor=None):
    """Sums (n_nodes,) at the nodes of the bounds of their cells' largest eigenvalues, N/m, for displacements u."""
    state, check = at(cells.sub, u), StabilityCheck(cells.sub)
    state.time_step = 2.0  # the mass of a stable step is dt^2 / 4 times the bound
    check.evaluate(state, step_of(cells.sub).terms, 1.0, tensor)
    return check.required[0]


def tensors(cells, u):
    """The bounds of support domains as a tensor (n, k, 3, 3) at each node, N/m."""
    tensor = np.zeros((6, cells.sub.n_nodes))
    assert not required(cells, u, tensor).any()
    return tensor[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(-1, 3, 3)[cells.nodes]


def in_runs(cells):
    """Whether the cells are boxes in runs."""
    return {packed.name for packed in cells.sub.packed} == {"voxel hexahedra"}


def bounds(cells, u):
    """The bound (n,) of each cell, N/m."""
    at_nodes = required(cells, u)[cells.nodes]
    if not in_runs(cells):
        assert np.array_equal(at_nodes, np.repeat(at_nodes[:, :1], at_nodes.shape[1], axis=1))
        return at_nodes[:, 0]
    near = at_nodes[:, 0].reshape(-1, RUN)  # of a box and the one before
    found = near.copy()
    for box in range(1, RUN):
        found[:, box] -= found[:, box - 1]
    return found.ravel()


# --- the plain formulas ----------------------------------------------------------------------------------------------


def stress(F, c10, c01, lam):
    """First Piola-Kirchhoff stress of the Mooney-Rivlin solid; with c01 = 0 of the neo-Hookean one."""
    C = np.swapaxes(F, 1, 2) @ F
    J, I1 = np.linalg.det(F), np.trace(C, axis1=1, axis2=2)
    slope = lam * (J - 1) - 2 * (c10 + 2 * c01) / J
    p, q, r = ((2 * number)[:, None, None] for number in (c10 + c01 * I1, c01, slope * J / 2))
    return p * F - q * F @ C + r * np.swapaxes(np.linalg.inv(F), 1, 2)


def moduli(F, law):
    """dP/dF (n, 9, 9)."""
    A = np.empty((len(F), 3, 3, 3, 3))
    for row, column in product(range(3), repeat=2):
        step = np.zeros((3, 3), complex)
        step[row, column] = 1e-20j
        A[..., row, column] = stress(F + step, *law).imag / 1e-20
    return A.reshape(-1, 9, 9)


def gradient(cells, u):
    """F (n, 3, 3)."""
    return np.eye(3) + np.einsum("eai,eaj->eij", u[cells.nodes], cells.gradients)


def tangent(cells, u):
    """Each cell's stiffness (n, 3 k, 3 k), N/m."""
    F, (n, k) = gradient(cells, u), cells.nodes.shape
    by_node = np.einsum("eaj,il->eijal", cells.gradients, np.eye(3)).reshape(n, 9, 3 * k)
    A = cells.volumes[:, None, None] * moduli(F, cells.law)
    modes = np.einsum("eab,ij->eaibj", cells.modes, np.eye(3)).reshape(n, 3 * k, 3 * k)
    return np.swapaxes(by_node, 1, 2) @ A @ by_node + modes


def formulas(cells, u):
    """The bounds as documented: of each cell (n,), and of support domains as tensors (n, k, 3, 3)."""
    F, B, (c10, c01, lam) = gradient(cells, u), cells.gradients, cells.law
    J = np.linalg.det(F)
    K = J[:, None, None] * np.swapaxes(np.linalg.inv(F), 1, 2)
    G = np.einsum("eij,eaj->eai", K, B)
    mu = 2 * (c10 + 2 * c01)
    q = np.abs(lam * (J - 1) - mu / J)
    of_F, of_K = (np.linalg.norm(tensor, axis=(1, 2)) for tensor in (F, K))
    along = cells.volumes * np.maximum(0, lam + mu / J**2)
    same = cells.volumes * (2 * c10 + c01 * (4 * of_F**2 + np.sqrt(8) * of_K) + q * np.sqrt(2) * of_F)
    modes = np.linalg.eigvalsh(cells.modes)[:, -1]
    lengths, of_B = np.linalg.norm(G, axis=2), np.linalg.norm(B, axis=2)
    rank_one = np.einsum("ea,eai,eaj->eaij", (along * lengths.sum(axis=1))[:, None] / lengths, G, G)
    isotropic = (same * of_B.sum(axis=1))[:, None] * of_B + modes[:, None]
    number = along * (G**2).sum((1, 2)) + same * (B**2).sum((1, 2)) + modes
    return number, rank_one + isotropic[..., None, None] * np.eye(3)


# --- random cells ----------------------------------------------------------------------------------------------------


def some_materials(rng, nus=(0.0, 0.499), laws=(NeoHookean, MooneyRivlin)):
    made: list[Law] = []
    for nu in [*nus, 0.3, 0.49, *rng.uniform(*nus, N_MATERIALS - 4)]:
        for law in laws:
            E = 10 ** rng.uniform(1, 5)
            c10, c01 = E * rng.uniform(0.05, 0.5, 2)
            lowest = c01 / (c10 + 3 * c01)  # where the volumetric term vanishes
            values = {"poissons_ratio": nu, "youngs_modulus": E}
            if law is MooneyRivlin:
                values = {"poissons_ratio": max(nu, 1.001 * lowest), "c10": c10, "c01": c01}
            made.append(law(**{key: float(value) for key, value in values.items()}))
    return tuple(Material(f"m{i}", law, 1000.0) for i, law in enumerate(made))


def of_materials(materials, material):
    """Coefficients of the Mooney-Rivlin solid, and lambda and mu of the undeformed solid, each (n,), of cells."""
    laws = [m.law for m in materials]
    rows = [
        (*(law.coefficients if isinstance(law, MooneyRivlin) else (law.mu / 2, 0.0, law.lam)), law.lam, law.mu)
        for law in laws
    ]
    *law, lam, mu = np.array(rows)[material].T
    return tuple(law), lam, mu


def hexahedron_cells(points, nodes, material, materials, hourglass):
    B, V = hexahedra.geometry(points, nodes)
    law, lam, mu = of_materials(materials, material)
    gamma = MODES - B @ (np.swapaxes(points[nodes], 1, 2) @ MODES)
    k = hourglass * np.minimum(lam + 2 * mu, LIMIT * mu) * V * (B**2).sum((1, 2)) / 8
    modes = k[:, None, None] * gamma @ np.swapaxes(gamma, 1, 2)
    sub = pack(points, nodes, no_domains(), material, materials, hourglass, 0.0)
    return Cells(sub, points, nodes, B, V, law, modes)


def boxes(rng, hourglass=0.04 / 9):
    """Runs of boxes whose edges are as 1 to 100 at most."""
    grid, run, n = grid_points((RUN, 1, 1), (RUN, 1, 1)), structured_hexahedra((RUN, 1, 1)), N // RUN
    points = (grid * 1e-3 * 10 ** rng.uniform(-1, 1, (n, 1, 3))).reshape(-1, 3)
    nodes = (run + len(grid) * np.arange(n)[:, None, None]).reshape(-1, 8)
    materials = some_materials(rng)
    material = np.repeat(rng.integers(len(materials), size=n), RUN)
    cells = hexahedron_cells(points, nodes, material, materials, hourglass)
    assert in_runs(cells)
    return cells


def distorted(rng, hourglass=0.04 / 9):
    """Hexahedra with corners moved by up to a third of an edge, then stretched and sheared."""
    corners = CORNERS + rng.uniform(-0.65, 0.65, (N, 8, 3))
    skew = np.eye(3) + rng.uniform(-1, 1, (N, 3, 3)) * rng.choice([0, 1], (N, 1, 1))
    skew *= 10 ** rng.uniform(-1, 1, (N, 1, 3)) * np.sign(np.linalg.det(skew))[:, None, None]
    points = (1e-3 * corners @ skew).reshape(-1, 3)
    nodes = np.arange(8 * N).reshape(-1, 8)
    nodes = nodes[np.setdiff1d(np.arange(N), hexahedra.check(points, nodes)[0])]
    used = np.unique(nodes)
    points, nodes = points[used], np.searchsorted(used, nodes)
    materials = some_materials(rng)
    return hexahedron_cells(points, nodes, rng.integers(len(materials), size=len(nodes)), materials, hourglass)


def domains(rng, n=8, stabilisation=0.1, gradients=None, **of_material):
    """Support domains with nodes at random, of radii from 0.1 to 10 mm, and gradients of the linear basis."""
    points = rng.normal(size=(N, n, 3)) * 1e-3 * 10 ** rng.uniform(-1, 1, (N, 1, 3))
    centred = points - points.mean(axis=1, keepdims=True)
    inverse = np.linalg.inv(np.swapaxes(centred, 1, 2) @ centred)
    B = centred @ inverse if gradients is None else gradients
    V, nodes, materials = (
        10 ** rng.uniform(-12, -8, N),
        np.arange(n * N).reshape(-1, n),
        some_materials(rng, **of_material),
    )
    material = rng.integers(len(materials), size=N)
    law, lam, mu = of_materials(materials, material)
    kappa = stabilisation * (lam + 2 * mu) * V * np.trace(inverse, axis1=1, axis2=2) / 8
    affine = 1 / n + centred @ inverse @ np.swapaxes(centred, 1, 2)
    points, modes = points.reshape(-1, 3), kappa[:, None, None] * (np.eye(n) - affine)
    sub = pack(points, no_domains()[0], (nodes, B, V), material, materials, 0.0, stabilisation)
    return Cells(sub, points, nodes, B, V, law, modes)


SCENES = {
    "boxes": boxes,
    "boxes without hourglass control": lambda rng: boxes(rng, 0.0),
    "distorted": distorted,
    "domains": domains,
    "domains of 13 nodes": lambda rng: domains(rng, 13),
    "domains without stabilisation": lambda rng: domains(rng, 8, 0.0),
    "auxetic domains": lambda rng: domains(rng, nus=(-0.9, 0.0), laws=(NeoHookean,)),
}


@cache
def deformed(name):
    """Cells of a scene, displacements (n_nodes, 3) that stretch them by e^5 at most, and which cells have J > 0.001."""
    rng = np.random.default_rng(17)
    cells = SCENES[name](rng)
    n = len(cells.nodes)
    turns = np.linalg.qr(rng.normal(size=(2, n, 3, 3)))[0]
    turns *= np.linalg.det(turns)[..., None, None]
    stretches = np.exp(rng.choice([0.01, 0.3, 1.0, 2.0], (n, 1)) * rng.normal(size=(n, 3)))
    F = turns[0] * stretches[:, None] @ turns[1]
    middle = cells.points[cells.nodes].mean(axis=1, keepdims=True)
    if in_runs(cells):
        F, middle = (np.repeat(some[::RUN], RUN, axis=0) for some in (F, middle))
    u = np.empty_like(cells.points)
    u[cells.nodes] = (cells.points[cells.nodes] - middle) @ np.swapaxes(F - np.eye(3), 1, 2)
    u *= 1 + rng.choice([0.0, 0.1], (len(u), 1)) * rng.uniform(-1, 1, u.shape)  # other modes than the affine
    proper = np.linalg.det(gradient(cells, u)) > 1e-3
    assert proper.sum() > 0.8 * n
    return cells, u, proper


# --- tests -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_no_cell_is_stiffer_than_its_bound(name):
    cells, u, proper = deformed(name)
    exact = np.linalg.eigvalsh(tangent(cells, u)[proper])[:, -1]
    share = exact / bounds(cells, u)[proper]
    print(f"{name}: {proper.sum()} cells, shares up to {share.max():.6f}, median {np.median(share):.2f}")
    assert share.max() <= 1 + 1e-12
    assert share.max() > 0.95


def tensor_shares(blocks, K):
    """The largest eigenvalue (n,) of K x = s M x, M of the blocks (n, k, 3, 3) at the nodes."""
    n, k = blocks.shape[:2]
    roots = np.linalg.inv(np.linalg.cholesky(blocks))
    scaled = np.einsum("eaij,eajbk->eaibk", roots, K.reshape(n, k, 3, k, 3), optimize=True)
    scaled = np.einsum("eaibk,eblk->eaibl", scaled, roots, optimize=True)
    return np.linalg.eigvalsh(scaled.reshape(n, 3 * k, 3 * k))[:, -1]


@pytest.mark.parametrize("name", [name for name in SCENES if "domains" in name])
def test_no_domain_is_stiffer_than_the_tensors_of_its_nodes(name):
    """Block-diagonal tensors less the tangent are positive semidefinite."""
    cells, u, proper = deformed(name)
    share = tensor_shares(tensors(cells, u)[proper], tangent(cells, u)[proper])
    print(f"{name}: {proper.sum()} domains, shares up to {share.max():.6f}, median {np.median(share):.2f}")
    assert share.max() <= 1 + 1e-9
    assert share.max() > 0.95


def test_a_bound_is_met_where_it_can_be():
    """Gradients along one direction, neo-Hookean, q = lambda (J - 1) - mu / J = 0: no inequality loses anything."""
    rng = np.random.default_rng(3)
    along, lengths = rng.normal(size=(N, 1, 3)), 10 ** rng.uniform(2, 3, (N, 8, 1)) * rng.choice([-1, 1], (N, 8, 1))
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    cells = domains(rng, 8, 0.0, lengths * along, nus=(0.01, 0.499), laws=(NeoHookean,))
    J = (1 + np.sqrt(1 + 8 * cells.law[0] / cells.law[2])) / 2
    u = np.zeros_like(cells.points)
    u[cells.nodes[:, 0]] = rng.normal(size=(N, 3)) / np.abs(lengths[:, 0])
    short = (J - np.linalg.det(gradient(cells, u)))[:, None] / lengths[:, 0]
    u[cells.nodes[:, 0]] += short * along[:, 0]
    K = tangent(cells, u)
    assert np.linalg.eigvalsh(K)[:, -1] == pytest.approx(bounds(cells, u), rel=1e-12)
    assert tensor_shares(tensors(cells, u), K) == pytest.approx(1, rel=1e-9)


@pytest.mark.parametrize("scene", [boxes, distorted])
def test_the_share_of_hourglass_control_is_its_largest_eigenvalue(scene):
    """So much of it that nothing else counts."""
    cells = scene(np.random.default_rng(4), 1e12)
    found = bounds(cells, np.zeros_like(cells.points))
    assert np.linalg.eigvalsh(cells.modes)[:, -1] == pytest.approx(found, rel=1e-9)


@pytest.mark.parametrize("name", SCENES)
def test_bounds_and_forces_are_those_of_the_formulas(name):
    """That no part of the bound is larger than it has to be; and the tangent is of the forces that act."""
    cells, u, proper = deformed(name)
    number, tensor = formulas(cells, u)
    assert bounds(cells, u)[proper] == pytest.approx(number[proper], rel=1e-9)
    if "domains" in name:
        error = np.abs(tensors(cells, u) - tensor).max((1, 2, 3)) / np.abs(tensor).max((1, 2, 3))
        assert error[proper].max() < 1e-9
    P = cells.volumes[:, None, None] * stress(gradient(cells, u), *cells.law)
    of_cells = P[:, None] @ cells.gradients[..., None]
    expected = np.zeros_like(u)
    np.add.at(expected, cells.nodes, of_cells[..., 0] + cells.modes @ u[cells.nodes])
    size = np.zeros(len(u))
    np.add.at(size, cells.nodes, np.abs(expected[cells.nodes]).max((1, 2))[:, None])
    found = np.abs(forces(cells.sub, at(cells.sub, u)) - expected) / size[:, None]
    assert found[cells.nodes[proper]].max() < 1e-9
