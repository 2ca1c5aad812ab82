"""How sharp the bound of the cells' stiffness is: the assembled operator's largest eigenvalue, by power iteration.

The sum of the cells' bounds is two to ten times the largest eigenvalue of the assembled stiffness, for neighbours do
not swing in their stiffest modes together. The quotient is a matter of the mesh and changes slowly with the
deformation; steps and masses that the bound asks for are relaxed by it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import copy
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from mpitled import kernels
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.restart import Kept
from mpitled.solver.step import State, Term, take

#: Most quotients at first, and later; and the growth of Rayleigh's quotient in one at which they end. It grows towards
#: the eigenvalue: what is missing is left to `solver.safety`, 0.64 of the eigenvalue. Each time they begin at random:
#: from the last eigenvector a mode that comes up elsewhere, as next to a growing seed, is found too late.
FIRST, AGAIN, CONVERGED = 60, 15, 1.01
#: What is found is rounded up to a power of this, so that ranks summed in another order find the same.
RUNG = 1.02
#: Where the share grew by more than this, it is looked for again at once.
GROWS = 1.05
#: Each time the iteration begins with the same numbers: where none of its first quotients is larger than it was by more
#: than this factor, nothing has changed, and the rest is left out.
FIRST_QUOTIENTS, RISES = 3, 1.003


class Sharpness:
    """Power iteration on K = df/du in the present configuration, on all ranks; all of its calls are collective."""

    LASTING = Kept(alike=("share", "seldom", "whole", "next", "lowest", "glances"))

    def __init__(self, sub: Subdomain, world: World, forces: tuple[Term, ...]) -> None:
        self._sub, self._world, self._forces = sub, world, forces
        self._held = sub.held % 3, sub.held // 3
        self.share = 0.0  # of the bound, that the operator has had at most
        # Steps from one time that it is looked for to the next, and which time nothing is left out; set by the method.
        self.seldom, self.whole = 1, 1
        self.next = 0  # the step when it is looked for again
        # The lowest first quotients since the whole iteration, as shares; how often it has been left out since.
        self.lowest: list[float] = []
        self.glances = 0
        spread = float(np.ptp(sub.rows.read("points"), axis=0).max()) if sub.n_nodes else 0.0
        # m, of the largest displacement that is tried: well above round-off, well below a cell.
        self._reach = float(np.finfo(sub.precision).eps) ** 0.5 * 0.02 * self._largest(spread)

    def renew(self, s: State, mobility: NDArray[np.float64], bound: float) -> None:
        """The share that the largest eigenvalue of `mobility` K has of its bound (alike), and when to look again.

        s has the forces of its displacements, whose last bits may change. mobility, s^2/kg: (1, n_nodes), or symmetric
        tensors (6, n_nodes); 0 where it does not matter. What is tried takes the room of `s.good`.
        """
        grows, known = self.next == s.step, len(self.lowest)
        whole, shares = grows or self.glances + 1 >= self.whole or not known, [0.0]
        for quotient in islice(self._quotients(s, mobility), (AGAIN if self.share else FIRST) if bound > 0 else 0):
            shares.append(quotient / bound)
            rises = any(share > RISES * low for share, low in zip(shares[1:], self.lowest, strict=False))
            if (len(shares) > known and not whole and not rises) or (
                len(shares) > 3 and shares[-1] < CONVERGED * shares[-2]
            ):
                break
            whole = whole or rises
        # Small displacements may have changed in their last bits: a run that is continued begins with their forces.
        s.f[:] = 0
        take(s, self._forces)
        if not whole:
            self.lowest = [min(pair) for pair in zip(shares[1:], self.lowest, strict=False)]
            self.glances += 1
            self.next = s.step + self.seldom
            return
        found = float(RUNG ** math.ceil(math.log(shares[-1]) / math.log(RUNG))) if shares[-1] > 0 else 0.0
        self.lowest, self.glances = shares[1 : 1 + FIRST_QUOTIENTS], 0
        self.next = s.step if found > GROWS * self.share > 0 else s.step + self.seldom
        self.share = min(1.0, max(self.share, found)) or 1.0  # where nothing is free nothing is found

    def _quotients(self, s: State, mobility: NDArray[np.float64]) -> Iterator[float]:
        """Rayleigh's quotients (1/s^2 times the mobility's dt^2) of `mobility` K, rising to the largest eigenvalue."""
        rows, trial, mode = self._sub.rows, copy(s), s.good
        trial.f = np.empty_like(s.f)
        # The mode has less than the displacements' precision, for whatever it is, it is tried as it is.
        kernels.scramble(mode, rows.nodes)
        mode[self._held] = 0
        size, weight = self._largest(np.abs(mode).max(initial=0.0)), 0.0
        while 0 < size < math.inf:
            # Tried in place and taken back, for a copy would be among the largest arrays of a run. Round-off remains of
            # it, the same on all ranks.
            scale = self._reach / size
            kernels.perturb(s.u, mode, scale, s.seen)
            trial.f[:] = 0
            take(trial, self._forces)
            kernels.perturb(s.u, mode, -scale if s.seen is s.u else 0.0, s.seen)
            # The mode becomes mobility times its response, so that the response times it is mode . M mode.
            trial.f[self._held] = s.f[self._held]
            table = self._world.gather(kernels.respond(mode, trial.f, s.f, mobility, rows.owned, self._reach, size))
            quotient, size = float(table[:, 0].sum()), float(table[:, 2].max())
            if weight > 0:
                yield quotient / weight
            weight = float(table[:, 1].sum()) / size**2 if size > 0 else 0.0

    def _largest(self, value: float) -> float:
        return float(self._world.gather([value]).max())
