"""Checkpoints: the last one that a run can resume from, what it contains, and whose run it is."""

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
from mpitled.terms.restart import Objects, Packed, Scope, Snapshot, pack, unpack


class Found(NamedTuple):
    """An intact checkpoint."""

    path: Path
    contents: dict[str, Any]
    damaged: str  # what is wrong with a later one, which it replaces; "" if there is none


def marks(deck: Deck, model_key: str) -> dict[str, Any]:
    """Identity of a run: a checkpoint with the same marks belongs to it."""
    return {
        "version": __version__,
        "program": decks.program(),
        "deck": json.loads(json.dumps(decks.canonical(deck, paths=False))),
        "model": hashlib.sha256(model_key.encode()).hexdigest(),
    }


def find(directory: Path, deck: Deck, model_key: str) -> Found | None:
    """The last intact checkpoint in a directory, or None; InputError if it is of another run, or none is intact."""
    damaged: list[str] = []
    found = newest(directory, damaged)
    if found and (difference := other(found.contents, deck, model_key)):
        raise InputError(f"{found.path}: {difference}; put that back, or remove the file to begin anew")
    if damaged and not found:
        raise InputError(f"{'; '.join(damaged)}; begin anew, without --resume")
    return found


def newest(directory: Path, damaged: list[str] | None = None) -> Found | None:
    """The last intact checkpoint in a directory, of any run; what is wrong with others is appended to `damaged`."""
    damaged = [] if damaged is None else damaged
    for path in (Path(directory) / name for name in store.CHECKPOINTS):
        if path.exists():
            try:
                return Found(path, store.checkpoint_contents(path), "; ".join(damaged))
            except InputError as error:
                damaged.append(str(error))
    return None


def reached(contents: Mapping[str, Any]) -> str:
    """How far the run of a checkpoint is."""
    return "after its load" if contents["seeks_distance"] else f"at {contents['share']:.1%}"


def is_done(directory: Path, deck: Deck, model_key: str) -> bool:
    """Whether the directory has the complete result of the run; its report may be missing."""
    if store.is_unfinished(directory):
        return False
    try:
        with store.open_result(directory) as result:
            return not other(result.metadata["marks"], deck, model_key)
    except (InputError, KeyError):
        return False


def other(marked: Mapping[str, Any], deck: Deck, model_key: str) -> str:
    """How the run with other marks differs from this one; "" if it is the same."""
    ours = marks(deck, model_key)
    if marked["program"] != ours["program"]:
        return f"was written by another program (version {marked['version']}, this is {__version__})"
    if difference := decks.difference(deck, marked["deck"]):
        return f"was written for {difference}"
    same = marked["model"] == ours["model"]
    return "" if same else "was written for another model: a file that the deck reads differs"


def save(
    directory: Path,
    world: World,
    sub: Subdomain,
    about: dict[str, Any],
    objects: Objects,
    snapshots: Mapping[str, tuple[Scope, Snapshot]],
) -> None:
    """Write a checkpoint with snapshots of the objects, by name, each with its scope. Collective."""
    packed = {name: pack(objects, scope, values, sub) for name, (scope, values) in snapshots.items()}
    nodal = {f"{name}/{key}": values for name, of in packed.items() for key, values in of.nodal.items()}
    numbers = {f"{name}/{key}": value for name, of in packed.items() for key, value in of.reduced.items()}
    replicated = {name: of.replicated for name, of in packed.items()}
    contents = about | {"reduced": list(numbers), "replicated": replicated}
    store.write_checkpoint(directory, world.comm, sub.rows, contents, nodal, list(numbers.values()))


def load(found: Found, sub: Subdomain) -> Callable[[str, Objects, Scope], Snapshot | None]:
    """The function that reads a snapshot of a checkpoint by its name; None if there is none of that name."""
    nodal, table = store.read_checkpoint(found.path, sub.rows.nodes)
    numbers = dict(zip(found.contents["reduced"], table.T, strict=True))

    def read(name: str, objects: Objects, scope: Scope) -> Snapshot | None:
        if name not in found.contents["replicated"]:
            return None
        of_nodes = {key.removeprefix(f"{name}/"): v for key, v in nodal.items() if key.startswith(f"{name}/")}
        reduced = {key.removeprefix(f"{name}/"): v for key, v in numbers.items() if key.startswith(f"{name}/")}
        return unpack(objects, scope, Packed(of_nodes, {}, found.contents["replicated"][name]), reduced, sub)

    return read
