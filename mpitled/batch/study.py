"""The study of a scene: error against run time over the keys that trade one for the other, a process for each run."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpitled import atomic
from mpitled.batch import launch, manifest
from mpitled.batch import vary as families
from mpitled.deck import Deck, load_deck, scene_key
from mpitled.errors import InputError
from mpitled.job import included
from mpitled.results import compare

MANIFEST = "study.json"

COLUMNS = (
    "family", "value", "ranks", "max_error_mm", "rms_error_mm", "cloud_misfit_mm", "static_distance_mm", "loop_s",
    "whole_s", "steps", "cells", "cell_updates", "pareto", "is_reference", "warnings", "failure",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Variant:
    """One run: the deck with the overrides of one value of a family, on so many ranks."""

    family: str  # the varied key, or "as it is"
    value: str
    overrides: tuple[str, ...]
    ranks: int

    def folder(self, scene: Deck) -> str:
        """A name that a person can read, and that no other variant has, nor this one of a deck that was changed."""
        key = scene_key(scene, included(scene))
        return families.folder(f"{self.family}-{self.value}", json.dumps([self.ranks, key]))


def variants(vary: Sequence[str], base: Sequence[str]) -> Iterator[Variant]:
    """The scene as it is, then each family in turn (see `vary.family`); the key "ranks" is the number of ranks."""
    yield Variant("as it is", "", tuple(base), 1)
    for text in vary:
        for values in families.family(text):
            ranks = values.get("ranks", "1")
            if not ranks.isdecimal() or int(ranks) < 1:
                raise InputError(f"--vary {text}: ranks = {ranks}: is not a number of ranks; give 1 or more")
            keys = {key: value for key, value in values.items() if key != "ranks"}
            yield Variant("+".join(values), " ".join(values.values()), families.overrides(base, keys), int(ranks))


def study(
    deck: Path,
    reference: Path | None,
    vary: Sequence[str],
    base: Sequence[str],
    out: Path,
    beyond: float | None,
    quiet: bool = False,
) -> list[dict[str, Any]]:
    """Run what has not been run yet, one after the other, and tell what all of them gave: study.csv and study.png.

    Errors (mm) are against the reference beyond so far (m) from edges, or, without one, against the run of most cell
    updates: how near a run is to rest says nothing of its mesh. InputError for keys and values that the deck does not
    take, and for a folder that holds another study, before anything runs.
    """
    todo = list(variants(vary, base))
    folders = [out / variant.folder(load_deck(deck, base, variant.overrides[len(base) :])) for variant in todo]
    cases = [
        {"folder": folder.name, "values": {variant.family: variant.value}}
        for variant, folder in zip(todo, folders, strict=True)
    ]
    manifest.claim(out / MANIFEST, {"deck": str(deck.resolve()), "overrides": list(base), "cases": cases})
    rows = []
    for i, (variant, folder) in enumerate(zip(todo, folders, strict=True), 1):
        if (failure := launch.outcome(folder)) is None:
            if not quiet:
                print(f"{i}/{len(todo)}: {variant.family} {variant.value}".rstrip(), file=sys.stderr, flush=True)
            failure = launch.run_apart(deck, variant.overrides, variant.ranks, folder)
        rows.append(_row(variant, failure, folder))
    done = [(row, folder) for row, folder in zip(rows, folders, strict=True) if not row["failure"]]
    if reference is None and done:
        finest, reference = max(done, key=lambda run: run[0]["cell_updates"])
        finest["is_reference"] = True
    for row, folder in done:
        if reference and not row["is_reference"]:
            groups = compare.compare(folder, reference, beyond)["groups"]
            found = groups["free beyond" if beyond is not None else "free"]
            row |= {"max_error_mm": found["largest_mm"][-1], "rms_error_mm": found["rms_mm"][-1]}
    for row in rows:
        row["pareto"] = _is_best(row, rows)
    atomic.write_csv(out / "study.csv", COLUMNS, rows)
    if not any(row["max_error_mm"] for row in rows):  # of runs that failed, or of one alone
        print(f"{out}: no picture, for there are no errors to draw", file=sys.stderr)
        return rows
    try:
        from mpitled.results import charts
    except ImportError:
        print(f"{out}: no picture, for matplotlib is missing", file=sys.stderr)
    else:
        with atomic.writing(out / "study.png"):
            charts.draw_study(rows, out / "study.png", f"largest {_named(rows)}, mm")
    return rows


def _row(variant: Variant, failure: str, folder: Path) -> dict[str, Any]:
    row: dict[str, Any] = dict.fromkeys(COLUMNS, "")
    row |= {"family": variant.family, "value": variant.value, "ranks": variant.ranks, "failure": failure}
    if failure:
        return row
    report = json.loads((folder / "report.json").read_text())
    cells = sum(report["cells"].values())
    return row | {
        "cloud_misfit_mm": report.get("cloud_misfit_mm", ""),
        "static_distance_mm": report.get("static_distance_mm", ""),
        "loop_s": report["seconds"]["loop"],
        "whole_s": sum(report["seconds"].values()),
        "steps": report["steps"],
        "cells": cells,
        "cell_updates": cells * report["steps"],
        "warnings": "; ".join(report["warnings"]),
    }


def _named(rows: list[dict[str, Any]]) -> str:
    """What the errors are: without a reference they are not known, but how far runs are from the one of most work."""
    return "difference" if any(row["is_reference"] for row in rows) else "error"


def _is_best(row: dict[str, Any], rows: list[dict[str, Any]]) -> bool:
    """Whether no other run is both more accurate and faster (Pareto)."""
    if row["max_error_mm"] == "":
        return False
    others = (other for other in rows if other is not row and other["max_error_mm"] != "")
    return not any(
        other["max_error_mm"] <= row["max_error_mm"]
        and other["loop_s"] <= row["loop_s"]
        and (other["max_error_mm"], other["loop_s"]) != (row["max_error_mm"], row["loop_s"])
        for other in others
    )


def records(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows for JSON: nothing where there is no number."""
    texts = ("value", "warnings", "failure")
    return [{name: None if v == "" and name not in texts else v for name, v in row.items()} for row in rows]


def table(rows: list[dict[str, Any]]) -> str:
    """The runs as lines for the terminal: * none beats it in both error and time; ! it was warned of."""
    error = f"{_named(rows)}, mm"
    heading = f"{'':3}{'family':34}{'value':24}{error:>15}{'rms, mm':>10}{'misfit, mm':>12}"
    lines = [heading + f"{'loop, s':>9}{'steps':>8}{'cells':>9}"]
    for row in rows:
        if row["failure"]:
            lines.append(f"   {row['family']:34}{row['value']:24}  {row['failure'][:90]}")
            continue
        names = (("max_error_mm", 15), ("rms_error_mm", 10), ("cloud_misfit_mm", 12), ("loop_s", 9))
        numbers = [f"{row[name]:{width}.3g}" if row[name] != "" else " " * width for name, width in names]
        if row["is_reference"]:
            numbers[0] = f"{'reference':>15}"
        marks = ("*" if row["pareto"] else "") + ("!" if row["warnings"] else "")
        lines.append(f"{marks:3}{row['family']:34}{row['value']:24}{''.join(numbers)}{row['steps']:8}{row['cells']:9}")
    if any(row["warnings"] for row in rows):
        lines.append("! warned of: its report.json says why, and the column warnings of study.csv")
    return "\n".join(lines)
