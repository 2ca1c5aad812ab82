"""LS-DYNA decks: fixed columns of every width, commas, parameters, sets, constraints, and errors with file and line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from decks import DYNA, DYNA_COMMAS, FLAT
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_abaqus import assert_same, ids_of
from test_abaqus import read as read_named

from mpitled.deck import MeshFiles
from mpitled.errors import InputError
from mpitled.mesh import grid_points, structured_hexahedra
from mpitled.readers import meshes
from mpitled.readers.meshfile import MeshFile


def read(folder: Path, text: str, name: str = "deck.k") -> MeshFile:
    return read_named(folder, text, name)


def widened(width: int) -> str:
    """DYNA in the long format (width 20), or with ten columns for all numbers of nodes and elements (I10)."""
    lines, keyword = [], ""
    for line in DYNA_COMMAS.splitlines():
        keyword = line if line.startswith("*") else keyword
        fields, widths = line.split(","), [width] * 10
        if keyword == "*NODE":
            widths[1:4] = [max(16, width)] * 3
        if keyword == "*DEFINE_CURVE" and len(fields) == 2:
            widths[:2] = [20, 20]
        lines.append(
            "".join(f"{field:>{w}}" for field, w in zip(fields, widths, strict=False)) if "," in line else line
        )
    return "\n".join(lines).replace("*KEYWORD", {20: "*KEYWORD LONG=Y", 10: "*KEYWORD I10=Y"}[width]) + "\n"


WRITTEN = {
    "commas": DYNA_COMMAS,
    "long": widened(20),
    "I10": widened(10),
    "small letters": "\n".join(line.lower() if line[:1] == "*" else line for line in DYNA.splitlines()) + "\n",
    "CRLF": DYNA.replace("\n", "\r\n"),
    "no comments": re.sub(r"(?m)^\$.*\n", "", DYNA),
    "more comments": DYNA.replace("\n", "\n$ 1 2 3\n"),
    "Fortran's exponents": DYNA.replace("1e-9", "1.-9")
    .replace("3e-3", "3.-3")
    .replace("             1.0", "           .1+01"),
    "a line for the part": re.sub(r"(?m)^( +[73] +1)((?: +\d+){8})$", r"\1\n\2", DYNA),
    "held in *NODE": re.sub(
        r"(?m)^( +(?:10|15|110|115)(?: +[01]\.0){3})( +0 +0)?$", r"\1       7       0", DYNA
    ).replace("*BOUNDARY_SPC_SET_ID", "*TITLE"),
    "node by node": DYNA[: DYNA.index("*BOUNDARY_SPC")]
    + "*BOUNDARY_SPC_NODE\n"
    + "".join(f"{node:10d}{0:10d}{1:10d}{1:10d}{1:10d}\n" for node in (10, 15, 110, 115))
    + DYNA[DYNA.index("*BOUNDARY_PRESCRIBED") :],
    "general set": DYNA.replace("*SET_NODE_LIST_TITLE", "*SET_NODE_GENERAL_TITLE").replace(
        "        10        15       110       115\n", "NODE              10        15\nNODE             110       115\n"
    ),
}


@pytest.mark.parametrize("how", WRITTEN)
def test_every_notation_gives_the_same_model(tmp_path, how):
    """It is also the model of the Abaqus deck: nodes, elements, sets, constraints and materials."""
    plain, other = read(tmp_path, DYNA), read(tmp_path, WRITTEN[how], "other.k")
    if how == "node by node":  # four constraints on one node each
        assert sorted(
            node for c in other.constraints if c.directions == (0, 1, 2) for node in ids_of(other, c.node_set)
        ) == [10, 15, 110, 115]
        return
    assert_same(plain, other)
    abaqus = read(tmp_path, FLAT, "deck.inp")
    assert abaqus.points.tobytes() == other.points.tobytes()
    for name in ("left", "right"):
        assert ids_of(abaqus, name) == ids_of(other, name)
    moved = {(c.node_set, c.directions, c.displacement) for c in other.constraints}
    assert moved == {(c.node_set, c.directions, c.displacement) for c in abaqus.constraints}
    assert [(m.youngs_modulus, m.poissons_ratio, m.density) for _, m in other.materials] == [(3e-3, 0.49, 1e-9)]


def test_includes_with_the_rest_of_the_deck(tmp_path):
    (tmp_path / "deeper").mkdir()
    (tmp_path / "deeper" / "meshfile.k").write_text(DYNA[: DYNA.index("*PART")] + "*END\n")
    text = "*KEYWORD\n*INCLUDE_PATH\ndeeper\n*INCLUDE\nmesh +\nfile.k\n" + DYNA[DYNA.index("*PART") :]
    assert_same(read(tmp_path, DYNA), read(tmp_path, text, "including.k"))


def test_degenerate_solids_get_their_kind(tmp_path):
    """All in the unit cube: volumes 1/6 (tetrahedron), 1/2 (wedge) and 1/3 (pyramid)."""
    rows = {"tetrahedron": [15, 10, 20, 110] + [110] * 4, "wedge": [10, 20, 25, 15, 110, 110, 115, 115],
            "pyramid": [10, 20, 25, 15] + [110] * 4, "hexahedron": [10, 20, 25, 15, 110, 120, 125, 115]}  # fmt: skip
    volumes = {"tetrahedron": 1 / 6, "wedge": 1 / 2, "pyramid": 1 / 3, "hexahedron": 1.0}
    for kind, nodes in rows.items():
        solid = f"{7:8d}{1:8d}" + "".join(f"{node:8d}" for node in nodes)
        text = re.sub(r"(?m)^ +7 +1 .*\n +3 +1 .*$", solid, DYNA)
        file = read(tmp_path, text)
        (block,) = file.cells
        assert block.kind == kind
        section = MeshFiles(efg=file.path)
        mesh = meshes.assemble(section, None, file)
        assert mesh.integration_volumes == pytest.approx([volumes[kind]], rel=1e-14)


def test_parts_are_cell_sets_with_their_materials(tmp_path):
    text = DYNA.replace("       3       1      20", "       3       2      20").replace(
        "*SECTION", "*PART\n\n         2         1         9\n*SECTION"
    )
    file = read(tmp_path, text + "*SET_PART_LIST\n")
    assert file.cell_sets["solid"].tolist() == [0]
    assert file.cell_sets["part 2"].tolist() == [1]
    assert [cells for cells, _ in file.materials] == ["solid"]
    assert any("material 9 of part 2 is not in the deck" in remark for remark in file.remarks)


def test_the_curve_and_its_scale_give_the_displacement(tmp_path):
    text = DYNA.replace("                 1.0                 1.0\n", "                 1.0                 4.0\n")
    text = text.replace(
        "         5         0       1.0       1.0       0.0       0.0",
        "         5         0       1.0       2.0       0.0       1.0",
    )
    (moved,) = [c for c in read(tmp_path, text).constraints if c.node_set == "right"]
    assert moved.displacement == (0.25 * 2 * (4 + 1),)


SPC = "         1         0         1         1         1"
MOTION = "         2         1         2         5      0.25"
WRONG = {
    "no keyword": ("1 2 3\n", "is not an LS-DYNA deck"),
    "not a number": (DYNA.replace("20             1.0", "20             1.O"), "line 10: '1.O' is not a number"),
    "unknown node": (DYNA.replace("       7       1      10", "       7       1      11"), "element 7 has node 11"),
    "huge number": (DYNA_COMMAS.replace("135,", "4999999999999,"), "is not between 1 and"),
    "huge range": (DYNA.replace("        30        35", "         19999999999"), "is no range of numbers"),
    "unknown set": (DYNA.replace(SPC, "         4" + SPC[10:]), "there is no node set 4"),
    "unknown curve": (DYNA.replace(MOTION, MOTION.replace("5      0.25", "6      0.25")), "there is no curve 6"),
    "unknown parameter": (DYNA.replace("&young", "&junge"), "there is no parameter &junge"),
    "local system": (DYNA.replace(SPC, SPC.replace("1         0", "1         3", 1)), "in a local system"),
    "missing include": (DYNA.replace("*PART", "*INCLUDE\ngone.k\n*PART"), "*INCLUDE names gone.k"),
    "circle": (DYNA.replace("*PART", "*INCLUDE\ndeck.k\n*PART"), "break the circle"),
    "moved copies": (DYNA.replace("*PART", "*INCLUDE_TRANSFORM\nx.k\n*PART"), "*INCLUDE_TRANSFORM is not read"),
    "half an element": (
        re.sub(r"(?m)^( +[73] +1)((?: +\d+){8})$", r"\1\n\2", DYNA).replace(
            "\n      20      30      35      25     120     130     135     125", ""
        ),
        "the last row of *ELEMENT_SOLID is not complete",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_errors_name_file_and_cause(tmp_path, case):
    text, words = WRONG[case]
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / "deck.k"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("*CONTACT_AUTOMATIC_SINGLE_SURFACE\n         1\n", "*CONTACT_AUTOMATIC_SINGLE_SURFACE changes the mechanics"),
        ("*RIGIDWALL_PLANAR\n         0\n", "*RIGIDWALL_PLANAR"),
        ("*BOUNDARY_PRESCRIBED_MOTION_SET\n         2         2         0         5\n", "DOF 2 and VAD 0"),
        ("*CONSTRAINED_NODE_SET\n         1\n", "*CONSTRAINED_NODE_SET"),
    ],
)
def test_unsupported_mechanics_are_refused_with_name_and_line(tmp_path, more, words):
    path = tmp_path / "deck.k"
    path.write_text(DYNA.replace("*PART\n", more + "*PART\n"))
    with pytest.raises(InputError) as caught:
        meshes.read_mesh(MeshFiles(fe=path))
    assert words in str(caught.value)
    assert "line 2" in str(caught.value)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    shape=st.tuples(*[st.integers(1, 3)] * 3),
    seed=st.integers(0, 2**32 - 1),
    layout=st.sampled_from(["standard", "i10", "long", "commas"]),
    end=st.sampled_from(["\n", "\r\n", "\n$ 1 2\n", "   \n"]),
    two_lines=st.booleans(),
    step=st.integers(1, 10_000),
)
def test_random_meshes_in_random_notation(tmp_path, shape, seed, layout, end, two_lines, step):
    rng = np.random.default_rng(seed)
    points = grid_points(shape, (1.0, 2.0, 3.0))
    points += rng.uniform(-0.1, 0.1, points.shape)
    points = np.array([[float(f"{x:.9e}") for x in row] for row in points])  # sixteen columns hold these digits
    cells, ids = structured_hexahedra(shape), rng.permutation(len(points)) * step + 1
    width = {"standard": 8, "i10": 10, "long": 20, "commas": 0}[layout]

    def line(integers: list[int], reals: list[float] = []) -> str:  # noqa: B006
        if layout == "commas":
            return ",".join([*map(str, integers), *(f"{x:.9e}" for x in reals)]) + end
        return "".join(f"{n:{width}d}" for n in integers) + "".join(f"{x:{max(16, width)}.9e}" for x in reals) + end

    text = {"standard": "*KEYWORD", "i10": "*KEYWORD I10=Y", "long": "*KEYWORD LONG=Y", "commas": "*KEYWORD"}[layout]
    text += end + "*NODE" + end
    text += "".join(line([int(number)], row) for number, row in zip(ids, points.tolist(), strict=True))
    text += "*ELEMENT_SOLID" + end
    for i, nodes in enumerate(ids[cells].tolist(), 1):
        text += line([i, 3]) + line(nodes) if two_lines else line([i, 3, *nodes])
    file = read(tmp_path, text)
    assert file.points.tobytes() == points.tobytes()
    np.testing.assert_array_equal(file.node_ids, ids)
    np.testing.assert_array_equal(file.cells[0].nodes, cells)
    assert len(file.cell_sets["part 3"]) == len(cells)
