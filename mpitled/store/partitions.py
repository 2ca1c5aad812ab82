"""The layout of partitions in a model, and what one part reads of both."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled.errors import InputError
from mpitled.material import Material
from mpitled.store.files import check_room, matching, put, read_rows, replacing
from mpitled.store.models import check_ascending, check_finite, check_numbers, open_model, read_materials

if TYPE_CHECKING:
    from partition import PartTables


def write_partition(path: Path, tables: PartTables) -> None:
    """Add the partition to the model, in place of one of as many parts.

    The model is copied and the copy takes its name: HDF5 keeps no journal, so that an append cut short
    could cost the model. Beside the tables it keeps the row of every node in the result files: owned nodes
    of part 0 ascending, then those of part 1, and so on.
    """
    with open_model(path) as file:
        n_nodes = len(file["points"])
    # The first of several mentions is the lowest part's, which owns the node.
    touched, first = np.unique(tables.nodes, return_index=True)
    if len(touched) != n_nodes:
        raise InputError(f"{path}: {n_nodes - len(touched)} nodes are on no part; partition the model anew")
    owner = np.searchsorted(tables.node_offsets, first, side="right") - 1
    rows = np.empty(n_nodes, np.int64)
    rows[np.argsort(owner, kind="stable")] = np.arange(n_nodes)

    with replacing(path) as temporary:
        check_room(
            path, Path(path).stat().st_size + sum(np.asarray(getattr(tables, f.name)).nbytes for f in fields(tables))
        )
        shutil.copyfile(path, temporary)
        with h5py.File(temporary, "r+", locking=False) as file:
            name = f"partitions/{tables.n_parts}"
            if name in file:
                del file[name]
            group = file.create_group(name)
            for column in fields(tables):
                if column.name != "n_parts":
                    put(group, column.name, getattr(tables, column.name))
            put(group, "rows", rows)
            file.flush()


def has_partition(path: Path, n_parts: int) -> bool:
    """Whether the model can be read in so many parts; one part needs no partition."""
    with open_model(path) as file:
        return n_parts == 1 or f"partitions/{n_parts}" in file


def partition_mark(path: Path, n_parts: int) -> str:
    """What tells partitions in as many parts from each other. InputError if there is none."""
    with open_model(path) as file:
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
    with open_model(path) as file:
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
            check_numbers(nodes, len(group["rows"]), "nodes")
            rows = read_rows(group["rows"], nodes)
            first_row, end_row = group["owned_offsets"][part : part + 2]
            own = _range(group["neighbour_offsets"], part)
            neighbours = group["neighbours"][own]
            shared_offsets = group["shared_offsets"][own.start : own.stop + 1]
            check_numbers(shared_offsets, len(group["shared"]) + 1, "shared_offsets")
            shared = group["shared"][shared_offsets[0] : shared_offsets[-1]]
            shared_offsets = shared_offsets - shared_offsets[0]
            if len(shared_offsets) != len(neighbours) + 1 or (np.diff(shared_offsets) < 0).any():
                raise ValueError("shared_offsets do not fit the neighbours")
            for name, numbers, end in (("neighbours", neighbours, n_parts), ("rows", rows, n_nodes)):
                check_numbers(numbers, end, name)
            for name, numbers, end in (("cells", cells, n_hexahedra + n_domains), ("nodes", nodes, n_nodes)):
                check_numbers(numbers, end, name)
                check_ascending(numbers, name)
            if part in neighbours or not np.isin(shared, nodes).all():
                raise ValueError("a part shares with itself, or nodes that are not its own")

        own_hexahedra, own_domains = np.split(cells, [np.searchsorted(cells, n_hexahedra)])
        own_domains = own_domains - n_hexahedra
        dofs, prescribed = matching(file["prescribed_dofs"], nodes, 3)
        field_domains, fields_here = matching(file["field_domains"], own_domains, 1)
        n_fe_nodes = int(file.attrs["n_fe_nodes"])
        hexahedra, domains = read_rows(file["hexahedra"], own_hexahedra), read_rows(file["domains"], own_domains)
        material, materials = read_rows(file["material"], cells), read_materials(file)
        check_numbers(material, len(materials), "material")
        check_ascending(dofs, "prescribed_dofs")
        for name, numbers in (("hexahedra", hexahedra), ("domains", domains)):
            # As `localise` will find them: a node of which this part has no copy would be beyond its arrays.
            check_numbers(numbers, n_nodes, name)
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
        check_finite({f.name: v for f in fields(PartRows) if isinstance(v := getattr(part_rows, f.name), np.ndarray)})
        return part_rows


def _range(offsets: h5py.Dataset, part: int) -> slice:
    start, stop = offsets[part : part + 2]
    if not 0 <= start <= stop:
        raise ValueError(f"{offsets.name} do not ascend")
    return slice(int(start), int(stop))
