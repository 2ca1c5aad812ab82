"""What a user asks of a run, in the user's units: report.json, a table, and pictures.

All displacements are those of the field u_h: at EFG nodes that is not their parameter (a tumour's surface, which moves
as prescribed, is the exception, and is reported both ways).
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import atomic, store
from mpitled.cells import hexahedra
from mpitled.errors import InputError, damaged
from mpitled.meshing.faces import boundary_faces, interface_faces
from mpitled.model import Model
from mpitled.results.solid import Solid, solid_of

REPORT, MODEL = "report.json", "model.h5"
#: Displacements beyond this are large (paper, 6.2), m.
LARGE = 5e-3
#: What is warned of: energy of hourglass control and stabilisation as a share of the internal energy (right results
#: have had up to 0.15, wrong ones from 0.3); a wrong volume balance; a distance to the static solution, and a misfit of
#: the cloud, mm.
ARTIFICIAL, UNBALANCED, FAR = 0.2, 0.05, 0.5
#: Poisson's ratios above this are nearly incompressible; cells below this J have lost much.
INCOMPRESSIBLE, CRUSHED = 0.495, 0.5
#: What is warned of: volume in such cells as a share of the tumour's.
MUCH_CRUSHED = 0.02
VENTRICLES = {"left": "left_ventricle", "right": "right_ventricle"}
#: Exact to degree 3 in each coordinate; a bilinear face's volume integrand has degree 2.
_GAUSS = (-(3**-0.5), 3**-0.5)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The model and where a run took it, at the last frame; SI units and the model's order."""

    model: Model
    field: NDArray[np.float64]  # (n_nodes, 3), m, u_h
    displacement: NDArray[np.float64]  # (n_nodes, 3), m, as prescribed or computed: parameters at EFG nodes
    domain_displacement: NDArray[np.float64]  # (n_domains, 3), m, u_h at integration points
    jacobian: NDArray[np.float64]  # (n_cells,)
    time: float  # s
    complete: bool  # whether the run came to its end
    metadata: dict[str, Any]  # what it was started with
    figures: dict[str, Any]  # what it ended with; empty if it was killed

    @property
    def title(self) -> str:
        """Of the scene; there is always one."""
        return self.metadata.get("title") or "mpitled"

    @property
    def seed(self) -> NDArray[np.int64]:
        """Nodes on the surface of the tumour; none without one."""
        return self.model.node_sets.get("tumour", np.empty(0, np.int64))

    @property
    def centre(self) -> NDArray[np.float64] | None:
        """The tumour's centre (3,), m."""
        tumour = self.metadata.get("tumour")
        return np.array(tumour["centre_m"]) if tumour else None

    @property
    def moved(self) -> NDArray[np.float64]:
        """(n_nodes, 3), m: the field, and the tumour's surface as prescribed."""
        moved = self.field.copy()
        moved[self.seed] = self.displacement[self.seed]
        return moved

    @property
    def solid(self) -> Solid:
        """As it is drawn; made at each call."""
        return solid_of(self.model, self.moved, anatomical="labels" in self.metadata.get("deck", {}))


def write(directory: Path, seconds: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Make the report of the run in a directory, and keep it; errors as both."""
    report = make(directory, seconds)
    keep(directory, report)
    return report


def make(directory: Path, seconds: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Compute the report of the run in a directory, and draw the pictures there, if it lets itself be written.

    `seconds` are the phases of a run that is at its end. InputError if the directory holds no results, or they and
    the model do not belong together.
    """
    begin = time.perf_counter()
    directory = Path(directory)
    outcome = read(directory)
    report = compute(outcome)
    report["pictures"] = _draw(outcome, directory)
    phases = dict(seconds or report.get("seconds", {}))
    took = {"report": time.perf_counter() - begin} if seconds else _first_report(directory, phases)
    report["seconds"] = phases | took
    return dict(_without_nan(report))


def _first_report(directory: Path, phases: Mapping[str, float]) -> dict[str, float]:
    """What the run itself took for its report: looking at it again must not change how long it ran."""
    try:
        kept = dict(json.loads((directory / REPORT).read_text(encoding="utf-8"))["seconds"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return {"report": kept["report"]} if kept.keys() - phases.keys() == {"report"} else {}


def keep(directory: Path, report: Mapping[str, Any]) -> None:
    """Write report.json into the run's directory. InputError if the disc refuses."""
    atomic.write_text(directory / REPORT, json.dumps(report, indent=2, allow_nan=False) + "\n")


def read(directory: Path) -> Outcome:
    """The last frame of the run in a directory, and its model; errors as `write`."""
    if not directory.is_dir():
        raise InputError(f"{directory}: is no folder; give the one that 'mpitled run' wrote")
    with store.open_result(directory) as result, damaged(result.path, "run the deck again"):
        if result.n_frames == 0:
            raise InputError(f"{result.path}: holds no frame yet; run the deck again")
        model = store.read_model(directory / MODEL)
        if not np.array_equal(result.node_points, model.points) or len(result.in_cells("J")) != model.n_cells:
            raise InputError(f"{result.path}: is not of the model beside it, {MODEL}; run the deck again")
        return Outcome(
            model=model,
            field=result.at_nodes("displacement", -1),
            displacement=result.at_nodes("parameters", -1),
            domain_displacement=result.at_integration_points("displacement", -1),
            jacobian=result.in_cells("J", -1),
            time=float(result.times[-1]),
            complete=result.complete,
            metadata=result.metadata,
            figures=result.figures,
        )


def compute(outcome: Outcome) -> dict[str, Any]:
    """The report as plain numbers by key; what a scene does not have is absent."""
    model, field = outcome.model, outcome.field
    size = np.linalg.norm(field, axis=1)
    fe_volumes = hexahedra.volumes(model.points, model.hexahedra)
    volumes = np.concatenate([fe_volumes, model.domain_volumes])
    at_cells = np.concatenate([field[model.hexahedra].mean(axis=1), outcome.domain_displacement])
    large = np.linalg.norm(at_cells, axis=1) > LARGE
    report: dict[str, Any] = {
        "title": outcome.metadata.get("title", ""),
        "complete": outcome.complete,
        "load_share": min(1.0, outcome.time / outcome.metadata["load_time_s"]),
        "max_displacement_mm": 1e3 * float(size.max()),
        "share_over_5mm": {
            "volume": float(volumes[large].sum() / volumes.sum()),
            "nodes": float(np.mean(size > LARGE)),
        },
    }
    if len(outcome.seed):
        outside = np.linalg.norm(_outside_first_ring(outcome), axis=1)
        if len(outside):
            report["max_displacement_outside_first_ring_mm"] = 1e3 * float(outside.max())
    if model.n_nodes > model.n_fe_nodes:
        # What the cloud's polynomials leave of the values that they are fitted to: where that is much they cannot
        # follow the field, which is then wrong by about as much (told 0.8 to 3.8 times, in 14 grown spheres).
        misfit = np.linalg.norm((outcome.field - outcome.displacement)[model.n_fe_nodes :], axis=1)
        report["cloud_misfit_mm"] = 1e3 * float(misfit.max())
        report["cloud_misfit_of_90_percent_mm"] = 1e3 * float(np.quantile(misfit, 0.9))
    report |= _ventricles(outcome, fe_volumes)
    if outcome.centre is not None and len(outcome.seed):
        report |= _tumour(outcome, outcome.centre)
    report |= _smallest(outcome, volumes) | outcome.figures
    if solver := outcome.metadata.get("deck", {}).get("solver"):
        report["method"] = solver["method"]
        if solver["method"] == "dynamic-relaxation":  # whose time is fictitious
            report.pop("time_step_s", None)
    # What there is of a run that was stopped is not taken for a result, and its figures are off for that reason.
    report["warnings"] = [*model.warnings, *(_warnings(report, model) if outcome.complete else ())]
    return report


def unfound(balance: Mapping[str, float]) -> float:
    """What of the added volume (mm^3) a volume balance did not find; below 0 if it found more."""
    return balance["tumour_added_mm3"] - balance["pushed_through_interface_mm3"] - balance["elastic_compression_mm3"]


def _warnings(report: Mapping[str, Any], model: Model) -> list[str]:
    """Why a result may not be what it seems, and the remedy."""
    found = []
    relaxed = report.get("method") == "dynamic-relaxation"
    energy = report.get("energy_J", {})
    if energy.get("internal", 0) > 0:
        share = (energy["hourglass"] + energy["stabilisation"]) / energy["internal"]
        if share > ARTIFICIAL:
            # What resists these modes is a share of lambda + 2 mu, which has no bound towards 0.5.
            stiff = max(material.poissons_ratio for material in model.materials) > INCOMPRESSIBLE
            remedy = "lower material.NAME.poissons_ratio (0.49)" if stiff else "raise support.stabilisation"
            found.append(
                f"{share:.0%} of the internal energy is in modes that no cell's strain sees, so the displacements are "
                f"not to be trusted: refine the mesh or the cloud, or {remedy}"
            )
    balance = report.get("volume_balance", {})
    if (error := balance.get("relative_error", 0.0)) > UNBALANCED:
        wrong = "of the grown volume is lost" if unfound(balance) > 0 else "more volume is displaced than was grown"
        found.append(f"{error:.0%} {wrong}: refine the cloud around the tumour (cloud.growth)")
    crushed, tumour = report["crushed"]["volume_mm3"], report.get("tumour_volume_mm3", math.inf)
    if crushed > MUCH_CRUSHED * tumour:
        found.append(
            f"{crushed:.3g} mm3 of tissue, {crushed / tumour:.1%} of the tumour's volume, is in cells that lost over "
            "half of theirs: beside the tumour the field is not to be trusted; refine the cloud there (cloud.growth)"
        )
    if (misfit := report.get("cloud_misfit_mm", 0.0)) > FAR:
        # Next to a grown seed the spacing on its surface decides, and a finer cloud behind it changes little.
        keys = "raise tumour.surface_nodes: four times as many halve it" if "volume_balance" in report else ""
        most = report["cloud_misfit_of_90_percent_mm"]
        found.append(
            f"the cloud is too coarse for its field, which is uncertain by {misfit:.2g} mm at its worst node, and by "
            f"{most:.2g} mm at most at 90 % of its nodes: refine it there ({keys or 'lower cloud.spacing'})"
        )
    if (distance := report.get("static_distance_mm", 0.0)) > FAR:
        remedy = 'load more slowly (solver.load_time), or take solver.method = "dynamic-relaxation"'
        found.append(
            f"the run ended {distance:.2g} mm from the static solution: "
            f"{'lower solver.tolerance' if relaxed else remedy}"
        )
    elif report.get("method") == "quasi-static" and "static_distance_mm" not in report:
        found.append(
            "how far the ramp ended from the static solution could not be found: load more slowly (solver.load_time), "
            'or take solver.method = "dynamic-relaxation"'
        )
    return found


def incomplete(report: Mapping[str, Any]) -> str:
    """What there is of a run that did not come to its end, and why, if it could say so."""
    stopped = f"; {report['stopped']}" if "stopped" in report else ""
    return f"not complete: the last frame is at {report['load_share']:.1%} of the load{stopped}"


def table(report: Mapping[str, Any], *, whole: bool = True) -> str:
    """The report for people to read, or the few figures that decide what to do next; what is absent is absent here."""
    lines = [report["title"]] if report["title"] else []
    if not report["complete"]:
        lines.append(incomplete(report))
    lines += [f"  {name:<47}  {value}" for name, value in rows(report, whole=whole)]
    lines += [f"  warning: {text}" for text in report["warnings"]]
    pictures = report["pictures"]
    lines.append(f"  {'pictures':<47}  {', '.join(pictures) if isinstance(pictures, list) else pictures}")
    return "\n".join(lines)


# --- what is computed ----------------------------------------------------------------------------------------------


def enclosed_volume(points: NDArray[np.float64], faces: NDArray[np.int64]) -> float:
    """Volume (m^3) inside a closed surface of bilinear faces (n, 4), anticlockwise seen from outside; exact.

    (1/3) of the integral of x . n: the faces of trilinear hexahedra are such, so that volumes add up to round-off.
    """
    a, b, c, d = np.moveaxis(points[faces], 1, 0)
    total = 0.0
    for r in _GAUSS:
        for s in _GAUSS:
            x = ((1 - r) * (1 - s) * a + (1 + r) * (1 - s) * b + (1 + r) * (1 + s) * c + (1 - r) * (1 + s) * d) / 4
            along_r = (1 - s) * (b - a) + (1 + s) * (c - d)
            along_s = (1 - r) * (d - a) + (1 + r) * (c - b)
            total += float((x * np.cross(along_r, along_s)).sum()) / 48
    return total


def _outside_first_ring(outcome: Outcome) -> NDArray[np.float64]:
    """Displacements (n, 3), m, at nodes and integration points that no cell with a node of the tumour has."""
    model = outcome.model
    on_seed = np.zeros(model.n_nodes, bool)
    on_seed[outcome.seed] = True
    ring_domains = on_seed[model.domains].any(axis=1)
    outside = np.ones(model.n_nodes, bool)
    outside[model.domains[ring_domains]] = False
    outside[model.hexahedra[on_seed[model.hexahedra].any(axis=1)]] = False
    return np.concatenate([outcome.field[outside], outcome.domain_displacement[~ring_domains]])


def _ventricles(outcome: Outcome, fe_volumes: NDArray[np.float64]) -> dict[str, Any]:
    """Volumes of the ventricles' hexahedra, their change (negative: they shrink), and how far their walls moved."""
    model = outcome.model
    before, change, wall = {}, {}, {}
    for side, cells in _in_ventricles(model).items():
        after = hexahedra.volumes(model.points + outcome.field, model.hexahedra[cells])
        before[side] = 1e6 * float(fe_volumes[cells].sum())
        change[side] = 1e6 * float((after - fe_volumes[cells]).sum())
        on_wall = np.unique(boundary_faces(model.hexahedra[cells]))
        wall[side] = 1e3 * float(np.linalg.norm(outcome.field[on_wall], axis=1).max())
    if not before:
        return {}
    return {
        "ventricle_volume_ml": before | {"total": sum(before.values())},
        "ventricle_volume_change_ml": change | {"total": sum(change.values())},
        "max_displacement_of_ventricle_wall_mm": wall,
        **({"midline_shift_mm": shift} if (shift := _midline_shift(outcome, fe_volumes)) is not None else {}),
    }


def _in_ventricles(model: Model) -> dict[str, NDArray[np.int64]]:
    """Hexahedra of each ventricle that there is, left first."""
    sets = {side: model.cell_sets.get(name, np.empty(0, np.int64)) for side, name in VENTRICLES.items()}
    found = {side: cells[cells < len(model.hexahedra)] for side, cells in sets.items()}
    return {side: cells for side, cells in found.items() if len(cells)}


def _midline_shift(outcome: Outcome, fe_volumes: NDArray[np.float64]) -> float | None:
    """How far what lies between the ventricles moves across the midline, mm: the largest, above 0 to the right.

    The midline's plane halves the way between the ventricles' middles and is normal to it. Of the nodes within half a
    hexahedron of it those count that lie as far front and back, up and down as the ventricles do. None without two.
    """
    model = outcome.model
    sides = _in_ventricles(model)
    if len(sides) < 2:
        return None
    nodes = [np.unique(model.hexahedra[cells]) for cells in sides.values()]
    left, right = (model.points[of].mean(axis=0) for of in nodes)
    across = (right - left) / np.linalg.norm(right - left)
    from_plane = model.points @ across - (left + right) @ across / 2
    # Where they lie, seen along the way across.
    flat = model.points - np.outer(model.points @ across, across)
    both = flat[np.concatenate(nodes)]
    between = ((flat >= both.min(axis=0)) & (flat <= both.max(axis=0))).all(axis=1)
    near = np.abs(from_plane) <= float(np.cbrt(fe_volumes.mean())) / 2
    shifts = (outcome.field @ across)[between & near]
    return 1e3 * float(shifts[np.abs(shifts).argmax()]) if len(shifts) else None


def _smallest(outcome: Outcome, volumes: NDArray[np.float64]) -> dict[str, Any]:
    """Where J is smallest in the last frame, and how much of the body is in cells that lost much of their volume."""
    model, jacobian = outcome.model, outcome.jacobian
    cell, n = int(np.argmin(jacobian)), len(model.hexahedra)
    place = model.points[model.hexahedra[cell]].mean(axis=0) if cell < n else model.domain_points[cell - n]
    crushed = jacobian < CRUSHED
    return {
        "smallest_jacobian": {
            "now": float(jacobian[cell]),
            "cell": "hexahedron" if cell < n else "support domain",
            "material": model.materials[model.material[cell]].name,
            "place_mm": (1e3 * place).tolist(),
        },
        "crushed": {"cells": int(crushed.sum()), "volume_mm3": 1e9 * float(volumes[crushed].sum())},
    }


def _tumour(outcome: Outcome, centre: NDArray[np.float64]) -> dict[str, Any]:
    """Volume of the tumour as reached, by its nodes and by the field there, and where the added volume went.

    The volume is that of the sphere of which the nodes are a sample, (4 pi / 3) mean r^3: their hull would be short of
    it by the caps between them. Its integral of r^3 over the solid angle holds for the field's bumpy surface as well.
    """
    model, seed = outcome.model, outcome.seed

    def volume(displacement: NDArray[np.float64]) -> float:
        cubes = np.linalg.norm(model.points[seed] + displacement[seed] - centre, axis=1) ** 3
        return 4 / 3 * math.pi * float(cubes.mean())

    reached = volume(outcome.displacement)
    report: dict[str, Any] = {
        "tumour_volume_mm3": 1e9 * reached,
        "tumour_volume_by_field_mm3": 1e9 * volume(outcome.field),
    }
    interface = model.node_sets.get("interface", np.empty(0, np.int64))
    faces = interface_faces(model.points, model.hexahedra, interface, model.domain_points)
    if len(faces) and not np.any(outcome.field[_rim(faces)]):
        added = reached - 4 / 3 * math.pi * outcome.metadata["tumour"]["seed_radius_m"] ** 3
        pushed = enclosed_volume(model.points, faces) - enclosed_volume(model.points + outcome.field, faces)
        compressed = float((model.domain_volumes * (1 - outcome.jacobian[len(model.hexahedra) :])).sum())
        report["volume_balance"] = {
            "tumour_added_mm3": 1e9 * added,
            "pushed_through_interface_mm3": 1e9 * pushed,
            "elastic_compression_mm3": 1e9 * compressed,
            "relative_error": abs(added - pushed - compressed) / added if added > 0 else math.nan,
        }
    return report


def _rim(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Nodes where a surface of faces (n, 4) ends: edges that no other face runs along the other way."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    base = int(faces.max()) + 1
    forth, back = edges[:, 0] * base + edges[:, 1], edges[:, 1] * base + edges[:, 0]
    return np.unique(edges[~np.isin(forth, back)])


def _draw(outcome: Outcome, directory: Path) -> list[str] | str:
    """Names of the pictures drawn, or why there are none."""
    if not outcome.metadata.get("deck", {}).get("output", {}).get("pictures", True):
        return "none, for output.pictures is false"
    try:
        import matplotlib  # noqa: F401  (optional: only the pictures need it)
    except ImportError:
        return "none, for matplotlib is missing; install it: pip install 'mpitled[pictures]'"
    from mpitled.results import plot

    try:
        return plot.draw(directory, outcome.solid, outcome.centre, outcome.title)
    except OSError as error:
        return f"none, for they cannot be written ({error.strerror})"


def _without_nan(value: Any) -> Any:
    """The same with None for numbers that JSON does not have."""
    if isinstance(value, Mapping):
        return {name: _without_nan(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_without_nan(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# --- the table -----------------------------------------------------------------------------------------------------

#: Key, name and format of each line of the table; parts of a key are listed as they are. With `_HEADLINES`, which are
#: what was asked for and how far it can be trusted, a run ends; the others are for who looks closer.
_LINES = (
    ("max_displacement_mm", "largest displacement", "{:.2f} mm"),
    ("max_displacement_outside_first_ring_mm", "outside the tumour's first ring of cells", "{:.2f} mm"),
    ("max_displacement_of_ventricle_wall_mm", "largest, ventricle walls", "{:.2f} mm"),
    ("share_over_5mm", "moved more than 5 mm", "{:.2%}"),
    ("midline_shift_mm", "shift of the midline between the ventricles", "{:+.2f} mm (+: to the right)"),
    ("ventricle_volume_ml", "ventricles, undeformed", "{:.3f} ml"),
    ("ventricle_volume_change_ml", "ventricles, change", "{:+.3f} ml"),
    ("tumour_volume_mm3", "tumour as reached", "{:.1f} mm3"),
    ("tumour_volume_by_field_mm3", "tumour by the field at its nodes", "{:.1f} mm3"),
    ("volume_balance.tumour_added_mm3", "volume added by the tumour", "{:.1f} mm3"),
    ("volume_balance.pushed_through_interface_mm3", "pushed through the interface", "{:.1f} mm3"),
    ("volume_balance.elastic_compression_mm3", "compression of the cloud", "{:.1f} mm3"),
    ("volume_balance.relative_error", "volume balance, error", "{:.2%}"),
    ("cloud_misfit_mm", "uncertainty of the cloud, worst node", "{:.3f} mm"),
    ("static_distance_mm", "from the static solution, by its own estimate", "{:.2g} mm"),
    ("min_jacobian", "smallest J, a cell's volume over undeformed", "{:.4f}"),
    ("crushed.volume_mm3", "in cells below J = 0.5", "{:.3g} mm3"),
    ("energy_J.external", "external work", "{:.4g} J"),
    ("energy_J.internal", "internal energy", "{:.4g} J"),
    ("energy_J.kinetic", "kinetic energy", "{:.4g} J"),
    ("energy_J.added_mass", "energy of added mass", "{:.4g} J"),
    ("energy_J.dissipated", "taken by damping, less what changed masses gave", "{:.4g} J"),
    ("energy_J.balance_error", "energy balance, error", "{:.2%}"),
    ("kinetic_to_internal.largest_after_10_percent", "kinetic/internal, largest after 10 %", "{:.2%}"),
    ("kinetic_to_internal.at_end", "kinetic/internal, at the end", "{:.2%}"),
    ("nodes", "nodes", "{:,}"),
    ("cells", "cells", "{:,}"),
    ("ranks", "ranks", "{}"),
    ("steps", "steps", "{:,}"),
    ("time_step_s", "time step", "{:.3g} s"),
    ("cell_updates_per_second", "cell updates a second", "{:.3g}"),
    ("halo_share", "halo's share of the loop, worst rank", "{:.1%}"),
    ("imbalance", "imbalance of computing", "{:.1%}"),
    ("run_s", "run time", "{:.1f} s"),
    ("seconds", "run time, by phase", "{:.1f} s"),
)
_HEADLINES = {
    "max_displacement_mm", "max_displacement_of_ventricle_wall_mm", "midline_shift_mm", "ventricle_volume_change_ml",
    "tumour_volume_mm3", "volume_balance.relative_error", "cloud_misfit_mm", "static_distance_mm", "min_jacobian",
    "crushed.volume_mm3", "steps", "run_s",
}  # fmt: skip
#: Lines of relaxation alone, and those that mean nothing there, where masses and time are fictitious.
_OF_RELAXATION = {"energy_J.dissipated"}
_OF_MARCHES = {"energy_J.added_mass", "kinetic_to_internal.largest_after_10_percent", "time_step_s"}


def rows(report: Mapping[str, Any], *, whole: bool = True) -> Iterator[tuple[str, str]]:
    """Name and value of each line of the table, or of its headlines."""
    if "loop" in report["seconds"]:  # of a run that was killed nothing is known but how long its report took
        report = dict(report) | {"run_s": sum(report["seconds"].values())}
    foreign = _OF_MARCHES if report.get("method") == "dynamic-relaxation" else _OF_RELAXATION
    for key, name, form in _LINES:
        if key in foreign or not (whole or key in _HEADLINES):
            continue
        value: Any = report
        for part in key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if isinstance(value, Mapping):
            parts = (f"{form.format(v)} {k.replace('_', ' ')}" for k, v in value.items() if v is not None)
            yield name, ", ".join(parts)
        elif value is not None:
            yield name, form.format(value)
    if whole and "peak_memory_bytes" in report:
        yield "peak memory of each rank", ", ".join(f"{b / 2**20:.0f} MiB" for b in report["peak_memory_bytes"])
