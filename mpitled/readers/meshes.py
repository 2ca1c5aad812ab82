"""Meshes that other programs made: one FE file, one of the cloud, and integration points become the mixed mesh.

The only importer of meshio. Abaqus and LS-DYNA decks have readers of their own, because meshio's drop boundary
conditions and sets of sets.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpitled import store
from mpitled.cells import hexahedra
from mpitled.errors import InputError
from mpitled.material import Material
from mpitled.mesh import METRES, Constraint, Mesh
from mpitled.meshing import checks
from mpitled.meshing.integration_cells import subdivide, volumes_and_centroids
from mpitled.readers import abaqus, lsdyna, meshfile, tables
from mpitled.readers.meshfile import Cells, MeshFile

if TYPE_CHECKING:
    from mpitled import deck

#: kg/m^3 of a material whose file gives no density.
DENSITY = 1000.0
#: Integration volumes that miss the void's by more than this share are warned about.
FILLED = 0.01
_PASCALS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9}
_DENSITIES = {"kg/m3": 1.0, "g/cm3": 1e3, "kg/mm3": 1e9, "t/mm3": 1e12}
#: Solids of real matter; what is outside is a slip of units.
_PLAUSIBLE = (1.0, 30000.0)  # kg/m^3
#: Each solid as a hexahedron some of whose corners coincide: its volume and its centroid are still exact.
_AS_HEXAHEDRON = {
    "hexahedron": [0, 1, 2, 3, 4, 5, 6, 7],
    "wedge": [0, 1, 2, 2, 3, 4, 5, 5],
    "pyramid": [0, 1, 2, 3, 4, 4, 4, 4],
    "tetrahedron": [0, 1, 2, 2, 3, 3, 3, 3],
}
#: meshio's names of the solids; those with more nodes begin with the corners.
_MESHIO = {
    "hexahedron": "hexahedron", "tetra": "tetrahedron", "tetra10": "tetrahedron", "wedge": "wedge",
    "pyramid": "pyramid",
}  # fmt: skip
_MOST_VALUES = 100  # a field of integers with more different values is no division into sets


# --- files ---------------------------------------------------------------------------------------------------------


def read_file(path: Path) -> MeshFile:
    """What a mesh file of any kind says. InputError if it is none, or wrong."""
    with np.errstate(over="ignore", invalid="ignore"):  # of what is refused right away
        file = _reader(path)[0](path)
    bad = np.flatnonzero(~(np.abs(file.points) < meshfile.FARTHEST).all(axis=1))
    if len(bad):
        raise InputError(
            f"{path}: node {file.node_ids[bad[0]]} has a coordinate beyond {meshfile.FARTHEST:g} ({len(bad)} such)"
        )
    return file


def files(section: deck.MeshFiles) -> list[Path]:
    """The meshes of a deck's section with all that they include: the model depends on their contents."""
    found = [_reader(path)[1](path) for path in (section.fe, section.efg) if path]
    return [path for several in found for path in several]


def _reader(path: Path) -> tuple[Callable[[Path], MeshFile], Callable[[Path], list[Path]]]:
    """The reader of a file, and the function that says what it includes; chosen by name and contents."""
    try:
        meshfile.check_file(path, "a mesh")
        with path.open("rb") as file:
            head = file.read(1 << 16)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give the path of a mesh") from None
    suffix = path.suffix.lower()
    lines = [line.strip() for line in head.removeprefix(b"\xef\xbb\xbf").split(b"\n")]
    dollars = any(line[:1] == b"$" for line in lines) and not head.startswith(b"$MeshFormat")
    first = next((line.upper() for line in lines if line and line[:1] != b"$" and line[:2] != b"**"), b"")
    if suffix in (".k", ".key", ".dyn") or (first.startswith(b"*") and (dollars or first.startswith(b"*KEYWORD"))):
        return lsdyna.read, lsdyna.files
    if suffix == ".inp" or (first.startswith(b"*") and b"\0" not in head):
        return abaqus.read, abaqus.files
    return _read_with_meshio, lambda path: [path]


def _read_with_meshio(path: Path) -> MeshFile:
    import meshio

    if path.suffix.lower() not in meshio.extension_to_filetypes:
        raise InputError(
            f"{path}: is no mesh that is known; give an Abaqus or LS-DYNA deck, or {', '.join(_some_suffixes())} ..."
        )
    _check_hdf5(path)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
            return _of_meshio(meshio.read(path), path)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # meshio raises what it likes, exits, and returns what does not fit
        reason = " ".join((str(error) if not isinstance(error, SystemExit) else said.getvalue()).split())[:100]
        raise InputError(f"{path}: cannot be read by meshio ({reason or type(error).__name__}); correct it") from None


def _check_hdf5(path: Path) -> None:
    """InputError if a file that is HDF5, or names some as XDMF does, would have meshio led elsewhere."""
    with path.open("rb") as file:
        head = file.read(8)
    if head == b"\x89HDF\r\n\x1a\n":
        store.check_hdf5(path)
    elif path.suffix.lower() in (".xdmf", ".xmf"):
        text = meshfile.decoded(meshfile.read_text(path, "a mesh (XDMF)"))
        for name in sorted(set(re.findall(r"([^<>\s]+):/", text))):
            beside = path.parent / name
            if Path(name).name != name or not beside.is_file():
                raise InputError(f"{path}: its data are in {name}, which is not beside it; put it there")
            store.check_hdf5(beside)


def _of_meshio(mesh: Any, path: Path) -> MeshFile:
    points = np.asarray(mesh.points, float)
    if points.ndim != 2 or not 1 < points.shape[1] < 4:
        raise InputError(f"{path}: has nodes that are no places in space; correct it")
    points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    file = MeshFile(path, f"meshio ({path.suffix})", points, np.arange(1, len(points) + 1))
    first = 0
    for block in mesh.cells:
        data: Any = np.empty((len(block.data), 0), np.int64)  # of polyhedra and the like, which have lists
        if isinstance(block.data, np.ndarray) and block.data.ndim == 2 and block.data.dtype.kind in "iu":
            data = block.data
        if data.size and (data.min() < 0 or data.max() >= len(points)):
            raise InputError(f"{path}: a cell of type {block.type} has a node that the file does not define")
        kind = _MESHIO.get(block.type, "other")
        if data.shape[1] < meshfile.SOLIDS.get(kind, 0):
            raise InputError(f"{path}: cells of type {block.type} have {data.shape[1]} nodes; correct it")
        ids = first + 1 + np.arange(len(data))
        nodes = data[:, : meshfile.SOLIDS.get(kind)].astype(np.int64)
        file.cells.append(Cells(kind, block.type, ids, nodes, str(path)))
        first += len(data)
    _meshio_sets(mesh, file)
    return file


def _some_suffixes() -> list[str]:
    return [".vtu", ".vtk", ".msh", ".med", ".xdmf", ".mesh", ".bdf", ".e"]


def _meshio_sets(mesh: Any, file: MeshFile) -> None:
    """Sets by name, physical groups of gmsh, families of MED, and integer fields with few values."""
    ends = np.cumsum([0, *(len(block.ids) for block in file.cells)])
    for name, members in mesh.point_sets.items():
        meshfile.add_set(file.node_sets, name, _rows(members, len(file.points), name, file))
    for name, blocks in mesh.cell_sets.items():
        if not name.startswith("gmsh:"):
            own = [
                start + _rows(rows, len(block.ids), name, file)
                for start, rows, block in zip(ends, blocks, file.cells, strict=False)
                if rows is not None
            ]
            meshfile.add_set(file.cell_sets, name, np.unique(np.concatenate([np.empty(0, np.int64), *own])))
    # Of gmsh: a tag and a dimension. What others keep there is no group.
    fields = getattr(mesh, "field_data", {}).items()
    groups = {int(np.ravel(pair)[0]): name for name, pair in fields if _is_group(pair)}
    cell_fields = {
        name: np.concatenate([np.empty(0, np.int64), *map(np.ravel, parts)]) for name, parts in mesh.cell_data.items()
    }
    for data_fields, families, sets, size in (
        (mesh.point_data, getattr(mesh, "point_tags", {}), file.node_sets, len(file.points)),
        (cell_fields, getattr(mesh, "cell_tags", {}), file.cell_sets, file.n_cells),
    ):
        for name, data in data_fields.items():
            values: NDArray[Any] = np.asarray(data)
            if (
                values.dtype.kind not in "iu"
                or values.shape != (size,)
                or name in ("gmsh:geometrical", "gmsh:dim_tags")
            ):
                continue
            different = np.unique(values)
            for value in different[:_MOST_VALUES] if len(different) <= _MOST_VALUES else []:
                rows = np.flatnonzero(values == value)
                if name == "gmsh:physical":
                    names = [groups.get(int(value), f"physical {value}")]
                elif name in ("cell_tags", "point_tags"):
                    names = list(families.get(int(value), []))
                else:
                    names = [f"{name} {value}"]
                for chosen in names:
                    sets[chosen] = np.union1d(sets.get(chosen, np.empty(0, np.int64)), rows)


def _rows(rows: Any, end: int, name: str, file: MeshFile) -> NDArray[np.int64]:
    """A set's rows, ascending. InputError if there are no such rows."""
    found = np.unique(np.asarray(rows, np.int64))
    if len(found) and not 0 <= found[0] <= found[-1] < end:
        raise InputError(f"{file.path}: the set '{name}' has members that the file does not define; correct it")
    return found


def _is_group(pair: Any) -> bool:
    return not isinstance(pair, str | list | dict) and np.shape(pair) == (2,) and np.asarray(pair).dtype.kind in "iu"


# --- one file ------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Part:
    """A file in metres with what the mesh takes from it: where its nodes and elements went."""

    file: MeshFile
    points: NDArray[np.float64]  # (n, 3), m, all of the file's
    metre: float  # m in a unit of length
    node_map: NDArray[np.int64]  # (n,), node of the mesh; -1 if it is left out
    cell_parents: NDArray[np.int64]  # (k,), the file's element of each cell that came from it
    cells: NDArray[np.int64]  # (k,), that cell of the mesh

    def cells_of(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Cells of the mesh that came from elements (ascending), ascending."""
        return np.sort(self.cells[np.isin(self.cell_parents, rows)])


def check_solids(file: MeshFile) -> None:
    """InputError if the file has elements but no solids, or parts that change the mechanics and cannot be computed."""
    solid = any(block.kind != "other" or abaqus.is_solid(block.type) for block in file.cells)
    if len(file.points) == 0:
        raise InputError(f"{file.path}: has no nodes; give a mesh")
    if file.cells and not solid:
        kinds = {block.type: block.origin for block in file.cells if len(block.ids)}
        found = meshfile.listed(f"{kind} ({_line(origin)})" for kind, origin in kinds.items())
        raise InputError(f"{file.path}: has no solid elements; its elements are {found or 'none'}")
    if file.refused:
        more = f" ({len(file.refused) - 1} more such)" if len(file.refused) > 1 else ""
        raise InputError(file.refused[0] + more)
    for kind in meshfile.SOLIDS:
        blocks = list(_elements(file, (kind,)))
        if not blocks:
            continue
        nodes = blocks[0][0].nodes if len(blocks) == 1 else np.concatenate([block.nodes for block, _ in blocks])
        rows = np.concatenate([rows for _, rows in blocks])
        again, before = checks.repeated(nodes)
        if len(again):
            (block, number), (_, first) = (_element(file, int(rows[found[0]])) for found in (again, before))
            raise InputError(
                f"{block.origin}: element {number} has the same nodes as element {first}, and would count twice "
                f"({len(again)} such); take one of the two out"
            )


def check_cloud(file: MeshFile) -> list[str]:
    """Remarks about a file that can only be the cloud's; InputError if one of its cells is flat."""
    remarks = _others(file)
    corners, parents = _solid_corners(file, file.points)
    if len(corners):
        _check_volumes(_cell_volumes(corners)[0], file, parents)
    if len(repeated := checks.coincident(file.points, 0.0)):
        remarks.append(f"warning: {file.path}: {len(repeated)} nodes lie where another one does")
    return remarks


def _line(origin: str) -> str:
    return origin.rpartition(": ")[2]


def _solid_nodes(file: MeshFile, kinds: tuple[str, ...]) -> NDArray[np.bool_]:
    used = np.zeros(len(file.points), bool)
    for block in file.cells:
        if block.kind in kinds:
            used[block.nodes] = True
    return used


def _others(file: MeshFile) -> list[str]:
    """What becomes of shells, beams and the like: faces of solids are node sets, structural parts are refused."""
    solid, remarks, first = _solid_nodes(file, tuple(meshfile.SOLIDS)), [], 0
    structural = np.zeros(file.n_cells, bool)
    for name in file.structural:
        structural[file.cell_sets[name]] = True
    is_other = np.zeros(file.n_cells, bool)
    for block in file.cells:
        rows = slice(first, first + len(block.ids))
        first += len(block.ids)
        if block.kind != "other" or not len(block.ids):
            continue
        is_other[rows] = True
        there = block.nodes >= 0
        touching = (solid[block.nodes] & there).any(axis=1)
        bad = np.count_nonzero(touching & structural[rows])
        if bad:
            raise InputError(
                f"{block.origin}: {bad} elements of type {block.type} with a section share nodes with the solid; "
                "they cannot be computed, take them out"
            )
        kind = "which have no section" if touching.all() else "which do not hang on the solid"
        remarks.append(f"{block.origin}: {len(block.ids)} elements of type {block.type}, {kind}, are left out")
    for name, members in list(file.cell_sets.items()):
        if len(members) and is_other[members].all():
            nodes = _element_nodes(file, members)
            nodes = nodes[solid[nodes]]
            if len(nodes) and name not in file.node_sets:
                file.node_sets[name] = nodes
    return remarks


def _element_nodes(file: MeshFile, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    found, first = [np.empty(0, np.int64)], 0
    for block in file.cells:
        some = rows[(rows >= first) & (rows < first + len(block.ids))] - first
        found.append(np.unique(block.nodes[some]))
        first += len(block.ids)
    nodes = np.unique(np.concatenate(found))
    return nodes[nodes >= 0]


def _elements(file: MeshFile, kinds: tuple[str, ...]) -> Iterator[tuple[Cells, NDArray[np.int64]]]:
    """Blocks of these kinds, and the numbers of their elements in the file's order."""
    first = 0
    for block in file.cells:
        if block.kind in kinds and len(block.ids):
            yield block, first + np.arange(len(block.ids))
        first += len(block.ids)


def _hexahedra(
    file: MeshFile, points: NDArray[np.float64], taken: NDArray[np.bool_], repair: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64], list[str]]:
    """Hexahedra (n, 8) in rows of the file's points, the file's elements (n,) they are, and remarks.

    InputError for those that are inverted or flat, unless another order of their nodes makes them sound and `repair`
    asks for it, and for other solids among those that are `taken` (n_cells,).
    """
    for block, rows in _elements(file, ("tetrahedron", "wedge", "pyramid")):
        if n := np.count_nonzero(taken[rows]):
            raise InputError(
                f"{block.origin}: {n} elements of type {block.type} in the FE mesh; only hexahedra can be computed: "
                "mesh with them, or name the set in mesh.dropped"
            )
    blocks = [(block, rows[taken[rows]], block.nodes[taken[rows]]) for block, rows in _elements(file, ("hexahedron",))]
    if not blocks:
        return np.empty((0, 8), np.int64), np.empty(0, np.int64), []
    remarks = []
    if len(blocks) == 1:
        _, parents, cells = blocks[0]
    else:
        parents = np.concatenate([rows for _, rows, _ in blocks])
        cells = np.concatenate([nodes for _, _, nodes in blocks])
    del blocks
    unusable, poor = hexahedra.check(points, cells)
    if len(unusable):
        better = checks.reordered(points, cells, unusable)
        mends = better[:, 0] >= 0
        if repair:
            cells = cells.copy()
            cells[unusable[mends]] = better[mends]
            if mends.any():
                remarks.append(f"{file.path}: nodes of {np.count_nonzero(mends)} hexahedra put in order")
            unusable = unusable[~mends]
        if len(unusable):
            block, number = _element(file, int(parents[unusable[0]]))
            hint = (
                f"; {np.count_nonzero(mends)} have their nodes in another order, which mesh.repair = true corrects"
                if not repair and mends.any()
                else "; correct the mesh"
            )
            raise InputError(
                f"{block.origin}: {len(unusable)} hexahedra are inverted or flat, the first is element {number}{hint}"
            )
    if len(poor):
        block, number = _element(file, int(parents[poor[0]]))
        remarks.append(
            f"warning: {block.origin}: {len(poor)} hexahedra have a flat or inverted corner, the first is {number}"
        )
    return cells, parents, remarks


def _element(file: MeshFile, row: int) -> tuple[Cells, int]:
    for block in file.cells:
        if row < len(block.ids):
            return block, int(block.ids[row])
        row -= len(block.ids)
    raise IndexError(row)


# --- the mixed mesh ------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Cloud:
    """Integration points with the elements or sets they come with."""

    points: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))  # m
    volumes: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))  # m^3
    sets: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    fe_parents: NDArray[np.int64] | None = None  # element of the FE file of each point
    efg_parents: NDArray[np.int64] | None = None


def read_mesh(section: deck.MeshFiles, seed_volume: float = 0.0) -> Mesh:
    """The mesh of a deck's files: FE nodes in the FE file's order, then those of the EFG file that are no FE nodes.

    `seed_volume` (m^3) is what the integration points leave free within the void. InputError for all that is wrong.
    """
    if not section.fe and not section.efg:
        raise InputError("mesh.fe: is missing; give the file of the hexahedra, or mesh.efg for a cloud alone")
    fe = read_file(section.fe) if section.fe else _empty(section.efg)
    efg = read_file(section.efg) if section.efg else None
    return assemble(section, fe, efg, seed_volume)


def _empty(path: Path | None) -> MeshFile:
    assert path is not None
    return MeshFile(path, "", np.empty((0, 3)), np.empty(0, np.int64))


def assemble(section: deck.MeshFiles, fe: MeshFile, efg: MeshFile | None, seed_volume: float = 0.0) -> Mesh:
    """The mesh of files that are read; see `read_mesh`."""
    remarks = [*fe.remarks]
    if section.fe:
        check_solids(fe)
        remarks += _others(fe)
    if efg:
        check_solids(efg)
        remarks += efg.remarks + _others(efg)
    metre = METRES[section.unit]
    taken = _taken(section, fe)
    fe_points = fe.points * metre if metre != 1 else fe.points
    cells, parents, said = _hexahedra(fe, fe_points, taken, section.repair)
    remarks += said
    if section.fe and not len(cells) and not section.dropped:
        found = meshfile.listed({block.type: 0 for block in fe.cells}) or "none"
        raise InputError(f"{fe.path}: has no hexahedra (elements: {found}); it may be mesh.efg, not mesh.fe")
    fe_map, cells = _numbers(fe, cells)
    n_fe_nodes = int(fe_map.max(initial=-1)) + 1
    points, ids = fe_points[fe_map >= 0], fe.node_ids[fe_map >= 0]
    if left := len(fe.points) - n_fe_nodes:
        remarks.append(f"{fe.path}: {left} nodes that no hexahedron has are left out")
    parts = [_Part(fe, fe_points, metre, fe_map, parents, np.arange(len(cells)))]
    interface = np.empty(0, np.int64)
    cloud, corners = _Cloud(), np.empty((0, 8, 3))
    if efg:
        efg_metre = METRES[section.efg_unit or section.unit]
        efg_points = efg.points * efg_metre
        efg_map, interface = _merge(efg, efg_points, points, section.merge_tolerance)
        new = efg_map >= n_fe_nodes
        points, ids = np.concatenate([points, efg_points[new]]), np.concatenate([ids, efg.node_ids[new]])
        cloud, corners = _integration(section, fe, fe_points, taken, efg, efg_points)
        at = len(cells) + np.arange(len(cloud.points))
        for part_parents, part in ((cloud.fe_parents, parts[0]), (cloud.efg_parents, None)):
            if part_parents is not None and part:
                part.cell_parents = np.concatenate([part.cell_parents, part_parents])
                part.cells = np.concatenate([part.cells, at])
        own = cloud.efg_parents if cloud.efg_parents is not None else np.empty(0, np.int64)
        parts.append(_Part(efg, efg_points, efg_metre, efg_map, own, at[: len(own)]))
        known = f"{len(interface)} nodes merged with FE nodes, " if len(interface) else ""
        remarks.append(f"{efg.path}: {known}{np.count_nonzero(new)} EFG nodes added")
    elif section.integration_points or section.dropped or section.surface_areas:
        raise InputError("mesh.efg: is missing; integration points and dropped hexahedra need the nodes of a cloud")
    if len(repeated := checks.coincident(points, section.merge_tolerance)):
        remarks.append(
            f"warning: {len(repeated)} nodes lie where another one does, the first is node {ids[repeated[0]]}; "
            "the mesh is open there"
        )
    node_sets, cell_sets = _sets(parts, cloud, len(cells))
    if efg and len(interface) and "interface" not in node_sets:
        node_sets["interface"] = interface
    if efg:
        remarks += _cloud_remarks(section, points, cells, cloud, corners, node_sets, seed_volume)
        if not {"skull", "surface"} & node_sets.keys():
            node_sets["surface"] = _outer(points, cells, parts[1], node_sets.get("interface", interface))
    materials, said = _materials(section, parts, cell_sets)
    remarks += said
    return Mesh(
        points=points,
        n_fe_nodes=n_fe_nodes,
        hexahedra=cells,
        integration_points=cloud.points,
        integration_volumes=cloud.volumes,
        node_sets=node_sets,
        cell_sets=cell_sets,
        node_ids=ids,
        surface_areas=tables.read_areas(section.surface_areas, metre, ids) if section.surface_areas else None,
        materials=materials,
        constraints=tuple(_constraints(parts, node_sets, remarks)),
        remarks=tuple(dict.fromkeys(remarks)),
    )


def _taken(section: deck.MeshFiles, fe: MeshFile) -> NDArray[np.bool_]:
    """Elements of the FE file that are not dropped."""
    taken = np.ones(fe.n_cells, bool)
    for name in section.dropped:
        if name not in fe.cell_sets:
            known = meshfile.listed(sorted(fe.cell_sets)) or "none"
            raise InputError(f"mesh.dropped: {fe.path} has no cell set '{name}'; sets: {known}")
        if not len(fe.cell_sets[name]):
            raise InputError(f"mesh.dropped: the set '{name}' of {fe.path} is empty")
        taken[fe.cell_sets[name]] = False
    return taken


def _numbers(fe: MeshFile, cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Node of the mesh for each of the file's, -1 for those that no hexahedron has, and the hexahedra in these."""
    used = np.zeros(len(fe.points), bool)
    used[cells] = True
    if used.all():
        return np.arange(len(used)), cells
    number = np.where(used, np.cumsum(used) - 1, -1)
    return number, number[cells]


def _merge(
    efg: MeshFile, efg_points: NDArray[np.float64], fe_points: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Node of the mesh for each of the EFG file's, and the FE nodes that it repeats, ascending.

    Nodes of elements are taken if there are any, else all nodes.
    """
    wanted = _solid_nodes(efg, tuple(meshfile.SOLIDS))
    if not wanted.any():
        wanted[:] = True
    number = np.full(len(efg_points), -1)
    merged = np.zeros(len(efg_points), bool)
    if tolerance > 0 and len(fe_points):
        distance, nearest = cKDTree(fe_points).query(efg_points, distance_upper_bound=tolerance)
        merged = np.isfinite(distance) & wanted
        number[merged] = nearest[merged]
    new = wanted & ~merged
    number[new] = len(fe_points) + np.arange(np.count_nonzero(new))
    return number, np.unique(number[merged])


def _solid_corners(
    file: MeshFile, points: NDArray[np.float64], chosen: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners (n, 8, 3) of the file's solids as hexahedra, and the elements they are."""
    corners, parents = [np.empty((0, 8, 3))], [np.empty(0, np.int64)]
    for block, rows in _elements(file, tuple(meshfile.SOLIDS)):
        some = chosen[rows] if chosen is not None else np.ones(len(rows), bool)
        corners.append(points[block.nodes[some][:, _AS_HEXAHEDRON[block.kind]]])
        parents.append(rows[some])
    return np.concatenate(corners), np.concatenate(parents)


def _integration(
    section: deck.MeshFiles,
    fe: MeshFile,
    fe_points: NDArray[np.float64],
    taken: NDArray[np.bool_],
    efg: MeshFile,
    efg_points: NDArray[np.float64],
) -> tuple[_Cloud, NDArray[np.float64]]:
    """The integration points, and corners (n, 8, 3) of the cells that make up the void, where they are known."""
    dropped, dropped_rows = _solid_corners(fe, fe_points, ~taken)
    own, own_rows = _solid_corners(efg, efg_points)
    void = dropped if len(dropped) else own
    if section.integration_points:
        points, volumes, sets = tables.read_grid(section.integration_points)
        metre = METRES[section.integration_unit or section.unit]
        return _Cloud(points * metre, volumes * metre**3, sets), void
    if len(dropped):
        k = section.cuts
        parts = subdivide(dropped, np.full((len(dropped), 3), k))
        volumes, centroids = _cell_volumes(parts)
        parents = np.repeat(dropped_rows, k**3)
        _check_volumes(volumes, fe, parents)
        return _Cloud(centroids, volumes, fe_parents=parents), void
    if not len(own):
        raise InputError(
            f"{efg.path}: has no elements to integrate over; give mesh.integration_points, or mesh.dropped"
        )
    volumes, centroids = _cell_volumes(own)
    _check_volumes(volumes, efg, own_rows)
    return _Cloud(centroids, volumes, efg_parents=own_rows), void


def _cell_volumes(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Volumes and centroids of integration cells; those that are numbered the other way round are as good."""
    with np.errstate(divide="ignore", invalid="ignore"):
        volumes, centroids = volumes_and_centroids(corners)
    return np.abs(volumes), centroids


def _check_volumes(volumes: NDArray[np.float64], file: MeshFile, parents: NDArray[np.int64]) -> None:
    bad = np.flatnonzero(~(volumes > 1e-9 * np.median(volumes)))
    if len(bad):
        block, number = _element(file, int(parents[bad[0]]))
        raise InputError(
            f"{block.origin}: {len(bad)} integration cells are inverted or flat, the first in element {number}; "
            "correct the mesh"
        )


def _sets(
    parts: list[_Part], cloud: _Cloud, n_hexahedra: int
) -> tuple[dict[str, NDArray[np.int64]], dict[str, NDArray[np.int64]]]:
    """Node sets and cell sets of all files; those of the same name are one."""
    node_sets: dict[str, NDArray[np.int64]] = {}
    cell_sets: dict[str, NDArray[np.int64]] = {}
    n_cells = n_hexahedra + len(cloud.points)
    for part in parts:
        for name, rows in part.file.node_sets.items():
            nodes = part.node_map[rows]
            nodes = np.unique(nodes[nodes >= 0])
            node_sets[name] = np.union1d(node_sets[name], nodes) if name in node_sets else nodes
        for name, rows in part.file.cell_sets.items():
            cells = part.cells_of(rows)
            if len(cells) or not len(rows):
                cell_sets[name] = np.union1d(cell_sets[name], cells) if name in cell_sets else cells
    for name, points in cloud.sets.items():
        cells = n_hexahedra + points
        cell_sets[name] = np.union1d(cell_sets[name], cells) if name in cell_sets else cells
    named = np.zeros(n_cells, bool)
    for cells in cell_sets.values():
        named[cells] = True
    if not named[n_hexahedra:].all() and "cloud" not in cell_sets:
        cell_sets["cloud"] = n_hexahedra + np.flatnonzero(~named[n_hexahedra:])
    cell_sets["all"] = np.arange(n_cells)
    return node_sets, cell_sets


def _cloud_remarks(
    section: deck.MeshFiles,
    points: NDArray[np.float64],
    cells: NDArray[np.int64],
    cloud: _Cloud,
    void_corners: NDArray[np.float64],
    node_sets: dict[str, NDArray[np.int64]],
    seed_volume: float,
) -> list[str]:
    """Warnings about integration points outside the void, and volumes that do not fill it."""
    remarks = []
    source = section.integration_points or section.efg
    within = checks.inside(cloud.points, points[cells])
    if n := np.count_nonzero(within):
        remarks.append(f"warning: {source}: {n} integration points lie in hexahedra, outside the void")
    if not section.integration_points:
        return remarks
    interface = np.zeros(len(points), bool)
    interface[node_sets.get("interface", [])] = True
    if len(void_corners):
        expected: float | None = float(np.abs(volumes_and_centroids(void_corners)[0]).sum())
        outside = np.count_nonzero(~checks.inside(cloud.points, void_corners) & ~within)
        # Points on the planes between cells are in none for sure; a grid may have all of its points there.
        if outside > 0.5 * len(cloud.points):
            remarks.append(f"warning: {source}: {outside} integration points lie outside the cells of the void")
        if not section.dropped:
            seed_volume = 0.0  # the cells leave it out
    else:
        block = Cells("hexahedron", "", np.arange(len(cells)), cells, "")
        # They look into the hexahedra, and so out of the void.
        faces = meshfile.exterior_faces([block])[0]
        expected = checks.enclosed_volume(points, faces[interface[faces].all(axis=1)])
    if expected is not None:
        total, wanted = float(cloud.volumes.sum()), expected - seed_volume
        if abs(total - wanted) > FILLED * abs(wanted):
            remarks.append(
                f"warning: {source}: the integration volumes sum to {total * 1e9:.6g} mm3, the void has "
                f"{wanted * 1e9:.6g} mm3"
            )
    return remarks


def _outer(
    points: NDArray[np.float64], cells: NDArray[np.int64], efg: _Part, interface: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Nodes of the outer surface: of exterior faces of both parts that do not lie on the interface."""
    at_interface = np.zeros(len(points) + 1, bool)
    at_interface[interface] = True
    at_interface[-1] = True  # what fills up triangles
    found = [np.empty(0, np.int64)]
    blocks = [Cells("hexahedron", "", np.arange(len(cells)), cells, "")]
    own = [
        Cells(b.kind, b.type, b.ids, efg.node_map[b.nodes], b.origin)
        for b, _ in _elements(efg.file, tuple(_AS_HEXAHEDRON))
    ]
    for several in (blocks, own):
        faces = meshfile.exterior_faces(several)[0]
        found.append(np.unique(faces[~at_interface[faces].all(axis=1)]))
    nodes = np.unique(np.concatenate(found))
    return nodes[nodes >= 0]


# --- materials and constraints -------------------------------------------------------------------------------------


def _materials(
    section: deck.MeshFiles, parts: list[_Part], cell_sets: dict[str, NDArray[np.int64]]
) -> tuple[dict[str, Material], list[str]]:
    """Materials by cell set, in SI units, and remarks about their densities."""
    found: dict[str, Material] = {}
    remarks = []
    for part, stress in zip(parts, (section.stress_unit, section.efg_stress_unit or section.stress_unit), strict=False):
        pascal = _PASCALS[stress]
        density_unit = _DENSITIES.get(section.density_unit, pascal / part.metre**2)
        for name, given in part.file.materials:
            density = DENSITY
            if given.density is None or given.density <= 0:
                remarks.append(
                    f"warning: {given.origin}: material {given.name} has no density; {DENSITY:g} kg/m3 is taken"
                )
            else:
                density = given.density * density_unit
                if not _PLAUSIBLE[0] <= density <= _PLAUSIBLE[1]:
                    remarks.append(
                        f"warning: {given.origin}: material {given.name} has density {density:g} kg/m3; check "
                        "mesh.unit, mesh.stress_unit and mesh.density_unit"
                    )
            material = Material(given.name, given.youngs_modulus * pascal, given.poissons_ratio, density)
            if not np.isfinite([material.youngs_modulus, density, material.p_wave_modulus]).all():
                raise InputError(f"{given.origin}: material {given.name} has a modulus or density without bounds")
            if name not in cell_sets:
                continue  # all of its elements are left out
            if found.setdefault(name, material) != material:
                raise InputError(
                    f"{given.origin}: the cells of '{name}' are of material {found[name].name} already; rename one set"
                )
    return found, remarks


def _constraints(
    parts: list[_Part], node_sets: dict[str, NDArray[np.int64]], remarks: list[str]
) -> Iterator[Constraint]:
    """Constraints of all files in metres on sets of the mesh; a file's constraint holds for the file's own nodes."""
    for part in parts:
        for given in part.file.constraints:
            rows = part.file.node_sets[given.node_set]
            nodes = part.node_map[rows]
            there = nodes >= 0
            if not there.all():
                remarks.append(
                    f"warning: {given.origin}: holds or moves {np.count_nonzero(~there)} nodes that are left out"
                )
            if not there.any():
                continue
            unique, first = np.unique(nodes[there], return_index=True)
            name = given.node_set
            if len(unique) != len(node_sets[name]) and not _alike(parts, given):
                name = meshfile.add_set(node_sets, f"{part.file.path.name}:{name}", unique)
            elif len(unique) != len(node_sets[name]) and part is not parts[0]:
                continue  # the first file's stands for both
            moves = [
                value[there][first] * part.metre if isinstance(value, np.ndarray) else value * part.metre
                for value in given.displacement
            ]
            yield Constraint(name, given.directions, tuple(moves), given.origin)


def _alike(parts: list[_Part], given: Constraint) -> bool:
    """Whether every file that has the set constrains it alike, so that it can be constrained as a whole."""
    if any(isinstance(value, np.ndarray) for value in given.displacement):
        return False
    wanted = given.directions, tuple(value for value in given.displacement)
    owners = [part for part in parts if given.node_set in part.file.node_sets]
    return all(
        any(
            (other.directions, other.displacement) == wanted
            for other in part.file.constraints
            if other.node_set == given.node_set and not any(isinstance(v, np.ndarray) for v in other.displacement)
        )
        for part in owners
    )
