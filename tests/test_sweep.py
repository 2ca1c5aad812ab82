"""Sweeps: the same table on processes and on groups of ranks, after a kill, with broken cases, and from array jobs."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ENVIRONMENT, ROOT, complaint, mpitled
from scenes import TUMOUR, block, pulled

from mpitled import lock, open_sweep
from mpitled.batch import array_job, cases, launch, summary, terminal, vary
from mpitled.errors import InputError
from mpitled.store import checkpoint_contents

CUBE = ROOT / "jobs" / "validation" / "cube.toml"
#: Three cases on one model; half the height in one step turns cells inside out.
WORDS = [
    "sweep", CUBE, "--set", "solver.method=dynamic-relaxation", "--set", "block.elements=[2,2,2]",
    "--vary", "solver.load_steps=400,500,1",
]  # fmt: skip
GROWTH = f"""{TUMOUR}
[solver]
method = "quasi-static"
load_time = 0.5
[output]
pictures = false
"""


@pytest.fixture
def deck(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(GROWTH)
    return path


@pytest.fixture(scope="module")
def groups(tmp_path_factory):
    """The folder of a sweep that two groups of one rank computed, and their stderr."""
    out = tmp_path_factory.mktemp("sweep") / "out"
    return out, mpitled(*WORDS, "--out", out, n=2, status=3).stderr


def wait_until(condition: Callable[[], object], seconds: float = 120) -> None:
    deadline = time.time() + seconds
    while not condition() and time.time() < deadline:
        time.sleep(0.02)


def read(folder: Path) -> list[dict[str, str]]:
    with (folder / "table.csv").open() as file:
        return list(csv.DictReader(file))


def start(*words: object) -> subprocess.Popen[str]:
    """The command in a process of its own."""
    command = [str(Path(sys.executable).with_name("mpitled")), *map(str, words)]
    return subprocess.Popen(command, env=ENVIRONMENT, cwd=ROOT, stderr=subprocess.DEVNULL, text=True)


def at_work(folder: Path) -> list[int]:
    """Numbers of the processes that have the folder in their command."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "cmdline").read_bytes()
        except OSError:
            continue
        if str(folder).encode() in words:
            found.append(int(process.name))
    return found


def test_a_killed_sweep_gives_the_table_of_groups_of_ranks(tmp_path, groups):
    by_groups, stderr = groups
    rows = read(by_groups)
    assert [row["solver.load_steps"] for row in rows] == ["400.0", "500.0", "1.0"]
    assert ["unstable" in row["failure"] for row in rows] == [False, False, True]
    assert float(rows[0]["min_jacobian"]) > 0
    assert rows[2]["min_jacobian"] == ""
    assert f"3 cases, 2 at a time; logs in {by_groups}/*/run.log" in stderr.splitlines()
    ended = [line for line in stderr.splitlines() if line.startswith("[")]
    assert {line[:13] for line in ended} >= {"[3 of 3 done]"}  # two groups that end at the same time both count 3
    assert sum("of 3 done] solver.load_steps=1: broken: unstable" in line for line in ended) == 1

    out = tmp_path / "killed"
    with start(*WORDS, "--out", out) as process:
        wait_until(lambda: list(out.glob("*/done.json")))
        process.send_signal(signal.SIGKILL)
    ended = {path: path.stat().st_mtime_ns for path in out.glob("*/done.json")}
    assert 0 < len(ended) < 3
    wait_until(lambda: not at_work(out), 10)
    assert at_work(out) == []  # the processes of the cases ended with the sweep
    mpitled("sweep", out, status=3)
    assert (out / "table.csv").read_bytes() == (by_groups / "table.csv").read_bytes()
    assert all(path.stat().st_mtime_ns == then for path, then in ended.items())
    assert len({path.stat().st_ino for path in out.glob("*/model.h5")}) == 1  # of all three

    ended = {path: path.stat().st_mtime_ns for path in out.glob("*/done.json")}
    again = mpitled("sweep", out, "--retry", status=3)
    assert again.stderr.count("broken: unstable") == 1
    assert sum(path.stat().st_mtime_ns == then for path, then in ended.items()) == 2


def test_table_in_hdf5_markdown_and_html(tmp_path, groups):
    out, _ = groups
    beside = tmp_path / "by_hand.csv"
    beside.write_text("solver.load_steps,max_displacement_mm\n500,12.5\n")
    assert "by_hand " in mpitled("report", out, "--beside", beside, status=3).stdout
    with h5py.File(out / "table.h5") as file:
        assert file["table/solver.load_steps"][:].tolist() == [400, 500, 1]
        assert (file["table/static_distance_mm"][:2] < 0.01).all()  # the tolerance of relaxation
        assert np.isnan(file["table/static_distance_mm"][2])
        assert [bool(text) for text in file["table/failure"].asstr()[:]] == [False, False, True]
        assert (file["times/whole_s"][:2] > file["times/loop_s"][:2]).all()
    lines = (out / "table.md").read_text().splitlines()
    assert len(lines) == 6  # headings, rule, three cases, and the compared figures
    assert "12.50" in lines[4]
    page = (out / "table.html").read_text()
    assert page.count("<tr>") == 5
    assert page.count('<img src="data:image/png;base64,') == 2
    for name in ("quantities.png", "cost.png"):
        assert (out / name).stat().st_size > 10_000
    assert [record["case"] for record in open_sweep(out)] == [1, 2, 3]
    again = mpitled(*WORDS[:6], "--cases", out / "table.csv", "--out", out, "-q", "--retry", status=3)
    assert (again.stdout, again.stderr) == ("", "1 broken; --retry computes them again\n")


def test_a_table_shows_which_cases_have_warnings(tmp_path, groups, capsys):
    out = shutil.copytree(groups[0], tmp_path / "out")
    sweep = cases.read(out)
    path = sweep.cases[1].folder / "report.json"
    made = json.loads(path.read_text())
    path.write_text(json.dumps(made | {"warnings": ["far from rest", "coarse"], "cloud_misfit_mm": 0.75}))
    table = summary.collect(sweep)
    summary.write(sweep, table)
    line = "warning for solver.load_steps=500: far from rest; coarse"
    summary.show(table)
    printed = capsys.readouterr().out.splitlines()
    assert [row.split()[1] == "*" for row in printed[-4:-1]] == [False, True, False]
    assert "0.750" in printed[-3]
    assert printed[-1] == line
    assert (out / "table.md").read_text().endswith(f"\n\n- {line}\n")
    assert [row["warnings"] for row in read(out)] == ["", "far from rest; coarse", ""]
    with h5py.File(out / "table.h5") as file:
        assert file["table/warnings"].asstr()[1] == "far from rest; coarse"
    assert line in (out / "table.html").read_text()
    nu = "material.brain.poissons_ratio"
    rows = [row | {nu: 0.45 + 0.01 * i, "warnings": "coarse"} for i, row in enumerate(table.rows[:2])]
    assert summary.warnings(table._replace(keys=[*table.keys, nu], rows=rows)) == [
        f"warning for solver.load_steps=400 {nu}=0.45, solver.load_steps=500 {nu}=0.46: coarse"
    ]


def test_charts_have_the_columns_that_differ_and_short_names(tmp_path, groups, monkeypatch):
    from mpitled.results import charts

    labels: list[str] = []
    names: list[str] = []
    monkeypatch.setattr(charts, "draw_quantities", lambda *given: labels.extend(given[3].values()))
    monkeypatch.setattr(charts, "draw_cost", lambda points, _: names.extend(name for *_, name in points))
    table = summary.collect(cases.read(groups[0]))
    nu = "material.brain.poissons_ratio"
    rows = [row | {"cloud_misfit_mm": 0.0, "warnings": "", nu: 0.45} for row in table.rows]
    summary._draw(table._replace(rows=rows), tmp_path)
    assert "largest displacement, mm" in labels
    assert not [label for label in labels if "uncertainty" in label]  # zero everywhere
    summary._draw(table._replace(keys=[*table.keys, nu], rows=rows), tmp_path)
    assert names == ["400", "500", "load_steps=400 poissons_ratio=0.45", "load_steps=500 poissons_ratio=0.45"]


def write_array_job(
    folder: Path, deck: Path, base: list[str], text: str, scheduler: str
) -> tuple[Path, dict[str, str]]:
    """The script for a sweep into folder/out, and an environment with substitutes for srun and mpirun.

    The folder has a jobs/environment.sh, as a clone has.
    """
    tools = folder / "bin"
    for subfolder in (tools, folder / "jobs"):
        subfolder.mkdir(exist_ok=True)
    (folder / "jobs" / "environment.sh").write_text(f"touch {folder}/sourced\n")
    for name, skip in (("srun", 1), ("mpirun", 2)):
        (tools / name).write_text(f'#!/bin/sh\nshift {skip}\nexec "$@"\n')
        (tools / name).chmod(0o755)
    path = os.pathsep.join([str(tools), str(Path(sys.executable).parent), ENVIRONMENT["PATH"]])
    plan = cases.plan(deck, vary.grid([text]), base, 1, folder / "out")
    return array_job.write(plan, scheduler), ENVIRONMENT | {"PATH": path}


def test_an_array_job_computes_each_task_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    base = ["block.elements=[2,2,2]", "solver.method=dynamic-relaxation"]
    for scheduler, number in (("slurm", "SLURM_ARRAY_TASK_ID"), ("pbs", "PBS_ARRAY_INDEX")):
        script, variables = write_array_job(tmp_path, CUBE, base, "solver.load_steps=400,500,600", scheduler)
        assert "1-3\n" in script.read_text()
        assert ("srun --mpi=pmix" in script.read_text()) == (scheduler == "slurm")
        assert f"export PATH={Path(sys.executable).parent}:$PATH" in script.read_text()
        task = {number: "2" if scheduler == "slurm" else "3"}
        subprocess.run([script], env=variables | task, check=True, timeout=120, stderr=subprocess.DEVNULL)
        (tmp_path / "sourced").unlink()
    out = tmp_path / "out"
    assert [case.failure for case in cases.read(out).cases] == [None, "", ""]
    assert mpitled("report", out).stdout.count("not computed") == 1


def test_an_array_job_fits_its_sweep(tmp_path, monkeypatch, deck):
    """Number of ranks, logs in a path with blanks, no script of an older plan, and the path of the program."""
    out, spaced = tmp_path / "out", tmp_path / "my 50% files"
    words = ["sweep", deck, "--vary", "tumour.volume=150,300", "--out"]
    for scheduler in ("pbs", "slurm"):
        mpitled(*words, out, "--scheduler", scheduler)
    assert (out / "pbs.sh").exists()
    mpitled(*words, out, "--scheduler", "slurm", "--ranks", 2)
    assert not (out / "pbs.sh").exists()
    line = complaint(mpitled("sweep", out, "--only", 1, n=4, status=2))
    assert "--only 1: a case has 2 ranks, and 4 started; start as many" in line
    with monkeypatch.context() as patch:
        patch.setenv("OMPI_COMM_WORLD_SIZE", "1")
        assert "and 1 started" in complaint(mpitled("sweep", out, "--only", 1, status=2))

    script = Path(mpitled(*words, spaced, "--scheduler", "slurm").stdout.strip())
    assert f'#SBATCH --output="{tmp_path}/my 50%% files/slurm-%A_%a.log"' in script.read_text()
    assert "pbs refuses this path" in complaint(mpitled(*words, spaced, "--scheduler", "pbs", status=2))
    # The shell of the job does not have the program in its path.
    monkeypatch.chdir(tmp_path)
    plan = cases.plan(deck, vary.grid(["tumour.volume=150"]), [], 1, spaced)
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "none"))
    lines = [line for line in array_job.write(plan, "slurm").read_text().splitlines() if not line.startswith("#")]
    begin = "\n".join(lines[: lines.index("launch=(srun --mpi=pmix)")])
    shell = ["env", "-i", "PATH=/usr/bin:/bin", "bash", "-c", f"{begin}\ncommand -v mpitled"]
    found = subprocess.run(shell, capture_output=True, text=True, check=True).stdout
    assert found.strip() == str(Path(sys.executable).with_name("mpitled"))


def test_the_reason_of_a_failure_is_the_last_line_with_letters(tmp_path):
    """mpirun frames its messages."""
    process = launch.Process(["sh", "-c", "echo there are not enough slots; echo; echo ------; exit 1"], tmp_path)
    process.ended()
    assert process.failure == "there are not enough slots"


@pytest.mark.parametrize("scheduler", ["slurm", "pbs"])
def test_a_task_of_an_array_job_writes_a_checkpoint_before_its_time_limit(tmp_path, monkeypatch, deck, scheduler):
    """SLURM sends a signal; PBS sends none early enough, so that the script has a clock."""
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "out"
    script, variables = write_array_job(tmp_path, deck, ["solver.load_time=50"], "tumour.volume=150", scheduler)
    assert re.search(r"(time|walltime)=01:00:00$", script.read_text(), re.M)
    if scheduler == "pbs":
        assert re.findall(r"RUN_SECONDS:-(\d+)", script.read_text()) == [str(3600 - 120)]
    variables |= {"SLURM_ARRAY_TASK_ID": "1", "RUN_SECONDS": "20"}
    with subprocess.Popen([script], env=variables, stderr=subprocess.PIPE, text=True) as process:
        wait_until(lambda: list(out.glob("*/result.partial.vtkhdf")))
        time.sleep(0.5)
        if scheduler == "slurm":
            process.send_signal(signal.SIGUSR1)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 4, errors
    assert list(out.glob("*/checkpoint.h5"))


def test_progress_bars_are_on_a_terminal_only(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    log = ["note: 3% of it", " 10%      9 s left  100 steps/s", " 45%      5 s left  100 steps/s", "written"]
    assert terminal.share_done(log) == 0.45
    assert terminal.share_done([]) == 0
    line = f"[1 of 5 done] a=[1,2] {100 * 'long '}"
    for stream in (Terminal(), io.StringIO()):
        monkeypatch.setattr(sys, "stderr", stream)
        screen = terminal.Screen()
        screen.show({"a=[1,2]": 0.45, "a=2": 0.0}, 3)
        screen.print(line, "green")
        screen.show({}, 0)
        printed = stream.getvalue()
        assert ("\033[" in printed) == (" 45%" in printed) == stream.isatty()
        assert line in printed
    assert printed == f"{line}\n"


def test_bad_values_end_a_sweep_before_its_first_run(tmp_path):
    table, out = tmp_path / "cases.csv", tmp_path / "out"
    good = "solver.load_steps,solver.tolerance\n5,\n6,0.1\n"

    def plan(text: str) -> cases.Sweep:
        table.write_text(text)
        return cases.plan(CUBE, vary.table(table), [], 1, out)

    for texts, message in (
        (["solver.load_step=1,2"], "did you mean load_steps"),
        (["solver.load_steps"], "key=value"),
        (["a=1,2+b=3"], "equally many values"),
        (["solver.load_steps=5", "solver.load_steps=6"], "varied twice"),
        (["solver.load_steps=5,5"], "cases 1 and 2 are the same"),
    ):
        with pytest.raises(InputError, match=message):
            cases.plan(CUBE, vary.grid(texts), [], 1, out)
    for text, message in (
        ("", "has no cases"),
        ("a,a\n1,2\n", "line 1: has a key twice"),
        ("a,b\n1\n", "line 2: has 1 values for 2 keys"),
        ("a;b\n1,5;2\n", "line 1: separate by commas, not semicolons"),
        ("# of today\nsolver.load_step\n\n5\n", "line 4: solver.load_step = 5: unknown key; did you mean load_steps"),
        ("solver.load_steps\n5\n#6\n5\n", "line 4: cases 1 and 2 are the same"),
    ):
        with pytest.raises(InputError, match=f"{table}: {message}"):
            plan(text)
    sweep = plan(good)
    assert [dict(case.values) for case in sweep.cases] == [
        {"solver.load_steps": "5"}, {"solver.load_steps": "6", "solver.tolerance": "0.1"}
    ]  # fmt: skip
    for text, message in (("solver.load_steps\n", "no column solver.tolerance"), (f"x,{good}", "x is no column")):
        table.write_text(text)
        with pytest.raises(InputError, match=message):
            summary.collect(sweep, table)
    assert not out.exists()
    with pytest.raises(InputError, match="holds no sweep"):
        cases.read(tmp_path)


def test_cases_are_sorted_by_their_expected_run_time(tmp_path):
    brain, keys = ROOT / "jobs" / "brain_tumour.toml", ["labels.element_size=4,3", "tumour.volume=113.1,4188.8"]
    plan = cases.plan(brain, vary.grid(keys), [], 1, tmp_path)
    first, *_, last = sorted(plan.cases, key=lambda case: case.work)
    assert list(first.values.values()) == ["4", "113.1"]
    assert list(last.values.values()) == ["3", "4188.8"]


def test_two_processes_do_not_compute_one_case(tmp_path):
    """A task, a sweep, a run and a study each lock their folder."""
    pytest.importorskip("fcntl")
    out, study = tmp_path / "out", tmp_path / "study"
    keys = ["block.elements=[2,2,2]", "solver.method=dynamic-relaxation"]
    plan = cases.plan(CUBE, vary.grid(["solver.load_steps=400,500"]), keys, 1, out)
    plan.write_manifest()
    with lock.directory_lock(out, lock.RUN):
        assert "another sweep is at work" in complaint(mpitled("sweep", out, status=2))
    busy, free = plan.cases
    for name in (lock.RUN, lock.TASK):
        busy.folder.mkdir(exist_ok=True)
        (busy.folder / "precious").touch()
        with lock.directory_lock(busy.folder, name):
            for words in (["--only", "1"], []):
                line = complaint(mpitled("sweep", out, *words, status=2))
                assert f"{busy.folder}: another run is at work there" in line
                assert (busy.folder / "precious").exists()
                assert busy.failure is None
            complaint(mpitled("sweep", out, n=2, status=2))
        assert free.failure == ""
        shutil.rmtree(free.folder)
    with lock.directory_lock(busy.folder, lock.RUN):
        for n in (1, 2):
            line = complaint(mpitled("run", CUBE, "--out", busy.folder, n=n, status=2))
            assert "another run is at work there; wait for its end, or give another --out" in line
    words = ["study", CUBE, "--out", study, *(word for key in keys for word in ("--set", key))]
    mpitled(*words)
    folder = next(study.glob("as*"))
    (folder / "done.json").unlink()
    with lock.directory_lock(folder, lock.RUN):
        assert "another run is at work" in complaint(mpitled(*words, status=2))
    assert (folder / "result.vtkhdf").exists()

    twice = [start("sweep", out, "--only", 1) for _ in range(2)]
    assert sorted(process.wait(60) for process in twice) in (
        [0, 2],
        [0, 0],
    )  # 0: it starts after the end of the first
    assert busy.failure == ""
    assert json.loads((busy.folder / "report.json").read_text())["load_share"] == 1


def test_a_task_prints_the_outcome_of_its_case(tmp_path):
    out = tmp_path / "out"
    mpitled(*WORDS, "--out", out, "--scheduler", "slurm")
    assert "case 3, solver.load_steps=1: unstable" in complaint(mpitled("sweep", out, "--only", 3, status=3))
    done = mpitled("sweep", out, "--only", 3, "--json", status=3)  # not computed again
    assert "unstable" in json.loads(done.stdout)["failure"]
    assert json.loads(mpitled("sweep", out, "--only", 1, "--json").stdout)["max_displacement_mm"] > 0
    done = mpitled(*WORDS, "--out", out, "--scheduler", "pbs", "--json")
    assert json.loads(done.stdout) == {"script": str(out / "pbs.sh")}


@pytest.mark.parametrize("words", [WORDS, [*WORDS, "--scheduler", "slurm"], ["study", *WORDS[1:]]])
def test_runs_and_sweeps_refuse_each_others_folders(tmp_path, words):
    sweep, run, file = tmp_path / "sweep", tmp_path / "run", tmp_path / "file"
    cases.plan(CUBE, vary.grid(["solver.load_steps=400"]), [], 1, sweep).write_manifest()
    run.mkdir()
    (run / "model.h5").touch()
    file.touch()
    assert f"{sweep}: is the folder of a sweep" in complaint(mpitled("run", CUBE, "--out", sweep, status=2))
    for out, reason in ((run, "is the folder of a run"), (file / "out", "cannot be made")):
        assert f"{out}: {reason}" in complaint(mpitled(*words, "--out", out, status=2))


@pytest.mark.parametrize("command", ["sweep", "study"])
def test_no_table_is_replaced_by_another_table(tmp_path, command):
    """The same command resumes and may add values."""
    deck, out = tmp_path / "scene.toml", tmp_path / "out"
    text = f"{block((20, 20, 20), (2, 2, 2))}{pulled(0.1)}"
    deck.write_text(text)
    nu = "material.brain.poissons_ratio"
    words = [command, deck, "--out", out, "--set", "solver.load_steps=60"]
    for values in ("0.3,0.4", "0.3,0.4", "0.45,0.4,0.3"):
        mpitled(*words, "--vary", f"{nu}={values}")
    table = out / {"sweep": "table.csv", "study": "study.csv"}[command]
    kept = table.read_bytes()
    for changed, reason in (
        ([*words, "--vary", f"{nu}=0.3,0.45"], f"with {nu}=0.4;"),
        ([*words, "--vary", "hexahedra.hourglass=0.01"], f"over {nu};"),
        ([*words, "--set", "solver.tolerance=0.1", "--vary", f"{nu}=0.3"], "with --set solver.load_steps=60;"),
    ):
        line = complaint(mpitled(*changed, status=2))
        assert f"holds the table of another {command}, {reason}" in line
        assert f"remove {out / command}.json to replace it" in line
    deck.write_text(text.replace("3000", "4000"))
    line = complaint(mpitled(*words, "--vary", f"{nu}=0.3,0.4,0.45", status=2))
    assert "of an earlier version of the deck or of a file that it reads" in line
    if command == "sweep":  # its table can still be read
        assert "was changed since" in complaint(mpitled("sweep", out, status=2))
        for change in (lambda: None, deck.unlink):
            change()
            note = f"note: {out}: {deck}, or a file that it reads, has changed since the sweep"
            assert note in mpitled("report", out).stderr
            assert [row[nu] for row in open_sweep(out)] == [0.45, 0.4, 0.3]
    assert table.read_bytes() == kept
    deck.write_text(text)
    (out / f"{command}.json").unlink()
    mpitled(*words, "--vary", f"{nu}=0.3")
    assert table.read_bytes().count(b"\n") < kept.count(b"\n")


def test_one_growth_agrees_with_separate_runs(tmp_path, deck):
    out, apart = tmp_path / "out", tmp_path / "apart"
    words = ["sweep", deck, "--vary", "tumour.volume=150,523.6,300", "--one-growth"]
    mpitled(*words, "--out", out)
    rows = open_sweep(out)
    assert len(list(out.glob("*/result.vtkhdf"))) == 1
    for row in rows[::2]:
        mpitled("run", deck, "-q", "--set", f"tumour.volume={row['tumour.volume']}", "--out", apart)
        alone = json.loads((apart / "report.json").read_text())
        folder = next(out.glob(f"tumour.volume-{row['tumour.volume']:g}-*"))
        passed = json.loads((folder / "report.json").read_text())
        assert passed["tumour_volume_mm3"] == pytest.approx(row["tumour.volume"], rel=1e-9)
        for key in ("max_displacement_mm", "max_displacement_outside_first_ring_mm"):
            assert abs(passed[key] - alone[key]) < passed["static_distance_mm"] + alone["static_distance_mm"]
        assert 0 < passed["interpolation_mm"] < passed["static_distance_mm"]
        pushed = [r["volume_balance"]["pushed_through_interface_mm3"] for r in (passed, alone)]
        assert pushed[0] == pytest.approx(pushed[1], rel=0.02)
    assert rows[0]["min_jacobian"] > rows[2]["min_jacobian"] > rows[1]["min_jacobian"]

    # A missing case is computed again. A run that stops early has results of the volumes before its stop.
    table = (out / "table.csv").read_bytes()
    next(out.glob("tumour.volume-150-*/done.json")).unlink()
    mpitled("sweep", out)
    assert (out / "table.csv").read_bytes() == table
    broken = tmp_path / "broken"
    too_much = ["--vary", "tumour.volume=150,20000,33000", "--one-growth", "--set", "solver.load_time=0.1"]
    mpitled("sweep", deck, *too_much, "--out", broken, status=3)
    failures = {row["tumour.volume"]: row["failure"] for row in open_sweep(broken)}
    assert failures[150.0] == ""
    assert "unstable" in failures[20000.0]
    assert failures[20000.0] == failures[33000.0]


@pytest.mark.parametrize(("words", "reason"), [
    (["--vary", "cloud.growth=0.3,0.4"], "tumour.volume as the only varied key"),
    (["--vary", "tumour.volume=100,200", "--set", "solver.method=dynamic"], "not near rest"),
    (["--vary", "tumour.volume=100,200", "--scheduler", "slurm"], "not an array of jobs"),
])  # fmt: skip
def test_one_growth_needs_slow_loading_to_volumes(tmp_path, deck, words, reason):
    out = tmp_path / "out"
    assert reason in complaint(mpitled("sweep", deck, *words, "--one-growth", "--out", out, status=2))
    assert not out.exists()


def test_an_interrupted_case_resumes_from_its_checkpoint(tmp_path, deck):
    out = tmp_path / "out"
    words = ["sweep", deck, "--vary", "tumour.volume=150", "--set", "solver.load_time=5", "--out", out]
    with start(*words) as process:
        wait_until(lambda: list(out.glob("*/result.partial.vtkhdf")))
        time.sleep(0.5)
        process.send_signal(signal.SIGTERM)
    assert process.returncode == 4
    (kept,) = out.glob("*/checkpoint.h5")
    step = checkpoint_contents(kept)["step"]
    mpitled("sweep", out)
    report = json.loads((kept.parent / "report.json").read_text())
    assert report["resumed_at_step"] == step > 0
