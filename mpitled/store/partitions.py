"""The layout of partitions in a model, and what one part reads of both."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled.errors import InputError, damaged
from mpitled.laws import Material
from mpitled.store.files import REBUILD, check_room, matching, open_file, put, read_rows, replacing
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


#: Rows first to last of a column, in the part's order.
Source = Callable[[str, int, int], NDArray[Any]]
#: What each long column has a row of.
_COLUMNS = {
    **dict.fromkeys(("node_ids", "rows", "points", "mass"), "nodes"),
    **dict.fromkeys(("cells", "material"), "cells"),
    "hexahedra": "hexahedra",
    **dict.fromkeys(("domains", "domain_points", "domain_volumes", "domain_gradients", "domain_shapes"), "domains"),
}
#: Rows of long columns at a time.
BLOCK = 1 << 16


@dataclass(frozen=True, slots=True)
class PartRows:
    """The rows of the model that one part needs, in SI units and global numbers.

    A cell is on one part; a node is on every part whose cells touch it, and the lowest of them owns it. The long
    columns stay where they are until they are asked for (`read`), so that a run need not hold what it needs once:

    - of `nodes`: "node_ids" (k,), numbers in the file that they came from; "rows" (k,) in the result files; "points"
      (k, 3), m; "mass" (k,), kg, of the whole model's cells;
    - of cells, this part's hexahedra and then its support domains: "cells" (n,) ascending; "material" (n,);
    - "hexahedra" (n_own_hexahedra, 8), nodes;
    - of support domains: "domains" (n_own_domains, n), nodes; "domain_points" (.., 3), m; "domain_volumes" (..,), m^3;
      "domain_gradients" (.., n, 3), 1/m; "domain_shapes" (.., n).
    """

    n_parts: int
    part: int
    n_nodes: int  # of the whole model
    n_fe_nodes: int  # of the whole model
    n_hexahedra: int  # of the whole model
    n_domains: int  # of the whole model
    n_own_hexahedra: int
    n_own_domains: int
    nodes: NDArray[np.signedinteger]  # (k,) ascending nodes that the part's cells touch; int32 as far as it goes
    owned: NDArray[np.bool_]  # (k,)
    first_row: int  # row of the first owned node; owned nodes follow each other
    materials: tuple[Material, ...]
    prescribed_dofs: NDArray[np.int64]  # ascending 3 node + direction, on `nodes`
    prescribed_displacements: NDArray[np.float64]  # m
    prescribed_turns: NDArray[np.float64]  # (len(prescribed_dofs), 3)
    field_nodes: NDArray[np.int64]  # ascending EFG nodes whose field one of "domains" gives; not all in `nodes`
    field_domains: NDArray[np.int64]  # the support domain of each, a number of the whole model
    field_shapes: NDArray[np.float64]  # (len(field_nodes), n)
    neighbours: NDArray[np.int32]  # ascending parts that share nodes with this one
    shared: NDArray[np.int64]  # ascending nodes shared with each neighbour in turn
    shared_offsets: NDArray[np.int64]  # (len(neighbours) + 1,) into `shared`
    source: Source

    @property
    def n_own_cells(self) -> int:
        return self.n_own_hexahedra + self.n_own_domains

    def length(self, name: str) -> int:
        """Rows of a column."""
        lengths = {
            "nodes": len(self.nodes),
            "cells": self.n_own_cells,
            "hexahedra": self.n_own_hexahedra,
            "domains": self.n_own_domains,
        }
        return lengths[_COLUMNS[name]]

    def local(self, nodes: NDArray[np.integer]) -> NDArray[np.int64]:
        """Places of nodes in `nodes`, where they have to be."""
        # Of its own type, or numpy would make `nodes` anew of the other.
        return np.searchsorted(self.nodes, nodes.astype(self.nodes.dtype, copy=False))

    def read(self, name: str, first: int = 0, last: int | None = None) -> NDArray[Any]:
        """Rows first to last of a long column, from the file. InputError if it cannot be read any more."""
        return self.source(name, first, self.length(name) if last is None else last)

    def blocks(self, name: str) -> Iterator[tuple[int, NDArray[Any]]]:
        """A long column in blocks, each with its first row."""
        length = self.length(name)
        for first in range(0, length, BLOCK):
            yield first, self.read(name, first, min(first + BLOCK, length))

    def holding(self, **columns: NDArray[Any]) -> PartRows:
        """The same with other columns in place of the file's."""

        def source(name: str, first: int, last: int) -> NDArray[Any]:
            return columns[name][first:last] if name in columns else self.source(name, first, last)

        return replace(self, source=source)


class _File:
    """The long columns of one part in an open model; it stays open, whatever becomes of its name."""

    def __init__(self, path: Path, n_parts: int, part: int, nodes: NDArray[np.signedinteger]) -> None:
        """nodes: of the part, ascending."""
        self._file, self._path, self._nodes = open_file(path), path, nodes
        self._group = None if n_parts == 1 else self._file[f"partitions/{n_parts}"]
        self._n_hexahedra = len(self._file["hexahedra"])
        self._cells = slice(0, 0) if self._group is None else _range(self._group["cell_offsets"], part)
        cells = self.numbers(0, self._cells.stop - self._cells.start)
        self.n_own_hexahedra = int(np.searchsorted(cells, self._n_hexahedra))

    def numbers(self, first: int, last: int) -> NDArray[np.int64]:
        """Of cells of the part in the whole model."""
        if self._group is None:
            return np.arange(first, last)
        return np.asarray(self._group["cells"][self._cells.start + first : self._cells.start + last], np.int64)

    def __call__(self, name: str, first: int, last: int) -> NDArray[Any]:
        with damaged(self._path, REBUILD):
            if name == "cells":
                return self.numbers(first, last)
            if self._group is None:
                return np.arange(first, last) if name == "rows" else np.asarray(self._file[name][first:last])
            kind, before = _COLUMNS[name], self.n_own_hexahedra
            if kind == "nodes":
                return read_rows((self._group if name == "rows" else self._file)[name], self._nodes[first:last])
            if kind == "domains":
                return read_rows(self._file[name], self.numbers(before + first, before + last) - self._n_hexahedra)
            return read_rows(self._file[name], self.numbers(first, last))


def read_part(path: Path, n_parts: int, part: int) -> PartRows:
    """The rows of part `part` of `n_parts`, without holding those of others; the file stays open for `PartRows.read`.

    InputError if the model has no such partition.
    """
    with open_model(path) as file:
        n_nodes, n_hexahedra, n_domains = (len(file[name]) for name in ("points", "hexahedra", "domains"))
        if n_parts == 1:
            nodes = rows = _numbers(np.arange(n_nodes), n_nodes)
            source = _File(path, n_parts, part, nodes)
            n_own_hexahedra, n_own_cells = n_hexahedra, n_hexahedra + n_domains
            own_domains = np.arange(n_domains)
            first_row, end_row = 0, n_nodes
            neighbours, shared, shared_offsets = np.empty(0, np.int32), np.empty(0, np.int64), np.zeros(1, np.int64)
        else:
            if f"partitions/{n_parts}" not in file:
                raise InputError(f"{path}: has no partition in {n_parts} parts; partition the model first")
            group = file[f"partitions/{n_parts}"]
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
            cells = group["cells"][_range(group["cell_offsets"], part)]
            if len(shared_offsets) != len(neighbours) + 1 or (np.diff(shared_offsets) < 0).any():
                raise ValueError("shared_offsets do not fit the neighbours")
            for name, numbers, end in (("neighbours", neighbours, n_parts), ("rows", rows, n_nodes)):
                check_numbers(numbers, end, name)
            for name, numbers, end in (("cells", cells, n_hexahedra + n_domains), ("nodes", nodes, n_nodes)):
                check_numbers(numbers, end, name)
                check_ascending(numbers, name)
            if part in neighbours or not np.isin(shared, nodes).all():
                raise ValueError("a part shares with itself, or nodes that are not its own")
            nodes = _numbers(nodes, n_nodes)
            source = _File(path, n_parts, part, nodes)
            n_own_hexahedra, n_own_cells = source.n_own_hexahedra, len(cells)
            own_domains = cells[n_own_hexahedra:] - n_hexahedra

        dofs, prescribed = matching(file["prescribed_dofs"], nodes, 3)
        field_domains, fields_here = matching(file["field_domains"], own_domains, 1)
        n_fe_nodes = int(file.attrs["n_fe_nodes"])
        check_ascending(dofs, "prescribed_dofs")
        part_rows = PartRows(
            n_parts=n_parts,
            part=part,
            n_nodes=n_nodes,
            n_fe_nodes=n_fe_nodes,
            n_hexahedra=n_hexahedra,
            n_domains=n_domains,
            n_own_hexahedra=n_own_hexahedra,
            n_own_domains=n_own_cells - n_own_hexahedra,
            nodes=nodes,
            owned=(rows >= first_row) & (rows < end_row),
            first_row=int(first_row),
            materials=read_materials(file),
            prescribed_dofs=dofs,
            prescribed_displacements=read_rows(file["prescribed_displacements"], prescribed),
            prescribed_turns=read_rows(file["prescribed_turns"], prescribed),
            field_nodes=n_fe_nodes + fields_here,
            field_domains=field_domains,
            field_shapes=read_rows(file["field_shapes"], fields_here),
            neighbours=neighbours,
            shared=shared,
            shared_offsets=shared_offsets,
            source=source,
        )
        check_finite({f.name: v for f in fields(PartRows) if isinstance(v := getattr(part_rows, f.name), np.ndarray)})
        _check_columns(part_rows)
        return part_rows


def _numbers(nodes: NDArray[np.int64], n_nodes: int) -> NDArray[np.signedinteger]:
    """In half the room where a model has no more than 2^31 nodes."""
    return nodes.astype(np.int32) if n_nodes <= np.iinfo(np.int32).max else nodes


def _check_columns(part: PartRows) -> None:
    """ValueError unless the long columns hold what they may."""
    for name in _COLUMNS:
        for _, values in part.blocks(name):
            if name in ("hexahedra", "domains"):
                # As `localise` will find them: a node of which this part has no copy would be beyond its arrays.
                check_numbers(values, part.n_nodes, name)
                if not (part.nodes.take(part.local(values), mode="clip") == values).all():
                    raise ValueError(f"{name} have nodes that their part has not")
            elif name == "material":
                check_numbers(values, len(part.materials), name)
            else:
                check_finite({name: values})


def _range(offsets: h5py.Dataset, part: int) -> slice:
    start, stop = offsets[part : part + 2]
    if not 0 <= start <= stop:
        raise ValueError(f"{offsets.name} do not ascend")
    return slice(int(start), int(stop))
