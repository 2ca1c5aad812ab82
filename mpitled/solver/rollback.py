"""Return of an unstable run to an earlier state."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from mpitled.solver.integrator import Integrator
from mpitled.solver.monitor import BALANCE_LIMIT
from mpitled.terms.restart import Objects, Scope, Snapshot, replicated, restore, snapshot

#: Checks between snapshots, and most rollbacks of a run. The third rollback of a relaxation restarts the load: earlier
#: snapshots are already unstable.
ROLLBACK_INTERVAL, MAX_ROLLBACKS, RESTART_AT = 5, 5, 3
#: No snapshot is taken where the balance error exceeds this share of its limit.
HEALTHY_BALANCE = 0.2


@dataclass(slots=True, eq=False)
class Rollback:
    """Snapshots of a run, and the return to them."""

    n_rollbacks: int = replicated(control=True, default=0)
    n_checks: int = replicated(control=True, default=0)
    #: The older of two is used: the younger may be unstable already.
    snapshots: deque[Snapshot] = field(default_factory=lambda: deque(maxlen=2))
    start: Snapshot = field(default_factory=dict)  # the numbers of the first snapshot, at no load

    @property
    def possible(self) -> bool:
        """Whether there is a snapshot, and the run may use it."""
        return bool(self.snapshots) and self.n_rollbacks < MAX_ROLLBACKS

    def clear(self) -> None:
        """Forget all snapshots."""
        self.n_checks, self.start = 0, {}
        self.snapshots.clear()

    def save(self, integrator: Integrator, objects: Objects, balance_error: float) -> None:
        """Take a snapshot at some of the checks."""
        healthy = balance_error < HEALTHY_BALANCE * BALANCE_LIMIT
        if integrator.recovers and self.n_checks % ROLLBACK_INTERVAL == 0 and healthy:
            self.snapshots.append(snapshot(objects, integrator.rollback_scope))
            self.start = self.start or snapshot(objects, Scope.NUMBERS)
        self.n_checks += 1

    def go_back(self, integrator: Integrator, objects: Objects, may_restart: bool) -> str:
        """Restore the older snapshot, or the start of the load, with a reduced step; what was done, for the user.

        The forces are still to be computed.
        """
        self.n_rollbacks += 1
        scope = integrator.rollback_scope
        restart = may_restart and scope.to_rest and self.n_rollbacks == RESTART_AT
        while len(self.snapshots) > 1:
            self.snapshots.pop()
        if restart:
            integrator.clear()
            restore(objects, Scope.NUMBERS, self.start)
            self.snapshots[0] = snapshot(objects, scope)
        else:
            restore(objects, scope, self.snapshots[0])
        integrator.state.sync_cell_copy()
        integrator.reduce_step(restart)
        return "the load restarts, more slowly" if restart else "it returns to an earlier state and goes on more slowly"
