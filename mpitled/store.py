"""Every HDF5 layout: the model, its partitions, the results as VTKHDF, and checkpoints; all with checksums."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import checksum, room, vet
from mpitled.errors import InputError, damaged
from mpitled.material import Material
from mpitled.model import Model

if TYPE_CHECKING:
    from partition import PartTables

#: Written into every model; a file of another layout is built anew, never read by guess.
MODEL_LAYOUT = 2

#: Files of results and checkpoints of another layout are refused too.
RESULT_LAYOUT, CHECKPOINT_LAYOUT = 1, 1

#: Bytes that are read over rather than skipped: about what one more call of HDF5 costs (70 us at 3.5 GB/s).
_GAP_BYTES = 1 << 18
#: Bytes held at most at a time beside what is asked for; stays in the cache.
_BLOCK_BYTES = 1 << 22

_MODEL_ARRAYS = {
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
_REBUILD, _AGAIN = "build the model anew", "run the deck again"
#: Numbers in SI units are smaller by far.
_LARGEST = 1e50


def hdf5_version() -> str:
    """Version of the HDF5 library that h5py was built on."""
    return str(h5py.version.hdf5_version)


def has_mpi() -> bool:
    """Whether several ranks can write one file."""
    return bool(h5py.get_config().mpi)


# --- the model ---------------------------------------------------------------------------------------------------


def write_model(path: Path, model: Model, key: str, scene: Mapping[str, Any] | None = None) -> None:
    """Write the model to `path` at once or not at all; `key` says what it was built from (see `model_key`).

    `scene` is the deck, for the export. InputError if it cannot be written.

    Arrays are contiguous, so that any range of rows is one read.
    """
    with _replacing(path) as temporary, h5py.File(temporary, "w", locking=False) as file:
        _room(path, sum(np.asarray(getattr(model, name)).nbytes for name in _MODEL_ARRAYS))
        file.attrs["format"] = "mpitled model"
        file.attrs["layout"] = MODEL_LAYOUT
        file.attrs["key"] = key
        file.attrs["n_fe_nodes"] = model.n_fe_nodes
        for name, dtype in _MODEL_ARRAYS.items():
            _put(file, name, np.asarray(getattr(model, name), dtype))
        if model.surface_areas is not None:
            _put(file, "surface_areas", model.surface_areas)
        for name in ("node_sets", "cell_sets"):
            _write_sets(file.create_group(name), getattr(model, name))
        _write_json(file, "materials", [asdict(material) for material in model.materials])
        _write_json(file, "figures", model.figures)
        _write_json(file, "remarks", model.remarks)
        _write_json(file, "scene", scene or {})
        file.flush()  # what fails as a file is closed is not said


def read_model(path: Path) -> Model:
    """The whole model. InputError if the file is missing, not a model, or of another layout."""
    with _open_model(path) as file:
        arrays = {name: file[name][...] for name in _MODEL_ARRAYS}
        n_nodes, n_domains, n_cells = len(file["points"]), len(file["domains"]), len(file["material"])
        node_sets, cell_sets, materials = (
            _read_sets(file["node_sets"]),
            _read_sets(file["cell_sets"]),
            _read_materials(file),
        )
        _check_finite(arrays)
        ends = {"hexahedra": n_nodes, "domains": n_nodes, "field_domains": n_domains, "material": len(materials)}
        for name, end in (ends | {"prescribed_dofs": 3 * n_nodes}).items():
            _check_numbers(arrays[name], end, name)
        for sets, end in ((node_sets, n_nodes), (cell_sets, n_cells)):
            for name, members in sets.items():
                _check_numbers(members, end, name)
        return Model(
            **arrays,
            n_fe_nodes=int(file.attrs["n_fe_nodes"]),
            node_sets=node_sets,
            cell_sets=cell_sets,
            surface_areas=file["surface_areas"][...] if "surface_areas" in file else None,
            materials=materials,
            figures=_read_figures(file),
            remarks=_read_remarks(file),
        )


def read_cells(path: Path) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Hexahedra (n, 8), support domains (m, k) and their points (m, 3), m: all that a partition is made from."""
    with _open_model(path) as file:
        hexahedra, domains = file["hexahedra"][...], file["domains"][...]
        for cells in (hexahedra, domains):
            _check_numbers(cells, len(file["points"]), "cells")
        return hexahedra, domains, file["domain_points"][...]


def read_points(path: Path) -> NDArray[np.float64]:
    """Places (n_nodes, 3), m, of the nodes."""
    with _open_model(path) as file:
        return np.asarray(file["points"][...], np.float64)


def model_key(path: Path) -> str | None:
    """The key that the model was written with; None if there is no model of this layout."""
    try:
        with _open_model(path) as file:
            return str(file.attrs["key"])
    except InputError:
        return None


def check_model(path: Path) -> None:
    """Read all of the model; InputError names what does not have the checksum that it was written with."""
    with _open_model(path) as file:
        if broken := _first_broken(file):
            raise InputError(f"{path}: is damaged: {broken} is not what was written")


def read_sets(path: Path) -> tuple[dict[str, NDArray[np.int64]], dict[str, NDArray[np.int64]]]:
    """Node sets and cell sets of the model, by name; ascending global numbers."""
    with _open_model(path) as file:
        return _read_sets(file["node_sets"]), _read_sets(file["cell_sets"])


def read_figures(path: Path) -> dict[str, Any]:
    """What the preprocessor counted and measured, by name."""
    with _open_model(path) as file:
        return _read_figures(file)


def read_scene(path: Path) -> dict[str, Any]:
    """The deck that the model was built from, in the deck's layout and units."""
    with _open_model(path) as file:
        return dict(_read_json(file, "scene")) if "scene" in file else {}


def read_remarks(path: Path) -> list[str]:
    """What the readers and meshers skipped, repaired or took for granted, a line each."""
    with _open_model(path) as file:
        return list(_read_remarks(file))


def model_contents(path: Path) -> dict[str, Any]:
    """Sizes, sets, materials and figures of a model, as JSON can hold them."""
    with _open_model(path) as file:
        return {
            "nodes": len(file["points"]),
            "fe_nodes": int(file.attrs["n_fe_nodes"]),
            "hexahedra": len(file["hexahedra"]),
            "support_domains": len(file["domains"]),
            "domain_nodes": file["domains"].shape[1],
            "prescribed_dofs": len(file["prescribed_dofs"]),
            "materials": [asdict(material) for material in _read_materials(file)],
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
    lines += [
        f"material         {m.name}: E {m.youngs_modulus:g} Pa, nu {m.poissons_ratio:g}, {m.density:g} kg/m3"
        for m in (Material(**values) for values in has["materials"])
    ]
    for kind in ("node_sets", "cell_sets"):
        lines += [f"{kind[:-1].replace('_', ' '):16} {name}: {n}" for name, n in has[kind].items()]
    lines += [f"{name}: {value:.6g}" for name, value in has["figures"].items()]
    return "\n".join([*lines, *has["remarks"]])


def read_grid(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (n, 3) and volumes (n,) of a grid of integration points: datasets x, y, z, volume at the file's top."""
    with _open(path) as file, damaged(path, "write it anew"):
        names = ("x", "y", "z", "volume")
        if missing := [name for name in names if name not in file]:
            raise InputError(f"{path}: has no dataset '{missing[0]}'; give x, y, z and volume")
        given = [vet.member(file, name, path) for name in names]
        kinds = {item.dtype.kind if isinstance(item, h5py.Dataset) else "" for item in given}
        if not kinds <= set("fiu") or {len(item.shape or ()) for item in given} != {1} or len({*map(len, given)}) > 1:
            raise InputError(f"{path}: x, y, z and volume are not four lists of as many numbers; correct them")
        for item in given:
            vet.check_dataset(item, path)
        # Packed data may be a thousand times what is in the file.
        room.check_memory(32 * len(given[0]), f"{path}: its {len(given[0])} points", "give fewer")
        columns = [item[...].astype(np.float64) for item in given]
    return np.stack(columns[:3], axis=1), columns[3]


def write_columns(path: Path, groups: Mapping[str, Mapping[str, Sequence[float | str]]]) -> None:
    """Columns of tables, a group for each table, at once or not at all: numbers, or where there are others, text."""
    with _replacing(path) as temporary, h5py.File(temporary, "w", locking=False) as file:
        for name, columns in groups.items():
            group = file.create_group(name, track_order=True)
            for column, values in columns.items():
                text = any(isinstance(value, str) for value in values)
                data: Any = [str(value) for value in values] if text else np.asarray(values, np.float64)
                group.create_dataset(column, data=data, dtype=h5py.string_dtype() if text else None)


@contextmanager
def _open_model(path: Path) -> Iterator[h5py.File]:
    with _open(path) as file, damaged(path, _REBUILD):
        if _attribute(file, "format") != "mpitled model":
            raise InputError(f"{path}: is not a model of mpitled; build the model from its deck")
        if (layout := _attribute(file, "layout")) != MODEL_LAYOUT:
            raise InputError(f"{path}: has layout {layout}, this version reads {MODEL_LAYOUT}; {_REBUILD}")
        vet.check_file(file, path, numbers=True)
        _check_shapes(file)
        yield file


def _attribute(holder: h5py.Group, name: str) -> str | int | None:
    """A text or a whole number, if it is there as one: what else attributes can hold is never read."""
    if name not in holder.attrs:
        return None
    kind = holder.attrs.get_id(name)
    if kind.shape != () or (kind.dtype.kind not in "iuS" and not h5py.check_string_dtype(kind.dtype)):
        raise ValueError(f"attribute {name} is neither a number nor text")
    value = holder.attrs[name]
    return value if isinstance(value, str) else value.decode() if isinstance(value, bytes) else int(value)


def _check_shapes(file: h5py.File) -> None:
    """ValueError unless the arrays of a model have the types that they are written in, and fit each other."""
    n_nodes, n_fe_nodes = len(file["points"]), _attribute(file, "n_fe_nodes")
    if not isinstance(n_fe_nodes, int) or not 0 <= n_fe_nodes <= n_nodes:
        raise ValueError(f"n_fe_nodes is not between 0 and {n_nodes}")
    sizes: dict[str, int] = {"efg_nodes": n_nodes - n_fe_nodes}
    sizes["cells"] = len(file["hexahedra"]) + len(file["domains"])
    for name, dtype in _MODEL_ARRAYS.items():
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


def _check_numbers(numbers: NDArray[np.integer], end: int, what: str) -> None:
    """ValueError unless all of them count something of which there are `end`."""
    if numbers.size and not 0 <= numbers.min() <= numbers.max() < end:
        raise ValueError(f"{what} has numbers beyond 0 to {end - 1}")


def _check_finite(arrays: Mapping[str, NDArray[Any]]) -> None:
    """ValueError unless all numbers are there, and small enough to be squared and multiplied."""
    for name, values in arrays.items():
        if values.dtype.kind == "f" and not (np.abs(values) < _LARGEST).all():
            raise ValueError(f"{name} has numbers that are none, or beyond {_LARGEST:g}")


def _check_ascending(numbers: NDArray[np.integer], what: str) -> None:
    if (np.diff(numbers) <= 0).any():
        raise ValueError(f"{what} do not ascend")


def _open(path: Path) -> h5py.File:
    # No locks: every rank reads the same file, and network file systems often refuse them.
    try:
        return h5py.File(path, "r", locking=False)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read as HDF5 ({str(error).splitlines()[0]})") from None


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its name, safe on disc, when the block ends well."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    with _told(path):
        try:
            yield temporary
            _fsync(temporary)
            os.replace(temporary, path)
            _fsync(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """What the disc refuses, as one line that names the file."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be written ({str(error).splitlines()[0]})") from None


def _room(path: Path, size: int) -> None:
    """InputError if the disc has no room for so many bytes, some of HDF5's own added: HDF5 takes a full disc badly."""
    needed, free = size + size // 50 + (1 << 16), shutil.disk_usage(Path(path).parent).free
    if free < needed:
        raise InputError(
            f"{path}: cannot be written (it takes {needed / 1e6:.2f} MB, the disc has {free / 1e6:.2f} MB left)"
        )


def _reserve(path: Path) -> None:
    """Take the room that the file says it has from the disc, so that no write into it finds the disc full."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.posix_fallocate(descriptor, 0, os.fstat(descriptor).st_size)
    finally:
        os.close(descriptor)


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_sets(group: h5py.Group, sets: dict[str, NDArray[np.int64]]) -> None:
    # Names go beside the numbers: a set of an input file may be called what HDF5 cannot.
    _write_json(group, "names", list(sets))
    members = [np.asarray(members, np.int64) for members in sets.values()]
    _put(group, "offsets", np.cumsum([0, *map(len, members)], dtype=np.int64))
    _put(group, "members", np.concatenate([np.empty(0, np.int64), *members]))


def _read_sets(group: h5py.Group) -> dict[str, NDArray[np.int64]]:
    members, offsets = group["members"][...], group["offsets"][...]
    _check_numbers(offsets, len(members) + 1, "offsets")
    slices = [members[start:stop] for start, stop in pairwise(offsets)]
    return dict(zip(_read_json(group, "names"), slices, strict=True))


def _write_json(group: h5py.Group, name: str, value: Any) -> None:
    # numpy's numbers become Python's.
    text = json.dumps(value, default=lambda number: number.item()).encode()
    _put(group, name, np.bytes_(text))


def _read_json(group: h5py.Group, name: str) -> Any:
    text = group[name]
    if text.attrs.get("checksum", _sum(text)) != _sum(text):
        raise InputError(f"{group.file.filename}: {text.name} is not what was written; the file is damaged")
    return json.loads(text[()])


def _put(group: h5py.Group, name: str, values: Any) -> None:
    """A dataset with its checksum."""
    dataset = group.create_dataset(name, data=values)
    dataset.attrs["checksum"] = checksum.total([checksum.share(np.asarray(values), 0)])


def _sum(dataset: h5py.Dataset, first: int = 0, count: int | None = None) -> int:
    """Checksum of `count` rows, read block by block."""
    if not dataset.shape:
        return checksum.total([checksum.share(np.asarray(dataset[()]), 0)])
    last = len(dataset) if count is None else first + count
    entries = int(np.prod(dataset.shape[1:]))
    rows = max(1, _BLOCK_BYTES // max(1, entries * dataset.dtype.itemsize))
    return checksum.total(
        checksum.share(dataset[start : min(start + rows, last)], (start - first) * entries)
        for start in range(first, last, rows)
    )


def _first_broken(file: h5py.File) -> str | None:
    """The first dataset that has another checksum than it was written with."""

    def look(name: str, thing: h5py.Group | h5py.Dataset) -> str | None:
        there = isinstance(thing, h5py.Dataset) and "checksum" in thing.attrs
        return name if there and thing.attrs["checksum"] != _sum(thing) else None

    return file.visititems(look)


def _read_materials(file: h5py.File) -> tuple[Material, ...]:
    materials = tuple(Material(**values) for values in _read_json(file, "materials"))
    for material in materials:
        _, *numbers = asdict(material).values()
        if not np.isfinite(numbers).all() or not np.isfinite([material.lam, material.mu]).all():
            raise ValueError(f"material {material.name} has moduli that are no numbers")
    return materials


def _read_figures(file: h5py.File) -> dict[str, float]:
    figures = dict(_read_json(file, "figures"))
    if not all(isinstance(value, int | float) for value in figures.values()):
        raise ValueError("figures holds what is no number")
    return figures


def _read_remarks(file: h5py.File) -> tuple[str, ...]:
    return tuple(map(str, _read_json(file, "remarks")))


# --- partitions --------------------------------------------------------------------------------------------------


def write_partition(path: Path, tables: PartTables) -> None:
    """Add the partition to the model, in place of one of as many parts.

    The model is copied and the copy takes its name: HDF5 keeps no journal, so that an append cut short
    could cost the model. Beside the tables it keeps the row of every node in the result files: owned nodes
    of part 0 ascending, then those of part 1, and so on.
    """
    with _open_model(path) as file:
        n_nodes = len(file["points"])
    # The first of several mentions is the lowest part's, which owns the node.
    touched, first = np.unique(tables.nodes, return_index=True)
    if len(touched) != n_nodes:
        raise InputError(f"{path}: {n_nodes - len(touched)} nodes are on no part; partition the model anew")
    owner = np.searchsorted(tables.node_offsets, first, side="right") - 1
    rows = np.empty(n_nodes, np.int64)
    rows[np.argsort(owner, kind="stable")] = np.arange(n_nodes)

    with _replacing(path) as temporary:
        _room(path, Path(path).stat().st_size + sum(np.asarray(getattr(tables, f.name)).nbytes for f in fields(tables)))
        shutil.copyfile(path, temporary)
        with h5py.File(temporary, "r+", locking=False) as file:
            name = f"partitions/{tables.n_parts}"
            if name in file:
                del file[name]
            group = file.create_group(name)
            for column in fields(tables):
                if column.name != "n_parts":
                    _put(group, column.name, getattr(tables, column.name))
            _put(group, "rows", rows)
            file.flush()


def has_partition(path: Path, n_parts: int) -> bool:
    """Whether the model can be read in so many parts; one part needs no partition."""
    with _open_model(path) as file:
        return n_parts == 1 or f"partitions/{n_parts}" in file


def partition_mark(path: Path, n_parts: int) -> str:
    """What tells partitions in as many parts from each other. InputError if there is none."""
    with _open_model(path) as file:
        if n_parts == 1:
            return "whole"
        if f"partitions/{n_parts}" not in file:
            raise InputError(f"{path}: has no partition in {n_parts} parts; partition the model first")
        return f"{n_parts}:{int(file[f'partitions/{n_parts}/nodes'].attrs['checksum']) % (1 << 64):016x}"


@dataclass(frozen=True, slots=True)
class PartRows:
    """The rows of the model that one part needs, in SI units and global numbers.

    A cell is on one part; a node is on every part whose cells touch it, and the lowest of them owns it.
    """

    n_parts: int
    part: int
    n_nodes: int  # of the whole model
    n_fe_nodes: int  # of the whole model
    n_hexahedra: int  # of the whole model
    n_domains: int  # of the whole model
    cells: NDArray[np.int64]  # (n,) ascending: this part's hexahedra, then its support domains
    nodes: NDArray[np.int64]  # (k,) ascending nodes that these cells touch
    node_ids: NDArray[np.int64]  # (k,) numbers in the file that the nodes came from
    rows: NDArray[np.int64]  # (k,) row of each node in the result files
    owned: NDArray[np.bool_]  # (k,)
    first_row: int  # row of the first owned node; owned nodes follow each other
    points: NDArray[np.float64]  # (k, 3), m
    mass: NDArray[np.float64]  # (k,), kg, of the whole model's cells
    hexahedra: NDArray[np.int64]  # (n_own_hexahedra, 8), nodes
    domains: NDArray[np.int64]  # (n_own_domains, n), nodes
    domain_points: NDArray[np.float64]  # (n_own_domains, 3), m
    domain_volumes: NDArray[np.float64]  # (n_own_domains,), m^3
    domain_gradients: NDArray[np.float64]  # (n_own_domains, n, 3), 1/m
    domain_shapes: NDArray[np.float64]  # (n_own_domains, n)
    material: NDArray[np.int16]  # (n,)
    materials: tuple[Material, ...]
    prescribed_dofs: NDArray[np.int64]  # ascending 3 node + direction, on `nodes`
    prescribed_displacements: NDArray[np.float64]  # m
    prescribed_turns: NDArray[np.float64]  # (len(prescribed_dofs), 3)
    field_nodes: NDArray[np.int64]  # ascending EFG nodes whose field one of `domains` gives; not all in `nodes`
    field_domains: NDArray[np.int64]  # the support domain of each, a number of the whole model
    field_shapes: NDArray[np.float64]  # (len(field_nodes), n)
    neighbours: NDArray[np.int32]  # ascending parts that share nodes with this one
    shared: NDArray[np.int64]  # ascending nodes shared with each neighbour in turn
    shared_offsets: NDArray[np.int64]  # (len(neighbours) + 1,) into `shared`


def read_part(path: Path, n_parts: int, part: int) -> PartRows:
    """The rows of part `part` of `n_parts`, without holding those of others.

    InputError if the model has no such partition.
    """
    with _open_model(path) as file:
        n_nodes, n_hexahedra, n_domains = (len(file[name]) for name in ("points", "hexahedra", "domains"))
        if n_parts == 1:
            cells, nodes, rows = np.arange(n_hexahedra + n_domains), np.arange(n_nodes), np.arange(n_nodes)
            first_row, end_row = 0, n_nodes
            neighbours, shared, shared_offsets = np.empty(0, np.int32), np.empty(0, np.int64), np.zeros(1, np.int64)
        else:
            if f"partitions/{n_parts}" not in file:
                raise InputError(f"{path}: has no partition in {n_parts} parts; partition the model first")
            group = file[f"partitions/{n_parts}"]
            cells = group["cells"][_range(group["cell_offsets"], part)]
            nodes = group["nodes"][_range(group["node_offsets"], part)]
            _check_numbers(nodes, len(group["rows"]), "nodes")
            rows = read_rows(group["rows"], nodes)
            first_row, end_row = group["owned_offsets"][part : part + 2]
            own = _range(group["neighbour_offsets"], part)
            neighbours = group["neighbours"][own]
            shared_offsets = group["shared_offsets"][own.start : own.stop + 1]
            _check_numbers(shared_offsets, len(group["shared"]) + 1, "shared_offsets")
            shared = group["shared"][shared_offsets[0] : shared_offsets[-1]]
            shared_offsets = shared_offsets - shared_offsets[0]
            if len(shared_offsets) != len(neighbours) + 1 or (np.diff(shared_offsets) < 0).any():
                raise ValueError("shared_offsets do not fit the neighbours")
            for name, numbers, end in (("neighbours", neighbours, n_parts), ("rows", rows, n_nodes)):
                _check_numbers(numbers, end, name)
            for name, numbers, end in (("cells", cells, n_hexahedra + n_domains), ("nodes", nodes, n_nodes)):
                _check_numbers(numbers, end, name)
                _check_ascending(numbers, name)
            if part in neighbours or not np.isin(shared, nodes).all():
                raise ValueError("a part shares with itself, or nodes that are not its own")

        own_hexahedra, own_domains = np.split(cells, [np.searchsorted(cells, n_hexahedra)])
        own_domains = own_domains - n_hexahedra
        dofs, prescribed = _matching(file["prescribed_dofs"], nodes, 3)
        field_domains, fields_here = _matching(file["field_domains"], own_domains, 1)
        n_fe_nodes = int(file.attrs["n_fe_nodes"])
        hexahedra, domains = read_rows(file["hexahedra"], own_hexahedra), read_rows(file["domains"], own_domains)
        material, materials = read_rows(file["material"], cells), _read_materials(file)
        _check_numbers(material, len(materials), "material")
        _check_ascending(dofs, "prescribed_dofs")
        for name, numbers in (("hexahedra", hexahedra), ("domains", domains)):
            # As `localise` will find them: a node of which this part has no copy would be beyond its arrays.
            _check_numbers(numbers, n_nodes, name)
            if numbers.size and not (nodes.take(np.searchsorted(nodes, numbers), mode="clip") == numbers).all():
                raise ValueError(f"{name} have nodes that their part has not")
        part_rows = PartRows(
            n_parts=n_parts,
            part=part,
            n_nodes=n_nodes,
            n_fe_nodes=n_fe_nodes,
            n_hexahedra=n_hexahedra,
            n_domains=n_domains,
            cells=cells,
            nodes=nodes,
            node_ids=read_rows(file["node_ids"], nodes),
            rows=rows,
            owned=(rows >= first_row) & (rows < end_row),
            first_row=int(first_row),
            points=read_rows(file["points"], nodes),
            mass=read_rows(file["mass"], nodes),
            hexahedra=hexahedra,
            domains=domains,
            **{
                name: read_rows(file[name], own_domains)
                for name in ("domain_points", "domain_volumes", "domain_gradients", "domain_shapes")
            },
            material=material,
            materials=materials,
            prescribed_dofs=dofs,
            prescribed_displacements=read_rows(file["prescribed_displacements"], prescribed),
            prescribed_turns=read_rows(file["prescribed_turns"], prescribed),
            field_nodes=n_fe_nodes + fields_here,
            field_domains=field_domains,
            field_shapes=read_rows(file["field_shapes"], fields_here),
            neighbours=neighbours,
            shared=shared,
            shared_offsets=shared_offsets,
        )
        _check_finite({f.name: v for f in fields(PartRows) if isinstance(v := getattr(part_rows, f.name), np.ndarray)})
        return part_rows


def read_rows(dataset: h5py.Dataset, rows: NDArray[np.int64]) -> NDArray[Any]:
    """Rows of a dataset, given as ascending numbers without repeats.

    Reads ranges and picks from them. A gap is read over where that is cheaper than another call, so that the
    time is that of reading the file once at worst; HDF5's own lists of points cost a search for every row.
    """
    values = np.empty((len(rows), *dataset.shape[1:]), dataset.dtype)
    if values.size == 0:
        return values
    row_bytes = values.itemsize * int(np.prod(dataset.shape[1:]))
    buffer = np.empty((max(1, _BLOCK_BYTES // row_bytes), *dataset.shape[1:]), dataset.dtype)
    block = rows // len(buffer)
    breaks = np.flatnonzero((np.diff(rows) > _GAP_BYTES // row_bytes + 1) | (np.diff(block) > 0)) + 1
    for first, last in zip([0, *breaks], [*breaks, len(rows)], strict=True):
        start, stop = int(rows[first]), int(rows[last - 1]) + 1
        if stop - start == last - first:
            dataset.read_direct(values, np.s_[start:stop], np.s_[first:last])
        else:
            dataset.read_direct(buffer, np.s_[start:stop], np.s_[: stop - start])
            # A mode other than "raise" lets numpy write into `out` without a copy.
            np.take(buffer, rows[first:last] - start, axis=0, out=values[first:last], mode="clip")
    return values


def _range(offsets: h5py.Dataset, part: int) -> slice:
    start, stop = offsets[part : part + 2]
    if not 0 <= start <= stop:
        raise ValueError(f"{offsets.name} do not ascend")
    return slice(int(start), int(stop))


def _matching(
    dataset: h5py.Dataset, wanted: NDArray[np.int64], divisor: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Values of a list whose quotient is among `wanted` (ascending), and their rows; read block by block."""
    values, rows = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    block = _BLOCK_BYTES // 8
    for start in range(0, len(dataset) if len(wanted) else 0, block):
        some = dataset[start : start + block]
        place = np.searchsorted(wanted, some // divisor).clip(max=len(wanted) - 1)
        here = np.flatnonzero(wanted[place] == some // divisor)
        values.append(some[here])
        rows.append(start + here)
    return np.concatenate(values), np.concatenate(rows)


# --- results -----------------------------------------------------------------------------------------------------

_FINISHED, _UNFINISHED = "result.vtkhdf", "result.partial.vtkhdf"
_VTK_VERTEX, _VTK_HEXAHEDRON = 1, 12
_HEXAHEDRON, _EFG_NODE, _INTEGRATION_POINT = 0, 1, 2


#: Bytes in a result, of the mesh and of each frame: of a point (place, two numbers; two displacements), of a cell
#: (offset, type, number, material, kind, part; J), and of a corner of a cell.
_POINT_BYTES, _CELL_BYTES, _CORNER_BYTES = (24 + 16, 48), (8 + 1 + 8 + 2 + 1 + 4, 8), 8
#: Of the tables of steps for each frame; and of the deck, and HDF5's own.
_FRAME_BYTES, _ON_TOP = 537, 47_800


def result_bytes(rows: PartRows, n_frames: int) -> int:
    """Size of the whole model's result.vtkhdf with so many frames, to some kilobytes; see `ResultWriter`."""
    n_hexahedra, n_vertices = rows.n_hexahedra, rows.n_nodes - rows.n_fe_nodes + rows.n_domains
    n_points = rows.n_nodes + rows.n_domains
    size = sum(_POINT_BYTES[k] * n_points * n for k, n in enumerate((1, n_frames)))
    size += sum(_CELL_BYTES[k] * (n_hexahedra + n_vertices) * n for k, n in enumerate((1, n_frames)))
    return size + _CORNER_BYTES * (8 * n_hexahedra + n_vertices) + _FRAME_BYTES * n_frames + _ON_TOP


class ResultWriter:
    """Writes `result.vtkhdf`: a VTKHDF unstructured grid with steps, one piece for the whole mesh, in parallel.

    Points are the owned nodes of rank 0, 1, ... and then the integration points of rank 0, 1, ...; cells are
    hexahedra, a vertex for each EFG node, and a vertex for each integration point, each kind by rank. The mesh is
    written once, undeformed. Every method is collective. Until `close` the file is named `result.partial.vtkhdf`,
    and at any time it can be read with all the frames that are finished.

    VTKHDF: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/vtkhdf_specifications.html
    """

    def __init__(
        self,
        directory: Path,
        comm: Any,
        part: PartRows,
        n_frames: int,
        metadata: Mapping[str, Any],
        *,
        point_data: Mapping[str, int] = MappingProxyType({"displacement": 3, "field_displacement": 3}),
        cell_data: Mapping[str, int] = MappingProxyType({"J": 1}),
        series: Sequence[str] = (),
        frames: int = 0,
    ) -> None:
        """Write the mesh and make room for `n_frames` frames at most, or go on with an unfinished file.

        Of the unfinished file in the directory so many `frames` are kept: as they are where it was written in the same
        parts, which the metadata's "partition" says, else in a new file, by global numbers.
        `comm` is an MPI communicator whose ranks are the parts in order, or None. `metadata` is what JSON can hold;
        rank 0's is kept. `point_data` and `cell_data` give the components of what each frame holds; `series` names
        the numbers of each frame. InputError, from here on, if the file cannot be written.
        """
        if comm is not None and comm.size == 1:
            comm = None
        if comm is not None and not has_mpi():
            raise InputError("h5py: is built without MPI; build it against parallel HDF5, or run on one rank")
        self._comm, self._part, self._n_frames, self._frame = comm, part, n_frames, 0
        self._announced = {*point_data, *cell_data, *series}
        self._path = Path(directory) / _FINISHED
        self._partial = Path(directory) / _UNFINISHED
        self._transfer = _collective(comm)
        self._shares: dict[str, int] = {}  # of this rank, to the checksums of what is written once
        self._count()
        with _told(self._partial):
            if self._leads:
                Path(directory).mkdir(parents=True, exist_ok=True)
            if comm is not None:
                comm.barrier()
            if not frames:
                self._begin(self._partial, point_data, cell_data, series, metadata)
                return
        with open_result(self._partial) as old:
            if old.n_frames < frames:
                raise InputError(
                    f"{self._partial}: holds {old.n_frames} frames of {frames}; begin anew, without --resume"
                )
            if old.metadata["partition"] != metadata["partition"]:
                new = self._partial.with_name(f".{self._partial.name}")
                with _told(new):
                    self._begin(new, point_data, cell_data, series, metadata)
                self._take_over(old, frames, series)
                if self._leads:
                    with _told(new):
                        _fsync(new)
                        os.replace(new, self._partial)
                return
        if comm is not None:
            comm.barrier()
        with _told(self._partial):
            self._file = _create(self._partial, comm, "r+")
            self._frame = frames
            if "figures" in self._file["mpitled"]:
                del self._file["mpitled/figures"]
            self._announce(frames)

    def _begin(
        self,
        path: Path,
        point_data: Mapping[str, int],
        cell_data: Mapping[str, int],
        series: Sequence[str],
        metadata: Mapping[str, Any],
    ) -> None:
        """A new file with the mesh, no frame, and room for all."""
        components = sum(point_data.values()) * self._n_points + sum(cell_data.values()) * self._n_cells
        corners = int((np.array([8, 1, 1]) * self._all_counts[1:]).sum())
        if self._leads:
            path.unlink(missing_ok=True)
            _room(path, 8 * (self._n_frames * components + corners) + 40 * self._n_points + 28 * self._n_cells)
        if self._comm is not None:
            self._comm.barrier()
        self._file = _create(path, self._comm)
        self._write_mesh()
        self._make_steps(point_data, cell_data, series)
        ours = self._file.create_group("mpitled")
        ours.attrs["layout"] = RESULT_LAYOUT
        for name in (*(f"PointData/{n}" for n in point_data), *(f"CellData/{n}" for n in cell_data), "series"):
            _make(ours, f"checksums/{name}", (self._n_frames,), np.int64)
        self._note("metadata", metadata)
        self._note("mesh_checksums", self._totals(self._shares))
        self._file.flush()
        if self._leads:
            _reserve(path)

    def _take_over(self, old: Result, frames: int, series: Sequence[str]) -> None:
        """Write the first frames of a file that was written in other parts."""
        part = self._part
        nodes, in_nodes = old.find("node_id", part.nodes[part.owned])
        cells, in_cells = old.find("cell_id", part.cells)
        points = old.point_rows(in_cells[cells][len(part.hexahedra) :])
        order = np.argsort(points)
        back = np.argsort(order)
        for k in range(frames):
            point_data = {
                name: np.concatenate([
                    old.rows("Point", name, k, in_nodes)[nodes], old.rows("Point", name, k, points[order])[back]
                ])
                for name in old.names("Point")
            }  # fmt: skip
            cell_data = {name: old.rows("Cell", name, k, in_cells)[cells] for name in old.names("Cell")}
            numbers = {name: float(old.series[name][k]) for name in series}
            self.write_frame(float(old.times[k]), point_data, cell_data, numbers)

    @property
    def _leads(self) -> bool:
        return self._comm is None or self._comm.rank == 0

    def write_frame(
        self,
        time: float,
        point_data: Mapping[str, NDArray[np.float64]],
        cell_data: Mapping[str, NDArray[np.float64]],
        series: Mapping[str, float] | None = None,
    ) -> None:
        """Write one frame; it counts once it is on its way to the disc.

        Point data: (owned nodes + own support domains, components), nodes ascending, then integration points.
        Cell data: (own cells, components) in the order of `PartRows.cells`. Rank 0's time (s) and series are kept.
        """
        if self._frame == self._n_frames:
            raise ValueError(f"{self._n_frames} frames were announced, and one more is written")
        if {*point_data, *cell_data, *(series or {})} != self._announced:
            raise ValueError(f"every frame holds {', '.join(sorted(self._announced))}")
        grid = self._file["VTKHDF"]
        point_row, cell_row = self._frame * self._n_points, self._frame * self._n_cells
        shares = {"series": checksum.share(_series(time, series or {}), 0) if self._leads else 0}
        with _told(self._partial):
            for name, values in point_data.items():
                shares[f"PointData/{name}"] = self._write(grid["PointData"][name], self._point_slabs, values, point_row)
            for name, values in cell_data.items():
                shares[f"CellData/{name}"] = self._write(
                    grid["CellData"][name], self._cell_slabs, self._with_efg(values, np.nan), cell_row
                )
            totals = self._totals(shares)
            if self._leads:
                for name, value in (series or {}).items():
                    grid["FieldData"][name][self._frame] = value
                for name, total in totals.items():
                    self._file[f"mpitled/checksums/{name}"][self._frame] = total
            self._file.flush()
            self._frame += 1
            self._announce(self._frame, time)

    def _announce(self, n_frames: int, time: float | None = None) -> None:
        """Let readers know of so many frames, and of the time (s) of the last."""
        steps = self._file["VTKHDF/Steps"]
        # Together, and before the next flush: VTK reads all times into room for NSteps of them.
        steps.attrs.modify("NSteps", np.int64(n_frames))
        steps["Values"].resize((n_frames,))
        if self._leads and time is not None:
            steps["Values"][n_frames - 1] = time
        self._file.flush()

    def sync(self) -> None:
        """See that the frames are on the disc."""
        with _told(self._partial):
            _fsync(self._partial)

    def close(self, figures: Mapping[str, Any] | None = None) -> None:
        """End the file with rank 0's figures of the run (what JSON can hold) and give it its name."""
        self.abandon(figures)
        if self._leads:
            with _told(self._partial):
                _fsync(self._partial)
                os.replace(self._partial, self._path)
                _fsync(self._path.parent)
        if self._comm is not None:
            self._comm.barrier()

    def abandon(self, figures: Mapping[str, Any] | None = None) -> None:
        """End the file as it is; it keeps the name of an unfinished one and can be read."""
        with _told(self._partial):
            self._note("figures", figures or {})
            self._file.close()

    def _note(self, name: str, value: Mapping[str, Any]) -> None:
        # Made alike on all ranks, as HDF5 demands of whatever makes a dataset.
        _write_json(self._file["mpitled"], name, value if self._comm is None else self._comm.bcast(dict(value)))

    def _totals(self, shares: Mapping[str, int]) -> dict[str, int]:
        """The checksums that all ranks' shares make."""
        rows = [list(shares.values())] if self._comm is None else self._comm.allgather(list(shares.values()))
        return {name: checksum.total(column) for name, column in zip(shares, zip(*rows, strict=True), strict=True)}

    def _count(self) -> None:
        """Where this rank's rows are."""
        part = self._part
        efg = part.owned & (part.nodes >= part.n_fe_nodes)
        counts = np.array([part.owned.sum(), len(part.hexahedra), efg.sum(), len(part.domains)])
        by_rank = np.array([counts] if self._comm is None else self._comm.allgather(counts))
        totals, before = by_rank.sum(axis=0), by_rank[: part.part].sum(axis=0)
        self._counts, self._all_counts, self._counts_before = counts, totals, before
        self._n_efg = int(counts[2])
        self._n_points, self._n_cells = int(totals[[0, 3]].sum()), int(totals[1:].sum())
        self._point_slabs = _slabs(totals[[0, 3]], before[[0, 3]], counts[[0, 3]])
        self._cell_slabs = _slabs(totals[1:], before[1:], counts[1:])

    def _write_mesh(self) -> None:
        part, counts, totals, before = self._part, self._counts, self._all_counts, self._counts_before
        owned = part.owned
        efg = owned & (part.nodes >= part.n_fe_nodes)
        sizes = np.array([8, 1, 1])
        corner_slabs = _slabs(sizes * totals[1:], sizes * before[1:], sizes * counts[1:])
        integration_rows = totals[0] + before[3] + np.arange(counts[3])
        corners = part.rows[np.searchsorted(part.nodes, part.hexahedra)].ravel()
        # Offsets say where each cell's corners end, after a first row that says where they begin.
        ends = [
            first + size * np.arange(1, n // size + 1) for (first, n), size in zip(corner_slabs, sizes, strict=True)
        ]
        end_slabs = [(first + 1, n) for first, n in self._cell_slabs]
        if part.part == 0:
            ends, end_slabs = [np.zeros(1, np.int64), *ends], [(0, 1), *end_slabs]

        grid = self._file.create_group("VTKHDF")
        grid.attrs["Version"] = np.array([2, 0])
        grid.attrs["Type"] = np.bytes_("UnstructuredGrid")
        n_corners = int((sizes * totals[1:]).sum())
        self._table(grid, "NumberOfPoints", [self._n_points])
        self._table(grid, "NumberOfCells", [self._n_cells])
        self._table(grid, "NumberOfConnectivityIds", [n_corners])

        def write(name: str, slabs: _Slabs, n_rows: int, values: NDArray[Any]) -> None:
            made = _make(grid, name, (n_rows, *values.shape[1:]), values.dtype)
            self._shares[name] = self._write(made, slabs, values)

        points = np.concatenate([part.points[owned], part.domain_points])
        write("Points", self._point_slabs, self._n_points, points)
        write("Connectivity", corner_slabs, n_corners, np.concatenate([corners, part.rows[efg], integration_rows]))
        write("Offsets", end_slabs, self._n_cells + 1, np.concatenate(ends))
        kinds = np.repeat(np.array([_HEXAHEDRON, _EFG_NODE, _INTEGRATION_POINT], np.uint8), counts[1:])
        types = np.where(kinds == _HEXAHEDRON, _VTK_HEXAHEDRON, _VTK_VERTEX).astype(np.uint8)
        write("Types", self._cell_slabs, self._n_cells, types)
        none = np.full(counts[3], -1)
        for name, of_nodes in (("node_id", part.nodes), ("node_label", part.node_ids)):
            write(f"PointData/{name}", self._point_slabs, self._n_points, np.concatenate([of_nodes[owned], none]))
        for name, of_cells in (
            ("cell_id", self._with_efg(part.cells, -1)),
            ("material", self._with_efg(part.material, -1)),
            ("kind", kinds),
            ("part", np.full(len(kinds), part.part, np.int32)),
        ):
            write(f"CellData/{name}", self._cell_slabs, self._n_cells, of_cells)

    def _make_steps(self, point_data: Mapping[str, int], cell_data: Mapping[str, int], series: Sequence[str]) -> None:
        n = self._n_frames
        grid = self._file["VTKHDF"]
        steps = grid.create_group("Steps")
        steps.attrs["NSteps"] = np.int64(0)
        # One row at first, so that its one chunk has its place in the file; later only the extent changes.
        values = _make(steps, "Values", (1,), np.float64, maxshape=(n,), chunks=(n,))
        if self._leads:
            values[...] = 0.0
        self._table(steps, "NumberOfParts", np.ones(n))
        # The mesh, and what is said of it, is the same in every step: all offsets into it are 0.
        for name, shape in (
            ("PartOffsets", n),
            ("PointOffsets", n),
            ("CellOffsets", (n, 1)),
            ("ConnectivityIdOffsets", (n, 1)),
        ):
            self._table(steps, name, np.zeros(shape))
        for kind, n_rows, components in (("Point", self._n_points, point_data), ("Cell", self._n_cells, cell_data)):
            data, offsets = grid[f"{kind}Data"], steps.create_group(f"{kind}DataOffsets")
            for name in data:
                self._table(offsets, name, np.zeros(n))
            for name, width in components.items():
                _make(data, name, (n * n_rows, width)[: 1 + (width > 1)], np.float64)
                self._table(offsets, name, n_rows * np.arange(n))
        for name in series:
            numbers = _make(grid, f"FieldData/{name}", (n,), np.float64)
            if self._leads:
                numbers[...] = np.nan
            self._table(steps, f"FieldDataOffsets/{name}", np.arange(n))
            self._table(steps, f"FieldDataSizes/{name}", np.ones((n, 2)))

    def _with_efg(self, values: NDArray[Any], filler: float) -> NDArray[Any]:
        """Values of own cells with `filler` for the vertices of EFG nodes, which are no cells of the model."""
        between = np.full((self._n_efg, *values.shape[1:]), filler, values.dtype)
        n_hexahedra = len(self._part.hexahedra)
        return np.concatenate([values[:n_hexahedra], between, values[n_hexahedra:]])

    def _table(self, group: h5py.Group, name: str, values: Any) -> None:
        """A small dataset of integers that all ranks make and the first writes."""
        dataset = _make(group, name, np.shape(values), np.int64)
        values = np.asarray(values, np.int64)
        self._shares[dataset.name.removeprefix("/VTKHDF/")] = checksum.share(values, 0) if self._leads else 0
        if self._leads:
            dataset[...] = values

    def _write(self, dataset: h5py.Dataset, slabs: _Slabs, values: NDArray[Any], first_row: int = 0) -> int:
        return _write_rows(dataset, slabs, values, first_row, self._transfer)


_Slabs = list[tuple[int, int]]


def _write_rows(
    dataset: h5py.Dataset, slabs: _Slabs, values: NDArray[Any], first_row: int, transfer: h5py.h5p.PropDXID | None
) -> int:
    """Write the rows of this rank in one collective call, which a rank without rows makes as well.

    Its share of the checksum of the rows from first_row on.
    """
    shape = (sum(count for _, count in slabs), *dataset.shape[1:])
    if values.shape != shape:
        raise ValueError(f"{dataset.name}: {values.shape} values for rows of shape {shape}")
    values = np.ascontiguousarray(values, dataset.dtype)
    space, memory = dataset.id.get_space(), h5py.h5s.create_simple(shape)
    space.select_none()
    entries, done, shares = int(np.prod(shape[1:])), 0, 0
    for start, count in slabs:
        if count:
            start_of_slab = (first_row + start, *(0 for _ in shape[1:]))
            space.select_hyperslab(start_of_slab, (count, *shape[1:]), op=h5py.h5s.SELECT_OR)
        shares += checksum.share(values[done : done + count], start * entries)
        done += count
    if not values.size:
        memory.select_none()
    dataset.id.write(memory, space, values, dxpl=transfer)
    return shares


def _series(time: float, series: Mapping[str, float]) -> NDArray[np.float64]:
    """The time and the numbers of a frame, as their checksum has them."""
    return np.array([time, *(series[name] for name in sorted(series))], np.float64)


def _collective(comm: Any) -> h5py.h5p.PropDXID | None:
    """What makes a transfer one of all ranks."""
    if comm is None:
        return None
    transfer = h5py.h5p.create(h5py.h5p.DATASET_XFER)
    transfer.set_dxpl_mpio(h5py.h5fd.MPIO_COLLECTIVE)
    return transfer


def _create(path: Path, comm: Any, mode: str = "w", **options: Any) -> h5py.File:
    """A file that all ranks write together."""
    if comm is None:
        return h5py.File(path, mode, locking=False, **options)
    return h5py.File(path, mode, driver="mpio", comm=comm, **options)


def _slabs(totals: NDArray[np.int64], before: NDArray[np.int64], counts: NDArray[np.int64]) -> _Slabs:
    """First row and count of this rank in each of several lists that follow each other in one dataset."""
    firsts = np.cumsum([0, *totals[:-1]]) + before
    return list(zip(firsts.tolist(), counts.tolist(), strict=True))


def _make(group: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any, **options: Any) -> h5py.Dataset:
    """A dataset, contiguous unless told otherwise, with its room on disc from the start.

    A run that is killed then keeps what it wrote; resizable data were lost.
    """
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    return group.create_dataset(name, shape, dtype, dcpl=properties, **options)


class Result:
    """The results of a run, read as they are asked for: the grid as it is in the file, or in the model's order.

    Use it `with damaged` where the file may come from others.
    """

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file, self._grid, self.path = file, file["VTKHDF"], path

    def __enter__(self) -> Result:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def complete(self) -> bool:
        """Whether the run came to its end."""
        return ".partial" not in self.path.suffixes

    @property
    def metadata(self) -> dict[str, Any]:
        """What the run was started with."""
        return _read_json(self._file["mpitled"], "metadata")

    @property
    def figures(self) -> dict[str, Any]:
        """What the run ended with; empty if it was killed."""
        return _read_json(self._file["mpitled"], "figures") if "figures" in self._file["mpitled"] else {}

    def check(self) -> None:
        """Read all of the file; InputError names what does not have the checksum that it was written with."""
        broken = _first_broken(self._file)
        for name, total in _read_json(self._file["mpitled"], "mesh_checksums").items():
            if _sum(self._grid[name]) != total:
                broken = broken or name
        times, series = self.times, self.series
        for name in (*(f"PointData/{n}" for n in self.names("Point")), *(f"CellData/{n}" for n in self.names("Cell"))):
            n_rows = int(self._grid[f"NumberOf{name.partition('Data')[0]}s"][0])
            totals = self._file[f"mpitled/checksums/{name}"]
            for frame in range(self.n_frames):
                if _sum(self._grid[name], frame * n_rows, n_rows) != totals[frame]:
                    broken = broken or f"{name} of frame {frame}"
        for frame in range(self.n_frames):
            numbers = _series(times[frame], {name: values[frame] for name, values in series.items()})
            if checksum.total([checksum.share(numbers, 0)]) != self._file["mpitled/checksums/series"][frame]:
                broken = broken or f"time and energies of frame {frame}"
        if broken:
            raise InputError(f"{self.path}: is damaged: {broken} is not what was written; run the deck again")

    def names(self, kind: str) -> list[str]:
        """What each frame holds for each "Point" or "Cell"."""
        return list(self._file[f"mpitled/checksums/{kind}Data"])

    @property
    def n_frames(self) -> int:
        steps = self._grid["Steps"]
        return min(int(steps.attrs["NSteps"]), len(steps["Values"]))

    @property
    def times(self) -> NDArray[np.float64]:
        """(n_frames,), s."""
        return self._grid["Steps/Values"][: self.n_frames]

    @property
    def series(self) -> dict[str, NDArray[np.float64]]:
        """Numbers of each frame, (n_frames,), by name."""
        return {name: values[: self.n_frames] for name, values in self._grid.get("FieldData", {}).items()}

    @property
    def points(self) -> NDArray[np.float64]:
        """(nodes + integration points, 3), m, undeformed."""
        return self._grid["Points"][...]

    @property
    def hexahedra(self) -> NDArray[np.int64]:
        """(n_hexahedra, 8), rows of `points`."""
        n_hexahedra = int(np.count_nonzero(self.cell_data("kind") == _HEXAHEDRON))
        return self._grid["Connectivity"][: 8 * n_hexahedra].reshape(-1, 8)

    def point_data(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Values at `points` in a frame (negative: from the last); of what does not change in any."""
        return self._rows("Point", name, frame)

    def cell_data(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Values in cells: hexahedra, EFG nodes (nan or -1 where it is nothing of theirs), integration points."""
        return self._rows("Cell", name, frame)

    @property
    def node_points(self) -> NDArray[np.float64]:
        """(n_nodes, 3), m, undeformed, in the order of the model."""
        return self.points[_ascending(self.point_data("node_id"))]

    def at_nodes(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Point data of the nodes, in the order of the model."""
        return self.point_data(name, frame)[_ascending(self.point_data("node_id"))]

    def at_integration_points(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Point data of the integration points, in the order of the model."""
        cell_id = self.cell_data("cell_id")[self.cell_data("kind") == _INTEGRATION_POINT]
        return self.point_data(name, frame)[self.point_data("node_id") < 0][np.argsort(cell_id)]

    def in_cells(self, name: str, frame: int = 0) -> NDArray[Any]:
        """Cell data of hexahedra and support domains, in the order of the model."""
        return self.cell_data(name, frame)[_ascending(self.cell_data("cell_id"))]

    def find(self, numbers: str, wanted: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where wanted (ascending) "node_id" or "cell_id" are: rows (ascending), and whose turn each wanted one is."""
        kind = "Point" if numbers == "node_id" else "Cell"
        found, rows = _matching(self._grid[f"{kind}Data/{numbers}"], wanted, 1)
        return np.argsort(found), rows

    def point_rows(self, cell_rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows of the integration points that are in these rows of the cells: both end with them, in the same order."""
        return cell_rows - int(self._grid["NumberOfCells"][0]) + int(self._grid["NumberOfPoints"][0])

    def rows(self, kind: str, name: str, frame: int, rows: NDArray[np.int64]) -> NDArray[Any]:
        """Some rows (ascending) of what a frame holds for each "Point" or "Cell"."""
        first = int(self._grid[f"Steps/{kind}DataOffsets/{name}"][frame])
        return read_rows(self._grid[f"{kind}Data/{name}"], first + rows)

    def _rows(self, kind: str, name: str, frame: int) -> NDArray[Any]:
        first = int(self._grid[f"Steps/{kind}DataOffsets/{name}"][: max(1, self.n_frames)][frame])
        return self._grid[f"{kind}Data/{name}"][first : first + int(self._grid[f"NumberOf{kind}s"][0])]


def _ascending(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the numbers from 0 on, in their order; -1 is no number."""
    rows = np.flatnonzero(numbers >= 0)
    return rows[np.argsort(numbers[rows])]


def unfinished_bytes(directory: Path) -> int:
    """Room that the unfinished results in a directory take, which a run there goes on with or writes anew."""
    path = Path(directory) / _UNFINISHED
    return path.stat().st_size if path.exists() else 0


def is_unfinished(directory: Path) -> bool:
    """Whether a directory holds results of a run that did not come to its end."""
    return (Path(directory) / _UNFINISHED).exists()


def is_checkpoint(path: Path) -> bool:
    """Whether the HDF5 file is a checkpoint, of whatever layout; InputError if it is no HDF5 file."""
    with _open(path) as file, damaged(path, _AGAIN):
        vet.check_file(file, path, numbers=True)
        return "told" in file and "node" in file


def check_hdf5(path: Path) -> None:
    """InputError if another library that is about to read a file would be led out of it, or told to take too much."""
    with _open(path) as file, damaged(path, "write it anew"):
        vet.check_file(file, path)


def is_result(path: Path) -> bool:
    """Whether the HDF5 file is a result of ours, of whatever layout; InputError if it is no HDF5 file."""
    with _open(path) as file, damaged(path, "give another file"):
        vet.check_file(file, path)
        return "mpitled" in file and "VTKHDF" in file


def open_result(path: Path) -> Result:
    """Results in a file, or in a directory: there the unfinished ones, which are later than any finished, if any.

    InputError if there are none, or the file is not one of ours or cut short.
    """
    path = Path(path)
    if path.is_dir():
        there = [path / name for name in (_UNFINISHED, _FINISHED) if (path / name).exists()]
        if not there:
            raise InputError(f"{path}: holds no result; give the folder that 'mpitled run' wrote")
        path = there[0]
    file = _open(path)
    try:
        with damaged(path, _AGAIN):
            vet.check_file(file, path, numbers=True)
            layout = _attribute(file["mpitled"], "layout") if "mpitled" in file and "VTKHDF" in file else None
            if layout == RESULT_LAYOUT:
                return Result(file, path)
    except InputError:
        file.close()
        raise
    file.close()
    if layout is None:
        raise InputError(f"{path}: is not a result of mpitled; give a file that 'mpitled run' wrote")
    raise InputError(f"{path}: has layout {layout}, this version reads {RESULT_LAYOUT}; run the deck again")


# --- checkpoints -------------------------------------------------------------------------------------------------

#: The last checkpoint of a run, and the one before it.
CHECKPOINTS = ("checkpoint.h5", "checkpoint.previous.h5")


def write_checkpoint(
    directory: Path,
    comm: Any,
    part: PartRows,
    told: Mapping[str, Any],
    nodal: Mapping[str, NDArray[np.float64]],
    own: Sequence[float],
) -> None:
    """Write a checkpoint, whole and on the disc before it takes the place of the last, which becomes the one before.

    Collective. told: what JSON can hold, rank 0's; nodal: (n owned nodes, components) by name; own: numbers of this
    rank. InputError if it cannot be written.
    """
    if comm is not None and comm.size == 1:
        comm = None
    path, previous = (Path(directory) / name for name in CHECKPOINTS)
    new = path.with_name(f".{path.name}")
    slabs, transfer, shares = [(part.first_row, int(part.owned.sum()))], _collective(comm), {}
    with _told(path):
        if part.part == 0:
            components = sum(values.shape[1] for values in nodal.values())
            _room(path, 8 * part.n_nodes * (1 + components) + 8 * part.n_parts * len(own) + len(str(told)))
        # The latest format has checksums of its own for what is not data.
        with _create(new, comm, libver="latest") as file:
            file.attrs["layout"] = CHECKPOINT_LAYOUT

            def write(name: str, n_rows: int, slabs: _Slabs, values: NDArray[Any]) -> None:
                made = _make(file, name, (n_rows, *values.shape[1:]), values.dtype)
                shares[name] = _write_rows(made, slabs, values, 0, transfer)

            write("node", part.n_nodes, slabs, part.nodes[part.owned])
            for name, values in nodal.items():
                write(f"nodal/{name}", part.n_nodes, slabs, values)
            write("own", part.n_parts, [(part.part, 1)], np.array([own], np.float64))
            every = [shares] if comm is None else comm.allgather(shares)
            for name in shares:
                file[name].attrs["checksum"] = checksum.total(of_rank[name] for of_rank in every)
            _write_json(file, "told", dict(told) if comm is None else comm.bcast(dict(told)))
            file.flush()
        _fsync(new)
        if comm is not None:
            comm.barrier()
        if part.part == 0:
            if path.exists():
                os.replace(path, previous)
            os.replace(new, path)
            _fsync(path.parent)
        if comm is not None:
            comm.barrier()


def checkpoint_contents(path: Path) -> dict[str, Any]:
    """What a checkpoint tells. Reads all of it; InputError if it is none of this layout, or not what was written."""
    with _open(path) as file, damaged(path, _AGAIN):
        vet.check_file(file, path, numbers=True)
        layout = _attribute(file, "layout") if "told" in file and "node" in file else None
        if layout == CHECKPOINT_LAYOUT and (broken := _first_broken(file)) is None:
            return dict(_read_json(file, "told"))
    if layout is None:
        raise InputError(f"{path}: is not a checkpoint of mpitled")
    if layout != CHECKPOINT_LAYOUT:
        raise InputError(f"{path}: has layout {layout}, this version reads {CHECKPOINT_LAYOUT}; begin anew")
    raise InputError(f"{path}: is damaged: {broken} is not what was written")


def read_checkpoint(path: Path, nodes: NDArray[np.int64]) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.float64]]:
    """What a checkpoint holds of the nodes (ascending), (n nodes, components) by name; the numbers of each rank.

    Of a file that `checkpoint_contents` has read.
    """
    with _open(path) as file, damaged(path, _AGAIN):
        vet.check_file(file, path, numbers=True)
        found, rows = _matching(file["node"], nodes, 1)
        order = np.argsort(found)
        if not np.array_equal(found[order], nodes):
            raise ValueError("it is of other nodes")
        names: list[str] = []
        file["nodal"].visititems(lambda name, thing: names.append(name) if isinstance(thing, h5py.Dataset) else None)
        return {name: read_rows(file["nodal"][name], rows)[order] for name in names}, file["own"][...]


def discard_checkpoints(directory: Path) -> bool:
    """Remove the checkpoints of a run, if there are any: whether there were."""
    paths = [Path(directory) / name for name in (f".{CHECKPOINTS[0]}", *CHECKPOINTS)]
    there = [path for path in paths if path.exists()]
    for path in there:
        with _told(path):
            path.unlink()
    return bool(there)
