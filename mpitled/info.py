"""`mpitled info`: versions of the libraries, what is missing and how to install it; the contents of a file."""

from __future__ import annotations

import importlib
import importlib.metadata
import platform
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from mpitled import __version__
from mpitled.errors import InputError, damaged

_MAX_LABELS = 200  # labels that are listed
_Description = tuple[str, list[tuple[str, str]]]  # heading; name and value of each line
_SETUP = "bash jobs/brain.sh sets it up, or see jobs/environment.sh"


class _Part(NamedTuple):
    """A library or a program."""

    name: str
    version: str | None  # None: missing
    purpose: str
    remedy: str
    needed: bool = True


def table() -> str:
    """The version of each part; for each missing part its purpose and the command that installs it."""
    parts = _parts()
    lines = [f"{part.name:<12}{part.version or 'missing'}" for part in parts]
    for part in parts:
        if part.version is None:
            need = "needed" if part.needed else "useful"
            lines.append(f"{part.name} is missing, {need} for {part.purpose}: {part.remedy}")
    return "\n".join(lines)


def complete() -> bool:
    """Whether all parts for runs on several ranks are installed."""
    return not any(part.needed and part.version is None for part in _parts())


def versions() -> dict[str, str | None]:
    """The version of each part; None if it is missing."""
    return {part.name: part.version for part in _parts()}


def contents(path: Path) -> dict[str, Any]:
    """The kind and contents of a model, result, checkpoint, table or label image, for JSON, after a check of all data.

    Tables have no checksums: only their structure is read. InputError for damaged files and for files of other kinds.
    """
    from mpitled.meshing import label_image

    path = _file_of(path)
    if label_image.is_image(path):
        return {"kind": "image", "path": str(path), **label_image.contents(path)}
    if path.is_file() and (redirection := _redirection(path)):
        raise InputError(f"{path}: {redirection}")
    with damaged(path, "build the model again, or run the deck again"):
        return _contents(path)


def _file_of(path: Path) -> Path:
    """The file itself; in the folder of a run its result, or its model if there is no result."""
    if not path.is_dir():
        return path
    candidates = (path / name for name in ("result.partial.vtkhdf", "result.vtkhdf", "model.h5"))
    file = next(filter(Path.exists, candidates), None)
    if file is None:
        raise InputError(f"{path}: is a folder without a result or a model; give a file, or the folder of a run")
    return file


def _redirection(path: Path) -> str:
    """The kind of a file that this command does not read, and the command or program that does; "" for other files."""
    from mpitled.deck import OF_MESHES

    if path.name == "report.json":
        return f"is the report of a run: mpitled report {path.parent}"
    kinds = {".toml": f"is a deck: mpitled check {path}"}
    kinds |= dict.fromkeys(OF_MESHES, f"is a mesh: mpitled check {path}")
    kinds |= dict.fromkeys((".csv", ".md"), "is a table of text; open it in an editor or a spreadsheet")
    kinds |= dict.fromkeys((".png", ".html"), "is a picture or a page; open it in a viewer or a browser")
    return kinds.get(path.suffix.lower(), "")


def _contents(path: Path) -> dict[str, Any]:
    from mpitled import store

    if store.model_key(path) is not None:
        store.check_model(path)
        return {"kind": "model", "path": str(path), **store.model_contents(path)}
    if tables := store.table_contents(path):
        return {"kind": "table", "path": str(path), "tables": tables}
    if store.is_checkpoint(path):
        checkpoint = store.checkpoint_contents(path)
        names = ("version", "ranks", "step", "share", "frames")
        return {"kind": "checkpoint", "path": str(path)} | {name: checkpoint[name] for name in names}
    with store.open_result(path) as result:
        result.check()
        metadata, times = result.metadata, result.times
        n_hexahedra, last = len(result.hexahedra), float(times[-1]) if len(times) else 0.0
        relaxed = metadata.get("deck", {}).get("solver", {}).get("method") == "dynamic-relaxation"
        reached = {"load_share": last} if relaxed else {"time_s": last, "load_time_s": metadata["load_time_s"]}
        return {
            "kind": "result",
            "path": str(path),
            "complete": result.complete,
            "title": metadata["title"],
            "frames": result.n_frames,
            **reached,
            "nodes": len(result.at_nodes("node_id")),
            "hexahedra": n_hexahedra,
            "support_domains": len(result.in_cells("cell_id")) - n_hexahedra,
            "ranks": metadata["ranks"],
            "versions": metadata["versions"],
        }


def describe(path: Path) -> str:
    """The contents of a file as text; errors as `contents`."""
    path = _file_of(path)
    figures = contents(path)
    heading, rows = _DESCRIPTIONS[figures["kind"]](figures)
    return "\n".join([f"{path}: {heading}", *(f"{name:<16} {value}" if name else value for name, value in rows)])


def _describe_model(figures: dict[str, Any]) -> _Description:
    from mpitled import store

    return "a whole model of mpitled", [("", store.describe_model(Path(figures["path"])))]


def _describe_image(figures: dict[str, Any]) -> _Description:
    volumes = figures["labels_ml"]
    extent = ", ".join(f"{axis} {low:.6g} to {high:.6g}" for axis, (low, high) in figures["extent_mm"].items())
    rows = [
        ("voxels", " x ".join(map(str, figures["voxels"]))),
        ("voxel", f"{' x '.join(f'{edge:.6g}' for edge in figures['voxel_mm'])} mm"),
        ("extent", f"{extent} mm, to the right, front and top"),
        *(("label", f"{label}: {ml:.3f} ml") for label, ml in list(volumes.items())[:_MAX_LABELS]),
    ]
    if len(volumes) > _MAX_LABELS:
        rows.append(("", f"{len(volumes) - _MAX_LABELS} more; the image may hold intensities instead of labels"))
    return f"an image of {len(volumes)} labels", rows


def _describe_table(figures: dict[str, Any]) -> _Description:
    tables = figures["tables"].items()
    return "tables of mpitled", [(name, f"{of['rows']} rows of {', '.join(of['columns'])}") for name, of in tables]


def _describe_checkpoint(figures: dict[str, Any]) -> _Description:
    rows = [("step", f"{figures['step']}, {figures['share']:.1%} of the run")]
    rows += [(name, str(figures[name])) for name in ("frames", "ranks")]
    return f"a whole checkpoint of mpitled {figures['version']}", rows


def _describe_result(figures: dict[str, Any]) -> _Description:
    if "load_share" in figures:
        reached = f"{figures['load_share']:.1%} of the load"
    else:
        reached = f"{figures['time_s']:g} s of {figures['load_time_s']:g} s"
    rows = [("title", figures["title"]), ("frames", f"{figures['frames']}, to {reached}")]
    names = ("nodes", "hexahedra", "support_domains", "ranks")
    rows += [(name.replace("_", " "), str(figures[name])) for name in names]
    rows.append(("versions", ", ".join(f"{name} {version}" for name, version in figures["versions"].items())))
    return f"{'a whole' if figures['complete'] else 'an unfinished'} result of mpitled", rows


_DESCRIPTIONS: dict[str, Callable[[dict[str, Any]], _Description]] = {
    "model": _describe_model,
    "image": _describe_image,
    "table": _describe_table,
    "checkpoint": _describe_checkpoint,
    "result": _describe_result,
}


def _parts() -> list[_Part]:
    def package(name: str, purpose: str, extra: str = "", needed: bool = True) -> _Part:
        target = f"'mpitled[{extra}]'" if extra else f"'{name}'"
        return _Part(name, _installed(name), purpose, f"pip install {target}", needed)

    metis = _installed("pymetis")
    parallel = _reported("mpitled.store", "has_mpi")
    parallel = {"True": "yes", "False": None}.get(str(parallel), parallel)
    return [
        _Part("mpitled", __version__, "", ""),
        _Part("Python", platform.python_version(), "", ""),
        _Part("MPI", _reported("mpitled.parallel.halo", "library_version"), "more than one rank", _SETUP),
        _Part("mpirun", shutil.which("mpirun"), "more than one rank", _SETUP),
        package("mpi4py", "more than one rank"),
        _Part("HDF5", _reported("mpitled.store", "hdf5_version"), "every file", _SETUP),
        _Part("HDF5 + MPI", parallel, "files of more than one rank (h5py built with MPI)", _SETUP),
        package("h5py", "every file"),
        _Part("METIS", metis and f"in pymetis {metis}", "more than one rank", "pip install 'pymetis'"),
        package("numba", "the kernels"),
        package("numpy", "everything"),
        package("scipy", "building models"),
        package("pydantic", "decks"),
        package("rich", "tables and progress of sweeps"),
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


def _reported(module: str, function: str) -> str | None:
    """The version of a library from a function of this program; None if the library is missing or cannot be loaded."""
    try:
        return str(getattr(importlib.import_module(module), function)())
    except (ImportError, OSError, RuntimeError) as error:
        package = (getattr(error, "name", None) or "").partition(".")[0]
        return None if package in ("", "mpi4py", "h5py") else f"unknown, because {package} is missing"
