"""Stress and energy of a law at arrays of deformation gradients, for results and for tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpitled.laws.law import Law, Tensor


def first_piola(law: Law, F: NDArray[np.float64]) -> NDArray[np.float64]:
    """First Piola-Kirchhoff stress (..., 3, 3), Pa, at deformation gradients F (..., 3, 3)."""
    rows, K, J = _kinematics(F)
    return np.stack(law.stress(rows, K, J, law.coefficients), axis=-1).reshape(F.shape)


def strain_energy(law: Law, F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Strain energy density (...), Pa, at deformation gradients F (..., 3, 3)."""
    rows, K, J = _kinematics(F)
    return np.asarray(law.energy(_rows(F - np.eye(3)), rows, K, J, law.coefficients))


def _kinematics(F: NDArray[np.float64]) -> tuple[Tensor, Tensor, NDArray[np.float64]]:
    """F by rows, its cofactor by rows, and its determinant."""
    J = np.linalg.det(F)
    return _rows(F), _rows(J[..., None, None] * np.swapaxes(np.linalg.inv(F), -1, -2)), J


def _rows(tensor: NDArray[np.float64]) -> Tensor:
    a, b, c, d, e, f, g, h, i = np.moveaxis(tensor.reshape(*tensor.shape[:-2], 9), -1, 0)
    return a, b, c, d, e, f, g, h, i
