"""Decks: each mistake gets one line with key, value and remedy; values are SI and can be read again."""

from __future__ import annotations

import copy
import json
import math
import subprocess
import sys

import jsonschema
import pytest
from conftest import ENVIRONMENT, ROOT
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mpitled.deck import canonical, json_schema, keys, load_deck, markdown_table, model_key
from mpitled.deck.record import flat
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
    """A TOML document of plain values, with inline tables below the first level."""
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
    """The deck with another value of the key `name` ("fixed.0.nodes"); without the key if the value is None."""
    content = copy.deepcopy(content)
    *parts, last = (int(part) if part.isdecimal() else part for part in name.split("."))
    table = content
    for part in parts:
        table = table[part] if isinstance(part, int) else table.setdefault(part, {})
    if value is None:
        del table[last]
    else:
        table[last] = value
    return content


def complaint(path, *overrides):
    with pytest.raises(InputError) as error:
        load_deck(path, overrides)
    message = str(error.value)
    assert "\n" not in message
    return message


# ------------------------------------------------------------ one wrong key


#: Deck, key, wrong value, and a part of the message: the error, the remedy, the nearest key or choice.
WRONG = [
    # impossible values
    (BLOCK, "material.brain.poissons_ratio", 0.5, "not less than 0.5; give a number above -1 and below 0.5"),
    (BLOCK, "material.brain.youngs_modulus", math.nan, "give a number above 0, in Pa"),
    (BLOCK, "material.brain.youngs_modulus", 1e31, "not a number up to 1e30; give a number above 0, in Pa"),
    (BLOCK, "material.brain.youngs_modulus", 10**400, "give a number above 0, in Pa"),
    (BLOCK, "material.brain.youngs_modulus", 1e-31, "not greater than 0"),
    (BLOCK, "material.brain.density", -1.0, "a number above 0, in kg/m3 (default 1000.0)"),
    (BLOCK, "block.size", [30.0, 0.0, 24.0], "entry 2 is not greater than 0; give a list of 3 numbers above 0, in mm"),
    (BLOCK, "block.elements", [10, 8, 0], "entry 3 is not greater than or equal to 1; give a list of 3 integers"),
    (BLOCK, "block.elements", [10, 8, 2**40], "entry 3 is not less than"),
    (BLOCK, "block.fitted", "cyst", "is none of the spheres (there are none); add [sphere.cyst]"),
    (FULL, "tumour.volume", 33.5, "less than the seed's 33.51 mm3; give more, or a smaller tumour.seed_radius"),
    (FULL, "cloud.radius", 2.0, "lies within the seed; give more than tumour.seed_radius = 2 mm"),
    (FULL, "block.cloud", "none", 'give "core" or "all"'),
    (FULL, "solver.time_step", 0.0, 'give "auto" or a number above 0, in s (default "auto")'),
    (FULL, "solver.time_step", 2.5, "is longer than solver.load_time; give less than 2 s"),
    (FULL, "displaced.0.displacement", [6.0], "one number for each of"),
    (FULL, "displaced.0.rotation", 361, "a number at least -360 and at most 360, in degrees (default 0.0)"),
    (HEAD, "labels.image", "", "give a path relative to the deck's folder"),
    (HEAD, "labels.left_ventricle", [1], "1 is in labels.tissue already; name a label once"),
    # wrong types, which are not converted
    (BLOCK, "block.size", 30.0, "is not a list; give a list of 3 numbers above 0, in mm"),
    (BLOCK, "block.size", [30.0, "24", 24.0], "entry 2 is not a valid number"),
    (BLOCK, "material.brain.youngs_modulus", "3000", "is not a valid number; give a number"),
    (BLOCK, "material.brain.youngs_modulus", True, "is not a valid number; give a number"),
    (BLOCK, "material.brain.cells", [], "wrong number of entries"),
    (BLOCK, "material.brain.cells", ["all", "all"], "has an entry twice"),
    (BLOCK, "material.brain.law", "neo-hooke", "is not offered; did you mean neo-hookean?"),
    (BLOCK, "support.consistency", 1, "give true or false (default true)"),
    (BLOCK, "support.weight", "quartik", 'did you mean quartic?; give "equal" or "quartic" (default "quartic")'),
    # values instead of sections
    (BLOCK, "support", 8, "is not a section; write [support] above its keys"),
    (BLOCK, "material.poissons_ratio", 0.49, "is not a section; write [material.NAME] above its keys"),
    (BLOCK, "fixed", {"nodes": "x0"}, "is not a section; write [[fixed]] above its keys"),
    # unknown names, with the nearest known name
    (BLOCK, "blok", {"size": [1.0, 1.0, 1.0]}, "unknown section or key; did you mean block?"),
    (BLOCK, "material.brain.young_modulus", 3000.0, "unknown key; did you mean youngs_modulus?"),
    (BLOCK, "block.density", 1000.0, "unknown key; density belongs to [material.NAME]"),
    (BLOCK, "poissons_ratio", 0.49, 'poissons_ratio belongs to [material.NAME] law = "neo-hookean"'),
]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "head.nii.gz").write_bytes(b"only the mesher reads it")
    return tmp_path


@pytest.mark.parametrize(("content", "name", "value", "words"), WRONG)
@pytest.mark.parametrize("where", ["file", "--set"])
def test_a_wrong_value_gets_one_line_with_key_value_and_remedy(folder, content, name, value, words, where):
    if where == "file":
        path, overrides = write(folder, changed(content, name, value)), []
    else:
        path, overrides = write(folder, content), [f"{name}={toml(value, False)}"]
    message = complaint(path, *overrides)
    start = f"{path if where == 'file' else '--set'}: {name} = "
    assert message.startswith(f"{start}{json.dumps(value)[:50]}")
    assert words in message


@pytest.mark.parametrize(
    ("content", "name", "value", "words"),
    [
        (FULL, "tumour.seed_radius", 5.1, "tumour.volume = 523.6: is less than the seed's"),
        (BLOCK, "material.csf", BLOCK["material"]["brain"], 'material.csf.cells = ["all"]: all is in material.brain.'),
        (BLOCK, "support", {"nodes": 12, "basis": 20}, "support.nodes = 12: is fewer than the 20 monomials"),
        (FULL, "displaced.0", {"nodes": "x1"}, "displaced.0.displacement: is missing; give a list of numbers, in mm"),
        (FULL, "displaced.0.field", "head.nii.gz", "cannot be combined with displacement; give one of the two"),
        (FULL, "displaced.0.directions", ["x"], "does not have one number for each of"),
        (BLOCK, "displaced", [{"nodes": "x", "displacement": [1], "directions": ["x"], "rotation": 9}],
         'displaced.0.directions = ["x"]: turns nodes about z that are free in a direction across it'),
        (BLOCK, "labels", HEAD["labels"], "has [labels] and [block]; give exactly one of [labels], [block]"),
        (BLOCK, "block", None, "has no geometry; give exactly one of [labels], [block]"),
        (BLOCK, "material", None, "has no material; give at least one [material.NAME]"),
        (BLOCK, "block.size", None, "is missing; give a list of 3 numbers above 0, in mm: edges along x, y, z"),
        (BLOCK, "material.brain.poissons_ratio", None, "give a number above -1 and below 0.5: Poisson's ratio, nu"),
        (FULL, "fixed.1.nodes", None, "fixed.1.nodes: is missing; give a string: name of a node set"),
        (HEAD, "labels.image", None, "labels.image: is missing; give a path"),
    ],
)  # fmt: skip
def test_missing_and_contradictory_keys(folder, content, name, value, words):
    path = write(folder, changed(content, name, value))
    message = complaint(path)
    assert message.startswith(f"{path}: ")
    assert words in message


# ------------------------------------------------------------ files that are not decks


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("title = 'one'\n[block\nsize = 1\n", "line 2: "),
        ("title = 'one'\n\nsize = 1 mm\n", "line 3: Expected newline or end of document after a statement: size = 1"),
        ("title = 'one'\ntitle = 'two'\n", "line 2: "),
        ("# a\u2028line\n\n\nsize = 1 mm\n", "line 4: "),
        ("[block]\nsize = [1, 2\n", "Unclosed array"),
        ("[tumour]\nvolume = 523,6\n", "(decimals come after a point): volume = 523,6; correct the TOML"),
        (f"{'a.' * 150}b = 1", "is not a deck"),
        (f"a = {'[' * 2000}", "correct the TOML"),
        ("[mesh]\nx = 0x" + "f" * 9000, "mesh.x: unknown key"),
    ],
)  # fmt: skip
def test_bad_toml_is_named_with_its_line(tmp_path, text, words):
    path = write(tmp_path, text)
    message = complaint(path)
    assert message.startswith(f"{path}: ")
    assert words in message


def test_files_that_are_not_decks(tmp_path):
    path = tmp_path / "fe.inp"
    path.write_text("*NODE\n")
    assert complaint(path).startswith(f"{path}: is a mesh; check it by: mpitled check {path}; ")
    path = tmp_path / "scene.toml"
    assert complaint(path) == f"{path}: No such file or directory; give the path of a deck (TOML)"
    assert complaint(tmp_path).startswith(f"{tmp_path}: Is a directory; ")
    path.write_bytes('# Größe\n\ntitle = "'.encode() + "Größe".encode("latin-1") + b'"\n')
    assert complaint(path) == f"{path}: line 3: is not UTF-8 text; a deck is a TOML file in UTF-8"
    path.write_bytes(b"\xef\xbb\xbf" + toml(BLOCK).encode())  # some editors write a byte order mark
    assert load_deck(path).block is not None


@settings(max_examples=200, deadline=None)
@given(text=st.text(alphabet="[]{}=.,\"'#\n\\ abn1-:_é\t\x00\u2028", max_size=40))
@example(text='"a\\nb" = 1')
@example(text='material."a\\nb".cells = 1')
@example(text="solver.load_time\n= [\n1")
@example(text="x" + ".x" * 5000 + "=1")
def test_every_text_gets_one_line(tmp_path_factory, text):
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
        ("solver..load_time=2.0", "is not section.key=value"),
        ("solver.load_time=", "the value is not TOML"),
        ("block.size=[1.0, 2.0", "the value is not TOML; check quotes and brackets"),
        ("fixed.2.nodes=x1", "the deck has 2 [[fixed]]; count them from 0"),
        ("fixed.-1.nodes=x1", "the deck has 2 [[fixed]]; count them from 0"),
        ("block.size.3=1.0", "the deck has 3 [[block.size]]; count them from 0"),
    ],
)
def test_overrides_that_cannot_be_read(folder, text, words):
    message = complaint(write(folder, FULL), text)
    assert message.startswith(f"--set {text}: ")
    assert words in message


def test_messages_name_the_override_that_causes_an_error(folder):
    path = write(folder, FULL)
    for text, name in (
        ("block.size.1=-24.0", "block.size"),
        ('displaced.0={nodes = "x1"}', "displaced.0.displacement"),
        ("fixed=[{nodes = 3}]", "fixed.0.nodes"),
        ("title.x.1.y=1", "title"),
    ):
        assert complaint(path, text).startswith(f"--set: {name}")
    message = complaint(path, "tumour.centre=1,2, 3")
    assert message.startswith('--set: tumour.centre = "1,2, 3": is not a list; give a list of 3 numbers, in mm')
    assert message.endswith("'tumour.centre=[1, 2, 3]'")
    # The file is the cause of a wrong value in the file.
    path = write(folder, changed(BLOCK, "block.elements", [10, 8, 0]))
    assert complaint(path, "block.size.1=24.0").startswith(f"{path}: block.elements")


def test_overrides_change_the_deck(folder):
    path = write(folder, FULL)
    deck = load_deck(
        path,
        [
            "title=without quotes",
            'block.cloud = "all"',
            "block.size.1=25",
            "fixed.1.nodes=z0",
            'displaced.0={nodes = "x1", displacement = [1], directions = ["x"]}',
            "output.frames=2",  # of a section that is not in the file
            "output.frames=3",  # the last one counts
        ],
        ["solver.time_step=1e-4"],
    )
    assert (deck.title, deck.block.cloud, deck.block.size) == ("without quotes", "all", (0.03, 0.025, 0.024))
    assert [held.nodes for held in deck.fixed] == ["x0", "z0"]
    assert deck.displaced[0].displacement == (0.001,)
    assert (deck.solver.time_step, deck.output.frames) == (1e-4, 3)
    assert load_deck(path).title == "all sections"


def test_files_are_relative_to_the_deck(folder, monkeypatch):
    path = write(folder, HEAD)
    (folder / "elsewhere").mkdir()
    monkeypatch.chdir(folder / "elsewhere")
    assert load_deck("../scene.toml").labels.image.samefile(folder / "head.nii.gz")
    (folder / "other.nii").write_bytes(b"")
    assert load_deck(path, ["labels.image=other.nii"]).labels.image == folder / "other.nii"


# ------------------------------------------------------------ values


def test_values_are_si_and_defaults_take_effect(folder):
    deck = load_deck(write(folder, changed(FULL, "displaced.0.rotation", 180)))
    assert deck.block.size == (0.03, 0.024, 0.024)
    assert (deck.tumour.volume, deck.tumour.seed_radius) == (523.6 / 1e9, 0.002)
    assert deck.displaced[0].displacement == (0.006, -0.0001, 0.0)
    material = deck.materials[0].material
    assert (material.name, material.law.youngs_modulus, material.density) == ("brain", 3000.0, 1000.0)
    assert deck.materials[0].cells == ("all",)
    # The paper's: m = 4, R_hg = 0.04 / 9.
    assert (deck.support.nodes, deck.support.basis, deck.hexahedra.hourglass) == (20, 4, 0.04 / 9)
    held, partly, moved = deck.constraints()
    assert (held.node_set, held.directions, held.displacement) == ("x0", (0, 1, 2), (0.0,) * 3)
    assert (partly.directions, partly.displacement) == ((1,), (0.0,))
    assert (moved.displacement, moved.rotation.angle) == (deck.displaced[0].displacement, pytest.approx(math.pi))
    assert moved.origin == f"{deck.path}: displaced.0.nodes"
    # Integers are numbers, and materials keep their order.
    integers = changed(changed(BLOCK, "block.size", [30, 24, 24]), "material.brain.youngs_modulus", 3000)
    assert load_deck(write(folder, integers)) == load_deck(write(folder, BLOCK))
    deck = load_deck(write(folder, changed(BLOCK, "material.a", {**BLOCK["material"]["brain"], "cells": ["cloud"]})))
    assert [section.name for section in deck.materials] == ["brain", "a"]


DECIMALS = st.builds(lambda digits, power: float(f"{digits}e{power}"), st.integers(1, 10**15 - 1), st.integers(-20, 3))
NUMBERS = st.floats(1e-3, 1e6)


@settings(max_examples=100, deadline=None)
@given(
    size=st.lists(DECIMALS | NUMBERS, min_size=3, max_size=3),
    moved=st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3),
    added=DECIMALS | NUMBERS,
    text=st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), max_size=8),
    modulus=NUMBERS,
    ratio=st.floats(-1, 0.5, exclude_min=True, exclude_max=True),
    angle=st.floats(-360, 360),
)
def test_a_canonical_deck_reads_as_the_same_deck(tmp_path_factory, size, moved, added, text, modulus, ratio, angle):
    folder = tmp_path_factory.getbasetemp()
    content = copy.deepcopy(FULL)
    content["title"] = text
    content["block"]["size"] = size
    content["tumour"]["volume"] = 34.0 + added
    content["displaced"][0] |= {"displacement": moved, "rotation": angle}
    content["material"] = {json.dumps(text, ensure_ascii=False): {"youngs_modulus": modulus, "poissons_ratio": ratio}}
    deck = load_deck(write(folder, content))
    assert deck.block.size == tuple(edge / 1e3 for edge in size)
    written = canonical(deck)
    # The report shows the digits of the deck if they are at most 15.
    for given_edge, edge in zip(size, written["block"]["size"], strict=True):
        assert edge == given_edge or float(f"{given_edge:.15g}") != given_edge
    for again in (written, json.loads(json.dumps(written))):
        reread = load_deck(write(folder, "\n".join(lines(again))))
        assert reread == deck
        assert canonical(reread) == written
        assert model_key(reread) == model_key(deck)


# ------------------------------------------------------------ the model's key

#: Values for keys with a word: the first that the deck accepts replaces the word.
WORDS = ["recover", "single", "quartic", "equal", "quasi-static", "centre", "all", "mm", "x", "dynamic", "other"]


def alternatives(value):
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, 10]
    if isinstance(value, float):
        return [value * 0.999 + 1e-3]
    if isinstance(value, str):
        return [word for word in WORDS if word != value] + [1e-3, 3]
    return [[other, *value[1:]] for other in alternatives(value[0])] + [value[:-1], value[::-1]]


def test_the_models_key_changes_exactly_with_the_input_of_the_model(folder):
    path = write(folder, FULL)
    content, key = canonical(load_deck(path)), model_key(load_deck(path))
    seen, unchangeable = {key}, []
    for name, value in flat(content):
        for other in alternatives(value):
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
    assert unchangeable == ["material.brain.law"]  # another law has other parameters


def test_the_models_key_depends_on_contents_and_not_names_of_files(folder):
    path = write(folder, HEAD)
    key = model_key(load_deck(path))
    (folder / "deeper").mkdir()
    copied = folder / "deeper" / "copy.nii.gz"
    copied.write_bytes((folder / "head.nii.gz").read_bytes())
    other = folder / "deeper" / "other.toml"
    other.write_text(toml(changed(HEAD, "labels.image", "copy.nii.gz")))
    assert model_key(load_deck(other)) == key
    assert str(folder) not in key
    copied.write_bytes(copied.read_bytes() + b".")
    assert model_key(load_deck(other)) != key


# ------------------------------------------------------------ the schema


@pytest.mark.parametrize("path", sorted((ROOT / "jobs").rglob("*.toml")), ids=lambda path: path.stem)
def test_shipped_decks_load_and_fit_the_json_schema(path):
    deck = load_deck(path)
    assert deck.title
    validator = jsonschema.Draft7Validator(json_schema())
    validator.validate(tomllib.loads(path.read_text(encoding="utf-8")))
    validator.validate(canonical(deck))


def test_the_json_schema_refuses_wrong_values_of_single_keys():
    schema = json_schema()
    jsonschema.Draft7Validator.check_schema(schema)
    assert schema["definitions"]["Block"]["properties"]["size"]["description"] == "edges along x, y, z, in mm"
    assert schema["definitions"]["Tumour"]["properties"]["seed_radius"]["default"] == 2.0
    validator = jsonschema.Draft7Validator(schema)
    assert validator.is_valid(FULL)
    for content, name, value, words in WRONG:
        if any(word in words for word in ("unknown", "offered", "a list;", "not greater", "not less", "number;")):
            assert value == 1e-31 or not validator.is_valid(changed(content, name, value)), name


def test_table_and_completions_have_every_key_and_its_default(folder):
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in markdown_table().splitlines()]
    assert all(len(row) == 5 and row[4] for row in rows[2:])
    defaults, home = {}, ""
    for name, value, _, default, _ in rows[2:]:
        if name.startswith("**"):
            home = name.strip("*`").partition(" ")[0].strip("[]").removesuffix(".NAME") + "."
        else:
            assert value
            defaults[home + name.strip("`")] = default
    for name, value in flat(canonical(load_deck(write(folder, BLOCK)))):
        if name.split(".")[0] not in BLOCK:
            assert tomllib.loads(f"value = {defaults[name].strip('`')}")["value"] == value, name
    assert defaults["material.poissons_ratio"] == defaults["block.size"] == "required"
    repeated = ("title", "sphere", "material", "fixed", "displaced")
    assert set(keys()) == {name for name in defaults if name.split(".")[0] not in repeated}
    known = keys(write(folder, FULL))
    assert {"fixed.1.nodes", "material.brain.youngs_modulus", "tumour.volume"} < set(known)
    assert not [name for name in known if name.startswith("labels.")]
    assert (known["support.consistency"], known["solver.time_step"]) == (["true", "false"], ["auto"])


#: Registers a law before the deck is imported.
NEW_LAW = """
import sys
from pathlib import Path
from typing import ClassVar
from mpitled import laws
from mpitled.laws.law import parameter

class Stiffening(laws.Law):
    'A law of a test.'
    name: ClassVar[str] = "stiffening"
    modulus: float = parameter("Initial modulus, a", "Pa", gt=0)
    exponent: float = parameter("Exponent, b", ge=1, le=9)

laws.LAWS["stiffening"] = Stiffening
from mpitled.deck import canonical, json_schema, keys, load_deck, markdown_table
from mpitled.errors import InputError
path = Path(sys.argv[1])
text = path.read_text()

def message(parameters):
    path.write_text(f"{text}[material.x]\\ncells = ['a']\\nlaw = 'stiffening'\\n{parameters}")
    try:
        return load_deck(path)
    except InputError as error:
        return str(error).partition(": material.x.")[2]

deck = message("modulus = 30\\nexponent = 2.5")
assert deck.materials[1].material.law == Stiffening(modulus=30.0, exponent=2.5)
assert canonical(deck)["material"]["x"]["exponent"] == 2.5
assert "material.x.exponent" in keys(path) and "material.brain.exponent" not in keys(path)
for parameters, words in (
    ("modulus = -1.0\\nexponent = 2.0", "modulus = -1.0: is not greater than 0; give a number above 0, in Pa"),
    ("modulus = 1e31\\nexponent = 2.0", "modulus = 1e+31: is not a number up to 1e30; give a number above 0, in Pa"),
    ("modulus = 1.0", "exponent: is missing; give a number at least 1 and at most 9: Exponent, b"),
    ("modulus = 1.0\\nexponnt = 2.0", "exponnt = 2.0: unknown key; did you mean exponent?"),
    ("poissons_ratio = 0", 'poissons_ratio = 0: unknown key; poissons_ratio belongs to [material.NAME] law = "neo'),
):
    assert message(parameters).startswith(words), message(parameters)
assert '| **`[material.NAME] law = "stiffening"`** | | | | A law of a test. |' in markdown_table()
assert "| `modulus` | a number above 0 | Pa | required | Initial modulus, a |" in markdown_table()
variant = json_schema()["definitions"]["MaterialSection"]["anyOf"][-1]
assert variant["properties"]["modulus"]["description"] == "Initial modulus, a, in Pa"
assert sorted(variant["required"]) == ["exponent", "law", "modulus"]
"""


def test_a_new_law_needs_no_change_of_the_deck(folder):
    path = write(folder, "\n".join(lines(BLOCK)))
    subprocess.run([sys.executable, "-c", NEW_LAW, path], env=ENVIRONMENT, cwd=ROOT, timeout=120, check=True)
