"""`mpitled new`: write a first deck. Its comments, units and defaults come from the deck's schema."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import tomlkit

from mpitled import atomic, deck, toml
from mpitled.errors import InputError

#: The label image in a clone of the repository.
_IMAGE = Path(__file__).parents[1] / "jobs" / "data" / "mni152_labels_1mm.nii.gz"
_BRAIN = "material.brain = {youngs_modulus = 3000.0, poissons_ratio = 0.49}"
#: The values that are not defaults, by kind of scene.
_SCENES = {
    "brain": """
tumour = {centre = [-32.0, -20.0, 10.0], volume = 4188.8, surface_nodes = 1600}
material.brain = {youngs_modulus = 3000.0, poissons_ratio = 0.49, cells = ["tissue"]}
material.csf = {youngs_modulus = 10.0, poissons_ratio = 0.1, cells = ["left_ventricle", "right_ventricle"]}
fixed = [{nodes = "skull"}]""",
    "decks": f"""{_BRAIN}
fixed = [{{nodes = "x0"}}]
displaced = [{{nodes = "x1", displacement = [4.0, 0.0, 0.0]}}]""",
    "block": f"""{_BRAIN}
block = {{size = [48.0, 40.0, 40.0], elements = [12, 10, 10], cloud = "core"}}
tumour = {{centre = [24.0, 20.0, 20.0], volume = 523.6}}
cloud = {{radius = 11.0}}
fixed = [{{nodes = "surface"}}]""",
    "cylinder": f"""{_BRAIN}
cylinder = {{radius = 20.0, height = 40.0, cloud = "core"}}
fixed = [{{nodes = "bottom"}}]
displaced = [{{nodes = "top", displacement = [0.0, 0.0, 4.0]}}]""",
    "ellipsoid": f"""{_BRAIN}
ellipsoid = {{semi_axes = [40.0, 32.0, 32.0], cloud = "core"}}
tumour = {{centre = [0.0, 0.0, 0.0], volume = 523.6}}
fixed = [{{nodes = "surface"}}]""",
}
#: The block that gives the meshes for a deck with mesh files.
_SAMPLE = f"""{_BRAIN}
block = {{size = [40.0, 20.0, 20.0], elements = [8, 5, 5], cloud = "core"}}
fixed = [{{nodes = "x0"}}]"""
#: Sections that every deck shows, also if all of their keys have defaults.
_SHOWN = ("cloud", "support", "hexahedra", "solver", "output", "partition")


def write(kind: str, path: Path) -> list[Path]:
    """Write a deck and the meshes that it reads, and return their paths. InputError if the deck exists already."""
    if path.exists():
        raise InputError(f"{path}: exists already; give another name, or remove it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    meshes = _write_meshes(path.with_name(f"{path.stem}_mesh")) if kind == "decks" else []
    atomic.write_text(path, text(kind, path, meshes))
    return [path, *meshes]


def text(kind: str, path: Path, meshes: Sequence[Path] = ()) -> str:
    """The text of a deck for a path. InputError if the deck needs meshes and none are given."""
    scene: dict[str, Any] = tomlkit.parse(_SCENES[kind]).unwrap()
    if kind == "brain":
        scene["labels"] = {"image": os.path.relpath(_IMAGE, path.parent) if _IMAGE.exists() else "labels.nii.gz"}
    elif kind == "decks":
        if not meshes:
            raise InputError("new decks: meshes are written beside the deck; give a file, not -")
        keys = ("fe", "efg", "integration_points", "surface_areas")
        scene["mesh"] = {key: f"{mesh.parent.name}/{mesh.name}" for key, mesh in zip(keys, meshes, strict=True)}
    lines = [
        f"# A first scene of mpitled ({kind}). A key after # has its default value: remove the # to change it.",
        f"# 'mpitled check {path.name}' lists its contents, 'mpitled run {path.name}' computes it.",
        *_keys("", {"title": f"A scene of kind {kind}"}),
    ]
    for home in deck.homes()[1:]:
        given = scene.get(home.section, {} if home.section in _SHOWN else None)
        if given is not None and not home.law:
            entries = dict(enumerate(given)) if isinstance(given, list) else given if home.depth == 3 else {"": given}
            for name, values in entries.items():
                heading = home.heading.replace("NAME", str(name))
                lines += ["", f"# {home.about}", heading, *_keys(home.section, values)]
    return "\n".join(lines) + "\n"


def _keys(section: str, values: dict[str, Any]) -> Iterator[str]:
    """Every key of a section with its meaning. A key without a given value is a comment."""
    for name, key in deck.keys_of(section).items():
        yield f"# {key['description']}; {deck.expected(key)}"
        default = toml.value(key["default"]) if "default" in key else ""
        yield f"{name} = {toml.value(values[name])}" if name in values else f"# {name} = {default}".rstrip()


def _write_meshes(folder: Path) -> list[Path]:
    """Write the meshes of a small block with a cloud, which the user replaces by real meshes."""
    from mpitled import export, store
    from mpitled.model import build as model_build

    with tempfile.TemporaryDirectory() as temporary:
        sample, model = Path(temporary) / "sample.toml", Path(temporary) / "model.h5"
        sample.write_text(_SAMPLE)
        scene = deck.load_deck(sample)
        store.write_model(model, model_build.build(scene), "", deck.canonical(scene))
        *meshes, _ = export.write_abaqus(model, Path(temporary) / "export")
        with atomic.writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            return [Path(shutil.copy(mesh, folder)) for mesh in meshes]
