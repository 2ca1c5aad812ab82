"""The material of each cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpitled.deck import Deck
from mpitled.errors import InputError
from mpitled.laws import Material
from mpitled.mesh import Mesh, named_set
from mpitled.meshing import label_image


def assign_materials(deck: Deck, mesh: Mesh) -> tuple[NDArray[np.int16], tuple[Material, ...]]:
    """Material (n_cells,) of each cell, and all materials: first of the deck, then of the mesh file.

    "all" in the deck means the cells that no other set of the deck has. The remaining cells have the materials of the
    mesh file; materials without cells are dropped. The deck may name a material for ventricles that do not exist.
    InputError if a cell has two materials or none.
    """
    absent = {name for name in label_image.VENTRICLES if deck.labels and not getattr(deck.labels, name)}
    claims = [(name, section.material) for section in deck.materials for name in section.cells if name not in absent]
    materials = list(dict.fromkeys(material for _, material in claims))
    assigned = np.full(mesh.n_cells, -1, np.int16)

    def fill(name: str, material: Material, origin: str, open_cells: NDArray[np.bool_]) -> None:
        cells = np.arange(mesh.n_cells) if name == "all" else named_set(mesh.cell_sets, name, origin)
        cells = cells[open_cells[cells]]
        n_twice = np.count_nonzero(assigned[cells] >= 0)
        if n_twice:
            other = materials[assigned[cells].max()].name
            raise InputError(
                f"{origin}: {n_twice} cells of '{name}' are of material '{other}' already; take them out of one of "
                "the two"
            )
        assigned[cells] = materials.index(material)

    for name, material in sorted(claims, key=lambda claim: claim[0] == "all"):
        open_cells = assigned < 0 if name == "all" else np.ones(mesh.n_cells, bool)
        fill(name, material, f"{deck.path}: material.{material.name}.cells", open_cells)
    left = assigned < 0
    of_file = [(name, material) for name, material in mesh.materials.items() if left[mesh.cell_sets[name]].any()]
    materials += [material for material in dict.fromkeys(m for _, m in of_file) if material not in materials]
    for name, material in of_file:
        fill(name, material, f"{deck.path}: mesh: section of material {material.name}", left)
    if (assigned < 0).any():
        cell = int(np.argmax(assigned < 0))
        sets = [name for name, members in mesh.cell_sets.items() if cell in members]
        raise InputError(
            f"{deck.path}: material: {np.count_nonzero(assigned < 0)} cells have none, the first in "
            f"{' and '.join(sets) or 'no set'}; name their set in a material's cells"
        )
    return assigned, tuple(materials)
