"""The cases of a sweep: each has its own values of the varied keys, and its own folder."""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mpitled import deck as decks
from mpitled.batch import launch, manifest
from mpitled.batch.manifest import Manifest, ManifestCase
from mpitled.batch.vary import Values, folder_name
from mpitled.deck import Deck
from mpitled.errors import InputError
from mpitled.job import included
from mpitled.model.loading import sphere_radius

MANIFEST = "sweep.json"
#: Frames of the run of `--one-growth`; the results of other cases are interpolated between frames.
GROWTH_FRAMES = 40


@dataclass(frozen=True, slots=True, eq=False)
class CaseRecord:
    """One case of a sweep that was started. The deck may have changed since."""

    number: int  # from 1
    values: Values  # of the varied keys
    folder: Path

    @property
    def label(self) -> str:
        """The values, for messages."""
        return " ".join(self.values.overrides)

    @property
    def failure(self) -> str | None:
        """None: the case has not ended. "": it is completed. Otherwise the reason of its failure."""
        return launch.outcome(self.folder)


@dataclass(frozen=True, slots=True, eq=False)
class Case(CaseRecord):
    """One case of a sweep that can be computed."""

    overrides: tuple[str, ...]  # of all cases, then of this case
    deck: Deck
    model: Path  # folder of the model
    shares_model: bool  # whether other cases have the same model

    @property
    def work(self) -> float:
        """Estimate of the run time in arbitrary units, by which the cases of one deck are sorted."""
        deck, solver = self.deck, self.deck.solver
        geometry = deck.labels or deck.cylinder or deck.ellipsoid
        edge = geometry.element_size if geometry else 1.0
        cells = edge**-3
        if deck.block:
            cells = math.prod(deck.block.elements)
            edge = max(length / n for length, n in zip(deck.block.size, deck.block.elements, strict=True))
        if solver.method == "dynamic-relaxation":
            steps = 200.0 if solver.load_steps == "auto" else float(solver.load_steps)
        else:
            speed = max((section.material.wave_speed for section in deck.materials), default=1.0)
            steps = (solver.load_time + solver.hold_time) * speed / edge
        # A larger tumour deforms the cells beside it more, which shortens the stable step.
        growth = sphere_radius(deck.tumour.volume) / deck.tumour.seed_radius if deck.tumour else 1.0
        return cells * steps * (1 + growth)


@dataclass(frozen=True, slots=True)
class SweepRecord:
    """A sweep that was started, as in its manifest."""

    deck: Path
    title: str
    folder: Path
    cases: Sequence[CaseRecord]
    overrides: Sequence[str]  # of all cases
    ranks: int  # of each case
    one_growth: bool  # only the largest tumour is run; the other cases are interpolated in its result

    @property
    def keys(self) -> list[str]:
        """The varied keys."""
        return list(dict.fromkeys(key for case in self.cases for key in case.values))


@dataclass(frozen=True, slots=True)
class Sweep(SweepRecord):
    """A sweep that can be computed."""

    cases: Sequence[Case]

    @property
    def runs(self) -> Sequence[Case]:
        """The cases that are computed by a run."""
        return (max(self.cases, key=_tumour_volume),) if self.one_growth else self.cases

    def write_manifest(self) -> None:
        """Write the file from which the sweep is resumed; errors as `manifest.write`."""
        cases = [ManifestCase(number=c.number, folder=c.folder.name, values=c.values) for c in self.cases]
        content = Manifest(
            deck=str(self.deck.resolve()), title=self.title, overrides=list(self.overrides), ranks=self.ranks,
            one_growth=self.one_growth, cases=cases,
        )  # fmt: skip
        manifest.write(self.folder / MANIFEST, content)


def plan(
    deck: Path,
    values: Sequence[Values],
    overrides: Sequence[str],
    ranks: int,
    folder: Path,
    one_growth: bool = False,
) -> Sweep:
    """The sweep of a deck: one case for each entry of `values`. `one_growth`: see the module `growth`.

    InputError if the deck does not accept a value, or if two cases are equal.
    """
    scenes = []
    numbers: dict[str, int] = {}
    for number, given in enumerate(values, 1):
        all_overrides = (*overrides, *given.overrides)
        scene = decks.load_deck(deck, overrides, given.overrides, given.source or "varied")
        if one_growth:
            _check_growth(scene, given)
            if scene.output.frames < GROWTH_FRAMES:
                all_overrides = (*all_overrides, f"output.frames={GROWTH_FRAMES}")
                scene = decks.load_deck(deck, all_overrides)
        files = included(scene)
        key = decks.scene_key(scene, files)
        if (first := numbers.setdefault(key, number)) != number:
            raise InputError(f"{given.source or deck}: cases {first} and {number} are the same; leave one out")
        scenes.append((number, given, all_overrides, scene, key, decks.model_key(scene, files)))
    models = [model for *_, model in scenes]
    mode = f"{ranks} one growth" if one_growth else f"{ranks}"
    cases = []
    for number, given, all_overrides, scene, key, model in scenes:
        name = folder_name(" ".join(f"{name}-{value}" for name, value in given.items()), f"{mode} {key}")
        model_folder = folder / "models" / hashlib.sha256(model.encode()).hexdigest()[:16]
        shares_model = models.count(model) > 1
        cases.append(Case(number, given, folder / name, all_overrides, scene, model_folder, shares_model))
    return Sweep(deck, cases[0].deck.title, folder, tuple(cases), tuple(overrides), ranks, one_growth)


def _check_growth(deck: Deck, values: Values) -> None:
    """InputError unless the growth of a larger tumour passes through the state of this case."""
    if list(values) != ["tumour.volume"] or deck.tumour is None:
        raise InputError("--one-growth: needs tumour.volume as the only varied key; vary no other key, or leave it out")
    if deck.solver.method != "quasi-static":
        raise InputError(
            f'--one-growth: solver.method = "{deck.solver.method}" is not near rest during the growth; give '
            '"quasi-static", or leave it out'
        )


def _tumour_volume(case: Case) -> float:
    return case.deck.tumour.volume if case.deck.tumour else 0.0


def is_sweep(folder: Path) -> bool:
    """Whether a folder holds a sweep."""
    return (folder / MANIFEST).is_file()


def _read_manifest(folder: Path) -> SweepRecord:
    path = folder / MANIFEST
    try:
        content = Manifest.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{folder}: holds no sweep; give a deck, or the folder of a sweep") from None
    except (OSError, ValueError):
        raise InputError(f"{path}: cannot be read; give the deck again with --vary or --cases") from None
    cases = [CaseRecord(n, Values(case.values), folder / case.folder) for n, case in enumerate(content.cases, 1)]
    deck, title, ranks, growth = Path(content.deck), content.title or "", content.ranks or 1, bool(content.one_growth)
    return SweepRecord(deck, title, folder, cases, content.overrides, ranks, growth)


def read(folder: Path) -> Sweep:
    """The sweep of a folder, for its computation. InputError if its deck has changed."""
    old = _read_manifest(folder)
    sweep = plan(old.deck, [case.values for case in old.cases], old.overrides, old.ranks, folder, old.one_growth)
    if [case.folder for case in sweep.cases] != [case.folder for case in old.cases]:
        raise InputError(
            f"{folder}: {old.deck} or a file that it reads was changed since; undo the change, or give another --out"
        )
    return sweep


def read_record(folder: Path) -> SweepRecord:
    """The sweep of a folder, for its table. Prints a note if its deck is absent or has changed."""
    try:
        return read(folder)
    except (InputError, OSError):
        old = _read_manifest(folder)
        print(f"note: {folder}: {old.deck}, or a file that it reads, has changed since the sweep", file=sys.stderr)
        return old
