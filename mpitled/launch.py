"""A run of a deck as a process of its own, or as ranks of their own: what studies and sweeps are made of."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

#: Says in a run's folder that it ended, and how.
DONE = "done.json"


def ranked(ranks: int) -> list[str]:
    """The words that start so many ranks; none for one."""
    return ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks)] if ranks > 1 else []


def command(deck: Path, overrides: Sequence[str], ranks: int, folder: Path) -> list[str]:
    """What computes a deck with overrides ("section.key=value") into a folder, quietly."""
    start = [sys.executable, "-c", "from mpitled.cli import main; main()"]
    words = [*start, "run", str(deck), "-q", "--out", str(folder)]
    words += [word for override in overrides for word in ("--set", override)]
    return [*ranked(ranks), *words]


def run_apart(deck: Path, overrides: Sequence[str], ranks: int, folder: Path) -> str:
    """Compute a deck in its folder, emptied before; the reason of its failure, "" if it is done."""
    shutil.rmtree(folder, ignore_errors=True)
    ended = subprocess.run(command(deck, overrides, ranks, folder), capture_output=True, text=True)
    lines = [line for line in ended.stderr.splitlines() if line.startswith("mpitled: ")]
    failure = "" if ended.returncode == 0 else (lines or ended.stderr.splitlines() or ["no reason given"])[-1]
    failure = failure.removeprefix("mpitled: ")
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f".{DONE}"
    temporary.write_text(json.dumps({"failure": failure}))
    os.replace(temporary, folder / DONE)
    return failure


def outcome(folder: Path) -> str | None:
    """How a run ended in its folder: None if it did not, the reason of its failure, or "" for success."""
    done = folder / DONE
    return str(json.loads(done.read_text())["failure"]) if done.exists() else None
