"""Two hosts and a cable: a run over TCP has the same bits, and a run ends if the cable is cut."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import ENVIRONMENT, ROOT, mpitled, ranks
from scenes import block, pulled

from mpitled.deck import load_deck
from mpitled.errors import InputError
from mpitled.solver import checkpoint
from mpitled.store import CHECKPOINTS, model_key, open_result

COMMAND = Path(sys.executable).with_name("mpitled")
SCRIPT = Path(__file__).with_name("two_hosts.sh")
#: Upper bound of the time of the launcher's keep-alive, the attempts of TCP and the end of the ranks, s.
END_SECONDS = 30
SCENE = f"""{block((20, 20, 20), (8, 7, 7), "core")}{pulled(1.0)}
[solver]
method = "dynamic"
load_time = 0.2
[output]
frames = 4
pictures = false
"""


def output(*words: object, check: bool = True) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*map(str, words)], capture_output=True, text=True, timeout=60, check=check)


@pytest.fixture
def hosts():
    """The tag of two hosts; they are removed after the test."""
    ranks(2)
    if shutil.which("ip") is None:
        pytest.skip("no ip (iproute2), which makes network namespaces")
    tag = f"mp{os.getpid() % 10**6}"
    up = output(SCRIPT, "up", tag, check=False)
    try:
        if up.returncode:
            pytest.skip(f"no permission for network namespaces: {up.stderr.strip().splitlines()[-1]}")
        yield tag
    finally:
        output(SCRIPT, "down", tag, check=False)


def processes(tag: str) -> str:
    """Processes on the hosts."""
    return "".join(output("ip", "netns", "pids", tag + host).stdout for host in "ab")


def start(tag: str, *words: object) -> subprocess.Popen[str]:
    return popen(SCRIPT, "run", tag, COMMAND, *words)


def popen(*words: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*map(str, words)], env=ENVIRONMENT, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )


def frames(out: Path) -> int:
    """Number of frames that can be read."""
    try:
        with open_result(out) as result:
            return result.n_frames
    except InputError:
        return 0


def wait(condition: Callable[[], object], job: subprocess.Popen[str] | None, seconds: float) -> None:
    """Wait until the condition holds, the job ends or the time is over."""
    begin = time.monotonic()
    while not condition() and (job is None or job.poll() is None) and time.monotonic() - begin < seconds:
        time.sleep(0.1)


def test_a_run_over_tcp_has_the_bits_of_one_on_a_single_host(hosts, tmp_path):
    deck = tmp_path / "scene.toml"
    deck.write_text(SCENE)
    job = start(hosts, "run", "-q", deck, "--out", tmp_path / "two")
    text, _ = job.communicate(timeout=120)
    assert job.returncode == 0, text
    received = output("ip", "netns", "exec", f"{hosts}b", "cat", f"/sys/class/net/{hosts}0/statistics/rx_bytes").stdout
    assert int(received) > 10**6  # forces of every step
    mpitled("run", "-q", deck, "--out", tmp_path / "one", n=2)
    with open_result(tmp_path / "one") as one, open_result(tmp_path / "two") as two:
        assert one.n_frames == two.n_frames == 5
        for frame in range(5):
            for name in ("parameters", "displacement"):
                assert one.point_data(name, frame).tobytes() == two.point_data(name, frame).tobytes()
            assert one.cell_data("J", frame).tobytes() == two.cell_data("J", frame).tobytes()
        series = [{name: values.tobytes() for name, values in result.series.items()} for result in (one, two)]
        assert series[0] == series[1]
    assert not processes(hosts)


def test_a_cut_cable_ends_the_job_on_both_hosts(hosts, tmp_path):
    deck, out = tmp_path / "scene.toml", tmp_path / "out"
    deck.write_text(SCENE)
    keys = ("solver.load_time=2000", "output.checkpoint_minutes=0.01")
    words = ["run", deck, "--out", out, *itertools.chain(*(("--set", key) for key in keys))]
    job = start(hosts, *words)
    try:
        wait(lambda: frames(out) and (out / CHECKPOINTS[0]).exists(), job, 60)
        assert job.poll() is None
        output(SCRIPT, "cut", hosts)
        text, _ = job.communicate(timeout=END_SECONDS)
    finally:
        job.kill()
    assert job.returncode != 0
    assert "lost communication" in text or "unable to communicate" in text.lower()
    wait(lambda: not processes(hosts), None, END_SECONDS)
    assert not processes(hosts)
    assert frames(out) > 0
    assert not (out / "result.vtkhdf").exists()
    # The run continues from its checkpoint on one host, beyond the step of the cut.
    scene, key = load_deck(deck, keys), model_key(out / "model.h5") or ""

    def step() -> int:
        last = checkpoint.find(out, scene, key)
        assert last is not None
        return int(last.contents["step"])

    step_of_cut = step()
    assert step_of_cut > 0
    job = popen(*ranks(2), COMMAND, *words, "--resume")
    wait(lambda: step() > step_of_cut, job, 60)
    job.send_signal(signal.SIGUSR1)
    text, _ = job.communicate(timeout=END_SECONDS)
    assert job.returncode == 4, text
    assert step() > step_of_cut
