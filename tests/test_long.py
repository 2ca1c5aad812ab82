"""A million steps: memory that does not grow, energy that does not drift, and a file of the size that was foretold."""

from __future__ import annotations

import contextlib
import ctypes
import re
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import ENVIRONMENT, ROOT, mpitled, ranks
from scenes import block, pulled

from mpitled.store import open_result

STEPS, FRAMES = 3_000_000, 50
#: What the energy of the body may differ from the work done on it, as a share. At any time by what the central
#: difference lets it swing, of the order of the squared product of step and frequency; on the way by no more than
#: chance lets the means of both halves of the frames differ, and less than DRIFT.
SWING, DRIFT = 1e-2, 1e-3
#: Growth of a rank's memory over the second half of the run, bytes: none, but for a page here and there.
GROWTH = 1 << 18
#: Stretched in 20 steps, half of its slowest period, and left to itself: it swings to the end, for nothing damps it.
SCENE = (
    block((20, 20, 20), (5, 5, 5), "core")
    + pulled(1.0)
    + """
[support]
nodes = 12
[solver]
method = "dynamic"
load_time = {load}
hold_time = {hold}
time_step = {step}
[output]
frames = {frames}
pictures = false
"""
)


def memory(of: int) -> int:
    """Resident bytes of a process."""
    return 4096 * int(Path(f"/proc/{of}/statm").read_text().split()[1])


def without_huge_pages() -> None:
    """Of this process and its children: the kernel makes 2 MiB of some pages when it likes, which is no growth."""
    ctypes.CDLL(None).prctl(41, 1, 0, 0, 0)  # PR_SET_THP_DISABLE


@pytest.mark.study
def test_a_million_steps_on_two_ranks(tmp_path):
    step = 1e-3
    deck, out = tmp_path / "scene.toml", tmp_path / "out"
    end = STEPS * step
    deck.write_text(SCENE.format(load=20 * step, hold=end - 20 * step, step=step, frames=FRAMES))
    told = mpitled("run", deck, "--dry", "--out", out, n=2).stdout
    print(told[: told.index("rank ")])
    command = [*ranks(2), "mpitled", "run", "-q", str(deck), "--out", str(out)]
    job = subprocess.Popen(
        command, env=ENVIRONMENT, cwd=ROOT, stderr=subprocess.PIPE, text=True, preexec_fn=without_huge_pages
    )
    samples: dict[int, list[tuple[float, int]]] = {}
    begin = time.monotonic()
    while job.poll() is None:
        children = Path(f"/proc/{job.pid}/task/{job.pid}/children").read_text().split()
        for rank in map(int, children):
            with contextlib.suppress(FileNotFoundError):
                samples.setdefault(rank, []).append((time.monotonic() - begin, memory(rank)))
        time.sleep(0.5)
    seconds = time.monotonic() - begin
    assert job.returncode == 0, job.stderr and job.stderr.read()
    assert len(samples) == 2
    for rank, seen in samples.items():
        times, bytes_ = np.array(seen).T
        late = (times > seconds / 2) & (times < 0.95 * seconds)
        slope = np.polyfit(times[late], bytes_[late], 1)[0]
        grown = slope * seconds / 2
        print(f"rank process {rank}: {bytes_[late].mean() / 2**20:.1f} MiB, {grown:.0f} bytes grown in the second half")
        assert grown < GROWTH
    foretold = float(re.search(r"^output: ([0-9.]+) kB", told, re.M)[1])  # type: ignore[index]
    assert 1e3 * foretold == pytest.approx((out / "result.vtkhdf").stat().st_size, rel=0.01)
    with open_result(out) as result:
        assert result.complete
        assert result.figures["steps"] >= STEPS
        series = {name: values[1:] for name, values in result.series.items()}
        total = sum(series[f"{name}_energy"] for name in ("strain", "hourglass", "stabilisation", "kinetic"))
        off = total / series["external_work"] - 1
        drift = off[FRAMES // 2 :].mean() - off[: FRAMES // 2].mean()
        chance = 3 * off.std() * (4 / FRAMES) ** 0.5
        kinetic = (series["kinetic_energy"] / total).mean()
        print(
            f"{result.figures['steps']} steps in {seconds:.0f} s; {kinetic:.1%} of the energy is kinetic, in the mean"
        )
        print(f"energy is off by {np.abs(off).max():.1e} at most, drifts by {drift:.1e} (chance: {chance:.1e})")
        assert kinetic > 0.05  # it swings
        assert np.abs(off).max() < SWING
        assert abs(drift) < min(chance, DRIFT)
