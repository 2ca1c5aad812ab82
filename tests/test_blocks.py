"""Blocks of cells: a scene in three blocks, in any order, is the scene in two."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import mpitled
from numpy.typing import NDArray
from scenes import MIXED, pulled

from mpitled import deck, job, store
from mpitled.model import CellBlock, Model
from mpitled.model import build as model_build

SCENE = f"""{
    MIXED.replace(
        "[cloud]",
        '''cells = ["hexahedra"]
[material.core]
youngs_modulus = 2000.0
poissons_ratio = 0.45
cells = ["cloud"]
[cloud]''',
    )
}{pulled(1.0)}
[solver]
method = "quasi-static"
load_time = 0.05
on_inversion = "stop"
[output]
frames = 2
stress = true
"""
ORDERS = {"solids first": [0, 1, 2], "cloud first": [2, 0, 1], "cloud between": [1, 2, 0]}


def cut_of(solid: CellBlock) -> int:
    """A row in the middle of a voxel run."""
    return len(solid) // 2 + 3


def in_two(path: Path) -> Model:
    """The model, in which the upper hexahedra are of the material of the core."""
    model = model_build.build(deck.load_deck(path))
    solid, cloud = model.blocks
    upper = np.arange(len(solid)) >= cut_of(solid)
    return replace(model, blocks=(replace(solid, material=np.where(upper, cloud.material[0], solid.material)), cloud))


def in_three(model: Model, order: list[int]) -> tuple[Model, NDArray[np.int64]]:
    """The model with its hexahedra in two blocks, and the new order of the cells."""
    solid, cloud = model.blocks
    cut = cut_of(solid)
    halves = [
        CellBlock(name, solid.kind, solid.nodes[own], solid.material[own])
        for name, own in (("lower", slice(cut)), ("upper", slice(cut, None)))
    ]
    cells = np.split(np.arange(model.n_cells), [cut, len(solid)])
    blocks, numbers = [*halves, cloud], np.concatenate([cells[i] for i in order])
    position = np.argsort(numbers)
    cell_sets = {name: np.sort(position[members]) for name, members in model.cell_sets.items()}
    return replace(model, blocks=tuple(blocks[i] for i in order), cell_sets=cell_sets), numbers


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run in two blocks on one rank."""
    folder = tmp_path_factory.mktemp("two")
    (folder / "scene.toml").write_text(SCENE)
    scene = deck.load_deck(folder / "scene.toml")
    store.write_model(
        folder / job.MODEL, in_two(folder / "scene.toml"), deck.model_key(scene, []), deck.canonical(scene)
    )
    mpitled("run", "-q", folder / "scene.toml", "--out", folder)
    return folder


@pytest.mark.parametrize(
    ("order", "ranks"), [("solids first", 1), ("solids first", 4), ("cloud first", 2), ("cloud between", 2)]
)
def test_a_scene_in_three_blocks_agrees_with_the_scene_in_two(
    two: Path, tmp_path: Path, order: str, ranks: int
) -> None:
    model, numbers = in_three(in_two(two / "scene.toml"), ORDERS[order])
    path = tmp_path / job.MODEL
    key = store.model_key(two / job.MODEL)
    assert key is not None
    store.write_model(path, model, key, store.read_scene(two / job.MODEL))
    back = store.read_model(path)
    assert [block.name for block in back.blocks] == [("lower", "upper", "support domains")[i] for i in ORDERS[order]]
    mpitled("run", "-q", two / "scene.toml", "--out", tmp_path, n=ranks)
    with store.open_result(two) as of_two, store.open_result(tmp_path) as of_three:
        assert [(block.name, block.cells) for block in of_three.blocks] == [(b.name, len(b)) for b in model.blocks]
        assert of_three.n_frames == of_two.n_frames
        assert np.array_equal(of_three.at_nodes("node_label"), of_two.at_nodes("node_label"))
        assert np.array_equal(of_three.in_cells("material"), of_two.in_cells("material")[numbers])
        largest = np.abs(of_two.at_nodes("displacement", -1)).max()
        for frame in range(of_two.n_frames):
            for name in ("displacement", "parameters"):
                for at in (type(of_two).at_nodes, type(of_two).at_integration_points):
                    difference = at(of_three, name, frame) - at(of_two, name, frame)
                    assert np.abs(difference).max() < 1e-9 * largest
            for name, scale in (("J", 1.0), ("stress", np.abs(of_two.in_cells("stress", -1)).max())):
                difference = of_three.in_cells(name, frame) - of_two.in_cells(name, frame)[numbers]
                assert np.abs(difference).max() < 1e-9 * scale
        node_id = of_three.point_data("node_id")
        for block in model.blocks:
            cell_id = of_three.cell_data("cell_id")[of_three.block_rows(block.name)]
            own = block.nodes[cell_id - cell_id.min()]
            corners = of_three.corners(block.name)
            if block.kind.meshfree:
                assert np.array_equal(of_three.points[corners[:, 0]], block.columns["points"][cell_id - cell_id.min()])
            else:
                assert np.array_equal(node_id[corners], own)
