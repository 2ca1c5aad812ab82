"""Runs that were stopped and continued: the bits of the run that was not, and refusals of what is another run."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import ranks
from faults import inject
from hypothesis import given
from hypothesis import strategies as st
from scenes import MIXED, pulled

from mpitled import checksum, cli, job, store
from mpitled import deck as decks
from mpitled.deck import load_deck
from mpitled.errors import InputError, InterruptedRun
from mpitled.parallel.halo import World
from mpitled.solver.progress import Progress
from mpitled.solver.run import Run
from mpitled.store import checkpoints

BLOCK = (
    MIXED
    + pulled("{millimetres}", rotation="{degrees}", axis='"x"', centre=[0.0, 12.0, 12.0])
    + """
[solver]
load_time = 0.2
{solver}
[output]
frames = 3
pictures = false
"""
)
RAMP = 'method = "quasi-static"'
#: What is not of the scene but of the machine, or of having been stopped.
OF_THE_MACHINE = {"seconds", "term_seconds", "cell_updates_per_second", "halo_share", "imbalance", "peak_memory_bytes"}


def run(deck: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, stop_at: int = 0, resume: bool = False) -> Any:
    """The report; or stop at a check, as a signal does, and give the number of checks that there were."""
    checks, check = 0, Run._check

    def counted(this: Run) -> None:
        nonlocal checks
        checks += 1
        this.interrupts.asked = checks == stop_at
        check(this)

    with monkeypatch.context() as patch:
        patch.setattr(Run, "_check", counted)
        try:
            report = job.run(load_deck(deck), folder, World(), quiet=True, resume=resume)
        except InterruptedRun:
            return checks
    report["checks"] = checks
    return report


def held(folder: Path) -> tuple[list[bytes], dict[str, Any]]:
    """All that a whole result holds of its frames, and its figures."""
    with store.open_result(folder) as result:
        assert result.complete
        result.check()
        arrays = [result.times, *result.series.values()]
        for k in range(result.n_frames):
            arrays += [result.at_nodes("parameters", k), result.at_nodes("displacement", k)]
            arrays += [result.at_integration_points("displacement", k), result.in_cells("J", k)]
        figures = {k: v for k, v in result.figures.items() if k not in OF_THE_MACHINE | {"resumed_at_step"}}
    return [array.tobytes() for array in arrays], figures


@pytest.mark.parametrize(("solver", "millimetres", "degrees"), [
    (RAMP, 4.0, 0.0),  # and on to the distance of its end from the static solution
    ('method = "dynamic"\nhold_time = 0.05', 4.0, 30.0),
    ('method = "dynamic-relaxation"\nprecision = "single"\ntolerance = 0.05', 4.0, 30.0),
    ('method = "dynamic-relaxation"\nload_steps = 5\non_inversion = "recover"', 14.0, 0.0),
])  # fmt: skip
def test_a_run_goes_on_to_the_same_bits(tmp_path, monkeypatch, solver, millimetres, degrees):
    """Stopped three times: early, in the middle and late."""
    deck = tmp_path / "scene.toml"
    deck.write_text(BLOCK.format(solver=solver, millimetres=millimetres, degrees=degrees))
    whole = run(deck, tmp_path / "whole", monkeypatch)
    if "recover" in solver:
        assert whole["recoveries"] > 2  # twice a little, then from the beginning
    checks = [run(deck, tmp_path / "part", monkeypatch, 10)]
    for share in (0.3, 0.4):
        checks.append(run(deck, tmp_path / "part", monkeypatch, int(share * whole["checks"]), resume=True))
    assert isinstance(checks[-1], int), "was not stopped"
    report = run(deck, tmp_path / "part", monkeypatch, resume=True)
    assert report["resumed_at_step"] > 0
    assert held(tmp_path / "part") == held(tmp_path / "whole")
    same = {name for name in report if name not in OF_THE_MACHINE | {"resumed_at_step", "checks"}}
    assert {name: report[name] for name in same} == {name: whole[name] for name in same}
    assert not any((tmp_path / "part" / name).exists() for name in store.CHECKPOINTS)
    again = run(deck, tmp_path / "part", monkeypatch, resume=True)  # only the report is made
    assert again["checks"] == 0


@pytest.fixture
def stopped(tmp_path, monkeypatch) -> tuple[Path, Path]:
    """A deck and the folder of a run of it that was stopped twice: it has two checkpoints."""
    deck, folder = tmp_path / "scene.toml", tmp_path / "out"
    deck.write_text(BLOCK.format(solver=RAMP, millimetres=1.0, degrees=0.0))
    run(deck, folder, monkeypatch, 3)
    run(deck, folder, monkeypatch, 3, resume=True)
    return deck, folder


def test_another_run_is_refused(stopped, monkeypatch):
    deck, folder = stopped
    go_on = lambda *keys: job.run(load_deck(deck, keys), folder, World(), quiet=True, resume=True)  # noqa: E731
    with pytest.raises(
        InputError, match=r"checkpoint\.h5: was written for solver\.load_time = 0\.2, and not 0\.3; put"
    ):
        go_on("solver.load_time=0.3")
    with pytest.raises(InputError, match=r"material\.brain\.density"):
        go_on("material.brain.density=1001")
    with monkeypatch.context() as patch:
        patch.setattr(decks, "program", lambda: "another")
        with pytest.raises(InputError, match="another program"):
            go_on()
    assert go_on("title=renamed", "output.checkpoint_minutes=1")["complete"]


def test_a_run_that_could_go_on_is_not_written_over(stopped, monkeypatch, capsys):
    deck, folder = stopped
    last, before = (folder / name for name in store.CHECKPOINTS)
    with pytest.raises(InputError, match=r"checkpoint\.h5: holds this very run at [0-9.]+%; go on .* --resume, or rem"):
        run(deck, folder, monkeypatch)
    assert last.exists()
    other = load_deck(deck, ["solver.load_time=0.1"])
    with pytest.raises(
        InputError, match=r"h5: holds a run at .*% that was written for solver\.load_time = 0\.2.* --out"
    ):
        job.run(other, folder, World())
    assert last.exists()
    for path in (last, before):
        path.write_bytes(path.read_bytes()[:1000])
    assert job.run(other, folder, World())["complete"]
    assert "note: a checkpoint that is damaged is discarded" in capsys.readouterr().err
    assert not last.exists()
    assert not before.exists()
    assert run(deck, folder, monkeypatch)["resumed_at_step"] == 0
    job.run(load_deck(deck), folder, World())
    assert "note: the result of an earlier run is there" in capsys.readouterr().err


def test_nodes_of_a_checkpoint_may_be_in_any_order(tmp_path):
    """Each rank writes the nodes that it owns, one rank after the other."""
    written = np.array([7, 2, 9, 4])
    with h5py.File(tmp_path / "file.h5", "w") as file:
        file["node"], file["nodal/now/u"], file["own"] = written, written[:, None] / 8, np.zeros((1, 1))
    fields, _ = checkpoints.read_checkpoint(tmp_path / "file.h5", np.array([2, 4, 7]))
    assert np.array_equal(fields["now/u"][:, 0], np.array([2, 4, 7]) / 8)


def test_a_damaged_checkpoint_is_named_and_the_one_before_it_used(stopped, monkeypatch, capsys):
    deck, folder = stopped
    last, before = (folder / name for name in store.CHECKPOINTS)
    steps = [store.checkpoint_contents(path)["step"] for path in (before, last)]
    assert steps[0] < steps[1]
    rng = np.random.default_rng(0)
    whole = last.read_bytes()
    for harm in (lambda data: data[: len(data) // 2], lambda data: b"", flipped(rng), flipped(rng), flipped(rng)):
        last.write_bytes(harm(whole))
        with pytest.raises(InputError, match=str(last)):
            store.checkpoint_contents(last)
    assert run(deck, folder, monkeypatch, resume=True)["resumed_at_step"] == steps[0]
    assert str(last) in capsys.readouterr().err
    before.write_bytes(b"no checkpoint")
    last.write_bytes(whole[:1000])
    (folder / "result.vtkhdf").unlink()
    with pytest.raises(InputError, match="begin anew"):
        run(deck, folder, monkeypatch, resume=True)


def test_a_run_says_where_it_goes_on_and_counts_from_there(stopped, capsys):
    deck, folder = stopped
    step = store.checkpoint_contents(folder / store.CHECKPOINTS[0])["step"]
    job.run(load_deck(deck), folder, World(), resume=True)
    assert f"note: goes on from step {step:,} (" in capsys.readouterr().err
    progress = Progress(0.5, 10_000)
    progress.begin -= 10
    progress.show(0.75, 11_000, {"kinetic_ratio": 0.0, "min_jacobian": 1.0})
    assert capsys.readouterr().err.startswith(" 75%     10 s left  100 steps/s")


def flipped(rng: np.random.Generator) -> Any:
    def harm(data: bytes) -> bytes:
        changed = bytearray(data)
        # In the displacements, which fill the second quarter of the file: between arrays there are gaps.
        changed[int(rng.integers(len(data) // 4, len(data) // 2))] ^= 1 << int(rng.integers(8))
        return bytes(changed)

    return harm


def test_info_names_what_is_damaged(stopped, monkeypatch, capsys):
    deck, folder = stopped
    run(deck, folder, monkeypatch, resume=True)
    rng = np.random.default_rng(1)
    for name in ("model.h5", "result.vtkhdf"):
        path = folder / name
        for harm, status in ((lambda data: data, 0), (flipped(rng), 2), (lambda data: data[:-5000], 2)):
            whole = path.read_bytes()
            path.write_bytes(harm(whole))
            with pytest.raises(SystemExit) as end:
                cli.main(["info", str(path)])
            path.write_bytes(whole)
            assert end.value.code == status
            said = capsys.readouterr()
            assert ("whole" in said.out) == (status == 0)
            assert status == 0 or str(path) in said.err


def test_info_of_a_folder_is_of_its_result(stopped, capsys, tmp_path):
    _, folder = stopped
    for where, said, status in ((folder, "result.partial.vtkhdf: an unfinished result", 0), (tmp_path / "none", "", 2)):
        where.mkdir(exist_ok=True)
        with pytest.raises(SystemExit) as end:
            cli.main(["info", str(where)])
        assert end.value.code == status
        assert said in capsys.readouterr().out


def test_nobody_computes_with_what_is_damaged(stopped, monkeypatch, capsys):
    """A number that is as plausible as the one that it took the place of."""
    deck, folder = stopped
    run(deck, folder, monkeypatch, resume=True)
    model, result = folder / "model.h5", folder / "result.vtkhdf"
    out = ["--out", str(folder / "made")]
    for path, array, commands in (
        (model, "points", (["report"], ["compare", str(folder)], ["export", "--abaqus", *out], ["partition", "2"])),
        (model, "blocks/0/nodes", (["report"], ["partition", "2"])),
        (result, "VTKHDF/PointData/displacement", (["report"], ["compare", str(folder)])),
        (result, "VTKHDF/FieldData/strain_energy", (["report", "--html"],)),
    ):
        whole = path.read_bytes()
        with h5py.File(path, "r+") as file:
            file[array][-1] = file[array][-2]
        for name, *options in commands:
            with pytest.raises(SystemExit) as end:
                cli.main([name, str(folder), *options])
            said = capsys.readouterr().err
            assert (end.value.code, said.count("\n")) == (2, 1), (name, said)
            assert re.search(rf"{path}: is damaged: .* is not what was written; (run the deck|build the model) a", said)
        path.write_bytes(whole)
    assert not (folder / "made").exists()


def test_a_damaged_model_is_built_anew(stopped, monkeypatch, capsys):
    deck, folder = stopped
    path = folder / "model.h5"
    whole = path.read_bytes()
    with h5py.File(path, "r+") as file:
        file["blocks/1/gradients"][3, 2, 1] *= 1 + 1e-12
    run(deck, folder, monkeypatch, resume=True)
    assert "it is built anew" in capsys.readouterr().err
    assert path.read_bytes() == whole


@given(st.binary(min_size=8, max_size=400), st.integers(0, 50), st.integers(0, 7), st.data())
def test_shares_of_a_checksum_add_up_and_any_change_of_a_word_shows(data, cut, bit, draw):
    words = np.frombuffer(data[: len(data) // 8 * 8], np.float64)
    cut = min(cut, len(words))
    whole = checksum.total([checksum.share(words, 0)])
    assert checksum.total([checksum.share(words[cut:], cut), checksum.share(words[:cut], 0)]) == whole
    place = draw.draw(st.integers(0, len(words) - 1))
    changed = bytearray(words.tobytes())
    changed[8 * place + bit] ^= 1 << bit
    assert checksum.total([checksum.share(np.frombuffer(bytes(changed), np.float64), 0)]) != whole


def test_a_few_faults_are_survived(tmp_path):
    """A short cut of `python tests/faults.py`."""
    if sys.platform != "linux":
        pytest.skip("kills by what /proc says")
    ranks(2)
    made = inject(tmp_path, 3)
    assert all(survived == n for *_, survived, n in made.table), made.table
