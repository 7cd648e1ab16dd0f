"""A run as one object, for scripts and notebooks."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, final

import drjit as dr
import mitsuba as mi
import numpy as np

from .config import FitConfig
from .config.light import LightConfig
from .dataset.camera import Camera
from .dataset.views import Dataset, View
from .errors import UserError, named, printable
from .evaluation import evaluate, rendering, renderings
from .evaluation.settings import EvaluationSettings, RenderSettings
from .exports.bake import Baker
from .exports.export import DEFAULT_FORMATS, export
from .exports.observed import Views, training_views
from .exports.parts import Part, read_parts
from .exports.unwrap import LARGEST, Placed
from .fields.materials import Materials
from .quantities import QUANTITIES
from .report.page import write_report
from .training.recovered import Recovered, load_run
from .training.run_folder import RunFolder
from .transport.render import render_materials

#: Names that a message lists.
_NAMED = 6
#: What scores are of, by their key in `metrics.json`.
_ROWS = {"heldout": "held-out views", "train": "training views"}
#: What held-out scores are measured by; see `evaluation/yardsticks.py`.
_YARDSTICKS = {"ceiling": "ceiling of the fields", "untrained": "untrained fields"}


@final
class Run:
    """A fit that is finished or still running. Nothing is loaded before it is needed.

        run = unbake.Run("run")
        picture = run.render(run.cameras("heldout")[0], spp=256)

    Files are read anew with each use, but for the data set and the newest checkpoint: those are
    read once. Make another `Run` to see a later checkpoint.

    Args:
        path: folder of a fit.
        allow_outside: read files of the data set and its scene that lie outside of its folder.

    Raises:
        UserError: the folder holds no run.
    """

    def __init__(self, path: str | Path, *, allow_outside: bool = False) -> None:
        self.folder = RunFolder(Path(path))
        self.folder.require_fitted()
        self._allow_outside = allow_outside

    @property
    def path(self) -> Path:
        """The folder."""
        return self.folder.path

    @property
    def settings(self) -> FitConfig:
        """The settings of the fit; errors as in `RunFolder.settings`."""
        return self.folder.settings()

    @property
    def metrics(self) -> dict[str, Any]:
        """The numbers of the newest evaluation; errors as in `RunFolder.metrics`."""
        return self.folder.metrics()

    @property
    def log(self) -> list[dict[str, Any]]:
        """Losses and scores over time, a line every few steps; errors as in `RunFolder.log`."""
        return self.folder.log()

    @cached_property
    def dataset(self) -> Dataset:
        """The data set that the run was fit to; errors as in `load_run`."""
        loaded = self.__dict__.get("recovered")
        if loaded is not None:
            return loaded.dataset
        data = self.folder.data(self.folder.origin().data)
        return Dataset.load(data, allow_outside=self._allow_outside)

    @cached_property
    def recovered(self) -> Recovered:
        """The recovered scene of the newest checkpoint; see `load_run`."""
        return load_run(self.path, allow_outside=self._allow_outside)

    @property
    def scene(self) -> mi.Scene:
        """The recovered scene, which Mitsuba's integrators render as it is; see `load_run`."""
        return self.recovered.problem.scene_view.scene

    def cameras(self, split: str | None = None) -> list[Camera]:
        """The cameras of the data set, as it tells them.

        `render` takes a view, or its name, for its camera as the fit found it.

        Args:
            split: "train" or "heldout"; None: all.

        Raises:
            UserError: there is no such split, or the data set cannot be read.
        """
        if split not in (None, "train", "heldout"):
            what = f"unknown split {printable(split)!r}"
            raise UserError(what, None, "The splits are 'train' and 'heldout'")
        return [view.camera for view in self.dataset.views if split in (None, view.split)]

    def render(
        self,
        camera: Camera | View | str,
        *,
        spp: int = 64,
        width: int | None = None,
        height: int | None = None,
        max_depth: int = 48,
        seed: int = 1,
    ) -> np.ndarray:
        """Path trace a picture with what was recovered, with full global illumination.

        Args:
            camera: a camera, a view of the data set, or the name of one. Those of views are as the
                fit found them, where they were unknown.
            spp: samples a pixel.
            width: in pixels; None: the camera's own, or in the proportions of `height`.
            height: in pixels; None: the camera's own, or in the proportions of `width`.
            max_depth: longest light path.
            seed: of all random numbers.

        Returns:
            Linear RGB radiance, float32, (height, width, 3).

        Raises:
            UserError: there is no such view, a number is out of range, or the run cannot be read.

        Paper: Sec. 6.
        """
        settings = RenderSettings(
            spp=spp, width=width, height=height, max_depth=max_depth, seed=seed
        )
        found = self._camera(camera)
        found = found.rescaled(*rendering.picture_size(found, settings))
        problem = self.recovered.problem
        return renderings.render_camera(
            problem.scene_view, found, settings, problem.hide_emitters, seed
        )

    def material(self, mesh: str, uv: np.ndarray) -> dict[str, np.ndarray]:
        """What was recovered at texture coordinates of a mesh.

        Meshes have the names that `export` gives them: those of the scene file, or of their files.
        Coordinates are the mesh's own, as Mitsuba reads them: (0, 0) is the corner of the first
        texel of the first row of an image. Where several triangles share coordinates, one counts.

        Args:
            mesh: its name.
            uv: (n, 2) or (2,).

        Returns:
            By quantity, float32: albedo (n, 3), linear RGB in [0, 1]; others (n,), without units:
            roughness is perceptual (GGX α = roughness²). `on_mesh`, (n,) bool: whether there is
            surface; values are zeros where there is none. `observed`, (n,) bool: whether a training
            view saw it; where none did, the value is a guess of the field.

        Raises:
            UserError: the run recovered no materials, there is no such mesh, it has no texture
                coordinates, its material was known, or the coordinates are not finite or have
                another shape.
        """
        materials = self._materials
        at = _coordinates(uv)
        parts = self._parts
        if mesh not in parts:
            what = f"no mesh named {printable(mesh)!r}"
            raise UserError(what, self.dataset.scene, f"There are {named(list(parts), _NAMED)}")
        part = parts[mesh]
        if not part.is_optimized:
            what = f"the material of {printable(mesh)!r} was known, and is not recovered"
            raise UserError(what, self.dataset.scene, "Give another mesh")
        if part.triangles.uv is None:
            what = f"the mesh {printable(mesh)!r} has no texture coordinates"
            remedy = "`export` unwraps it; `material_along` takes rays"
            raise UserError(what, self.dataset.scene, remedy)
        baker = Baker(materials, {}, self._views)
        values, hit, seen = baker.at(Placed(part, part.triangles, part.triangles.uv), at)
        return values | {"on_mesh": hit, "observed": seen}

    def material_along(
        self, origins: np.ndarray, directions: np.ndarray, *, seed: int = 1
    ) -> dict[str, np.ndarray]:
        """The recovered materials where rays meet surfaces.

        For points on a surface with normals n, start the rays a little above: origins p + ε n,
        directions −n. Cut-outs let rays pass with their transparency. Fields are asked on the
        surfaces of the run's own scene: some depend on more than the position.

        Args:
            origins: (n, 3), world units; (3,) is one for all directions.
            directions: (n, 3), of any length; (3,) is one for all origins.
            seed: of the random numbers of cut-outs.

        Returns:
            By quantity, float32: (n, 3) linear RGB or (n,). `seen`, (n,) bool: whether the ray
            met a surface whose material was unknown, and not through a mirror or glass. The others
            have zeros.

        Raises:
            UserError: the run recovered no materials, or the rays are not finite or have other
                shapes.
        """
        known = self._materials
        o, d = _rays(origins, directions)
        count = len(o)
        start, towards = (mi.Point3f(o.T), mi.Vector3f(d.T))

        def through(lane: mi.UInt32, _: mi.Point2f) -> mi.Ray3f:
            at = dr.gather(mi.Point3f, start, lane)
            return mi.Ray3f(at, dr.gather(mi.Vector3f, towards, lane))

        scene_view = self.recovered.problem.scene_view
        values, coverage = render_materials(scene_view, through, count, 1, seed=seed)
        found = {k: x if QUANTITIES[k].channels == 3 else x[:, 0] for k, x in values.items()}
        return {k: x for k, x in found.items() if k in known} | {"seen": coverage > 0}

    def evaluate(
        self,
        settings: EvaluationSettings | None = None,
        *,
        tell: Callable[[str], None] = print,
    ) -> dict[str, Any]:
        """Render the views and measure them; see `unbake.evaluate`."""
        return evaluate.evaluate(self.path, settings, allow_outside=self._allow_outside, tell=tell)

    def export(
        self,
        out: str | Path,
        formats: str | Collection[str] = DEFAULT_FORMATS,
        *,
        texels: float | None = None,
        max_texture: int = LARGEST,
        metres_per_unit: float = 1.0,
        cameras: bool = True,
        tell: Callable[[str], None] = print,
    ) -> dict[str, Any]:
        """Write textures, glTF, OpenUSD or a scene for Mitsuba; see `unbake.export`.

        Args:
            formats: one, or several.
        """
        return export(
            self.path,
            out,
            formats,
            texels=texels,
            max_texture=max_texture,
            metres_per_unit=metres_per_unit,
            cameras=cameras,
            allow_outside=self._allow_outside,
            tell=tell,
        )

    def relight(
        self,
        out: str | Path,
        light: LightConfig | str | Path,
        settings: RenderSettings | None = None,
        *,
        cameras: str | Path | None = None,
        turntable: int | None = None,
        truth: str | Path | None = None,
        tell: Callable[[str], None] = print,
    ) -> dict[str, Any]:
        """Path trace pictures under another light into a folder; see `unbake.relight`.

        Args:
            light: the file of an environment map, or a light with more to say.
        """
        return rendering.relight(
            self.path,
            out,
            light,
            settings,
            cameras=cameras,
            turntable=turntable,
            truth=truth,
            allow_outside=self._allow_outside,
            tell=tell,
        )

    def report(
        self,
        out: str | Path,
        *,
        exported: Sequence[str | Path] = (),
        relit: Sequence[str | Path] = (),
    ) -> Path:
        """Write the page of an evaluated run; see `unbake.write_report`."""
        return write_report(
            [self.path], out, exported=exported, relit=relit, allow_outside=self._allow_outside
        )

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    def _repr_html_(self) -> str:
        """A table of the scores, which notebooks show."""
        config = self.settings
        told = f"<b>{escape(printable(self.path, 200))}</b>: {config.unknown} by {config.method}"
        if not self.folder.metrics_file.is_file():
            return f"<p>{told}; not evaluated yet</p>"
        metrics = self.metrics
        rows = {_ROWS[key]: metrics.get(key) for key in _ROWS}
        yardsticks = metrics.get("yardsticks") or {}
        rows |= {name: yardsticks.get(key) for key, name in _YARDSTICKS.items()}
        scored = {name: row for name, row in rows.items() if isinstance(row, dict)}
        keys = ["render_psnr", *(f"{name}_psnr" for name in QUANTITIES)]
        keys = [key for key in keys if any(row.get(key) is not None for row in scored.values())]
        titles = ["PSNR, dB", *(key.removesuffix("_psnr") for key in keys)]
        head = "".join(f"<th>{title}</th>" for title in titles)
        body = "".join(
            f"<tr><td>{name}</td>{''.join(_cell(row.get(key)) for key in keys)}</tr>"
            for name, row in scored.items()
        )
        steps = f"{metrics.get('steps', 0):,} steps"
        return f"<p>{told}, {steps}</p><table><tr>{head}</tr>{body}</table>"

    @cached_property
    def _parts(self) -> dict[str, Part]:
        """The parts of the scene as its author gave them, by their names."""
        dataset, pieces = self.dataset, self.recovered.problem.pieces
        return {part.name: part for part in read_parts(dataset.scene, dataset.root, pieces).parts}

    @cached_property
    def _views(self) -> Views:
        """What the training views see of the scene."""
        return training_views(self.recovered)

    @property
    def _materials(self) -> Materials:
        """What was recovered of the materials.

        Raises:
            UserError: the run recovered none.
        """
        found = self.recovered.problem.materials
        if found is None:
            what = f"the run recovered {self.settings.unknown}, and no materials"
            raise UserError(what, self.path, "Give a run of `unbake fit` with --unknown materials")
        return found

    def _camera(self, camera: Camera | View | str) -> Camera:
        if isinstance(camera, Camera):
            return camera
        if isinstance(camera, View):
            return self.recovered.camera(camera)
        by_name: Mapping[str, View] = {view.name: view for view in self.dataset.views}
        if camera not in by_name:
            what = f"no view named {printable(camera)!r}"
            raise UserError(what, self.dataset.folder, f"There are {named(list(by_name), _NAMED)}")
        return self.recovered.camera(by_name[camera])


def _coordinates(uv: np.ndarray) -> np.ndarray:
    """Texture coordinates, (n, 2) float32.

    Raises:
        UserError: there are none, they have another shape, or are not finite.
    """
    remedy = "Give texture coordinates of shape (n, 2)"
    try:
        found = np.atleast_2d(np.asarray(uv, np.float32))
    except (ValueError, TypeError):
        raise UserError("texture coordinates are no array of numbers", None, remedy) from None
    if uv is None or not found.size:
        raise UserError("no texture coordinates are given", None, remedy)
    if found.ndim != 2 or found.shape[1] != 2:
        raise UserError(f"texture coordinates have shape {found.shape}", None, remedy)
    if not np.isfinite(found).all():
        raise UserError("a texture coordinate is not finite", None, "Leave such ones out")
    return found


def _rays(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions, (n, 3) float32 each.

    Raises:
        UserError: there are none, they have other shapes, are not finite, or a direction is zero.
    """
    remedy = "Give origins and directions of shape (n, 3)"
    try:
        o, d = (np.asarray(x, np.float32) for x in (origins, directions))
        if o.ndim == d.ndim == 2 and len(o) != len(d):
            what = f"there are {len(o)} origins and {len(d)} directions"
            raise UserError(what, None, "Give as many of both, or one alone for all, of shape (3,)")
        o, d = np.broadcast_arrays(np.atleast_2d(o), np.atleast_2d(d))
    except (ValueError, TypeError):
        raise UserError(
            "origins and directions are not arrays of like shapes", None, remedy
        ) from None
    if origins is None or directions is None or not o.size:
        raise UserError("no rays are given", None, remedy)
    if o.ndim != 2 or o.shape[1] != 3:
        raise UserError(f"origins and directions have shape {o.shape}", None, remedy)
    length = np.linalg.norm(d, axis=1, keepdims=True)
    if not (np.isfinite(o).all() and np.isfinite(length).all() and (length > 0).all()):
        what = "a ray is not finite, or its direction is zero"
        raise UserError(what, None, "Leave such rays out")
    return o, d / length


def _cell(score: float | None) -> str:
    return f"<td>{'—' if score is None else f'{score:.1f}'}</td>"
