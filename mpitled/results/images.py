"""Export of a result to the grid of its label image, as NIfTI files for 3D Slicer and other programs based on ITK.

Vectors are in mm along the world axes of the image (x right, y front, z up), for any order of the voxels. The files
have the intent code of displacements (1006): ITK (from 5.4) and Slicer (since 2023) convert such vectors to their own
axes (left, back). These programs read a displacement field as a transform from points of the warped image to points of
the original image. The inverse field is therefore the one that warps an image. Displacements are zero where there is no
tissue (outside the body, inside the seed, inside the grown tumour). Interpolation next to such voxels is meaningless.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mpitled import atomic, deck, resources
from mpitled.errors import InputError, damaged
from mpitled.meshing.label_image import VENTRICLES, Image, Mask, read_image, segment
from mpitled.results.field import Field, open_field

DISPLACEMENT, INVERSE, LABELS = "displacement.nii.gz", "inverse_displacement.nii.gz", "labels.nii.gz"

_DISPLACEMENT_VECTORS = 1006  # NIFTI_INTENT_DISPVECT
_ALIGNED = 2  # NIFTI_XFORM_ALIGNED_ANAT, for an image without a code
_VOXEL_BYTES, _BODY_BYTES = 80, 350  # memory for each voxel, and additional memory for each voxel of the body
_VOLUME_RTOL = 1e-6  # above round-off, below one voxel


@dataclass(frozen=True, slots=True)
class NiftiExport:
    """The files of an export, and their accuracy."""

    paths: list[Path]
    tumour: int | None  # the label of the grown tumour
    missed: float  # m: largest error of the inverse field
    share: float  # of the load
    complete: bool  # whether the run reached its end


@dataclass(frozen=True, slots=True)
class _Ball:
    """The seed, or the grown tumour."""

    centre: NDArray[np.float64]  # (3,), m
    radius: float  # m

    def contains(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points (n, 3), m, are inside."""
        return np.asarray(((positions - self.centre) ** 2).sum(axis=1) < self.radius**2)

    def voxels(self, image: Image) -> Mask:
        """Whether the centre of each voxel of the image is inside (nz, ny, nx)."""
        x, y, z = (
            (image.origin[i] + image.voxel[i] * (np.arange(n) + 0.5) - self.centre[i]) ** 2
            for i, n in enumerate(image.labels.shape[::-1])
        )
        return np.asarray(z[:, None, None] + y[:, None] + x < self.radius**2)


def write_nifti(run: Path, directory: Path) -> NiftiExport:
    """Write the last frame of a run into a directory, on the voxels of the deck's label image.

    There are two fields (nx, ny, nz, 1, 3), float32. The first has the displacements of the tissue at the undeformed
    centres of voxels. The second, for resampling an image, has the vectors from the centres of voxels to the undeformed
    positions of the tissue that occupies the voxels after the deformation. In the deformed labels (nx, ny, nz) the
    tumour has a new, largest label. InputError if the run has no image, if the image has changed, or if a file cannot
    be written.
    """
    field = open_field(run)
    image, body, ventricles = _image_of(field, run)
    needed = _VOXEL_BYTES * body.size + _BODY_BYTES * float(body.sum())
    resources.check_memory(needed, f"{image.path}: its {body.size:.3g} voxels", "cut it to the head")
    seed, tumour = _balls(field)
    atomic.make_folder(directory)
    paths = [directory / name for name in (DISPLACEMENT, INVERSE, LABELS)]

    index = np.argwhere(body)
    positions = _centres(image, index)
    displacement = field.at(positions).displacement
    if seed:
        displacement[seed.contains(positions)] = 0
    _write(paths[0], image, _vectors(image, index, displacement), "displacement of tissue in mm")

    index = np.argwhere(_reachable(image, body, index, displacement))
    positions = _centres(image, index)
    if tumour:
        tissue = ~tumour.contains(positions)
        index, positions = index[tissue], positions[tissue]
    origins = field.origins(positions)
    undeformed = (origins.position - image.origin)[:, ::-1] / image.voxel[::-1]  # in voxels, each from i to i + 1
    in_body = np.asarray(((undeformed >= 0) & (undeformed < body.shape)).all(axis=1))
    in_body[in_body] = body[tuple(undeformed[in_body].astype(int).T)]
    index, undeformed = index[in_body], undeformed[in_body]
    inverse = _vectors(image, index, (origins.position - positions)[in_body])
    _write(paths[1], image, inverse, "deformed to undeformed position, mm")

    labels = np.where(body, 0, image.labels).astype(np.int64)
    labels[tuple(index.T)] = _deformed_labels(image, body, ventricles, undeformed)
    label, description = None, "deformed labels"
    if tumour:
        label = int(image.labels.max()) + 1
        labels[tumour.voxels(image)] = label
        description = f"{description}; {label}: tumour"
    _write(paths[2], image, labels, description)
    missed = float(origins.missed[in_body].max(initial=0))
    return NiftiExport(paths, label, missed, field.share, field.complete)


def _deformed_labels(
    image: Image, body: Mask, ventricles: Sequence[Mask], undeformed: NDArray[np.float64]
) -> NDArray[np.int32]:
    """Labels (n,) of voxels with undeformed positions (n, 3), which are in voxels by z, y, x.

    A voxel gets the label of the voxel around the undeformed position, except in ventricles: displacements below half
    a voxel would change no label, and a shrinking ventricle would keep its volume. A ventricle therefore gets the
    voxels with the largest interpolated shares, and as many voxels as the sum of the shares. The mesh selects the
    hexahedra of ventricles in the same way.
    """
    part = np.zeros(len(undeformed), np.int8)
    for number, mask in enumerate(ventricles, 1):
        share = ndimage.map_coordinates(mask.astype(np.float32), undeformed.T - 0.5, order=1, mode="nearest")
        n = round(float(share.sum(dtype=float)))
        share[part > 0] = 0
        part[np.argsort(-share, kind="stable")[:n]] = number
    labels = np.empty(len(undeformed), np.int32)
    rest = body & ~np.any([np.zeros_like(body), *ventricles], axis=0)
    for number, mask in enumerate((rest, *ventricles)):
        nearest = ndimage.distance_transform_edt(~mask, image.voxel[::-1], return_distances=False, return_indices=True)
        in_part = part == number
        voxel = tuple(undeformed[in_part].astype(int).T)
        labels[in_part] = image.labels[tuple(axis[voxel] for axis in nearest)]
    return labels


def _image_of(field: Field, run: Path) -> tuple[Image, Mask, list[Mask]]:
    """The label image of a run, its voxels (nz, ny, nx) of the body, and those of each ventricle.

    InputError if the image is missing or has changed.
    """
    with damaged(run, "run the deck again"):
        given = field.metadata["deck"].get("labels")
        if not given:
            raise InputError(f"--nifti: the scene of {run} has no [labels], and so no label image")
        labels = deck.Labels(
            image=Path(field.metadata["folder"]) / given["image"],
            element_size=1e-3 * given["element_size"],
            tissue=tuple(given["tissue"]),
            **{name: tuple(given[name]) for name in VENTRICLES},
        )
    path = labels.image
    remedy = "restore the image of the run, or run the deck again"
    if not path.is_file():
        raise InputError(f"{path}: the label image of {run} is missing; restore it")
    image = read_image(path)
    try:
        body, parts, _ = segment(image, labels)
    except InputError as error:
        raise InputError(f"{error}; it has changed since {run} was computed") from None
    voxel = float(image.voxel.prod())
    for name, mask in {"solid": body, **parts}.items():
        volume = field.model.figures.of_mesh.get(f"image_{name}_volume_m3", np.nan)
        if not abs(mask.sum() * voxel - volume) <= _VOLUME_RTOL * volume:
            raise InputError(f"{path}: has other labels than when {run} was computed; {remedy}")
    nodes = field.model.points[: field.model.n_fe_nodes]
    index = np.array(np.nonzero(body)[::-1])
    ends = image.origin + image.voxel * np.stack([index.min(axis=1), index.max(axis=1)])
    # The grid of hexahedra is centred on the body. The mesh and the body may differ by up to two layers of hexahedra.
    if np.abs(ends - [nodes.min(axis=0), nodes.max(axis=0)]).max() > 2 * labels.element_size + image.voxel.max():
        raise InputError(f"{path}: has another position than when {run} was computed; {remedy}")
    return image, body, list(parts.values())


def _balls(field: Field) -> tuple[_Ball, _Ball] | tuple[None, None]:
    """Seed and tumour, with the volumes of the report: each radius is the cubic mean of the distances of the nodes."""
    nodes = field.model.node_sets.get("tumour", np.empty(0, np.int64))
    if not len(nodes) or not field.metadata.get("tumour"):
        return None, None
    centre = np.array(field.metadata["tumour"]["centre_m"])
    surface = field.model.points[nodes] - centre
    seed, tumour = (
        _Ball(centre, float((np.linalg.norm(nodes_on_it, axis=1) ** 3).mean() ** (1 / 3)))
        for nodes_on_it in (surface, surface + field.parameters[nodes])
    )
    return seed, tumour


def _reachable(image: Image, body: Mask, index: NDArray[np.int64], displacement: NDArray[np.float64]) -> Mask:
    """Voxels (nz, ny, nx) that the deformed body can reach: not farther away than the displacement of its surface."""
    surface = body & ~ndimage.binary_erosion(body)
    largest = np.linalg.norm(displacement[surface[tuple(index.T)]], axis=1).max()
    return np.asarray(ndimage.distance_transform_edt(~body, sampling=image.voxel[::-1]) <= largest)


def _centres(image: Image, index: NDArray[np.int64]) -> NDArray[np.float64]:
    """Centres (n, 3), m, of voxels with indices (n, 3) by z, y, x."""
    return image.origin + image.voxel * (index[:, ::-1] + 0.5)


def _vectors(image: Image, index: NDArray[np.int64], vectors: NDArray[np.float64]) -> NDArray[np.float32]:
    """A grid (nz, ny, nx, 3) with vectors (n, 3), m, at voxels (n, 3), in mm, and zeros at other voxels."""
    grid = np.zeros((*image.labels.shape, 3), np.float32)
    grid[tuple(index.T)] = 1e3 * vectors
    return grid


def _write(path: Path, image: Image, data: NDArray[Any], description: str) -> None:
    """Write labels (nz, ny, nx) or vectors (nz, ny, nx, 3) with the voxel order and the affine of the image file."""
    import nibabel  # read_image has raised InputError if it is missing

    source: Any = nibabel.load(image.path)
    affine = np.vstack([1e3 * image.to_world, [0, 0, 0, 1]])
    ras = [[0, 1], [1, 1], [2, 1]]  # right, anterior, superior
    reorientation = nibabel.orientations.ornt_transform(ras, nibabel.io_orientation(affine))
    values = nibabel.apply_orientation(np.moveaxis(data, (0, 1, 2), (2, 1, 0)), reorientation)
    vectors = data.ndim == 4
    if vectors:
        values = values[:, :, :, None]
    dtype = data.dtype if vectors else _label_type(data, source.get_data_dtype())
    # A new header, because the header of the source may contain personal data.
    written: Any = nibabel.Nifti1Image(values.astype(dtype, copy=False), affine, dtype=dtype)
    code = int(source.header.get("sform_code", 0)) or int(source.header.get("qform_code", 0)) or _ALIGNED
    written.set_sform(affine, code)
    written.set_qform(affine, code)
    written.header.set_xyzt_units("mm")
    written.header["descrip"] = f"mpitled: {description}"
    if vectors:
        written.header.set_intent(_DISPLACEMENT_VECTORS)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")  # nibabel chooses the format by the suffix
    with atomic.writing(path):
        try:
            nibabel.save(written, temporary)
            os.replace(temporary, path)
        finally:
            with suppress(OSError):  # an error here would hide the first one
                temporary.unlink()


def _label_type(labels: NDArray[np.int64], of_image: np.dtype[Any]) -> np.dtype[Any]:
    """The type of the image if it can represent all labels, or else the smallest integer type that can."""
    ends = np.array([labels.min(), labels.max()])
    types = (of_image.newbyteorder("="), *map(np.dtype, (np.int16, np.int32, np.int64)))
    return next(dtype for dtype in types if (ends.astype(dtype) == ends).all())
