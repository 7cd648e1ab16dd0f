"""The folder of a data set: where its files lie, and what is read from and written to them.

    DATA/
      transforms.json                  cameras and images, in the layout of nerfstudio
      scene/                           the Mitsuba scene and its files
      images/VIEW.exr                  photographs; of cameras as .jpg, .png or .tif
      masks/VIEW.png                   zero where pixels do not count; only where there are masks
      truth/QUANTITY/VIEW.exr          true materials; a quantity that is not known has no folder
      truth/environment.exr            the true environment map
      truth/emission.json              the true strengths of lights
      degraded.json                    what `unbake degrade` did to photographs and poses
      .cache/                          decoded photographs, measured ceilings; can be deleted

`transforms.json` says where photographs and scene lie, so that those of another program may lie
elsewhere in the folder. No other module names these files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from ..errors import UserError
from ..formats import check_format
from ..io import inside, read_object, relative, require_utf8, write_json

#: The file that makes a folder a data set.
TRANSFORMS = "transforms.json"
#: The newest format of that file that can be read, and the one that is written.
FORMAT = 1

_MAKE_DATA = "Render a data set from a scene with `unbake capture SCENE --out DATA`"
#: What turns the folder of another program into a data set.
IMPORT = "`unbake import SOURCE --mesh MESH --out DATA` makes a data set of it"
#: What is found in the folders of other programs.
_FOREIGN = {
    "transforms_train.json": "Blender",
    "sparse": "COLMAP",
    "cameras.bin": "COLMAP",
    "cameras.txt": "COLMAP",
    "K_list.txt": "FIPT",
}
_KIND = "data folder"


@final
@dataclass(frozen=True)
class DataFolder:
    """The files of a data set.

    Args:
        path: the folder; it need not exist yet.
        allow_outside: read files that lie elsewhere, by their path or through links.
    """

    path: Path
    allow_outside: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))

    @property
    def transforms_file(self) -> Path:
        """Cameras and images."""
        return self.path / TRANSFORMS

    @property
    def scene(self) -> Path:
        """The folder of the scene, where the data set was captured."""
        return self.path / "scene"

    def image(self, view: str, suffix: str = ".exr") -> Path:
        """The photograph of a view, where the data set was captured or imported."""
        return self.path / "images" / f"{view}{suffix}"

    def mask(self, view: str) -> Path:
        """The mask of a view, where the data set was imported."""
        return self.path / "masks" / f"{view}.png"

    def truth(self, quantity: str, view: str) -> Path:
        """The true picture of a quantity, such as "albedo", in a view."""
        return self.path / "truth" / quantity / f"{view}.exr"

    @property
    def environment_file(self) -> Path:
        """The true environment map."""
        return self.path / "truth" / "environment.exr"

    @property
    def emission_file(self) -> Path:
        """The true strengths of lights."""
        return self.path / "truth" / "emission.json"

    @property
    def degraded_file(self) -> Path:
        """The truth of what photographs and poses were degraded by."""
        return self.path / "degraded.json"

    @property
    def cache(self) -> Path:
        """The folder of decoded photographs and of measured ceilings."""
        return self.path / ".cache"

    @property
    def cache_key(self) -> Path:
        """The input of the cache; it is written last."""
        return self.cache / "key.json"

    @property
    def cached_photographs(self) -> Path:
        """The pixels of all photographs."""
        return self.cache / "photographs.npy"

    @property
    def cached_foreground(self) -> Path:
        """The numbers of the pixels that see the scene."""
        return self.cache / "foreground.npy"

    def ceiling(self, key: str) -> Path:
        """What fields trained on the true maps score.

        Args:
            key: stands for the maps and the fields.
        """
        return self.cache / f"ceiling-{key}.json"

    def inside(self, name: str, where: str) -> Path:
        """The file that `transforms.json` names; it must lie in the folder.

        Args:
            where: the entry that names it, for error messages.

        Raises:
            UserError: `name` is not a path, or leads out of the folder.
        """
        return inside(self.path, name, where, _KIND, allow_outside=self.allow_outside)

    def known(self, file: str | Path) -> bool:
        """Whether there is such a file of the truth.

        Raises:
            UserError: it is a link that leads out of the folder.
        """
        file = Path(file)
        if not file.is_file():
            return False
        self.inside(file.relative_to(self.path).as_posix(), str(self.path))
        return True

    def require_own_cache(self) -> None:
        """Raise a `UserError` if the cache would be written through a link."""
        if self.cache.is_symlink() and not self.allow_outside:
            raise UserError(
                "the cache is a link, and nothing is written through it",
                self.cache,
                "Remove it, or pass --allow-outside",
            )

    def relative(self, file: str | Path) -> str:
        """How `transforms.json` names a file of the folder.

        Raises:
            UserError: the file lies outside the folder.
        """
        return relative(self.path, Path(file), _KIND)

    def read_transforms(self) -> dict[str, Any]:
        """The content of `transforms.json`, as it stands in the file.

        Raises:
            UserError: there is no data set, or the file is damaged or of a newer version.
        """
        require_utf8(self.path, _KIND)
        if self.path.is_file() and self.path.name == TRANSFORMS:
            remedy = f"Give its folder: {self.path.parent}"
            raise UserError("is a file, not a data folder", self.path, remedy)
        if self.path.is_file():
            raise UserError("is a file, not a data folder", self.path, _MAKE_DATA)
        if not self.path.is_dir():
            raise UserError("the data folder does not exist", self.path, "Check the path")
        file = self.transforms_file
        if not file.exists():
            programs = [_FOREIGN[name] for name in _FOREIGN if (self.path / name).exists()]
            told = f"It looks like one of {programs[0]}: {IMPORT}" if programs else None
            what = f"no {TRANSFORMS} in the folder"
            raise UserError(what, self.path, told or "Is this a data folder?")
        content = read_object(self.inside(TRANSFORMS, str(self.path)))
        check_format(content, FORMAT, file)
        if "scene" not in content and "frames" in content:
            what = "the key 'scene' is missing, as in files of nerfstudio and Blender"
            raise UserError(what, file, f"{IMPORT[0].upper()}{IMPORT[1:]}")
        return content

    def write_transforms(self, content: Mapping[str, Any]) -> None:
        """Write `transforms.json`, complete or not at all, and flushed to disk.

        Raises:
            UserError: the folder cannot be written.
            ValueError: a number is not finite.
        """
        described = {"format": FORMAT, **content}
        write_json(self.transforms_file, described, allow_nan=False, durable=True)
