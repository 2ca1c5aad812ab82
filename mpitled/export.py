"""Export a model: the FE mesh and the cloud as Abaqus files, integration points as CSV, and the scene as TOML.

Numbers are in SI units, written as the shortest decimals that are read as the same floats. Nodes and cells keep the
model's order. So the exported scene gives the same model, bit for bit, unless the cloud has several materials: the
files do not hold the material of a node, so that support domains have nodes of all materials. The scene notes this.

Abaqus has a slightly different neo-Hookean law (see `_LAW`). C10 and D1 determine E and nu only up to round-off:
therefore the scene has E and nu.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import atomic, store, toml
from mpitled.deck import GEOMETRIES
from mpitled.errors import InputError
from mpitled.laws import Material, NeoHookean
from mpitled.model import Model
from mpitled.readers.meshfile import MAX_ID

FE, EFG, GRID, AREAS, SCENE = "fe.inp", "efg.inp", "integration_points.csv", "surface_areas.csv", "scene.toml"
#: *ELASTIC is hypoelastic in a step with NLGEOM: it differs more from the law of the model than this law.
_LAW = (
    "** mpitled has the energy mu/2 (I1 - 3) - mu ln J + lambda/2 (J - 1)^2, and Abaqus\n"
    "** C10 (J^(-2/3) I1 - 3) + (J - 1)^2/D1. With C10 = mu/2 and D1 = 2/(lambda + 2 mu/3)\n"
    "** they agree for small strain and where J = 1, and differ in large changes of volume.\n"
)
_ROW = 16  # numbers in a line of a set
_CHUNK = 1 << 16  # lines in one piece of text


def write_abaqus(path: Path, directory: Path) -> list[Path]:
    """Export the model of a file into a directory and return the paths. InputError if Abaqus cannot hold the model."""
    model, scene = store.read_model(path), store.read_scene(path)
    _check_names(path, model)
    model = _with_material_sets(model)
    ids = _node_numbers(model)
    contents: dict[str, Iterable[str]] = {}
    if model.n_fe_nodes:
        contents[FE] = _fe(model, ids)
    if len(model.domains):
        contents[EFG] = _efg(model, ids)
        contents[GRID] = _grid(model)
        if model.surface_areas is not None:
            contents[AREAS] = _areas(model.surface_areas, ids)
    contents[SCENE] = _scene(model, scene, list(contents))
    atomic.make_folder(directory)
    for name, lines in contents.items():
        atomic.write_text(directory / name, lines)
    return [directory / name for name in contents]


def _check_names(path: Path, model: Model) -> None:
    """InputError for names of sets that Abaqus refuses or does not distinguish."""
    for sets in (model.node_sets, model.cell_sets):
        names: dict[str, str] = {}
        for name in sets:
            other = names.setdefault(name.casefold(), name)
            if other != name:
                raise InputError(f"{path}: Abaqus does not distinguish sets '{other}' and '{name}'; rename one")
            if name != name.strip() or not name or any(mark in name for mark in '";\n\r'):
                raise InputError(f"{path}: set {name!r} has a name that Abaqus cannot hold; rename it")


def _node_numbers(model: Model) -> NDArray[np.int64]:
    """Numbers of the nodes in the files: those of the model if they are unique and valid, else the rows from 1."""
    ids = model.node_ids
    unique = len(np.unique(ids)) == len(ids) and ids.min() >= 1 and ids.max() <= MAX_ID
    return ids if unique else np.arange(1, len(ids) + 1)


def _with_material_sets(model: Model) -> Model:
    """The model with cell sets that give the cells of each material."""
    sets = dict(model.cell_sets)
    for i, material in enumerate(model.materials):
        cells = np.flatnonzero(model.material == i)
        if len(cells) and not _sets_of(cells, sets):
            sets[_free_name(f"material {material.name}", sets)] = cells
    return replace(model, cell_sets=sets)


def _free_name(name: str, used: Container[str]) -> str:
    while name in used:
        name += "_"
    return name


def _sets_of(cells: NDArray[np.int64], sets: dict[str, NDArray[np.int64]]) -> list[str]:
    """Names of disjoint sets whose union is these cells; empty if there are no such sets."""
    chosen, remaining = [], np.zeros(int(cells.max(initial=-1)) + 1, bool)
    remaining[cells] = True
    inside = {name: members for name, members in sets.items() if len(members) and members[-1] < len(remaining)}
    for name in sorted(inside, key=lambda name: -len(inside[name])):
        if remaining[inside[name]].all():
            chosen.append(name)
            remaining[inside[name]] = False
    return chosen if not remaining.any() else []


# --- the decks -----------------------------------------------------------------------------------------------------


def _fe(model: Model, ids: NDArray[np.int64]) -> Iterator[str]:
    n, n_cells = model.n_fe_nodes, len(model.hexahedra)
    yield "*HEADING\nFE mesh, in m, Pa, kg and s\n"
    yield from _nodes(ids[:n], model.points[:n])
    yield "*ELEMENT, TYPE=C3D8R\n"
    yield from _rows(np.concatenate([np.arange(1, n_cells + 1)[:, None], ids[model.hexahedra]], axis=1))
    yield from _all_sets("NSET", model.node_sets, ids, 0, n)
    cell_ids = np.arange(1, n_cells + 1)
    yield from _all_sets("ELSET", {k: v for k, v in model.cell_sets.items() if k != "all"}, cell_ids, 0, n_cells)
    yield f"*ELSET, ELSET=all, GENERATE\n1, {n_cells}, 1\n"
    for i, material in enumerate(model.materials):
        for name in _sets_of(np.flatnonzero(model.material == i), model.cell_sets):
            if len(model.cell_sets[name]) and model.cell_sets[name][0] < n_cells:
                yield f"*SOLID SECTION, ELSET={_quoted(name)}, MATERIAL={_quoted(material.name)}\n"
        yield f"*MATERIAL, NAME={_quoted(material.name)}\n*DENSITY\n{material.density!r}\n"
        yield _abaqus_law(material)
    yield from _boundary(model, ids, 0, n)


def _abaqus_law(material: Material) -> str:
    """The law of a material for Abaqus. InputError unless it is neo-Hookean."""
    law = material.law
    if not isinstance(law, NeoHookean):
        raise InputError(f"material.{material.name}: Abaqus decks hold neo-hookean materials, not {law.name}")
    bulk = law.youngs_modulus / (3 * (1 - 2 * law.poissons_ratio))
    return f"{_LAW}*HYPERELASTIC, NEO HOOKE\n{law.mu / 2!r}, {2 / bulk!r}\n"


def _efg(model: Model, ids: NDArray[np.int64]) -> Iterator[str]:
    n, n_nodes = model.n_fe_nodes, model.n_nodes
    yield "*HEADING\nNodes of the cloud, in m\n"
    yield from _nodes(ids[n:], model.points[n:])
    yield from _all_sets("NSET", model.node_sets, ids, n, n_nodes)
    yield from _boundary(model, ids, n, n_nodes)


def _nodes(ids: NDArray[np.int64], points: NDArray[np.float64]) -> Iterator[str]:
    yield "*NODE\n"
    for first in range(0, len(ids), _CHUNK):
        chunk = slice(first, first + _CHUNK)
        rows = zip(ids[chunk].tolist(), points[chunk].tolist(), strict=True)
        yield "".join(f"{number}, {x!r}, {y!r}, {z!r}\n" for number, (x, y, z) in rows)


def _rows(numbers: NDArray[np.int64]) -> Iterator[str]:
    for first in range(0, len(numbers), _CHUNK):
        yield "".join(", ".join(map(str, row)) + "\n" for row in numbers[first : first + _CHUNK].tolist())


def _all_sets(
    keyword: str, sets: dict[str, NDArray[np.int64]], ids: NDArray[np.int64], first: int, stop: int
) -> Iterator[str]:
    """The members of the sets from `first` to before `stop`; empty sets are written in the first file only."""
    for name, members in sets.items():
        inside = members[(members >= first) & (members < stop)]
        if len(inside) or (not len(members) and first == 0):
            yield f"*{keyword}, {keyword}={_quoted(name)}\n"
            numbers = ids[inside].tolist()
            yield from (", ".join(map(str, numbers[i : i + _ROW])) + "\n" for i in range(0, len(numbers), _ROW))


def _boundary(model: Model, ids: NDArray[np.int64], first: int, stop: int) -> Iterator[str]:
    """Fixed nodes as model data, displaced nodes as a step: by set if all of its nodes are prescribed, else by node."""
    value = np.full((model.n_nodes, 3), np.nan)
    value.ravel()[model.prescribed_dofs] = model.prescribed_displacements
    value[:first] = np.nan
    value[stop:] = np.nan
    fixed: list[str] = []
    displaced: list[str] = []
    by_set: list[list[str]] = []  # for each set with different displacements, so that a reader finds the set again
    for name, members in sorted(model.node_sets.items(), key=lambda item: -len(item[1])):
        inside = members[(members >= first) & (members < stop)]
        rows = []
        for direction in range(3) if len(inside) else ():
            values = value[inside, direction].copy()
            if np.isnan(values).any():
                continue
            if (values == values[0]).all():
                line = f"{_quoted(name)}, {direction + 1}, {direction + 1}"
                (fixed if values[0] == 0 else displaced).append(f"{line}, {values[0].item()!r}\n")
            else:
                rows += _by_node(ids[inside], direction, values)
            value[inside, direction] = np.nan
        if rows:
            by_set.append(rows)
    for direction in range(3):
        nodes = np.flatnonzero(~np.isnan(value[:, direction]))
        values = value[nodes, direction]
        fixed += _by_node(ids[nodes[values == 0]], direction, values[values == 0])
        displaced += _by_node(ids[nodes[values != 0]], direction, values[values != 0])
    if fixed:
        yield "*BOUNDARY\n" + "".join(line.rpartition(", ")[0] + "\n" for line in fixed)
    if displaced or by_set:
        yield "*STEP, NLGEOM=YES\n*STATIC\n"
        yield from ("*BOUNDARY\n" + "".join(rows) for rows in (displaced, *by_set) if rows)
        yield "*END STEP\n"


def _by_node(ids: NDArray[np.int64], direction: int, values: NDArray[np.float64]) -> list[str]:
    dof = direction + 1
    return [f"{n}, {dof}, {dof}, {value!r}\n" for n, value in zip(ids.tolist(), values.tolist(), strict=True)]


def _grid(model: Model) -> Iterator[str]:
    yield "x,y,z,volume,sets\n"
    names = [""] * len(model.domains)
    for name, members in model.cell_sets.items():
        if name != "all":
            for point in model.rows_of("support domains", members).tolist():
                names[point] += f";{name}"
    rows = np.column_stack([model.domain_points, model.domain_volumes]).tolist()
    for (x, y, z, volume), sets in zip(rows, names, strict=True):
        yield f"{x!r},{y!r},{z!r},{volume!r},{sets[1:] or 'all'}\n"


def _areas(areas: NDArray[np.float64], ids: NDArray[np.int64]) -> Iterator[str]:
    yield "node,x,y,z\n"
    nodes = np.flatnonzero((areas != 0).any(axis=1))
    for number, (x, y, z) in zip(ids[nodes].tolist(), areas[nodes].tolist(), strict=True):
        yield f"{number},{x!r},{y!r},{z!r}\n"


def _quoted(name: str) -> str:
    """A name for Abaqus: in quotation marks unless it has letters, digits and underscores only."""
    return name if re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) else f'"{name}"'


# --- the scene -----------------------------------------------------------------------------------------------------


def _scene(model: Model, scene: dict[str, Any], files: Sequence[str]) -> Iterator[str]:
    """The deck from which the model was built, with these files in place of its geometry."""
    yield "# Written by mpitled export. Fixed and displaced nodes are in the files of [mesh], rotations are below.\n"
    if model.figures.cloud_parts > 1:
        yield "# In the model each support domain has nodes of its own material only, but not if built from here.\n"
    names = {"fe": FE, "efg": EFG, "integration_points": GRID, "surface_areas": AREAS}
    mesh = {key: name for key, name in names.items() if name in files} | {"unit": "m", "merge_tolerance": 0.0}
    materials: dict[str, Any] = {}
    for i, material in enumerate(model.materials):
        if sets := _sets_of(np.flatnonzero(model.material == i), model.cell_sets):
            keys = {key: value for key, value in material.record().items() if key not in ("name", "law")}
            materials[_free_name(material.name, materials)] = keys | {"cells": sets}
    removed = (*GEOMETRIES, "cloud", "sphere", "material", "fixed", "displaced")
    kept = {key: value for key, value in scene.items() if key not in removed}
    # The files have the final displacement of rotated nodes, but not their circular path.
    rotated = [entry for entry in scene.get("displaced", ()) if entry["rotation"]]
    deck = {"title": scene.get("title", ""), "mesh": mesh} | kept | {"displaced": rotated, "material": materials}
    yield "\n".join(toml.lines({key: value for key, value in deck.items() if value}))
