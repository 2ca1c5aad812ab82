"""Small scenes that tests of several files compute: a block that is held and pulled, and a tumour in a block."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpitled.deck import Solver
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.integrators import make_integrator
from mpitled.terms import Scene, Step


def block(size: Sequence[float], elements: Sequence[int], cloud: str = "none", nu: float = 0.3) -> str:
    """A block of brain tissue, mm."""
    return f"""
[block]
size = {[*map(float, size)]}
elements = {[*elements]}
cloud = "{cloud}"
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = {nu}
"""


def pulled(millimetres: float | str, **keys: object) -> str:
    """The block's low face along x is held and the high one moved along x; keys: more of how, as in a deck."""
    more = "".join(f"{key} = {value}\n" for key, value in keys.items())
    return f"""
[[fixed]]
nodes = "x0"
[[displaced]]
nodes = "x1"
displacement = [{millimetres}, 0.0, 0.0]
{more}"""


#: A block of 640 cells, half of them a core of support domains.
MIXED = block((30, 24, 24), (10, 8, 8), "core", 0.49) + "[cloud]\npoints_per_spacing = 1.4\n"

#: A tumour that grows in a mixed block whose surface is held; what it is solved by is to be added.
TUMOUR = """
[tumour]
centre = [24.0, 20.0, 20.0]
volume = 523.6
surface_nodes = 400
[cloud]
radius = 11.0
growth = 0.35
[[fixed]]
nodes = "surface"
""" + block((48, 40, 40), (12, 10, 10), "core", 0.49)


def step_of(sub: Subdomain, method: Any = "quasi-static") -> Step:
    """The composed step of a part on one rank."""
    return Step(Scene(sub, Solver(method=method)))


def integrator_of(sub: Subdomain, solver: Solver, model: dict[str, Any] | None = None) -> Any:
    """The integrator of a part on one rank, at rest. model: figures of the model, where the solver is no relaxation."""
    return make_integrator(Scene(sub, solver), 1, World(), model or {})
