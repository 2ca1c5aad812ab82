"""Locks on folders for one process at a time. The operating system releases a lock when its process ends."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from mpitled import atomic
from mpitled.errors import InputError

#: Lock file of a process that computes into a folder, and of a process that starts a run and records its outcome.
RUN, TASK = ".lock", ".task.lock"
REMEDY = "is at work there; wait for its end, or give another --out"


class LockError(InputError):
    """Another process holds the lock of the folder."""


@contextmanager
def directory_lock(folder: Path, name: str, owner: str = "run") -> Iterator[None]:
    """Hold the lock `name` of a folder, which is created if necessary. Without effect on a file system without locks.

    LockError if another process, called `owner` in the message, holds the lock.
    """
    atomic.make_folder(folder)
    path = folder / name
    while True:
        with atomic.writing(path):
            file = path.open("w")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise LockError(f"{folder}: another {owner} {REMEDY}") from None
        except OSError:
            break  # the file system has no locks
        if _is_file_at(file, path):
            break
        file.close()  # the previous owner has just removed the file
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()
        file.close()


def _is_file_at(file: IO[str], path: Path) -> bool:
    """Whether the path still leads to this open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False
