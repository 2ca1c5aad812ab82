"""The kernels against the paper's plain formulas in numpy, with cells of two laws, and their conservation laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import step_of

from mpitled import kernels
from mpitled.cells import hexahedra
from mpitled.cells.kind import HEXAHEDRA, SUPPORT_DOMAINS
from mpitled.laws import Material, MooneyRivlin, NeoHookean, first_piola, strain_energy
from mpitled.mesh import CORNERS, grid_points, structured_hexahedra
from mpitled.model import CellBlock
from mpitled.model.loading import loading_curve
from mpitled.parallel.subdomain import cell_costs, localise
from mpitled.solver.stability_check import StabilityCheck
from mpitled.store import PartBlock, PartRows
from mpitled.terms import State, apply

BRAIN = Material("brain", NeoHookean(youngs_modulus=3000.0, poissons_ratio=0.49), 1000.0)
SOFT = Material("soft", MooneyRivlin(c10=1.5, c01=0.5, poissons_ratio=0.25), 1000.0)
HOURGLASS = 0.04 / 9
R, S, T = CORNERS.T
MODES = np.stack([R * S, S * T, R * T, R * S * T], axis=1)


def part_block(kind, first, columns):
    """The cells of a block, all on the only part, in the order of their own numbers."""
    n, k = columns["nodes"].shape
    columns = {"cells": np.arange(first, first + n)} | columns
    return PartBlock(kind.name, kind, k, n, n, first, lambda name, first, last: columns[name][first:last])


def column(rows, kind, name="nodes"):
    """A column of the cells of a kind."""
    return np.concatenate([block.read(name) for block in rows.of_kind(kind.name)])


def part(points, cells, domains, gradients, volumes, material, prescribed=((), ()), materials=None):
    """A whole model as the only part, in the order of its own numbers."""
    n, n_domains = len(points), len(domains)
    columns = {
        "points": points,
        "mass": np.ones(n),
    }
    of_cloud = {"volumes": volumes, "gradients": gradients, "shapes": np.full(domains.shape, 1 / 8)}
    material = np.asarray(material, np.int16)
    nothing = np.zeros(0, np.int64)
    return PartRows(
        n_parts=1,
        part=0,
        n_nodes=n,
        n_fe_nodes=n if not n_domains else len(np.unique(cells)),
        blocks=(
            part_block(HEXAHEDRA, 0, {"nodes": cells, "material": material[: len(cells)]}),
            part_block(SUPPORT_DOMAINS, len(cells), {"nodes": domains, "material": material[len(cells) :]} | of_cloud),
        ),
        field_block="",
        nodes=np.arange(n),
        owned=np.ones(n, bool),
        first_row=0,
        materials=materials or (BRAIN, SOFT),
        prescribed_dofs=np.asarray(prescribed[0], np.int64),
        prescribed_displacements=np.asarray(prescribed[1], float),
        rotation_paths=np.zeros((len(prescribed[1]), 3)),
        field_nodes=nothing,
        field_domains=nothing,
        field_shapes=np.zeros((0, 8)),
        neighbours=nothing.astype(np.int32),
        shared=nothing,
        shared_offsets=np.zeros(1, np.int64),
        source=lambda name, first, last: columns[name][first:last],
    )


def no_domains():
    return np.zeros((0, 8), np.int64), np.zeros((0, 8, 3)), np.zeros(0)


def box(shape=(37, 3, 2), edge=2e-3, distortion=0.0, seed=0):
    points = grid_points(shape, tuple(edge * n for n in shape))
    points += np.random.default_rng(seed).uniform(-distortion, distortion, points.shape) * edge
    cells = structured_hexahedra(shape)
    material = (np.arange(len(cells)) // 60) % 2  # changes within a line of 37
    return points, cells, material


def cloud(n=90, n_domains=53, per_domain=8, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 0.01, (n, 3))
    domains = np.array([rng.choice(n, per_domain, replace=False) for _ in range(n_domains)])
    centred = points[domains] - points[domains].mean(axis=1, keepdims=True)
    gradients = centred @ np.linalg.inv(np.einsum("gai,gaj->gij", centred, centred))
    return points, domains, gradients, rng.uniform(0.5, 1.5, n_domains) * 1e-9


def plain(rows, u, stabilisation, rule="mean", hourglass=HOURGLASS):
    """Forces, strain energy, energy of the stabilised modes and J by the paper's formulas, one array operation each."""
    f = np.zeros_like(u)
    strain = resisted = 0.0
    J = []
    lam = np.array([m.lam for m in rows.materials])[rows.read("material")]
    mu = np.array([m.mu for m in rows.materials])[rows.read("material")]
    n = rows.n_own("hexahedra")
    kinds = []
    if n:
        B, V = hexahedra.geometry(rows.read("points"), column(rows, HEXAHEDRA), rule)
        x = rows.read("points")[column(rows, HEXAHEDRA)]
        gamma = MODES - np.einsum("eai,ebi,bm->eam", B, x, MODES)
        k = hourglass * (lam[:n] + 2 * mu[:n]) * V * (B**2).sum((1, 2)) / 8
        kinds.append((column(rows, HEXAHEDRA), B, V, k, np.einsum("eam,ebm->eab", gamma, gamma), slice(0, n)))
    if rows.n_own("support domains"):
        B, V = column(rows, SUPPORT_DOMAINS, "gradients"), column(rows, SUPPORT_DOMAINS, "volumes")
        x = rows.read("points")[column(rows, SUPPORT_DOMAINS)]
        P = np.concatenate([np.ones((*x.shape[:2], 1)), x - x.mean(1, keepdims=True)], axis=2)
        Q = np.eye(x.shape[1]) - P @ np.linalg.inv(np.swapaxes(P, 1, 2) @ P) @ np.swapaxes(P, 1, 2)
        linear = (x - x.mean(1, keepdims=True)) @ np.linalg.inv(np.einsum("gai,gaj->gij", P[..., 1:], P[..., 1:]))
        k = stabilisation * (lam[n:] + 2 * mu[n:]) * V * (linear**2).sum((1, 2)) / 8
        kinds.append((column(rows, SUPPORT_DOMAINS), B, V, k, Q, slice(n, None)))
    for nodes, B, V, k, Q, these in kinds:
        X = np.eye(3) + np.einsum("eai,eaj->eij", u[nodes], B)
        P, W = np.empty_like(X), np.empty(len(X))
        for number, m in enumerate(rows.materials):
            own = rows.read("material")[these] == number
            P[own], W[own] = first_piola(m.law, X[own]), strain_energy(m.law, X[own])
        modes = k[:, None, None] * np.einsum("eab,ebi->eai", Q, u[nodes])
        np.add.at(f, nodes, V[:, None, None] * np.einsum("eij,eaj->eai", P, B) + modes)
        strain += V @ W
        resisted += 0.5 * (modes * u[nodes]).sum()
        J.append(np.linalg.det(X))
    return f, strain, resisted, np.concatenate(J)


def at(sub, u):
    """A state with these displacements (n, 3)."""
    state = State.at_rest(sub, 1.0, 1e-4)
    state.u[:, : len(u)] = u.T
    return state


def forces(sub, state):
    step_of(sub).apply_forces(state)
    return state.f[:, : sub.n_nodes].T


SCENES = {
    "voxels": lambda: part(*box()[:2], *no_domains(), box()[2]),
    "voxels along y": lambda: turned(1),
    "voxels along z": lambda: turned(2),
    "distorted along z": lambda: turned(2, 0.15),
    "distorted": lambda: part(*box(distortion=0.15)[:2], *no_domains(), box()[2]),
    "voxels and distorted": lambda: mixed_shapes(),
    "domains": lambda: all_domains(8),
    "domains of 13 nodes": lambda: all_domains(13),
}


def turned(axis, distortion=0.0):
    """Bricks whose nodes follow each other along another axis than x."""
    points, cells, material = box(distortion=distortion)
    order = [CORNERS.tolist().index(np.roll(corner, -axis).tolist()) for corner in CORNERS]
    return part(np.roll(points * [1.0, 0.7, 1.5], axis, axis=1), cells[:, order], *no_domains(), material)


def mixed_shapes():
    points, cells, material = box()
    points[:40] += np.random.default_rng(3).uniform(-2e-4, 2e-4, (40, 3))
    return part(points, cells, *no_domains(), material)


def all_domains(n):
    points, domains, gradients, volumes = cloud(per_domain=n)
    return part(points, np.zeros((0, 8), np.int64), domains, gradients, volumes, np.arange(len(domains)) % 2)


@pytest.mark.parametrize("rule", ["mean", "centre"])
@pytest.mark.parametrize("stabilisation", [0.0, 0.1])
@pytest.mark.parametrize("scene", SCENES)
def test_forces_energies_and_jacobians_are_those_of_the_plain_formulas(scene, stabilisation, rule):
    rows = SCENES[scene]()
    sub = localise(rows, HOURGLASS, stabilisation, rule)
    kinds = {cells.name for cells in sub.packed}
    assert ("voxel hexahedra" in kinds) == ("voxels" in scene)
    assert ("hexahedra" in kinds) == ("distorted" in scene)
    u = np.random.default_rng(1).normal(size=rows.read("points").shape) * 1e-4
    expected, strain, resisted, J = plain(rows, u, stabilisation, rule)
    state = at(sub, u)
    found = forces(sub, state).copy()
    # Sums of some 50 products of each cell, and of 8 to 20 cells a node: tens of roundings.
    assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()
    least = state.smallest_jacobian
    assert least == pytest.approx(J.min(), rel=1e-14)
    forces(sub, at_rest_again := replace(state, u=0 * state.u, u_cells=0 * state.u))
    assert at_rest_again.smallest_jacobian == least  # of all steps
    seen = StabilityCheck(sub)
    figures = seen.evaluate(state, step_of(sub).terms, 1.0)
    assert seen.jacobian[:-1] == pytest.approx(J, rel=2.0**-23)  # as it is kept
    assert figures["strain"] == pytest.approx(strain, rel=1e-10)  # W is a small difference of (J - 1) and ln J
    assert figures["hourglass"] + figures["stabilisation"] == pytest.approx(resisted, rel=1e-12)


def test_nodes_behind_a_run_are_no_cell():
    """Stretched by an edge, a line's last node and the next line's first would be a cell of no volume."""
    edge = 2.0**-9
    points, cells, _ = box((6, 3, 2), edge)
    rows = part(points, cells, *no_domains(), np.zeros(len(cells), np.int64))
    u = points * [1 / 6, 0.0, 0.0]
    sub = localise(rows, HOURGLASS, 0.0, "mean")
    assert [cells.name for cells in sub.packed] == ["voxel hexahedra"]
    state = at(sub, u)
    found = forces(sub, state)
    expected = plain(rows, u, 0.0)[0]
    assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()
    assert state.smallest_jacobian == 1.0  # that of rest: no cell is compressed


@pytest.mark.parametrize("scene", SCENES)
def test_cells_cost_by_what_computes_them(scene):
    rows = SCENES[scene]()
    sub = localise(rows.with_columns(material=0 * rows.read("material")), HOURGLASS, 0.1, "mean")
    blocks = [CellBlock(block.name, block.kind, block.read("nodes"), block.read("material")) for block in rows.blocks]
    costs = cell_costs(rows.read("points"), blocks)
    in_runs = sum(cells.n_cells for cells in sub.packed if cells.name == "voxel hexahedra")
    of_domain = SUPPORT_DOMAINS.node_cost * column(rows, SUPPORT_DOMAINS).shape[1]
    expected = (
        [1.0] * in_runs
        + [8 * HEXAHEDRA.node_cost] * (rows.n_own("hexahedra") - in_runs)
        + [of_domain] * rows.n_own("support domains")
    )
    assert sorted(costs) == sorted(expected)


@pytest.mark.parametrize("scene", SCENES)
def test_forces_are_the_gradient_of_the_energies(scene):
    rows = SCENES[scene]()
    sub = localise(rows, HOURGLASS, 0.1, "mean")
    rng = np.random.default_rng(2)
    u, direction = rng.normal(size=(2, *rows.read("points").shape)) * 1e-4

    def energy(step):
        figures = StabilityCheck(sub).evaluate(at(sub, u + step * direction), step_of(sub).terms, 1.0)
        return figures["strain"] + figures["hourglass"] + figures["stabilisation"]

    h = 1e-3
    slope = (8 * (energy(h) - energy(-h)) - (energy(2 * h) - energy(-2 * h))) / (12 * h)
    # Truncation h^4 times fifth derivatives of order one, rounding 1e-16 / h.
    assert slope == pytest.approx((forces(sub, at(sub, u)) * direction).sum(), rel=1e-9)


@pytest.mark.parametrize("scene", SCENES)
def test_no_force_from_rigid_motion_and_no_moment_from_any(scene):
    rows = SCENES[scene]()
    sub = localise(rows, HOURGLASS, 0.1, "mean")
    rng = np.random.default_rng(4)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    rigid = rows.read("points") @ turn.T - rows.read("points") + [1e-3, 2e-3, -3e-3]
    wild = rng.normal(size=rows.read("points").shape) * 1e-4
    f = forces(sub, at(sub, wild)).copy()
    scale = np.abs(f).sum()
    assert np.abs(forces(sub, at(sub, rigid))).max() < 1e-12 * scale
    assert np.abs(f.sum(axis=0)).max() < 1e-14 * scale
    reach = np.abs(rows.read("points")).max()
    # Hourglass and stabilising forces act along the reference frame: their moment about reference positions vanishes.
    # The moment of the stress vanishes about present positions.
    moment = np.cross(rows.read("points") + wild, f).sum(axis=0)
    modes = np.cross(wild, f - plain(rows, wild, 0.0, hourglass=0.0)[0]).sum(axis=0)
    assert np.abs(moment - modes).max() < 1e-13 * scale * reach


def test_a_step_allocates_nothing():
    """Every array of a step is there before it: numpy makes none of a node's or a cell's size in a thousand steps."""
    import tracemalloc

    points, cells, _ = box((60, 12, 12))
    points[:40] += 1e-5
    sub = localise(part(points, cells, *no_domains(), np.zeros(len(cells))), HOURGLASS, 0.1, "mean")
    terms, state = step_of(sub).terms, State.at_rest(sub, 1.0, 1e-5)
    apply(state, terms)
    tracemalloc.start()
    for _ in range(1000):
        apply(state, terms)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 * sub.n_nodes  # less than one nodal array of one component


def test_raised_masses_bring_their_kinetic_energy():
    rng, n, dt = np.random.default_rng(7), 40, 1e-3
    (u, u_prev), (m, required) = rng.normal(size=(2, 3, n)), rng.uniform(1, 2, (2, n))
    counted, dt2_over_m = rng.random(n) < 0.7, dt**2 / m
    added, energy = kernels.raise_mass(u, u_prev, dt2_over_m, required, counted, dt)
    more = counted * np.maximum(0, required - m)
    assert added == pytest.approx(more.sum(), rel=1e-12)
    assert energy == pytest.approx(0.5 * (more * ((u - u_prev) / dt) ** 2).sum(), rel=1e-12)
    assert dt2_over_m == pytest.approx(dt**2 / np.maximum(m, required), rel=1e-12)


def test_steps_of_any_length_follow_a_constant_acceleration_and_the_load():
    """u = a t^2 / 2 at free dofs, where the central difference is exact; prescribed dofs are where the load is then."""
    points, cells, _ = box((1, 1, 1), 1.0)
    rows = part(points, cells, *no_domains(), np.zeros(1), prescribed=(np.arange(3), [0.0, 0.1, 0.2]))
    sub = localise(rows, HOURGLASS, 0.0, "mean")
    state, (update,) = State.at_rest(sub, 4.0, 1.0), step_of(sub).update
    for ratio in (1.0, 0.5, 1.4):
        state.time_step *= ratio
        state.dt2_over_m[:] = state.time_step**2  # of masses of 1 kg
        state.f[:] = -2.0
        kernels.change_step(state.u, state.u_prev, state.f, state.dt2_over_m, ratio)
        update.apply(state)
        if state.step == 1:
            state.u_prev[:, : sub.n_nodes], state.u[:, : sub.n_nodes] = 0, 1.0  # begins at rest a step before
        assert state.u[:, 1 : sub.n_nodes] == pytest.approx(state.time**2, rel=1e-12)
    assert state.u[:, 0] == pytest.approx(loading_curve(state.time / 4.0) * np.array([0.0, 0.1, 0.2]), rel=1e-12)


def test_kinetic_energy_is_that_of_the_middle_of_two_half_steps_but_at_prescribed_dofs():
    """There it is that of the last half step, because the forces do not move them."""
    rng, n, dt = np.random.default_rng(6), 40, 1e-3
    u, u_prev, f = rng.normal(size=(3, 3, n + kernels.PADDING))
    m, counted, prescribed = rng.uniform(1, 2, n), rng.random(n) < 0.7, rng.random((3, n)) < 0.3
    held = np.flatnonzero(prescribed.T.ravel()).astype(np.uint32)
    velocity = (u - u_prev)[:, :n] / dt - np.where(prescribed, 0, 0.5 * dt * 1e6 * f[:, :n] / m)
    found = kernels.kinetic_energy(u, u_prev, 1e6 * f, dt**2 / m, counted, held)
    assert found == pytest.approx(0.5 * (counted * m * velocity**2).sum(), rel=1e-12)


def test_a_power_iteration_sums_over_owned_nodes():
    rng, n, reach, size = np.random.default_rng(8), 40, 1e-3, 0.7
    mode, f, at_rest = rng.normal(size=(3, 3, n))
    dt2_over_m, owned, renewed = rng.uniform(1, 2, (1, n)), rng.random(n) < 0.7, mode.copy()
    old, new, largest = kernels.power_iteration(renewed, f, at_rest, dt2_over_m, owned, reach, size)
    response = (f - at_rest) / reach
    assert renewed == pytest.approx(dt2_over_m * response, rel=1e-12)
    assert old == pytest.approx((response * mode)[:, owned].sum() / size, rel=1e-12)
    assert new == pytest.approx((response * renewed)[:, owned].sum(), rel=1e-12)
    assert largest == np.abs(renewed).max()
