"""The problem that a fit solves: a scene with trainable fields in the place of its unknowns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..config import CameraConfig, FitConfig, ObjectiveConfig
from ..config.fit import OWN_BETA2
from ..dataset.data_folder import TRANSFORMS
from ..dataset.photographs import Photographs
from ..dataset.pixels import CameraRays, PixelSource
from ..dataset.views import Dataset, View
from ..errors import UserError
from ..fields.camera import CameraModel
from ..fields.domain import Domain
from ..fields.emission import Emission, emission_textures
from ..fields.envmap import EnvironmentMap, environment_emitter
from ..fields.field import Field
from ..fields.guide import LightGuide
from ..fields.materials import Materials, make_materials
from ..fields.pieces import Pieces
from ..fields.radiance import RadianceField, make_radiance
from ..fields.registry import representation
from ..fields.settings import NetworkConfig
from ..fields.texture import material_numbers, material_textures
from ..progress import silent
from ..ranks import Ranks
from ..scene import edit, emitters
from ..scene.parse import ParsedScene, parse
from ..transport.emitter_weights import RAYS, chosen_alike, weigh_emitters
from ..transport.objective import has_radiance
from ..transport.vertex import SceneView
from .grid_sizes import domain_seen
from .limits import require_room
from .outliers import OutlierModel
from .poses import PoseModel

Parameters = Mapping[str, mi.Float | mi.TensorXf]


@dataclass(kw_only=True)
class Problem:
    """A scene with unknowns φ, and the radiance field if the method has one.

    A field that is None is not optimized: the scene gives its values.
    """

    scene_view: SceneView
    materials: Materials | None
    environment: EnvironmentMap | None
    emission: Emission | None
    emitter_names: list[str]  #: of the emitters whose strength is unknown
    radiance: RadianceField | None
    hide_emitters: bool
    half_precision: bool  #: in products of its networks
    camera: CameraModel | None = None  #: of the training views; None: all is as the data set tells
    poses: PoseModel | None = None  #: corrections of the training views' cameras; None: as given
    outliers: OutlierModel | None = None  #: of the training views; None: all pixels count alike
    guide: LightGuide | None = None  #: of bounces; None: BSDFs alone draw directions
    beta2: float = OWN_BETA2  #: Adam's first one, for the unknowns
    #: Whether pixels to train on show unknown light (`told_scale.py`); None: nobody looked.
    shows_light: bool | None = None
    #: What the mean albedo is by convention, where photographs do not tell it; linear RGB.
    mean_albedo: tuple[float, float, float] = (0.5, 0.5, 0.5)
    #: Weight of the deviation from it at present; None: that of the beginning.
    anchor: float | None = None

    def fields(self) -> list[Field]:
        """The fields of the materials, and the one of L_θ."""
        found = [] if self.materials is None else list(self.materials.values())
        return found if self.radiance is None else [*found, self.radiance.function]

    @property
    def pieces(self) -> Pieces | None:
        """The pieces of surface that its materials tell apart, if they do."""
        return None if self.materials is None else self.materials.pieces

    @property
    def light_is_unknown(self) -> bool:
        """Whether the environment is optimized, or the strengths of lights are."""
        return self.environment is not None or self.emission is not None

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """The trainable arrays φ by name; the first word is the unknown's."""
        named: dict[str, mi.Float | mi.TensorXf] = {}
        if self.materials is not None:
            named |= self.materials.parameters()
        for word, light in self._lighting():
            named |= {f"{word}.{key}": value for key, value in light.parameters().items()}
        for model in self._of_photographs():
            named |= model.parameters()
        return named

    def learned_parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """The trainable arrays θ of L_θ by name, and those of the guide that learns beside it."""
        if self.radiance is None:
            return {}
        guide = {} if self.guide is None else self.guide.parameters()
        return {**self.radiance.parameters(), **guide}

    def assign_learned(self, parameters: Parameters) -> None:
        """Use these arrays of `learned_parameters`."""
        if self.radiance is not None:
            self.radiance.assign(dict(parameters))
        if self.guide is not None:
            self.guide.assign(parameters)

    def assign(self, parameters: Parameters) -> None:
        """Use these arrays, and update the tables that are derived from them."""
        if self.materials is not None:
            self.materials.assign(parameters)
        for word, light in self._lighting():
            light.assign({key: parameters[f"{word}.{key}"] for key in light.parameters()})
            light.prepare()
        for model in self._of_photographs():
            model.assign(parameters)

    def read_by_scene(self) -> dict[str, mi.Float | mi.TensorXf]:
        """The arrays that the scene's textures and emitters look into."""
        arrays: dict[str, mi.Float | mi.TensorXf] = {}
        if self.materials is not None:
            arrays |= self.materials.parameters()
        if self.environment is not None:
            arrays["environment"] = self.environment.texels
        if self.emission is not None:
            arrays |= {f"emission.{i}": c for i, c in enumerate(self.emission.values)}
        return arrays

    def _of_photographs(self) -> list[CameraModel | PoseModel | OutlierModel]:
        found = (self.camera, self.poses, self.outliers)
        return [model for model in found if model is not None]

    def _lighting(self) -> list[tuple[str, EnvironmentMap | Emission]]:
        both = [("environment", self.environment), ("emission", self.emission)]
        return [(word, light) for word, light in both if light is not None]


def make_problem(
    scene: str | Path,
    background: str,
    config: FitConfig,
    scale: float,
    root: str | Path | None = None,
    *,
    views: Sequence[View] = (),
    change: Callable[[ParsedScene], object] | None = None,
) -> Problem:
    """Replace the unknowns of a scene by untrained fields.

    Args:
        scene: the Mitsuba scene; its own values of the unknowns are ignored.
        background: `visible` or `hidden`.
        scale: radiance of the untrained radiance field and emitters, and of the environment unless
            the settings say it. Points and spots begin with the intensity that causes about that.
        root: folder that the scene's files must not leave; None: the scene's own.
        views: the training views, where something of their cameras is unknown.
        change: called with the scene once the fields are in it, such as to change its light. Points
            are located in the scene without that change.

    Raises:
        UserError: the scene cannot be loaded, has no emitter or nothing to fit, has meshes without
            the texture coordinates that bitmaps need, or the fields do not fit the memory.
        ValueError: something of the cameras is unknown, and there are no views.
    """
    scene, root = Path(scene), None if root is None else Path(root)
    parsed = parse(scene, root)
    edit.to_principled(parsed)
    require_room(config, len(edit.material_names(parsed)))
    seeds = np.random.SeedSequence(config.seed).generate_state(2)
    materials = environment = emission = None
    emitter_names: list[str] = []
    places: list[np.ndarray | None] = []
    if config.learns_materials:
        materials = _unknown_materials(parsed, config, int(seeds[0]))
    if config.learns_environment:
        start = config.lighting.initial_radiance or scale
        gain = config.lighting.coarse_gain if config.learns_materials else 1.0
        environment = EnvironmentMap(config.lighting.resolution, scale=start, coarse_gain=gain)
        edit.set_environment(parsed, environment_emitter(environment))
    if config.learns_emission:
        places = emitters.places(parsed)
        emission, emitter_names = _unknown_emission(parsed, scale, config)
    if change is not None:
        change(parsed)
    loaded = parsed.instantiate()
    if config.learns_materials:
        edit.require_optimized(loaded, scene)
    emitters.require_emitters(loaded, scene)
    unchanged = loaded if change is None else parse(scene, root).instantiate()
    if emission is not None:
        emission.start(emitters.squared_distances(unchanged, places))
    domain = Domain.of(unchanged.bbox())
    if materials is not None:
        materials.domain = domain
        materials.pieces = _pieces(unchanged, config)
        if materials.pieces is not None:
            materials.pieces.attach(loaded)
        if representation(config.representation).unwrapped:
            edit.require_unwrapped(loaded, scene)
            materials.numbers = material_numbers(loaded)
        materials.assign(materials.parameters())  # so that Mitsuba can render them untrained, too

    radiance = None
    if has_radiance(config.chosen_method):
        radiance = make_radiance(
            config.radiance_representation,
            config.radiance_settings,
            domain,
            scale=scale,
            seed=int(seeds[1]),
            half=config.half_precision,
        )
    guide = None
    if radiance is not None and config.guide.cells:
        cameras = [view.camera for view in views]
        # Of runs of before it is the whole domain: their guides learn anew.
        seen = domain_seen(unchanged, cameras, domain) if cameras else domain
        guide = LightGuide(config.guide, seen)
    scene_view = SceneView.of(loaded, materials, config.transport.max_specular)
    return Problem(
        scene_view=scene_view,
        materials=materials,
        environment=environment,
        emission=emission,
        emitter_names=emitter_names,
        radiance=radiance,
        hide_emitters=background == "hidden",
        half_precision=config.half_precision,
        camera=_unknown_camera(config.camera, len(views)),
        poses=_unknown_poses(config.camera, unchanged, views),
        outliers=_unknown_outliers(config.objective, views),
        guide=guide,
        beta2=config.beta2 or OWN_BETA2,
    )


def problem_of(
    dataset: Dataset,
    config: FitConfig,
    scale: float,
    *,
    change: Callable[[ParsedScene], object] | None = None,
) -> Problem:
    """The problem of a data set, with the cameras of its training views; see `make_problem`.

    Lights that are known are sampled as often as suits these views.
    """
    problem = make_problem(
        dataset.scene,
        dataset.background,
        config,
        scale,
        dataset.root,
        views=dataset.train,
        change=change,
    )
    if not problem.light_is_unknown:
        weigh_lights_alike(problem, dataset)
    return problem


def weigh_lights_alike(problem: Problem, dataset: Dataset) -> None:
    """Let lights that are sampled alike be sampled as often as suits the training views."""
    if dataset.train and chosen_alike(problem.scene_view.scene):
        weigh_lights(problem.scene_view, dataset.train, hide_emitters=problem.hide_emitters)


def weigh_lights(scene_view: SceneView, views: Sequence[View], *, hide_emitters: bool) -> None:
    """Let lights be sampled by how much they bring to what some pixels of views see.

    Args:
        scene_view: whose scene is changed; see `chosen_alike`.
        views: one at least.
        hide_emitters: as of `Problem`.
    """
    rays = CameraRays.of([view.camera for view in views])
    rng = np.random.default_rng(0)
    chosen = mi.UInt32(rng.integers(0, rays.pixels, RAYS).astype(np.uint32))
    offset = mi.Point2f(rng.random((2, RAYS)).astype(np.float32))
    weigh_emitters(scene_view, rays.through(chosen, offset), hide_emitters=hide_emitters, seed=0)


def pixels_of(
    dataset: Dataset,
    config: FitConfig,
    *,
    clip_negative: bool,
    ranks: Ranks | None = None,
    tell: Callable[[str], None] = silent,
) -> PixelSource:
    """The training pixels with what the settings ask of them; see `training_pixels`."""
    return training_pixels(
        dataset,
        clip_negative=clip_negative,
        smoothed=config.loss_reference == "smoothed",
        slopes=bool(config.camera.of_places),
        ranks=ranks,
        tell=tell,
    )


def _unknown_camera(config: CameraConfig, views: int) -> CameraModel | None:
    if config.unknowns and not views:
        raise ValueError("something of the cameras is unknown: give the training views")
    if not config.of_light:
        return None
    return CameraModel(
        views,
        exposure=config.exposure == "per-image",
        white_balance=config.white_balance,
        vignetting=config.vignetting == "radial",
        response=config.response == "monotone",
    )


def _unknown_poses(
    config: CameraConfig, scene: mi.Scene, views: Sequence[View]
) -> PoseModel | None:
    unknown = config.of_places
    if not unknown:
        return None
    cameras = [view.camera for view in views]
    return PoseModel.of(
        scene, cameras, poses="poses" in unknown, intrinsics="intrinsics" in unknown
    )


def _unknown_outliers(config: ObjectiveConfig, views: Sequence[View]) -> OutlierModel | None:
    if config.outliers == "kept":
        return None
    if not views:
        raise ValueError("outliers are to be found: give the training views")
    return OutlierModel([view.camera for view in views], config.block, config.tolerance)


def _unknown_materials(parsed: ParsedScene, config: FitConfig, seed: int) -> Materials:
    names = edit.material_names(parsed)
    materials = make_materials(
        config.representation,
        config.material_settings,
        names,
        seed=seed,
        half=config.half_precision,
        least_slope=max(config.least_slope, 0.0),
    )
    shared = material_textures(materials)
    own = representation(config.representation).unwrapped
    each = [material_textures(materials, n) if own else shared for n in range(len(names))]
    for number in known_materials(parsed, config):
        each[number] = {}
    edit.set_own_textures(parsed, each)
    return materials


def known_materials(parsed: ParsedScene, config: FitConfig) -> frozenset[int]:
    """The numbers of the `principled` BSDFs that a fit of materials leaves as the scene has them.

    They keep their numbers, so that the arrays of a fit are those of its scene.
    """
    return edit.lamp_materials(parsed) if config.lamps == "known" else frozenset()


def _pieces(scene: mi.Scene, config: FitConfig) -> Pieces | None:
    """The pieces of a scene, if any field has values of them."""
    settings = [s for s in config.material_settings.values() if isinstance(s, NetworkConfig)]
    most = max((s.pieces.most for s in settings), default=0)
    across = all(s.pieces.across_slivers for s in settings)
    return Pieces(scene, most, across_slivers=across) if most else None


def _unknown_emission(
    parsed: ParsedScene, scale: float, config: FitConfig
) -> tuple[Emission, list[str]]:
    made: list[Emission] = []
    patterns = emitters.pictures(parsed) if config.lamp_pictures == "known" else []

    def textures(count: int) -> list[mi.Texture]:
        made.append(Emission(count, scale=scale, patterns=patterns))
        return emission_textures(made[0])

    named = edit.set_emission(parsed, textures)
    return made[0], [emitter.name for emitter in named]


def training_pixels(
    dataset: Dataset,
    *,
    clip_negative: bool,
    smoothed: bool = True,
    slopes: bool = False,
    ranks: Ranks | None = None,
    tell: Callable[[str], None] = silent,
) -> PixelSource:
    """The pixels of the training views.

    Args:
        clip_negative: take negative pixels as zero.
        smoothed: keep a blurred copy of the photographs, which `loss_reference = "smoothed"` needs
            and which takes as much memory again.
        slopes: give batches the slopes of the photographs, which corrections of poses need.
        ranks: processes that share the photographs, see `Photographs.load`; None: this one holds
            all.
        tell: called with lines of progress where decoding takes long.

    Raises:
        UserError: there is no training view, an image is bad, or all pixels are black.
    """
    views = dataset.train
    if not views:
        raise UserError(
            "no training view", dataset.folder, f'Give frames of {TRANSFORMS} "split": "train"'
        )
    photographs = Photographs.load(
        dataset, clip_negative, smoothed=smoothed, ranks=ranks, tell=tell
    )
    if not photographs.count:
        remedy = "Masks are white where pixels count: see `unbake data check`"
        raise UserError("no foreground pixel in any training view", dataset.folder, remedy)
    if photographs.mean <= 0:
        raise UserError("all training images are black", dataset.folder)
    limits = None
    if any(view.clipped is not None for view in views):
        limits = np.array([view.limit for view in views], np.float32)
    exposures = np.array([view.exposure for view in views], np.float32)
    rays = CameraRays.of([view.camera for view in views])
    return PixelSource(rays, photographs, limits=limits, exposures=exposures, slopes=slopes)
