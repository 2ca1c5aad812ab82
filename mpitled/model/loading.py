"""Prescribed motion: the loading curve, the growing sphere of the tumour, and rotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpitled.mesh import Rotation


def loading_curve(share: float) -> float:
    """Share of the full load at the share t/T of the load time (paper, eq. 4.1): rest at both ends."""
    s = min(max(share, 0.0), 1.0)
    return (10 - 15 * s + 6 * s * s) * s**3


def sphere_radius(volume: float) -> float:
    """Radius (m) of the sphere of that volume (m^3)."""
    return float(np.cbrt(3 * volume / (4 * np.pi)))


def growth(
    points: NDArray[np.float64], centre: NDArray[np.float64], seed_radius: float, volume: float
) -> NDArray[np.float64]:
    """Radial displacement (n, 3), m at full load, of nodes (n, 3), m, on the seed's surface to a sphere of that volume.

    In a mesh that does not follow the seed, nodes are beside its surface. They move as incompressible tissue does: the
    cube of the distance from the centre grows by R^3 - r0^3.
    """
    cubed = ((points - centre) ** 2).sum(axis=1) ** 1.5
    grown = np.cbrt(cubed + sphere_radius(volume) ** 3 - seed_radius**3)
    return (grown / np.cbrt(cubed) - 1)[:, None] * (points - centre)


def rotation_path(points: NDArray[np.float64], rotation: Rotation) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Displacements (n, 3), m at full load, of rotated points (n, 3), m, and their paths (n, 3, 3).

    The last axis of the paths is, for each direction, the angle phi in rad, the arm r from the axis and e x r, both in
    m: at the share d of the load the displacement is (cos(d phi) - 1) r + sin(d phi) e x r.
    """
    arm = points - np.asarray(rotation.centre)
    arm[:, rotation.axis] = 0.0
    across = np.cross(np.eye(3)[rotation.axis], arm)
    paths = np.stack([np.full_like(arm, rotation.angle), arm, across], axis=2)
    return (np.cos(rotation.angle) - 1) * arm + np.sin(rotation.angle) * across, paths
