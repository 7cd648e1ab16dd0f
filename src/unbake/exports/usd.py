"""The scene as OpenUSD: meshes, UsdPreviewSurface materials with textures, lights and cameras.

    usd/scene.usdc        binary; names of parts and materials are display names
    usd/textures/         PNG, sRGB for albedo; and the environment

A texture coordinate (u, v) of Mitsuba and glTF is (u, 1 − v) in USD: (0, 0) is below. Units
stay those of the scene, and so do axes where y or z is up: the stage says which, and how long a
unit is. Where neither is up, `/scene` turns what is to the nearer of the two.

Source: Pixar, OpenUSD: UsdGeom, UsdShade, UsdPreviewSurface 2.6, UsdLux; GfCamera.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..dataset.camera import Camera
from ..errors import UserError
from ..imaging.pictures import write_png
from ..scene.parse import ParsedScene
from ..scene.triangles import unit
from .bake import Baked
from .cameras import NO_SHOT, Shot
from .constants import CUTOFF, Constants, material_constants
from .gltf import Document, plain_material
from .lights import Light
from .parts import Part
from .tessellate import Triangles
from .textures import COLOUR_SPACES, base_colour, file_names, picture
from .upright import Up

#: Of the shader: the quantity, and its type and the channels of the texture that it takes.
_INPUTS = {
    "albedo": ("diffuseColor", "Color3f", "rgb"),
    "roughness": ("roughness", "Float", "r"),
    "metallic": ("metallic", "Float", "r"),
}
#: A light without extent is a small sphere, whose size its intensity does not depend on.
_RADIUS = 1e-3
#: Of all cameras, metres: the width of film, of which only its share of the focal length counts.
_FILM = 0.036


def require_usd() -> None:
    """Check that usd-core is there.

    Raises:
        UserError: it is not.
    """
    if importlib.util.find_spec("pxr") is None:
        what = "usd needs the package usd-core"
        raise UserError(what, "--format", "Run pip install 'unbake[usd]'")


def write_usd(
    folder: Path,
    scene: ParsedScene,
    parts: Sequence[Part],
    baked: Sequence[Baked],
    lights: Sequence[Light],
    environment: str | None,
    up: Up,
    metres: float = 1.0,
    shot: Shot = NO_SHOT,
) -> None:
    """Write parts, their materials, the lights and cameras.

    Args:
        folder: to write to; it exists.
        scene: the nodes that the parts are of.
        parts: all of them; those that no fit optimizes get materials without textures.
        baked: textures of the others.
        lights: those without extent are written as such, area lights as emission of their parts.
        environment: path of the environment's file from the folder, which is copied to the
            textures; None: there is none.
        up: what is up in the scene.
        metres: of a unit of the scene.
        shot: the cameras.
    """
    from pxr import Usd, UsdGeom, UsdLux

    stage = Usd.Stage.CreateNew(os.fspath(folder / "scene.usdc"))
    UsdGeom.SetStageUpAxis(stage, up.of_usd)
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    writer = _Writer(stage, up)
    stems = file_names([one.atlas.name for one in baked])
    placed, textured = {}, {}
    for stem, one in zip(stems, baked, strict=True):
        constants = material_constants(scene, one.atlas.materials)
        textured[id(one)] = writer.textured(folder, stem, one, constants)
        placed |= {id(p.part): (p.triangles, textured[id(one)]) for p in one.atlas.placed}
    glow = {light.node: light.strength for light in lights}
    for part in parts:
        if part.is_optimized:
            triangles, material = placed[id(part)]
        else:
            strength = None if part.emitter is None else glow.get(part.emitter)
            told = plain_material(Document(), scene, part, strength)
            triangles, material = part.triangles, writer.plain(told)
        writer.mesh(part, triangles, material)
    for light in lights:
        if light.strength is not None:
            writer.light(light)
    for name, camera in shot.cameras.items():
        writer.camera(name, camera, (shot.near, shot.far), metres)
    if environment is not None:
        dome = UsdLux.DomeLight.Define(stage, writer.path("lights", "environment"))
        copied = f"textures/{Path(environment).name}"
        (folder / "textures").mkdir(exist_ok=True)
        shutil.copyfile(folder / environment, folder / copied)
        dome.CreateTextureFileAttr(f"./{copied}")
        dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    stage.GetRootLayer().Save()


class _Writer:
    """Adds prims to a stage; names that USD does not take are changed, and kept for display."""

    def __init__(self, stage: Any, up: Up) -> None:
        from pxr import Gf, UsdGeom

        self._stage = stage
        self._taken: set[str] = set()
        self._plain: dict[str, Any] = {}
        root = UsdGeom.Xform.Define(stage, "/scene")
        stage.SetDefaultPrim(root.GetPrim())
        if up.is_turned(up.of_usd):
            turn = np.eye(4)
            turn[:3, :3] = up.rotation(up.of_usd).T  # rows are the images of the axes
            root.AddTransformOp().Set(Gf.Matrix4d(turn.tolist()))
        for name in ("parts", "materials", "lights", "cameras"):
            UsdGeom.Scope.Define(stage, f"/scene/{name}")

    def path(self, under: str, name: str) -> str:
        """A path for a prim that no other has."""
        from pxr import Tf

        plain = Tf.MakeValidIdentifier(name)
        number, chosen = 1, f"/scene/{under}/{plain}"
        while chosen in self._taken:
            number += 1
            chosen = f"/scene/{under}/{plain}_{number}"
        self._taken.add(chosen)
        return chosen

    def mesh(self, part: Part, triangles: Triangles, material: Any) -> None:
        """Add a part with its material."""
        from pxr import Sdf, UsdGeom, UsdShade, Vt

        mesh = UsdGeom.Mesh.Define(self._stage, self.path("parts", part.name))
        mesh.GetPrim().SetDisplayName(part.name)
        positions = np.ascontiguousarray(triangles.positions, np.float32)
        corners = triangles.faces.astype(np.int32).ravel()
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(positions))
        counts = np.full(len(triangles.faces), 3, np.int32)
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(part.two_sided or part.is_pane)
        box = np.stack([positions.min(0), positions.max(0)])
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(box))
        if triangles.normals is not None:
            mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(unit(triangles.normals)))
            mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        if part.is_optimized and triangles.uv is not None:
            st = np.stack([triangles.uv[:, 0], 1 - triangles.uv[:, 1]], -1)
            kind = Sdf.ValueTypeNames.TexCoord2fArray
            primvars = UsdGeom.PrimvarsAPI(mesh)
            made = primvars.CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
            made.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(st, np.float32)))
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)

    def textured(self, folder: Path, stem: str, baked: Baked, constants: Constants) -> Any:
        """Add a material of textures, and write those."""
        from pxr import Sdf, UsdShade

        kinds = Sdf.ValueTypeNames
        material, surface = self._material(baked.atlas.name)
        surface.CreateInput("ior", kinds.Float).Set(constants.ior)
        if constants.clearcoat > 0:
            surface.CreateInput("clearcoat", kinds.Float).Set(constants.clearcoat)
            coat = surface.CreateInput("clearcoatRoughness", kinds.Float)
            coat.Set(constants.clearcoat_roughness)
        root = material.GetPath()
        reader = UsdShade.Shader.Define(self._stage, root.AppendChild("st"))
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", kinds.String).Set("st")
        coordinates = reader.CreateOutput("result", kinds.Float2)
        for name, (target, kind, channels) in _INPUTS.items():
            file = f"textures/{stem}_{name}.png"
            values = baked.values[name]
            pixels = base_colour(baked) if name == "albedo" else picture(name, values)
            write_png(folder / file, pixels)
            texture = UsdShade.Shader.Define(self._stage, root.AppendChild(name))
            texture.CreateIdAttr("UsdUVTexture")
            texture.CreateInput("file", kinds.Asset).Set(f"./{file}")
            space = "sRGB" if COLOUR_SPACES[name]["png"] == "sRGB" else "raw"
            texture.CreateInput("sourceColorSpace", kinds.Token).Set(space)
            for wrap in ("wrapS", "wrapT"):
                texture.CreateInput(wrap, kinds.Token).Set("clamp")
            texture.CreateInput("st", kinds.Float2).ConnectToSource(coordinates)
            colour = kinds.Float3 if channels == "rgb" else kinds.Float
            found = texture.CreateOutput(channels, colour)
            surface.CreateInput(target, getattr(kinds, kind)).ConnectToSource(found)
            if name == "albedo" and baked.opacity is not None:
                opacity = surface.CreateInput("opacity", kinds.Float)
                if baked.constant_opacity is None:
                    opacity.ConnectToSource(texture.CreateOutput("a", kinds.Float))
                else:
                    opacity.Set(baked.constant_opacity)
        if baked.opacity is not None and not baked.blends:
            surface.CreateInput("opacityThreshold", kinds.Float).Set(CUTOFF)
        return material

    def plain(self, told: Mapping[str, Any]) -> Any:
        """A material of numbers, from those of glTF; equal ones are one."""
        key = json.dumps(told, sort_keys=True)
        if key in self._plain:
            return self._plain[key]
        from pxr import Gf, Sdf

        kinds = Sdf.ValueTypeNames
        material, surface = self._material(told["name"])
        factors, extra = told["pbrMetallicRoughness"], told.get("extensions", {})
        *colour, opacity = factors.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])
        surface.CreateInput("diffuseColor", kinds.Color3f).Set(Gf.Vec3f(*colour))
        surface.CreateInput("roughness", kinds.Float).Set(factors["roughnessFactor"])
        surface.CreateInput("metallic", kinds.Float).Set(factors["metallicFactor"])
        if "emissiveFactor" in told:
            strength = extra["KHR_materials_emissive_strength"]["emissiveStrength"]
            glow = Gf.Vec3f(*(strength * x for x in told["emissiveFactor"]))
            surface.CreateInput("emissiveColor", kinds.Color3f).Set(glow)
        opacity = 0.0 if "KHR_materials_transmission" in extra else opacity
        if opacity < 1:
            surface.CreateInput("opacity", kinds.Float).Set(opacity)
        if "KHR_materials_ior" in extra:
            surface.CreateInput("ior", kinds.Float).Set(extra["KHR_materials_ior"]["ior"])
        self._plain[key] = material
        return material

    def light(self, light: Light) -> None:
        """Add a point, spot or directional light; USD's look along -z, Mitsuba's along +z."""
        from pxr import Gf, UsdGeom, UsdLux

        if light.plugin not in ("point", "spot", "directional"):
            return
        assert light.strength is not None
        path, largest = self.path("lights", light.name), max(*light.strength, 1e-12)
        if light.plugin == "directional":
            made = UsdLux.DistantLight.Define(self._stage, path)
            made.CreateAngleAttr(0.0)
            made.CreateIntensityAttr(largest)
        else:
            made = UsdLux.SphereLight.Define(self._stage, path)
            made.CreateRadiusAttr(_RADIUS)
            made.CreateTreatAsPointAttr(True)
            # Divided by the sphere's surface, which is four times what is seen of it.
            made.CreateNormalizeAttr(True)
            made.CreateIntensityAttr(4 * largest)
        made.CreateColorAttr(Gf.Vec3f(*(max(x, 0.0) / largest for x in light.strength)))
        if light.plugin == "spot":
            inner, outer = (float(x) for x in light.angles)
            shaping = UsdLux.ShapingAPI.Apply(made.GetPrim())
            shaping.CreateShapingConeAngleAttr(math.degrees(outer))
            shaping.CreateShapingConeSoftnessAttr(1 - min(inner / max(outer, 1e-9), 1.0))
        made.GetPrim().SetDisplayName(light.name)
        UsdGeom.Xformable(made).AddTransformOp().Set(Gf.Matrix4d(light.pose.T.tolist()))

    def camera(
        self, name: str, camera: Camera, clipped: tuple[float, float], metres: float
    ) -> None:
        """Add a camera: USD's look along -z, as those of a data set.

        Args:
            name: of its view.
            camera: the camera.
            clipped: what is nearer and farther, world units.
            metres: of a unit.
        """
        from pxr import Gf, UsdGeom

        made = UsdGeom.Camera.Define(self._stage, self.path("cameras", name))
        made.GetPrim().SetDisplayName(name)
        across = 10 * _FILM / metres  # lengths of film are tenths of units
        focal = across * camera.fl_x / camera.width
        x, y = focal / camera.fl_x, focal / camera.fl_y  # of a pixel
        made.CreateFocalLengthAttr(focal)
        made.CreateHorizontalApertureAttr(x * camera.width)
        made.CreateVerticalApertureAttr(y * camera.height)
        made.CreateHorizontalApertureOffsetAttr(x * (camera.width / 2 - camera.cx))
        made.CreateVerticalApertureOffsetAttr(y * (camera.cy - camera.height / 2))
        made.CreateClippingRangeAttr(Gf.Vec2f(*clipped))
        made.AddTransformOp().Set(Gf.Matrix4d(camera.to_world.T.tolist()))

    def _material(self, name: str) -> tuple[Any, Any]:
        """A material and its surface shader."""
        from pxr import Sdf, UsdShade

        material = UsdShade.Material.Define(self._stage, self.path("materials", name))
        material.GetPrim().SetDisplayName(name)
        surface = UsdShade.Shader.Define(self._stage, material.GetPath().AppendChild("surface"))
        surface.CreateIdAttr("UsdPreviewSurface")
        output = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(output)
        return material, surface
