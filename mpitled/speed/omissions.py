"""What each thing that a scene can do without costs a step: the step with everything on against the step without it."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mpitled import store
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import localise
from mpitled.speed import bench
from mpitled.speed.pace import QUICK_REPEATS, QUICK_SPAN, REPEATS, SPAN, Pace, made, timed
from mpitled.store import PartRows


@dataclass(frozen=True, slots=True)
class Scene:
    """A whole model, and what the step is composed from."""

    rows: PartRows
    boxes: PartRows  # the same model whose hexahedra are boxes
    hourglass: float
    stabilisation: float
    relaxed: bool = True
    precision: type[np.floating] = np.float64

    def composed(self) -> Pace:
        """The step of this scene."""
        sub = localise(self.rows, self.hourglass, self.stabilisation, "mean", self.precision)
        return made(sub, World(), relaxed=self.relaxed)


def _one_material(scene: Scene) -> Scene:
    return replace(scene, rows=scene.rows.with_columns(material=np.zeros(scene.rows.n_own_cells, np.int16)))


def _straight(scene: Scene) -> Scene:
    return replace(scene, rows=replace(scene.rows, rotation_paths=np.zeros_like(scene.rows.rotation_paths)))


def _fixed(scene: Scene) -> Scene:
    still = np.zeros_like(scene.rows.prescribed_displacements)
    return _straight(replace(scene, rows=replace(scene.rows, prescribed_displacements=still)))


#: What is left out, and how; each alone, then all.
OMISSIONS: dict[str, Callable[[Scene], Scene]] = {
    "cells that are no boxes": lambda s: replace(s, rows=s.rows.with_columns(points=s.boxes.read("points"))),
    "hourglass control": lambda s: replace(s, hourglass=0.0),
    "stabilisation": lambda s: replace(s, stabilisation=0.0),
    "several materials": _one_material,
    "turning nodes": _straight,
    "moving nodes": _fixed,
    "mass tensors, damping": lambda s: replace(s, relaxed=False),
    "double precision": lambda s: replace(s, precision=np.float32),
}


def measure(quick: bool) -> str:
    """The mixed scene's step with everything on, without each thing, and without all: a table with gains in speed."""
    repeats, span = (QUICK_REPEATS, QUICK_SPAN) if quick else (REPEATS, SPAN)
    with tempfile.TemporaryDirectory(prefix="mpitled-bench-") as folder:
        print("building the mixed scene", file=sys.stderr, flush=True)
        told = bench.scene(Path(folder) / "mixed", "mixed", bench.SIZES["mixed"][0 if quick else 1])
        boxes = store.read_part(Path(told["model"]), 1, 0)
    turns = np.where(boxes.prescribed_displacements[:, None] != 0, [0.1, 1e-3, 1e-3], 0.0)
    # A shear makes parallelepipeds of boxes: as many cells, but for the general kernel.
    points = boxes.read("points")
    sheared = points + 1e-3 * points[:, [2, 0, 1]]
    everything = Scene(
        replace(boxes.with_columns(points=sheared), rotation_paths=turns),
        boxes,
        told["hourglass"],
        told["stabilisation"],
    )
    scenes = {"": everything} | {name: leave_out(everything) for name, leave_out in OMISSIONS.items()}
    least = everything
    for leave_out in OMISSIONS.values():
        least = leave_out(least)
    scenes["all of these"] = least
    paces = {name: scene.composed() for name, scene in scenes.items()}
    seconds = timed({name: pace.take for name, pace in paces.items()}, World(), repeats, span)
    n_cells = boxes.n_own_cells
    lines = [f"{'left out':26}{'M cells/s':>10}{'gain':>8}"]
    for name, took in seconds.items():
        lines.append(f"{name or '(everything on)':26}{n_cells / took / 1e6:10.2f}{seconds[''] / took:8.2f}")
    return "\n".join(lines)
