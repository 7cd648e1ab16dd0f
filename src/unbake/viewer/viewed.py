"""What the page shows of a data set or a run: colours on surfaces, pictures of views, the log.

Nothing here knows the page, and nothing is written anywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.camera import Camera
from ..dataset.pixels import CameraRays
from ..dataset.small_views import block_of, small_camera
from ..dataset.views import Dataset, View, read_mask, read_photograph, read_view
from ..errors import UserError
from ..exports.bake import OwnTextures, look_up, own_textures
from ..exports.observed import Views
from ..exports.parts import parsed_principled, read_parts
from ..fields.arrays import from_numpy
from ..fields.materials import Materials
from ..fields.pieces import Pieces, decoded
from ..imaging.pictures import absolute_error, block_means, false_colour, shown, tonemap
from ..quantities import QUANTITIES
from ..training.cameras import Cameras
from ..training.checkpoint import Progress, load_written
from ..training.monitor import loss_terms
from ..training.poses import refined_view
from ..training.recovered import open_run
from ..training.validation import MaterialBuffers
from ..transport.render import render_one_bounce, render_radiance
from .surface import Surface, make_surface

#: What can be shown on surfaces beside quantities.
SHAPE, RADIANCE = "shape", "radiance"
_ERROR = " error"
#: Errors of quantities, and of radiance after the exposure, that are painted brightest.
SCALES = {"quantity": 0.25, "radiance": 0.25}
#: Vertices that are looked up at once, so that one kernel serves all scenes.
_CHUNK = 1 << 16
#: Pixels along the longer edge of pictures, at most; samples a pixel of materials and renderings.
LONGEST, MATERIAL_SPP, SPP = 192, 16, 64
#: Paths of renderings of runs without a radiance field.
_MAX_DEPTH, _RR_DEPTH = 16, 5


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture with what it shows."""

    caption: str
    pixels: np.ndarray  #: (H, W, 3) uint8 sRGB


class ViewedData:
    """A data set: its geometry and photographs, and its materials if it was captured.

    Args:
        folder: the data set's.
        allow_outside: read files that lie outside of it.

    Raises:
        UserError: the data set or its scene cannot be read.
    """

    def __init__(self, folder: Path, *, allow_outside: bool = False) -> None:
        dataset = Dataset.load(folder, allow_outside=allow_outside)
        scene = parsed_principled(dataset.scene, dataset.root).instantiate()
        self._open(dataset, scene)

    def _open(self, dataset: Dataset, scene: mi.Scene, pieces: Pieces | None = None) -> None:
        self.dataset = dataset
        self._scene = scene
        every = read_parts(dataset.scene, dataset.root, pieces).parts
        parts = [part for part in every if part.is_shown]
        cameras, hidden = [view.camera for view in dataset.train], dataset.background == "hidden"
        views = Views(scene, cameras, hide_emitters=hidden)
        self.surface: Surface = make_surface(parts, views)
        self._numbers = sorted({p.materials[0] for p in parts if p.is_optimized})
        self._own = self._own_textures()
        #: Whether the scene's own materials are those that the photographs were rendered with.
        self.has_true_materials = dataset.has_true_materials and self._own is not None

    def _own_textures(self) -> OwnTextures | None:
        parsed = parsed_principled(self.dataset.scene, self.dataset.root)
        try:
            return own_textures(parsed, ())
        except UserError:  # values stored in meshes: there is nothing to compare with
            return None

    # ------------------------------------------------------------------------- on surfaces

    def choices(self) -> dict[str, str]:
        """What `colours` can show, with titles; the first is shown first."""
        found = {}
        if self.has_true_materials:
            found = {name: f"{q.title} (true)" for name, q in QUANTITIES.items()}
        return {SHAPE: "Shape"} | found

    def colours(self, choice: str, eye: np.ndarray, exposure: float = 0.0) -> np.ndarray:
        """Colours at the vertices of the surface.

        Args:
            choice: of `choices`.
            eye: (3,) world units, from where radiance is seen.
            exposure: of radiance, in stops.

        Returns:
            (n, 3) uint8 sRGB.
        """
        surface = self.surface
        if choice == SHAPE:
            return _shaded(surface)
        colours = _shaded(surface, surface.plain)
        colours[surface.optimized] = self._values(choice, eye, exposure)[surface.optimized]
        return colours

    def _values(self, choice: str, eye: np.ndarray, exposure: float) -> np.ndarray:
        values = self._looked_up(None)[choice]
        return shown(values[:, None], QUANTITIES[choice].display)[:, 0]

    def _looked_up(self, materials: Materials | None) -> dict[str, np.ndarray]:
        """All quantities at vertices, (n, channels) float32, linear.

        Args:
            materials: those that were recovered; None: the scene's own are all there is.
        """
        surface = self.surface
        own, numbers = self._own or {}, self._numbers if self._own else []
        found: dict[str, list[np.ndarray]] = {name: [] for name in QUANTITIES}
        for part in _chunks(len(surface.positions)):
            si = dr.zeros(mi.SurfaceInteraction3f, _CHUNK)
            si.p = mi.Point3f(_columns(surface.positions, part))
            si.n = mi.Normal3f(_columns(surface.normals, part))
            si.uv = mi.Point2f(_columns(surface.uv, part))
            number = from_numpy(mi.UInt32, surface.materials[part])
            piece = None
            if surface.pieces is not None:
                info = mi.Color3f(_columns(surface.pieces, part))
                piece = decoded(info, mi.Bool(True))
            values = look_up(materials, own, numbers, si, number, piece, mi.Bool(True))
            dr.eval(values)
            for name, channels in values.items():
                rows = [np.broadcast_to(np.array(c), _CHUNK) for c in channels]
                found[name].append(np.stack(rows, -1))
        return {k: np.concatenate(v)[: len(surface.positions)] for k, v in found.items()}

    # --------------------------------------------------------------------------- of views

    def pictures(self, view: View, choice: str, exposure: float = 0.0) -> list[list[Picture]]:
        """Pictures of a view, row by row: the photograph, and what belongs to it.

        Args:
            view: of the data set.
            choice: of `choices`; its true map is shown, where there is one.
            exposure: of photographs, in stops.

        Raises:
            UserError: an image cannot be read.
        """
        photograph, _, _ = _small_photograph(view)
        row = [Picture("photograph", tonemap(photograph, exposure))]
        if choice in view.truth:
            truth, _ = _small(_truth(view, choice), view.camera)
            row.append(Picture(f"true {choice}", shown(truth, QUANTITIES[choice].display)))
        return [row]

    def told(self) -> dict[str, str]:
        """Facts about what is shown, by their names."""
        data = self.dataset
        return {
            "data set": data.folder.resolve().name,
            "views": f"{len(data.train)} training, {len(data.heldout)} held-out",
            "true materials": "known" if self.has_true_materials else "not known",
        }

    def overview(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """A place to look at the whole scene from, what to look at, up, and the diagonal."""
        positions = self.surface.positions.astype(np.float64)
        low, high = positions.min(0), positions.max(0)
        diagonal, centre = float(np.linalg.norm(high - low)), (low + high) / 2
        poses = np.stack([view.camera.to_world for view in self.dataset.train])
        mean = poses[:, :3, 1].mean(0)
        up = np.zeros(3)
        axis = int(np.argmax(np.abs(mean)))
        up[axis] = 1.0 if mean[axis] >= 0 else -1.0
        aside = (poses[:, :3, 3] - centre).mean(0)
        aside -= (aside @ up) * up
        if np.linalg.norm(aside) < 0.05 * diagonal:  # cameras all around
            aside = np.roll(up, 1) + 0.5 * np.roll(up, 2)
        direction = aside / np.linalg.norm(aside) + 0.75 * up
        eye = centre + diagonal * direction / np.linalg.norm(direction)
        return eye, centre, up, diagonal


class ViewedRun(ViewedData):
    """A run, which may still be going on: what it has recovered so far.

    It is read alone: neither is its lock taken, nor is anything in its folder changed.

    Args:
        folder: of a fit.
        allow_outside: read files of the data set and its scene that lie outside of its folder.

    Raises:
        UserError: the folder holds no run, or its data set is gone.
    """

    def __init__(self, folder: Path, *, allow_outside: bool = False) -> None:
        self._run = open_run(folder, allow_outside=allow_outside)
        #: How far the checkpoint that is shown has come; None: none was read yet.
        self.progress: Progress | None = None
        self._problem = self._run.problem
        #: That checkpoint.
        self.shown: Path | None = None
        self._open(self._run.dataset, self._problem.scene_view.scene, self._problem.pieces)
        self._found: dict[str, np.ndarray] | None = None
        self._log: dict[str, str] = {}
        self._log_state = (-1, -1)  # its size and the time of its last change

    def checkpoints(self) -> list[Path]:
        """The checkpoints that there are now, the oldest first, whole or not."""
        try:
            return self._run.folder.written_checkpoints()[::-1]
        except OSError:  # one was deleted meanwhile
            return []

    def turn_to(self, checkpoint: Path) -> bool:
        """Show what a checkpoint holds; whether it is another one than before.

        Nothing changes if it cannot be read now.

        Raises:
            UserError: it does not fit the settings, or was written by a newer version.
        """
        if checkpoint == self.shown:
            return False
        progress = load_written(self._run.folder, self._run.state, checkpoint)
        if progress is None:
            return False
        self._run.state.publish(self._problem)
        self.progress, self.shown, self._found = progress, checkpoint, None
        return True

    def follow(self) -> bool:
        """Show the newest checkpoint that can be read; whether it is another one than before.

        Raises:
            UserError: as of `turn_to`.
        """
        for checkpoint in reversed(self.checkpoints()):
            if checkpoint == self.shown:
                return False
            if self.turn_to(checkpoint):
                return True
        return False

    # ------------------------------------------------------------------------- on surfaces

    def choices(self) -> dict[str, str]:
        """What `colours` can show, with titles; see `ViewedData.choices`."""
        learned = list(self._problem.materials or ())
        found = {name: QUANTITIES[name].title for name in learned}
        if self._problem.radiance is not None:
            found[RADIANCE] = "Radiance L_θ, seen from here"
        if self.has_true_materials:
            found |= {name + _ERROR: f"{QUANTITIES[name].title}: error" for name in learned}
        return found | {SHAPE: "Shape"}

    def _values(self, choice: str, eye: np.ndarray, exposure: float) -> np.ndarray:
        found = self._recovered()
        if choice == RADIANCE:
            return tonemap(self._radiance(found["albedo"], eye), exposure)
        if choice.endswith(_ERROR):
            name = choice.removesuffix(_ERROR)
            error = np.abs(found[name] - self._looked_up(None)[name]).mean(1)
            return false_colour(error[:, None], SCALES["quantity"])[:, 0]
        return shown(found[choice][:, None], QUANTITIES[choice].display)[:, 0]

    def _recovered(self) -> dict[str, np.ndarray]:
        if self._found is None:
            self._found = self._looked_up(self._problem.materials)
        return self._found

    def _radiance(self, albedo: np.ndarray, eye: np.ndarray) -> np.ndarray:
        """L_θ at vertices towards a point, (n, 3) float32, linear."""
        radiance, surface = self._problem.radiance, self.surface
        assert radiance is not None
        found = []
        origin = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in eye))
        for part in _chunks(len(surface.positions)):
            p = mi.Point3f(_columns(surface.positions, part))
            n = mi.Normal3f(_columns(surface.normals, part))
            w = dr.normalize(origin - p)
            n = dr.select(dr.dot(n, w) < 0, -n, n)
            colour = mi.Color3f(_columns(albedo, part))
            value = radiance.evaluate(p, mi.Vector3f(w), n, colour, mi.Bool(True))
            found.append(np.array(value).T)
        return np.concatenate(found)[: len(surface.positions)]

    # --------------------------------------------------------------------------- of views

    def pictures(self, view: View, choice: str, exposure: float = 0.0) -> list[list[Picture]]:
        """Pictures of a view: photograph, rendering and error; truth, what was recovered, error.

        See `ViewedData.pictures`. What is rendered is at most `LONGEST` pixels wide and high.
        """
        view = refined_view(self._problem.poses, self._run.dataset.train, view)
        photograph, counted, camera = _small_photograph(view)
        first = [Picture("photograph", tonemap(photograph, exposure))]
        if self.progress is None:
            return [first]
        image, how = self._rendered(camera)
        cameras = Cameras(self._problem.camera, self._run.dataset.train)
        dimmed = cameras.dimmed(replace(view, camera=camera), image)
        told = counted if counted.any() else np.ones_like(counted)
        image = cameras.photographed(
            view, dimmed, cameras.gain(view, dimmed[told], photograph[told])
        )
        gain = 2.0**exposure
        compared = view.readable(photograph)
        error = absolute_error(image.clip(0, 1 / gain), compared.clip(0, 1 / gain)) * gain
        first.append(Picture(how, tonemap(image, exposure)))
        first.append(
            Picture(_error_to("radiance"), false_colour(error, SCALES["radiance"], counted))
        )
        name = choice.removesuffix(_ERROR)
        if name not in (self._problem.materials or ()):
            return [first]
        (seen,) = MaterialBuffers.of(self._problem, [replace(view, camera=camera)], MATERIAL_SPP, 0)
        display = QUANTITIES[name].display
        second = [Picture(f"recovered {name}", shown(seen.values[name], display))]
        if name in view.truth:
            truth, _ = _small(_truth(view, name), view.camera)
            error = absolute_error(seen.values[name], truth)
            known = (seen.coverage >= 1) & _small_mask(view)
            second.insert(0, Picture(f"true {name}", shown(truth, display)))
            second.append(
                Picture(_error_to("quantity"), false_colour(error, SCALES["quantity"], known))
            )
        return [first, second]

    def _rendered(self, camera: Camera) -> tuple[np.ndarray, str]:
        """A rendering (H, W, 3), linear, and how it was made."""
        problem, rays = self._problem, CameraRays.of([camera])
        shape = (camera.height, camera.width, 3)
        if problem.radiance is None:
            image = render_radiance(
                problem.scene_view, rays.through, rays.pixels, SPP, seed=0,
                max_depth=_MAX_DEPTH, rr_depth=_RR_DEPTH, hide_emitters=problem.hide_emitters,
            )  # fmt: skip
            return image.reshape(shape), "path traced"
        image = render_one_bounce(
            problem.scene_view, problem.radiance, rays.through, rays.pixels, SPP, seed=0,
            hide_emitters=problem.hide_emitters,
        )  # fmt: skip
        return image.reshape(shape), "one bounce"

    # ---------------------------------------------------------------------------- the log

    def told(self) -> dict[str, str]:
        """Facts about the run and its settings, by their names."""
        config = self._run.config
        facts = {"run": self._run.folder.path.resolve().name}
        facts |= {"unknown": config.unknown, "method": config.method}
        if self.progress is None:
            return facts | {"checkpoint": "none yet"}
        step, seconds = self.progress.step, self.progress.seconds
        return facts | {"checkpoint": f"step {step}, {seconds:.0f} s of training"}

    def log(self) -> dict[str, str]:
        """The end of the log by name: where the fit is, terms of the loss, validation.

        Empty where there is no log yet; an entry `log` says why it cannot be read.
        """
        try:
            about = self._run.folder.log_file.stat()
        except OSError:
            return {}
        if (about.st_size, about.st_mtime_ns) != self._log_state:
            self._log_state = about.st_size, about.st_mtime_ns
            try:
                self._log = log_tail(self._run.folder.log())
            except UserError as error:
                self._log = {"log": str(error)}
        return self._log


def log_tail(lines: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The newest numbers of a log's lines, as texts by name."""
    told: dict[str, str] = {}
    losses = [line for line in lines if "samples_per_second" in line or "learning_rate" in line]
    if lines:
        newest = lines[-1]
        told["step"] = f"{newest.get('step', 0):.0f}"
        told["seconds"] = f"{newest.get('seconds', 0.0):.0f}"
    if losses:
        newest = losses[-1]
        if newest.get("samples_per_second"):
            told["samples / s"] = f"{newest['samples_per_second']:,.0f}"
        if skipped := sum(line.get("skipped", 0) for line in losses):
            told["skipped steps"] = f"{skipped:.0f}"
        for name in loss_terms(newest):
            told[f"loss: {name}"] = f"{newest[name]:.4f}"
    for key in ("validation", "score"):
        scores = next((line[key] for line in reversed(lines) if key in line), {})
        for name, value in scores.items():
            if name.endswith("_psnr") and value is not None:
                told[f"{key}: {name.removesuffix('_psnr')}"] = f"{value:.2f} dB"
    note = next((line["note"] for line in reversed(lines) if "note" in line), None)
    return told if note is None else told | {"note": note}


# ------------------------------------------------------------------------------------- pictures


def _shaded(surface: Surface, colours: np.ndarray | None = None) -> np.ndarray:
    """Colours at vertices by how surfaces lie, so that edges can be seen, (n, 3) uint8."""
    towards = np.array([0.48, 0.64, 0.6])
    light = 0.55 + 0.45 * np.abs(surface.normals @ towards)
    base = np.full((len(light), 3), 200.0) if colours is None else colours
    return np.round(base * light[:, None]).astype(np.uint8)


def _error_to(what: str) -> str:
    return f"error, 0 to {SCALES[what]:g}"


def _small_photograph(view: View) -> tuple[np.ndarray, np.ndarray, Camera]:
    """A photograph (H, W, 3), pixels that are neither masked nor transparent, and its camera."""
    pixels, camera = _small(read_photograph(view, clip_negative=True), view.camera)
    return pixels[..., :3], pixels[..., 3] >= 1, camera


def _small_mask(view: View) -> np.ndarray:
    """Pixels of a small picture none of whose parts are masked, (H, W) bool."""
    counted = read_mask(view)
    if counted is None:
        counted = np.ones((view.camera.height, view.camera.width), bool)
    return _small(counted, view.camera)[0] >= 1


def _truth(view: View, name: str) -> np.ndarray:
    return read_view(view.truth[name], view)[..., : QUANTITIES[name].channels]


def _small(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """An image of `LONGEST` pixels a side at most, and its camera."""
    return block_means(image, block_of(camera, LONGEST)), small_camera(camera, LONGEST)


def _chunks(count: int) -> list[np.ndarray]:
    """Numbers of vertices in runs of equal length; the last is filled up with its last one."""
    starts = range(0, count, _CHUNK)
    return [np.minimum(np.arange(first, first + _CHUNK), count - 1) for first in starts]


def _columns(values: np.ndarray, part: np.ndarray) -> list[mi.Float]:
    return [from_numpy(mi.Float, column) for column in values[part].T]
