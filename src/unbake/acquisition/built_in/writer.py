"""Writes the parts of a built-in scene as a self-contained Mitsuba scene.

The XML is our own because `mi.parser.write_file` of Mitsuba 3.9.1 loses the ids of shapes and
emitters: it writes ids only of nodes that others refer to. Emitters are known by those ids.
"""

from __future__ import annotations

from pathlib import Path
from typing import final
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

from .cameras import Camera
from .meshes import Mesh

VERSION = "3.0.0"


@final
class SceneWriter:
    """Collects a scene, then writes `scene.xml` beside the folders `meshes` and `textures`.

    All colours are linear RGB, all paths in the scene file relative to it.
    """

    def __init__(self, folder: Path, camera: Camera, *, max_depth: int) -> None:
        self._folder = Path(folder)
        self._root = ElementTree.Element("scene", version=VERSION)
        integrator = self._add(self._root, "integrator", type="path")
        self._add(integrator, "integer", name="max_depth", value=str(max_depth))
        # Russian roulette saves little in bright rooms and costs a tenth of the standard deviation.
        self._add(integrator, "integer", name="rr_depth", value=str(max_depth))
        self._write_sensor(camera)

    def save(self) -> Path:
        """Write `scene.xml` and return its path."""
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / "scene.xml"
        ElementTree.indent(self._root, space="    ")
        ElementTree.ElementTree(self._root).write(path, encoding="utf-8", xml_declaration=True)
        return path

    def painted(self, name: str, base_color: np.ndarray, roughness: np.ndarray) -> str:
        """A `principled` material with textures: base_color (h, w, 3), roughness (h, w).

        Roughness from 0.15 to 0.9 is mapped to 0.175 to 0.55, that of lacquer: photographs do not
        distinguish 0.7 from 0.9.
        """
        roughness = 0.1 + 0.5 * roughness
        bsdf = self._principled(name)
        self._bitmap(bsdf, "base_color", self._texture(f"{name}_base_color", base_color))
        self._bitmap(bsdf, "roughness", self._texture(f"{name}_roughness", roughness))
        return name

    def plain(self, name: str, base_color: tuple[float, float, float], roughness: float) -> str:
        """A `principled` material of one colour and one roughness."""
        bsdf = self._principled(name)
        self._add(bsdf, "rgb", name="base_color", value=_numbers(base_color))
        self._add(bsdf, "float", name="roughness", value=_numbers([roughness]))
        return name

    def diffuse(self, name: str, albedo: float) -> str:
        """A Lambertian material; `principled` at roughness 1 is not Lambertian."""
        bsdf = self._add(self._root, "bsdf", type="diffuse", id=name)
        self._add(bsdf, "rgb", name="reflectance", value=_numbers([albedo] * 3))
        return name

    def mirror(self, name: str) -> str:
        """A perfect mirror."""
        bsdf = self._add(self._root, "bsdf", type="conductor", id=name)
        self._add(bsdf, "string", name="material", value="none")
        return name

    def mesh(self, name: str, mesh: Mesh, bsdf: str, emission: tuple | None = None) -> None:
        """A mesh with a material, an area emitter if `emission` (linear RGB radiance) is given."""
        path = self._subfolder("meshes") / f"{name}.ply"
        mesh.write(path)
        shape = self._add(self._root, "shape", type="ply", id=f"{name}_shape")
        self._add(shape, "string", name="filename", value=f"meshes/{path.name}")
        if mesh.normals is None:
            self._add(shape, "boolean", name="face_normals", value="true")
        self._add(shape, "ref", name="bsdf", id=bsdf)
        if emission is not None:
            emitter = self._add(shape, "emitter", type="area")
            self._add(emitter, "rgb", name="radiance", value=_numbers(emission))

    def environment(self, name: str, radiance: np.ndarray) -> None:
        """An environment map from latitude-longitude radiance, (h, 2 h, 3), z up."""
        emitter = self._add(self._root, "emitter", type="envmap", id=name)
        self._add(emitter, "string", name="filename", value=self._texture(name, radiance))
        transform = self._add(emitter, "transform", name="to_world")
        self._add(transform, "rotate", x="1", angle="90")

    def _principled(self, name: str) -> ElementTree.Element:
        bsdf = self._add(self._root, "bsdf", type="principled", id=name)
        # Varnished (F0 = 0.08): under diffuse illumination roughness has little effect otherwise.
        self._add(bsdf, "float", name="specular", value="1.0")
        # By default half of all samples go to the specular lobe, which carries a few per cent of
        # the light: the weights of long diffuse paths then grow as 2^bounces.
        self._add(bsdf, "float", name="main_specular_sampling_rate", value="0.2")
        return bsdf

    def _write_sensor(self, camera: Camera) -> None:
        sensor = self._add(self._root, "sensor", type="perspective")
        self._add(sensor, "float", name="fov", value=_numbers([camera["fov"]]))
        transform = self._add(sensor, "transform", name="to_world")
        axes = {key: _numbers(camera[key]) for key in ("origin", "target", "up")}
        self._add(transform, "lookat", **axes)
        film = self._add(sensor, "film", type="hdrfilm")
        self._add(film, "integer", name="width", value="256")
        self._add(film, "integer", name="height", value="256")
        self._add(film, "rfilter", type="box")
        sampler = self._add(sensor, "sampler", type="independent")
        self._add(sampler, "integer", name="sample_count", value="64")

    def _texture(self, name: str, values: np.ndarray) -> str:
        path = self._subfolder("textures") / f"{name}.exr"
        # Half precision suffices: ground truth is rendered from these files.
        mi.Bitmap(np.ascontiguousarray(values, dtype=np.float16)).write(str(path))
        return f"textures/{path.name}"

    def _bitmap(self, bsdf: ElementTree.Element, name: str, filename: str) -> None:
        texture = self._add(bsdf, "texture", type="bitmap", name=name)
        self._add(texture, "string", name="filename", value=filename)
        self._add(texture, "boolean", name="raw", value="true")
        self._add(texture, "string", name="wrap_mode", value="mirror")

    def _subfolder(self, name: str) -> Path:
        path = self._folder / name
        path.mkdir(parents=True, exist_ok=True)
        return path

    @staticmethod
    def _add(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
        return ElementTree.SubElement(parent, tag, attributes)


def _numbers(values) -> str:
    return ", ".join(f"{v:.6g}" for v in values)
