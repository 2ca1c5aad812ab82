"""Constitutive laws: one file each, registered in `LAWS`, and the materials that they make."""

from collections.abc import Mapping
from typing import Any

from mpitled.laws.arrays import first_piola, strain_energy
from mpitled.laws.law import Law, Tensor
from mpitled.laws.material import Material
from mpitled.laws.mooney_rivlin import MooneyRivlin
from mpitled.laws.neo_hookean import NeoHookean

#: Laws by their names in a deck.
LAWS: dict[str, type[Law]] = {law.name: law for law in (NeoHookean, MooneyRivlin)}


def material_of(record: Mapping[str, Any]) -> Material:
    """The material that `Material.record` gave. ValueError if the record is none."""
    values = dict(record)
    name, density, law = (values.pop(key, None) for key in ("name", "density", "law"))
    if law not in LAWS or not isinstance(density, float | int):
        raise ValueError(f"material {name} has the law {law} and the density {density}")
    return Material(str(name), LAWS[law](**values), float(density))


__all__ = ["LAWS", "Law", "Material", "NeoHookean", "Tensor", "first_piola", "material_of", "strain_energy"]
