# Dr.Jit as an untyped library: see the stub of mitsuba. In the stubs of Dr.Jit 1.5 arithmetic of
# arrays loses its type, `HashGridEncoding.data` is read-only and `freeze` returns a plain method.
from typing import Any

def __getattr__(name: str) -> Any: ...
