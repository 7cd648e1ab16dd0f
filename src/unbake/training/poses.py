"""What is unknown of where cameras stood: small corrections of poses and intrinsics (ours).

A pose P is corrected in the camera's own axes, and its intrinsics in pixels:

    P' = P [R(ω) t],    fl' = fl (1 + s), cx' = cx + a, cy' = cy + b

Camera rays are shot by the present corrections, so that their hits are where they belong. What a
pixel shows follows its camera in a way that no derivative of a ray tells: where geometry has an
edge, it jumps. So gradients go another way. A point X that the centre of a pixel sees lies at the
place π(X) in the photograph, which moves with the correction. The photograph P is read there, to
first order:

    P(u + π(X) − u) ≈ P(u) + ∇P(u) · (π(X) − u)

π(X) − u is zero, and its derivative is that of the projection of a fixed point: geometry need not
be differentiable. ∇P is of the photograph, whose noise is not that of the rendering.

What decides where photographs do not: corrections are small, as the uncertainty of the poses says
(`prior`). It weighs as in a maximum a posteriori estimate if each pixel was an observation of its
own, with the error that the fit leaves. Geometry is known, so that nothing else need be fixed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.camera import Camera
from ..dataset.pixels import CameraRays, PixelBatch, RayBatch
from ..dataset.small_views import seen_by, small_camera
from ..dataset.views import View
from ..fields.arrays import from_numpy, read_small
from ..scene.free_space import bounds
from ..transport.loss import as_weight

#: Numbers of a pose and of intrinsics: turn and shift along x, y and z; focal length, cx, cy.
POSE, LENS = 6, 3
#: Distance of what no surface is seen at, in diagonals of the scene.
_FAR = 1e3


@dataclass
class PoseUnits:
    """What corrections of one pixel are; a PyTree, which frozen functions take as an argument."""

    sizes: mi.Float  # radians, world units, and half the width of the image, of each view
    lens: mi.UInt32  # number of the intrinsics of each view


@final
class PoseModel:
    """Unknown corrections of the poses and intrinsics of training views.

    All are in pixels: a turn or shift of 1 moves what lies in the middle of the image, at the
    median distance that the view sees, by a pixel (one along or about the optical axis moves
    what is at a focal length from the middle so much); a focal length of 1 moves the edge.
    Views of the same intrinsics share their corrections.

    Args:
        cameras: of the training views, as the data set tells.
        distances: median distance that each sees, world units, shape (views,).
        far: a distance beyond the scene, world units.
        poses: whether poses are unknown.
        intrinsics: whether intrinsics are unknown.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        distances: np.ndarray,
        far: float,
        *,
        poses: bool = True,
        intrinsics: bool = False,
    ) -> None:
        self.given = tuple(cameras)
        self._far = far
        lenses = [(c.fl_x, c.fl_y, c.cx, c.cy, c.width, c.height) for c in cameras]
        self._lenses = list(dict.fromkeys(lenses))
        self._lens_of = [self._lenses.index(lens) for lens in lenses]
        # World units and radians of a correction of one pixel
        self._turns, self._shifts = _units(cameras, distances)
        sizes = {
            "poses.moves": POSE * len(cameras) * poses,
            "intrinsics.moves": LENS * len(self._lenses) * intrinsics,
        }
        self._arrays = {key: dr.zeros(mi.Float, size) for key, size in sizes.items() if size}
        widths = [c.width / 2 for c in cameras]
        self.units = PoseUnits(
            from_numpy(mi.Float, np.stack([self._turns, self._shifts, widths], 1)),
            from_numpy(mi.UInt32, np.array(self._lens_of)),
        )
        dr.make_opaque(self._arrays)

    @classmethod
    def of(
        cls, scene: mi.Scene, cameras: Sequence[Camera], *, poses: bool, intrinsics: bool
    ) -> PoseModel:
        """Corrections of cameras that look at a scene."""
        far = _FAR * bounds(scene)[2]
        distances = _distances(scene, cameras)
        return cls(cameras, distances, far, poses=poses, intrinsics=intrinsics)

    @property
    def has_poses(self) -> bool:
        """Whether poses are unknown."""
        return "poses.moves" in self._arrays

    def parameters(self) -> dict[str, mi.Float]:
        """The trainable arrays; `assign` takes them back."""
        return dict(self._arrays)

    def assign(self, parameters: Mapping[str, Any]) -> None:
        """Use these arrays from now on; gradients arrive in the arrays given."""
        self._arrays = {key: parameters[key] for key in self._arrays}

    # ---------------------------------------------------------------------------- in a step

    def placed(self, rays: CameraRays, units: PoseUnits | None = None) -> CameraRays:
        """Rays with corrected cameras, which pass gradients.

        Args:
            rays: through the training views, and maybe others after them, which stay as they are.
            units: `self.units`, as a frozen function was given them; None: those themselves.
        """
        units = units or self.units
        view = dr.arange(mi.UInt32, rays.views)
        known = view < len(self.given)
        turn, shift, half = (read_small(units.sizes, 3 * view + i, known) for i in range(3))
        pose, lens = rays.pose, rays.lens
        if self.has_poses:
            array = self._arrays["poses.moves"]
            move = [read_small(array, POSE * view + i, known) for i in range(POSE)]
            h = mi.Vector3f(move[:3]) * (0.5 * turn)
            moved = mi.Vector3f(move[3:]) * shift
            old = [read_small(pose, 12 * view + i) for i in range(12)]
            # The rotation of the quaternion (1, h): that about 2h, to first order
            scale = 2 / (1 + dr.squared_norm(h))
            entries = []
            for row in range(3):
                axes = mi.Vector3f(old[4 * row : 4 * row + 3])
                # (I + s [h]ₓ + s [h]ₓ²)ᵀ applied to a row: [h]ₓᵀ v = v × h
                once = dr.cross(axes, h)
                turned = axes + scale * (once + dr.cross(once, h))
                entries += [*turned, old[4 * row + 3] + dr.dot(axes, moved)]
            pose = dr.ravel(mi.ArrayXf(entries))
        if "intrinsics.moves" in self._arrays:
            array = self._arrays["intrinsics.moves"]
            which = dr.gather(mi.UInt32, units.lens, view, known)
            longer, x, y = (read_small(array, LENS * which + i, known) for i in range(LENS))
            fx, fy, cx, cy = (read_small(lens, 4 * view + i) for i in range(4))
            factor = 1 + dr.select(known, longer / half, 0)
            lens = dr.ravel(mi.ArrayXf([fx * factor, fy * factor, cx + x, cy + y]))
        dr.eval(pose, lens)
        return replace(rays, pose=pose, lens=lens)

    def target(
        self, scene: mi.Scene, placed: CameraRays, pixels: PixelBatch, batch: RayBatch
    ) -> mi.Color3f:
        """The photographs of pixels where their cameras now see them: gradients reach corrections.

        Args:
            placed: from `placed`.
            pixels: with the slopes of photographs.
            batch: of these.
        """
        assert batch.slopes is not None
        number = pixels.numbers()
        with dr.suspend_grad():
            ray = dr.detach(placed).through(number, mi.Point2f(0.5))
            hit = scene.ray_intersect_preliminary(ray)
            point = ray(dr.select(hit.is_valid(), hit.t, self._far))
        place = placed.project(number, dr.detach(point))
        shift = place - dr.detach(place)
        across, down = batch.slopes
        return batch.target + across * shift.x + down * shift.y

    def prior(self, sigma: float, photometric: mi.Float | None, pixels: int) -> mi.Float:
        """How unlikely the corrections are.

        Args:
            sigma: standard deviation of each correction, in pixels.
            photometric: the photometric loss, whose expectation is the variance of a pixel; None:
                the method has none, and the variance is that of black pictures, 1.
            pixels: that there are to train on.
        """
        variance = mi.Float(1) if photometric is None else as_weight(photometric, 0, 1)
        squares = [dr.sum(dr.square(array)) for array in self._arrays.values()]
        return variance / (pixels * sigma**2) * sum(squares)

    # ----------------------------------------------------------------------------- as numbers

    def cameras(self) -> list[Camera]:
        """The corrected cameras of the training views."""
        moves, lenses = self._moves(), self._lens_moves()
        return [self._corrected(i, move, lenses) for i, move in enumerate(moves)]

    def camera(self, number: int) -> Camera:
        """The corrected camera of one training view."""
        return self._corrected(number, self._moves()[number], self._lens_moves())

    def intrinsics(self) -> list[tuple[Camera, Camera]]:
        """A camera as the data set tells and as it was found, for each of the intrinsics."""
        firsts = [self._lens_of.index(number) for number in range(len(self._lenses))]
        cameras = self.cameras()
        return [(self.given[i], cameras[i]) for i in firsts]

    def lens(self, camera: Camera) -> Camera:
        """Another camera with corrected intrinsics, if it has those of training views."""
        own = (camera.fl_x, camera.fl_y, camera.cx, camera.cy, camera.width, camera.height)
        if own not in self._lenses:
            return camera
        return _with_lens(camera, self._lens_moves()[self._lenses.index(own)])

    def units_of(self, scene: mi.Scene, camera: Camera) -> tuple[float, float]:
        """What corrections of one pixel are of a camera: radians and world units."""
        turns, shifts = _units([camera], _distances(scene, [camera]))
        return float(turns[0]), float(shifts[0])

    def _corrected(self, number: int, move: np.ndarray, lenses: np.ndarray) -> Camera:
        camera = self.given[number]
        turn, shift = self._turns[number], self._shifts[number]
        moved = camera.moved(turn * move[:3], shift * move[3:])
        return _with_lens(moved, lenses[self._lens_of[number]])

    def _moves(self) -> np.ndarray:
        if not self.has_poses:
            return np.zeros((len(self.given), POSE))
        return self._array("poses.moves").reshape(-1, POSE)

    def _lens_moves(self) -> np.ndarray:
        if "intrinsics.moves" not in self._arrays:
            return np.zeros((len(self._lenses), LENS))
        return self._array("intrinsics.moves").reshape(-1, LENS)

    def _array(self, key: str) -> np.ndarray:
        return np.array(dr.detach(self._arrays[key]), np.float64)


def refined_view(model: PoseModel | None, train: Sequence[View], view: View) -> View:
    """A view with what a fit found of its camera: as it is where nothing was unknown.

    Of views that are none of the training views that is their intrinsics alone.

    Args:
        model: of the fit.
        train: the training views, in the order of the model.
        view: any view of the same data set.
    """
    if model is None:
        return view
    found = next((i for i, other in enumerate(train) if other.name == view.name), None)
    camera = model.lens(view.camera) if found is None else model.camera(found)
    return replace(view, camera=camera)


def _distances(scene: mi.Scene, cameras: Sequence[Camera]) -> np.ndarray:
    """Median distances that cameras see, lamps left out, world units; for none the diagonal."""
    found = []
    for seen in seen_by(scene, [small_camera(camera) for camera in cameras]):
        known = seen.distance[np.isfinite(seen.distance) & ~seen.emits]
        found.append(float(np.median(known)) if len(known) else bounds(scene)[2])
    return np.array(found)


def _units(cameras: Sequence[Camera], distances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radians, and world units, that move what cameras see by a pixel."""
    turns = np.array([1 / camera.fl_x for camera in cameras])
    return turns, distances * turns


def _with_lens(camera: Camera, move: np.ndarray) -> Camera:
    if not move.any():
        return camera
    longer, x, y = (float(value) for value in move)
    factor = 1 + longer / (camera.width / 2)
    return replace(
        camera,
        fl_x=camera.fl_x * factor,
        fl_y=camera.fl_y * factor,
        cx=camera.cx + x,
        cy=camera.cy + y,
    )
