"""Results as NIfTI on the grid of their label image: the field and its inverse, sides, volumes, and clear errors."""

from __future__ import annotations

import json
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from conftest import complaint, mpitled
from scenes import block, pulled
from test_labels import phantom, save

from mpitled.results import field, final_state
from mpitled.store import results

nibabel = pytest.importorskip("nibabel")

VOXEL = (1.0, 1.5, 2.0)
CENTRE, SEED = (15.0, 12.0, 7.0), 2.0
DECK = f"""
[labels]
image = "head.nii.gz"
element_size = 4.1 # so that no voxel is as near to one integration point as to another
tissue = [41]
left_ventricle = [5]
right_ventricle = [7]
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[material.csf]
youngs_modulus = 10.0
poissons_ratio = 0.1
cells = ["left_ventricle", "right_ventricle"]
[[fixed]]
nodes = "skull"
[tumour]
centre = {list(CENTRE)}
volume = 904.8
seed_radius = {SEED}
surface_nodes = 600
[cloud]
radius = 13.0
growth = 0.3
"""


class Export(NamedTuple):
    """What is known of an exported run."""

    folder: Path
    image: Path  # of labels
    said: list[str]
    field: field.Field
    u: np.ndarray  # (nx, ny, nz, 3), mm
    back: np.ndarray  # (nx, ny, nz, 3), mm
    labels: np.ndarray  # (nx, ny, nz)
    before: np.ndarray  # (nx, ny, nz)
    places: np.ndarray  # (nx, ny, nz, 3), mm


def exported(folder, name):
    return nibabel.load(folder / "export" / f"{name}.nii.gz")


def array(image):
    return np.asarray(image.dataobj)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A phantom in which a tumour of 6 mm radius has grown beside the right ventricle."""
    folder = tmp_path_factory.mktemp("images")
    data, affine = phantom(VOXEL)
    image = save(folder / "head.nii.gz", data, affine)
    (folder / "head.toml").write_text(DECK)
    mpitled("run", folder / "head.toml", "--out", folder / "out")
    out = folder / "out"
    said = mpitled("export", out, "--nifti").stdout.splitlines()
    u, back = (array(exported(out, name))[:, :, :, 0] for name in ("displacement", "inverse_displacement"))
    places = np.stack(np.indices(data.shape), axis=3) @ affine[:3, :3] + affine[:3, 3]
    labels = array(exported(out, "labels"))
    return Export(out, image, said, field.open_field(out), u, back, labels, data, places)


def test_files_lie_on_the_image_and_say_what_they_are(run):
    image = nibabel.load(run.image)
    *paths, label, told = run.said
    names = ("displacement.nii.gz", "inverse_displacement.nii.gz", "labels.nii.gz")
    assert paths == [str(run.folder / "export" / name) for name in names]
    assert label == "label 42 of labels.nii.gz is the tumour"
    assert told.startswith("inverse_displacement.nii.gz inverts the displacements to within 0.")
    for path in paths:
        written = nibabel.load(path)
        np.testing.assert_array_equal(written.affine, image.affine)
        np.testing.assert_array_equal(written.get_qform(), image.affine)
        for code in ("sform_code", "qform_code"):
            assert written.header[code] == image.header["sform_code"]
        assert written.header.get_xyzt_units()[0] == "mm"
        if "labels" not in path:
            assert written.header["intent_code"] == 1006
            assert written.shape == (*image.shape, 1, 3)
            assert written.get_data_dtype() == np.float32
    assert written.shape == image.shape
    assert written.get_data_dtype() == image.get_data_dtype() == np.int16
    assert bytes(written.header["descrip"].item()).endswith(b"42: tumour")
    assert len(list((run.folder / "export").iterdir())) == 3


def test_displacement_is_the_field_at_the_voxels_of_tissue(run):
    apart = np.linalg.norm(run.places - CENTRE, axis=3)
    tissue = (run.before > 0) & (apart >= SEED)
    values = run.field.at(1e-3 * run.places[tissue])
    assert set(values.source) == {field.IN_HEXAHEDRON, field.IN_CLOUD, field.OUTSIDE}
    same = np.isclose(run.u[tissue], 1e3 * values.displacement, rtol=1e-6, atol=1e-9).all(axis=1)
    assert same.mean() > 0.9999  # a place as near to one hexahedron as to another has either's value
    assert not run.u[~tissue].any()
    assert (apart < SEED).any()


def test_the_inverse_leads_back_to_where_the_tissue_was(run):
    (told,) = (float(line.split()[-6]) for line in run.said if "inverts the displacements" in line)
    tumour = np.linalg.norm(run.places - CENTRE, axis=3) < 6
    covered = (run.before > 0) & ~tumour  # which the skull does not let go
    assert not run.back[~covered].any()
    y = run.places[covered]
    there = y + run.back[covered]
    values = run.field.at(1e-3 * there)
    missed = np.linalg.norm(there + 1e3 * values.displacement - y, axis=1)
    hexahedra = values.source == field.IN_HEXAHEDRON
    # Float32 of less than 8 mm is off by 2.4e-7 mm a component, and displacements do not grow faster than fivefold.
    assert np.mean(missed[hexahedra] < 1e-5) > 0.99
    assert np.mean(missed < 1e-2) > 0.98
    # What is told has two digits. A jump of the field is that of the polynomials of two domains at one place.
    assert missed.max() < 1.05 * told + 1e-3
    assert told < final_state.read(run.folder).metadata["deck"]["labels"]["element_size"] / 8


def test_labels_have_the_volumes_of_the_report(run):
    told = json.loads((run.folder / "report.json").read_text())
    voxel = np.prod(VOXEL)
    outcome = final_state.read(run.folder)
    for side, label in (("left", 5), ("right", 7)):
        in_image = run.before == label
        change = voxel * (np.count_nonzero(run.labels == label) - np.count_nonzero(in_image))
        # Voxels of the label and the hexahedra of the ventricle are not quite the same places: each is told by its J.
        cells = outcome.model.cell_sets[f"{side}_ventricle"]
        inside = run.before > 0
        found, _, outside = field.locate(outcome.model.points, outcome.model.hexahedra, 1e-3 * run.places[inside])
        mesh = np.zeros(run.before.shape, bool)
        mesh[inside] = np.isin(found, cells) & (outside == 0)
        shrinks = np.zeros(run.before.shape)
        shrinks[inside] = np.where(outside == 0, 1 - outcome.jacobian[found], 0)
        differ = voxel * np.abs(shrinks[mesh ^ in_image]).sum()
        of_mesh = 1e3 * told["ventricle_volume_change_ml"][side]
        assert of_mesh < -voxel
        # The mean J of a cell for its voxels, and the cells' edges by whole voxels, are off by a tenth.
        assert abs(change - of_mesh) < differ + voxel + 0.1 * abs(of_mesh)
        assert change < 0
    # Middles of voxels in a ball miscount it by the root of the voxels on its surface, in sigmas of 1/3.
    on_surface = 4 * np.pi * 36 / voxel ** (2 / 3)
    found = np.count_nonzero(run.labels == 42)
    assert abs(found - told["tumour_volume_mm3"] / voxel) < 3 / 3 * np.sqrt(on_surface)
    outside = run.before == 0
    np.testing.assert_array_equal(run.labels[outside], 0)
    assert (run.labels[~outside] > 0).all()


@contextmanager
def replaced(run, image):
    """The label image of the run is another one for a while."""
    kept = run.image.read_bytes()
    try:
        nibabel.save(image, run.image)
        yield
    finally:
        run.image.write_bytes(kept)


def export_of(run, image, folder):
    """The export of the run with another label image in its place; what was printed."""
    with replaced(run, image):
        return mpitled("export", run.folder, "--nifti", "--out", folder / "export").stdout


@pytest.mark.parametrize("axes", ["LAS", "PSR", "IAL"])
def test_whichever_way_voxels_run_the_world_is_the_same(run, tmp_path, axes):
    orientations = nibabel.orientations
    turn = orientations.ornt_transform(orientations.axcodes2ornt("RAS"), orientations.axcodes2ornt(axes))
    turned = nibabel.load(run.image).as_reoriented(turn)
    export_of(run, turned, tmp_path)
    for name, same in (("displacement", run.u), ("inverse_displacement", run.back), ("labels", run.labels)):
        written = exported(tmp_path, name)
        assert nibabel.aff2axcodes(written.affine) == tuple(axes)
        np.testing.assert_allclose(written.affine, turned.affine, rtol=0, atol=1e-5)
        data = array(written).reshape(*turned.shape, -1)
        # By the file's own affine, without nibabel's reorientation: the same point has the same vector.
        index = np.stack(np.indices(turned.shape), axis=3) @ written.affine[:3, :3].T + written.affine[:3, 3]
        i, j, k = np.rint((index - run.places[0, 0, 0]) / VOXEL).astype(int).reshape(-1, 3).T
        np.testing.assert_array_equal(data.reshape(len(i), -1), same[i, j, k].reshape(len(i), -1))


def test_an_image_in_metres_has_results_in_millimetres(run, tmp_path):
    image = nibabel.load(run.image)
    in_metres = nibabel.Nifti1Image(array(image), np.diag([1e-3, 1e-3, 1e-3, 1]) @ image.affine)
    in_metres.header.set_xyzt_units("meter")
    export_of(run, in_metres, tmp_path)
    written = exported(tmp_path, "displacement")
    assert written.header.get_xyzt_units()[0] == "mm"
    np.testing.assert_allclose(written.affine, image.affine, rtol=1e-6)
    there = np.isclose(array(written)[:, :, :, 0], run.u, rtol=1e-3, atol=1e-5).all(axis=3)
    assert there.mean() > 0.999  # the header's float32 moves voxels by less than a micrometre, some to another domain


@pytest.mark.parametrize(("kind", "most", "wider"), [("u1", 255, "i2"), ("i4", 2**31 - 1, "i8"), ("f4", 90, "f4")])
def test_labels_keep_their_type_if_it_holds_one_more(run, tmp_path, kind, most, wider):
    """The largest label is outside the brain, and stays where it is."""
    image = nibabel.load(run.image)
    data = array(image).astype(kind)
    data[0, 0, 0] = most
    said = export_of(run, nibabel.Nifti1Image(data, image.affine), tmp_path)
    written = exported(tmp_path, "labels")
    assert f"label {most + 1} of labels.nii.gz is the tumour" in said
    assert written.get_data_dtype() == wider
    assert array(written)[0, 0, 0] == most
    np.testing.assert_array_equal(array(written) == most + 1, run.labels == 42)


def test_another_image_than_that_of_the_run_is_refused(run):
    image = nibabel.load(run.image)
    data, shifted = array(image), np.eye(4)
    shifted[0, 3] = 20.0
    for changed, affine, words in (
        (np.where(data == 5, 41, data), image.affine, "label 5 (labels.left_ventricle) is not in it"),
        (np.where(np.roll(data, 1, 0) == 5, 5, data), image.affine, "has other labels than when"),
        (data, shifted @ image.affine, "has another position than when"),
    ):
        with replaced(run, nibabel.Nifti1Image(changed, affine)):
            assert words in complaint(mpitled("export", run.folder, "--nifti", status=2))


def test_what_is_missing_is_told_in_a_line(run, tmp_path, monkeypatch):
    moved = run.image.rename(run.image.with_name("gone.nii.gz"))
    try:
        line = complaint(mpitled("export", run.folder, "--nifti", status=2))
    finally:
        moved.rename(run.image)
    assert line == f"mpitled: {run.image}: the label image of {run.folder} is missing; restore it"
    assert "holds no result" in complaint(mpitled("export", tmp_path, "--nifti", status=2))
    (tmp_path / "block.toml").write_text(block((20, 20, 20), (2, 2, 2)) + pulled(0.1) + "[output]\nframes = 1\n")
    mpitled("run", "-q", tmp_path / "block.toml", "--out", tmp_path / "block")
    line = complaint(mpitled("export", tmp_path / "block", "--nifti", status=2))
    assert line.startswith("mpitled: --nifti: the scene of ")
    assert "has no [labels]" in line
    (tmp_path / "file").touch()
    assert "cannot be made" in complaint(
        mpitled("export", run.folder, "--nifti", "--out", tmp_path / "file" / "x", status=2)
    )
    assert "one of the arguments --abaqus --nifti is required" in mpitled("export", run.folder, status=2).stderr
    monkeypatch.setitem(sys.modules, "nibabel", None)
    line = complaint(mpitled("export", run.folder, "--nifti", status=2))
    assert line.endswith("label images need nibabel; install it: pip install 'mpitled[images]'")


def test_an_undeformed_body_is_where_it_was(run):
    """As the first frame of a run that was stopped at once."""
    still = field.open_field(run.folder, 0)
    places = 1e-3 * run.places[(run.before > 0) & (np.linalg.norm(run.places - CENTRE, axis=3) > SEED)]
    origins = still.origins(places)
    np.testing.assert_allclose(origins.position, places, rtol=0, atol=1e-6)  # where Newton is content
    assert origins.missed.max() <= 1e-6


def test_of_an_unfinished_run_the_last_frame_is_written(run, tmp_path, monkeypatch):
    monkeypatch.setattr(results.Result, "complete", False)
    done = mpitled("export", run.folder, "--nifti", "--out", tmp_path)
    note = f"note: {run.folder}: is not complete; the images show its last frame, at 100.0% of the load\n"
    assert done.stderr == note


def test_a_body_that_moves_takes_its_labels_along(run, tmp_path):
    """Without a tumour, and with a surface that goes beyond where it was: 8 voxels to the right."""
    deck = DECK[: DECK.index("[[fixed]]")] + '[[displaced]]\nnodes = "skull"\ndisplacement = [8.0, 0.0, 0.0]\n'
    data, affine = phantom((2.0, 2.0, 2.0))
    data = np.pad(data, ((4, 4), (0, 0), (0, 0)))
    data[0, 0, 0] = 90
    save(tmp_path / "head.nii.gz", data, affine)
    (tmp_path / "head.toml").write_text(deck)
    mpitled("run", "-q", tmp_path / "head.toml", "--out", tmp_path / "out")
    said = mpitled("export", tmp_path / "out", "--nifti").stdout
    assert "tumour" not in said
    labels = array(exported(tmp_path / "out", "labels"))
    # The run ends within 0.01 mm of the solution, a rigid motion: half of what would change a voxel is 1 mm.
    np.testing.assert_array_equal(labels[4:], np.where(data == 90, 0, data)[:-4])
    assert labels[0, 0, 0] == 90
