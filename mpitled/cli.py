# PYTHON_ARGCOMPLETE_OK
"""The command line: what each command does with its arguments."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from mpitled import arguments
from mpitled.errors import InputError, InterruptedRun, MpitledError

if TYPE_CHECKING:
    from mpitled.batch.cases import Case, Sweep, SweepRecord

# Modules are imported by the command that needs them: `--help` must not wait for compilers and libraries.


def main(words: Sequence[str] | None = None) -> NoReturn:
    """Run a command; exit status 0 done, 1 broken, 2 bad input, 3 unstable, 4 interrupted."""
    parser = arguments.parser(_COMMANDS)
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)
    options = parser.parse_args(words)
    try:
        if options.verbose:
            _log_phases()
        status = options.command(options)
    except MpitledError as error:
        _end(error, error.status)
    except BrokenPipeError:
        os._exit(1)
    except KeyboardInterrupt:  # of what has nothing to keep; a run and a sweep end in order
        print("mpitled: interrupted", file=sys.stderr, flush=True)
        sys.exit(InterruptedRun.status)
    except ImportError as error:
        _missing(error)
    except Exception as error:
        traceback.print_exc()
        _end(error, 1)
    sys.exit(status or 0)


def _end(error: Exception, status: int) -> NoReturn:
    """One message, and the end of every rank: alike if all know of the error, else by aborting the job."""
    from mpitled.parallel.halo import World

    world = World()
    if getattr(error, "everywhere", False) or world.size == 1:
        if world.leads:
            print(f"mpitled: {error}", file=sys.stderr, flush=True)
        sys.exit(status)
    print(f"mpitled: rank {world.rank}: {error}", file=sys.stderr, flush=True)
    world.abort(status)


def _missing(error: ImportError) -> NoReturn:
    """A library that is not there or cannot be loaded, maybe the one that ranks speak through."""
    print(f"mpitled: {error}; 'mpitled info' says what is missing and how to get it", file=sys.stderr, flush=True)
    if "mpi4py.MPI" in sys.modules:
        from mpitled.parallel.halo import World

        World().abort(2)
    sys.exit(2)


def _log_phases() -> None:
    """Phases of the work on stderr, with the time and the rank."""
    import logging

    from mpitled.parallel.halo import World

    logging.basicConfig(format=f"%(asctime)s rank {World().rank}: %(message)s", level=logging.WARNING)
    logging.getLogger("mpitled").setLevel(logging.INFO)


def _print(figures: Any, table: Callable[[Any], str], options: argparse.Namespace) -> None:
    print(json.dumps(figures, indent=2) if options.json else table(figures))


def _mind_the_compiler() -> None:
    """A word before a silence: whoever calls the kernels for the first time waits for their compilation."""
    cache = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent / "solver" / "kernels" / "__pycache__")
    if not any(cache.glob("mpitled-*/**/*.nbi")):
        print("note: the kernels are compiled now, once; that takes some 15 s", file=sys.stderr, flush=True)


def _output(options: argparse.Namespace) -> Path:
    return options.out or Path("out") / options.deck.stem


def _run(options: argparse.Namespace) -> None:
    from mpitled.deck import load_deck
    from mpitled.errors import everywhere
    from mpitled.job import run
    from mpitled.parallel.halo import World
    from mpitled.solver.progress import INTERRUPTS

    world = World()
    with everywhere():  # each rank reads the same file
        deck = load_deck(options.deck, options.set)
    if world.leads and not options.quiet:
        _mind_the_compiler()
    if options.dry:
        if options.json:
            raise InputError("run --dry: is for people; mpitled check DECK --json has its figures")
        from mpitled.preview.dry_run import dry_run

        told = dry_run(deck, _output(options), world, verbose=options.verbose)
        if world.leads:
            print(told)
        return
    world.on_leader(lambda: _refuse_sweep(_output(options)))
    for which in INTERRUPTS:  # what comes after the end of the run must not make a failure of it
        signal.signal(which, signal.SIG_IGN)
    made = run(deck, _output(options), world, quiet=options.quiet, resume=options.resume)
    if world.leads and options.quiet:
        for text in made["warnings"]:
            print(f"mpitled: warning: {text}", file=sys.stderr)
    if world.leads and (options.json or not options.quiet):
        from mpitled.results import report

        _print(made, partial(report.table, whole=options.verbose), options)
        if not options.json:
            print(f"written to {_output(options)}; mpitled report {_output(options)} --html makes a page of it")


def _refuse_sweep(folder: Path) -> None:
    """InputError for the folder of a sweep, whose table a run would hide."""
    from mpitled.batch.cases import is_sweep

    if is_sweep(folder):
        raise InputError(f"{folder}: is the folder of a sweep; give another --out")


def _sweep(options: argparse.Namespace) -> int:
    from mpitled.batch import array_job, cases, growth, summary, sweep, vary
    from mpitled.errors import everywhere
    from mpitled.parallel.halo import World

    world = World()
    with everywhere():  # each rank reads the same files
        if options.deck.is_dir():
            if options.vary or options.cases or options.set or options.out or options.ranks or options.one_growth:
                raise InputError(f"{options.deck}: goes on as it began; give the deck to vary, set or place it anew")
            plan = cases.read(options.deck)
        else:
            if not options.vary and not options.cases:
                raise InputError("sweep: nothing is varied; give --vary KEY=A,B,... or --cases CSV")
            values = vary.table(options.cases, summary.NAMES) if options.cases else vary.grid(options.vary)
            out = options.out or Path("out") / f"sweep_{options.deck.stem}"
            plan = cases.plan(options.deck, values, options.set, options.ranks or 1, out, options.one_growth)
        if plan.one_growth and (options.scheduler or options.only):
            raise InputError("--one-growth: is one run, and no array of jobs; leave out --scheduler and --only")
    if options.scheduler:
        path = world.on_leader(lambda: array_job.write(plan, options.scheduler))
        if world.leads:
            print(json.dumps({"script": str(path)}) if options.json else path)
        return 0
    sweep.compute(plan, world, jobs=options.jobs, retry=options.retry, only=options.only, quiet=options.quiet)
    if options.only:
        return int(world.on_leader(lambda: _tell_case(plan, plan.cases[options.only - 1], options)))
    if plan.one_growth and world.leads:
        growth.write_reports(plan)
    return _tabulate(plan, options, must=True) if world.leads else 0


def _tell_case(plan: Sweep, case: Case, options: argparse.Namespace) -> int:
    """What became of a case by itself; 3 if it is broken."""
    from dataclasses import replace

    from mpitled.batch import summary

    if options.json:
        (record,) = summary.records(summary.collect(replace(plan, cases=(case,))))
        print(json.dumps(record, indent=2))
    if case.failure:
        told = f"mpitled: case {case.number}, {case.label}: {case.failure}"
        print(f"{told} (--retry computes it again)", file=sys.stderr)
    return 3 if case.failure else 0


def _tabulate(told: SweepRecord, options: argparse.Namespace, *, must: bool) -> int:
    """Print the table of a sweep, then write it; 3 if a case is broken. `must`: InputError if the disc refuses."""
    from mpitled.batch import summary

    table = summary.collect(told, options.beside)
    if options.json:
        print(json.dumps(summary.records(table), indent=2))
    elif not options.quiet:
        summary.show(table)
    else:
        for text in summary.warnings(table):
            print(f"mpitled: {text}", file=sys.stderr)
    try:
        summary.write(told, table)
    except InputError as error:
        if must:
            raise
        _note(error)
    else:
        if not (options.json or options.quiet):
            print(f"written to {told.folder}")
    if broken := [case for case in told.cases if case.failure]:
        print(f"{len(broken)} broken; --retry computes them again", file=sys.stderr)
    return 3 if broken else 0


def _note(error: InputError) -> None:
    print(f"note: {error}", file=sys.stderr)


def _new(options: argparse.Namespace) -> None:
    from mpitled import scaffold

    path = Path(f"{options.kind}.toml")
    if options.file == Path("-"):
        print(scaffold.text(options.kind, path), end="")
        return
    for written in scaffold.write(options.kind, options.file or path):
        print(written)


def _build(options: argparse.Namespace) -> None:
    from mpitled.deck import load_deck
    from mpitled.job import build, ensure_partition
    from mpitled.store import describe_model

    deck = load_deck(options.deck, options.set)
    path, built = build(deck, _output(options))
    ensure_partition(path, options.ranks, deck.partition.seed)
    print(f"{path}: {'built' if built else 'up to date'}")
    print(describe_model(path))


def _check(options: argparse.Namespace) -> None:
    from mpitled.preview import overview

    if options.file.suffix == ".toml":
        _mind_the_compiler()
    if options.json:
        print(json.dumps(overview.figures(options.file, options.set), indent=2))
    else:
        print(overview.check(options.file, options.set))


def _export(options: argparse.Namespace) -> None:
    path = _model(options.model)
    out = options.out or path.parent / "export"
    if options.nifti:
        _export_images(path.parent, out)
        return
    from mpitled import export

    for written in export.write_abaqus(path, out):
        print(written)


def _export_images(run: Path, out: Path) -> None:
    from mpitled.results import images

    written = images.write_nifti(run, out)
    if not written.complete:
        told = f"{run}: is not complete; the images are of its last frame, at {written.share:.1%} of the load"
        print(f"note: {told}", file=sys.stderr)
    print(*written.paths, sep="\n")
    if written.tumour is not None:
        print(f"label {written.tumour} of {images.LABELS} is the tumour")
    print(f"{images.INVERSE} leads back to within {1e3 * written.missed:.2g} mm at its worst voxel")


def _model(path: Path) -> Path:
    from mpitled.job import MODEL

    return path / MODEL if path.is_dir() else path


def _partition(options: argparse.Namespace) -> None:
    from mpitled.job import divide

    path = _model(options.model)
    if options.parts < 2:
        raise InputError(f"{options.parts} parts: one rank needs no partition; ask for 2 or more")
    print(divide(path, options.parts, options.seed))


def _report(options: argparse.Namespace) -> int:
    from mpitled.batch import cases
    from mpitled.results import report

    if cases.is_sweep(options.directory):
        return _tabulate(cases.read_record(options.directory), options, must=False)
    made = report.make(options.directory)
    _print(made, report.table, options)
    if options.html:
        from mpitled.results import page

        report.keep(options.directory, made)
        print(f"written to {page.write(options.directory, made)}", file=sys.stderr)
    else:
        try:
            report.keep(options.directory, made)
        except InputError as error:
            _note(error)
    return 0


def _view(options: argparse.Namespace) -> None:
    from mpitled.results import views

    views.show(options.result)


def _compare(options: argparse.Namespace) -> None:
    from mpitled.results import compare

    figures = compare.compare(options.result, options.reference, options.beyond and options.beyond / 1e3)
    _print(figures, compare.table, options)


def _study(options: argparse.Namespace) -> None:
    from mpitled.batch import study

    beyond = options.beyond and options.beyond / 1e3
    out = options.out or Path("out") / f"study_{options.deck.stem}"
    rows = study.study(options.deck, options.reference, options.vary, options.set, out, beyond, quiet=options.quiet)
    if options.json:
        print(json.dumps(study.records(rows), indent=2))
    elif not options.quiet:
        study.show(rows)
        print(f"written to {out}")


def _bench(options: argparse.Namespace) -> int:
    from mpitled.speed import bench

    if options.omissions:
        from mpitled.speed import omissions

        print(omissions.measure(options.quick))
        return 0
    ranks = _numbers("--ranks", options.ranks) if options.ranks else bench.default_ranks()
    bench.check_ranks(ranks)
    if options.scaling:
        from mpitled.speed import scaling

        print(scaling.measure(ranks, options.quick))
        return 0
    old = bench.load(options.compare) if options.compare else None
    outcome = bench.bench(ranks, options.quick, old)
    print(bench.table(outcome))
    if options.json:
        bench.write(outcome, options.json)
    if old is None:
        return 0
    text, slower = bench.comparison(outcome, old)
    print(text)
    return int(slower)


def _predict(options: argparse.Namespace) -> None:
    from dataclasses import replace

    from mpitled.speed import predict

    counts, path = _numbers("--parts", options.parts), _model(options.model)
    cluster = predict.Cluster()
    for name, unit in (("latency", 1e-6), ("bandwidth", 1e9), ("rate", 1e6), ("fixed", 1e-6)):
        value = getattr(options, name)
        if value is not None:
            if not 0 < value < float("inf"):
                raise InputError(f"--{name} {value:g}: is not a number above 0; give one")
            cluster = replace(cluster, **{name: value * unit})
    out = options.out or path.parent
    rows = predict.predict(path, counts, cluster, out)
    _print(rows, partial(predict.table, cluster=cluster), options)
    if not options.json:
        print(f"written to {out}")


def _numbers(name: str, text: str) -> list[int]:
    """Whole numbers above 0 between commas."""
    words = text.split(",")
    if not all(word.strip().isdecimal() and int(word) > 0 for word in words):
        raise InputError(f"{name} {text}: is not a list of whole numbers above 0; write for example {name} 1,2")
    return [int(word) for word in words]


def _stability(options: argparse.Namespace) -> int:
    from mpitled.batch import stability

    rows = stability.matrix(options.out, [name for name in options.only.split(",") if name])
    print(stability.summary(rows))
    print(f"written to {options.out}")
    return 1 if any(row["outcome"] == stability.WRONG for row in rows) else 0


def _info(options: argparse.Namespace) -> int:
    from mpitled import info

    if options.json:
        print(json.dumps(info.contents(options.file) if options.file else info.versions(), indent=2))
    else:
        print(info.describe(options.file) if options.file else info.table())
    return 0 if options.file or info.complete() else 1


_COMMANDS: dict[str, Callable[[argparse.Namespace], int | None]] = {
    "run": _run,
    "sweep": _sweep,
    "new": _new,
    "check": _check,
    "build": _build,
    "partition": _partition,
    "report": _report,
    "view": _view,
    "compare": _compare,
    "study": _study,
    "stability": _stability,
    "bench": _bench,
    "predict": _predict,
    "export": _export,
    "info": _info,
}
