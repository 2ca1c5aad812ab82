"""The compiled kernels of a step: nodal forces, the survey of the cells, the central-difference update, packing.

Nodal arrays are component-major, (3, n_nodes + PADDING). Every index is unsigned, because numba's test for negative
indices stops the vectoriser. Forces are *internal* forces f; the equation of motion is m a = -f at free nodes. All are
in SI units, and run in the precision of the arrays that they are given. Constants are cast (`u.dtype.type`), or float32
would be promoted.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba.core import config


@contextmanager
def _cached_by_source() -> Iterator[None]:
    """Cached apart for each state of this package: numba itself sees no change in a module that a kernel imports."""
    settings: Any = config
    digest, before, here = hashlib.sha256(), settings.CACHE_DIR, Path(__file__).parent
    for path in sorted(here.glob("*.py")):
        digest.update(path.read_bytes())
    settings.CACHE_DIR = str(Path(before or here / "__pycache__") / f"mpitled-{digest.hexdigest()[:16]}")
    try:
        yield
    finally:
        settings.CACHE_DIR = before


with _cached_by_source():
    from mpitled.kernels.domains import domain_forces, domain_survey
    from mpitled.kernels.hexahedra import hexahedron_forces, hexahedron_survey, voxel_forces, voxel_survey
    from mpitled.kernels.lanes import BATCH as BATCH_LANES
    from mpitled.kernels.nodes import (
        add,
        add_gathered,
        change_step,
        gather,
        hash_random,
        invert_masses,
        kinetic_energy,
        limit_mass_decrease,
        perturb,
        power_iteration,
        raise_mass,
        reaction_work,
        relax,
        relaxation_norms,
        rotate_prescribed,
        scatter,
        update,
    )  # fmt: skip

PADDING = BATCH_LANES  # the last vector of a run reads beyond the run's nodes, and adds nothing there

__all__ = [
    "BATCH_LANES", "PADDING", "add", "add_gathered", "change_step", "domain_forces", "domain_survey", "gather",
    "hash_random", "hexahedron_forces", "hexahedron_survey", "invert_masses", "kinetic_energy",
    "limit_mass_decrease", "perturb", "power_iteration", "raise_mass", "reaction_work", "relax", "relaxation_norms",
    "rotate_prescribed", "scatter", "update", "voxel_forces", "voxel_survey",
]  # fmt: skip
