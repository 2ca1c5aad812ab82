"""The constitutive law: Lame constants, the neo-Hookean stress in numpy, and the wave speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Material:
    """A homogeneous, isotropic neo-Hookean solid in SI units."""

    name: str
    youngs_modulus: float  # Pa, > 0
    poissons_ratio: float  # in (-1, 0.5)
    density: float  # kg/m^3, > 0

    @property
    def lam(self) -> float:
        """First Lame constant, Pa (paper, eq. 4.2)."""
        nu = self.poissons_ratio
        return self.youngs_modulus * nu / ((1 + nu) * (1 - 2 * nu))

    @property
    def mu(self) -> float:
        """Shear modulus, Pa. Eq. 4.3 prints E nu / (2 (1 + nu)), a misprint: it has no linear limit."""
        return self.youngs_modulus / (2 * (1 + self.poissons_ratio))

    @property
    def p_wave_modulus(self) -> float:
        """lambda + 2 mu, Pa: the stiffness against uniaxial strain."""
        return self.lam + 2 * self.mu

    @property
    def wave_speed(self) -> float:
        """Speed of pressure waves in the undeformed solid, m/s."""
        return float(np.sqrt(self.p_wave_modulus / self.density))


#: lambda + 2 mu at nu = 0.495, in shear moduli.
_STIFFEST = 102.0


def hourglass_modulus(lam: NDArray[np.float64], mu: NDArray[np.float64]) -> NDArray[np.float64]:
    """What hourglass control (eq. 4.22) is a share of, Pa: lambda + 2 mu, at most that of nu = 0.495.

    Hourglass modes keep the volume to first order: towards nu = 0.5 a share of lambda would lock them. At nu = 0.499
    without the limit the largest error of a stretched cylinder doubles; with that of nu = 0.49 a fine mesh of a
    compressed one gives way at the platens' edges. The modes of support domains have to hold against pressure, which
    such a limit lets tumours grow through: they are stabilised with the whole lambda + 2 mu.
    """
    return np.minimum(lam + 2 * mu, _STIFFEST * mu)


def first_piola(X: NDArray[np.float64], lam: float, mu: float) -> NDArray[np.float64]:
    """First Piola-Kirchhoff stress P = X S, (..., 3, 3) in Pa, of deformation gradients X (..., 3, 3).

    S = mu (I - C^-1) + lambda J (J - 1) C^-1 (paper, 4.2.1; 3.2 step 7 calls C what is C^-1). With the
    cofactor K = J X^-T this is P = mu X + (lambda (J - 1) - mu / J) K. The kernels compute the same form.
    """
    J = np.linalg.det(X)[..., None, None]
    K = J * np.swapaxes(np.linalg.inv(X), -1, -2)
    return mu * X + (lam * (J - 1) - mu / J) * K


def strain_energy(X: NDArray[np.float64], lam: float, mu: float) -> NDArray[np.float64]:
    """Strain energy density W = mu/2 (tr C - 3) - mu ln J + lambda/2 (J - 1)^2, (...) in Pa, whose gradient is P."""
    J = np.linalg.det(X)
    return mu / 2 * ((X**2).sum((-1, -2)) - 3) - mu * np.log(J) + lam / 2 * (J - 1) ** 2
