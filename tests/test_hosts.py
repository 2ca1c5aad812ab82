"""Two hosts joined by a cable: over TCP the bits of shared memory, and an end in order when the cable is cut."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import ENVIRONMENT, ROOT, mpitled, ranks
from scenes import block, pulled

from mpitled.deck import load_deck
from mpitled.errors import InputError
from mpitled.solver import checkpoint
from mpitled.store import CHECKPOINTS, model_key, open_result

SCRIPT = Path(__file__).with_name("two_hosts.sh")
#: All that the launcher's keep-alive, TCP's tries and the end of the ranks take, s.
SOON = 30
SCENE = f"""{block((20, 20, 20), (8, 7, 7), "core")}{pulled(1.0)}
[solver]
method = "dynamic"
load_time = 0.2
[output]
frames = 4
pictures = false
"""


def script(*words: object, **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(SCRIPT), *map(str, words)], capture_output=True, text=True, timeout=60, **options)  # type: ignore[call-overload,no-any-return]


@pytest.fixture
def hosts():
    """The tag of two hosts, which are gone afterwards, whatever happened on them."""
    ranks(2)
    if shutil.which("ip") is None:
        pytest.skip("no ip (iproute2), which makes network namespaces")
    tag = f"mp{os.getpid() % 10**6}"
    made = script("up", tag)
    try:
        if made.returncode:
            pytest.skip(f"network namespaces are not permitted here: {made.stderr.strip().splitlines()[-1]}")
        yield tag
    finally:
        script("down", tag)


def at_work(tag: str) -> str:
    """Processes on the hosts."""
    return "".join(
        subprocess.run(["ip", "netns", "pids", tag + host], capture_output=True, text=True, check=True).stdout
        for host in "ab"
    )


def start(tag: str, *words: object) -> subprocess.Popen[str]:
    command = [str(SCRIPT), "run", tag, str(Path(sys.executable).with_name("mpitled")), *map(str, words)]
    return subprocess.Popen(
        command, env=ENVIRONMENT, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )


def frames(out: Path) -> int:
    """Frames that can be read of a run that is at work, or was."""
    try:
        with open_result(out) as result:
            return result.n_frames
    except InputError:
        return 0


def test_a_run_over_tcp_has_the_bits_of_one_on_a_single_host(hosts, tmp_path):
    deck = tmp_path / "scene.toml"
    deck.write_text(SCENE)
    received = "/sys/class/net/{}0/statistics/rx_bytes"
    job = start(hosts, "run", "-q", deck, "--out", tmp_path / "two")
    said, _ = job.communicate(timeout=120)
    assert job.returncode == 0, said
    counted = subprocess.run(
        ["ip", "netns", "exec", f"{hosts}b", "cat", received.format(hosts)], capture_output=True, text=True, check=True
    )
    assert int(counted.stdout) > 10**6  # forces, every step
    mpitled("run", "-q", deck, "--out", tmp_path / "one", n=2)
    with open_result(tmp_path / "one") as one, open_result(tmp_path / "two") as two:
        assert one.n_frames == two.n_frames == 5
        for frame in range(5):
            for name in ("parameters", "displacement"):
                assert one.point_data(name, frame).tobytes() == two.point_data(name, frame).tobytes()
            assert one.cell_data("J", frame).tobytes() == two.cell_data("J", frame).tobytes()
        assert {name: values.tobytes() for name, values in one.series.items()} == {
            name: values.tobytes() for name, values in two.series.items()
        }
    assert not at_work(hosts)


def test_a_cut_cable_ends_the_job_on_both_hosts(hosts, tmp_path):
    deck, out = tmp_path / "scene.toml", tmp_path / "out"
    deck.write_text(SCENE)
    keys = ("solver.load_time=2000", "output.checkpoint_minutes=0.01")
    job = start(hosts, "run", deck, "--out", out, *itertools.chain(*(("--set", key) for key in keys)))
    begin = time.monotonic()
    try:
        while (
            not (frames(out) and (out / CHECKPOINTS[0]).exists())
            and job.poll() is None
            and time.monotonic() - begin < 60
        ):
            time.sleep(0.1)
        assert job.poll() is None
        script("cut", hosts, check=True)
        begin = time.monotonic()
        said, _ = job.communicate(timeout=SOON)
    finally:
        job.kill()
    print(f"ended {time.monotonic() - begin:.1f} s after the cut:\n{said}")
    assert job.returncode != 0
    assert "lost communication" in said or "unable to communicate" in said.lower()
    while at_work(hosts) and time.monotonic() - begin < SOON:
        time.sleep(0.2)
    assert not at_work(hosts)
    assert frames(out) > 0
    assert not (out / "result.vtkhdf").exists()
    # The run goes on from what is left, on one host, and farther than it had come.
    scene, key = load_deck(deck, keys), model_key(out / "model.h5") or ""

    def step() -> int:
        kept = checkpoint.find(out, scene, key)
        assert kept is not None
        return int(kept.contents["step"])

    cut_at = step()
    assert cut_at > 0
    words = [
        *ranks(2),
        Path(sys.executable).with_name("mpitled"),
        "run",
        deck,
        "--out",
        out,
        "--resume",
        *itertools.chain(*(("--set", key) for key in keys)),
    ]
    job = subprocess.Popen([str(word) for word in words], env=ENVIRONMENT, cwd=ROOT, text=True, stderr=subprocess.PIPE)
    begin = time.monotonic()
    while step() == cut_at and job.poll() is None and time.monotonic() - begin < 60:
        time.sleep(0.1)
    job.send_signal(signal.SIGUSR1)
    _, said = job.communicate(timeout=SOON)
    assert job.returncode == 4, said
    assert "--resume goes on" in said
    assert step() > cut_at
