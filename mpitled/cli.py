# PYTHON_ARGCOMPLETE_OK
"""The command line: parse the arguments, execute the command, end with its exit status."""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Sequence
from typing import NoReturn

from mpitled import __version__, commands
from mpitled.errors import InterruptedRun, MpitledError


def main(words: Sequence[str] | None = None) -> NoReturn:
    """Execute a command. Exit status: 0 done, 1 error of the program, 2 bad input, 3 unstable, 4 interrupted."""
    parser = argparse.ArgumentParser(
        prog="mpitled",
        description="Brain deformation by tumour growth: coupled FE/EFG and explicit dynamics on MPI ranks.",
    )
    parser.add_argument("--version", action="version", version=f"mpitled {__version__}")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for add in commands.COMMANDS:
        add(subparsers)
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
    except KeyboardInterrupt:  # runs and sweeps handle the signal themselves
        print("mpitled: interrupted", file=sys.stderr, flush=True)
        sys.exit(InterruptedRun.status)
    except ImportError as error:
        _end_without_library(error)
    except Exception as error:
        traceback.print_exc()
        _end(error, 1)
    sys.exit(status or 0)


def _end(error: Exception, status: int) -> NoReturn:
    """Print one message and end all ranks: by exit if all ranks raise the error, else by an abort."""
    from mpitled.parallel.halo import World

    world = World()
    if getattr(error, "everywhere", False) or world.size == 1:
        if world.leads:
            print(f"mpitled: {error}", file=sys.stderr, flush=True)
        sys.exit(status)
    print(f"mpitled: rank {world.rank}: {error}", file=sys.stderr, flush=True)
    world.abort(status)


def _end_without_library(error: ImportError) -> NoReturn:
    """End because a library is missing or cannot be loaded, which may be the MPI library."""
    print(f"mpitled: {error}; 'mpitled info' lists what is missing and its remedy", file=sys.stderr, flush=True)
    if "mpi4py.MPI" in sys.modules:
        from mpitled.parallel.halo import World

        World().abort(2)
    sys.exit(2)


def _log_phases() -> None:
    """Print each phase of the run on stderr, with time and rank."""
    import logging

    from mpitled.parallel.halo import World

    logging.basicConfig(format=f"%(asctime)s rank {World().rank}: %(message)s", level=logging.WARNING)
    logging.getLogger("mpitled").setLevel(logging.INFO)
