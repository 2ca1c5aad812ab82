"""Errors of a result against a reference: another solver's displacements at given points, or another result."""

from __future__ import annotations

import csv
import io
import json
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mpitled import deck, resources, store
from mpitled.cells import hexahedra
from mpitled.errors import InputError, damaged
from mpitled.model import Model
from mpitled.model.build import OUTER
from mpitled.readers import text
from mpitled.readers.meshfile import MAX_COORDINATE
from mpitled.results import field
from mpitled.results.field import Field

#: Meanings of the tags of a reference. Fixed and moved points are prescribed, and so do not belong to "free".
TAGS = ("interior", "free surface", "fixed", "moved", "material interface")
_PRESCRIBED = (2, 3)
#: A reference for several tumours applies to a run whose tumour has one of their radii, to this relative difference.
_RADIUS_RTOL = 1e-3
_MAX_KEYS = 4  # differing keys that a message names
_SAMPLES = 32  # points on each edge, from which distances are measured


@dataclass(frozen=True, slots=True)
class Reference:
    """A displacement field that is taken as exact, at n points of the undeformed body."""

    positions: NDArray[np.float64]  # (n, 3), m
    displacement: NDArray[np.float64]  # (n, 3), m
    error: NDArray[np.float64] | None = None  # (n,), m: the reference's own error estimate, of the largest component
    tag: NDArray[np.int64] | None = None  # (n,), index into TAGS
    deck: dict[str, Any] | None = None  # if the reference is a run of mpitled


def compare(result: Path, reference: Path, beyond: float | None = None) -> dict[str, Any]:
    """Differences, in mm, between the last frame of a run and a reference, by groups of points.

    Groups are "all", "free" (not prescribed) and each tag of the reference. With `beyond` (m) the group "free beyond"
    has the free points that are farther than this from edges between the free surface and the surface that is
    prescribed in all directions: the field is singular at such edges. Errors are those of `read_reference`.
    """
    ours = field.open_field(result)
    theirs = read_reference(reference, ours)
    values = ours.at(theirs.positions)
    difference = values.displacement - theirs.displacement
    everywhere = np.ones(len(difference), bool)
    free = everywhere if theirs.tag is None else ~np.isin(theirs.tag, _PRESCRIBED)
    groups = {"all": everywhere, "free": free}
    if theirs.tag is not None:
        groups |= {name: theirs.tag == tag for tag, name in enumerate(TAGS) if (theirs.tag == tag).any()}
    if beyond is not None:
        groups["free beyond"] = free & (edge_distance(ours.model, theirs.positions) > beyond)
    return {
        "result": str(result),
        "reference": str(reference),
        "load": ours.share,
        "complete": ours.complete,
        "scene_differs_in": _differing(ours.metadata["deck"], theirs.deck),
        "beyond_mm": None if beyond is None else 1e3 * beyond,
        "largest_displacement_mm": _largest(theirs.displacement),
        "in_hexahedra": int(np.count_nonzero(values.source == field.IN_HEXAHEDRON)),
        "in_cloud": int(np.count_nonzero(values.source == field.IN_CLOUD)),
        "outside": int(np.count_nonzero(values.source == field.OUTSIDE)),
        "beside_the_body": int(np.count_nonzero(values.outside > _mean_edge(ours.model))),
        "farthest_outside_mm": 1e3 * float(values.outside.max(initial=0)),
        "groups": {name: _figures(theirs, difference, chosen) for name, chosen in groups.items() if chosen.any()},
    }


def table(figures: dict[str, Any]) -> str:
    """The figures of `compare` as a table for the terminal."""
    lines = [
        f"{figures['result']} against {figures['reference']}",
        f"{figures['in_hexahedra']} points in hexahedra, {figures['in_cloud']} in the cloud, {figures['outside']} "
        f"outside (at most {figures['farthest_outside_mm']:.3f} mm); "
        f"largest displacement {figures['largest_displacement_mm']:.3f} mm",
    ]
    if figures["beside_the_body"]:
        lines.append(
            f"warning: {figures['beside_the_body']} points lie outside the body by more than the edge of a cell; check "
            "that result and reference are of the same body, and in metres"
        )
    if keys := figures["scene_differs_in"]:
        more = f" and {len(keys) - _MAX_KEYS} more" if len(keys) > _MAX_KEYS else ""
        lines.append(f"note: the scenes differ in {', '.join(keys[:_MAX_KEYS])}{more}")
    if not figures["complete"]:
        lines.append(f"note: the run is not complete; its last frame is at {figures['load']:.1%} of the load time")
    lines.append(
        f"{'':24}{'':>8}{'largest error, mm':>36}{'rms error, mm':>36}{'share of':>9}{'reference':>11}\n"
        f"{'':24}{'points':>8}"
        + 2 * "".join(f"{c:>9}" for c in ("x", "y", "z", "norm"))
        + f"{'largest':>9}{'err, mm':>11}"
    )
    for name, group in figures["groups"].items():
        label = f"{name} {figures['beyond_mm']:g} mm" if name == "free beyond" else name
        numbers = "".join(f"{number:9.4f}" for number in (*group["largest_mm"], *group["rms_mm"]))
        uncertainty = "-" if (error := group["reference_error_mm"]) is None else f"{error:.4f}"
        lines.append(f"{label:24}{group['places']:8}{numbers}{group['share_of_largest']:9.2%}{uncertainty:>11}")
    return "\n".join(lines)


def _differing(ours: dict[str, Any], theirs: dict[str, Any] | None) -> list[str]:
    """Keys of the scene that differ between both runs; none if the reference is not a run."""

    def same_file(values: list[Any]) -> bool:  # in another folder
        return all(isinstance(value, str) for value in values) and len({Path(value).name for value in values}) == 1

    differences = deck.differences(ours, theirs or ours)
    return [key for key, *values in differences if deck.changes_physics(key) and not same_file(values)]


def _mean_edge(model: Model) -> float:
    """Mean edge of the hexahedra, m. Surfaces of different meshes of a body differ by less."""
    sizes = hexahedra.volumes(model.points, model.hexahedra)
    return float(np.cbrt(sizes.mean())) if len(sizes) else float("inf")


def _largest(displacement: NDArray[np.float64]) -> float:
    return 1e3 * float(np.linalg.norm(displacement, axis=1).max(initial=0))


def _figures(reference: Reference, difference: NDArray[np.float64], chosen: NDArray[np.bool_]) -> dict[str, Any]:
    """Largest value and root mean square of x, y, z and the norm of the difference over the chosen points."""
    errors = 1e3 * np.abs(np.column_stack([difference, np.linalg.norm(difference, axis=1)])[chosen])
    largest = _largest(reference.displacement)
    return {
        "places": len(errors),
        "largest_mm": errors.max(axis=0).tolist(),
        "rms_mm": np.sqrt((errors**2).mean(axis=0)).tolist(),
        "share_of_largest": float(errors[:, 3].max() / largest) if largest else 0.0,
        "reference_error_mm": None if reference.error is None else 1e3 * float(reference.error[chosen].max()),
        "worst_place_mm": (1e3 * reference.positions[chosen][errors[:, 3].argmax()]).tolist(),
    }


# --- edges ---------------------------------------------------------------------------------------------------------


def edge_distance(model: Model, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (n,), m, of positions (n, 3) from edges between prescribed and free surface; infinite without an edge.

    On hexahedra an edge separates a face with all nodes prescribed in all directions from another face. A surface of
    EFG nodes has no faces. Its edge consists of the prescribed nodes that have a free node among the nearest three.
    """
    clamped, _ = field.prescribed(model)
    faces = field.outer_faces(model)
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    unique, index = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    of_clamped = np.repeat(clamped[faces].all(axis=1), 4)
    beside_clamped, beside_free = (
        np.bincount(index.ravel(), side, len(unique)) > 0 for side in (of_clamped, ~of_clamped)
    )
    ends = model.points[unique[beside_clamped & beside_free]]
    share = np.linspace(0, 1, _SAMPLES)[:, None, None]
    on_edges = ((1 - share) * ends[:, 0] + share * ends[:, 1]).reshape(-1, 3)

    outer = np.unique(np.concatenate([np.empty(0, np.int64), *(model.node_sets.get(name, []) for name in OUTER)]))
    outer = outer[outer >= model.n_fe_nodes].astype(np.int64)
    if len(outer):
        near = cKDTree(model.points[outer]).query(model.points[outer], min(4, len(outer)))[1].reshape(len(outer), -1)
        rim = outer[clamped[outer] & ~clamped[outer[near]].all(axis=1)]
        on_edges = np.concatenate([on_edges, model.points[rim]])
    return np.asarray(cKDTree(on_edges).query(positions)[0]) if len(on_edges) else np.full(len(positions), np.inf)


# --- references ----------------------------------------------------------------------------------------------------


def read_reference(path: Path, ours: Field) -> Reference:
    """Read a reference for a run: .npz, .csv, .vtu or .vtkhdf, all in metres, or another run's folder or result.

    An .npz file has X (n, 3), u (n, 3) and optionally err_u (n,) and tag (n,). In a file for k tumour radii u has the
    shape (k, n, 3), and the JSON string `meta` has the radii under "R". A .csv file has the columns x, y, z, ux, uy, uz
    and optionally err and tag, with names in the first line. A VTK file needs PyVista and a point array of
    displacements. InputError if there is no such file, or if it is invalid.
    """
    if path.is_dir() or (path.suffix == ".vtkhdf" and path.exists() and store.is_result(path)):
        return _of_result(path)
    readers: dict[str, Callable[[Path], Reference]] = {
        ".npz": partial(_of_npz, ours=ours),
        ".csv": _of_csv,
        ".vtu": _of_vtk,
        ".vtkhdf": _of_vtk,
    }
    if not path.exists() or path.suffix not in readers:
        problem = "is not a reference" if path.exists() else "does not exist"
        raise InputError(f"{path}: {problem}; give .npz, .csv, .vtu, .vtkhdf or the folder of a run")
    return readers[path.suffix](path)


def _of_result(path: Path) -> Reference:
    """The nodes of another run, with the tags of its model."""
    theirs = field.open_field(path)
    if not theirs.complete:
        raise InputError(f"{path}: the run is not complete; run it again")
    model = theirs.model
    clamped, moving = field.prescribed(model)
    tag = np.zeros(model.n_nodes, np.int64)
    tag[field.outer_faces(model)] = TAGS.index("free surface")
    for name in OUTER:
        tag[model.node_sets.get(name, [])] = TAGS.index("free surface")
    tag[clamped] = TAGS.index("fixed")
    tag[moving] = TAGS.index("moved")
    return Reference(model.points, theirs.at_nodes, None, tag, theirs.metadata["deck"])


def _of_npz(path: Path, ours: Field) -> Reference:
    names = ("X", "u", "err_u", "tag", "meta")
    try:
        with zipfile.ZipFile(path) as archive:
            # The arrays may be a thousand times larger than the compressed file.
            size = sum(member.file_size for member in archive.infolist() if member.filename[:-4] in names)
        resources.check_memory(4 * size, f"{path}: its arrays", "give fewer points")
        with np.load(path, allow_pickle=False) as arrays:
            data = {name: np.asarray(arrays[name]) for name in names if name in arrays}
        meta = dict(json.loads(str(data.pop("meta", "{}"))))
        radii = np.asarray(meta.get("R", []), float)
        if any(values.dtype.kind not in "fiub" for values in data.values()):
            raise ValueError("an array is not numeric")
    except InputError:
        raise
    except Exception as problem:  # zipfile and numpy raise many types
        reason = " ".join(str(problem).split())[:100] or type(problem).__name__
        raise InputError(f"{path}: cannot be read as .npz ({reason}); write it again with numpy.savez") from None
    if "X" not in data or "u" not in data:
        raise InputError(f"{path}: has no arrays X and u: positions (n, 3) and displacements (n, 3)")
    u, error = data["u"], data.get("err_u")
    if u.ndim == 3:
        row = _row(path, radii, len(u), ours)
        u, error = u[row], error[row] if error is not None and error.shape[:1] == radii.shape else error
    return _checked(path, Reference(data["X"], u, error, data.get("tag")))


def _row(path: Path, radii: NDArray[np.float64], n: int, ours: Field) -> int:
    """The index of the run's tumour radius among the n radii (m) of a reference."""
    if len(radii) != n:
        raise InputError(f'{path}: u has {n} loads, but meta names {len(radii)} tumour radii ("R", in m)')
    tumours = f"{path}: has tumours of {', '.join(f'{1e3 * radius:.4g}' for radius in radii)} mm radius"
    tumour = ours.metadata["tumour"]
    if not tumour:
        raise InputError(f"{tumours}, but the run has no tumour")
    row = int(np.abs(radii - tumour["radius_m"]).argmin())
    if abs(radii[row] - tumour["radius_m"]) > _RADIUS_RTOL * radii[row]:
        raise InputError(f"{tumours}, the run's tumour has {1e3 * tumour['radius_m']:.4g} mm")
    return row


def _of_csv(path: Path) -> Reference:
    file = io.StringIO(text.decode(text.read_text(path, "a table of positions and displacements (CSV)")))
    with damaged(path, "give x, y, z, ux, uy, uz in each line"):
        rows = csv.reader(file)
        names = [name.strip() for name in next(rows, [])]
        missing = [name for name in ("x", "y", "z", "ux", "uy", "uz") if name not in names]
        if missing:
            raise InputError(f"{path}: line 1: has no column {missing[0]}; name the columns x, y, z, ux, uy, uz")
        values = []
        for row in rows:
            try:
                values.append([float(cell) for cell in row])
            except ValueError as error:
                raise InputError(f"{path}: line {rows.line_num}: {error}; give numbers") from None
            if len(row) != len(names):
                raise InputError(f"{path}: line {rows.line_num}: has {len(row)} numbers for {len(names)} columns")
    column = dict(zip(names, np.array(values).reshape(-1, len(names)).T, strict=True))
    positions, u = (np.column_stack([column[prefix + axis] for axis in "xyz"]) for prefix in ("", "u"))
    return _checked(path, Reference(positions, u, column.get("err"), column.get("tag")))


def _of_vtk(path: Path) -> Reference:
    """Points and displacements of the last step of an unstructured grid."""
    try:
        import pyvista
    except ImportError:
        raise InputError(f"{path}: needs PyVista; install it: pip install 'mpitled[pictures]'") from None
    if path.suffix == ".vtu":
        _check_vtu(path)
    with pyvista.vtk_verbosity("off"), damaged(path, "give an unstructured grid of VTK"):
        reader: Any = pyvista.get_reader(path)
        if path.suffix == ".vtkhdf":  # PyVista cannot select the step
            reader.reader.UpdateInformation()
            reader.reader.SetStep(max(reader.reader.GetNumberOfSteps() - 1, 0))
        grid: Any = reader.read()
    if not isinstance(grid, pyvista.UnstructuredGrid) or not grid.n_points:
        raise InputError(f"{path}: cannot be read as an unstructured grid of VTK")
    vectors = {name: array for name, array in grid.point_data.items() if array.shape == (grid.n_points, 3)}
    named = [name for name in vectors if name.lower().startswith(("u", "disp", "field_disp"))] or list(vectors)
    if len(named) != 1:
        raise InputError(f"{path}: has the point vectors {', '.join(vectors) or 'none'}; name one u or displacement")
    return _checked(path, Reference(np.array(grid.points), np.array(vectors[named[0]])))


def _check_vtu(path: Path) -> None:
    """InputError if an XML file declares more points or cells than its bytes can hold: VTK would allocate them."""
    content = path.read_bytes()
    counts = re.findall(rb'NumberOf(?:Points|Cells|Tuples|Components)\s*=\s*["\'](\d{1,18})', content)
    declared = max(map(int, counts), default=0)
    if declared > 1000 * len(content) or re.search(rb'NumberOf\w+\s*=\s*["\']\s*[+-]?\d{19}', content):
        raise InputError(f"{path}: declares {declared} points or cells in {len(content)} bytes; write it again")


def _checked(path: Path, reference: Reference) -> Reference:
    """The reference in float64. InputError if its arrays do not fit together."""
    n = len(reference.positions)
    for name, shape in {"positions": (n, 3), "displacement": (n, 3), "error": (n,), "tag": (n,)}.items():
        array = getattr(reference, name)
        if array is not None and (array.shape != shape or not np.isfinite(array).all()):
            raise InputError(f"{path}: {name} has shape {array.shape} for {n} points, or values that are not finite")
    if not all((np.abs(array) < MAX_COORDINATE).all() for array in (reference.positions, reference.displacement)):
        raise InputError(f"{path}: has positions or displacements beyond {MAX_COORDINATE:g} m; correct them")
    if n == 0:
        raise InputError(f"{path}: has no points")
    tag = None if reference.tag is None else reference.tag.astype(np.int64)
    if tag is not None and not np.isin(tag, range(len(TAGS))).all():
        raise InputError(f"{path}: tag has numbers other than 0 to {len(TAGS) - 1} ({', '.join(TAGS)})")
    error = None if reference.error is None else reference.error.astype(float)
    return Reference(reference.positions.astype(float), reference.displacement.astype(float), error, tag)
