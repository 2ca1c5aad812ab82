"""Mixed meshes from files, their checks, the formats of meshio, and the export."""

from __future__ import annotations

import json
import re
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
from conftest import complaint, mpitled
from decks import CLOUD, FLAT, void_decks

from mpitled import export, store
from mpitled.cells import hexahedra
from mpitled.deck import MeshFiles, load_deck
from mpitled.errors import InputError
from mpitled.laws import Material, NeoHookean
from mpitled.mesh import Mesh, grid_points, structured_hexahedra
from mpitled.model.build import build
from mpitled.preview import overview
from mpitled.readers import meshes, tables

EPS = float(np.finfo(float).eps)
GROWTH = """
title = "a tumour in a block"
[block]
size = [48.0, 40.0, 40.0]
elements = [12, 10, 10]
cloud = "core"
[tumour]
centre = [24.0, 20.0, 20.0]
volume = 90.0
surface_nodes = 400
[cloud]
radius = 11.0
growth = 0.35
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
cells = ["hexahedra"]
[material.cloud]
youngs_modulus = 2500.0
poissons_ratio = 0.45
cells = ["cloud"]
[[fixed]]
nodes = "x0"
[[displaced]]
nodes = "x1"
displacement = [0.7, 0.0, -0.3]
rotation = 3.0
axis = "x"
centre = [0.0, 20.0, 20.0]
[solver]
method = "quasi-static"
load_time = 0.1
[output]
frames = 2
"""


@pytest.fixture
def void(tmp_path: Path) -> Path:
    """The folder of a mixed mesh: fe.inp, efg.inp, grid.csv and scene.toml."""
    for name, text in void_decks().items():
        (tmp_path / name).write_text(text)
    return tmp_path


def warnings(mesh: Mesh) -> list[str]:
    return [remark for remark in mesh.remarks if remark.startswith("warning")]


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


# ------------------------------------------------------------ the mixed mesh


def test_the_cloud_is_merged_into_the_void(void):
    mesh = meshes.read_mesh(load_deck(void / "scene.toml").mesh)
    # 6^3 grid nodes without 2^3 inner nodes; the cloud repeats the 4^3 - 2^3 nodes of the interface.
    assert (mesh.n_fe_nodes, mesh.n_nodes) == (6**3 - 2**3, 6**3)
    assert len(mesh.node_sets["interface"]) == 4**3 - 2**3
    assert (mesh.node_sets["interface"] < mesh.n_fe_nodes).all()
    assert any("56 nodes merged with FE nodes, 8 EFG nodes added" in remark for remark in mesh.remarks)
    assert len(mesh.hexahedra) == 5**3 - 3**3
    assert mesh.integration_volumes.sum() == pytest.approx(27e-9, rel=1e-14)
    assert np.abs(mesh.points).max() == 5e-3
    # Nodes keep the numbers of their files.
    assert mesh.node_ids[0] == 1
    assert mesh.node_ids[mesh.n_fe_nodes :].tolist() == [22, 23, 26, 27, 38, 39, 42, 43]
    assert mesh.cell_sets["cloud"].tolist() == list(range(len(mesh.hexahedra), mesh.n_cells))
    assert warnings(mesh) == []
    model = build(load_deck(void / "scene.toml"))
    assert model.mass.sum() == pytest.approx(125e-9 * 1000, rel=1e-12)
    assert model.figures.consistency_after < 1e-13


def test_each_file_has_its_unit(void):
    section = load_deck(void / "scene.toml").mesh
    in_mm = meshes.read_mesh(section)
    for name in ("efg.inp", "grid.csv"):
        lines = []
        for line in (void / name).read_text().splitlines():
            fields = line.split(",")
            if line[0].isdigit():
                first = [fields.pop(0)] if name == "efg.inp" else []
                scaled = [float(x) * (1e-3 if i < 3 else 1e-9) for i, x in enumerate(fields)]
                line = ", ".join([*first, *map(repr, scaled)])
            lines.append(line)
        (void / name).write_text("\n".join(lines) + "\n")
    edit(void / "scene.toml", 'unit = "mm"', 'unit = "mm"\nefg_unit = "m"\nintegration_unit = "m"')
    in_m = meshes.read_mesh(load_deck(void / "scene.toml").mesh)
    np.testing.assert_allclose(in_m.points, in_mm.points, rtol=1e-15)
    np.testing.assert_allclose(in_m.integration_volumes, in_mm.integration_volumes, rtol=1e-14)


def test_integration_points_from_dropped_hexahedra(void, tmp_path):
    """k^3 points for each hexahedron, with the exact volume and the sets and material of the hexahedra."""
    shape = (5, 5, 5)
    points, cells = grid_points(shape, (5.0, 5.0, 5.0)), structured_hexahedra(shape)
    centre = points[cells].mean(axis=1)
    core = np.flatnonzero((np.abs(centre - 2.5) < 1.5).all(axis=1)) + 1
    text = "*NODE\n" + "".join(f"{i}, {x}, {y}, {z}\n" for i, (x, y, z) in enumerate(points.tolist(), 1))
    text += "*ELEMENT, TYPE=C3D8, ELSET=tissue\n"
    text += "".join(", ".join(map(str, [i, *row])) + "\n" for i, row in enumerate((cells + 1).tolist(), 1))
    text += "*ELSET, ELSET=core\n" + "".join(f"{n},\n" for n in core)
    text += (
        "*SOLID SECTION, ELSET=tissue, MATERIAL=brain\n*MATERIAL, NAME=brain\n*DENSITY\n1e-9\n*ELASTIC\n3e-3, 0.49\n"
    )
    (void / "fe.inp").write_text(text + "*NSET, NSET=skull\n1, 2, 3\n*BOUNDARY\nskull, 1, 3\n")
    scene = void / "scene.toml"
    edit(scene, 'integration_points = "grid.csv"', 'dropped = ["core"]\ncuts = 3\nstress_unit = "MPa"')
    scene.write_text(scene.read_text().partition("[material.brain]")[0])
    mesh = meshes.read_mesh(load_deck(scene).mesh)
    assert len(mesh.hexahedra) == 5**3 - 3**3
    assert len(mesh.integration_volumes) == 27 * 27
    assert mesh.integration_volumes.sum() == pytest.approx(27e-9, rel=1e-13)
    assert len(mesh.cell_sets["core"]) == 27 * 27
    assert (mesh.cell_sets["core"] >= len(mesh.hexahedra)).all()
    assert len(mesh.cell_sets["tissue"]) == mesh.n_cells
    model = build(load_deck(scene))
    (material,) = model.materials
    # mm, MPa and t/mm^3.
    assert (material.youngs_modulus, material.density) == pytest.approx((3000.0, 1000.0), rel=1e-14)


def test_a_cloud_alone_of_tetrahedra(tmp_path):
    (tmp_path / "cloud.inp").write_text(CLOUD)
    mesh = meshes.read_mesh(MeshFiles(efg=tmp_path / "cloud.inp"))
    assert (mesh.n_fe_nodes, mesh.n_nodes, len(mesh.integration_volumes)) == (0, 8, 6)
    np.testing.assert_allclose(mesh.integration_volumes, 1 / 6, rtol=1e-14)
    np.testing.assert_allclose(
        mesh.integration_points[0], np.mean([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]], axis=0)
    )
    assert mesh.cell_sets["cloud"].tolist() == list(range(6))
    assert mesh.node_sets["surface"].tolist() == list(range(8))


def test_grids_in_hdf5_and_with_sets(void):
    x, y, z, volume = np.loadtxt(void / "grid.csv", delimiter=",", skiprows=1).T
    with h5py.File(void / "grid.h5", "w") as file:
        file.update({"x": x, "y": y, "z": z, "volume": volume})
    same = tables.read_grid(void / "grid.h5")
    table = tables.read_grid(void / "grid.csv")
    assert (same[0].tobytes(), same[1].tobytes()) == (table[0].tobytes(), table[1].tobytes())
    lines = (void / "grid.csv").read_text().splitlines()
    lines = ["x,y,z,volume,sets", lines[1] + ",a;b b", lines[2] + ",", lines[3] + ",a", *(x + ",c" for x in lines[4:])]
    (void / "grid.csv").write_text("\n".join(lines))
    sets = tables.read_grid(void / "grid.csv")[2]
    assert sets["a"].tolist() == [0, 2]
    assert sets["b b"].tolist() == [0]
    mesh = meshes.read_mesh(load_deck(void / "scene.toml").mesh)
    assert mesh.cell_sets["cloud"].tolist() == [len(mesh.hexahedra) + 1]  # the point without a set


def test_constraints_of_file_and_deck_are_combined(void):
    scene = void / "scene.toml"
    model = build(load_deck(scene))
    skull = model.node_sets["skull"]
    np.testing.assert_array_equal(model.prescribed_dofs, (3 * skull[:, None] + np.arange(3)).ravel())
    assert not any(" replaces what " in remark for remark in model.remarks)
    edit(scene, 'nodes = "skull"', 'nodes = "scull"')
    with pytest.raises(InputError, match=r"no set 'scull'; did you mean 'skull'\? Sets: interface, skull"):
        build(load_deck(scene))


def test_a_deck_replaces_prescribed_dofs_of_the_file(void):
    """The file fixes the skull in x, y and z; the deck moves it along x. There is one remark."""
    scene = void / "scene.toml"
    edit(scene, "displacement = [0.0]", "displacement = [1.0]")
    model = build(load_deck(scene))
    np.testing.assert_array_equal(model.prescribed_displacements, np.tile([1e-3, 0, 0], len(model.node_sets["skull"])))
    replaced = [remark for remark in model.remarks if " replaces what " in remark]
    n = len(model.node_sets["skull"])
    assert replaced == [f"{scene}: displaced.0 replaces what {void / 'fe.inp'} prescribes at {n} nodes"]
    twice = scene.read_text() + '[[fixed]]\nnodes = "skull"\n'
    scene.write_text(twice)
    with pytest.raises(InputError, match=r"displaced\.0.* moved by 1 mm in x, and by 0 mm through .*fixed\.0"):
        build(load_deck(scene))


# ------------------------------------------------------------ checks


def test_integration_points_that_do_not_fit_the_void_cause_warnings(void):
    scene = void / "scene.toml"
    edit(void / "grid.csv", "0.125", "0.925")
    (warning,) = warnings(meshes.read_mesh(load_deck(scene).mesh))
    assert "sum to 27.8 mm3, the void has 27 mm3" in warning
    edit(void / "grid.csv", "0.925", "0.125")
    edit(void / "grid.csv", "1.25, 1.25, 1.25", "0.25, 1.25, 1.25")
    (warning,) = warnings(meshes.read_mesh(load_deck(scene).mesh))
    assert "1 integration points lie in hexahedra" in warning
    edit(void / "grid.csv", "0.25, 1.25, 1.25, 0.125", "0.25, 1.25, 1.25, -0.125")
    with pytest.raises(InputError, match=r"grid.csv: line 2: .* positive volume \(1 such\)"):
        meshes.read_mesh(load_deck(scene).mesh)


ORDERS = {
    "inside out": [4, 5, 6, 7, 0, 1, 2, 3],
    "mirrored": [0, 3, 2, 1, 4, 7, 6, 5],
    "crosswise": [0, 1, 3, 2, 4, 5, 7, 6],
    "crosswise, inside out": [4, 5, 7, 6, 0, 1, 3, 2],
}


@pytest.mark.parametrize("how", ORDERS)
def test_wrong_node_orders_are_repaired_on_request(tmp_path, how):
    nodes = np.array([10, 20, 25, 15, 110, 120, 125, 115])[ORDERS[how]]
    text = FLAT.replace("7, 10, 20, 25, 15, 110, 120, 125, 115", ", ".join(map(str, [7, *nodes])))
    path = tmp_path / "deck.inp"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        meshes.read_mesh(MeshFiles(fe=path))
    assert "line 17: 1 hexahedra are inverted or flat, the first is element 7; 1 have" in str(caught.value)
    assert "mesh.repair = true" in str(caught.value)
    mesh = meshes.read_mesh(MeshFiles(fe=path, repair=True))
    assert any("1 hexahedra put in order" in remark for remark in mesh.remarks)
    np.testing.assert_allclose(hexahedra.volumes(mesh.points, mesh.hexahedra), 1.0, rtol=1e-14)
    assert hexahedra.scaled_jacobian(mesh.points, mesh.hexahedra).min() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        # The top nodes at the level of the base.
        ("0., 1.\n", "0., 1e-9\n", "2 hexahedra are inverted or flat, the first is element 7; correct"),
        # Stiffness and mass would be doubled.
        (
            "*NSET, NSET=left",
            "9, 25, 15, 10, 20, 125, 115, 110, 120\n*NSET, NSET=left",
            "line 17: element 9 has the same nodes as element 7.*take one .* out",
        ),
        (
            " left, 1, 3\n",
            " left, 1, 3\n left, 1, 1, 0.1\n",
            r"node 10 is moved by 100 mm in x, and by 0 mm .*\(4 such\)",
        ),
    ],
    ids=["flat", "element twice", "fixed and displaced"],
)
def test_meshes_that_cannot_be_computed_are_refused(tmp_path, old, new, message):
    text = FLAT.replace(old, new, 1)
    if "flat" in message:
        text = re.sub(r"(?m)^( 1[123][05], .*), 1\.$", r"\1, 1e-9", FLAT)
    (tmp_path / "deck.inp").write_text(text)
    with pytest.raises(InputError, match=message):
        overview.check(tmp_path / "deck.inp")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"*DENSITY\n 1e-9,\n": ""}, "line 28: material brain has no density; 1000 kg/m3 is used"),
        ({"left, 1, 3": "left, 2"}, "can move as a rigid body (1 of 6 motions)"),
        (
            {
                " 3, 20, 30, 35, 25, 120, 130, 135, 125": " 3, 21, 30, 35, 26, 121, 130, 135, 126",
                "*ELEMENT": "*NODE\n 21, 1., 0., 0.\n 26, 1., 1., 0.\n 121, 1., 0., 1.\n 126, 1., 1., 1.\n*ELEMENT",
            },
            "the mesh is in 2 pieces that share no node",
        ),
        ({" left, 1, 3": "** left"}, "rigid"),  # the set right is prescribed along x only
        (
            {"*ELEMENT": "*NODE\n 1, 1., 0., 0.\n*ELEMENT", " 3, 20,": " 3, 1,"},
            "1 nodes lie where another one does, the first is node 1",
        ),
    ],
)
def test_suspicious_meshes_get_a_remark(tmp_path, changes, words):
    text = FLAT
    for old, new in changes.items():
        text = text.replace(old, new, 1)
    (tmp_path / "deck.inp").write_text(text)
    assert words in overview.check(tmp_path / "deck.inp")


def test_check_prints_the_contents_of_a_file_and_a_deck(void):
    (void / "flat.inp").write_text(FLAT)
    printed = mpitled("check", void / "flat.inp").stdout
    for line in (
        "nodes            12",
        "cells            hexahedron (C3D8R): 2",
        "node set         left: 4",
        "cell set         solid: 2",
        "material         brain in solid: E 0.003, nu 0.49, density 1e-09",
        "fixed            left (4 nodes) in x, y, z",
        "displaced        right (4 nodes) in x by 0.25",
    ):
        assert line in printed.splitlines()
    printed = mpitled("check", void / "scene.toml").stdout
    for line in ("hexahedra        98", "integration      216 points, 27 mm3", "cell set         cloud: 216"):
        assert line in printed.splitlines()
    (void / "flat.inp").write_text(FLAT.replace("*BOUNDARY\n right", "*BOUNDARY\n wrong"))
    line = complaint(mpitled("check", void / "flat.inp", status=2))
    assert "there is no node set wrong; sets: everything, left, right" in line
    assert "flat.inp: line" in line


# ------------------------------------------------------------ meshio


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".med", ".xdmf", ".mesh"])
def test_formats_of_meshio_are_read_with_their_sets(tmp_path, suffix):
    points, cells = grid_points((2, 1, 1), (2.0, 1.0, 1.0)), structured_hexahedra((2, 1, 1))
    part = np.array([1, 2], np.int32)
    data = {"part": [part]}
    if suffix == ".msh":
        data = {"gmsh:physical": [part], "gmsh:geometrical": [part]}
    elif suffix == ".med":
        data = {"cell_tags": [-part]}
    elif suffix == ".mesh":
        data = {"medit:ref": [part]}
    mesh = meshio.Mesh(points, [("hexahedron", cells)], cell_data=data)
    if suffix == ".msh":
        mesh.field_data = {"grey": np.array([1, 3]), "white": np.array([2, 3])}
    elif suffix == ".med":
        mesh.cell_tags = {-1: ["grey"], -2: ["white"]}
    path = tmp_path / f"mesh{suffix}"
    mesh.write(path, **({"file_format": "gmsh22"} if suffix == ".msh" else {}))
    result = meshes.read_mesh(MeshFiles(fe=path))
    np.testing.assert_array_equal(result.hexahedra, cells)
    np.testing.assert_array_equal(result.points, points)
    names = ["grey", "white"] if suffix in (".msh", ".med") else [f"{next(iter(data))} {i}" for i in (1, 2)]
    assert [result.cell_sets[name].tolist() for name in names] == [[0], [1]]


def test_invalid_files_of_meshio_are_refused(tmp_path):
    for name, text in (("a.vtu", "<VTKFile"), ("a.msh", "$MeshFormat\n4.1 0 8\n"), ("a.obj", "v"), ("a.txt", "hello")):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError) as caught:
            overview.check(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)
        assert "\n" not in str(caught.value)


# ------------------------------------------------------------ export


def test_an_exported_model_runs_to_the_same_bits(tmp_path):
    """Block, core cloud, tumour, fixed, displaced and rotated sets, two materials."""
    (tmp_path / "scene.toml").write_text(GROWTH)
    mpitled("run", tmp_path / "scene.toml", "--out", tmp_path / "a")
    printed = mpitled("export", tmp_path / "a", "--abaqus", "--out", tmp_path / "decks").stdout.split()
    assert [Path(name).name for name in printed] == [
        "fe.inp", "efg.inp", "integration_points.csv", "surface_areas.csv", "scene.toml",
    ]  # fmt: skip
    mpitled("run", tmp_path / "decks" / "scene.toml", "--out", tmp_path / "b")
    models = [store.read_model(tmp_path / x / "model.h5") for x in "ab"]
    one, other = map(store.model_arrays, models)
    assert [*one] == [*other]
    for name in one:
        assert one[name].tobytes() == other[name].tobytes(), name
    assert models[0].materials == models[1].materials
    assert not any("several steps" in remark for remark in models[1].remarks)
    assert models[0].surface_areas.tobytes() == models[1].surface_areas.tobytes()
    for kind in ("node_sets", "cell_sets"):
        one, other = (getattr(model, kind) for model in models)
        assert one.keys() == other.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])
    last = []
    for x in "ab":
        with store.open_result(tmp_path / x) as result:
            last.append((result.at_nodes("parameters", -1), result.at_integration_points("displacement", -1)))
    assert np.abs(last[0][0]).max() > 5e-4
    for one, other in zip(*last, strict=True):
        assert one.tobytes() == other.tobytes()


def test_exported_materials_are_read_with_the_same_moduli(void):
    """Each cell has another material. The export has C10 and D1, and E and nu are recovered to round-off."""
    model = build(load_deck(void / "scene.toml"))
    rng, n = np.random.default_rng(0), model.n_cells
    laws = zip(10 ** rng.uniform(-3, 12, n), rng.uniform(-0.99, 0.4999, n), strict=True)
    given = [
        Material(f"m{i}", NeoHookean(youngs_modulus=float(E), poissons_ratio=float(nu)), 1000.0)
        for i, (E, nu) in enumerate(laws)
    ]
    blocks = [replace(block, material=np.arange(n, dtype=np.int16)[cells]) for cells, block in model.numbered()]
    model = replace(model, materials=tuple(given), blocks=tuple(blocks))
    store.write_model(void / "model.h5", model, "key", {})
    export.write_abaqus(void / "model.h5", void / "decks")
    file = meshes.read_file(void / "decks" / "fe.inp")
    assert len(file.materials) == len(model.hexahedra)
    for (_, found), material in zip(file.materials, given, strict=False):
        assert found.youngs_modulus == pytest.approx(material.law.youngs_modulus, rel=5 * EPS)
        assert found.poissons_ratio == pytest.approx(material.law.poissons_ratio, rel=0, abs=3 * EPS)
    assert "*ELASTIC" not in (void / "decks" / "fe.inp").read_text()


@pytest.mark.parametrize("cloud", ["none", "all"])
def test_an_exported_model_of_one_kind_of_cell_is_the_same(tmp_path, cloud):
    text = GROWTH.partition("[tumour]")[0] + GROWTH[GROWTH.index("[material.brain]") :]
    text = text.replace('"core"', f'"{cloud}"').replace('["hexahedra"]', '["all"]')
    head, _, rest = text.partition("[material.cloud]")
    (tmp_path / "scene.toml").write_text(head + rest[rest.index("[[fixed]]") :])
    mpitled("build", tmp_path / "scene.toml", "--out", tmp_path / "a")
    mpitled("export", tmp_path / "a" / "model.h5", "--abaqus")
    mpitled("build", tmp_path / "a" / "export" / "scene.toml", "--out", tmp_path / "b")
    models = [store.read_model(tmp_path / x / "model.h5") for x in "ab"]
    one, other = map(store.model_arrays, models)
    assert [*one] == [*other]
    for name in one:
        assert one[name].tobytes() == other[name].tobytes(), name


def test_a_changed_include_rebuilds_the_model(tmp_path):
    (tmp_path / "nodes.inp").write_text(FLAT[: FLAT.index("*ELEMENT")])
    (tmp_path / "fe.inp").write_text("*INCLUDE, INPUT=nodes.inp\n" + FLAT[FLAT.index("*ELEMENT") :])
    (tmp_path / "scene.toml").write_text('[mesh]\nfe = "fe.inp"\nunit = "mm"\nstress_unit = "MPa"\n')
    out = lambda: mpitled("build", tmp_path / "scene.toml", "--out", tmp_path / "out").stdout.splitlines()[0]  # noqa: E731
    assert out().endswith("built")
    assert out().endswith("up to date")
    edit(tmp_path / "nodes.inp", "2., 1., 1.", "2., 1., 1.5")
    assert out().endswith("built")


# ------------------------------------------------------------ warnings and size


def test_a_load_that_is_not_applied_is_a_warning_of_the_result(tmp_path):
    """Before the run, at its end, with -q, and at the top of the page, once each."""
    (tmp_path / "fe.inp").write_text(FLAT.replace("*END STEP", "*DSLOAD\n top, P, 1.\n*END STEP"))
    (tmp_path / "scene.toml").write_text(
        '[mesh]\nfe = "fe.inp"\nunit = "mm"\nstress_unit = "MPa"\n[solver]\nmethod = "quasi-static"\nload_time = 0.01\n'
    )
    warning = f"{tmp_path / 'fe.inp'}: line 39: *DSLOAD is not applied: loads are not supported"
    done = mpitled("run", tmp_path / "scene.toml", "--out", tmp_path / "out")
    assert [line for line in done.stderr.splitlines() if "DSLOAD" in line] == [f"warning: {warning}"]
    assert [line.strip() for line in done.stdout.splitlines() if "DSLOAD" in line] == [f"warning: {warning}"]
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["warnings"] == [warning]
    quietly = mpitled("run", tmp_path / "scene.toml", "-q", "--out", tmp_path / "out").stderr
    assert quietly == f"mpitled: warning: {warning}\n"
    mpitled("report", tmp_path / "out", "--html")
    top, _, below = (tmp_path / "out" / "report.html").read_text().partition("<h2>")
    assert "DSLOAD" in top
    assert "DSLOAD" not in below


@pytest.mark.study
def test_a_million_hexahedra_are_read_in_twenty_seconds_and_a_gibibyte(tmp_path):
    shape = (100, 100, 100)
    points = grid_points(shape, (100.0, 100.0, 100.0)) + np.random.default_rng(0).uniform(-0.1, 0.1, (101**3, 3))
    with (tmp_path / "big.inp").open("w") as file:
        file.write("*NODE\n")
        file.writelines(f"{i}, {x:.9g}, {y:.9g}, {z:.9g}\n" for i, (x, y, z) in enumerate(points.tolist(), 1))
        file.write("*ELEMENT, TYPE=C3D8R, ELSET=tissue\n")
        rows = (structured_hexahedra(shape) + 1).tolist()
        file.writelines(f"{i}, {', '.join(map(str, row))}\n" for i, row in enumerate(rows, 1))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [str(Path(sys.executable).with_name("mpitled")), "check", str(tmp_path / "big.inp")]
    assert "hexahedron (C3D8R): 1000000" in subprocess.run(command, check=True, capture_output=True, text=True).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{seconds:.1f} s of CPU time, {after.ru_maxrss / 2**20:.2f} GiB")
    assert seconds < 20
    assert after.ru_maxrss < 2**20
