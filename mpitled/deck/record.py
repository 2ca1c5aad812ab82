"""Records of decks: every value that took effect, differences between two records, and keys of models and scenes."""

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
    """Every value that took effect, defaults too, in the deck's layout and units; ready for JSON or TOML.

    Without `paths`, file names are left out: a file may have been moved and still be the same.
    """
    return _table(deck, str if paths else lambda _: None)


def _table(deck: Deck, name_of: Callable[[Path], str | None]) -> dict[str, Any]:
    """The `canonical` table with `name_of` each file; None leaves the key out."""
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
    """The deck of a `canonical` table without its geometry and motion: their files may no longer exist."""
    removed = (*GEOMETRIES, "fixed", "displaced")
    return Deck.from_table({name: section for name, section in table.items() if name not in removed}, path)


def difference(deck: Deck, earlier: dict[str, Any]) -> str:
    """The first key that affects the result and differs from an earlier `canonical` table without paths; "" if none."""
    for name, *values in differences(canonical(deck, paths=False), earlier):
        after, before = ("absent" if value is None else shown(value) for value in values)
        return f"{name} = {before}, and not {after}"
    return ""


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Keys that affect the result and differ between two `canonical` tables, with both values; None: absent."""
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
    """Whether a key defines the problem and not its numerical solution: geometry, tumour, materials and motion."""
    return name.partition(".")[0] in _PHYSICS


def model_key(deck: Deck, included: Sequence[Path] = ()) -> str:
    """What determines the model, as JSON: this program, the deck's values, and files by their SHA-256.

    `included` are files that the files of the deck include.
    """
    table = _table(deck, _digest)
    return _content({"program": program()} | {name: table[name] for name in _MODEL if name in table}, included)


def scene_key(deck: Deck, included: Sequence[Path] = ()) -> str:
    """What determines the result, whatever the program: all sections, like `model_key`."""
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
