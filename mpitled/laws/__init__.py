"""Constitutive laws: one file each, registered in `LAWS`, and the materials that they make."""

from mpitled.laws.law import Law, Tensor
from mpitled.laws.material import Material
from mpitled.laws.neo_hookean import NeoHookean

#: Laws by their names in a deck.
LAWS: dict[str, type[Law]] = {law.name: law for law in (NeoHookean,)}

__all__ = ["LAWS", "Law", "Material", "NeoHookean", "Tensor"]
