"""Ablation: the speed of the step with all features of a scene, without each of them, and without all of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import models
import numpy as np
from step_benchmark import StepBenchmark, compose, time_steps

from mpitled import store
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import localise
from mpitled.store import PartRows


@dataclass(frozen=True, slots=True)
class Scene:
    """The model on one rank, and the options that its step is composed from."""

    rows: PartRows
    boxes: PartRows  # the same model, in which hexahedra are boxes
    hourglass: float
    stabilisation: float
    relaxation: bool = True
    precision: type[np.floating] = np.float64

    def compose(self) -> StepBenchmark:
        """The step of this scene."""
        sub = localise(self.rows, self.hourglass, self.stabilisation, "mean", self.precision)
        return compose(sub, World(), self.relaxation)

    def with_rows(self, **fields: object) -> Scene:
        """The scene with other fields of its rows."""
        return replace(self, rows=replace(self.rows, **fields))


def _unrotated(scene: Scene) -> Scene:
    return scene.with_rows(prescribed_turns=np.zeros_like(scene.rows.prescribed_turns))


def _one_material(scene: Scene) -> Scene:
    return replace(scene, rows=scene.rows.holding(material=np.zeros(scene.rows.n_own_cells, np.int16)))


#: Each feature, and how to leave it out.
FEATURES = {
    "cells that are not boxes": lambda s: replace(s, rows=s.rows.holding(points=s.boxes.read("points"))),
    "hourglass control": lambda s: replace(s, hourglass=0.0),
    "stabilisation": lambda s: replace(s, stabilisation=0.0),
    "several materials": _one_material,
    "rotating nodes": _unrotated,
    "moving nodes": lambda s: _unrotated(s).with_rows(
        prescribed_displacements=np.zeros_like(s.rows.prescribed_displacements)
    ),
    "mass tensors, damping": lambda s: replace(s, relaxation=False),
    "double precision": lambda s: replace(s, precision=np.float32),
}


def measure(folder: Path, quick: bool) -> str:
    """A table: million cells per second of the brain's step, and the gain from leaving out each feature."""
    built = models.build(folder / "mixed", "mixed", models.SIZES["mixed"][0 if quick else 1])
    boxes = store.read_part(Path(built["model"]), 1, 0)
    rotations = np.where(boxes.prescribed_displacements[:, None] != 0, [0.1, 1e-3, 1e-3], 0.0)
    # A shear turns boxes into parallelepipeds: the same cells, but in the general kernel.
    points = boxes.read("points")
    rows = replace(boxes.holding(points=points + 1e-3 * points[:, [2, 0, 1]]), prescribed_turns=rotations)
    complete = bare = Scene(rows, boxes, built["hourglass"], built["stabilisation"])
    scenes = {"(all features)": complete}
    for name, leave_out in FEATURES.items():
        scenes[name], bare = leave_out(complete), leave_out(bare)
    scenes["all of these"] = bare
    seconds = time_steps({name: scene.compose() for name, scene in scenes.items()}, World(), quick)
    lines = [f"{'left out':26}{'M cells/s':>10}{'gain':>8}"]
    for name, step in seconds.items():
        lines.append(f"{name:26}{boxes.n_own_cells / step / 1e6:10.2f}{seconds['(all features)'] / step:8.2f}")
    return "\n".join(lines)
