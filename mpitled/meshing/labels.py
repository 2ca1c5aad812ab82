"""From a label image of a head to a mesh: volume-true hexahedra, ventricles, skull and, around a tumour, the cloud."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mpitled import resources
from mpitled.errors import InputError
from mpitled.mesh import CORNERS, Mesh, Part, check_size
from mpitled.meshing.cloud import fill_void, in_millimetres, length, looks_like_metres

if TYPE_CHECKING:
    from mpitled import deck

Cells = NDArray[np.bool_]  # (nz, ny, nx), so that x runs fastest in memory and in all numbers

_METRES = {"mm": 1e-3, "unknown": 1e-3, "meter": 1.0, "micron": 1e-6}
#: Images that are read; what else nibabel knows may lead to other files.
_SUFFIXES = (".nii", ".nii.gz", ".mgh", ".mgz")
# Bytes of memory that a voxel, beside its label, and a cube of the grid take while the head is meshed, at the most.
_VOXEL_BYTES, _CUBE_BYTES = 40, 60
_INFLATED = 1032  # gzip makes no more of a byte than this
_MOST_BEFORE = 1 << 24  # bytes of a NIfTI file before its voxels
#: Parts of a head beside its tissue, left and right: keys of the deck, and cell and node sets.
VENTRICLES = ("left_ventricle", "right_ventricle")


@dataclass(frozen=True, slots=True)
class Image:
    """A label image on an axis-parallel grid of voxels, in metres of the image's world (x to the right, z up)."""

    path: Path
    labels: NDArray[np.int32]  # (nz, ny, nx)
    origin: NDArray[np.float64]  # (3,), m: the first voxel's lowest corner
    voxel: NDArray[np.float64]  # (3,), m: its edges along x, y, z
    to_world: NDArray[np.float64]  # (3, 4), m: of the file's own voxel indices and a last 1
    placed: bool  # whether the header says how its voxels lie in the world


@dataclass(frozen=True, slots=True)
class Grid:
    """The cubes from which the solid's hexahedra are taken; at least one layer around the solid stays empty."""

    origin: NDArray[np.float64]  # (3,), m
    size: float  # m
    shape: tuple[int, int, int]  # (nx, ny, nz)

    def cell_of(self, place: NDArray[np.float64]) -> tuple[int, int, int] | None:
        """Index (z, y, x) of the cube that holds a place (3,), m; None outside the grid."""
        i = np.floor((place - self.origin) / self.size).astype(int)
        if (i < 0).any() or (i >= self.shape).any():
            return None
        return int(i[2]), int(i[1]), int(i[0])

    def hexahedra(self, cells: Cells) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Points (n, 3) and hexahedra (m, 8) of the chosen cubes, both numbered along x, then y, then z."""
        nx, ny, _ = self.shape
        lines = np.array([1, nx + 1, (nx + 1) * (ny + 1)])
        first = np.stack(np.nonzero(cells)[::-1], axis=1) @ lines
        nodes, numbers = np.unique(first[:, None] + ((CORNERS + 1) // 2) @ lines, return_inverse=True)
        place = np.stack([nodes % lines[1], nodes // lines[1] % (ny + 1), nodes // lines[2]], axis=1)
        return self.origin + self.size * place, numbers.reshape(-1, 8).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Head:
    """The parts of a head as cubes of a grid."""

    grid: Grid
    solid: Cells  # all parts
    deep: Cells  # cubes of the solid without a node on its outer surface
    parts: dict[str, Cells]  # tissue and the ventricles
    figures: dict[str, float]  # volumes, in the image and as cubes
    to_world: NDArray[np.float64]  # (3, 4), m: of the image's voxel indices and a last 1
    remarks: tuple[str, ...]


def mesh_labels(
    labels: deck.Labels, cloud: deck.Cloud, tumour: deck.Tumour | None, spheres: Sequence[deck.Sphere] = ()
) -> Mesh:
    """The mesh of a label image: one face-connected solid of cubes without non-manifold edges or vertices.

    Each label keeps its volume. No ventricle touches the outer surface, each is one face-connected piece. With a
    tumour the tissue within `cloud.radius` of its centre becomes a cloud. Raises InputError for an image that is none,
    labels that are missing, and a tumour that does not lie in tissue.
    """
    head = label_cells(labels)
    points, hexahedra = head.grid.hexahedra(head.solid)
    cell_sets = {name: np.flatnonzero(cells[head.solid]) for name, cells in head.parts.items()}
    node_sets = {name: np.unique(hexahedra[cells]) for name, cells in cell_sets.items() if name != "tissue"}
    # The solid has no cavities: a node that fewer than eight cubes share lies on the outer surface.
    node_sets["skull"] = np.flatnonzero(np.bincount(hexahedra.ravel()) < 8)
    figures, n_fe_nodes = head.figures, len(points)
    integration_points, integration_volumes, surface_areas = np.empty((0, 3)), np.empty(0), None
    parts: tuple[Part, ...] = ()
    if tumour is not None:
        void = _void(head, cloud.radius, np.asarray(tumour.centre, float), tumour.seed_radius + head.grid.size)
        filling = fill_void(points, hexahedra, void[head.solid], cloud, tumour, head.grid.size, spheres)
        points, hexahedra, n_fe_nodes = filling.points, filling.hexahedra, filling.n_fe_nodes
        integration_points, integration_volumes = filling.integration_points, filling.integration_volumes
        node_sets = {name: filling.renumber(nodes) for name, nodes in node_sets.items()}
        node_sets |= {"tumour": filling.seed_nodes, "interface": filling.interface}
        cell_sets = {name: np.flatnonzero(cells[head.solid & ~void]) for name, cells in head.parts.items()}
        cell_sets["tissue"] = np.append(cell_sets["tissue"], len(hexahedra) + np.arange(len(integration_volumes)))
        figures = figures | filling.figures
        surface_areas, parts = filling.surface_areas, filling.parts
    cell_sets["all"] = np.arange(len(hexahedra) + len(integration_volumes))
    return Mesh(
        points=points,
        n_fe_nodes=n_fe_nodes,
        hexahedra=hexahedra,
        integration_points=integration_points,
        integration_volumes=integration_volumes,
        node_sets=node_sets,
        cell_sets=cell_sets,
        node_ids=np.arange(1, len(points) + 1),
        surface_areas=surface_areas,
        parts=parts,
        remarks=head.remarks,
        figures=figures,
    )


def label_cells(labels: deck.Labels) -> Head:
    """The cubes of tissue and ventricles of a label image; errors as `mesh_labels`."""
    image = read_image(Path(labels.image))
    body, voxels, remarks = parts_of(image, labels)
    size = labels.element_size
    if size < image.voxel.min():
        remarks.append(
            f"warning: labels.element_size = {1e3 * size:g} mm: is smaller than a voxel of {image.path}, "
            f"{1e3 * image.voxel.min():.3g} mm, beyond which an image has no more to tell"
        )
    if not image.placed:
        remarks.append(
            f"warning: {image.path}: its header does not say where its voxels are, so which side is left is taken for "
            "granted"
        )
    n_cubes = float(body.sum() * (image.voxel / size).prod())
    check_size(n_cubes, f"labels.element_size = {1e3 * size:g} mm", "enlarge it")
    grid = _grid(image, body, size)
    shares = {name: box_shares(image, mask, grid) for name, mask in {"solid": body, **voxels}.items()}
    solid, repaired = solid_cells(shares["solid"])
    if not solid.any():
        raise InputError(f"labels.element_size = {1e3 * size:g} mm: is too large for {image.path}; make it smaller")
    if repaired:
        remarks.append(f"{repaired} hexahedra added where the solid met itself in an edge or vertex only")
    # Cubes without a node on the outer surface.
    deep = ndimage.binary_erosion(solid, np.ones((3, 3, 3)))
    ventricles = _ventricles(image, grid, shares, deep)
    parts = {"tissue": solid & ~np.any([np.zeros_like(solid), *ventricles.values()], axis=0), **ventricles}
    counts = {name: float(cells.sum()) for name, cells in {"solid": solid, **parts}.items()}
    counts |= {f"image_{name}": float(share.sum()) for name, share in shares.items()}
    figures = {f"{name}_volume_m3": n * size**3 for name, n in counts.items()}
    return Head(grid, solid, deep, parts, figures, image.to_world, tuple(remarks))


def parts_of(image: Image, labels: deck.Labels) -> tuple[Cells, dict[str, Cells], list[str]]:
    """Voxels (nz, ny, nx) of the body, one piece without cavities, those of it in each ventricle, and remarks.

    Raises InputError for labels that are missing or given twice.
    """
    wanted = {name: getattr(labels, name) for name in ("tissue", *VENTRICLES) if len(getattr(labels, name))}
    numbers = [number for several in wanted.values() for number in several]
    if twice := sorted({number for number in numbers if numbers.count(number) > 1}):
        raise InputError(f"{image.path}: label {twice[0]} is given twice in [labels]; a voxel is of one part only")
    voxels = {name: _voxels(image, name, several) for name, several in wanted.items()}
    body, remarks = _body(image, voxels)
    if all(name in voxels for name in VENTRICLES):
        left, right = (np.nonzero(voxels[name])[2].mean() for name in VENTRICLES)
        if left > right:
            remarks.append(
                f"warning: labels.left_ventricle lies right of labels.right_ventricle in {image.path}; swap them"
            )
    return body, {name: mask & body for name, mask in voxels.items() if name in VENTRICLES}, remarks


def read_image(path: Path) -> Image:
    """The label image of a file that nibabel reads (NIfTI, MGH, ...), turned to x right, y front, z up.

    Raises InputError if it is missing, no image, not three-dimensional, oblique, or holds other than integers.
    """
    try:
        import nibabel
    except ImportError as error:
        raise InputError(f"{path}: label images need nibabel; install it: pip install 'mpitled[images]'") from error
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; labels.image is a path from the deck's folder")
    if not is_image(path):
        raise InputError(
            f"{path}: is not an image of a kind that is read ({', '.join(_SUFFIXES)}); convert it to NIfTI"
        )
    try:
        _check_start(path)
        image: Any = nibabel.load(path)
        placed = any(int(image.header.get(name, 1)) for name in ("qform_code", "sform_code"))  # of NIfTI alone
        if len(image.shape) > 3 and set(image.shape[3:]) == {1}:  # one volume, with more axes than it needs
            image = nibabel.funcs.squeeze_image(image)
        if len(image.shape) != 3 or 0 in image.shape:
            raise InputError(f"{path}: has shape {image.shape}, not three dimensions; give one volume of labels")
        _check_claim(path, image)
        to_world = image.affine[:3]
        image = nibabel.as_closest_canonical(image)
        data = np.asarray(image.dataobj)
    except InputError:
        raise
    except Exception as error:  # nibabel raises what it likes
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise InputError(f"{path}: not an image that can be read ({reason}); give a NIfTI file of labels") from error
    if data.dtype.kind not in "iufb":
        raise InputError(f"{path}: voxels of type {data.dtype} are no labels; give a volume of integers")
    if data.dtype.kind == "f" and not (np.isfinite(data).all() and (data == np.round(data)).all()):
        raise InputError(f"{path}: holds values that are no integers; give labels, not intensities or probabilities")
    axes, corner = image.affine[:3, :3], image.affine[:3, 3]
    edges = np.diag(axes)
    # A tilt that moves no voxel by more than half its size over the whole image is round-off of the header.
    tilt = np.abs(axes - np.diag(edges)) * np.array(data.shape)
    if not (edges > 0).all() or tilt.max() > 0.5 * edges.min():
        raise InputError(
            f"{path}: its axes are oblique to the scanner's; resample it first, without interpolating the labels: "
            f'python -c "import nibabel as n, nibabel.processing as p; '
            f"n.save(p.resample_to_output(n.load('{path}'), order=0), 'straight.nii.gz')\""
        )
    try:
        metre = _METRES[getattr(image.header, "get_xyzt_units", lambda: ("mm",))()[0]]
    except KeyError:
        raise InputError(f"{path}: its header has a unit of length that is none; correct it (mm)") from None
    return Image(
        path=path,
        labels=np.ascontiguousarray(data.T).astype(np.int32),
        origin=(corner - edges / 2) * metre,
        voxel=edges * metre,
        to_world=to_world * metre,
        placed=placed,
    )


def is_image(path: Path) -> bool:
    """Whether a file is called as the images that are read."""
    return path.name.lower().endswith(_SUFFIXES)


def contents(path: Path) -> dict[str, Any]:
    """Voxels of a label image along x, y, z, their edges (mm), its extent (mm), and the volume of each label (ml)."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give an image of labels")
    image = read_image(path)
    n = np.array(image.labels.shape[::-1])
    labels, counts = np.unique(image.labels[image.labels != 0], return_counts=True)
    ends = 1e3 * np.stack([image.origin, image.origin + n * image.voxel], axis=1)
    ml = 1e6 * float(image.voxel.prod())
    return {
        "voxels": n.tolist(),
        "voxel_mm": (1e3 * image.voxel).tolist(),
        "extent_mm": dict(zip("xyz", ends.tolist(), strict=True)),
        "labels_ml": {str(label): ml * count for label, count in zip(labels.tolist(), counts.tolist(), strict=True)},
    }


def _check_start(path: Path) -> None:
    """InputError if a NIfTI file claims that much lies before its voxels, all of which would be read."""
    if path.name.lower().endswith((".mgh", ".mgz")):
        return
    with gzip.open(path) if path.suffix.lower() == ".gz" else path.open("rb") as file:
        head = file.read(176)
    for order in "<>":
        for size, place, kind in ((348, 108, "f"), (540, 168, "q")):  # NIfTI-1 and NIfTI-2
            if len(head) == 176 and struct.unpack_from(f"{order}i", head)[0] == size:
                before = struct.unpack_from(order + kind, head, place)[0]
                if not 0 <= before <= _MOST_BEFORE:
                    raise InputError(f"{path}: claims {before:g} bytes before its voxels; write it anew")


def _check_claim(path: Path, image: Any) -> None:
    """InputError if a header claims more voxels than the file can hold, or the memory."""
    n, kind = float(np.prod(image.shape, dtype=float)), image.get_data_dtype()
    packed = path.suffix.lower() in (".gz", ".mgz")
    if n * kind.itemsize > path.stat().st_size * (_INFLATED if packed else 1):
        raise InputError(f"{path}: claims {n:.3g} voxels and has {path.stat().st_size} bytes; write it anew")
    resources.check_memory(
        n * (2 * max(kind.itemsize, 8) + _VOXEL_BYTES), f"{path}: its {n:.3g} voxels", "cut it to the head"
    )


def box_shares(image: Image, mask: Cells, grid: Grid) -> NDArray[np.float64]:
    """Share (nz, ny, nx) of each of the grid's cubes that the masked voxels fill: an exact box integral."""
    share = mask.astype(float)
    for axis, i in ((0, 2), (1, 1), (2, 0)):
        cells = grid.origin[i] + grid.size * np.arange(grid.shape[i] + 1)
        voxels = image.origin[i] + image.voxel[i] * np.arange(mask.shape[axis] + 1)
        overlap = np.minimum(cells[1:, None], voxels[None, 1:]) - np.maximum(cells[:-1, None], voxels[None, :-1])
        share = np.moveaxis(np.tensordot(np.maximum(overlap, 0) / grid.size, share, axes=(1, axis)), 0, axis)
    return share


def solid_cells(share: NDArray[np.float64]) -> tuple[Cells, int]:
    """Cubes of one face-connected manifold solid of the shares' volume, and how many were added to make it that."""
    target = round(float(share.sum()))
    n, best, least, repaired = target, np.zeros(share.shape, bool), np.inf, 0
    # Repairs only add: so the next trial starts with that much less.
    for _ in range(4):
        taken = _piece(_fullest(share, n))
        trial = _manifold(taken, share)
        surplus = int(trial.sum()) - target
        if abs(surplus) < least:
            best, least, repaired = trial, abs(surplus), int(trial.sum() - taken.sum())
        if surplus == 0:
            break
        n -= surplus
    return best, repaired


def _voxels(image: Image, name: str, numbers: Sequence[int]) -> Cells:
    missing = [str(n) for n in numbers if not (image.labels == n).any()]
    if missing:
        there = ", ".join(map(str, np.unique(image.labels[image.labels > 0])[:20]))
        what = f"label {', '.join(missing)} (labels.{name}) is not in it"
        remedy = f"leave it out, or name one of {there}"
        if len(missing) == len(numbers):  # without it a default would take effect
            remedy = f"name one of {there}" + (f", or none: labels.{name} = []" if name in VENTRICLES else "")
        raise InputError(f"{image.path}: {what}; {remedy}")
    return np.isin(image.labels, numbers)


def _body(image: Image, voxels: dict[str, Cells]) -> tuple[Cells, list[str]]:
    """All labelled voxels as one piece without cavities, and what that took."""
    if "tissue" not in voxels:
        raise InputError(f"{image.path}: labels.tissue names no label; give the numbers of the brain's tissue")
    labelled = np.any(list(voxels.values()), axis=0)
    body = _piece(labelled)
    full = _without_cavities(body)
    ml = 1e6 * float(image.voxel.prod())
    remarks = []
    if dropped := int(labelled.sum() - body.sum()):
        remarks.append(f"{image.path}: {dropped * ml:.3g} ml of labelled voxels do not touch the rest and are left out")
    if filled := int(full.sum() - body.sum()):
        remarks.append(f"{image.path}: {filled * ml:.3g} ml of unlabelled voxels inside are taken as tissue")
    return full, remarks


def _grid(image: Image, body: Cells, size: float) -> Grid:
    """Cubes centred on the body, so that a symmetric one stays so."""
    low, high = np.empty(3), np.empty(3)
    for i in range(3):
        occupied = np.flatnonzero(body.any(axis=tuple({0, 1, 2} - {2 - i})))
        low[i] = image.origin[i] + image.voxel[i] * occupied[0]
        high[i] = image.origin[i] + image.voxel[i] * (occupied[-1] + 1)
    # Two layers more than the body needs: repairs may add to it, and the outside must stay in one piece.
    wanted = np.ceil((high - low) / size - 1e-9) + 4
    overlaps = (wanted * image.labels.shape[::-1]).sum()  # see box_shares
    what = f"labels.element_size = {1e3 * size:g} mm: a grid of {wanted.prod():.3g} cubes"
    resources.check_memory(_CUBE_BYTES * (wanted.prod() + overlaps), what, "enlarge it")
    n = wanted.astype(int)
    return Grid((low + high) / 2 - size * n / 2, size, (int(n[0]), int(n[1]), int(n[2])))


def _fullest(share: NDArray[np.float64], n: int) -> Cells:
    """The n cubes with the largest shares; between equals the fuller neighbourhood decides."""
    around = ndimage.uniform_filter(share, 3, mode="constant")
    order = np.argsort(-(share + 1e-3 * around), axis=None, kind="stable")
    order = order[share.ravel()[order] > 0][:n]
    cells = np.zeros(share.size, bool)
    cells[order] = True
    return cells.reshape(share.shape)


def _piece(cells: Cells, of: tuple[int, int, int] | None = None) -> Cells:
    """The face-connected piece that holds the cube `of`, or the largest."""
    pieces, n = ndimage.label(cells)
    if n == 0:
        return cells
    chosen = pieces[of] if of is not None else 1 + np.argmax(np.bincount(pieces.ravel())[1:])
    return (pieces == chosen) & cells


def _without_cavities(cells: Cells) -> Cells:
    outside = _piece(np.pad(~cells, 1, constant_values=True), of=(0, 0, 0))
    return ~outside[1:-1, 1:-1, 1:-1]


def _sound_corners() -> NDArray[np.bool_]:
    """For each of 256 patterns of the 8 cubes at a node: are the full ones, and the empty ones, face-connected?

    Just then the surface at the node is a disc (or there is none); edges are checked with it.
    """
    sound = np.zeros(256, bool)
    for code in range(256):
        pattern = np.array([code >> bit & 1 for bit in range(8)], bool).reshape(2, 2, 2)
        sound[code] = ndimage.label(pattern)[1] <= 1 and ndimage.label(~pattern)[1] <= 1
    return sound


def _manifold(cells: Cells, share: NDArray[np.float64]) -> Cells:
    """Cubes added, those with the largest share first, until no node or edge of the surface is met twice by it."""
    sound = _sound_corners()
    cells = _without_cavities(cells)
    around = list(product((0, 1), repeat=3))
    while True:
        full = np.pad(cells, 1)
        nz, ny, nx = (n - 1 for n in full.shape)
        code = sum(full[k : k + nz, j : j + ny, i : i + nx].astype(int) << bit for bit, (k, j, i) in enumerate(around))
        bad = np.stack(np.nonzero(~sound[code]), axis=1)
        if len(bad) == 0:
            return cells
        neighbours = (bad[:, None] + np.array(around)).transpose(2, 0, 1)
        empty_share = np.where(full[tuple(neighbours)], -1.0, np.pad(share, 1)[tuple(neighbours)])
        pick = neighbours[:, np.arange(len(bad)), empty_share.argmax(axis=1)]
        full[tuple(pick)] = True
        cells = _without_cavities(full[1:-1, 1:-1, 1:-1])


def _ventricles(image: Image, grid: Grid, shares: dict[str, NDArray[np.float64]], deep: Cells) -> dict[str, Cells]:
    """Cubes of each ventricle: one face-connected piece of the label's volume, off the outer surface."""
    names = [name for name in VENTRICLES if name in shares]
    parts = {}
    for name in names:
        own = np.where(deep, shares[name], 0.0)
        for other in names:
            # A cube that both fill is the fuller one's, and of equals the first's.
            if other != name:
                mine = own >= shares[other] if names.index(name) < names.index(other) else own > shares[other]
                own = np.where(mine, own, 0.0)
        parts[name] = _connected_part(own, round(float(shares[name].sum())))
        if not parts[name].any():
            raise InputError(
                f"labels.element_size = {1e3 * grid.size:g} mm: the {name.replace('_', ' ')} of {image.path} is too "
                "small or too near the surface for it; make it smaller"
            )
    return parts


def _connected_part(share: NDArray[np.float64], target: int) -> Cells:
    """The largest piece of the fullest cubes, as many as it takes to make it `target` cubes, or next to that."""
    if target == 0 or not share.any():
        return np.zeros(share.shape, bool)
    box = ndimage.find_objects((share > 0).astype(np.int8))[0]
    share_in_box = share[box]
    low, high = target, max(target, int(np.count_nonzero(share_in_box)))
    while low < high:
        middle = (low + high) // 2
        if _piece(_fullest(share_in_box, middle)).sum() >= target:
            high = middle
        else:
            low = middle + 1
    more, less = (_piece(_fullest(share_in_box, n)) for n in (low, low - 1))
    part = np.zeros(share.shape, bool)
    part[box] = more if more.sum() - target <= target - less.sum() else less
    return part


def _distance(grid: Grid, cells: Cells, place: NDArray[np.float64]) -> float:
    """How far a place (3,), m, is from the nearest of the cubes, m."""
    low = grid.origin + grid.size * np.argwhere(cells)[:, ::-1]
    apart = np.maximum(np.maximum(low - place, place - low - grid.size), 0.0)
    return float(np.linalg.norm(apart, axis=1).min(initial=np.inf))


def _elsewhere(grid: Grid, free: Cells, centre: NDArray[np.float64], needed: float) -> str:
    """Where the nearest place is that has nothing but free cubes within so many metres, in words."""
    # From middle to middle of cubes; half a diagonal is what a place may be nearer to the next cube's corner.
    far = grid.size * (ndimage.distance_transform_edt(free) - 3**0.5 / 2)
    middles = grid.origin + grid.size * (np.argwhere(far >= needed)[:, ::-1] + 0.5)
    if not len(middles):
        return "no place in this head has it"
    return f"the nearest place that has it is {in_millimetres(middles[((middles - centre) ** 2).sum(axis=1).argmin()])}"


def _void(head: Head, radius: float, centre: NDArray[np.float64], needed: float) -> Cells:
    """Cubes of tissue within the radius of the tumour's centre that make room for the cloud: one piece around it.

    No cube with a node on the skull is among them, and what remains of the solid is one piece. InputError if the centre
    is not in tissue, or one that must stay is nearer than `needed`.
    """
    where = f"tumour.centre = {in_millimetres(centre)}"
    grid, parts = head.grid, head.parts
    at = np.argwhere(head.solid)[:, ::-1]
    ends = (grid.origin + grid.size * at.min(axis=0), grid.origin + grid.size * (at.max(axis=0) + 1))
    hint = f"; {said}" if (said := looks_like_metres(centre, *ends)) else ""
    cell = grid.cell_of(centre)
    part = next((name for name, cells in parts.items() if cell is not None and cells[cell]), None)
    if part != "tissue":
        lies = f"in the {part.replace('_', ' ')}" if part else "outside the brain"
        apart = length(_distance(grid, parts["tissue"], centre))
        extent = ", ".join(f"{name} {1e3 * a:.0f} to {1e3 * b:.0f}" for name, a, b in zip("xyz", *ends, strict=True))
        as_voxels = head.to_world @ np.append(1e3 * centre, 1.0)
        meant = grid.cell_of(as_voxels) if part is None else None
        if meant is not None and head.solid[meant] and not hint:
            hint = f"; it looks like voxels: in mm it is {in_millimetres(as_voxels).removesuffix(' mm')}"
        raise InputError(
            f"{where}: lies {lies}, {apart} from the nearest tissue; move it into tissue (the head: {extent} mm){hint}"
        )
    away = [(grid.origin[i] + grid.size * (np.arange(grid.shape[i]) + 0.5) - centre[i]) ** 2 for i in (2, 1, 0)]
    square_distance = away[0][:, None, None] + away[1][:, None] + away[2]
    free = parts["tissue"] & head.deep
    stay = {name.replace("_", " "): parts[name] for name in VENTRICLES if name in parts}
    stay["skull"] = parts["tissue"] & ~head.deep
    apart_from = {name: _distance(grid, cells, centre) for name, cells in stay.items()}
    nearest = min(apart_from, key=apart_from.__getitem__)
    if apart_from[nearest] < needed:
        raise InputError(
            f"{where}: is {length(apart_from[nearest])} from the {nearest}'s hexahedra, and the seed and an element's "
            f"size of cloud around it need {length(needed)}; move it ({_elsewhere(grid, free, centre, needed)}), or "
            f"make the hexahedra smaller{hint}"
        )
    void = free & (square_distance <= radius**2)
    while void[cell]:
        void = _piece(void, cell)
        rest = head.solid & ~void
        pieces, n = ndimage.label(rest)
        if n == 1:
            return void
        islands = rest & ~_piece(rest)
        held = islands & np.isin(pieces, np.unique(pieces[islands & ~free]))
        if not held.any():
            # Islands of tissue join the void.
            return void | islands
        # One that must stay grows on the side away from the tumour until it is tied to the rest.
        beyond = square_distance > square_distance[held].mean()
        void &= ~(ndimage.binary_dilation(held) & beyond)
    raise InputError(
        f"{where}: there is no room for a cloud so near to the skull or a ventricle; move it away from there{hint}"
    )
