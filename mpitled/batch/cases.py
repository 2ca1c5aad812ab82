"""The cases of a sweep: the deck with other values of some keys in each, a folder for each, and a manifest of them."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mpitled import deck as decks
from mpitled.batch import launch, manifest, vary
from mpitled.deck import Deck
from mpitled.errors import InputError
from mpitled.job import included
from mpitled.model.loading import sphere_radius

MANIFEST = "sweep.json"
#: Frames of a run that passes through the volumes of a sweep; between them results are interpolated.
FRAMES = 40


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """One case of a sweep, as its table has it."""

    number: int  # from 1
    values: vary.Values  # of the varied keys
    folder: Path

    @property
    def words(self) -> str:
        """What it is, for messages."""
        return " ".join(f"{key}={value}" for key, value in self.values.items())

    @property
    def failure(self) -> str | None:
        """None if it did not end yet, "" if it is done, or why it is broken."""
        return launch.outcome(self.folder)


@dataclass(frozen=True, slots=True, eq=False)
class Case(Entry):
    """One run of a sweep."""

    overrides: tuple[str, ...]
    deck: Deck
    model: Path  # folder for the model, if several cases have the same one
    shares: bool  # whether they do

    @property
    def work(self) -> float:
        """Time that it takes, in unknown units: good enough to tell long cases of one deck from short ones."""
        deck, solver = self.deck, self.deck.solver
        sized = deck.labels or deck.cylinder or deck.ellipsoid
        edge = sized.element_size if sized else 1.0
        cells = edge**-3
        if deck.block:
            cells = math.prod(deck.block.elements)
            edge = max(length / n for length, n in zip(deck.block.size, deck.block.elements, strict=True))
        speed = max((section.material.wave_speed for section in deck.materials), default=1.0)
        steps = (solver.load_time + solver.hold_time) * speed / edge
        if solver.method == "dynamic-relaxation":
            steps = 200.0 if solver.load_steps == "auto" else solver.load_steps
        # What grows more is stiffer next to the tumour, and takes longer.
        growth = sphere_radius(deck.tumour.volume) / deck.tumour.seed_radius if deck.tumour else 1.0
        return cells * steps * (1 + growth)


@dataclass(frozen=True, slots=True)
class Told:
    """All cases of a deck in a folder, as their table has them."""

    deck: Path
    title: str
    folder: Path
    cases: Sequence[Entry]
    base: Sequence[str]  # overrides for all

    @property
    def keys(self) -> list[str]:
        """The varied keys."""
        return list(dict.fromkeys(key for case in self.cases for key in case.values))


@dataclass(frozen=True, slots=True)
class Sweep(Told):
    """All cases of a deck in a folder, to be computed."""

    cases: Sequence[Case]
    ranks: int  # of each case
    one_growth: bool = False  # whether the largest tumour alone is run, and the others are on its way

    @property
    def runs(self) -> Sequence[Case]:
        """The cases that are computed by themselves."""
        return (max(self.cases, key=_volume),) if self.one_growth else self.cases

    def write_manifest(self) -> None:
        """What `read` takes: a sweep goes on by its folder alone, from anywhere. InputError as `manifest.claim`."""
        cases = [{"number": c.number, "folder": c.folder.name, "values": c.values} for c in self.cases]
        told = {"deck": str(self.deck.resolve()), "title": self.title, "overrides": self.base, "ranks": self.ranks}
        manifest.claim(self.folder / MANIFEST, told | {"one_growth": self.one_growth, "cases": cases})


def plan(
    deck: Path,
    values: Sequence[vary.Values],
    base: Sequence[str],
    ranks: int,
    folder: Path,
    one_growth: bool = False,
) -> Sweep:
    """The sweep of a deck over values of keys; one_growth: as one run, see `growth`.

    InputError for what a deck does not take, before anything runs, and for a case that is there twice.
    """
    scenes = []
    for given in values:
        overrides = vary.overrides(base, given)
        place = given.place if isinstance(given, vary.Line) else "varied"
        scene = decks.load_deck(deck, base, vary.words(given), place)
        if one_growth:
            _check_growth(scene, given)
            if scene.output.frames < FRAMES:
                overrides = (*overrides, f"output.frames={FRAMES}")
                scene = decks.load_deck(deck, overrides)
        files = included(scene)
        scenes.append((given, overrides, scene, decks.scene_key(scene, files), decks.model_key(scene, files)))
    numbers: dict[str, int] = {}
    for number, (given, _, _, key, _) in enumerate(scenes, 1):
        if (first := numbers.setdefault(key, number)) != number:
            place = given.place if isinstance(given, vary.Line) else str(deck)
            raise InputError(f"{place}: cases {first} and {number} are the same; leave one out")
    models = [model for *_, model in scenes]
    cases, mode = [], f"{ranks} one growth" if one_growth else f"{ranks}"
    for number, (given, overrides, scene, key, model) in enumerate(scenes, 1):
        words = " ".join(f"{name}-{value}" for name, value in given.items())
        name = hashlib.sha256(model.encode()).hexdigest()[:16]
        cases.append(
            Case(
                number, given, folder / vary.folder(words, f"{mode} {key}"), overrides, scene, folder / "models" / name,
                models.count(model) > 1,
            )
        )  # fmt: skip
    return Sweep(deck, cases[0].deck.title, folder, tuple(cases), tuple(base), ranks, one_growth)


def _check_growth(deck: Deck, given: vary.Values) -> None:
    """InputError unless a larger tumour passes through what the case asks for."""
    if list(given) != ["tumour.volume"] or deck.tumour is None:
        raise InputError("--one-growth: is for tumour.volume alone; vary nothing else, or leave it out")
    if deck.solver.method != "quasi-static":
        raise InputError(
            f'--one-growth: solver.method = "{deck.solver.method}" is not near rest while it grows; take '
            '"quasi-static", or leave it out'
        )


def _volume(case: Case) -> float:
    return case.deck.tumour.volume if case.deck.tumour else 0.0


def is_sweep(folder: Path) -> bool:
    """Whether a folder is that of a sweep."""
    return (folder / MANIFEST).is_file()


class _Manifest(NamedTuple):
    """What `Sweep.write_manifest` wrote."""

    deck: Path
    title: str
    base: list[str]
    ranks: int
    one_growth: bool
    values: list[vary.Values]
    names: list[str]  # of the folders


def _read_manifest(folder: Path) -> _Manifest:
    path = folder / MANIFEST
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        values = [{str(key): str(value) for key, value in case["values"].items()} for case in told["cases"]]
        deck, base, ranks = Path(told["deck"]), [str(text) for text in told["overrides"]], told["ranks"]
        one_growth, names = told["one_growth"], [Path(case["folder"]).name for case in told["cases"]]
        if type(ranks) is not int or ranks < 1 or type(one_growth) is not bool or not names or {"", ".."} & {*names}:
            raise ValueError(f"{ranks} ranks, folders {names}")
        return _Manifest(deck, str(told.get("title", "")), base, ranks, one_growth, values, names)
    except FileNotFoundError:
        raise InputError(f"{folder}: holds no sweep; give a deck, or the folder that 'mpitled sweep' wrote") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f"{path}: cannot be read; give the deck again with --vary or --cases") from None


def told(folder: Path) -> Told:
    """What was swept in a folder, though the deck be another by now, or gone; a note says so."""
    deck, title, base, _, _, values, names = _read_manifest(folder)
    try:
        return read(folder)
    except (InputError, OSError):
        print(f"note: {folder}: {deck}, or a file that it reads, is not what was swept any more", file=sys.stderr)
    pairs = enumerate(zip(values, names, strict=True), 1)
    entries = [Entry(number, given, folder / name) for number, (given, name) in pairs]
    return Told(deck, title, folder, entries, base)


def read(folder: Path) -> Sweep:
    """The sweep that was begun in a folder, to go on."""
    deck, _, base, ranks, one_growth, values, names = _read_manifest(folder)
    sweep = plan(deck, values, base, ranks, folder, one_growth)
    if [case.folder.name for case in sweep.cases] != names:
        raise InputError(
            f"{folder}: {deck} or a file that it reads was changed since; undo that, or give it with another --out"
        )
    return sweep
