"""The report of a run, in the user's units: report.json, a table for the terminal, and pictures.

All displacements are values of the field u_h, which differs from the parameters at EFG nodes. The tumour is reported
with two volumes: its nodes move as prescribed, and the field at these nodes differs a little.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpitled import atomic
from mpitled.cells import hexahedra
from mpitled.meshing.faces import boundary_faces, interface_faces
from mpitled.model import Model
from mpitled.results.figures import BY_KEY, RELAXATION, LowestJacobian, Report, rows
from mpitled.results.final_state import FinalState, read

REPORT, PAGE = "report.json", "report.html"
#: Displacements above this are large (paper, 6.2), m.
LARGE = 5e-3
#: The report warns if hourglass control and stabilisation have more than this share of the internal energy. The share
#: was at most 0.15 in correct results, and at least 0.3 in wrong ones.
MAX_ARTIFICIAL_ENERGY = 0.2
#: Materials with a larger Poisson's ratio are nearly incompressible.
NEARLY_INCOMPRESSIBLE = 0.495
#: Cells with a smaller J lost much of their volume. The report warns if the volume of such cells is more than this
#: share of the tumour's.
LOW_JACOBIAN, MAX_LOW_JACOBIAN_VOLUME = 0.5, 0.02
#: Gauss points: exact to degree 3 in each coordinate, and the volume integrand of a bilinear face has degree 2.
_GAUSS = (-(3**-0.5), 3**-0.5)

_Floats = NDArray[np.float64]


# --- files ---------------------------------------------------------------------------------------------------------


def write(directory: Path, seconds: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Make the report of the run in a directory, and write and return the content of report.json.

    Errors are those of `make` and `save`.
    """
    report = make(directory, seconds).as_json()
    save(directory, report)
    return report


def make(directory: Path, seconds: Mapping[str, float] | None = None) -> Report:
    """Compute the report of the run in a directory, and draw its pictures there if the directory is writable.

    `seconds` are the durations of the phases, if the run ends now. InputError if the directory has no result, or if
    result and model do not belong together.
    """
    begin = time.perf_counter()
    state = read(directory)
    report = compute(state)
    report.pictures = _draw(state, directory)
    phases = dict(seconds or report.seconds)
    own = {"report": time.perf_counter() - begin} if seconds else _report_seconds(directory, phases)
    report.seconds = phases | own
    return report


def _report_seconds(directory: Path, phases: Mapping[str, float]) -> dict[str, float]:
    """The duration of the report at the end of the run, from report.json; a later report of the run repeats it."""
    try:
        old = dict(json.loads((directory / REPORT).read_text(encoding="utf-8"))["seconds"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return {"report": old["report"]} if old.keys() - phases.keys() == {"report"} else {}


def save(directory: Path, report: Mapping[str, Any]) -> None:
    """Write report.json into the run's directory. InputError if the file cannot be written."""
    atomic.write_text(directory / REPORT, json.dumps(report, indent=2, allow_nan=False) + "\n")


def _draw(state: FinalState, directory: Path) -> list[str] | str:
    """Names of the pictures that were drawn, or the reason why there are none."""
    if not state.metadata.get("deck", {}).get("output", {}).get("pictures", True):
        return "none, because output.pictures is false"
    try:
        from mpitled.results import cuts
    except ImportError as error:
        library = str(error.name).partition(".")[0]
        return f"none, because {library} is missing; install it: pip install 'mpitled[pictures]'"
    try:
        return cuts.draw(directory, state)
    except OSError as error:
        return f"none, because they cannot be written ({error.strerror})"


def incomplete(report: Mapping[str, Any]) -> str:
    """The last frame of a run that did not reach its end, and the reason if the run recorded it."""
    stopped = f"; {report['stopped']}" if "stopped" in report else ""
    return f"not complete: the last frame is at {report['load_share']:.1%} of the load{stopped}"


def table(report: Mapping[str, Any], *, full: bool = True) -> str:
    """The content of report.json as a table for the terminal: all figures, or the headlines."""
    lines = [report["title"]] if report["title"] else []
    if not report["complete"]:
        lines.append(incomplete(report))
    lines += [f"  {name:<47}  {value}" for name, value in rows(report, headlines=not full)]
    lines += [f"  warning: {text}" for text in report["warnings"]]
    pictures = report["pictures"]
    lines.append(f"  {'pictures':<47}  {', '.join(pictures) if isinstance(pictures, list) else pictures}")
    return "\n".join(lines)


# --- figures -------------------------------------------------------------------------------------------------------


def compute(state: FinalState) -> Report:
    """The report of a state, without pictures and durations of phases."""
    report = Report(
        title=state.metadata.get("title", ""),
        complete=state.complete,
        load_share=min(1.0, state.time / state.metadata["load_time_s"]),
    )
    for measure in (_displacements, _cloud, _ventricles, _tumour, _jacobians):
        measure(report, state)
    report.set_figures(state.figures)
    if solver := state.metadata.get("deck", {}).get("solver"):
        report.method = solver["method"]
        if report.method == RELAXATION:
            report.time_step_s = None  # the time of relaxation is fictitious
    # The figures of a stopped run are wrong because it was stopped: further warnings would be misleading.
    report.warnings = [*state.model.warnings, *(_warnings(report, state.model) if state.complete else ())]
    return report


def _displacements(report: Report, state: FinalState) -> None:
    size = np.linalg.norm(state.field, axis=1)
    large = state.cell_displacements > LARGE
    report.max_displacement_mm = 1e3 * float(size.max())
    report.share_over_5mm = {
        "volume": float(state.volumes[large].sum() / state.volumes.sum()),
        "nodes": float(np.mean(size > LARGE)),
    }
    if len(state.seed) and len(outside := _outside_first_ring(state)):
        report.max_displacement_outside_first_ring_mm = 1e3 * float(np.linalg.norm(outside, axis=1).max())


def _outside_first_ring(state: FinalState) -> _Floats:
    """Displacements (n, 3), m, at the nodes and integration points that belong to no cell with a node of the tumour."""
    model = state.model
    on_seed = np.zeros(model.n_nodes, bool)
    on_seed[state.seed] = True
    ring_domains = on_seed[model.domains].any(axis=1)
    outside = np.ones(model.n_nodes, bool)
    outside[model.domains[ring_domains]] = False
    outside[model.hexahedra[on_seed[model.hexahedra].any(axis=1)]] = False
    return np.concatenate([state.field[outside], state.domain_displacement[~ring_domains]])


def _cloud(report: Report, state: FinalState) -> None:
    """Residuals of moving least squares at the EFG nodes.

    A large residual means that the polynomials cannot represent the field. In 14 grown spheres the error of the field
    was 0.8 to 3.8 times the residual.
    """
    misfit = np.linalg.norm((state.field - state.displacement)[state.model.n_fe_nodes :], axis=1)
    if len(misfit):
        report.cloud_misfit_mm = 1e3 * float(misfit.max())
        report.cloud_misfit_of_90_percent_mm = 1e3 * float(np.quantile(misfit, 0.9))


def _ventricles(report: Report, state: FinalState) -> None:
    """Volumes of the ventricles, changes of the volumes (negative: smaller), and displacements of the walls."""
    model, undeformed = state.model, state.hexahedron_volumes
    before, change, wall = {}, {}, {}
    for side, cells in state.ventricles.items():
        after = hexahedra.volumes(model.points + state.field, model.hexahedra[cells])
        before[side] = 1e6 * float(undeformed[cells].sum())
        change[side] = 1e6 * float((after - undeformed[cells]).sum())
        on_wall = np.unique(boundary_faces(model.hexahedra[cells]))
        wall[side] = 1e3 * float(np.linalg.norm(state.field[on_wall], axis=1).max())
    if before:
        report.ventricle_volume_ml = before | {"total": sum(before.values())}
        report.ventricle_volume_change_ml = change | {"total": sum(change.values())}
        report.max_displacement_of_ventricle_wall_mm = wall
        report.midline_shift_mm = _midline_shift(state)


def _midline_shift(state: FinalState) -> float | None:
    """Largest displacement across the midline of the tissue between the ventricles, mm; positive to the right.

    The plane of the midline is half-way between the centres of the ventricles, and normal to the line between them. The
    tissue is that of the nodes within half a hexahedron of the plane, and within the bounds of the ventricles' nodes
    after projection onto the plane. None without two ventricles.
    """
    model, sides = state.model, state.ventricles
    if len(sides) < 2:
        return None
    nodes = [np.unique(model.hexahedra[cells]) for cells in sides.values()]
    left, right = (model.points[one].mean(axis=0) for one in nodes)
    normal = (right - left) / np.linalg.norm(right - left)
    from_plane = model.points @ normal - (left + right) @ normal / 2
    projected = model.points - np.outer(model.points @ normal, normal)
    both = projected[np.concatenate(nodes)]
    between = ((projected >= both.min(axis=0)) & (projected <= both.max(axis=0))).all(axis=1)
    near = np.abs(from_plane) <= float(np.cbrt(state.hexahedron_volumes.mean())) / 2
    shifts = (state.field @ normal)[between & near]
    return 1e3 * float(shifts[np.abs(shifts).argmax()]) if len(shifts) else None


def _jacobians(report: Report, state: FinalState) -> None:
    """The smallest J in the last frame with its cell, and the volume of cells with a low J."""
    cell, low = int(np.argmin(state.jacobian)), state.jacobian < LOW_JACOBIAN
    report.smallest_jacobian = LowestJacobian(
        now=float(state.jacobian[cell]),
        cell=state.cell_kind(cell),
        material=state.model.materials[state.model.material[cell]].name,
        place_mm=(1e3 * state.cell_centre(cell)).tolist(),
    )
    report.low_jacobian_cells = int(low.sum())
    report.low_jacobian_mm3 = 1e9 * float(state.volumes[low].sum())


def _tumour(report: Report, state: FinalState) -> None:
    """Volume of the tumour from its nodes and from the field at these nodes, and the balance of the added volume.

    The volume is (4 pi / 3) mean r^3 of the nodes, the integral of r^3 / 3 over the solid angle. This holds for a
    sphere and for the uneven surface of the field. The convex hull of the nodes would be too small.
    """
    model, seed, centre = state.model, state.seed, state.centre
    if centre is None or not len(seed):
        return

    def volume(displacement: _Floats) -> float:
        cubes = np.linalg.norm(model.points[seed] + displacement[seed] - centre, axis=1) ** 3
        return 4 / 3 * math.pi * float(cubes.mean())

    final = volume(state.displacement)
    report.tumour_volume_mm3 = 1e9 * final
    report.tumour_volume_by_field_mm3 = 1e9 * volume(state.field)
    interface = model.node_sets.get("interface", np.empty(0, np.int64))
    faces = interface_faces(model.points, model.hexahedra, interface, model.domain_points)
    if len(faces) and not np.any(state.field[_open_edge_nodes(faces)]):
        added = final - 4 / 3 * math.pi * state.metadata["tumour"]["seed_radius_m"] ** 3
        pushed = enclosed_volume(model.points, faces) - enclosed_volume(model.points + state.field, faces)
        compressed = float((model.domain_volumes * (1 - state.jacobian[model.cells_of("support domains")])).sum())
        report.volume_added_mm3 = 1e9 * added
        report.volume_pushed_mm3 = 1e9 * pushed
        report.volume_compressed_mm3 = 1e9 * compressed
        report.volume_error = abs(added - pushed - compressed) / added if added > 0 else math.nan


def enclosed_volume(points: _Floats, faces: NDArray[np.int64]) -> float:
    """Exact volume (m^3) inside a closed surface of bilinear faces (n, 4), anticlockwise seen from outside.

    The volume is 1/3 of the surface integral of x . n. Faces of trilinear hexahedra are bilinear, so the volumes inside
    and outside agree to round-off.
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


def _open_edge_nodes(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Nodes on the rim of a surface of faces (n, 4): on edges that no other face has in the opposite direction."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    base = int(faces.max()) + 1
    return np.unique(edges[~np.isin(edges @ [base, 1], edges @ [1, base])])


# --- warnings ------------------------------------------------------------------------------------------------------


def _warnings(report: Report, model: Model) -> Iterator[str]:
    """Reasons why a result may be wrong, each with its remedy."""
    yield from _artificial_energy(report, model)
    yield from _volume_warnings(report)
    if report.cloud_misfit_mm is not None and _is_over("cloud_misfit_mm", report.cloud_misfit_mm):
        # Next to a grown seed the spacing of the nodes on its surface decides; a finer cloud elsewhere changes little.
        grown = report.volume_error is not None
        remedy = "raise tumour.surface_nodes: four times as many halve it" if grown else "lower cloud.spacing"
        yield (
            "the cloud is too coarse for its field: the residual of moving least squares is "
            f"{report.cloud_misfit_mm:.2g} mm at the worst node, and up to "
            f"{report.cloud_misfit_of_90_percent_mm:.2g} mm at 90 % of the nodes; refine the cloud there ({remedy})"
        )
    yield from _static_distance(report)


def _is_over(key: str, value: float) -> bool:
    limit = BY_KEY[key].limit
    return limit is not None and value > limit


def _artificial_energy(report: Report, model: Model) -> Iterator[str]:
    energy = report.energy_J or {}
    if energy.get("internal", 0) <= 0:
        return
    share = (energy["hourglass"] + energy["stabilisation"]) / energy["internal"]
    if share > MAX_ARTIFICIAL_ENERGY:
        # The stiffness of these modes is a share of lambda + 2 mu, which tends to infinity at a ratio of 0.5.
        stiff = max(material.poissons_ratio for material in model.materials) > NEARLY_INCOMPRESSIBLE
        remedy = "lower material.NAME.poissons_ratio (0.49)" if stiff else "raise support.stabilisation"
        yield (
            f"{share:.0%} of the internal energy is in modes without strain at the integration points, so the "
            f"displacements are not to be trusted: refine the mesh or the cloud, or {remedy}"
        )


def _volume_warnings(report: Report) -> Iterator[str]:
    error = report.volume_error
    if error is not None and _is_over("volume_balance.relative_error", error):
        wrong = (
            "of the grown volume is lost"
            if report.volume_unaccounted_mm3 > 0
            else "more volume is displaced than was grown"
        )
        yield f"{error:.0%} {wrong}: refine the cloud around the tumour (cloud.growth)"
    low, tumour = report.low_jacobian_mm3 or 0.0, report.tumour_volume_mm3 or math.inf
    if low > MAX_LOW_JACOBIAN_VOLUME * tumour:
        yield (
            f"{low:.3g} mm3 of tissue, {low / tumour:.1%} of the tumour's volume, is in cells that lost more than half "
            "of their volume: the field beside the tumour is not to be trusted; refine the cloud there (cloud.growth)"
        )


def _static_distance(report: Report) -> Iterator[str]:
    slower = 'load more slowly (solver.load_time), or set solver.method = "dynamic-relaxation"'
    distance = report.static_distance_mm
    if distance is not None and _is_over("static_distance_mm", distance):
        remedy = "lower solver.tolerance" if report.method == RELAXATION else slower
        yield f"the run ended {distance:.2g} mm from the static solution: {remedy}"
    elif report.method == "quasi-static" and distance is None:
        yield f"the distance of the end of the ramp from the static solution could not be estimated: {slower}"
