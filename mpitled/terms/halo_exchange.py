"""Sums the forces of shared nodes over the ranks: sent before the interior cells are computed, received after."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from mpitled.parallel.halo import Halo
from mpitled.terms.state import State
from mpitled.terms.term import Scene, Term


class _HaloTerm(Term):
    name = "halo"
    collective = True

    def __init__(self, halo: Halo) -> None:
        self._halo = halo

    @classmethod
    def from_scene(cls, scene: Scene) -> Iterator[Term]:
        if scene.halo is not None:
            yield cls(scene.halo)


class StartHalo(_HaloTerm):
    """Sends this rank's forces at shared nodes."""

    def apply(self, s: State) -> None:
        """Send."""
        self._halo.start(s.f)

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterable[str]:
        """Nothing: see `FinishHalo`."""
        return ()


class FinishHalo(_HaloTerm):
    """Receives the forces of other ranks and adds them."""

    def apply(self, s: State) -> None:
        """Receive and add."""
        self._halo.finish(s.f)

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterator[str]:
        """On one rank, and where no node is shared."""
        if scene.sub.rows.n_parts == 1:
            yield f"{cls.name}: one rank"
        elif not scene.sub.shared:
            yield f"{cls.name}: no node is shared"
