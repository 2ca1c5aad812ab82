"""`mpitled new`: a deck to begin with, whose sections, units, defaults and comments are those that deck.py declares."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mpitled import atomic, deck, toml
from mpitled.errors import InputError

#: A label image that a clone of the repository has; others give their own.
_IMAGE = Path(__file__).parents[1] / "jobs" / "data" / "mni152_labels_1mm.nii.gz"
_MATERIAL: dict[str, Any] = {"youngs_modulus": 3000.0, "poissons_ratio": 0.49}
_FIXED = ("[[fixed]]", {"nodes": "surface"})
_BRAIN = ("[material.brain]", _MATERIAL)
#: The block whose meshes go with a deck of decks.
_SAMPLE = """[block]
size = [40.0, 20.0, 20.0]
elements = [8, 5, 5]
cloud = "core"
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[fixed]]
nodes = "x0"
"""

#: What is not left at its default, by kind and heading, in the order of the deck.
_SCENES: Mapping[str, tuple[tuple[str, dict[str, Any]], ...]] = {
    "brain": (
        ("[labels]", {}),
        ("[tumour]", {"centre": (-32.0, -20.0, 10.0), "volume": 4188.8, "surface_nodes": 1600}),
        ("[material.brain]", _MATERIAL | {"cells": ("tissue",)}),
        (
            "[material.csf]",
            {"youngs_modulus": 10.0, "poissons_ratio": 0.1, "cells": ("left_ventricle", "right_ventricle")},
        ),
        ("[[fixed]]", {"nodes": "skull"}),
    ),
    "decks": (
        ("[mesh]", {}),
        _BRAIN,
        ("[[fixed]]", {"nodes": "x0"}),
        ("[[displaced]]", {"nodes": "x1", "displacement": (4.0, 0.0, 0.0)}),
    ),
    "block": (
        ("[block]", {"size": (48.0, 40.0, 40.0), "elements": (12, 10, 10), "cloud": "core"}),
        ("[tumour]", {"centre": (24.0, 20.0, 20.0), "volume": 523.6}),
        ("[cloud]", {"radius": 11.0}),
        _BRAIN,
        _FIXED,
    ),
    "cylinder": (
        ("[cylinder]", {"radius": 20.0, "height": 40.0, "cloud": "core"}),
        _BRAIN,
        ("[[fixed]]", {"nodes": "bottom"}),
        ("[[displaced]]", {"nodes": "top", "displacement": (0.0, 0.0, 4.0)}),
    ),
    "ellipsoid": (
        ("[ellipsoid]", {"semi_axes": (40.0, 32.0, 32.0), "cloud": "core"}),
        ("[tumour]", {"centre": (0.0, 0.0, 0.0), "volume": 523.6}),
        _BRAIN,
        _FIXED,
    ),
}
#: Sections for which there is nothing to choose, shown with their defaults; the first are of scenes with a cloud.
_REST = ("[cloud]", "[support]", "[hexahedra]", "[solver]", "[output]", "[partition]")


def write(kind: str, path: Path) -> list[Path]:
    """Write a deck, and meshes if it needs some to begin with; the paths. InputError if it is there already."""
    if path.exists():
        raise InputError(f"{path}: is there already; give another name, or remove it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    meshes = _meshes(path.with_name(f"{path.stem}_mesh")) if kind == "decks" else []
    atomic.write_text(path, text(kind, path, meshes))
    return [path, *meshes]


def text(kind: str, path: Path, meshes: Sequence[Path] = ()) -> str:
    """The deck for a path, with the meshes that it reads; InputError if it reads some and there are none."""
    geometry = {}
    if kind == "brain":
        geometry = {"image": os.path.relpath(_IMAGE, path.parent) if _IMAGE.exists() else "labels.nii.gz"}
    elif kind == "decks":
        if not meshes:
            raise InputError("new decks: meshes are written beside the deck; give a file, not -")
        keys = ("fe", "efg", "integration_points", "surface_areas")
        geometry = {key: f"{mesh.parent.name}/{mesh.name}" for key, mesh in zip(keys, meshes, strict=True)}
    (heading, chosen), *others = _SCENES[kind]
    scene = [(heading, chosen | geometry), *others]
    given = {name for name, _ in scene}
    scene += [(name, {}) for name in _REST if name not in given]
    about_top, top = deck.declared("the top of the deck")
    lines = [
        f"# A scene of mpitled to begin with ({kind}). A key behind # has its default: take the # away to change it.",
        f"# 'mpitled check {path.name}' says what is in it, 'mpitled run {path.name}' computes it.{about_top}",
        *_key("title", top["title"], f"A scene of kind {kind}"),
    ]
    for name, values in scene:
        lines += ["", *_section(name, values)]
    return "\n".join(lines) + "\n"


def _section(heading: str, values: Mapping[str, Any]) -> Iterator[str]:
    """A section with all of its keys."""
    about, keys = deck.declared("[material.NAME]" if heading.startswith("[material.") else heading)
    yield f"# {about}"
    yield heading
    for written, key in keys.items():
        yield from _key(written, key, values.get(written))


def _key(written: str, key: deck.Declared, value: Any) -> Iterator[str]:
    """A key with what it means; as a comment if nothing is given."""
    yield f"# {key.meaning}; {key.expected}"
    if value is not None:
        yield f"{written} = {toml.value(value)}"
    else:  # an empty list stands for what is not given
        yield f"# {written} = {'' if key.default in (None, ()) else toml.value(key.default)}".rstrip()


def _meshes(folder: Path) -> list[Path]:
    """The meshes of a small block with a cloud, where a user's own will be."""
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
