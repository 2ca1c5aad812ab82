"""The layout of models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import hdf5_validation
from mpitled.errors import InputError, damaged
from mpitled.laws import Material, material_of
from mpitled.model import Model
from mpitled.store.files import (
    REBUILD,
    attribute,
    check_room,
    first_broken,
    open_file,
    put,
    read_json,
    replacing,
    whole,
    write_json,
)

#: Written into every model; a file of another layout is built anew, never read by guess.
MODEL_LAYOUT = 3
MODEL_ARRAYS = {
    "points": np.float64,
    "node_ids": np.int64,
    "hexahedra": np.int64,
    "domains": np.int64,
    "domain_points": np.float64,
    "domain_volumes": np.float64,
    "domain_gradients": np.float64,
    "domain_shapes": np.float64,
    "field_domains": np.int64,
    "field_shapes": np.float64,
    "material": np.int16,
    "mass": np.float64,
    "prescribed_dofs": np.int64,
    "prescribed_displacements": np.float64,
    "prescribed_turns": np.float64,
}
#: Their rows and columns, by name or number: kernels go where these say, and look no more.
_MODEL_SHAPES: dict[str, tuple[str | int, ...]] = {
    "points": ("nodes", 3),
    "node_ids": ("nodes",),
    "hexahedra": ("hexahedra", 8),
    "domains": ("domains", "n"),
    "domain_points": ("domains", 3),
    "domain_volumes": ("domains",),
    "domain_gradients": ("domains", "n", 3),
    "domain_shapes": ("domains", "n"),
    "field_domains": ("efg_nodes",),
    "field_shapes": ("efg_nodes", "n"),
    "material": ("cells",),
    "mass": ("nodes",),
    "prescribed_dofs": ("dofs",),
    "prescribed_displacements": ("dofs",),
    "prescribed_turns": ("dofs", 3),
}
#: Numbers in SI units are smaller by far.
_LARGEST = 1e50


def write_model(path: Path, model: Model, key: str, scene: Mapping[str, Any] | None = None) -> None:
    """Write the model to `path` at once or not at all; `key` says what it was built from (see `model_key`).

    `scene` is the deck, for the export. InputError if it cannot be written.

    Arrays are contiguous, so that any range of rows is one read.
    """
    with replacing(path) as temporary, h5py.File(temporary, "w", locking=False) as file:
        check_room(path, sum(np.asarray(getattr(model, name)).nbytes for name in MODEL_ARRAYS))
        file.attrs["format"] = "mpitled model"
        file.attrs["layout"] = MODEL_LAYOUT
        file.attrs["key"] = key
        file.attrs["n_fe_nodes"] = model.n_fe_nodes
        for name, dtype in MODEL_ARRAYS.items():
            put(file, name, np.asarray(getattr(model, name), dtype))
        if model.surface_areas is not None:
            put(file, "surface_areas", model.surface_areas)
        for name in ("node_sets", "cell_sets"):
            _write_sets(file.create_group(name), getattr(model, name))
        write_json(file, "materials", [material.record() for material in model.materials])
        write_json(file, "figures", model.figures)
        write_json(file, "remarks", model.remarks)
        write_json(file, "scene", scene or {})
        file.flush()  # what fails as a file is closed is not said


def read_model(path: Path) -> Model:
    """The whole model. InputError if the file is missing, not a model, or of another layout."""
    with open_model(path) as file:
        arrays = {name: whole(file[name]) for name in MODEL_ARRAYS}
        n_nodes, n_domains, n_cells = len(file["points"]), len(file["domains"]), len(file["material"])
        node_sets, cell_sets, materials = (
            _read_sets(file["node_sets"]),
            _read_sets(file["cell_sets"]),
            read_materials(file),
        )
        check_finite(arrays)
        ends = {"hexahedra": n_nodes, "domains": n_nodes, "field_domains": n_domains, "material": len(materials)}
        for name, end in (ends | {"prescribed_dofs": 3 * n_nodes}).items():
            check_numbers(arrays[name], end, name)
        for sets, end in ((node_sets, n_nodes), (cell_sets, n_cells)):
            for name, members in sets.items():
                check_numbers(members, end, name)
        return Model(
            **arrays,
            n_fe_nodes=int(file.attrs["n_fe_nodes"]),
            node_sets=node_sets,
            cell_sets=cell_sets,
            surface_areas=whole(file["surface_areas"]) if "surface_areas" in file else None,
            materials=materials,
            figures=_read_figures(file),
            remarks=_read_remarks(file),
        )


def read_cells(path: Path) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Hexahedra (n, 8), support domains (m, k) and their points (m, 3), m: all that a partition is made from."""
    with open_model(path) as file:
        hexahedra, domains = whole(file["hexahedra"]), whole(file["domains"])
        for cells in (hexahedra, domains):
            check_numbers(cells, len(file["points"]), "cells")
        return hexahedra, domains, whole(file["domain_points"])


def read_points(path: Path) -> NDArray[np.float64]:
    """Places (n_nodes, 3), m, of the nodes."""
    with open_model(path) as file:
        return np.asarray(whole(file["points"]), np.float64)


def model_key(path: Path) -> str | None:
    """The key that the model was written with; None if there is no model of this layout."""
    try:
        with open_model(path) as file:
            return str(file.attrs["key"])
    except InputError:
        return None


def check_model(path: Path) -> None:
    """Read all of the model; InputError names what does not have the checksum that it was written with."""
    with open_model(path) as file:
        if broken := first_broken(file):
            raise InputError(f"{path}: is damaged: {broken} is not what was written")


def read_sets(path: Path) -> tuple[dict[str, NDArray[np.int64]], dict[str, NDArray[np.int64]]]:
    """Node sets and cell sets of the model, by name; ascending global numbers."""
    with open_model(path) as file:
        return _read_sets(file["node_sets"]), _read_sets(file["cell_sets"])


def read_figures(path: Path) -> dict[str, Any]:
    """What the preprocessor counted and measured, by name."""
    with open_model(path) as file:
        return _read_figures(file)


def read_scene(path: Path) -> dict[str, Any]:
    """The deck that the model was built from, in the deck's layout and units."""
    with open_model(path) as file:
        return dict(read_json(file, "scene")) if "scene" in file else {}


def read_remarks(path: Path) -> list[str]:
    """What the readers and meshers skipped, repaired or took for granted, a line each."""
    with open_model(path) as file:
        return list(_read_remarks(file))


def model_contents(path: Path) -> dict[str, Any]:
    """Sizes, sets, materials and figures of a model, as JSON can hold them."""
    with open_model(path) as file:
        return {
            "nodes": len(file["points"]),
            "fe_nodes": int(file.attrs["n_fe_nodes"]),
            "hexahedra": len(file["hexahedra"]),
            "support_domains": len(file["domains"]),
            "domain_nodes": file["domains"].shape[1],
            "prescribed_dofs": len(file["prescribed_dofs"]),
            "materials": [material.record() for material in read_materials(file)],
            "node_sets": {name: len(members) for name, members in _read_sets(file["node_sets"]).items()},
            "cell_sets": {name: len(members) for name, members in _read_sets(file["cell_sets"]).items()},
            "figures": _read_figures(file),
            "remarks": list(_read_remarks(file)),
        }


def describe_model(path: Path) -> str:
    """The contents of a model, a line each."""
    has = model_contents(path)
    lines = [
        f"nodes            {has['nodes']} ({has['fe_nodes']} FE)",
        f"hexahedra        {has['hexahedra']}",
        f"support domains  {has['support_domains']} of {has['domain_nodes']} nodes",
        f"prescribed dofs  {has['prescribed_dofs']}",
    ]
    lines += [f"material         {material_of(record).describe()}" for record in has["materials"]]
    for kind in ("node_sets", "cell_sets"):
        lines += [f"{kind[:-1].replace('_', ' '):16} {name}: {n}" for name, n in has[kind].items()]
    lines += [f"{name}: {value:.6g}" for name, value in has["figures"].items()]
    return "\n".join([*lines, *has["remarks"]])


@contextmanager
def open_model(path: Path) -> Iterator[h5py.File]:
    """A model, to be read, whose arrays fit each other. InputError if it is none of this layout."""
    with open_file(path) as file, damaged(path, REBUILD):
        if attribute(file, "format") != "mpitled model":
            raise InputError(f"{path}: is not a model of mpitled; build the model from its deck")
        if (layout := attribute(file, "layout")) != MODEL_LAYOUT:
            raise InputError(f"{path}: has layout {layout}, this version reads {MODEL_LAYOUT}; {REBUILD}")
        hdf5_validation.check_file(file, path, numbers=True)
        _check_shapes(file)
        yield file


def _check_shapes(file: h5py.File) -> None:
    """ValueError unless the arrays of a model have the types that they are written in, and fit each other."""
    n_nodes, n_fe_nodes = len(file["points"]), attribute(file, "n_fe_nodes")
    if not isinstance(n_fe_nodes, int) or not 0 <= n_fe_nodes <= n_nodes:
        raise ValueError(f"n_fe_nodes is not between 0 and {n_nodes}")
    sizes: dict[str, int] = {"efg_nodes": n_nodes - n_fe_nodes}
    sizes["cells"] = len(file["hexahedra"]) + len(file["domains"])
    for name, dtype in MODEL_ARRAYS.items():
        array = file[name]
        expected = _MODEL_SHAPES[name]
        fits = len(array.shape) == len(expected) and array.dtype == dtype
        if not fits or any(
            n != (sizes.setdefault(size, n) if isinstance(size, str) else size)
            for n, size in zip(array.shape, expected, strict=True)
        ):
            raise ValueError(f"{name} has type {array.dtype} and shape {array.shape}")
    areas = file.get("surface_areas")
    if areas is not None and (areas.shape != (n_nodes, 3) or areas.dtype != np.float64):
        raise ValueError(f"surface_areas has type {areas.dtype} and shape {areas.shape}")


def check_numbers(numbers: NDArray[np.integer], end: int, what: str) -> None:
    """ValueError unless all of them count something of which there are `end`."""
    if numbers.size and not 0 <= numbers.min() <= numbers.max() < end:
        raise ValueError(f"{what} has numbers beyond 0 to {end - 1}")


def check_finite(arrays: Mapping[str, NDArray[Any]]) -> None:
    """ValueError unless all numbers are there, and small enough to be squared and multiplied."""
    for name, values in arrays.items():
        if values.dtype.kind == "f" and not (np.abs(values) < _LARGEST).all():
            raise ValueError(f"{name} has numbers that are none, or beyond {_LARGEST:g}")


def check_ascending(numbers: NDArray[np.integer], what: str) -> None:
    """ValueError unless each number is larger than the one before."""
    if (np.diff(numbers) <= 0).any():
        raise ValueError(f"{what} do not ascend")


def _write_sets(group: h5py.Group, sets: dict[str, NDArray[np.int64]]) -> None:
    # Names go beside the numbers: a set of an input file may be called what HDF5 cannot.
    write_json(group, "names", list(sets))
    members = [np.asarray(members, np.int64) for members in sets.values()]
    put(group, "offsets", np.cumsum([0, *map(len, members)], dtype=np.int64))
    put(group, "members", np.concatenate([np.empty(0, np.int64), *members]))


def _read_sets(group: h5py.Group) -> dict[str, NDArray[np.int64]]:
    members, offsets = whole(group["members"]), whole(group["offsets"])
    check_numbers(offsets, len(members) + 1, "offsets")
    slices = [members[start:stop] for start, stop in pairwise(offsets)]
    return dict(zip(read_json(group, "names"), slices, strict=True))


def read_materials(file: h5py.File) -> tuple[Material, ...]:
    """The materials of a model, by number. ValueError if they are none."""
    materials = tuple(material_of(record) for record in read_json(file, "materials"))
    for material in materials:
        if not np.isfinite([material.density, material.lam, material.mu, *material.law.coefficients]).all():
            raise ValueError(f"material {material.name} has moduli that are no numbers")
    return materials


def _read_figures(file: h5py.File) -> dict[str, float]:
    figures = dict(read_json(file, "figures"))
    if not all(isinstance(value, int | float) for value in figures.values()):
        raise ValueError("figures holds what is no number")
    return figures


def _read_remarks(file: h5py.File) -> tuple[str, ...]:
    return tuple(map(str, read_json(file, "remarks")))
