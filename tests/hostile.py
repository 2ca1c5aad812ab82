"""Hostile input: valid files of every format, random changes of these files, and their readers."""

from __future__ import annotations

import gzip
import io
import random
import re
import shutil
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from decks import KINDS, void_decks

from mpitled.deck import keys
from mpitled.errors import InputError

_NASTY = [
    "", "-", "1e", "1e999", "-1e308", "nan", "inf", "0x10", "1_0", "1.0-3", "1.0D+2", "999999999999999999", "1e18",
    "-5", "0", "2147483648", "9" * 400, "1.5", '"', ",", "*", "**", "$", "&x", "\t", "\x00", "é", "  ", "1 2", "+",
    "1000000000000", "../../../tmp/out", "/dev/zero", "true", "[]", "[[[[", "{}", "1e-300",
]  # fmt: skip
#: Values of a deck in valid syntax.
_VALUES = [
    "0", "-1", "1", "2", "100000", "2147483647", "1e-300", "1e-9", "1e-3", "0.5", "1.0", "1e6", "1e15", "1e300", "inf",
    "nan", "true", '""', '"x"', '"../../x"', '"x0"', '"all"', '"core"', '"none"', '"dynamic"', "[]", "[1]", "[[1]]",
    "[1e9, 1e9, 1e9]", "[100000, 100000, 100000]", "[2147483647, 1, 1]", "[0.0, 0.0, 0.0]", "[1e-6, 1e3, 1e12]",
    "[-1.0, 2.0, 3.0]", '["x", "y"]', '["x0", "x1"]', "{}", "{a = 1}", "0x" + "f" * 5000, "9" * 400,
    "1979-05-27", "[" * 2000 + "]" * 2000,
]  # fmt: skip
_KEYS = sorted({name.partition(".")[2] for name in keys()})
_WORDS = [0, 1, 2**31 - 1, 2**31, 2**32 - 1, 10**12, 2**63 - 1, 2**63, 2**64 - 1]


@dataclass(frozen=True, slots=True)
class Reader:
    """A reader and valid inputs; an input is a set of files, and the reader gets the first of them."""

    read: Callable[[Path], object]
    inputs: Mapping[str, Mapping[str, bytes]]
    #: Suffix of a file -> functions that unpack the file before the change and pack it afterwards.
    inside: Mapping[str, tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]] = field(default_factory=dict)


def attempt(reader: Reader, folder: Path, rng: random.Random) -> str:
    """Change one input and read it. Returns "result" or "error" (a one-line InputError); raises for a fault."""
    files = reader.inputs[rng.choice(list(reader.inputs))]
    victim = rng.choice(list(files))
    written = set()
    try:
        for name, data in files.items():
            path = folder / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(broken(reader, name, data, rng) if name == victim else data)
            written.add(path)
        try:
            reader.read(folder / next(iter(files)))
        except InputError as error:
            if "\n" in str(error) or not str(error):
                raise AssertionError(f"a message that is not one line: {error!r}") from None
            return "error"
        if left := {path for path in folder.rglob("*") if path.is_file()} - written:
            raise AssertionError(f"left {', '.join(map(str, left))}")
        return "result"
    finally:
        for path in folder.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def broken(reader: Reader, name: str, data: bytes, rng: random.Random) -> bytes:
    """The file with one to six changes of its unpacked content."""
    if name.endswith((".h5", ".vtkhdf")) and rng.random() < 0.6:
        return _broken_hdf5(data, rng)
    if name.endswith(".toml") and rng.random() < 0.7:
        return _broken_deck(data, rng)
    opened, closed = next((pair for end, pair in reader.inside.items() if name.endswith(end)), (bytes, bytes))
    if rng.random() < 0.1:
        opened, closed = bytes, bytes
    data = opened(data)
    for _ in range(rng.choice([1, 1, 1, 2, 3, 6])):
        data = _text_change(data, rng) if _is_text(data) else _binary_change(data, rng)
    return closed(data)


def _broken_deck(data: bytes, rng: random.Random) -> bytes:
    """One to four changed values, or inserted keys of another section."""
    lines = data.decode().split("\n")
    for _ in range(rng.choice([1, 1, 2, 4])):
        at = rng.choice([i for i, line in enumerate(lines) if " = " in line])
        key, _, _ = lines[at].partition(" = ")
        if rng.random() < 0.3:
            home = rng.choice([i for i, line in enumerate(lines) if line.startswith("[")] or [0])
            lines.insert(home + 1, f"{rng.choice(_KEYS)} = {rng.choice(_VALUES)}")
        else:
            lines[at] = f"{key} = {rng.choice(_VALUES)}"
    return "\n".join(lines).encode()


def _is_text(data: bytes) -> bool:
    return b"\0" not in data[:4096]


def _text_change(data: bytes, rng: random.Random) -> bytes:
    """Removed or changed bytes, swapped, removed or repeated lines, invalid numbers, or a missing end."""
    lines = data.split(b"\n")
    kind = rng.randrange(10)
    at = rng.randrange(len(data)) if data else 0
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    if kind == 0:
        return data[:at] + data[at + rng.randint(1, 12) :]
    if kind == 1 and data:
        return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
    if kind == 2:
        lines[i], lines[j] = lines[j], lines[i]
        return b"\n".join(lines)
    if kind == 3:
        return b"\n".join(lines[:i] + lines[i + 1 :])
    if kind == 4:
        return b"\n".join([*lines[:i], lines[j], *lines[i:]])
    if kind in (5, 6, 7):
        found = list(re.finditer(rb"[\w.+-]+", data))
        if not found:
            return data
        word = rng.choice(found)
        return data[: word.start()] + rng.choice(_NASTY).encode() + data[word.end() :]
    if kind == 8:
        return data[:at]
    return data.replace(b"\n", rng.choice([b"\r\n", b"\r", b"\n\n", b",\n"]), rng.randint(1, 20))


def _binary_change(data: bytes, rng: random.Random) -> bytes:
    """Changed bytes or words of two to eight bytes, removed or repeated pieces, or a missing end; often in the head."""
    end = len(data) if rng.random() < 0.5 else min(len(data), 2048)
    at, kind = rng.randrange(max(end, 1)), rng.randrange(7)
    if kind == 0:
        return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
    if kind in (1, 2, 3):
        size = rng.choice([2, 4, 8])
        at -= at % size if kind < 3 else 0
        word = rng.choice(_WORDS) % 2 ** (8 * size)
        return data[:at] + word.to_bytes(size, rng.choice(["little", "little", "big"])) + data[at + size :]
    if kind == 4:
        return data[:at]
    if kind == 5:
        return data[:at] + data[at + rng.randint(1, 64) :]
    return data[:at] + data[at - min(at, 64) : at] + data[at:]


def _broken_hdf5(data: bytes, rng: random.Random) -> bytes:
    """A valid HDF5 file with changed values, shapes, types, links, claimed sizes or attributes."""
    image = io.BytesIO(data)
    with h5py.File(image, "r+") as file:
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        name = rng.choice(names)
        old, kind = file[name], rng.randrange(12)
        values = old[()]
        if kind in (0, 1, 2) and old.size and old.dtype.kind in "iuf":
            flat = np.array(values).ravel()
            for _ in range(rng.choice([1, 1, len(flat)])):
                odd = rng.choice([-1, 0, 2**31 - 1, -(2**63), 2**63 - 1, float("nan"), float("inf"), 1e300])
                with np.errstate(all="ignore"):
                    flat[rng.randrange(len(flat))] = np.array(odd).astype(flat.dtype)
            old[...] = flat.reshape(old.shape)
        elif kind in (0, 1, 2) and old.dtype.kind == "S":
            del file[name]
            file[name] = np.bytes_(_text_change(bytes(values), rng) or b" ")
        elif kind == 3:
            del file[name]
        elif kind == 4:
            del file[name]
            file[name] = rng.choice([0, 1.5, "text", np.zeros((0, 3)), np.zeros((3, 3, 3, 3)), np.arange(7)])
        elif kind == 5:
            del file[name]
            file[name] = np.concatenate([np.atleast_1d(values)] * 2)[
                : rng.randrange(1, 2 * max(1, len(np.atleast_1d(values))))
            ]
        elif kind == 6:
            del file[name]
            file[name] = rng.choice(
                [h5py.SoftLink("/points"), h5py.ExternalLink("/etc/passwd", "/x"), h5py.SoftLink(name)]
            )
        elif kind == 7:  # a claimed size without data
            del file[name]
            chunks = rng.choice([None, (1 << 20,)])
            packed = {"compression": "gzip"} if chunks and rng.random() < 0.5 else {}
            file.create_dataset(
                name, (10**12,), values.dtype if values.dtype.kind != "S" else "u1", chunks=chunks, **packed
            )
        elif kind == 8:
            del file[name]
            file.create_dataset(name, (5,), "f8", external=[("/etc/passwd", 0, 40)])
        elif kind == 9:
            layout = h5py.VirtualLayout((10**9, 3), "f8")
            layout[:5] = h5py.VirtualSource("/etc/passwd", "x", (5, 3))
            del file[name]
            file.create_virtual_dataset(name, layout)
        elif kind == 10:
            holder = rng.choice([file, old.parent])
            for key in list(holder.attrs):
                if rng.random() < 0.5:
                    holder.attrs[key] = rng.choice([-1, 10**12, "x", np.zeros(3), np.nan])
        else:
            del file[name]
            file.create_dataset(name, data=["a", "b"], dtype=h5py.string_dtype())
    return image.getvalue()


# --- readers --------------------------------------------------------------------------------------------------------


def _rezip(change: Callable[[bytes], bytes]) -> tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]:
    """Change the largest member of a .npz, with correct checksums."""
    kept: dict[str, bytes] = {}

    def opened(data: bytes) -> bytes:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            kept.update({name: archive.read(name) for name in archive.namelist()})
        return change(kept[max(kept, key=lambda name: len(kept[name]))])

    def closed(data: bytes) -> bytes:
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            largest = max(kept, key=lambda name: len(kept[name]))
            for name, content in kept.items():
                archive.writestr(name, data if name == largest else content)
        return packed.getvalue()

    return opened, closed


_BRAIN = "[material.brain]\nyoungs_modulus = 3000.0\npoissons_ratio = 0.49\n"
_SCENES = {
    "block": '[block]\nsize = [20.0, 20.0, 20.0]\nelements = [4, 4, 4]\nfitted = "ball"\n'
    '[sphere.ball]\ncentre = [10.0, 10.0, 10.0]\nradius = 4.0\n[[fixed]]\nnodes = "x0"\n'
    '[[displaced]]\nnodes = "x1"\ndisplacement = [0.1, 0.0, 0.0]\nrotation = 5.0\n' + _BRAIN,
    "cloud": '[block]\nsize = [20.0, 20.0, 20.0]\nelements = [5, 5, 5]\ncloud = "core"\n[support]\nnodes = 8\n'
    '[[fixed]]\nnodes = "x0"\ndirections = ["x"]\n[solver]\nmethod = "dynamic"\nload_time = 1.0\n[output]\nframes = 2\n'
    + _BRAIN,
    "tumour": "[ellipsoid]\nsemi_axes = [32.0, 26.0, 24.0]\nelement_size = 8.0\n"
    "[tumour]\ncentre = [6.0, 0.0, 3.0]\nvolume = 113.1\nsurface_nodes = 50\n"
    '[[fixed]]\nnodes = "surface"\n[solver]\nmethod = "dynamic-relaxation"\n' + _BRAIN,
    "cylinder": '[cylinder]\nradius = 20.0\nheight = 20.0\nelement_size = 8.0\ncloud = "core"\n'
    '[cloud]\nspacing = 6.0\n[[fixed]]\nnodes = "bottom"\n' + _BRAIN,
}  # fmt: skip
_HEAD = '[labels]\nimage = "head.nii.gz"\nelement_size = 4.0\n[[fixed]]\nnodes = "skull"\n' + _BRAIN


def readers(scratch: Path) -> dict[str, Reader]:
    """All readers by name; `scratch` is a folder for computed inputs."""
    from mpitled.batch import cases, vary
    from mpitled.preview import overview

    decks = {name: {file: text.encode() for file, text in files.items()} for name, files in KINDS.items()}
    void = {name: text.encode() for name, text in void_decks().items()}
    mixed = {"scene.toml": void["scene.toml"], **void}
    scenes = {name: {"scene.toml": text.encode()} for name, text in _SCENES.items()}
    numbers = np.random.default_rng(0).uniform(0, 0.02, (30, 6))
    table = "x,y,z,ux,uy,uz\n" + "".join(",".join(map(repr, row)) + "\n" for row in numbers.tolist())
    run, model, result, kept = _run(scratch)
    unpack = {".gz": (gzip.decompress, gzip.compress), ".npz": _rezip(bytes)}
    planned = cases.plan(
        scratch / "run.toml",
        [vary.Values({"solver.load_time": "1.0"})],
        ["output.pictures=false"],
        1,
        scratch / "sweep",
    )
    planned.write_manifest()
    sweep = (scratch / "sweep" / cases.MANIFEST).read_bytes()
    return {
        "Abaqus decks": Reader(overview.check, {k: v for k, v in decks.items() if "dyna" not in k}),
        "LS-DYNA decks": Reader(overview.check, {k: v for k, v in decks.items() if "dyna" in k}),
        "decks of a mixed mesh": Reader(overview.check, {"mixed": mixed}),
        "gmsh, VTK and others": Reader(overview.check, _meshio_files(scratch)),
        "deck (TOML)": Reader(_build, scenes),
        "deck, with the time it takes": Reader(overview.check, {k: v for k, v in scenes.items() if k != "cloud"}),
        "label image": Reader(_build, {"head": {"scene.toml": _HEAD.encode(), "head.nii.gz": _head()}}, unpack),
        "integration points (CSV)": Reader(_points, {"grid": {"grid.csv": void["grid.csv"]}}),
        "integration points (HDF5)": Reader(_points, {"grid": {"grid.h5": _grid_hdf5()}}),
        "surface areas (CSV)": Reader(_areas, {"areas": {"areas.csv": b"node,x,y,z\n1,0.5,0.0,0.0\n3,0.0,1e-4,2.0\n"}}),
        "displacements (CSV)": Reader(_field, {"field": {"field.csv": table.encode()}}),
        "cases (CSV)": Reader(
            vary.table, {"cases": {"c.csv": b'solver.load_time,block.elements\n1.0,"[4,4,4]"\n2,\n'}}
        ),
        "sweep.json": Reader(lambda path: cases.read(path.parent), {"sweep": {"sweep.json": sweep}}),
        "reference (npz)": Reader(_reference(run), {"npz": {"r.npz": _npz()}}, unpack),
        "reference (CSV)": Reader(_reference(run), {"csv": {"r.csv": table.encode()}}),
        "reference (vtu)": Reader(_reference(run), {"vtu": {"r.vtu": _vtu(scratch)}}),
        "model.h5": Reader(_model, {"model": {"model.h5": model}}),
        "checkpoint.h5": Reader(_checkpoint, {"checkpoint": {"checkpoint.h5": kept}}),
        "result.vtkhdf": Reader(_result, {"result": {"result.vtkhdf": result, "model.h5": model}}),
    }


def _build(path: Path) -> object:
    from mpitled.deck import load_deck
    from mpitled.model import build as model_build

    return model_build.build(load_deck(path))


def _points(path: Path) -> object:
    from mpitled.readers import tables

    return tables.read_grid(path)


def _areas(path: Path) -> object:
    from mpitled.readers import tables

    return tables.read_areas(path, 1.0, np.arange(1, 5))


def _field(path: Path) -> object:
    from mpitled.model.mapping import carry_over

    return carry_over(path, 1.0, np.full((3, 3), 0.01), "nodes")


def _reference(run: Path) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        from mpitled.results import compare

        return compare.compare(run, path)

    return read


def _model(path: Path) -> object:
    """Read a model completely, make the arrays of a rank, and call each kernel once."""
    from mpitled import info, store
    from mpitled.deck import Solver
    from mpitled.parallel.halo import World
    from mpitled.parallel.subdomain import localise
    from mpitled.solver.integrators import make_integrator
    from mpitled.terms import Scene

    info.contents(path)
    store.read_model(path)
    store.read_scene(path)
    store.read_blocks(path)
    for part in range(2):
        if store.has_partition(path, 2):
            localise(store.read_part(path, 2, part), 0.004, 0.1, "mean")
    sub = localise(store.read_part(path, 1, 0), 0.004, 0.1, "mean")
    with np.errstate(all="ignore"):
        solver = Solver(method="dynamic")
        integrator = make_integrator(Scene(sub, solver), 1, World(), store.read_figures(path))
        integrator.warm_up()
    return integrator


def _checkpoint(path: Path) -> object:
    from mpitled import info, store

    info.contents(path)
    return store.checkpoint_contents(path), store.read_checkpoint(path, np.arange(50))


def _result(path: Path) -> object:
    from mpitled import info
    from mpitled.results import field, final_state, report

    info.contents(path)
    with np.errstate(all="ignore"):
        report.compute(final_state.read(path.parent))
    return field.open_field(path)


# --- valid files ---------------------------------------------------------------------------------------------------


def _run(scratch: Path) -> tuple[Path, bytes, bytes, bytes]:
    """The folder of a small run, and its model (with a partition for two ranks), result and checkpoint."""
    from mpitled import job, store
    from mpitled.deck import load_deck
    from mpitled.parallel.halo import World

    deck, folder = scratch / "run.toml", scratch / "run"
    deck.write_text(_SCENES["cloud"])
    if not (folder / "result.vtkhdf").exists():
        job.run(load_deck(deck, ("output.pictures=false", "solver.load_time=0.05")), folder, World(), quiet=True)
        job.ensure_partition(folder / job.MODEL, 2, 0)
        rows = store.read_part(folder / job.MODEL, 1, 0)
        record = {"version": "0", "ranks": 1, "step": 3, "share": 0.1, "frames": 1}
        store.write_checkpoint(scratch, None, rows, record, {"u": np.zeros((rows.n_nodes, 3))}, [0.5, 1.0])
    files = (folder / job.MODEL, folder / "result.vtkhdf", scratch / store.CHECKPOINTS[0])
    model, result, kept = (path.read_bytes() for path in files)
    return folder, model, result, kept


def _cubes() -> Any:
    """Two hexahedra with sets, as a mesh of meshio."""
    import meshio

    points = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1, 2)], float)
    cells = np.array([[0, 1, 4, 3, 6, 7, 10, 9], [1, 2, 5, 4, 7, 8, 11, 10]])
    tags = {name: [np.array([1, 2], np.int32)] for name in ("gmsh:physical", "gmsh:geometrical")}
    return meshio.Mesh(points, [("hexahedron", cells)], cell_data=tags)


def _meshio_files(scratch: Path) -> dict[str, dict[str, bytes]]:
    forms = {
        "gmsh.msh": {"file_format": "gmsh", "binary": True}, "gmsh_text.msh": {"file_format": "gmsh", "binary": False},
        "gmsh2.msh": {"file_format": "gmsh22", "binary": True}, "vtu.vtu": {}, "vtk.vtk": {}, "medit.mesh": {},
        "binary.meshb": {}, "med.med": {}, "xdmf.xdmf": {}, "nastran.bdf": {}, "netgen.vol": {},
        "ply.ply": {}, "hmf.hmf": {}, "su2.su2": {}, "tecplot.tec": {},
    }  # fmt: skip
    found = {}
    for name, options in forms.items():
        folder = scratch / name.replace(".", "_")
        folder.mkdir(exist_ok=True)
        try:
            _cubes().write(folder / name, **options)
        except ImportError:  # an optional package of the format is missing
            continue
        files = {name: (folder / name).read_bytes()}
        found[name] = files | {path.name: path.read_bytes() for path in folder.iterdir() if path.name != name}
    return found


def _head() -> bytes:
    import nibabel

    z, y, x = np.indices((12, 12, 12)) - 5.5
    labels = (x**2 + y**2 + z**2 < 30).astype(np.uint8)
    labels[4:7, 4:6, 5:7], labels[4:7, 6:8, 5:7] = 2, 3
    return gzip.compress(bytes(nibabel.Nifti1Image(labels, np.diag([4.0, 4.0, 4.0, 1.0])).to_bytes()))


def _npz() -> bytes:
    packed, rng = io.BytesIO(), np.random.default_rng(1)
    np.savez(packed, X=rng.uniform(0, 0.02, (40, 3)), u=rng.uniform(0, 1e-3, (40, 3)), tag=np.zeros(40, int))
    return packed.getvalue()


def _grid_hdf5() -> bytes:
    image, rng = io.BytesIO(), np.random.default_rng(2)
    with h5py.File(image, "w") as file:
        for name in ("x", "y", "z", "volume"):
            file.create_dataset(name, data=rng.random(50), chunks=(10,), compression="gzip", shuffle=True)
    return image.getvalue()


def _vtu(scratch: Path) -> bytes:
    mesh = _cubes()
    mesh.points *= 0.01
    mesh.point_data["displacement"] = np.full((12, 3), 1e-3)
    mesh.write(scratch / "reference.vtu", binary=False)
    return (scratch / "reference.vtu").read_bytes()
