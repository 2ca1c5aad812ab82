"""Free memory and disc space of this machine, checked before they are used."""

from __future__ import annotations

import os
import resource
import shutil
from pathlib import Path

from mpitled.errors import InputError

#: Memory limits of control groups in Linux, each with the file of the present use, bytes.
_GROUPS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def memory() -> int:
    """Bytes that this process can still allocate: within the machine, its control group and its own limits."""
    free = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for line in _text("/proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            free.append(1024 * int(line.split()[1]))
    for most, taken in _GROUPS:
        if (limit := _text(most).strip()).isdecimal():
            free.append(int(limit) - int(_text(taken) or 0))
    size = [int(pages) * os.sysconf("SC_PAGE_SIZE") for pages in _text("/proc/self/statm").split()] or [0] * 7
    for which, taken_bytes in ((resource.RLIMIT_AS, size[0]), (resource.RLIMIT_DATA, size[5])):
        soft, _ = resource.getrlimit(which)
        if soft != resource.RLIM_INFINITY:
            free.append(soft - taken_bytes)
    return max(0, min(free))


def check_memory(needed: float, what: str, remedy: str) -> None:
    """InputError if `what` needs more bytes than are free."""
    if needed > (free := memory()):
        raise InputError(
            f"{what}: would take {format_bytes(needed)} of memory, and {format_bytes(free)} are free here; {remedy}"
        )


def check_disc(needed: float, directory: Path, what: str, remedy: str) -> None:
    """InputError if a file system has no space for `what` of so many bytes in a directory, which need not exist."""
    existing = directory.resolve()
    while not existing.exists():
        existing = existing.parent
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise InputError(
            f"{directory}: {what} takes {format_bytes(needed)}, and {format_bytes(free)} are free there; {remedy}"
        )


def format_bytes(size: float) -> str:
    """A size in words: "12.3 GB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"


def _text(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
