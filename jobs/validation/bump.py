"""Write bump.csv: a smooth bump of 10 mm depth on an ellipsoid's surface, as a registration might give it.

Reference: tests/data/B_bump.npz. Places are 3 mm apart in the bump and 8 mm elsewhere, where nothing moves.
"""

from pathlib import Path

import numpy as np

AXES, DEPTH, REACH = np.array([80.0, 65.0, 60.0]), 10.0, 40.0  # mm


def bump(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Displacement along z, mm."""
    return np.where(z > 0, -DEPTH * np.maximum(1 - (x**2 + y**2) / REACH**2, 0) ** 3, 0.0)


def spread(apart: float) -> np.ndarray:
    """Places (n, 3), mm, on the ellipsoid, at most about so far apart: a Fibonacci lattice, stretched."""
    n = int(4 * np.pi * AXES.max() ** 2 / apart**2)
    i = np.arange(n) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / n), np.pi * (1 + 5**0.5) * i
    return AXES * np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)


fine, coarse = spread(3.0), spread(8.0)
near = np.hypot(fine[:, 0], fine[:, 1]) < 1.15 * REACH
fine = fine[near & (fine[:, 2] > 0)]
coarse = coarse[(np.hypot(coarse[:, 0], coarse[:, 1]) > 1.1 * REACH) | (coarse[:, 2] < 0)]
places = np.concatenate([fine, coarse]).round(3)
moved = bump(*places.T)[:, None] * [0.0, 0.0, 1.0] + 0.0  # no -0.0 in the file
np.savetxt(
    Path(__file__).with_name("bump.csv"), np.hstack([places, moved]), "%.3f", ",", header="x,y,z,ux,uy,uz", comments=""
)
