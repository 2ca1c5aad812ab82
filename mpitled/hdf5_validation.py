"""Validation of untrusted HDF5 files before reading any data.

HDF5 follows links and external storage into other files, and allocates the memory that a file claims to need.
Therefore every link must be a hard link, every dataset must be stored in the file, and no dataset may claim more data
than its stored bytes can hold.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from mpitled.errors import InputError

#: Largest number of objects in a file; files of mpitled have fewer than 100.
MAX_OBJECTS = 10_000
#: Largest compression ratio of deflate, the strongest of the filters.
_MAX_RATIO = 1032
_HARD = 0  # H5L_TYPE_HARD
#: Filters of HDF5 and h5py: deflate, shuffle, fletcher32, szip, nbit, scale-offset, LZF.
_FILTERS = {1, 2, 3, 4, 5, 6, 32000}


def check_file(file: Any, path: Path, *, numbers: bool = False) -> None:
    """InputError unless every object of an open h5py.File is valid; `numbers`: fixed-length numbers and text only."""
    free_bytes, todo, seen = path.stat().st_size, [file["/"]], {file["/"]}
    n_objects = 0
    while todo:
        group = todo.pop()
        for name in group:
            n_objects += 1
            if n_objects > MAX_OBJECTS:
                raise InputError(f"{path}: has more than {MAX_OBJECTS} objects; it is not read")
            item = member(group, name, path)
            if item in seen:
                continue
            seen.add(item)
            if hasattr(item, "keys"):
                todo.append(item)
            elif hasattr(item, "shape"):
                free_bytes -= check_dataset(item, path)
                if numbers and item.dtype.kind not in "fiuSb":
                    raise InputError(
                        f"{path}: {item.name} holds other than numbers and text of fixed length; it is not read"
                    )
    # Datasets can share storage: each is at most as large as the file, but their sum is larger.
    if free_bytes < 0:
        raise InputError(f"{path}: claims to hold more than its {path.stat().st_size} bytes; write it anew")


def member(group: Any, name: str, path: Path) -> Any:
    """A group or dataset in a group. InputError unless its link is a hard link."""
    if group.id.links.get_info(name.encode()).type != _HARD:
        raise InputError(f"{path}: {name} is a link that leads elsewhere; it is not followed: copy the data in")
    return group[name]


def check_dataset(dataset: Any, path: Path) -> int:
    """Stored bytes of a dataset.

    InputError if the data are in another file, need an unknown filter, or claim to be larger than these bytes can hold.
    """
    if dataset.is_virtual or dataset.external:
        raise InputError(f"{path}: the data of {dataset.name} are in another file; it is not read: copy them in")
    properties, stored = dataset.id.get_create_plist(), dataset.id.get_storage_size()
    filters = {properties.get_filter(i)[0] for i in range(properties.get_nfilters())}
    if not filters <= _FILTERS:
        raise InputError(f"{path}: {dataset.name} is packed by a filter that is not known; write it without")
    if dataset.shape is None:  # an empty dataset
        return int(stored)
    claimed = math.prod(dataset.shape, start=dataset.dtype.itemsize)
    chunk = math.prod(dataset.chunks, start=dataset.dtype.itemsize) if dataset.chunks else 0
    limit = stored * (_MAX_RATIO if filters - {2, 3} else 1)
    if stored > path.stat().st_size or claimed > limit or (filters and claimed and chunk > limit):
        raise InputError(f"{path}: {dataset.name} claims {claimed} bytes, and {stored} are there; write the file anew")
    return int(stored)
