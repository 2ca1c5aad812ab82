"""Memory and time per cell to build, partition and run models of millions of cells. Long: pytest -m study."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import ENVIRONMENT, ROOT
from scenes import block

#: A block compressed along z.
PRESSED = """
[[fixed]]
nodes = "z0"
[[displaced]]
nodes = "z1"
directions = ["z"]
displacement = [-1.0]
"""
#: Short runs, and upper bounds of their memory, bytes per cell. The arrays of a step have 93 bytes (jobs/bench). The
#: rest are the stability check, the last stable state, the forces of the power iteration, and in relaxation the
#: snapshots and the arrays of the eigenvalue estimate.
RUNS = {
    "dynamic run": ("solver.method=dynamic", "solver.load_time=0.002"),
    "relaxation": ("solver.method=dynamic-relaxation", "solver.tolerance=0.5"),
}
MAX_BYTES = {"dynamic run": 155, "relaxation": 280}
#: The fewest frames.
SHORT = ("output.frames=1", "output.pictures=false")


def measure(*words: object) -> tuple[float, int]:
    """Time, s, and peak memory, bytes, of a command."""
    begin = time.perf_counter()
    command = [str(Path(sys.executable).with_name("mpitled")), *map(str, words)]
    with subprocess.Popen(command, env=ENVIRONMENT, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    return time.perf_counter() - begin, 1024 * used.ru_maxrss


def cells_and_memory(deck: Path, out: Path, *keys: str) -> tuple[int, int]:
    """Cells and peak memory, bytes, of a run on one rank. The second run counts: the first compiles the kernels."""
    for _ in range(2):
        measure("run", deck, "-q", "--out", out, *(word for key in (*SHORT, *keys) for word in ("--set", key)))
    report = json.loads((out / "report.json").read_text())
    return sum(report["cells"].values()), report["peak_memory_bytes"][0]


@pytest.mark.study
def test_four_million_voxels(tmp_path):
    memory: dict[int, list[int]] = {}
    for n in (100, 159):
        deck, out = tmp_path / f"{n}.toml", tmp_path / str(n)
        deck.write_text(block((100, 100, 100), (n, n, n), nu=0.49) + PRESSED)
        built, cut = measure("build", deck, "--out", out), measure("partition", out, 2)
        print(f"{n**3} cells: built in {built[0]:.1f} s and {built[1] / 1e9:.2f} GB, cut in {cut[0]:.1f} s and "
              f"{cut[1] / 1e9:.2f} GB")  # fmt: skip
        memory[n] = [n**3, built[1]]
        for keys in RUNS.values():
            memory[n].append(cells_and_memory(deck, out, *keys)[1])
    assert built[0] + cut[0] < 180
    assert max(built[1], cut[1]) < 6 << 30
    cells, build, *runs = (large - small for large, small in zip(memory[159], memory[100], strict=True))
    print(f"build: {build / cells:.0f} bytes per cell")
    assert build / cells < 1024
    for name, run in zip(RUNS, runs, strict=True):
        print(f"{name}: {run / cells:.0f} bytes per cell")
        assert run / cells < MAX_BYTES[name]


METHOD = "solver.method=dynamic-relaxation"


@pytest.mark.study
def test_the_brain_at_two_sizes(tmp_path):
    """Hexahedra and support domains. The share of support domains falls with the element size, as in practice."""
    memory = []
    for size in (4.0, 2.0):
        key = f"labels.element_size={size}"
        deck, out = ROOT / "jobs" / "brain_tumour.toml", tmp_path / str(size)
        measure("build", deck, "--out", out, "--set", key)  # separate: needs more memory than the run
        memory.append(cells_and_memory(deck, out, key, METHOD))
    (few, small), (many, large) = memory
    print(f"{few} to {many} cells: {(large - small) / (many - few):.0f} bytes a cell")
    assert (large - small) / (many - few) < 450
