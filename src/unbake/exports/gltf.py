"""The scene as one binary glTF 2.0 file: a node for each part, textures and lights inside of it.

Texture coordinates are the same in Mitsuba and in glTF: (0, 0) is the corner of the first texel of
the first row. Positions are those of the scene. glTF takes +y as up, and metres: a node around all
others turns what is up in the scene to +y, and scales a unit of the scene to metres. Cameras and
lights below it have the inverse scale, so that none is left in the world.

Source: Khronos, glTF 2.0 specification; KHR_lights_punctual, KHR_materials_emissive_strength,
KHR_materials_transmission, KHR_materials_volume, KHR_materials_ior, KHR_materials_clearcoat.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..imaging.pictures import png_bytes
from ..io import write_atomically
from ..scene.parse import ParsedScene
from ..scene.triangles import unit
from ..version import VERSION
from .bake import Baked
from .cameras import NO_SHOT, Shot
from .constants import CUTOFF, Constants, constant_opacity, is_number, material_constants
from .lights import Light
from .parts import Part, unique_names
from .tessellate import Triangles
from .textures import base_colour, picture
from .upright import Up

_FLOAT, _UINT, _ARRAY, _INDEX = 5126, 5125, 34962, 34963
_LINEAR, _MIPMAPS, _CLAMP = 9729, 9987, 33071
#: BSDFs that light passes through.
_GLASS = ("dielectric", "thindielectric", "roughdielectric")
_CONDUCTORS = ("conductor", "roughconductor")
_PLASTIC = "plastic"
#: Width of microfacets in Mitsuba where nothing is said.
_ALPHA = 0.1
#: Lights without extent, as glTF calls them.
PUNCTUAL = {"point": "point", "spot": "spot", "directional": "directional"}

#: The node that turns and scales the scene, where its up is not +y or its unit no metre.
UPRIGHT = "upright"
#: Bytes that the header of a file can tell.
LARGEST = 2**32 - 1


class Document:
    """A glTF document and its one buffer."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": f"unbake {VERSION}"},
            "scene": 0,
            "scenes": [{"nodes": []}],
        }
        self._parts: list[bytes] = []
        self._length = 0
        self._extensions: set[str] = set()

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Append to a list of the document; the number of the new entry."""
        entries = self.json.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def turn(self, up: Up, metres: float = 1.0) -> None:
        """Put a node around all that there is, which turns up to +y, and scales a unit to metres.

        There is none where there is nothing to turn or to scale.
        """
        node: dict[str, Any] = {"name": UPRIGHT}
        if up.is_turned("Y"):
            node["rotation"] = up.quaternion("Y").tolist()
        if metres != 1:
            node["scale"] = [metres] * 3
        top = self.json["scenes"][0]
        if len(node) > 1 and top["nodes"]:
            top["nodes"] = [self.add("nodes", node | {"children": top["nodes"]})]

    def use(self, extension: str) -> str:
        """Declare an extension."""
        self._extensions.add(extension)
        return extension

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes to the buffer; the number of their view."""
        entry = {"buffer": 0, "byteOffset": self._length, "byteLength": len(data)}
        if target is not None:
            entry["target"] = target
        padded = data + b"\0" * (-len(data) % 4)
        self._parts.append(padded)
        self._length += len(padded)
        return self.add("bufferViews", entry)

    def array(self, values: np.ndarray, kind: str, *, bounds: bool = False) -> int:
        """Append an array of the attributes of vertices, or of indices; the number of its accessor.

        Args:
            values: float32 (n, components), or uint32 (n,).
            kind: of glTF, such as `VEC3`.
            bounds: tell the least and the most of each component.
        """
        index = values.dtype == np.uint32
        entry: dict[str, Any] = {
            "bufferView": self.view(
                np.ascontiguousarray(values).tobytes(), _INDEX if index else _ARRAY
            ),
            "componentType": _UINT if index else _FLOAT,
            "count": len(values),
            "type": kind,
        }
        if bounds:
            entry |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        return self.add("accessors", entry)

    def image(self, name: str, pixels: np.ndarray) -> int:
        """Append a picture of 8 bits; the number of its texture."""
        data = self.view(png_bytes(pixels))
        image = self.add("images", {"name": name, "bufferView": data, "mimeType": "image/png"})
        if "samplers" not in self.json:
            clamped = {"wrapS": _CLAMP, "wrapT": _CLAMP}
            self.add("samplers", {"magFilter": _LINEAR, "minFilter": _MIPMAPS, **clamped})
        return self.add("textures", {"sampler": 0, "source": image})

    def content(self) -> list[bytes]:
        """The file, in pieces.

        Raises:
            UserError: it would be larger than files can be.
        """
        self.json["buffers"] = [{"byteLength": self._length}]
        if self._extensions:
            self.json["extensionsUsed"] = sorted(self._extensions)
        text = json.dumps(self.json, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + self._length
        if total > LARGEST:
            what = f"the file would have {total / 2**30:.1f} GiB, glTF has at most 4"
            raise UserError(what, None, "Export fewer texels (--texels), or to usd (--format)")
        return [
            struct.pack("<4sII", b"glTF", 2, total),
            struct.pack("<I4s", len(text), b"JSON") + text,
            struct.pack("<I4s", self._length, b"BIN\0"),
            *self._parts,
        ]

    def write(self, path: Path) -> None:
        """Write the file, complete or not at all."""
        content = self.content()

        def save(target: Path) -> None:
            with target.open("wb") as file:
                file.writelines(content)

        write_atomically(path, save)


def write_glb(
    path: Path,
    scene: ParsedScene,
    parts: Sequence[Part],
    baked: Sequence[Baked],
    lights: Sequence[Light],
    up: Up,
    metres: float = 1.0,
    shot: Shot = NO_SHOT,
) -> None:
    """Write parts, their materials, the lights and cameras.

    Args:
        path: the file.
        scene: the nodes that the parts are of.
        parts: all of them; those that no fit optimizes get materials without textures.
        baked: textures of the others.
        lights: point, spot and directional lights are written as such, area lights as emission of
            their parts; environments are left out, as glTF knows none.
        up: what is up in the scene.
        metres: of a unit of the scene.
        shot: the cameras; principal points are taken as in the middle of images.
    """
    document = Document()
    placed = {id(p.part): (p.triangles, b) for b in baked for p in b.atlas.placed}
    glow = {light.node: light.strength for light in lights}
    textures: dict[int, dict[str, Any]] = {}
    materials: dict[str, int] = {}
    for part in parts:
        if part.is_optimized:
            triangles, one = placed[id(part)]
            if id(one) not in textures:
                constants = material_constants(scene, one.atlas.materials)
                textures[id(one)] = _textured(document, one, constants)
            material = {"name": one.atlas.name, **textures[id(one)]}
        else:
            triangles = part.triangles
            strength = None if part.emitter is None else glow.get(part.emitter)
            material = plain_material(document, scene, part, strength)
        material["doubleSided"] = part.two_sided or part.is_pane
        key = json.dumps(material, sort_keys=True)
        if key not in materials:
            materials[key] = document.add("materials", material)
        triangles = triangles if part.is_optimized else replace(triangles, uv=None)
        _add_part(document, part.name, triangles, materials[key])
    for light in lights:
        if light.plugin in PUNCTUAL and light.strength is not None:
            _add_light(document, light, metres)
    if shot.cameras:
        _add_cameras(document, shot, metres)
    document.turn(up, metres)
    document.write(path)


def _add_part(document: Document, name: str, triangles: Triangles, material: int) -> None:
    attributes = {"POSITION": document.array(triangles.positions, "VEC3", bounds=True)}
    if triangles.normals is not None:
        attributes["NORMAL"] = document.array(unit(triangles.normals), "VEC3")
    if triangles.uv is not None:
        attributes["TEXCOORD_0"] = document.array(triangles.uv.astype(np.float32), "VEC2")
    indices = document.array(triangles.faces.astype(np.uint32).ravel(), "SCALAR")
    primitive = {"attributes": attributes, "indices": indices, "material": material}
    mesh = document.add("meshes", {"name": name, "primitives": [primitive]})
    node = document.add("nodes", {"name": name, "mesh": mesh})
    document.json["scenes"][0]["nodes"].append(node)


def _textured(document: Document, baked: Baked, constants: Constants) -> dict[str, Any]:
    """A material of textures: roughness is the green channel and metallic the blue one."""
    extensions: dict[str, Any] = {document.use("KHR_materials_ior"): {"ior": constants.ior}}
    if constants.clearcoat > 0:
        extensions[document.use("KHR_materials_clearcoat")] = {
            "clearcoatFactor": constants.clearcoat,
            "clearcoatRoughnessFactor": constants.clearcoat_roughness,
        }
    name, values = baked.atlas.name, baked.values
    roughness, metallic = (picture(k, values[k]) for k in ("roughness", "metallic"))
    both = np.stack([np.full_like(roughness, 255), roughness, metallic], -1)
    colour = document.image(f"{name} base colour", base_colour(baked))
    factors: dict[str, Any] = {
        "baseColorTexture": {"index": colour},
        "metallicRoughnessTexture": {"index": document.image(f"{name} roughness", both)},
    }
    material: dict[str, Any] = {"pbrMetallicRoughness": factors, "extensions": extensions}
    if baked.opacity is not None:
        material["alphaMode"] = "BLEND" if baked.blends else "MASK"
        if not baked.blends:
            material["alphaCutoff"] = CUTOFF
        if baked.constant_opacity is not None:
            factors["baseColorFactor"] = [1.0, 1.0, 1.0, baked.constant_opacity]
    return material


def plain_material(
    document: Document,
    scene: ParsedScene,
    part: Part,
    strength: tuple[float, float, float] | None,
) -> dict[str, Any]:
    """A material of numbers for what no fit optimizes: lights, glass, mirrors and the like.

    Args:
        document: declares the extensions that the material uses.
        scene: the nodes that the part is of.
        part: the part.
        strength: linear RGB radiance of its emitter; None: it has none, or it varies.
    """
    nodes = scene.state.nodes
    found = [] if part.bsdf is None else scene.reachable(part.bsdf)
    props = {nodes[i].props.plugin_name(): nodes[i].props for i in reversed(found)}
    material: dict[str, Any] = {"name": part.name}
    factors: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    if part.emitter is not None:
        factors["baseColorFactor"] = [0.0, 0.0, 0.0, 1.0]
        if strength is not None:
            material |= _emissive(document, strength)
    elif glass := next((props[k] for k in _GLASS if k in props), None):
        factors["roughnessFactor"] = _roughness(glass, "roughdielectric")
        transmission = document.use("KHR_materials_transmission")
        factors["baseColorFactor"] = [*_colour(glass.get("specular_transmittance", 1.0), 1.0), 1.0]
        material["extensions"] = {transmission: {"transmissionFactor": 1.0}}
        material["extensions"] |= _refraction(document, glass, 1.5046)
        if not part.is_pane:
            volume = document.use("KHR_materials_volume")
            material["extensions"][volume] = {"thicknessFactor": _thickness(part.triangles)}
    elif metal := next((props[k] for k in _CONDUCTORS if k in props), None):
        factors["metallicFactor"] = 1.0
        factors["roughnessFactor"] = _roughness(metal, "roughconductor")
        factors["baseColorFactor"] = [*_head_on(metal), 1.0]
    elif plastic := props.get(_PLASTIC):
        factors["roughnessFactor"] = 0.0
        colour = _colour(plastic.get("diffuse_reflectance", 0.5), default=0.5)
        factors["baseColorFactor"] = [*colour, 1.0]
        material["extensions"] = _refraction(document, plastic, 1.49)
    else:
        factors["baseColorFactor"] = [0.5, 0.5, 0.5, 1.0]
    opacity = constant_opacity(scene, part.masks)
    if opacity is not None and opacity < 1:
        factors["baseColorFactor"][3] = opacity
        material["alphaMode"] = "BLEND"
    material["pbrMetallicRoughness"] = factors
    return material


def _thickness(triangles: Triangles) -> float:
    """About how thick a solid is, in units of the scene: the least edge of its box.

    It is more than 0, also of the surface of a pond: glTF takes what has no thickness as a pane.
    """
    edges = np.ptp(triangles.positions, axis=0)
    return float(max(edges.min(), 0.01 * edges.max()))


def _refraction(document: Document, props: Any, default: float) -> dict[str, Any]:
    """The index of refraction of a known BSDF: a number, or the name of what Mitsuba knows."""
    ior = props.get("int_ior", default)
    if isinstance(ior, str):
        eta = mi.traverse(mi.load_dict({"type": "dielectric", "int_ior": ior, "ext_ior": 1.0}))
        ior = float(np.ravel(np.array(eta["eta"]))[0])
    known = isinstance(ior, float) and ior >= 1
    return {document.use("KHR_materials_ior"): {"ior": ior}} if known else {}


def _head_on(metal: Any) -> list[float]:
    """What a conductor reflects at a right angle, linear RGB; grey where textures tell it."""
    props = mi.Properties("conductor")
    for key in ("material", "eta", "k", "specular_reflectance"):
        if key in metal:
            if isinstance(metal[key], mi.Properties.ResolvedReference):
                return _colour(None)
            props[key] = metal[key]
    bsdf = mi.PluginManager.instance().create_object(props)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0, 0, 1)
    _, reflected = bsdf.sample(mi.BSDFContext(), si, 0, mi.Point2f(0))
    return _colour(np.ravel(np.array(reflected)))


def _roughness(props: Any, rough: str) -> float:
    """Perceptual roughness of a microfacet width, 0 of what is smooth.

    Of two widths their mean counts; one that is a texture counts as Mitsuba's default.
    """
    if props.plugin_name() != rough:
        return 0.0
    keys = ("alpha_u", "alpha_v") if {"alpha_u", "alpha_v"} & set(props) else ("alpha",)
    given = [props.get(key, _ALPHA) for key in keys]
    widths = [alpha if is_number(alpha) else _ALPHA for alpha in given]
    return math.sqrt(min(max(sum(widths) / len(widths), 0.0), 1.0))


def _colour(value: Any, default: float = 0.9) -> list[float]:
    """A colour of the scene, linear RGB in [0, 1]; grey where it is no number."""
    try:
        rgb = np.ravel(np.array(value, np.float64))
    except (TypeError, ValueError, RuntimeError):
        rgb = np.array([])
    if rgb.size not in (1, 3) or not np.isfinite(rgb).all():
        return [default] * 3
    return np.broadcast_to(rgb.clip(0, 1), 3).tolist()


def _emissive(document: Document, strength: Sequence[float]) -> Mapping[str, Any]:
    """Emission: a colour in [0, 1] and what multiplies it."""
    largest = max(*strength, 1e-12)
    return {
        "emissiveFactor": [max(x, 0.0) / largest for x in strength],
        "extensions": {
            document.use("KHR_materials_emissive_strength"): {"emissiveStrength": largest}
        },
    }


def _add_light(document: Document, light: Light, metres: float) -> None:
    """A light without extent; glTF's look along -z, Mitsuba's along +z.

    Its irradiance stays the same where a unit becomes so many metres.
    """
    assert light.strength is not None
    largest = max(*light.strength, 1e-12)
    entry: dict[str, Any] = {
        "name": light.name,
        "type": PUNCTUAL[light.plugin],
        "color": [max(x, 0.0) / largest for x in light.strength],
        "intensity": largest * (1.0 if light.plugin == "directional" else metres**2),
    }
    if light.plugin == "spot":
        inner, outer = light.angles
        outer = min(float(outer), math.pi / 2)
        entry["spot"] = {
            "innerConeAngle": min(float(inner), 0.999 * outer),
            "outerConeAngle": outer,
        }
    extension = document.use("KHR_lights_punctual")
    known = document.json.setdefault("extensions", {}).setdefault(extension, {"lights": []})
    known["lights"].append(entry)
    node = {
        "name": light.name,
        "matrix": _unscaled(light.pose, metres),
        "extensions": {extension: {"light": len(known["lights"]) - 1}},
    }
    document.json["scenes"][0]["nodes"].append(document.add("nodes", node))


def _add_cameras(document: Document, shot: Shot, metres: float) -> None:
    """Cameras of glTF look along -z, as those of a data set; a node has all of them.

    No two nodes have one name: programs mix them up, as trimesh does.
    """
    children, others = [], [node["name"] for node in document.json.get("nodes", ())]
    own = unique_names([*others, *(f"camera {name}" for name in shot.cameras), "cameras"])
    *nodes, group = own[len(others) :]
    for (name, camera), called in zip(shot.cameras.items(), nodes, strict=True):
        wide, high = camera.width / camera.fl_x, camera.height / camera.fl_y
        perspective = {
            "aspectRatio": wide / high,
            "yfov": 2 * math.atan(high / 2),
            "znear": shot.near * metres,
            "zfar": shot.far * metres,
        }
        made = {"name": name, "type": "perspective", "perspective": perspective}
        number, matrix = document.add("cameras", made), _unscaled(camera.to_world, metres)
        node = {"name": called, "camera": number, "matrix": matrix}
        children.append(document.add("nodes", node))
    top = document.add("nodes", {"name": group, "children": children})
    document.json["scenes"][0]["nodes"].append(top)


def _unscaled(pose: np.ndarray, metres: float) -> list[float]:
    """The matrix of a node whose scale in the world is 1, where the node around it has metres."""
    return (pose @ np.diag([1 / metres] * 3 + [1.0])).T.ravel().tolist()
