"""Errors of a result against a reference: the field of another solver at its own points, or another result."""

from __future__ import annotations

import csv
import io
import json
import re
import zipfile
from dataclasses import dataclass, replace
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

#: Meanings of the tags of a reference. Fixed and moved points are prescribed: their errors do not count as "free".
TAGS = ("interior", "free surface", "fixed", "moved", "material interface")
_PRESCRIBED = (2, 3)
#: A reference for several tumours applies to a run whose tumour radius is within this share of one of theirs.
_SAME_RADIUS = 1e-3
_SHOWN = 4  # keys in which two scenes differ that a message names
_SAMPLES = 32  # points on each edge, for distances from it


@dataclass(frozen=True, slots=True)
class Reference:
    """A displacement field that counts as exact, at points of the undeformed body."""

    places: NDArray[np.float64]  # (n, 3), m
    displacement: NDArray[np.float64]  # (n, 3), m
    error: NDArray[np.float64] | None = None  # (n,), m: estimate by its authors, of the largest component
    tag: NDArray[np.int64] | None = None  # (n,), index into TAGS
    deck: dict[str, Any] | None = None  # if the reference is a run of mpitled


def compare(result: Path, reference: Path, beyond: float | None = None) -> dict[str, Any]:
    """Figures of the difference, in mm, in the last frame of a run.

    Groups are "all", "free" (not prescribed), each tag of the reference, and with `beyond` (m) "free beyond" that
    distance from edges between the free surface and nodes prescribed in all directions, where the field is singular.
    """
    ours = field.open_field(result)
    theirs = read_reference(reference, ours)
    values = ours.at(theirs.places)
    difference = values.displacement - theirs.displacement
    every = np.ones(len(difference), bool)
    free = every if theirs.tag is None else ~np.isin(theirs.tag, _PRESCRIBED)
    groups = {"all": every, "free": free}
    if theirs.tag is not None:
        groups |= {name: theirs.tag == tag for tag, name in enumerate(TAGS) if (theirs.tag == tag).any()}
    if beyond is not None:
        groups["free beyond"] = free & (edge_distance(ours.model, theirs.places) > beyond)
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
        "beside_the_body": int(np.count_nonzero(values.outside > _edge(ours.model))),
        "farthest_outside_mm": 1e3 * float(values.outside.max(initial=0)),
        "groups": {name: _figures(theirs, difference, chosen) for name, chosen in groups.items() if chosen.any()},
    }


def table(figures: dict[str, Any]) -> str:
    """The figures of `compare` as a table for the terminal."""
    lines = [
        f"{figures['result']} against {figures['reference']}",
        f"{figures['in_hexahedra']} places in hexahedra, {figures['in_cloud']} in the cloud, {figures['outside']} "
        f"outside (at most {figures['farthest_outside_mm']:.3f} mm); "
        f"largest displacement {figures['largest_displacement_mm']:.3f} mm",
    ]
    if figures["beside_the_body"]:
        lines.append(
            f"warning: {figures['beside_the_body']} places lie outside the body by more than the edge of a cell; are "
            "both of the same body, and in metres?"
        )
    if keys := figures["scene_differs_in"]:
        more = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
        lines.append(f"note: the scenes differ in {', '.join(keys[:_SHOWN])}{more}")
    if not figures["complete"]:
        lines.append(f"note: the run is not complete; its last frame is at {figures['load']:.1%} of the load time")
    lines.append(
        f"{'':24}{'':>8}{'largest error, mm':>36}{'rms error, mm':>36}{'share of':>9}{'reference':>11}\n"
        f"{'':24}{'places':>8}"
        + 2 * "".join(f"{c:>9}" for c in ("x", "y", "z", "norm"))
        + f"{'largest':>9}{'err, mm':>11}"
    )
    for name, group in figures["groups"].items():
        label = f"{name} {figures['beyond_mm']:g} mm" if name == "free beyond" else name
        numbers = "".join(f"{number:9.4f}" for number in (*group["largest_mm"], *group["rms_mm"]))
        own = group["reference_error_mm"]
        lines.append(
            f"{label:24}{group['places']:8}{numbers}{group['share_of_largest']:9.2%}"
            + (f"{'-':>11}" if own is None else f"{own:11.4f}")
        )
    return "\n".join(lines)


def _differing(ours: dict[str, Any], theirs: dict[str, Any] | None) -> list[str]:
    """Keys of the scene that differ between both runs; none if the reference is no run."""
    found = []
    for name, *values in deck.differences(ours, theirs or ours):
        moved = all(isinstance(value, str) for value in values) and len({Path(value).name for value in values}) == 1
        if deck.changes_physics(name) and not moved:  # a moved file may be the same
            found.append(name)
    return found


def _edge(model: Model) -> float:
    """Mean edge of the hexahedra, m: the surfaces of different meshes of a body differ by less."""
    sizes = hexahedra.volumes(model.points, model.hexahedra)
    return float(np.cbrt(sizes.mean())) if len(sizes) else float("inf")


def _largest(displacement: NDArray[np.float64]) -> float:
    return 1e3 * float(np.linalg.norm(displacement, axis=1).max(initial=0))


def _figures(reference: Reference, difference: NDArray[np.float64], chosen: NDArray[np.bool_]) -> dict[str, Any]:
    """Largest and root mean square of x, y, z and the norm over the chosen places."""
    four = 1e3 * np.abs(np.column_stack([difference, np.linalg.norm(difference, axis=1)])[chosen])
    largest = _largest(reference.displacement)
    return {
        "places": len(four),
        "largest_mm": four.max(axis=0).tolist(),
        "rms_mm": np.sqrt((four**2).mean(axis=0)).tolist(),
        "share_of_largest": float(four[:, 3].max() / largest) if largest else 0.0,
        "reference_error_mm": None if reference.error is None else 1e3 * float(reference.error[chosen].max()),
        "worst_place_mm": (1e3 * reference.places[chosen][four[:, 3].argmax()]).tolist(),
    }


# --- edges ---------------------------------------------------------------------------------------------------------


def edge_distance(model: Model, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances (n,), m, of places (n, 3) from edges between prescribed and free surface; infinite without an edge.

    On hexahedra an edge is between a face whose nodes are all prescribed in all directions and another face. A surface
    of EFG nodes has no faces: there the prescribed nodes count that have a free node among their three nearest.
    """
    held, _ = field.prescribed(model)
    faces = field.outer_faces(model)
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    unique, which = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    of_held = np.repeat(held[faces].all(axis=1), 4)
    between = [np.bincount(which.ravel(), side, len(unique)) > 0 for side in (of_held, ~of_held)]
    ends = model.points[unique[between[0] & between[1]]]
    share = np.linspace(0, 1, _SAMPLES)[:, None, None]
    on_edges = ((1 - share) * ends[:, 0] + share * ends[:, 1]).reshape(-1, 3)

    outer = np.unique(np.concatenate([np.empty(0, np.int64), *(model.node_sets.get(name, []) for name in OUTER)]))
    outer = outer[outer >= model.n_fe_nodes].astype(np.int64)
    if len(outer):
        near = cKDTree(model.points[outer]).query(model.points[outer], min(4, len(outer)))[1].reshape(len(outer), -1)
        last = outer[held[outer] & ~held[outer[near]].all(axis=1)]
        on_edges = np.concatenate([on_edges, model.points[last]])
    return np.asarray(cKDTree(on_edges).query(places)[0]) if len(on_edges) else np.full(len(places), np.inf)


# --- references ----------------------------------------------------------------------------------------------------


def read_reference(path: Path, ours: Field) -> Reference:
    """A reference for the run: .npz, .csv, .vtu or .vtkhdf, all in metres, or another run's folder or result.

    An .npz holds X (n, 3), u (n, 3) and optionally err_u (n,) and tag (n,); u (k, n, 3) belongs to the k tumour radii
    of "R" in its JSON string `meta`. A .csv has a line of names, x, y, z, ux, uy, uz and optionally err and tag. VTK
    files need PyVista and a point array of displacements. InputError if there is no such file or it is invalid.
    """
    if not path.exists():
        raise InputError(f"{path}: does not exist; give .npz, .csv, .vtu, .vtkhdf or the folder of a run")
    if path.is_dir():
        return _of_result(path)
    if path.suffix == ".npz":
        return _of_npz(path, ours)
    if path.suffix == ".csv":
        return _of_csv(path)
    if path.suffix == ".vtkhdf" and store.is_result(path):
        return _of_result(path)
    if path.suffix in (".vtu", ".vtkhdf"):
        return _of_vtk(path)
    raise InputError(f"{path}: is not a reference; give .npz, .csv, .vtu, .vtkhdf or the folder of a run")


def _of_result(path: Path) -> Reference:
    """The nodes of another run, with the tags of its model."""
    theirs = field.open_field(path)
    if not theirs.complete:
        raise InputError(f"{path}: the run is not complete; run it again")
    held, moves = field.prescribed(theirs.model)
    tag = np.zeros(theirs.model.n_nodes, np.int64)
    tag[np.unique(field.outer_faces(theirs.model))] = TAGS.index("free surface")
    for name in OUTER:
        tag[theirs.model.node_sets.get(name, [])] = TAGS.index("free surface")
    tag[held] = TAGS.index("fixed")
    tag[moves] = TAGS.index("moved")
    return Reference(theirs.model.points, theirs.at_nodes, None, tag, theirs.metadata["deck"])


def _of_npz(path: Path, ours: Field) -> Reference:
    names = ("X", "u", "err_u", "tag", "meta")
    try:
        with zipfile.ZipFile(path) as archive:
            # The arrays may be a thousand times larger than the compressed file.
            size = sum(member.file_size for member in archive.infolist() if member.filename[:-4] in names)
        resources.check_memory(4 * size, f"{path}: its arrays", "give fewer places")
        with np.load(path, allow_pickle=False) as arrays:
            data = {name: np.asarray(arrays[name]) for name in names if name in arrays}
        meta = dict(json.loads(str(data.pop("meta", "{}"))))
        radii = np.asarray(meta.get("R", []), float)
        if any(values.dtype.kind not in "fiub" for values in data.values()):
            raise ValueError("an array is not numeric")
    except InputError:
        raise
    except Exception as problem:  # zip and numpy raise any kind
        reason = " ".join(str(problem).split())[:100] or type(problem).__name__
        raise InputError(f"{path}: cannot be read as .npz ({reason}); write it again with numpy.savez") from None
    if "X" not in data or "u" not in data:
        raise InputError(f"{path}: has no arrays X and u, places (n, 3) and displacements (n, 3)")
    u, error = data["u"], data.get("err_u")
    if u.ndim == 3:
        row = _row(path, radii, len(u), ours)
        u, error = u[row], error[row] if error is not None and error.shape[:1] == radii.shape else error
    return _checked(path, Reference(data["X"], u, error, data.get("tag")))


def _row(path: Path, radii: NDArray[np.float64], n: int, ours: Field) -> int:
    """The row of the run's tumour among those of a reference."""
    if len(radii) != n:
        raise InputError(f'{path}: u has {n} loads, but meta names {len(radii)} tumour radii ("R", in m)')
    shown = ", ".join(f"{1e3 * radius:.4g}" for radius in radii)
    tumour = ours.metadata["tumour"]
    if not tumour:
        raise InputError(f"{path}: has tumours of {shown} mm radius, but the run has no tumour")
    row = int(np.abs(radii - tumour["radius_m"]).argmin())
    if abs(radii[row] - tumour["radius_m"]) > _SAME_RADIUS * radii[row]:
        raise InputError(
            f"{path}: has tumours of {shown} mm radius, the run's tumour has {1e3 * tumour['radius_m']:.4g} mm"
        )
    return row


def _of_csv(path: Path) -> Reference:
    file = io.StringIO(text.decode(text.read_text(path, "a table of places and displacements (CSV)")))
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
    places, u = (np.column_stack([column[a + axis] for axis in "xyz"]) for a in ("", "u"))
    return _checked(path, Reference(places, u, column.get("err"), column.get("tag")))


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
        if path.suffix == ".vtkhdf":  # PyVista has no choice of the step
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
    """InputError if an XML file declares more points or cells than its bytes can hold: VTK allocates them first."""
    content = path.read_bytes()
    claims = [int(n) for n in re.findall(rb'NumberOf(?:Points|Cells|Tuples|Components)\s*=\s*["\'](\d{1,18})', content)]
    if max(claims, default=0) > 1000 * len(content) or re.search(rb'NumberOf\w+\s*=\s*["\']\s*[+-]?\d{19}', content):
        raise InputError(
            f"{path}: declares {max(claims, default=0)} points or cells in {len(content)} bytes; write it again"
        )


def _checked(path: Path, reference: Reference) -> Reference:
    """The reference in float64. InputError if its arrays do not fit together."""
    n = len(reference.places)
    for name, shape in {"places": (n, 3), "displacement": (n, 3), "error": (n,), "tag": (n,)}.items():
        array = getattr(reference, name)
        if array is not None and (array.shape != shape or not np.isfinite(array).all()):
            raise InputError(f"{path}: {name} has shape {array.shape} for {n} places, or values that are not finite")
    if (
        not (np.abs(reference.places) < MAX_COORDINATE).all()
        or not (np.abs(reference.displacement) < MAX_COORDINATE).all()
    ):
        raise InputError(f"{path}: has places or displacements beyond {MAX_COORDINATE:g} m; correct them")
    if n == 0:
        raise InputError(f"{path}: has no places")
    tag = None if reference.tag is None else reference.tag.astype(np.int64)
    if tag is not None and not np.isin(tag, range(len(TAGS))).all():
        raise InputError(f"{path}: tag has numbers other than 0 to {len(TAGS) - 1} ({', '.join(TAGS)})")
    error = None if reference.error is None else reference.error.astype(float)
    return replace(
        reference, places=reference.places.astype(float), displacement=reference.displacement.astype(float),
        error=error, tag=tag,
    )  # fmt: skip
