"""The commands: the arguments of each command, and the function that executes it.

Each function imports its modules itself, so that `mpitled --help` does not load compilers and libraries.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpitled.errors import InputError

if TYPE_CHECKING:
    from mpitled.batch.cases import Case, Sweep, SweepRecord

_Options = argparse.Namespace
#: Adds an argument to a parser or to a group of a parser.
_Argument = Callable[[Any], None]
#: Executes a command and returns its exit status (None: 0).
_Function = Callable[[_Options], "int | None"]

#: Kinds of decks that `mpitled new` writes.
KINDS = ("brain", "decks", "block", "cylinder", "ellipsoid")
#: Each entry adds a command to the subparsers, in the order of the help. `options.command` is its function.
COMMANDS: list[Callable[[Any], None]] = []


def _command(name: str, help: str, *arguments: _Argument) -> Callable[[_Function], _Function]:
    def register(function: _Function) -> _Function:
        def add(subparsers: Any) -> None:
            parser = subparsers.add_parser(name, help=help)
            parser.set_defaults(command=function, verbose=False, quiet=False, json=False)
            for argument in arguments:
                argument(parser)

        COMMANDS.append(add)
        return function

    return register


def _option(*names: str, completer: Callable[..., list[str]] | None = None, **settings: Any) -> _Argument:
    def add(parser: Any) -> None:
        parser.add_argument(*names, **settings).completer = completer

    return add


def _one_of(*options: _Argument, required: bool = False) -> _Argument:
    def add(parser: Any) -> None:
        group = parser.add_mutually_exclusive_group(required=required)
        for option in options:
            option(group)

    return add


# --- arguments of several commands ---------------------------------------------------------------------------------


def _complete_keys(prefix: str, parsed_args: _Options | None = None, **_others: object) -> list[str]:
    """Completions for the shell: keys, also of the deck in the command; after "=" values."""
    from mpitled.deck import keys

    known = keys(getattr(parsed_args, "deck", None))
    key, equals, _ = prefix.partition("=")
    if equals:
        return [f"{key}={value}" for value in known.get(key, ())]
    return [f"{name}=" for name in known if name.startswith(prefix)]


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text}: give 1 or more")
    return number


def _scene(prefix: str = "", kind: str = ", a TOML file") -> _Argument:
    """The deck, its overrides, and the folder of the results."""

    def add(parser: Any) -> None:
        parser.add_argument("deck", type=Path, help=f"the scene{kind}")
        folder = f"folder of the results (out/{prefix}NAME OF THE DECK)"
        parser.add_argument("--out", type=Path, metavar="DIR", help=folder)
        _SET(parser)

    return add


def _keys(name: str, metavar: str, help: str) -> _Argument:
    return _option(name, action="append", default=[], metavar=metavar, help=help, completer=_complete_keys)


_SET = _keys("--set", "SECTION.KEY=VALUE", "override a key of the deck; repeatable")
_TOGETHER = "keys that vary together: KEY=A,B+KEY=C,D"
_MODEL = _option("model", type=Path, help="model.h5, or the folder that holds it")
_JSON = _option("--json", action="store_true", help="JSON instead of a table")
_QUIET = _option("-q", "--quiet", action="store_true", help="no progress and no table")
_BESIDE = _option("--beside", type=Path, metavar="CSV", help="figures for comparison in a sweep's table, by its keys")


def _folder(options: _Options, prefix: str = "") -> Path:
    return options.out or Path("out") / f"{prefix}{options.deck.stem}"


def _model(path: Path) -> Path:
    from mpitled.job import MODEL

    return path / MODEL if path.is_dir() else path


def _print(figures: Any, table: Callable[[Any], str], options: _Options) -> None:
    print(json.dumps(figures, indent=2) if options.json else table(figures))


def _note(message: object) -> None:
    print(f"note: {message}", file=sys.stderr, flush=True)


def _note_compilation() -> None:
    """Print a note if the kernels have not been compiled yet."""
    cache = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent / "kernels" / "__pycache__")
    if not any(cache.glob("mpitled-*/**/*.nbi")):
        _note("the kernels are compiled once; this takes about 15 s")


# --- runs ----------------------------------------------------------------------------------------------------------


@_command(
    "run",
    "compute a deck; on N ranks: mpirun -n N mpitled run DECK",
    _JSON,
    _scene(),
    _option(
        "-v", "--verbose", action="store_true",
        help="print each phase at its start, with its rank, and all figures at the end; with --dry, all arrays",
    ),
    _QUIET,
    _option("--resume", action="store_true", help="resume from the last checkpoint, or from the start without one"),
    _option("--dry", action="store_true", help="print the expected time and number of steps; compute no step"),
)  # fmt: skip
def _run(options: _Options) -> None:
    from mpitled.deck import load_deck
    from mpitled.errors import everywhere
    from mpitled.job import run
    from mpitled.parallel.halo import World
    from mpitled.solver.progress import INTERRUPTS

    world, folder = World(), _folder(options)
    with everywhere():  # each rank reads the same file
        deck = load_deck(options.deck, options.set)
    if world.leads and not options.quiet:
        _note_compilation()
    if options.dry:
        if options.json:
            raise InputError("run --dry: prints no JSON; use mpitled check DECK --json")
        from mpitled.preview.dry_run import dry_run

        text = dry_run(deck, folder, world, verbose=options.verbose)
        if world.leads:
            print(text)
        return
    world.on_leader(lambda: _refuse_sweep(folder))
    for which in INTERRUPTS:  # a signal after the end of the run must not fail the command
        signal.signal(which, signal.SIG_IGN)
    figures = run(deck, folder, world, quiet=options.quiet, resume=options.resume)
    if not world.leads:
        return
    if options.quiet:
        for text in figures["warnings"]:
            print(f"mpitled: warning: {text}", file=sys.stderr)
    if options.json or not options.quiet:
        from mpitled.results import report

        _print(figures, partial(report.table, full=options.verbose), options)
        if not options.json:
            print(f"written to {folder}; mpitled report {folder} --html writes a page")


def _refuse_sweep(folder: Path) -> None:
    """InputError for the folder of a sweep, whose table a run would hide."""
    from mpitled.batch.cases import is_sweep

    if is_sweep(folder):
        raise InputError(f"{folder}: is the folder of a sweep; give another --out")


@_command(
    "sweep",
    "a table over values of keys with a run for each case; the same command resumes a sweep",
    _JSON,
    _scene("sweep_", ", or the folder of a sweep to resume"),
    _one_of(
        _keys("--vary", "KEY=A,B,...", f"values of a key, combined with those of other keys; {_TOGETHER}; repeatable"),
        _option("--cases", type=Path, metavar="CSV", help="a table of cases: a line of keys, then lines of values"),
    ),
    _option("--ranks", type=_positive, metavar="R", help="ranks of each case (1); under mpirun -n N: groups of R"),
    _option("--jobs", type=_positive, default=1, metavar="J", help="cases that run at once, without mpirun (1)"),
    _option("--retry", action="store_true", help="compute broken cases again"),
    _option("--only", type=_positive, metavar="N", help="case N alone and no table, as a task of an array job"),
    _option("--one-growth", action="store_true", help="one run through all tumour volumes"),
    _option("--scheduler", choices=["slurm", "pbs"], help="write an array job instead of computing"),
    _BESIDE,
    _QUIET,
)  # fmt: skip
def _sweep(options: _Options) -> int:
    from mpitled.batch import array_job, growth, sweep
    from mpitled.errors import everywhere
    from mpitled.parallel.halo import World

    world = World()
    with everywhere():  # each rank reads the same files
        plan = _plan(options)
    if options.scheduler:
        path = world.on_leader(lambda: array_job.write(plan, options.scheduler))
        if world.leads:
            print(json.dumps({"script": str(path)}) if options.json else path)
        return 0
    sweep.compute(plan, world, jobs=options.jobs, retry=options.retry, only=options.only, quiet=options.quiet)
    if options.only:
        return int(world.on_leader(lambda: _report_case(plan, plan.cases[options.only - 1], options)))
    if plan.one_growth and world.leads:
        growth.write_reports(plan)
    return _tabulate(plan, options, must_write=True) if world.leads else 0


def _plan(options: _Options) -> Sweep:
    from mpitled.batch import cases, summary, vary

    if options.deck.is_dir():
        if options.vary or options.cases or options.set or options.out or options.ranks or options.one_growth:
            raise InputError(f"{options.deck}: is resumed with its own options; give the deck for other options")
        plan = cases.read(options.deck)
    elif options.vary or options.cases:
        values = vary.table(options.cases, summary.NAMES) if options.cases else vary.grid(options.vary)
        folder = _folder(options, "sweep_")
        plan = cases.plan(options.deck, values, options.set, options.ranks or 1, folder, options.one_growth)
    else:
        raise InputError("sweep: nothing is varied; give --vary KEY=A,B,... or --cases CSV")
    if plan.one_growth and (options.scheduler or options.only):
        raise InputError("--one-growth: is a single run, not an array of jobs; leave out --scheduler and --only")
    return plan


def _report_case(plan: Sweep, case: Case, options: _Options) -> int:
    """Print the outcome of one case and return the exit status: 3 if the case is broken."""
    from dataclasses import replace

    from mpitled.batch import summary

    if options.json:
        (record,) = summary.records(summary.collect(replace(plan, cases=(case,))))
        print(json.dumps(record, indent=2))
    if case.failure:
        message = f"mpitled: case {case.number}, {case.label}: {case.failure}"
        print(f"{message} (--retry computes it again)", file=sys.stderr)
    return 3 if case.failure else 0


def _tabulate(sweep: SweepRecord, options: _Options, *, must_write: bool) -> int:
    """Print and write the table of a sweep and return the exit status: 3 if a case is broken.

    If the table cannot be written: InputError with `must_write`, otherwise a note.
    """
    from mpitled.batch import summary

    table = summary.collect(sweep, options.beside)
    if options.json:
        print(json.dumps(summary.records(table), indent=2))
    elif not options.quiet:
        summary.show(table)
    else:
        for text in summary.warnings(table):
            print(f"mpitled: {text}", file=sys.stderr)
    try:
        summary.write(sweep, table)
    except InputError as error:
        if must_write:
            raise
        _note(error)
    else:
        if not (options.json or options.quiet):
            print(f"written to {sweep.folder}")
    if broken := [case for case in sweep.cases if case.failure]:
        print(f"{len(broken)} broken; --retry computes them again", file=sys.stderr)
    return 3 if broken else 0


@_command(
    "study",
    "error against run time over varied keys; the same command resumes a study",
    _JSON,
    _scene("study_"),
    _QUIET,
    _keys("--vary", "KEY=A,B,...", f"a family of runs; {_TOGETHER}; ranks=1,2 varies the ranks; repeatable"),
    _option("--reference", type=Path, help="reference for the errors (see compare); default: the run of most work"),
    _option("--beyond", type=float, metavar="MM", help="errors farther than this from prescribed edges"),
)
def _study(options: _Options) -> None:
    from mpitled.batch import study

    beyond, out = options.beyond and options.beyond / 1e3, _folder(options, "study_")
    rows = study.study(options.deck, options.reference, options.vary, options.set, out, beyond, quiet=options.quiet)
    if options.json:
        print(json.dumps(study.records(rows), indent=2))
    elif not options.quiet:
        study.show(rows)
        print(f"written to {out}")


# --- before a run --------------------------------------------------------------------------------------------------


@_command(
    "new",
    "write a first deck with comments",
    _option("kind", choices=KINDS, help="geometry: a label image, mesh files, or a shape"),
    _option("file", type=Path, nargs="?", help="path of the deck (KIND.toml); -: standard output"),
)
def _new(options: _Options) -> None:
    from mpitled import scaffold

    path = Path(f"{options.kind}.toml")
    if options.file == Path("-"):
        print(scaffold.text(options.kind, path), end="")
    else:
        print(*scaffold.write(options.kind, options.file or path), sep="\n")


@_command(
    "check",
    "check a mesh file or a deck, list its contents, and forecast its run",
    _JSON,
    _option("file", type=Path, help="a mesh (Abaqus, LS-DYNA, or a format of meshio), or a deck (TOML)"),
    _SET,
)
def _check(options: _Options) -> None:
    from mpitled.preview import overview

    if options.file.suffix == ".toml":
        _note_compilation()
    if options.json:
        print(json.dumps(overview.figures(options.file, options.set), indent=2))
    else:
        print(overview.check(options.file, options.set))


@_command(
    "build",
    "build the model of a deck",
    _scene(),
    _option("--ranks", type=_positive, default=1, metavar="N", help="also partition it for N ranks"),
)
def _build(options: _Options) -> None:
    from mpitled.deck import load_deck
    from mpitled.job import build, ensure_partition
    from mpitled.store import describe_model

    deck = load_deck(options.deck, options.set)
    path, built = build(deck, _folder(options))
    ensure_partition(path, options.ranks, deck.partition.seed)
    print(f"{path}: {'built' if built else 'up to date'}\n{describe_model(path)}")


@_command(
    "partition",
    "partition a model ahead of a job",
    _MODEL,
    _option("parts", type=int, help="number of ranks"),
    _option("--seed", type=int, default=0, help="METIS's seed (0)"),
)
def _partition(options: _Options) -> None:
    from mpitled.job import divide

    if options.parts < 2:
        raise InputError(f"{options.parts} parts: one rank needs no partition; ask for 2 or more")
    print(divide(_model(options.model), options.parts, options.seed))


# --- after a run ---------------------------------------------------------------------------------------------------


@_command(
    "report",
    "table, report.json and pictures of a run; the table of a sweep",
    _JSON,
    _option("directory", type=Path, help="the folder that a run or a sweep wrote"),
    _option("--html", action="store_true", help="also all results on one page, report.html"),
    _BESIDE,
)
def _report(options: _Options) -> int:
    from mpitled.batch import cases
    from mpitled.results import report

    if cases.is_sweep(options.directory):
        return _tabulate(cases.read_record(options.directory), options, must_write=False)
    figures = report.make(options.directory)
    _print(figures.as_json(), report.table, options)
    try:
        report.save(options.directory, figures.as_json())
        if options.html:
            from mpitled.results import page

            print(f"written to {page.write(options.directory, figures)}", file=sys.stderr)
    except InputError as error:
        if options.html:
            raise
        _note(error)
    return 0


@_command(
    "view",
    "show a result in a window, to rotate and to play",
    _option("result", type=Path, help="the folder that a run wrote, or its result.vtkhdf"),
)
def _view(options: _Options) -> None:
    from mpitled.results import views

    views.show(options.result)


@_command(
    "compare",
    "errors of a result against a reference, in mm",
    _JSON,
    _option("result", type=Path, help="the folder that a run wrote"),
    _option("reference", type=Path, help=".npz, .csv, .vtu or .vtkhdf in metres, or the folder of another run"),
    _option(
        "--beyond", type=float, metavar="MM", help="also at points farther than this from edges of prescribed surfaces"
    ),
)
def _compare(options: _Options) -> None:
    from mpitled.results import compare

    figures = compare.compare(options.result, options.reference, options.beyond and options.beyond / 1e3)
    _print(figures, compare.table, options)


@_command(
    "export",
    "write a model as decks for this program and for Abaqus, or a result as images for 3D Slicer",
    _MODEL,
    _one_of(
        _option("--abaqus", action="store_true", help="the model as Abaqus decks and a CSV table"),
        _option(
            "--nifti", action="store_true",
            help="a result on the voxels of its label image: displacements, their inverse, deformed labels",
        ),
        required=True,
    ),
    _option("--out", type=Path, metavar="DIR", help="folder of the files (export beside the model)"),
)  # fmt: skip
def _export(options: _Options) -> None:
    path = _model(options.model)
    out = options.out or path.parent / "export"
    if options.abaqus:
        from mpitled import export

        print(*export.write_abaqus(path, out), sep="\n")
        return
    from mpitled.results import images

    written = images.write_nifti(path.parent, out)
    if not written.complete:
        _note(f"{path.parent}: is not complete; the images show its last frame, at {written.share:.1%} of the load")
    print(*written.paths, sep="\n")
    if written.tumour is not None:
        print(f"label {written.tumour} of {images.LABELS} is the tumour")
    print(f"{images.INVERSE} inverts the displacements to within {1e3 * written.missed:.2g} mm at the worst voxel")


@_command(
    "info",
    "versions of the libraries and missing libraries, or the contents of a file",
    _JSON,
    _option("file", type=Path, nargs="?", help="model, result, checkpoint, table, label image or folder of a run"),
)
def _info(options: _Options) -> int:
    from mpitled import info

    if options.json:
        print(json.dumps(info.contents(options.file) if options.file else info.versions(), indent=2))
    else:
        print(info.describe(options.file) if options.file else info.table())
    return 0 if options.file or info.complete() else 1
