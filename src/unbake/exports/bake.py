"""Fields to textures: what was recovered, texel by texel of an atlas."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..fields.domain import SurfacePoint
from ..fields.materials import Materials
from ..fields.pieces import ATTRIBUTE, Piece, decoded
from ..imaging.pictures import encoded
from ..memory import free_bytes, require_memory
from ..quantities import QUANTITIES
from ..scene.parse import ParsedScene, is_reference, is_spectrum, reason
from .constants import CUTOFF, FRACTIONS
from .observed import Views, filled
from .tessellate import Triangles
from .unwrap import Atlas, Placed, joined, parameterized, surface_points

#: Texels that are looked up at once; bounds the memory.
CHUNK = 1 << 17
#: Places in a texel that are looked up: the middles of its quarters.
_PLACES = 4
#: Bytes a texel of the arrays here, with those of the pyramid.
_TEXEL_BYTES = 120
#: How near textures are to the fields: their largest error, as PNG files store them, and the share
#: of the surface with no larger one that resolutions are chosen for.
NEAR, WANTED = 2 / 255, 0.95
#: Points of an atlas at which that is tried.
_TRIED = 4096
#: Points of an atlas that tell how much of its surface was seen.
_COUNTED = 1 << 16
#: By how much the resolution of an atlas may rise for it, and to how many texels in all of them.
_FINEST, _MOST = 8, 1 << 25
#: Texels of one texture of the scene whose resolution rises, at most.
_MOST_KNOWN = 1 << 22

#: The opacity below which there is nothing, of what is transparent to a part.
_NOTHING = 1 / 255

#: Textures of a material that a scene gives: by its number, then by quantity.
OwnTextures = dict[int, dict[str, "mi.Texture"]]
#: Opacities of masks, by the node of each.
Opacities = Mapping[int, "mi.Texture"]


@dataclass(frozen=True, eq=False)
class Baked:
    """The textures of an atlas. Row 0 is v = 0; texels are centred at (i + 1/2) / n."""

    atlas: Atlas
    values: dict[str, np.ndarray]  #: by quantity: (n, n, channels) float32, linear
    covered: np.ndarray  #: (n, n) bool: there is surface, and not a hole alone
    observed: np.ndarray  #: (n, n) bool: and a training view saw it
    learned: tuple[str, ...]  #: quantities that were recovered; the others are the scene's own
    unobserved_share: float  #: of the surface, by area, that no training view saw
    #: By recovered quantity, the share of the surface that training views saw where the texture
    #: has the field's value, to `NEAR`.
    near: Mapping[str, float] = field(default_factory=dict)
    #: The same, of the surface that is no hole, by what was not learned; and of all the surface by
    #: opacity: of cut-outs, the share that is solid, or a hole, as in the scene, or that of what is
    #: solid there, if it is less. Empty where that was not asked for.
    known_near: Mapping[str, float] = field(default_factory=dict)
    #: What masks leave of the surface, (n, n) float32 in [0, 1]; None: all of it.
    opacity: np.ndarray | None = None
    #: Some parts of it are mostly transparent to a part; False: it is solid, with holes.
    blends: bool = False

    @property
    def is_near(self) -> bool:
        """Whether all textures are near to the fields where it counts."""
        return min(self.near.values(), default=1.0) >= WANTED

    @property
    def coarse(self) -> list[str]:
        """What was not learned, and is coarser than in the scene."""
        return [name for name, share in self.known_near.items() if share < WANTED]

    @property
    def constant_opacity(self) -> float | None:
        """Its opacity where that is one number; None where it is a texture."""
        if self.opacity is None:
            return 1.0
        one = np.ptp(self.opacity) <= _NOTHING
        return float(self.opacity.mean(dtype=np.float64)) if one else None


class _Texels(NamedTuple):
    """Some texels of an atlas."""

    means: dict[str, np.ndarray]  #: of quantities, where there is surface that is no hole
    opacity: np.ndarray | None  #: mean; None: nothing is cut out
    surface: np.ndarray  #: bool: there is surface, holes included
    covered: np.ndarray  #: bool: as of `Baked`
    observed: np.ndarray  #: bool: as of `Baked`


class _Points(NamedTuple):
    """What is found at points of an atlas."""

    values: dict[str, np.ndarray]  #: by quantity, (n, channels), linear
    opacity: np.ndarray  #: (n, 1)
    hit: np.ndarray  #: bool: there is surface, holes included
    solid: np.ndarray  #: bool: and no hole
    seen: np.ndarray  #: bool: and a training view saw it


class _Surface(NamedTuple):
    """An atlas to look things up in."""

    mesh: mi.Mesh
    masks: list[tuple[int, ...]]  #: as of `Atlas.masks`
    least: float  #: the opacity below which there is a hole


class Baker:
    """Looks up materials on the surfaces of atlases.

    Args:
        materials: what was recovered; None: the scene's own materials are all there is.
        own: textures of the scene, for what was not recovered.
        views: those that the fit learned from.
        opacities: of the masks of the scene, of which all are asked that atlases have; None: masks
            count as solid.
        texels: of all atlases that will be baked, before any is refined.
    """

    def __init__(
        self,
        materials: Materials | None,
        own: OwnTextures,
        views: Views,
        opacities: Opacities | None = None,
        texels: int = 0,
    ) -> None:
        self._materials, self._own, self._views = materials, own, views
        self._opacities = opacities
        self._learned = () if materials is None else tuple(materials)
        self._texels = texels

    def bake(
        self,
        atlas: Atlas,
        advance: Callable[[int, int], object] = lambda done, more: None,
        *,
        refine: bool = False,
        known: bool = False,
    ) -> Baked:
        """The textures of an atlas, averaged over four places a texel in linear space.

        Texels that no view saw, holes, and those beside charts are filled from those that were
        seen.

        Args:
            atlas: where parts lie.
            advance: called with numbers of texels: that are done, and that there are more to do.
            refine: double the resolution until the textures are near to the fields.
            known: those of what was not learned count, too: they are compared with the scene's.

        Raises:
            UserError: the textures do not fit into the memory.
        """
        n = atlas.resolution
        require_memory(_TEXEL_BYTES * n * n, "the textures need", "Lower --texels", atlas.name)
        _, uv = surface_points(atlas.placed, _TRIED)
        surface = self._surface(atlas)
        points = self._at(surface, uv, atlas.materials if known else ())
        finest = min(_FINEST * n, atlas.most)
        while True:
            baked = self._compared(self._baked(surface, atlas, advance), uv, points, known=known)
            n = 2 * atlas.resolution
            enough = baked.is_near and not baked.coarse
            if not refine or enough or n > finest or not self._has_room(atlas.resolution, n):
                return baked
            self._texels += n**2 - atlas.resolution**2
            atlas = replace(atlas, resolution=n, wanted=n)
            advance(0, n * n)

    def _has_room(self, before: int, after: int) -> bool:
        """Whether the resolution of an atlas may become so large."""
        free = free_bytes()
        fits = free is None or _TEXEL_BYTES * after**2 < free
        return fits and self._texels + after**2 - before**2 <= _MOST

    def _compared(self, baked: Baked, uv: np.ndarray, points: _Points, *, known: bool) -> Baked:
        """The same with how near it is to what there is at points (n, 2)."""

        def share(name: str, counted: np.ndarray) -> float:
            colour = QUANTITIES[name].display == "colour"
            texture, truth = baked.values[name], points.values[name]
            return _share_near(texture, uv, truth, counted, colour=colour)

        near, others = {}, {}
        if points.seen.any():
            near = {name: share(name, points.seen) for name in self._learned}
        if known:
            own = [name for name in QUANTITIES if name not in self._learned]
            others = {name: share(name, points.solid) for name in own}
        if known and baked.opacity is not None:
            opacity, hit = baked.opacity[..., None], points.hit
            share_near = _share_near if baked.blends else _share_cut
            others["opacity"] = share_near(opacity, uv, points.opacity, hit)
        return replace(baked, near=near, known_near=others)

    def _surface(self, atlas: Atlas) -> _Surface:
        """An atlas to look things up in; points under each of its masks tell what holes are."""
        masks = [] if self._opacities is None else atlas.masks
        surface = _Surface(_lookup(atlas, masks), masks, CUTOFF)
        if not masks:
            return surface
        under = [[each for each in atlas.placed if each.part.masks == mask] for mask in masks]
        uv = np.concatenate([surface_points(placed, _TRIED)[1] for placed in under])
        si = surface.mesh.eval_parameterization(mi.Point2f(np.ascontiguousarray(uv.T)))
        valid = si.is_valid()
        info = surface.mesh.eval_attribute_3("face_info", si, valid)
        si = _in_own_coordinates(surface.mesh, si, valid)
        opacity = np.array(dr.select(valid, self._opacity(surface, si, info, valid), 1))
        if (opacity >= 1 - _NOTHING).all():
            return surface._replace(masks=[])
        low, high = FRACTIONS
        fractions = ((opacity > low) & (opacity < high)).reshape(len(masks), _TRIED)
        blends = (fractions.mean(1) > 0.5).any()
        return surface._replace(least=_NOTHING) if blends else surface

    def _baked(
        self, surface: _Surface, atlas: Atlas, advance: Callable[[int, int], object]
    ) -> Baked:
        n = atlas.resolution
        values = {k: np.zeros((n * n, q.channels), np.float32) for k, q in QUANTITIES.items()}
        opacity = np.ones((n * n, 1), np.float32) if surface.masks else None
        there, covered, observed = (np.zeros(n * n, bool) for _ in range(3))
        for start in range(0, n * n, CHUNK):
            part = slice(start, min(start + CHUNK, n * n))
            count = part.stop - part.start
            texels = self._chunk(surface, atlas, start, min(CHUNK, n * n))
            for name, mean in texels.means.items():
                values[name][part] = mean[:count]
            there[part] = texels.surface[:count]
            covered[part], observed[part] = texels.covered[:count], texels.observed[:count]
            if opacity is not None and texels.opacity is not None:
                opacity[part, 0] = texels.opacity[:count]
            advance(count, 0)
        baked = {}
        for name, quantity in QUANTITIES.items():
            known = observed if name in self._learned else covered
            default = [quantity.default] * quantity.channels
            square = values[name].reshape(n, n, quantity.channels)
            baked[name] = filled(square, known.reshape(n, n), default)
        covered, observed = covered.reshape(n, n), observed.reshape(n, n)
        _, everywhere = surface_points(atlas.placed, _COUNTED, seed=1)
        unseen = _share_unseen(covered, observed, everywhere)
        if opacity is not None:
            opacity = filled(opacity.reshape(n, n, 1), there.reshape(n, n), (1.0,))[..., 0]
        return Baked(
            atlas,
            baked,
            covered,
            observed,
            self._learned,
            unseen,
            opacity=opacity,
            blends=bool(surface.masks) and surface.least < CUTOFF,
        )

    def at(
        self, placed: Placed, uv: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """What was recovered at texture coordinates of a part, in linear space.

        Args:
            placed: the part; its triangles have the coordinates that are meant.
            uv: (n, 2) float32.

        Returns:
            By quantity, (n, 3) or (n,) float32; whether there is surface, (n,) bool; whether a
            training view saw it, (n,) bool. Where there is no surface, values are zeros.
        """
        atlas = Atlas(placed.part.name, (), [placed], "own", 1.0, 1, 1)
        points = self._at(self._surface(atlas), uv)
        flat = {k: x if x.shape[1] == 3 else x[:, 0] for k, x in points.values.items()}
        return flat, points.hit, points.seen

    def _at(self, surface: _Surface, uv: np.ndarray, numbers: Collection[int] = ()) -> _Points:
        """What there is at points of an atlas.

        Args:
            surface: the atlas.
            uv: (n, 2) float32.
            numbers: of the materials whose own textures are wanted as well.
        """
        mesh = surface.mesh
        values = {
            name: np.zeros((len(uv), QUANTITIES[name].channels), np.float32)
            for name in (QUANTITIES if numbers else self._learned)
        }
        opacities = np.ones((len(uv), 1), np.float32)
        hit, solids, seen = (np.zeros(len(uv), bool) for _ in range(3))
        for start in range(0, len(uv), CHUNK):
            part = slice(start, start + CHUNK)
            si = mesh.eval_parameterization(mi.Point2f(np.ascontiguousarray(uv[part].T)))
            valid = si.is_valid()
            info = mesh.eval_attribute_3("face_info", si, valid)
            p, normal = mi.Point3f(si.p), mi.Normal3f(si.n)
            own = _in_own_coordinates(mesh, si, valid)
            found = self._values(mesh, numbers, own, info, valid)
            solid, opacity = valid, None
            if surface.masks:
                opacity = self._opacity(surface, own, info, valid)
                solid = valid & (opacity >= surface.least)
            dr.eval(found, valid, solid, opacity, info, p, normal)
            for name, value in values.items():
                each = [np.array(dr.select(valid, channel, 0)) for channel in found[name]]
                value[part] = np.stack(each, -1)
            hit[part], solids[part] = np.array(valid), np.array(solid)
            if opacity is not None:
                opacities[part, 0] = np.array(opacity)
            two_sided = info.y > 0.5
            seen[part] = np.array(self._views.see(p, normal, two_sided, solid))
        return _Points(values, opacities, hit, solids, seen)

    def _chunk(self, surface: _Surface, atlas: Atlas, start: int, width: int) -> _Texels:
        mesh = surface.mesh
        si, place = _places(mesh, atlas.resolution, start, width)
        valid = si.is_valid()
        info = mesh.eval_attribute_3("face_info", si, valid)
        p, normal = mi.Point3f(si.p), mi.Normal3f(si.n)
        si = _in_own_coordinates(mesh, si, valid)
        opacity, solid = None, valid
        if surface.masks:
            opacity = dr.select(valid, self._opacity(surface, si, info, valid), 0)
            solid = valid & (opacity >= surface.least)
        found = {
            name: [dr.select(solid, v, 0) for v in value]
            for name, value in self._values(mesh, atlas.materials, si, info, solid).items()
        }
        dr.eval(found, valid, solid, opacity, p, normal, info)
        count = dr.block_sum(dr.select(solid, mi.Float(1), 0), _PLACES)
        sums = {
            name: [dr.block_sum(v, _PLACES) for v in channels] for name, channels in found.items()
        }
        there = count
        if opacity is not None:
            there = dr.block_sum(dr.select(valid, mi.Float(1), 0), _PLACES)
            opacity = np.array(dr.block_sum(opacity, _PLACES) * dr.rcp(dr.maximum(there, 1)))
        # One place of each texel tells whether it was seen.
        last = dr.block_reduce(dr.ReduceOp.Max, dr.select(solid, place, 0), _PLACES)
        chosen = dr.arange(mi.UInt32, width) * _PLACES + last
        p, normal = dr.gather(mi.Point3f, p, chosen), dr.gather(mi.Normal3f, normal, chosen)
        two_sided = dr.gather(mi.Float, info.y, chosen) > 0.5
        hit = count > 0
        seen = self._views.see(p, normal, two_sided, hit)
        scale = dr.rcp(dr.maximum(count, 1))
        means = {
            name: np.stack([np.array(c * scale) for c in channels], -1)
            for name, channels in sums.items()
        }
        return _Texels(means, opacity, np.array(there > 0), np.array(hit), np.array(seen))

    def _opacity(
        self, surface: _Surface, si: mi.SurfaceInteraction3f, info: mi.Color3f, valid: mi.Bool
    ) -> mi.Float:
        """What masks leave of the surface at points in their own coordinates."""
        opacities, found = self._opacities or {}, mi.Float(1)
        for number, masks in enumerate(surface.masks, 1):
            here = valid & (mi.UInt32(dr.round(info.z)) == number)
            value = mi.Float(1)
            for mask in masks:
                value *= dr.clip(opacities[mask].eval_1(si, here), 0, 1)
            found = dr.select(here, value, found)
        return found

    def _values(
        self,
        mesh: mi.Mesh,
        numbers: Collection[int],
        si: mi.SurfaceInteraction3f,
        info: mi.Color3f,
        valid: mi.Bool,
    ) -> dict[str, list[mi.Float]]:
        """All quantities at points in their own coordinates, in linear space."""
        number = mi.UInt32(dr.round(info.x))
        piece = None
        if self._materials is not None and self._materials.pieces is not None:
            piece = decoded(mesh.eval_attribute_3(ATTRIBUTE, si, valid), valid)
        return look_up(self._materials, self._own, numbers, si, number, piece, valid)


def look_up(
    materials: Materials | None,
    own: OwnTextures,
    numbers: Collection[int],
    si: mi.SurfaceInteraction3f,
    number: mi.UInt32,
    piece: Piece | None,
    valid: mi.Bool,
) -> dict[str, list[mi.Float]]:
    """All quantities at surface points, in linear space.

    Args:
        materials: what was recovered; None: nothing.
        own: textures of the scene, for what was not recovered.
        numbers: of the materials that there are at these points.
        si: the points, of which position and texture coordinates are read.
        number: of the material of each.
        piece: of surface that each is on; None where no field asks for it.
        valid: points that count.
    """
    found: dict[str, list[mi.Float]] = {}
    if materials is not None:
        position = materials.domain.to_unit(si.p, valid)
        point = SurfacePoint(position, si.uv, dr.select(valid, number, 0), piece)
        for name, value in materials.evaluate_at(point).items():
            found[name] = list(value) if QUANTITIES[name].channels == 3 else [value]
    for name, quantity in QUANTITIES.items():
        if name in found:
            continue
        value = mi.Color3f(quantity.default)
        for material in numbers:
            texture = own[material][name]
            here = valid & (number == dr.opaque(mi.UInt32, material))  # one kernel for all
            three = quantity.channels == 3
            looked_up = texture.eval(si, here) if three else texture.eval_1(si, here)
            value = dr.select(here, mi.Color3f(looked_up), value)
        found[name] = list(value)[: quantity.channels]
    return found


def _share_unseen(covered: np.ndarray, observed: np.ndarray, uv: np.ndarray) -> float:
    """The share of points in texels that no training view saw; 1 where no texel has surface.

    Texels do not tell it: where coordinates are stretched, some have more surface than others.

    Args:
        covered, observed: as of `Baked`.
        uv: (points, 2), by area.
    """
    last = len(covered) - 1
    x, y = np.minimum((uv * len(covered)).astype(np.int64), last).T
    counted = covered[y, x]
    return float((~observed[y, x])[counted].mean()) if counted.any() else 1.0


def _share_near(
    texture: np.ndarray,
    uv: np.ndarray,
    truth: np.ndarray,
    counted: np.ndarray,
    *,
    colour: bool = False,
    scale: float = 1.0,
) -> float:
    """The share of points at which a texture, interpolated, has the true value, to `NEAR`.

    Args:
        texture: (n, n, channels) float32, linear.
        uv: (points, 2), where it is looked up.
        truth: (points, channels), what should be there, linear.
        counted: (points,) bool, the points that count.
        colour: it is compared as sRGB.
        scale: of its values, in which `NEAR` is told.
    """
    value = _interpolated(texture, uv)
    if colour:
        value, truth = encoded(value), encoded(truth)
    off = np.abs(value - truth).max(1)
    return float((off[counted] <= NEAR * scale).mean()) if counted.any() else 1.0


def _share_cut(
    opacity: np.ndarray, uv: np.ndarray, truth: np.ndarray, counted: np.ndarray
) -> float:
    """The share of points that are solid, or a hole, as it should be; arguments as above.

    Of all points, or of those that should be solid, where it is less: blades of grass are little of
    the surface that they are cut out of.
    """
    solid = (truth[counted] >= CUTOFF)[:, 0]
    same = (_interpolated(opacity, uv)[counted] >= CUTOFF)[:, 0] == solid
    return min(float(each.mean()) for each in (same, same[solid], np.ones(1)) if each.size)


def _interpolated(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """A texture (n, n, channels) at points (points, 2), bilinear: (points, channels)."""
    last = len(texture) - 1
    at = np.clip(uv * len(texture) - 0.5, 0, last)
    low = at.astype(np.int64)
    high = np.minimum(low + 1, last)
    right, down = np.moveaxis(at - low, 1, 0)[..., None]
    found = [
        (1 - right) * texture[y, low[:, 0]] + right * texture[y, high[:, 0]]
        for y in (low[:, 1], high[:, 1])
    ]
    return (1 - down) * found[0] + down * found[1]


def bake_texture(
    baked: Baked, texture: mi.Texture, *, colour: bool, refine: bool = False
) -> tuple[np.ndarray, bool]:
    """A texture of the scene in the coordinates of an atlas.

    Args:
        baked: a material.
        texture: of one of its BSDFs.
        colour: the BSDF reads colours of it, and not one number.
        refine: double the resolution until it is near to the texture.

    Returns:
        (n, n, 3) float32, averaged over four places a texel, as it is stored; and whether it has
        the values of the texture, to 2/255 of their range, on `WANTED` of the surface. A range
        below a thousandth of the largest value is taken as that: it may be rounding alone.
    """
    mesh = _lookup(baked.atlas)
    _, uv = surface_points(baked.atlas.placed, _TRIED)
    si = mesh.eval_parameterization(mi.Point2f(np.ascontiguousarray(uv.T)))
    hit = np.array(si.is_valid())
    truth = np.stack([np.array(channel) for channel in _read(mesh, si, texture, colour)], -1)
    scale = 1.0
    if hit.any():
        scale = max(float(np.ptp(truth[hit])), 1e-3 * float(np.abs(truth[hit]).max()), 1e-6)
    n = baked.atlas.resolution
    finest = min(_FINEST * n, baked.atlas.most)
    while True:
        found = _baked_texture(mesh, n, texture, colour)
        is_near = _share_near(found, uv, truth, hit, scale=scale) >= WANTED
        n *= 2
        if is_near or not refine or n > finest or n * n > _MOST_KNOWN:
            return found, is_near


def _read(
    mesh: mi.Mesh, si: mi.SurfaceInteraction3f, texture: mi.Texture, colour: bool
) -> list[mi.Float]:
    """A texture of the scene at points on the mesh of an atlas, zeros beside it."""
    valid = si.is_valid()
    read = texture.eval if colour else texture.eval_1
    values = mi.Color3f(read(_in_own_coordinates(mesh, si, valid), valid))
    return [dr.select(valid, channel, 0) for channel in values]


def _baked_texture(mesh: mi.Mesh, n: int, texture: mi.Texture, colour: bool) -> np.ndarray:
    """A texture of the scene on the mesh of an atlas, in a square (n, n, 3)."""
    found, covered = np.zeros((n * n, 3), np.float32), np.zeros(n * n, bool)
    width = min(CHUNK, n * n)
    for start in range(0, n * n, width):
        si, _ = _places(mesh, n, start, width)
        values = _read(mesh, si, texture, colour)
        count = dr.block_sum(dr.select(si.is_valid(), mi.Float(1), 0), _PLACES)
        scale = dr.rcp(dr.maximum(count, 1))
        means = [np.array(dr.block_sum(channel, _PLACES) * scale) for channel in values]
        found[start : start + width] = np.stack(means, -1)
        covered[start : start + width] = np.array(count > 0)
    return filled(found.reshape(n, n, 3), covered.reshape(n, n), (0.5, 0.5, 0.5))


def own_textures(
    scene: ParsedScene,
    without: Sequence[str],
    numbers: Collection[int] | None = None,
    *,
    stored: bool = False,
) -> OwnTextures:
    """The textures of the quantities of a scene's materials; constants are textures as well.

    The nodes cannot be used to make the scene again.

    Args:
        scene: the scene.
        without: quantities that are not needed.
        numbers: of the materials that are needed; None: of all.
        stored: the points that are looked up are on meshes that have the values stored in them.

    Raises:
        UserError: a texture is stored in meshes, and `stored` is false, or one cannot be made.
    """
    found: OwnTextures = {}
    for number, node in enumerate(scene.principled_indices()):
        if numbers is not None and number not in numbers:
            continue
        found[number] = {
            name: _texture_of(scene, node, q.slot, q.default, name == "albedo", stored=stored)
            for name, q in QUANTITIES.items()
            if name not in without
        }
    return found


def own_opacities(scene: ParsedScene, masks: Collection[int]) -> dict[int, mi.Texture]:
    """The opacities of masks, by their nodes; constants are textures as well.

    The nodes cannot be used to make the scene again.

    Raises:
        UserError: a texture cannot be made.
    """
    return {mask: _texture_of(scene, mask, "opacity", 0.5, stored=True) for mask in masks}


def _texture_of(
    scene: ParsedScene, node: int, slot: str, default: float, colour: bool = False, *, stored: bool
) -> mi.Texture:
    """What a BSDF has in a slot, as a texture.

    Args:
        node: of the BSDF.
        default: where it has nothing there.
        colour: it is a colour, and not one number.
        stored: as of `own_textures`.
    """
    props = scene.state.nodes[node].props
    value = props.get(slot, default)
    if is_reference(value):
        return make_texture(scene, value.index(), stored=stored)
    if is_spectrum(value):
        return props.get_texture(slot, default)
    rgb = [float(x) for x in np.ravel(np.array(value, np.float64))]
    if colour:
        return mi.load_dict({"type": "rgb", "value": rgb * 3 if len(rgb) == 1 else rgb})
    return mi.load_dict({"type": "uniform", "value": rgb[0]})


def make_texture(scene: ParsedScene, node: int, *, stored: bool = False) -> mi.Texture:
    """The texture of a node, with those that it refers to.

    Args:
        scene: the scene.
        node: of the texture.
        stored: as of `own_textures`.

    Raises:
        UserError: it is stored in meshes, and `stored` is false, or Mitsuba cannot make it.
    """
    props = scene.state.nodes[node].props
    if props.plugin_name() == "mesh_attribute" and not stored:
        what = "values stored in meshes are no textures"
        raise UserError(what, scene.path, "Use a bitmap for them")
    for key in list(props):
        if is_reference(props[key]):
            props[key] = make_texture(scene, props[key].index(), stored=stored)
    try:
        made = mi.PluginManager.instance().create_object(props)
    except (RuntimeError, ValueError) as error:
        raise UserError(f"a texture cannot be made: {reason(error)}", scene.path) from None
    return (made.expand() or [made])[0]


def _lookup(atlas: Atlas, masks: Sequence[tuple[int, ...]] = ()) -> mi.Mesh:
    """The parts of an atlas as one mesh, with what is asked of points on it.

    `face_info` is the number of the material, whether it has two sides, and the number of its masks
    among these, from 1; 0: none.
    """
    mesh = parameterized(*joined(atlas.placed))
    info = [
        np.broadcast_to(
            np.array(
                [
                    each.part.materials[0],
                    each.part.two_sided,
                    1 + masks.index(each.part.masks) if each.part.masks in masks else 0,
                ],
                np.float32,
            ),
            (len(each.triangles.faces), 3),
        )
        for each in atlas.placed
    ]
    own = [
        np.zeros((len(each.triangles.positions), 3), np.float32)
        if each.own_uv is None
        else np.pad(each.own_uv, ((0, 0), (0, 1)))
        for each in atlas.placed
    ]
    mesh.add_attribute("face_info", 3, mi.Float(np.concatenate(info).ravel()))
    pieces = [each.part.pieces for each in atlas.placed if each.part.pieces is not None]
    if pieces:
        mesh.add_attribute(ATTRIBUTE, 3, mi.Float(np.concatenate(pieces).ravel()))
    mesh.add_attribute("vertex_own", 3, mi.Float(np.concatenate(own).ravel().astype(np.float32)))
    for name, values in _stored([each.triangles for each in atlas.placed]).items():
        mesh.add_attribute(name, values.shape[1], mi.Float(values.ravel()))
    return mesh


def _stored(meshes: Sequence[Triangles]) -> dict[str, np.ndarray]:
    """Values stored in meshes, one after the other; zeros where a mesh has none of that name."""
    channels = {name: v.shape[1] for mesh in meshes for name, v in mesh.stored.items()}
    found = {}
    for name, count in channels.items():
        rows = []
        for mesh in meshes:
            length = len(mesh.positions if name.startswith("vertex_") else mesh.faces)
            values = mesh.stored.get(name, np.zeros((length, count), np.float32))
            same = values.shape[1] == count
            rows.append(values if same else np.zeros((length, count), np.float32))
        found[name] = np.concatenate(rows)
    return found


def _places(
    mesh: mi.Mesh, resolution: int, start: int, width: int
) -> tuple[mi.SurfaceInteraction3f, mi.UInt32]:
    """The middles of the quarters of texels on the mesh of an atlas, and the number of each, 0–3.

    Args:
        resolution: of the atlas.
        start: the first texel.
        width: texels; what is beyond the last one is no surface.
    """
    lane = dr.arange(mi.UInt32, _PLACES * width)
    texel, place = lane // _PLACES + dr.opaque(mi.UInt32, start), lane % _PLACES
    edge = dr.opaque(mi.UInt32, resolution)
    offset = mi.Point2f(place % 2, place // 2) / 2 + 0.25
    uv = (mi.Point2f(texel % edge, texel // edge) + offset) / mi.Float(edge)
    return mesh.eval_parameterization(uv, active=texel < edge * edge), place


def _in_own_coordinates(
    mesh: mi.Mesh, si: mi.SurfaceInteraction3f, valid: mi.Bool
) -> mi.SurfaceInteraction3f:
    """Points on the mesh of an atlas with the texture coordinates of the scene."""
    own = mesh.eval_attribute_3("vertex_own", si, valid)
    si = mi.SurfaceInteraction3f(si)
    si.uv = mi.Point2f(own.x, own.y)
    return si
