"""The file layout of models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import hdf5_validation
from mpitled.cells.kind import KINDS, CellKind
from mpitled.errors import InputError, damaged
from mpitled.hdf5 import open_file
from mpitled.laws import Material, material_of
from mpitled.model import CellBlock, Model, ModelFigures
from mpitled.store.files import (
    REBUILD,
    attribute,
    check_free_space,
    first_damaged,
    put,
    read_checked,
    read_json,
    replacing,
    write_json,
)

#: Version of the layout. A model of another layout is rebuilt, never read.
MODEL_LAYOUT = 3
#: Arrays at the top of the file: type and shape (names of lengths, or numbers). Kernels index them without checks.
MODEL_ARRAYS: dict[str, tuple[type[np.generic], tuple[str | int, ...]]] = {
    "points": (np.float64, ("nodes", 3)),
    "node_ids": (np.int64, ("nodes",)),
    "field_domains": (np.int64, ("efg_nodes",)),
    "field_shapes": (np.float64, ("efg_nodes", "n_field")),
    "mass": (np.float64, ("nodes",)),
    "prescribed_dofs": (np.int64, ("dofs",)),
    "prescribed_displacements": (np.float64, ("dofs",)),
    "rotation_paths": (np.float64, ("dofs", 3)),
}
#: Upper bound of numbers in SI units; products of a few numbers stay finite.
_MAX_VALUE = 1e50


def block_arrays(kind: CellKind) -> dict[str, tuple[type[np.generic], tuple[str | int, ...]]]:
    """Arrays in the group of a block: types and shapes, as in `MODEL_ARRAYS`; "n" is the number of nodes per cell."""
    columns = {name: (np.float64, ("cells", *row)) for name, row in kind.columns.items()}
    return {"nodes": (np.int64, ("cells", kind.n_nodes or "n")), "material": (np.int16, ("cells",)), **columns}


class BlockGroup(NamedTuple):
    """A block of cells in an open file."""

    name: str
    kind: CellKind
    group: h5py.Group
    first: int  # number of its first cell
    n_cells: int


def model_arrays(model: Model) -> dict[str, NDArray[Any]]:
    """The arrays of a model, by their names in the file."""
    arrays = {name: np.asarray(getattr(model, name), dtype) for name, (dtype, _) in MODEL_ARRAYS.items()}
    for i, block in enumerate(model.blocks):
        of_block = {"nodes": block.nodes, "material": block.material, **block.columns}
        for name, (dtype, _) in block_arrays(block.kind).items():
            arrays[f"blocks/{i}/{name}"] = np.asarray(of_block[name], dtype)
    return arrays


def write_model(path: Path, model: Model, key: str, scene: Mapping[str, Any] | None = None) -> None:
    """Write the model atomically.

    key: identifies the input of the build, see `model_key`; scene: the deck, for the export. Arrays are contiguous, so
    that any range of rows is one read. InputError if the file cannot be written.
    """
    arrays = model_arrays(model)
    with replacing(path) as temporary, h5py.File(temporary, "w", locking=False) as file:
        check_free_space(path, sum(values.nbytes for values in arrays.values()))
        header = {"format": "mpitled model", "layout": MODEL_LAYOUT, "key": key, "n_fe_nodes": model.n_fe_nodes}
        for name, value in (header | {"n_blocks": len(model.blocks), "field_block": model.field_block}).items():
            file.attrs[name] = value
        for name, values in arrays.items():
            put(file, name, values)
        for i, block in enumerate(model.blocks):
            file[f"blocks/{i}"].attrs.update(name=block.name, kind=block.kind.name)
        if model.surface_areas is not None:
            put(file, "surface_areas", model.surface_areas)
        for name in ("node_sets", "cell_sets"):
            _write_sets(file.create_group(name), getattr(model, name))
        write_json(file, "materials", [material.record() for material in model.materials])
        write_json(file, "figures", asdict(model.figures))
        write_json(file, "remarks", model.remarks)
        write_json(file, "scene", scene or {})
        file.flush()  # errors at closing are not reported


def read_model(path: Path) -> Model:
    """The model. InputError if the file is missing, damaged, no model, or a model of another layout."""
    with open_model(path) as file:
        arrays = {name: read_checked(file[name]) for name in MODEL_ARRAYS}
        n_nodes, materials, blocks = len(file["points"]), read_materials(file), _read_blocks(file)
        node_sets, cell_sets = _read_sets(file["node_sets"]), _read_sets(file["cell_sets"])
        check_finite(arrays)
        for block in blocks:
            check_finite(block.columns)
            check_range(block.material, len(materials), f"material of {block.name}")
        field_block = str(attribute(file, "field_block"))
        n_domains = next((len(block) for block in blocks if block.name == field_block), 0)
        for name, end in (("field_domains", n_domains), ("prescribed_dofs", 3 * n_nodes)):
            check_range(arrays[name], end, name)
        for sets, end in ((node_sets, n_nodes), (cell_sets, sum(map(len, blocks)))):
            for name, members in sets.items():
                check_range(members, end, name)
        return Model(
            **arrays,
            n_fe_nodes=int(file.attrs["n_fe_nodes"]),
            blocks=blocks,
            field_block=field_block,
            node_sets=node_sets,
            cell_sets=cell_sets,
            surface_areas=read_checked(file["surface_areas"]) if "surface_areas" in file else None,
            materials=materials,
            figures=_read_figures(file),
            remarks=_read_remarks(file),
        )


def read_blocks(path: Path) -> tuple[CellBlock, ...]:
    """The blocks of cells."""
    with open_model(path) as file:
        return _read_blocks(file)


def read_points(path: Path) -> NDArray[np.float64]:
    """Positions (n_nodes, 3), m, of the nodes."""
    with open_model(path) as file:
        return np.asarray(read_checked(file["points"]), np.float64)


def model_key(path: Path) -> str | None:
    """The key that was passed to `write_model`; None if the file is no model of this layout."""
    try:
        with open_model(path) as file:
            return str(file.attrs["key"])
    except InputError:
        return None


def check_model(path: Path) -> None:
    """Check every checksum. InputError names the dataset with a wrong checksum."""
    with open_model(path) as file:
        if name := first_damaged(file):
            raise InputError(f"{path}: is damaged: {name} is not what was written")


def read_figures(path: Path) -> ModelFigures:
    """Quality figures of the model from its build."""
    with open_model(path) as file:
        return _read_figures(file)


def read_scene(path: Path) -> dict[str, Any]:
    """The deck of the model, as in the deck file."""
    with open_model(path) as file:
        return dict(read_json(file, "scene")) if "scene" in file else {}


def read_remarks(path: Path) -> list[str]:
    """Remarks of readers and meshers, one line each: skipped, repaired or assumed input."""
    with open_model(path) as file:
        return list(_read_remarks(file))


def model_contents(path: Path) -> dict[str, Any]:
    """Sizes, sets, materials and figures of a model, as a JSON value."""
    with open_model(path) as file:
        blocks = [
            {"name": b.name, "kind": b.kind.name, "cells": b.n_cells, "nodes": b.group["nodes"].shape[1]}
            for b in block_groups(file)
        ]
        return {
            "nodes": len(file["points"]),
            "fe_nodes": int(file.attrs["n_fe_nodes"]),
            "blocks": blocks,
            "prescribed_dofs": len(file["prescribed_dofs"]),
            "materials": [material.record() for material in read_materials(file)],
            "node_sets": {name: len(members) for name, members in _read_sets(file["node_sets"]).items()},
            "cell_sets": {name: len(members) for name, members in _read_sets(file["cell_sets"]).items()},
            "figures": _read_figures(file).flat(),
            "remarks": list(_read_remarks(file)),
        }


def describe_model(path: Path) -> str:
    """The contents of a model as text, one item a line."""
    contents = model_contents(path)
    lines = [f"nodes            {contents['nodes']} ({contents['fe_nodes']} FE)"]
    lines += [f"{block['name']:16} {block['cells']} of {block['nodes']} nodes" for block in contents["blocks"]]
    lines.append(f"prescribed dofs  {contents['prescribed_dofs']}")
    lines += [f"material         {material_of(record).describe()}" for record in contents["materials"]]
    for kind in ("node_sets", "cell_sets"):
        lines += [f"{kind[:-1].replace('_', ' '):16} {name}: {n}" for name, n in contents[kind].items()]
    lines += [f"{name}: {value:.6g}" for name, value in contents["figures"].items()]
    return "\n".join([*lines, *contents["remarks"]])


@contextmanager
def open_model(path: Path) -> Iterator[h5py.File]:
    """An open model whose arrays have valid shapes. InputError if the file is no model of this layout."""
    with open_file(path) as file, damaged(path, REBUILD):
        if attribute(file, "format") != "mpitled model":
            raise InputError(f"{path}: is not a model of mpitled; build the model from its deck")
        if (layout := attribute(file, "layout")) != MODEL_LAYOUT:
            raise InputError(f"{path}: has layout {layout}, this version reads {MODEL_LAYOUT}; {REBUILD}")
        hdf5_validation.check_file(file, path, numbers=True)
        _check_shapes(file)
        yield file


def block_groups(file: h5py.File) -> list[BlockGroup]:
    """The blocks of an open model, in order. ValueError if the kind of a block is unknown or a name is repeated."""
    n_blocks, blocks, first = attribute(file, "n_blocks"), list[BlockGroup](), 0
    if not isinstance(n_blocks, int) or n_blocks < 0 or n_blocks != len(file.get("blocks", ())):
        raise ValueError(f"n_blocks is not {len(file.get('blocks', ()))}")
    for i in range(n_blocks):
        group = file[f"blocks/{i}"]
        name, kind = (str(attribute(group, key)) for key in ("name", "kind"))
        if kind not in KINDS or name in {block.name for block in blocks}:
            raise ValueError(f"block {i} has the kind {kind} and the name {name}")
        blocks.append(BlockGroup(name, KINDS[kind], group, first, len(group["nodes"])))
        first += blocks[-1].n_cells
    return blocks


def _check_shapes(file: h5py.File) -> None:
    """ValueError unless the arrays of a model have the types of the layout and consistent lengths."""
    n_nodes, n_fe_nodes = len(file["points"]), attribute(file, "n_fe_nodes")
    if not isinstance(n_fe_nodes, int) or not 0 <= n_fe_nodes <= n_nodes:
        raise ValueError(f"n_fe_nodes is not between 0 and {n_nodes}")
    lengths = {"nodes": n_nodes, "efg_nodes": n_nodes - n_fe_nodes}
    blocks = block_groups(file)
    for block in blocks:
        if block.name == attribute(file, "field_block"):
            lengths["n_field"] = block.group["nodes"].shape[-1]
        _check_arrays(block.group, block_arrays(block.kind), {})
    if n_nodes > n_fe_nodes and "n_field" not in lengths:
        raise ValueError("there is no block with the name in field_block")
    _check_arrays(file, MODEL_ARRAYS, lengths)
    if "surface_areas" in file:
        _check_arrays(file, {"surface_areas": (np.float64, ("nodes", 3))}, lengths)


def _check_arrays(
    group: h5py.Group, arrays: Mapping[str, tuple[type[np.generic], tuple[str | int, ...]]], lengths: dict[str, int]
) -> None:
    """ValueError unless the arrays have these types and shapes; adds unknown lengths to `lengths`."""
    for name, (dtype, expected) in arrays.items():
        array = group[name]
        fits = len(array.shape) == len(expected) and array.dtype == dtype
        if not fits or any(
            n != (lengths.setdefault(length, n) if isinstance(length, str) else length)
            for n, length in zip(array.shape, expected, strict=True)
        ):
            raise ValueError(f"{array.name} has type {array.dtype} and shape {array.shape}")


def check_range(numbers: NDArray[np.integer], end: int, name: str) -> None:
    """ValueError unless all numbers are in 0 ... end - 1."""
    if numbers.size and not 0 <= numbers.min() <= numbers.max() < end:
        raise ValueError(f"{name} has numbers outside of 0 to {end - 1}")


def check_finite(arrays: Mapping[str, NDArray[Any]]) -> None:
    """ValueError unless the absolute values of all real numbers are below `_MAX_VALUE`."""
    for name, values in arrays.items():
        if values.dtype.kind == "f" and not (np.abs(values) < _MAX_VALUE).all():
            raise ValueError(f"{name} has numbers that are not finite or exceed {_MAX_VALUE:g}")


def check_ascending(numbers: NDArray[np.integer], name: str) -> None:
    """ValueError unless the numbers ascend without repetition."""
    if (np.diff(numbers) <= 0).any():
        raise ValueError(f"{name} do not ascend")


def _read_blocks(file: h5py.File) -> tuple[CellBlock, ...]:
    blocks = []
    for block in block_groups(file):
        nodes, material = (read_checked(block.group[name]) for name in ("nodes", "material"))
        check_range(nodes, len(file["points"]), f"nodes of {block.name}")
        columns = {name: read_checked(block.group[name]) for name in block.kind.columns}
        blocks.append(CellBlock(block.name, block.kind, nodes, material, columns))
    return tuple(blocks)


def _write_sets(group: h5py.Group, sets: dict[str, NDArray[np.int64]]) -> None:
    # Names are stored as data, because input files allow names that HDF5 does not allow.
    write_json(group, "names", list(sets))
    members = [np.asarray(members, np.int64) for members in sets.values()]
    put(group, "offsets", np.cumsum([0, *map(len, members)], dtype=np.int64))
    put(group, "members", np.concatenate([np.empty(0, np.int64), *members]))


def _read_sets(group: h5py.Group) -> dict[str, NDArray[np.int64]]:
    members, offsets = read_checked(group["members"]), read_checked(group["offsets"])
    check_range(offsets, len(members) + 1, "offsets")
    slices = [members[start:stop] for start, stop in pairwise(offsets)]
    return dict(zip(read_json(group, "names"), slices, strict=True))


def read_materials(file: h5py.File) -> tuple[Material, ...]:
    """The materials of a model, by number. ValueError if their constants are not finite."""
    materials = tuple(material_of(record) for record in read_json(file, "materials"))
    for material in materials:
        if not np.isfinite([material.density, material.lam, material.mu, *material.law.coefficients]).all():
            raise ValueError(f"material {material.name} has moduli that are not finite")
    return materials


def _read_figures(file: h5py.File) -> ModelFigures:
    stored = dict(read_json(file, "figures"))
    numbers = {**stored, **stored.get("of_mesh", {})}
    numbers.pop("of_mesh", None)
    if not all(isinstance(value, int | float | None) for value in numbers.values()):
        raise ValueError("figures has values that are no numbers")
    return ModelFigures(**{item.name: stored[item.name] for item in fields(ModelFigures) if item.name in stored})


def _read_remarks(file: h5py.File) -> tuple[str, ...]:
    return tuple(map(str, read_json(file, "remarks")))
