"""How sharp the bound of the cells' stiffness is: the assembled operator's largest eigenvalue, by power iteration.

The sum of the cells' bounds is two to ten times the largest eigenvalue of the assembled stiffness, for neighbours do
not swing in their stiffest modes together. The quotient is a matter of the mesh and changes slowly with the
deformation; steps and masses that the bound asks for are relaxed by it.
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np
from numpy.typing import NDArray

from mpitled.solver import kernels
from mpitled.solver.halo import World
from mpitled.solver.memory import Kept
from mpitled.solver.step import State, Term, take
from mpitled.solver.subdomain import Subdomain

#: Most iterations at first, and later; and the growth of Rayleigh's quotient in one at which they end. It grows towards
#: the eigenvalue: what is missing is left to `solver.safety`, 0.64 of the eigenvalue. Each time they begin at random:
#: from the last eigenvector a mode that comes up elsewhere, as next to a growing seed, is found too late.
FIRST, AGAIN, CONVERGED = 60, 15, 1.01
#: What is found is rounded up to a power of this, so that ranks summed in another order find the same.
RUNG = 1.02
#: Where the share grew by more than this, it is looked for again at once.
GROWS = 1.05


class Sharpness:
    """Power iteration on K = df/du in the present configuration, on all ranks; all of its calls are collective."""

    LASTING = Kept(alike=("share", "seldom", "next"))

    def __init__(self, sub: Subdomain, world: World, forces: tuple[Term, ...]) -> None:
        self._sub, self._world, self._forces = sub, world, forces
        held = np.concatenate([sub.fixed, sub.moving])
        self._held = held % 3, held // 3
        self.share = 0.0  # of the bound, that the operator has had at most
        self.seldom, self.next = 1, 0  # steps from one time that it is looked for to the next, and when that is
        spread = float(np.ptp(sub.rows.read("points"), axis=0).max()) if sub.n_nodes else 0.0
        # m, of the largest displacement that is tried: well above round-off, well below a cell.
        self._reach = float(np.finfo(sub.precision).eps) ** 0.5 * 0.02 * self._largest(spread)

    def asleep(self) -> Sharpness:
        """A copy that asks nothing of other ranks at the next survey."""
        twin = copy(self)
        twin.share = 1.0
        return twin

    def renew(self, s: State, mobility: NDArray[np.float64], bound: float) -> None:
        """The share that the largest eigenvalue of `mobility` K has of its bound (alike), and when to look again."""
        found = self.largest_eigenvalue(s, mobility) / bound if bound > 0 else 0.0
        # Small displacements may have changed in their last bits: a run that is continued begins with their forces.
        s.f[:] = 0
        take(s, self._forces)
        self.next = s.step if found > GROWS * self.share else s.step + self.seldom
        self.share = min(1.0, max(self.share, found)) or 1.0  # where nothing is free nothing is found

    def largest_eigenvalue(self, s: State, mobility: NDArray[np.float64]) -> float:
        """Largest eigenvalue (1/s^2 times the mobility's dt^2) of `mobility` K at the displacements of s, from below.

        s has the forces of its displacements, which may change in their last bits. mobility, s^2/kg: (1, n_nodes), or
        symmetric tensors (6, n_nodes); 0 where it does not matter. What is tried takes the room of `s.good`.
        """
        rows, trial, mode = self._sub.rows, copy(s), s.good
        trial.f = np.empty_like(s.f)
        # The mode has less than the displacements' precision, for whatever it is, it is tried as it is.
        kernels.scramble(mode, rows.nodes)
        mode[self._held] = 0
        size, weight, found = self._largest(np.abs(mode).max(initial=0.0)), 0.0, 0.0
        for iteration in range(AGAIN if self.share else FIRST):
            if not 0 < size < math.inf:
                return found
            # Tried in place and taken back, for a copy would be among the largest arrays of a run. Round-off remains of
            # it, the same on all ranks.
            scale = self._reach / size
            kernels.perturb(s.u, mode, scale, s.seen)
            trial.f[:] = 0
            take(trial, self._forces)
            kernels.perturb(s.u, mode, -scale if s.seen is s.u else 0.0, s.seen)
            # The mode becomes mobility times its response, so that the response times it is mode . M mode.
            trial.f[self._held] = s.f[self._held]
            sums = kernels.respond(mode, trial.f, s.f, mobility, rows.owned, self._reach, size)
            table = self._world.gather(sums)
            quotient, last = float(table[:, 0].sum()), found
            if iteration > 0 and weight > 0:
                found = quotient / weight
            size = float(table[:, 2].max())
            if iteration > 2 and found < CONVERGED * last:
                break
            weight = float(table[:, 1].sum()) / size**2 if size > 0 else 0.0
        return float(RUNG ** math.ceil(math.log(found) / math.log(RUNG))) if found > 0 else 0.0

    def _largest(self, value: float) -> float:
        return float(self._world.gather([value]).max())
