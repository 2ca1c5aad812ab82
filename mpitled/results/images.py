"""Export of a result to the grid of its label image, as NIfTI files for 3D Slicer and other programs based on ITK.

Vectors are in mm along the axes of the image's world (x right, y front, z up), whichever way the voxels run. The files
have the intent code of displacements (1006): ITK (from 5.4) and Slicer (since 2023) convert such vectors to their own
axes (left, back). These programs read a displacement field as a transform from points of the warped image to points of
the image to warp, so the inverse field is the one that warps an image. Displacements are zero where there is no tissue
(outside the body, inside the seed, inside the grown tumour); interpolation next to such voxels is meaningless.
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
_ALIGNED = 2  # NIFTI_XFORM_ALIGNED_ANAT, for an image without a code of its own
_VOXEL_BYTES, _BODY_BYTES = 80, 350  # memory for each voxel, and in addition for each voxel of the body
_SAME = 1e-6  # relative difference of volumes: above round-off, below one voxel


@dataclass(frozen=True, slots=True)
class Written:
    """The files of an export, and their accuracy."""

    paths: list[Path]
    tumour: int | None  # the label of the grown tumour
    missed: float  # m: largest distance by which the inverse field misses
    share: float  # of the load
    complete: bool  # whether the run came to its end


@dataclass(frozen=True, slots=True)
class _Ball:
    """The seed before the growth, or the tumour after it."""

    centre: NDArray[np.float64]  # (3,), m
    radius: float  # m

    def holds(self, places: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points (n, 3), m, are inside."""
        return np.asarray(((places - self.centre) ** 2).sum(axis=1) < self.radius**2)

    def voxels(self, image: Image) -> Mask:
        """The image's voxels (nz, ny, nx) whose centres are inside."""
        x, y, z = (
            (image.origin[i] + image.voxel[i] * (np.arange(n) + 0.5) - self.centre[i]) ** 2
            for i, n in enumerate(image.labels.shape[::-1])
        )
        return np.asarray(z[:, None, None] + y[:, None] + x < self.radius**2)


def write_nifti(run: Path, directory: Path) -> Written:
    """Write the last frame of a run's folder into a directory, on the voxels of the deck's label image.

    Two fields (x, y, z, 1, 3), float32: the displacements of the tissue at the undeformed centres of voxels, and the
    vectors from the centres of voxels to the undeformed positions of the tissue that is there after the deformation
    (for resampling an image). And the deformed labels (x, y, z), in which the tumour has a new largest label.
    InputError if the run has no image, if the image has changed, or if a file cannot be written.
    """
    field = open_field(run)
    image, body, ventricles = _image_of(field, run)
    needed = _VOXEL_BYTES * body.size + _BODY_BYTES * float(body.sum())
    resources.check_memory(needed, f"{image.path}: its {body.size:.3g} voxels", "cut it to the head")
    seed, tumour = _balls(field)
    atomic.make_folder(directory)
    paths = [directory / name for name in (DISPLACEMENT, INVERSE, LABELS)]

    index = np.argwhere(body)
    places = _centres(image, index)
    displacement = field.at(places).displacement
    if seed:
        displacement[seed.holds(places)] = 0
    _write(paths[0], image, _vectors(image, index, displacement), "displacement of tissue in mm")

    index = np.argwhere(_reached(image, body, index, displacement))
    places = _centres(image, index)
    if tumour:
        tissue = ~tumour.holds(places)
        index, places = index[tissue], places[tissue]
    origins = field.origins(places)
    before = (origins.place - image.origin)[:, ::-1] / image.voxel[::-1]  # in voxels, each from i to i + 1
    known = np.asarray(((before >= 0) & (before < body.shape)).all(axis=1))
    known[known] = body[tuple(before[known].astype(int).T)]
    index, before = index[known], before[known]
    back = _vectors(image, index, (origins.place - places)[known])
    _write(paths[1], image, back, "from deformed places back to undeformed, mm")

    labels = np.where(body, 0, image.labels).astype(np.int64)
    labels[tuple(index.T)] = _carried(image, body, ventricles, before)
    label, about = None, "labels as tissue carried them"
    if tumour:
        label = int(image.labels.max()) + 1
        labels[tumour.voxels(image)] = label
        about = f"{about}; {label}: tumour"
    _write(paths[2], image, labels, about)
    missed = float(origins.missed[known].max(initial=0))
    return Written(paths, label, missed, field.share, field.complete)


def _carried(image: Image, body: Mask, ventricles: Sequence[Mask], before: NDArray[np.float64]) -> NDArray[np.int32]:
    """Labels (n,) of voxels with undeformed positions `before` (n, 3), in voxels by z, y, x.

    The label is that of the voxel around the position, except in ventricles: displacements below half a voxel would
    change no label, and a ventricle that shrinks would keep its volume. Each ventricle therefore gets as many voxels as
    its interpolated shares add up to, those with the largest shares; the mesh chooses its hexahedra in the same way.
    """
    part = np.zeros(len(before), np.int8)
    for number, mask in enumerate(ventricles, 1):
        share = ndimage.map_coordinates(mask.astype(np.float32), before.T - 0.5, order=1, mode="nearest")
        n = round(float(share.sum(dtype=float)))
        share[part > 0] = 0
        part[np.argsort(-share, kind="stable")[:n]] = number
    labels = np.empty(len(before), np.int32)
    rest = body & ~np.any([np.zeros_like(body), *ventricles], axis=0)
    for number, mask in enumerate((rest, *ventricles)):
        nearest = ndimage.distance_transform_edt(~mask, image.voxel[::-1], return_distances=False, return_indices=True)
        own = part == number
        at = tuple(before[own].astype(int).T)
        labels[own] = image.labels[tuple(of[at] for of in nearest)]
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
        if not abs(mask.sum() * voxel - volume) <= _SAME * volume:
            raise InputError(f"{path}: has other labels than when {run} was computed; {remedy}")
    nodes = field.model.points[: field.model.n_fe_nodes]
    ends = image.origin + image.voxel * np.array([[f(of) for of in np.nonzero(body)[::-1]] for f in (np.min, np.max)])
    # Hexahedra are centred on the body, which may lack or have up to two layers of them.
    if np.abs(ends - [nodes.min(axis=0), nodes.max(axis=0)]).max() > 2 * labels.element_size + image.voxel.max():
        raise InputError(f"{path}: has another position than when {run} was computed; {remedy}")
    return image, body, list(parts.values())


def _balls(field: Field) -> tuple[_Ball, _Ball] | tuple[None, None]:
    """Seed and tumour, each with the volume in the report: that of the sphere of which its nodes are a sample."""
    nodes = field.model.node_sets.get("tumour", np.empty(0, np.int64))
    if not len(nodes) or not field.metadata.get("tumour"):
        return None, None
    centre = np.array(field.metadata["tumour"]["centre_m"])
    surface = field.model.points[nodes] - centre
    seed, tumour = (
        _Ball(centre, float((np.linalg.norm(at, axis=1) ** 3).mean() ** (1 / 3)))
        for at in (surface, surface + field.parameters[nodes])
    )
    return seed, tumour


def _reached(image: Image, body: Mask, index: NDArray[np.int64], displacement: NDArray[np.float64]) -> Mask:
    """Voxels (nz, ny, nx) where the deformed body may be: at most the displacement of its surface away from it."""
    surface = body & ~ndimage.binary_erosion(body)
    far = np.linalg.norm(displacement[surface[tuple(index.T)]], axis=1).max()
    return np.asarray(ndimage.distance_transform_edt(~body, sampling=image.voxel[::-1]) <= far)


def _centres(image: Image, index: NDArray[np.int64]) -> NDArray[np.float64]:
    """Centres (n, 3), m, of voxels (n, 3), by z, y, x."""
    return image.origin + image.voxel * (index[:, ::-1] + 0.5)


def _vectors(image: Image, index: NDArray[np.int64], vectors: NDArray[np.float64]) -> NDArray[np.float32]:
    """Vectors (n, 3), m, at voxels (n, 3), in mm on the whole grid (nz, ny, nx, 3)."""
    grid = np.zeros((*image.labels.shape, 3), np.float32)
    grid[tuple(index.T)] = 1e3 * vectors
    return grid


def _write(path: Path, image: Image, data: NDArray[Any], about: str) -> None:
    """Write labels (nz, ny, nx) or vectors (nz, ny, nx, 3) in the order of the image file's own voxels, in mm."""
    import nibabel  # read_image has raised InputError if it is missing

    source: Any = nibabel.load(image.path)
    affine = np.vstack([1e3 * image.to_world, [0, 0, 0, 1]])
    upright = [[0, 1], [1, 1], [2, 1]]
    turn = nibabel.orientations.ornt_transform(upright, nibabel.io_orientation(affine))
    own = nibabel.apply_orientation(np.moveaxis(data, (0, 1, 2), (2, 1, 0)), turn)
    vectors = data.ndim == 4
    kind = data.dtype if vectors else _kind(data, source.get_data_dtype())
    shown = own[:, :, :, None] if vectors else own
    # A new header: the header of the source may hold data of a person.
    written: Any = nibabel.Nifti1Image(shown.astype(kind, copy=False), affine, dtype=kind)
    codes = [int(source.header.get(name, 0)) for name in ("sform_code", "qform_code")]
    code = next(filter(None, codes), _ALIGNED)
    written.set_sform(affine, code)
    written.set_qform(affine, code)
    written.header.set_xyzt_units("mm")
    written.header["descrip"] = f"mpitled: {about}"
    if vectors:
        written.header.set_intent(_DISPLACEMENT_VECTORS)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")  # nibabel chooses the format by the suffix
    with atomic.writing(path):
        try:
            nibabel.save(written, temporary)
            os.replace(temporary, path)
        finally:
            with suppress(OSError):  # it would hide the first error
                temporary.unlink()


def _kind(labels: NDArray[np.int64], own: np.dtype[Any]) -> np.dtype[Any]:
    """The type of the image itself if it can hold all labels, or the smallest that can."""
    ends = np.array([labels.min(), labels.max()])
    kinds = (own.newbyteorder("="), *map(np.dtype, (np.int16, np.int32, np.int64)))
    return next(kind for kind in kinds if (ends.astype(kind) == ends).all())
