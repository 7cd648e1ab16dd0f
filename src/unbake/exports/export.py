"""`unbake export`: what a run recovered, as textures, glTF, OpenUSD or a scene for Mitsuba.

DIR/
  export.json             what is there, how it was made, and its conventions
  textures/               of each material: OpenEXR, PNG, and a mask of what no view saw
  scene.glb               the scene as binary glTF
  unobserved/             masks of what no view saw, where no textures are written
  mitsuba/scene.xml       the scene for Mitsuba, with its own meshes and textures
  usd/scene.usdc          the scene as OpenUSD, with its own textures
  environment.exr         the environment, recovered or that of the scene
  environment_upright.exr the same in the axes of scene.glb, where these are others
  environment_unobserved.png  where nothing is known of a recovered one
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from ..dataset.camera import Camera
from ..errors import UserError, collected, named, raise_together
from ..imaging.pictures import to_bytes, write_exr, write_png
from ..io import filled_folder, require_new_folder, write_json
from ..scene import free_space
from ..scene.emitters import ENVIRONMENTS, STRENGTHS, names_besides
from ..training.grid_sizes import surface_seen
from ..training.problem import known_materials
from ..training.recovered import Recovered, load_run, tell_changed_geometry
from ..training.run_folder import RunFolder
from ..training.surroundings import surroundings
from ..transport.render import path_integrator
from ..version import VERSION
from . import DEFAULT_FORMATS, EXPORT_FORMAT, FORMATS, Format
from .bake import WANTED, Baked, Baker, own_opacities, own_textures
from .cameras import NO_SHOT, Shot
from .constants import TEXTURED, constant_opacity, material_constants
from .gltf import PUNCTUAL, write_glb
from .lights import Light, environment_picture, read_lights, turned_latlong
from .mitsuba import write_scene
from .observed import training_views
from .parts import Part, Parts, parsed_principled, read_parts
from .textures import COLOUR_SPACES, file_names, write_mask, write_textures
from .unwrap import LARGEST, SMALLEST, UNIQUE, Atlas, make_atlases
from .upright import Up
from .usd import require_usd, write_usd

#: The environment, recovered or of the scene, beside `export.json`.
_ENVIRONMENT = Path("environment").with_suffix(".exr").name
#: The same in the axes of `scene.glb`.
_UPRIGHT = Path("environment_upright").with_suffix(".exr").name
#: Where nothing is known of the environment.
_UNOBSERVED = Path("environment_unobserved").with_suffix(".png").name
#: Texels along the edge of a texture.
_SIZES = [1 << n for n in range(SMALLEST.bit_length() - 1, LARGEST.bit_length())]
#: Texels along the diagonal of a scene that no camera sees.
_BLIND = 1024
#: Metres across a scene from which its unit is told to be another, maybe.
_SMALL, _LARGE = 0.01, 200.0
#: Units that large scenes may have, metres, and what is no larger than a large room.
_LENGTHS, _ROOM = {"centimetres": 0.01, "millimetres": 0.001}, 30.0
#: Materials that are told one by one.
_TOLD = 12
#: BSDFs around others that are not written to glTF and OpenUSD, and what they give.
_LAYERS = {
    "bumpmap": "bump maps",
    "normalmap": "normal maps",
    "blendbsdf": "blends of materials",
}
#: What to do where textures are coarser than what was recovered: if --texels was given, else.
_COARSE = "without --texels, textures are as dense as it takes", "a larger --texels keeps more"

_CONVENTIONS = {
    "axes": "those of the scene; a node of glTF turns up to +y, and scales units to metres",
    "metres_per_unit": "how long a unit of the scene is: usd keeps units, and its stage says it",
    "cameras": "views of the data set with the intrinsics and poses that the fit found, as glTF "
    "and usd have them; in glTF the principal point is in the middle",
    "texture coordinates": "(0, 0) is the corner of the first texel of the first row of an image, "
    "in Mitsuba and in glTF",
    "roughness": "perceptual: GGX alpha = roughness squared",
    "axes of usd": "those of the scene where y or z is up by the cameras, as the stage says; "
    "else /scene turns what is up to one of them",
    "texture coordinates of usd": "(u, 1 - v): (0, 0) is the corner of the first texel of the last "
    "row",
    "light of usd": "a point or spot light of radiant intensity I has intensity 4 I and is "
    "normalized: its radiance does not depend on the radius",
    "opacity": "the alpha of the base colour, in glTF and in usd: cut-outs are solid from 0.5 on, "
    "and what is transparent to a part is blended",
    "metallic and roughness of glTF": "blue and green of one texture",
    "light": "radiance and intensity in the scene's own units; glTF takes them as candela, where "
    "an intensity has the square of metres_per_unit as a factor",
    "environment": "latitude and longitude as Mitsuba's envmap reads them without to_world: +y is "
    "the first row, -y the last one, +z the middle column, -z the left and right border, +x at a "
    "quarter of the width; linear RGB; in axes of the scene, and environment_upright in those of "
    "scene.glb, where these are others",
    "environment_unobserved": "white where no light of the environment reaches what training views "
    "show, in the pixels of environment; not written where that is less than 5 %",
    "texels_per_unit": "at least, but for textures of the smallest and the largest size; where "
    "nobody chose it, textures have more that need it",
    "near": "by quantity, the share of the surface seen by training views where the texture "
    "differs from the recovered field by 2/255 at most, albedo as sRGB",
    "unobserved": "a picture for each material, in its texture coordinates: white where no "
    "training view saw the surface; what was learned is filled in there from values around it that "
    "were seen, or is the quantity's default where a material has none, and all else is the "
    "scene's own; what is seen in mirrors, through glass or in pixels that are not fitted alone "
    "counts as not seen",
    "unobserved_share": "of the surface, by its area, as the masks have it",
}


@dataclass(frozen=True)
class _Wanted:
    """What is wanted of an export; see there."""

    formats: tuple[Format, ...]
    texels: float | None
    most: int  #: texels along an edge
    metres: float
    cameras: bool


def export(
    run: Path | str,
    out: Path | str,
    formats: str | Collection[str] = DEFAULT_FORMATS,
    *,
    texels: float | None = None,
    max_texture: int = LARGEST,
    metres_per_unit: float = 1.0,
    cameras: bool = True,
    allow_outside: bool = False,
    console: Console | None = None,
    tell: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Write what a run recovered for other programs.

    Args:
        run: folder of a fit.
        out: folder to write; it must be new or empty, and is filled only when all is complete.
        formats: one of `FORMATS`, or several, also with commas between them.
        texels: along a scene unit; None: one for each pixel of the training views on the surfaces,
            or more where the recovered fields or known textures hold finer detail, until 95 % of
            each surface differs from them by 2/255 at most, or is as solid where it is cut out.
        max_texture: texels along an edge of a texture of a material, at most: a power of two.
        metres_per_unit: how long a unit of the scene is, as glTF and OpenUSD have it.
        cameras: write the views of the data set as cameras of glTF and OpenUSD.
        allow_outside: read files of the data set and its scene that lie outside of its folder.
        console: where a progress bar is shown, if it is a terminal; None: nowhere.
        tell: called with lines of progress.

    Returns:
        The contents of `export.json`.

    Raises:
        UserError: the run or its data set cannot be read, the folder is not empty, a format is
            unknown, or the textures do not fit into memory or onto the disk.
    """
    run, out = Path(run), Path(out)
    given = [formats] if isinstance(formats, str) else formats
    names = [name.strip() for each in given for name in str(each).split(",") if name.strip()]
    options = _Wanted((), texels, max_texture, metres_per_unit, cameras)
    wanted = _require_sound(run, out, names, options)
    recovered = load_run(run, allow_outside=allow_outside)
    with filled_folder(out) as partial:
        manifest = _export(recovered, RunFolder(run), partial, wanted, console, tell)
        write_json(partial / "export.json", manifest, allow_nan=False)
    return manifest


def _require_sound(run: Path, out: Path, formats: Collection[str], wanted: _Wanted) -> _Wanted:
    """Check all that can be checked before anything is read; tells all mistakes at once.

    Returns:
        What is wanted, with these formats.
    """
    wrong: list[UserError] = []
    with collected(wrong):
        RunFolder(run).require_fitted()
    with collected(wrong):
        require_new_folder(out)
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        what = f"no format named {', '.join(map(repr, unknown))}" if unknown else "no format given"
        near = dict.fromkeys(x for name in unknown for x in get_close_matches(name, FORMATS, 1))
        meant = f"Did you mean {' '.join(near)}? " if near else ""
        wrong.append(UserError(what, "--format", f"{meant}There are {' '.join(FORMATS)}"))
    if "usd" in formats:
        with collected(wrong):
            require_usd()
    numbers = {"--texels": wanted.texels, "--metres-per-unit": wanted.metres}
    for option, number in numbers.items():
        if number is not None and not 1e-9 < number < 1e9:
            wrong.append(UserError(f"must be between 1e-9 and 1e9, not {number:g}", option))
    if formats and not {"gltf", "usd"} & {*formats} and not unknown:
        useless = {"--metres-per-unit": wanted.metres != 1, "--no-cameras": not wanted.cameras}
        for option in (option for option, given in useless.items() if given):
            what = "is for gltf and usd, and neither is written"
            wrong.append(UserError(what, option, "Leave it out"))
    if wanted.most not in _SIZES:
        what = f"must be one of {', '.join(map(str, _SIZES))}, not {wanted.most}"
        wrong.append(UserError(what, "--max-texture"))
    raise_together(wrong, most=None)
    return replace(wanted, formats=tuple(name for name in FORMATS if name in formats))


def _export(
    recovered: Recovered,
    folder: RunFolder,
    out: Path,
    wanted: _Wanted,
    console: Console | None,
    tell: Callable[[str], None],
) -> dict[str, Any]:
    formats, texels = wanted.formats, wanted.texels
    problem, dataset = recovered.problem, recovered.dataset
    tell_changed_geometry(folder, dataset, tell)
    cameras = recovered.cameras
    scene = problem.scene_view.scene
    density = texels
    if density is None:
        seen = surface_seen(scene, cameras)
        density = _BLIND / free_space.bounds(scene)[2] if seen is None else 1 / seen.footprint
    found = read_parts(dataset.scene, dataset.root, problem.pieces)
    found = found.without(known_materials(found.scene, recovered.config))
    lights = read_lights(found.scene, problem)
    learned = () if problem.materials is None else tuple(problem.materials)
    of_lamps = "mitsuba" in formats and bool(learned)
    placed = [p for p in found.parts if p.is_optimized or of_lamps]
    with _Bar(console) as bar:
        atlases = make_atlases(found.scene, placed, density, bar.unwraps, wanted.most)
        bar.total(sum(atlas.resolution**2 for atlas in atlases))
        baker, known = _baker(recovered, atlases, learned), set(formats) != {"mitsuba"}
        baked = []
        for atlas in atlases:
            bar.bakes(atlas.name)
            refine = texels is None and atlas.is_optimized
            shown = known and atlas.is_optimized
            baked.append(baker.bake(atlas, bar.advance, refine=refine, known=shown))
        bar.says("writing …")
        environment = environment_picture(problem)
        written = _write(recovered, out, wanted, found, baked, lights, environment, learned)
    names = {id(placed.part): atlas.name for atlas in atlases for placed in atlas.placed}
    manifest = {
        "format": EXPORT_FORMAT,
        "unbake": VERSION,
        "run": {
            "folder": os.fspath(folder.path.resolve()),
            "data": folder.origin().data,
            "steps": recovered.progress.step,
        },
        "formats": list(formats),
        "learned": list(learned),
        "texels_per_unit": density,
        "metres_per_unit": wanted.metres,
        "unobserved_share": _unobserved(baked),
        "near": _near(baked),
        "files": sorted(p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()),
        "materials": [_material(one, written) for one in baked if one.atlas.is_optimized],
        "parts": [_part(part, names.get(id(part))) for part in found.parts],
        "left_out": found.left_out,
        "lights": [
            {
                "name": light.name,
                "type": light.plugin,
                "strength": light.strength,
                "recovered": light.recovered,
            }
            for light in lights
        ],
        "cameras": written.cameras,
        "environment": None if environment is None else _ENVIRONMENT,
        "environment_upright": _UPRIGHT if (out / _UPRIGHT).exists() else None,
        "environment_unobserved": _UNOBSERVED if (out / _UNOBSERVED).exists() else None,
        "colour_spaces": COLOUR_SPACES,
        "conventions": _CONVENTIONS,
        "notes": [
            *_notes(found, baked, lights, _COARSE[texels is None]),
            *_without_place(found, baked, formats, learned),
            *_of_lamps(found, formats, learned),
            *_of_coordinates(baked, formats),
            *_of_strengths(lights, wanted.metres, formats),
            *_of_backs(found.parts, lights, formats),
            *_of_axes([view.camera for view in dataset.train], formats),
            *_of_size(found.parts, wanted.metres, formats),
            *written.notes,
        ],
    }
    _report(manifest, tell)
    return manifest


def _baker(recovered: Recovered, atlases: Sequence[Atlas], learned: Sequence[str]) -> Baker:
    """What looks up the materials of atlases."""
    parsed = parsed_principled(recovered.dataset.scene, recovered.dataset.root)
    numbers = {number for atlas in atlases for number in atlas.materials}
    own = own_textures(parsed, learned, numbers, stored=True)
    masks = {mask for atlas in atlases for around in atlas.masks for mask in around}
    opacities = own_opacities(parsed, masks)
    texels = sum(atlas.resolution**2 for atlas in atlases)
    return Baker(recovered.problem.materials, own, training_views(recovered), opacities, texels)


@dataclass(frozen=True)
class _Written:
    """What was written."""

    textures: dict[str, list[str]]  #: names of files, by material
    masks: dict[str, str]  #: of what no training view saw, by material
    notes: list[str]  #: what is not as it was
    cameras: list[str]  #: names of views that became cameras


def _write(
    recovered: Recovered,
    out: Path,
    wanted: _Wanted,
    found: Parts,
    baked: Sequence[Baked],
    lights: Sequence[Light],
    environment: Any,
    learned: Sequence[str],
) -> _Written:
    """Write all formats."""
    dataset, formats = recovered.dataset, wanted.formats
    shown = [one for one in baked if one.atlas.is_optimized]
    files: dict[str, list[str]] = {}
    notes: list[str] = []
    stems = file_names([one.atlas.name for one in shown])
    masks = {}
    for stem, one in zip(stems, shown, strict=True):
        if "textures" in formats:
            files[one.atlas.name] = write_textures(out / "textures", stem, one)
            masks[one.atlas.name] = f"textures/{stem}_unobserved.png"
        else:
            masks[one.atlas.name] = f"unobserved/{write_mask(out / 'unobserved', stem, one)}"
    if environment is not None:
        write_exr(out / _ENVIRONMENT, environment)
    if environment is not None and recovered.problem.environment is not None:
        told = surroundings(recovered, len(environment))
        if told.note:
            write_png(out / _UNOBSERVED, to_bytes(~told.lit))
            notes.append(f"{told.note}: {_UNOBSERVED}")
    visible = [part for part in found.parts if part.is_shown]
    others = [name for name in formats if name in ("gltf", "usd")]
    if others and len(visible) < len(found.parts):
        hidden = named([part.name for part in found.parts if not part.is_shown])
        notes.append(f"glTF and usd have no surfaces that nobody sees (null): without {hidden}")
    up = Up.of([view.camera for view in dataset.train])
    shot = _shot(recovered, visible) if wanted.cameras and others else NO_SHOT
    notes += _of_cameras(shot, len(dataset.views), formats)
    if "gltf" in formats:
        write_glb(out / "scene.glb", found.scene, visible, shown, lights, up, wanted.metres, shot)
        notes += _environment_of_gltf(out, environment, up, formats)
    if "usd" in formats:
        (out / "usd").mkdir()
        beside = None if environment is None else f"../{_ENVIRONMENT}"
        write_usd(out / "usd", found.scene, visible, shown, lights, beside, up, wanted.metres, shot)
    if "mitsuba" in formats:
        (out / "mitsuba").mkdir()
        # The scene's own stays as it is.
        recovered_environment = None if recovered.problem.environment is None else environment
        scene = write_scene(
            out / "mitsuba",
            parsed_principled(dataset.scene, dataset.root),
            parsed_principled(dataset.scene, dataset.root),
            found.parts,
            baked if learned else (),  # what was not learned stays as it is
            lights,
            recovered_environment,
            recovered.camera(dataset.train[0]),
            integrator=path_integrator(recovered.problem.scene_view.scene),
            refine=wanted.texels is None,
        )
        notes += scene.notes
    return _Written(files, masks, notes, list(shot.cameras))


def _shot(recovered: Recovered, parts: Sequence[Part]) -> Shot:
    """The cameras of all views, as the fit found them."""
    views = recovered.dataset.views
    return Shot.of({view.name: recovered.camera(view) for view in views}, parts)


def _of_cameras(shot: Shot, views: int, formats: Sequence[Format]) -> list[str]:
    """Which cameras are not as they were."""
    if not shot.cameras:
        return []
    notes = []
    if len(shot.cameras) < views:
        notes.append(f"{len(shot.cameras)} of {views} views are cameras in glTF and usd")
    if "gltf" in formats and (off := shot.off_centre()):
        what = "glTF has the principal point of cameras in the middle"
        notes.append(f"{what}: pictures are shifted by up to {off:.1f} pixels")
    return notes


def _of_size(parts: Sequence[Part], metres: float, formats: Sequence[Format]) -> list[str]:
    """That a scene is so large or small that its unit may be another."""
    ends = [end(p.triangles.positions, 0) for p in parts if p.is_shown for end in (np.min, np.max)]
    if not ends or not {"gltf", "usd"} & set(formats):
        return []
    units = float(np.linalg.norm(np.ptp(ends, axis=0)))
    if _SMALL <= units * metres <= _LARGE:
        return []
    remedy = "--metres-per-unit tells how long a unit is"
    for name, length in _LENGTHS.items():
        if units * metres > _LARGE and units * length < _ROOM:
            remedy = f"if units are {name}, --metres-per-unit {length:g}"
            break
    across = f"{units * metres:.0f}" if units * metres > _LARGE else f"{units * metres:.2g}"
    return [f"the scene is {across} m across: {remedy}"]


def _environment_of_gltf(
    out: Path, environment: Any, up: Up, formats: Sequence[Format]
) -> list[str]:
    """Write the environment in the axes of `scene.glb`, where these are others; what to tell."""
    if environment is None:
        return []
    what = "glTF has no environment: for scene.glb it is"
    turn = "in Blender, its Environment Texture needs a Mapping, Rotation Z 90°"
    if not up.is_turned("Y"):
        return [f"{what} {_ENVIRONMENT}", turn]
    write_exr(out / _UPRIGHT, turned_latlong(environment, up.rotation("Y")))
    kept = f"{_ENVIRONMENT} has the axes of the scene"
    others = " and ".join(name for name in ("mitsuba", "usd") if name in formats)
    if others:
        kept += f", as in {others}"
    return [f"{what} {_UPRIGHT}", turn, kept]


def _of_coordinates(baked: Sequence[Baked], formats: Sequence[Format]) -> list[str]:
    """Which textures are in coordinates that no file has."""
    unwrapped = [
        one.atlas.name for one in baked if one.atlas.is_optimized and one.atlas.method != "own"
    ]
    if set(formats) != {"textures"} or not unwrapped:
        return []
    what = f"unwrapped, in texture coordinates that no file here has: {named(unwrapped)}"
    return [f"{what}; add gltf, usd or mitsuba to --format for meshes that have them"]


def _of_strengths(lights: Sequence[Light], metres: float, formats: Sequence[Format]) -> list[str]:
    """Which lights Blender takes for others.

    It divides those of glTF by 683, unless it is told not to, but not lamps; and it scales places
    of a stage to metres, but not intensities.
    """
    lit = [light for light in lights if light.plugin in PUNCTUAL and light.strength]
    notes = []
    if "gltf" in formats and lit:
        what = "in Blender, import scene.glb with Lighting Mode: Unitless"
        notes.append(f"{what}, for {named([light.name for light in lit])}")
    scaled = [light.name for light in lit if light.plugin != "directional"]
    if "usd" in formats and metres != 1 and scaled:
        what = f"in Blender, multiply the power of lights of scene.usdc by {metres**2:g}"
        notes.append(f"{what}, which it does not scale: {named(scaled)}")
    return notes


def _of_backs(
    parts: Sequence[Part], lights: Sequence[Light], formats: Sequence[Format]
) -> list[str]:
    """Which lamps have backs that shine in Cycles: it knows no lamps of one side."""
    lit = {light.node for light in lights if light.strength is not None and any(light.strength)}
    lamps = [part for part in parts if part.emitter in lit and not part.triangles.is_closed]
    if not lamps or not {"gltf", "usd"} & set(formats):
        return []
    what = "in Blender, lamps shine on their backs unless Backfacing ends it"
    return [f"{what}: {named([part.name for part in lamps])}"]


def _of_axes(cameras: Sequence[Camera], formats: Sequence[Format]) -> list[str]:
    """What is turned because the scene is not upright."""
    up = Up.of(cameras)
    axes = {"gltf": "Y", "usd": up.of_usd}
    turned = [name for name, to in axes.items() if name in formats and up.is_turned(to)]
    usual = up.axis in ("+y", "+z") and not up.tilt
    if not turned or usual:  # between +y and +z every program turns
        return []
    names = " and ".join("glTF" if name == "gltf" else name for name in turned)
    return [f"up is {up.told()} by the cameras, and turned upright in {names}"]


# ------------------------------------------------------------------------------------- the manifest


def _material(baked: Baked, written: _Written) -> dict[str, Any]:
    atlas = baked.atlas
    return {
        "name": atlas.name,
        "textures": written.textures.get(atlas.name, []),
        "unobserved": written.masks.get(atlas.name),
        "resolution": atlas.resolution,
        "wanted_resolution": atlas.wanted,
        "coordinates": atlas.method,
        "unique_share": atlas.unique,
        "area": atlas.area(),
        "unobserved_share": baked.unobserved_share,
        "near": dict(baked.near),
        "parts": [placed.part.name for placed in atlas.placed],
    }


def _part(part: Part, material: str | None) -> dict[str, Any]:
    return {
        "name": part.name,
        "material": material if part.is_optimized else None,
        "triangles": len(part.triangles.faces),
        "tessellated": not part.exact,
        "without_area": part.dropped,
    }


def _unobserved(baked: Sequence[Baked]) -> float:
    """The share of the optimized surface that no training view saw."""
    shown = [(one.atlas.area(), one.unobserved_share) for one in baked if one.atlas.is_optimized]
    return sum(a * s for a, s in shown) / max(sum(a for a, _ in shown), 1e-30)


def _near(baked: Sequence[Baked]) -> dict[str, float]:
    """The share of the surface seen where textures have the fields' values, by quantity."""
    shown = [one for one in baked if one.atlas.is_optimized and one.near]
    seen = [one.atlas.area() * (1 - one.unobserved_share) + 1e-30 for one in shown]
    names = shown[0].near if shown else ()
    return {
        name: float(np.average([one.near[name] for one in shown], weights=seen)) for name in names
    }


def _notes(found: Parts, baked: Sequence[Baked], lights: Sequence[Light], remedy: str) -> list[str]:
    """What is not as it should be.

    Args:
        remedy: where textures are too coarse.
    """
    notes = []
    if found.left_out:
        notes.append(f"no triangles, left out: {', '.join(found.left_out)}")
    for one in filter(lambda each: each.atlas.is_optimized, baked):
        atlas = one.atlas
        if atlas.resolution < atlas.wanted:
            notes.append(
                f"{atlas.name}: limited to {atlas.resolution} texels, {atlas.wanted} were wanted"
            )
        if atlas.unique < UNIQUE:
            overlap = 100 * (1 - atlas.unique)
            notes.append(f"{atlas.name}: {overlap:.1f} % of its surface shares texels")
        if one.learned and not one.observed.any():
            notes.append(f"{atlas.name}: no training view saw it, its textures are the defaults")
    shown = [one for one in baked if one.atlas.is_optimized]
    far = [one.atlas.name for one in shown if not one.is_near]
    if far:
        notes.append(
            f"less than {100 * WANTED:.0f} % of the surface is within 2/255 of the fields in "
            f"{len(far)} of {len(shown)} materials ({named(far)}); {remedy}"
        )
    coarse: dict[str, list[str]] = {}
    for one in shown:
        for name in one.coarse:
            coarse.setdefault(name, []).append(one.atlas.name)
    for name, of in coarse.items():
        notes.append(f"{name} is coarser than in the scene in {named(of)}; {remedy}")
    varying = [light.name for light in lights if light.varies and light.strength is not None]
    if varying:
        what = "lights with a picture have its mean in glTF and usd"
        notes.append(f"{what}: {', '.join(varying)}")
    dark = [light.name for light in lights if light.strength is None]
    if dark:
        notes.append(f"lights of unknown strength are dark in glTF and usd: {', '.join(dark)}")
    if not any(one.learned for one in baked):
        what = "the run learned no materials: all textures are the scene's own"
        notes.append(f"{what}, sampled anew")
    return notes


def _without_place(
    found: Parts, baked: Sequence[Baked], formats: Sequence[Format], learned: Sequence[str]
) -> list[str]:
    """What materials and lights have that is not written to glTF and OpenUSD."""
    if not {"gltf", "usd"} & set(formats):
        return []
    lost = {name: ["all materials"] for name in learned if name not in TEXTURED}
    for one in filter(lambda each: each.atlas.is_optimized, baked):
        for name in material_constants(found.scene, one.atlas.materials).left_out:
            lost.setdefault(name, []).append(one.atlas.name)
    nodes = found.scene.state.nodes
    for part in found.parts:
        inside = [] if part.bsdf is None else found.scene.reachable(part.bsdf)
        plugins = {nodes[i].props.plugin_name() for i in inside}
        for plugin in filter(plugins.__contains__, _LAYERS):
            lost.setdefault(_LAYERS[plugin], []).append(part.name)
        if not part.is_optimized and constant_opacity(found.scene, part.masks) is None:
            lost.setdefault("cut-outs of materials without textures", []).append(part.name)
    told = [
        f"unbake does not write {name} to glTF and usd: left out of {named(of)}"
        for name, of in lost.items()
    ]
    if others := names_besides(found.scene, (*STRENGTHS, *ENVIRONMENTS)):
        told.append(f"unbake does not write such lights to glTF and usd: {named(others)}")
    return told


def _of_lamps(found: Parts, formats: Sequence[Format], learned: Sequence[str]) -> list[str]:
    """What was learned of materials of lamps, which Mitsuba's scene alone has."""
    lamps = [part.name for part in found.parts if part.materials and part.emitter is not None]
    others = [name for name in formats if name != "mitsuba"]
    if not (lamps and others and learned):
        return []
    what = "what was learned of materials on lamps is in the scene for Mitsuba alone"
    return [f"{what}: left out of {named(lamps)}"]


def _report(manifest: dict[str, Any], tell: Callable[[str], None]) -> None:
    """Tell what was written, in a few lines."""
    materials = manifest["materials"]
    for row in materials[:_TOLD]:
        size = row["resolution"]
        own = "its own coordinates" if row["coordinates"] == "own" else "unwrapped"
        unseen = f"{100 * row['unobserved_share']:.1f} % unobserved"
        tell(f"{row['name']}: {size} x {size} texels, {own}, {unseen}")
    if len(materials) > _TOLD:
        tell(f"… and {len(materials) - _TOLD} materials more, all in export.json")
    if manifest["near"]:
        least = 100 * min(manifest["near"].values())
        tell(f"{least:.1f} % of the surface seen is within 2/255 of the recovered fields")
    share = 100 * manifest["unobserved_share"]
    filled = ", and is filled in" if manifest["learned"] else ""
    tell(f"{share:.1f} % of the surface was seen by no training view{filled}")
    for note in manifest["notes"]:
        tell(f"note: {note}")


class _Bar:
    """Shows progress on a terminal; a context manager."""

    def __init__(self, console: Console | None) -> None:
        shown = console is not None and console.is_terminal
        self._bar = Progress(
            TextColumn("{task.percentage:3.0f} %"),
            BarColumn(bar_width=24),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.description}"),
            console=console if shown else Console(quiet=True),
            disable=not shown,
            transient=True,
        )
        self._texels = 0
        self._task = self._bar.add_task("reading the scene …", total=None)

    def __enter__(self) -> _Bar:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def says(self, what: str) -> None:
        """Show what is at work."""
        self._bar.update(self._task, description=what)

    def unwraps(self, name: str) -> None:
        """Show which material is unwrapped."""
        self.says(f"unwrapping {name[:40]}")

    def bakes(self, name: str) -> None:
        """Show which material is baked."""
        self.says(f"baking {name[:40]}")

    def total(self, texels: int) -> None:
        """Set the number of texels there are."""
        self._texels = texels
        self._bar.update(self._task, total=texels)

    def advance(self, done: int, more: int) -> None:
        """Add texels that are done, and texels that there are as well."""
        self.total(self._texels + more)
        self._bar.advance(self._task, done)
