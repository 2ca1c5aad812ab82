"""Open HDF5 files for reading. `mpitled.store` and this module are the importers of h5py."""

from __future__ import annotations

from pathlib import Path

import h5py

from mpitled import hdf5_validation
from mpitled.errors import InputError, damaged


def open_file(path: Path) -> h5py.File:
    """An HDF5 file, open for reading. InputError if the file is missing or is not HDF5."""
    # No locks: every rank reads the same file, and network file systems often refuse locks.
    try:
        return h5py.File(path, "r", locking=False)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except OSError as error:
        reason = "it is cut short" if "truncated" in str(error) else str(error).splitlines()[0]
        raise InputError(f"{path}: cannot be read as HDF5 ({reason}); make it anew, or give another file") from None


def check_hdf5(path: Path) -> None:
    """InputError if another library cannot read the file safely, see `hdf5_validation`."""
    with open_file(path) as file, damaged(path, "write it anew"):
        hdf5_validation.check_file(file, path)
