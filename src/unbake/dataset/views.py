"""The views of a data folder: posed photographs, each read once and checked when it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar, final

import numpy as np

from unbake.dataset.camera import Camera
from unbake.dataset.camera_files import camera_from_frame, frame_of, read_split
from unbake.dataset.data_folder import DataFolder
from unbake.dataset.image_files import ENCODINGS, JPEG, check_header, counted_in, read_image
from unbake.dataset.scene_kind import SceneKind, scene_kind
from unbake.errors import UserError, collected, raise_together
from unbake.imaging.headers import CODED_SUFFIXES, HeaderError, read_header
from unbake.imaging.windows import along
from unbake.io import number, require_file, text
from unbake.quantities import QUANTITIES
from unbake.transport.light_by_depth import depth_of_light, light_of_depth

BACKGROUNDS = ("visible", "hidden")
#: What is known of the light of the scene: all, or nothing, and a placeholder stands for it.
LIGHTS = ("known", "unknown")
#: A key of `render`: false where the scene has lost the materials that it was rendered with.
TRUE_MATERIALS = "true_materials"

#: Suffixes of images that cannot hold alpha.
_OPAQUE = (*JPEG, ".hdr", ".rgbe", ".pfm")
#: Least and greatest exposure, and value at which a photograph is clipped.
MEASURABLE = (1e-12, 1e12)
_MEANT = {
    "exposure": "the photograph is radiance times this number, 1 by default",
    "clipped": "from this value on the photograph says only that it is as bright at least",
    "shot": "the variance of the noise of a decoded value x is shot · x + read²",
    "read": "the variance of the noise of a decoded value x is shot · x + read²",
}
#: Bytes of the name of a view, which files of results are named after.
LONGEST_NAME = 200


@final
@dataclass(frozen=True)
class SensorNoise:
    """Noise of decoded values x of a photograph, with the variance shot · x + read².

    A sensor that counts e electrons at x = 1, with a read noise of r electrons, has shot = 1 / e
    and read = r / e.
    """

    shot: float = 0.0
    read: float = 0.0

    def divided(self, exposure: float) -> SensorNoise:
        """The noise of values that were divided by a number."""
        return SensorNoise(self.shot / exposure, self.read / exposure)

    def variance(self, values: np.ndarray) -> np.ndarray:
        """The variance of values that are known without noise, of the same shape."""
        return np.float32(self.shot) * np.maximum(values, 0) + np.float32(self.read**2)


@final
@dataclass(frozen=True, eq=False)
class View:
    """One posed image.

    Args:
        name: the image's file name without its suffix, unique in the data set.
        split: "train" or "heldout".
        camera: pose and intrinsics, in the image's pixels.
        image: RGB, radiance times the exposure; alpha 1 where a surface is seen; inside the data
            folder.
        truth: true pictures by quantity, of those that the data set has.
        encoding: "linear" where the image holds radiance; "srgb" where it holds code values of 8 or
            16 bits, which the sRGB curve decodes to [0, 1].
        mask: an image of the same size, zero where a pixel counts neither in a fit nor in scores;
            None: all count.
        exposure: the photograph is radiance times this number.
        clipped: value of the decoded photograph from which on a channel says "at least that much";
            None: it says what it says.
        noise: of the decoded photograph; None: it is told from neighbouring pixels.
        mask_from_mesh: whether the mask is where the mesh was seen from this pose, which it
            therefore tells nothing of.
    """

    name: str
    split: str
    camera: Camera
    image: Path
    truth: Mapping[str, Path]
    encoding: str = "linear"
    mask: Path | None = None
    exposure: float = 1.0
    clipped: float | None = None
    noise: SensorNoise | None = None
    mask_from_mesh: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", Path(self.image))
        if self.mask is not None:
            object.__setattr__(self, "mask", Path(self.mask))
        truth = {name: Path(file) for name, file in self.truth.items()}
        object.__setattr__(self, "truth", truth)

    @property
    def limit(self) -> float:
        """The radiance from which on the photograph is clipped; infinite where it never is."""
        if self.clipped is None:
            return math.inf
        # In single precision, as pixels are divided: what is equal stays equal.
        return float(np.float32(self.clipped) / np.float32(self.exposure))

    def photographed(self, picture: np.ndarray, gain: float = 1.0) -> np.ndarray:
        """Radiance as the photograph shows it: exposed, and at most as bright as it can be.

        Scores of renderings against photographs are made of such pictures.

        Args:
            picture: linear RGB radiance, any shape.
            gain: how much brighter the photograph is than its exposure tells.
        """
        factor = self.exposure * gain
        exposed = picture if factor == 1 else picture * np.asarray(factor, picture.dtype)
        return self.readable(exposed)

    def readable(self, photograph: np.ndarray) -> np.ndarray:
        """The photograph with all that is clipped at the same value."""
        if self.clipped is None:
            return photograph
        return np.minimum(photograph, np.asarray(self.clipped, photograph.dtype))


@final
@dataclass(frozen=True, eq=False)
class Dataset:
    """A data folder.

    Args:
        folder: where it lies.
        scene: the Mitsuba scene file, inside the folder.
        background: "visible" where images show the environment behind the scene, else "hidden".
        views: all views, in the order of the file.
        render: how the images were rendered; empty where they were not.
        coverage: fraction of surface area that training views see, in [0, 1]; None if unknown.
        light_by_depth: shares of the light that surfaces reflect to the training views on paths of
            depth 1, 2, … at most (Mitsuba's meaning: 2 is direct illumination), not decreasing;
            deeper paths add nothing. Empty if unknown.
        allow_outside: whether files may lie outside the folder.
        light: "known" where the light of the scene is the true one; "unknown" where a constant
            environment stands for what nobody knows.
    """

    folder: Path
    scene: Path
    background: str
    views: tuple[View, ...]
    render: dict[str, Any]
    coverage: float | None
    light_by_depth: tuple[float, ...] = ()
    allow_outside: bool = False
    light: str = "known"

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", Path(self.folder))
        object.__setattr__(self, "scene", Path(self.scene))

    def depth_of_light(self, share: float) -> int | None:
        """The smallest depth of paths that carry this share of the light; None if unknown."""
        return depth_of_light(self.light_by_depth, share)

    def light_of_depth(self, depth: int) -> float | None:
        """The share of the light that paths of at most this depth carry; None if unknown."""
        return light_of_depth(self.light_by_depth, depth)

    @property
    def root(self) -> Path:
        """The folder that the scene's files must not leave."""
        folder = self.folder.resolve()
        return Path(folder.anchor) if self.allow_outside else folder

    @property
    def kind(self) -> SceneKind:
        """The kind of scene."""
        return scene_kind(self.background)

    @property
    def has_true_materials(self) -> bool:
        """Whether the scene has the materials that its photographs were rendered with."""
        return bool(self.render) and self.render.get(TRUE_MATERIALS) is not False

    @property
    def train(self) -> tuple[View, ...]:
        """The views to learn from."""
        return tuple(view for view in self.views if view.split == "train")

    @property
    def heldout(self) -> tuple[View, ...]:
        """The views to judge by."""
        return tuple(view for view in self.views if view.split == "heldout")

    @classmethod
    def load(
        cls,
        folder: str | Path,
        *,
        allow_outside: bool = False,
        faults: list[UserError] | None = None,
    ) -> Dataset:
        """Read a data folder and check all of it but the pixels: those when they are read.

        Args:
            folder: has a nerfstudio `transforms.json`; frames without "split" are for training.
            allow_outside: read files that lie outside the folder, by their path or through links.
            faults: takes what is wrong with single frames, which are then left out; None: that is
                an error.

        Raises:
            UserError: anything is missing, malformed, outside the folder, or not a valid camera,
                or an image cannot hold radiance or has another size than its frame says. It names
                the file and the remedy, of all frames that cannot be used.
        """
        found: list[UserError] = []
        data = DataFolder(Path(folder), allow_outside)
        top, file = data.read_transforms(), data.transforms_file
        scene = data.inside(text(top, "scene", str(file)), f"{file}: 'scene'")
        require_file(scene, "scene file", f"Set 'scene' in {file}")
        views = _read_views(data, file, top, found)
        render = _or_none(found, _render, top, file) or {}
        seen = _or_none(found, _coverage, top, file)
        by_depth = _or_none(found, _light_by_depth, top, file) or ()
        background = _or_none(found, _one_of, top, "background", BACKGROUNDS, file)
        light = _or_none(found, _one_of, top, "light", LIGHTS, file)
        if faults is not None:
            faults += found
        else:
            raise_together(found, ", all of which `unbake data check` tells")
        if not any(view.split == "train" for view in views):
            if found and any(_is_to_train(frame) for frame in top["frames"]):
                raise UserError("none of the training views can be used", file)
            raise UserError("no view has the split 'train'", file, "There is nothing to learn from")
        background, light = background or BACKGROUNDS[0], light or LIGHTS[0]
        return cls(
            data.path, scene, background, views, render, seen, by_depth, allow_outside, light
        )

    def save(self, folder: str | Path) -> None:
        """Write `transforms.json` into a folder, atomically; images are not touched.

        Args:
            folder: the data folder, in which scene and images lie.

        Raises:
            UserError: a file lies outside the folder.
        """
        data = DataFolder(Path(folder))
        content = {
            "scene": data.relative(self.scene),
            "background": self.background,
            **({} if self.light == "known" else {"light": self.light}),
            "render": self.render,
            "coverage": self.coverage,
            "light_by_depth": list(self.light_by_depth),
            "frames": [_frame(data, view) for view in self.views],
        }
        data.write_transforms(content)


def read_view(image: Path, view: View) -> np.ndarray:
    """A true picture of a view, (H, W, 4) float32, with alpha; errors as in `read_image`.

    Negative pixels, as filters leave them at edges, are taken as zero.
    """
    width, height = view.camera.width, view.camera.height
    return read_image(image, width, height, clip_negative=True).reshape(height, width, 4)


def read_photograph(view: View, clip_negative: bool = False) -> np.ndarray:
    """The photograph of a view, (H, W, 4) float32: linear RGB, and alpha, 0 where it is masked.

    Raises:
        UserError: as in `read_image`, for the photograph or its mask.
    """
    pixels, counted = read_masked(view, clip_negative)
    if counted is not None:
        pixels[..., 3] *= counted
    return pixels


def read_masked(view: View, clip_negative: bool = False) -> tuple[np.ndarray, np.ndarray | None]:
    """The photograph of a view, (H, W, 4) float32, and whether pixels count, (H, W) bool.

    The second is None where the view has no mask. Errors are as in `read_photograph`.
    """
    width, height = view.camera.width, view.camera.height
    pixels = read_image(view.image, width, height, clip_negative, view.encoding)
    pixels = pixels.reshape(height, width, 4)
    return pixels, read_mask(view)


def read_mask(view: View) -> np.ndarray | None:
    """Whether pixels count by the mask of a view, (H, W) bool; None where it has none.

    Raises:
        UserError: the mask cannot be read, or has another size.
    """
    if view.mask is None:
        return None
    check_header(view.mask, view.camera.width, view.camera.height, "srgb")
    return counted_in(view.mask)


def fitted_pixels(view: View, background: str) -> np.ndarray | None:
    """Which pixels of a view's photograph are fitted, (H, W) bool, as `fitted` says; None: all.

    The photograph is read only where its alpha may say so.

    Raises:
        UserError: as in `read_photograph`, but for negative pixels.
    """
    counted: np.ndarray | None
    if may_ring(view) or (background == "hidden" and _may_be_transparent(view.image)):
        counted = fitted(*read_masked(view, clip_negative=True), background, view)
    else:
        counted = read_mask(view)
    return None if counted is None or counted.all() else counted


def fitted(
    pixels: np.ndarray, mask: np.ndarray | None, background: str, view: View | None = None
) -> np.ndarray:
    """Which pixels of a photograph are fitted, (H, W) bool.

    They are not masked and, where the background is hidden, have alpha > 0.

    Args:
        pixels, mask: as of `read_masked`.
        background: of the data set.
        view: whose photograph may ring, so that pixels that do are not fitted; None: it does not.
    """
    counted = np.ones(pixels.shape[:2], bool) if mask is None else mask
    if background == "hidden":
        counted = counted & (pixels[..., 3] > 0)
    if view is not None and may_ring(view):
        counted = counted & ~_ringing(pixels[..., :3], view.clipped)
    return counted


def leaves_out(view: View) -> bool:
    """Whether pixels of a photograph may not be fitted, whatever the background is."""
    return view.mask is not None or may_ring(view)


def may_ring(view: View) -> bool:
    """Whether a photograph may be wrong beside what is clipped in it: JPEG files may."""
    return view.clipped is not None and view.image.suffix.lower() in JPEG


def _ringing(photograph: np.ndarray, limit: float | None) -> np.ndarray:
    """Pixels with a channel that is below the limit beside a pixel where it is not, (H, W) bool.

    JPEG files ring there: a lamp that is many times as bright as the limit may read as half of it,
    which nothing tells from light that is as bright as that.

    Args:
        photograph: as decoded, shape (H, W, 3).
        limit: value from which on channels are clipped.
    """
    clipped = photograph >= np.float32(np.inf if limit is None else limit)
    if not clipped.any():
        return np.zeros(photograph.shape[:2], bool)
    near = clipped
    for axis in (0, 1):
        near = np.logical_or.reduce(list(along(near, axis, 1)))
    return (near & ~clipped).any(axis=2)


def _may_be_transparent(image: Path) -> bool:
    """Whether an image may have transparent pixels, which are not read for that."""
    suffix = image.suffix.lower()
    if suffix in _OPAQUE:
        return False
    try:
        # Files of code values may name a colour that is transparent.
        return suffix in CODED_SUFFIXES or read_header(image).channels in (2, 4)
    except (HeaderError, OSError):
        return True  # reading it tells what is wrong


def _read_views(
    data: DataFolder, file: Path, top: dict[str, Any], faults: list[UserError]
) -> tuple[View, ...]:
    """The views that can be used; what is wrong with the others goes to `faults`."""
    frames = top.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError("'frames' is not a list of frames", file, "Each view is one frame")
    views, names = [], set()
    for index, frame in enumerate(frames):
        where = f"{file}: frame {index}"
        found: list[UserError] = []
        with collected(found):
            if not isinstance(frame, dict):
                raise UserError("the frame is not an object", where, "Each view is one frame")
            view = _read_view(data, frame, top, where)
            if view.name in names:
                raise UserError(f"two frames are named {view.name!r}", where, "Rename one image")
            names.add(view.name)
            found += _file_faults(view)
            if not found:
                views.append(view)
        faults += found
    return tuple(views)


def _file_faults(view: View) -> list[UserError]:
    """What is wrong with the files of a view, without reading their pixels."""
    size = view.camera.width, view.camera.height
    found: list[UserError] = []
    with collected(found):
        check_header(view.image, *size, view.encoding)
    # True pictures have the size of the image: if that is wrong, it is told once.
    for image in () if found else view.truth.values():
        with collected(found):
            check_header(image, *size)
    if view.mask is not None:
        with collected(found):
            require_file(view.mask, "mask", "Add it, or remove 'mask_path' from the frame")
            check_header(view.mask, *size, "srgb")
    return found


def _read_view(data: DataFolder, frame: dict[str, Any], top: dict[str, Any], where: str) -> View:
    image = data.inside(text(frame, "file_path", where), f"{where}: 'file_path'")
    where = f"{where} ({image.name})"
    if len(image.stem.encode()) > LONGEST_NAME:
        what = f"the name of the image has over {LONGEST_NAME} bytes"
        raise UserError(what, where, "Rename it: results are named after it")
    if not image.stem.isprintable():
        what = "the name of the image has control characters"
        raise UserError(what, where, "Rename it: results are named after it")
    split = read_split(frame, where)
    camera = camera_from_frame(frame, top, where)
    known = {name: data.truth(name, image.stem) for name in QUANTITIES}
    encoding = frame.get("encoding", top.get("encoding", "linear"))
    if encoding not in ENCODINGS:
        raise UserError(f"unknown encoding {encoding!r}", where, "It is 'linear' or 'srgb'")
    mask = None
    if "mask_path" in frame:
        mask = data.inside(text(frame, "mask_path", where), f"{where}: 'mask_path'")
    clipped = _positive(frame if "clipped" in frame else top, "clipped", where)
    return View(
        image.stem,
        split,
        camera,
        image,
        {name: file for name, file in known.items() if data.known(file)},
        encoding=encoding,
        mask=mask,
        exposure=_positive(frame, "exposure", where) or 1.0,
        clipped=clipped,
        noise=_noise(frame if "noise" in frame else top, where),
        mask_from_mesh=_mask_from_mesh(frame, where),
    )


def _mask_from_mesh(frame: dict[str, Any], where: str) -> bool:
    origin = frame.get("mask_from")
    if origin not in (None, "mesh"):
        what = f"'mask_from' is {origin!r}"
        raise UserError(what, where, "It is 'mesh', of masks that `unbake import` has drawn")
    return origin == "mesh"


def _noise(table: dict[str, Any], where: str) -> SensorNoise | None:
    """The key of a frame, or of all; None where the table has none, or null."""
    told = table.get("noise")
    if told is None:
        return None
    if not isinstance(told, dict) or not told or told.keys() - {"shot", "read"}:
        remedy = 'It is a table such as {"shot": 0.001, "read": 0.002}'
        raise UserError("'noise' is no table of 'shot' and 'read'", where, remedy)
    there = f"{where}: 'noise'"
    return SensorNoise(**{key: _positive(told, key, there, or_zero=True) or 0.0 for key in told})


def _positive(
    table: dict[str, Any], key: str, where: str, *, or_zero: bool = False
) -> float | None:
    """A positive number of single precision; None where the table has none, or null."""
    if table.get(key) is None:
        return None
    low, high = MEASURABLE
    try:
        found = number(table, key, where)
    except UserError:
        found = math.nan
    if not (low <= found <= high or (or_zero and found == 0)):
        what = f"{key!r} is not a number from {low:g} to {high:g}"
        raise UserError(what, where, f"Correct it, or remove it: {_MEANT[key]}")
    return found


def _frame(data: DataFolder, view: View) -> dict[str, Any]:
    return {
        "file_path": data.relative(view.image),
        "split": view.split,
        **frame_of(view.camera),
        **({} if view.encoding == "linear" else {"encoding": view.encoding}),
        **({} if view.mask is None else {"mask_path": data.relative(view.mask)}),
        **({"mask_from": "mesh"} if view.mask_from_mesh else {}),
        **({} if view.exposure == 1 else {"exposure": view.exposure}),
        **({} if view.clipped is None else {"clipped": view.clipped}),
        **({} if view.noise is None else {"noise": asdict(view.noise)}),
    }


def _one_of(top: dict[str, Any], key: str, names: Sequence[str], file: Path) -> str:
    """A word at the top of the file, the first of its names where it is missing."""
    word = top.get(key, names[0])
    if word not in names:
        remedy = f"It is {' or '.join(map(repr, names))}"
        raise UserError(f"unknown {key} {word!r}", file, remedy)
    return word


Read = TypeVar("Read")


def _or_none(found: list[UserError], read: Callable[..., Read], *args: Any) -> Read | None:
    """What is read of a file; None, and what is wrong, where it cannot be."""
    with collected(found):
        return read(*args)
    return None


def _is_to_train(frame: object) -> bool:
    return isinstance(frame, dict) and frame.get("split", "train") == "train"


def _render(top: dict[str, Any], file: Path) -> dict[str, Any]:
    render = top.get("render", {})
    if not isinstance(render, dict):
        raise UserError("'render' is not an object", file, "Remove it if it is unknown")
    return render


def _coverage(top: dict[str, Any], file: Path) -> float | None:
    if top.get("coverage") is None:
        return None
    try:
        share = number(top, "coverage", str(file))
    except UserError:
        share = -1.0
    if not 0 <= share <= 1:
        raise UserError("'coverage' is not a number from 0 to 1", file, "Set it to null")
    return share


def _light_by_depth(top: dict[str, Any], file: Path) -> tuple[float, ...]:
    """The shares in the file; none where it has none, as those of unbake 0.1.0 and older."""
    shares = top.get("light_by_depth") or []
    what = "'light_by_depth' is not a list of shares from 0 to 1 that ends at 1"
    error = UserError(what, file, "Remove it if it is unknown")
    if not isinstance(shares, list):
        raise error
    if not all(isinstance(x, int | float) and not isinstance(x, bool) for x in shares):
        raise error
    rises = all(a <= b for a, b in zip([0, *shares], [*shares, 1], strict=True))
    if shares and (not rises or shares[-1] != 1):
        raise error
    return tuple(map(float, shares))
