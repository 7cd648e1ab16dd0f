"""Lamps of rooms: found where photographs show what no surface can reflect, as meshes of scenes."""

import dataclasses

import numpy as np
import pytest
import trimesh
from layouts import quiet, write_nerfstudio
from support import TINY_FIT, tiny_fields

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.dataset.views import Dataset
from unbake.importing import lamps
from unbake.importing.import_data import import_data
from unbake.importing.lamps import find_lamps, with_lamps
from unbake.importing.meshes import Part
from unbake.importing.settings import ImportSettings
from unbake.scene.emitters import named_emitters
from unbake.scene.parse import parse
from unbake.training.defaults import with_unknown
from unbake.training.problem import make_problem

BULB, PANEL = (30.0, 20.0, 10.0), (4.0, 5.0, 9.0)
#: A box, a ball that shines and part of whose box does.
ROOM = """<scene version="3.0.0"><sensor type="perspective"><float name="fov" value="80"/>
    <transform name="to_world"><lookat origin="1,-2.5,0.5" target="0,0.5,0" up="0,0,1"/></transform>
    </sensor>{shapes}</scene>"""
SHAPE = """<shape type="ply"><string name="filename" value="{name}.ply"/>
    <bsdf type="twosided"><bsdf type="principled">{colour}</bsdf></bsdf>{light}</shape>"""
SPOT = """<emitter type="spot"><rgb name="intensity" value="90"/><float name="cutoff_angle"
    value="60"/><transform name="to_world"><lookat origin="0,0,2.8" target="0,0.5,-3" up="0,1,0"/>
    </transform></emitter>"""


def room_meshes():
    """The walls with a panel, as one mesh, a ball, and the triangles of the panel."""
    walls = trimesh.creation.box((6, 6, 6))
    walls.invert()
    panel = trimesh.Trimesh([[-1, 2.9, -1], [1, 2.9, -1], [1, 2.9, 1], [-1, 2.9, 1]],
                            [[0, 1, 2], [0, 2, 3]])  # fmt: skip
    both = trimesh.util.concatenate([walls, panel])
    shines = np.arange(len(both.faces)) >= len(walls.faces)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.4)
    ball.apply_translation((-1.2, 0.5, 0.8))
    return both, ball, shines


def write_room(folder, lit):
    """A scene: `lit` says what lights it, lamps or a spot."""
    both, ball, shines = room_meshes()
    folder.mkdir(parents=True)
    parts = {
        "walls": both.submesh([np.flatnonzero(~shines)], append=True),
        "panel": both.submesh([np.flatnonzero(shines)], append=True),
        "ball": ball,
    }
    shapes = ""
    for name, mesh in parts.items():
        mesh.export(folder / f"{name}.ply")
        radiance = {"panel": PANEL, "ball": BULB}.get(name) if lit == "lamps" else None
        value = "" if radiance is None else " ".join(map(str, radiance))
        light = f'<emitter type="area"><rgb name="radiance" value="{value}"/></emitter>'
        albedo = "0" if radiance else "0.6 0.5 0.4"
        colour = f'<rgb name="base_color" value="{albedo}"/><float name="specular" value="0"/>'
        shapes += SHAPE.format(name=name, colour=colour, light=light if radiance else "")
    scene = folder / "scene.xml"
    scene.write_text(ROOM.format(shapes=shapes + (SPOT if lit == "spot" else "")))
    return scene


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lit")
    small = CaptureSettings(views=8, held_out=2, resolution=40, spp=64, max_depth=8)
    return capture(write_room(folder / "scene", "lamps"), folder / "data", small, tell=quiet)


def room_parts():
    both, ball, shines = room_meshes()
    uv = np.random.default_rng(0).random((len(both.vertices), 2))
    walls = Part("walls", np.array(both.vertices), np.array(both.faces), None, uv)
    return [walls, Part("ball", np.array(ball.vertices), np.array(ball.faces), None, None)], shines


@pytest.mark.parametrize("turned", [False, True])
def test_what_shines_is_found_with_its_radiance(turned, lit):
    parts, shines = room_parts()
    if turned:
        parts = [dataclasses.replace(part, faces=part.faces[:, ::-1]) for part in parts]
    ball, panel = find_lamps(parts, lit.train, quiet)
    print(ball.radiance, panel.radiance, ball.turned, panel.turned)
    assert (ball.part, panel.part) == (1, 0)
    assert set(panel.faces) == set(np.flatnonzero(shines))
    assert len(ball.faces) > 0.9 * len(parts[1].faces)
    np.testing.assert_allclose(ball.radiance, BULB, rtol=0.02)
    np.testing.assert_allclose(panel.radiance, PANEL, rtol=0.02)
    assert ball.turned == turned
    assert not ball.clipped and not panel.clipped


def test_clipped_lamps_are_as_bright_as_the_room_asks_for(lit, monkeypatch):
    parts, _ = room_parts()
    read = lamps.read_photograph
    clipped = [dataclasses.replace(view, clipped=1.0) for view in lit.train]
    monkeypatch.setattr(lamps, "read_photograph", lambda view: np.minimum(read(view), 1))
    found = find_lamps(parts, clipped, quiet)
    assert {lamp.part for lamp in found} == {0, 1} and all(lamp.clipped for lamp in found)
    shown = [max(lamp.radiance) for lamp in found]
    print(shown)
    assert min(shown) > 4 and max(shown) < 4 * max(BULB)


def test_exposures_are_taken_out(lit, monkeypatch):
    parts, _ = room_parts()
    read = lamps.read_photograph
    factors = {view.name: 2.0**i for i, view in enumerate(lit.train)}
    views = [dataclasses.replace(view, exposure=factors[view.name]) for view in lit.train]
    monkeypatch.setattr(lamps, "read_photograph", lambda view: read(view) * factors[view.name])
    found = find_lamps(parts, views, quiet)
    np.testing.assert_allclose(found[0].radiance, BULB, rtol=0.02)


def test_nothing_is_a_lamp_where_photographs_do_not_show_what_lights_them(tmp_path):
    small = CaptureSettings(views=8, held_out=2, resolution=40, spp=64, max_depth=8)
    scene = write_room(tmp_path / "scene", "spot")
    dataset = capture(scene, tmp_path / "data", small, tell=quiet)
    assert find_lamps(room_parts()[0], dataset.train, quiet) == []


def test_lamps_become_parts_of_their_own():
    parts, shines = room_parts()
    panel = lamps.Lamp(0, np.flatnonzero(shines), PANEL, True, False)
    ball = lamps.Lamp(1, np.arange(len(parts[1].faces)), BULB, False, False)
    rest, own = with_lamps(
        [*parts, dataclasses.replace(parts[1], name="walls-lamp")], [panel, ball]
    )
    assert [part.name for part in rest] == ["walls", "walls-lamp"]
    assert [part.name for part in own] == ["walls-lamp-2", "ball-lamp"]
    walls, cut = rest[0], own[0]
    assert len(walls.faces) + len(cut.faces) == len(parts[0].faces) and len(cut.positions) == 4
    corners = parts[0].positions[parts[0].faces]
    np.testing.assert_array_equal(walls.positions[walls.faces], corners[~shines])
    np.testing.assert_array_equal(cut.positions[cut.faces], corners[shines][:, ::-1])
    np.testing.assert_array_equal(cut.uv[cut.faces], parts[0].uv[parts[0].faces[shines]][:, ::-1])


# ------------------------------------------------------------------------------------- of an import


@pytest.fixture
def source(lit, tmp_path):
    """A folder of nerfstudio, and the files of its mesh."""
    write_nerfstudio(lit, tmp_path / "source")
    both, ball, _ = room_meshes()
    both.export(tmp_path / "walls.ply")
    ball.export(tmp_path / "ball.ply")
    return tmp_path / "source", [tmp_path / "walls.ply", tmp_path / "ball.ply"]


def test_a_room_is_imported_with_its_lamps_and_fitted_with_them(source, tmp_path, unbake):
    folder, meshes = source
    words = [word for mesh in meshes for word in ("--mesh", mesh)]
    outcome = unbake("import", folder, *words, "--out", tmp_path / "data")
    assert outcome.status == 0, outcome
    assert "lamps: 2 found, " in outcome.out and "stand inside the mesh" not in outcome.out
    dataset = Dataset.load(tmp_path / "data")
    scene = parse(dataset.scene, dataset.root)
    strengths = {light.name: light.strength for light in named_emitters(scene)}
    assert len(strengths) == 2
    assert "2 clipped in the photographs" in outcome.out
    assert 4 < min(map(max, strengths.values())) and max(map(max, strengths.values())) < 120
    written = {file.name for file in (tmp_path / "data" / "scene" / "meshes").iterdir()}
    assert {"walls.ply", "walls-lamp.ply", "ball-lamp.ply"} <= written
    config = with_unknown(tiny_fields("grid"), dataset)
    assert config.unknown == "materials+emission"
    problem = make_problem(dataset.scene, dataset.background, config, 0.5)
    assert len(problem.emitter_names) == 2 and problem.environment is None


def test_lamps_are_left_alone_where_nobody_wants_them(source, tmp_path):
    folder, meshes = source
    told: list[str] = []
    settings = ImportSettings(lamps="none")
    import_data(folder, tmp_path / "data", meshes, settings, tell=told.append)
    assert "stand inside the mesh" in told[-1]
    dataset = Dataset.load(tmp_path / "data")
    (light,) = named_emitters(parse(dataset.scene, dataset.root))
    assert light.name == "environment"
    assert with_unknown(TINY_FIT, dataset).unknown == "materials+lighting"


def test_lamps_are_not_looked_for_beside_known_light(source, tmp_path, unbake):
    folder, meshes = source
    lights = tmp_path / "lights.xml"
    lights.write_text("<scene version='3.0.0'><emitter type='point'/></scene>")
    words = ["--mesh", meshes[0], "--lights", lights, "--lamps", "found"]
    outcome = unbake("import", folder, *words, "--out", tmp_path / "data")
    assert outcome.status == 2 and "lamps are found where the light is unknown" in outcome.err


def test_that_no_lamp_was_found_is_told_to_who_asked(captured, meshes, tmp_path):
    write_nerfstudio(captured, tmp_path / "source")
    told: list[str] = []
    import_data(
        tmp_path / "source",
        tmp_path / "data",
        meshes,
        ImportSettings(lamps="found"),
        tell=told.append,
    )
    assert "lamps: none found, no surface is surely too bright to reflect" in told


@pytest.mark.parametrize(
    ("lights", "unknown"),
    [
        ("<emitter type='constant'/>", "materials+lighting"),
        ("<emitter type='point'/>", "materials+emission"),
        ("<emitter type='constant'/><emitter type='point'/>", "materials+lighting+emission"),
    ],
)
def test_of_unknown_light_all_is_unknown(lights, unknown, lit, tmp_path):
    (tmp_path / "scene.xml").write_text(
        f"<scene version='3.0.0'><shape type='cube'/>{lights}</scene>"
    )
    dataset = dataclasses.replace(
        lit, folder=tmp_path, scene=tmp_path / "scene.xml", light="unknown"
    )
    assert with_unknown(TINY_FIT, dataset).unknown == unknown
    known = dataclasses.replace(dataset, light="known")
    assert with_unknown(TINY_FIT, known).unknown == "materials"
