"""What the report says, against closed forms; what is absent; the pictures; and the commands that print it."""

from __future__ import annotations

import errno
import importlib.metadata
import json
import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT, complaint, mpitled

from mpitled import info, results, store
from mpitled.cells import hexahedra
from mpitled.deck import Cloud, load_deck
from mpitled.mesh import grid_points, structured_hexahedra
from mpitled.meshing.cloud import build_cloud
from mpitled.meshing.faces import boundary_faces, interface_faces
from mpitled.model.build import build
from mpitled.results import figures, report
from mpitled.results.final_state import FinalState

GROWTH = """
title = "a tumour in a block"
[block]
size = [48.0, 40.0, 40.0]
elements = [{elements}]
cloud = "{cloud}"
[tumour]
centre = [24.0, 20.0, 20.0]
volume = 113.1
[cloud]
radius = 11.0
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[fixed]]
nodes = "surface"
[solver]
method = "quasi-static"
load_time = 0.1
[output]
frames = 2
"""

SHEAR = """
[block]
size = [30.0, 24.0, 24.0]
elements = [10, 8, 8]
cloud = "{cloud}"
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.3
[[fixed]]
nodes = "z0"
[[displaced]]
nodes = "z1"
displacement = [6.0, 0.0, 0.0]
[solver]
method = "quasi-static"
load_time = 0.2
[output]
frames = 1
"""

#: Keys of every report of a whole run, and those of a tumour in a mixed mesh and of ventricles.
ALWAYS = {
    "max_displacement_mm", "share_over_5mm", "min_jacobian", "energy_J", "steps", "time_step_s", "seconds", "ranks",
    "cells", "nodes", "cell_updates_per_second", "halo_share", "peak_memory_bytes", "kinetic_to_internal",
}  # fmt: skip
OF_TUMOUR = {"tumour_volume_mm3", "volume_balance", "max_displacement_outside_first_ring_mm"}
OF_VENTRICLES = {"ventricle_volume_ml", "ventricle_volume_change_ml", "max_displacement_of_ventricle_wall_mm"}


def model_of(folder, text, **values):
    path = folder / "scene.toml"
    path.write_text(text.format(**values))
    return build(load_deck(path, []))


def state_of(model, move, tumour=None):
    """A run that ended with the displacement move(X) at every place X, m."""
    displacement = move(model.points)
    return FinalState(
        model=model,
        field=displacement,
        displacement=displacement,
        domain_displacement=move(model.domain_points),
        jacobian=np.ones(model.n_cells),
        time=1.0,
        complete=True,
        metadata={"title": "", "load_time_s": 1.0, "tumour": tumour},
        figures={},
    )


def computed(state):
    """The content of report.json."""
    return report.compute(state).as_json()


def test_affine_motion_changes_volumes_by_its_determinant(tmp_path):
    """On distorted hexahedra, whose trilinear volumes an affine map multiplies by its determinant exactly."""
    model = model_of(tmp_path, SHEAR, cloud="none")
    rng = np.random.default_rng(0)
    points = model.points + rng.uniform(-1e-3, 1e-3, model.points.shape)
    half = len(model.hexahedra) // 2
    sets = {"left_ventricle": np.arange(half), "right_ventricle": np.arange(half, len(model.hexahedra))}
    model = replace(model, points=points, cell_sets=sets)
    slope = rng.uniform(-0.2, 0.2, (3, 3))
    made = computed(state_of(model, lambda X: X @ slope.T))
    growth = np.linalg.det(np.eye(3) + slope) - 1
    volumes = {side: made["ventricle_volume_ml"][side] for side in ("left", "right", "total")}
    assert volumes["total"] == pytest.approx(1e6 * hexahedra.volumes(points, model.hexahedra).sum(), rel=1e-13)
    for side, volume in volumes.items():
        assert made["ventricle_volume_change_ml"][side] == pytest.approx(growth * volume, rel=1e-11)
    largest = 1e3 * np.linalg.norm(points @ slope.T, axis=1).max()
    assert made["max_displacement_mm"] == pytest.approx(largest, rel=1e-13)
    # Together the two are the block, on whose surface an affine motion is largest.
    assert max(made["max_displacement_of_ventricle_wall_mm"].values()) == pytest.approx(largest, rel=1e-13)


def test_the_midline_shifts_towards_the_side_that_is_named_right(tmp_path):
    """u_x = 0.1 x, and more beyond what lies between the ventricles: cells 2 and 7 of ten along x, 3 mm each."""
    model = model_of(tmp_path, SHEAR, cloud="none")
    middle = model.points[model.hexahedra].mean(axis=1)
    low, high = middle[:, 1:].min(axis=0), middle[:, 1:].max(axis=0)
    inside = ((middle[:, 1:] > low + 1e-6) & (middle[:, 1:] < high - 1e-6)).all(axis=1)
    at = {x: np.flatnonzero(inside & (np.abs(middle[:, 0] - x) < 1e-6)) for x in (7.5e-3, 22.5e-3)}
    assert all(map(len, at.values()))

    def move(X):
        outside = (X[:, 1:] < low + 1e-3) | (X[:, 1:] > high - 1e-3)
        return np.column_stack([0.1 * X[:, 0] + 1e-2 * outside.any(axis=1), 0 * X[:, 0], 0 * X[:, 0]])

    for sides, sign in (((7.5e-3, 22.5e-3), 1), ((22.5e-3, 7.5e-3), -1)):
        sets = dict(zip(("left_ventricle", "right_ventricle"), map(at.get, sides), strict=True))
        made = computed(state_of(replace(model, cell_sets=model.cell_sets | sets), move))
        assert made["midline_shift_mm"] == pytest.approx(sign * 1.5, rel=1e-12)


def test_crushed_cells_are_counted_and_the_worst_is_named(tmp_path):
    model = model_of(tmp_path, SHEAR, cloud="none")
    jacobian = np.ones(model.n_cells)
    jacobian[[3, 8]] = 0.4, 0.1
    made = computed(replace(state_of(model, lambda X: 0 * X), jacobian=jacobian))
    volume = 1e9 * hexahedra.volumes(model.points, model.hexahedra[[3, 8]]).sum()
    assert made["crushed"] == {"cells": 2, "volume_mm3": pytest.approx(volume, rel=1e-13)}
    worst = made["smallest_jacobian"]
    assert (worst["now"], worst["cell"], worst["material"]) == (0.1, "hexahedron", "brain")
    np.testing.assert_allclose(worst["place_mm"], 1e3 * model.points[model.hexahedra[8]].mean(axis=0), rtol=1e-13)


def test_share_that_moved_far(tmp_path):
    """u_x = 0.4 x on 10 cells of 3 mm: beyond 5 mm is x > 12.5 mm, six cells of ten and six nodes of eleven."""
    model = model_of(tmp_path, SHEAR, cloud="none")
    made = computed(state_of(model, lambda X: X * [0.4, 0, 0]))
    assert made["share_over_5mm"] == {"volume": pytest.approx(6 / 10, rel=1e-13), "nodes": pytest.approx(6 / 11)}


def swell(centre, seed_radius, radius):
    """Displacement of the incompressible swelling of a sphere: r^3 grows by the same everywhere."""

    def move(X):
        from_centre = X - centre
        r = np.linalg.norm(from_centre, axis=1, keepdims=True)
        return from_centre * (np.cbrt(1 + (radius**3 - seed_radius**3) / r**3) - 1)

    return move


def test_volume_balance_of_an_incompressible_swelling(tmp_path):
    """All that the tumour adds goes through the interface; its faces are flat where the motion is not: order h^2."""
    errors = []
    for elements in ("12, 10, 10", "24, 20, 20"):
        model = model_of(tmp_path, GROWTH, elements=elements, cloud="core")
        centre, radii = np.array([24e-3, 20e-3, 20e-3]), (2e-3, 3e-3)
        tumour = {"centre_m": list(centre), "seed_radius_m": radii[0], "radius_m": radii[1]}
        state = state_of(model, swell(centre, *radii), tumour)
        made = computed(state)
        balance, sphere = made["volume_balance"], 4 / 3 * np.pi * 1e9
        assert made["tumour_volume_mm3"] == pytest.approx(sphere * radii[1] ** 3, rel=1e-12)
        assert balance["tumour_added_mm3"] == pytest.approx(sphere * (radii[1] ** 3 - radii[0] ** 3), rel=1e-12)
        assert balance["elastic_compression_mm3"] == 0
        errors.append(balance["relative_error"])
        # Of a surface that is not round, half of it at rest: the mean of the cubes.
        field = state.field.copy()
        field[state.seed[::2]] = 0
        cubes = np.where(np.arange(len(state.seed)) % 2, radii[1] ** 3, radii[0] ** 3)
        by_field = computed(replace(state, field=field))["tumour_volume_by_field_mm3"]
        assert by_field == pytest.approx(sphere * cubes.mean(), rel=1e-12)
        # The first ring is about a spacing wide there, and the next node moves less than the surface's 1 mm.
        assert 0.2 < made["max_displacement_outside_first_ring_mm"] < 0.95
    assert errors[0] < 0.02
    assert errors[1] < errors[0] / 2.5


@pytest.mark.parametrize(
    ("share", "words"), [(0.8, "of the grown volume is lost"), (1.2, "more volume is displaced than was grown")]
)
def test_volume_that_is_lost_is_told_from_volume_that_is_gained(tmp_path, share, words):
    model = model_of(tmp_path, GROWTH, elements="12, 10, 10", cloud="core")
    centre, radii = np.array([24e-3, 20e-3, 20e-3]), (2e-3, 3e-3)
    tumour = {"centre_m": list(centre), "seed_radius_m": radii[0], "radius_m": radii[1]}
    state = state_of(model, swell(centre, *radii), tumour)
    made = report.compute(replace(state, field=share * state.field))
    assert made.volume_error == pytest.approx(0.2, abs=0.02)
    assert (made.volume_unaccounted_mm3 > 0) == (share < 1)
    assert any(words in warning for warning in made.warnings)


def test_the_first_ring_has_every_cell_with_a_node_of_the_tumour(tmp_path):
    """Hexahedra and support domains: what moves by a metre there is left out, and 2 mm at one node beside it found."""
    model = model_of(tmp_path, SHEAR, cloud="core")
    seed = model.node_sets["interface"][:5]
    fe_ring = model.hexahedra[np.isin(model.hexahedra, seed).any(axis=1)]
    ring_domains = np.isin(model.domains, seed).any(axis=1)
    ring = np.union1d(fe_ring, model.domains[ring_domains])
    assert len(np.setdiff1d(fe_ring, model.domains[ring_domains]))
    state = state_of(replace(model, node_sets=model.node_sets | {"tumour": seed}), lambda X: 0 * X)
    state.field[ring] = state.domain_displacement[ring_domains] = 1.0
    state.field[np.setdiff1d(np.arange(model.n_nodes), ring)[0], 1] = 2e-3
    assert computed(state)["max_displacement_outside_first_ring_mm"] == pytest.approx(2.0, rel=1e-12)


def test_volume_is_balanced_only_where_the_interface_is_closed_or_its_rim_at_rest(tmp_path):
    """Through a hole that moves volume comes and goes that no face counts."""
    model = model_of(tmp_path, GROWTH, elements="12, 10, 10", cloud="core")
    interface = model.node_sets["interface"]
    model = replace(model, node_sets=model.node_sets | {"interface": interface[1:]})
    centre = np.array([24e-3, 20e-3, 20e-3])
    tumour = {"centre_m": list(centre), "seed_radius_m": 2e-3, "radius_m": 3e-3}
    state = state_of(model, swell(centre, 2e-3, 3e-3), tumour)
    assert "volume_balance" not in computed(state)
    state.field[model.hexahedra[(model.hexahedra == interface[0]).any(axis=1)]] = 0
    assert "volume_balance" in computed(state)


def test_enclosed_volume_is_that_of_the_hexahedra():
    """To round-off, for any motion: what the void gains, the hexahedra around it lose if their outside is held."""
    points, cells = grid_points((5, 5, 5), (0.05, 0.05, 0.05)), structured_hexahedra((5, 5, 5))
    points = points + np.random.default_rng(1).uniform(-3e-3, 3e-3, points.shape)
    inside = report.enclosed_volume(points, boundary_faces(cells))
    assert inside == pytest.approx(hexahedra.volumes(points, cells).sum(), rel=1e-13)


def test_interface_is_where_the_cloud_is():
    """The top of a hexahedron amid cloud is no part of it, though all its nodes are on the interface."""
    points, cells = grid_points((3, 3, 2), (0.03, 0.03, 0.02)), structured_hexahedra((3, 3, 2))
    dropped = np.zeros(len(cells), bool)
    dropped[9:] = True
    dropped[13] = False
    mesh = build_cloud(points, cells, dropped, {}, Cloud(), None, 0.01).mesh
    faces = interface_faces(mesh.points, mesh.hexahedra, mesh.node_sets["interface"], mesh.integration_points)
    heights = mesh.points[faces].mean(axis=1)[:, 2]
    assert sorted(np.round(heights, 6)) == [0.01] * 8 + [0.015] * 4


@pytest.fixture(scope="module")
def grown(tmp_path_factory):
    """A tumour in a mixed block, run by the command; its folder and what was printed."""
    folder = tmp_path_factory.mktemp("grown")
    (folder / "scene.toml").write_text(GROWTH.format(elements="12, 10, 10", cloud="core"))
    done = mpitled("run", folder / "scene.toml", "--out", folder / "out", pictures=True)
    return folder / "out", done.stdout


def strictly(path):
    """JSON without the numbers that JSON does not have."""
    return json.loads(path.read_text(), parse_constant=pytest.fail)


def test_report_of_a_run_and_its_repetition(grown):
    folder, printed = grown
    made = strictly(folder / "report.json")
    assert made.keys() >= ALWAYS | OF_TUMOUR
    assert not made.keys() & OF_VENTRICLES
    assert made["complete"]
    assert made["tumour_volume_mm3"] == pytest.approx(113.1, rel=1e-9)
    assert made["max_displacement_mm"] == pytest.approx(1.0, abs=0.1)  # R - r0, but for the field
    balance = made["volume_balance"]
    added = balance["tumour_added_mm3"]
    rest = added - balance["pushed_through_interface_mm3"] - balance["elastic_compression_mm3"]
    assert balance["relative_error"] == pytest.approx(abs(rest) / added, rel=1e-9)
    assert balance["relative_error"] < 0.1

    (folder / "report.json").unlink()
    (folder / "deformed.png").unlink()
    whole = mpitled("report", folder).stdout
    again = strictly(folder / "report.json")
    assert {**again, "seconds": {}} == {**made, "seconds": {}}
    assert (folder / "deformed.png").exists()
    lines = {line[2:49].strip(): line[51:] for line in whole.splitlines() if line.startswith("  ")}
    relaxation = {figure.label for figure in figures.FIGURES if figure.relaxation}
    ventricles = {figure.label for figure in figures.FIGURES if re.search("ventricle", figure.key + figure.label)}
    assert lines.keys() == {figure.label for figure in figures.FIGURES} - relaxation - ventricles | {"pictures"}
    assert lines["tumour as reached"] == "113.1 mm3"
    assert lines["cells"] == ", ".join(f"{n:,} {kind.replace('_', ' ')}" for kind, n in made["cells"].items())
    assert lines["run time"] == f"{sum(again['seconds'].values()):.1f} s"
    short = {line[2:49].strip() for line in printed.splitlines() if line.startswith("  ")} - {"pictures"}
    assert short == {figure.label for figure in figures.FIGURES if figure.headline} - ventricles


def test_figures_are_declared_once():
    """Each has one key and one label, which fits the table; a limit has a warning in its meaning."""
    labels = [figure.label for figure in figures.FIGURES]
    assert len(set(labels)) == len(labels)
    assert max(map(len, labels)) <= 47
    assert len({(figure.key, figure.total) for figure in figures.FIGURES}) == len(figures.FIGURES)
    assert all("the report warns above" in figure.meaning for figure in figures.FIGURES if figure.limit)


def test_pictures_show_the_cuts(grown):
    image = pytest.importorskip("matplotlib.image")
    pixels = {name: image.imread(grown[0] / f"{name}.png")[..., :3] for name in ("undeformed", "deformed")}
    for picture in pixels.values():
        coloured = np.ptp(picture, axis=-1) > 0.05  # neither white, black nor grey
        assert coloured.mean() > 0.2
        assert len(np.unique(np.round(picture[coloured], 2), axis=0)) > 100
    assert pixels["undeformed"].shape == pixels["deformed"].shape  # the same frame, so that they can be compared
    assert (pixels["undeformed"] != pixels["deformed"]).mean() > 0.01


@pytest.mark.parametrize("cloud", ["none", "core", "all"])
def test_scenes_without_a_tumour(tmp_path, cloud):
    (tmp_path / "scene.toml").write_text(SHEAR.format(cloud=cloud))
    printed = mpitled("run", tmp_path / "scene.toml", "--out", tmp_path / "out", pictures=True).stdout
    made = strictly(tmp_path / "out" / "report.json")
    assert made.keys() >= ALWAYS
    assert not made.keys() & (OF_TUMOUR | OF_VENTRICLES)
    assert "tumour as reached" not in printed
    assert made["pictures"] == ["undeformed.png", "deformed.png"]


def test_the_energies_of_relaxation_add_up(tmp_path):
    (tmp_path / "scene.toml").write_text(SHEAR.format(cloud="none"))
    method = "solver.method=dynamic-relaxation"
    printed = mpitled("run", "-v", tmp_path / "scene.toml", "--set", method, "--out", tmp_path / "out").stdout
    lines = dict(re.split(r"  +", line.strip(), maxsplit=1) for line in printed.splitlines() if line.startswith("  "))
    external, taken, internal = (
        float(lines[name].removesuffix(" J"))
        for name in ("external work", "dissipated by damping and changes of mass", "internal energy")
    )
    assert external - taken == pytest.approx(internal, rel=1e-3)
    assert float(lines["distance from the static solution, estimated"].removesuffix(" mm")) < 0.01
    assert not {"time step", "kinetic/internal, largest after 10 %", "energy of added mass"} & lines.keys()
    assert ", to 100.0% of the load\n" in mpitled("info", tmp_path / "out" / "result.vtkhdf").stdout


def test_unfinished_results_without_figures(tmp_path):
    """What a killed run left, and numbers that are none: what is unknown is absent or null."""
    model = model_of(tmp_path, SHEAR, cloud="core")
    store.write_model(tmp_path / "model.h5", model, "key")
    rows = store.read_part(tmp_path / "model.h5", 1, 0)
    writer = store.ResultWriter(tmp_path, None, rows, 3, {"title": "killed", "load_time_s": 2.0, "tumour": None})
    moved = np.full((model.n_nodes + len(model.domains), 3), 1e-3)
    for time in (0.0, 0.5):
        values = {"parameters": time * moved, "displacement": time * moved}
        writer.write_frame(time, values, {"J": np.ones(model.n_cells)})
    writer.abandon({"min_jacobian": float("nan"), "peak_memory_bytes": [1, 2]})
    printed = mpitled("report", tmp_path).stdout
    assert "not complete: the last frame is at 25.0% of the load\n" in printed
    assert "smallest J" not in printed
    made = strictly(tmp_path / "report.json")
    assert not made["complete"]
    assert made["min_jacobian"] is None
    assert made["max_displacement_mm"] == pytest.approx(np.sqrt(3) / 2)

    store.write_model(tmp_path / "model.h5", replace(model, points=model.points + 1), "key")
    assert "model.h5" in complaint(mpitled("report", tmp_path, status=2))
    assert "is not a folder" in complaint(mpitled("report", tmp_path / "nowhere", status=2))


@pytest.mark.parametrize("library", ["matplotlib", "pyvista"])
def test_report_without_the_libraries_of_pictures(grown, monkeypatch, library):
    for name in ("cuts", "solid"):
        monkeypatch.delitem(sys.modules, f"mpitled.results.{name}", raising=False)
        monkeypatch.delattr(results, name, raising=False)
    for name in [name for name in sys.modules if name.partition(".")[0] == library]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, library, None)
    made = report.write(grown[0])
    assert made["pictures"] == f"none, because {library} is missing; install it: pip install 'mpitled[pictures]'"
    assert made["pictures"] in report.table(made)


def test_a_folder_that_cannot_be_written_has_its_table(grown, monkeypatch):
    """A page is refused, for it is what was asked for."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    for name in ("replace", "unlink"):  # nor can the temporary file be removed
        monkeypatch.setattr(os, name, refuse)
    done = mpitled("report", grown[0])
    assert "largest displacement" in done.stdout
    said = f"{grown[0] / 'report.json'}: cannot be written (Read-only file system)"
    assert done.stderr == f"note: {said}\n"
    done = mpitled("report", grown[0], "--html", status=2)
    assert "largest displacement" in done.stdout
    assert done.stderr == f"mpitled: {said}\n"


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_cuts_have_no_holes_and_the_right_values(tmp_path, share):
    """Random places in a plane through hexahedra and cloud, for u = (0, 0.1 y, 0): each is in a cut, with |u|."""
    pyvista = pytest.importorskip("pyvista")
    from mpitled.results import cuts, solid

    model = model_of(tmp_path, GROWTH, elements="12, 10, 10", cloud="core")
    state = state_of(model, lambda X: X * [0, 0.1, 0])
    meshes, plane = solid.solid_of(state), (0, 1, 2)
    places = np.random.default_rng(2).uniform(0.1, 39.9, (4000, 3))
    places[:, 0] = 25.0  # between the layers of hexahedra
    stretch = [1, 1 + 0.1 * share, 1]
    places = places[np.linalg.norm(places - [24, 20, 20], axis=1) > 2.0]  # the seed
    found = np.full(len(places), np.nan)
    for mesh in (meshes.hexahedra, meshes.cloud):
        cut = cuts._cut(solid.deformed(mesh, share), plane, 25.0, triangles=True)
        values = pyvista.PolyData(places * stretch).sample(cut)
        inside = values["vtkValidPointMask"] == 1
        assert inside.sum() > 300
        found[inside] = values[solid.SIZE][inside]
    np.testing.assert_allclose(found, 0.1 * places[:, 1], rtol=0, atol=1e-6)


def test_info_of_the_machine_and_of_files(grown):
    printed = mpitled("info").stdout
    for name in ("mpitled", "Python", "MPI", "HDF5", "h5py", "METIS", "numba"):
        assert any(line.startswith(name) for line in printed.splitlines())
    assert importlib.metadata.version("numba") in printed
    assert "a whole result" in mpitled("info", grown[0] / "result.vtkhdf").stdout
    assert "a whole model" in mpitled("info", grown[0] / "model.h5").stdout
    assert mpitled("info", grown[0]).stdout == mpitled("info", grown[0] / "result.vtkhdf").stdout
    assert "is a folder without a result" in complaint(mpitled("info", ROOT, status=2))


def test_info_knows_the_files_around_a_run(tmp_path):
    """Each with the command for it; a file of ours that is cut short is said to be that."""
    for name, words in {
        "a.toml": f"is a deck: mpitled check {tmp_path / 'a.toml'}",
        "a.inp": f"is a mesh: mpitled check {tmp_path / 'a.inp'}",
        "a.k": f"is a mesh: mpitled check {tmp_path / 'a.k'}",
        "report.json": f"is the report of a run: mpitled report {tmp_path}",
        "a.csv": "is a table of text; open it in an editor or a spreadsheet",
        "a.png": "is a picture or a page; open it in a viewer or a browser",
    }.items():
        (tmp_path / name).write_text("anything")
        assert complaint(mpitled("info", tmp_path / name, status=2)) == f"mpitled: {tmp_path / name}: {words}"
    columns = {"case": [1, 2], "warnings": ["", "the cloud is too coarse"]}
    path = tmp_path / "table.h5"
    store.write_columns(path, {"table": columns, "times": {"case": [1, 2]}})
    printed = mpitled("info", path).stdout.splitlines()
    assert printed[1:] == ["table            2 rows of case, warnings", "times            2 rows of case"]
    assert json.loads(mpitled("info", path, "--json").stdout)["tables"]["times"] == {"columns": ["case"], "rows": 2}
    path.write_bytes(path.read_bytes()[:-100])
    assert "(it is cut short); make it anew" in complaint(mpitled("info", path, status=2))


def test_info_names_what_is_missing(monkeypatch):
    """It must not fail with what it is to report."""
    code = (
        "import sys; sys.modules.update(mpi4py=None, h5py=None, matplotlib=None)\n"
        "from mpitled import info; print(info.table()); sys.exit(info.complete())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stderr
    assert "MPI is missing, needed for more than one rank" in done.stdout
    assert "HDF5 is missing" in done.stdout

    installed = importlib.metadata.version

    def version(name):
        if name in ("pymetis", "nibabel"):
            raise importlib.metadata.PackageNotFoundError(name)
        return installed(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    table = info.table()
    assert "METIS is missing, needed for more than one rank: pip install 'pymetis'" in table
    assert "nibabel is missing, useful for label images: pip install 'mpitled[images]'" in table
    assert not info.complete()
