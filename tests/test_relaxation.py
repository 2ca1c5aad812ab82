"""Dynamic relaxation: masses that fall slowly, the end of a run, and the monitor that stops any run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import integrator_of
from test_kernels import HOURGLASS, box, cloud, no_domains, part

from mpitled import kernels
from mpitled.deck import Solver
from mpitled.errors import UnstableError
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import localise
from mpitled.solver.dynamic_relaxation import BETWEEN, CONVERGED_STEPS, MAX_MASS_DROP, STALL_CHECKS
from mpitled.solver.monitor import FIRST_JUDGED_STEP, Monitor

TOLERANCE = 1e-5  # m


def relaxation(rows):
    """Of a part on one rank."""
    sub = localise(rows, HOURGLASS, 0.1, "mean")
    return integrator_of(sub, Solver(method="dynamic-relaxation", tolerance=TOLERANCE))


def bar():
    """Hexahedra with one end held."""
    points, cells, material = box((6, 3, 2))
    held = np.flatnonzero(points[:, 0] == 0)
    dofs = (3 * held[:, None] + np.arange(3)).ravel()
    rows = part(points, cells, *no_domains(), material // 2, prescribed=(dofs, np.zeros(len(dofs))))
    return replace(rows, blocks=rows.blocks[:1])


def held_cloud():
    """Support domains with some nodes held in one or two directions."""
    points, domains, *measures = cloud(n=30)
    none = np.zeros((0, 8), np.int64)
    return part(points, none, domains, *measures, np.zeros(len(domains)), prescribed=([1, 7, 8, 30], np.zeros(4)))


def full(tensors):
    """(n, 3, 3) of scalars (1, n), or of the components (6, n) of symmetric tensors."""
    if len(tensors) == 1:
        return tensors[0][:, None, None] * np.eye(3)
    return tensors[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(-1, 3, 3)


@pytest.mark.parametrize(("rows", "diagonal"), [(bar(), [0]), (held_cloud(), [0, 3, 5])])
def test_masses_rise_at_once_and_fall_by_a_tenth_in_a_check(rows, diagonal):
    """Scalars of hexahedra and tensors of support domains, pulled to twice their length and let go."""
    method = relaxation(rows)
    assert MAX_MASS_DROP == 0.9
    assert len(method.mass) == diagonal[-1] + 1

    def masses(stretch):
        method.state.u[0, : method.sub.n_nodes] = (stretch - 1) * rows.read("points")[:, 0]
        method.check()
        return method.mass[diagonal].sum(axis=0)

    rest, pulled = masses(1.0).copy(), masses(2.0).copy()
    free = rest > 0
    assert np.array_equal(free, method.free.any(axis=0))
    assert (pulled[free] > 1.2 * rest[free]).all()
    masses_then = pulled
    for _ in range(30):
        now = masses(1.0).copy()
        expected = np.maximum(rest, MAX_MASS_DROP * masses_then)
        assert now == pytest.approx(expected, rel=1e-9)
        masses_then = now
    assert masses_then == pytest.approx(rest, rel=1e-9)
    mass, inverse = (full(tensor) for tensor in (method.mass, method.state.dt2_over_m))
    directions = method.free.T if len(diagonal) == 3 else np.repeat(free[:, None], 3, axis=1)
    assert inverse @ mass == pytest.approx(directions[:, :, None] * np.eye(3), abs=1e-9)


@pytest.mark.parametrize("components", [1, 6])
def test_norms_are_those_of_counted_dofs(components):
    rng, n = np.random.default_rng(9), 40
    u, u_prev, f, u_last, f_last = rng.normal(size=(5, 3, n))
    counted, (mass, inverse) = rng.random((3, n)) < 0.7, rng.uniform(1, 2, (2, components, n))
    v, d, of_f, before = counted * (u - u_prev), counted * (u - u_last), counted * f, f_last.copy()
    found = kernels.relaxation_norms(u, u_prev, f, mass, inverse, counted, u_last, f_last)
    mv, md, a = (np.einsum("nij,jn->in", full(of), vector) for of, vector in ((mass, v), (mass, d), (inverse, of_f)))
    sums = 0.5 * (v * mv).sum(), 0.5 * (v * of_f).sum(), (d * (of_f - before)).sum(), (d * md).sum()
    largest = (np.linalg.norm(vector, axis=0).max() for vector in (v, a))
    assert found == pytest.approx((*sums, *largest), rel=1e-12)
    assert np.array_equal(u_last, u)
    assert np.array_equal(f_last, of_f)


def decide(method, distance, lowest):
    """Whether the run ends at a check with these estimates."""
    figures = {"rayleigh_force": lowest, "rayleigh_mass": 1.0, "change": distance * lowest**0.5}
    return method.decide(figures | {"residual": 0.5 * distance * lowest})[1]


def test_an_estimate_that_grows_ends_nothing():
    """Though it is below the tolerance: a slower mode overtakes it. It ends as soon as the estimate shrinks."""
    method, lowest, distance = relaxation(bar()), 1e-4, 0.1 * TOLERANCE
    method.state.time = method.load_time
    for _ in range(2 * CONVERGED_STEPS // BETWEEN):
        distance *= 1.01
        assert not decide(method, distance, lowest)
    assert decide(method, 0.99 * distance, lowest)
    assert method.distance == pytest.approx(0.99 * distance)
    # Damping is critical: u+ = u + c1 (u - u_prev) - c2 lowest u has a double root.
    c1, c2 = method.state.c1, method.state.c2
    assert (1 + c1 - c2 * lowest) ** 2 == pytest.approx(4 * c1, abs=2 * lowest**2)
    # It holds for as many steps as are asked for.
    method.converged_steps, method.distance, calls = 0, 1.0, 1
    while not decide(method, 0.5 * TOLERANCE, lowest):
        calls += 1
    assert calls == CONVERGED_STEPS // BETWEEN
    assert not decide(method, 2 * TOLERANCE, lowest)


def test_it_stalls_only_after_the_load_and_while_neither_estimate_nor_slowest_mode_falls():
    method, lowest, distance = relaxation(bar()), 1e-3, 1.0
    method.begin()
    assert not any(decide(method, distance, lowest) for _ in range(STALL_CHECKS + 10))
    method.state.time = method.load_time
    for fall in (1.0, 0.95):
        for _ in range(STALL_CHECKS // 2 - 1):
            lowest, distance = max(1e-4, fall * lowest), 1.001 * distance
            assert not decide(method, distance, lowest)
    calls = 1
    while not decide(method, distance, lowest):
        calls += 1
    assert STALL_CHECKS / 3 < calls < STALL_CHECKS


def test_a_run_is_stopped_by_a_turned_cell_by_energies_that_do_not_add_up_and_by_numbers_that_are_none():
    method = relaxation(bar())
    method.state.time, method.state.step = 0.5 * method.load_time, FIRST_JUDGED_STEP
    monitor = Monitor(World(), method, 1e-6, "scene", "remedy")
    well = dict.fromkeys(("hourglass", "stabilisation", "kinetic", "added", "dissipated"), 0.0)
    well |= {"external": 1.0, "strain": 1.0, "min_jacobian": 1e-3, "step_ratio": 0.8}

    def check(**changed):
        method.check = lambda: well | changed
        monitor.update(0)

    check()
    check(external=1.05)  # 5 % of the largest energy
    for changed, reason in (
        ({"min_jacobian": 0.0}, "a cell is turned inside out"),
        ({"external": 1.06}, "energy balance is wrong by 5.7%"),
        ({"strain": np.nan}, "diverged"),
    ):
        with pytest.raises(UnstableError, match=reason):
            check(**changed)
    method.state.step = FIRST_JUDGED_STEP - 1
    check(external=2.0)
