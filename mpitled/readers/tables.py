"""Tables: integration points (CSV or HDF5), areas of the outer surface (CSV) and displacements at points (CSV)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mpitled import hdf5_validation, resources
from mpitled.errors import InputError, damaged
from mpitled.hdf5 import open_file
from mpitled.mesh import Floats, Ints
from mpitled.readers import meshfile
from mpitled.readers.text import Block, decode, read_text, separated, where


def read_grid(path: Path) -> tuple[Floats, Floats, dict[str, Ints]]:
    """Points (n, 3), volumes (n,) and sets of integration points, in the file's units, from CSV or HDF5.

    CSV has a line for each point: x, y, z, volume and, optionally, the names of the point's sets, separated by
    semicolons. The first line may be the names of the columns. InputError if a volume is not positive.
    """
    if path.suffix.lower() in (".h5", ".hdf5", ".hdf"):
        points, volumes = _read_hdf5(path)
        sets: dict[str, Ints] = {}
        first = None
    else:
        points, volumes, sets, first = _read_csv(path)
    if not len(points):
        raise InputError(f"{path}: has no integration points; give lines of x, y, z, volume")
    bad = np.flatnonzero(
        ~(
            (volumes > 0)
            & (volumes < meshfile.MAX_COORDINATE**3)
            & (np.abs(points) < meshfile.MAX_COORDINATE).all(axis=1)
        )
    )
    if len(bad):
        position = f"line {first + bad[0]}" if first is not None else f"row {bad[0] + 1}"
        raise InputError(
            f"{path}: {position}: an integration point needs finite x, y, z and a positive volume ({len(bad)} such)"
        )
    return points, volumes, sets


def read_areas(path: Path, metre: float, ids: Ints) -> Floats:
    """Areas (n_nodes, 3), m^2, from a table of node, x, y, z; 0 for nodes without a line."""
    rows, first = _read_table(path, ("node", "x", "y", "z"))
    numbering = meshfile.Numbering(ids)
    if (np.diff(numbering.ids) == 0).any():
        raise InputError(f"{path}: some nodes of the FE and the EFG file have the same number; renumber those of one")
    at, found = numbering.rows(meshfile.as_ids(rows[:, 0], "node", str(path)))
    if not found.all():
        line = first + int(np.argmax(~found))
        raise InputError(f"{path}: line {line}: there is no such node ({np.count_nonzero(~found)} such); correct it")
    areas = np.zeros((len(ids), 3))
    areas[at] = rows[:, 1:] * metre**2
    return areas


def read_field(path: Path) -> tuple[Floats, int]:
    """Rows (n, 6) of x, y, z, ux, uy, uz in the file's unit, and the line of the first row."""
    rows, first = _read_table(path, ("x", "y", "z", "ux", "uy", "uz"))
    bad = np.flatnonzero(~(np.abs(rows) < meshfile.MAX_COORDINATE).all(axis=1))
    if len(bad):
        raise InputError(
            f"{path}: line {first + bad[0]}: a number is beyond {meshfile.MAX_COORDINATE:g} ({len(bad)} such)"
        )
    return rows, first


def _read_table(path: Path, names: tuple[str, ...]) -> tuple[Floats, int]:
    """Numbers (n, len(names)) of a CSV file, and the line of the first row; the first line may be the names."""
    text = read_text(path, f"a table of {', '.join(names)} (CSV)")
    end = text.find(b"\n") + 1 or len(text)
    header = [name.strip().casefold() for name in decode(text[:end]).split(",")]
    named = header == list(names)
    block = Block(path, 1 + named, text, end if named else 0, len(text))
    return _rows_of(block, len(names), ", ".join(names)), 1 + named


def _rows_of(block: Block, width: int, names: str) -> Floats:
    values, counts = separated(block, float, "#")
    if (counts != width).any():
        row = int(np.argmax(counts != width))
        raise InputError(
            f"{block.path}: line {block.line + row}: has {counts[row]} numbers; give {names} "
            f"({np.count_nonzero(counts != width)} such)"
        )
    return values.reshape(-1, width)


def _read_hdf5(path: Path) -> tuple[Floats, Floats]:
    """Positions (n, 3) and volumes (n,) from the datasets x, y, z and volume of the root group."""
    names = ("x", "y", "z", "volume")
    with open_file(path) as file, damaged(path, "write it anew"):
        if missing := [name for name in names if name not in file]:
            raise InputError(f"{path}: has no dataset '{missing[0]}'; give x, y, z and volume")
        datasets = [hdf5_validation.member(file, name, path) for name in names]
        shapes = {getattr(item, "shape", None) for item in datasets}
        kinds = {item.dtype.kind for item in datasets if hasattr(item, "dtype")}
        if len(shapes) > 1 or len(shapes.pop() or ()) != 1 or not kinds <= set("fiu"):
            raise InputError(f"{path}: x, y, z and volume are not four lists of as many numbers; correct them")
        for item in datasets:
            hdf5_validation.check_dataset(item, path)
        # Compressed data may be a thousand times as large as the file.
        resources.check_memory(32 * len(datasets[0]), f"{path}: its {len(datasets[0])} points", "give fewer")
        columns = [item[...].astype(np.float64) for item in datasets]
    return np.stack(columns[:3], axis=1), columns[3]


def _read_csv(path: Path) -> tuple[Floats, Floats, dict[str, Ints], int]:
    text = read_text(path, "a table of integration points (CSV)")
    end = text.find(b"\n") + 1 or len(text)
    header = [name.strip().strip('"').casefold() for name in decode(text[:end]).strip().split(",")]
    start, named = (end, True) if any(name[:1].isalpha() for name in header) else (0, False)
    if named and (header[:4] not in (["x", "y", "z", "volume"], ["x", "y", "z", "v"]) or len(header) > 5):
        raise InputError(f"{path}: line 1: the columns are {', '.join(header)[:60]}; give x, y, z, volume and sets")
    block = Block(path, 1 + named, text, start, len(text))
    names: list[str] = []
    if len(header) > 4:
        block, names = _split_sets(block)
    rows = _rows_of(block, 4, "x, y, z, volume")
    sets: dict[str, Ints] = {}
    if names:
        groups, group = np.unique(np.array(names), return_inverse=True)
        for i, set_names in enumerate(groups.tolist()):
            members = np.flatnonzero(group == i)
            for name in filter(None, (part.strip() for part in set_names.split(";"))):
                meshfile.extend_set(sets, name, members)
    return rows[:, :3].copy(), rows[:, 3].copy(), sets, 1 + named


def _split_sets(block: Block) -> tuple[Block, list[str]]:
    """The columns of numbers, and the last column: the names of sets."""
    numbers, names = [], []
    for line, text in block.lines("#"):
        fields = text.split(",", 4)
        if len(fields) < 4:
            raise InputError(f"{where(block.path, line)}: has {len(fields)} fields; give x, y, z, volume, sets")
        numbers.append(",".join(fields[:4]))
        names.append(fields[4].strip().strip('"') if len(fields) > 4 else "")
    return Block.of(block.path, block.line, "\n".join(numbers).encode()), names
