"""Prescribed dofs: from the constraints of the deck and of the mesh file, and from the growth of the tumour."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpitled.deck import Deck
from mpitled.errors import InputError
from mpitled.mesh import Constraint, Mesh, named_set
from mpitled.meshing.placement import format_length
from mpitled.model.loading import growth, rotation_path, sphere_radius
from mpitled.model.mapping import carry_over
from mpitled.model.scene import OUTER, TUMOUR, members


class Prescribed(NamedTuple):
    """Prescribed dofs and displacements, and their origins."""

    dofs: NDArray[np.int64]  # (n,), 3 node + direction, ascending
    displacements: NDArray[np.float64]  # (n,), m at full load
    rotation_paths: NDArray[np.float64]  # (n, 3), see `loading.rotation_path`
    origins: NDArray[np.object_]  # (n,), file and line, or key


def prescribe(deck: Deck, mesh: Mesh) -> tuple[Prescribed, list[str]]:
    """The prescribed dofs, and remarks about constraints of the mesh file that the deck replaces.

    InputError if the deck or its files prescribe two displacements of one dof, or if nothing is prescribed.
    """
    of_deck = _motions(mesh, deck.constraints())
    if deck.tumour:
        origin = f"{deck.path}: tumour"
        nodes = named_set(mesh.node_sets, TUMOUR, origin)
        moved = growth(mesh.points[nodes], np.array(deck.tumour.centre), deck.tumour.seed_radius, deck.tumour.volume)
        of_deck.extend((3 * nodes + i, moved[:, i], np.zeros((len(nodes), 3)), origin) for i in range(3))
    of_files = _motions(mesh, mesh.constraints)
    if not of_deck and not of_files:
        raise InputError(f"{deck.path}: nothing is fixed, displaced or grows; add [[fixed]], [[displaced]] or [tumour]")
    deck_dofs, file_dofs = (_without_clashes(mesh, motions) for motions in (of_deck, of_files))
    _, in_deck, in_file = np.intersect1d(deck_dofs.dofs, file_dofs.dofs, assume_unique=True, return_indices=True)
    changed = deck_dofs.displacements[in_deck] != file_dofs.displacements[in_file]
    replaced: dict[tuple[str, str], set[int]] = {}
    for new, old in zip(in_deck[changed], in_file[changed], strict=True):
        key, file = deck_dofs.origins[new].removesuffix(".nodes"), file_dofs.origins[old].partition(": line ")[0]
        replaced.setdefault((key, file), set()).add(int(deck_dofs.dofs[new]) // 3)
    remarks = [
        f"{key} replaces what {file} prescribes at {len(nodes)} nodes" for (key, file), nodes in replaced.items()
    ]
    remaining = np.ones(len(file_dofs.dofs), bool)
    remaining[in_file] = False
    both = [
        np.concatenate([of_deck, of_file[remaining]]) for of_deck, of_file in zip(deck_dofs, file_dofs, strict=True)
    ]
    order = np.argsort(both[0])
    return Prescribed(*(values[order] for values in both)), remarks


def check_growth(deck: Deck, mesh: Mesh, dofs: NDArray[np.int64], displacements: NDArray[np.float64]) -> None:
    """InputError if the grown tumour reaches beyond fixed nodes of the outer surface."""
    if deck.tumour is None:
        return
    nodes, directions = np.unique(dofs[displacements == 0] // 3, return_counts=True)
    outer = np.concatenate([members(mesh, name) for name in OUTER])
    fixed = np.setdiff1d(np.intersect1d(nodes[directions == 3], outer), members(mesh, TUMOUR))
    distances = np.linalg.norm(mesh.points[fixed] - np.asarray(deck.tumour.centre), axis=1)
    radius, nearest = sphere_radius(deck.tumour.volume), float(distances.min(initial=np.inf))
    if radius > nearest:
        raise InputError(
            f"{deck.path}: tumour.volume = {1e9 * deck.tumour.volume:.10g}: its sphere of {format_length(radius)} "
            f"radius reaches beyond the outer surface, which is fixed {format_length(nearest)} from tumour.centre; "
            "lower it"
        )


#: Dofs (n,), their displacements (n,), rotation paths (n, 3), and the file or key that prescribes them.
_Motion = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], str]


def _motions(mesh: Mesh, constraints: Iterable[Constraint]) -> list[_Motion]:
    """The motion of each constraint in each of its directions."""
    motions: list[_Motion] = []
    for constraint in constraints:
        nodes = named_set(mesh.node_sets, constraint.node_set, constraint.origin)
        extra, paths = np.zeros((len(nodes), 3)), np.zeros((len(nodes), 3, 3))
        if constraint.rotation:
            extra, paths = rotation_path(mesh.points[nodes], constraint.rotation)
        if constraint.field:
            key = constraint.origin.removesuffix("nodes") + "field"
            extra = extra + carry_over(constraint.field, constraint.field_metre, mesh.points[nodes], key)
        for direction, displacement in zip(constraint.directions, constraint.displacement, strict=True):
            moved = displacement + extra[:, direction]
            motions.append((3 * nodes + direction, moved, paths[:, direction], constraint.origin))
    return motions


def _without_clashes(mesh: Mesh, motions: list[_Motion]) -> Prescribed:
    """All motions as one, with each dof once; InputError if two displacements of a dof differ."""
    origins = np.array([origin for *_, origin in motions], object)
    dofs = np.concatenate([np.empty(0, np.int64), *(dofs for dofs, *_ in motions)])
    moved = np.concatenate([np.empty(0), *(moved for _, moved, *_ in motions)])
    paths = np.concatenate([np.empty((0, 3)), *(paths for _, _, paths, _ in motions)])
    source = np.repeat(np.arange(len(motions)), [len(dofs) for dofs, *_ in motions])
    order = np.lexsort((moved, dofs))
    dofs, moved, source, paths = dofs[order], moved[order], source[order], paths[order]
    clash = np.flatnonzero((np.diff(dofs) == 0) & (np.diff(moved) != 0))
    if len(clash):
        first = clash[0]
        node = dofs[first] // 3
        raise InputError(
            f"{origins[source[first + 1]]}: node {mesh.node_ids[node]} is moved by {moved[first + 1] * 1e3:g} mm in "
            f"{'xyz'[dofs[first] % 3]}, and by {moved[first] * 1e3:g} mm through {origins[source[first]]}; "
            f"take it out of one of the two ({len(clash)} such)"
        )
    keep = np.append(True, np.diff(dofs) > 0)[: len(dofs)]
    return Prescribed(dofs[keep], moved[keep], paths[keep], origins[source[keep]])
