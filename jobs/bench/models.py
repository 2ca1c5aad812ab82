"""The models that benchmarks time: blocks of voxels, of distorted hexahedra and of support domains, and the brain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mpitled import job, store
from mpitled.deck import load_deck
from mpitled.model import build as model_build

BRAIN = Path(__file__).parents[1] / "brain_tumour.toml"
BLOCK = """
[block]
size = [96.0, 96.0, 96.0]
elements = {elements}
cloud = "{cloud}"
[support]
nodes = {nodes}
consistency = false
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[fixed]]
nodes = "z0"
[[displaced]]
nodes = "z1"
directions = ["z"]
displacement = [-1.0]
"""
#: Sizes of each scene: elements along each edge of a block, and the edge of the brain's hexahedra in mm.
SIZES: dict[str, tuple[Any, ...]] = {
    "voxel": (20, 40, 80),
    "distorted": (20, 40, 80),
    "cloud": (16, 28, 48),
    "mixed": (6.0, 4.0, 2.0),
}
#: Nodes of a support domain in the block: the paper's.
DOMAIN_NODES = 8
#: Random shift of a distorted block's inner nodes, as a share of the edge.
DISTORTION = 0.15


def build(folder: Path, scene: str, size: Any, nodes: int = DOMAIN_NODES) -> dict[str, Any]:
    """Write the model of a scene into a new folder, and return what a worker process needs to know of it.

    size: see `SIZES`; a block may also have three numbers of elements. nodes: of each support domain of a block.
    """
    folder.mkdir()
    if scene == "mixed":
        deck = load_deck(BRAIN, [f"labels.element_size={size}"])
    else:
        path, elements = folder / "scene.toml", size if isinstance(size, list) else [size] * 3
        path.write_text(BLOCK.format(elements=elements, cloud="all" if scene == "cloud" else "none", nodes=nodes))
        deck = load_deck(path)
    mesh = model_build.read_mesh(deck)
    if scene == "distorted":
        inner = np.setdiff1d(np.arange(mesh.n_nodes), mesh.node_sets["surface"])
        points = mesh.points.copy()
        edge = np.array(deck.block.size) / deck.block.elements
        points[inner] += np.random.default_rng(0).uniform(-DISTORTION, DISTORTION, (len(inner), 3)) * edge
        mesh = replace(mesh, points=points)
    store.write_model(folder / job.MODEL, model_build.discretise(deck, mesh), "bench")
    return {
        "scene": scene,
        "size": size,
        "model": str(folder / job.MODEL),
        "hourglass": deck.hexahedra.hourglass,
        "stabilisation": deck.support.stabilisation,
    }
