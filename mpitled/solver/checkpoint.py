"""Checkpoints: whether there is one that a run can go on from, what goes into it, and what comes out of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from mpitled import __version__, store
from mpitled import deck as decks
from mpitled.deck import Deck
from mpitled.errors import InputError
from mpitled.parallel.halo import World
from mpitled.parallel.subdomain import Subdomain
from mpitled.solver.restart import Memory, Packed, Parts, pack, unpack


class Found(NamedTuple):
    """A whole checkpoint of the run."""

    path: Path
    told: dict[str, Any]
    damaged: str  # what is wrong with the one that it stands in for; "" if it is the last


def marks(deck: Deck, model_key: str) -> dict[str, Any]:
    """What tells runs from each other: a run goes on from what has the same marks."""
    return {
        "version": __version__,
        "program": decks.program(),
        "deck": json.loads(json.dumps(decks.canonical(deck, paths=False))),
        "model": hashlib.sha256(model_key.encode()).hexdigest(),
    }


def find(directory: Path, deck: Deck, model_key: str) -> Found | None:
    """The last whole checkpoint in a directory, or None; InputError if it is another run's, or none is whole."""
    damaged: list[str] = []
    found = newest(directory, damaged)
    if found and (what := other(found.told, deck, model_key)):
        raise InputError(f"{found.path}: {what}; put that back, or remove the file to begin anew")
    if damaged and not found:
        raise InputError(f"{'; '.join(damaged)}; begin anew, without --resume")
    return found


def newest(directory: Path, damaged: list[str] | None = None) -> Found | None:
    """The last whole checkpoint in a directory, of whatever run; `damaged` is told what is wrong with others."""
    damaged = [] if damaged is None else damaged
    for path in (Path(directory) / name for name in store.CHECKPOINTS):
        if path.exists():
            try:
                return Found(path, store.checkpoint_contents(path), "; ".join(damaged))
            except InputError as error:
                damaged.append(str(error))
    return None


def reached(told: Mapping[str, Any]) -> str:
    """How far the run of a checkpoint is."""
    return "after its load" if told["seeks_distance"] else f"at {told['share']:.1%}"


def is_done(directory: Path, deck: Deck, model_key: str) -> bool:
    """Whether the directory holds the result of the run, whole but for what is made of it afterwards."""
    if store.is_unfinished(directory):
        return False
    try:
        with store.open_result(directory) as result:
            return not other(result.metadata["marks"], deck, model_key)
    except (InputError, KeyError):
        return False


def other(told: dict[str, Any], deck: Deck, model_key: str) -> str:
    """What of another run is told; "" if it is the same."""
    here = marks(deck, model_key)
    if told["program"] != here["program"]:
        return f"was written by another program (version {told['version']}, this is {__version__})"
    if what := decks.difference(deck, told["deck"]):
        return f"was written for {what}"
    return "" if told["model"] == here["model"] else "was written for another model: a file that the deck reads differs"


def save(
    directory: Path, world: World, sub: Subdomain, about: dict[str, Any], memories: Mapping[str, tuple[Parts, Memory]]
) -> None:
    """Write a checkpoint of memories by name, each with the parts that it is of. Collective."""
    packed = {name: pack(parts, memory, sub) for name, (parts, memory) in memories.items()}
    nodal = {f"{name}/{key}": values for name, of in packed.items() for key, values in of.nodal.items()}
    own = {f"{name}/{key}": value for name, of in packed.items() for key, value in of.own.items()}
    alike = {name: of.alike for name, of in packed.items()}
    told = about | {"own": list(own), "alike": alike}
    store.write_checkpoint(directory, world.comm, sub.rows, told, nodal, list(own.values()))


def load(found: Found, sub: Subdomain) -> Callable[[str, Parts], Memory | None]:
    """What finds a memory of a checkpoint by its name and its parts; None if there is none of that name."""
    nodal, table = store.read_checkpoint(found.path, sub.rows.nodes)
    numbers = dict(zip(found.told["own"], table.T, strict=True))

    def read(name: str, parts: Parts) -> Memory | None:
        if name not in found.told["alike"]:
            return None
        of = {key.removeprefix(f"{name}/"): v for key, v in nodal.items() if key.startswith(f"{name}/")}
        own = {key.removeprefix(f"{name}/"): v for key, v in numbers.items() if key.startswith(f"{name}/")}
        return unpack(parts, Packed(of, {}, found.told["alike"][name]), own, sub)

    return read
