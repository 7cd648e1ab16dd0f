"""Fields to textures: what was recovered, texel by texel of an atlas."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

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
from .observed import Views, filled
from .unwrap import LARGEST, Atlas, Placed, joined, parameterized, surface_points

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

#: Textures of a material that a scene gives: by its number, then by quantity.
OwnTextures = dict[int, dict[str, "mi.Texture"]]


@dataclass(frozen=True, eq=False)
class Baked:
    """The textures of an atlas. Row 0 is v = 0; texels are centred at (i + 1/2) / n."""

    atlas: Atlas
    values: dict[str, np.ndarray]  #: by quantity: (n, n, channels) float32, linear
    covered: np.ndarray  #: (n, n) bool: there is surface
    observed: np.ndarray  #: (n, n) bool: and a training view saw it
    learned: tuple[str, ...]  #: quantities that were recovered; the others are the scene's own
    unobserved_share: float  #: of the surface, by area, that no training view saw
    #: By recovered quantity, the share of the surface that training views saw where the texture
    #: has the field's value, to `NEAR`.
    near: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_near(self) -> bool:
        """Whether all textures are near to the fields where it counts."""
        return min(self.near.values(), default=1.0) >= WANTED


class Baker:
    """Looks up materials on the surfaces of atlases.

    Args:
        materials: what was recovered; None: the scene's own materials are all there is.
        own: textures of the scene, for what was not recovered.
        views: those that the fit learned from.
    """

    def __init__(self, materials: Materials | None, own: OwnTextures, views: Views) -> None:
        self._materials, self._own, self._views = materials, own, views
        self._learned = () if materials is None else tuple(materials)
        self._texels = 0  # of all textures so far

    def bake(
        self,
        atlas: Atlas,
        advance: Callable[[int, int], object] = lambda done, more: None,
        *,
        refine: bool = False,
    ) -> Baked:
        """The textures of an atlas, averaged over four places a texel in linear space.

        Texels that no view saw, and those beside charts, are filled from those that were seen.

        Args:
            atlas: where parts lie.
            advance: called with numbers of texels: that are done, and that there are more to do.
            refine: double the resolution until the textures are near to the fields.

        Raises:
            UserError: the textures do not fit into the memory.
        """
        n, mesh = atlas.resolution, _lookup(atlas)
        require_memory(_TEXEL_BYTES * n * n, "the textures need", "Lower --texels", atlas.name)
        _, uv = surface_points(atlas.placed, _TRIED)
        truth, hit, seen = self._at(mesh, uv)
        finest = min(_FINEST * n, LARGEST)
        while True:
            baked = self._baked(mesh, atlas, advance)
            near = {
                name: _share_near(name, baked.values[name], uv, value, hit & seen)
                for name, value in truth.items()
            }
            baked = replace(baked, near=near if (hit & seen).any() else {})
            self._texels += atlas.resolution**2
            n = 2 * atlas.resolution
            if not refine or baked.is_near or n > finest or not self._has_room(n):
                return baked
            self._texels -= atlas.resolution**2
            atlas = replace(atlas, resolution=n, wanted=n)
            advance(0, n * n)

    def _has_room(self, resolution: int) -> bool:
        """Whether an atlas may become so large."""
        texels, free = resolution**2, free_bytes()
        return self._texels + texels <= _MOST and (free is None or _TEXEL_BYTES * texels < free)

    def _baked(self, mesh: mi.Mesh, atlas: Atlas, advance: Callable[[int, int], object]) -> Baked:
        n = atlas.resolution
        values = {k: np.zeros((n * n, q.channels), np.float32) for k, q in QUANTITIES.items()}
        covered, observed = np.zeros(n * n, bool), np.zeros(n * n, bool)
        for start in range(0, n * n, CHUNK):
            part = slice(start, min(start + CHUNK, n * n))
            count = part.stop - part.start
            means, hit, seen = self._chunk(mesh, atlas, start, min(CHUNK, n * n))
            for name, mean in means.items():
                values[name][part] = mean[:count]
            covered[part], observed[part] = hit[:count], seen[:count]
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
        return Baked(atlas, baked, covered, observed, self._learned, unseen)

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
        mesh = _lookup(Atlas(placed.part.name, (), [placed], "own", 1.0, 1, 1))
        values, hit, seen = self._at(mesh, uv)
        flat = {k: x if x.shape[1] == 3 else x[:, 0] for k, x in values.items()}
        return flat, hit, seen

    def _at(
        self, mesh: mi.Mesh, uv: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """As `at`, on the mesh of an atlas; all values are (n, channels)."""
        values = {
            name: np.zeros((len(uv), QUANTITIES[name].channels), np.float32)
            for name in self._learned
        }
        hit, seen = np.zeros(len(uv), bool), np.zeros(len(uv), bool)
        for start in range(0, len(uv), CHUNK):
            part = slice(start, start + CHUNK)
            si = mesh.eval_parameterization(mi.Point2f(np.ascontiguousarray(uv[part].T)))
            valid = si.is_valid()
            info = mesh.eval_attribute_3("face_info", si, valid)
            found = self._values(mesh, (), si, info, valid)
            dr.eval(found, valid, info)
            for name, value in values.items():
                each = [np.array(dr.select(valid, channel, 0)) for channel in found[name]]
                value[part] = np.stack(each, -1)
            hit[part] = np.array(valid)
            two_sided = info.y > 0.5
            seen[part] = np.array(self._views.see(mi.Point3f(si.p), si.n, two_sided, valid))
        return values, hit, seen

    def _chunk(
        self, mesh: mi.Mesh, atlas: Atlas, start: int, width: int
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """Means of quantities, whether there is surface, and whether it was seen."""
        n = atlas.resolution
        lane = dr.arange(mi.UInt32, _PLACES * width)
        texel, place = lane // _PLACES + dr.opaque(mi.UInt32, start), lane % _PLACES
        edge = dr.opaque(mi.UInt32, n)
        offset = mi.Point2f(place % 2, place // 2) / 2 + 0.25
        uv = (mi.Point2f(texel % edge, texel // edge) + offset) / mi.Float(edge)
        si = mesh.eval_parameterization(uv, active=texel < edge * edge)
        valid = si.is_valid()
        # The number of the material and whether it has two sides.
        info = mesh.eval_attribute_3("face_info", si, valid)
        found = {
            name: [dr.select(valid, v, 0) for v in value]
            for name, value in self._values(mesh, atlas.materials, si, info, valid).items()
        }
        p, normal = mi.Point3f(si.p), mi.Normal3f(si.n)
        dr.eval(found, valid, p, normal, info)
        count = dr.block_sum(dr.select(valid, mi.Float(1), 0), _PLACES)
        sums = {
            name: [dr.block_sum(v, _PLACES) for v in channels] for name, channels in found.items()
        }
        # One place of each texel tells whether it was seen.
        last = dr.block_reduce(dr.ReduceOp.Max, dr.select(valid, place, 0), _PLACES)
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
        return means, np.array(hit), np.array(seen)

    def _values(
        self,
        mesh: mi.Mesh,
        numbers: Collection[int],
        si: mi.SurfaceInteraction3f,
        info: mi.Color3f,
        valid: mi.Bool,
    ) -> dict[str, list[mi.Float]]:
        """All quantities at points, in linear space."""
        own = mesh.eval_attribute_3("vertex_own", si, valid)
        si = mi.SurfaceInteraction3f(si)
        si.uv = mi.Point2f(own.x, own.y)
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
            here = valid & (number == material)
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
    name: str, texture: np.ndarray, uv: np.ndarray, truth: np.ndarray, counted: np.ndarray
) -> float:
    """The share of points at which a texture, interpolated, has the true value, to `NEAR`.

    Args:
        name: of the quantity.
        texture: (n, n, channels) float32, linear.
        uv: (points, 2), where it is looked up.
        truth: (points, channels), what should be there, linear.
        counted: (points,) bool, the points that count.
    """
    last = len(texture) - 1
    at = np.clip(uv * len(texture) - 0.5, 0, last)
    low = at.astype(np.int64)
    high = np.minimum(low + 1, last)
    right, down = np.moveaxis(at - low, 1, 0)[..., None]
    found = [
        (1 - right) * texture[y, low[:, 0]] + right * texture[y, high[:, 0]]
        for y in (low[:, 1], high[:, 1])
    ]
    value = (1 - down) * found[0] + down * found[1]
    if QUANTITIES[name].display == "colour":
        value, truth = encoded(value), encoded(truth)
    off = np.abs(value - truth).max(1)
    return float((off[counted] <= NEAR).mean()) if counted.any() else 1.0


def bake_texture(baked: Baked, texture: mi.Texture, *, colour: bool) -> np.ndarray:
    """A texture of the scene in the coordinates of an atlas, (n, n, 3) float32, as stored.

    Args:
        baked: a material.
        texture: of one of its BSDFs.
        colour: the BSDF reads colours of it, and not one number.
    """
    atlas, n = baked.atlas, baked.atlas.resolution
    mesh = _lookup(atlas)
    found, covered = np.zeros((n * n, 3), np.float32), np.zeros(n * n, bool)
    width = min(CHUNK, n * n)
    for start in range(0, n * n, width):
        lane = dr.arange(mi.UInt32, width) + dr.opaque(mi.UInt32, start)
        uv = mi.Point2f(mi.Float(lane % n) + 0.5, mi.Float(lane // n) + 0.5) / n
        si = mesh.eval_parameterization(uv)
        own = mesh.eval_attribute_3("vertex_own", si, si.is_valid())
        si.uv = mi.Point2f(own.x, own.y)
        read = texture.eval if colour else texture.eval_1
        found[start : start + width] = np.array(mi.Color3f(read(si, si.is_valid()))).T
        covered[start : start + width] = np.array(si.is_valid())
    return filled(found.reshape(n, n, 3), covered.reshape(n, n), (0.5, 0.5, 0.5))


def own_textures(scene: ParsedScene, without: Sequence[str]) -> OwnTextures:
    """The textures of the quantities of a scene's materials; constants are textures as well.

    The nodes cannot be used to make the scene again.

    Args:
        scene: the scene.
        without: quantities that are not needed.

    Raises:
        UserError: a texture is stored in meshes.
    """
    nodes = scene.state.nodes
    found: OwnTextures = {}
    for number, node in enumerate(scene.principled_indices()):
        props, found[number] = nodes[node].props, {}
        for name, quantity in QUANTITIES.items():
            if name in without:
                continue
            value = props.get(quantity.slot, quantity.default)
            if is_reference(value):
                found[number][name] = make_texture(scene, value.index())
            elif is_spectrum(value):
                found[number][name] = props.get_texture(quantity.slot, quantity.default)
            else:
                rgb = [float(x) for x in np.ravel(np.array(value, np.float64))]
                rgb = rgb * 3 if len(rgb) == 1 else rgb
                colour = {"type": "rgb", "value": rgb} if name == "albedo" else None
                uniform = {"type": "uniform", "value": rgb[0]}
                found[number][name] = mi.load_dict(colour or uniform)
    return found


def make_texture(scene: ParsedScene, node: int) -> mi.Texture:
    """The texture of a node, with those that it refers to.

    Raises:
        UserError: it is stored in a mesh, or Mitsuba cannot make it.
    """
    props = scene.state.nodes[node].props
    if props.plugin_name() == "mesh_attribute":
        what = "values stored in meshes cannot be exported as textures"
        raise UserError(what, scene.path, "Use a bitmap for them")
    for key in list(props):
        if is_reference(props[key]):
            props[key] = make_texture(scene, props[key].index())
    try:
        made = mi.PluginManager.instance().create_object(props)
    except (RuntimeError, ValueError) as error:
        raise UserError(f"a texture cannot be made: {reason(error)}", scene.path) from None
    return (made.expand() or [made])[0]


def _lookup(atlas: Atlas) -> mi.Mesh:
    """The parts of an atlas as one mesh, with what is asked of points on it."""
    mesh = parameterized(*joined(atlas.placed))
    info = [
        np.broadcast_to(
            np.array([each.part.materials[0], each.part.two_sided, 0], np.float32),
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
    return mesh
