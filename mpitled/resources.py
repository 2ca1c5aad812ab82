"""What this machine has room for: memory and disc, asked before they are taken."""

from __future__ import annotations

import os
import resource
import shutil
from pathlib import Path

from mpitled.errors import InputError

#: Files in which Linux says what a process may still take: bytes, and the file with what is taken of them.
_GROUPS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def memory() -> int:
    """Bytes that this process can still take: the least of what machine, control group and its own limits leave."""
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
    """InputError if `what`, which is about to take so many bytes, finds no room for them."""
    if needed > (free := memory()):
        raise InputError(f"{what}: would take {told(needed)} of memory, and {told(free)} are free here; {remedy}")


def check_disc(needed: float, directory: Path, what: str, remedy: str) -> None:
    """InputError if a file system has no room for `what` of so many bytes in a directory, which need not be there."""
    place = directory.resolve()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if needed > free:
        raise InputError(f"{directory}: {what} takes {told(needed)}, and {told(free)} are free there; {remedy}")


def told(size: float) -> str:
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
