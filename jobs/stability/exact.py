"""Closed forms of static solutions: homogeneous deformations, two layers, and a sphere that grows in a shell.

Each gives displacements (n, 3), m, of a model at points (n, 3), m. The volume, m^3, is that of a grown tumour.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from mpitled.laws import Material, first_piola
from mpitled.model import Model
from mpitled.model.loading import sphere_radius

Array = NDArray[np.float64]


def stretched(model: Model, points: Array, volume: float) -> Array:
    """Stretch or compression along z between z0 and z1, with free sides apart from x = y = 0."""
    stretch, material = _stretch(model), model.materials[0]
    # J = m^2 stretch is between 1 (incompressible) and stretch (nu = 0); it lies outside for nu < 0.
    bounds = sorted((0.5 * min(1.0, stretch**-0.5), 2 * max(1.0, stretch**-0.5)))
    m = brentq(lambda m: _stress(material, m, m, stretch)[0], *bounds, xtol=1e-15)
    return (points - model.points.min(axis=0)) * [m - 1, m - 1, stretch - 1]


def confined(model: Model, points: Array, volume: float) -> Array:
    """The same with fixed sides."""
    return (points - model.points.min(axis=0)) * [0.0, 0.0, _stretch(model) - 1]


def layers(model: Model, points: Array, volume: float) -> Array:
    """As `confined`, with the cells of the set "upper" (half of the height) of another material: equal stresses."""
    stretch = _stretch(model)
    upper = model.materials[model.material[model.cell_sets["upper"][0]]]
    lower = model.materials[model.material[np.setdiff1d(model.cell_sets["all"], model.cell_sets["upper"])[0]]]

    def jump(below: float) -> float:
        return _stress(lower, 1.0, 1.0, below)[2] - _stress(upper, 1.0, 1.0, 2 * stretch - below)[2]

    below = brentq(jump, 1e-3, 2 * stretch - 1e-3, xtol=1e-15)
    z, half = points[:, 2] - model.points[:, 2].min(), 0.5 * np.ptp(model.points[:, 2])
    moved = np.where(z < half, (below - 1) * z, (below - 1) * half + (2 * stretch - below - 1) * (z - half))
    return np.outer(moved, [0.0, 0.0, 1.0])


def sheared(model: Model, points: Array, volume: float) -> Array:
    """The whole surface moves along x in proportion to z."""
    moved, height = np.abs(model.prescribed_displacements).max(), np.ptp(model.points[:, 2])
    return np.outer((points[:, 2] - model.points[:, 2].min()) / height * moved, [1.0, 0.0, 0.0])


def shell(model: Model, points: Array, volume: float) -> Array:
    """A sphere around the origin, the node set "tumour", grows in a sphere with a fixed surface.

    Solves the radial balance dP_rr/drho + 2/rho (P_rr - P_tt) = 0 by collocation.
    """
    material, distance = model.materials[0], np.linalg.norm(model.points, axis=1)
    inner, outer = float(distance[model.node_sets["tumour"]].mean()), float(distance.max())
    radius, lam, mu = sphere_radius(volume), material.lam, material.mu

    def slopes(rho: Array, y: Array) -> Array:
        hoop, radial = y[0] / rho, y[1]
        J = radial * hoop**2
        q, dq = lam * (J - 1) - mu / J, lam + mu / J**2
        # P_rr = mu radial + q hoop^2, P_tt = mu hoop + q radial hoop; dP_rr/drho is solved for d radial/drho.
        known = (dq * 2 * radial * hoop**3 + 2 * q * hoop) * (radial - hoop) / rho
        difference = mu * (radial - hoop) + q * hoop * (hoop - radial)
        return np.stack([radial, -(known + 2 / rho * difference) / (mu + dq * hoop**4)])

    def ends(at_inner: Array, at_outer: Array) -> Array:
        return np.array([at_inner[0] / radius - 1, at_outer[0] / outer - 1])

    rho = np.geomspace(inner, outer, 2000)
    added = (radius**3 - inner**3) * (outer**3 - rho**3) / (outer**3 - inner**3)  # uniform compression
    guess = np.cbrt(rho**3 + added)
    found = solve_bvp(slopes, ends, rho, np.stack([guess, np.gradient(guess, rho)]), tol=1e-8, max_nodes=100_000)
    if not found.success:
        raise ArithmeticError(found.message)
    at = np.clip(np.linalg.norm(points, axis=1), inner, outer)
    return ((found.sol(at)[0] / at) - 1)[:, None] * points


def _stretch(model: Model) -> float:
    """Of the height, from the displacement of the node set "z1"."""
    dof = 3 * model.node_sets["z1"][0] + 2
    moved = model.prescribed_displacements[np.searchsorted(model.prescribed_dofs, dof)]
    return float(1 + moved / np.ptp(model.points[:, 2]))


def _stress(material: Material, *stretches: float) -> Array:
    return np.diagonal(first_piola(material.law, np.diag(stretches)))


CLOSED_FORMS = {form.__name__: form for form in (stretched, confined, layers, sheared, shell)}
