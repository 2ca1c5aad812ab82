"""The integrators, and which one a scene takes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mpitled.parallel.halo import Halo, World
from mpitled.solver.central_difference import CentralDifference
from mpitled.solver.dynamic_relaxation import DynamicRelaxation
from mpitled.solver.integrator import Integrator
from mpitled.terms import Scene
from mpitled.terms.term import Method

INTEGRATORS: tuple[type[Integrator], ...] = (CentralDifference, DynamicRelaxation)
#: Makes the halo of nodal values with so many components in a precision; None on one rank.
Halos = Callable[[int, type[np.floating]], Halo | None]


def no_halos(components: int, precision: type[np.floating]) -> None:
    """On one rank."""


def make_integrator(
    scene: Scene, frames: int, world: World, model: dict[str, Any], halos: Halos = no_halos
) -> Integrator:
    """The integrator of the scene's method, at rest. model: figures of the model. Collective."""
    if scene.method is Method.RELAXATION:
        halo = halos(DynamicRelaxation.mass_components(scene.sub), np.float64)
        return DynamicRelaxation(scene, frames, world, halo)
    return CentralDifference(scene, frames, world, halos(1, np.float64), model)
