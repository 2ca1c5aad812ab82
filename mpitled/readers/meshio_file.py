"""Mesh files in the formats of meshio."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled.errors import InputError
from mpitled.hdf5 import check_hdf5
from mpitled.mesh import Ints
from mpitled.readers import meshfile
from mpitled.readers.meshfile import Cells, MeshFile
from mpitled.readers.text import decode, read_text

#: meshio's names of the solids; types with more nodes begin with the corners.
_KINDS = {
    "hexahedron": "hexahedron", "tetra": "tetrahedron", "tetra10": "tetrahedron", "wedge": "wedge",
    "pyramid": "pyramid",
}  # fmt: skip
_MAX_VALUES = 100  # a field of integers with more values does not define sets


def read(path: Path) -> MeshFile:
    """The mesh of a file. InputError if meshio does not know its format or cannot read it."""
    import meshio

    if path.suffix.lower() not in meshio.extension_to_filetypes:
        formats = ".vtu, .vtk, .msh, .med, .xdmf, .mesh, .bdf, .e"
        raise InputError(f"{path}: is no mesh in a known format; give an Abaqus or LS-DYNA deck, or {formats} ...")
    _check_hdf5(path)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as printed:
            return _converted(meshio.read(path), path)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # meshio raises many kinds of errors, exits, and returns invalid arrays
        reason = " ".join((str(error) if not isinstance(error, SystemExit) else printed.getvalue()).split())[:100]
        raise InputError(f"{path}: cannot be read by meshio ({reason or type(error).__name__}); correct it") from None


def _check_hdf5(path: Path) -> None:
    """InputError if the HDF5 file, or a file that an XDMF file names, would make meshio read further files."""
    with path.open("rb") as file:
        head = file.read(8)
    if head == b"\x89HDF\r\n\x1a\n":
        check_hdf5(path)
    elif path.suffix.lower() in (".xdmf", ".xmf"):
        text = decode(read_text(path, "a mesh (XDMF)"))
        for name in sorted(set(re.findall(r"([^<>\s]+):/", text))):
            beside = path.parent / name
            if Path(name).name != name or not beside.is_file():
                raise InputError(f"{path}: its data are in {name}, which is not beside it; put it there")
            check_hdf5(beside)


def _converted(mesh: Any, path: Path) -> MeshFile:
    points = np.asarray(mesh.points, float)
    if points.ndim != 2 or not 1 < points.shape[1] < 4:
        raise InputError(f"{path}: has nodes without two or three coordinates; correct it")
    points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    file = MeshFile(path, f"meshio ({path.suffix})", points, np.arange(1, len(points) + 1))
    for block in mesh.cells:
        data: Any = np.empty((len(block.data), 0), np.int64)  # of polyhedra and other types with lists of nodes
        if isinstance(block.data, np.ndarray) and block.data.ndim == 2 and block.data.dtype.kind in "iu":
            data = block.data
        if data.size and (data.min() < 0 or data.max() >= len(points)):
            raise InputError(f"{path}: a cell of type {block.type} has a node that the file does not define")
        kind = _KINDS.get(block.type, "other")
        if data.shape[1] < meshfile.SOLIDS.get(kind, 0):
            raise InputError(f"{path}: cells of type {block.type} have {data.shape[1]} nodes; correct it")
        ids = file.n_cells + 1 + np.arange(len(data))
        nodes = data[:, : meshfile.SOLIDS.get(kind)].astype(np.int64)
        file.cells.append(Cells(kind, block.type, ids, nodes, str(path)))
    _enter_sets(mesh, file)
    return file


def _enter_sets(mesh: Any, file: MeshFile) -> None:
    """Named sets, physical groups of gmsh, families of MED, and integer fields with few values."""
    for name, members in mesh.point_sets.items():
        meshfile.add_set(file.node_sets, name, _members(members, len(file.points), name, file))
    starts = np.cumsum([0, *(len(block.ids) for block in file.cells)])
    for name, blocks in mesh.cell_sets.items():
        if not name.startswith("gmsh:"):
            members = [
                start + _members(rows, len(block.ids), name, file)
                for start, rows, block in zip(starts, blocks, file.cells, strict=False)
                if rows is not None
            ]
            meshfile.add_set(file.cell_sets, name, meshfile.union(members))
    # In gmsh files, field_data has the tag and dimension of each group; other formats have other data.
    fields = getattr(mesh, "field_data", {}).items()
    groups = {int(np.ravel(pair)[0]): name for name, pair in fields if _is_group(pair)}
    cell_data = {name: meshfile.joined(map(np.ravel, parts)) for name, parts in mesh.cell_data.items()}
    for data, families, sets, size in (
        (mesh.point_data, getattr(mesh, "point_tags", {}), file.node_sets, len(file.points)),
        (cell_data, getattr(mesh, "cell_tags", {}), file.cell_sets, file.n_cells),
    ):
        for name, values in data.items():
            column: NDArray[Any] = np.asarray(values)
            if name in ("gmsh:geometrical", "gmsh:dim_tags") or column.dtype.kind not in "iu":
                continue
            if column.shape != (size,) or len(distinct := np.unique(column)) > _MAX_VALUES:
                continue
            for value in distinct:
                if name == "gmsh:physical":
                    names = [groups.get(int(value), f"physical {value}")]
                elif name in ("cell_tags", "point_tags"):
                    names = list(families.get(int(value), []))
                else:
                    names = [f"{name} {value}"]
                for set_name in names:
                    meshfile.extend_set(sets, set_name, np.flatnonzero(column == value))


def _members(rows: Any, end: int, name: str, file: MeshFile) -> Ints:
    """Rows of a set, ascending. InputError if one does not exist."""
    found = np.unique(np.asarray(rows, np.int64))
    if len(found) and not 0 <= found[0] <= found[-1] < end:
        raise InputError(f"{file.path}: the set '{name}' has members that the file does not define; correct it")
    return found


def _is_group(pair: Any) -> bool:
    return not isinstance(pair, str | list | dict) and np.shape(pair) == (2,) and np.asarray(pair).dtype.kind in "iu"
