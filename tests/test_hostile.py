"""Hostile input gives a result or a one-line error; no links are followed, no code is run, no memory is wasted."""

from __future__ import annotations

import gzip
import io
import os
import random
import resource
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ENVIRONMENT, ROOT, mpitled
from hostile import attempt, readers

from mpitled import resources, store
from mpitled.batch import vary
from mpitled.deck import load_deck
from mpitled.errors import InputError
from mpitled.meshing.label_image import read_image
from mpitled.model.build import build
from mpitled.readers import abaqus, tables
from mpitled.results import compare

#: Inputs for each reader; `python tests/fuzz.py` is the long form.
FEW = 40


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    return readers(tmp_path_factory.mktemp("hostile"))


@pytest.fixture
def model(known, tmp_path):
    path = tmp_path / "model.h5"
    path.write_bytes(known["model.h5"].inputs["model"]["model.h5"])
    return path


def test_every_reader_reads_its_valid_inputs(known, tmp_path):
    for name, reader in known.items():
        for number, files in enumerate(reader.inputs.values()):
            folder = tmp_path / name.replace("/", "-") / str(number)
            for file, data in files.items():
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / file).write_bytes(data)
            reader.read(folder / next(iter(files)))


def test_changed_inputs_give_a_result_or_one_line(known, tmp_path):
    slow = {"deck, with the time it takes", "decks of a mixed mesh"}
    for name, reader in known.items():
        ends = {attempt(reader, tmp_path, random.Random(f"{name} {i}")) for i in range(5 if name in slow else FEW)}
        assert name in slow or "error" in ends, name


# ------------------------------------------------------------ HDF5


def refused(path, message, read=store.read_model):
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["points", "materials"])
def test_links_out_of_a_file_are_not_followed(model, name):
    secret = model.with_name("secret.h5")
    with h5py.File(secret, "w") as file:
        file["x"] = np.zeros((9, 3))
    whole = model.read_bytes()
    layout = h5py.VirtualLayout((9, 3), "f8")
    layout[:] = h5py.VirtualSource(secret, "x", (9, 3))

    def links(link):
        def put(file):
            file[name] = link

        return put

    for put, message in (
        (links(h5py.ExternalLink(str(secret), "/x")), "is a link that leads elsewhere"),
        (links(h5py.SoftLink("/mass")), "is a link that leads elsewhere"),
        (lambda file: file.create_dataset(name, (9,), "f8", external=[(str(secret), 0, 72)]), "are in another file"),
        (lambda file: file.create_virtual_dataset(name, layout), "are in another file"),
        (lambda file: file.create_dataset(name, data=["a"], dtype=h5py.string_dtype()), "other than numbers and text"),
    ):
        model.write_bytes(whole)
        with h5py.File(model, "r+") as file:
            del file[name]
            put(file)
        refused(model, message)


@pytest.mark.parametrize(("options", "read"), [
    ({}, store.read_model),
    ({"chunks": (1 << 20,)}, store.read_model),
    ({"chunks": (1 << 20,), "compression": "gzip"}, store.read_model),
    ({"chunks": (1 << 20,), "compression": "gzip"}, lambda path: tables.read_grid(path)),
])  # fmt: skip
def test_datasets_that_claim_more_than_their_bytes_are_refused(model, options, read):
    for name in ("mass", "x"):
        with h5py.File(model, "r+") as file:
            file.pop(name, None)
            file.create_dataset(name, (10**12,), "f8", **options)
            for other in ("y", "z", "volume"):
                file.require_dataset(other, (10**12,), "f8", **options)
    refused(model, "claims 8000000000000 bytes, and 0 are there", read)


def test_strongly_compressed_integration_points_are_refused_by_their_memory(tmp_path, monkeypatch):
    """All claims of the file are true."""
    path = tmp_path / "grid.h5"
    with h5py.File(path, "w") as file:
        for name in ("x", "y", "z", "volume"):
            file.create_dataset(name, data=np.zeros(1 << 20), chunks=(1 << 18,), compression="gzip")
    monkeypatch.setattr(resources, "memory", lambda: 16 << 20)
    refused(path, "its 1048576 points: would take 33.6 MB of memory", tables.read_grid)


def test_indices_outside_their_arrays_are_refused(model):
    whole = model.read_bytes()
    for name, value in (
        ("blocks/0/nodes", 10**9), ("blocks/1/nodes", -1), ("blocks/1/material", 7),
        ("field_domains", 10**6), ("prescribed_dofs", -3),
        ("partitions/2/nodes", 10**7), ("partitions/2/cells", 10**7), ("partitions/2/rows", 10**7),
        ("partitions/2/shared", 10**7), ("partitions/2/neighbours", 5), ("partitions/2/shared_offsets", 10**6),
    ):  # fmt: skip
        model.write_bytes(whole)
        with h5py.File(model, "r+") as file:
            file[name][-1] = value
            file[name].attrs.pop("checksum", None)  # an attacker would write a correct checksum
        read = (
            store.read_model
            if not name.startswith("partitions")
            else lambda path: [store.read_part(path, 2, part) for part in (0, 1)]
        )
        refused(model, r"model.h5: is damaged \(ValueError: .*\); build the model anew", read)


# ------------------------------------------------------------ images, tables, meshes


def nifti(*shape):
    """A header that claims this shape, followed by a hundred bytes."""
    import nibabel

    head = bytearray(nibabel.Nifti1Image(np.zeros((2, 2, 2), np.uint8), np.eye(4)).to_bytes()[:352])
    struct.pack_into("<8h", head, 40, len(shape), *shape, *[1] * (7 - len(shape)))
    return bytes(head) + bytes(100)


def test_an_image_that_claims_too_much_is_refused(tmp_path, monkeypatch):
    plain, packed = tmp_path / "a.nii", tmp_path / "b.nii.gz"
    plain.write_bytes(nifti(32000, 32000, 32000))
    refused(plain, "claims 3.28e[+]13 voxels and has 452 bytes", read_image)
    packed.write_bytes(gzip.compress(nifti(32000, 32000, 32000)))
    refused(packed, "claims 3.28e[+]13 voxels", read_image)
    # A zip bomb: the claims are true, and the file is a thousand times smaller.
    packed.write_bytes(gzip.compress(nifti(300, 300, 300) + bytes(27_000_000)))
    monkeypatch.setattr(resources, "memory", lambda: 1 << 28)
    refused(packed, "its 2.7e[+]07 voxels: would take 1.51 GB of memory, and 268 MB are free", read_image)
    before = bytearray(nifti(2, 2, 2))
    struct.pack_into("<f", before, 108, 2e9)
    packed.write_bytes(gzip.compress(bytes(before)))
    refused(packed, "claims 2e[+]09 bytes before its voxels", read_image)


def test_npz_files_run_no_code_and_are_limited_in_memory(tmp_path, monkeypatch):
    class Attack:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "run by pickle"),)

    path = tmp_path / "r.npz"
    np.savez(path, X=np.array([Attack()], object), u=np.zeros((1, 3)))
    refused(path, "cannot be read as .npz", lambda path: compare.read_reference(path, None))
    assert not (tmp_path / "run by pickle").exists()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("X", "u"):
            member = io.BytesIO()
            np.save(member, np.zeros((1 << 18, 3)))
            archive.writestr(f"{name}.npy", member.getvalue())
    assert path.stat().st_size < 1 << 17
    monkeypatch.setattr(resources, "memory", lambda: 1 << 24)
    refused(path, "its arrays: would take 50.3 MB of memory", lambda path: compare.read_reference(path, None))


def test_devices_and_pipes_are_not_read(tmp_path):
    deck = tmp_path / "deck.inp"
    for device in ("/dev/zero", str(tmp_path / "pipe")):
        if not Path(device).exists():
            os.mkfifo(device)
        deck.write_text(f"*INCLUDE, INPUT={device}\n")
        refused(deck, "which is not there", abaqus.read)
        mpitled("check", device, status=2, timeout=30)
        refused(Path(device), "is a device or a pipe", load_deck)
        refused(Path(device), "is a device or a pipe", tables.read_grid)


# ------------------------------------------------------------ decks

SCENE = """
{geometry}
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[fixed]]
nodes = "surface"
"""
LARGE = {
    "block.elements": "[block]\nsize = [1.0, 1.0, 1.0]\nelements = [100000, 100000, 100000]",
    "cloud.spacing": '[block]\nsize = [1.0, 1.0, 1.0]\nelements = [1, 1, 1]\ncloud = "all"\n[cloud]\nspacing = 1e-9',
    "cylinder.element_size": "[cylinder]\nradius = 10.0\nheight = 1e9\nelement_size = 0.001",
    "ellipsoid.element_size": "[ellipsoid]\nsemi_axes = [1.0, 1e6, 1e6]\nelement_size = 0.1",
    "tumour.surface_nodes": "[ellipsoid]\nsemi_axes = [30.0, 30.0, 30.0]\n"
    "[tumour]\ncentre = [0.0, 0.0, 0.0]\nvolume = 50.0\nsurface_nodes = 2000000000",
    "cloud.growth": '[block]\nsize = [60.0, 60.0, 60.0]\nelements = [9, 9, 9]\ncloud = "core"\n[cloud]\ngrowth = 1e-6\n'
    "[tumour]\ncentre = [30.0, 30.0, 30.0]\nvolume = 50.0",
    "cloud": '[block]\nsize = [60.0, 60.0, 60.0]\nelements = [9, 9, 9]\ncloud = "core"\n'
    "[cloud]\npoints_per_spacing = 1000.0",
    "support.nodes": '[block]\nsize = [60.0, 60.0, 60.0]\nelements = [5, 5, 5]\ncloud = "core"\n'
    "[support]\nnodes = 2000000000",
}  # fmt: skip


@pytest.mark.parametrize("key", LARGE)
def test_decks_that_need_too_much_memory_are_refused_before_allocation(tmp_path, key):
    deck = tmp_path / "deck.toml"
    deck.write_text(SCENE.format(geometry=LARGE[key]))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(deck, rf"^{deck}: {key}.*(of memory, and|is more than)", lambda path: build(load_deck(path)))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 16  # KiB


def test_the_memory_limit_of_the_process_counts(tmp_path):
    """Batch systems set such limits."""
    deck = tmp_path / "deck.toml"
    deck.write_text(SCENE.format(geometry="[block]\nsize = [1.0, 1.0, 1.0]\nelements = [200, 200, 200]"))
    code = (
        "import resource, sys; from mpitled.cli import main; "
        "resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30)); main(['build', sys.argv[1]])"
    )
    command = [sys.executable, "-c", code, str(deck)]
    done = subprocess.run(command, env=ENVIRONMENT, cwd=ROOT, timeout=60, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert "makes 8e+06 hexahedra, which: would take 4 GB of memory, and " in done.stderr


@pytest.mark.parametrize("text", ["a." * 20000 + "a = 1", "[" * 100000, "x = 0x" + "f" * 100000, "#" * (1 << 21)])
def test_toml_with_excessive_structure_is_refused(tmp_path, text):
    deck = tmp_path / "deck.toml"
    deck.write_text(text)
    refused(deck, "deck.toml: ", load_deck)


def test_names_do_not_become_paths(tmp_path):
    """Names are titles, materials, spheres and sets."""
    deck, out = tmp_path / "deck.toml", tmp_path / "out"
    name = f"../../{30 * 'x'}/../"
    deck.write_text(
        f'title = "{name}"\n[block]\nsize = [20.0, 20.0, 20.0]\nelements = [4, 4, 4]\n'
        f'[sphere."{name}"]\ncentre = [10.0, 10.0, 10.0]\nradius = 6.0\n'
        f'[material."{name}"]\nyoungs_modulus = 3000.0\npoissons_ratio = 0.3\n'
        '[[fixed]]\nnodes = "x0"\n[[displaced]]\nnodes = "x1"\ndisplacement = [0.1, 0.0, 0.0]\n'
        "[solver]\nload_time = 0.05\n[output]\nframes = 1\npictures = false\n"
    )
    mpitled("run", "-q", deck, "--out", out)
    mpitled("export", out, "--abaqus")
    mpitled("check", out / "export" / "scene.toml")
    assert {path.name for path in tmp_path.iterdir()} == {"deck.toml", "out"}
    assert not [path for path in tmp_path.parent.iterdir() if path.name.startswith("x")]
    assert Path(vary.folder_name(name, "content")).name == vary.folder_name(name, "content")
