"""The errors that a user meets, each with the exit status of the command that ends with it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class MpitledError(Exception):
    """An end with a reason: one line to the user, no traceback."""

    status = 1
    everywhere = False  # whether every rank raises it alike, so that one message is enough and none need be aborted


class InputError(MpitledError):
    """Bad input: names the file, the line or key, and the remedy."""

    status = 2


class UnstableError(MpitledError):
    """The computation cannot go on: names the cell, the place and what to change."""

    status = 3


class InterruptedRun(MpitledError):
    """Ended from outside (Ctrl-C, SIGTERM); what was written is readable, and the run can go on from there."""

    status = 4


@contextmanager
def damaged(path: Path, remedy: str) -> Iterator[None]:
    """What goes wrong inside, with the contents of a file of ours that others may have changed, as an InputError."""
    try:
        yield
    except MpitledError:
        raise
    except Exception as error:  # of h5py, json and numpy, each of which raises what it likes
        reason = " ".join(str(error).split())[:100] or "it does not fit together"
        raise InputError(f"{path}: is damaged ({type(error).__name__}: {reason}); {remedy}") from error


@contextmanager
def everywhere() -> Iterator[None]:
    """What is raised inside is raised on every rank alike: the command need not abort the others."""
    try:
        yield
    except MpitledError as error:
        error.everywhere = True
        raise
