"""The study of a scene: error against run time for values of keys that affect both; a process for each run."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpitled import atomic
from mpitled.batch import launch, manifest, vary
from mpitled.batch.manifest import Manifest, ManifestCase
from mpitled.batch.terminal import print_table
from mpitled.deck import Deck, load_deck, scene_key
from mpitled.errors import InputError
from mpitled.job import included
from mpitled.results import compare

MANIFEST = "study.json"

COLUMNS = (
    "family", "value", "ranks", "max_error_mm", "rms_error_mm", "cloud_misfit_mm", "static_distance_mm", "loop_s",
    "whole_s", "steps", "cells", "cell_updates", "pareto", "is_reference", "warnings", "failure",
)  # fmt: skip
Row = dict[str, Any]  # by column; "" for a missing value


@dataclass(frozen=True, slots=True)
class Variant:
    """One run: the deck with one value of a family, on a number of ranks."""

    family: str  # the varied key, or "as it is"
    value: str
    overrides: Sequence[str]  # of this run only
    ranks: int

    def folder(self, scene: Deck) -> str:
        """A readable name that is unique for the number of ranks and the content of the scene and its files."""
        content = json.dumps([self.ranks, scene_key(scene, included(scene))])
        return vary.folder_name(f"{self.family}-{self.value}", content)


def variants(families: Sequence[str]) -> Iterator[Variant]:
    """The scene as it is, then each family in turn (`vary.family`); the key "ranks" is the number of ranks."""
    yield Variant("as it is", "", (), 1)
    for text in families:
        for values in vary.family(text):
            family, value, ranks = "+".join(values), " ".join(values.values()), values.pop("ranks", "1")
            if not ranks.isdecimal() or int(ranks) < 1:
                raise InputError(f"--vary {text}: ranks = {ranks}: is not a number of ranks; give 1 or more")
            yield Variant(family, value, values.overrides, int(ranks))


def study(
    deck: Path,
    reference: Path | None,
    families: Sequence[str],
    overrides: Sequence[str],
    out: Path,
    beyond: float | None,
    quiet: bool = False,
) -> list[Row]:
    """Run the variants that have not been run, one after the other, and write study.csv and study.png.

    Returns a row for each variant. Errors (mm) are against the reference, at points farther than `beyond` (m) from
    prescribed edges. Without a reference they are differences from the run with the most cell updates: a small
    distance from rest does not show the error of the mesh. InputError, before the first run, for keys and values that
    the deck does not accept, and for a folder that holds another study.
    """
    runs = [(v, out / v.folder(load_deck(deck, overrides, v.overrides))) for v in variants(families)]
    cases = [ManifestCase(folder=folder.name, values={variant.family: variant.value}) for variant, folder in runs]
    manifest.write(out / MANIFEST, Manifest(deck=str(deck.resolve()), overrides=list(overrides), cases=cases))
    rows = []
    for i, (variant, folder) in enumerate(runs, 1):
        if (failure := launch.outcome(folder)) is None:
            if not quiet:
                print(f"{i}/{len(runs)}: {variant.family} {variant.value}".rstrip(), file=sys.stderr, flush=True)
            failure = launch.run_apart(deck, (*overrides, *variant.overrides), variant.ranks, folder)
        rows.append(_row(variant, failure, folder))
    done = [(row, folder) for row, (_, folder) in zip(rows, runs, strict=True) if not row["failure"]]
    if reference is None and done:
        finest, reference = max(done, key=lambda run: run[0]["cell_updates"])
        finest["is_reference"] = True
    for row, folder in done:
        if reference and not row["is_reference"]:
            groups = compare.compare(folder, reference, beyond)["groups"]
            errors = groups["free beyond" if beyond is not None else "free"]
            row |= {"max_error_mm": errors["largest_mm"][-1], "rms_error_mm": errors["rms_mm"][-1]}
    for row in rows:
        row["pareto"] = _is_pareto(row, rows)
    atomic.write_csv(out / "study.csv", COLUMNS, rows)
    _draw(rows, out)
    return rows


def _draw(rows: list[Row], out: Path) -> None:
    if not any(row["max_error_mm"] for row in rows):  # all runs failed, or there is only one run
        print(f"{out}: no picture, because there are no errors to draw", file=sys.stderr)
        return
    try:
        from mpitled.results import charts
    except ImportError:
        print(f"{out}: no picture, because matplotlib is missing", file=sys.stderr)
        return
    with atomic.writing(out / "study.png"):
        charts.draw_study(rows, out / "study.png", f"largest {_quantity(rows)}, mm")


def _row(variant: Variant, failure: str, folder: Path) -> Row:
    row: Row = dict.fromkeys(COLUMNS, "")
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


def _quantity(rows: list[Row]) -> str:
    """The kind of the errors: against a reference, or differences from one of the runs."""
    return "difference" if any(row["is_reference"] for row in rows) else "error"


def _is_pareto(row: Row, rows: list[Row]) -> bool:
    """Whether no other run is at least as accurate and as fast, and better in one of the two."""
    if row["max_error_mm"] == "":
        return False
    error, seconds = row["max_error_mm"], row["loop_s"]
    points = [(other["max_error_mm"], other["loop_s"]) for other in rows if other["max_error_mm"] != ""]
    return not any(e <= error and s <= seconds and (e, s) != (error, seconds) for e, s in points)


def records(rows: list[Row]) -> list[Row]:
    """The rows for JSON: None for a missing number."""
    texts = ("value", "warnings", "failure")
    return [{name: None if v == "" and name not in texts else v for name, v in row.items()} for row in rows]


def show(rows: list[Row]) -> None:
    """Print the rows: * marks a Pareto optimum of error and time, ! a run with warnings."""
    numbers = {"max_error_mm": f"{_quantity(rows)}, mm", "rms_error_mm": "rms, mm", "cloud_misfit_mm": "misfit, mm"}
    numbers |= {"loop_s": "loop, s", "steps": "steps", "cells": "cells"}
    lines = []
    for row in rows:
        cells = ["*" * bool(row["pareto"]) + "!" * bool(row["warnings"]), row["family"], row["value"]]
        if not row["failure"]:
            figures = [f"{v:.3g}" if isinstance(v, float) else str(v) for v in map(row.get, numbers)]
            cells += ["reference", *figures[1:]] if row["is_reference"] else figures
        lines.append((cells, row["failure"]))
    print_table(["", "family", "value", *numbers.values()], lines, n_texts=3)
    if any(row["warnings"] for row in rows):
        print("! the run has warnings: see its report.json, or the column warnings of study.csv")
