"""The geometry of a scene: the result of every reader and mesher, and the input of the model."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mpitled import resources
from mpitled.errors import InputError
from mpitled.laws import Material

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

#: Units of length of decks and files, in m.
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
#: Corners of the reference hexahedron in the Abaqus/VTK order (paper, eq. 4.4).
CORNERS = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
#: Lower bound of the memory per hexahedron while a model is built (measured: 490 to 610 in blocks and phantoms).
_HEXAHEDRON_BYTES = 500


@dataclass(frozen=True, slots=True)
class Rotation:
    """A rotation about an axis parallel to x, y or z."""

    angle: float  # rad, at full load; right-handed
    axis: int  # 0, 1, 2
    centre: tuple[float, float, float]  # a point on the axis, m


@dataclass(frozen=True, slots=True)
class Constraint:
    """Nodes that are fixed (displacement 0) or moved along the loading curve, in the named directions only."""

    node_set: str
    directions: tuple[int, ...]  # of 0, 1, 2
    #: m at full load, one for each direction, 0 if fixed; an array (n_nodes,) if the nodes have different values
    displacement: tuple[float | Floats, ...]
    origin: str = ""  # file and line or key, for messages
    rotation: Rotation | None = None  # its displacement is added
    field: Path | None = None  # a table of displacements to be added, see `model.mapping`
    field_metre: float = 1.0  # the table's unit of length, m


@dataclass(frozen=True, slots=True)
class Part:
    """The cloud of one material: a separate body that shares the nodes of its surface with its neighbours."""

    spheres: tuple[str, ...]  # names of the spheres around it
    integration_points: Ints  # ascending
    nodes: Ints  # inside and on the surface, ascending
    areas: Floats  # (n_nodes, 3), m^2: integral of N_a n over the surface without the seed; 0 in a single part


@dataclass(frozen=True, slots=True)
class Mesh:
    """Nodes, hexahedra and integration points in metres; FE nodes first, then EFG nodes (paper, 4.1.2).

    Cell sets number the hexahedra first, then the integration points.
    """

    points: Floats  # (n_nodes, 3), m
    n_fe_nodes: int  # rows of `points` that hexahedra use
    hexahedra: Ints  # (n_hexahedra, 8), Abaqus/VTK order
    integration_points: Floats  # (n_integration, 3), m
    integration_volumes: Floats  # (n_integration,), m^3
    node_sets: dict[str, Ints]  # name -> ascending nodes
    cell_sets: dict[str, Ints]  # name -> ascending cells
    node_ids: Ints  # (n_nodes,), numbers in the input file
    # (n_nodes, 3), m^2: integral of N_a n over the outer surface at nodes on the cloud's boundary; None if unknown.
    surface_areas: Floats | None = None
    parts: tuple[Part, ...] = ()  # of the cloud, if known
    materials: dict[str, Material] = field(default_factory=dict)  # cell set -> material, from files
    constraints: tuple[Constraint, ...] = ()  # from files
    remarks: tuple[str, ...] = ()  # one line each: what was skipped, merged or repaired
    figures: dict[str, float] = field(default_factory=dict)  # e.g. void_volume_m3

    @property
    def n_nodes(self) -> int:
        return len(self.points)

    @property
    def n_cells(self) -> int:
        return len(self.hexahedra) + len(self.integration_points)


def check_size(n_hexahedra: float, key: str, remedy: str = "ask for fewer") -> None:
    """InputError if the number of hexahedra that a key of the deck requests exceeds the machine's memory."""
    request = f"{key}: makes {n_hexahedra:.3g} hexahedra, which"
    resources.check_memory(_HEXAHEDRON_BYTES * n_hexahedra, request, remedy)


def hexahedral_mesh(points: Floats, hexahedra: Ints, node_sets: dict[str, Ints]) -> Mesh:
    """A mesh of hexahedra only."""
    return numbered_mesh(points, len(points), hexahedra, np.empty((0, 3)), np.empty(0), node_sets, {})


def numbered_mesh(
    points: Floats,
    n_fe_nodes: int,
    hexahedra: Ints,
    integration_points: Floats,
    integration_volumes: Floats,
    node_sets: dict[str, Ints],
    figures: dict[str, float],
    surface_areas: Floats | None = None,
    parts: tuple[Part, ...] = (),
) -> Mesh:
    """A generated mesh: node numbers start at 1, and the cell sets are "all", "hexahedra" and "cloud"."""
    cells = np.arange(len(hexahedra) + len(integration_points))
    return Mesh(
        points=points,
        n_fe_nodes=n_fe_nodes,
        hexahedra=hexahedra,
        integration_points=integration_points,
        integration_volumes=integration_volumes,
        node_sets=node_sets,
        cell_sets={"all": cells, "hexahedra": cells[: len(hexahedra)], "cloud": cells[len(hexahedra) :]},
        node_ids=np.arange(1, len(points) + 1),
        surface_areas=surface_areas,
        parts=parts,
        figures=figures,
    )


def structured_hexahedra(shape: tuple[int, int, int]) -> Ints:
    """Hexahedra (n, 8) of a grid of (nx, ny, nz) cells; nodes are numbered along x, then y, then z."""
    nx, ny, nz = shape
    lines = np.array([1, nx + 1, (nx + 1) * (ny + 1)])
    k, j, i = np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij")
    first = (i * lines[0] + j * lines[1] + k * lines[2]).ravel()
    return first[:, None] + ((CORNERS + 1) // 2) @ lines


def grid_points(shape: tuple[int, int, int], size: tuple[float, float, float]) -> Floats:
    """Nodes (n, 3), m, of a grid of (nx, ny, nz) cells that fills the box [0, size]; x runs fastest."""
    axes = [np.linspace(0.0, length, n + 1) for n, length in zip(shape, size, strict=True)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)


def named_set(sets: dict[str, Ints], name: str, origin: str) -> Ints:
    """The set with that name; InputError if it is missing or empty."""
    if name not in sets:
        near = difflib.get_close_matches(name, sets, 1)
        hint = f"did you mean '{near[0]}'? Sets: " if near else "sets: "
        raise InputError(f"{origin}: there is no set '{name}'; {hint}{', '.join(sorted(sets)) or 'none'}")
    if len(sets[name]) == 0:
        raise InputError(f"{origin}: the set '{name}' is empty")
    return sets[name]
