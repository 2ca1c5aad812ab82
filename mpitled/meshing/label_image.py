"""Read a label image of a head with nibabel, and find the voxels of each part."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mpitled import resources
from mpitled.errors import InputError
from mpitled.mesh import Bools, Floats

if TYPE_CHECKING:
    from mpitled import deck

Mask = Bools  # (nz, ny, nx): x runs fastest in memory and in the numbering

_METRES = {"mm": 1e-3, "unknown": 1e-3, "meter": 1.0, "micron": 1e-6}
#: Image formats that are read; other formats of nibabel may refer to further files.
_SUFFIXES = (".nii", ".nii.gz", ".mgh", ".mgz")
_VOXEL_BYTES = 40  # upper bound of the memory per voxel, without its label, while the head is meshed
_MAX_INFLATION = 1032  # gzip expands a byte to at most this many
_MAX_HEADER = 1 << 24  # bytes of a NIfTI file before its voxels
#: Parts of a head beside its tissue: keys of the deck, and names of cell and node sets.
VENTRICLES = ("left_ventricle", "right_ventricle")


@dataclass(frozen=True, slots=True)
class Image:
    """A label image on an axis-parallel grid of voxels, in world coordinates in metres (x to the right, z up)."""

    path: Path
    labels: NDArray[np.int32]  # (nz, ny, nx)
    origin: Floats  # (3,), m: the first voxel's lowest corner
    voxel: Floats  # (3,), m: its edges along x, y, z
    to_world: Floats  # (3, 4), m: from the file's voxel indices (i, j, k, 1) to the world
    placed: bool  # whether the header gives the position of the voxels in the world


def read_image(path: Path) -> Image:
    """The label image of a NIfTI or MGH file, reoriented to x right, y front, z up.

    InputError if the file is missing, no image, not three-dimensional, oblique, or has values that are no integers.
    """
    try:
        import nibabel
    except ImportError as error:
        raise InputError(f"{path}: label images need nibabel; install it: pip install 'mpitled[images]'") from error
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; labels.image is a path from the deck's folder")
    if not is_image(path):
        raise InputError(f"{path}: is not an image in a known format ({', '.join(_SUFFIXES)}); convert it to NIfTI")
    try:
        _check_header_size(path)
        image: Any = nibabel.load(path)
        placed = any(int(image.header.get(name, 1)) for name in ("qform_code", "sform_code"))  # of NIfTI only
        if len(image.shape) > 3 and set(image.shape[3:]) == {1}:  # one volume with redundant axes
            image = nibabel.funcs.squeeze_image(image)
        if len(image.shape) != 3 or 0 in image.shape:
            raise InputError(f"{path}: has shape {image.shape}, not three dimensions; give one volume of labels")
        _check_size(path, image)
        to_world = image.affine[:3]
        image = nibabel.as_closest_canonical(image)
        data = np.asarray(image.dataobj)
    except InputError:
        raise
    except Exception as error:  # nibabel raises many kinds of errors
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
        raise InputError(f"{path}: its header has an unknown unit of length; correct it (mm)") from None
    return Image(
        path=path,
        labels=np.ascontiguousarray(data.T).astype(np.int32),
        origin=(corner - edges / 2) * metre,
        voxel=edges * metre,
        to_world=to_world * metre,
        placed=placed,
    )


def is_image(path: Path) -> bool:
    """Whether the file's name has the suffix of a known image format."""
    return path.name.lower().endswith(_SUFFIXES)


def contents(path: Path) -> dict[str, Any]:
    """Numbers of voxels of a label image along x, y, z, voxel edges and extent in mm, and volumes of labels in ml."""
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


def segment(image: Image, labels: deck.Labels) -> tuple[Mask, dict[str, Mask], list[str]]:
    """Masks of the body (one piece without cavities) and of each ventricle in it, and remarks.

    InputError if a label is missing or given twice.
    """
    wanted = {name: getattr(labels, name) for name in ("tissue", *VENTRICLES) if len(getattr(labels, name))}
    numbers = [number for several in wanted.values() for number in several]
    if twice := sorted({number for number in numbers if numbers.count(number) > 1}):
        raise InputError(f"{image.path}: label {twice[0]} is given twice in [labels]; a voxel belongs to one part only")
    masks = {name: _mask(image, name, several) for name, several in wanted.items()}
    if "tissue" not in masks:
        raise InputError(f"{image.path}: labels.tissue names no label; give the numbers of the brain's tissue")
    labelled = np.any(list(masks.values()), axis=0)
    largest = largest_piece(labelled)
    body = without_cavities(largest)
    ml = 1e6 * float(image.voxel.prod())
    remarks = []
    if dropped := int(labelled.sum() - largest.sum()):
        remarks.append(f"{image.path}: {dropped * ml:.3g} ml of labelled voxels do not touch the rest and are left out")
    if filled := int(body.sum() - largest.sum()):
        remarks.append(f"{image.path}: {filled * ml:.3g} ml of unlabelled voxels inside are taken as tissue")
    if all(name in masks for name in VENTRICLES):
        left, right = (np.nonzero(masks[name])[2].mean() for name in VENTRICLES)
        if left > right:
            remarks.append(
                f"warning: labels.left_ventricle lies right of labels.right_ventricle in {image.path}; swap them"
            )
    return body, {name: mask & body for name, mask in masks.items() if name in VENTRICLES}, remarks


def largest_piece(mask: Mask) -> Mask:
    """The largest face-connected piece of the mask."""
    pieces, n = ndimage.label(mask)
    return pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:]) if n else mask


def piece_at(mask: Mask, index: tuple[int, int, int]) -> Mask:
    """The face-connected piece of the mask with the element `index`."""
    pieces, _ = ndimage.label(mask)
    return (pieces == pieces[index]) & mask


def without_cavities(mask: Mask) -> Mask:
    """The mask with filled cavities: elements that are not face-connected to the outside."""
    outside = piece_at(np.pad(~mask, 1, constant_values=True), (0, 0, 0))
    return ~outside[1:-1, 1:-1, 1:-1]


def _mask(image: Image, name: str, numbers: Sequence[int]) -> Mask:
    missing = [str(n) for n in numbers if not (image.labels == n).any()]
    if missing:
        known = ", ".join(map(str, np.unique(image.labels[image.labels > 0])[:20]))
        remedy = f"leave it out, or name one of {known}"
        if len(missing) == len(numbers):  # without the key a default would take effect
            remedy = f"name one of {known}" + (f", or none: labels.{name} = []" if name in VENTRICLES else "")
        raise InputError(f"{image.path}: label {', '.join(missing)} (labels.{name}) is not in it; {remedy}")
    return np.isin(image.labels, numbers)


def _check_header_size(path: Path) -> None:
    """InputError if a NIfTI header claims a large offset of the voxels: nibabel would read all bytes before them."""
    if path.name.lower().endswith((".mgh", ".mgz")):
        return
    with gzip.open(path) if path.suffix.lower() == ".gz" else path.open("rb") as file:
        head = file.read(176)
    for order in "<>":
        for size, offset, kind in ((348, 108, "f"), (540, 168, "q")):  # NIfTI-1 and NIfTI-2
            if len(head) == 176 and struct.unpack_from(f"{order}i", head)[0] == size:
                before = struct.unpack_from(order + kind, head, offset)[0]
                if not 0 <= before <= _MAX_HEADER:
                    raise InputError(f"{path}: claims {before:g} bytes before its voxels; write it anew")


def _check_size(path: Path, image: Any) -> None:
    """InputError if a header claims more voxels than the file or the memory can hold."""
    n, kind = float(np.prod(image.shape, dtype=float)), image.get_data_dtype()
    packed = path.suffix.lower() in (".gz", ".mgz")
    if n * kind.itemsize > path.stat().st_size * (_MAX_INFLATION if packed else 1):
        raise InputError(f"{path}: claims {n:.3g} voxels and has {path.stat().st_size} bytes; write it anew")
    n_bytes = n * (2 * max(kind.itemsize, 8) + _VOXEL_BYTES)
    resources.check_memory(n_bytes, f"{path}: its {n:.3g} voxels", "cut it to the head")
