"""What a sweep or a study says of itself in its folder, so that no other takes the place of its table unasked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mpitled import atomic
from mpitled.batch import launch
from mpitled.errors import InputError
from mpitled.job import MODEL


def claim(path: Path, manifest: Mapping[str, Any]) -> None:
    """Write a manifest, whose "cases" each have a "folder" beside it and "values" by key.

    InputError if another one is there, and a case of it that is done is none of these: the same cases go on, and more
    may be added to them. InputError as well if the folder is a run's, which its table would hide.
    """
    if (path.parent / MODEL).exists():
        raise InputError(f"{path.parent}: is the folder of a run; give another --out")
    if other := _other(path, manifest):
        raise InputError(
            f"{path.parent}: holds the table of another {path.stem}, {other}; give another --out, or remove {path} to "
            "replace it"
        )
    atomic.make_folder(path.parent)
    atomic.write_text(path, json.dumps(manifest, indent=2) + "\n")


def _other(path: Path, manifest: Mapping[str, Any]) -> str:
    """How the one that is there differs from a manifest that would lose a case of it; "" if none is lost."""
    ours = {case["folder"] for case in manifest["cases"]}
    try:
        old = json.loads(path.read_text(encoding="utf-8"))
        lost = [case for case in old["cases"] if case["folder"] not in ours]
        lost = [case for case in lost if launch.outcome(path.parent / Path(case["folder"]).name) == ""]
        if not lost:
            return ""
        values = {str(key): str(value) for key, value in lost[0]["values"].items()}
        for name, words in (
            ("deck", f"of {old['deck']}"),
            ("overrides", f"with {' '.join(f'--set {word}' for word in old['overrides']) or 'no --set'}"),
            ("ranks", f"on so many ranks a case: {old.get('ranks')}"),
            ("one_growth", f"{'of' if old.get('one_growth') else 'not of'} one growth"),
        ):
            if old.get(name) != json.loads(json.dumps(manifest.get(name))):
                return words
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return ""  # of no use to anybody
    here = [case["values"] for case in manifest["cases"]]
    if values in here:
        return "of the deck before it or a file that it reads was changed"
    if set(values) not in [set(given) for given in here]:
        return f"over {' and '.join(values) or 'nothing'}"
    return f"with {' '.join(f'{key}={value}' for key, value in values.items())}"
