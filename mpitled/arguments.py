"""What the command line takes: every command with its arguments, without what carries them out."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mpitled import __version__

#: What `mpitled new` writes a deck for.
KINDS = ("brain", "decks", "block", "cylinder", "ellipsoid")


def parser(commands: Mapping[str, Callable[[argparse.Namespace], int | None]]) -> argparse.ArgumentParser:
    """The parser; `options.command` is the function of the chosen command."""
    made = argparse.ArgumentParser(
        prog="mpitled",
        description="Brain deformation by tumour growth: coupled FE/EFG and explicit dynamics on MPI ranks.",
    )
    made.add_argument("--version", action="version", version=f"mpitled {__version__}")
    of_all = made.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, words: str, *, json: bool = False) -> argparse.ArgumentParser:
        added = of_all.add_parser(name, help=words)
        added.set_defaults(command=commands[name], verbose=False, quiet=False, json=False)
        if json:
            added.add_argument("--json", action="store_true", help="JSON instead of a table")
        return added

    run = command("run", "compute a deck; on N ranks: mpirun -n N mpitled run DECK", json=True)
    _deck(run)
    run.add_argument(
        "-v",
        "--verbose",
        action="store_true",
        help="also each phase as it begins, with its rank, and every figure at the end; of --dry, every array",
    )
    _quiet(run)
    run.add_argument("--resume", action="store_true", help="go on from the last checkpoint; from the start without one")
    run.add_argument(
        "--dry", action="store_true", help="say how long it would take, and what would be done (-v: in full); no step"
    )

    sweep = command("sweep", "a table over values of keys, a run for each; goes on where it was stopped", json=True)
    _deck(sweep, "the scene, or the folder of a sweep that goes on", "sweep_")
    varied = sweep.add_mutually_exclusive_group()
    vary: Any = varied.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="KEY=A,B,...",
        help="values of a key, each with each of others; keys that go together: KEY=A,B+KEY=C,D; repeatable",
    )
    vary.completer = _keys
    varied.add_argument("--cases", type=Path, metavar="CSV", help="a table of cases: keys, and below them values")
    sweep.add_argument("--ranks", type=_count, metavar="R", help="ranks of each case (1); of mpirun -n N: groups of R")
    sweep.add_argument("--jobs", type=_count, default=1, metavar="J", help="cases at work at once, without mpirun (1)")
    sweep.add_argument("--retry", action="store_true", help="compute broken cases again")
    sweep.add_argument("--only", type=_count, metavar="N", help="case N alone and no table, as a task of an array job")
    sweep.add_argument(
        "--one-growth",
        action="store_true",
        help="one run for all volumes of a tumour, which the largest passes through",
    )
    sweep.add_argument("--scheduler", choices=["slurm", "pbs"], help="write an array job, compute nothing")
    _beside(sweep)
    _quiet(sweep)

    new = command("new", "write a deck with comments to begin with")
    new.add_argument("kind", choices=KINDS, help="geometry: a label image, mesh files, or a shape")
    new.add_argument("file", type=Path, nargs="?", help="the deck that is written (KIND.toml); -: standard output")

    check = command("check", "check a mesh file or a deck, and say what is in it and what it will take", json=True)
    check.add_argument("file", type=Path, help="a mesh (Abaqus, LS-DYNA, or what meshio reads), or a deck (TOML)")
    _set(check)

    build = command("build", "build the model of a deck")
    _deck(build)
    build.add_argument("--ranks", type=_count, default=1, metavar="N", help="also partition it for so many ranks")

    part = command("partition", "partition a model ahead of a job")
    _model(part)
    part.add_argument("parts", type=int, help="number of ranks")
    part.add_argument("--seed", type=int, default=0, help="METIS's seed (0)")

    report = command("report", "table, report.json and pictures of a run; the table of a sweep", json=True)
    report.add_argument("directory", type=Path, help="the folder that a run or a sweep wrote")
    report.add_argument("--html", action="store_true", help="also all of it on one page, report.html")
    _beside(report)

    view = command("view", "a result in a window, to turn and to slide through")
    view.add_argument("result", type=Path, help="the folder that a run wrote, or its result.vtkhdf")

    compare = command("compare", "errors of a result against a reference, in mm", json=True)
    compare.add_argument("result", type=Path, help="the folder that a run wrote")
    compare.add_argument(
        "reference", type=Path, help=".npz, .csv, .vtu or .vtkhdf in metres, or a folder of another run"
    )
    compare.add_argument(
        "--beyond", type=float, metavar="MM", help="also only places farther than this from edges of prescribed surface"
    )

    study = command("study", "error against run time over varied keys; goes on where it was stopped", json=True)
    _deck(study, prefix="study_")
    _quiet(study)
    vary = study.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="KEY=A,B,...",
        help="a family of runs; keys that go together: KEY=A,B+KEY=C,D; ranks=1,2 varies the ranks; repeatable",
    )
    vary.completer = _keys
    study.add_argument(
        "--reference", type=Path, help="what errors are against (see compare); else the run of most work"
    )
    study.add_argument("--beyond", type=float, metavar="MM", help="errors farther than this from prescribed edges")

    export = command(
        "export",
        "write a model as decks that run to the same result here, and elsewhere if volumes change little, or a result "
        "as images for 3D Slicer",
    )
    _model(export)
    kind = export.add_mutually_exclusive_group(required=True)
    kind.add_argument("--abaqus", action="store_true", help="the model as Abaqus decks and a CSV table")
    kind.add_argument(
        "--nifti",
        action="store_true",
        help="a result on the voxels of its label image: displacements, their inverse, deformed labels",
    )
    export.add_argument("--out", type=Path, metavar="DIR", help="folder of the files (export beside the model)")

    info = command("info", "versions of what mpitled works with, and what is missing; or of a file", json=True)
    info.add_argument(
        "file",
        type=Path,
        nargs="?",
        help="model, result, checkpoint, table, label image or folder of a run: what it holds, and whether it is whole",
    )
    return made


def _deck(added: argparse.ArgumentParser, what: str = "the scene, a TOML file", prefix: str = "") -> None:
    added.add_argument("deck", type=Path, help=what)
    folder = f"out/{prefix}NAME OF THE DECK"
    added.add_argument("--out", type=Path, metavar="DIR", help=f"folder of the results ({folder})")
    _set(added)


def _quiet(added: argparse.ArgumentParser) -> None:
    added.add_argument("-q", "--quiet", action="store_true", help="no progress and no table")


def _set(added: argparse.ArgumentParser) -> None:
    option: Any = added.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a key of the deck; repeatable"
    )
    option.completer = _keys


def _keys(prefix: str, parsed_args: argparse.Namespace | None = None, **_others: object) -> list[str]:
    """For the shell's completion: keys, of the deck if there is one on the line, and after the = their values."""
    from mpitled.deck import keys

    known = keys(getattr(parsed_args, "deck", None))
    key, given, _ = prefix.partition("=")
    if given:
        return [f"{key}={value}" for value in known.get(key, ())]
    return [f"{name}=" for name in known if name.startswith(prefix)]


def _model(added: argparse.ArgumentParser) -> None:
    added.add_argument("model", type=Path, help="model.h5, or the folder that holds it")


def _beside(added: argparse.ArgumentParser) -> None:
    added.add_argument("--beside", type=Path, metavar="CSV", help="rows of others for a sweep's table, by its keys")


def _count(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text}: give 1 or more")
    return number
