"""The command line: `mpitled run|build|check|export|partition|report|compare|study|bench|predict|info`."""

from __future__ import annotations

import argparse
import json
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from mpitled import __version__
from mpitled.errors import InputError, MpitledError

# Modules are imported by the command that needs them: `--help` must not wait for compilers and libraries.


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command; exit status 0 done, 1 broken, 2 bad input, 3 unstable, 4 interrupted."""
    options = _parser().parse_args(arguments)
    try:
        status = options.command(options)
    except MpitledError as error:
        _end(error, error.status)
    except BrokenPipeError:
        os._exit(1)
    except Exception as error:
        traceback.print_exc()
        _end(error, 1)
    sys.exit(status or 0)


def _end(error: Exception, status: int) -> NoReturn:
    """One message, and the end of every rank: alike if all know of the error, else by aborting the job."""
    from mpitled.halo import World

    world = World()
    if getattr(error, "everywhere", False) or world.size == 1:
        if world.leads:
            print(f"mpitled: {error}", file=sys.stderr, flush=True)
        sys.exit(status)
    print(f"mpitled: rank {world.rank}: {error}", file=sys.stderr, flush=True)
    world.abort(status)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mpitled",
        description="Brain deformation by tumour growth: coupled FE/EFG and explicit dynamics on MPI ranks.",
    )
    parser.add_argument("--version", action="version", version=f"mpitled {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="compute a deck; on N ranks: mpirun -n N mpitled run DECK")
    _deck_arguments(run)
    run.add_argument("-q", "--quiet", action="store_true", help="no progress and no table")
    run.add_argument("--dry", action="store_true", help="say what would be done, and how long it would take; no step")
    run.set_defaults(command=_run)

    build = commands.add_parser("build", help="build the model of a deck")
    _deck_arguments(build)
    build.set_defaults(command=_build)

    check = commands.add_parser("check", help="check a mesh file or a deck, and say what is in it")
    check.add_argument("file", type=Path, help="a mesh (Abaqus, LS-DYNA, or what meshio reads), or a deck (TOML)")
    check.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a key of the deck; repeatable"
    )
    check.set_defaults(command=_check)

    export = commands.add_parser("export", help="write a model as decks that run to the same result, here or elsewhere")
    export.add_argument("model", type=Path, help="model.h5, or the folder that holds it")
    export.add_argument("--abaqus", action="store_true", required=True, help="as Abaqus decks and a CSV table")
    export.add_argument("--out", type=Path, metavar="DIR", help="folder of the decks (export beside the model)")
    export.set_defaults(command=_export)

    part = commands.add_parser("partition", help="partition a model ahead of a job")
    part.add_argument("model", type=Path, help="model.h5, or the folder that holds it")
    part.add_argument("parts", type=int, help="number of ranks")
    part.add_argument("--seed", type=int, default=0, help="METIS's seed (0)")
    part.set_defaults(command=_partition)

    report = commands.add_parser("report", help="table, report.json and pictures of a run")
    report.add_argument("directory", type=Path, help="the folder that a run wrote")
    report.set_defaults(command=_report)

    compare = commands.add_parser("compare", help="errors of a result against a reference, in mm")
    compare.add_argument("result", type=Path, help="the folder that a run wrote")
    compare.add_argument(
        "reference", type=Path, help=".npz, .csv, .vtu or .vtkhdf in metres, or a folder of another run"
    )
    compare.add_argument(
        "--beyond", type=float, metavar="MM", help="also only places farther than this from edges of prescribed surface"
    )
    compare.add_argument("--json", action="store_true", help="JSON instead of a table")
    compare.set_defaults(command=_compare)

    study = commands.add_parser("study", help="error against run time over varied keys; goes on where it was stopped")
    _deck_arguments(study)
    study.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="KEY=A,B,...",
        help="a family of runs; keys that go together: KEY=A,B+KEY=C,D; ranks=1,2 varies the ranks; repeatable",
    )
    study.add_argument("--reference", type=Path, help="what errors are against (see compare); else the own estimate")
    study.add_argument("--beyond", type=float, metavar="MM", help="errors farther than this from prescribed edges")
    study.set_defaults(command=_study)

    bench = commands.add_parser("bench", help="speed of the step on fixed scenes, against what the machine can do")
    bench.add_argument("--json", type=Path, metavar="FILE", help="write the outcome")
    bench.add_argument("--compare", type=Path, metavar="OLD.json", help="exit status 1 if a case is 10 %% slower")
    bench.add_argument("--ranks", metavar="N,...", help="numbers of ranks (1,2 where there are two cores)")
    bench.add_argument("--quick", action="store_true", help="the smallest of each scene, in less time")
    bench.add_argument("--omissions", action="store_true", help="instead: what each thing costs that a scene can lack")
    bench.set_defaults(command=_bench)

    predict = commands.add_parser("predict", help="efficiency on a cluster, from real partitions in many parts")
    predict.add_argument("model", type=Path, help="model.h5, or the folder that holds it")
    predict.add_argument(
        "--parts", default="64,256,1024,4096,16384", metavar="N,...", help="numbers of ranks (%(default)s)"
    )
    predict.add_argument("--latency", type=float, metavar="US", help="microseconds a message takes (1.5)")
    predict.add_argument("--bandwidth", type=float, metavar="GB/S", help="of one rank, in each direction (10)")
    predict.add_argument("--rate", type=float, metavar="M", help="million hexahedra a second of one core (25)")
    predict.add_argument("--fixed", type=float, metavar="US", help="microseconds of a step that depend on no size (15)")
    predict.add_argument("--out", type=Path, metavar="DIR", help="folder of predict.csv and predict.png (the model's)")
    predict.set_defaults(command=_predict)

    info = commands.add_parser("info", help="versions of what mpitled works with, and what is missing; or of a file")
    info.add_argument("file", type=Path, nargs="?", help="model.h5 or result.vtkhdf: say what it is and holds")
    info.set_defaults(command=_info)
    return parser


def _deck_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("deck", type=Path, help="the scene, a TOML file")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the results (out/NAME OF THE DECK)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a key of the deck; repeatable"
    )


def _output(options: argparse.Namespace) -> Path:
    return options.out or Path("out") / options.deck.stem


def _run(options: argparse.Namespace) -> None:
    from mpitled.deck import load_deck
    from mpitled.halo import World
    from mpitled.run import everywhere, run

    world = World()
    with everywhere():  # each rank reads the same file
        deck = load_deck(options.deck, options.set)
    if options.dry:
        from mpitled.dry import dry_run

        told = dry_run(deck, _output(options), world)
        if world.leads:
            print(told)
        return
    made = run(deck, _output(options), world, quiet=options.quiet)
    if world.leads and not options.quiet:
        from mpitled import report

        print(report.table(made))
        print(f"written to {_output(options)}")


def _build(options: argparse.Namespace) -> None:
    from mpitled.deck import load_deck
    from mpitled.run import build
    from mpitled.store import describe_model

    path, built = build(load_deck(options.deck, options.set), _output(options))
    print(f"{path}: {'built' if built else 'up to date'}")
    print(describe_model(path))


def _check(options: argparse.Namespace) -> None:
    from mpitled import overview

    print(overview.check(options.file, options.set))


def _export(options: argparse.Namespace) -> None:
    from mpitled import export

    path = _model(options.model)
    for written in export.write_abaqus(path, options.out or path.parent / "export"):
        print(written)


def _model(path: Path) -> Path:
    from mpitled.run import MODEL

    return path / MODEL if path.is_dir() else path


def _partition(options: argparse.Namespace) -> None:
    from mpitled.run import divide

    path = _model(options.model)
    if options.parts < 2:
        raise InputError(f"{options.parts} parts: one rank needs no partition; ask for 2 or more")
    print(divide(path, options.parts, options.seed))


def _report(options: argparse.Namespace) -> None:
    from mpitled import report

    print(report.table(report.write(options.directory)))


def _compare(options: argparse.Namespace) -> None:
    from mpitled import compare

    figures = compare.compare(options.result, options.reference, options.beyond and options.beyond / 1e3)
    print(json.dumps(figures, indent=2) if options.json else compare.table(figures))


def _study(options: argparse.Namespace) -> None:
    from mpitled import study

    beyond = options.beyond and options.beyond / 1e3
    out = options.out or Path("out") / f"study_{options.deck.stem}"
    print(study.table(study.study(options.deck, options.reference, options.vary, options.set, out, beyond)))
    print(f"written to {out}")


def _bench(options: argparse.Namespace) -> int:
    from mpitled import bench

    if options.omissions:
        from mpitled import omissions

        print(omissions.measure(options.quick))
        return 0
    ranks = _numbers("--ranks", options.ranks) if options.ranks else bench.default_ranks()
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

    from mpitled import predict

    counts, path = _numbers("--parts", options.parts), _model(options.model)
    cluster = predict.Cluster()
    for name, unit in (("latency", 1e-6), ("bandwidth", 1e9), ("rate", 1e6), ("fixed", 1e-6)):
        value = getattr(options, name)
        if value is not None:
            if not 0 < value < float("inf"):
                raise InputError(f"--{name} {value:g}: is not a number above 0; give one")
            cluster = replace(cluster, **{name: value * unit})
    out = options.out or path.parent
    print(predict.table(predict.predict(path, counts, cluster, out), cluster))
    print(f"written to {out}")


def _numbers(name: str, text: str) -> list[int]:
    """Whole numbers above 0 between commas."""
    words = text.split(",")
    if not all(word.strip().isdecimal() and int(word) > 0 for word in words):
        raise InputError(f"{name} {text}: is not a list of whole numbers above 0; write for example {name} 1,2")
    return [int(word) for word in words]


def _info(options: argparse.Namespace) -> int:
    from mpitled import info

    if options.file:
        print(info.describe(options.file))
        return 0
    print(info.table())
    return 0 if info.complete() else 1
