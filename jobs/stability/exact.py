"""Closed forms of static solutions: homogeneous deformations, two layers, and a sphere that grows in a shell."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from mpitled.material import Material, first_piola
from mpitled.model import Model
from mpitled.model.loading import sphere_radius


def stretched(model: Model, places: NDArray[np.float64], _: float) -> NDArray[np.float64]:
    """Pulled or pressed along z between z0 and z1, with free sides but for x = y = 0."""
    stretch, material = _stretch(model), model.materials[0]

    def side_stress(m: float) -> float:
        return float(_stress(material, m, m, stretch)[0])

    # J = m^2 stretch lies between 1 (incompressible) and stretch (nu = 0), and beyond it for nu < 0.
    bounds = sorted((0.5 * min(1.0, stretch**-0.5), 2 * max(1.0, stretch**-0.5)))
    m = float(brentq(side_stress, *bounds, xtol=1e-15))
    return (places - model.points.min(axis=0)) * [m - 1, m - 1, stretch - 1]


def confined(model: Model, places: NDArray[np.float64], _: float) -> NDArray[np.float64]:
    """The same with sides that stay where they are."""
    return (places - model.points.min(axis=0)) * [0.0, 0.0, _stretch(model) - 1]


def layers(model: Model, places: NDArray[np.float64], _: float) -> NDArray[np.float64]:
    """The same where the upper half is of another material, of the set "upper": both carry the same stress."""
    stretch = _stretch(model)
    upper = model.materials[model.material[model.cell_sets["upper"][0]]]
    lower = model.materials[model.material[np.setdiff1d(model.cell_sets["all"], model.cell_sets["upper"])[0]]]

    def jump(own: float) -> float:
        other = 2 * stretch - own
        return float(_stress(lower, 1.0, 1.0, own)[2] - _stress(upper, 1.0, 1.0, other)[2])

    own = float(brentq(jump, 1e-3, 2 * stretch - 1e-3, xtol=1e-15))
    z, half = places[:, 2] - model.points[:, 2].min(), 0.5 * np.ptp(model.points[:, 2])
    moved = np.where(z < half, (own - 1) * z, (own - 1) * half + (2 * stretch - own - 1) * (z - half))
    return np.outer(moved, [0.0, 0.0, 1.0])


def sheared(model: Model, places: NDArray[np.float64], _: float) -> NDArray[np.float64]:
    """The whole surface moved along x in proportion to z."""
    moved, height = np.abs(model.prescribed_displacements).max(), np.ptp(model.points[:, 2])
    return np.outer((places[:, 2] - model.points[:, 2].min()) / height * moved, [1.0, 0.0, 0.0])


def shell(model: Model, places: NDArray[np.float64], volume: float) -> NDArray[np.float64]:
    """A sphere around the origin, the set tumour, grown to a volume (m^3) in one whose surface is fixed.

    The radial equation of balance, dP_rr/drho + 2/rho (P_rr - P_tt) = 0, by collocation.
    """
    material, distance = model.materials[0], np.linalg.norm(model.points, axis=1)
    inner, outer = float(distance[model.node_sets["tumour"]].mean()), float(distance.max())
    radius = sphere_radius(volume)
    lam, mu = material.lam, material.mu

    def slopes(rho: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        hoop, radial = y[0] / rho, y[1]
        J = radial * hoop**2
        q = lam * (J - 1) - mu / J
        slope_of_hoop = (radial - hoop) / rho
        # P_rr = mu radial + q hoop^2, P_tt = mu hoop + q radial hoop; dP_rr/drho solved for d radial/drho.
        dq = lam + mu / J**2
        known = (dq * 2 * radial * hoop**3 + 2 * q * hoop) * slope_of_hoop
        difference = mu * (radial - hoop) + q * hoop * (hoop - radial)
        return np.stack([radial, -(known + 2 / rho * difference) / (mu + dq * hoop**4)])

    def ends(at_inner: NDArray[np.float64], at_outer: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([at_inner[0] / radius - 1, at_outer[0] / outer - 1])

    rho = np.geomspace(inner, outer, 2000)
    grown = (radius**3 - inner**3) * (outer**3 - rho**3) / (outer**3 - inner**3)  # as if all were compressed alike
    guess = np.cbrt(rho**3 + grown)
    found = solve_bvp(slopes, ends, rho, np.stack([guess, np.gradient(guess, rho)]), tol=1e-8, max_nodes=100_000)
    if not found.success:
        raise ArithmeticError(found.message)
    at = np.clip(np.linalg.norm(places, axis=1), inner, outer)
    return ((found.sol(at)[0] / at) - 1)[:, None] * places


def _stretch(model: Model) -> float:
    """Of the height, by the displacement of the set z1."""
    dofs = 3 * model.node_sets["z1"] + 2
    moved = model.prescribed_displacements[np.searchsorted(model.prescribed_dofs, dofs[0])]
    return float(1 + moved / np.ptp(model.points[:, 2]))


def _stress(material: Material, *stretches: float) -> NDArray[np.float64]:
    return np.diagonal(first_piola(np.diag(stretches), material.lam, material.mu))


#: By name: displacements (n, 3), m, of a model at places (n, 3), m; the last argument is the tumour's volume, m^3.
CLOSED_FORMS: dict[str, Callable[[Model, NDArray[np.float64], float], NDArray[np.float64]]] = {
    form.__name__: form for form in (stretched, confined, layers, sheared, shell)
}
