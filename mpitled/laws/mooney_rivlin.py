"""The compressible Mooney-Rivlin solid."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from pydantic import model_validator

from mpitled.laws.law import Law, Tensor, parameter


class MooneyRivlin(Law):
    """W = c10 (I1 - 3) + c01 (I2 - 3) - 2 (c10 + 2 c01) ln J + l/2 (J - 1)^2.

    I1 = F:F and I2 = K:K are the invariants of C; l follows from Poisson's ratio. With c01 = 0 it is the neo-Hookean
    solid of mu = 2 c10. Mooney (1940), J. Appl. Phys. 11, 582; the volumetric terms make I free of stress, as in the
    coupled Mooney-Rivlin solid of FEBio.
    """

    name: ClassVar[str] = "mooney-rivlin"
    n_coefficients: ClassVar[int] = 3

    c10: float = parameter("coefficient of the first invariant, half of the shear modulus if c01 is 0", "Pa", gt=0)
    c01: float = parameter("coefficient of the second invariant", "Pa", ge=0)
    poissons_ratio: float = parameter("Poisson's ratio of the undeformed solid, nu", gt=-1, lt=0.5)

    @model_validator(mode="after")
    def _volumetric_term_is_positive(self) -> MooneyRivlin:
        if self.coefficients[2] < 0:
            # lambda = 4 c01 at this ratio.
            least = 2 * self.c01 / (self.mu + 4 * self.c01)
            raise ValueError(f"poissons_ratio is too small for this c01; give at least {least:.3g}")
        return self

    @property
    def mu(self) -> float:
        return 2 * (self.c10 + self.c01)

    @property
    def lam(self) -> float:
        nu = self.poissons_ratio
        return 2 * self.mu * nu / (1 - 2 * nu)

    @property
    def coefficients(self) -> tuple[float, ...]:
        # I2 - 3 - 4 ln J has the first Lame constant 4 itself.
        return self.c10, self.c01, self.lam - 4 * self.c01

    @staticmethod
    def stress(F: Tensor, K: Tensor, J: Any, c: Any) -> Tensor:
        """P = 2 c10 F + 2 c01 F x K + q K, q = l (J - 1) - 2 (c10 + 2 c01) / J, with the tensor cross product F x K."""
        c10, c01, lam = c
        p, r = c10 * 2, c01 * 2
        q = lam * (J - 1) - (p + r * 2) / J
        a, b, d, e, f, g, h, i, j = F
        A, B, D, E, G, H, L, M, N = K
        return (
            p * a + r * (f * N - g * M + j * G - i * H) + q * A,
            p * b + r * (g * L - e * N + h * H - j * E) + q * B,
            p * d + r * (e * M - f * L + i * E - h * G) + q * D,
            p * e + r * (d * M - b * N + i * D - j * B) + q * E,
            p * f + r * (a * N - d * L + j * A - h * D) + q * G,
            p * g + r * (b * L - a * M + h * B - i * A) + q * H,
            p * h + r * (b * H - d * G + g * B - f * D) + q * L,
            p * i + r * (d * E - a * H + e * D - g * A) + q * M,
            p * j + r * (a * G - b * E + f * A - e * B) + q * N,
        )

    @staticmethod
    def energy(H: Tensor, F: Tensor, K: Tensor, J: Any, c: Any) -> Any:
        """W, from H and from K - I = H x I + cof H without cancellation at small strain."""
        c10, c01, lam = c
        a, b, d, e, f, g, h, i, j = H
        # The cofactor of F less I: its part linear in H, and the cofactor of H.
        A, B, D = f + j + (f * j - g * i), (g * h - e * j) - e, (e * i - f * h) - h
        E, G, L = (d * i - b * j) - b, a + j + (a * j - d * h), (b * h - a * i) - i
        M, N, P = (b * g - d * f) - d, (d * e - a * g) - g, a + f + (a * f - b * e)
        first = (a + f + j) * 2 + (a * a + b * b + d * d + e * e + f * f + g * g + h * h + i * i + j * j)
        second = (A + G + P) * 2 + (A * A + B * B + D * D + E * E + G * G + L * L + M * M + N * N + P * P)
        return c10 * first + c01 * second - (c10 + c01 * 2) * 2 * np.log(J) + lam * (J - 1) * (J - 1) * 0.5

    @staticmethod
    def tangent_bound(F: Tensor, K: Tensor, J: Any, c: Any) -> tuple[Any, Any]:
        """a = l + 2 (c10 + 2 c01) / J^2; b = 2 c10 + c01 (4 F:F + 2 sqrt(2) |K|) + |q| sqrt(2) |F|.

        The second derivative of I2 along G is 2 |F x G|^2 + 2 K:(G x G), and |F x G| is at most sqrt(2) |F| |G|.
        """
        c10, c01, lam = c
        a, b, d, e, f, g, h, i, j = F
        A, B, D, E, G, H, L, M, N = K
        s = (c10 + c01 * 2) * 2
        q = lam * (J - 1) - s / J
        square = a * a + b * b + d * d + e * e + f * f + g * g + h * h + i * i + j * j
        of_cofactor = A * A + B * B + D * D + E * E + G * G + H * H + L * L + M * M + N * N
        bound = c10 * 2 + c01 * (square * 4 + np.sqrt(of_cofactor * 8)) + np.abs(q) * np.sqrt(square * 2)
        return np.maximum(lam + s / (J * J), 0), bound
