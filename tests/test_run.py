"""Whole runs from a deck: physics with a closed form, the contract of ranks, and how runs end."""

from __future__ import annotations

import functools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import ENVIRONMENT, ROOT, complaint, mpitled, ranks, script
from scenes import MIXED, TUMOUR
from scipy.optimize import brentq

from mpitled import job, store
from mpitled.deck import load_deck
from mpitled.model.loading import loading_curve
from mpitled.solver.cauchy_stress import cauchy
from mpitled.store import open_result

SLIDING = "".join(f'[[fixed]]\nnodes = "{face}0"\ndirections = ["{face}"]\n' for face in "xyz")
#: A block that is stretched between two of its faces, which may slide: homogeneous whatever the mesh.
STRETCH = (
    MIXED.replace('"core"', '"{cloud}"')
    + SLIDING
    + """
[[displaced]]
nodes = "x1"
directions = ["x"]
displacement = [{millimetres}]
[solver]
method = "quasi-static"
load_time = {load_time}
[output]
frames = 2
"""
)
GROWTH = (
    TUMOUR.replace("523.6", "{volume}")
    + """
[solver]
method = "quasi-static"
load_time = 0.1
[output]
frames = 2
"""
)


def deck(folder: Path, text: str, **values: object) -> Path:
    path = folder / "scene.toml"
    path.write_text(text.format(**values))
    return path


def test_loading_curve_rests_at_both_ends():
    s = np.linspace(0, 1, 1001)
    d = np.array([loading_curve(x) for x in s])
    assert (d[0], d[-1]) == (0, 1)
    assert (np.diff(d) > 0).all()
    assert abs(d[1]) < 1e-8  # 10 s^3
    assert 1 - d[-2] < 1.1e-8


def stretched(stretch: float) -> tuple[float, float]:
    """Lateral stretch and J of x -> (l x, m y, m z) with P_yy = mu m + q l m = 0, q = lambda (J - 1) - mu / J."""
    E, nu = 3000.0, 0.49
    lam, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))

    def lateral_stress(m: float) -> float:
        J = stretch * m * m
        return mu * m + (lam * (J - 1) - mu / J) * stretch * m

    m = float(brentq(lateral_stress, 0.8, 1.0, xtol=1e-15))
    return m, stretch * m * m


@pytest.mark.parametrize("cloud", ["none", "core", "all"])
def test_homogeneous_stretch_has_its_closed_form(tmp_path, cloud):
    """Hexahedra only, the mixed mesh and support domains only, from the same step: 20 % of uniaxial stretch.

    What is left is the dynamics of the ramp, whose size the run tells: its distance to the static solution.
    """
    path = deck(tmp_path, STRETCH, cloud=cloud, millimetres=6.0, load_time=0.5)
    mpitled("run", path, "--out", tmp_path / "out")
    m, volume_ratio = stretched(1.2)
    with open_result(tmp_path / "out") as result:
        figures = result.figures
        exact = result.points * [0.2, m - 1, m - 1]
        error = np.linalg.norm(result.point_data("parameters", -1) - exact, axis=1).max()
        J = result.in_cells("J", -1)
    assert figures["kinetic_to_internal"]["at_end"] < 1e-4
    # The estimate is of the largest component, and honest to a factor of 3.
    assert 1e3 * error < 3 * np.sqrt(3) * figures["static_distance_mm"]
    assert figures["static_distance_mm"] < 0.1
    # Strains are wrong by that distance over the shortest wave that the ramp excites, an edge of the block.
    assert np.abs(J - volume_ratio).max() < 0.01


@pytest.mark.parametrize("cloud", ["none", "core"])
def test_relaxation_reaches_the_static_solution_in_few_steps(tmp_path, cloud):
    """To the tolerance asked for, by its own estimate and in truth, in a fifth of the steps of a ramp."""
    path = deck(tmp_path, STRETCH, cloud=cloud, millimetres=6.0, load_time=1.5)
    steps = {}
    for method in ("quasi-static", "dynamic-relaxation"):
        mpitled(
            "run", path, "--out", tmp_path / method, "--set", f"solver.method={method}", "--set",
            "solver.load_steps=100", "--set", "solver.tolerance=1e-3",
        )  # fmt: skip
        with open_result(tmp_path / method) as result:
            figures = result.figures
            m, _ = stretched(1.2)
            exact = result.points * [0.2, m - 1, m - 1]
            error = np.abs(result.point_data("parameters", -1) - exact).max()
            steps[method] = figures["steps"]
            assert result.times[-1] == (1.0 if method == "dynamic-relaxation" else 1.5)  # share of the load, or s
        assert json.loads((tmp_path / method / "report.json").read_text())["load_share"] == 1.0
        assert figures["static_distance_mm"] < (1e-3 if method == "dynamic-relaxation" else 0.1)
        assert 1e3 * error < 3 * figures["static_distance_mm"]
    assert figures["energy_J"]["balance_error"] < 1e-3  # second order in the step at the load's fastest
    assert 5 * steps["dynamic-relaxation"] < steps["quasi-static"]


def test_a_wave_keeps_its_energy_while_the_step_shortens(tmp_path):
    """Dynamic: a fast stretch and a hold. The step follows the deformed cells, and the ledger closes."""
    path = deck(tmp_path, STRETCH, cloud="core", millimetres=15.0, load_time=0.02)
    mpitled("run", path, "--out", tmp_path / "out", "--set", "solver.method=dynamic", "--set", "solver.hold_time=0.02")
    with open_result(tmp_path / "out") as result:
        figures, series, times = result.figures, result.series, result.times
    assert times[-1] == 0.04
    assert figures["energy_J"]["kinetic"] > 0.01 * figures["energy_J"]["internal"]  # waves, not statics
    assert figures["energy_J"]["balance_error"] < 0.01
    assert (series["step_ratio"] <= 1.0).all()
    assert figures["added_mass_kg"] == 0
    assert figures["time_step_s"] < 0.04 / figures["steps"]  # the last is shorter than the mean


def final(directory: Path) -> tuple[np.ndarray, np.ndarray]:
    """Displacements of nodes and of integration points in the last frame, in the order of the model."""
    with open_result(directory) as result:
        return result.at_nodes("displacement", -1), result.at_integration_points("displacement", -1)


@pytest.fixture(scope="module")
def grown(tmp_path_factory) -> Callable[[str], Path]:
    """The folder of growth to R/r0 = 2.5 on one rank in double precision, by a method; computed once."""

    @functools.cache
    def computed(method: str) -> Path:
        folder = tmp_path_factory.mktemp(method)
        words = ("--set", f"solver.method={method}", "--set", "solver.tolerance=1e-4")
        mpitled("run", deck(folder, GROWTH, volume=523.6), *words, "--out", folder / "out")
        return folder / "out"

    return computed


def test_one_two_and_four_ranks_agree_and_repeat(tmp_path, grown):
    """Growth to R/r0 = 2.5, J from 1 to far from it: sums in another order, and nothing else, between rank counts."""
    path = deck(tmp_path, GROWTH, volume=523.6)
    for n in (2, 4):
        mpitled("run", path, "--out", tmp_path / str(n), n=n)
    mpitled("run", path, "--out", tmp_path / "again", n=2)
    one = final(grown("quasi-static"))
    largest = np.abs(one[0]).max()
    with open_result(grown("quasi-static")) as result:
        moved = np.linalg.norm(result.at_nodes("parameters", -1), axis=1).max()
    assert moved == pytest.approx(3e-3, rel=1e-3)  # R - r0, the volume having four digits
    for n in (2, 4):
        for other, values in zip(final(tmp_path / str(n)), one, strict=True):
            assert np.abs(other - values).max() < 1e-8 * largest
    for other, values in zip(final(tmp_path / "again"), final(tmp_path / "2"), strict=True):
        assert other.tobytes() == values.tobytes()


@pytest.mark.parametrize("method", ["quasi-static", "dynamic-relaxation"])
def test_single_precision_of_the_cells_is_enough(tmp_path, grown, method):
    """On two ranks against double precision on one. u in single precision is known to 6e-8; across a cell of a tenth of
    |u| that is a strain of 6e-7, by lambda / mu = 49 the shear strain of 3e-5 that balances its pressure, and over such
    a cell 3e-6 of |u|. A few cells add up.
    """
    path = deck(tmp_path, GROWTH, volume=523.6)
    keys = (f"solver.method={method}", "solver.precision=single", "solver.tolerance=1e-4")
    mpitled("run", path, *(word for key in keys for word in ("--set", key)), "--out", tmp_path / "out", n=2)
    for single, double in zip(final(tmp_path / "out"), final(grown(method)), strict=True):
        assert 0 < np.abs(single - double).max() < 3e-5 * np.abs(double).max()


def test_a_tolerance_below_round_off_ends_with_what_can_be_reached(tmp_path):
    path = deck(tmp_path, STRETCH, cloud="none", millimetres=6.0, load_time=0.1)
    keys = ("solver.method=dynamic-relaxation", "solver.precision=single", "solver.tolerance=1e-9")
    done = mpitled("run", path, *(w for key in keys for w in ("--set", key)), "--out", tmp_path / "out", status=3)
    said = complaint(done)
    assert "solver.tolerance" in said
    reachable = float(said.split("solver.tolerance = ")[1].split()[0])
    assert 1e-9 < reachable < 1e-2
    keys = (*keys[:2], f"solver.tolerance={reachable}")
    mpitled("run", path, *(w for key in keys for w in ("--set", key)), "--out", tmp_path / "out")


def test_ranks_agree_to_round_off_in_the_linear_range(tmp_path):
    """A strain of 1/600: the round-off of I + grad u is 1e-13 of it, and some thousand steps add to that."""
    path = deck(tmp_path, STRETCH, cloud="core", millimetres=0.05, load_time=0.1)
    for n in (1, 2, 4):
        mpitled("run", path, "--out", tmp_path / str(n), n=n)
    one = final(tmp_path / "1")[0]
    for n in (2, 4):
        assert np.abs(final(tmp_path / str(n))[0] - one).max() < 1e-12 * np.abs(one).max()


@pytest.mark.parametrize("n", [2, 4])
def test_copies_of_shared_nodes_have_the_same_bits(tmp_path, n):
    path = deck(tmp_path, GROWTH, volume=113.1)
    compared = int(script("parallel_run.py", path, tmp_path / "out", n=n).splitlines()[-1])
    assert compared > 1000


def test_ranks_without_one_kind_of_cell(tmp_path):
    """A cloud at one end of a bar: of four parts some have no support domains, and some no hexahedra."""
    text = GROWTH.replace("[48.0, 40.0, 40.0]", "[480.0, 20.0, 20.0]").replace("[12, 10, 10]", "[120, 5, 5]")
    text = text.replace("[24.0, 20.0, 20.0]", "[12.0, 10.0, 10.0]").replace("nodes = 400", "nodes = 100")
    text = text.replace("radius = 11.0\ngrowth = 0.35", "radius = 9.0\ngrowth = 0.5\npoints_per_spacing = 1.2")
    path = deck(tmp_path, text, volume=60.0)
    for n in (1, 4):
        mpitled("run", path, "--out", tmp_path / str(n), n=n)
    with open_result(tmp_path / "4") as result:
        part, kind = result.cell_data("part"), result.cell_data("kind")
    kinds = [set(kind[part == p]) for p in range(4)]
    assert {0} in kinds  # hexahedra alone
    assert any(0 not in k for k in kinds)
    one, four = final(tmp_path / "1")[0], final(tmp_path / "4")[0]
    assert np.abs(one - four).max() < 1e-8 * np.abs(one).max()


def test_model_is_used_again_until_the_scene_changes(tmp_path):
    path = deck(tmp_path, STRETCH, cloud="core", millimetres=1.0, load_time=0.1)
    build = lambda *more: mpitled("build", path, "--out", tmp_path / "out", *more).stdout.splitlines()[0]  # noqa: E731
    assert build().endswith("built")
    before = (tmp_path / "out" / "model.h5").read_bytes()
    assert build().endswith("up to date")
    assert build("--set", "solver.load_time=0.2").endswith("up to date")
    assert build("--set", "material.brain.poissons_ratio=0.45").endswith("built")
    assert build().endswith("built")
    assert (tmp_path / "out" / "model.h5").read_bytes() == before  # bit for bit


def test_partition_ahead_of_a_job(tmp_path):
    path = deck(tmp_path, STRETCH, cloud="core", millimetres=1.0, load_time=0.05)
    mpitled("build", path, "--out", tmp_path / "out")
    table = mpitled("partition", tmp_path / "out", 2).stdout
    for word in ("balance", "halo", "neighbours"):
        assert word in table
    refused = mpitled("partition", tmp_path / "out", 100_000, status=2)
    assert "100000" in complaint(refused)


# ------------------------------------------------------------ how runs end


@pytest.mark.parametrize("n", [1, 2])
def test_bad_decks_end_with_one_line_on_all_ranks(tmp_path, n):
    path = deck(tmp_path, STRETCH.replace("youngs_modulus", "young_modulus"), cloud="none", millimetres=1, load_time=1)
    line = complaint(mpitled("run", path, "--out", tmp_path / "out", n=n, status=2))
    assert "young_modulus" in line
    assert "youngs_modulus" in line
    path = deck(tmp_path, STRETCH.replace('"x1"', '"x2"'), cloud="none", millimetres=1, load_time=1)
    line = complaint(mpitled("run", path, "--out", tmp_path / "out", n=n, status=2))
    assert "'x2'" in line
    assert "x1" in line  # what there is


def test_more_ranks_than_cells_are_refused(tmp_path):
    text = STRETCH.replace("[10, 8, 8]", "[1, 1, 2]")
    path = deck(tmp_path, text, cloud="none", millimetres=0.1, load_time=0.1)
    line = complaint(mpitled("run", path, "--out", tmp_path / "out", n=3, status=2))
    assert "3" in line


@pytest.mark.parametrize("n", [1, 2])
def test_a_step_above_the_critical_one_is_refused_with_the_one_to_use(tmp_path, n):
    path = deck(tmp_path, STRETCH, cloud="core", millimetres=3.0, load_time=1.0)
    run = ("run", path, "--out", tmp_path / "out", "--set", "solver.mass_scaling=false", "--set")
    line = complaint(mpitled(*run, "solver.time_step=3e-3", n=n, status=2))
    assert f"{path}: solver.time_step = 0.003" in line
    longest = float(line.split("give at most ")[1].split(" (s)")[0])
    mpitled(*run, f"solver.time_step={longest}", "--set", "solver.load_time=0.05", n=n)
    # With more mass any step is stable, but of too few of them there is no ramp.
    few = complaint(mpitled("run", path, "--out", tmp_path / "out", "--set", "solver.time_step=0.3", n=n, status=2))
    assert f"{path}: solver.time_step = 0.3: leaves 3.3 steps for a run of 1 s; give at most 0.05 (s)" in few


def test_a_density_in_the_wrong_unit_is_refused_for_the_steps_that_it_takes(tmp_path):
    """t/mm3 in place of kg/m3: a million times as many steps."""
    path = deck(tmp_path, STRETCH, cloud="none", millimetres=3.0, load_time=1.0)
    line = complaint(mpitled("run", path, "--out", tmp_path / "out", "--set", "material.brain.density=1e-9", status=2))
    assert "solver.load_time = 1: takes" in line
    assert "units of densities" in line


@pytest.mark.parametrize("n", [1, 2])
def test_an_unstable_run_stops_and_says_why(tmp_path, n):
    """A block pressed through itself: no step and no mass can save it."""
    path = deck(tmp_path, STRETCH, cloud="core", millimetres=-45.0, load_time=0.1)
    line = complaint(mpitled("run", path, "--out", tmp_path / "out", n=n, status=3))
    for word in (f"of the load of {path.name}: ", "mm", "J = ", "rank", "brain", "(a longer solver.load_time)"):
        assert word in line
    assert "seed_radius" not in line
    with open_result(tmp_path / "out") as result:
        assert not result.complete
        assert result.n_frames >= 2  # at rest, and the last good state
        assert np.abs(result.at_nodes("parameters", -1)).max() > 1e-3
        assert result.in_cells("J", -1).min() > 0


@pytest.mark.parametrize(("method", "keys"), [
    ("dynamic-relaxation", ("solver.load_steps=40",)),  # so fast that the seed runs into its neighbours
    ("quasi-static", ("solver.safety=1.0", "solver.load_time=0.2")),  # at the edge of stability
])  # fmt: skip
def test_an_unstable_run_recovers_on_request(tmp_path, grown, method, keys):
    """It ends where a slow, safe run ends, within what both say is left to the static solution."""
    path = deck(tmp_path, GROWTH, volume=523.6)
    words = [word for key in (f"solver.method={method}", *keys) for word in ("--set", key)]
    line = complaint(mpitled("run", path, "--out", tmp_path / "stops", *words, status=3))
    assert ("more solver.load_steps" in line) == (method == "dynamic-relaxation")
    assert ("a longer solver.load_time" in line) == (method == "quasi-static")
    assert "tumour.seed_radius" in line
    mpitled("run", path, "--out", tmp_path / "recovers", *words, "--set", "solver.on_inversion=recover")
    report = json.loads((tmp_path / "recovers" / "report.json").read_text())
    assert 1 <= report["recoveries"] <= 5
    assert report["energy_J"]["balance_error"] < 0.05
    within = 1e-3 * report["static_distance_mm"] + 1e-5
    for found, safe in zip(final(tmp_path / "recovers"), final(grown("dynamic-relaxation")), strict=True):
        assert np.abs(found - safe).max() < within


@pytest.mark.parametrize("way", ["step_too_long", "not_a_number", "inverted_cell"])
def test_what_one_of_four_ranks_breaks_ends_all_of_them_at_once(tmp_path, way):
    """One message, and every rank is out of the command within a second of the survey that finds it."""
    path = deck(tmp_path, STRETCH, cloud="core", millimetres=6.0, load_time=0.5)
    script = Path(__file__).with_name("parallel_broken.py")
    command = [*ranks(4), sys.executable, script, path, tmp_path / "out", way]
    done = subprocess.run(command, env=ENVIRONMENT, cwd=ROOT, timeout=120, capture_output=True, text=True)
    assert done.returncode == 3
    line = complaint(done)
    # What is so wrong is no number anywhere when it is looked at, so that no cell is the worst but that of before.
    for word in ("unstable at", "grew without bound", "until then the worst was", "mm", "J = ", "brain", "rank"):
        assert word in line
    assert "nan" not in line
    ends = [json.loads((tmp_path / "out" / f"rank_{rank}.json").read_text()) for rank in range(4)]
    assert [end["status"] for end in ends] == [3] * 4
    assert sum("broken" in end for end in ends) == 1
    assert max(end["ended"] for end in ends) - min(end["detected"] for end in ends) < 1.0


def test_a_result_that_is_not_to_be_trusted_says_so(tmp_path):
    """A cube of support domains pressed to half its volume: the pressure is too much for their other modes."""
    path = ROOT / "jobs" / "validation" / "cube.toml"
    keys = ("block.elements=[5,5,5]", "block.cloud=all", "support.nodes=8", "solver.method=dynamic-relaxation")
    keys = (*keys, "fixed.0.nodes=surface", "fixed.1.nodes=surface")
    words = [word for key in keys for word in ("--set", key)]
    said = mpitled("run", path, "-q", "--out", tmp_path / "soft", *words, "--set", "support.stabilisation=0.1").stderr
    assert "not to be trusted" in said
    assert "support.stabilisation" in said
    trusted = mpitled("run", path, "-q", "--out", tmp_path / "held", *words)
    assert not trusted.stderr
    with open_result(tmp_path / "held") as result:
        exact = result.points * [0, 0, -0.5]
        assert np.abs(result.point_data("displacement", -1) - exact).max() < 1e-5


def test_a_ramp_too_fast_for_any_estimate_says_so(tmp_path):
    """In one step: nothing has moved but the nodes that were moved, and no relaxation leads on from there."""
    path = deck(tmp_path, STRETCH, cloud="core", millimetres=6.0, load_time=1e-6)
    assert "warning" in mpitled("run", path, "-q", "--out", tmp_path / "out").stderr


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_a_readable_file(tmp_path, signal_number):
    path = deck(tmp_path, STRETCH, cloud="core", millimetres=3.0, load_time=500.0)
    command = [str(Path(sys.executable).with_name("mpitled")), "run", path, "--out", tmp_path / "out", "--set"]
    with subprocess.Popen(
        [*command, "output.frames=20000"], env=ENVIRONMENT, cwd=ROOT, stderr=subprocess.PIPE, text=True
    ) as process:
        file = tmp_path / "out" / "result.partial.vtkhdf"
        deadline = time.time() + 60
        while not file.exists() and time.time() < deadline:
            time.sleep(0.1)
        time.sleep(1.0)
        process.send_signal(signal_number)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 4, errors
    assert "interrupted" in errors
    with open_result(tmp_path / "out") as result:
        assert not result.complete
        assert result.n_frames >= 1


def test_the_death_of_one_rank_ends_the_others(tmp_path):
    path = deck(tmp_path, STRETCH, cloud="core", millimetres=3.0, load_time=500.0)
    command = [*ranks(2), str(Path(sys.executable).with_name("mpitled")), "run", path, "--out", tmp_path / "out"]
    with subprocess.Popen(command, env=ENVIRONMENT, cwd=ROOT, stderr=subprocess.DEVNULL) as process:
        file = tmp_path / "out" / "result.partial.vtkhdf"
        deadline = time.time() + 60
        while not file.exists() and time.time() < deadline:
            time.sleep(0.1)
        time.sleep(0.5)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        os.kill(int(children[0]), signal.SIGKILL)
        assert process.wait(timeout=30) != 0


@pytest.mark.parametrize("rule", ["mean", "centre"])
def test_the_stress_of_results_is_the_closed_form_where_the_gradient_is_the_same_everywhere(tmp_path, rule):
    """Cauchy's: mu/J (b - I) + lambda (J - 1) I, of both kinds of cell and two materials, on one part or two."""
    text = MIXED.replace("[material.brain]", '[material.stiff]\ncells = ["ball"]\nyoungs_modulus = 9000.0\n'
        'poissons_ratio = 0.3\n[sphere.ball]\ncentre = [15.0, 12.0, 12.0]\nradius = 6.0\n[material.brain]')  # fmt: skip
    (tmp_path / "scene.toml").write_text(text + '[[fixed]]\nnodes = "x0"\n')
    path, _ = job.build(load_deck(tmp_path / "scene.toml"), tmp_path)
    job.divide(path, 2, 0)
    X = np.array([[1.2, 0.3, -0.1], [0.05, 0.9, 0.2], [-0.15, 0.1, 1.1]])
    b, J = X @ X.T, np.linalg.det(X)
    model = store.read_model(path)
    assert len(np.unique(model.material)) == 2
    mu, lam = (
        np.array([getattr(m, name) for m in model.materials])[model.material, None, None] for name in ("mu", "lam")
    )
    expected = mu / J * (b - np.eye(3)) + lam * (J - 1) * np.eye(3)
    for n_parts in (1, 2):
        seen = 0
        for part in range(n_parts):
            rows = store.read_part(path, n_parts, part)
            u = (X - np.eye(3)) @ rows.read("points").T
            xx, yy, zz, xy, yz, xz = cauchy(rows, u, rule).T
            found = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
            of_part = expected[rows.read("cells")]
            # Sums of 20 products that are ten times their sum, and lambda is that over the stress: 1e3 roundings.
            assert np.abs(found - of_part).max() < 1e3 * np.finfo(float).eps * np.abs(expected).max()
            seen += len(found)
        assert seen == model.n_cells
