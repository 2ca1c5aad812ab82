"""File layouts of tables: results of many runs, and grids of integration points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpitled import hdf5_validation
from mpitled.errors import damaged
from mpitled.hdf5 import open_file
from mpitled.store.files import replacing


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
