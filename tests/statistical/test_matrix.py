"""Images and gradients of each method in scenes of each kind, against Mitsuba's path tracers.

A cell is a scene and a method. Its image is compared pixel by pixel. Its gradients are those of the
weighted sum of the image by all unknowns: albedo, roughness, metallic, strengths of lights and the
environment. The reference is Mitsuba's `path`, or `volpath` where there are cut-outs, and nothing
of it is differentiated: finite differences with common random numbers, and for lights, in which an
image is linear, the image of that light alone.

What a method leaves out on purpose is left out of its reference too: `direct` has paths of one
bounce, and `ours` differentiates the first bounce alone, below a radiance field that is a constant.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    ConstantMaterials,
    ConstantRadiance,
    PathTracedRadiance,
    assert_same_expectation,
    assert_same_mean,
    pixel_rays,
    planned_sampler,
    seeded,
    stock_path,
    student_quantile,
)

from unbake.dataset.camera import Camera
from unbake.fields.emission import Emission, emission_textures
from unbake.fields.envmap import EnvironmentMap, environment_emitter
from unbake.fields.texture import material_textures
from unbake.transport import path_sample
from unbake.transport.operator import bounce
from unbake.transport.path_tracer import path_traced
from unbake.transport.vertex import SceneView

#: Parameters of an environment map of 8 x 8 texels.
SKY_LEVELS = ("level.4", "level.8")
CAMERA = Camera.look_at((0, -2.6, 0.7), (0, 0, -0.15), (0, 0, 1), 50.0, 12, 12)

# ------------------------------------------------------------------------------------- scenes


@dataclass(frozen=True)
class Values:
    """All that can be unknown: numbers for Mitsuba's own plugins, or textures and emitters."""

    albedo: object
    roughness: object
    metallic: object
    lights: dict[str, object]  # strengths of lamps, by name
    sky: mi.Emitter | None = None

    @property
    def paint(self) -> dict:
        return {
            "type": "principled",
            "base_color": self.albedo,
            "roughness": self.roughness,
            "metallic": self.metallic,
        }


def rgb(values) -> dict:
    return {"type": "rgb", "value": [float(v) for v in values]}


def pane(origin, target, bsdf, size=1.0, **more) -> dict:
    up = [0, 1, 0] if origin[:2] == target[:2] else [0, 0, 1]
    to_world = mi.ScalarTransform4f().look_at(list(origin), list(target), up).scale(size)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf, **more}


def ball(bsdf, **more) -> dict:
    return {"type": "sphere", "center": [0.1, 0, -0.45], "radius": 0.5, "bsdf": bsdf, **more}


def front(bsdf) -> dict:
    """A pane between the camera and the wall that leaves some of both free."""
    return pane((0.3, -0.4, -0.2), (0, -2.6, 0.7), bsdf, 0.5)


def bumps() -> dict:
    v, u = np.mgrid[0:16, 0:16] / 16
    heights = (0.06 * np.sin(2 * np.pi * u) * np.cos(2 * np.pi * v)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(heights[..., None]), "raw": True}


def instances(bsdf) -> dict:
    places = (mi.ScalarTransform4f().translate([x, 0.1, -0.3]).scale(0.7) for x in (-0.4, 0.5))
    group = {"type": "shapegroup", "ball": ball(bsdf)}
    two = {
        f"instance{i}": {
            "type": "instance",
            "to_world": place,
            "group": {"type": "ref", "id": "group"},
        }
        for i, place in enumerate(places)
    }
    return {"group": group, **two}


@dataclass(frozen=True)
class Kind:
    """A kind of scene: a floor, a wall and a thing between them; the walls are of the same paint.

    Args:
        thing: shapes, from the paint.
        lights: names of the lamps.
        sky: whether there is an environment.
        specular: whether there are surfaces that pass or reflect rays. Mitsuba counts these as
            bounces and we do not, so that paths must be long enough for the rest not to matter.
            (Small lamps are left out there: seen through others, they have heavy tails.)
        integrator: Mitsuba's.
    """

    thing: Callable[[dict], dict]
    lights: tuple[str, ...] = ("lamp",)
    sky: bool = False
    roughness: float = 0.5
    metallic: float = 0.2
    specular: bool = False
    integrator: str = "path"

    @property
    def mirrors(self) -> bool:
        """Whether there are surfaces that pass or reflect rays, and are not cut-outs."""
        return self.specular and self.integrator == "path"

    @property
    def depth(self) -> int:
        """`max_depth` of whole paths, of ours."""
        return 6 if self.specular else 4

    @property
    def stock_depth(self) -> int:
        """`max_depth` of the same paths in Mitsuba, which counts every surface."""
        return 12 if self.specular else 4

    @property
    def unknowns(self) -> list[str]:
        """Names of all numbers that an image is differentiated by."""
        lights = [f"{light} {c}" for light in self.lights for c in ("red", "green", "blue")]
        sky = [f"environment {key}" for key in SKY_LEVELS] if self.sky else []
        return ["red", "green", "blue", "roughness", "metallic", *lights, *sky]


def a_ball(paint: dict) -> dict:
    return {"ball": ball(paint)}


def a_mirror(paint: dict) -> dict:
    return {"ball": ball({"type": "conductor", "material": "none"})}


def a_glass(paint: dict) -> dict:
    return {"ball": ball({"type": "dielectric", "int_ior": 1.5})}


def a_mask(paint: dict) -> dict:
    both = {"type": "twosided", "bsdf": paint}
    return {"pane": front({"type": "mask", "opacity": 0.6, "bsdf": both})}


def a_bump(paint: dict) -> dict:
    return {"pane": front({"type": "bumpmap", "arbitrary": bumps(), "bsdf": paint})}


def a_back(paint: dict) -> dict:
    """A pane whose back the camera sees, and whose front the wall."""
    return {
        "pane": pane((0.3, -0.4, -0.2), (0.3, 2.6, 0.7), {"type": "twosided", "bsdf": paint}, 0.5)
    }


KINDS = {
    "area light": Kind(a_ball),
    "environment": Kind(a_ball, lights=(), sky=True),
    "point light": Kind(a_ball, lights=("point",)),
    "several lights": Kind(a_ball, lights=("lamp", "point"), sky=True),
    "glossy": Kind(a_ball, roughness=0.3, metallic=0.0),
    "metal": Kind(a_ball, roughness=0.35, metallic=0.9),
    "mask": Kind(a_mask, lights=(), sky=True, specular=True, integrator="volpath"),
    "bump": Kind(a_bump),
    "two-sided": Kind(a_back),
    "glass": Kind(a_glass, lights=(), sky=True, specular=True),
    "mirror": Kind(a_mirror, lights=("point",), sky=True, specular=True),
    "instances": Kind(instances),
}

ALBEDO = np.array([0.5, 0.35, 0.2])
STRENGTHS = {"lamp": np.array([6.0, 5.0, 4.0]), "point": np.array([2.0, 2.5, 3.0])}


def make_scene(kind: Kind, values: Values) -> mi.Scene:
    lights = {}
    if "lamp" in values.lights:
        emitter = {"type": "area", "radiance": values.lights["lamp"]}
        black = {"type": "diffuse", "reflectance": 0.0}
        lights["lamp"] = pane((0.3, -0.4, 1.5), (0, 0, -1), black, 0.5, emitter=emitter)
    if "point" in values.lights:
        position = [-0.6, -0.8, 1.2]
        lights["point"] = {
            "type": "point",
            "position": position,
            "intensity": values.lights["point"],
        }
    if values.sky is not None:
        lights["sky"] = values.sky
    return mi.load_dict(
        {
            "type": "scene",
            "floor": pane((0, 0, -1), (0, 0, 0), values.paint, 1.5),
            "wall": pane((0, 1.2, 0), (0, 0, 0), values.paint, 1.5),
            **kind.thing(values.paint),
            **lights,
        }
    )


# ------------------------------------------------------------------------------------- unknowns


class Sky:
    """An environment that is not the same everywhere, and directions to move it in."""

    def __init__(self) -> None:
        self.map = EnvironmentMap(8, scale=0.6)
        rng = np.random.default_rng(5)
        self.at = {
            key: mi.Float(rng.normal(0, 0.4, dr.width(value)).astype(np.float32))
            for key, value in self.map.parameters().items()
        }
        self.towards = {
            key: rng.uniform(0, 1, dr.width(value)).astype(np.float32)
            for key, value in self.at.items()
        }
        self.moved(None, 0)
        self.sampling = {k: v for k, v in self.map.tables.items() if k != "texels"}
        self.emitter = environment_emitter(self.map)

    def moved(self, key: str | None, offset: float) -> None:
        """Move one array of parameters; directions are sampled as before."""
        parameters = dict(self.at)
        if key is not None:
            parameters[key] = self.at[key] + offset * mi.Float(self.towards[key])
        self.map.assign(parameters)
        self.map.prepare()
        if key is not None:
            self.map.tables.update(self.sampling)


class Live:
    """A scene whose unknowns are parameters that take gradients."""

    def __init__(self, kind: Kind) -> None:
        self.kind = kind
        self.materials = ConstantMaterials(
            mi.Color3f(*ALBEDO.tolist()), kind.roughness, kind.metallic
        )
        textures = material_textures(self.materials)
        self.sky = Sky() if kind.sky else None
        self.emission = Emission(max(1, len(kind.lights)), scale=1.0)
        values = Values(
            textures["base_color"],
            textures["roughness"],
            textures["metallic"],
            dict(zip(kind.lights, emission_textures(self.emission), strict=False)),
            self.sky.emitter if self.sky else None,
        )
        self.scene = make_scene(kind, values)
        self.view = SceneView.of(self.scene, self.materials, 40)
        self.reset()

    def reset(self) -> None:
        """Fresh parameters, with gradients of zero."""
        m, kind = self.materials, self.kind
        m.albedo = mi.Color3f(*ALBEDO.tolist())
        m.roughness, m.metallic = mi.Float(kind.roughness), mi.Float(kind.metallic)
        strengths = [STRENGTHS[name] for name in kind.lights] or [np.ones(3)]
        self.log = mi.Float(np.log(np.concatenate(strengths)).astype(np.float32))
        dr.make_opaque(m.albedo, m.roughness, m.metallic)
        dr.enable_grad(m.albedo, m.roughness, m.metallic, self.log)
        self.emission.assign({"log": self.log})
        self.emission.prepare()
        if self.sky:
            dr.disable_grad(self.sky.at)
            dr.enable_grad(self.sky.at)
            self.sky.moved(None, 0)

    def read_by_scene(self) -> dict:
        m = self.materials
        arrays = {"albedo": m.albedo, "roughness": m.roughness, "metallic": m.metallic}
        arrays |= {f"emission.{i}": c for i, c in enumerate(self.emission.values)}
        return arrays | ({"environment": self.sky.map.texels} if self.sky else {})

    def gradients(self) -> np.ndarray:
        """By the unknowns, in the order of `Kind.unknowns`."""
        m = self.materials
        found = [*dr.grad(m.albedo), dr.grad(m.roughness), dr.grad(m.metallic)]
        numbers = [float(g[0]) for g in found]
        if self.kind.lights:
            numbers += np.array(dr.grad(self.log), np.float64).tolist()
        if self.sky:
            for key, value in self.sky.at.items():
                numbers.append(np.dot(np.array(dr.grad(value), np.float64), self.sky.towards[key]))
        return np.array(numbers)


@lru_cache(maxsize=1)
def scene_of(name: str) -> Live:
    """The scene of a kind; the one before is freed, as Dr.Jit calls every BSDF that there is."""
    gc.collect()
    return Live(KINDS[name])


# -------------------------------------------------------------------------------------- methods


@dataclass(frozen=True)
class Way:
    """A method, as a cell of the matrix has it.

    Args:
        method: its name in the table of methods.
        reference: what its gradients are those of: whole paths, one bounce, or the first bounce of
            whole paths.
        bounces: differentiable ones of the image; None: as many as whole paths have.
        exact: whether the radiance field is the exact one, rather than black.
    """

    method: str
    reference: str
    bounces: int | None = 1
    exact: bool = False


WAYS = {
    "prb": Way("prb", "paths"),
    "ad-pt": Way("ad-pt", "paths"),
    "ours, all bounces": Way("direct", "paths", bounces=None),
    "ours": Way("ours", "first bounce", exact=True),
    "no-prior": Way("no-prior", "first bounce", exact=True),
    "direct": Way("direct", "one bounce"),
}


def cells(fast: set[tuple[str, str]]) -> list:
    """All cells of the matrix; those that are not fast are marked as slow."""
    found = []
    for name, kind in KINDS.items():
        for way, row in WAYS.items():
            if kind.mirrors and row.reference == "one bounce":
                continue  # `path` counts mirrors and glass, and so has no such image
            if way == "no-prior" and name != "several lights":
                continue  # φ is trained by the same image as in `ours`
            marks = [] if (name, way) in fast else [pytest.mark.slow]
            found.append(pytest.param(name, way, id=f"{name}, {way}", marks=marks))
    return found


@lru_cache(maxsize=1)
def sampler_of(name: str, way: str, spp: int):
    """The path sampler of a cell."""
    live, row = scene_of(name), WAYS[way]
    depth = live.kind.depth
    exact = PathTracedRadiance(live.view, 10_000, depth - 1)
    return planned_sampler(
        row.method,
        live.view,
        pixel_rays([CAMERA], spp, 1),
        spp,
        max_depth=live.kind.stock_depth if way == "prb" else depth,
        bounces=row.bounces or depth - 1,
        radiance=exact if row.exact else ConstantRadiance(0),
        read_by_scene=live.read_by_scene,
    )


# ----------------------------------------------------------------------------------- references

#: Samples a pixel of a batch of gradients, number of batches, and samples of references.
SPP, BATCHES, REFERENCE_SPP = 256, 16, 4096
#: Samples a pixel of images.
IMAGE_SPP = 512
#: All else that has random numbers of its own.
STOCK = ("series", "weights", "paths", "first bounce", "one bounce")
#: Of finite differences, relative to the roughness.
STEP = 0.15


def seeds(name: str, way: str, count: int) -> np.ndarray:
    """Seeds of a cell: no other cell has the same random numbers."""
    place = [list(KINDS).index(name), [*WAYS, *STOCK].index(way)]
    return np.random.SeedSequence(place).generate_state(count) >> 1


@cache
def weights_of_pixels(name: str) -> np.ndarray:
    """Of pixels in the sum that is differentiated, (3, pixels).

    Roughness moves light from some pixels to others: with equal weights, its derivative would be
    almost nothing. Pixels that it makes brighter weigh more.
    """
    kind, (first, second) = KINDS[name], seeds(name, "weights", 2).tolist()
    ray, h = pixel_rays([CAMERA], 1024, first), 2 * STEP * kind.roughness
    ends = [image_of(name, stock_scene(name, roughness=x), ray, second, 2) for x in (h, -h)]
    brighter = (ends[0] - ends[1]).reshape(3, -1, 1024).mean(-1) > 0
    uneven = np.random.default_rng(3).uniform(0.8, 1.2, brighter.shape)
    return uneven + np.where(brighter, 0.7, -0.7)


def weights(name: str, spp: int) -> np.ndarray:
    """The same of samples, (3, lanes)."""
    return np.repeat(weights_of_pixels(name), spp, axis=1)


def is_solid(scene: mi.Scene, ray: mi.Ray3f) -> np.ndarray:
    """Where rays meet a surface first that neither passes nor mirrors them."""
    flags = scene.ray_intersect(ray).bsdf().flags()
    smooth = mi.has_flag(flags, mi.BSDFFlags.Smooth) & ~mi.has_flag(flags, mi.BSDFFlags.Null)
    return np.array(smooth)


def stock_scene(name: str, only: str = "all", **moved: float) -> mi.Scene:
    """The scene with Mitsuba's own plugins.

    Args:
        only: the one light that shines.
        moved: offsets of `albedo`, `roughness` and `metallic`.
    """
    kind = KINDS[name]
    lights = {light: rgb(STRENGTHS[light] * (only in ("all", light))) for light in kind.lights}
    sky = scene_of(name).sky
    values = Values(
        rgb(ALBEDO + moved.get("albedo", 0)),
        kind.roughness + moved.get("roughness", 0),
        kind.metallic + moved.get("metallic", 0),
        lights,
        sky.emitter if sky and only == "all" else None,
    )
    return make_scene(kind, values)


def image_of(name: str, scene: mi.Scene, ray: mi.Ray3f, seed: int, depth: int) -> np.ndarray:
    """Samples of Mitsuba's image without Russian roulette, (3, lanes)."""
    integrator = KINDS[name].integrator
    image = stock_path(scene, ray, seed, max_depth=depth, rr_depth=99, integrator=integrator)
    return np.array(image, np.float64)


def after_first_bounce(name: str, scene: mi.Scene, ray: mi.Ray3f, seed: int) -> np.ndarray:
    """Light of two bounces and more, where only the first has the materials of this scene."""
    fixed, lanes, depth = stock_scene(name), dr.width(ray), KINDS[name].stock_depth
    with dr.suspend_grad():
        si, sampler, ctx = fixed.ray_intersect(ray), seeded(seed, lanes), mi.BSDFContext()
        bs, _ = si.bsdf().sample(ctx, si, sampler.next_1d(), sampler.next_2d(), si.is_valid())
        here = scene.ray_intersect(ray)
        goes_on = si.is_valid() & (bs.pdf > 0)
        weight = dr.select(goes_on, here.bsdf().eval(ctx, here, bs.wo, goes_on) / bs.pdf, 0)
        onward = si.spawn_ray(si.to_world(bs.wo))
        onward.o = dr.select(goes_on, onward.o, 1e6)
        dr.eval(weight, onward)
    whole, emitted = (image_of(name, fixed, onward, seed + 1, d) for d in (depth - 1, 1))
    return np.array(weight, np.float64) * (whole - emitted)


def differences(kind: Kind) -> dict[str, dict[float, float]]:
    """By quantity, steps of finite differences and their factors.

    Of second order in albedo and metallic, in which an image is a polynomial, else of fourth. Steps
    are long: random decisions that the step changes make a noise that grows with their inverse.
    """
    h = STEP * kind.roughness
    return {
        "albedo": {0.05: 10.0, -0.05: -10.0},
        "roughness": {n * h: w / (12 * h) for n, w in ((1, 8), (-1, -8), (2, -1), (-2, 1))},
        "metallic": {0.08: 6.25, -0.08: -6.25},
    }


@cache
def reference(name: str, kind_of: str) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the weighted sum of Mitsuba's image, and their standard errors."""
    kind, (first, second, third) = KINDS[name], seeds(name, kind_of, 3).tolist()
    ray = pixel_rays([CAMERA], REFERENCE_SPP, first)
    depth = kind.stock_depth if kind_of == "paths" else 2
    weight = weights(name, REFERENCE_SPP)
    if kind_of == "first bounce":
        weight = weight * is_solid(stock_scene(name), ray)

    def samples(scene: mi.Scene) -> np.ndarray:
        image = image_of(name, scene, ray, second, depth)
        if kind_of == "first bounce":
            image = image + after_first_bounce(name, scene, ray, third)
        return weight * image

    found = []
    for quantity, steps in differences(kind).items():
        moved = sum(w * samples(stock_scene(name, **{quantity: h})) for h, w in steps.items())
        # In linear RGB, the colour of a surface changes its own channel alone.
        found += list(moved) if quantity == "albedo" else [moved.sum(0)]
    for light in kind.lights:
        found += list(weight * image_of(name, stock_scene(name, only=light), ray, second, depth))
    sky = scene_of(name).sky
    for key in sky.at if sky else []:
        ends = []
        for h in (0.05, -0.05):
            sky.moved(key, h)
            ends.append(weight * image_of(name, stock_scene(name), ray, second, depth))
        sky.moved(None, 0)
        found.append(((ends[0] - ends[1]) / 0.1).sum(0))
    of_pixels = np.stack(found).reshape(len(found), -1, REFERENCE_SPP)
    error = np.sqrt(of_pixels.var(-1, ddof=1).sum(-1) / REFERENCE_SPP) / of_pixels.shape[1]
    return of_pixels.mean((1, 2)), error


def gradients(name: str, way: str) -> np.ndarray:
    """Derivatives of the weighted sum of a method's image, (batches, unknowns)."""
    live, sampler = scene_of(name), sampler_of(name, way, SPP)
    rows = []
    for seed in seeds(name, way, 2 * BATCHES).reshape(-1, 2).tolist():
        ray = pixel_rays([CAMERA], SPP, seed[0])
        weight = weights(name, SPP)
        if WAYS[way].reference == "first bounce":
            weight = weight * is_solid(live.scene, ray)
        live.reset()
        with sampler.prepared():
            image = sampler.image(live.scene, ray, seeded(seed[1], dr.width(ray)))
            dr.backward(dr.sum(dr.mean(mi.Color3f(weight.astype(np.float32)) * image, axis=1)))
        rows.append(live.gradients())
    return np.array(rows)


# ---------------------------------------------------------------------------------------- tests

CELLS = cells({("area light", "direct"), ("environment", "direct"), ("two-sided", "direct")})
#: Numbers that all cells compare, for Šidák's correction.
TESTS = sum(len(KINDS[cell.values[0]].unknowns) for cell in CELLS)
#: Relative errors that the test of gradients must be able to see.
SEEN = {"roughness": 0.5, "metallic": 0.07}
SEEN_OF_OTHERS = 0.04


def compare(name: str, way: str, found: np.ndarray) -> dict[str, float]:
    """Test the gradients of a cell; the relative errors that it would have seen, by unknown."""
    kind, row = KINDS[name], WAYS[way]
    expected, error = reference(name, row.reference)
    names = kind.unknowns
    if kind.mirrors and row.reference == "first bounce":
        names = names[:5]  # our bounce ends behind mirrors and glass, which `path` counts
    n = len(names)
    seen = assert_same_mean(found[:, :n], expected[:n], error[:n], names, TESTS)
    return dict(zip(names, seen, strict=True))


def image_and_truth(name: str, way: str) -> tuple[mi.Color3f, mi.Color3f]:
    """Samples of the images of a method and of Mitsuba."""
    live, kind = scene_of(name), KINDS[name]
    live.reset()
    first, second, third = seeds(name, way, 2 * BATCHES + 3)[-3:].tolist()
    ray = pixel_rays([CAMERA], IMAGE_SPP, first)
    one_bounce = way != "series" and WAYS[way].reference == "one bounce"
    with dr.suspend_grad():
        if way == "series":
            image = path_traced(
                live.view, ray, second, max_depth=kind.depth, rr_depth=5, hide_emitters=False
            )
        else:
            sampler = sampler_of(name, way, IMAGE_SPP)
            with sampler.prepared():
                image = sampler.image(live.scene, ray, seeded(second, dr.width(ray)))
    depth = 2 if one_bounce else kind.stock_depth
    truth = stock_path(stock_scene(name), ray, third, max_depth=depth, integrator=kind.integrator)
    return image, truth


@pytest.mark.parametrize(("name", "way"), CELLS)
def test_gradients_are_those_of_mitsubas_image(name, way):
    for unknown, relative in compare(name, way, gradients(name, way)).items():
        if unknown == "roughness" and KINDS[name].sky:
            continue  # light from everywhere is much the same on rough and on smooth surfaces
        assert relative < SEEN.get(unknown, SEEN_OF_OTHERS), f"{unknown}: the test sees too little"


@pytest.mark.parametrize(("name", "way"), CELLS)
def test_images_are_those_of_mitsuba(name, way):
    assert_same_expectation(*image_and_truth(name, way), IMAGE_SPP)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_images_of_the_path_tracer_are_those_of_mitsuba(name):
    assert_same_expectation(*image_and_truth(name, "series"), IMAGE_SPP)


# ------------------------------------------------------------------------------ tests of the test


def test_results_five_percent_off_are_rejected():
    found = gradients("area light", "direct")
    image, truth = image_and_truth("area light", "direct")
    for factor in (0.95, 1.05):
        with pytest.raises(AssertionError, match="exceeds"):
            compare("area light", "direct", factor * found)
        with pytest.raises(AssertionError, match="accepted"):
            assert_same_expectation(factor * image, truth, IMAGE_SPP)


@pytest.mark.parametrize("part", ["weight", "direct"])
def test_an_estimator_with_a_wrong_weight_is_rejected(part, monkeypatch):
    """Light that one of both sampling techniques finds is 5 % too bright."""

    def too_bright(*args):
        found = bounce(*args)
        return replace(found, **{part: 1.05 * getattr(found, part)})

    monkeypatch.setattr(path_sample, "bounce", too_bright)
    with pytest.raises(AssertionError, match="exceeds"):
        compare("environment", "direct", gradients("environment", "direct"))


@pytest.mark.parametrize(
    ("probability", "freedom", "value"),
    [(0.975, 10, 2.228), (0.9995, 10, 4.587), (0.9995, 15, 4.073), (0.999995, 30, 5.2996)],
)
def test_the_quantiles_of_students_distribution_are_those_of_tables(probability, freedom, value):
    assert student_quantile(probability, freedom) == pytest.approx(value, rel=0.01)


def test_an_unbiased_estimator_is_rejected_as_often_as_the_significance_says():
    rng, names, rejected = np.random.default_rng(1), list("abcdefgh"), 0
    expected, error = np.ones(8), np.full(8, 0.1)
    for _ in range(1000):
        reference = expected + error * rng.normal(size=8)
        batches = expected + rng.normal(size=(BATCHES, 8))
        try:
            assert_same_mean(batches, reference, error, names, tests=8)
        except AssertionError:
            rejected += 1
    assert 1 <= rejected <= 20, "1 % of 1000"
