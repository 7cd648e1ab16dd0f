"""Mitsuba scenes in Mitsuba's own parsed form (`mi.parser`): read, instantiated, written."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError


@dataclass
class ParsedScene:
    """A scene before it is instantiated: nodes that `edit` can change."""

    path: Path
    config: mi.parser.ParserConfig
    state: mi.parser.ParserState

    def instantiate(self) -> mi.Scene:
        """Make the scene, once: the nodes cannot be used again.

        Equal materials become one, and meshes that share a material one mesh: tracing a step takes
        longer with every object that a ray can hit.

        Raises:
            UserError: Mitsuba cannot instantiate the scene.
        """
        try:
            mi.parser.transform_merge_equivalent(self.config, self.state)
            mi.parser.transform_merge_meshes(self.config, self.state)
            scene = mi.parser.instantiate(self.config, self.state)
        except RuntimeError as error:
            # Mitsuba 3.9: emitters that were made although their shapes were not crash the process
            # in the next virtual call. They live as long as the nodes, which this error keeps.
            self.state = mi.parser.ParserState()
            reason = _reason(error)
            if "not been instantiated" in reason:
                # Mitsuba 3.9 loads in parallel and may report an error that another one caused.
                reason = _serial_reason(self.path) or reason
            raise UserError(f"Mitsuba cannot make this scene: {reason}", self.path) from None
        scene = scene[0] if isinstance(scene, list) else scene
        box = np.ravel([scene.bbox().min, scene.bbox().max])
        if not np.isfinite(box).all():
            raise UserError("the scene has no shapes, or one without end", self.path)
        return scene

    def principled_nodes(self) -> list:
        """The BSDF nodes whose textures can be replaced."""
        return [n for n in self.state.nodes if n.props.plugin_name() == "principled"]


def parse(path: Path) -> ParsedScene:
    """Parse a Mitsuba XML scene and resolve its references.

    Raises:
        UserError: the file is missing or is not a Mitsuba scene, or has a number that is not
            finite.
    """
    if not path.is_file():
        raise UserError("no such scene file", where=path)
    config = mi.parser.ParserConfig(mi.variant())
    try:
        state = mi.parser.parse_file(config, str(path))
        mi.parser.transform_upgrade(config, state)
        mi.parser.transform_resolve(config, state)
    except RuntimeError as error:
        raise UserError(f"not a scene that Mitsuba can read: {_reason(error)}", path) from None
    scene = ParsedScene(path, config, state)
    _require_finite(scene)
    _resolve_files(scene)
    return scene


def write(scene: ParsedScene, folder: Path) -> Path:
    """Write the scene and copies of all its files into a folder, as `scene.xml`.

    Raises:
        UserError: a file that the scene names is missing.
    """
    try:
        mi.parser.transform_relocate(scene.config, scene.state, str(folder))
        mi.parser.write_file(scene.state, str(folder / "scene.xml"))
    except RuntimeError as error:
        raise UserError(f"cannot be copied: {_reason(error)}", scene.path) from None
    return folder / "scene.xml"


def referenced(scene: ParsedScene, value: Any) -> Any | None:
    """The node that a property refers to; None if it is no reference."""
    return scene.state.nodes[value.index()] if is_reference(value) else None


def is_reference(value: object) -> bool:
    """Whether the value of a property is a reference to another node."""
    return isinstance(value, mi.Properties.ResolvedReference)


def _serial_reason(path: Path) -> str | None:
    """The error of instantiating a scene on one thread; None if there is none."""
    scene = parse(path)
    scene.config.parallel = False
    try:
        mi.parser.instantiate(scene.config, scene.state)
    except RuntimeError as error:
        scene.state = mi.parser.ParserState()
        return _reason(error)
    return None


def _resolve_files(scene: ParsedScene) -> None:
    """Make file names absolute: Mitsuba would look for them in the working directory."""
    folder = scene.path.parent.resolve()
    for node in scene.state.nodes:
        for key in list(node.props):
            value = node.props[key]
            if not isinstance(value, str):
                continue
            file = folder / value
            if value and file.is_file():
                node.props[key] = str(file)
            elif key == "filename":
                where = mi.parser.file_location(scene.state, node)
                raise UserError(f"the file {value!r} does not exist", where=where)


def _require_finite(scene: ParsedScene) -> None:
    for node in scene.state.nodes:
        for key in list(node.props):
            if not _is_finite(node.props[key]):
                raise UserError(
                    f"{node.props.plugin_name()}.{key} has a number that is not finite",
                    mi.parser.file_location(scene.state, node),
                    "Correct it",
                )


def _is_finite(value: Any) -> bool:
    if hasattr(value, "wavelengths"):  # a spectrum: its class has no name of its own
        value = value.values
    elif dr.is_array_v(value):
        value = np.array(value)
    elif isinstance(value, mi.ScalarAffineTransform4d):
        value = np.array(value.matrix)
    elif not isinstance(value, float):
        return True
    return bool(np.isfinite(value).all())


def _reason(error: Exception) -> str:
    """Mitsuba's message on one line, without positions in its C++ source."""
    text = " ".join(re.sub(r"\[\w+\.(cpp|h):\d+\]", "", str(error)).split())
    return text[:300] or type(error).__name__
