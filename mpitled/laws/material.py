"""A material: a constitutive law and a density."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from mpitled.laws.law import Law


@dataclass(frozen=True, slots=True)
class Material:
    """A homogeneous solid in SI units."""

    name: str
    law: Law
    density: float  # kg/m^3, > 0

    @property
    def lam(self) -> float:
        """First Lame constant of the undeformed solid, Pa."""
        return self.law.lam

    @property
    def mu(self) -> float:
        """Shear modulus of the undeformed solid, Pa."""
        return self.law.mu

    @property
    def p_wave_modulus(self) -> float:
        """lambda + 2 mu, Pa: the stiffness of the undeformed solid against uniaxial strain."""
        return self.law.p_wave_modulus

    @property
    def youngs_modulus(self) -> float:
        """Young's modulus of the undeformed solid, Pa."""
        return self.mu * (3 * self.lam + 2 * self.mu) / (self.lam + self.mu)

    @property
    def poissons_ratio(self) -> float:
        """Poisson's ratio of the undeformed solid."""
        return self.lam / (2 * (self.lam + self.mu))

    @property
    def wave_speed(self) -> float:
        """Speed of pressure waves in the undeformed solid, m/s."""
        return math.sqrt(self.p_wave_modulus / self.density)

    def record(self) -> dict[str, Any]:
        """The material as JSON can hold it."""
        return {"name": self.name, "law": self.law.name, "density": self.density} | self.law.model_dump()

    def describe(self) -> str:
        """The material in one line, for tables and messages."""
        parameters = ", ".join(f"{key} {value:g}" for key, value in self.law.model_dump().items())
        return f"{self.name}: {self.law.name}, {parameters}, density {self.density:g} kg/m3"
