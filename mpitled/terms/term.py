"""What a term of the step is: what it does, its energies, its share of the stability bound, and why it is absent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from mpitled.deck import Deck, Solver
from mpitled.parallel.halo import Halo
from mpitled.parallel.subdomain import Subdomain
from mpitled.terms.restart import declared
from mpitled.terms.state import State


class Method(str, Enum):
    """How the nodes move: `solver.method` of the deck."""

    QUASI_STATIC = "quasi-static"
    DYNAMIC = "dynamic"
    RELAXATION = "dynamic-relaxation"


class Stage(IntEnum):
    """When a term acts in a step. Terms of one stage act in the order of the registry."""

    FORCES = 0  # adds internal forces to `State.f`; also called by the power iteration, so it changes nothing else
    WORK = 1  # reads the complete forces
    UPDATE = 2  # moves the nodes


class Side(Enum):
    """Side of a line in the energy balance: work + numerical - dissipated = stored + kinetic."""

    WORK = "work"  # of loads and prescribed displacements
    NUMERICAL = "numerical"  # supplied by the method, not by loads
    DISSIPATED = "dissipated"
    STORED = "stored"
    KINETIC = "kinetic"


@dataclass(frozen=True, slots=True)
class Figure:
    """A number that every stability check finds on each rank, and how the ranks' numbers are reduced to one."""

    name: str
    reduce: Literal["sum", "min", "max"] = "sum"
    series: str = ""  # its name in the series of the result; "" if the result does not have it
    side: Side | None = None  # of an energy, J: a line of the ledger, and of `energy_J` in report.json
    always: bool = False  # listed, as 0, in scenes without its term too: readers of results rely on it


def energy(name: str, side: Side, series: str = "", *, always: bool = False) -> Figure:
    """A line of the energy ledger (J); its series is named NAME_energy by default."""
    return Figure(name, "sum", series or f"{name}_energy", side, always)


@dataclass(frozen=True, slots=True)
class Scene:
    """What terms are composed from."""

    sub: Subdomain
    solver: Solver
    halo: Halo | None = None  # sums forces over the ranks; None on one rank
    deck: Deck | None = None  # None where only a step is measured
    #: Whether a fact holds on any rank. Collective.
    anywhere: Callable[[bool], bool] = bool

    @property
    def method(self) -> Method:
        """How the nodes move."""
        return Method(self.solver.method)


@dataclass(slots=True)
class StabilityBound:
    """What a step of some length asks of the nodal masses; terms add their shares.

    A step is stable where each node's mass is at least dt^2 / 4 times the sum of the largest eigenvalues of its cells
    (and other terms). The same holds for mass tensors and tensors of bounds.
    """

    factor: float  # s^2: (dt / (2 safety))^2, by which a bound of an eigenvalue becomes a mass
    required: NDArray[np.float64]  # (n_nodes,), kg; each rank adds its own share at shared nodes
    jacobian: NDArray[np.float32]  # (n_cells + 1,), J of the cells; the last is for lanes without a cell
    tensor: NDArray[np.float64] | None = None  # (6, n_nodes: xx, xy, xz, yy, yz, zz), kg, in place of `required`


class Term:
    """A term of the step. A subclass overrides what the term has; everything else has a default.

    Restart fields are dataclass fields of the subclass, see `restart`. A term that has `figures` or restart fields
    must be present on all ranks or on none: decide by `Scene.anywhere`.
    """

    name: str = ""  # for timers and dry runs; terms of one name are timed together
    stage: ClassVar[Stage] = Stage.FORCES
    figures: ClassVar[tuple[Figure, ...]] = ()
    absent: ClassVar[str] = ""  # why a scene does without it
    collective: ClassVar[bool] = False  # whether `apply` needs all ranks

    @classmethod
    def from_scene(cls, scene: Scene) -> Iterable[Term]:
        """The terms of this class that the scene has: none, one, or one for each block of cells."""
        raise NotImplementedError

    @classmethod
    def left_out(cls, scene: Scene, present: bool) -> Iterable[str]:
        """Sentences of a dry run: the term if it is absent, or what the scene needs no part of, each with the reason.

        present: whether this rank has a term of this class.
        """
        return () if present else (f"{cls.name}: {cls.absent}",)

    def apply(self, s: State) -> None:
        """What the term does in each step. Allocates nothing."""

    def check(self, s: State, bound: StabilityBound) -> Mapping[str, float]:
        """The term's `figures` on this rank; adds its share to the bound.

        Figures of the same name from several terms are added. At shared nodes only one rank may count.
        """
        return {}

    def clear(self) -> None:
        """Go back to rest: arrays among the restart fields become 0."""
        for name, _ in declared(self):
            if isinstance(array := getattr(self, name), np.ndarray):
                array[:] = 0
