"""What is checked of a scene's XML before Mitsuba reads it.

Mitsuba 3.9 trusts a scene: it follows each `<include>` wherever that leads, needs a stack that
grows with nesting, and takes twice as long for each level of nested two-sided BSDFs.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

from ..errors import UserError
from .files import find, find_folder

#: Elements inside of each other, those that are referred to included.
DEPTH = 20
#: Elements of a scene with all its includes: reading takes Mitsuba ten seconds.
ELEMENTS = 200_000
#: Bytes of a scene with all its includes.
BYTES = 1 << 26
#: Files that include each other: each adds two to the depth of its elements.
INCLUDES = 5
#: Parameters of a scene (`<default>`), and characters of a value that they are put into.
PARAMETERS, CHARACTERS = 256, 1 << 16

_Where = Callable[[], str]
_ENCODINGS = ("utf-8", "us-ascii", "ascii")


def check_xml(path: Path, root: Path) -> list[Path]:
    """Check the XML of a scene and of all that it includes.

    Args:
        path: the scene.
        root: folder that what it includes must not leave, without links.

    Returns:
        Folders in which the scene wants its files to be searched, besides its own.

    Raises:
        UserError: a file is no XML that can be read, is not a scene, names files outside of `root`,
            or has more elements, levels or parameters than a scene has.
    """
    reader = _Reader(root)
    reader.read(path, [path.parent])
    reader.require_shallow(path)
    return reader.folders


class _Reader:
    """Walks through the elements in the order of Mitsuba, which gives parameters their values."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.folders: list[Path] = []
        self.bytes = self.count = self.includes = 0
        self.parameters: dict[str, str] = {}
        self.open: list[int] = []  # elements, from the root to the present one
        self.children: dict[int, list[int]] = {}
        self.ids: dict[str, int] = {}
        self.references: list[tuple[int, str]] = []  # elements, and the ids that they refer to

    def read(self, path: Path, folders: list[Path]) -> None:
        """Read one file; `folders` are searched for what it includes, in this order."""
        text = self._bytes(path)
        parser = expat.ParserCreate(namespace_separator=None)
        parser.buffer_text = True

        def where() -> str:
            return f"{path} (line {parser.CurrentLineNumber}, col {parser.CurrentColumnNumber + 1})"

        def declared(version: str, encoding: str | None, standalone: int) -> None:
            if encoding is not None and encoding.lower() not in _ENCODINGS:
                raise UserError(f"the encoding is {encoding!r}", path, "Save it as UTF-8")

        def refuse_types(*_: object) -> NoReturn:
            raise UserError("a scene has no document type or entities", where(), "Remove <!DOCTYPE")

        def start(tag: str, attributes: dict[str, str]) -> None:
            self._start(tag, attributes, path, where, folders)

        parser.XmlDeclHandler = declared
        parser.StartDoctypeDeclHandler = refuse_types
        parser.StartElementHandler = start
        parser.EndElementHandler = lambda _: self.open.pop()
        try:
            parser.Parse(text, True)
        except expat.ExpatError as error:
            raise UserError(f"not a scene that Mitsuba can read: {error}", path) from None

    def require_shallow(self, path: Path) -> None:
        """Raise a `UserError` for a chain of references that is too long, or has no end."""
        graph = self.children
        for parent, name in self.references:
            if name in self.ids:
                graph[parent].append(self.ids[name])
        depth: dict[int, int] = {}
        try:
            for number in TopologicalSorter(graph).static_order():
                inside = graph.get(number, ())
                depth[number] = 1 + max((depth[child] for child in inside), default=0)
        except CycleError:
            raise UserError("elements refer to each other in a circle", path, "Undo it") from None
        if max(depth.values(), default=0) > DEPTH:
            _too_deep(path)

    def _bytes(self, path: Path) -> bytes:
        try:
            with path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                content = file.read(min(size, BYTES + 1 - self.bytes))
        except OSError as error:
            raise UserError(f"the file cannot be read ({error.strerror})", path) from None
        self.bytes += len(content)
        if self.bytes > BYTES:
            raise UserError(f"the scene has more than {BYTES >> 20} MiB of XML", path)
        try:
            text = content.decode("utf-8")
        except UnicodeDecodeError as error:
            said = f"not a scene that Mitsuba can read: byte {error.start} is not UTF-8"
            raise UserError(said, path, "Save it as UTF-8") from None
        if "\0" in text:
            raise UserError("not a scene that Mitsuba can read: it has a zero byte", path)
        return content

    def _start(
        self, tag: str, attributes: dict[str, str], path: Path, where: _Where, folders: list[Path]
    ) -> None:
        number = self.count
        self.count += 1
        if self.count > ELEMENTS:
            raise UserError(f"the scene has more than {ELEMENTS} elements", where())
        if number == 0 and tag != "scene":
            said = f"not a scene that Mitsuba can read: its root is <{tag[:40]}>, not <scene>"
            raise UserError(said, path)
        if self.open:
            self.children[self.open[-1]].append(number)
        self.open.append(number)
        self.children[number] = []
        if len(self.open) > DEPTH:
            _too_deep(where())
        values = {key: self._substituted(value, where) for key, value in attributes.items()}
        self._refer(tag, values, number)
        if tag == "default":
            self._define(values, where)
        elif tag == "include" and "filename" in values:
            included = find(values["filename"], folders, self.root, where())
            self._include(included, folders, where)
        elif tag == "path" and "value" in values:
            folder = find_folder(values["value"], folders, self.root, where())
            folders.insert(0, folder)
            self.folders.insert(0, folder)
        elif tag == "spectrum" and "type" not in values and "filename" in values:
            find(values["filename"], folders, self.root, where())

    def _refer(self, tag: str, values: dict[str, str], number: int) -> None:
        if tag == "alias":
            self.ids[values.get("as", "")] = self.ids.get(values.get("id", ""), number)
        elif tag == "ref":
            self.references.append((number, values.get("id", "")))
        elif "id" in values:
            self.ids[values["id"]] = number

    def _include(self, file: Path, folders: list[Path], where: _Where) -> None:
        self.includes += 1
        if self.includes > INCLUDES:
            said = f"more than {INCLUDES} files include each other"
            raise UserError(said, where(), "Does one include itself?")
        self.read(file, [file.parent, *folders])
        self.includes -= 1

    def _define(self, values: dict[str, str], where: _Where) -> None:
        self.parameters.setdefault(values.get("name", ""), values.get("value", ""))
        if len(self.parameters) > PARAMETERS:
            raise UserError(f"the scene has more than {PARAMETERS} parameters", where())

    def _substituted(self, value: str, where: _Where) -> str:
        """A value with parameters (`$name`) put in as Mitsuba does: those of long names first."""
        if "$" not in value:
            return value
        for name in sorted(self.parameters, key=len, reverse=True):
            new, key = self.parameters[name], rf"(?<!\\)\${re.escape(name)}"
            if len(value) + value.count(f"${name}") * len(new) > CHARACTERS:
                raise UserError(f"a value has more than {CHARACTERS} characters", where())
            value = re.sub(key, lambda _, new=new: new, value)
        return value.replace("\\$", "$")


def _too_deep(where: object) -> NoReturn:
    raise UserError(f"elements are nested more than {DEPTH} deep", where, "Nest fewer BSDFs")
