"""Decks as TOML text."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any


def value(given: Any) -> str:
    """A number, a truth value, a string, or a list of such."""
    if isinstance(given, list | tuple):
        return f"[{', '.join(map(value, given))}]"
    # JSON's strings, numbers and truth values are TOML's too.
    return json.dumps(given, ensure_ascii=False)


def lines(table: Mapping[str, Any], heading: str = "") -> Iterator[str]:
    """A deck as `deck.canonical` tells it: its keys, then the sections below it, each under its heading."""
    yield from (f"{key} = {value(given)}" for key, given in table.items() if not _sections(given))
    for key, given in table.items():
        name = f"{heading}.{_name(key)}" if heading else _name(key)
        if isinstance(given, Mapping):
            if any(not isinstance(inner, Mapping) for inner in given.values()):
                yield from ("", f"[{name}]")
            yield from lines(given, name)
        elif _sections(given):
            for entry in given:
                yield from ("", f"[[{name}]]", *lines(entry, name))


def _sections(given: Any) -> bool:
    return isinstance(given, Mapping) or (isinstance(given, list) and bool(given) and isinstance(given[0], Mapping))


def _name(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else value(key)
