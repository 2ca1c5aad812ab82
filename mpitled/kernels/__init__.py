"""The compiled kernels of nodes, and what the kernels of cells are made from: vectors, tensors and templates.

Nodal arrays are component-major, (3, n_nodes + PADDING). Every index is unsigned, because numba's test for negative
indices stops the vectoriser. Forces are *internal* forces f; the equation of motion is m a = -f at free nodes. All are
in SI units, and run in the precision of the arrays that they are given. Constants are cast (`u.dtype.type`), or float32
would be promoted.
"""

from mpitled.kernels.templates import cached_by_source

with cached_by_source():
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
    "BATCH_LANES", "PADDING", "add", "add_gathered", "change_step", "gather", "hash_random", "invert_masses",
    "kinetic_energy", "limit_mass_decrease", "perturb", "power_iteration", "raise_mass", "reaction_work", "relax",
    "relaxation_norms", "rotate_prescribed", "scatter", "update",
]  # fmt: skip
