"""A folder for one process at a time: a lock that ends with the process, on file systems that have locks."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mpitled import atomic
from mpitled.errors import InputError

#: Of what computes into a folder; and of what starts a run there, and records how it ended.
RUN, TASK = ".lock", ".task.lock"
REMEDY = "is at work there; wait for its end, or give another --out"


class Taken(InputError):
    """Another process is at work in the folder."""


@contextmanager
def held(folder: Path, name: str, who: str = "run") -> Iterator[None]:
    """A folder, made if need be, for this process alone. Taken if another `who` is at work there.

    The file of the lock stays: to remove one that somebody waits for would let two in.
    """
    atomic.make_folder(folder)
    path = folder / name
    with atomic.writing(path):
        file = path.open("w")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Taken(f"{folder}: another {who} {REMEDY}") from None
        except OSError:
            pass  # there are none here
        yield
