"""Meshes without normals get some that are smooth, but at creases."""

from itertools import product

import numpy as np
import pytest
from scene_texts import ROOM
from support import globe

from unbake.scene.normals import turned_share
from unbake.scene.parse import parse
from unbake.scene.triangles import creased, write_mesh


def box():
    corners = np.array(list(product((0, 1), repeat=3)), np.float32)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))])


def test_a_box_has_sharp_edges():
    corners, faces = box()
    vertices, new, normals = creased(corners, faces)
    assert len(vertices) == 24, "three normals at each corner"
    np.testing.assert_array_equal(vertices[new], faces)
    outwards = 2 * corners[faces].mean(1) - 1
    of_sides = np.eye(3)[np.abs(outwards).argmax(1)] * np.sign(outwards)
    np.testing.assert_allclose(normals[new], of_sides[:, None].repeat(3, 1), atol=1e-6)


def test_a_globe_is_smooth_also_at_its_seam():
    positions, faces = globe(32, 16)
    vertices, new, normals = creased(positions, faces)
    np.testing.assert_array_equal(vertices[new], faces)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)
    a, b, c = np.moveaxis(positions[faces], 1, 0)
    seen = new[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-6].ravel()
    cosine = (normals[seen] * positions[vertices[seen]]).sum(1)
    assert (cosine > np.cos(np.radians(10))).all(), "also near the poles"
    at = positions[vertices]
    assert ((normals * at).sum(1)[np.abs(at[:, 2]) < 0.8] > np.cos(np.radians(1))).all(), (
        "no facets"
    )
    # At the seam two vertices are at one place, and have one normal.
    first, last = new.reshape(-1, 32, 2, 3)[8, [0, -1], 0]
    np.testing.assert_allclose(normals[first[0]], normals[last[1]], atol=1e-5)


def bent(degrees, faces=((0, 1, 2), (1, 0, 3))):
    """Two triangles that share an edge, and are turned by an angle against each other there."""
    turn = np.radians(degrees)
    far = [0, -np.cos(turn), -np.sin(turn)]
    return np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], far]), np.array(faces)


@pytest.mark.parametrize(("degrees", "sharp"), [(30, False), (45, False), (55, True), (60, True)])
def test_normals_of_triangles_that_are_far_apart_make_a_crease(degrees, sharp):
    vertices, _, normals = creased(*bent(degrees))
    assert len(vertices) == (6 if sharp else 4)
    apart = np.degrees(np.arccos(np.clip(normals @ [0, 0, 1], -1, 1)))
    weights = [90, 45, 90, 45]  # of both triangles at the ends of the edge: angles in degrees
    share = weights[2] / (weights[0] + weights[2])
    smooth = {0, round(share * degrees), degrees}
    assert set(np.round(apart).astype(int)) == ({0, degrees} if sharp else smooth)


def test_a_corner_counts_by_its_angle():
    """A right angle above, and one of 45 degrees that goes down: two thirds and one."""
    positions, faces = bent(40)
    positions[3] = [1, *positions[3, 1:]]  # the right angle is at the other end
    vertices, _, normals = creased(positions, faces)
    above, below = (
        np.array([0, 0, 1]),
        np.array([0, -np.sin(np.radians(40)), np.cos(np.radians(40))]),
    )
    mean = (90 * above + 45 * below) / np.linalg.norm(90 * above + 45 * below)
    (at,) = np.flatnonzero(vertices == 0)
    np.testing.assert_allclose(normals[at], mean, atol=1e-5)


def test_sheets_that_face_opposite_sides_have_normals_of_their_own():
    sheets = bent(0, ((0, 1, 2), (0, 2, 1)))
    vertices, _, normals = creased(*sheets)
    assert len(vertices) == 6
    assert sorted(normals[:, 2].tolist()) == [-1, -1, -1, 1, 1, 1]


def test_slivers_have_no_say():
    positions, faces = bent(0)
    positions = np.append(positions, [[0.5, 0.5, 1e-8]], 0)  # on an edge, but for a rounding
    with_sliver = np.append(faces, [[1, 2, 4]], 0)
    normals = creased(positions, with_sliver)[2]
    np.testing.assert_allclose(normals, np.tile([0, 0, 1], (len(normals), 1)), atol=1e-6)


def test_parts_do_not_matter(monkeypatch):
    wanted = creased(*globe(16, 8))
    monkeypatch.setattr("unbake.scene.triangles._AT_ONCE", 7)
    for found, known in zip(creased(*globe(16, 8)), wanted, strict=True):
        np.testing.assert_array_equal(found, known)


def test_triangles_without_area_have_normals_that_are_numbers():
    positions, faces = globe(8, 4)
    for turned in (faces, faces[:, ::-1], np.zeros((2, 3), int)):
        normals = creased(positions, turned)[2]
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)


@pytest.mark.parametrize(
    ("mesh", "kind", "told"),
    [
        (box(), "round", True),
        (box(), "creased", False),
        (box(), "facets", False),
        (globe(8, 4), "round", False),
    ],
    ids=["round box", "box", "facets", "coarse globe"],
)
def test_surfaces_that_are_shaded_as_if_edges_were_round_are_told(tmp_path, mesh, kind, told):
    positions, faces = mesh
    normals = None
    if kind == "creased":
        vertices, faces, normals = creased(positions, faces)
        positions = positions[vertices]
    elif kind == "round":
        centred = positions - positions.mean(0)
        normals = centred / np.linalg.norm(centred, axis=1, keepdims=True)
    write_mesh(tmp_path / "thing.ply", positions, faces, normals)
    facets = '<boolean name="face_normals" value="true"/>' if kind == "facets" else ""
    shape = f'<shape type="ply"><string name="filename" value="thing.ply"/>{facets}'
    bsdf = '<bsdf type="twosided"><bsdf type="principled"/></bsdf></shape>'
    (tmp_path / "scene.xml").write_text(ROOM.format(shape + bsdf))
    share = turned_share(parse(tmp_path / "scene.xml").instantiate())
    assert (share > 0.1) == told and (share == 0) == (not told)
