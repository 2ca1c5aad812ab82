"""Errors of a result against a reference: another solver's field at its own places, or another result of ours."""

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
from mpitled.readers import meshfile
from mpitled.readers.meshfile import FARTHEST
from mpitled.results import field
from mpitled.results.field import Field

#: What the tags of a reference mean; fixed and moved places are prescribed, so that they say nothing of the solution.
TAGS = ("interior", "free surface", "fixed", "moved", "material interface")
_PRESCRIBED = (2, 3)
#: A reference for several tumours is used for a run whose radius is within this share of one of them.
_SAME_RADIUS = 1e-3
_SHOWN = 4  # keys in which two scenes differ that are named
_SAMPLES = 32  # places on each edge, for distances from it


@dataclass(frozen=True, slots=True)
class Reference:
    """A displacement field that is taken for true, at places of the undeformed body."""

    places: NDArray[np.float64]  # (n, 3), m
    displacement: NDArray[np.float64]  # (n, 3), m
    error: NDArray[np.float64] | None = None  # (n,), m: its own estimate, of the largest component
    tag: NDArray[np.int64] | None = None  # (n,), index into TAGS
    deck: dict[str, Any] | None = None  # of a run of ours


def compare(result: Path, reference: Path, beyond: float | None = None) -> dict[str, Any]:
    """Figures of the difference, in mm, in the last frame of a run; `beyond` (m) makes a group of its own.

    Groups are "all", "free" (what is not prescribed), each tag of the reference, and "free beyond" that distance from
    edges between nodes that are prescribed in all directions and free surface, where fields are singular.
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
    """What `compare` found, as lines for the terminal."""
    lines = [
        f"{figures['result']} against {figures['reference']}",
        f"{figures['in_hexahedra']} places in hexahedra, {figures['in_cloud']} in the cloud, {figures['outside']} "
        f"outside (at most {figures['farthest_outside_mm']:.3f} mm); "
        f"largest displacement {figures['largest_displacement_mm']:.3f} mm",
    ]
    if figures["beside_the_body"]:
        lines.append(
            f"warning: {figures['beside_the_body']} places lie more than a cell's edge outside of the body, where it "
            "has no field: are both of one body, and in metres?"
        )
    if keys := figures["scene_differs_in"]:
        more = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
        lines.append(f"note: the scenes of both differ in {', '.join(keys[:_SHOWN])}{more}")
    if not figures["complete"]:
        lines.append(f"the run is not finished: the field is that at {figures['load']:.1%} of the load time")
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
    """Keys of the scene that are not the same for both runs; none where the reference is no run."""
    found = []
    for name, *values in deck.differences(ours, theirs or ours):
        moved = all(isinstance(value, str) for value in values) and len({Path(value).name for value in values}) == 1
        if deck.changes_physics(name) and not moved:  # a file may lie elsewhere, and be the same
            found.append(name)
    return found


def _edge(model: Model) -> float:
    """Of a hexahedron, in the mean, m: surfaces of bodies that are meshed otherwise differ by less."""
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
    """Distances (n,), m, of places (n, 3) from edges between prescribed and free surface; infinite without any.

    On hexahedra these are the faces' edges between faces whose nodes are all prescribed in all directions and others.
    On a surface of EFG nodes, which has no faces, they are prescribed nodes with a free one among their three nearest.
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

    An .npz holds X (n, 3), u (n, 3) and perhaps err_u (n,) and tag (n,); u (k, n, 3) is for the k tumour radii of "R"
    in its JSON string `meta`. A .csv has a line of names, x, y, z, ux, uy, uz and perhaps err and tag. VTK files need
    the package vtk and a point array of displacements. InputError if there is no such file or it is not like that.
    """
    if not path.exists():
        raise InputError(f"{path}: is not there; give .npz, .csv, .vtu, .vtkhdf or the folder of a run")
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
    raise InputError(f"{path}: is no reference; give .npz, .csv, .vtu, .vtkhdf or the folder of a run")


def _of_result(path: Path) -> Reference:
    """The nodes of another run, tagged by what the model says of them."""
    theirs = field.open_field(path)
    if not theirs.complete:
        raise InputError(f"{path}: the run did not come to its end; run it again")
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
            # What is packed may be a thousand times what is in the file.
            size = sum(member.file_size for member in archive.infolist() if member.filename[:-4] in names)
        resources.check_memory(4 * size, f"{path}: its arrays", "give fewer places")
        with np.load(path, allow_pickle=False) as arrays:
            data = {name: np.asarray(arrays[name]) for name in names if name in arrays}
        meta = dict(json.loads(str(data.pop("meta", "{}"))))
        radii = np.asarray(meta.get("R", []), float)
        if any(values.dtype.kind not in "fiub" for values in data.values()):
            raise ValueError("it holds other than numbers")
    except InputError:
        raise
    except Exception as problem:  # of zip and numpy, which raise what they like
        reason = " ".join(str(problem).split())[:100] or type(problem).__name__
        raise InputError(f"{path}: cannot be read as .npz ({reason}); write it anew with numpy.savez") from None
    if "X" not in data or "u" not in data:
        raise InputError(f"{path}: has no X and u; give places (n, 3) and displacements (n, 3) under these names")
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
        raise InputError(f"{path}: is of tumours of {shown} mm radius, but the run has no tumour")
    row = int(np.abs(radii - tumour["radius_m"]).argmin())
    if abs(radii[row] - tumour["radius_m"]) > _SAME_RADIUS * radii[row]:
        raise InputError(f"{path}: is of tumours of {shown} mm radius, the run's has {1e3 * tumour['radius_m']:.4g} mm")
    return row


def _of_csv(path: Path) -> Reference:
    file = io.StringIO(meshfile.decoded(meshfile.read_text(path, "a table of places and displacements (CSV)")))
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
    """Points and displacements of the last step of an unstructured grid of others."""
    try:
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkIOHDF import vtkHDFReader
        from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader
    except ImportError:
        raise InputError(f"{path}: to read it, install vtk: pip install vtk") from None
    if path.suffix == ".vtu":
        _check_vtu(path)
    reader: Any = vtkXMLUnstructuredGridReader() if path.suffix == ".vtu" else vtkHDFReader()
    reader.SetFileName(str(path))
    if path.suffix == ".vtkhdf":
        reader.UpdateInformation()
        reader.SetStep(max(reader.GetNumberOfSteps() - 1, 0))
    reader.Update()
    grid = reader.GetOutputDataObject(0)
    if grid is None or not grid.IsA("vtkUnstructuredGrid") or not grid.GetNumberOfPoints():
        raise InputError(f"{path}: cannot be read as an unstructured grid of VTK")
    arrays = [grid.GetPointData().GetArray(i) for i in range(grid.GetPointData().GetNumberOfArrays())]
    vectors = {array.GetName(): array for array in arrays if array and array.GetNumberOfComponents() == 3}
    named = [name for name in vectors if name.lower().startswith(("u", "disp", "field_disp"))] or list(vectors)
    if len(named) != 1:
        raise InputError(f"{path}: point vectors are {', '.join(vectors) or 'none'}; name one u or displacement")
    places, u = vtk_to_numpy(grid.GetPoints().GetData()), vtk_to_numpy(vectors[named[0]])
    return _checked(path, Reference(places, u))


def _check_vtu(path: Path) -> None:
    """InputError if an XML file claims more points or cells than its bytes can make: VTK takes room for them first."""
    content = path.read_bytes()
    claims = [int(n) for n in re.findall(rb'NumberOf(?:Points|Cells|Tuples|Components)\s*=\s*["\'](\d{1,18})', content)]
    if max(claims, default=0) > 1000 * len(content) or re.search(rb'NumberOf\w+\s*=\s*["\']\s*[+-]?\d{19}', content):
        raise InputError(
            f"{path}: claims {max(claims, default=0)} points or cells in {len(content)} bytes; write it anew"
        )


def _checked(path: Path, reference: Reference) -> Reference:
    """The reference in float64, or an InputError if its arrays do not fit each other."""
    n = len(reference.places)
    for name, shape in {"places": (n, 3), "displacement": (n, 3), "error": (n,), "tag": (n,)}.items():
        array = getattr(reference, name)
        if array is not None and (array.shape != shape or not np.isfinite(array).all()):
            raise InputError(f"{path}: {name} has shape {array.shape} for {n} places, or numbers that are not finite")
    if not (np.abs(reference.places) < FARTHEST).all() or not (np.abs(reference.displacement) < FARTHEST).all():
        raise InputError(f"{path}: has places or displacements beyond {FARTHEST:g} m; correct them")
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
