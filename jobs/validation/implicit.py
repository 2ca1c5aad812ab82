#!/usr/bin/env python3
"""Error against run time beside an implicit code: cylinder and tumour on one core, each run a process of its own.

    python jobs/validation/implicit.py    # out/implicit/implicit.csv and .png, kept in jobs/studies; some ten minutes

FElupe's Newton with Pardiso solves the scenes of cylinder.toml (hexahedra only) and tumour.toml (hexahedra in shells
around the seed) with the same law on the same kind of meshes, in the elements that suit nearly incompressible tissue:
"Q1P0", trilinear with the mean dilatation of each cell, and "Q2Q1", triquadratic with a continuous trilinear pressure,
the nodes between the corners put on the curved surfaces. mpitled relaxes to 0.01 mm. Runs take turns, three of each;
medians count. A process first solves a coarse mesh, so that imports and compilation are done with ("start_s"); what
counts is the time from the deck to displacements: mesh and set-up ("setup_s"), and the solution ("solve_s"), assembly
included, without the writing of results. All are processor times of one thread: other work on the machine hardly
counts, and nothing waits.

Needs FElupe and Pardiso: pip install -e '.[implicit]'
"""

from __future__ import annotations

import csv
import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpitled import job
from mpitled.deck import Deck, load_deck
from mpitled.mesh import CORNERS, Mesh
from mpitled.model import build as model_build
from mpitled.model.loading import sphere_radius
from mpitled.parallel.halo import World
from mpitled.results import compare, field

ROOT = Path(__file__).resolve().parents[2]
OUT = Path("out/implicit")
REPEATS = 3
OURS = "mpitled, one-point hexahedra"
IMPLICIT = {"FElupe, Q1P0 hexahedra": 1, "FElupe, Q2Q1 hexahedra": 2}  # the displacement's order
#: Newton ends when the free nodes' forces are this share of the reactions; before the last load step, sooner.
TOLERANCE, LOOSE = 1e-4, 1e-2
COLUMNS = (
    "scene", "family", "mesh", "cells", "unknowns", "max_error_mm", "rms_error_mm", "seconds", "setup_s", "solve_s",
    "start_s", "steps",
)  # fmt: skip


@dataclass(frozen=True)
class Scene:
    """A deck of this folder, made of hexahedra only, and the meshes of each family."""

    deck: str
    overrides: tuple[str, ...]
    reference: str
    beyond: float  # m from edges: errors count there
    error: str  # what is measured, for the figure
    load_steps: int  # of Newton: no fewer converge
    meshes: dict[str, tuple[tuple[str, ...], ...]]  # of each family, by overrides

    def load(self, mesh: tuple[str, ...]) -> Deck:
        """The deck on one of the meshes."""
        overrides = (*self.overrides, "solver.method=dynamic-relaxation", "output.pictures=false", *mesh)
        return load_deck(ROOT / "jobs" / "validation" / self.deck, overrides)


def _sizes(*sizes: float) -> tuple[tuple[str, ...], ...]:
    return tuple((f"cylinder.element_size={size}",) for size in sizes)


def _shells(*meshes: tuple[int, float]) -> tuple[tuple[str, ...], ...]:
    return tuple((f"tumour.surface_nodes={n}", f"ellipsoid.element_size={size}") for n, size in meshes)


SCENES = {
    "cylinder, 20 % extension": Scene(
        deck="cylinder.toml",
        overrides=("cylinder.cloud=none",),
        reference="A_ext.npz",
        beyond=5e-3,
        error="largest error beyond 5 mm from edges, mm",
        load_steps=1,
        meshes={
            OURS: _sizes(20, 14, 10, 7, 5, 3.5, 2.5),
            "FElupe, Q1P0 hexahedra": _sizes(20, 14, 10, 7, 5),
            "FElupe, Q2Q1 hexahedra": _sizes(33, 20, 14, 10),
        },
    ),
    "tumour of 523.6 mm3 in an ellipsoid": Scene(
        deck="tumour.toml",
        overrides=("ellipsoid.cloud=none",),
        reference="C_tum.npz",
        beyond=0.0,
        error="largest error, mm",
        load_steps=3,
        meshes={
            OURS: _shells((96, 30), (96, 14), (384, 20), (864, 6), (1536, 5)),
            "FElupe, Q1P0 hexahedra": _shells((96, 30), (96, 14), (384, 20)),
            "FElupe, Q2Q1 hexahedra": _shells((96, 30), (96, 14)),
        },
    ),
}


def main() -> None:
    """Run all that there is to run, and tell."""
    if sys.argv[1:]:
        _one(*sys.argv[1:])
        return
    try:
        import felupe  # noqa: F401
        import pypardiso  # noqa: F401
    except ImportError as missing:
        print(f"implicit.py: {missing.name} is missing; install it with: pip install -e '.[implicit]'", file=sys.stderr)
        sys.exit(2)
    OUT.mkdir(parents=True, exist_ok=True)
    todo = [
        (name, family, mesh)
        for name, scene in SCENES.items()
        for family, meshes in scene.meshes.items()
        for mesh in meshes
    ]
    found: dict[tuple[str, str, tuple[str, ...]], list[dict[str, Any]]] = {key: [] for key in todo}
    for turn in range(REPEATS):
        for name, family, mesh in todo:
            print(f"{turn + 1}/{REPEATS}: {name}, {family}, {' '.join(mesh)}", file=sys.stderr, flush=True)
            found[name, family, mesh].append(_apart(name, family, mesh))
        _tell(found)


def _tell(found: dict[tuple[str, str, tuple[str, ...]], list[dict[str, Any]]]) -> None:
    """The table and the figure of the medians of what has been measured, under scene, family and mesh."""
    from drawing import draw_programs  # not for the runs

    rows = [
        {"scene": name, "family": family, "mesh": " ".join(mesh)} | _median(measured)
        for (name, family, mesh), measured in found.items()
    ]
    with (OUT / "implicit.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    panels = {name: [row for row in rows if row["scene"] == name] for name in SCENES}
    errors = [scene.error for scene in SCENES.values()]
    draw_programs(panels, OUT / "implicit.png", "from the deck to displacements on one core, s", errors)


def _apart(name: str, family: str, mesh: tuple[str, ...]) -> dict[str, Any]:
    """What `_one` found in a process of its own, on one core."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, __file__, name, family, *mesh]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"implicit.py: {name}, {family}, {' '.join(mesh)}: {done.stderr.splitlines()[-1]}")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _median(measured: list[dict[str, Any]]) -> dict[str, Any]:
    return {name: statistics.median(one[name] for one in measured) for name in measured[0]}


def _one(name: str, family: str, *mesh: str) -> None:
    """Solve a coarse mesh, then this one; the figures of the latter as a line of JSON."""
    time.perf_counter = time.process_time  # of this script's clock, and of the run's
    begin = time.perf_counter()
    scene, coarse = SCENES[name], next(iter(SCENES.values()))
    with np.load(ROOT / "tests" / "data" / scene.reference) as arrays:
        data = dict(arrays)
    _solve(coarse, family, _sizes(33)[0], data["X"])
    begun = time.perf_counter()
    u, figures = _solve(scene, family, mesh, data["X"])

    deck, exact = scene.load(()), data["u"]
    if deck.tumour:
        radii = np.array(json.loads(str(data["meta"]))["R"])
        exact = exact[np.abs(radii - sphere_radius(deck.tumour.volume)).argmin()]
    edge = compare.edge_distance(model_build.build(deck), data["X"])
    chosen = (edge > scene.beyond) & ~np.isin(data["tag"], (2, 3))  # prescribed places say nothing
    error = 1e3 * np.linalg.norm(u - exact, axis=1)[chosen]
    figures |= {"max_error_mm": error.max(), "rms_error_mm": np.sqrt((error**2).mean())}
    print(json.dumps(figures | {"start_s": begun - begin}))


def _solve(
    scene: Scene, family: str, mesh: tuple[str, ...], places: NDArray[np.float64]
) -> tuple[NDArray[np.float64], dict[str, Any]]:
    """Displacements (n, 3), m, at places (n, 3), and figures."""
    deck = scene.load(mesh)
    return _explicit(deck, places) if family == OURS else _implicit(deck, places, IMPLICIT[family], scene.load_steps)


def _figures(cells: int, unknowns: int, setup: float, solution: float, steps: int) -> dict[str, Any]:
    return {
        "cells": cells,
        "unknowns": unknowns,
        "seconds": setup + solution,
        "setup_s": setup,
        "solve_s": solution,
        "steps": steps,
    }


def _explicit(deck: Deck, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], dict[str, Any]]:
    """mpitled's displacements (n, 3), m, at places (n, 3), and its figures."""
    report = job.run(deck, OUT / "run", World(), quiet=True)
    ours, seconds = field.open_field(OUT / "run"), report["seconds"]
    setup = seconds["model"] + seconds["partition"] + seconds["read"]
    unknowns = 3 * ours.model.n_nodes - len(ours.model.prescribed_dofs)
    figures = _figures(ours.model.n_cells, unknowns, setup, seconds["loop"], report["steps"])
    return ours.at(places).displacement, figures


def _implicit(
    deck: Deck, places: NDArray[np.float64], order: int, load_steps: int
) -> tuple[NDArray[np.float64], dict[str, Any]]:
    """FElupe's displacements (n, 3), m, at places (n, 3), and its figures; order 1 is Q1P0, 2 is Q2Q1.

    Its volumetric energy is K (J - 1)^2 / 2, so that with K = lambda and the rest of W as the distortional part the law
    is that of `mpitled.laws.NeoHookean`.
    """
    import felupe

    begin = time.perf_counter()
    linear = model_build.read_mesh(deck)
    material = deck.materials[0].material
    shear = felupe.NeoHookeCompressible(mu=material.mu)
    mesh = felupe.Mesh(linear.points, linear.hexahedra, "hexahedron")
    if order == 1:
        dofs, full, _ = model_build.prescribe(deck, linear)
        region = felupe.RegionHexahedron(mesh)
        fields = felupe.FieldContainer([felupe.Field(region, dim=3)])
        body = felupe.SolidBodyNearlyIncompressible(shear, fields, bulk=material.lam)
    else:
        mesh, sets = _quadratic(deck, linear, mesh)
        numbers = np.arange(len(mesh.points))
        dofs, full, _ = model_build.prescribe(
            deck, replace(linear, points=mesh.points, node_ids=numbers, node_sets=sets)
        )
        region = felupe.RegionTriQuadraticHexahedron(mesh)
        fields = felupe.FieldsMixed(region, n=3, disconnect=False)
        body = felupe.SolidBody(felupe.NearlyIncompressible(shear, bulk=material.lam), fields)
    free = np.setdiff1d(np.arange(sum(fields.fieldsizes)), dofs)
    ready = time.perf_counter()
    iterations = 0
    for step in range(1, load_steps + 1):
        iterations += felupe.newtonraphson(
            items=[body],
            dof0=dofs,
            dof1=free,
            ext0=step / load_steps * full,
            solver=_cholesky if order == 1 else _indefinite,
            tol=TOLERANCE if step == load_steps else LOOSE,
            verbose=0,
        ).iterations
    done = time.perf_counter()
    figures = _figures(len(mesh.cells), len(free), ready - begin, done - ready, iterations)

    cells, xi, _ = field.locate(linear.points, linear.hexahedra, places)
    corners = mesh.points[mesh.cells[cells]]
    for _ in range(10):  # of Newton: a trilinear cell's coordinates are near those in the curved one
        shapes, slopes = (np.array([of(x) for x in xi]) for of in (region.element.function, region.element.gradient))
        off = places - np.einsum("na,nai->ni", shapes, corners)
        xi = xi + np.linalg.solve(np.einsum("nai,naj->nij", corners, slopes), off[..., None])[..., 0]
    return np.einsum("na,nai->ni", shapes, fields[0].values[mesh.cells[cells]]), figures


def _quadratic(deck: Deck, linear: Mesh, mesh: Any) -> tuple[Any, dict[str, NDArray[np.int64]]]:
    """FElupe's mesh with nodes between the corners of another, and its node sets.

    A node is in the sets that all the corners that it lies between are in, and on the surface that they are on.
    """
    import felupe

    mesh = mesh.convert(order=2, calc_points=True, calc_midfaces=True, calc_midvolumes=True)
    local = np.asarray(felupe.element.TriQuadraticHexahedron().points)
    between = ((local[:, None] == 0) | (local[:, None] == CORNERS)).all(axis=2)  # (27, 8)
    sets = {}
    for name, nodes in linear.node_sets.items():
        within = np.isin(linear.hexahedra, nodes)
        sets[name] = np.unique(mesh.cells[(within[:, None] | ~between).all(axis=2)])
    x = mesh.points
    if deck.cylinder:
        side = sets["side"]
        x[side, :2] *= deck.cylinder.radius / np.linalg.norm(x[side, :2], axis=1, keepdims=True)
    if deck.ellipsoid and deck.tumour:
        surface, seed, centre = sets["surface"], sets["tumour"], np.asarray(deck.tumour.centre)
        x[surface] /= np.linalg.norm(x[surface] / deck.ellipsoid.semi_axes, axis=1, keepdims=True)
        arm = x[seed] - centre
        x[seed] = centre + deck.tumour.seed_radius * arm / np.linalg.norm(arm, axis=1, keepdims=True)
    return mesh, sets


def _cholesky(matrix: Any, right: NDArray[np.float64]) -> NDArray[np.float64]:
    """The solution of a positive definite system."""
    from pypardiso import PyPardisoSolver

    return _solution(PyPardisoSolver(mtype=2), matrix, right)


def _indefinite(matrix: Any, right: NDArray[np.float64]) -> NDArray[np.float64]:
    """The solution of a symmetric system with pressures, with the scaling and matching that zeros in it need."""
    from pypardiso import PyPardisoSolver

    solver = PyPardisoSolver(mtype=-2)
    # Own parameters, METIS, 2 refinements, pivots of 1e-8, scaling, matching, Bunch-Kaufman: MKL's numbers, from 1.
    for number, value in ((1, 1), (2, 2), (8, 2), (10, 8), (11, 1), (13, 1), (21, 1)):
        solver.set_iparm(number, value)
    return _solution(solver, matrix, right)


def _solution(solver: Any, matrix: Any, right: NDArray[np.float64]) -> NDArray[np.float64]:
    found = solver.solve(scipy.sparse.triu(matrix, format="csr"), right)
    solver.free_memory(everything=True)
    return np.asarray(found)


if __name__ == "__main__":
    main()
