"""What `mpitled check` prints: the contents of a mesh file or of a deck's mesh, after all checks of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mpitled import checks, meshes, preprocess
from mpitled.deck import Deck, MeshFiles, load_deck
from mpitled.errors import InputError
from mpitled.mesh import Constraint
from mpitled.meshfile import MeshFile


def check(path: Path, overrides: Sequence[str] = ()) -> str:
    """Contents and remarks of a mesh file or of a deck (TOML); InputError if it cannot be computed with."""
    if path.suffix.lower() == ".toml":
        return "\n".join(_deck(load_deck(path, overrides)))
    if overrides:
        raise InputError(f"{path}: is a mesh and has no keys to override; leave out --set")
    return "\n".join(_file(meshes.read_file(path)))


def _deck(deck: Deck) -> Iterator[str]:
    mesh = preprocess.read_mesh(deck)
    model = preprocess.discretise(deck, mesh)
    yield f"nodes            {mesh.n_nodes} ({mesh.n_fe_nodes} FE, {mesh.n_nodes - mesh.n_fe_nodes} EFG)"
    yield f"hexahedra        {len(mesh.hexahedra)}"
    yield f"integration      {len(mesh.integration_points)} points, {mesh.integration_volumes.sum() * 1e9:.6g} mm3"
    yield _extent(mesh.points, 1e3, " mm")
    yield from _sets("node set", mesh.node_sets)
    yield from _sets("cell set", mesh.cell_sets)
    counts = np.bincount(model.material, minlength=len(model.materials))
    for material, n in zip(model.materials, counts, strict=True):
        yield (
            f"material         {material.name}: E {material.youngs_modulus:g} Pa, nu {material.poissons_ratio:g}, "
            f"{material.density:g} kg/m3, {n} cells"
        )
    yield from _constraints((*deck.constraints(), *mesh.constraints), mesh.node_sets, 1e3, " mm")
    if deck.tumour:
        yield f"grows            tumour ({len(mesh.node_sets[preprocess.TUMOUR])} nodes)"
    yield f"prescribed dofs  {len(model.prescribed_dofs)} of {3 * model.n_nodes}"
    yield from model.remarks


def _file(file: MeshFile) -> Iterator[str]:
    """A mesh file alone: as an FE mesh if it has hexahedra, else as what it can be, in its own units."""
    remarks = list(_file_checks(file))
    yield f"format           {file.format}"
    yield f"nodes            {len(file.points)}"
    kinds: dict[str, int] = {}
    for block in file.cells:
        kind = f"{block.kind} ({block.type})" if block.kind != "other" else block.type
        kinds[kind] = kinds.get(kind, 0) + len(block.ids)
    for kind, n in kinds.items():
        yield f"cells            {kind}: {n}"
    yield _extent(file.points, 1.0, "")
    yield from _sets("node set", file.node_sets)
    yield from _sets("cell set", file.cell_sets)
    for name, material in file.materials:
        density = "none" if material.density is None else f"{material.density:g}"
        yield (
            f"material         {material.name} in {name}: E {material.youngs_modulus:g}, nu "
            f"{material.poissons_ratio:g}, density {density}"
        )
    yield from _constraints(file.constraints, file.node_sets, 1.0, "")
    yield from dict.fromkeys(remarks)


def _file_checks(file: MeshFile) -> Iterator[str]:
    kinds = {block.kind for block in file.cells if len(block.ids)}
    if "hexahedron" in kinds and not kinds & {"tetrahedron", "wedge", "pyramid"}:
        section = MeshFiles(fe=file.path)
        mesh = meshes.assemble(section, file, None)
        deck = Deck(mesh=section, path=file.path)
        dofs = preprocess.prescribe(deck, mesh)[0] if mesh.constraints else np.empty(0, np.int64)
        yield from mesh.remarks
        none = np.empty((0, 8), np.int64)
        said = checks.scene_remarks(mesh.points, mesh.hexahedra, none, mesh.n_fe_nodes, dofs)
        yield from said if len(dofs) else [remark for remark in said if "rigid" not in remark]
    else:
        meshes.check_solids(file)
        yield from file.remarks
        yield from meshes.check_cloud(file)
        yield (
            f"warning: {file.path}: has {'no hexahedra' if 'hexahedron' not in kinds else 'more than hexahedra'}; it "
            "may be mesh.efg" + (", and mesh.fe if mesh.dropped names the rest" if "hexahedron" in kinds else "")
        )
    if not file.constraints:
        yield f"warning: {file.path}: fixes and displaces nothing; the deck has to"


def _extent(points: NDArray[np.float64], scale: float, unit: str) -> str:
    ends = zip("xyz", points.min(axis=0) * scale, points.max(axis=0) * scale, strict=True)
    return "extent           " + ", ".join(f"{axis} {low:.6g} to {high:.6g}" for axis, low, high in ends) + unit


def _sets(kind: str, sets: dict[str, NDArray[np.int64]]) -> Iterator[str]:
    for name, members in sets.items():
        yield f"{kind:16} {name}: {len(members)}"


def _constraints(
    constraints: Iterable[Constraint], node_sets: dict[str, NDArray[np.int64]], scale: float, unit: str
) -> Iterator[str]:
    for constraint in constraints:
        axes = ", ".join("xyz"[direction] for direction in constraint.directions)
        n = len(node_sets.get(constraint.node_set, ()))
        if any(isinstance(value, np.ndarray) or value for value in constraint.displacement):
            moves = ", ".join(_moved(value, scale) for value in constraint.displacement)
            yield f"displaced        {constraint.node_set} ({n} nodes) in {axes} by {moves}{unit}"
        else:
            yield f"fixed            {constraint.node_set} ({n} nodes) in {axes}"


def _moved(value: float | NDArray[np.float64], scale: float) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.min() * scale:.6g} to {value.max() * scale:.6g}"
    return f"{value * scale:.6g}"
