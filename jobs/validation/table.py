"""Tables 6.1 and 6.2 of the paper with our errors beside its own, and its Figures 6.2 and 6.3: FE, EFG and mixed.

python jobs/validation/table.py [FOLDER]   (out/validation)

Runs what has not been run yet, one after the other on one rank, some half an hour in all; goes on where it was stopped.
Writes validation.csv, validation.md and validation_profiles.png in jobs/studies. Errors are the largest of each
component, in mm, against tests/data, at places that are not prescribed.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from drawing import Profile, draw_profiles
from numpy.typing import NDArray

from mpitled.batch import launch
from mpitled.cells import hexahedra
from mpitled.meshing.scatter import fibonacci_sphere
from mpitled.results import compare, field

HERE = Path(__file__).parent
REFERENCES, STUDIES = HERE.parents[1] / "tests" / "data", HERE.parent / "studies"
#: What the cloud replaces.
KINDS = {"none": "FE", "all": "EFG", "core": "mixed"}
#: Relaxed so that what is left of it is nothing beside the errors; nothing but the solution is written.
ALWAYS = ("solver.method=dynamic-relaxation", "solver.tolerance=0.002", "output.frames=1", "output.pictures=false")
VOLUMES = {"261.8": (0.0076, 0.0082, 0.0061), "523.6": (0.0188, 0.0007, 0.0112), "817.3": (0.0273, 0.0133, 0.0617)}
#: A seed of 2 mm grown to this (m) in the middle of a sphere; meshes; and bands of distance from the middle, m, that
#: begin a node's spacing outside the seed.
SHELL_RADIUS = 5e-3
SHELLS: dict[str, tuple[str, ...]] = {
    "deck's": (),
    "fine": (
        "cloud.growth=0.063", "tumour.surface_nodes=2800", "ellipsoid.element_size=2.7", "cloud.radius=24",
        "solver.tolerance=1e-5",
    ),
}  # fmt: skip
SHELL_BANDS = (2.25e-3, 6e-3, 18e-3, 30e-3, 45e-3, 55e-3)


@dataclass(frozen=True, slots=True)
class Scene:
    """A row of the paper's Table 6.1 or of what stands beside it."""

    title: str
    deck: str
    reference: str
    beyond: float  # mm from edges that are singular; 0: there are none
    goal: float  # mm beyond them at the finest mesh, without the reference's own error
    overrides: tuple[str, ...] = ()
    paper: tuple[float, float, float] | None = None  # mm
    geometry: str = "cylinder"
    finest: str = "cylinder.element_size=3"
    finest_cloud: tuple[str, ...] = ()  # where the cloud replaces all; () for the same


_TORSION, _CUBE = "block.elements=[12,12,48]", "block.elements=[16,16,16]"
_BALL = "ellipsoid.element_size=3"
# Clouds that press nothing in a mould and grow nothing need less to hold their modes; the same at nu = 0.49 and 0.499.
_CLOUD = ("cylinder.element_size=1.75", "support.stabilisation=0.03")
_NEARLY_CLOUD = ("cylinder.element_size=1.75", "support.stabilisation=0.003")
_BAR_CLOUD = ("block.elements=[16,16,64]",)
_BALL_CLOUD = ("ellipsoid.element_size=1.6", "support.stabilisation=0.03")
_BUMP_CLOUD = ("ellipsoid.element_size=2",)
_NEARLY = "material.brain.poissons_ratio=0.499"


def _pushed(x: float, z: float) -> str:
    return f"displaced.0.displacement=[{x:g},0,{z:g}]"


SCENES = (
    Scene("extension 20 %", "cylinder", "A_ext", 5, 0.05, (), (0.1744, 0.0055, 0.0694), finest_cloud=_CLOUD),
    Scene(
        "compression 20 %", "cylinder", "A_comp", 10, 0.15, (_pushed(0, -20),), (0.1058, 0.0177, 0.0672),
        finest_cloud=_CLOUD,
    ),
    Scene("compression 10 %", "cylinder", "A_comp10", 5, 0.05, (_pushed(0, -10),), finest_cloud=_CLOUD),
    Scene(
        "shear 20 %", "cylinder", "A_shear", 5, 0.05, (_pushed(20, 0),), (0.0193, 0.0273, 0.0097), finest_cloud=_CLOUD
    ),
    Scene("extension, nu 0.499", "cylinder", "E1_ext", 5, 0.05, (_NEARLY,), finest_cloud=_NEARLY_CLOUD),
    Scene(
        "compression, nu 0.499", "cylinder", "E1_comp", 10, 0.15, (_NEARLY, _pushed(0, -20)),
        finest_cloud=_NEARLY_CLOUD,
    ),
    Scene(
        "indentation", "indentation", "B_ind", 10, 0.15, (), (0.1628, 0.0734, 0.1055), "ellipsoid", _BALL, _BALL_CLOUD
    ),
    Scene("bump", "bump", "B_bump", 0, 0.05, (), None, "ellipsoid", _BALL, _BUMP_CLOUD),
    Scene("soft sphere", "inclusion", "E2_inc", 0, 0.05, (), None, "block", "block.elements=[10,10,10]"),
    Scene("torsion 90 deg", "torsion", "E4_torsion", 5, 0.05, (), None, "block", _TORSION, _BAR_CLOUD),
    Scene("cube, to 50 %", "cube", "E3_cube_stress_50", 0, 0.05, (), None, "block", _CUBE),
    Scene(
        "cube, to 40 %", "cube", "E3_cube_stress_60", 0, 0.05, ("displaced.0.displacement=[-30]",), None, "block", _CUBE
    ),
    Scene(
        "cube, confined, to 50 %", "cube", "E3_cube_strain_50", 0, 0.05,
        ("fixed.0.nodes=surface", "fixed.1.nodes=surface"), None, "block", _CUBE,
    ),
)  # fmt: skip


def _folder(out: Path, *words: str) -> Path:
    return out / "".join(c if c.isalnum() or c in "._" else "-" for c in "-".join(words))


def solved(folder: Path, deck: str, overrides: Sequence[str]) -> str:
    """Run a deck if it has not run yet; the reason of its failure, "" if it has a solution."""
    if (failure := launch.outcome(folder)) is None:
        print(folder.name, file=sys.stderr, flush=True)
        failure = launch.run_apart(HERE / f"{deck}.toml", (*ALWAYS, *overrides), 1, folder)
    return failure


def errors(folder: Path, reference: str, beyond: float) -> dict[str, Any]:
    """Largest errors, mm, of a run: everywhere and beyond so far (mm) from edges, with what the run took."""
    report = json.loads((folder / "report.json").read_text())
    row = {
        "cells": sum(report["cells"].values()),
        "steps": report["steps"],
        "loop_s": report["seconds"]["loop"],
        "static_distance_mm": report["static_distance_mm"],
        "min_J": report["min_jacobian"],
    }
    groups = compare.compare(folder, REFERENCES / f"{reference}.npz", beyond / 1e3)["groups"]
    for name, group in (("all", "free"), ("beyond", "free beyond")):
        found = groups[group]
        row |= {
            f"{name}_{axis}": error for axis, error in zip(("x", "y", "z", "norm"), found["largest_mm"], strict=True)
        }
        row[f"{name}_reference"] = found["reference_error_mm"] or 0.0
    return row


def table_61(out: Path, finest: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Every scene in its deck's mesh, in the finest mesh for these keys of KINDS, and FE in some other meshes."""
    for scene in SCENES:
        variants: list[tuple[str, str, tuple[str, ...]]] = [(kind, "deck's", ()) for kind in KINDS]
        variants += [(kind, "finest", ()) for kind in finest]
        if scene.paper and scene.deck == "cylinder":
            variants.append(("none", "3,000 hexahedra", ("cylinder.element_size=6.3",)))
        if _NEARLY in scene.overrides:
            variants.append(("none", "deck's, hourglass / 10", ("hexahedra.hourglass=0.00044444",)))
            variants.append(("all", "deck's, stabilisation / 100", ("support.stabilisation=0.001",)))
        for kind, mesh, keys in variants:
            fine = scene.finest_cloud if kind == "all" and scene.finest_cloud else (scene.finest,)
            given = (*scene.overrides, f"{scene.geometry}.cloud={kind}", *keys, *(fine * (mesh == "finest")))
            folder = _folder(out, scene.reference, KINDS[kind], mesh)
            row: dict[str, Any] = {"scene": scene.title, "kind": KINDS[kind], "mesh": mesh}
            row["failure"] = solved(folder, scene.deck, given)
            if not row["failure"]:
                row |= errors(folder, scene.reference, scene.beyond)
                row["goal"] = scene.goal + row["beyond_reference"]
            if scene.paper:
                row |= {f"paper_{axis}": error for axis, error in zip("xyz", scene.paper, strict=True)}
            yield row


def table_62(out: Path) -> Iterator[dict[str, Any]]:
    """Tumours: FE in shells around the seed, the paper's kind of FE mesh, mixed and EFG; errors and how cells fare."""
    # The mixed mesh first, from which the others differ.
    kinds = {
        "mixed": ("core", "fitted"), "EFG": ("all", "fitted"), "FE, fitted": ("none", "fitted"),
        "FE, moved": ("none", "moved"),
    }  # fmt: skip
    for volume in (*VOLUMES, "3053.6"):
        for name, (cloud, cavity) in kinds.items():
            folder = _folder(out, "C_tum", volume, name)
            row: dict[str, Any] = {"scene": f"tumour {volume} mm3", "kind": name, "mesh": "deck's"}
            keys = (f"tumour.volume={volume}", f"ellipsoid.cloud={cloud}", f"ellipsoid.cavity={cavity}")
            row["failure"] = solved(folder, "tumour", keys)
            if not row["failure"]:
                row |= errors(folder, "C_tum", 0) | distortion(folder)
                row["from_mixed"] = difference(folder, _folder(out, "C_tum", volume, "mixed"))
            yield row


def table_shell(out: Path) -> Iterator[dict[str, Any]]:
    """A seed grown in the middle of a sphere, whose solution is known along the radius: the mixed meshes of SHELLS."""
    with np.load(REFERENCES / "C_shell_ode.npz") as data:
        reference = dict(data)
    exact = reference["u"][np.abs(reference["R"] - SHELL_RADIUS).argmin()]
    for mesh, keys in SHELLS.items():
        folder = _folder(out, "C_shell", mesh)
        row: dict[str, Any] = {"scene": "expanded shell", "kind": "mixed", "mesh": mesh}
        row["failure"] = solved(folder, "shell", keys)
        if not row["failure"]:
            report = json.loads((folder / "report.json").read_text())
            row |= {
                "cells": sum(report["cells"].values()),
                "steps": report["steps"],
                "loop_s": report["seconds"]["loop"],
                "static_distance_mm": report["static_distance_mm"],
            }
            row |= shares(field.open_field(folder), reference["rho"], exact)
        yield row


def shares(ours: field.Field, rho: NDArray[np.float64], exact: NDArray[np.float64]) -> dict[str, float]:
    """Largest distance from radial displacements u(rho), m, as a share of them, at free nodes and between, by bands.

    Between nodes the places are 4,000, in 100 directions.
    """
    held, _ = field.prescribed(ours.model)
    nodes = ours.model.points[~held]
    radii = np.geomspace(SHELL_BANDS[0], SHELL_BANDS[-1], 40, endpoint=False)
    places = (radii[:, None, None] * fibonacci_sphere(100)).reshape(-1, 3)
    points = np.concatenate([nodes, places])
    found = np.concatenate([ours.at_nodes[~held], ours.at(places).displacement])
    distance = np.linalg.norm(points, axis=1)
    true = np.interp(distance, rho, exact)
    share = np.linalg.norm(found - (true / distance)[:, None] * points, axis=1) / true
    of_node = np.arange(len(points)) < len(nodes)
    row = {}
    for low, high in pairwise(SHELL_BANDS):
        within = (distance >= low) & (distance < high)
        for name, chosen in (("nodes", within & of_node), ("places", within & ~of_node)):
            if chosen.any():
                row[f"{name}_{1e3 * low:g}"] = float(share[chosen].max())
    return row


def distortion(folder: Path) -> dict[str, float]:
    """Of the hexahedra: the least J of a corner, and by how much the most compressed shrinks in its worst direction."""
    ours = field.open_field(folder)
    model, now = ours.model, ours.model.points + ours.parameters
    if not len(model.hexahedra):
        return {}
    before, after = (hexahedra.corner_jacobians(points, model.hexahedra) for points in (model.points, now))
    gradients, _ = hexahedra.geometry(model.points, model.hexahedra)
    stretches = np.linalg.svd(np.einsum("nai,naj->nij", now[model.hexahedra], gradients), compute_uv=False)
    return {"corner_J": float((after / before).min()), "compression": float(1 - stretches.min())}


def difference(folder: Path, other: Path) -> str:
    """Largest differences of two runs in x, y, z, mm, at the reference's places in the tissue; "" if there are none."""
    if launch.outcome(other) != "" or folder == other:
        return ""
    ours, theirs = field.open_field(folder), field.open_field(other)
    reference = compare.read_reference(REFERENCES / "C_tum.npz", ours)
    assert reference.tag is not None
    places = reference.positions[reference.tag == compare.TAGS.index("interior")]
    apart = np.abs(ours.at(places).displacement - theirs.at(places).displacement).max(axis=0)
    return _three(1e3 * apart)


def profiles(out: Path) -> list[Profile]:
    """The free sides of the cylinder, and the ellipsoid's surface, in the decks' meshes."""
    found = []
    for scene in SCENES:
        if scene.paper:
            runs = {}
            for kind in KINDS.values():
                folder = _folder(out, scene.reference, kind, "deck's")
                if launch.outcome(folder) == "":
                    ours = field.open_field(folder)
                    line = compare.read_reference(REFERENCES / f"{scene.reference}_profile.npz", ours)
                    runs[kind] = 1e3 * ours.at(line.positions).displacement
            found.append(Profile(scene.title, 1e3 * line.positions, 1e3 * line.displacement, runs))
    return found


def _three(values: Sequence[float]) -> str:
    return " / ".join(f"{value:.3f}" for value in values)


def _shortly(failure: str) -> str:
    return failure.partition(";")[0]


def _found(row: dict[str, Any], name: str) -> str:
    return _three([row[f"{name}_{axis}"] for axis in "xyz"])


_FIRST = """# The paper's validation

Written by `python jobs/validation/table.py`; all columns are in `validation.csv`. Largest errors in x / y / z, mm,
against `tests/data`, at places that are not prescribed. *Beyond* is 5 mm from edges of prescribed and free surface,
10 mm in 20 % compression and indentation, whose references are singular there; where there are no such edges, it is
everywhere. The goal, for each component at the finest mesh, is 0.05 mm (0.15 mm in those two) and the reference's own
error; what misses it is in bold. Clouds alone are finest at 1.6 to 2 mm, and cylinder and indentation take
`support.stabilisation=0.03` there, 0.003 at nu = 0.499: nothing in them grows or is pressed in a mould.

## Table 6.1

| scene | cells | mesh | number | all | beyond | goal | paper |
|---|---|---|---:|---|---|---:|---|
"""
_SECOND = """
A cube pressed between frictionless platens does not keep its homogeneous state: below a stretch of 0.54 its free edges
buckle, in the shorter waves the sooner, and the cube tilts. Confined to half its volume it is under a pressure of 25
shear moduli, to which support domains give way at the default `support.stabilisation`. The deck of the cube holds both
by `hexahedra.hourglass = 2` and `support.stabilisation = 2`, which see no affine field and so leave the solution as it
is.

Towards nu = 0.5 EFG alone locks: support domains' modes that their gradient does not see are held by a share of
lambda + 2 mu, which is ten times larger at nu = 0.499 than at 0.49. Hourglass control has a limit there; these modes
have none, for beside a tumour they hold against pressure. *Stabilisation / 100* (`support.stabilisation=0.001`) is no
farther off than the default at nu = 0.49. *Hourglass / 10* is as good in extension, but gives way at the platens' edges
in compression.

NiftySim, with 3,072 one-point hexahedra and its own law: 0.25 / 0.25 / 0.18 in extension, 0.30 / 0.31 / 0.44 in
compression, 0.38 / 0.38 / 0.35 in shear.

## Table 6.2

J is the least of a cell, at its centre; corner J the least of a hexahedron's corners; compression how much the most
compressed hexahedron shrinks in its worst direction. The last columns are largest differences from the mixed mesh.

| tumour | cells | number | error | J | corner J | compression | from mixed | paper |
|---|---|---:|---|---:|---:|---:|---|---|
"""
_THIRD = f"""
## Expanded shell

A seed of 2 mm radius grown to 5 mm in the middle of a sphere of 60 mm radius (`shell.toml`), whose solution is known
along the radius. Largest distance from it of the mixed mesh, as a share of the displacement there, by distance from
the middle, at nodes / between them.

| mesh | keys | number | {" | ".join(f"{1e3 * low:g} to {1e3 * high:g} mm" for low, high in pairwise(SHELL_BANDS))} |
|---|---|---:|{"---|" * (len(SHELL_BANDS) - 1)}
"""


def markdown(first: list[dict[str, Any]], second: list[dict[str, Any]], third: Sequence[dict[str, Any]] = ()) -> str:
    """All tables; in the first, what misses its goal at the finest mesh is in bold."""
    lines = _FIRST.splitlines()
    for row in first:
        paper = _three([row[f"paper_{axis}"] for axis in "xyz"]) if "paper_x" in row else ""
        head = f"| {row['scene']} | {row['kind']} | {row['mesh']} |"
        if row["failure"]:
            lines.append(f"{head} | {_shortly(row['failure'])} | | | {paper} |")
            continue
        beyond = _found(row, "beyond")
        goal = f"{row['goal']:.3f}" if row["mesh"] == "finest" else ""
        if goal and max(row[f"beyond_{axis}"] for axis in "xyz") > row["goal"]:
            beyond = f"**{beyond}**"
        lines.append(f"{head} {row['cells']:,} | {_found(row, 'all')} | {beyond} | {goal} | {paper} |")
    lines += _SECOND.splitlines()
    for row in second:
        volume = row["scene"].split()[1]
        paper = _three(VOLUMES[volume]) if volume in VOLUMES and row["kind"] == "FE, moved" else ""
        head = f"| {volume} mm3 | {row['kind']} |"
        if row["failure"]:
            lines.append(f"{head} | {_shortly(row['failure'])} | | | | | {paper} |")
            continue
        corner = f"{row['corner_J']:.3f} | {row['compression']:.0%}" if "corner_J" in row else " | "
        lines.append(
            f"{head} {row['cells']:,} | {_found(row, 'all')} | {row['min_J']:.3f} | {corner} | "
            f"{row['from_mixed']} | {paper} |"
        )
    lines += _THIRD.splitlines()
    for row in third:
        head = f"| {row['mesh']} |"
        if row["failure"]:
            lines.append(f"{head} | | {_shortly(row['failure'])} |")
            continue
        keys = ", ".join(f"`{key}`" for key in SHELLS[row["mesh"]])
        bands = (
            " / ".join(f"{row[name]:.1%}" for kind in ("nodes", "places") if (name := f"{kind}_{1e3 * low:g}") in row)
            for low in SHELL_BANDS[:-1]
        )
        lines.append(f"{head} {keys} | {row['cells']:,} | {' | '.join(bands)} |")
    return "\n".join(lines) + "\n"


def write(rows: Sequence[dict[str, Any]], text: str) -> None:
    """Both files of the tables."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with (STUDIES / "validation.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(
            {name: f"{value:.4g}" if isinstance(value, float) else value for name, value in row.items()} for row in rows
        )
    (STUDIES / "validation.md").write_text(text)


def main() -> None:
    """Run the decks' meshes, then the finest, FE first; write what came out after each."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/validation")
    STUDIES.mkdir(exist_ok=True)
    second: list[dict[str, Any]] = []
    third: list[dict[str, Any]] = []
    for finest in ((), ("none",), ("none", "core"), tuple(KINDS)):
        first = list(table_61(out, finest))
        second = second or list(table_62(out))
        third = third or list(table_shell(out))
        write([*first, *second, *third], markdown(first, second, third))
        draw_profiles(profiles(out), STUDIES / "validation_profiles.png")


if __name__ == "__main__":
    main()
