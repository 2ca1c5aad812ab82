"""The rate at which displacements converge with the mesh, on a field that solves Navier's equation exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from conftest import ROOT, mpitled
from scenes import integrator_of

from mpitled import store
from mpitled.deck import load_deck
from mpitled.model import build as model_build
from mpitled.parallel.subdomain import localise
from mpitled.results import compare
from mpitled.terms import apply

SIZE = 0.06  # m
BLOCK = """
[block]
size = [60.0, 60.0, 60.0]
elements = [{n}, {n}, {n}]
cloud = "{cloud}"
[support]
consistency = {consistency}
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[fixed]]
nodes = "surface"
[solver]
load_steps = 50
"""
#: Strains are of this size: the law is linear, and what is not is smaller by that factor.
STRAIN = 1e-6


def exact(points):
    """grad(sin ax sin by sinh cz), c^2 = a^2 + b^2: neither divergence nor curl, so no body force whatever nu."""
    a, b = 2.0 / SIZE, 2.5 / SIZE
    c = np.hypot(a, b)
    x, y, z = points.T
    u = np.stack(
        [
            a * np.cos(a * x) * np.sin(b * y) * np.sinh(c * z),
            b * np.sin(a * x) * np.cos(b * y) * np.sinh(c * z),
            c * np.sin(a * x) * np.sin(b * y) * np.cosh(c * z),
        ],
        axis=1,
    )
    return STRAIN * u / (c * c * np.sinh(c * SIZE))


def distorted(points):
    """A smooth map of the block onto itself, so that cells are neither boxes nor equal."""
    x, y, z = points.T / SIZE
    bump = 0.2 * SIZE * np.sin(np.pi * x) * np.sin(np.pi * y) * np.sin(np.pi * z)
    return points + bump[:, None] * [0.7, -0.5, 0.6]


def error(folder, n, cloud, consistency="true"):
    """Root mean square over all free nodes of the error of the field, as a share of that of the field itself."""
    path = folder / "scene.toml"
    path.write_text(BLOCK.format(n=n, cloud=cloud, consistency=consistency))
    deck = load_deck(path)
    mesh = model_build.read_mesh(deck)
    if cloud == "none":
        mesh = replace(mesh, points=distorted(mesh.points))
    model = model_build.discretise(deck, mesh)
    surface = model.prescribed_dofs[::3] // 3
    model = replace(model, prescribed_displacements=exact(model.points[surface]).ravel())
    store.write_model(folder / "model.h5", model, "")
    rows = store.read_part(folder / "model.h5", 1, 0)
    sub = localise(rows, deck.hexahedra.hourglass, deck.support.stabilisation, "mean")
    tolerance = 1e-5 * STRAIN * SIZE
    relaxation = integrator_of(sub, deck.solver.model_copy(update={"tolerance": tolerance}))
    u = relaxed(relaxation)
    if len(model.field_domains):
        at = u[model.domains[model.field_domains]]
        u[model.n_fe_nodes :] = np.einsum("na,nai->ni", model.field_shapes, at)
    free = np.setdiff1d(np.arange(model.n_nodes), surface)
    true = exact(model.points)[free]
    return np.sqrt(((u[free] - true) ** 2).sum() / (true**2).sum())


def relaxed(relaxation):
    """Displacements (n_nodes, 3), m, of the static solution."""
    s, step = relaxation.state, relaxation.step
    relaxation.begin()
    apply(s, (*step.forces, *step.work))
    while not relaxation.decide(relaxation.check())[1]:
        for _ in range(relaxation.between):
            apply(s, step.cycle)
    assert not relaxation.stalled
    return s.u[:, : relaxation.sub.n_nodes].T.copy()


def test_hexahedra_converge_with_the_square_of_their_size(tmp_path):
    """On distorted cells; from above, for the coarse mesh's eight cells hold more than a wave."""
    coarse, fine = (error(tmp_path, n, "none") for n in (8, 16))
    assert 1.8 < np.log2(coarse / fine) < 2.4


def test_the_mixed_mesh_converges_alike_only_where_constant_stress_is_in_balance(tmp_path):
    """Without the correction of the gradients a constant stress is out of balance, by a share that no finer cloud makes
    smaller: the error falls only as long as that is small beside the rest.
    """
    errors = {
        consistency: [error(tmp_path, n, "core", consistency) for n in (8, 16)] for consistency in ("true", "false")
    }
    corrected, plain = (np.log2(coarse / fine) for coarse, fine in errors.values())
    assert corrected > 1.8
    assert plain < corrected
    for better, worse in zip(errors["true"], errors["false"], strict=True):
        assert better < worse
    assert errors["false"][1] / errors["true"][1] > errors["false"][0] / errors["true"][0]


def test_a_nearly_incompressible_cylinder_does_not_lock(tmp_path):
    """At nu = 0.499 the error is what it is at 0.49; a share of lambda in hourglass control would double it."""
    errors = []
    for nu, reference in ((0.49, "A_ext"), (0.499, "E1_ext")):
        keys = ("cylinder.element_size=8", "cylinder.cloud=none", f"material.brain.poissons_ratio={nu}")
        keys = (*keys, "solver.method=dynamic-relaxation")
        words = [word for key in keys for word in ("--set", key)]
        out = tmp_path / reference
        mpitled("run", ROOT / "jobs" / "validation" / "cylinder.toml", "--out", out, *words)
        found = compare.compare(out, ROOT / "tests" / "data" / f"{reference}.npz", 5e-3)["groups"]["free beyond"]
        errors.append(found["largest_mm"][-1])
    assert errors[1] < 1.5 * errors[0]
