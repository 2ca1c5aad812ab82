"""Warnings about scenes that are possible, but probably not intended."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mpitled.deck import Deck
from mpitled.laws import Material
from mpitled.mesh import Mesh
from mpitled.meshing.placement import format_length, format_position, unit_hint
from mpitled.model.loading import sphere_radius
from mpitled.model.scene import OUTER, TUMOUR, centroids, members

#: Ratio of tumour radius to seed radius up to which clouds converge, with a margin (jobs/studies/README.md).
MAX_GROWTH = 8.0
#: Young's modulus, Pa, of the tissue around a tumour; a smaller value is probably in kPa or MPa.
MIN_MODULUS = 50.0
#: Poisson's ratio up to which results are validated (jobs/studies/README.md).
MAX_POISSONS_RATIO = 0.499
#: Seed radius, m, below which the deck's value is probably in metres; largest sensible seed volume over tumour volume.
MIN_SEED_RADIUS, MAX_SEED_SHARE = 5e-5, 0.5


def unit_warnings(
    deck: Deck, mesh: Mesh, material: NDArray[np.int16], materials: tuple[Material, ...]
) -> Iterator[str]:
    """Warnings about materials and a tumour with numbers that look like a wrong unit."""
    warned = set()
    for section in deck.materials:
        name, solid = f"material.{section.name}", section.material
        modulus, ratio = solid.youngs_modulus, solid.poissons_ratio
        if not 1 <= modulus <= 1e12:
            warned.add(section.name)
            yield f"warning: {name}.youngs_modulus = {modulus:.10g}: is it in Pa? Brain tissue has about 3000"
        if ratio > MAX_POISSONS_RATIO + 1e-9:  # round-off
            yield (
                f"warning: {name}.poissons_ratio = {ratio:.10g}: results are known up to "
                f"{MAX_POISSONS_RATIO:g}; take 0.49, or {MAX_POISSONS_RATIO:g} at most"
            )
        if not 100 <= section.density <= 25000:
            yield f"warning: {name}.density = {section.density:.10g}: is it in kg/m3? Tissue has about 1000"
    if deck.tumour is None:
        return
    centre = np.asarray(deck.tumour.centre)
    if reason := unit_hint(centre, mesh.points.min(axis=0), mesh.points.max(axis=0)):
        yield f"warning: tumour.centre = {format_position(centre)}: {reason}"
    tissue = materials[material[((centroids(mesh) - centre) ** 2).sum(axis=1).argmin()]]
    if tissue.youngs_modulus < MIN_MODULUS and tissue.name not in warned:
        key = f"material.{tissue.name}.youngs_modulus = {tissue.youngs_modulus:.10g}"
        yield f"warning: {key}: is softer than any tissue that a tumour grows in; moduli are in Pa"


def unconstrained_warning(mesh: Mesh, dofs: NDArray[np.int64]) -> Iterator[str]:
    """A warning if only nodes of the tumour are prescribed."""
    seed = members(mesh, TUMOUR)
    names = [name for name in OUTER if name in mesh.node_sets]
    if len(seed) and names and not len(np.setdiff1d(dofs // 3, seed)):
        yield (
            "warning: no node but the tumour's is held, so that the whole body gives way to it; add [[fixed]] with "
            f'nodes = "{names[0]}"'
        )


def growth_warnings(deck: Deck) -> Iterator[str]:
    """Warnings about a tumour that grows more than a cloud is known to allow."""
    if deck.tumour is None:
        return
    radius, seed = sphere_radius(deck.tumour.volume), deck.tumour.seed_radius
    if seed < MIN_SEED_RADIUS:
        yield f"warning: tumour.seed_radius = {1e3 * seed:.10g}: is in mm; does it look like metres?"
    if (share := (seed / radius) ** 3) > MAX_SEED_SHARE:
        yield (
            f"warning: tumour.seed_radius = {1e3 * seed:.10g}: {share:.0%} of tumour.volume is there at the start and "
            "moves nothing, and only the rest is grown; make it smaller"
        )
    grows = f"warning: the tumour grows to a radius of {format_length(radius)}"
    if radius > MAX_GROWTH * seed:
        times = f"{radius / seed:.3g} times its seed's"
        yield f"{grows}, {times}, where cells may turn inside out; enlarge tumour.seed_radius"
    if radius > deck.cloud.radius and not deck.mesh:
        yield f"{grows}, beyond the cloud's {format_length(deck.cloud.radius)}; enlarge cloud.radius"
