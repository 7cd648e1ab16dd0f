"""Pieces of surface are those of geometry, however a scene is stored."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from unbake.fields.pieces import FULL_SHARE, Pieces, connected
from unbake.fields.shapes import met_shapes

#: A unit cube about the origin: corners, and two triangles of each side.
CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) - 0.5
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOX = np.array([t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))])


def mesh(name, positions, faces):
    made = mi.Mesh(name, len(positions), len(faces))
    params = mi.traverse(made)
    params["vertex_positions"] = mi.Float(np.ravel(positions).astype(np.float32))
    params["faces"] = mi.UInt32(np.ravel(faces).astype(np.uint32))
    params.update()
    return made


def scene(*meshes, **others):
    shapes = {f"shape{i}": one for i, one in enumerate(meshes)}
    return mi.load_dict({"type": "scene", **shapes, **others})


def split(positions, faces):
    """A mesh with three vertices of its own for each triangle."""
    return positions[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


def numbers(pieces, scene):
    return [pieces.of(shape)[:, 0].astype(int) for shape in met_shapes(scene)]


def test_each_side_of_a_box_is_a_piece_and_a_ball_is_one():
    made = scene(mesh("box", CORNERS, BOX), ball={"type": "sphere", "radius": 3})
    pieces = Pieces(made, 100)
    (box, ball) = numbers(pieces, made)
    assert pieces.count == 7
    assert ball.tolist() == [0]  # the largest
    assert (box[::2] == box[1::2]).all()
    assert sorted(set(box.tolist())) == [1, 2, 3, 4, 5, 6]


def test_a_smooth_surface_is_one_piece_whatever_its_vertices_are():
    angle = np.linspace(0, np.pi, 13)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    bent = np.concatenate([np.insert(ring, 2, z, axis=1) for z in (0, 1)])
    i = np.arange(12)
    faces = np.concatenate(
        [np.stack([i, i + 1, i + 13], -1), np.stack([i + 14, i + 13, i + 1], -1)]
    )
    for positions, triangles in ((bent, faces), split(bent, faces), (bent, faces[:, ::-1])):
        assert Pieces(scene(mesh("bent", positions, triangles)), 100).count == 1


def test_how_meshes_are_divided_and_ordered_does_not_matter():
    away = CORNERS * 0.5 + np.float32(2)
    whole = np.concatenate([CORNERS, away]), np.concatenate([BOX, BOX + 8])
    order = np.random.default_rng(3).permutation(len(whole[1]))
    wanted = Pieces(made := scene(mesh("all", *whole)), 100)
    (found,) = numbers(wanted, made)
    shuffled = scene(mesh("all", *split(whole[0], whole[1][order])))
    assert (numbers(Pieces(shuffled, 100), shuffled)[0] == found[order]).all()
    # Halves of one side may lie in two meshes.
    for cut in (5, 13):
        apart = scene(mesh("b", whole[0], whole[1][cut:]), mesh("a", whole[0], whole[1][:cut]))
        parts = numbers(Pieces(apart, 100), apart)
        assert sorted(map(len, parts)) == sorted([cut, 24 - cut])
        for part in parts:
            assert (part == (found[:cut] if len(part) == cut else found[cut:])).all()


def test_a_scene_with_other_shapes_has_the_same_pieces():
    ball = {"type": "sphere", "radius": 2}
    made = scene(mesh("box", CORNERS, BOX), ball=ball)
    pieces = Pieces(made, 100)
    lamp = mesh("lamp", 50 * CORNERS, BOX)
    lit = scene(
        lamp, mesh("box", *split(CORNERS, BOX[::-1, ::-1])), ball=ball, sun=ball | {"radius": 9}
    )
    wanted, rows = numbers(pieces, made), [pieces.of(shape) for shape in met_shapes(lit)]
    box = next(r for r, shape in zip(rows, met_shapes(lit), strict=True) if shape.id() == "shape1")
    assert (box[:, 0] == wanted[0][::-1]).all()
    unknown = [row for r in rows for row in r.tolist() if row[1] == 0]
    assert len(unknown) == 12 + 1  # the lamp and the sun
    assert {row[0] for row in unknown} == {99}


def test_small_pieces_are_weak():
    made = scene(mesh("large", 10 * CORNERS, BOX), mesh("small", CORNERS + np.float32(9), BOX))
    large, small = (Pieces(made, 100).of(shape) for shape in met_shapes(made))
    assert set(large[:, 0]) == {0, 1, 2, 3, 4, 5}
    np.testing.assert_allclose(large[:, 1], 1)
    np.testing.assert_allclose(small[:, 1], np.sqrt(1 / 606 / FULL_SHARE), rtol=1e-5)


def test_the_smallest_pieces_share_a_number_and_are_strong_together():
    made = scene(mesh("large", 10 * CORNERS, BOX), mesh("small", CORNERS + np.float32(9), BOX))
    few = Pieces(made, 7)
    large, small = (few.of(shape) for shape in met_shapes(made))
    assert few.count == 7
    assert set(large[:, 0]) == {0, 1, 2, 3, 4, 5}
    assert set(small[:, 0]) == {6}
    np.testing.assert_allclose(small[:, 1], np.sqrt(6 / 606 / FULL_SHARE), rtol=1e-5)


def test_triangles_without_area_do_no_harm():
    flat = np.concatenate([BOX, [(0, 0, 0), (0, 1, 1)]])
    pieces = Pieces(made := scene(mesh("box", CORNERS, flat)), 6)
    assert np.isfinite(pieces.of(met_shapes(made)[0])).all()
    assert len(set(numbers(pieces, made)[0][:12])) == 6


@pytest.mark.parametrize("angle", [0, 20, 90])
def test_slivers_join_what_meets_at_them_as_an_edge_does(angle):
    """Meshes of CAD programs have them where a vertex lies on an edge of a neighbour."""
    up = np.array([(np.cos(np.radians(angle)), 0, np.sin(np.radians(angle)))])
    seam = np.array([(0, 0, 0), (0, 1, 0), (0, 2, 0)], float)
    left, right = seam[[0, 2]] - (1, 0, 0), seam + up
    positions = np.concatenate([seam, left, right]) + np.array((100, 3, 7))
    walls = [(0, 2, 4), (0, 4, 3), (0, 1, 6), (0, 6, 5), (1, 2, 7), (1, 7, 6)]
    for sliver in ([(0, 1, 2)], [(0, 1, 2), (0, 1, 1)], [(0, 0, 1), (0, 2, 1), (0, 0, 2)]):
        made = scene(mesh("wall", positions, np.array(sliver + walls)))
        pieces = Pieces(made, 100)
        assert pieces.count == (1 if angle < 40 else 2), sliver
    (without,) = numbers(Pieces(made := scene(mesh("wall", positions, np.array(walls))), 100), made)
    assert len(set(without)) == 2, "the sides do not share an edge"


def test_rays_meet_the_pieces_of_their_faces():
    ball = {"type": "sphere", "center": [0, 0, 5], "radius": 0.5}
    made = scene(mesh("box", CORNERS, BOX), ball=ball)
    pieces = Pieces(made, 100)
    pieces.attach(made)
    origins = mi.Point3f([0.1, 0.1, 3, 0.1], 0.2, [-3, 3, 5, 9])
    si = made.ray_intersect(mi.Ray3f(origins, mi.Vector3f([0, 0, -1, 0], 0, [1, -1, 0, 1])))
    found = pieces.at(si, si.is_valid())
    box, single = (pieces.of(shape) for shape in met_shapes(made))
    hit = np.array(si.prim_index)[:2]
    rows = np.concatenate([box[hit], single, [(0, 1, 0)]])  # the last ray meets nothing
    assert np.array(found.number).tolist() == rows[:, 0].astype(int).tolist()
    np.testing.assert_allclose(np.array(found.strength), rows[:, 1])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_components_are_those_of_a_search(seed):
    rng = np.random.default_rng(seed)
    one, other = rng.integers(0, 60, (2, 45))
    label = connected(60, one, other)
    matrix = np.eye(60, dtype=bool)
    matrix[one, other] = matrix[other, one] = True
    for _ in range(6):
        matrix = matrix @ matrix
    assert ((label[:, None] == label[None, :]) == matrix).all()
    firsts = [np.flatnonzero(label == i)[0] for i in range(label.max() + 1)]
    assert firsts == sorted(firsts)


def test_a_scene_without_meshes_has_pieces():
    made = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    pieces = Pieces(made, 5)
    pieces.attach(made)
    si = made.ray_intersect(mi.Ray3f([0, 0, -3], [0, 0, 1]))
    assert pieces.count == 1
    assert np.array(pieces.at(si, si.is_valid()).number).tolist() == [0]
    dr.sync_thread()
