"""The file layout of partitions in a model, and the rows of the model that one part needs."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled.cells.kind import CellKind
from mpitled.errors import InputError, damaged
from mpitled.hdf5 import open_file
from mpitled.laws import Material
from mpitled.store.files import REBUILD, attribute, check_free_space, matching, put, read_rows, replacing
from mpitled.store.models import (
    BlockGroup,
    block_arrays,
    block_groups,
    check_ascending,
    check_finite,
    check_range,
    open_model,
    read_materials,
)

if TYPE_CHECKING:
    from partition import PartTables


def write_partition(path: Path, tables: PartTables) -> None:
    """Add the partition to the model; replaces a partition with the same number of parts.

    The function writes a copy of the model, which then replaces the model: an interrupted append could destroy an HDF5
    file. The file also stores the row of every node in results: ascending owned nodes of part 0, then of part 1, and so
    on. InputError if a node is on no part, or the file cannot be written.
    """
    with open_model(path) as file:
        n_nodes = len(file["points"])
    # The first entry of a node in the tables is in its lowest part, the owner.
    nodes, first = np.unique(tables.nodes, return_index=True)
    if len(nodes) != n_nodes:
        raise InputError(f"{path}: {n_nodes - len(nodes)} nodes are on no part; partition the model anew")
    owner = np.searchsorted(tables.node_offsets, first, side="right") - 1
    rows = np.empty(n_nodes, np.int64)
    rows[np.argsort(owner, kind="stable")] = np.arange(n_nodes)

    with replacing(path) as temporary:
        size = sum(np.asarray(getattr(tables, column.name)).nbytes for column in fields(tables))
        check_free_space(path, Path(path).stat().st_size + size)
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
    """Whether `read_part` can read the model in n_parts parts; one part needs no partition."""
    with open_model(path) as file:
        return n_parts == 1 or f"partitions/{n_parts}" in file


def partition_mark(path: Path, n_parts: int) -> str:
    """An identifier of the partition into n_parts parts. InputError if there is no such partition."""
    with open_model(path) as file:
        if n_parts == 1:
            return "whole"
        return f"{n_parts}:{int(_partition(file, n_parts)['nodes'].attrs['checksum']) % (1 << 64):016x}"


def _partition(file: h5py.File, n_parts: int) -> h5py.Group:
    if f"partitions/{n_parts}" not in file:
        raise InputError(f"{file.filename}: has no partition into {n_parts} parts; partition the model first")
    return file[f"partitions/{n_parts}"]


#: Function of (column, first, last): rows first to last of a column, in the order of the part.
Source = Callable[[str, int, int], NDArray[Any]]
#: Columns with a row for each node of the part.
NODE_COLUMNS = ("node_ids", "rows", "points", "mass")
#: Rows of a column that one call reads or writes.
CHUNK_ROWS = 1 << 16


@dataclass(frozen=True, slots=True)
class PartBlock:
    """The cells of one block on a part; n_own may be 0.

    Columns: "cells" (n_own,), int64, ascending numbers in the model; "nodes" (n_own, k), int64, global numbers;
    "material" (n_own,), int16; and the columns of the kind, see `CellKind.columns`.
    """

    name: str
    kind: CellKind
    n_nodes: int  # nodes per cell, k
    n_cells: int  # cells of the block in the model
    n_own: int  # cells of the block on this part
    first_own: int  # local number of the first cell; local cells are numbered block after block
    source: Source

    def read(self, name: str, first: int = 0, last: int | None = None) -> NDArray[Any]:
        """Rows first to last of a column, from the file. InputError if reading fails."""
        return self.source(name, first, self.n_own if last is None else last)

    def chunks(self, name: str) -> Iterator[tuple[int, NDArray[Any]]]:
        """Pairs (first row, rows) of a column in pieces of `CHUNK_ROWS`."""
        for first in range(0, self.n_own, CHUNK_ROWS):
            yield first, self.read(name, first, min(first + CHUNK_ROWS, self.n_own))

    def gradients(self, points: NDArray[np.float64], cells: NDArray[np.integer], first: int, rule: str = "mean") -> Any:
        """Gradients (n, k, 3), 1/m, of the shape functions of `cells` (n, k).

        points: (n_nodes, 3), m; cells: local nodes of the rows first to first + n of the block; rule: "mean" or
        "centre", for hexahedra.
        """
        if self.kind.geometry:
            return self.kind.geometry(points, cells, rule)[0]
        return self.read("gradients", first, first + len(cells))


@dataclass(frozen=True, slots=True)
class PartRows:
    """The rows of the model that one part needs, in SI units and global numbers.

    A cell is on one part. A node is on every part with a cell that touches the node; the lowest of these parts owns the
    node. Long columns stay in the file: a run reads them once and does not store them. `read` returns columns of
    `nodes`: "node_ids" (k,), numbers in the input file; "rows" (k,), rows in results; "points" (k, 3), m; "mass" (k,),
    kg, with the cells of all parts. `read` also returns "cells" and "material" of all blocks; `blocks` have all columns
    of cells.
    """

    n_parts: int
    part: int
    n_nodes: int  # of the model
    n_fe_nodes: int  # of the model
    blocks: tuple[PartBlock, ...]  # all blocks of the model, in order
    nodes: NDArray[np.signedinteger]  # (k,) ascending nodes of the part's cells; int32 if n_nodes permits
    owned: NDArray[np.bool_]  # (k,)
    first_row: int  # row of the first owned node in results; the rows of owned nodes are consecutive
    materials: tuple[Material, ...]
    prescribed_dofs: NDArray[np.int64]  # ascending 3 node + direction, on `nodes`
    prescribed_displacements: NDArray[np.float64]  # m
    rotation_paths: NDArray[np.float64]  # (len(prescribed_dofs), 3)
    field_block: str  # name of the block that interpolates the field at EFG nodes
    field_nodes: NDArray[np.int64]  # ascending EFG nodes whose field a cell of this part gives; may not be in `nodes`
    field_domains: NDArray[np.int64]  # (len(field_nodes),) these cells, rows of the field block on this part
    field_shapes: NDArray[np.float64]  # (len(field_nodes), k)
    neighbours: NDArray[np.int32]  # ascending parts that share nodes with this part
    shared: NDArray[np.int64]  # nodes shared with the first neighbour, ascending, then with the second, and so on
    shared_offsets: NDArray[np.int64]  # (len(neighbours) + 1,) into `shared`
    source: Source

    @property
    def n_cells(self) -> int:
        """Cells of the model."""
        return sum(block.n_cells for block in self.blocks)

    @property
    def n_own_cells(self) -> int:
        """Cells of this part."""
        return sum(block.n_own for block in self.blocks)

    def of_kind(self, kind: str) -> list[PartBlock]:
        """The blocks of a kind."""
        return [block for block in self.blocks if block.kind.name == kind]

    def n_own(self, kind: str) -> int:
        """Cells of a kind on this part."""
        return sum(block.n_own for block in self.of_kind(kind))

    def find_cell(self, cell: int) -> tuple[PartBlock, int]:
        """The block of a local cell, and the row of the cell in the block."""
        block = next(block for block in self.blocks if cell < block.first_own + block.n_own)
        return block, cell - block.first_own

    def local(self, nodes: NDArray[np.integer]) -> NDArray[np.int64]:
        """Local numbers of nodes of this part, from global numbers."""
        # With another type, numpy would convert all of `self.nodes`.
        return np.searchsorted(self.nodes, nodes.astype(self.nodes.dtype, copy=False))

    def read(self, name: str, first: int = 0, last: int | None = None) -> NDArray[Any]:
        """Rows first to last of a column, from the file. InputError if reading fails."""
        if name in NODE_COLUMNS:
            return self.source(name, first, len(self.nodes) if last is None else last)
        last = self.n_own_cells if last is None else last
        ranges = [(b, *np.clip([first - b.first_own, last - b.first_own], 0, b.n_own).tolist()) for b in self.blocks]
        return np.concatenate([block.read(name, start, stop) for block, start, stop in ranges])

    def with_columns(self, **columns: NDArray[Any]) -> PartRows:
        """A copy with these columns, of nodes or of all cells, in place of the columns of the file."""
        blocks = [
            replace(b, source=_replaced(b.source, {n: v[b.first_own :][: b.n_own] for n, v in columns.items()}))
            for b in self.blocks
        ]
        return replace(self, source=_replaced(self.source, columns), blocks=tuple(blocks))


def _replaced(source: Source, columns: dict[str, NDArray[Any]]) -> Source:
    def read(name: str, first: int, last: int) -> NDArray[Any]:
        return columns[name][first:last] if name in columns else source(name, first, last)

    return read


class _PartFile:
    """Columns of one part in an open model. The file stays open, even if another file replaces it."""

    def __init__(self, path: Path, n_parts: int, part: int, nodes: NDArray[np.signedinteger]) -> None:
        """nodes: (k,) ascending nodes of the part."""
        self._file, self._path, self._nodes = open_file(path), path, nodes
        self._group = None if n_parts == 1 else self._file[f"partitions/{n_parts}"]
        self._cells = slice(0, 0) if self._group is None else _range(self._group["cell_offsets"], part)

    def __call__(self, name: str, first: int, last: int) -> NDArray[Any]:
        with damaged(self._path, REBUILD):
            if self._group is None:
                return np.arange(first, last) if name == "rows" else np.asarray(self._file[name][first:last])
            return read_rows((self._group if name == "rows" else self._file)[name], self._nodes[first:last])

    def blocks(self) -> tuple[PartBlock, ...]:
        """All blocks of the model."""
        blocks, first_own = [], 0
        own = None if self._group is None else self._group["cells"][self._cells]
        for block in block_groups(self._file):
            n_own = block.n_cells
            if own is not None:
                n_own = int(np.diff(np.searchsorted(own, [block.first, block.first + n_own]))[0])
            source = self._block_source(block, first_own)
            k = block.group["nodes"].shape[1]
            blocks.append(PartBlock(block.name, block.kind, k, block.n_cells, n_own, first_own, source))
            first_own += n_own
        return tuple(blocks)

    def _block_source(self, block: BlockGroup, first_own: int) -> Source:
        start = self._cells.start + first_own

        def read(name: str, first: int, last: int) -> NDArray[Any]:
            with damaged(self._path, REBUILD):
                if self._group is None:
                    if name == "cells":
                        return np.arange(block.first + first, block.first + last)
                    return np.asarray(block.group[name][first:last])
                cells = np.asarray(self._group["cells"][start + first : start + last], np.int64)
                return cells if name == "cells" else read_rows(block.group[name], cells - block.first)

        return read


def read_part(path: Path, n_parts: int, part: int) -> PartRows:
    """The rows of one part. The file stays open for `PartRows.read`.

    InputError if the model has no partition into n_parts parts, or is damaged.
    """
    with open_model(path) as file:
        n_nodes, n_fe_nodes = len(file["points"]), int(file.attrs["n_fe_nodes"])
        n_cells = sum(block.n_cells for block in block_groups(file))
        if n_parts == 1:
            nodes = rows = _narrowed(np.arange(n_nodes), n_nodes)
            first_row, end_row = 0, n_nodes
            neighbours, shared, shared_offsets = np.empty(0, np.int32), np.empty(0, np.int64), np.zeros(1, np.int64)
        else:
            group = _partition(file, n_parts)
            nodes = group["nodes"][_range(group["node_offsets"], part)]
            check_range(nodes, len(group["rows"]), "nodes")
            rows = read_rows(group["rows"], nodes)
            first_row, end_row = group["owned_offsets"][part : part + 2]
            own = _range(group["neighbour_offsets"], part)
            neighbours = group["neighbours"][own]
            shared_offsets = group["shared_offsets"][own.start : own.stop + 1]
            check_range(shared_offsets, len(group["shared"]) + 1, "shared_offsets")
            shared = group["shared"][shared_offsets[0] : shared_offsets[-1]]
            shared_offsets = shared_offsets - shared_offsets[0]
            cells = group["cells"][_range(group["cell_offsets"], part)]
            if len(shared_offsets) != len(neighbours) + 1 or (np.diff(shared_offsets) < 0).any():
                raise ValueError("shared_offsets do not fit the neighbours")
            for name, numbers, end in (("neighbours", neighbours, n_parts), ("rows", rows, n_nodes)):
                check_range(numbers, end, name)
            for name, numbers, end in (("cells", cells, n_cells), ("nodes", nodes, n_nodes)):
                check_range(numbers, end, name)
                check_ascending(numbers, name)
            if part in neighbours or not np.isin(shared, nodes).all():
                raise ValueError("a part shares nodes with itself, or shares nodes of other parts")
            nodes = _narrowed(nodes, n_nodes)
        source = _PartFile(path, n_parts, part, nodes)
        blocks, field_block = source.blocks(), str(attribute(file, "field_block"))
        own_domains = np.empty(0, np.int64)
        for block, stored in zip(blocks, block_groups(file), strict=True):
            if block.name == field_block:
                own_domains = block.read("cells") - stored.first
        dofs, prescribed = matching(file["prescribed_dofs"], nodes, 3)
        field_domains, with_field = matching(file["field_domains"], own_domains, 1)
        check_ascending(dofs, "prescribed_dofs")
        part_rows = PartRows(
            n_parts=n_parts,
            part=part,
            n_nodes=n_nodes,
            n_fe_nodes=n_fe_nodes,
            blocks=blocks,
            nodes=nodes,
            owned=(rows >= first_row) & (rows < end_row),
            first_row=int(first_row),
            materials=read_materials(file),
            prescribed_dofs=dofs,
            prescribed_displacements=read_rows(file["prescribed_displacements"], prescribed),
            rotation_paths=read_rows(file["rotation_paths"], prescribed),
            field_block=field_block,
            field_nodes=n_fe_nodes + with_field,
            field_domains=np.searchsorted(own_domains, field_domains),
            field_shapes=read_rows(file["field_shapes"], with_field),
            neighbours=neighbours,
            shared=shared,
            shared_offsets=shared_offsets,
            source=source,
        )
        check_finite({f.name: v for f in fields(PartRows) if isinstance(v := getattr(part_rows, f.name), np.ndarray)})
        _check_columns(part_rows)
        return part_rows


def _narrowed(nodes: NDArray[np.int64], n_nodes: int) -> NDArray[np.signedinteger]:
    """Node numbers as int32, which halves their memory, if the model has fewer than 2^31 nodes."""
    return nodes.astype(np.int32) if n_nodes <= np.iinfo(np.int32).max else nodes


def _check_columns(part: PartRows) -> None:
    """ValueError unless the columns in the file hold valid numbers."""
    for name in NODE_COLUMNS:
        for first in range(0, len(part.nodes), CHUNK_ROWS):
            check_finite({name: part.read(name, first, min(first + CHUNK_ROWS, len(part.nodes)))})
    for block in part.blocks:
        for name in ("cells", *block_arrays(block.kind)):
            for _, values in block.chunks(name):
                if name == "nodes":
                    check_range(values, part.n_nodes, f"nodes of {block.name}")
                    # The local number of a node outside of the part would be beyond the arrays of the part.
                    if not (part.nodes.take(part.local(values), mode="clip") == values).all():
                        raise ValueError(f"a cell of {block.name} has a node that is not on the part of the cell")
                elif name == "material":
                    check_range(values, len(part.materials), f"material of {block.name}")
                else:
                    check_finite({name: values})


def _range(offsets: h5py.Dataset, part: int) -> slice:
    start, stop = offsets[part : part + 2]
    if not 0 <= start <= stop:
        raise ValueError(f"{offsets.name} do not ascend")
    return slice(int(start), int(stop))
