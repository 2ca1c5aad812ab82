"""File layouts of tables: results of many runs, and grids of integration points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mpitled import hdf5_validation, resources
from mpitled.errors import InputError, damaged
from mpitled.store.files import open_file, replacing


def write_columns(path: Path, groups: Mapping[str, Mapping[str, Sequence[float | str]]]) -> None:
    """Write tables of columns, one group each, atomically. A column with any text is a column of text.

    InputError if the file cannot be written.
    """
    with replacing(path) as temporary, h5py.File(temporary, "w", locking=False) as file:
        for name, columns in groups.items():
            group = file.create_group(name, track_order=True)
            for column, values in columns.items():
                text = any(isinstance(value, str) for value in values)
                data: Any = [str(value) for value in values] if text else np.asarray(values, np.float64)
                group.create_dataset(column, data=data, dtype=h5py.string_dtype() if text else None)


def table_contents(path: Path) -> dict[str, dict[str, Any]]:
    """Names of columns and number of rows of each table, by name; empty if the file holds other objects than tables.

    InputError if the file is not valid HDF5.
    """
    with open_file(path) as file, damaged(path, "make it anew"):
        hdf5_validation.check_file(file, path)
        tables = {}
        for name, group in file.items():
            columns = dict(group) if isinstance(group, h5py.Group) else {}
            if not all(isinstance(item, h5py.Dataset) and len(item.shape or ()) == 1 for item in columns.values()):
                return {}
            lengths = {len(item) for item in columns.values()}
            if len(lengths) != 1:
                return {}
            tables[name] = {"columns": list(columns), "rows": lengths.pop()}
        return tables


def read_grid(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions (n, 3) and volumes (n,) of integration points: datasets x, y, z, volume in the root group."""
    with open_file(path) as file, damaged(path, "write it anew"):
        names = ("x", "y", "z", "volume")
        if missing := [name for name in names if name not in file]:
            raise InputError(f"{path}: has no dataset '{missing[0]}'; give x, y, z and volume")
        given = [hdf5_validation.member(file, name, path) for name in names]
        kinds = {item.dtype.kind if isinstance(item, h5py.Dataset) else "" for item in given}
        if not kinds <= set("fiu") or {len(item.shape or ()) for item in given} != {1} or len({*map(len, given)}) > 1:
            raise InputError(f"{path}: x, y, z and volume are not four lists of as many numbers; correct them")
        for item in given:
            hdf5_validation.check_dataset(item, path)
        # Compressed data may be a thousand times as large as the file.
        resources.check_memory(32 * len(given[0]), f"{path}: its {len(given[0])} points", "give fewer")
        columns = [item[...].astype(np.float64) for item in given]
    return np.stack(columns[:3], axis=1), columns[3]
