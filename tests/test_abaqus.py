"""Abaqus decks: equal content in every notation, features of the format, and errors with file and line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from decks import ASSEMBLY, CLOUD, FLAT, INCLUDED, INCLUDING
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mpitled.deck import MeshFiles
from mpitled.errors import InputError
from mpitled.mesh import grid_points, structured_hexahedra
from mpitled.readers import meshes
from mpitled.readers.meshfile import MeshFile, exterior_faces


def read(folder: Path, text: str | bytes, name: str = "deck.inp") -> MeshFile:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return meshes.read_file(path)


def ids_of(file: MeshFile, name: str) -> list[int]:
    return sorted(file.node_ids[file.node_sets[name]].tolist())


def assert_same(one: MeshFile, other: MeshFile) -> None:
    """The models of both files are bit-identical."""
    assert one.points.tobytes() == other.points.tobytes()
    np.testing.assert_array_equal(one.node_ids, other.node_ids)
    nodes = [np.concatenate([block.nodes for block in file.cells]) for file in (one, other)]
    np.testing.assert_array_equal(*nodes)
    np.testing.assert_array_equal(*(np.concatenate([block.ids for block in file.cells]) for file in (one, other)))
    for kind in ("node_sets", "cell_sets"):
        mine, theirs = ({name.casefold(): rows for name, rows in getattr(f, kind).items()} for f in (one, other))
        assert mine.keys() == theirs.keys()
        for name, members in mine.items():
            np.testing.assert_array_equal(members, theirs[name])
    constraints = [
        sorted((c.node_set.casefold(), c.directions, c.displacement) for c in file.constraints) for file in (one, other)
    ]
    assert constraints[0] == constraints[1]
    laws = [[(m.youngs_modulus, m.poissons_ratio, m.density) for _, m in file.materials] for file in (one, other)]
    assert laws[0] == laws[1]


def test_a_flat_deck_is_read_completely(tmp_path):
    file = read(tmp_path, FLAT)
    np.testing.assert_array_equal(file.node_ids[:3], [10, 20, 30])  # the file's order and numbers
    (block,) = file.cells
    assert (block.kind, block.ids.tolist()) == ("hexahedron", [7, 3])
    np.testing.assert_array_equal(file.node_ids[block.nodes[0]], [10, 20, 25, 15, 110, 120, 125, 115])
    assert ids_of(file, "everything") == [10, 15, 20, 25, 30, 35]
    assert ids_of(file, "right") == [30, 35, 130, 135]
    assert ids_of(file, "top") == [110, 115, 120, 125, 130, 135]
    assert file.cell_sets["solid"].tolist() == [0, 1]
    held, moved = sorted(file.constraints, key=lambda constraint: constraint.node_set)
    assert (held.node_set, held.directions, held.displacement) == ("left", (0, 1, 2), (0.0,) * 3)
    assert (moved.node_set, moved.directions, moved.displacement) == ("right", (0,), (0.25,))
    assert held.origin.endswith("deck.inp: line 34")
    ((cells, material),) = file.materials
    assert (cells, material.youngs_modulus, material.poissons_ratio, material.density) == ("solid", 3e-3, 0.49, 1e-9)
    assert file.remarks == []


def test_skipped_keywords_are_listed(tmp_path):
    """Except titles and requests for output; *CONTACT OUTPUT is no contact."""
    output = "*OUTPUT, FIELD\n*NODE OUTPUT\n U,\n*CONTACT OUTPUT\n CSTRESS,\n*RESTART, WRITE\n*END STEP"
    file = read(tmp_path, FLAT.replace("*STATIC", "*VISCO").replace("*END STEP", output))
    assert file.remarks == [f"{tmp_path / 'deck.inp'}: skipped, because the results do not depend on it: *VISCO"]
    assert file.refused == []


def test_a_deck_that_is_cut_short_is_recognised(tmp_path):
    """Nodes of a part without an instance are not in the model."""
    cut = ASSEMBLY[: ASSEMBLY.index("*Elset, elset=Set-1")]
    with pytest.raises(InputError, match=r"Cube, .* has no \*INSTANCE; the file ends within \*PART Cube: is it cut"):
        read(tmp_path, cut)
    with pytest.raises(InputError, match=r"which has 8 nodes, has no \*INSTANCE; add one$"):
        read(tmp_path, ASSEMBLY[: ASSEMBLY.index("*Assembly")])
    assert [
        remark.partition("deck.inp: ")[2] for remark in read(tmp_path, FLAT + cut).remarks if "warning" in remark
    ] == ["part Cube has no *INSTANCE and is left out", "the file ends within *PART Cube: is it cut short?"]


WRITTEN = {
    "capitals": FLAT.upper(),
    "small letters": FLAT.lower(),
    "CRLF": FLAT.replace("\n", "\r\n"),
    "CR": FLAT.replace("\n", "\r"),
    "byte order mark": "\ufeff" + FLAT,
    "tabs": FLAT.replace(", ", ",\t").replace("\n ", "\n\t"),
    "spaces around =": FLAT.replace("=", " = "),
    "blanks in front": re.sub("(?m)^", "  ", FLAT),
    "blanks behind": FLAT.replace("\n", "  \n"),
    "comments": FLAT.replace("\n", "\n** a comment, with 1, 2, 3\n"),
    "blank lines": FLAT.replace("\n", "\n\n"),
    "commas behind": re.sub(r"(?m)^( [^*\n]*\d\.?)$", r"\1,", FLAT),
    "Fortran's exponents": FLAT.replace("1e-9", "1.0D-09").replace("3e-3", "3.0d-3"),
    "keyword over lines": FLAT.replace(
        "*ELEMENT, TYPE=C3D8R, ELSET=solid", "*ELEMENT,\n** here\nTYPE=C3D8R,\nELSET=solid"
    ),
    "rows over lines": FLAT.replace("25, 15,", "25, 15,\n").replace("35, 25,", "35, 25,\n"),
    "quoted names": FLAT.replace("ELSET=solid", 'ELSET="solid"').replace(" solid,", ' "solid",'),
    "another hexahedron": FLAT.replace("C3D8R", "C3D8I"),
    "blocks of nodes": FLAT.replace(" 25, 1., 1., 0.\n", "*NODE, NSET=EVERYTHING\n 25, 1., 1., 0.\n"),
    "unsorted sets": FLAT.replace("10, 15, 110, 115", "115, 10,\n 10, 110, 15"),
    "dof by dof": FLAT.replace(" left, 1, 3", " left, 1\n left, 2, 2, 0.\n left, 3,, 0"),
    "symbolic": FLAT.replace(" left, 1, 3", " Left, EnCastre"),
}


@pytest.mark.parametrize("how", WRITTEN)
def test_every_notation_gives_the_same_model(tmp_path, how):
    assert_same(read(tmp_path, FLAT), read(tmp_path, WRITTEN[how], "other.inp"))


def test_instances_are_translated_rotated_and_named(tmp_path):
    file = read(tmp_path, ASSEMBLY)
    assert len(file.points) == 16
    np.testing.assert_array_equal(file.node_ids, [*range(1, 9)] * 2)
    first, second = file.points[:8], file.points[8:]
    # Translated by 10 along x, then rotated by 90 degrees about the line x = 10, y = 0.
    expected = np.stack([10 - first[:, 1], first[:, 0], first[:, 2]], axis=1)
    np.testing.assert_allclose(second, expected, atol=1e-15 * 10)
    assert file.node_sets["both bases"].tolist() == [0, 1, 2, 3, 8, 9, 10, 11]
    assert file.node_sets["_PickedSet4"].tolist() == [4, 5, 6, 7, 12, 13, 14, 15]
    assert file.node_sets["Cube-2.base"].tolist() == [8, 9, 10, 11]
    assert file.node_sets["Surf-1"].tolist() == [12, 13, 14, 15]
    assert file.cell_sets["Cube-1.Set-1"].tolist() == [0]
    assert [cells for cells, _ in file.materials] == ["Cube-1.Set-1", "Cube-2.Set-1"]
    assert {c.node_set: c.displacement for c in file.constraints} == {"both bases": (0, 0, 0), "_PickedSet4": (-0.1,)}


def test_neo_hooke_becomes_moduli_at_small_strain(tmp_path):
    """W = C10 (I1bar - 3) + (J - 1)^2 / D1: shear modulus 2 C10, bulk modulus 2 / D1."""
    file = read(tmp_path, ASSEMBLY)
    material = file.materials[0][1]
    E, nu = material.youngs_modulus, material.poissons_ratio
    assert E / (2 * (1 + nu)) == pytest.approx(2 * 500.0, rel=1e-14)
    assert E / (3 * (1 - 2 * nu)) == pytest.approx(2 / 1e-4, rel=1e-12)
    assert any("C10" in remark and "Grey Matter" in remark for remark in file.remarks)


def test_sets_of_sets_in_any_order_and_ranges(tmp_path):
    sets = """*NSET, NSET=all
 later, 10
*NSET, NSET=later, GENERATE
 20, 30
*NSET, NSET=of elements, ELSET=solid
*ELSET, ELSET=half
 3
*NSET, NSET="A, b"
 LATER
"""
    file = read(tmp_path, FLAT.replace("*SURFACE", sets + "*SURFACE"))
    assert ids_of(file, "all") == [10, 20, 25, 30]
    assert ids_of(file, "later") == ids_of(file, "A, b") == [20, 25, 30]
    assert len(file.node_sets["of elements"]) == 12
    assert file.cell_sets["half"].tolist() == [1]


def test_faces_of_all_solids_are_their_surface(tmp_path):
    """Each face S1 to S6 of a cube lies in another plane; without a face name all exterior faces count."""
    cube = FLAT.replace(" 3, 20, 30, 35, 25, 120, 130, 135, 125\n", "")
    planes = set()
    for face in range(1, 7):
        file = read(tmp_path, cube.replace(" solid, S2", f" 7, S{face}"))
        x = file.points[file.node_sets["top"]]
        assert len(x) == 4
        (axis,) = np.flatnonzero(np.ptp(x, axis=0) == 0)
        planes.add((int(axis), float(x[0, axis])))
    assert len(planes) == 6
    blank = read(tmp_path, FLAT.replace(" solid, S2", " solid,"))
    assert len(blank.node_sets["top"]) == 12
    tetrahedra = read(tmp_path, CLOUD + "*SURFACE, NAME=skin\n cloud\n")
    assert len(exterior_faces(tetrahedra.cells)[0]) == 12
    assert len(tetrahedra.node_sets["skin"]) == 8


def test_includes_are_text_in_their_place(tmp_path):
    plain = read(tmp_path, FLAT)
    read(tmp_path, INCLUDED, "mesh/nodes.inp")
    assert_same(plain, read(tmp_path, INCLUDING, "including.inp"))
    # A file within a file, beside it; and data that go on after the included ones.
    (tmp_path / "mesh/nodes.inp").write_text("*INCLUDE, INPUT=deeper.inp\n")
    read(tmp_path, INCLUDED.replace(" 135, 2., 1., 1.\n", ""), "mesh/deeper.inp")
    text = INCLUDING.replace("nodes.inp\n", "nodes.inp\n 135, 2., 1., 1.\n")
    assert_same(plain, read(tmp_path, text, "including.inp"))
    (tmp_path / "rows.txt").write_text(" left, 2, 3\n")
    text = FLAT.replace(" left, 1, 3", "*INCLUDE, INPUT=rows.txt\n left, 1")
    assert_same(plain, read(tmp_path, text))


def test_coordinates_in_other_systems(tmp_path):
    system = "*SYSTEM\n 5., 0., 0., 5., 1., 0.\n 4., 0., 0.\n"
    plain, moved = read(tmp_path, FLAT).points, read(tmp_path, system + FLAT, "moved.inp").points
    np.testing.assert_allclose(moved, np.stack([5 - plain[:, 1], plain[:, 0], plain[:, 2]], axis=1), atol=1e-15)
    node = "*NODE, SYSTEM=C\n 1, 2., 90., 3.\n*NODE, SYSTEM=S\n 2, 2., 0., 90.\n"
    points = read(tmp_path, node).points
    np.testing.assert_allclose(points, [[0, 2, 3], [0, 0, 2]], atol=1e-15)


def test_later_steps_replace_conditions_of_earlier_steps(tmp_path):
    more = "*STEP\n*BOUNDARY\n 30, 1, 1, 0.5\n left, 1, 1, -0.5\n*END STEP\n"
    file = read(tmp_path, FLAT + more)
    at: dict[tuple[int, int], set[float]] = {}
    for constraint in file.constraints:
        for direction, value in zip(constraint.directions, constraint.displacement, strict=True):
            for node in ids_of(file, constraint.node_set):
                at.setdefault((node, direction), set()).add(float(value))
    assert all(len(values) == 1 for values in at.values())
    assert at[30, 0] == {0.5}
    assert at[35, 0] == {0.25}
    assert at[10, 0] == {-0.5}
    assert at[10, 1] == {0.0}
    assert any("several steps; those of the last step count" in remark for remark in file.remarks)
    assert not any("several steps" in remark for remark in read(tmp_path, FLAT).remarks)  # held first, then moved
    new = read(tmp_path, FLAT + more.replace("*BOUNDARY", "*BOUNDARY, OP=NEW"))
    assert {c.displacement for c in new.constraints} == {(0.5,), (-0.5,)}


def test_nodes_one_by_one_are_one_constraint(tmp_path):
    rows = "".join(f" {node}, 3, 3, {0.01 * node}\n" for node in (130, 30, 35))
    file = read(tmp_path, FLAT.replace(" right, 1, 1, 0.25\n", rows))
    (moved,) = [c for c in file.constraints if c.node_set != "left"]
    (values,) = moved.displacement
    np.testing.assert_array_equal(values, 0.01 * file.node_ids[file.node_sets[moved.node_set]])


# ------------------------------------------------------------ unsupported content


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("*BOUNDARY\n left", "*CONTACT PAIR, INTERACTION=a\n top, top\n*BOUNDARY\n left", "line 33: *CONTACT PAIR"),
        ("*STEP", "*EQUATION\n 2\n 10,1,1.,20,1,-1.\n*STEP", "line 35: *EQUATION"),
        ("*STEP", "*MPC\n TIE, 10, 20\n*STEP", "*MPC"),
        ("right, 1, 1, 0.25", "right, 1, 1, 0.25\n*BOUNDARY, TYPE=VELOCITY\n right, 2, 2, 1.", "TYPE=VELOCITY"),
        ("*NSET, NSET=left", "*ELEMENT, TYPE=C3D4\n 99, 10, 20, 25, 120\n*NSET, NSET=left", "C3D4"),
        (
            "*NSET, NSET=left",
            "*ELEMENT, TYPE=S4, ELSET=skin\n 99, 10, 20, 25, 15\n*SHELL SECTION, ELSET=skin, MATERIAL=brain\n .1\n"
            "*NSET, NSET=left",
            "1 elements of type S4",
        ),
        (FLAT[len(INCLUDED) :], f"*ELEMENT, TYPE=C3D20R\n 1{', 10' * 20}\n", "C3D20R"),
        (FLAT[len(INCLUDED) :], "*ELEMENT, TYPE=CPS4R\n 1, 10, 20, 25, 15\n", "its elements are CPS4R (line 17)"),
    ],
)
def test_unsupported_mechanics_are_refused_with_name_and_line(tmp_path, old, new, words):
    path = tmp_path / "deck.inp"
    path.write_text(FLAT.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        meshes.read_mesh(MeshFiles(fe=path))
    assert words in str(caught.value)


def test_faces_that_gmsh_writes_as_elements_are_node_sets(tmp_path):
    text = FLAT.replace("*NSET, NSET=left", "*ELEMENT, TYPE=CPS4, ELSET=Face1\n 99, 10, 20, 25, 15\n*NSET, NSET=left")
    (tmp_path / "deck.inp").write_text(text)
    mesh = meshes.read_mesh(MeshFiles(fe=tmp_path / "deck.inp"))
    assert mesh.node_ids[mesh.node_sets["Face1"]].tolist() == [10, 20, 15, 25]
    assert any("CPS4" in remark and "left out" in remark for remark in mesh.remarks)


def test_unsupported_laws_are_remarked(tmp_path):
    file = read(tmp_path, FLAT.replace("*ELASTIC", "*PLASTIC\n 1., 0.\n*ELASTIC"))
    assert file.materials == []
    assert any("brain has *PLASTIC" in remark and "solid" in remark for remark in file.remarks)
    file = read(tmp_path, FLAT.replace("*ELASTIC\n 3e-3, 0.49", "*HYPERELASTIC, NEO HOOKE\n 500., 0."))
    assert any("incompressible" in remark for remark in file.remarks)


# ------------------------------------------------------------ errors

WRONG = {
    "no keyword": ("1 2 3\n4 5 6\n", "is not an Abaqus deck"),
    "data first": ("1, 2.\n" + FLAT, "line 1: is not an Abaqus deck"),
    "empty": ("\n\n", "is empty"),
    "not text": ("*NODE\n1, 0\0\n", "not a text file"),
    "not a number": (FLAT.replace("20, 1., 0., 0.", "20, 1., O., 0."), "line 5: 'O.' is not a number"),
    "not finite": (FLAT.replace("20, 1., 0., 0.", "20, nan, 0., 0."), "line 5: 'nan' is not a number"),
    "too large": (FLAT.replace("20, 1., 0., 0.", "20, 1e999, 0., 0."), "line 5: '1e999' is not a finite number"),
    "too far": (FLAT.replace("20, 1., 0., 0.", "20, 1e300, 0., 0."), "node 20 has a coordinate"),
    "blanks for commas": (FLAT.replace("20, 1., 0., 0.", "20 1. 0. 0."), "line 5: '20 1. 0. 0.' is not a number"),
    "unknown node": (FLAT.replace(" 7, 10,", " 7, 11,"), "line 17: element 7 has node 11, which the file does not"),
    "no nodes in an element": (FLAT.replace("115\n 3,", "115\n 3\n 4,"), "rows that are not 9 numbers"),
    "no type": (FLAT.replace("TYPE=C3D8R, ", ""), "*ELEMENT has no TYPE="),
    "element twice": (FLAT.replace(" 3, 20, 30", " 7, 20, 30"), "element 7 is defined twice"),
    "node twice": (FLAT.replace("20, 1., 0., 0.", "20, 1., 0., 0.\n 20, 1., 0., 0.5"), "node 20 is defined twice"),
    "huge number": (FLAT.replace(" 135,", " 1000000000000000000,"), "is not between 1 and"),
    "huge range": (FLAT.replace("30, 35, 5", "1, 1000000000000"), "is not between 1 and"),
    "no range": (FLAT.replace("30, 35, 5", "35, 30, 5"), "line 23: 35, 30, 5 is no range"),
    "unknown set": (FLAT.replace(" left, 1, 3", " lift, 1, 3"), "line 34: there is no node set lift"),
    "unknown element set": (FLAT.replace("ELSET=solid, MAT", "ELSET=sold, MAT"), "there is no element set"),
    "unknown material": (FLAT.replace("MATERIAL=brain", "MATERIAL=brane"), "there is no material 'brane'"),
    "set in itself": (FLAT.replace("*SURFACE", "*NSET, NSET=a\n b\n*NSET, NSET=b\n a\n*SURFACE"), "part of itself"),
    "no degree": (FLAT.replace("left, 1, 3", "left, UX"), "'UX' is no degree of freedom"),
    "missing include": ("*INCLUDE, INPUT=gone.inp\n" + FLAT, "line 1: *INCLUDE names gone.inp"),
    "circle": ("*INCLUDE, INPUT=deck.inp\n" + FLAT, "break the circle"),
    "unknown part": (ASSEMBLY.replace("part=Cube\n", "part=Cub\n", 1), "names part Cub"),
    "copies": (FLAT.replace("*ELEMENT", "*NGEN\n 10, 20\n*ELEMENT"), "*NGEN generates nodes"),
}


@pytest.mark.parametrize("case", WRONG)
def test_errors_name_file_and_cause(tmp_path, case):
    text, words = WRONG[case]
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert words in message
    assert message.startswith(str(tmp_path / "deck.inp"))
    assert "\n" not in message


def test_repeated_nodes_at_one_place_and_unknown_members_are_remarked(tmp_path):
    text = FLAT.replace("20, 1., 0., 0.", "20, 1., 0., 0.\n 20, 1., 0., 0.").replace(
        "10, 15, 110", "10, 15, 16, 17, 110"
    )
    file = read(tmp_path, text)
    assert len(file.points) == 12
    assert any("1 nodes that are given twice" in remark for remark in file.remarks)
    assert any("set left has 2 nodes that are not there, the first 16" in remark for remark in file.remarks)


# ------------------------------------------------------------ random meshes in random notation


@st.composite
def formats(draw):
    """Notation of a deck: case, line ends, separators, comments, floats, fields in a line, blocks."""
    return {
        "case": draw(st.sampled_from([str.upper, str.lower, str.title, str])),
        "end": draw(st.sampled_from(["\n", "\r\n", " \n", "\n\n", "\n** 1, 2, 3\n"])),
        "comma": draw(st.sampled_from([",", ", ", " , ", ",\t"])),
        "equals": draw(st.sampled_from(["=", " = ", "= "])),
        "last": draw(st.sampled_from(["", ","])),
        "cut": draw(st.integers(2, 20)),
        "float": draw(st.sampled_from(["{!r}", "{:.17e}", "{:25.17g}"])),
        "blocks": draw(st.integers(1, 3)),
    }


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    shape=st.tuples(*[st.integers(1, 3)] * 3), seed=st.integers(0, 2**32 - 1), how=formats(), step=st.integers(1, 1000)
)
def test_random_meshes_in_random_notation(tmp_path, shape, seed, how, step):
    rng = np.random.default_rng(seed)
    points = grid_points(shape, (1.0, 2.0, 3.0)) + rng.uniform(-0.1, 0.1, (np.prod(np.array(shape) + 1), 3))
    cells = structured_hexahedra(shape)
    ids = rng.permutation(len(points)) * step + 1
    order = rng.permutation(len(cells))
    chosen = np.flatnonzero(rng.random(len(points)) < 0.5)

    def keyword(text: str) -> str:
        return how["case"](text.replace("=", how["equals"])) + how["end"]

    def row(*fields: object) -> str:
        words = [how["float"].format(field) if isinstance(field, float) else str(field) for field in fields]
        pieces = [words[i : i + how["cut"]] for i in range(0, len(words), how["cut"])]
        # A line that is continued ends with a comma.
        lines = [how["comma"].join(piece) for piece in pieces]
        return (",\n").join(lines) + how["last"] + how["end"]

    text = keyword("*heading")
    for part in np.array_split(np.arange(len(points)), how["blocks"]):
        text += keyword("*node")
        text += "".join(
            how["comma"].join([str(ids[i]), *(how["float"].format(x) for x in points[i].tolist())]) + how["end"]
            for i in part
        )
    for part in np.array_split(order, how["blocks"]):
        text += keyword("*element, type=c3d8, elset=grey") + "".join(row(i + 1, *ids[cells[i]]) for i in part)
    text += keyword("*nset, nset=some") + (row(*ids[chosen]) if len(chosen) else "")
    file = read(tmp_path, text)
    assert file.points.tobytes() == points.tobytes()
    np.testing.assert_array_equal(file.node_ids, ids)
    np.testing.assert_array_equal(np.concatenate([b.nodes for b in file.cells if len(b.ids)]), cells[order])
    np.testing.assert_array_equal(np.concatenate([b.ids for b in file.cells]), order + 1)
    (some,) = file.node_sets.values()
    np.testing.assert_array_equal(some, chosen)
    (grey,) = file.cell_sets.values()
    assert len(grey) == len(cells)
