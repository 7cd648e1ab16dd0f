"""New fits have hash grids as fine as the photographs of their data set tell surfaces apart."""

import dataclasses
import math
import re

import mitsuba as mi
import numpy as np
import pytest
from support import TINY_FIT

from unbake.comparison.method_variant import MethodVariant
from unbake.config import FitConfig, from_toml, preset, read_toml, to_toml, update
from unbake.dataset.camera import Camera
from unbake.dataset.views import Dataset
from unbake.fields.domain import Domain
from unbake.fields.grid_sizes import sized
from unbake.fields.shapes import bsdf_classes, met_shapes
from unbake.scene.edit import to_principled
from unbake.scene.parse import parse
from unbake.training import grid_sizes
from unbake.training.grid_sizes import domain_seen, surface_seen, with_grid_sizes
from unbake.transport.emitter_sampling import has_cut_outs
from unbake.transport.optimized import optimized_shapes

#: Tiny fields whose sizes are left open, but for one.
OPEN = {
    "materials": {
        "albedo": {"neural": {"grid": {"levels": 0, "table_log2": 0}}},
        "roughness": {"neural": {"grid": {"levels": 0}}},
    }
}


def sizes(config):
    fields = (*config.material_settings.values(), config.radiance_settings)
    return [(field.grid.levels, field.grid.table_log2) for field in fields]


def wall(side: float) -> mi.Scene:
    """A square of that side in the plane z = 0, and no light."""
    turned = mi.ScalarTransform4f().scale(side / 2)
    return mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "to_world": turned}})


def camera(distance: float, fov: float, pixels: int = 32) -> Camera:
    return Camera.look_at((0, 0, distance), (0, 0, 0), (0, 1, 0), fov, pixels, pixels)


def test_extent_footprint_and_area_of_a_wall():
    # The wall fills the image.
    straight = camera(4.0, straight_fov())
    seen = surface_seen(wall(2.0), [straight])
    assert seen.extent == pytest.approx(2.02)
    # 2 / 32 where the pixel looks straight, a little more elsewhere.
    assert 2 / 32 < seen.footprint < 1.05 * 2 / 32
    assert seen.area == pytest.approx(4.0, rel=0.2)
    # Twice as many pixels on the same surface; a second view of it shows no more of it.
    finer = surface_seen(wall(2.0), [camera(4.0, straight_fov(), 64)] * 2)
    assert finer.footprint == pytest.approx(seen.footprint / 2, rel=1e-3)
    assert finer.area == pytest.approx(seen.area, rel=0.2)
    # A part is less than all of it.
    part = surface_seen(wall(4.0), [straight])
    assert part.extent == pytest.approx(4.04) and part.area == pytest.approx(4.0, rel=0.4)


def test_many_photographs_from_one_place_show_no_more():
    alone, many = (surface_seen(wall(2.0), [camera(4.0, 30.0)] * count) for count in (1, 40))
    assert alone.area / 2 < many.area < 2 * alone.area


def test_the_domain_of_what_is_seen_leaves_out_what_is_far_away():
    """A lamp at the distance of a sun is most of a scene's box, and nothing that cameras see."""
    turned = mi.ScalarTransform4f().scale(1.0)
    far = {"type": "sphere", "center": [300.0, 0, 500.0], "radius": 2.0}
    near = {"type": "rectangle", "to_world": turned}
    scene = mi.load_dict({"type": "scene", "wall": near, "far": far})
    whole = Domain.of(scene.bbox())
    found = domain_seen(scene, [camera(4.0, straight_fov())], whole)
    np.testing.assert_allclose(found.centre, 0, atol=0.05)
    assert whole.extent > 400 and 2 < found.extent < 2.5
    # What cameras see nearly all of is fields' domain as it is, and so is what they do not see.
    alone = wall(2.0)
    assert domain_seen(alone, [camera(4.0, straight_fov())], Domain.of(alone.bbox())) == Domain.of(
        alone.bbox()
    )
    away = Camera.look_at((0, 0, 4), (0, 0, 9), (0, 1, 0), 40.0, 8, 8)
    assert domain_seen(alone, [away], whole) == whole


def straight_fov() -> float:
    return 2 * math.degrees(math.atan(1 / 4))


def test_cameras_that_see_nothing_tell_nothing():
    away = Camera.look_at((0, 0, 4), (0, 0, 9), (0, 1, 0), 40.0, 8, 8)
    assert surface_seen(wall(2.0), [away]) is None
    assert surface_seen(wall(2.0), [camera(4.0, 30.0), away]) is not None


def test_sizes_follow_the_data_set_and_settings_come_first(cornell):
    dataset = Dataset.load(cornell)
    config = with_grid_sizes(FitConfig(), dataset)
    seen = grid_sizes._SEEN[dataset]
    # 16 x 16 pixels for a box of extent 2: cells of some 0.1.
    assert seen.extent / 40 < seen.footprint < seen.extent / 8
    albedo, roughness, radiance = sizes(config)
    assert albedo == (sized(FitConfig().materials["albedo"]["neural"], seen).grid.levels, 15)
    assert 3 <= albedo[0] <= 5 and radiance[0] == albedo[0] - 1 and roughness == (2, 15)
    assert with_grid_sizes(config, dataset) is config
    assert config.regularization.albedo_radius == seen.footprint / seen.extent
    assert from_toml(to_toml(config)) == config
    # What is no unknown stays open.
    assert config.materials["metallic"] == FitConfig().materials["metallic"]

    mine = from_toml("[materials.albedo.neural.grid]\nlevels = 9\n")
    assert sizes(with_grid_sizes(mine, dataset)) == [(9, 15), roughness, radiance]
    for name in ("paper", "release", "release-lighting"):
        published = preset(name)
        assert with_grid_sizes(published, dataset) is published
    # The same for all methods.
    for method in ("prb", "direct", "no-prior"):
        assert sizes(with_grid_sizes(FitConfig(method=method), dataset)) == sizes(config)
    assert sizes(MethodVariant("prb").settings(config)) == sizes(config)


def test_settings_that_leave_nothing_open_need_no_scene(cornell):
    dataset = dataclasses.replace(Dataset.load(cornell), scene=cornell / "none.xml")
    assert with_grid_sizes(TINY_FIT, dataset) is TINY_FIT


def test_a_run_goes_on_with_the_sizes_that_it_was_started_with(
    unbake, cornell, tiny, tmp_path, monkeypatch
):
    settings, run = tmp_path / "open.toml", tmp_path / "run"
    settings.write_text(to_toml(update(read_toml(tiny), OPEN)))
    words = ("fit", cornell, "--out", run)
    assert unbake(*words, "--settings", settings, "--steps", 1).status == 0
    first = read_toml(run / "config.toml")
    # Bases of 2 with cells of an eighth of the box; what the file gives stays.
    (levels, table), roughness, radiance = sizes(first)
    assert 4 <= levels <= 6 and table == 15 and roughness == (2, 8) and radiance == (2, 8)
    monkeypatch.setattr(grid_sizes, "surface_seen", None)
    assert unbake(*words, "--resume", "--steps", 2).status == 0
    assert sizes(read_toml(run / "config.toml")) == sizes(first)


#: BSDFs with bitmaps in all the places where these may be; the first two differ in theirs alone.
PAINTED = {
    "red": '<bsdf type="principled">{base_color:red.png}{roughness:grey.png}</bsdf>',
    "blue": '<bsdf type="principled">{base_color:blue.png}{roughness:grey.png}</bsdf>',
    "diffuse": '<bsdf type="twosided"><bsdf type="diffuse">{reflectance:red.png}</bsdf></bsdf>',
    "bent": '<bsdf type="normalmap">{normalmap:flat.png}'
    '<bsdf type="principled">{base_color:red.png}</bsdf></bsdf>',
    "bumpy": '<bsdf type="bumpmap">{arbitrary:grey.png}'
    '<bsdf type="principled">{base_color:red.png}</bsdf></bsdf>',
    "blend": '<bsdf type="blendbsdf">{weight:grey.png}<bsdf type="principled"/>'
    '<bsdf type="conductor"/></bsdf>',
    "cut": '<bsdf type="mask">{opacity:holes.png}'
    '<bsdf type="principled">{base_color:blue.png}</bsdf></bsdf>',
    "mirror": '<bsdf type="conductor">{specular_reflectance:grey.png}</bsdf>',
    "lamp": '<emitter type="area">{radiance:red.png}</emitter>',
}


@pytest.fixture
def painted(tmp_path):
    """Makes the scene: cubes of these BSDFs beside each other, two of each."""
    rng = np.random.default_rng(1)
    pictures = {name: rng.integers(0, 256, (4, 4, 3), np.uint8) for name in ("red", "blue", "grey")}
    pictures["flat"] = np.full((4, 4, 3), (128, 128, 255), np.uint8)
    pictures["holes"] = np.uint8(255 * rng.integers(0, 2, (4, 4, 3)))
    for name, pixels in pictures.items():
        mi.Bitmap(pixels).write(str(tmp_path / f"{name}.png"))
    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "cube.ply"))
    texture = (
        r'<texture name="\1" type="bitmap"><boolean name="raw" value="true"/>'
        r'<string name="filename" value="\2"/></texture>'
    )
    shapes = [
        f'<shape type="ply"><string name="filename" value="cube.ply"/>{bsdf}'
        f'<transform name="to_world"><scale value="0.4"/>'
        f'<translate x="{i % 5}" y="{i // 5}"/></transform></shape>'
        for i, bsdf in enumerate([*PAINTED.values()] * 2)
    ]
    text = re.sub(r"\{(\w+):([\w.]+)\}", texture, "".join(shapes))
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{text}</scene>')

    def made(**options):
        parsed = parse(tmp_path / "scene.xml")
        to_principled(parsed)
        return parsed.instantiate(**options)

    return made


def test_sizes_are_the_same_without_the_bitmaps(painted):
    whole, bare = painted(), painted(bitmaps=False)
    cameras = [Camera.look_at((2, y, 6), (2, 1.5, 0), (0, 1, 0), 50.0, 64, 48) for y in (-3, 2)]
    assert surface_seen(bare, cameras) == surface_seen(whole, cameras)

    def shapes(scene):
        textures = ("Bitmap", "Uniform", "SRGB")
        return sorted(
            f"{sorted(c for c in bsdf_classes(s) if not c.startswith(textures))} "
            f"{s.primitive_count()}"
            for s in met_shapes(scene)
        )

    def bitmaps(scene):
        return [key for key, _ in mi.traverse(scene) if key.endswith(".data")]

    assert shapes(bare) == shapes(whole) and has_cut_outs(bare)
    assert len(optimized_shapes(bare)) == len(optimized_shapes(whole)) > 4
    assert len(bitmaps(whole)) > len(bitmaps(bare)) > 0
    assert {key.split(".")[-2] for key in bitmaps(bare)} == {"opacity", "radiance"}
