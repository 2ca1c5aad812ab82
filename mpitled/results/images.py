"""A result back on the grid of the label image that it came from, as NIfTI files for 3D Slicer and others of ITK.

Vectors are in mm along the axes of the image's world, x right, y front, z up, as NIfTI has them whichever way voxels
run. Their files have the intent of displacements (1006), by which ITK (from 5.4 on) and Slicer (since 2023) turn them
into axes of their own, left and back, as they read them. A field that is read as a transform is to them one that leads
from places of the warped image to those of the image to warp: the inverse one. Where there is no tissue (outside the
body, inside the seed before and the tumour after it has grown) displacements are zero, so that what is interpolated
between such a voxel and the next means nothing.
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
_ALIGNED = 2  # how an affine is meant that the file itself does not have, as nibabel says it
_VOXEL_BYTES, _BODY_BYTES = 80, 350  # of memory that a voxel takes, and one of the body beside that, at the most
_SAME = 1e-6  # of a volume: more than its sums are off by, less than a voxel


@dataclass(frozen=True, slots=True)
class Written:
    """What was written of a run."""

    paths: list[Path]
    tumour: int | None  # the label of the grown tumour
    missed: float  # m: how far the two fields are from undoing each other, at the worst voxel
    share: float  # of the load
    complete: bool  # whether the run came to its end


@dataclass(frozen=True, slots=True)
class _Ball:
    """The seed before, the tumour after it has grown."""

    centre: NDArray[np.float64]  # (3,), m
    radius: float  # m

    def holds(self, places: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which places (n, 3), m, lie inside."""
        return np.asarray(((places - self.centre) ** 2).sum(axis=1) < self.radius**2)

    def voxels(self, image: Image) -> Mask:
        """The image's voxels (nz, ny, nx) whose middles lie inside."""
        x, y, z = (
            (image.origin[i] + image.voxel[i] * (np.arange(n) + 0.5) - self.centre[i]) ** 2
            for i, n in enumerate(image.labels.shape[::-1])
        )
        return np.asarray(z[:, None, None] + y[:, None] + x < self.radius**2)


def write_nifti(run: Path, directory: Path) -> Written:
    """Write the last frame of a run's folder into a directory, on the voxels of the deck's label image.

    Two fields (x, y, z, 1, 3), float32: displacements of the tissue that was at the voxels' middles, and those that
    lead from the middles back to where the tissue came from that is there now, as resampling an image asks for. And
    the labels (x, y, z) as the tissue has carried them, with the tumour's the largest and one more. InputError if the
    run has no image, or not the one that there is, or the disc refuses.
    """
    field = open_field(run)
    image, body, ventricles = _image_of(field, run)
    needed = _VOXEL_BYTES * body.size + _BODY_BYTES * float(body.sum())
    resources.check_memory(needed, f"{image.path}: its {body.size:.3g} voxels", "cut it to the head")
    seed, tumour = _balls(field)
    atomic.make_folder(directory)
    paths = [directory / name for name in (DISPLACEMENT, INVERSE, LABELS)]

    index = np.argwhere(body)
    places = _middles(image, index)
    displacement = field.at(places).displacement
    if seed:
        displacement[seed.holds(places)] = 0
    _write(paths[0], image, _vectors(image, index, displacement), "displacement of tissue in mm")

    index = np.argwhere(_reached(image, body, index, displacement))
    places = _middles(image, index)
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
    """Labels (n,) of voxels whose middles came from the places before (n, 3), in voxels by z, y, x.

    It is the label of the voxel that holds the place, but for the ventricles: where all moves by less than half a
    voxel that would change no label at all, and a ventricle that shrinks would keep its volume. So each has as many
    voxels as its share of all of them adds up to, those with the largest shares; the mesh takes its hexahedra alike.
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

    InputError if it is not there or not what it was.
    """
    with damaged(run, "run the deck again"):
        given = field.metadata["deck"].get("labels")
        if not given:
            raise InputError(f"--nifti: the scene of {run} has no [labels], and so no image to go back to")
        labels = deck.Labels(
            image=Path(field.metadata["folder"]) / given["image"],
            element_size=1e-3 * given["element_size"],
            tissue=tuple(given["tissue"]),
            **{name: tuple(given[name]) for name in VENTRICLES},
        )
    path = labels.image
    remedy = "give back the image that the deck was run with, or run the deck again"
    if not path.is_file():
        raise InputError(f"{path}: the label image of {run} is not there; put it back")
    image = read_image(path)
    try:
        body, parts, _ = segment(image, labels)
    except InputError as error:
        raise InputError(f"{error}; it has changed since {run} was computed") from None
    voxel = float(image.voxel.prod())
    for name, mask in {"solid": body, **parts}.items():
        volume = field.model.figures.get(f"image_{name}_volume_m3", np.nan)
        if not abs(mask.sum() * voxel - volume) <= _SAME * volume:
            raise InputError(f"{path}: has other labels than when {run} was computed; {remedy}")
    nodes = field.model.points[: field.model.n_fe_nodes]
    ends = image.origin + image.voxel * np.array([[f(of) for of in np.nonzero(body)[::-1]] for f in (np.min, np.max)])
    # Hexahedra are centred on the body, and the layers that its volume takes or leaves are less than two.
    if np.abs(ends - [nodes.min(axis=0), nodes.max(axis=0)]).max() > 2 * labels.element_size + image.voxel.max():
        raise InputError(f"{path}: lies elsewhere than when {run} was computed; {remedy}")
    return image, body, list(parts.values())


def _balls(field: Field) -> tuple[_Ball, _Ball] | tuple[None, None]:
    """Seed and tumour, each with the volume that the report tells: of the sphere that its nodes are a sample of."""
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
    """Voxels (nz, ny, nx) where the body may be by now: no farther from where it was than its surface has moved."""
    surface = body & ~ndimage.binary_erosion(body)
    far = np.linalg.norm(displacement[surface[tuple(index.T)]], axis=1).max()
    return np.asarray(ndimage.distance_transform_edt(~body, sampling=image.voxel[::-1]) <= far)


def _middles(image: Image, index: NDArray[np.int64]) -> NDArray[np.float64]:
    """Places (n, 3), m, of the middles of voxels (n, 3), by z, y, x."""
    return image.origin + image.voxel * (index[:, ::-1] + 0.5)


def _vectors(image: Image, index: NDArray[np.int64], vectors: NDArray[np.float64]) -> NDArray[np.float32]:
    """Vectors (n, 3), m, at voxels (n, 3), in mm on the whole grid (nz, ny, nx, 3)."""
    grid = np.zeros((*image.labels.shape, 3), np.float32)
    grid[tuple(index.T)] = 1e3 * vectors
    return grid


def _write(path: Path, image: Image, data: NDArray[Any], about: str) -> None:
    """Write labels (nz, ny, nx) or vectors (nz, ny, nx, 3) in the order of the image file's own voxels, in mm."""
    import nibabel  # read_image has said what to do where there is none

    source: Any = nibabel.load(image.path)
    affine = np.vstack([1e3 * image.to_world, [0, 0, 0, 1]])
    upright = [[0, 1], [1, 1], [2, 1]]
    turn = nibabel.orientations.ornt_transform(upright, nibabel.io_orientation(affine))
    own = nibabel.apply_orientation(np.moveaxis(data, (0, 1, 2), (2, 1, 0)), turn)
    vectors = data.ndim == 4
    kind = data.dtype if vectors else _kind(data, source.get_data_dtype())
    shown = own[:, :, :, None] if vectors else own
    # A header of its own: what else that of the source says, of a person maybe, is not of this image.
    written: Any = nibabel.Nifti1Image(shown.astype(kind, copy=False), affine, dtype=kind)
    codes = [int(source.header.get(name, 0)) for name in ("sform_code", "qform_code")]
    code = next(filter(None, codes), _ALIGNED)
    written.set_sform(affine, code)
    written.set_qform(affine, code)
    written.header.set_xyzt_units("mm")
    written.header["descrip"] = f"mpitled: {about}"
    if vectors:
        written.header.set_intent(_DISPLACEMENT_VECTORS)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")  # nibabel goes by the end of the name
    with atomic.writing(path):
        try:
            nibabel.save(written, temporary)
            os.replace(temporary, path)
        finally:
            with suppress(OSError):  # which would hide why nothing was written
                temporary.unlink()


def _kind(labels: NDArray[np.int64], own: np.dtype[Any]) -> np.dtype[Any]:
    """The type that the image has itself if it holds all labels, or the smallest one that does."""
    ends = np.array([labels.min(), labels.max()])
    kinds = (own.newbyteorder("="), *map(np.dtype, (np.int16, np.int32, np.int64)))
    return next(kind for kind in kinds if (ends.astype(kind) == ends).all())
