"""Results for other programs: textures, glTF, OpenUSD, and scenes for Mitsuba without unbake."""

from typing import Literal, get_args

#: Of `export.json`.
EXPORT_FORMAT = 1

Format = Literal["gltf", "textures", "mitsuba", "usd"]
FORMATS: tuple[Format, ...] = get_args(Format)
DEFAULT_FORMATS: tuple[Format, ...] = ("gltf", "textures")
#: Texels along an edge of a texture, at most.
LARGEST_TEXTURE = 8192
