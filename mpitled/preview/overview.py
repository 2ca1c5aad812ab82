"""`mpitled check`: check a mesh file or a deck, describe its mesh, and forecast the run of the deck."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpitled.deck import Deck, MeshFiles, Tumour, load_deck
from mpitled.errors import InputError
from mpitled.mesh import Constraint, Mesh
from mpitled.meshing import checks, label_image
from mpitled.meshing.placement import format_length, format_position
from mpitled.model import build as model_build
from mpitled.model.loading import sphere_radius
from mpitled.preview import forecast
from mpitled.readers import meshes, solids
from mpitled.readers.meshfile import MeshFile

#: A tumour closer than this to the plane between left and right has no side, m.
_MIDDLE = 0.5e-3


class Item(NamedTuple):
    """One statement about the contents of a file."""

    name: str  # "" for a remark
    text: str
    figures: Any  # for JSON; dictionaries of the same name are merged


def check(path: Path, overrides: Sequence[str] = ()) -> str:
    """Contents and remarks of a mesh file or a deck (TOML), one line each. InputError for a file that a run refuses."""
    return "\n".join(f"{item.name:16} {item.text}" if item.name else item.text for item in _items(path, overrides))


def figures(path: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Contents and remarks for JSON; arguments and errors as `check`."""
    items: dict[str, Any] = {"remarks": []}
    for name, _, value in _items(path, overrides):
        key = name.replace(" ", "_") or "remarks"
        if isinstance(value, dict):
            items.setdefault(key, {}).update(value)
        elif key in ("remarks", "fixed", "displaced"):
            items.setdefault(key, []).append(value)
        else:
            items[key] = value
    return items


def _items(path: Path, overrides: Sequence[str]) -> Iterator[Item]:
    if path.suffix.lower() == ".toml":
        return _deck(load_deck(path, overrides))
    if label_image.is_image(path):
        remedy = f'mpitled info {path}; a deck computes it by: [labels] image = "{path.name}"'
        raise InputError(f"{path}: is an image; list its labels by: {remedy}")
    if overrides:
        raise InputError(f"{path}: is a mesh and has no keys to override; leave out --set")
    return _file(meshes.read_file(path))


def _deck(deck: Deck) -> Iterator[Item]:
    mesh = model_build.read_mesh(deck)
    model = model_build.discretise(deck, mesh)
    efg = mesh.n_nodes - mesh.n_fe_nodes
    nodes = {"all": mesh.n_nodes, "fe": mesh.n_fe_nodes, "efg": efg}
    yield Item("nodes", f"{mesh.n_nodes} ({mesh.n_fe_nodes} FE, {efg} EFG)", nodes)
    yield Item("hexahedra", f"{len(mesh.hexahedra)}", len(mesh.hexahedra))
    n_points, volume = len(mesh.integration_points), float(mesh.integration_volumes.sum() * 1e9)
    yield Item("integration", f"{n_points} points, {volume:.6g} mm3", {"points": n_points, "volume_mm3": volume})
    yield _extent(mesh.points, 1e3, " mm")
    yield from _sets("node set", mesh.node_sets)
    yield from _sets("cell set", mesh.cell_sets)
    counts = np.bincount(model.material, minlength=len(model.materials))
    for material, n in zip(model.materials, counts.tolist(), strict=True):
        text = f"{material.describe()}, {n} cells"
        yield Item("material", text, {material.name: material.record() | {"cells": n}})
    yield from _constraints((*deck.constraints(), *mesh.constraints), mesh.node_sets, 1e3, " mm")
    if deck.tumour:
        n = len(mesh.node_sets[model_build.TUMOUR])
        yield Item("grows", f"tumour ({n} nodes)", {"tumour": n})
        yield _tumour(deck.tumour, mesh, x_is_right=deck.labels is not None)
    n, of = len(model.prescribed_dofs), 3 * model.n_nodes
    yield Item("prescribed dofs", f"{n} of {of}", n)
    expected = forecast.forecast(deck, model)
    yield Item("run", expected.describe(), expected._asdict() | {"loop_s": expected.loop_s})
    yield from _remarks(model.remarks)


def _tumour(tumour: Tumour, mesh: Mesh, *, x_is_right: bool) -> Item:
    """Position and growth of the tumour, and distances of its centre from the nodes of nearby structures."""
    centre, radius = np.asarray(tumour.centre), sphere_radius(tumour.volume)
    n = len(mesh.hexahedra)
    structures = {}
    for name in label_image.VENTRICLES:
        cells = mesh.cell_sets.get(name, np.empty(0, np.int64))
        structures[name] = mesh.points[np.unique(mesh.hexahedra[cells[cells < n]])]
    for name in model_build.OUTER:
        outer = np.setdiff1d(mesh.node_sets.get(name, ()), mesh.node_sets[model_build.TUMOUR])
        structures[name] = mesh.points[outer.astype(np.int64)]
    structures = {name: points for name, points in structures.items() if len(points)}
    distances = {name: float(np.linalg.norm(points - centre, axis=1).min()) for name, points in structures.items()}
    ventricles = sorted((name for name in label_image.VENTRICLES if name in distances), key=distances.__getitem__)

    across = float(centre[0] - (mesh.points[:, 0].min() + mesh.points[:, 0].max()) / 2)
    if len(ventricles) == 2:
        left, right = (structures[name][:, 0].mean() for name in label_image.VENTRICLES)
        across *= 1 if left < right else -1
    elif not x_is_right:  # the side is unknown
        across = 0.0
    side = "" if abs(across) < _MIDDLE else "right" if across > 0 else "left"
    grown = tumour.volume - 4 / 3 * np.pi * tumour.seed_radius**3
    nearest = [*ventricles[:1], *(name for name in model_build.OUTER if name in distances)]
    parts = [
        f"{format_position(centre)}{side and f', {side} of the middle'}",
        f"{1e9 * tumour.volume:.10g} mm3, {1e9 * grown:.5g} of it grown, radius {1e3 * tumour.seed_radius:g} -> "
        f"{format_length(radius)}",
        ", ".join(f"{format_length(distances[name])} from the {name.replace('_', ' ')}" for name in nearest),
    ]
    figures = {
        "centre_mm": (1e3 * centre).tolist(),
        "side": side,
        "volume_mm3": 1e9 * tumour.volume,
        "seed_radius_mm": 1e3 * tumour.seed_radius,
        "radius_mm": 1e3 * radius,
        "distance_mm": {name: 1e3 * distance for name, distance in distances.items()},
    }
    return Item("tumour", "; ".join(filter(None, parts)), figures)


def _file(file: MeshFile) -> Iterator[Item]:
    """The contents of a mesh file, in the units of the file."""
    remarks = list(_file_checks(file))
    yield Item("format", str(file.format), str(file.format))
    yield Item("nodes", f"{len(file.points)}", len(file.points))
    kinds: dict[str, int] = {}
    for block in file.cells:
        kind = f"{block.kind} ({block.type})" if block.kind != "other" else block.type
        kinds[kind] = kinds.get(kind, 0) + len(block.ids)
    for kind, n in kinds.items():
        yield Item("cells", f"{kind}: {n}", {kind: n})
    yield _extent(file.points, 1.0, ", in the file's units")
    yield from _sets("node set", file.node_sets)
    yield from _sets("cell set", file.cell_sets)
    for name, material in file.materials:
        density = "none" if material.density is None else f"{material.density:g}"
        elastic = f"E {material.youngs_modulus:g}, nu {material.poissons_ratio:g}"
        text = f"{material.name} in {name}: {elastic}, density {density}"
        yield Item("material", text, {material.name: {"cells": name, "of_file": text}})
    yield from _constraints(file.constraints, file.node_sets, 1.0, "")
    yield from _remarks(dict.fromkeys(remarks))


def _remarks(texts: Iterable[str]) -> Iterator[Item]:
    yield from (Item("", text, text) for text in texts)


def _file_checks(file: MeshFile) -> Iterator[str]:
    """Remarks on a file: as an FE mesh if all of its solids are hexahedra, otherwise as a cloud."""
    kinds = {block.kind for block in file.cells if len(block.ids)}
    if "hexahedron" in kinds and not kinds & {"tetrahedron", "wedge", "pyramid"}:
        section = MeshFiles(fe=file.path)
        mesh = meshes.assemble(section, file, None)
        deck = Deck(mesh=section, path=file.path)
        dofs = model_build.prescribe(deck, mesh)[0].dofs if mesh.constraints else np.empty(0, np.int64)
        yield from mesh.remarks
        none = np.empty((0, 8), np.int64)
        remarks = checks.scene_remarks(mesh.points, mesh.hexahedra, none, mesh.n_fe_nodes, dofs)
        yield from remarks if len(dofs) else [remark for remark in remarks if "rigid" not in remark]
    else:
        solids.check_solids(file)
        yield from file.remarks
        yield from solids.check_cloud(file)
        has, more = "no hexahedra", ""
        if "hexahedron" in kinds:
            has, more = "more than hexahedra", ", and mesh.fe if mesh.dropped names the rest"
        yield f"warning: {file.path}: has {has}; it may be mesh.efg{more}"
    if not file.constraints:
        yield f"warning: {file.path}: fixes and displaces no nodes; the deck has to prescribe some"


def _extent(points: NDArray[np.float64], scale: float, unit: str) -> Item:
    ends = np.stack([points.min(axis=0), points.max(axis=0)], axis=1) * scale
    text = ", ".join(f"{axis} {low:.6g} to {high:.6g}" for axis, (low, high) in zip("xyz", ends, strict=True))
    return Item("extent", text + unit, dict(zip("xyz", ends.tolist(), strict=True)))


def _sets(kind: str, sets: dict[str, NDArray[np.int64]]) -> Iterator[Item]:
    for name, members in sets.items():
        yield Item(kind, f"{name}: {len(members)}", {name: len(members)})


def _constraints(
    constraints: Iterable[Constraint], node_sets: dict[str, NDArray[np.int64]], scale: float, unit: str
) -> Iterator[Item]:
    for constraint in constraints:
        axes = ", ".join("xyz"[direction] for direction in constraint.directions)
        n = len(node_sets.get(constraint.node_set, ()))
        name, text = "fixed", f"{constraint.node_set} ({n} nodes) in {axes}"
        if any(isinstance(value, np.ndarray) or value for value in constraint.displacement):
            ends = [(np.min(value) * scale, np.max(value) * scale) for value in constraint.displacement]
            moves = (f"{low:.6g} to {high:.6g}" if low < high else f"{low:.6g}" for low, high in ends)
            name, text = "displaced", f"{text} by {', '.join(moves)}{unit}"
        yield Item(name, text, text)
