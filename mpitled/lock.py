"""A folder for one process at a time: a lock that ends with the process, on file systems that have locks."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from mpitled import atomic
from mpitled.errors import InputError

#: Of what computes into a folder; and of what starts a run there, and records how it ended.
RUN, TASK = ".lock", ".task.lock"
REMEDY = "is at work there; wait for its end, or give another --out"


class Taken(InputError):
    """Another process is at work in the folder."""


@contextmanager
def held(folder: Path, name: str, who: str = "run") -> Iterator[None]:
    """A folder, made if need be, for this process alone. Taken if another `who` is at work there."""
    atomic.make_folder(folder)
    path = folder / name
    while True:
        with atomic.writing(path):
            file = path.open("w")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise Taken(f"{folder}: another {who} {REMEDY}") from None
        except OSError:
            break  # there are none here
        if _is_there(file, path):
            break
        file.close()  # who held it has just removed it
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()
        file.close()


def _is_there(file: IO[str], path: Path) -> bool:
    """Whether an open file still has its name."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False
