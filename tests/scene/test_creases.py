"""Meshes without normals get some that are smooth, but at creases."""

from itertools import product

import numpy as np
from support import globe

from unbake.scene.triangles import creased


def test_a_box_has_sharp_edges():
    corners = np.array(list(product((0, 1), repeat=3)), np.float32)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))])
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
    assert (cosine > np.cos(np.radians(10))).all()
    facet = np.cross(b - a, c - a)[np.array([200])]
    facet /= np.linalg.norm(facet, axis=1, keepdims=True)
    assert (facet * positions[faces[200, 0]]).sum() < np.cos(np.radians(5)), "not a facet's normal"
    # At the seam two vertices are at one place, and have one normal.
    first, last = new.reshape(-1, 32, 2, 3)[8, [0, -1], 0]
    np.testing.assert_allclose(normals[first[0]], normals[last[1]], atol=1e-5)


def test_triangles_without_area_have_normals_that_are_numbers():
    positions, faces = globe(8, 4)
    for turned in (faces, faces[:, ::-1], np.zeros((2, 3), int)):
        normals = creased(positions, turned)[2]
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)
