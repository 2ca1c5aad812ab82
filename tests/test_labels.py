"""Label images: exact volumes, one manifold solid, sets, the void of a tumour, any orientation, and errors."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import complaint, mpitled
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mpitled import deck
from mpitled.errors import InputError
from mpitled.meshing.faces import FACES, boundary_faces
from mpitled.meshing.head import Grid, solid_cells
from mpitled.meshing.label_image import read_image
from mpitled.meshing.labels import mesh_labels

nibabel = pytest.importorskip("nibabel")

DATA = Path(__file__).parent.parent / "jobs" / "data"
CENTRE = (-0.026, -0.070, 0.003)


def tumour(centre=CENTRE):
    return deck.Tumour(centre=centre, volume=523.6e-9, surface_nodes=400)


@pytest.fixture(scope="module")
def brain():
    """The brain of jobs/data in 5 mm hexahedra, without and with a tumour."""
    labels = deck.Labels(image=DATA / "mni152_labels_1mm.nii.gz", element_size=0.005)
    cloud = deck.Cloud(points_per_spacing=1.4, growth=0.3)
    return mesh_labels(labels, cloud, None), mesh_labels(labels, cloud, tumour())


def n_pieces(hexahedra):
    """Number of face-connected pieces; each face belongs to one or two hexahedra."""
    _, face, count = np.unique(
        np.sort(hexahedra[:, FACES].reshape(-1, 4), axis=1), axis=0, return_inverse=True, return_counts=True
    )
    assert count.max() <= 2
    cell = np.arange(face.size) // 6
    graph = coo_array((np.ones(face.size), (cell, len(hexahedra) + face.ravel())), (len(hexahedra) + len(count),) * 2)
    return connected_components(graph, directed=False)[0]


def assert_manifold(faces):
    """Each edge of the surface belongs to two faces, and the faces around each node are one fan."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    _, edge, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    assert set(count) == {2}
    # Corners of faces, connected across edges, are the fans of all nodes.
    face = np.arange(len(edges)) // 4
    first, second = np.sort(np.argsort(edge.ravel(), kind="stable").reshape(-1, 2), axis=1).T
    corner = [4 * face + (np.arange(len(edges)) + end) % 4 for end in (0, 1)]
    # Neighbours have opposite directions along their common edge.
    joins = [(corner[0][first], corner[1][second]), (corner[1][first], corner[0][second])]
    i, j = (np.concatenate(side) for side in zip(*joins, strict=True))
    assert (faces.ravel()[i] == faces.ravel()[j]).all()
    fans = connected_components(coo_array((np.ones(len(i)), (i, j)), (faces.size,) * 2), directed=False)[0]
    assert fans == len(np.unique(faces))


def test_brain_is_one_manifold_solid_with_the_volumes_of_its_labels(brain):
    mesh, _ = brain
    assert n_pieces(mesh.hexahedra) == 1
    surface = boundary_faces(mesh.hexahedra)
    assert_manifold(surface)
    np.testing.assert_array_equal(mesh.node_sets["skull"], np.unique(surface))
    np.testing.assert_array_equal(np.unique(mesh.hexahedra), np.arange(mesh.n_nodes))
    figures, cube = mesh.figures, 0.005**3
    # Volumes are multiples of a cube: errors are up to half a cube, and up to two cubes in the repaired solid.
    assert figures["image_solid_volume_m3"] == pytest.approx(1837.79e-6, rel=1e-9)
    assert abs(figures["solid_volume_m3"] - figures["image_solid_volume_m3"]) < 2 * cube
    for side in ("left", "right"):
        name = f"{side}_ventricle"
        assert figures[f"image_{name}_volume_m3"] == pytest.approx(8.558e-6, rel=1e-9)
        assert abs(figures[f"{name}_volume_m3"] - 8.558e-6) <= 0.5 * cube
        cells = mesh.hexahedra[mesh.cell_sets[name]]
        assert len(cells) * cube == pytest.approx(figures[f"{name}_volume_m3"])
        assert n_pieces(cells) == 1
        np.testing.assert_array_equal(mesh.node_sets[name], np.unique(cells))
        assert not np.isin(mesh.node_sets["skull"], cells).any()
        assert (mesh.points[cells].mean(axis=(0, 1))[0] < 0) == (side == "left")
    assert_partition(mesh)


def assert_partition(mesh):
    parts = [mesh.cell_sets[name] for name in ("tissue", "left_ventricle", "right_ventricle")]
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(mesh.n_cells))
    np.testing.assert_array_equal(mesh.cell_sets["all"], np.arange(mesh.n_cells))


def test_nodes_and_hexahedra_are_numbered_along_x(brain):
    for mesh in brain:
        fe = np.rint((mesh.points[: mesh.n_fe_nodes] - mesh.points.min(axis=0)) / 0.005).astype(int)
        assert (np.diff(fe @ [1, 1000, 1000000]) > 0).all()
        assert (np.diff(fe[mesh.hexahedra[:, 0]] @ [1, 1000, 1000000]) > 0).all()
        # For neighbours along x all eight node numbers increase by one.
        a, b = mesh.hexahedra[:-1], mesh.hexahedra[1:]
        neighbours = a[:, 1] == b[:, 0]
        assert neighbours.mean() > 0.9
        assert (b[neighbours] == a[neighbours] + 1).mean() > 0.9
        np.testing.assert_array_equal(mesh.hexahedra[:, 1], mesh.hexahedra[:, 0] + 1)


def test_tumour_makes_a_void_in_tissue_only(brain):
    whole, mesh = brain
    np.testing.assert_array_equal(mesh.points[mesh.node_sets["skull"]], whole.points[whole.node_sets["skull"]])
    for name in ("left_ventricle", "right_ventricle"):
        np.testing.assert_array_equal(mesh.points[mesh.node_sets[name]], whole.points[whole.node_sets[name]])
    assert n_pieces(mesh.hexahedra) == 1
    np.testing.assert_array_equal(np.unique(mesh.hexahedra), np.arange(mesh.n_fe_nodes))
    assert_partition(mesh)
    dropped = len(whole.hexahedra) - len(mesh.hexahedra)
    assert mesh.figures["void_volume_m3"] == pytest.approx(dropped * 0.005**3, rel=1e-12)
    seed_volume = 4 / 3 * np.pi * 0.002**3
    void = mesh.figures["void_volume_m3"] - seed_volume
    assert mesh.integration_volumes.sum() == pytest.approx(void, rel=1e-12)
    seed = mesh.points[mesh.node_sets["tumour"]]
    assert len(seed) == 400
    np.testing.assert_allclose(np.linalg.norm(seed - CENTRE, axis=1), 0.002, rtol=1e-12)
    cavity = np.setdiff1d(np.unique(boundary_faces(mesh.hexahedra)), mesh.node_sets["skull"])
    np.testing.assert_array_equal(mesh.node_sets["interface"], cavity)
    # All tissue in the sphere of 18 mm, by centres of hexahedra.
    middle = whole.points[whole.hexahedra].mean(axis=1)
    inside = np.linalg.norm(middle - CENTRE, axis=1) <= 0.018
    assert dropped == np.count_nonzero(inside & np.isin(np.arange(len(middle)), whole.cell_sets["tissue"]))


@pytest.mark.parametrize("element_size", [0.002, 0.003, 0.004])
def test_the_tumour_of_the_job_decks_fits_at_every_element_size(element_size):
    labels = deck.Labels(image=DATA / "mni152_labels_2mm.nii.gz", element_size=element_size)
    mesh = mesh_labels(labels, deck.Cloud(points_per_spacing=1.4, growth=0.3), tumour())
    assert mesh.figures["void_volume_m3"] == pytest.approx(4 / 3 * np.pi * 0.018**3, rel=0.05)
    assert 2.4 < mesh.figures["integration_points_per_efg_node"] < 4
    assert n_pieces(mesh.hexahedra) == 1


@pytest.mark.parametrize("seed", range(4))
def test_random_solids_are_repaired(seed):
    """Noise has hundreds of non-manifold edges and vertices, cavities and separate pieces."""
    share = np.zeros((16, 15, 14))
    share[2:-2, 2:-2, 2:-2] = np.random.default_rng(seed).random((12, 11, 10))
    solid, added = solid_cells(share)
    assert added > 0
    _, hexahedra = Grid(np.zeros(3), 1.0, (14, 15, 16)).hexahedra(solid)
    assert n_pieces(hexahedra) == 1
    surface = boundary_faces(hexahedra)
    assert_manifold(surface)
    nodes, faces = np.unique(surface, return_inverse=True)
    edges = (np.repeat(faces.reshape(-1, 4)[:, 0], 4), faces.ravel())
    graph = coo_array((np.ones(faces.size), edges), (len(nodes),) * 2)
    assert connected_components(graph, directed=False)[0] == 1  # one surface: no cavity


# --- phantoms --------------------------------------------------------------------------------------------------------


def phantom(voxel=(1.0, 1.0, 1.0), gap=0.5, left=(6.0, 12.0, 5.0), right=(4.0, 9.0, 4.0)):
    """Labels and affine of an ellipsoid, semi-axes 34, 42, 30 mm around (3, -5, 7) mm, with two ventricles."""
    box = zip((3, -5, 7), (36, 44, 32), voxel, strict=True)
    axes = [np.arange(c - half + v / 2, c + half, v) for c, half, v in box]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    data = np.zeros(x.shape, np.int16)

    def ball(centre, semi):
        return sum(((p - c) / s) ** 2 for p, c, s in zip((x, y, z), centre, semi, strict=True)) <= 1

    data[ball((3, -5, 7), (34, 42, 30))] = 41
    data[ball((3 - gap - left[0], -5, 7), left)] = 5
    data[ball((3 + gap + right[0], -5, 7), right)] = 7
    affine = np.diag([*voxel, 1.0])
    affine[:3, 3] = [a[0] for a in axes]
    return data, affine


def save(path, data, affine):
    nibabel.save(nibabel.Nifti1Image(data, affine), path)
    return path


def labels_of(path, size=0.004, **keys):
    given = {"tissue": (41,), "left_ventricle": (5,), "right_ventricle": (7,)} | keys
    return deck.Labels(image=path, element_size=size, **given)


@pytest.mark.parametrize("voxel", [(1.0, 1.0, 1.0), (1.0, 1.5, 2.0)])
@pytest.mark.parametrize("size", [0.003, 0.0047])
def test_volumes_and_positions_of_anisotropic_voxels(tmp_path, voxel, size):
    data, affine = phantom(voxel)
    mesh = mesh_labels(labels_of(save(tmp_path / "p.nii.gz", data, affine), size), deck.Cloud(), None)
    ml = 1e-9 * np.prod(voxel)
    for name, label in (("left_ventricle", 5), ("right_ventricle", 7)):
        assert abs(mesh.figures[f"{name}_volume_m3"] - (data == label).sum() * ml) <= 0.5 * size**3
    assert abs(mesh.figures["solid_volume_m3"] - (data > 0).sum() * ml) <= 2 * size**3
    middle = mesh.points[mesh.hexahedra].mean(axis=1)
    # Positions are those of the ellipsoids, to a quarter of a hexahedron.
    np.testing.assert_allclose(middle.mean(axis=0), [0.003, -0.005, 0.007], atol=size / 4)
    left = middle[mesh.cell_sets["left_ventricle"]].mean(axis=0)
    np.testing.assert_allclose(left, [-0.0035, -0.005, 0.007], atol=size / 4)
    assert len(mesh.node_sets["skull"]) == len(np.unique(boundary_faces(mesh.hexahedra)))


@pytest.mark.parametrize("axes", ["LPS", "PSR", "IAL"])
def test_orientation_of_the_file_does_not_matter(tmp_path, axes):
    data, affine = phantom((1.0, 1.5, 2.0))
    image = nibabel.Nifti1Image(data, affine)
    turned = nibabel.orientations.ornt_transform(
        nibabel.orientations.axcodes2ornt("RAS"), nibabel.orientations.axcodes2ornt(axes)
    )
    nibabel.save(image.as_reoriented(turned), tmp_path / "turned.nii")
    mesh = mesh_labels(labels_of(tmp_path / "turned.nii"), deck.Cloud(), None)
    same = mesh_labels(labels_of(save(tmp_path / "p.nii", data, affine)), deck.Cloud(), None)
    np.testing.assert_allclose(mesh.points, same.points, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(mesh.hexahedra, same.hexahedra)
    for name in mesh.cell_sets:
        np.testing.assert_array_equal(mesh.cell_sets[name], same.cell_sets[name])


def test_ventricles_that_share_faces_stay_separate(tmp_path):
    data, affine = phantom(gap=0.0, left=(9.0, 14.0, 9.0), right=(5.0, 10.0, 7.0))
    assert (data[:-1][data[1:] == 7] == 5).any()
    mesh = mesh_labels(labels_of(save(tmp_path / "p.nii", data, affine)), deck.Cloud(), None)
    for name, label in (("left_ventricle", 5), ("right_ventricle", 7)):
        cells = mesh.hexahedra[mesh.cell_sets[name]]
        assert n_pieces(cells) == 1
        assert abs(len(cells) * 64e-9 - (data == label).sum() * 1e-9) <= 0.5 * 64e-9
    assert len(np.intersect1d(mesh.node_sets["left_ventricle"], mesh.node_sets["right_ventricle"])) >= 4


def test_separate_pieces_cavities_and_a_ventricle_at_the_surface(tmp_path):
    data, affine = phantom()
    data[:3, :3, :3] = 41
    data[34:38, 60:64, 40:44] = 0
    data[30:34, 40:46, 60:] = np.where(data[30:34, 40:46, 60:] > 0, 5, 0)
    mesh = mesh_labels(labels_of(save(tmp_path / "p.nii", data, affine)), deck.Cloud(), None)
    assert "0.027 ml" in mesh.remarks[0]
    assert "0.064 ml" in mesh.remarks[1]
    assert not np.isin(mesh.node_sets["left_ventricle"], mesh.node_sets["skull"]).any()


def test_a_ventricle_within_the_void_stays_connected(tmp_path):
    """A void of 19 mm holds the whole small right ventricle, which would be an island."""
    data, affine = phantom(right=(4.0, 5.0, 4.0), gap=4.0)
    path = save(tmp_path / "p.nii", data, affine)
    seed = tumour((0.0115, 0.006, 0.007))
    mesh = mesh_labels(labels_of(path, 0.0025), deck.Cloud(radius=0.019), seed)
    assert n_pieces(mesh.hexahedra) == 1
    whole = mesh_labels(labels_of(path, 0.0025), deck.Cloud(), None)
    assert len(mesh.cell_sets["right_ventricle"]) == len(whole.cell_sets["right_ventricle"])
    middle = whole.points[whole.hexahedra[whole.cell_sets["right_ventricle"]]].mean(axis=1)
    assert np.linalg.norm(middle - seed.centre, axis=1).max() < 0.019


def refused(labels, message, seed=None):
    with pytest.raises(InputError, match=message) as error:
        mesh_labels(labels, deck.Cloud(), seed)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data, affine: (data, affine @ tilt(5.0)), "oblique"),
        (lambda data, affine: (np.stack([data, data], axis=3), affine), "not three dimensions"),
        (lambda data, affine: (data * np.float32(0.5), affine), "no integers"),
        (lambda data, affine: (np.where(data == 5, 41, data).astype(np.int16), affine), r"label 5 .*left_ventricle"),
        (lambda data, affine: (np.zeros_like(data), affine), r"label 41 .*tissue"),
        (lambda data, affine: (data.astype(np.complex64), affine), "complex64"),
        (None, "no such file"),
        (b"not an image", "not an image"),
        ((DATA / "mni152_labels_2mm.nii.gz").read_bytes()[:9999], "not an image"),
    ],
)
def test_invalid_images_are_refused(tmp_path, change, message):
    path = tmp_path / "bad.nii.gz"
    if isinstance(change, bytes):
        path.write_bytes(change)
    elif change:
        save(path, *change(*phantom()))
    assert refused(labels_of(path), message).startswith(str(path))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"size": 0.004e-3}, "enlarge it"),
        ({"size": 0.2}, "make it smaller"),
        ({"size": 0.03}, "make it smaller"),
        ({"right_ventricle": (41,)}, "given twice"),
        ({"left_ventricle": (44,)}, r"in it; name one of 5, 7, 41, or none: labels.left_ventricle = \[\]$"),
        ({"tissue": (44,)}, "in it; name one of 5, 7, 41$"),
        ({"left_ventricle": (5, 44)}, r"label 44 \(labels.left_ventricle\) is not in it; leave it out, .* 5, 7, 41$"),
    ],
)
def test_keys_that_do_not_fit_the_image_are_refused(tmp_path, keys, message):
    refused(labels_of(save(tmp_path / "p.nii", *phantom()), **keys), message)


def tilt(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize("share", [0.4, -0.4, 0.6, -0.6])
def test_an_image_is_oblique_if_its_tilt_moves_a_voxel_by_more_than_half_its_size(tmp_path, share):
    data, affine = phantom()
    affine[1, 0] += share * np.abs(affine).max(axis=0)[:3].min() / data.shape[0]
    path = save(tmp_path / "tilted.nii.gz", data, affine)
    if abs(share) < 0.5:
        read_image(path)
    else:
        with pytest.raises(InputError, match="oblique"):
            read_image(path)


@pytest.mark.parametrize(
    ("centre", "message"),
    [
        # The ellipsoid ends at x = 37 mm, and a cube's edge is 4 mm.
        ((0.5, -0.005, 0.007), r"outside the brain, 46[1-7](\.\d)? mm from the nearest tissue"),
        ((0.003, 0.0362, 0.007), "from the skull's|outside"),
        ((-0.0035, -0.005, 0.007), "in the left ventricle"),
        ((0.003, -0.043, 0.007), "mm from the skull's hexahedra"),
        ((0.02e-3, -0.005e-3, 0.007e-3), r"; it looks like metres: in mm it is \(20, -5, 7\)$"),
    ],
)
def test_a_tumour_outside_the_tissue_is_refused(tmp_path, centre, message):
    line = refused(labels_of(save(tmp_path / "p.nii", *phantom())), message, tumour(centre))
    assert line.startswith("tumour.centre = (")
    assert "move it" in line


def test_messages_propose_a_valid_position(tmp_path):
    labels = labels_of(save(tmp_path / "p.nii", *phantom()))
    for centre, part in (((0.003, 0.032, 0.007), "skull"), ((-0.0125, -0.005, 0.007), "left ventricle")):
        line = refused(labels, rf"from the {part}'s hexahedra, .* need 6 mm; move it \(the near", tumour(centre))
        nearest = tuple(float(x) / 1e3 for x in re.search(r"has it is \((.*)\) mm\)", line)[1].split(","))
        assert 0 < np.linalg.norm(np.subtract(nearest, centre)) < 0.015
        mesh_labels(labels, deck.Cloud(), tumour(nearest))


def test_images_with_redundant_axes_or_without_a_position_are_read(tmp_path):
    data, affine = phantom()
    same = mesh_labels(labels_of(save(tmp_path / "p.nii", data, affine), 0.0009), deck.Cloud(), None)
    assert any("element_size = 0.9 mm: is smaller than a voxel" in remark for remark in same.remarks)
    nibabel.save(nibabel.Nifti1Image(data[..., None], None), tmp_path / "nowhere.nii")
    labels = labels_of(tmp_path / "nowhere.nii", tissue=(5, 7, 41), left_ventricle=(), right_ventricle=())
    mesh = mesh_labels(labels, deck.Cloud(), None)
    assert any("does not give the position of its voxels" in remark for remark in mesh.remarks)
    assert (set(mesh.cell_sets), set(mesh.node_sets)) == ({"all", "tissue"}, {"skull"})


def test_a_centre_in_voxels_is_converted_in_the_message(tmp_path):
    """By the axes of the file, which are permuted and reversed."""
    path = tmp_path / "turned.nii.gz"
    original = nibabel.load(DATA / "mni152_labels_2mm.nii.gz")
    turned = original.as_reoriented(np.array([[1, -1], [2, 1], [0, -1]]))
    nibabel.save(turned, path)
    voxel = np.round(np.linalg.inv(turned.affine) @ (-32.0, -20.0, 10.0, 1.0))
    there = ", ".join(f"{x:g}" for x in (turned.affine @ voxel)[:3])
    labels = deck.Labels(image=path, element_size=0.006)
    line = refused(labels, "outside", tumour(tuple(1e-3 * voxel[:3])))
    assert line.endswith(f"; it looks like voxels: in mm it is ({there})")
    assert "voxels" not in refused(labels, "outside", tumour((0.5, -0.005, 0.007)))


def test_exchanged_ventricles_cause_a_warning(tmp_path):
    """Left and right are those of the world, not of the voxels."""
    path = tmp_path / "turned.nii"
    nibabel.save(nibabel.Nifti1Image(*phantom()).as_reoriented(np.array([[0, -1], [1, 1], [2, 1]])), path)
    assert mesh_labels(labels_of(path), deck.Cloud(), None).remarks == ()
    swapped = labels_of(path, left_ventricle=(7,), right_ventricle=(5,))
    (remark,) = mesh_labels(swapped, deck.Cloud(), None).remarks
    assert remark == f"warning: labels.left_ventricle lies right of labels.right_ventricle in {path}; swap them"


def test_info_lists_the_labels_of_an_image(tmp_path):
    data, affine = phantom((1.0, 1.5, 2.0))
    path = save(tmp_path / "p.nii.gz", data, affine)
    info = json.loads(mpitled("info", path, "--json").stdout)
    assert info["voxels"] == [*data.shape]
    assert info["voxel_mm"] == pytest.approx([1, 1.5, 2])
    assert info["extent_mm"]["x"] == pytest.approx([3 - 36, 3 + 36])
    counts = {str(label): 3e-3 * np.count_nonzero(data == label) for label in (5, 7, 41)}
    assert info["labels_ml"] == pytest.approx(counts)
    lines = mpitled("info", path).stdout.splitlines()
    assert lines[2] == "voxel            1 x 1.5 x 2 mm"
    assert f"label            41: {counts['41']:.3f} ml" in lines
    assert f"list its labels by: mpitled info {path}" in complaint(mpitled("check", path, status=2))
    assert "no such file" in complaint(mpitled("info", tmp_path / "q.nii", status=2))


def test_a_brain_with_one_label_for_both_ventricles(tmp_path):
    """It is the left ventricle of the deck, from check to report; a material may name the missing ventricle."""
    data, affine = phantom()
    save(tmp_path / "p.nii", np.where(data == 7, 5, data), affine)
    text = """
[labels]
image = "p.nii"
element_size = 4.0
tissue = [41]
left_ventricle = [5]
right_ventricle = []
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.45
cells = ["tissue"]
[material.csf]
youngs_modulus = 10.0
poissons_ratio = 0.1
cells = ["left_ventricle", "right_ventricle"]
[[fixed]]
nodes = "skull"
[tumour]
centre = [3.0, 20.0, 7.0]
volume = 110.0
surface_nodes = 200
[cloud]
radius = 11.0
growth = 0.4
"""
    path = tmp_path / "brain.toml"
    path.write_text(text.replace("[]", "[5]"))
    line = complaint(mpitled("check", path, status=2))
    assert line.endswith("name a label once; one label of both ventricles: labels.right_ventricle = []")
    path.write_text(text)
    assert "mm from the left ventricle" in mpitled("check", path).stdout
    mpitled("run", path, "--out", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert set(report["ventricle_volume_change_ml"]) == {"left", "total"}
    mpitled("sweep", path, "--vary", "tumour.volume=110", "--set", "output.pictures=false", "--out", tmp_path / "table")
    (row,) = json.loads(mpitled("report", tmp_path / "table", "--json").stdout)
    assert row["right_ml"] is None
    assert row["left_ml"] == row["total_ml"]
    # Without ventricles no cell has the fluid's material.
    path.write_text(
        text.replace("tissue = [41]", "tissue = [5, 41]").replace("left_ventricle = [5]", "left_ventricle = []")
    )
    assert "csf" not in mpitled("check", path).stdout
