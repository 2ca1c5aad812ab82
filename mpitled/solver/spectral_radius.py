"""Largest eigenvalue of the assembled operator by power iteration, as a share of the sum of the cells' bounds.

The sum of the bounds is two to ten times the largest eigenvalue of the assembled stiffness, because neighbouring cells
do not oscillate together in their stiffest modes. The ratio depends on the mesh and changes slowly with the
deformation. Time steps and masses that follow from the bound are relaxed by it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import Subdomain
from mpitled.terms import State, Term, apply
from mpitled.terms.restart import replicated

#: Most iterations at first, and later; and the growth of Rayleigh's quotient in one iteration at which they end. The
#: quotient grows towards the eigenvalue; `solver.safety` covers the rest, 0.64 of the eigenvalue. Each start is random:
#: from the last eigenvector, a mode that appears elsewhere, as next to a growing seed, is found too late.
MAX_ITER_FIRST, MAX_ITER, RTOL = 60, 15, 1.01
#: The result is rounded up to a power of this, so that ranks that sum in another order find the same.
ROUND_TO = 1.02
#: If the ratio grew by more than this factor, the next step estimates it again.
REPEAT_ABOVE = 1.05
#: Each start has the same numbers: if none of the first quotients has grown by more than this factor, nothing has
#: changed, and the other iterations are skipped.
N_REFERENCE, CHANGED_ABOVE = 3, 1.003


@dataclass(init=False, eq=False, repr=False)
class SpectralRadius:
    """Power iteration on K = df/du in the present configuration. All calls are collective."""

    ratio_to_bound: float = replicated(control=True, default=0.0)  # the largest so far; 0 before the first estimate
    interval: int = replicated(control=True, default=1)  # steps between estimates; set by the integrator
    full_every: int = replicated(control=True, default=1)  # every which estimate skips nothing; set by the integrator
    next_step: int = replicated(control=True, default=0)  # the step of the next estimate
    reference: list[float] = replicated(control=True, default_factory=list)  # lowest first quotients, as ratios
    skipped: int = replicated(control=True, default=0)  # estimates since the last full one

    def __init__(self, sub: Subdomain, world: World, forces: tuple[Term, ...]) -> None:
        self._sub, self._world, self._forces = sub, world, forces
        self._held = sub.held % 3, sub.held // 3
        self.reference = []
        # Scratch; single precision is enough, because the mode is tried as it is.
        self.mode = np.zeros((3, sub.n_nodes), np.float32)
        spread = float(np.ptp(sub.rows.read("points"), axis=0).max()) if sub.n_nodes else 0.0
        # m, of the largest displacement that is tried: well above round-off, well below a cell.
        self._reach = float(np.finfo(sub.precision).eps) ** 0.5 * 0.02 * self._largest(spread)

    def update(self, s: State, dt2_over_m: NDArray[np.float64], bound: float) -> None:
        """Renew `ratio_to_bound`, of the largest eigenvalue of dt2_over_m K to its bound, and `next_step`.

        s has the forces of its displacements, whose last bits may change. dt2_over_m, s^2/kg: (1, n_nodes), or
        symmetric tensors (6, n_nodes); 0 at prescribed dofs. bound: the same on all ranks.
        """
        grown, n_reference = self.next_step == s.step, len(self.reference)
        full, ratios = grown or self.skipped + 1 >= self.full_every or not n_reference, [0.0]
        most = MAX_ITER if self.ratio_to_bound else MAX_ITER_FIRST
        for quotient in islice(self._quotients(s, dt2_over_m), most if bound > 0 else 0):
            ratios.append(quotient / bound)
            changed = any(r > CHANGED_ABOVE * low for r, low in zip(ratios[1:], self.reference, strict=False))
            if (len(ratios) > n_reference and not full and not changed) or (
                len(ratios) > 3 and ratios[-1] < RTOL * ratios[-2]
            ):
                break
            full = full or changed
        # Small displacements may have changed in their last bits: a resumed run begins with their forces.
        s.f[:] = 0
        apply(s, self._forces)
        if not full:
            self.reference = [min(pair) for pair in zip(ratios[1:], self.reference, strict=False)]
            self.skipped += 1
            self.next_step = s.step + self.interval
            return
        found = float(ROUND_TO ** math.ceil(math.log(ratios[-1]) / math.log(ROUND_TO))) if ratios[-1] > 0 else 0.0
        self.reference, self.skipped = ratios[1 : 1 + N_REFERENCE], 0
        self.next_step = s.step if found > REPEAT_ABOVE * self.ratio_to_bound > 0 else s.step + self.interval
        self.ratio_to_bound = min(1.0, max(self.ratio_to_bound, found)) or 1.0  # 1 if no dof is free

    def _quotients(self, s: State, dt2_over_m: NDArray[np.float64]) -> Iterator[float]:
        """Rayleigh's quotients of dt2_over_m K, rising to the largest eigenvalue."""
        rows, trial, mode = self._sub.rows, copy(s), self.mode
        trial.f = np.empty_like(s.f)
        kernels.hash_random(mode, rows.nodes)
        mode[self._held] = 0
        size, weight = self._largest(np.abs(mode).max(initial=0.0)), 0.0
        while 0 < size < math.inf:
            # Added in place and subtracted again: a copy would be among the largest arrays of a run. Round-off remains,
            # the same on all ranks.
            scale = self._reach / size
            kernels.perturb(s.u, mode, scale, s.u_cells)
            trial.f[:] = 0
            apply(trial, self._forces)
            kernels.perturb(s.u, mode, -scale if s.u_cells is s.u else 0.0, s.u_cells)
            # The mode becomes dt2_over_m times its response, so that response . mode = mode . M mode.
            trial.f[self._held] = s.f[self._held]
            sums = kernels.power_iteration(mode, trial.f, s.f, dt2_over_m, rows.owned, self._reach, size)
            table = self._world.gather(sums)
            quotient, size = float(table[:, 0].sum()), float(table[:, 2].max())
            if weight > 0:
                yield quotient / weight
            weight = float(table[:, 1].sum()) / size**2 if size > 0 else 0.0

    def _largest(self, value: float) -> float:
        return float(self._world.gather([value]).max())
