"""The scene with its recovered materials as a Mitsuba scene that needs no unbake."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..dataset.camera import Camera
from ..imaging.pictures import write_exr
from ..quantities import QUANTITIES
from ..scene.emitters import ENVIRONMENTS, STRENGTHS
from ..scene.parse import ParsedScene, is_reference, referenced, write
from ..scene.triangles import write_mesh
from .bake import Baked, bake_texture, make_texture
from .lights import Light
from .parts import Part
from .tessellate import Triangles
from .textures import as_image, file_names
from .unwrap import Placed

#: How bitmaps are looked up that do not say it.
_LOOKED_UP = {"wrap_mode": "repeat", "filter_type": "bilinear"}
#: Samples a pixel of a sensor that is added.
_SPP = 64
_TEXTURES, _MESHES, _ENVIRONMENT, _LIGHTS = "textures", "meshes", "environment", "lights"


@dataclass(frozen=True)
class Written:
    """A scene that was written."""

    path: Path
    notes: list[str]  #: what is not as it was


#: Parameters of BSDFs and lamps that are colours; all others that textures may give are one number.
_COLOURS = (
    "base_color",
    "reflectance",
    "diffuse_reflectance",
    "specular_reflectance",
    "specular_transmittance",
    "radiance",
)


def write_scene(
    folder: Path,
    scene: ParsedScene,
    scratch: ParsedScene,
    parts: Sequence[Part],
    baked: Sequence[Baked],
    lights: Sequence[Light],
    environment: np.ndarray | None,
    camera: Camera,
    *,
    integrator: str = "path",
    refine: bool = False,
) -> Written:
    """Write `scene.xml`, meshes and textures.

    Shapes whose materials are written as textures become PLY meshes with the coordinates of these
    textures; so do shapes that instances place, and those with bump maps, whose texture is turned a
    little here (see `scene.bumps`). All others stay as they are.

    Args:
        folder: to write to; it must be new.
        scene: freshly parsed; it is changed.
        scratch: the same scene once more; its nodes are used up.
        parts: of the scene.
        baked: the textures of all materials that a fit changed, those of lights included.
        lights: with recovered strengths.
        environment: the recovered one, as `envmap` reads it.
        camera: of the sensor that is added where the scene has none.
        integrator: plugin of the integrator that is added where the scene has none.
        refine: textures that move to other coordinates may become finer than their material's.

    Raises:
        UserError: a texture cannot be made, or a file cannot be written.
    """
    folder = folder.resolve()
    notes: list[str] = []
    recovered = [light for light in lights if light.recovered]
    names_of_lights = file_names([light.name for light in recovered])
    for light, stem in zip(recovered, names_of_lights, strict=True):
        props, strength = scene.state.nodes[light.node].props, light.strength or (0.0, 0.0, 0.0)
        if light.pattern is None:
            props[STRENGTHS[light.plugin]] = mi.ScalarColor3d(list(strength))
            continue
        own = referenced(scene, props[STRENGTHS[light.plugin]])
        looked_up = dict(_LOOKED_UP)  # as the lamp's own picture is
        if own is not None and own.props.plugin_name() == "bitmap":
            names = (*_LOOKED_UP, "to_uv")
            looked_up |= {key: own.props[key] for key in names if key in own.props}
        picture = np.array(strength, np.float32) * light.pattern.sampled()
        texture = _bitmap(scene, folder / _LIGHTS / f"{stem}.exr", picture, colour=True)
        # Nodes are others once one was appended
        for key, value in looked_up.items():
            scene.state.nodes[texture].props[key] = value
        lit = scene.state.nodes[light.node].props
        lit[STRENGTHS[light.plugin]] = mi.Properties.ResolvedReference(texture)
    stems = file_names([one.atlas.name for one in baked])
    copies = _own_bsdfs(scene, baked)
    for stem, one, copied in zip(stems, baked, copies, strict=True):
        _replace_textures(folder, stem, one, scene, copied)
        notes += _move_others(folder, stem, one, scene, scratch, copied, refine=refine)
    placed = {id(p.part): _triangles(p, one) for one in baked for p in one.atlas.placed}
    placed |= {id(part): part.triangles for part in parts if _is_to_turn(part, placed)}
    names = {part.node: part.name for part in parts if not part.instanced}
    names |= _replace_shapes(folder, scene, parts, placed)
    if environment is not None:
        _replace_environment(folder, scene, environment)
    notes += _require_sensor(scene, camera)
    _require_integrator(scene, integrator)
    _forget_unused(scene)
    _name_shapes(scene, names)
    return Written(write(scene, folder), notes)


# ----------------------------------------------------------------------------------------- textures


def _own_bsdfs(scene: ParsedScene, baked: Sequence[Baked]) -> list[dict[int, int]]:
    """Give parts copies of BSDFs that shapes outside of their atlas have, too.

    Lamps may have those of walls, and a metal may lie in the blends of several materials.

    Returns:
        For each of `baked` the nodes of its own BSDFs, by those that they are copies of.
    """

    def held(place: int, kind: mi.ObjectType) -> set[int]:
        return {i for i in scene.reachable(place) if scene.state.nodes[i].type == kind}

    placed = {each.part.node for one in baked for each in one.atlas.placed}
    used: set[int] = set()
    for shape in held(0, mi.ObjectType.Shape) - placed:
        for i in scene.references(shape):
            if scene.state.nodes[i].type == mi.ObjectType.BSDF:
                used |= held(i, mi.ObjectType.BSDF)
    found = []
    for one in baked:
        outer = {each.part.bsdf for each in one.atlas.placed if each.part.bsdf is not None}
        own = {i for bsdf in outer for i in held(bsdf, mi.ObjectType.BSDF)}
        found.append({} if used.isdisjoint(own) else _copied_bsdfs(scene, one))
        used |= own
    return found


def _copied_bsdfs(scene: ParsedScene, baked: Baked) -> dict[int, int]:
    """Copy the BSDFs of an atlas, and have its parts refer to the copies."""
    parts = [placed.part for placed in baked.atlas.placed]
    inside = {i for p in parts if p.bsdf is not None for i in scene.reachable(p.bsdf)}
    nodes = scene.state.nodes
    chosen = sorted(i for i in inside if nodes[i].type == mi.ObjectType.BSDF)
    copies = {old: len(nodes) + place for place, old in enumerate(chosen)}
    for old, new in copies.items():
        node = mi.parser.SceneNode()
        node.type = mi.ObjectType.BSDF
        node.props = mi.Properties(scene.state.nodes[old].props)
        if node.props.id():
            node.props.set_id(f"{node.props.id()} {new}")
        _refer_to(node.props, copies)
        scene.append(node)
    for part in parts:
        _refer_to(scene.state.nodes[part.node].props, copies)
    return copies


def _refer_to(props: mi.Properties, copies: Mapping[int, int]) -> None:
    """Have references to nodes become references to their copies."""
    for key in list(props):
        if is_reference(props[key]) and props[key].index() in copies:
            props[key] = mi.Properties.ResolvedReference(copies[props[key].index()])


def _replace_textures(
    folder: Path, stem: str, baked: Baked, scene: ParsedScene, copies: Mapping[int, int]
) -> None:
    """Give the BSDFs of a material its baked textures; what was not learned stays as it is.

    Args:
        copies: nodes of the BSDFs that stand for others in this atlas.
    """
    nodes = scene.principled_indices()
    for name in baked.learned:
        values = baked.values[name]
        file = folder / _TEXTURES / f"{stem}_{name}.exr"
        colour = QUANTITIES[name].display == "colour"
        texture = _bitmap(scene, file, as_image(values), colour=colour)
        for number in baked.atlas.materials:
            props = scene.state.nodes[copies.get(nodes[number], nodes[number])].props
            props[QUANTITIES[name].slot] = mi.Properties.ResolvedReference(texture)


def _move_others(
    folder: Path,
    stem: str,
    baked: Baked,
    scene: ParsedScene,
    scratch: ParsedScene,
    copies: Mapping[int, int],
    *,
    refine: bool,
) -> list[str]:
    """Bring the other textures of a material's BSDFs and lamps into the coordinates of its atlas.

    Those stay that are looked up in coordinates that the parts keep.

    Args:
        copies: as of `_replace_textures`.
        refine: as of `write_scene`.

    Returns:
        What is not as it was.
    """
    parts = [placed.part for placed in baked.atlas.placed]
    learned = {QUANTITIES[name].slot for name in baked.learned}
    numbered = [scene.principled_indices()[number] for number in baked.atlas.materials]
    fitted = {copies.get(i, i) for i in numbered}
    outer = {copies.get(part.bsdf, part.bsdf) for part in parts if part.bsdf is not None}
    inside = {i for bsdf in outer for i in scene.reachable(bsdf)}
    inside |= {part.emitter for part in parts if part.emitter is not None}
    notes, is_kept = [], baked.atlas.method == "own"
    if not is_kept and any(_is_anisotropic(scene.state.nodes[i].props) for i in inside):
        # They are along the coordinates.
        notes.append(f"{baked.atlas.name}: anisotropic highlights follow the new coordinates")
    moved: dict[tuple[int, bool], int] = {}
    for i in sorted(inside):
        node = scene.state.nodes[i]
        if node.type not in (mi.ObjectType.BSDF, mi.ObjectType.Emitter):
            continue
        plugin = node.props.plugin_name()
        for key in list(node.props):
            node = scene.state.nodes[i]  # anew: a node that is appended moves all others
            inner = referenced(scene, node.props[key])
            baked_here = i in fitted and key in learned
            if inner is None or inner.type != mi.ObjectType.Texture or baked_here:
                continue
            if is_kept and not _is_stored(scene, node.props[key].index()):
                continue
            if plugin == "normalmap":
                # Its vectors are in the frame of the old coordinates.
                node.props[key] = mi.ScalarColor3d([0.5, 0.5, 1.0])
                notes.append(f"{baked.atlas.name}: the normal map is left out")
                continue
            old, colour = node.props[key].index(), key in _COLOURS
            if (old, colour) not in moved:
                texture = make_texture(scratch, old, stored=True)
                pixels, is_near = bake_texture(baked, texture, colour=colour, refine=refine)
                if not is_near:
                    what = "bump map" if plugin == "bumpmap" else key
                    told = f"{baked.atlas.name}: its {what} is coarser than in the scene"
                    notes.append(f"{told}; a larger --texels keeps more")
                if (pixels == pixels[..., :1]).all():
                    pixels = pixels[..., 0]
                file = folder / _TEXTURES / f"{stem}_texture-{len(moved)}.exr"
                moved[old, colour] = _bitmap(scene, file, pixels, colour=colour)
            props = scene.state.nodes[i].props
            props[key] = mi.Properties.ResolvedReference(moved[old, colour])
    return notes


def _is_stored(scene: ParsedScene, texture: int) -> bool:
    """Whether a texture reads values stored in meshes, which the meshes here have not."""
    nodes = scene.state.nodes
    return any(nodes[i].props.plugin_name() == "mesh_attribute" for i in scene.reachable(texture))


def _is_anisotropic(props: mi.Properties) -> bool:
    """Whether the highlights of a BSDF have a direction."""
    if props.get("anisotropic", 0.0) != 0.0:
        return True
    return props.get("alpha_u", None) != props.get("alpha_v", None)


def _bitmap(scene: ParsedScene, file: Path, values: np.ndarray, *, colour: bool) -> int:
    """Write an image and append a texture of it; the number of the texture's node.

    Args:
        colour: whether it is one of light, which spectral variants convert, and not of numbers.
    """
    write_exr(file, values)
    node = mi.parser.SceneNode()
    node.type = mi.ObjectType.Texture
    node.props.set_plugin_name("bitmap")
    node.props["filename"] = str(file)
    node.props["raw"] = not colour
    node.props["wrap_mode"] = "clamp"
    return scene.append(node)


# ------------------------------------------------------------------------------------------- shapes


def _triangles(placed: Placed, baked: Baked) -> Triangles:
    """A part as it is written: with a bump map its own coordinates stay turned, and are not cut."""
    turned = baked.atlas.method == "own" and placed.part.is_bumped
    return replace(placed.triangles, uv=placed.own_uv) if turned else placed.triangles


def _is_to_turn(part: Part, placed: Mapping[int, Triangles]) -> bool:
    """Whether a part has a bump map, and nothing is written for it that is turned already."""
    triangles = part.triangles
    bumped = part.is_bumped and part.exact and triangles.uv is not None
    return bumped and not triangles.stored and id(part) not in placed


def _replace_shapes(
    folder: Path, scene: ParsedScene, parts: Sequence[Part], placed: dict[int, Triangles]
) -> dict[int, str]:
    """Put PLY meshes in the place of shapes; returns names of parts by the nodes of the meshes."""
    chosen = [part for part in parts if id(part) in placed or part.instanced]
    replaced = {part.node for part in chosen if not part.instanced}
    instances = any(part.instanced for part in parts)
    root = scene.state.root.props
    for key in list(root):
        node = referenced(scene, root[key])
        if node is None:
            continue
        grouped = instances and node.props.plugin_name() in ("shapegroup", "instance")
        if grouped or root[key].index() in replaced:
            del root[key]
    names = {}
    for number, (part, stem) in enumerate(
        zip(chosen, file_names([part.name for part in chosen]), strict=True)
    ):
        file = folder / _MESHES / f"{stem}.ply"
        triangles = placed.get(id(part), part.triangles)
        write_mesh(file, *triangles.arrays)
        node = mi.parser.SceneNode()
        node.type = mi.ObjectType.Shape
        node.props.set_plugin_name("ply")
        node.props["filename"] = str(file)
        node.props["face_normals"] = triangles.normals is None
        old = scene.state.nodes[part.node].props
        for key in list(old):
            if is_reference(old[key]):
                node.props[key] = old[key]
        scene.append_to_root(f"exported shape {number}", node)
        names[len(scene.state.nodes) - 1] = part.name
    return names


def _name_shapes(scene: ParsedScene, names: Mapping[int, str]) -> None:
    """Give the shapes of the scene itself names of parts as ids, each once.

    Args:
        names: by the nodes of the shapes.
    """
    nodes = scene.state.nodes
    shapes = [i for i in scene.references(0) if i in names]
    taken = {nodes[i].props.id() for i in scene.reachable(0) if i not in shapes}
    for i in shapes:
        name = _as_id(names[i])
        nodes[i].props.set_id("" if name in taken else name)
        taken.add(name)


def _as_id(name: str) -> str:
    """A name as Mitsuba takes ids: no dots, no control characters, none of its own marks."""
    return re.sub(r"[^\w /-]", "_", name).lstrip("_")


# ------------------------------------------------------------------------------- lights and sensors


def _replace_environment(folder: Path, scene: ParsedScene, picture: np.ndarray) -> None:
    file = folder / _TEXTURES / f"{_ENVIRONMENT}.exr"
    write_exr(file, picture)
    root = scene.state.root.props
    for key in list(root):
        node = referenced(scene, root[key])
        if node is not None and node.props.plugin_name() in ENVIRONMENTS:
            for name in list(node.props):
                del node.props[name]
            node.props.set_plugin_name("envmap")
            node.props["filename"] = str(file)


def _require_sensor(scene: ParsedScene, camera: Camera) -> list[str]:
    """Append a sensor where there is none.

    Returns:
        What is not as it was.
    """
    nodes = scene.state.nodes
    if any(node.type == mi.ObjectType.Sensor for node in nodes):
        return []
    notes = []
    if not camera.has_square_pixels:
        told = f"{camera.fl_x:g} and {camera.fl_y:g} pixels, which Mitsuba's camera has not"
        notes.append(f"the sensor has the mean of two focal lengths, {told}")
        mean = (camera.fl_x + camera.fl_y) / 2
        camera = replace(camera, fl_x=mean, fl_y=mean)
    wanted = camera.sensor(_SPP)
    sampler = _node(mi.ObjectType.Sampler, wanted.pop("sampler"))
    size = {"width": camera.width, "height": camera.height}
    film = _node(mi.ObjectType.Film, {"type": "hdrfilm"} | size)
    del wanted["film"]
    sensor = _node(mi.ObjectType.Sensor, wanted)
    sensor.props["film"] = mi.Properties.ResolvedReference(scene.append(film))
    sensor.props["sampler"] = mi.Properties.ResolvedReference(scene.append(sampler))
    scene.append_to_root("exported sensor", sensor)
    return notes


def _node(kind: mi.ObjectType, wanted: Mapping[str, Any]) -> mi.parser.SceneNode:
    """A node of a scene with the plugin and the properties of a dictionary."""
    node = mi.parser.SceneNode()
    node.type = kind
    node.props.set_plugin_name(wanted["type"])
    for key, value in wanted.items():
        if key != "type":
            node.props[key] = value
    return node


def _require_integrator(scene: ParsedScene, plugin: str) -> None:
    """Append an integrator where there is none, without which `mi.render` fails."""
    if any(node.type == mi.ObjectType.Integrator for node in scene.state.nodes):
        return
    integrator = mi.parser.SceneNode()
    integrator.type = mi.ObjectType.Integrator
    integrator.props.set_plugin_name(plugin)
    scene.append_to_root("exported integrator", integrator)


def _forget_unused(scene: ParsedScene) -> None:
    """Take the files from nodes that nothing refers to, so that they are not copied."""
    used = set(scene.reachable(0))
    for i, node in enumerate(scene.state.nodes):
        if i not in used and "filename" in node.props:
            del node.props["filename"]
