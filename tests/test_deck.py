"""Decks: every mistake gets one line with place, key, value and remedy; what is right is SI, and can be read again."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import re
import sys
import typing

import pytest
from conftest import ROOT
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mpitled import deck as decks
from mpitled.deck import canonical, load_deck, markdown_table, model_key
from mpitled.errors import InputError
from mpitled.toml import lines

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

BLOCK = {
    "block": {"size": [30.0, 24.0, 24.0], "elements": [10, 8, 8], "cloud": "core"},
    "material": {"brain": {"youngs_modulus": 3000.0, "poissons_ratio": 0.49}},
}
#: A deck in which every section that a block can have is there.
FULL = {
    **BLOCK,
    "title": "all sections",
    "tumour": {"centre": [15.0, 12.0, 12.0], "volume": 523.6},
    "support": {"nodes": 20},
    "fixed": [{"nodes": "x0"}, {"nodes": "y0", "directions": ["y"]}],
    "displaced": [{"nodes": "x1", "displacement": [6.0, -0.1, 0.0]}],
}
HEAD = {"labels": {"image": "head.nii.gz"}, "material": BLOCK["material"]}


def toml(value, top=True):
    """A TOML document of plain values; sections below the first level are inline tables, which read as the same."""
    if isinstance(value, dict):
        pairs = [f"{name} = {toml(inner, False)}" for name, inner in value.items()]
        return "\n".join(pairs) + "\n" if top else f"{{{', '.join(pairs)}}}"
    if isinstance(value, list):
        return f"[{', '.join(toml(inner, False) for inner in value)}]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value, ensure_ascii=False)


def write(folder, content):
    path = folder / "scene.toml"
    path.write_text(content if isinstance(content, str) else toml(content), encoding="utf-8")
    return path


def changed(content, name, value):
    """The deck with the key `name` ("fixed.0.nodes") set, or taken out if the value is None."""
    content = copy.deepcopy(content)
    *way, last = (int(step) if step.isdecimal() else step for step in name.split("."))
    place = content
    for step in way:
        place = place[step] if isinstance(step, int) else place.setdefault(step, {})
    if value is None:
        del place[last]
    else:
        place[last] = value
    return content


def complaint(path, *overrides):
    with pytest.raises(InputError) as error:
        load_deck(path, overrides)
    message = str(error.value)
    assert "\n" not in message
    return message


# ------------------------------------------------------------ one wrong key


#: Deck, key, wrong value, and words that the line must have: what to give, and nearest key or choice.
WRONG = [
    # impossible values
    (BLOCK, "material.brain.poissons_ratio", 0.5, "is not below 0.5; give a number above -1 and below 0.5"),
    (BLOCK, "material.brain.poissons_ratio", -1, "above -1"),
    (BLOCK, "material.brain.youngs_modulus", 0.0, "is not above 0; give a number above 0, in Pa"),
    (BLOCK, "material.brain.youngs_modulus", -3000.0, "above 0, in Pa"),
    (BLOCK, "material.brain.density", -1.0, "a number above 0, in kg/m3 (default 1000)"),
    (BLOCK, "material.brain.youngs_modulus", math.inf, "is not a finite number"),
    (BLOCK, "material.brain.youngs_modulus", math.nan, "is not a finite number"),
    (BLOCK, "block.size", [30.0, 0.0, 24.0], "entry 2 is not above 0; give a list of 3 numbers above 0, in mm"),
    (BLOCK, "block.elements", [10, 8, 0], "entry 3 is not at least 1; give a list of 3 integers at least 1"),
    (BLOCK, "block.elements", [10, 8, 2**40], "entry 3 is too large an integer"),
    (BLOCK, "block.core_share", 1.0, "above 0 and below 1 (default 0.5)"),
    (FULL, "tumour.volume", -523.6, "a number above 0, in mm3"),
    (FULL, "tumour.volume", 33.5, "less than the seed's 33.51 mm3; give more, or a smaller tumour.seed_radius"),
    (FULL, "tumour.seed_radius", 5.1, None),
    (FULL, "cloud.radius", 2.0, "lies within the seed; give more than tumour.seed_radius = 2 mm"),
    (FULL, "cloud.seed", -1, "an integer at least 0 (default 0)"),
    (FULL, "support.nodes", 3, "an integer at least 4 (default 20)"),
    (FULL, "support.min_domains", 0, "at least 1"),
    (FULL, "block.cloud", "none", 'leaves a tumour no cloud to grow in; give "core" or "all"'),
    (FULL, "solver.time_step", 0.0, '"auto" or a number above 0, in s (default "auto")'),
    (FULL, "solver.time_step", 2.5, "is longer than solver.load_time; give less than 2 s"),
    (FULL, "solver.safety", 1.1, "at most 1"),
    (FULL, "displaced.0.displacement", [6.0], "one number for each of"),
    (FULL, "material.csf", {"youngs_modulus": 10.0, "poissons_ratio": 0.1}, None),
    (HEAD, "labels.image", "foot.nii.gz", "there is no file"),
    (HEAD, "labels.image", "", "is empty; give a path"),
    (HEAD, "labels.left_ventricle", [1], "label 1 is in labels.tissue already; give each label one place"),
    (HEAD, "labels.element_size", -4, "a number above 0, in mm (default 4)"),
    # wrong types
    (BLOCK, "block.size", 30.0, "is a number, not a list; give a list of 3 numbers"),
    (BLOCK, "block.size", [30.0, 24.0], "has 2 entries; give a list of 3 numbers"),
    (BLOCK, "block.size", [30.0, "24", 24.0], "entry 2 is a string"),
    (BLOCK, "block.elements", [10, 8.0, 8], "entry 2 is a number; give a list of 3 integers"),
    (BLOCK, "block.elements", [10, True, 8], "entry 2 is true or false"),
    (BLOCK, "material.brain.youngs_modulus", "soft", "is a string; give a number"),
    (BLOCK, "material.brain.youngs_modulus", [3000.0], "is a list; give a number"),
    (BLOCK, "material.brain.youngs_modulus", {"value": 3000.0}, "is a section; give a number"),
    (BLOCK, "material.brain.youngs_modulus", True, "is true or false; give a number"),
    (BLOCK, "material.brain.cells", "tissue", 'is a string, not a list; give a list of strings (default ["all"])'),
    (BLOCK, "material.brain.cells", [], "has 0 entries"),
    (BLOCK, "material.brain.cells", ["all", "all"], "has an entry twice"),
    (BLOCK, "support.consistency", 1, "is an integer; give true or false (default true)"),
    (BLOCK, "support.nodes", 8.0, "is a number; give an integer"),
    (BLOCK, "support.weight", "gauss", 'is not offered; give "equal" or "quartic" (default "quartic")'),
    (BLOCK, "support.weight", "quartik", "did you mean quartic?"),
    (BLOCK, "support.basis", 7, "is not offered; give 4 or 10 or 20 (default 4)"),
    (BLOCK, "support.basis", 4.0, "is not offered"),
    (BLOCK, "block.cloud", "cor", "did you mean core?"),
    (BLOCK, "title", 3, "is an integer; give a string"),
    (FULL, "fixed.0.directions", ["x", "w"], "entry 2 is not offered"),
    (FULL, "fixed.1.directions", ["y", "y"], "has an entry twice"),
    # sections that are none, and keys out of place
    (BLOCK, "support", 8, "is a value, not a section; write [support] above its keys"),
    (BLOCK, "material", 3000.0, "is not a section; write [material.NAME] above its keys"),
    (BLOCK, "material.poissons_ratio", 0.49, "belongs to one material by its name; write [material.NAME] above it"),
    (BLOCK, "fixed", {"nodes": "x0"}, "there can be several; write [[fixed]] instead of [fixed]"),
    # unknown names, with the nearest that there is
    (BLOCK, "blok", {"size": [1.0, 1.0, 1.0]}, "unknown section or key; did you mean block?"),
    (BLOCK, "block.elemnts", [10, 8, 8], "unknown key; did you mean elements?"),
    (BLOCK, "material.brain.young_modulus", 3000.0, "unknown key; did you mean youngs_modulus?"),
    (FULL, "fixed.0.node", "x1", "unknown key; did you mean nodes?"),
    (BLOCK, "block.density", 1000.0, "unknown key; density belongs to [material.NAME]"),
    (BLOCK, "poissons_ratio", 0.49, "unknown section or key; poissons_ratio belongs to [material.NAME]"),
    (BLOCK, "output.zzz", 1, "unknown key; there are frames"),
]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "head.nii.gz").write_bytes(b"read by the mesher only")
    return tmp_path


@pytest.mark.parametrize(("content", "name", "value", "words"), [case for case in WRONG if case[3]])
@pytest.mark.parametrize("where", ["file", "--set"])
def test_a_wrong_value_gets_one_line_with_place_key_value_and_remedy(folder, content, name, value, words, where):
    if where == "file":
        path, overrides = write(folder, changed(content, name, value)), []
    else:
        path, overrides = write(folder, content), [f"{name}={toml(value, False)}"]
    message = complaint(path, *overrides)
    # A value that is a section may be shown by its entry that is wrong.
    place = f"{path if where == 'file' else '--set'}: {name}"
    assert message.startswith(place)
    assert words in message
    assert re.match(r" = \S", message[len(place) :])
    if isinstance(value, str | bool | int):
        assert message.startswith(f"{place} = {toml(value, False)}: ")
    elif isinstance(value, float):
        assert message.startswith(f"{place} = {value:g}: ")


def test_keys_that_clash_are_both_named(folder):
    message = complaint(write(folder, changed(FULL, "tumour.seed_radius", 5.1)))
    assert "tumour.volume = 523.6" in message
    assert "tumour.seed_radius" in message
    message = complaint(write(folder, changed(BLOCK, "material.csf", BLOCK["material"]["brain"])))
    assert 'material.csf.cells = ["all"]: all is filled by material.brain already' in message
    message = complaint(write(folder, changed(changed(BLOCK, "support.nodes", 12), "support.basis", 20)))
    assert "support.nodes = 12: is fewer than the 20 monomials of support.basis" in message


@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        (BLOCK, "block.size", "give a list of 3 numbers above 0, in mm: edges along x, y, z"),
        (BLOCK, "material.brain.poissons_ratio", "give a number above -1 and below 0.5: Poisson's ratio, nu"),
        (FULL, "tumour.centre", "give a list of 3 numbers, in mm"),
        (FULL, "fixed.1.nodes", "give a string: name of a node set"),
        (FULL, "displaced.0.displacement", "give a list of numbers, in mm"),
        (HEAD, "labels.image", "give a path"),
    ],
)
def test_a_missing_key_is_named_with_what_to_give(folder, content, name, words):
    path = write(folder, changed(content, name, None))
    message = complaint(path)
    assert message.startswith(f"{path}: {name}: is missing; ")
    assert words in message


def test_exactly_one_geometry_and_at_least_one_material(folder):
    path = write(folder, {**BLOCK, **HEAD})
    assert f"{path}: has [labels] and [block]; give exactly one of [labels], [block]" in complaint(path)
    path = write(folder, {"material": BLOCK["material"]})
    assert f"{path}: has no geometry; give exactly one of [labels], [block]" in complaint(path)
    assert f"{path}: has no geometry" in complaint(write(folder, ""))
    path = write(folder, {"block": BLOCK["block"]})
    assert f"{path}: has no material; give at least one [material.NAME]" in complaint(path)


# ------------------------------------------------------------ files that are no decks


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("title = 'one'\n[block\nsize = 1\n", 2),
        ("title = 'one'\n\nsize = 1 mm\n", 3),
        ("title = 'one'\ntitle = 'two'\n", 2),
        ("[block]\n[block]\n", 2),
        ("# a\u2028line to some\n\n\nsize = 1 mm\n", 4),
        ("[block]\nsize = [1, 2\n", None),
    ],
)
def test_bad_toml_is_named_with_its_line(tmp_path, text, line):
    path = write(tmp_path, text)
    message = complaint(path)
    assert message.startswith(f"{path}: ")
    assert message.endswith("; correct the TOML")
    if line is None:
        assert "Unclosed array (at end of document)" in message
    else:
        assert message.startswith(f"{path}: line {line}: ")
        assert message.endswith(f": {text.splitlines()[line - 1]}; correct the TOML") or "\u2028" in text
        assert "to some" not in message


def test_what_a_parser_says_is_whole(tmp_path):
    assert "line 1: Invalid statement: = 1; " in complaint(write(tmp_path, "= 1\n"))
    message = complaint(write(tmp_path, "[tumour]\nvolume = 523,6\n"))
    assert "after a statement (decimals come after a point): volume = 523,6; " in message


def test_a_mesh_is_no_deck(tmp_path):
    path = tmp_path / "fe.inp"
    path.write_text("*NODE\n")
    assert complaint(path) == (
        f'{path}: is a mesh; check it by: mpitled check {path}; a deck computes it by: [mesh] fe = "fe.inp"'
    )


def test_bytes_that_are_no_text_are_named_with_their_line(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_bytes('# Größe\n\ntitle = "'.encode() + "Größe".encode("latin-1") + b'"\n')
    assert complaint(path) == f"{path}: line 3: is not UTF-8 text; a deck is a TOML file in UTF-8"
    path.write_bytes(bytes(range(256)))
    assert complaint(path).startswith(f"{path}: ")
    # A byte order mark is what some editors write.
    path.write_bytes(b"\xef\xbb\xbf" + toml(BLOCK).encode())
    assert load_deck(path).block is not None


def test_a_file_that_is_not_there_is_named(tmp_path):
    path = tmp_path / "none.toml"
    assert complaint(path) == f"{path}: No such file or directory; give the path of a deck (TOML)"
    assert complaint(tmp_path).startswith(f"{tmp_path}: Is a directory; ")


@settings(max_examples=200, deadline=None)
@given(text=st.text(alphabet="[]{}=.,\"'#\n\\ abn1-:_é\t\x00\u2028", max_size=40))
@example(text='"a\\nb" = 1')
@example(text='material."a\\nb".cells = 1')
@example(text="solver.load_time\n= [\n1")
def test_no_text_gets_anything_else_than_one_line(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_text(text, encoding="utf-8")
    assert complaint(path).startswith(f"{path}: ")
    path.write_text(toml(FULL), encoding="utf-8")
    complaint(path, text)


# ------------------------------------------------------------ overrides


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("solver.load_time", "is not section.key=value; write for example --set "),
        ("=2.0", "is not section.key=value"),
        ("solver..load_time=2.0", "is not section.key=value"),
        ("solver.load_time=", "the value is not TOML"),
        ("block.size=[1.0, 2.0", "the value is not TOML; check quotes and brackets"),
        ('title="one', "the value is not TOML"),
        ("fixed.2.nodes=x1", "the deck has 2 [[fixed]]; count them from 0"),
        ("fixed.-1.nodes=x1", "the deck has 2 [[fixed]]; count them from 0"),
        ("fixed.nodes=x1", "the deck has 2 [[fixed]]; count them from 0"),
        ("title.x=1", "title is a value, not a section; leave out .x"),
        ("block.size.3=1.0", "the deck has 3 [[block.size]]; count them from 0"),
    ],
)
def test_overrides_that_cannot_be_read(folder, text, words):
    message = complaint(write(folder, FULL), text)
    assert message.startswith(f"--set {text}: ")
    assert words in message


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("block.size.1=-24.0", "block.size"),
        ('displaced.0={nodes = "x1"}', "displaced.0.displacement"),
        ("block={size = [1, 2, 3], elements = [1, 1, 0]}", "block.elements"),
        ("fixed=[{nodes = 3}]", "fixed.0.nodes"),
    ],
)
def test_an_override_is_to_blame_for_what_is_in_it_or_around_it(folder, text, name):
    assert complaint(write(folder, FULL), text).startswith(f"--set: {name}")
    # Not for what the file has wrong beside it.
    path = write(folder, changed(BLOCK, "block.elements", [10, 8, 0]))
    assert complaint(path, "block.size.1=24.0").startswith(f"{path}: block.elements")


def test_a_list_without_brackets_is_shown_with_them(folder):
    message = complaint(write(folder, FULL), "tumour.centre=1,2, 3")
    assert message.startswith(
        '--set: tumour.centre = "1,2, 3": is a string, not a list; give a list of 3 numbers, in mm'
    )
    assert message.endswith("'tumour.centre=[1, 2, 3]'")


def test_an_entry_of_a_list_can_be_overridden(folder):
    assert load_deck(write(folder, FULL), ["block.size.1=25"]).block.size == (0.03, 0.025, 0.024)


def test_overrides_change_what_the_file_says(folder):
    path = write(folder, FULL)
    deck = load_deck(
        path,
        [
            "title=without quotes",
            'block.cloud = "all"',
            "tumour.volume=4188.8",
            "fixed.1.nodes=z0",
            'displaced.0={nodes = "x1", displacement = [1], directions = ["x"]}',
            "solver.time_step=1e-4",
            "output.frames=2",  # a section that the file has not
            "output.frames=3",  # the last one counts
        ],
    )
    assert deck.title == "without quotes"
    assert deck.block.cloud == "all"
    assert deck.tumour.volume == 4188.8 / 1e9
    assert [held.nodes for held in deck.fixed] == ["x0", "z0"]
    assert deck.displaced[0].displacement == (0.001,)
    assert (deck.solver.time_step, deck.output.frames) == (1e-4, 3)
    assert load_deck(path).title == "all sections"


def test_files_are_relative_to_the_deck(folder, monkeypatch):
    path = write(folder, HEAD)
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    assert load_deck("../scene.toml").labels.image.samefile(folder / "head.nii.gz")
    (folder / "other.nii").write_bytes(b"")
    assert load_deck(path, ["labels.image=other.nii"]).labels.image == folder / "other.nii"


# ------------------------------------------------------------ what a deck means


def test_units_are_si_inside_and_defaults_take_effect(folder):
    deck = load_deck(write(folder, FULL))
    assert deck.block.size == (0.03, 0.024, 0.024)
    assert deck.tumour.volume == 523.6 / 1e9
    assert deck.tumour.seed_radius == 0.002
    assert deck.displaced[0].displacement == (0.006, -0.0001, 0.0)
    assert deck.materials[0].material.youngs_modulus == 3000.0
    assert deck.materials[0].density == 1000.0
    assert deck.materials[0].cells == ("all",)
    # The paper's: m = 4, at most 7 FE nodes, R_hg = 0.04 / 9. Its n = 8 and equal weights are in its own deck.
    support = load_deck(write(folder, BLOCK)).support
    assert (support.nodes, support.basis, support.weight, support.max_fe_nodes) == (20, 4, "quartic", 19)
    assert deck.hexahedra.hourglass == 0.04 / 9
    held, partly, moved = deck.constraints()
    assert (held.node_set, held.directions, held.displacement) == ("x0", (0, 1, 2), (0.0,) * 3)
    assert (partly.directions, partly.displacement) == ((1,), (0.0,))
    assert (moved.directions, moved.displacement) == ((0, 1, 2), deck.displaced[0].displacement)
    assert moved.origin == f"{deck.path}: displaced.0.nodes"


def test_integers_are_numbers_and_materials_keep_their_order(folder):
    whole = changed(changed(BLOCK, "block.size", [30, 24, 24]), "material.brain.youngs_modulus", 3000)
    assert load_deck(write(folder, whole)) == load_deck(write(folder, BLOCK))
    stiff = {"youngs_modulus": 1.0, "poissons_ratio": 0, "cells": ["cloud"]}
    deck = load_deck(write(folder, changed(BLOCK, "material.a", stiff)))
    assert [section.name for section in deck.materials] == ["brain", "a"]


DECIMALS = st.builds(lambda digits, power: float(f"{digits}e{power}"), st.integers(1, 10**15 - 1), st.integers(-20, 3))
NUMBERS = st.floats(1e-3, 1e6)


@settings(max_examples=100, deadline=None)
@given(
    size=st.lists(DECIMALS | NUMBERS, min_size=3, max_size=3),
    moved=st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3),
    added=DECIMALS | NUMBERS,
    title=st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), max_size=8),
    modulus=NUMBERS,
    ratio=st.floats(-1, 0.5, exclude_min=True, exclude_max=True),
    nodes=st.integers(10, 30),
    consistency=st.booleans(),
)
def test_a_canonical_deck_reads_as_the_same_deck(
    tmp_path_factory, size, moved, added, title, modulus, ratio, nodes, consistency
):
    folder = tmp_path_factory.getbasetemp()
    content = copy.deepcopy(FULL)
    content["title"] = title
    content["block"]["size"] = size
    content["tumour"]["volume"] = 34.0 + added
    content["displaced"][0]["displacement"] = moved
    content["material"]["brain"] = {"youngs_modulus": modulus, "poissons_ratio": ratio}
    content["support"] = {"nodes": nodes, "basis": 10, "consistency": consistency}
    deck = load_deck(write(folder, content))
    assert deck.block.size == tuple(edge / 1e3 for edge in size)
    written = canonical(deck)
    # What the user wrote in at most 15 digits is what the report shows.
    for given_edge, edge in zip(size, written["block"]["size"], strict=True):
        assert edge == given_edge or float(f"{given_edge:.15g}") != given_edge
    for again in (written, json.loads(json.dumps(written))):
        reread = load_deck(write(folder, "\n".join(lines(again))))
        assert reread == deck
        assert canonical(reread) == written
        assert model_key(reread) == model_key(deck)


@pytest.mark.parametrize("path", sorted((ROOT / "jobs").rglob("*.toml")), ids=lambda path: path.stem)
def test_shipped_decks_load(path):
    assert load_deck(path).title


# ------------------------------------------------------------ the model's key


def leaves(table, name=""):
    """Names and values of all keys; lists of sections count their entries."""
    for written, value in table.items() if isinstance(table, dict) else enumerate(table):
        full = f"{name}.{written}" if name else str(written)
        if isinstance(value, dict) or (isinstance(value, list) and isinstance(value[0], dict)):
            yield from leaves(value, full)
        else:
            yield full, value


#: Values for keys that hold a word: the first that the deck takes in place of its own.
WORDS = ["recover", "single", "quartic", "equal", "quasi-static", "centre", "all", "mm", "x", "dynamic", "other"]


def others(value):
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, 10]
    if isinstance(value, float):
        return [value * 0.999 + 1e-3]
    if isinstance(value, str):
        return [word for word in WORDS if word != value] + [1e-3, 3]
    return [[other, *value[1:]] for other in others(value[0])] + [value[:-1], value[::-1]]


def test_the_models_key_changes_exactly_with_what_the_model_depends_on(folder):
    path = write(folder, FULL)
    content, key = canonical(load_deck(path)), model_key(load_deck(path))
    seen, unchangeable = {key}, []
    for name, value in leaves(content):
        for other in others(value):
            try:
                deck = load_deck(write(folder, changed(content, name, other)))
            except InputError:
                continue
            if name.split(".")[0] in ("title", "solver", "output", "partition"):
                assert model_key(deck) == key, name
            else:
                assert model_key(deck) not in seen, name
                seen.add(model_key(deck))
            break
        else:
            unchangeable.append(name)
    assert len(seen) > 30
    assert not unchangeable


def test_the_models_key_follows_the_contents_of_files_and_not_their_names(folder):
    path = write(folder, HEAD)
    key = model_key(load_deck(path))
    (folder / "deeper").mkdir()
    copied = folder / "deeper" / "copy.nii.gz"
    copied.write_bytes((folder / "head.nii.gz").read_bytes())
    other = folder / "deeper" / "other.toml"
    other.write_text(toml(changed(HEAD, "labels.image", "copy.nii.gz")))
    assert model_key(load_deck(other)) == key
    copied.write_bytes(copied.read_bytes() + b".")
    assert model_key(load_deck(other)) != key
    assert str(folder) not in key
    assert model_key(load_deck(path)) == key


# ------------------------------------------------------------ the table


def declared():
    """Keys of each section, as the classes have them: the top first."""
    hints = typing.get_type_hints(decks.Deck)
    top = [f.name for f in dataclasses.fields(decks.Deck) if not inner(hints[f.name]) and f.name != "path"]
    sections = [cls for f in dataclasses.fields(decks.Deck) for cls in inner(hints[f.name])]
    return [top, *([f.name for f in dataclasses.fields(cls) if f.name != "name"] for cls in sections)]


def inner(hint):
    return [cls for cls in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(cls)]


def test_the_table_has_every_key_with_meaning_and_default(folder):
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in markdown_table().splitlines()]
    assert rows[0] == ["key", "value", "unit", "default", "meaning"]
    assert all(len(row) == 5 for row in rows)
    found, homes, defaults = [[]], [""], {}
    for name, value, _, default, meaning in rows[2:]:
        assert meaning
        if name.startswith("**"):
            found.append([])
            homes.append(re.sub(r"[*`\[\]]|\.NAME", "", name))
            continue
        assert value
        found[-1].append(name.strip("`"))
        defaults[f"{homes[-1]}.{found[-1][-1]}"] = default
    assert found == declared()
    # The defaults are those that take effect.
    for name, value in leaves(canonical(load_deck(write(folder, BLOCK)))):
        if name.split(".")[0] not in BLOCK:
            shown = tomllib.loads(f"value = {defaults[name if '.' in name else f'.{name}'].strip('`')}")["value"]
            assert shown == (pytest.approx(value, rel=1e-9) if isinstance(value, float) else value), name
    assert defaults["material.poissons_ratio"] == defaults["block.size"] == "required"
