"""Every HDF5 layout: the model, its partitions, and the results as VTKHDF."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled.errors import InputError
from mpitled.material import Material
from mpitled.model import Model

if TYPE_CHECKING:
    from partition import PartTables

#: Written into every model; a file of another layout is built anew, never read by guess.
MODEL_LAYOUT = 1

#: Bytes that are read over rather than skipped: about what one more call of HDF5 costs.
_GAP_BYTES = 1 << 16
#: Bytes held at most at a time beside what is asked for.
_BLOCK_BYTES = 1 << 24

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
}


# --- the model ---------------------------------------------------------------------------------------------------


def write_model(path: Path, model: Model, key: str) -> None:
    """Write the model to `path` at once or not at all; `key` says what it was built from (see `model_key`).

    Arrays are contiguous, so that any range of rows is one read.
    """
    with _replacing(path) as temporary, h5py.File(temporary, "w", locking=False) as file:
        file.attrs["format"] = "mpitled model"
        file.attrs["layout"] = MODEL_LAYOUT
        file.attrs["key"] = key
        file.attrs["n_fe_nodes"] = model.n_fe_nodes
        for name, dtype in _MODEL_ARRAYS.items():
            file.create_dataset(name, data=np.asarray(getattr(model, name), dtype))
        for name in ("node_sets", "cell_sets"):
            _write_sets(file.create_group(name), getattr(model, name))
        _write_json(file, "materials", [asdict(material) for material in model.materials])
        _write_json(file, "figures", model.figures)
        _write_json(file, "remarks", model.remarks)


def read_model(path: Path) -> Model:
    """The whole model. InputError if the file is missing, not a model, or of another layout."""
    with _open_model(path) as file:
        return Model(
            **{name: file[name][...] for name in _MODEL_ARRAYS},
            n_fe_nodes=int(file.attrs["n_fe_nodes"]),
            node_sets=_read_sets(file["node_sets"]),
            cell_sets=_read_sets(file["cell_sets"]),
            materials=_read_materials(file),
            figures=_read_json(file, "figures"),
            remarks=tuple(_read_json(file, "remarks")),
        )


def model_key(path: Path) -> str | None:
    """The key that the model was written with; None if there is no model of this layout."""
    try:
        with _open_model(path) as file:
            return str(file.attrs["key"])
    except InputError:
        return None


def read_sets(path: Path) -> tuple[dict[str, NDArray[np.int64]], dict[str, NDArray[np.int64]]]:
    """Node sets and cell sets of the model, by name; ascending global numbers."""
    with _open_model(path) as file:
        return _read_sets(file["node_sets"]), _read_sets(file["cell_sets"])


@contextmanager
def _open_model(path: Path) -> Iterator[h5py.File]:
    with _open(path) as file:
        if file.attrs.get("format") != "mpitled model":
            raise InputError(f"{path}: is not a model of mpitled; build the model from its deck")
        if file.attrs["layout"] != MODEL_LAYOUT:
            raise InputError(
                f"{path}: has layout {file.attrs['layout']}, this version reads {MODEL_LAYOUT}; build the model anew"
            )
        yield file


@contextmanager
def _open(path: Path) -> Iterator[h5py.File]:
    # No locks: every rank reads the same file, and network file systems often refuse them.
    try:
        file = h5py.File(path, "r", locking=False)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read as HDF5 ({str(error).splitlines()[0]})") from None
    with file:
        yield file


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its name, safe on disc, when the block ends well."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield temporary
        _fsync(temporary)
        os.replace(temporary, path)
        _fsync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


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
    group["offsets"] = np.cumsum([0, *map(len, members)], dtype=np.int64)
    group["members"] = np.concatenate([np.empty(0, np.int64), *members])


def _read_sets(group: h5py.Group) -> dict[str, NDArray[np.int64]]:
    offsets = group["offsets"][...]
    return dict(zip(_read_json(group, "names"), np.split(group["members"][...], offsets[1:-1]), strict=True))


def _write_json(group: h5py.Group, name: str, value: Any) -> None:
    text = json.dumps(value, ensure_ascii=True).encode()
    group.create_dataset(name, data=np.bytes_(text))


def _read_json(group: h5py.Group, name: str) -> Any:
    return json.loads(group[name][()])


def _read_materials(file: h5py.File) -> tuple[Material, ...]:
    return tuple(Material(**values) for values in _read_json(file, "materials"))


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
        shutil.copyfile(path, temporary)
        with h5py.File(temporary, "r+", locking=False) as file:
            name = f"partitions/{tables.n_parts}"
            if name in file:
                del file[name]
            group = file.create_group(name)
            for column in fields(tables):
                if column.name != "n_parts":
                    group[column.name] = getattr(tables, column.name)
            group["rows"] = rows


def has_partition(path: Path, n_parts: int) -> bool:
    """Whether the model can be read in so many parts; one part needs no partition."""
    with _open_model(path) as file:
        return n_parts == 1 or f"partitions/{n_parts}" in file


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
            rows = read_rows(group["rows"], nodes)
            first_row, end_row = group["owned_offsets"][part : part + 2]
            own = _range(group["neighbour_offsets"], part)
            neighbours = group["neighbours"][own]
            shared_offsets = group["shared_offsets"][own.start : own.stop + 1]
            shared = group["shared"][shared_offsets[0] : shared_offsets[-1]]
            shared_offsets = shared_offsets - shared_offsets[0]

        own_hexahedra, own_domains = np.split(cells, [np.searchsorted(cells, n_hexahedra)])
        own_domains = own_domains - n_hexahedra
        dofs, prescribed = _matching(file["prescribed_dofs"], nodes, 3)
        field_domains, fields_here = _matching(file["field_domains"], own_domains, 1)
        n_fe_nodes = int(file.attrs["n_fe_nodes"])
        return PartRows(
            n_parts=n_parts,
            part=part,
            n_nodes=n_nodes,
            n_fe_nodes=n_fe_nodes,
            n_hexahedra=n_hexahedra,
            n_domains=n_domains,
            cells=cells,
            nodes=nodes,
            rows=rows,
            owned=(rows >= first_row) & (rows < end_row),
            first_row=int(first_row),
            points=read_rows(file["points"], nodes),
            mass=read_rows(file["mass"], nodes),
            hexahedra=read_rows(file["hexahedra"], own_hexahedra),
            **{
                name: read_rows(file[name], own_domains)
                for name in ("domains", "domain_points", "domain_volumes", "domain_gradients", "domain_shapes")
            },
            material=read_rows(file["material"], cells),
            materials=_read_materials(file),
            prescribed_dofs=dofs,
            prescribed_displacements=read_rows(file["prescribed_displacements"], prescribed),
            field_nodes=n_fe_nodes + fields_here,
            field_domains=field_domains,
            field_shapes=read_rows(file["field_shapes"], fields_here),
            neighbours=neighbours,
            shared=shared,
            shared_offsets=shared_offsets,
        )


def read_rows(dataset: h5py.Dataset, rows: NDArray[np.int64]) -> NDArray[Any]:
    """Rows of a dataset, given as ascending numbers without repeats.

    Reads ranges and picks from them. A gap is read over where that is cheaper than another call, so that the
    time is that of reading the file once at worst; HDF5's own lists of points cost a search for every row.
    """
    values = np.empty((len(rows), *dataset.shape[1:]), dataset.dtype)
    if values.size == 0:
        return values
    row_bytes = values.itemsize * int(np.prod(dataset.shape[1:]))
    block = rows // max(1, _BLOCK_BYTES // row_bytes)
    breaks = np.flatnonzero((np.diff(rows) > _GAP_BYTES // row_bytes + 1) | (np.diff(block) > 0)) + 1
    for first, last in zip([0, *breaks], [*breaks, len(rows)], strict=True):
        start, stop = int(rows[first]), int(rows[last - 1]) + 1
        if stop - start == last - first:
            dataset.read_direct(values, np.s_[start:stop], np.s_[first:last])
        else:
            values[first:last] = dataset[start:stop][rows[first:last] - start]
    return values


def _range(offsets: h5py.Dataset, part: int) -> slice:
    start, stop = offsets[part : part + 2]
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
