"""Free memory and disc space of this machine."""

from __future__ import annotations

import os
import resource
import shutil
from pathlib import Path

from mpitled.errors import InputError

#: Files with the memory limit and the memory use of control groups (Linux, versions 2 and 1), bytes.
_GROUPS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def memory() -> int:
    """Bytes that this process can still allocate, by the machine, the control group and the limits of the process."""
    free = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for line in _text("/proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            free.append(1024 * int(line.split()[1]))
    for limit_file, use_file in _GROUPS:
        if (limit := _text(limit_file).strip()).isdecimal():
            free.append(int(limit) - int(_text(use_file) or 0))
    size = [int(pages) * os.sysconf("SC_PAGE_SIZE") for pages in _text("/proc/self/statm").split()] or [0] * 7
    for which, used in ((resource.RLIMIT_AS, size[0]), (resource.RLIMIT_DATA, size[5])):
        soft, _ = resource.getrlimit(which)
        if soft != resource.RLIM_INFINITY:
            free.append(soft - used)
    return max(0, min(free))


def check_memory(needed: float, what: str, remedy: str) -> None:
    """InputError if `what` needs more bytes of memory than are free; the message ends with the remedy."""
    if needed > (free := memory()):
        raise InputError(
            f"{what}: would take {format_bytes(needed)} of memory, and {format_bytes(free)} are free here; {remedy}"
        )


def check_disc(needed: float, directory: Path, what: str, remedy: str) -> None:
    """InputError if `what` needs more bytes than are free on the disc of a directory, which need not exist yet."""
    existing = directory.resolve()
    while not existing.exists():
        existing = existing.parent
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise InputError(
            f"{directory}: {what} takes {format_bytes(needed)}, and {format_bytes(free)} are free there; {remedy}"
        )


def format_bytes(size: float) -> str:
    """A size in bytes as text, such as "12.3 GB"."""
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
