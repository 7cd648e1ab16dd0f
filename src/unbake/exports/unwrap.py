"""Atlases: each material has a square of texture coordinates, which its parts share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..scene.bumps import turned
from ..scene.parse import ParsedScene
from ..scene.transforms import chosen_id
from ..scene.triangles import mesh_of, numbered, triangle_areas
from . import LARGEST_TEXTURE
from .constants import FRACTIONS, constant_opacity
from .parts import Part, unique_names
from .tessellate import Triangles

#: Texels along the edge of a texture.
SMALLEST, LARGEST = 64, LARGEST_TEXTURE
#: Points by which texture coordinates are tried, and the share that must find back.
POINTS, UNIQUE = 20_000, 0.999
#: By how much the page of uvunwrap may grow until charts fit into it.
_LARGER = 8
#: Empty texels around charts, at least.
_PADDING = 2
#: Of the edge of a texture: how far charts are apart where viewers average its texels far away, and
#: how much of what charts fill must be left by that.
_APART, _WORTH = 1 / 128, 0.9
#: Of the extent of a material's parts: how near a point must come back.
_NEAR = 1e-3
#: Radians by which charts of bump maps are turned.
_TURN = 1e-3
#: The share of a square that charts are expected to fill.
_FILLED = 0.6


@dataclass(frozen=True, eq=False)
class Placed:
    """A part with the texture coordinates of its material's atlas."""

    part: Part
    triangles: Triangles  #: `uv` is that of the atlas
    own_uv: np.ndarray | None  #: (n, 2), those of the scene, vertex by vertex


@dataclass(frozen=True, eq=False)
class Atlas:
    """What the parts of a material share: texture coordinates, and so textures."""

    name: str
    materials: tuple[int, ...]  #: numbers of its BSDFs: several where one holds several
    placed: list[Placed]
    method: str  #: "own", "uvunwrap" or "xatlas"
    unique: float  #: share of points whose texture coordinates lead back to them
    resolution: int  #: texels along an edge
    wanted: int  #: the resolution before it was limited
    most: int = LARGEST  #: texels along an edge that it may have

    @property
    def is_optimized(self) -> bool:
        """Whether any part shows what the fit recovered."""
        return any(placed.part.is_optimized for placed in self.placed)

    @property
    def masks(self) -> list[tuple[int, ...]]:
        """The masks that its parts have, each once, as of `Part.masks`."""
        return sorted({placed.part.masks for placed in self.placed if placed.part.masks})

    def area(self) -> float:
        """Of the surface, in square world units."""
        return sum(float(placed.triangles.areas().sum()) for placed in self.placed)


def make_atlases(
    scene: ParsedScene,
    parts: Sequence[Part],
    texels: float,
    advance: Callable[[str], object] = lambda name: None,
    most: int = LARGEST,
) -> list[Atlas]:
    """An atlas for each material that parts have, those of lamps last.

    Parts that are transparent to a part by one number have atlases of their own, whatever material
    they share: other programs blend a material as a whole. So have lamps: what a fit optimizes is
    not told of them. One that shows a picture has an atlas alone, in which its own coordinates can
    stay.

    Args:
        scene: the nodes that the parts are of.
        parts: those with materials are placed, the others are passed over.
        texels: wanted along a scene unit.
        advance: called with the name of each material before it is unwrapped.
        most: texels along an edge, a power of two.

    Raises:
        UserError: a material's parts cannot be unwrapped.
    """
    groups = _groups(scene, [part for part in parts if part.materials])
    names = _material_names(scene, groups)
    atlases = []
    for name, group in zip(names, groups, strict=True):
        advance(name)
        atlases.append(_atlas(name, group, texels, most))
    return atlases


def _groups(scene: ParsedScene, parts: Sequence[Part]) -> list[list[Part]]:
    """Parts of a kind that share a material, also through others: a BSDF may hold several."""
    first: dict[tuple[int, int], tuple[int, int]] = {}

    def root(key: tuple[int, int]) -> tuple[int, int]:
        while first.setdefault(key, key) != key:
            key = first[key]
        return key

    ordered = sorted(((_kind(scene, part), part) for part in parts), key=lambda pair: pair[0])
    for kind, part in ordered:
        for number in part.materials:
            low, high = sorted((root((kind, part.materials[0])), root((kind, number))))
            first[high] = low
    found: dict[tuple[int, int], list[Part]] = {}
    for kind, part in ordered:
        found.setdefault(root((kind, part.materials[0])), []).append(part)
    return list(found.values())


def _kind(scene: ParsedScene, part: Part) -> int:
    """What parts must have in common to share an atlas.

    0 of surfaces that emit no light, 1 of those that are transparent to a part by one number, 2 of
    lamps, and a number alone of each lamp with a picture.
    """
    if part.emitter is None:
        opacity, (low, high) = constant_opacity(scene, part.masks), FRACTIONS
        return int(opacity is not None and low < opacity < high)
    kinds = {scene.state.nodes[i].type for i in scene.references(part.emitter)}
    return 3 + part.emitter if mi.ObjectType.Texture in kinds else 2


def _material_names(scene: ParsedScene, groups: list[list[Part]]) -> list[str]:
    """The id of a group's material or of the BSDF around it, else the name of its first part."""
    nodes = scene.principled_indices()
    names = []
    for group in groups:
        part = group[0]
        known = [chosen_id(scene.state.nodes[nodes[part.materials[0]]])]
        if part.bsdf is not None:
            known.append(chosen_id(scene.state.nodes[part.bsdf]))
        names.append(next(filter(None, known), part.name))
    return unique_names(names)


def _atlas(name: str, parts: list[Part], texels: float, most: int) -> Atlas:
    materials = tuple(sorted({number for part in parts for number in part.materials}))
    own = _with_own(parts)
    if own is not None and (share := unique_share(own)) >= UNIQUE:
        filled = sum(_uv_areas(placed.triangles).sum() for placed in own)
        wanted, resolution = _resolution(own, texels, float(filled), most)
        return Atlas(name, materials, own, "own", share, resolution, wanted, most)
    whole = [Placed(part, part.triangles, part.triangles.uv) for part in parts]
    wanted, resolution = _resolution(whole, texels, _FILLED, most)
    found: list[Atlas] = []
    failures = []
    for method, unwrap in (("uvunwrap", _by_uvunwrap), ("xatlas", _by_xatlas)):
        try:
            corners, size = unwrap([part.triangles for part in parts], resolution)
        except (RuntimeError, ValueError, ImportError) as error:
            failures.append(f"{method}: {error}")
            continue
        if any(part.is_bumped for part in parts):
            corners = [_askew(uv) for uv in corners]
        placed = [_split(part, uv) for part, uv in zip(parts, corners, strict=True)]
        share = unique_share(placed)
        # Coordinates are shares of the page. With fewer texels than it has, charts are nearer.
        size = min(size, most)
        found.append(Atlas(name, materials, placed, method, share, size, wanted, most))
        if share >= UNIQUE:
            break
    if not found:
        why = " ".join("; ".join(failures).split())[:200]
        what = f"the material {name!r} cannot be unwrapped ({why})"
        raise UserError(what, None, "Give its meshes texture coordinates in a modelling program")
    return max(found, key=lambda atlas: atlas.unique)


def _resolution(
    placed: list[Placed], texels: float, filled: float, most: int = LARGEST
) -> tuple[int, int]:
    """Texels along an edge: what is wanted, and within the limits; powers of two."""
    area = sum(float(each.triangles.areas().sum()) for each in placed)
    edge = texels * math.sqrt(area / max(filled, 1e-9))
    wanted = 1 << max(0, math.ceil(math.log2(max(edge, 1.0)) - 1e-9))
    return wanted, min(max(wanted, SMALLEST), most)


# ------------------------------------------------------------------------- coordinates of the scene


def _with_own(parts: list[Part]) -> list[Placed] | None:
    """The parts with their own coordinates; None where some have none, or leave the square."""
    placed = []
    for part in parts:
        uv = part.triangles.uv
        # Not a number is outside as well.
        if uv is None or not ((uv > -1e-4) & (uv < 1 + 1e-4)).all():
            return None
        placed.append(Placed(part, replace(part.triangles, uv=uv.clip(0, 1)), uv))
    return placed


def unique_share(placed: list[Placed], seed: int = 0) -> float:
    """The share of random surface points that texture coordinates lead back to."""
    positions, faces, uv = joined(placed)
    mesh = parameterized(positions, faces, uv)
    points, coordinates = surface_points(placed, POINTS, seed)
    si = mesh.eval_parameterization(mi.Point2f(np.ascontiguousarray(coordinates.T)))
    back, valid = np.array(si.p).T, np.array(si.is_valid())
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    near = np.linalg.norm(np.where(valid[:, None], back, np.inf) - points, axis=1)
    return float((near < _NEAR * extent).mean())


def surface_points(
    placed: list[Placed], count: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Random points of a surface, by area, none of them on an edge.

    Returns:
        Positions (count, 3), float64, and texture coordinates (count, 2), float32.
    """
    positions, faces, uv = joined(placed)
    areas = triangle_areas(positions, faces)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(faces), count, p=areas / areas.sum())
    weights = _barycentric(rng, count)
    points = np.einsum("nk,nkd->nd", weights, positions[faces[chosen]])
    coordinates = np.einsum("nk,nkd->nd", weights, uv[faces[chosen]])
    return points, coordinates.astype(np.float32)


def _barycentric(rng: np.random.Generator, count: int) -> np.ndarray:
    """Uniform weights of corners, (count, 3); never on an edge."""
    root, other = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - other), root * other], -1)
    return 0.998 * weights + 0.002 / 3


def joined(placed: list[Placed]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, faces and texture coordinates of parts as one mesh."""
    counts = np.cumsum([0, *(len(each.triangles.positions) for each in placed)])
    faces = [each.triangles.faces + int(n) for each, n in zip(placed, counts, strict=False)]
    return (
        np.concatenate([each.triangles.positions for each in placed]),
        np.concatenate(faces).astype(np.uint32),
        np.concatenate([_uv(each.triangles) for each in placed]),
    )


def parameterized(positions: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> mi.Mesh:
    """A mesh of Mitsuba whose surface is looked up by its texture coordinates."""
    return mesh_of(positions, faces, uv=uv, name="atlas")


def _uv(triangles: Triangles) -> np.ndarray:
    if triangles.uv is None:
        raise ValueError("the triangles have no texture coordinates")
    return triangles.uv


def _uv_areas(triangles: Triangles) -> np.ndarray:
    return _areas_between(_uv(triangles)[triangles.faces])


def _areas_between(corners: np.ndarray) -> np.ndarray:
    """The areas of triangles with these corners (m, 3, 2), (m,) float64."""
    a, b, c = np.moveaxis(corners.astype(np.float64), 1, 0)
    (x, y), (z, w) = (b - a).T, (c - a).T
    return np.abs(x * w - y * z) / 2


# --------------------------------------------------------------------------------------- unwrapping


def _by_uvunwrap(meshes: list[Triangles], resolution: int) -> tuple[list[np.ndarray], int]:
    """Texture coordinates of each corner, (m, 3, 2) a mesh, and the edge of a page that holds all.

    The page is doubled where charts do not fit: each has `_PADDING` around it, however small it is.
    They are further apart in large textures where that costs little.
    """
    import uvunwrap  # needs Python 3.11

    given = [uvunwrap.Mesh(*_welded(mesh)) for mesh in meshes]

    def packed(size: int, padding: int) -> list[np.ndarray] | str:
        """Corners of each mesh, or why there are none."""
        try:
            atlas = uvunwrap.generate(given, page_size=size, padding=padding)
        except uvunwrap.UnwrapError as error:
            return str(error)
        if atlas.page_count != 1:
            return f"it needs {atlas.page_count} pages"
        found = [np.array(mesh.corner_uvs, np.float32).reshape(-1, 3, 2) for mesh in atlas.meshes]
        # A page that is less high than wide becomes a square: its texels are only denser.
        return _checked(found, meshes)

    size, largest = resolution, min(_LARGER * resolution, LARGEST)
    padding = int(_APART * size)
    wide = packed(size, padding) if padding > _PADDING else None
    if isinstance(wide, list) and _filled_by(wide) >= _FILLED:
        return wide, size
    while isinstance(close := packed(size, _PADDING), str) and 2 * size <= largest:
        size *= 2
    if isinstance(close, str):
        raise RuntimeError(close)
    if isinstance(wide, list) and _filled_by(wide) >= _WORTH * _filled_by(close):
        return wide, resolution
    return close, size


def _filled_by(corners: list[np.ndarray]) -> float:
    """The share of the square that triangles with these corners fill."""
    return sum(float(_areas_between(each).sum()) for each in corners)


def _by_xatlas(meshes: list[Triangles], resolution: int) -> tuple[list[np.ndarray], int]:
    """Texture coordinates of each corner, (m, 3, 2) a mesh, and the edge of the page."""
    import xatlas

    atlas = xatlas.Atlas()
    for mesh in meshes:
        atlas.add_mesh(*_welded(mesh))
    options = xatlas.PackOptions()
    options.resolution, options.padding = resolution, _PADDING
    atlas.generate(xatlas.ChartOptions(), options, False)
    if atlas.atlas_count != 1:
        raise RuntimeError(f"it needs {atlas.atlas_count} pages")
    corners = []
    for number in range(len(meshes)):
        _, indices, uv = atlas.get_mesh(number)
        corners.append(uv[indices].astype(np.float32))
    # The resolution is only a wish: a page grows until it holds the padding of all charts, too.
    # Coordinates are relative to each side of it; a square of the longer one is only denser.
    edge = 1 << math.ceil(math.log2(max(atlas.width, atlas.height, resolution)))
    return _checked(corners, meshes), min(edge, LARGEST)


def _welded(mesh: Triangles) -> tuple[np.ndarray, np.ndarray]:
    """Positions and faces with vertices of one place made one: only edges are seams."""
    positions, number = np.unique(mesh.positions, axis=0, return_inverse=True)
    faces = number.reshape(-1)[mesh.faces].astype(np.uint32)
    return np.ascontiguousarray(positions, np.float32), np.ascontiguousarray(faces)


def _checked(corners: list[np.ndarray], meshes: list[Triangles]) -> list[np.ndarray]:
    for uv, mesh in zip(corners, meshes, strict=True):
        if len(uv) != len(mesh.faces) or not np.isfinite(uv).all():
            raise RuntimeError("it left triangles out")
    return corners


def _askew(corners: np.ndarray) -> np.ndarray:
    """Corners in the unit square, turned a little within it; see `scene.bumps`.

    Charts are small: rounding would hide the turn that is enough for whole walls.
    """
    shrunk = (corners.reshape(-1, 2).astype(np.float64) - 0.5) / (math.cos(_TURN) + math.sin(_TURN))
    return (turned(shrunk, _TURN) + 0.5).astype(np.float32).reshape(corners.shape)


def _split(part: Part, corners: np.ndarray) -> Placed:
    """A part whose vertices are split where charts meet."""
    mesh = part.triangles
    keys = np.empty((mesh.faces.size, 3), np.uint32)
    keys[:, 0] = mesh.faces.ravel()
    keys[:, 1:] = np.ascontiguousarray(corners.reshape(-1, 2), np.float32).view(np.uint32)
    first, number = numbered(*keys.T)
    old = keys[first, 0]
    split = replace(
        mesh.of_vertices(old, number.astype(np.uint32).reshape(-1, 3)),
        uv=corners.reshape(-1, 2)[first].astype(np.float32).clip(0, 1),
    )
    return Placed(part, split, None if mesh.uv is None else mesh.uv[old])
