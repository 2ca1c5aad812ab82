"""How the prescribed motion grows: the loading curve, and the tumour's sphere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
    """Displacement (n, 3), m at full load, of nodes on the seed's surface: radially, to the sphere of that volume."""
    return (sphere_radius(volume) / seed_radius - 1) * (points - centre)
