"""Three million steps: constant memory, no drift of the energy, and the predicted size of the result. Long."""

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
#: Upper bounds of the relative energy error. The energy of the central difference method oscillates with an amplitude
#: of the order (time step times frequency)^2, at most OSCILLATION. The means of both halves of the frames differ by at
#: most DRIFT, and by no more than their statistical error.
OSCILLATION, DRIFT = 1e-2, 1e-3
#: Upper bound of the growth of a rank's memory in the second half of the run, bytes: a few pages.
GROWTH = 1 << 18
#: A block that is stretched in 20 steps, half of its longest period, and then oscillates without damping.
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


def memory(process: int) -> int:
    """Resident bytes of a process."""
    return 4096 * int(Path(f"/proc/{process}/statm").read_text().split()[1])


def without_huge_pages() -> None:
    """Switch huge pages off for this process and its children: their use would count as growth."""
    ctypes.CDLL(None).prctl(41, 1, 0, 0, 0)  # PR_SET_THP_DISABLE


@pytest.mark.study
def test_three_million_steps_on_two_ranks(tmp_path):
    step = 1e-3
    deck, out = tmp_path / "scene.toml", tmp_path / "out"
    end = STEPS * step
    deck.write_text(SCENE.format(load=20 * step, hold=end - 20 * step, step=step, frames=FRAMES))
    dry = mpitled("run", deck, "--dry", "--out", out, n=2).stdout
    print(dry[: dry.index("rank ")])
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
    for rank, of_rank in samples.items():
        times, sizes = np.array(of_rank).T
        late = (times > seconds / 2) & (times < 0.95 * seconds)
        growth = np.polyfit(times[late], sizes[late], 1)[0] * seconds / 2
        print(f"process {rank}: {sizes[late].mean() / 2**20:.1f} MiB, growth {growth:.0f} bytes in the second half")
        assert growth < GROWTH
    predicted = float(re.search(r"^output: ([0-9.]+) kB", dry, re.M)[1])  # type: ignore[index]
    assert 1e3 * predicted == pytest.approx((out / "result.vtkhdf").stat().st_size, rel=0.01)
    with open_result(out) as result:
        assert result.complete
        assert result.figures["steps"] >= STEPS
        series = {name: values[1:] for name, values in result.series.items()}
        total = sum(series[f"{name}_energy"] for name in ("strain", "hourglass", "stabilisation", "kinetic"))
        error = total / series["external_work"] - 1
        drift = error[FRAMES // 2 :].mean() - error[: FRAMES // 2].mean()
        deviation = 3 * error.std() * (4 / FRAMES) ** 0.5
        kinetic = (series["kinetic_energy"] / total).mean()
        print(f"{result.figures['steps']} steps in {seconds:.0f} s; mean share of kinetic energy {kinetic:.1%}")
        print(f"energy error {np.abs(error).max():.1e}, drift {drift:.1e} (three standard deviations {deviation:.1e})")
        assert kinetic > 0.05  # the block oscillates
        assert np.abs(error).max() < OSCILLATION
        assert abs(drift) < min(deviation, DRIFT)
