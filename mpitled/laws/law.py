"""What a constitutive law consists of; each law is one file of this folder."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

#: The nine components of a 3x3 tensor, row by row. Each is a number, an array, or a vector of a kernel.
Tensor = tuple[Any, Any, Any, Any, Any, Any, Any, Any, Any]


def parameter(meaning: str, unit: str = "", **limits: Any) -> Any:
    """A parameter of a law in SI units, which a deck must give; limits are `gt`, `ge`, `lt` and `le` of pydantic."""
    return Field(description=meaning, json_schema_extra={"unit": unit}, **limits)


class Law(BaseModel):
    """A hyperelastic law with its parameters, in SI units.

    A law is a strain energy density W(F), Pa, of the deformation gradient F. The static methods are its formulas. They
    are written with the operators of numbers and with `np.sqrt`, `np.log`, `np.abs` and `np.maximum` alone: the kernels
    compile the same functions for vectors of cells. They take

    - `F`, the deformation gradient, and `H` = F - I, the displacement gradient, by rows (`Tensor`);
    - `K` = J F^-T, the cofactor of F, by rows, and `J` = det F;
    - `c`, the law's `coefficients`. The formulas are linear in `c`, so that coefficients times the volume of a cell
      give its energy in J.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    #: Name in a deck.
    name: ClassVar[str]
    #: How many `coefficients` there are.
    n_coefficients: ClassVar[int]

    @property
    def coefficients(self) -> tuple[float, ...]:
        """The numbers that the formulas take, Pa."""
        raise NotImplementedError

    @property
    def mu(self) -> float:
        """Shear modulus of the undeformed solid, Pa."""
        raise NotImplementedError

    @property
    def lam(self) -> float:
        """First Lame constant of the undeformed solid, Pa."""
        raise NotImplementedError

    @property
    def p_wave_modulus(self) -> float:
        """lambda + 2 mu, Pa: the stiffness of the undeformed solid against uniaxial strain."""
        return self.lam + 2 * self.mu

    @staticmethod
    def stress(F: Tensor, K: Tensor, J: Any, c: Any) -> Tensor:
        """First Piola-Kirchhoff stress P = dW/dF by rows."""
        raise NotImplementedError

    @staticmethod
    def energy(H: Tensor, F: Tensor, K: Tensor, J: Any, c: Any) -> Any:
        """Strain energy density W, 0 at F = I."""
        raise NotImplementedError

    @staticmethod
    def tangent_bound(F: Tensor, K: Tensor, J: Any, c: Any) -> tuple[Any, Any]:
        """Numbers a, b >= 0 with D2W[G, G] <= a (K:G)^2 + b G:G for every increment G of F.

        The stable time step rests on these: a cell's largest eigenvalue is at most V (a |B K^T|^2 + b |B|^2), with its
        volume V and its gradients B.
        """
        raise NotImplementedError
