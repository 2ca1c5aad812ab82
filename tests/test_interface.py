"""The Python interface and the command line around it: lazy, and the same figures in each form."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from conftest import ENVIRONMENT, ROOT, mpitled

import mpitled as package
from mpitled import store
from mpitled.solver.cauchy_stress import cauchy

CUBE = ROOT / "jobs" / "validation" / "cube.toml"


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A small run through the interface: its folder and its report."""
    out = tmp_path_factory.mktemp("interface") / "out"
    keys = [
        "block.elements=[3,3,3]",
        "block.cloud=all",
        "solver.method=dynamic-relaxation",
        "output.frames=2",
        "output.stress=true",
    ]
    return out, package.run(CUBE, out, keys)


def test_importing_costs_nothing():
    code = (
        "import time; begin = time.process_time(); import mpitled; took = time.process_time() - begin;"
        "import sys; print(took, 'numpy' in sys.modules, sorted(mpitled.__all__) == mpitled.__all__)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, cwd=ROOT, capture_output=True, text=True)
    took, heavy, _ = done.stdout.split()
    assert float(took) < 0.1
    assert heavy == "False"
    assert {"load_deck", "build_model", "run", "open_result", "open_sweep"} <= {*dir(package)}
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = package.no_such_thing


def test_the_example_runs():
    done = subprocess.run(
        [sys.executable, "jobs/example.py"], env=ENVIRONMENT, cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "113.1 mm3" in done.stdout
    # From 2 mm radius to 3 mm, less what moving least squares over so coarse a cloud smooth at the seed.
    found = re.search(r"largest displacement ([0-9.]+) mm", done.stdout)
    assert found
    assert 0.95 < float(found[1]) <= 1


def test_arrays_are_read_frame_by_frame_in_the_models_order(result):
    out, report = result
    model = store.read_model(out / "model.h5")
    with package.open_result(out) as opened:
        assert opened.complete
        np.testing.assert_array_equal(opened.points, model.points)
        assert len(opened.displacement) == len(opened.times) == 3
        assert opened.displacement.shape == (3, model.n_nodes, 3) == np.stack(list(opened.displacement)).shape
        assert opened.displacement.dtype == opened.displacement[0].dtype
        sizes = [1e3 * np.linalg.norm(u, axis=1).max() for u in opened.displacement]
        assert sizes[0] == 0
        assert sizes[-1] == report["max_displacement_mm"] == opened.report["max_displacement_mm"]
        assert opened.jacobian[-1].shape == (model.n_cells,)
        assert opened.history["min_jacobian"][-1] == report["min_jacobian"]
        with pytest.raises(IndexError, match="3 frames"):
            opened.displacement[3]
        last = opened.displacement
        assert opened.stress.shape == (3, model.n_cells, 6)
        assert not opened.stress[0].any()
        rows = store.read_part(out / "model.h5", 1, 0)
        parameters = store.open_result(out).at_nodes("parameters", -1)
        np.testing.assert_array_equal(opened.stress[-1], cauchy(rows, parameters.T.copy(), "mean"))
    for read in (lambda: opened.points, lambda: last[0]):
        with pytest.raises(package.InputError, match="is closed"):
            read()
    assert repr(opened).endswith("closed>")


def test_a_result_without_stress_says_how_to_have_it(tmp_path):
    package.run(CUBE, tmp_path, ["block.elements=[3,3,3]", "solver.method=dynamic-relaxation"])
    with package.open_result(tmp_path) as opened, pytest.raises(package.InputError, match=r"output\.stress = true"):
        _ = opened.stress


def test_a_deck_is_a_path_or_what_load_deck_made_of_it(result):
    """One override need be no list: its letters would be taken for overrides."""
    keys = ["block.elements=[3,3,3]", "block.cloud=all"]
    deck = package.load_deck(CUBE, keys)
    assert package.load_deck(CUBE, keys[0]).block.elements == deck.block.elements == (3, 3, 3)
    models = package.build_model(deck), package.build_model(CUBE, keys), package.build_model(str(CUBE), keys)
    assert len({model.domain_gradients.tobytes() for model in models}) == 1
    with pytest.raises(package.InputError, match="give them to load_deck"):
        package.build_model(deck, keys)


def test_what_other_libraries_take(result):
    out, report = result
    with package.open_result(out) as opened:
        for library, convert in (("xarray", opened.to_xarray), ("pyvista", opened.to_pyvista)):
            if importlib.util.find_spec(library) is None:
                with pytest.raises(package.InputError, match=r"pip install 'mpitled\[(python|pictures)\]'"):
                    convert()
        if importlib.util.find_spec("xarray"):
            data = opened.to_xarray()
            largest = 1e3 * np.linalg.norm(data.displacement.isel(frame=-1), axis=1).max()
            assert largest == report["max_displacement_mm"]
        if importlib.util.find_spec("pyvista"):
            grid = opened.to_pyvista()
            assert grid.n_points == len(opened.points) + len(store.read_model(out / "model.h5").domains)
            assert np.nanmin(grid.cell_data["J"]) == opened.jacobian[-1].min()
            assert np.array_equal(np.isnan(grid.cell_data["J"]), grid.cell_data["material"] < 0)
            assert np.nanmax(grid.cell_data["stress"]) == opened.stress[-1].max()
            assert np.array_equal(np.isnan(grid.cell_data["J"]), grid.cell_data["kind"] == 1)  # EFG nodes
            assert np.count_nonzero(grid.cell_data["kind"] == 2) == len(store.read_model(out / "model.h5").domains)
            with pytest.raises(IndexError, match="but no frame 99"):
                opened.to_pyvista(99)
        assert repr(opened) == f"<RunResult {opened.path}: {len(opened.times)} frames>"
        if importlib.util.find_spec("pandas"):
            import pandas

            assert pandas.DataFrame(opened.history)["time"].iloc[-1] == opened.times[-1]


def test_json_is_what_the_tables_say(result):
    out, report = result
    assert json.loads(mpitled("report", out, "--json").stdout)["steps"] == report["steps"]
    of_model = json.loads(mpitled("info", out / "model.h5", "--json").stdout)
    of_result = json.loads(mpitled("info", out / "result.vtkhdf", "--json").stdout)
    assert (of_model["kind"], of_result["kind"]) == ("model", "result")
    assert of_model["nodes"] == of_result["nodes"] == report["nodes"]
    assert json.loads(mpitled("info", "--json").stdout)["mpitled"] == package.__version__
    checked = json.loads(mpitled("check", CUBE, "--json", "--set", "block.elements=[3,3,3]").stdout)
    assert (checked["hexahedra"], checked["nodes"]["all"]) == (27, 64)
    assert checked["run"]["loop_s"] == pytest.approx(
        checked["run"]["steps"] * checked["run"]["step_s"] + checked["run"]["checks"] * checked["run"]["check_s"]
    )


def test_the_shell_completes_commands_and_keys(tmp_path):
    pytest.importorskip("argcomplete")
    for line, word in (
        ("mpitled sw", "sweep"),
        ("mpitled run --set solver.lo", "solver.load_steps="),
        ("mpitled run --set solver.method=dyn", "dynamic-relaxation"),
        ("mpitled run --set output.pictures=", "false"),
        (f"mpitled sweep {CUBE} --vary material.", "material.brain.youngs_modulus="),
    ):
        told = tmp_path / "told"
        shell = {
            "_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": str(told), "_ARGCOMPLETE_SHELL": "bash",
            "COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9", "_ARGCOMPLETE_IFS": "\013",
        }  # fmt: skip
        command = [sys.executable, "-c", "from mpitled.cli import main; main()"]
        subprocess.run(command, env=os.environ | shell, cwd=ROOT, timeout=60, check=False)
        assert word in told.read_text()
