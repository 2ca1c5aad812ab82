"""TOML text of values and decks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import tomlkit


def value(given: Any) -> str:
    """A number, a truth value, a string, or a list of these."""
    return tomlkit.item(given).as_string()


def lines(table: Mapping[str, Any]) -> list[str]:
    """The lines of a deck that `deck.canonical` returned."""
    return tomlkit.dumps(table).split("\n")
