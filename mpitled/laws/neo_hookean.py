"""The compressible neo-Hookean solid of the paper."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from mpitled.laws.law import Law, Tensor, parameter


class NeoHookean(Law):
    """W = mu/2 (tr C - 3) - mu ln J + lambda/2 (J - 1)^2.

    Its second Piola-Kirchhoff stress is S = mu (I - C^-1) + lambda J (J - 1) C^-1 (paper, 4.2.1; step 7 of 3.2 calls C
    what is C^-1).
    """

    name: ClassVar[str] = "neo-hookean"
    n_coefficients: ClassVar[int] = 2

    youngs_modulus: float = parameter("Young's modulus, E", "Pa", gt=0)
    poissons_ratio: float = parameter("Poisson's ratio, nu", gt=-1, lt=0.5)

    @property
    def lam(self) -> float:
        """First Lame constant, Pa (paper, eq. 4.2)."""
        nu = self.poissons_ratio
        return self.youngs_modulus * nu / ((1 + nu) * (1 - 2 * nu))

    @property
    def mu(self) -> float:
        """Shear modulus, Pa. Eq. 4.3 prints E nu / (2 (1 + nu)), a misprint: that has no linear limit."""
        return self.youngs_modulus / (2 * (1 + self.poissons_ratio))

    @property
    def coefficients(self) -> tuple[float, ...]:
        return self.mu, self.lam

    @staticmethod
    def stress(F: Tensor, K: Tensor, J: Any, c: Any) -> Tensor:
        """P = mu F + (lambda (J - 1) - mu / J) K: the paper's P = F S without C and without an inverse."""
        mu, lam = c
        q = lam * (J - 1) - mu / J
        return (
            mu * F[0] + q * K[0], mu * F[1] + q * K[1], mu * F[2] + q * K[2],
            mu * F[3] + q * K[3], mu * F[4] + q * K[4], mu * F[5] + q * K[5],
            mu * F[6] + q * K[6], mu * F[7] + q * K[7], mu * F[8] + q * K[8],
        )  # fmt: skip

    @staticmethod
    def energy(H: Tensor, F: Tensor, K: Tensor, J: Any, c: Any) -> Any:
        """W; tr C - 3 = 2 tr H + H:H has no cancellation at small strain."""
        mu, lam = c
        a, b, d, e, f, g, h, i, j = H
        shear = (a + f + j) * 2 + (a * a + b * b + d * d + e * e + f * f + g * g + h * h + i * i + j * j)
        return (mu * shear + lam * (J - 1) * (J - 1)) * 0.5 - mu * np.log(J)

    @staticmethod
    def tangent_bound(F: Tensor, K: Tensor, J: Any, c: Any) -> tuple[Any, Any]:
        """a = lambda + mu / J^2, or 0; b = mu + |q| sqrt(2) |F| with q = lambda (J - 1) - mu / J.

        The tangent is mu I + (lambda + mu / J^2) K (x) K + q dK/dF. The last operator maps G to F x G, the tensor cross
        product, whose norm is at most sqrt(2) |F| |G|. lambda + mu / J^2 is negative where nu < 0 and J is large.
        """
        mu, lam = c
        a, b, d, e, f, g, h, i, j = F
        q = lam * (J - 1) - mu / J
        square = a * a + b * b + d * d + e * e + f * f + g * g + h * h + i * i + j * j
        return np.maximum(lam + mu / (J * J), 0), mu + np.abs(q) * np.sqrt(square * 2)
