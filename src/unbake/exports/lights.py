"""The lights of a scene with the strengths that a fit recovered."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..fields.emission import Pattern
from ..scene.emitters import (
    ENVIRONMENTS,
    emitter_nodes,
    environment_latlong,
    environment_rows,
    named_emitters,
    placement,
)
from ..scene.parse import ParsedScene
from ..training.problem import Problem

#: Rows of the picture of an environment, at least, and at most where the scene has one of more.
ROWS, _MOST_ROWS = 256, 1024


@dataclass(frozen=True, eq=False)
class Light:
    """An emitter of `scene.emitters.STRENGTHS`."""

    name: str
    node: int
    plugin: str
    strength: tuple[float, float, float] | None  #: linear RGB, maybe a mean; None: unknown
    varies: bool  #: over its surface
    pattern: Pattern | None  #: how, where it was recovered
    recovered: bool
    to_world: np.ndarray  #: (4, 4); lights look along +z
    angles: tuple[float, float]  #: of the cone of a spot, to its full and to no light, radians

    @property
    def pose(self) -> np.ndarray:
        """Where it stands without its scale, as glTF and OpenUSD say: it looks along -z, (4, 4)."""
        matrix = self.to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])
        matrix[:3, :3] /= np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-30)
        return matrix


def read_lights(scene: ParsedScene, problem: Problem) -> list[Light]:
    """The lights of a scene, without an environment where one was recovered.

    Args:
        scene: as it was parsed; its strengths must not have been replaced.
        problem: of the fit.
    """
    found = []
    recovered = None if problem.emission is None else np.array(problem.emission.values).T
    nodes = scene.state.nodes
    there = [*zip(named_emitters(scene), emitter_nodes(scene), strict=True)]
    if problem.environment is not None:  # the fit has no lamp in the place of the scene's own
        there = [x for x in there if nodes[x[1]].props.plugin_name() not in ENVIRONMENTS]
    for i, (named, node) in enumerate(there):
        props = nodes[node].props
        strength, varies, pattern = named.strength, named.varies, None
        if recovered is not None and problem.emission is not None:
            pattern = problem.emission.patterns[i]
            varies = pattern is not None
            red, green, blue = (float(x) for x in recovered[i])
            strength = (red, green, blue)
        found.append(
            Light(
                named.name,
                node,
                props.plugin_name(),
                strength,
                varies,
                pattern,
                recovered is not None,
                placement(props),
                _cone(props),
            )
        )
    return found


def environment_picture(problem: Problem) -> np.ndarray | None:
    """The environment as Mitsuba's `envmap` reads it; None where there is none.

    It is the recovered one, or else the scene's own.
    """
    if problem.environment is not None:
        return problem.environment.to_latlong(max(ROWS, 2 * problem.environment.resolution))
    scene = problem.scene_view.scene
    environment = scene.environment()
    if environment is None:
        return None
    rows = min(environment_rows(environment), _MOST_ROWS)
    return environment_latlong(scene, max(ROWS, rows))


def turned_latlong(picture: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """An environment in turned axes: a direction d has the radiance of R⁻¹ d.

    Args:
        picture: (rows, 2 rows, 3) float32, as `envmap` reads it.
        rotation: R, (3, 3).
    """
    to_world = np.eye(4)
    to_world[:3, :3] = rotation
    environment = {
        "type": "envmap",
        "bitmap": mi.Bitmap(picture),
        "to_world": mi.ScalarTransform4f(to_world),
    }
    scene = mi.load_dict({"type": "scene", "environment": environment})
    return environment_latlong(scene, len(picture))


def _cone(props: mi.Properties) -> tuple[float, float]:
    outer = float(props.get("cutoff_angle", 20.0))
    inner = float(props.get("beam_width", outer * 3 / 4))
    return np.radians(inner), np.radians(outer)
