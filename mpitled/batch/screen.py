"""How far many runs are, on one screen: what ended as lines, and below them on a terminal what is at work."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence

_RED, _GREEN, _PLAIN = "\033[31m", "\033[32m", "\033[0m"
_BAR = 30


def share_done(log: Sequence[str]) -> float:
    """How far a run says it is in its log, from 0 to 1."""
    found = (re.match(r" *(\d+)%  ", line) for line in reversed(log))
    return next((int(match[1]) / 100 for match in found if match), 0.0)


class Screen:
    """Lines on stderr, or none if it is quiet; in colours, and with bars that stay below them, on a terminal only."""

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._live = sys.stderr.isatty() and not quiet
        self._bars = 0

    def tell(self, text: str, good: bool = True) -> None:
        """A line that stays."""
        if self._quiet:
            return
        self._clear()
        if self._live:
            text = f"{_GREEN if good else _RED}{text}{_PLAIN}"
        print(text, file=sys.stderr, flush=True)

    def show(self, shares: Mapping[str, float], waiting: int) -> None:
        """Bars of what is at work, by its name."""
        if not self._live:
            return
        self._clear()
        for name, share in shares.items():
            print(f"{share:4.0%} |{'#' * round(_BAR * share):{_BAR}}| {name[:70]}", file=sys.stderr)
        print(f"{waiting} waiting", file=sys.stderr, flush=True)
        self._bars = len(shares) + 1

    def _clear(self) -> None:
        if self._bars:
            print(f"\033[{self._bars}F\033[J", end="", file=sys.stderr, flush=True)
        self._bars = 0
