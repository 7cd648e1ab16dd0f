"""The paper's scenes, with substitutes for those that are not published, and their data sets."""

from __future__ import annotations

import hashlib
import lzma
import shutil
import tarfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

import mitsuba as mi
import numpy as np

from ..acquisition.capture import capture
from ..acquisition.settings import LIGHT_PIXELS, LIGHT_SAMPLES, CaptureSettings
from ..config import FitConfig, from_toml
from ..dataset.data_folder import DataFolder
from ..dataset.views import Dataset
from ..errors import UserError
from ..imaging.pictures import read_exr, tonemap, write_exr, write_png
from ..scene.edit import to_principled
from ..scene.parse import ParsedScene, parse, referenced, write
from .experiment import ExperimentContext
from .jobs import Findings, Job, digest
from .scales import SMOKE
from .speed import capture_seconds

_CAMERAS = Path(__file__).parent / "cameras"

#: Settings at cpu scale: the defaults, without pictures while a fit is timed.
_CPU = "preview_seconds = 600.0"


@final
@dataclass(frozen=True)
class PaperScene:
    """A scene of the paper.

    Args:
        name: its name in the paper.
        folder: folder of the published scene, or its archive FOLDER.tar.xz. The camera file has the
            same name.
        file: scene file in the folder.
        room: whether the cameras stand inside.
        views: number of training views; six more are held out.
        steps: length of the paper's fits.
        spp: samples per pixel of the photographs at cpu scale. Scenes with difficult light need
            more: in the relative loss, pixels that are too dark by noise weigh more than pixels
            that are too bright.
        stands_in: name of the substitute if the paper's scene is not published, otherwise empty.
        albedo_power: exponent that is applied to every albedo. The authors raised the albedo of
            STAIRCASE; a value below 1 does so.
        environment: environment map of `envmaps_blender` that replaces the scene's own.
        cut_outs: whether it has opacities that are fractions, which Mitsuba's `path` renders wrong
            (see `path_integrator`).
    """

    name: str
    folder: str
    file: str
    room: bool
    views: int
    steps: int
    spp: int = 64
    stands_in: str = ""
    albedo_power: float = 1.0
    environment: str | None = None
    cut_outs: bool = False

    @property
    def label(self) -> str:
        """The name in tables."""
        return f"{self.name} ({self.stands_in})" if self.stands_in else self.name

    @property
    def cameras(self) -> Path:
        """The camera file, with all training and held-out views."""
        return _CAMERAS / f"{self.folder}.json"

    @property
    def lit_by(self) -> str | None:
        """The light that replaces the scene's own; None for rooms."""
        return None if self.room else self.environment or "its own map, clamped at zero"

    def require(self, context: ExperimentContext) -> None:
        """Check that the scene is there, before anything takes hours.

        Raises:
            UserError: it is missing.
        """
        for name in (self.folder, "envmaps_blender") if self.environment else (self.folder,):
            _published(context, name)

    def unpacked(self, context: ExperimentContext) -> Path:
        """The XML file of the scene, with the changes to the published one.

        Raises:
            UserError: the published scene is missing or damaged.
        """
        source = _unpacked(context, self.folder) / self.file
        if not source.is_file():
            raise UserError("the published scene lacks this file", source)
        if self.room and self.albedo_power == 1.0:
            return source
        changes = {"power": self.albedo_power, "lit_by": self.lit_by}
        changed = context.work / "scenes" / f"{self.folder}-{digest(changes)}"
        if not (changed / "scene.xml").is_file():
            changed.mkdir(parents=True, exist_ok=True)
            parsed = parse(source)
            to_principled(parsed)
            if self.albedo_power != 1.0:
                _raise_albedo(parsed, self.albedo_power, changed)
            if not self.room:
                map_ = None
                if self.environment:
                    map_ = _unpacked(context, "envmaps_blender") / self.environment
                _set_environment(parsed, map_, changed)
            write(parsed, changed)
        return changed / "scene.xml"

    def settings(self, context: ExperimentContext) -> FitConfig:
        """The settings of fits, except for method and length."""
        match context.scale:
            case "smoke":
                return from_toml(SMOKE)
            case "cpu":
                return from_toml(_CPU)
        pixels, spp = (16384, 16) if self.folder == "staircase" else (4096, 64)
        return from_toml(f'preset = "paper"\npixels = {pixels}\nspp = {spp}\n')

    def capture_settings(self, context: ExperimentContext) -> CaptureSettings:
        """How photographs are rendered."""
        size = context.pick(16, 256 if self.folder == "staircase" else 128, 512)
        spp = context.pick(4, self.spp, 8 * self.spp)
        return CaptureSettings(resolution=size, spp=spp, max_depth=64)

    def described(
        self, context: ExperimentContext, shots: CaptureSettings | None = None
    ) -> dict[str, Any]:
        """Everything that the data set depends on."""
        integrator = {"integrator": "volpath"} if self.cut_outs else {}
        return integrator | {
            "photographs": asdict(shots or self.capture_settings(context)),
            "albedo_power": self.albedo_power,
            "lit_by": self.lit_by,
            # Data sets of before do not tell the light of their paths.
            "light_by_depth": [LIGHT_PIXELS, LIGHT_SAMPLES],
            "cameras": hashlib.sha256(self.cameras.read_bytes()).hexdigest(),
        }

    def data(self, context: ExperimentContext, shots: CaptureSettings | None = None) -> Path:
        """The folder of the data set; each combination of settings has its own."""
        name = f"{self.folder}-{digest(self.described(context, shots))}"
        return context.work / "data" / name

    def captured(self, context: ExperimentContext, shots: CaptureSettings | None = None) -> Path:
        """Render the data set if it is not there, and return its folder."""
        folder = self.data(context, shots)
        if not folder.exists():
            capture(
                str(self.unpacked(context)),
                folder,
                shots or self.capture_settings(context),
                cameras=self.cameras,
                tell=context.tell,
            )
        return folder

    def capture(self, context: ExperimentContext) -> Job:
        """The job that renders the data set, unless another experiment has done so.

        Raises:
            UserError: the published scene is missing.
        """
        self.require(context)
        shots, folder = self.capture_settings(context), self.data(context)

        def work() -> Findings:
            dataset = Dataset.load(self.captured(context))
            return {"train": len(dataset.train), "heldout": len(dataset.heldout)}

        samples = (self.views + 6) * shots.resolution**2 * shots.spp
        seconds = 1.0 if folder.exists() else capture_seconds(samples)
        return Job(
            f"{self.folder}-data",
            self.described(context),
            work,
            context.pick(seconds, seconds, None),
            files=[DataFolder(folder).transforms_file],
            group=self.folder,
        )


STAIRCASE = PaperScene(
    "STAIRCASE",
    "staircase",
    "scene_principled.xml",
    room=True,
    views=26,
    steps=18_000,
    albedo_power=0.7,  # benchmarks/staircase_albedo.py
)
SCENES = (
    STAIRCASE,
    PaperScene(
        "KITCHEN",
        "kitchen",
        "scene_principled.xml",
        room=True,
        views=62,
        steps=32_000,
        spp=256,
        cut_outs=True,
    ),
    PaperScene(
        "LIVING ROOM",
        "living-room-2",
        "scene_principled.xml",
        room=True,
        views=64,
        steps=32_000,
        spp=192,
        cut_outs=True,
    ),
    PaperScene(
        "VEACH DOOR",
        "veach-ajar",
        "scene_principled.xml",
        room=True,
        views=19,
        steps=32_000,
        spp=1024,
    ),
    PaperScene(
        "LEGO",
        "lego",
        "scene_principled.xml",
        room=False,
        views=25,
        steps=10_000,
        environment="studio.exr",
    ),
    PaperScene(
        "HOTDOG",
        "vegboard",
        "scene_mi3.xml",
        room=False,
        views=25,
        steps=10_000,
        stands_in="vegboard",
    ),
    PaperScene(
        "FICUS",
        "plant",
        "scene_mi3.xml",
        room=False,
        views=25,
        steps=10_000,
        stands_in="plant",
        cut_outs=True,
    ),
    PaperScene("DRAGON", "dragon", "scene_mi3.xml", room=False, views=25, steps=10_000),
)


def scenes_at(context: ExperimentContext) -> tuple[PaperScene, ...]:
    """The scenes of an experiment: those that are chosen, or all, or at smoke scale the quickest.

    Raises:
        UserError: there is no scene of a chosen name.
    """
    known = {scene.folder: scene for scene in SCENES}
    unknown = [name for name in context.only if name not in known]
    if unknown:
        what = f"there is no scene {' or '.join(map(repr, unknown))}"
        raise UserError(what, "--only", f"The scenes are {', '.join(known)}")
    if context.only:
        return tuple(scene for name, scene in known.items() if name in context.only)
    return SCENES[-1:] if context.scale == "smoke" else SCENES


def _published(context: ExperimentContext, name: str) -> Path:
    """The folder of a published scene, or its archive if there is no folder."""
    folder, archive = context.scenes / name, context.scenes / f"{name}.tar.xz"
    for place in (folder, context.out / "work" / "published" / name):
        if place.is_dir():
            return place
    if not archive.is_file():
        remedy = "--scenes names a folder with the scenes, unpacked or as .tar.xz"
        raise UserError(f"there is no published scene {name!r} here", context.scenes, remedy)
    return archive


def _unpacked(context: ExperimentContext, name: str) -> Path:
    """The folder of a published scene. Unpacks the archive if there is no folder."""
    place = _published(context, name)
    if place.is_dir():
        return place
    own = context.out / "work" / "published" / name
    partial = own.with_name(f"{name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        with tarfile.open(place) as file:
            file.extractall(partial, filter="data")
        (partial / name).rename(own)
    except (tarfile.TarError, lzma.LZMAError, EOFError, OSError) as error:
        what = f"the archive cannot be unpacked to a folder {name!r} ({error})"
        raise UserError(what, place, "Get it again, or unpack it by hand") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return own


def _raise_albedo(scene: ParsedScene, power: float, folder: Path) -> None:
    """Apply an exponent to every albedo, colours and bitmaps, in linear RGB."""
    done = set()  # several materials may share a texture
    for node in scene.principled_nodes():
        colour = node.props["base_color"]
        node_of_texture = referenced(scene, colour)
        if node_of_texture is None:
            node.props["base_color"] = mi.ScalarColor3d([c**power for c in colour])
            continue
        if colour.index() in done:
            continue
        done.add(colour.index())
        texture = node_of_texture.props
        if "filename" not in texture:
            raise UserError("an albedo is a texture that is no bitmap", scene.path)
        source = Path(texture["filename"])
        raised = folder / "raised" / f"{colour.index()}-{source.stem}.png"
        rgb = (mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
        linear = np.array(mi.Bitmap(str(source)).convert(*rgb))
        write_png(raised, tonemap(linear**power))
        texture["filename"] = str(raised)


def _set_environment(scene: ParsedScene, map_: Path | None, folder: Path) -> None:
    """Light the scene with an environment map, or its own one, with negative texels set to zero."""
    for node in scene.state.nodes:
        if node.props.plugin_name() == "envmap":
            file = map_ or Path(node.props["filename"])
            texels = read_exr(file)[..., :3]
            own = folder / "light" / file.name
            write_exr(own, np.maximum(texels, 0))
            node.props["filename"] = str(own)
            return
    raise UserError("the scene has no environment map to replace", scene.path)
