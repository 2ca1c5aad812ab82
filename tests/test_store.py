"""The files: what is written is what is read, at any number of parts and ranks."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from mpitled import store
from mpitled.errors import InputError
from mpitled.material import Material
from mpitled.mesh import grid_points, structured_hexahedra
from mpitled.model import Model


@dataclass(frozen=True)
class Tables:
    """The columns of partition.PartTables, made here the slow and obvious way."""

    n_parts: int
    cells: NDArray[np.int64]
    cell_offsets: NDArray[np.int64]
    nodes: NDArray[np.int64]
    node_offsets: NDArray[np.int64]
    owned_offsets: NDArray[np.int64]
    neighbours: NDArray[np.int32]
    neighbour_offsets: NDArray[np.int64]
    shared: NDArray[np.int64]
    shared_offsets: NDArray[np.int64]


def small_model(seed: int = 0) -> Model:
    """A block of 4 x 3 x 3 hexahedra with a cloud of 40 nodes and 60 support domains; numbers at random."""
    rng = np.random.default_rng(seed)
    fe_points = grid_points((4, 3, 3), (0.04, 0.03, 0.03))
    hexahedra = structured_hexahedra((4, 3, 3))
    n_fe, n_efg, n_domains, n = len(fe_points), 40, 60, 8
    cloud = np.arange(n_fe, n_fe + n_efg)
    # Every cloud node is in some domain; a few FE nodes are too.
    firsts = np.resize(cloud, n_domains)
    others = [rng.choice(np.setdiff1d(np.r_[:5, cloud], first), n - 1, replace=False) for first in firsts]
    domains = np.sort(np.c_[firsts, others], axis=1)
    dofs = np.sort(rng.choice(3 * (n_fe + n_efg), 50, replace=False))
    return Model(
        points=np.r_[fe_points, 0.04 + 0.01 * rng.random((n_efg, 3))],
        n_fe_nodes=n_fe,
        node_ids=rng.permutation(n_fe + n_efg) + 1000,
        hexahedra=hexahedra,
        domains=domains,
        domain_points=rng.random((n_domains, 3)),
        domain_volumes=rng.random(n_domains),
        domain_gradients=rng.random((n_domains, n, 3)),
        domain_shapes=rng.random((n_domains, n)),
        field_domains=rng.integers(n_domains, size=n_efg),
        field_shapes=rng.random((n_efg, n)),
        material=rng.integers(2, size=len(hexahedra) + n_domains).astype(np.int16),
        materials=(Material("brain", 3000.0, 0.49, 1000.0), Material("cerebrospinal fluid", 10.0, 0.1, 1000.0)),
        mass=rng.random(n_fe + n_efg),
        prescribed_dofs=dofs,
        prescribed_displacements=rng.random(len(dofs)),
        node_sets={"skull": np.arange(7), "left/right é": np.array([3, 5]), "none": np.empty(0, np.int64)},
        cell_sets={"all": np.arange(len(hexahedra) + n_domains)},
        figures={"void_volume_m3": 1 / 3, "seed_volume_m3": 0.0},
        remarks=("merged 3 nodes", "skipped a tetrahedron"),
    )


def part_tables(model: Model, parts: NDArray[np.int64], n_parts: int) -> Tables:
    cell_nodes = [*model.hexahedra, *model.domains]
    cells = [np.flatnonzero(parts == part) for part in range(n_parts)]
    nodes = [np.unique(np.concatenate([np.empty(0, np.int64), *(cell_nodes[c] for c in own)])) for own in cells]
    owned = [np.setdiff1d(own, np.concatenate([[], *nodes[:part]])) for part, own in enumerate(nodes)]
    neighbours: list[list[int]] = []
    shared: list[NDArray[np.int64]] = []
    for part in range(n_parts):
        common = {q: np.intersect1d(nodes[part], nodes[q]) for q in range(n_parts) if q != part}
        neighbours.append([q for q in common if len(common[q])])
        shared += [common[q] for q in neighbours[-1]]

    def join(arrays: list, dtype: type = np.int64) -> tuple[NDArray, NDArray[np.int64]]:
        return np.concatenate([np.empty(0), *arrays]).astype(dtype), np.cumsum([0, *map(len, arrays)])

    return Tables(n_parts, *join(cells), *join(nodes), join(owned)[1], *join(neighbours, np.int32), *join(shared))


def same(a: object, b: object) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return list(a) == list(b) and all(same(a[name], b[name]) for name in a)
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    return a == b


def test_model_comes_back_as_it_was(tmp_path: Path) -> None:
    path, model = tmp_path / "model.h5", small_model()
    assert store.model_key(path) is None
    store.write_model(path, model, "key of the deck")
    assert store.model_key(path) == "key of the deck"
    back = store.read_model(path)
    for column in fields(Model):
        assert same(getattr(model, column.name), getattr(back, column.name)), column.name
    assert same(store.read_sets(path)[0], model.node_sets)
    assert [p.name for p in tmp_path.iterdir()] == ["model.h5"]


def test_what_is_not_a_model_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "model.h5"
    with pytest.raises(InputError, match="no such file"):
        store.read_model(path)
    path.write_text("title = 'a deck'")
    with pytest.raises(InputError, match="cannot be read as HDF5"):
        store.read_model(path)
    h5py.File(path, "w").close()
    with pytest.raises(InputError, match="not a model of mpitled"):
        store.read_model(path)
    store.write_model(path, small_model(), "k")
    with h5py.File(path, "r+") as file:
        file.attrs["layout"] = store.MODEL_LAYOUT + 1
    with pytest.raises(InputError, match="layout") as refusal:
        store.read_part(path, 1, 0)
    assert "\n" not in str(refusal.value)
    assert store.model_key(path) is None


def test_a_failed_write_leaves_the_old_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, model = tmp_path / "model.h5", small_model()
    store.write_model(path, model, "old")
    before = path.read_bytes()

    def fail(*_: object) -> None:
        raise OSError("disc full")

    monkeypatch.setattr(store, "_fsync", fail)
    with pytest.raises(OSError, match="disc full"):
        store.write_model(path, model, "new")
    with pytest.raises(OSError, match="disc full"):
        store.write_partition(path, part_tables(model, np.arange(model.n_cells) % 2, 2))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["model.h5"]


@pytest.mark.parametrize("n_parts", [1, 2, 3, 4])
def test_parts_are_the_rows_of_the_model(tmp_path: Path, n_parts: int) -> None:
    """Part 1 of 3 or more has no support domain, the last part of 4 has no cell at all."""
    path, model = tmp_path / "model.h5", small_model()
    store.write_model(path, model, "k")
    parts = np.random.default_rng(n_parts).integers(min(n_parts, 3), size=model.n_cells)
    parts[len(model.hexahedra) :][parts[len(model.hexahedra) :] == 1] = 0
    if n_parts > 1:
        with pytest.raises(InputError, match="no partition"):
            store.read_part(path, n_parts, 0)
        store.write_partition(path, part_tables(model, np.arange(model.n_cells) % 5, 5))
        store.write_partition(path, part_tables(model, np.zeros(model.n_cells, int), n_parts))
        store.write_partition(path, part_tables(model, parts, n_parts))
    assert store.has_partition(path, n_parts)
    assert not store.has_partition(path, 7)
    assert same(store.read_model(path).hexahedra, model.hexahedra)

    n_hexahedra, all_rows, owners = len(model.hexahedra), [], np.zeros(model.n_nodes, int)
    read = [store.read_part(path, n_parts, part) for part in range(n_parts)]
    for part, rows in enumerate(read):
        cells = np.flatnonzero(parts == part)
        domains = cells[cells >= n_hexahedra] - n_hexahedra
        here = np.flatnonzero(np.isin(model.prescribed_dofs // 3, rows.nodes))
        given = np.flatnonzero(np.isin(model.field_domains, domains))
        expected = {
            "cells": cells,
            "nodes": np.unique([*rows.hexahedra.ravel(), *rows.domains.ravel()]).astype(np.int64),
            "points": model.points[rows.nodes],
            "mass": model.mass[rows.nodes],
            "hexahedra": model.hexahedra[cells[cells < n_hexahedra]],
            "domains": model.domains[domains],
            "domain_points": model.domain_points[domains],
            "domain_volumes": model.domain_volumes[domains],
            "domain_gradients": model.domain_gradients[domains],
            "domain_shapes": model.domain_shapes[domains],
            "material": model.material[cells],
            "materials": model.materials,
            "prescribed_dofs": model.prescribed_dofs[here],
            "prescribed_displacements": model.prescribed_displacements[here],
            "field_nodes": given + model.n_fe_nodes,
            "field_domains": model.field_domains[given],
            "field_shapes": model.field_shapes[given],
        }
        for name, value in expected.items():
            assert same(getattr(rows, name), value), name
        shares = np.split(rows.shared, rows.shared_offsets[1:-1]) if len(rows.neighbours) else []
        for q, nodes in zip(rows.neighbours, shares, strict=True):
            assert same(nodes, np.intersect1d(rows.nodes, read[q].nodes))
        owners[rows.nodes[rows.owned]] += 1
        owned_rows = rows.rows[rows.owned]
        assert same(owned_rows, rows.first_row + np.arange(len(owned_rows)))
        all_rows.append(owned_rows)
        for q in range(part):
            assert not np.isin(rows.nodes[rows.owned], read[q].nodes).any()
            _, i, j = np.intersect1d(rows.nodes, read[q].nodes, return_indices=True)
            assert same(rows.rows[i], read[q].rows[j])
    assert (owners == 1).all()
    assert same(np.concatenate(all_rows), np.arange(model.n_nodes))


@pytest.mark.parametrize("gap_bytes", [0, 1 << 16])
def test_rows_are_read_by_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gap_bytes: int) -> None:
    monkeypatch.setattr(store, "_GAP_BYTES", gap_bytes)
    monkeypatch.setattr(store, "_BLOCK_BYTES", 1 << 10)
    data = np.random.default_rng(0).random((5000, 4))
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        file["data"] = data
        for rows in (np.flatnonzero(data[:, 0] > 0.9), np.r_[0, 2:900, 4999], np.arange(5000), np.arange(0)):
            assert same(store.read_rows(file["data"], rows), data[rows])
