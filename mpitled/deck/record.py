"""Records of decks: all effective values, differences between two records, and keys of models and scenes."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mpitled.deck.describe import shown
from mpitled.deck.schema import GEOMETRIES, Deck, Section, from_si
from mpitled.laws import Law

_PHYSICS = (*GEOMETRIES, "tumour", "sphere", "material", "fixed", "displaced")
#: Sections on which the model depends.
_MODEL = (*_PHYSICS, "cloud", "support", "hexahedra")
#: Keys without influence on the result.
COSMETIC_KEYS = ("title", "output.pictures", "output.checkpoint_minutes")


def canonical(deck: Deck, *, paths: bool = True) -> dict[str, Any]:
    """All effective values, including defaults, in the deck's layout and units, for JSON or TOML.

    Without `paths`, file names are omitted, because a file may have been moved without a change.
    """
    return _table(deck, str if paths else lambda _: None)


def _table(deck: Deck, name_of: Callable[[Path], str | None]) -> dict[str, Any]:
    """The `canonical` table with the result of `name_of` for each file; the key is omitted if it is None."""
    table: dict[str, Any] = _plain(deck, name_of)
    return {name: value for name, value in table.items() if value not in ([], {})}


def _plain(value: Any, name_of: Callable[[Path], str | None], unit: str = "") -> Any:
    if isinstance(value, Section):
        keys = [name for name, field in type(value).model_fields.items() if not field.validation_alias]
        table = {name: _plain(getattr(value, name), name_of, value.unit_of(name)) for name in keys}
        table |= table.pop("law", {})
        return {name: inner for name, inner in table.items() if inner is not None}
    if isinstance(value, Law):
        return {"law": value.name, **value.model_dump()}
    if isinstance(value, dict):
        return {name: _plain(inner, name_of) for name, inner in value.items()}
    if isinstance(value, tuple):
        return [_plain(inner, name_of, unit) for inner in value]
    return name_of(value) if isinstance(value, Path) else from_si(value, unit)


def recorded(table: Mapping[str, Any], path: Path) -> Deck:
    """The deck of a `canonical` table without geometry and prescribed nodes. Their files may not exist any more."""
    removed = (*GEOMETRIES, "fixed", "displaced")
    return Deck.from_table({name: section for name, section in table.items() if name not in removed}, path)


def difference(deck: Deck, earlier: dict[str, Any]) -> str:
    """The first difference that affects the result from an earlier `canonical` table without paths; "" if none."""
    for name, *values in differences(canonical(deck, paths=False), earlier):
        after, before = ("absent" if value is None else shown(value) for value in values)
        return f"{name} = {before}, and not {after}"
    return ""


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Keys that affect the result and differ between two `canonical` tables, with both values. None: absent."""
    first, second = dict(flat(one)), dict(flat(other))
    for name in dict.fromkeys([*second, *first]):
        if name not in COSMETIC_KEYS and first.get(name) != second.get(name):
            yield name, first.get(name), second.get(name)


def flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Full names and values of all keys of a `canonical` table."""
    if isinstance(value, dict):
        for part, inner in value.items():
            yield from flat(inner, f"{name}.{part}" if name else part)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for i, inner in enumerate(value):
            yield from flat(inner, f"{name}.{i}")
    else:
        yield name, value


def changes_physics(name: str) -> bool:
    """Whether a key defines the problem (geometry, tumour, materials, prescribed nodes), not its numerical solution."""
    return name.partition(".")[0] in _PHYSICS


def model_key(deck: Deck, included: Sequence[Path] = ()) -> str:
    """The input of the model as JSON: this program, the deck's values, and files by their SHA-256.

    `included` are files that the files of the deck include.
    """
    table = _table(deck, _digest)
    return _content({"program": program()} | {name: table[name] for name in _MODEL if name in table}, included)


def scene_key(deck: Deck, included: Sequence[Path] = ()) -> str:
    """The input of the result as JSON, without the program: all sections, in the form of `model_key`."""
    table = _table(deck, _digest)
    del table["title"], table["output"]["checkpoint_minutes"]
    return _content(table, included)


def _content(table: dict[str, Any], included: Sequence[Path]) -> str:
    return json.dumps(table | {"included": [_digest(path) for path in included]}, separators=(",", ":"))


@functools.cache
def program() -> str:
    """The SHA-256 of this program's sources: another version may build another model."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return f"sha256:{digest.hexdigest()}"


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return f"sha256:{digest.hexdigest()}"
