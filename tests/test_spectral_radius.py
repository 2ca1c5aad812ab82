"""The step that `auto` takes against the true limit of stability, found by bisection, in scenes of every kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import integrator_of

from mpitled import job, store
from mpitled.deck import load_deck, model_key
from mpitled.model import build as model_build
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import localise
from mpitled.terms import apply

TISSUE = """
[material.tissue]
youngs_modulus = 3000.0
poissons_ratio = {nu}
[[fixed]]
nodes = "{fixed}"
"""
BLOCK = """
[block]
size = {size}
elements = [6, 6, 6]
cloud = "{cloud}"
[cloud]
spacing = 3.0
"""
ELLIPSOID = """
[ellipsoid]
semi_axes = [24.0, 20.0, 18.0]
element_size = 5.0
cloud = "{cloud}"
"""
TUMOUR = """
[tumour]
centre = [3.0, 0.0, 0.0]
volume = 150.0
surface_nodes = 100
[cloud]
growth = 0.4
"""
#: In which a disturbance grows by e^38 even where the step is 0.3 % too long: by exp(2 acosh(1.003)) at each.
STEPS = 250
STRETCHES = {
    "": np.eye(3),
    "extended": np.diag([1.5, 0.82, 0.82]),
    "compressed": np.diag([1.25, 1.25, 0.65]),
    "sheared": np.array([[1.0, 0.8, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
}


def scenes():
    """Name, deck, share by which inner nodes are moved at random, stretch of the whole body."""

    def block(cloud="none", size=(30.0, 30.0, 30.0), nu=0.49, more="", fixed="z0"):
        return BLOCK.format(cloud=cloud, size=list(size)) + TISSUE.format(nu=nu, fixed=fixed) + more

    def ellipsoid(cloud, more=TUMOUR):
        return ELLIPSOID.format(cloud=cloud) + TISSUE.format(nu=0.49, fixed="surface") + more

    stiff = block("core").replace("poissons_ratio = 0.49", 'poissons_ratio = 0.49\ncells = ["cloud"]')
    stiff += '[material.stiff]\nyoungs_modulus = 3e6\npoissons_ratio = 0.3\ncells = ["hexahedra"]\n'
    yield "hexahedra", block(), 0, ""
    for nu in (0.0, 0.3, 0.499):
        yield f"hexahedra, nu {nu}", block(nu=nu), 0, ""
    yield "flat hexahedra", block(size=(30, 30, 3)), 0, ""
    yield "needles", block(size=(30, 3, 3)), 0, ""
    yield "no hourglass control", block(more="[hexahedra]\nhourglass = 0.0\n"), 0, ""
    for share in (0.1, 0.2, 0.3):
        yield f"hexahedra distorted by {share}", block(), share, ""
    for stretch in ("extended", "compressed", "sheared"):
        # Held all around, for what is free buckles, and that grows at every step.
        yield f"hexahedra {stretch}", block(fixed="surface"), 0, stretch
        yield f"distorted hexahedra {stretch}", block(fixed="surface"), 0.2, stretch
        yield f"mixed {stretch}", block("core", fixed="surface"), 0, stretch
    yield "support domains", block("all"), 0, ""
    for n in (8, 20):
        yield f"support domains of {n} nodes", block("all", more=f"[support]\nnodes = {n}\n"), 0, ""
    for s in (0.0, 0.5):
        yield f"support domains, stabilisation {s}", block("all", more=f"[support]\nstabilisation = {s}\n"), 0, ""
    yield "mixed", block("core"), 0, ""
    yield "mixed, a thousand times as stiff outside", stiff, 0, ""
    yield "tumour, hexahedra", ellipsoid("none"), 0, ""
    yield "tumour, mixed", ellipsoid("core"), 0, ""
    yield "tumour, support domains", ellipsoid("all"), 0, ""


def subdomain(tmp_path, text, share):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    deck = load_deck(path)
    mesh = model_build.read_mesh(deck)
    if share:
        inner = np.setdiff1d(np.arange(mesh.n_nodes), mesh.node_sets["surface"])
        shifts = np.random.default_rng(1).uniform(-share, share, (len(inner), 3))
        points = mesh.points.copy()
        points[inner] += shifts * np.ptp(points, axis=0) / 6
        mesh = replace(mesh, points=points)
    model = model_build.discretise(deck, mesh)
    store.write_model(tmp_path / "model.h5", model, model_key(deck))
    rows = store.read_part(tmp_path / "model.h5", 1, 0)
    sub = localise(rows, deck.hexahedra.hourglass, deck.support.stabilisation, deck.hexahedra.gradient)
    return deck, sub, store.read_figures(tmp_path / "model.h5")


def grows(method, mobility, ratio):
    """Whether a disturbance grows when every step is `ratio` times as long as the mobility has it."""
    n, s = method.sub.n_nodes, method.state
    start, free = s.u[:, :n].copy(), method.sub.free()
    tensors = mobility if len(mobility) == 6 else mobility * np.array([1.0, 0, 0, 1.0, 0, 1.0])[:, None]

    def force():
        s.f[:] = 0
        method.step.apply_forces(s)
        return s.f[:, :n].copy()

    s.u[:, :n] = start
    at_start = force()
    size = 1e-9 * np.ptp(method.sub.rows.read("points"))
    now = before = np.random.default_rng(0).uniform(-size, size, (3, n)) * free
    try:
        for _ in range(STEPS):
            s.u[:, :n] = start + now
            f = (force() - at_start) * free * ratio**2
            m = tensors
            moved = np.stack([
                m[0] * f[0] + m[1] * f[1] + m[2] * f[2],
                m[1] * f[0] + m[3] * f[1] + m[4] * f[2],
                m[2] * f[0] + m[4] * f[1] + m[5] * f[2],
            ])  # fmt: skip
            now, before = 2 * now - before - moved * free, now
            if np.abs(now).max() > 1000 * size:
                return True
        return False
    finally:
        s.u[:, :n] = start


def longest_stable(method, mobility):
    """The true limit, in steps of the mobility: between two steps that are and are not stable, within 1 %."""
    low, high = 0.5, 2.0
    assert not grows(method, mobility, low)
    while not grows(method, mobility, high):
        low, high = high, 2 * high
        assert high <= 64
    while high / low > 1.01:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if grows(method, mobility, middle) else (middle, high)
    return low


def test_auto_is_never_above_the_limit_and_mostly_near_it(tmp_path):
    shares = {}
    for name, text, share, stretch in scenes():
        deck, sub, figures = subdomain(tmp_path, text, share)
        place = (sub.rows.read("points") @ (STRETCHES[stretch] - np.eye(3)).T).T
        for kind in ("dynamic", "quasi-static", "dynamic-relaxation"):
            method = integrator_of(sub, deck.solver.model_copy(update={"method": kind}), figures)
            method.state.u[:, : sub.n_nodes] = place
            method.begin()
            method.check()
            shares[f"{name}, {kind}"] = 1 / longest_stable(method, method.state.dt2_over_m)
    for name, value in shares.items():
        print(f"{value:.3f} {name}")
    values = np.array(list(shares.values()))
    assert len(values) >= 20
    assert values.max() < 0.9  # of the limit, with a safety of 0.8
    assert np.median(values) >= 0.7


@pytest.mark.parametrize("kind", ["quasi-static", "dynamic-relaxation"])
@pytest.mark.parametrize("cloud", ["none", "core"])
def test_the_limit_is_followed_while_a_tumour_grows(tmp_path, cloud, kind):
    """At the end of growth the masses still hold a step of 0.8 of the limit, though the bound has grown 20-fold."""
    text = ELLIPSOID.format(cloud=cloud) + TISSUE.format(nu=0.49, fixed="surface") + TUMOUR
    deck, sub, figures = subdomain(tmp_path, text.replace("150.0", "600.0"), 0)
    # Slow enough that no cell is crushed on the way: that is a state which no step makes stable.
    changes = {"method": kind, "load_time": 0.5, "load_steps": 300}
    method = integrator_of(sub, deck.solver.model_copy(update=changes), figures)
    method.begin()
    step, last, limits = method.step, False, []
    apply(method.state, (*step.forces, *step.work))
    while not last and method.state.share < 1:
        figures = method.check()
        if method.state.share > 0.2 * len(limits):
            limits.append(1 / longest_stable(method, method.state.dt2_over_m))
            step.apply_forces(method.state)
        _, last = method.decide(figures)
        for _ in range(method.between):
            apply(method.state, step.cycle)
    print(limits)
    assert len(limits) >= 5
    assert max(limits) < 1


def test_a_stiffer_mode_that_comes_up_elsewhere_is_found(tmp_path):
    """Next to a seed that grows to 7.5 times its radius; begun from the last mode the iteration misses it at 33 %."""
    deck = ELLIPSOID.format(cloud="none").replace("[24.0, 20.0, 18.0]", "[30.0, 30.0, 30.0]")
    deck += "[tumour]\ncentre = [0.0, 0.0, 0.0]\nvolume = 14137.167\n" + TISSUE.format(nu=0.49, fixed="surface")
    deck += '[solver]\nmethod = "quasi-static"\nload_time = 0.5\n[output]\nframes = 1\npictures = false\n'
    (tmp_path / "scene.toml").write_text(deck)
    report = job.run(load_deck(tmp_path / "scene.toml"), tmp_path, World(), quiet=True)
    assert report["min_jacobian"] > 0.8


@pytest.mark.parametrize("kind", ["quasi-static", "dynamic", "dynamic-relaxation"])
def test_the_iteration_leaves_the_forces_of_the_displacements(tmp_path, kind):
    """To the bit: a run that is continued begins with forces made anew."""
    deck, sub, figures = subdomain(
        tmp_path, BLOCK.format(size=[30.0] * 3, cloud="core") + TISSUE.format(nu=0.49, fixed="z0"), 0.1
    )
    method = integrator_of(sub, deck.solver.model_copy(update={"method": kind}), figures)
    method.begin()
    s = method.state
    if kind != "dynamic-relaxation":  # nodes without a free dof need no mass for stability
        held = ~sub.free().any(axis=0)
        assert held.any()
        assert s.dt2_over_m[held] == pytest.approx(s.time_step**2 / sub.rows.read("mass")[held], rel=1e-12)
    # Displacements are smaller than those that the iteration tries, m.
    s.set_displacement(np.random.default_rng(0).normal(scale=1e-14, size=(3, sub.n_nodes)))
    method.step.apply_forces(s)
    before = s.u.copy()
    method.spectral_radius.next_step = 0
    method.decide(method.check())
    assert not np.array_equal(s.u, before)  # the iteration tries modes in place
    left = s.f.copy()
    s.f[:] = 0
    method.step.apply_forces(s)
    assert np.array_equal(s.f, left)
