"""Neural Radiosity: L_θ from the residual of the rendering equation alone (Sec. 3.1)."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from ..acquisition.built_in import SCENES, write_scene
from ..acquisition.capture import posed_cameras, require_scene
from ..acquisition.coverage import is_room
from ..acquisition.new_light import change_light, tell_tilt
from ..acquisition.settings import CaptureSettings
from ..config.light import LightConfig
from ..dataset.camera import Camera
from ..dataset.camera_files import named_by_split, read_named_cameras
from ..errors import UserError, require_kind
from ..fields.domain import Domain
from ..fields.grid_sizes import USUAL, sized
from ..fields.radiance import make_radiance
from ..io import require_new_folder
from ..scene import emitters
from ..scene.edit import to_principled
from ..scene.parse import ParsedScene, parse
from ..signals import cleaned_up
from ..training.grid_sizes import surface_seen
from ..training.recovered import Recovered, load_run
from ..training.run_folder import RunFolder
from ..transport.vertex import SceneView
from .learn import Known, Start, learn
from .lit import direct_light, matching_scale
from .points import SurfacePoints
from .settings import SolveSettings

#: Width and height, at most, of pictures of a run's views: those of photographs would take hours,
#: with the samples of `final_spp`, where the training takes minutes.
LARGEST = 512


def solve(
    scene: str | Path,
    out: Path | str,
    settings: SolveSettings | None = None,
    *,
    cameras: Path | str | None = None,
    light: LightConfig | Path | str | None = None,
    allow_outside: bool = False,
    console: Console | None = None,
    tell: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Learn the radiance of a scene with known materials and lights, without any path.

    L_θ is trained by the residual of the rendering equation at random points of all surfaces.

    Args:
        scene: a Mitsuba XML file, or the name of a built-in scene.
        out: folder to write; it must be new or empty. L_θ is written once a minute of training, and
            before and after the pictures of each measurement; pictures are written in the end.
        settings: how L_θ is learned and measured.
        cameras: a camera file; None: the built-in scene's own cameras, or automatic placement.
        light: takes the place of all light of the scene, unless it says otherwise, or the file of
            an environment map that does; None: the scene's own light.
        allow_outside: read files that the scene or the light names and that lie outside of its
            folder.
        console: shows progress; None: none is shown.
        tell: called with lines about the scene and with measurements.

    Returns:
        The contents of `solve.json`.

    Raises:
        UserError: the scene, the light or the cameras cannot be used, no light reaches a surface,
            or the folder is not empty or cannot be written.

    Paper: Eq. 3, Eq. 4, Sec. 3.1.
    """
    settings, out = _given(settings), Path(out)
    light = None if light is None else LightConfig.of(light)
    require_scene(str(scene))
    require_new_folder(out)
    known = _known_scene(str(scene), settings, cameras, light, allow_outside, tell)
    seen = surface_seen(known.scene_view.scene, list(known.cameras.values()))
    if seen is None:
        tell("warning: no camera sees any surface: all pictures will be empty")
    network = sized(settings.radiance, seen or USUAL)
    scale = direct_light(known.scene_view, known.points, settings.seed)
    domain = Domain.of(known.scene_view.scene.bbox())
    radiance = make_radiance("neural", network, domain, scale=scale, seed=settings.seed)
    return learn(known, Start(radiance, "neural", network), settings, out, console, tell)


def fine_tune(
    run: str | Path,
    out: Path | str,
    settings: SolveSettings | None = None,
    *,
    cameras: Path | str | None = None,
    light: LightConfig | Path | str | None = None,
    allow_outside: bool = False,
    console: Console | None = None,
    tell: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Learn the L_θ of a run further by the residual alone, with the materials it recovered.

    Under another light this is relighting without paths. The field is then scaled first so that
    both sides of the rendering equation have the same mean. Networks multiply in single precision,
    whatever the run did: nothing scales the loss of small residuals here.

    Args:
        run: folder of a fit by a method with L_θ.
        out: folder of the results, as of `solve`.
        console: as of `solve`.
        tell: as of `solve`.
        settings: how L_θ is learned and measured; `views`, `resolution` and the field's settings do
            not count.
        cameras: a camera file, whose pictures have the sizes that it says; None: the held-out views
            of the run's data set, at most `LARGEST` pixels wide and high.
        light: as of `solve`; None: the run's own light.
        allow_outside: read files of the data set, its scene and the light that lie outside of their
            folders.

    Returns:
        The contents of `solve.json`.

    Raises:
        UserError: the run has no L_θ or cannot be read, its fields cannot be evaluated inside of
            loops, and as of `solve`.

    Paper: Eq. 3, Eq. 4, Sec. 3.1.
    """
    settings, out, run = _given(settings), Path(out), Path(run)
    light = None if light is None else LightConfig.of(light)
    RunFolder(run).require_fitted()
    require_new_folder(out)
    change = None
    if light is not None:
        change = partial(change_light, light=light, allow_outside=allow_outside, tell=tell)
    recovered = load_run(run, allow_outside=allow_outside, change=change, single=True)
    tell_tilt(light, [view.camera for view in recovered.dataset.train], tell)
    problem, config = recovered.problem, recovered.config
    radiance = problem.radiance
    if radiance is None:
        what = f"the run by the method {config.method} has no radiance field to start from"
        remedy = "Give one by the method ours; or `unbake export --format mitsuba`, and solve that"
        raise UserError(what, run, remedy)
    if problem.materials is not None:
        problem.materials.stand_alone()  # materials are asked inside of virtual calls, too
    room = not problem.hide_emitters
    scene_view = problem.scene_view
    points = SurfacePoints.of(scene_view.scene, settings.seed)
    told = {
        "scene": os.fspath(recovered.dataset.scene),
        "run": {"folder": os.fspath(run.resolve()), "steps": recovered.progress.step},
        "light": None if light is None else light.told(),
    }
    known = Known(scene_view, _views(recovered, cameras, tell), room, points, told, problem)
    if light is not None:
        factor = matching_scale(scene_view, radiance, points, settings.seed)
        radiance.scale *= factor
        tell(f"L of the run is taken times {factor:.3g}: so bright is the new light")
    start = Start(radiance, config.radiance_representation, config.radiance_settings)
    return learn(known, start, settings, out, console, tell)


def _given(settings: SolveSettings | None) -> SolveSettings:
    """The settings, or the usual ones; a `UserError` where they are of another kind."""
    settings = settings or SolveSettings()
    require_kind(settings, SolveSettings, "settings", "unbake.SolveSettings(steps=1000)")
    return settings


def _known_scene(
    name: str,
    settings: SolveSettings,
    cameras: Path | str | None,
    light: LightConfig | None,
    allow_outside: bool,
    tell: Callable[[str], None],
) -> Known:
    made = Path(tempfile.mkdtemp(prefix="unbake-"))
    with cleaned_up(lambda: shutil.rmtree(made, ignore_errors=True)):
        path = write_scene(name, made) if name in SCENES else Path(name)
        root = Path(path.resolve().anchor) if allow_outside else None

        def parsed(tell: Callable[[str], None]) -> ParsedScene:
            scene = parse(path, root)
            if light is not None:
                change_light(scene, light, allow_outside, tell)
            return scene

        posed, room = _posed(name, parsed(tell), settings, cameras)
        tell_tilt(light, list(posed.values()), tell)
        scene = parsed(lambda line: None).instantiate()
    view = SceneView.of(scene, None, settings.max_specular)
    points = SurfacePoints.of(scene, settings.seed)
    told = {"scene": name, "run": None, "light": None if light is None else light.told()}
    return Known(view, posed, room, points, told)


def _posed(
    name: str, parsed: ParsedScene, settings: SolveSettings, cameras: Path | str | None
) -> tuple[dict[str, Camera], bool]:
    """The cameras by the names of their pictures, and whether they stand in a room.

    Args:
        name: of the scene.
        parsed: the scene. It is used up: cameras are placed to see materials that could be fitted,
            and by shapes that are not merged.
        settings: how many cameras, and the size of their pictures.
        cameras: a camera file; None: the built-in scene's own cameras, or automatic placement.
    """
    if cameras is None:
        with suppress(UserError):  # what cannot be fitted can be solved all the same
            to_principled(parsed)
    scene = parsed.instantiate(merge=False)
    emitters.require_emitters(scene, Path(name))
    size = settings.resolution
    if cameras is None:
        wanted = CaptureSettings(settings.views, 0, size, seed=settings.seed)
        posed = named_by_split(posed_cameras(name, scene, wanted))
        return _named(posed), is_room(scene)
    posed = read_named_cameras(Path(cameras), size, size)
    return _named(posed), is_room(scene, [camera for *_, camera in posed])


def _views(
    recovered: Recovered, cameras: Path | str | None, tell: Callable[[str], None]
) -> dict[str, Camera]:
    """The cameras of a file, else the held-out views; all views where there are none.

    Those of views are made small, and so are cameras of the file that say no size.
    """
    dataset = recovered.dataset
    if cameras is None:
        own = {v.name: recovered.camera(v) for v in dataset.heldout or dataset.views}
        small = {name: _small(camera) for name, camera in own.items()}
        if any(small[name].width != camera.width for name, camera in own.items()):
            told = f"pictures are at most {LARGEST} pixels wide and high, photographs are larger"
            tell(f"{told}: --cameras FILE says other sizes")
        return small
    first = _small(dataset.train[0].camera)
    return _named(read_named_cameras(Path(cameras), first.width, first.height, keep_size=True))


def _small(camera: Camera) -> Camera:
    """The camera with a smaller picture, if that is larger than `LARGEST`."""
    scale = LARGEST / max(camera.width, camera.height)
    if scale >= 1:
        return camera
    width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
    return camera.rescaled(width, height)


def _named(posed: list[tuple[str, str, Camera]]) -> dict[str, Camera]:
    """Cameras by the names of their pictures."""
    return {name: camera for name, _, camera in posed}
