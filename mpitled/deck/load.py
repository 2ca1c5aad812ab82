"""Load decks from TOML files: parsing, overrides, and a message of one line for an error."""

from __future__ import annotations

import difflib
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from mpitled.deck.describe import Schema, choices, expected, homes, keys_of, shorten, shown
from mpitled.deck.record import canonical
from mpitled.deck.schema import DEFAULT_LAW, GEOMETRIES, Deck
from mpitled.errors import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: Limits of a deck: size of the file, and parts of a key. The time of the parser is quadratic in the number of parts.
_MAX_BYTES, _MAX_PARTS = 1 << 18, 100
_DECIMAL_COMMA = re.compile(r"=\s*[-+]?\d+,\d+\s*(#|$)")
#: Suffixes of mesh files.
OF_MESHES = (".inp", ".k", ".key", ".dyn", ".msh", ".vtk", ".vtu", ".med", ".xdmf", ".mesh", ".bdf")
#: A dot after a part of a key, and characters that only a quoted key can have.
_DOT, _NO_KEY = re.compile(r"""[\w"'-][ \t]*\."""), re.compile(r"""[^\w"'. \t-]""")
_ABSENT = object()


def load_deck(
    path: str | Path, overrides: str | Sequence[str] = (), varied: Sequence[str] = (), place: str = "varied"
) -> Deck:
    """The scene of a TOML file, changed by one or more overrides "section.key=value". InputError for any error.

    The right side of an override is a TOML value; quotes around a string are optional. Entries of [[fixed]] and
    [[displaced]] count from 0: "fixed.0.nodes=skull". Files are relative to the deck's folder, also in overrides.
    varied: overrides of a case or variant, which are applied last. place: their name in messages.
    """
    path = Path(path)
    table = _parse(path)
    overrides = [overrides] if isinstance(overrides, str) else overrides
    given = [*(("--set", text) for text in overrides), *((place, text) for text in varied)]
    source = _Source(path, {_override(table, text, option): option for option, text in given})
    try:
        deck = Deck.from_table(table, path)
    except ValidationError as error:
        raise _refusal(error.errors(include_url=False), table, source) from None
    except RecursionError:
        raise InputError(f"{path}: has a list or section that is nested too deeply; correct the TOML") from None
    used = canonical(deck)
    for parts, reason in _conflicts(deck, used):
        value = _at(table, parts)
        value = _at(used, parts) if value is _ABSENT else value
        raise source.error(parts, reason, value) if parts else InputError(f"{path}: {reason}")
    return deck


class _Source(NamedTuple):
    """The origin of values, for messages."""

    path: Path
    overridden: Mapping[str, str]  # name of the key: "--set", or the place of a case

    def error(self, parts: Sequence[Any], reason: str, value: Any) -> InputError:
        """The error for the key with these parts. Its message names the override that is the cause, or the file."""
        name = ".".join(map(str, parts))
        # An override of a part of the value, or of the section around the key, is a cause too.
        causes = (key for key in self.overridden if f"{name}.".startswith(f"{key}.") or key.startswith(f"{name}."))
        origin = self.overridden.get(next(causes, ""), self.path)
        try:
            value = "" if value is _ABSENT else f" = {shown(value)}"
        except (RecursionError, ValueError):  # nested too deeply, or an integer of thousands of digits
            value = ""
        return InputError(" ".join(f"{origin}: {shorten(name)}{value}: {reason}".splitlines()))


def _at(table: Any, parts: Sequence[Any]) -> Any:
    """The value of a key in a table; _ABSENT if the table has no such key."""
    for part in parts:
        try:
            table = table[part]
        except (KeyError, IndexError, TypeError):
            return _ABSENT
    return table


# --- errors --------------------------------------------------------------------------------------------------------


def _refusal(errors: Sequence[Any], table: dict[str, Any], source: _Source) -> InputError:
    """The error for the first of pydantic's errors. An unknown key is first, because it may explain a missing key."""
    error = next((error for error in errors if error["type"] == "extra_forbidden"), errors[0])
    home = next((home for home in homes() if home.section == error["loc"][0]), homes()[0])
    parts = error["loc"][: home.depth]
    value, law = _at(table, parts), _at(table, (*parts[:-1], "law"))
    keys = keys_of(home.section, DEFAULT_LAW if law is _ABSENT else law)
    if error["type"] == "extra_forbidden":
        sections = () if home.section else [other.section for other in homes()[1:] if not other.law]
        return source.error(parts, _unknown(parts[-1], home.section, [*keys, *sections]), value)
    if error["type"] == "value_error":  # the parameters of a law contradict each other
        return source.error(parts, str(error["ctx"]["error"]), _ABSENT)
    if len(parts) < home.depth:
        return source.error(parts, f"is not a section; write {home.heading} above its keys", value)
    key = keys[parts[-1]]
    if value is _ABSENT:
        return source.error(parts, f"is missing; give {expected(key)}: {key['description']}", value)
    if "anyOf" in key:  # the last alternative is the number
        error = [error for error in errors if error["loc"][: len(parts)] == parts][-1]
    remedy = f"give {expected(key)}" + (f" (default {shown(key['default'])})" if "default" in key else "")
    name = ".".join(map(str, parts))
    if key.get("type") == "array" and name in source.overridden and isinstance(value, str) and "," in value:
        remedy += f", in brackets: '{name}=[{', '.join(part.strip() for part in value.split(','))}]'"
    return source.error(parts, f"{_reason(error, error['loc'][len(parts) :], key)}; {remedy}", value)


def _reason(error: Mapping[str, Any], rest: Sequence[Any], key: Schema) -> str:
    """The error in a value, or in the entry `rest` of a list, mostly with pydantic's text."""
    offered = choices(key.get("items", key))
    entry = f"entry {rest[0] + 1} " if rest and isinstance(rest[0], int) else ""
    if error["type"] in ("missing", "too_long", "too_short"):
        return "has the wrong number of entries"
    if offered and error["type"] not in ("tuple_type", "distinct"):
        near = difflib.get_close_matches(str(error["input"])[:100], map(str, offered), 1)
        return f"{entry}is not offered" + (f"; did you mean {near[0]}?" if near else "")
    return entry + str(error["msg"]).replace("Input should be", "is not").replace("valid tuple", "list").replace(
        "finite number", "number up to 1e30"
    )


def _unknown(name: str, section: str, valid: list[str]) -> str:
    """The message for an unknown key, with the nearest key or the section that has the key."""
    kind = "key" if section else "section or key"
    if near := difflib.get_close_matches(name[:100], valid, 1):
        return f"unknown {kind}; did you mean {near[0]}?"
    if headings := [home.heading or "the top of the deck" for home in homes() if name in home.keys]:
        return f"unknown {kind}; {name} belongs to {' or '.join(headings)}"
    return f"unknown {kind}; there are {', '.join(valid)}"


def _conflicts(deck: Deck, table: dict[str, Any]) -> Iterator[tuple[tuple[Any, ...], str]]:
    """Contradictions between keys: the parts of a key, or (), and the reason. table: the `canonical` table."""
    geometries = [f"[{name}]" for name in GEOMETRIES if name in table]
    if len(geometries) != 1:
        choice = ", ".join(f"[{name}]" for name in GEOMETRIES)
        yield (), f"has {' and '.join(geometries) or 'no geometry'}; give exactly one of {choice}"
    if not deck.materials and not deck.mesh:
        yield (), "has no material; give at least one [material.NAME]"
    filled = {("material", material.name, "cells"): material.cells for material in deck.materials}
    yield from _repeated(filled, "give each set of cells one material")
    if deck.labels:
        names = ("tissue", "left_ventricle", "right_ventricle")
        remedy = "name a label once; one label of both ventricles: labels.right_ventricle = []"
        yield from _repeated({("labels", name): getattr(deck.labels, name) for name in names}, remedy)
    basis, step, load_time = deck.support.basis, deck.solver.time_step, deck.solver.load_time
    if deck.support.nodes < basis:
        yield ("support", "nodes"), f"is fewer than the {basis} monomials of support.basis; give at least as many"
    if step != "auto" and step > load_time:
        yield ("solver", "time_step"), f"is longer than solver.load_time; give less than {load_time:g} s"
    if deck.tumour:
        radius = table["tumour"]["seed_radius"]
        seed_volume = 4 / 3 * math.pi * radius**3
        if table["tumour"]["volume"] < seed_volume:
            reason = f"is less than the seed's {seed_volume:.4g} mm3; give more, or a smaller tumour.seed_radius"
            yield ("tumour", "volume"), reason
        if deck.cloud.radius <= deck.tumour.seed_radius and not deck.mesh:
            yield ("cloud", "radius"), f"lies within the seed; give more than tumour.seed_radius = {radius:g} mm"
        for name in ("block", "cylinder"):
            if table.get(name, {}).get("cloud") == "none":
                yield (name, "cloud"), 'leaves no cloud in which the tumour can grow; give "core" or "all"'
    if deck.block and deck.block.fitted is not None and deck.block.fitted not in deck.sphere:
        spheres = ", ".join(deck.sphere) or "there are none"
        yield ("block", "fitted"), f"is none of the spheres ({spheres}); add [sphere.{deck.block.fitted}]"
    for i, section in enumerate(deck.displaced):
        value, directions = section.displacement, section.directions
        if value is None and section.field is None:
            reason = "is missing; give a list of numbers, in mm, or displaced.field, a CSV of points and displacements"
            yield ("displaced", i, "displacement"), reason
        if value and section.field:
            yield ("displaced", i, "field"), "cannot be combined with displacement; give one of the two"
        if value and len(value) != len(directions):
            reason = f"does not have one number for each of {shown(directions)}; give {len(directions)}, in mm"
            yield ("displaced", i, "displacement"), reason
        if section.rotation and set("xyz") - {section.axis} - set(directions):
            reason = f"turns nodes about {section.axis} that are free in a direction across it; prescribe it too"
            yield ("displaced", i, "directions"), reason


def _repeated(lists: Mapping[Any, Sequence[Any]], remedy: str) -> Iterator[tuple[tuple[str, ...], str]]:
    """Entries that are in two lists. Each list is given by the parts of its key."""
    first: dict[Any, str] = {}
    for parts, entries in lists.items():
        for entry in entries:
            if entry in first:
                yield parts, f"{entry} is in {first[entry]} already; {remedy}"
            first[entry] = ".".join(parts)


# --- TOML ----------------------------------------------------------------------------------------------------------


def _parse(path: Path) -> dict[str, Any]:
    try:
        if not path.is_file() and not path.is_dir() and path.exists():
            raise InputError(f"{path}: is a device or a pipe; give the path of a deck (TOML)")
        with path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; give the path of a deck (TOML)") from None
    if path.suffix.lower() in OF_MESHES:
        remedy = f'check it by: mpitled check {path}; a deck computes it by: [mesh] fe = "{path.name}"'
        raise InputError(f"{path}: is a mesh; {remedy}")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError(f"{path}: line {line}: is not UTF-8 text; a deck is a TOML file in UTF-8") from None
    parts = (len(_DOT.findall(piece)) for piece in _NO_KEY.split(text))
    if len(content) > _MAX_BYTES or max(parts) > _MAX_PARTS:
        raise InputError(f"{path}: is not a deck; a deck has less than {_MAX_BYTES} bytes and keys of few parts")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: {_syntax(text, error)}; correct the TOML") from None


def _syntax(text: str, error: Exception) -> str:
    """Number of the line, the parser's message, and the line."""
    message, line = str(error), re.search(r"(?: \(at )?line (\d+)", str(error))
    if not line:
        return message
    erroneous = shorten(" ".join(text.split("\n")[int(line[1]) - 1].split()))
    point = " (decimals come after a point)" if _DECIMAL_COMMA.search(erroneous) else ""
    return f"line {line[1]}: {message[: line.start()]}{point}: {erroneous}"


def _override(table: dict[str, Any], text: str, option: str) -> str:
    """Enter "section.key=value" into the table of the deck and return the name of the key."""
    name, equals, value = (part.strip() for part in text.partition("="))
    parts, origin = name.split("."), f"{option} {' '.join(text.splitlines())}"
    if not equals or not all(parts) or len(parts) > _MAX_PARTS:
        raise InputError(f"{origin}: is not section.key=value; write for example --set tumour.volume=523.6")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):
        if value[:1] in {"", '"', "'", "[", "{"}:
            raise InputError(f"{origin}: the value is not TOML; check quotes and brackets") from None
        parsed = value
    inner: Any = table
    for depth, part in enumerate(parts):
        listed = isinstance(inner, list)
        if listed and not (part.isdecimal() and int(part) < len(inner)):
            raise InputError(f"{origin}: the deck has {len(inner)} [[{'.'.join(parts[:depth])}]]; count them from 0")
        at: Any = int(part) if listed else part
        if depth == len(parts) - 1:
            inner[at] = parsed
        elif not isinstance(inner[at] if listed else inner.get(at), dict | list):
            inner[at] = {}
        inner = inner[at]
    return name


def keys(path: Path | None = None) -> dict[str, list[str]]:
    """Every "section.key" for `--set`, with the values of enumerations.

    A readable deck adds the keys of its repeated and named sections, and omits the keys of other geometries.
    """
    try:
        table = _parse(path) if path else {}
    except InputError:
        table = {}
    completions: dict[str, list[str]] = {}
    for home in homes()[1:]:
        inner = table.get(home.section, {})
        if table and home.section in GEOMETRIES and not inner:
            continue
        names = list(range(len(inner))) if isinstance(inner, list) else list(inner)
        if home.law:
            laws = (home.law, _ABSENT) if home.law == DEFAULT_LAW else (home.law,)
            names = [name for name in names if _at(inner, (name, "law")) in laws]
        prefixes = [home.section] if home.depth == 2 else [f"{home.section}.{name}" for name in names]
        completions |= {f"{prefix}.{name}": _values(key) for prefix in prefixes for name, key in home.keys.items()}
    return completions


def _values(key: Schema) -> list[str]:
    """The values of an enumeration for `--set`."""
    if "anyOf" in key:
        return [value for option in key["anyOf"] for value in _values(option)]
    return ["true", "false"] if key.get("type") == "boolean" else [str(choice) for choice in choices(key)]
