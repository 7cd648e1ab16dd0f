# Mitsuba as an untyped library. The stubs of Mitsuba 3.9.1 name types of the scalar variant where
# arrays are meant (`seed: UInt`), take two classes of one name (`mitsuba.Float` of its plugins and
# of Dr.Jit) for different ones, and lack attributes (`has_vertex_texcoords`). With them, pyright
# reports 200 mistakes that are none.
from typing import Any

def __getattr__(name: str) -> Any: ...
