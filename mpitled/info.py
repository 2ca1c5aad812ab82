"""What mpitled works with: versions, what is missing and how to get it; and what a file of its own holds."""

from __future__ import annotations

import importlib.metadata
import platform
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from mpitled import __version__
from mpitled.errors import InputError, damaged

_MOST_LABELS = 200  # that are shown, a line each
_SETUP = "bash jobs/brain.sh sets it up, or see jobs/environment.sh"


class _Part(NamedTuple):
    """Something that is needed, or only useful."""

    name: str
    version: str | None  # None where it is missing
    purpose: str
    remedy: str
    needed: bool = True


def table() -> str:
    """Versions, a line each, then what is missing, what it is for and how to get it."""
    parts = _parts()
    lines = [f"{part.name:<12}{part.version or 'missing'}" for part in parts]
    for part in parts:
        if part.version is None:
            need = "needed" if part.needed else "useful"
            lines.append(f"{part.name} is missing, {need} for {part.purpose}: {part.remedy}")
    return "\n".join(lines)


def complete() -> bool:
    """Whether nothing is missing that a run on several ranks needs."""
    return not any(part.needed and part.version is None for part in _parts())


def versions() -> dict[str, str | None]:
    """Version of each part; None where it is missing."""
    return {part.name: part.version for part in _parts()}


def contents(path: Path) -> dict[str, Any]:
    """What a model, result, checkpoint, table or label image is and holds, as JSON can hold it, after it was read.

    InputError if it is none of these, or damaged. Of tables, which have no checksums, only the outlines are read.
    """
    from mpitled.meshing import label_image

    path = _file_of(path)
    if label_image.is_image(path):
        return {"kind": "image", "path": str(path), **label_image.contents(path)}
    if path.is_file() and (what := _elsewhere(path)):
        raise InputError(f"{path}: {what}")
    with damaged(path, "build the model anew, or run the deck again"):
        return _contents(path)


def _file_of(path: Path) -> Path:
    """A file, or of the folder of a run its result, or where there is none the model."""
    if not path.is_dir():
        return path
    there = (path / name for name in ("result.partial.vtkhdf", "result.vtkhdf", "model.h5"))
    found = next(filter(Path.exists, there), None)
    if found is None:
        raise InputError(f"{path}: is a folder without a result or a model; give a file, or the folder of a run")
    return found


def _elsewhere(path: Path) -> str:
    """What a file is that is read by another command or program, by its name, and where to turn; else nothing."""
    from mpitled.deck import OF_MESHES

    if path.name == "report.json":
        return f"is the report of a run: mpitled report {path.parent}"
    of_others = {".toml": f"is a deck: mpitled check {path}"}
    of_others |= dict.fromkeys(OF_MESHES, f"is a mesh: mpitled check {path}")
    of_others |= dict.fromkeys((".csv", ".md"), "is a table of text; open it in an editor or a spreadsheet")
    of_others |= dict.fromkeys((".png", ".html"), "is there to be looked at; open it in a viewer or a browser")
    return of_others.get(path.suffix.lower(), "")


def _contents(path: Path) -> dict[str, Any]:
    from mpitled import store

    if store.model_key(path) is not None:
        store.check_model(path)
        return {"kind": "model", "path": str(path), **store.model_contents(path)}
    if tables := store.table_contents(path):
        return {"kind": "table", "path": str(path), "tables": tables}
    if store.is_checkpoint(path):
        told = store.checkpoint_contents(path)
        names = ("version", "ranks", "step", "share", "frames")
        return {"kind": "checkpoint", "path": str(path)} | {name: told[name] for name in names}
    with store.open_result(path) as result:
        result.check()
        metadata, times = result.metadata, result.times
        n_hexahedra, last = len(result.hexahedra), float(times[-1]) if len(times) else 0.0
        solver = metadata.get("deck", {}).get("solver", {})
        relaxed = solver.get("method") == "dynamic-relaxation"  # whose times are shares of the load
        return {
            "kind": "result",
            "path": str(path),
            "complete": result.complete,
            "title": metadata["title"],
            "frames": result.n_frames,
            **({"load_share": last} if relaxed else {"time_s": last, "load_time_s": metadata["load_time_s"]}),
            "nodes": len(result.at_nodes("node_id")),
            "hexahedra": n_hexahedra,
            "support_domains": len(result.in_cells("cell_id")) - n_hexahedra,
            "ranks": metadata["ranks"],
            "versions": metadata["versions"],
        }


def describe(path: Path) -> str:
    """The same for people to read."""
    path = _file_of(path)
    has = contents(path)
    if has["kind"] == "model":
        from mpitled import store

        return f"{path}: a whole model of mpitled\n{store.describe_model(path)}"
    if has["kind"] == "image":
        volumes = has["labels_ml"].items()
        lines = [
            f"{path}: an image of {len(volumes)} labels",
            f"voxels           {' x '.join(map(str, has['voxels']))}",
            f"voxel            {' x '.join(f'{edge:.6g}' for edge in has['voxel_mm'])} mm",
            "extent           "
            + ", ".join(f"{axis} {low:.6g} to {high:.6g}" for axis, (low, high) in has["extent_mm"].items())
            + " mm, to the right, front and top",
            *(f"label            {label}: {ml:.3f} ml" for label, ml in list(volumes)[:_MOST_LABELS]),
        ]
        if len(volumes) > _MOST_LABELS:
            lines.append(f"{len(volumes) - _MOST_LABELS} more; so many may be intensities, and no labels")
        return "\n".join(lines)
    if has["kind"] == "table":
        lines = [f"{path}: tables of mpitled"]
        for name, told in has["tables"].items():
            lines.append(f"{name:<16} {told['rows']} rows of {', '.join(told['columns'])}")
        return "\n".join(lines)
    if has["kind"] == "checkpoint":
        lines = [
            f"{path}: a whole checkpoint of mpitled {has['version']}",
            f"step             {has['step']}, {has['share']:.1%} of the run",
            f"frames           {has['frames']}",
            f"ranks            {has['ranks']}",
        ]
        return "\n".join(lines)
    if "load_share" in has:
        reached = f"{has['load_share']:.1%} of the load"
    else:
        reached = f"{has['time_s']:g} s of {has['load_time_s']:g} s"
    lines = [
        f"{path}: {'a whole' if has['complete'] else 'an unfinished'} result of mpitled",
        f"title            {has['title']}",
        f"frames           {has['frames']}, to {reached}",
        f"nodes            {has['nodes']}",
        f"hexahedra        {has['hexahedra']}",
        f"support domains  {has['support_domains']}",
        f"ranks            {has['ranks']}",
        f"versions         {', '.join(f'{name} {version}' for name, version in has['versions'].items())}",
    ]
    return "\n".join(lines)


def _parts() -> list[_Part]:
    def package(name: str, purpose: str, extra: str = "", needed: bool = True) -> _Part:
        what = f"'mpitled[{extra}]'" if extra else f"'{name}'"
        return _Part(name, _installed(name), purpose, f"pip install {what}", needed)

    metis = _installed("pymetis")
    return [
        _Part("mpitled", __version__, "", ""),
        _Part("Python", platform.python_version(), "", ""),
        _Part("MPI", _asked(_mpi), "more than one rank", _SETUP),
        _Part("mpirun", shutil.which("mpirun"), "more than one rank", _SETUP),
        package("mpi4py", "more than one rank"),
        _Part("HDF5", _asked(_hdf5), "every file", _SETUP),
        _Part("HDF5 + MPI", _asked(_parallel_hdf5), "files of more than one rank (h5py built with MPI)", _SETUP),
        package("h5py", "every file"),
        _Part("METIS", metis and f"in pymetis {metis}", "more than one rank", "pip install 'pymetis'"),
        package("numba", "the kernels"),
        package("numpy", "everything"),
        package("scipy", "building models"),
        package("meshio", "meshes of other programs"),
        package("nibabel", "label images", "images", needed=False),
        package("matplotlib", "the report's pictures", "pictures", needed=False),
        package("argcomplete", "completion in the shell", "completion", needed=False),
        package("pandas", "tables in Python", "python", needed=False),
        package("pyvista", "3-D pictures and windows, meshes in Python", "pictures", needed=False),
        package("xarray", "arrays with names in Python", "python", needed=False),
        package("tqdm", "the progress bar", "progress", needed=False),
    ]


def _installed(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _asked(ask: Callable[[], str | None]) -> str | None:
    """What a library says of itself; None if it is not there, or cannot be loaded."""
    try:
        return ask()
    except (ImportError, OSError, RuntimeError) as error:
        package = (getattr(error, "name", None) or "").partition(".")[0]
        return None if package in ("", "mpi4py", "h5py") else f"not asked, for {package} is missing"


def _mpi() -> str:
    from mpitled.parallel.halo import library_version

    return library_version()


def _hdf5() -> str:
    from mpitled.store import hdf5_version

    return hdf5_version()


def _parallel_hdf5() -> str | None:
    from mpitled.store import has_mpi

    return "yes" if has_mpi() else None
