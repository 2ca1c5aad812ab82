"""Progress of a run, wall time of its phases, and signals that end it."""

from __future__ import annotations

import logging
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mpitled.errors import InterruptedRun
from mpitled.parallel.halo import World

#: Signals that end a run in order. On the first two mpirun ends its ranks itself, within a second; it passes on the
#: third.
INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)

_log = logging.getLogger(__name__)


class Phases:
    """Wall time of each phase of a run, s."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        if name not in self.seconds:
            _log.info("%s", name)
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin


class Interrupts:
    """Signals that end a run in order: at its next check, or immediately, by rank 0, where there are no checks."""

    def __init__(self, world: World) -> None:
        self.asked, self.at_checks = False, False
        self.when = "before the first step; nothing is lost"
        self._leads = world.leads

    def __enter__(self) -> Interrupts:
        self._previous = {which: signal.signal(which, self._note) for which in INTERRUPTS}
        return self

    def __exit__(self, *_: object) -> None:
        for which, handler in self._previous.items():
            signal.signal(which, handler)

    def _note(self, signum: int, frame: object) -> None:
        self.asked = True
        if self._leads and not self.at_checks:
            raise InterruptedRun(f"interrupted {self.when}")


class Progress:
    """Progress on stderr: a bar on a terminal, else a line for every tenth of the run."""

    def __init__(self, done: float, step: int) -> None:
        """done, step: share and step at which the run starts; not 0 if it is resumed."""
        self.begin, self.first_done, self.first_step = time.perf_counter(), done, step
        self.tenth = int(10 * done)
        self.bar: Any = None
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

            columns = (TaskProgressColumn(), BarColumn(), TextColumn("{task.description}", markup=False))
            self.bar = Progress(*columns, console=Console(stderr=True))
            self.bar.add_task("", total=1.0, completed=done)
            self.bar.start()

    def show(self, done: float, step: int, figures: dict[str, float]) -> None:
        seconds = max(time.perf_counter() - self.begin, 1e-9)
        rate = (step - self.first_step) / seconds
        state = (
            f"{rate:.0f} steps/s, kinetic/internal {figures['kinetic_ratio']:.1e}, min J {figures['min_jacobian']:.3f}"
        )
        left = max(0.0, (1 - done) / max(done - self.first_done, 1e-9) * seconds)
        if self.bar is not None:
            self.bar.update(self.bar.task_ids[0], completed=done, description=f"{left:.0f} s left, {state}")
        elif (tenth := int(10 * done + 1e-6)) > self.tenth:  # the sum of all steps is short of 1 by round-off
            self.tenth = tenth
            print(f"{done:4.0%}  {left:5.0f} s left  {state}", file=sys.stderr, flush=True)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.stop()
