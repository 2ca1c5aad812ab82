"""The terms of a step. A new term is a module here and a line in `TERMS`.

Ledger, series, report, checkpoint and dry run iterate over this registry. A small term has `from_scene`, `apply`, a
sentence `absent`, and what it needs of the rest: `figures` with `check` for its energies and its share of the stability
bound, and restart fields. `tests/test_terms.py` has an example with all of them.
"""

from __future__ import annotations

from mpitled.terms.cell_forces import BorderCells, InteriorCells
from mpitled.terms.halo_exchange import FinishHalo, StartHalo
from mpitled.terms.motion import CentralDifferenceUpdate, Reactions, RelaxationUpdate
from mpitled.terms.state import State
from mpitled.terms.term import Figure, Scene, Side, Stage, Term

#: All terms in the order in which they act. Before `StartHalo` a term adds this rank's share of forces at any node;
#: between the two at nodes that are not shared; after `FinishHalo` the same complete force on each rank of a node.
TERMS: list[type[Term]] = [
    BorderCells,
    StartHalo,
    InteriorCells,
    FinishHalo,
    Reactions,
    CentralDifferenceUpdate,
    RelaxationUpdate,
]


class Step:
    """The terms that a scene needs, in their order; a term that the scene lacks is absent."""

    def __init__(self, scene: Scene) -> None:
        """Collective."""
        self.scene = scene
        self.terms = tuple(term for cls in TERMS for term in cls.from_scene(scene))
        self.forces, self.work, self.update = (
            tuple(term for term in self.terms if term.stage is stage) for stage in Stage
        )
        self.cycle = (*self.update, *self.forces, *self.work)  # from one set of complete forces to the next

    def apply_forces(self, s: State) -> None:
        """Add all forces to `State.f`. Collective if there are several ranks."""
        apply(s, self.forces)

    def left_out(self) -> list[str]:
        """What this rank does without, and why."""
        present = {type(term) for term in self.terms}
        return [text for cls in TERMS for text in cls.left_out(self.scene, cls in present)]


def apply(s: State, terms: tuple[Term, ...]) -> None:
    """Apply terms in their order. Collective if one of them is."""
    for term in terms:
        term.apply(s)


def warm_up(s: State, terms: tuple[Term, ...]) -> None:
    """Apply terms once without other ranks, so that their kernels are compiled or loaded from the cache."""
    apply(s, tuple(term for term in terms if not term.collective))


__all__ = ["TERMS", "Figure", "Scene", "Side", "Stage", "State", "Step", "Term", "apply", "warm_up"]
