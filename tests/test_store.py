"""The files: reading returns the written data, for any number of parts and ranks."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ENVIRONMENT, ranks
from numpy.typing import NDArray
from parallel_store import N_FRAMES, frame, write

import partition
from mpitled import store
from mpitled.cells.kind import HEXAHEDRA, SUPPORT_DOMAINS
from mpitled.errors import InputError
from mpitled.laws import Material, NeoHookean
from mpitled.mesh import grid_points, structured_hexahedra
from mpitled.model import CellBlock, Model, ModelFigures
from mpitled.store import files

CLOUD_COLUMNS = {"points": (3,), "volumes": (), "gradients": (8, 3), "shapes": (8,)}


def small_model(seed: int = 0) -> Model:
    """A block of 4 x 3 x 3 hexahedra with a cloud of 40 nodes and 60 support domains; random numbers."""
    rng = np.random.default_rng(seed)
    fe_points = grid_points((4, 3, 3), (0.04, 0.03, 0.03))
    hexahedra = structured_hexahedra((4, 3, 3))
    n_fe, n_efg, n_domains, n = len(fe_points), 40, 60, 8
    cloud = np.arange(n_fe, n_fe + n_efg)
    # Every cloud node and a few FE nodes are in a domain.
    firsts = np.resize(cloud, n_domains)
    others = [rng.choice(np.setdiff1d(np.r_[:5, cloud], first), n - 1, replace=False) for first in firsts]
    domains = np.sort(np.c_[firsts, others], axis=1)
    dofs = np.sort(rng.choice(3 * (n_fe + n_efg), 50, replace=False))
    columns = {name: rng.random((n_domains, *shape)) for name, shape in CLOUD_COLUMNS.items()}
    material = rng.integers(2, size=len(hexahedra) + n_domains).astype(np.int16)
    of_blocks = np.split(material, [len(hexahedra)])
    blocks = (
        CellBlock("hexahedra", HEXAHEDRA, hexahedra, of_blocks[0]),
        CellBlock("support domains", SUPPORT_DOMAINS, domains, of_blocks[1], columns),
    )
    return Model(
        points=np.r_[fe_points, 0.04 + 0.01 * rng.random((n_efg, 3))],
        n_fe_nodes=n_fe,
        node_ids=rng.permutation(n_fe + n_efg) + 1000,
        blocks=blocks,
        field_block=blocks[-1].name,
        field_domains=rng.integers(n_domains, size=n_efg),
        field_shapes=rng.random((n_efg, n)),
        materials=(
            Material("brain", NeoHookean(youngs_modulus=3000.0, poissons_ratio=0.49), 1000.0),
            Material("cerebrospinal fluid", NeoHookean(youngs_modulus=10.0, poissons_ratio=0.1), 1000.0),
        ),
        mass=rng.random(n_fe + n_efg),
        prescribed_dofs=dofs,
        prescribed_displacements=rng.random(len(dofs)),
        rotation_paths=rng.random((len(dofs), 3)),
        node_sets={"skull": np.arange(7), "left/right é": np.array([3, 5]), "none": np.empty(0, np.int64)},
        cell_sets={"all": np.arange(len(hexahedra) + n_domains)},
        figures=ModelFigures(1e-4, 0.1, 1e-4, of_mesh={"void_volume_m3": 1 / 3, "seed_volume_m3": 0.0}),
        remarks=("merged 3 nodes", "skipped a tetrahedron"),
    )


def random_parts(model: Model, n_parts: int) -> NDArray[np.int32]:
    """Random parts of the cells. Part 1 has no support domain; of 4 parts the last has no cell."""
    parts = np.random.default_rng(n_parts).integers(min(n_parts, 3), size=model.n_cells, dtype=np.int32)
    of_domains = parts[len(model.hexahedra) :]
    of_domains[of_domains == 1] = 0
    return parts


def add_partition(path: Path, model: Model, parts: NDArray[np.int32], n_parts: int) -> None:
    store.write_partition(
        path, partition.tables([partition.Block(block.nodes) for block in model.blocks], parts, n_parts)
    )


def same(a: object, b: object) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return list(a) == list(b) and all(same(a[name], b[name]) for name in a)
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    return a == b


def test_model_is_read_as_written(tmp_path: Path) -> None:
    path, model = tmp_path / "model.h5", small_model()
    assert store.model_key(path) is None
    store.write_model(path, model, "key of the deck")
    assert store.model_key(path) == "key of the deck"
    back = store.read_model(path)
    for column in fields(Model):
        if column.name != "blocks":
            assert same(getattr(model, column.name), getattr(back, column.name)), column.name
    assert [(block.name, block.kind) for block in back.blocks] == [(block.name, block.kind) for block in model.blocks]
    assert same(store.model_arrays(back), store.model_arrays(model))
    store.write_model(path, replace(model, node_sets={}, figures=ModelFigures(cloud_parts=np.int64(3))), "k")
    back = store.read_model(path)
    assert (back.node_sets, back.figures.cloud_parts) == ({}, 3)
    assert [p.name for p in tmp_path.iterdir()] == ["model.h5"]


def test_other_files_than_models_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.h5"
    for write_file, message in (
        (lambda: None, "no such file"),
        (lambda: path.write_text("title = 'a deck'"), "cannot be read as HDF5"),
        (lambda: h5py.File(path, "w").close(), "not a model of mpitled"),
    ):
        write_file()
        with pytest.raises(InputError, match=message):
            store.read_model(path)
    store.write_model(path, small_model(), "k")
    with h5py.File(path, "r+") as file:
        file.attrs["layout"] += 1
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

    monkeypatch.setattr(files, "fsync", fail)
    for write_file in (
        lambda: store.write_model(path, model, "new"),
        lambda: add_partition(path, model, random_parts(model, 2), 2),
    ):
        with pytest.raises(InputError, match=r"cannot be written \(disc full"):
            write_file()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["model.h5"]
    with pytest.raises(InputError, match="cannot be written"):
        store.write_model(tmp_path / "nowhere" / "model.h5", model, "k")


@pytest.mark.parametrize("n_parts", [1, 2, 3, 4])
def test_parts_are_the_rows_of_the_model(tmp_path: Path, n_parts: int) -> None:
    path, model = tmp_path / "model.h5", small_model()
    store.write_model(path, model, "k")
    parts = random_parts(model, n_parts)
    if n_parts > 1:
        with pytest.raises(InputError, match="no partition"):
            store.read_part(path, n_parts, 0)
        for other, n in ((random_parts(model, 5), 5), (np.zeros_like(parts), n_parts), (parts, n_parts)):
            add_partition(path, model, other, n)
    assert store.has_partition(path, n_parts)
    assert not store.has_partition(path, 7)
    assert same(store.read_model(path).hexahedra, model.hexahedra)

    n_hexahedra, all_rows, owners = len(model.hexahedra), [], np.zeros(model.n_nodes, int)
    read = [store.read_part(path, n_parts, part) for part in range(n_parts)]
    for part, rows in enumerate(read):
        cells = np.flatnonzero(parts == part)
        domains = cells[cells >= n_hexahedra] - n_hexahedra
        prescribed = np.flatnonzero(np.isin(model.prescribed_dofs // 3, rows.nodes))
        field = np.flatnonzero(np.isin(model.field_domains, domains))
        expected = {
            "cells": cells,
            "nodes": np.unique(np.concatenate([block.read("nodes").ravel() for block in rows.blocks])).astype(np.int32),
            "points": model.points[rows.nodes],
            "mass": model.mass[rows.nodes],
            "material": model.material[cells],
            "materials": model.materials,
            "prescribed_dofs": model.prescribed_dofs[prescribed],
            "prescribed_displacements": model.prescribed_displacements[prescribed],
            "rotation_paths": model.rotation_paths[prescribed],
            "field_nodes": field + model.n_fe_nodes,
            "field_domains": np.searchsorted(domains, model.field_domains[field]),
            "field_shapes": model.field_shapes[field],
        }
        for name, value in expected.items():
            assert same(getattr(rows, name) if hasattr(rows, name) else rows.read(name), value), name
        solid, cloud = rows.blocks
        assert same(solid.read("nodes"), model.hexahedra[cells[cells < n_hexahedra]])
        for name, column in {"nodes": model.domains, **model.blocks[1].columns}.items():
            assert same(cloud.read(name), column[domains]), name
        for cell in range(rows.n_own_cells):
            block, row = rows.find_cell(cell)
            assert (block is cloud, block.first_own + row) == (cell >= solid.n_own, cell)
        shares = np.split(rows.shared, rows.shared_offsets[1:-1]) if len(rows.neighbours) else []
        for q, nodes in zip(rows.neighbours, shares, strict=True):
            assert same(nodes, np.intersect1d(rows.nodes, read[q].nodes).astype(np.int64))
        owners[rows.nodes[rows.owned]] += 1
        owned_rows = rows.read("rows")[rows.owned]
        assert same(owned_rows, rows.first_row + np.arange(len(owned_rows)))
        all_rows.append(owned_rows)
        for q in range(part):
            assert not np.isin(rows.nodes[rows.owned], read[q].nodes).any()
            _, i, j = np.intersect1d(rows.nodes, read[q].nodes, return_indices=True)
            assert same(rows.read("rows")[i], read[q].read("rows")[j])
    assert (owners == 1).all()
    assert same(np.concatenate(all_rows), np.arange(model.n_nodes))


@pytest.mark.parametrize("gap_bytes", [0, 1 << 16])
def test_rows_are_read_by_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gap_bytes: int) -> None:
    monkeypatch.setattr(files, "_GAP_BYTES", gap_bytes)
    monkeypatch.setattr(files, "_BUFFER_BYTES", 1 << 10)
    data = np.random.default_rng(0).random((5000, 4))
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        file["data"] = data
        for rows in (np.flatnonzero(data[:, 0] > 0.9), np.r_[0, 2:900, 4999], np.arange(5000), np.arange(0)):
            assert same(store.read_rows(file["data"], rows), data[rows])


# --- results -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, model = tmp_path_factory.mktemp("store") / "model.h5", small_model()
    store.write_model(path, model, "k")
    for n in (2, 4):
        add_partition(path, model, random_parts(model, n), n)
    return path


def run(model_path: Path, directory: Path, n_ranks: int, end: str) -> None:
    """Write the frames of parallel_store.py."""
    if n_ranks == 1 and end != "kill":
        write(model_path, directory, end, None)
        return
    if not h5py.get_config().mpi:
        pytest.skip("h5py without MPI")
    script = Path(__file__).with_name("parallel_store.py")
    command = [*ranks(2)[:-1], str(n_ranks), sys.executable, script, model_path, directory, end]
    done = subprocess.run(command, env=ENVIRONMENT, timeout=60, capture_output=True, text=True)
    assert (done.returncode != 0) == (end == "kill"), done.stderr


def vtk_frames(path: Path) -> tuple[tuple[float, ...], list[dict[str, NDArray]]]:
    """Times and frames from VTK's reader, without any error or warning."""
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    reader = vtk.vtkHDFReader()
    messages: list[str] = []
    for event in ("ErrorEvent", "WarningEvent"):
        reader.AddObserver(event, lambda *_: messages.append(path.name))
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtk.vtkStreamingDemandDrivenPipeline.TIME_STEPS())
    frames = []
    for time in times:
        reader.UpdateTimeStep(time)
        grid = reader.GetOutputDataObject(0)
        assert isinstance(grid, vtk.vtkUnstructuredGrid)
        arrays = {"points": vtk_to_numpy(grid.GetPoints().GetData()), "bounds": np.array(grid.GetBounds())}
        arrays["types"] = np.array([grid.GetCellType(i) for i in range(grid.GetNumberOfCells())], np.uint8)
        arrays["connectivity"] = vtk_to_numpy(grid.GetCells().GetConnectivityArray())
        arrays["offsets"] = vtk_to_numpy(grid.GetCells().GetOffsetsArray())
        for data in (grid.GetPointData(), grid.GetCellData(), grid.GetFieldData()):
            for i in range(data.GetNumberOfArrays()):
                arrays[data.GetArrayName(i)] = vtk_to_numpy(data.GetArray(i)).copy()
        frames.append({name: array.copy() for name, array in arrays.items()})
    assert not messages
    return times, frames


@pytest.mark.parametrize("n_ranks", [1, 2, 4])
def test_vtk_reads_the_same_for_each_number_of_ranks(model_path: Path, tmp_path: Path, n_ranks: int) -> None:
    """Of 4 ranks, the second has no support domain, and the last has no cell."""
    model = store.read_model(model_path)
    run(model_path, tmp_path, n_ranks, "close")
    assert [p.name for p in tmp_path.iterdir()] == ["result.vtkhdf"]
    times, frames = vtk_frames(tmp_path / "result.vtkhdf")
    assert times == (0.0, 0.25, 0.5, 0.75)
    with h5py.File(tmp_path / "result.vtkhdf") as file:
        units = [file[f"VTKHDF/{name}"].attrs["units"] for name in ("Points", "PointData/displacement", "Steps/Values")]
    assert units == [b"m", b"m", b"s"]

    n_hexahedra, n_efg, n_domains = len(model.hexahedra), model.n_nodes - model.n_fe_nodes, len(model.domains)
    single_part = store.read_part(model_path, 1, 0)
    all_points = np.concatenate([model.points, model.domain_points])
    for k, grid_data in enumerate(frames):
        for name in ("points", "connectivity", "offsets", "types", "node_id", "cell_id", "part"):
            assert same(grid_data[name], frames[0][name]), name
        node_id, cell_id, kind = grid_data["node_id"], grid_data["cell_id"], grid_data["kind"]
        assert np.bincount(kind).tolist() == [n_hexahedra, n_efg, n_domains]
        assert same(grid_data["types"], np.array([12, 1, 1], np.uint8)[kind])
        assert same(grid_data["bounds"], np.ravel([all_points.min(axis=0), all_points.max(axis=0)], order="F"))

        # Compare in global numbers: points, then corners of cells.
        nodes, cells = np.argsort(node_id)[n_domains:], np.argsort(cell_id)[n_efg:]
        assert same(node_id[nodes], np.arange(model.n_nodes))
        assert same(cell_id[cells], np.arange(model.n_cells))
        assert same(grid_data["points"][nodes], model.points)
        assert same(grid_data["node_label"][nodes], model.node_ids)
        first = grid_data["offsets"][:-1]
        corners = grid_data["connectivity"][first[cells[:n_hexahedra], None] + np.arange(8)]
        assert same(node_id[corners], model.hexahedra)
        efg_nodes = grid_data["connectivity"][first[kind == 1]]
        assert same(np.sort(node_id[efg_nodes]), np.arange(model.n_fe_nodes, model.n_nodes))
        integration_points = grid_data["connectivity"][first[cells[n_hexahedra:]]]
        assert (node_id[integration_points] == -1).all()
        assert same(grid_data["points"][integration_points], model.domain_points)
        assert same(grid_data["material"][cells], model.material)
        parts = np.zeros(model.n_cells, np.int32) if n_ranks == 1 else random_parts(model, n_ranks)
        assert same(grid_data["part"][cells], parts)

        point_data, cell_data, series = frame(single_part, k)
        for name, expected in point_data.items():
            assert same(grid_data[name][np.concatenate([nodes, integration_points])], expected), name
        assert same(grid_data["J"][cells], cell_data["J"])
        assert np.isnan(grid_data["J"][kind == 1]).all()
        assert {name: grid_data[name].tolist() for name in series} == {name: [value] for name, value in series.items()}


def test_results_come_back_in_the_order_of_the_model(model_path: Path, tmp_path: Path) -> None:
    model, single_part = store.read_model(model_path), store.read_part(model_path, 1, 0)
    run(model_path, tmp_path, 2, "close")
    with store.open_result(tmp_path) as result:
        assert result.complete
        assert (result.metadata["ranks"], result.metadata["rank"]) == (2, 0)
        assert result.metadata["deck"].startswith("title = 'é'")
        assert result.figures == {"rank": 0, "steps": 7}
        assert result.times.tolist() == [0.0, 0.25, 0.5, 0.75]
        assert result.series["energy"].tolist() == [0.0, 0.5, 1.0, 1.5]
        assert same(result.at_nodes("node_label"), model.node_ids)
        hexahedra = result.point_data("node_id")[result.hexahedra]
        assert same(hexahedra[np.argsort(result.cell_data("cell_id")[: len(hexahedra)])], model.hexahedra)
        for k in (*range(N_FRAMES), -1):
            point_data, cell_data, _ = frame(single_part, k % N_FRAMES)
            for name, expected in point_data.items():
                assert same(result.at_nodes(name, k), expected[: model.n_nodes])
                assert same(result.at_integration_points(name, k), expected[model.n_nodes :])
            assert same(result.in_cells("J", k), cell_data["J"])


@pytest.mark.parametrize(("n_ranks", "end"), [(1, "abandon"), (1, "kill"), (2, "kill")])
def test_an_unfinished_file_holds_the_complete_frames(model_path: Path, tmp_path: Path, n_ranks: int, end: str) -> None:
    (tmp_path / "result.vtkhdf").write_text("of an earlier run")
    run(model_path, tmp_path, n_ranks, end)
    times, frames = vtk_frames(tmp_path / "result.partial.vtkhdf")
    assert times == (0.0, 0.25)
    with store.open_result(tmp_path) as result:
        assert not result.complete
        assert result.n_frames == 2
        assert result.figures == ({} if end == "kill" else {"rank": 0, "steps": 7})
        for k, grid_data in enumerate(frames):
            assert same(result.point_data("parameters", k), grid_data["parameters"])
            assert same(result.at_nodes("parameters", k)[:, 0], np.arange(120.0) + k)


def test_other_files_than_results_are_refused(model_path: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no result"):
        store.open_result(tmp_path)
    with pytest.raises(InputError, match="not a result of mpitled"):
        store.open_result(model_path)
    run(model_path, tmp_path, 1, "close")
    os.truncate(tmp_path / "result.vtkhdf", (tmp_path / "result.vtkhdf").stat().st_size // 2)
    with pytest.raises(InputError, match="cannot be read as HDF5") as refusal:
        store.open_result(tmp_path)
    assert "\n" not in str(refusal.value)
    with pytest.raises(InputError, match="cannot be written"):
        run(model_path, model_path / "below a file", 1, "close")


def test_frames_of_other_names_or_sizes_are_refused(model_path: Path, tmp_path: Path) -> None:
    part = store.read_part(model_path, 1, 0)
    writer = store.ResultWriter(tmp_path, None, part, 1, {})
    point_data, cell_data, _ = frame(part, 0)
    with pytest.raises(ValueError, match="every frame holds"):
        writer.write_frame(0.0, {"parameters": point_data["parameters"]}, cell_data)
    with pytest.raises(ValueError, match="values for 96 rows"):
        writer.write_frame(0.0, point_data, {"J": cell_data["J"][1:]})
    writer.write_frame(0.0, point_data, cell_data)
    with pytest.raises(ValueError, match="space for 1 frames"):
        writer.write_frame(1.0, point_data, cell_data)
    writer.close()
