"""How large hash grids are: as fine as the photographs of a data set tell surfaces apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

import mitsuba as mi
import numpy as np

from ..config import FitConfig
from ..dataset.camera import Camera, spread_rays
from ..dataset.views import Dataset
from ..fields.domain import Domain
from ..fields.grid_sizes import SurfaceSeen, is_open, sized
from ..scene import free_space
from ..scene.edit import to_principled
from ..scene.parse import parse
from ..transport.optimized import optimized_shapes

#: Rays that are traced, in all training views together; a ray a view at least.
RAYS = 4096
#: Hits to a box that tell how many boxes of that size the seen surface meets.
_HITS = 4

#: Share of the seen points that may lie beyond either side of what they are said to fill, how much
#: larger the box around them is taken, and how much smaller than the domain it has to be.
_BEYOND, _MARGIN, _MUCH_SMALLER = 0.01, 1.2, 0.5
#: Of the boxes, in their edges: walls often lie in planes through the middle of the domain, where
#: they would count in the boxes of either side.
_SHIFT = (0.31, 0.53, 0.79)

_SEEN: WeakKeyDictionary[Dataset, SurfaceSeen | None] = WeakKeyDictionary()


def with_grid_sizes(config: FitConfig, dataset: Dataset) -> FitConfig:
    """The settings with levels and tables of hash grids where they leave them open (0).

    The finest cells of albedo are about as wide as a pixel of the training views on the surfaces,
    those of other quantities and of L_θ a multiple of that (`GridConfig.footprints`). A table has
    room for those cells that the seen surface meets. The albedo's smoothness is that between points
    a pixel apart, where its radius is open. Other presets than `cpu` leave nothing open.

    Raises:
        UserError: the scene cannot be loaded.
    """
    materials = [config.materials[name][config.representation] for name in config.quantities]
    fields = [*materials, config.radiance[config.radiance_representation]]
    smoothed = config.regularization
    near = smoothed.albedo_smoothness > 0 and smoothed.albedo_radius == 0
    if not near and not any(map(is_open, fields)):
        return config
    if dataset not in _SEEN:
        parsed = parse(dataset.scene, dataset.root)
        to_principled(parsed)
        scene = parsed.instantiate(bitmaps=False)
        _SEEN[dataset] = surface_seen(scene, [view.camera for view in dataset.train])
    seen = _SEEN[dataset]
    if seen is None:  # the fit warns of poses that see nothing, and has the usual sizes
        return config
    form, of_radiance = config.representation, config.radiance_representation
    return replace(
        config,
        materials={
            name: {**forms, form: sized(forms[form], seen)} if name in config.quantities else forms
            for name, forms in config.materials.items()
        },
        radiance={**config.radiance, of_radiance: sized(config.radiance[of_radiance], seen)},
        regularization=replace(smoothed, albedo_radius=seen.footprint / seen.extent)
        if near
        else smoothed,
    )


def surface_seen(scene: mi.Scene, cameras: Sequence[Camera]) -> SurfaceSeen | None:
    """What cameras see of a scene's surfaces, of a sparse grid of rays in each.

    Args:
        scene: the scene.
        cameras: those that are learned from, one at least.

    Returns:
        Extent of the fields' domain, median footprint and area, in world units; None where no ray
        hits anything. The footprint is on surfaces whose material is optimized, if any is seen: a
        lamp or a known backdrop may be far larger. The area, which the radiance field has to cover,
        is of all: that of faces of boxes that have hits in them, exact to a factor of two.
    """
    hits, points, along = _first_hits(scene, cameras)
    focal = np.repeat([math.sqrt(camera.fl_x * camera.fl_y) for camera in cameras], along**2)
    distance = hits.distance
    hit = np.isfinite(points).all(axis=1)
    if not hit.any():
        return None
    points = points[hit]
    domain = Domain.of(scene.bbox())
    unit = (points - np.array(domain.centre)) / domain.extent + 0.5
    wanted = hit & np.isin(hits.shape, list(optimized_shapes(scene)))
    wanted = wanted if wanted.any() else hit
    footprint = float(np.median(distance[wanted] / focal[wanted]))
    return SurfaceSeen(domain.extent, footprint, domain.extent**2 * _area(unit))


def domain_seen(scene: mi.Scene, cameras: Sequence[Camera], domain: Domain) -> Domain:
    """The part of a domain in which cameras see surfaces, where that is much smaller.

    A lamp or a backdrop that is far away leaves a coarse grid a single cell for all that is seen.

    Args:
        scene: the scene.
        cameras: those that are learned from, one at least.
        domain: of the whole scene.
    """
    _, points, _ = _first_hits(scene, cameras)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return domain
    low, high = np.quantile(points, (_BEYOND, 1 - _BEYOND), axis=0)
    extent = _MARGIN * float((high - low).max())
    if not 0 < extent < _MUCH_SMALLER * domain.extent:
        return domain
    x, y, z = (0.5 * (low + high)).tolist()
    return Domain((x, y, z), extent)


def _first_hits(
    scene: mi.Scene, cameras: Sequence[Camera]
) -> tuple[free_space.Hits, np.ndarray, int]:
    """Hits of a sparse grid of rays of each camera, where they are, and rays along its edge.

    Points (n, 3) are infinite where nothing was hit.
    """
    along = math.ceil(math.sqrt(RAYS / len(cameras)))
    origins, directions = spread_rays(cameras, along)
    hits = free_space.trace(scene, origins, directions)
    hit = np.isfinite(hits.distance) & (hits.distance > 0)
    distance = np.where(hit, hits.distance, np.inf)[:, None]
    with np.errstate(invalid="ignore"):
        return hits, np.where(hit[:, None], origins + distance * directions, np.inf), along


def _area(points: np.ndarray) -> float:
    """The area of the surface that points (n, 3) in [0,1]³ lie on, counted in boxes.

    A surface meets a number of boxes that grows by four as their edge is halved. They are counted
    at the smallest edge at which a box has several points on average, so that hardly any is missed.
    """
    points = np.unique(points, axis=0)  # of cameras at one place no box parts them
    area, along = 1.0, 1
    while True:
        boxes = len(np.unique((points * along + _SHIFT).astype(int), axis=0))
        if boxes * _HITS > len(points):
            return area
        area, along = boxes / along**2, 2 * along
