"""The mesh of a deck's files: an FE file, an EFG file and integration points become one mixed mesh."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from mpitled.errors import InputError
from mpitled.laws import Material, NeoHookean
from mpitled.mesh import METRES, Bools, Constraint, Floats, Ints, Mesh
from mpitled.meshing import checks
from mpitled.meshing.integration_cells import subdivide, volumes_and_centroids
from mpitled.readers import abaqus, lsdyna, meshfile, meshio_file, solids, tables
from mpitled.readers.meshfile import Cells, MeshFile
from mpitled.readers.text import check_file

if TYPE_CHECKING:
    from mpitled import deck

#: kg/m^3 of a material without a density.
DENSITY = 1000.0
#: Largest relative difference of the integration volumes from the void's volume without a warning.
VOLUME_TOLERANCE = 0.01
_PASCALS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9}
_DENSITIES = {"kg/m3": 1.0, "g/cm3": 1e3, "kg/mm3": 1e9, "t/mm3": 1e12}
#: Range of densities of solids, kg/m^3; values outside indicate wrong units.
_PLAUSIBLE = (1.0, 30000.0)


# --- files ---------------------------------------------------------------------------------------------------------


def read_file(path: Path) -> MeshFile:
    """The contents of a mesh file in any known format. InputError if the file is wrong."""
    with np.errstate(over="ignore", invalid="ignore"):  # such coordinates are refused below
        file = _reader(path)[0](path)
    bad = np.flatnonzero(~(np.abs(file.points) < meshfile.MAX_COORDINATE).all(axis=1))
    if len(bad):
        number, limit = file.node_ids[bad[0]], f"{meshfile.MAX_COORDINATE:g}"
        raise InputError(f"{path}: node {number} has a coordinate beyond {limit} ({len(bad)} such); correct it")
    return file


def files(section: deck.MeshFiles) -> list[Path]:
    """The mesh files of a deck and all their includes."""
    return [included for path in (section.fe, section.efg) if path for included in _reader(path)[1](path)]


def _reader(path: Path) -> tuple[Callable[[Path], MeshFile], Callable[[Path], list[Path]]]:
    """The reader of a file and the function that lists its includes, chosen by name and contents."""
    try:
        check_file(path, "a mesh")
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
    return meshio_file.read, lambda path: [path]


# --- the mixed mesh ------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Source:
    """A file in metres, and the maps of its nodes and elements to nodes and cells of the mesh."""

    file: MeshFile
    points: Floats  # (n, 3), m, all nodes of the file
    metre: float  # m per unit of length
    node_map: Ints  # (n,), node of the mesh; -1 if it is left out
    parents: Ints = field(default_factory=lambda: np.empty(0, np.int64))  # (k,), element of the file
    cells: Ints = field(default_factory=lambda: np.empty(0, np.int64))  # (k,), cell of the mesh from this element

    def add_cells(self, parents: Ints, cells: Ints) -> None:
        self.parents, self.cells = np.concatenate([self.parents, parents]), np.concatenate([self.cells, cells])

    def cells_of(self, rows: Ints) -> Ints:
        """Cells of the mesh, ascending, that come from the elements `rows`."""
        return np.sort(self.cells[np.isin(self.parents, rows)])


@dataclass(slots=True)
class _Integration:
    """Integration points with their elements in one file, or with named sets."""

    points: Floats = field(default_factory=lambda: np.empty((0, 3)))  # m
    volumes: Floats = field(default_factory=lambda: np.empty(0))  # m^3
    sets: dict[str, Ints] = field(default_factory=dict)
    parent_file: MeshFile | None = None
    parents: Ints = field(default_factory=lambda: np.empty(0, np.int64))  # (n,), element of the point
    void: Floats = field(default_factory=lambda: np.empty((0, 8, 3)))  # corners of the void's cells, if known


def read_mesh(section: deck.MeshFiles, seed_volume: float = 0.0) -> Mesh:
    """The mesh of a deck's files: FE nodes in the FE file's order, then EFG nodes in the EFG file's order.

    `seed_volume` (m^3) is the part of the void without integration points. InputError if a file is wrong.
    """
    if not section.fe and not section.efg:
        raise InputError("mesh.fe: is missing; give the file of the hexahedra, or mesh.efg for a cloud alone")
    fe = read_file(section.fe) if section.fe else None
    efg = read_file(section.efg) if section.efg else None
    return assemble(section, fe, efg, seed_volume)


def assemble(section: deck.MeshFiles, fe: MeshFile | None, efg: MeshFile | None, seed_volume: float = 0.0) -> Mesh:
    """The mesh of an FE file and an EFG file that have been read; see `read_mesh`."""
    remarks: list[str] = []
    for file in (fe, efg):
        if file:
            solids.check_solids(file)
            remarks += file.remarks + solids.leave_out_others(file)
    if fe is None:
        assert efg is not None
        fe = MeshFile(efg.path, "", np.empty((0, 3)), np.empty(0, np.int64))
    source, hexahedra, kept = _fe_source(section, fe, remarks)
    sources, integration, interface = [source], _Integration(), np.empty(0, np.int64)
    points, ids = source.points[source.node_map >= 0], fe.node_ids[source.node_map >= 0]
    n_fe_nodes = len(points)
    if efg:
        unit = METRES[section.efg_unit or section.unit]
        cloud, interface = _efg_source(efg, unit, points, section.merge_tolerance)
        sources.append(cloud)
        new = cloud.node_map >= n_fe_nodes
        points, ids = np.concatenate([points, cloud.points[new]]), np.concatenate([ids, efg.node_ids[new]])
        integration = _integration(section, source, kept, cloud)
        for parent in sources:
            if parent.file is integration.parent_file:
                parent.add_cells(integration.parents, len(hexahedra) + np.arange(len(integration.points)))
        merged = f"{len(interface)} nodes merged with FE nodes, " if len(interface) else ""
        remarks.append(f"{efg.path}: {merged}{np.count_nonzero(new)} EFG nodes added")
    elif section.integration_points or section.dropped or section.surface_areas:
        raise InputError("mesh.efg: is missing; integration points and dropped hexahedra need the nodes of a cloud")
    if len(repeated := checks.coincident(points, section.merge_tolerance)):
        remarks.append(
            f"warning: {len(repeated)} nodes lie where another one does, the first is node {ids[repeated[0]]}; the "
            "mesh is open there"
        )
    node_sets, cell_sets = _sets(sources, integration, len(hexahedra))
    if efg:
        if len(interface):
            node_sets.setdefault("interface", interface)
        remarks += _integration_warnings(section, points, hexahedra, integration, node_sets, seed_volume)
        if not {"skull", "surface"} & node_sets.keys():
            node_sets["surface"] = _outer_surface(points, hexahedra, cloud, node_sets.get("interface", interface))
    materials = _materials(section, sources, cell_sets, remarks)
    return Mesh(
        points=points,
        n_fe_nodes=n_fe_nodes,
        hexahedra=hexahedra,
        integration_points=integration.points,
        integration_volumes=integration.volumes,
        node_sets=node_sets,
        cell_sets=cell_sets,
        node_ids=ids,
        surface_areas=tables.read_areas(section.surface_areas, source.metre, ids) if section.surface_areas else None,
        materials=materials,
        constraints=tuple(_constraints(sources, node_sets, remarks)),
        remarks=tuple(dict.fromkeys(remarks)),
    )


def _fe_source(section: deck.MeshFiles, fe: MeshFile, remarks: list[str]) -> tuple[_Source, Ints, Bools]:
    """The FE file in metres, its hexahedra (n, 8) in nodes of the mesh, and a mask of elements that are not dropped."""
    kept = np.ones(fe.n_cells, bool)
    for name in section.dropped:
        if name not in fe.cell_sets:
            known = meshfile.listed(sorted(fe.cell_sets))
            raise InputError(f"mesh.dropped: {fe.path} has no cell set '{name}'; sets: {known}")
        if not len(fe.cell_sets[name]):
            raise InputError(f"mesh.dropped: the set '{name}' of {fe.path} is empty")
        kept[fe.cell_sets[name]] = False
    metre = METRES[section.unit]
    points = fe.points * metre if metre != 1 else fe.points
    hexahedra, parents, more_remarks = solids.read_hexahedra(fe, points, kept, section.repair)
    remarks += more_remarks
    if section.fe and not len(hexahedra) and not section.dropped:
        types = meshfile.listed({block.type: 0 for block in fe.cells})
        raise InputError(f"{fe.path}: has no hexahedra (elements: {types}); it may be mesh.efg, not mesh.fe")
    used = np.zeros(len(points), bool)
    used[hexahedra] = True
    node_map = np.where(used, np.cumsum(used) - 1, -1)
    if unused := np.count_nonzero(~used):
        hexahedra = node_map[hexahedra]
        remarks.append(f"{fe.path}: {unused} nodes without a hexahedron are left out")
    return _Source(fe, points, metre, node_map, parents, np.arange(len(hexahedra))), hexahedra, kept


def _efg_source(efg: MeshFile, metre: float, fe_points: Floats, tolerance: float) -> tuple[_Source, Ints]:
    """The EFG file in metres with nodes merged into FE nodes, and the FE nodes, ascending, at these points.

    If the file has solids, only their nodes are used.
    """
    points = efg.points * metre
    wanted = solids.has_solid(efg)
    if not wanted.any():
        wanted[:] = True
    node_map, merged = np.full(len(points), -1), np.zeros(len(points), bool)
    if tolerance > 0 and len(fe_points):
        distance, nearest = cKDTree(fe_points).query(points, distance_upper_bound=tolerance)
        merged = np.isfinite(distance) & wanted
        node_map[merged] = nearest[merged]
    new = wanted & ~merged
    node_map[new] = len(fe_points) + np.arange(np.count_nonzero(new))
    return _Source(efg, points, metre, node_map), np.unique(node_map[merged])


def _integration(section: deck.MeshFiles, fe: _Source, kept: Bools, efg: _Source) -> _Integration:
    """Integration points from a table, from the dropped elements of the FE file, or from the EFG file's elements."""
    dropped, dropped_rows = solids.solid_corners(fe.file, fe.points, ~kept)
    solid, solid_rows = solids.solid_corners(efg.file, efg.points)
    void = dropped if len(dropped) else solid
    if section.integration_points:
        points, volumes, sets = tables.read_grid(section.integration_points)
        metre = METRES[section.integration_unit or section.unit]
        return _Integration(points * metre, volumes * metre**3, sets, void=void)
    if len(dropped):
        cells = subdivide(dropped, np.full((len(dropped), 3), section.cuts))
        file, parents = fe.file, np.repeat(dropped_rows, section.cuts**3)
    elif len(solid):
        cells, file, parents = solid, efg.file, solid_rows
    else:
        raise InputError(
            f"{efg.file.path}: has no elements to integrate over; give mesh.integration_points, or mesh.dropped"
        )
    volumes, centroids = solids.integration_cells(cells, file, parents)
    return _Integration(centroids, volumes, {}, file, parents, void)


def _sets(
    sources: list[_Source], integration: _Integration, n_hexahedra: int
) -> tuple[dict[str, Ints], dict[str, Ints]]:
    """Node sets and cell sets of all files; sets with the same name are joined."""
    node_sets: dict[str, Ints] = {}
    cell_sets: dict[str, Ints] = {}
    for source in sources:
        for name, rows in source.file.node_sets.items():
            nodes = source.node_map[rows]
            meshfile.extend_set(node_sets, name, np.unique(nodes[nodes >= 0]))
        for name, rows in source.file.cell_sets.items():
            cells = source.cells_of(rows)
            if len(cells) or not len(rows):
                meshfile.extend_set(cell_sets, name, cells)
    for name, points in integration.sets.items():
        meshfile.extend_set(cell_sets, name, n_hexahedra + points)
    n_cells = n_hexahedra + len(integration.points)
    named = np.zeros(n_cells, bool)
    named[meshfile.joined(cell_sets.values())] = True
    if not named[n_hexahedra:].all() and "cloud" not in cell_sets:
        cell_sets["cloud"] = n_hexahedra + np.flatnonzero(~named[n_hexahedra:])
    cell_sets["all"] = np.arange(n_cells)
    return node_sets, cell_sets


def _integration_warnings(
    section: deck.MeshFiles,
    points: Floats,
    hexahedra: Ints,
    integration: _Integration,
    node_sets: dict[str, Ints],
    seed_volume: float,
) -> Iterator[str]:
    """Warnings about integration points outside the void, and about their total volume."""
    source = section.integration_points or section.efg
    in_hexahedra = checks.inside(integration.points, points[hexahedra])
    if n := np.count_nonzero(in_hexahedra):
        yield f"warning: {source}: {n} integration points lie in hexahedra, outside the void"
    if not section.integration_points:
        return
    if len(integration.void):
        expected: float | None = float(np.abs(volumes_and_centroids(integration.void)[0]).sum())
        outside = np.count_nonzero(~checks.inside(integration.points, integration.void) & ~in_hexahedra)
        # A point on a plane between cells counts as outside both. All points of a regular grid may lie on such planes.
        if outside > 0.5 * len(integration.points):
            yield f"warning: {source}: {outside} integration points lie outside the cells of the void"
        if not section.dropped:
            seed_volume = 0.0  # the cells do not include the seed
    else:
        on_interface = np.zeros(len(points), bool)
        on_interface[node_sets.get("interface", [])] = True
        # Faces are clockwise seen from outside the hexahedra, so anticlockwise seen from outside the void.
        faces = meshfile.exterior_faces([_block(hexahedra)])[0]
        expected = checks.enclosed_volume(points, faces[on_interface[faces].all(axis=1)])
    if expected is not None:
        total, wanted = float(integration.volumes.sum()), expected - seed_volume
        if abs(total - wanted) > VOLUME_TOLERANCE * abs(wanted):
            yield (
                f"warning: {source}: the integration volumes sum to {total * 1e9:.6g} mm3, the void has "
                f"{wanted * 1e9:.6g} mm3"
            )


def _block(hexahedra: Ints) -> Cells:
    return Cells("hexahedron", "", np.arange(len(hexahedra)), hexahedra, "")


def _outer_surface(points: Floats, hexahedra: Ints, efg: _Source, interface: Ints) -> Ints:
    """Nodes of exterior faces of hexahedra and of the EFG file's solids, except faces on the interface."""
    on_interface = np.zeros(len(points) + 1, bool)
    on_interface[interface] = True
    on_interface[-1] = True  # -1 pads triangles
    efg_solids = [
        Cells(block.kind, block.type, block.ids, efg.node_map[block.nodes], block.origin)
        for block, _ in efg.file.blocks(*meshfile.SOLIDS)
    ]
    faces = np.concatenate([meshfile.exterior_faces(cells)[0] for cells in ([_block(hexahedra)], efg_solids)])
    nodes = np.unique(faces[~on_interface[faces].all(axis=1)])
    return nodes[nodes >= 0]


# --- materials and constraints -------------------------------------------------------------------------------------


def _materials(
    section: deck.MeshFiles, sources: list[_Source], cell_sets: dict[str, Ints], remarks: list[str]
) -> dict[str, Material]:
    """Materials by cell set, in SI units; remarks about their densities are appended."""
    found: dict[str, Material] = {}
    stress_units = (section.stress_unit, section.efg_stress_unit or section.stress_unit)
    for source, stress_unit in zip(sources, stress_units, strict=False):
        pascal = _PASCALS[stress_unit]
        density_unit = _DENSITIES.get(section.density_unit, pascal / source.metre**2)
        for name, given in source.file.materials:
            density = DENSITY
            warning = f"warning: {given.origin}: material {given.name} has "
            if given.density is None or given.density <= 0:
                remarks.append(f"{warning}no density; {DENSITY:g} kg/m3 is used")
            else:
                density = given.density * density_unit
                if not _PLAUSIBLE[0] <= density <= _PLAUSIBLE[1]:
                    units = "mesh.unit, mesh.stress_unit and mesh.density_unit"
                    remarks.append(f"{warning}density {density:g} kg/m3; check {units}")
            modulus = given.youngs_modulus * pascal
            try:
                law = NeoHookean(youngs_modulus=float(modulus), poissons_ratio=float(given.poissons_ratio))
            except ValueError:
                modulus = np.inf
            if not np.isfinite([modulus, density]).all() or not np.isfinite(law.p_wave_modulus):
                raise InputError(
                    f"{given.origin}: material {given.name} has an infinite modulus or density; correct it"
                )
            material = Material(given.name, law, density)
            if name not in cell_sets:
                continue  # all elements of the set are left out
            if found.setdefault(name, material) != material:
                raise InputError(
                    f"{given.origin}: the cells of '{name}' have material {found[name].name} already; rename one set"
                )
    return found


def _constraints(sources: list[_Source], node_sets: dict[str, Ints], remarks: list[str]) -> Iterator[Constraint]:
    """Constraints of all files, in metres, on sets of the mesh; each is restricted to the nodes of its file."""
    for source in sources:
        for given in source.file.constraints:
            nodes = source.node_map[source.file.node_sets[given.node_set]]
            used = nodes >= 0
            if not used.all():
                missing = np.count_nonzero(~used)
                remarks.append(f"warning: {given.origin}: fixes or moves {missing} nodes that are left out")
            if not used.any():
                continue
            unique, first = np.unique(nodes[used], return_index=True)
            name = given.node_set
            if len(unique) != len(node_sets[name]):  # another file has a set with this name
                if not _same_in_all(sources, given):
                    name = meshfile.add_set(node_sets, f"{source.file.path.name}:{name}", unique)
                elif source is not sources[0]:
                    continue  # the constraint of the first file is enough
            moves = [
                value[used][first] * source.metre if isinstance(value, np.ndarray) else value * source.metre
                for value in given.displacement
            ]
            yield Constraint(name, given.directions, tuple(moves), given.origin)


def _same_in_all(sources: Iterable[_Source], given: Constraint) -> bool:
    """Whether every file with the set has the same uniform constraint on it."""

    def is_uniform(constraint: Constraint) -> bool:
        return not any(isinstance(value, np.ndarray) for value in constraint.displacement)

    wanted = given.node_set, given.directions, given.displacement
    return is_uniform(given) and all(
        any((c.node_set, c.directions, c.displacement) == wanted for c in source.file.constraints if is_uniform(c))
        for source in sources
        if given.node_set in source.file.node_sets
    )
