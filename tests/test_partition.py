"""The graph of cells, its partition and the tables of the parts, compared with closed forms and brute force."""

import resource
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mpitled.cells.kind import HEXAHEDRA
from mpitled.mesh import grid_points, structured_hexahedra
from partition import Block, CellGraph, PartTables, cell_graph, cut, figures, tables

COSTS = (1.0, 1.3)  # of a hexahedron and of a support domain


def solid(hexahedra: NDArray[np.int64]) -> Block:
    return Block(hexahedra, faces=HEXAHEDRA.faces)


def mixed(n: int, core: float = 0.5, nodes: int = 8, share: float = 1.0) -> list[Block]:
    """n^3 cells: hexahedra, and in the core a random cloud with 8 `share` support domains in place of each cell."""
    rng = np.random.default_rng(1)
    hexahedra, points = structured_hexahedra((n, n, n)), grid_points((n, n, n), (1.0, 1.0, 1.0))
    centres = points[hexahedra].mean(axis=1)
    in_core = np.abs(centres - 0.5).max(axis=1) < core / 2
    efg = np.setdiff1d(np.arange(len(points)), hexahedra[~in_core])
    points[efg] += rng.uniform(-0.3 / n, 0.3 / n, (len(efg), 3))
    eighths = np.stack(np.meshgrid(*[[-0.25, 0.25]] * 3), axis=-1).reshape(-1, 3) / n
    domain_points = (centres[in_core][:, None] + eighths).reshape(-1, 3)
    domain_points = domain_points[rng.random(len(domain_points)) < share]
    domain_points += rng.uniform(-0.1 / n, 0.1 / n, domain_points.shape)
    domains = cKDTree(points).query(domain_points, k=nodes)[1]
    return [solid(hexahedra[~in_core]), Block(domains, points=domain_points)]


def costs(blocks: list[Block]) -> NDArray[np.float64]:
    return np.repeat(COSTS, [len(block.nodes) for block in blocks])


def sizes(blocks: list[Block]) -> dict[str, int]:
    return dict(zip(("hexahedra", "domains"), (len(block.nodes) for block in blocks), strict=False))


def edges(graph: CellGraph) -> set[tuple[int, int]]:
    """Pairs of all entries of the rows, without repetition."""
    rows = np.repeat(np.arange(graph.n_cells), np.diff(graph.xadj))
    pairs = list(zip(rows.tolist(), graph.adjncy.tolist(), strict=True))
    assert len(set(pairs)) == len(pairs)
    return set(pairs)


def n_components(graph: CellGraph) -> int:
    matrix = csr_matrix((np.ones(len(graph.adjncy)), graph.adjncy, graph.xadj), shape=(graph.n_cells, graph.n_cells))
    return int(connected_components(matrix, directed=False)[0])


def test_edges_of_hexahedra_are_faces_in_any_numbering():
    """Inner faces of an nx x ny x nz block: (nx - 1) ny nz and so on."""
    nx, ny, nz = 5, 4, 3
    block = structured_hexahedra((nx, ny, nz))
    graph = cell_graph([solid(block)])
    joined = edges(graph)
    assert len(joined) == 2 * ((nx - 1) * ny * nz + nx * (ny - 1) * nz + nx * ny * (nz - 1))
    i, j, k = np.unravel_index(np.arange(nx * ny * nz), (nx, ny, nz), order="F")
    for a, b in joined:
        assert abs(i[a] - i[b]) + abs(j[a] - j[b]) + abs(k[a] - k[b]) == 1

    rng = np.random.default_rng(0)
    cells, nodes = rng.permutation(len(block)), rng.permutation(block.max() + 1)
    # Rotations of the corners about the local z axis, so that faces meet in every orientation.
    turned = np.stack([h[(np.arange(8) // 4) * 4 + (np.arange(8) + r) % 4] for h, r in zip(block, cells, strict=True)])
    shuffled = edges(cell_graph([solid(nodes[turned][cells])]))
    assert {(cells[a], cells[b]) for a, b in shuffled} == joined


@pytest.mark.parametrize("nodes", [8, 20])
def test_edges_of_support_domains_join_nearest_domains_and_cells_with_common_nodes(nodes):
    blocks = mixed(6, nodes=nodes, share=0.4)
    graph = cell_graph(blocks)
    joined = edges(graph)
    hexahedra, domains, points = blocks[0].nodes, blocks[1].nodes, blocks[1].points
    n = len(hexahedra)
    assert all((b, a) in joined and a != b for a, b in joined)
    assert n_components(graph) == 1
    assert graph.edge_weights.min() >= 1

    nearest = cKDTree(points).query(points, k=7)[1]
    expected = {(n + a, n + b) for a, row in enumerate(nearest) for b in row if a != b}
    touched = [set(cell) for cell in [*hexahedra.tolist(), *domains.tolist()]]
    for a in range(n, len(touched)):
        needed = [4] * n + [max(4, nodes // 2)] * (a - n)
        expected |= {(a, b) for b in range(a) if len(touched[a] & touched[b]) >= needed[b]}
    hexahedra_only = edges(cell_graph([solid(hexahedra)]))
    assert joined == expected | {(b, a) for a, b in expected} | hexahedra_only


def test_graph_is_connected_where_the_mesh_is():
    """Two hexahedra share an edge but no face, and a third hexahedron is separate."""
    shared_edge = np.array([[0, 1, 2, 3, 4, 5, 6, 7], [2, 8, 9, 10, 6, 11, 12, 13], np.arange(20, 28)])
    graph = cell_graph([solid(shared_edge)])
    assert edges(graph) == {(0, 1), (1, 0)}


@pytest.mark.parametrize(
    ("scene", "n_parts"),
    [("hexahedra", 2), ("hexahedra", 7), ("cloud", 4), ("mixed", 2), ("mixed", 5), ("mixed", 16)],
)
def test_parts_have_equal_cost_and_their_tables_agree(scene, n_parts):
    blocks = mixed(10, core={"hexahedra": 0.0, "cloud": 1.1, "mixed": 0.5}[scene], share=0.4)
    graph = cell_graph(blocks)
    part = cut(graph, n_parts, costs(blocks), seed=3)
    assert np.array_equal(part, cut(graph, n_parts, costs(blocks), seed=3))
    assert part.dtype == np.int32
    assert set(part) == set(range(n_parts))

    part_tables = tables(blocks, part, n_parts)
    quality = figures(part_tables, costs(blocks), sizes(blocks), graph)
    # The imbalance of a bisection is at most 0.1 % or two cells; recursive bisection adds up to four cells.
    mean = quality.cost.mean()
    assert quality.cost.max() <= mean * 1.001 ** np.ceil(np.log2(n_parts)) + 4 * max(COSTS)
    check_tables(part_tables, blocks, part, n_parts)

    rows = np.repeat(np.arange(graph.n_cells), np.diff(graph.xadj))
    assert quality.cut.sum() == np.count_nonzero(part[rows] != part[graph.adjncy])
    assert quality.cost.sum() == pytest.approx(costs(blocks).sum(), rel=1e-12)
    assert len(quality.describe().splitlines()) == n_parts + 4


def check_tables(part_tables: PartTables, blocks: list[Block], part: NDArray[np.int32], n_parts: int) -> None:
    """Compare the tables of each part with sets of nodes."""
    cells = [cell for block in blocks for cell in block.nodes.tolist()]
    of_part = [sorted({node for c in np.flatnonzero(part == p) for node in cells[c]}) for p in range(n_parts)]
    owner = {node: p for p in reversed(range(n_parts)) for node in of_part[p]}
    for p in range(n_parts):
        own = slice(*part_tables.cell_offsets[p : p + 2])
        assert part_tables.cells[own].tolist() == np.flatnonzero(part == p).tolist()
        own = slice(*part_tables.node_offsets[p : p + 2])
        assert part_tables.nodes[own].tolist() == of_part[p]
        assert np.diff(part_tables.owned_offsets)[p] == sum(of == p for of in owner.values())
        expected = {q: sorted(set(of_part[p]) & set(of_part[q])) for q in range(n_parts) if q != p}
        expected = {q: nodes for q, nodes in expected.items() if nodes}
        links = range(*part_tables.neighbour_offsets[p : p + 2])
        assert part_tables.neighbours[links.start : links.stop].tolist() == list(expected)
        for link, nodes in zip(links, expected.values(), strict=True):
            assert part_tables.shared[slice(*part_tables.shared_offsets[link : link + 2])].tolist() == nodes
    assert part_tables.owned_offsets[-1] == len(owner)
    assert len(part_tables.shared_offsets) == len(part_tables.neighbours) + 1
    assert part_tables.shared_offsets[-1] == len(part_tables.shared)


def test_parts_without_one_kind_of_cell():
    """Both kinds of parts occur if the core is several parts wide."""
    blocks = mixed(10, core=0.7)
    part = cut(cell_graph(blocks), 32, costs(blocks))
    part_tables = tables(blocks, part, 32)
    quality = figures(part_tables, costs(blocks), sizes(blocks))
    assert (quality.cells_of["domains"] == 0).any()
    assert (quality.cells_of["hexahedra"] == 0).any()
    assert quality.cut is None
    check_tables(part_tables, blocks, part, 32)


def test_one_part_needs_no_metis(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymetis", None)
    blocks = mixed(4)
    graph = cell_graph(blocks)
    part = cut(graph, 1, costs(blocks))
    assert part.dtype == np.int32
    assert part.tolist() == [0] * graph.n_cells
    check_tables(tables(blocks, part, 1), blocks, part, 1)
    with pytest.raises(ImportError):
        cut(graph, 2, costs(blocks))


def test_as_many_parts_as_cells_but_no_more():
    """METIS leaves one of 27 parts empty; `cut` moves a cell into this part."""
    block = structured_hexahedra((3, 3, 3))
    graph = cell_graph([solid(block)])
    assert sorted(cut(graph, 27, np.ones(27))) == list(range(27))
    for n_parts, cost, message in (
        (28, np.ones(27), "cannot cut 27 cells into 28 parts"),
        (0, np.ones(27), "cannot cut into 0 parts"),
        (2, np.arange(27.0), "costs must be positive"),
    ):
        with pytest.raises(ValueError, match=message):
            cut(graph, n_parts, cost)


def test_edge_weights_leave_fewer_halo_nodes():
    """A dense cloud has more edges per node than hexahedra: with equal weights METIS avoids to cut the cloud."""
    blocks = mixed(16)
    graph = cell_graph(blocks)
    halo = {}
    for name, weighted in {"weights": graph, "equal": replace(graph, edge_weights=None)}.items():
        parts = [cut(weighted, 2, costs(blocks), seed) for seed in range(3)]
        halo[name] = sum(len(tables(blocks, part, 2).shared) for part in parts)
    assert halo["weights"] < halo["equal"]


@pytest.mark.study
def test_four_million_hexahedra():
    """Time and peak memory of graph, cut and tables. Run this test alone, with -s to print the numbers."""
    small = structured_hexahedra((4, 4, 4))  # compiles
    tables([solid(small)], cut(cell_graph([solid(small)]), 2, np.ones(64)), 2)
    block = structured_hexahedra((160, 160, 157))
    equal = np.ones(len(block))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    graph = cell_graph([solid(block)])
    print(f"\ngraph {time.perf_counter() - start:.1f} s")
    part = cut(graph, 2, equal)
    print(f"cut {time.perf_counter() - start:.1f} s")
    part_tables = tables([solid(block)], part, 2)
    seconds = time.perf_counter() - start
    peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / len(block)
    print(f"tables {seconds:.1f} s, peak {peak:.0f} bytes a cell")
    print(figures(part_tables, equal, {"hexahedra": len(block)}, graph).describe())
    # At most half of 3 minutes and 1 KB a cell, the limits for the model and its partition together.
    assert seconds < 90
    assert peak < 500
