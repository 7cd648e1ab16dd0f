"""Check a data set: all that is wrong with it at once, each with where and the remedy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, final

import mitsuba as mi
import numpy as np

from ..acquisition.coverage import BLACK, BLACK_BACKS, TURN_THEM, black_share, view_counts
from ..dataset.agreement import (
    Exposures,
    TurningLight,
    exposures,
    shared_points,
    turning_light,
)
from ..dataset.alignment import Alignment
from ..dataset.camera import Camera
from ..dataset.findings import (
    Check,
    Finding,
    light_that_turns,
    misaligned,
    noise_at_black,
    unequal_exposures,
)
from ..dataset.hot_pixels import told_hot_pixels, without_hot_pixels
from ..dataset.noise_at_black import found_noise
from ..dataset.own_poses import compared
from ..dataset.photographs import MOST_PIXELS, Photographs
from ..dataset.poses import check_cameras, pose_problems
from ..dataset.small_views import Seen, SmallView, block_of, seen_by, small_camera, small_view
from ..dataset.views import Dataset, View, fitted, read_masked
from ..errors import UserError, collected, named, printable
from ..progress import each_told, silent
from ..scene import edit, free_space
from ..scene.checked import checked_scene
from ..scene.normals import turned_share
from ..scene.parse import ParsedScene, parse
from .pictures import PictureFacts, blurred, percentage, picture_facts

Item = TypeVar("Item")

#: Share of the pixels of surfaces that may be clipped, of one view and of all; and of one view
#: where it is told from which value on they are.
_CLIPPED, _CLIPPED_IN_ALL, _CLIPPED_AND_TOLD = 0.05, 0.01, 0.25
#: The same of black pixels.
_BLACK, _BLACK_IN_ALL = 0.6, 0.3
#: Share of the surface that no view sees, above which it is told, and above which poses are wrong.
_UNSEEN, _ALL_UNSEEN = 0.3, 0.99
#: Share of the surface whose normals may be turned away from it.
_TURNED = 0.05
#: Cameras farther away than so many diagonals of the scene are doubtful.
_FAR = 20.0
#: Distance of cameras, in diagonals of the scene, and difference of the matrix of their axes, up to
#: which poses are the same.
_SAME = 1e-6
#: Stops by which the exposures of a bracket differ at least.
_BRACKET = 0.1


@final
@dataclass(frozen=True, eq=False)
class CheckedView:
    """A view with what was found of it.

    Args:
        view: of the data set.
        small: the same at low resolution, in radiance.
        facts: what its pixels tell.
        seen: what the pixels of the small view see.
        share: of the pixels that should see a surface, those that do, in [0, 1]; None where no
            pixel counts.
    """

    view: View
    small: SmallView
    facts: PictureFacts
    seen: Seen
    share: float | None


@final
@dataclass(eq=False)
class DataCheck:
    """What was found of a data set.

    Args:
        folder: of the data set.
        findings: what is wrong, errors first.
        dataset: what could be read of it; None if nothing could.
        scene: the scene; None if it cannot be used.
        views: that could be read.
        alignment: of edges; None where it cannot be told.
        exposures: of the views, relative to each other; None where there is no scene.
        light: whether it turns with the cameras; None where it cannot be told.
        coverage: shares of the reachable surface that 0, 1, 2 and more training views see.
        duplicates: pairs of views that are told as such.
    """

    folder: Path
    findings: list[Finding] = field(default_factory=list)
    dataset: Dataset | None = None
    scene: mi.Scene | None = None
    views: list[CheckedView] = field(default_factory=list)
    alignment: Alignment | None = None
    exposures: Exposures | None = None
    light: TurningLight | None = None
    coverage: tuple[float, float, float, float] | None = None
    duplicates: int = 0

    @property
    def usable(self) -> bool:
        """Whether a fit makes sense."""
        return all(finding.level != "error" for finding in self.findings)

    def count(self, level: str) -> int:
        """The number of findings of a level."""
        return sum(finding.level == level for finding in self.findings)

    def add(self, *findings: Finding | None) -> None:
        """Add what was found."""
        self.findings += [finding for finding in findings if finding is not None]

    def warn(
        self, check: Check, what: str, where: str | None = None, remedy: str | None = None
    ) -> None:
        """Add a warning."""
        self.add(Finding("warning", check, what, where, remedy))


def check_data(
    folder: str | Path,
    *,
    allow_outside: bool = False,
    clip_negative: bool = False,
    tell: Callable[[str], None] = silent,
) -> DataCheck:
    """Look for all that is wrong with a data set.

    Args:
        folder: of the data set.
        allow_outside: read files that lie outside of the folder.
        clip_negative: take negative pixels as zero.
        tell: called with lines of progress where photographs take long.

    Returns:
        What was found. Bad input is no exception here, but an error among the findings.
    """
    result = DataCheck(Path(folder))
    faults: list[UserError] = []
    with collected(faults):
        result.dataset = Dataset.load(folder, allow_outside=allow_outside, faults=faults)
    result.findings += _grouped(faults, Path(folder))
    if result.dataset is not None:
        _check_dataset(result, result.dataset, clip_negative, tell)
    order = ("error", "warning", "hint")
    result.findings.sort(key=lambda finding: order.index(finding.level))
    return result


def _grouped(faults: Sequence[UserError], folder: Path) -> list[Finding]:
    """One finding for all frames that have the same fault."""
    groups: dict[tuple[str, str | None], list[str]] = {}
    for fault in faults:
        where = (fault.where or "").removeprefix(f"{folder}/")
        groups.setdefault((fault.what, fault.remedy), []).append(where)
    return [
        Finding("error", "files", what, named([w for w in where if w]) or None, remedy)
        for (what, remedy), where in groups.items()
    ]


def _check_dataset(
    result: DataCheck, dataset: Dataset, clip_negative: bool, tell: Callable[[str], None]
) -> None:
    faults: list[UserError] = []
    parsed = scene = lost = None
    with collected(faults):
        parsed = parse(dataset.scene, dataset.root)
        lost = edit.lost_properties(parsed)
        scene, found = checked_scene(parsed, lit=dataset.light == "known")
        result.scene = scene
        faults += found
    if parsed is None or scene is None:
        result.findings += [replace(f, check="scene") for f in _grouped(faults, dataset.folder)]
        _check_files(result, dataset, clip_negative, tell)
        return
    _check_scene(result, dataset, parsed, scene, lost)
    count = sum(view.camera.width * view.camera.height for view in dataset.train)
    if count > MOST_PIXELS:
        what = f"the training views have {count:,} pixels, and a fit has {MOST_PIXELS:,} at most"
        remedy = "Use fewer views, or smaller images: `unbake import --longest` makes them"
        result.add(Finding("error", "size", what, None, remedy))
    cameras = [small_camera(view.camera) for view in dataset.views]
    pairs = zip(dataset.views, seen_by(scene, cameras), strict=True)
    for view, seen in _told(pairs, dataset, tell):
        with collected(faults):
            result.views.append(_checked(seen, dataset, view, result, clip_negative))
    result.findings += _grouped(faults, dataset.folder)
    result.add(noise_at_black(found_noise(dataset, clip_negative)))
    _check_masks(result)
    train = [v for v in result.views if v.view.split == "train"]
    if not train:
        return
    _check_poses(result, scene, train)
    _check_pictures(result)
    wrong = any(finding.check == "alignment" for finding in result.findings)
    if wrong and not (result.alignment and result.alignment.plausible):
        return  # with such poses, what views share and see is something else
    _check_light(result)
    result.coverage = _coverage(scene, train, hidden=dataset.background == "hidden")
    if result.coverage is not None and result.coverage[0] > _ALL_UNSEEN:
        what = "no training view sees anything of the scene, but a ground beneath it"
        remedy = "Check the axes of the poses and of the mesh: one of both may be upside down"
        result.add(Finding("error", "coverage", what, None, remedy))
    elif result.coverage is not None and result.coverage[0] > _UNSEEN:
        what = f"{100 * result.coverage[0]:.0f} % of the surface is seen by no training view"
        remedy = "What no photograph shows is guessed: take more, or accept that"
        result.warn("coverage", what, None, remedy)


def _check_scene(
    result: DataCheck, dataset: Dataset, parsed: ParsedScene, scene: mi.Scene, lost: str | None
) -> None:
    """Hints to what fits take the scene for, where that is not all that its file says."""
    where = str(dataset.scene).removeprefix(f"{dataset.folder}/")
    if parsed.repaired_normals:
        what = f"vertex normals that are not numbers: {parsed.repaired_normals}"
        remedy = "Normals of the triangles take their place. Compute them anew if you want others"
        result.add(Finding("hint", "normals", what, where, remedy))
    turned = turned_share(scene)
    if turned > _TURNED:
        what = f"{100 * turned:.0f} % of the surface is shaded as if its edges were round"
        remedy = "Give these meshes normals of their own, or their shapes 'face_normals'"
        result.add(Finding("hint", "normals", what, where, remedy))
    if parsed.media:
        what = f"participating media, which are left out: {parsed.media}"
        remedy = "Fog and murky glass go into the materials behind them"
        result.add(Finding("hint", "media", what, where, remedy))
    if lost is not None:
        what = f"fits make roughplastic principled, without {lost}"
        remedy = "What these change goes into the materials. Use principled BSDFs to choose others"
        result.add(Finding("hint", "scene", what, where, remedy))


def _told(each: Iterable[Item], dataset: Dataset, tell: Callable[[str], None]) -> Iterator[Item]:
    """What is checked of each view, in turn; lines tell how many photographs were read."""
    count = len(dataset.views)
    return each_told(each, count, lambda number: f"checking photographs: {number} of {count}", tell)


def _check_files(
    result: DataCheck, dataset: Dataset, clip_negative: bool, tell: Callable[[str], None]
) -> None:
    """What can be told of photographs without the scene: whether their pixels can be used."""
    faults: list[UserError] = []
    for view in _told(dataset.views, dataset, tell):
        with collected(faults):
            read_masked(view, clip_negative)
    result.findings += _grouped(faults, dataset.folder)


def _checked(
    seen: Seen, dataset: Dataset, view: View, result: DataCheck, clip_negative: bool
) -> CheckedView:
    camera, hidden = view.camera, dataset.background == "hidden"
    photograph, mask = read_masked(view, clip_negative)
    pixels = photograph.reshape(-1, 4)
    counted = fitted(photograph, mask, dataset.background, view).ravel()
    cleaned, hot_pixels = without_hot_pixels(pixels, counted, view.name, camera.width)
    if hot_pixels is not None and (told := told_hot_pixels([hot_pixels])):
        result.warn("hot pixels", told, None, "Remove them where they are no light that is seen")
    alpha = cleaned[:, 3] * counted if hidden else counted
    light = cleaned[:, :3] if view.exposure == 1 else cleaned[:, :3] / np.float32(view.exposure)
    small = small_view(view.name, camera, light, alpha, limit=view.limit)
    small = replace(small, of_mesh=view.mask_from_mesh)
    shape = (camera.height, camera.width)
    hit = np.isfinite(seen.distance)
    facts = picture_facts(
        pixels[:, :3].reshape(*shape, 3),
        _enlarged((hit & ~seen.emits).reshape(small.alpha.shape), camera),
        counted.reshape(shape),
        view.clipped,
    )
    wanted = (small.alpha > 0.5).ravel()
    share = float(hit[wanted].mean()) if wanted.any() else None
    return CheckedView(view, small, facts, seen, share)


def _check_masks(result: DataCheck) -> None:
    """Whether views have pixels that count, and a warning where only some have a mask."""
    empty = [v.view.name for v in result.views if not v.small.alpha.any()]
    remedy = "Masks are white where pixels count. Where the background is hidden, alpha says so"
    if empty and all(v.view.name in empty for v in result.views if v.view.split == "train"):
        what = "no pixel of any training view counts"
        result.add(Finding("error", "masks", what, None, remedy))
    elif empty:
        result.warn("masks", "no pixel of the view counts", named(empty), remedy)
    bare = [v.view.name for v in result.views if v.view.mask is None]
    if 0 < len(bare) < len(result.views):
        what = "the view has no mask, as others have"
        remedy = "Add 'mask_path' to the frame, if parts of it must not count"
        result.warn("masks", what, named(bare), remedy)


def _enlarged(
    mask: np.ndarray, camera: Camera, rest: Literal["constant", "edge"] = "constant"
) -> np.ndarray:
    """A mask of blocks as one of pixels; a remainder at the edges is False, or as beside it."""
    shape, block = (camera.height, camera.width), block_of(camera)
    large = mask.repeat(block, 0).repeat(block, 1)
    return np.pad(large, [(0, s - n) for s, n in zip(shape, large.shape, strict=True)], rest)


def _counted(view: CheckedView) -> np.ndarray | None:
    """Which pixels of a view count, row by row, (pixels,), by the blocks at or next to them.

    None: all.
    """
    some = view.small.alpha > 0
    return None if some.all() else _enlarged(some, view.view.camera, rest="edge").ravel()


# ------------------------------------------------------------------------------------------- poses


def _check_poses(result: DataCheck, scene: mi.Scene, train: list[CheckedView]) -> None:
    cameras = [v.small.camera for v in train]
    found = result.alignment = compared(scene, [v.small for v in train], cameras)
    better = misaligned(found)
    result.add(better)
    if better is None or (found is not None and found.plausible):
        # What is wrong with the poses is told once.
        hidden = result.dataset is not None and result.dataset.background == "hidden"
        for problem in _pose_problems(scene, train, hidden, result.folder):
            blind = not any(v.share for v in train)
            level = "error" if blind else "warning"
            result.add(Finding(level, "geometry", problem.what, problem.where, problem.remedy))
        inside = check_cameras(scene, {v.view.name: v.view.camera for v in result.views})
        if inside:
            what = "the camera seems to stand inside geometry"
            remedy = "Check the pose, or remove the frame"
            result.warn("geometry", what, named(inside), remedy)
        _check_distance(result, scene, train)
        black = black_share(scene, [v.view.camera for v in train])
        if black > BLACK:
            result.warn("geometry", f"{100 * black:.0f} % {BLACK_BACKS}", None, TURN_THEM)
    _check_duplicates(result, free_space.extent(scene)[2])


def _pose_problems(
    scene: mi.Scene, train: list[CheckedView], hidden: bool, folder: Path
) -> list[UserError]:
    views = [replace(v.view, camera=v.small.camera) for v in train]
    rgb = np.concatenate([v.small.rgb.reshape(-1, 3) for v in train])
    alpha = np.concatenate([v.small.alpha.ravel() > 0.5 for v in train])
    cameras = [v.camera for v in views]
    # Alpha says what counts: masked pixels do not, where the background is visible, too.
    small = Photographs.of(cameras, rgb, alpha, foreground_only=True, smoothed=False)
    return pose_problems(scene, views, small, folder, hidden=hidden)


def _check_distance(result: DataCheck, scene: mi.Scene, train: list[CheckedView]) -> None:
    low, high, diagonal = free_space.extent(scene)
    away = [np.linalg.norm(v.view.camera.origin - (low + high) / 2) / diagonal for v in train]
    if np.median(away) > _FAR:
        what = f"cameras stand {np.median(away):.0f} times the scene's extent away from it"
        remedy = "Check that positions have the units of the mesh"
        result.warn("units", what, None, remedy)


def _apart(a: float, b: float) -> bool:
    """Whether two exposures that the data set tells differ, as those of a bracket do."""
    return abs(math.log2(a / b)) > _BRACKET


def _check_duplicates(result: DataCheck, diagonal: float) -> None:
    cameras = [v.view.camera for v in result.views]
    origins = np.array([c.origin for c in cameras]) / diagonal
    axes = np.array([c.to_world[:3, :3] for c in cameras]).reshape(-1, 9)
    lenses = np.array([(c.fl_x, c.fl_y, c.cx, c.cy) for c in cameras])
    pairs: dict[tuple[str, str], list[str]] = {}  # by what is wrong, and the remedy
    alike: dict[Any, list[int]] = {}  # views by their file
    for i, one in enumerate(result.views):
        posed = np.abs(origins[:i] - origins[i]).max(axis=1, initial=0) <= _SAME
        posed &= np.abs(axes[:i] - axes[i]).max(axis=1, initial=0) <= _SAME
        twice = posed & (lenses[:i] == lenses[i]).all(axis=1)
        before = alike.setdefault(one.facts.digest, [])
        for j in sorted({*before, *np.flatnonzero(twice).tolist()}):
            other = result.views[j]
            pair = f"{printable(other.view.name)} and {printable(one.view.name)}"
            if one.facts.digest == other.facts.digest:
                if not one.small.rgb.any():  # black, which is told as such
                    continue
                what = "the photographs are the same" + (
                    "" if posed[j] else ", and their poses not"
                )
                remedy = "Remove one of them" if posed[j] else "Correct 'file_path' of one of them"
                pairs.setdefault((what, remedy), []).append(pair)
            else:
                bracket = _apart(one.view.exposure, other.view.exposure)
                same_split = one.view.split == other.view.split
                if bracket and same_split:
                    continue
                what = "two photographs have the same pose"
                what += "" if same_split else ", one for training and one held out"
                remedy = "Correct the pose of one, or leave one out"
                remedy = "Give all of a bracket the same 'split'" if bracket else remedy
                pairs.setdefault((what, remedy), []).append(pair)
        before.append(i)
    result.duplicates = sum(map(len, pairs.values()))
    for (what, remedy), names in pairs.items():
        result.warn("duplicates", what, named(names), remedy)


# -------------------------------------------------------------------------------------- photographs


def _check_pictures(result: DataCheck) -> None:
    views = result.views
    if not any(view.small.rgb.any() for view in views):
        remedy = "Check the lights, the cameras and the exposures that they were made with"
        result.add(Finding("error", "black", "all photographs are black", None, remedy))
        return
    told = all(view.view.clipped is not None for view in views)
    _share(
        result,
        "clipped",
        [_untold(v) for v in views],
        (_CLIPPED, _CLIPPED_IN_ALL),
        "of the pixels of surfaces are clipped: their light is not known",
        "Expose less" + ("" if told else ", or say from which value on they are ('clipped')"),
    )
    _share(
        result,
        "black",
        [v.facts.black for v in views],
        (_BLACK, _BLACK_IN_ALL),
        "of the pixels of surfaces are black",
        "Expose more, or check that the photographs are of these views",
    )
    soft = blurred([v.facts for v in views])
    if soft:
        remedy = "Leave them out: blur would be fitted as smoother materials"
        what = "much less sharp than the other views"
        result.warn("blur", what, named([views[i].view.name for i in soft]), remedy)


def _untold(view: CheckedView) -> float:
    """The clipped share of a view; 0 where it is told from which value on, and it is not much."""
    told = view.view.clipped is not None
    return 0.0 if told and view.facts.clipped < _CLIPPED_AND_TOLD else view.facts.clipped


def _share(
    result: DataCheck,
    check: Check,
    shares: list[float],
    limits: tuple[float, float],
    what: str,
    remedy: str,
) -> None:
    """A warning where one view has too much of something, or all have on average."""
    mean = float(np.mean(shares))
    worst = [i for i in np.argsort(shares)[::-1].tolist() if shares[i] > limits[0]]
    if not worst and mean <= limits[1]:
        return
    names = named([result.views[i].view.name for i in worst]) or None
    told = f"{percentage(max(shares) if worst else mean)} {what}"
    result.warn(check, ("up to " if worst else "") + told, names, remedy)


def _check_light(result: DataCheck) -> None:
    views = result.views
    points = shared_points([v.small for v in views], [v.seen for v in views])
    result.exposures = exposures(points, len(views))
    result.add(unequal_exposures(result.exposures, [v.view.name for v in views]))
    result.light = turning_light(points, result.exposures)
    result.add(light_that_turns(result.light))


def _coverage(
    scene: mi.Scene, train: list[CheckedView], *, hidden: bool
) -> tuple[float, float, float, float] | None:
    cameras, counted = [v.view.camera for v in train], map(_counted, train)
    counts = view_counts(scene, cameras, counted=counted, hide_emitters=hidden)
    if not len(counts):
        return None
    none, one, two = (float((counts == n).mean()) for n in range(3))
    return none, one, two, float((counts > 2).mean())
