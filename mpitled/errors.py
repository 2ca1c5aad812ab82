"""The errors of the program, each with the exit status of the command that it ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class MpitledError(Exception):
    """An expected error: the user sees one line and no traceback."""

    status = 1
    everywhere = False  # whether every rank raises the error, so that one message is enough and no abort is needed


class InputError(MpitledError):
    """Bad input. The message names the file, the line or key, and the remedy."""

    status = 2


class UnstableError(MpitledError):
    """The computation cannot continue. The message names the cell, its position and the remedy."""

    status = 3


class InterruptedRun(MpitledError):
    """A signal (Ctrl-C, SIGTERM) ended the run. The files are readable, and the run can be resumed."""

    status = 4


@contextmanager
def damaged(path: Path, remedy: str) -> Iterator[None]:
    """Turn any error inside into an InputError: the file, which this program wrote, was damaged or changed."""
    try:
        yield
    except MpitledError:
        raise
    except Exception as error:  # h5py, json and numpy raise errors of many types
        reason = " ".join(str(error).split())[:100] or "its contents are inconsistent"
        raise InputError(f"{path}: is damaged ({type(error).__name__}: {reason}); {remedy}") from error


@contextmanager
def everywhere() -> Iterator[None]:
    """Mark errors inside as raised on every rank, so that the command does not abort the other ranks."""
    try:
        yield
    except MpitledError as error:
        error.everywhere = True
        raise
