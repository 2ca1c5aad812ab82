"""Checks of the position of the tumour's seed, and positions and lengths in messages."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mpitled.errors import InputError
from mpitled.mesh import Bools, Floats, Ints
from mpitled.meshing.faces import boundary_faces

if TYPE_CHECKING:
    from mpitled import deck


def format_position(position: Floats) -> str:
    """A position (3,), m, as text in millimetres."""
    return "(" + ", ".join(f"{1e3 * x:g}" for x in position) + ") mm"


def format_length(metres: float) -> str:
    """A length, m, as text in millimetres, rounded to 0.01 mm and three digits."""
    return f"{round(1e3 * metres, 2):.3g} mm"


def unit_hint(position: Floats, low: Floats, high: Floats) -> str:
    """A hint or "": 1000 times the position (3,), m, lies in the box low to high, m, as if written in metres."""
    in_metres = 1e3 * position
    if not 0 < np.abs(position).max() < 1e-3 or not ((low <= in_metres) & (in_metres <= high)).all():
        return ""
    return f"it looks like metres: in mm it is {format_position(in_metres).removesuffix(' mm')}"


def in_sphere(points: Floats, sphere: deck.Sphere) -> Bools:
    """Mask (n,) of points (n, 3), m, in the sphere."""
    return np.asarray(np.linalg.norm(points - np.asarray(sphere.centre), axis=1) <= sphere.radius)


def check_inside(points: Floats, hexahedra: Ints, tumour: deck.Tumour) -> None:
    """InputError unless the tumour's centre lies inside the body of the hexahedra (n, 8)."""
    centre = np.asarray(tumour.centre, float)
    inside, distance = _locate(points[boundary_faces(hexahedra)], centre)
    if not inside:
        low, high = points.min(axis=0), points.max(axis=0)
        hint = unit_hint(centre, low, high)
        raise InputError(
            f"tumour.centre = {format_position(centre)}: is outside the body, {format_length(distance)} from it; "
            f"move it inside (from {format_position(low)} to {format_position(high)})" + (f"; {hint}" if hint else "")
        )


def check_seed_fits(points: Floats, boundary: Ints, tumour: deck.Tumour, element_size: float, radius: float) -> None:
    """InputError unless the seed lies inside the cloud's boundary (n, 4), with an element's size of cloud around it.

    `radius` (m) is cloud.radius: replaceable hexahedra with their centre within it are replaced.
    """
    centre = np.asarray(tumour.centre, float)
    inside, distance = _locate(points[boundary], centre)
    needed = tumour.seed_radius + element_size
    if inside and distance >= needed:
        return
    message = f"tumour.centre = {format_position(centre)}: is "
    if not inside:
        message += f"not inside the cloud, but {format_length(distance)} from it; move it"
    else:
        # The nearest hexahedron outside the cloud is too far from the centre, or it must not be replaced.
        remedy = "enlarge cloud.radius"
        if distance + element_size < radius:
            remedy = "the outer surface or a ventricle is too near, whatever cloud.radius: move it away from there"
        message += (
            f"{format_length(distance)} from the cloud's boundary, but the seed and an element's size of cloud around "
            f"it need {format_length(needed)}; {remedy}, or make the hexahedra smaller"
        )
    hint = unit_hint(centre, points.min(axis=0), points.max(axis=0))
    raise InputError(f"{message}; {hint}" if hint else message)


def _locate(surface: Floats, point: Floats) -> tuple[bool, float]:
    """Whether a point (3,) lies inside a closed surface of quadrilaterals (n, 4, 3), and their distance, m."""
    quads = surface - point
    # Solid angles of a closed surface sum to 4 pi for a point inside, to 0 outside (van Oosterom and Strackee 1983).
    a, b, c = np.moveaxis(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    denominator = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    solid_angle = 2 * np.arctan2((a * np.cross(b, c)).sum(1), denominator).sum()
    s = np.linspace(0, 1, 9)
    weights = np.stack(
        [np.outer(1 - s, 1 - s), np.outer(s, 1 - s), np.outer(s, s), np.outer(1 - s, s)], axis=-1
    ).reshape(-1, 4)
    distance = min(np.linalg.norm(quads.transpose(0, 2, 1) @ w, axis=1).min() for w in weights)
    return bool(solid_angle >= 2 * np.pi), float(distance)
