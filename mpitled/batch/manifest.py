"""The manifest of a sweep or a study: a JSON file beside its table that names the deck, the overrides and the cases."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, Field

from mpitled import atomic
from mpitled.batch import launch
from mpitled.errors import InputError
from mpitled.job import MODEL


def _last_part(path: str) -> str:
    """The last part of a path: a manifest cannot name files outside its folder."""
    if (name := Path(path).name) in ("", ".."):
        raise ValueError("not the name of a folder")
    return name


class ManifestCase(BaseModel):
    """One case: its number from 1, its folder beside the manifest, and the values of the varied keys."""

    number: int | None = None
    folder: Annotated[str, AfterValidator(_last_part)]
    values: dict[str, str]


class Manifest(BaseModel):
    """The content of the file. A study has no title, ranks and one_growth."""

    deck: str
    title: str | None = None
    overrides: list[str]
    ranks: Annotated[int, Field(strict=True, ge=1)] | None = None
    one_growth: Annotated[bool, Field(strict=True)] | None = None
    cases: Annotated[list[ManifestCase], Field(min_length=1)]


def write(path: Path, manifest: Manifest) -> None:
    """Write a manifest, which may replace an earlier one and add cases to it.

    InputError if the earlier manifest has a completed case that the new one lacks, or if the folder holds a run.
    """
    if (path.parent / MODEL).exists():
        raise InputError(f"{path.parent}: is the folder of a run; give another --out")
    if difference := _difference(path, manifest):
        raise InputError(
            f"{path.parent}: holds the table of another {path.stem}, {difference}; give another --out, or remove "
            f"{path} to replace it"
        )
    atomic.make_folder(path.parent)
    atomic.write_text(path, manifest.model_dump_json(indent=2, exclude_none=True) + "\n")


def _difference(path: Path, new: Manifest) -> str:
    """The difference between the earlier manifest and the new one; "" if no completed case would be lost."""
    try:
        old = Manifest.model_validate_json(path.read_bytes())
        folders = {case.folder for case in new.cases}
        lost = [case for case in old.cases if case.folder not in folders]
        lost = [case for case in lost if launch.outcome(path.parent / case.folder) == ""]
    except (OSError, ValueError):
        return ""  # the earlier manifest cannot be used
    if not lost:
        return ""
    if old.deck != new.deck:
        return f"of {old.deck}"
    if old.overrides != new.overrides:
        return f"with {' '.join(f'--set {override}' for override in old.overrides) or 'no --set'}"
    if old.ranks != new.ranks:
        return f"with --ranks {old.ranks}"
    if old.one_growth != new.one_growth:
        return f"{'with' if old.one_growth else 'without'} --one-growth"
    values = lost[0].values
    if any(values == case.values for case in new.cases):
        return "of an earlier version of the deck or of a file that it reads"
    if all(values.keys() != case.values.keys() for case in new.cases):
        return f"over {' and '.join(values) or 'nothing'}"
    return f"with {' '.join(f'{key}={value}' for key, value in values.items())}"
