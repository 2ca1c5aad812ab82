"""The check of all cells every few steps: energies, J, and the nodal masses that a stable step needs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mpitled.parallel.subdomain import Subdomain
from mpitled.terms import State, Term
from mpitled.terms.term import StabilityBound


@dataclass(slots=True)
class StabilityCheck:
    """Collects the shares of all terms in the stability bound, see `StabilityBound`, and their figures."""

    sub: Subdomain
    jacobian: NDArray[np.float32] = field(init=False)  # (n_cells + 1,), the last for lanes without a cell
    required: NDArray[np.float64] = field(init=False)  # (1, n_nodes), kg

    def __post_init__(self) -> None:
        self.jacobian = np.ones(self.sub.n_cells + 1, np.float32)
        self.required = np.zeros((1, self.sub.n_nodes))

    def evaluate(
        self, s: State, terms: tuple[Term, ...], safety: float, tensor: NDArray[np.float64] | None = None
    ) -> dict[str, float]:
        """This rank's figures of the terms, and "min_jacobian", the smallest J of all steps so far.

        Fills `jacobian`, and `required` with the masses that keep the step at `safety` times the bound, without the
        shares of other ranks. Support domains add to tensor (6, n_nodes) instead where it is given.
        """
        self.required[:] = 0
        bound = StabilityBound((s.time_step / (2 * safety)) ** 2, self.required[0], self.jacobian, tensor)
        found = dict.fromkeys((figure.name for term in terms for figure in term.figures), 0.0)
        for term in terms:
            for name, value in term.check(s, bound).items():
                found[name] += value
        s.smallest_jacobian = min(s.smallest_jacobian, float(self.jacobian[:-1].min()))
        return found | {"min_jacobian": s.smallest_jacobian}
