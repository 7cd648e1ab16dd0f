"""Mistakes that poses are often written with: axes, units, and the direction of the matrix."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .camera import Camera

#: From OpenCV's cameras, which look along z with y down, to OpenGL's.
OPENCV = np.diag([1.0, -1.0, -1.0])
#: Other flips of a camera's axes: of two at a time, as poses are rotations.
_FLIPS = {
    "in OpenCV's axes (negate columns 2 and 3 of the matrix)": OPENCV,
    "upside down (negate columns 1 and 2 of the matrix)": np.diag([-1.0, -1.0, 1.0]),
    "looking backwards (negate columns 1 and 3 of the matrix)": np.diag([-1.0, 1.0, -1.0]),
}
#: A quarter turn about x, either way: between worlds whose z and whose y points up.
_TURNS = {
    "z up (turn them by -90° about x: y, z become z, -y)": (
        np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    ),
    "y up (turn them by 90° about x: y, z become -z, y)": (
        np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    ),
}
#: What turns the mesh of an import instead, in the same order: an option, and what else does where
#: the mesh was imported with it, or without. A data set does not tell which of both it was.
_TURNS_OF_MESH = (
    ("--mesh-y-up", "if it had that already, keep it and add"),
    ("without --mesh-y-up", "if it was without, add"),
)
_INVERTED = "from world to camera (invert the matrices)"
#: Units that are taken for each other: millimetres, centimetres, inches, decimetres, metres.
UNITS = (0.001, 0.01, 0.0254, 0.1, 10.0, 1 / 0.0254, 100.0, 1000.0)


@dataclass(frozen=True, eq=False)
class Mistake:
    """What poses may have been written with, and how they are without it.

    Args:
        parts: what was done, a phrase each.
        scale: that positions must be multiplied by.
        turn: (3, 3), of the world.
        flip: (3, 3), of the camera's axes.
        inverted: whether matrices lead from world to camera.
        centre: (3,), about which the world is turned and scaled.
    """

    parts: tuple[str, ...]
    scale: float = 1.0
    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    flip: np.ndarray = field(default_factory=lambda: np.eye(3))
    inverted: bool = False
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def told(self) -> str:
        """The mistake as the end of a sentence on poses."""
        return " and ".join(self.parts)

    def corrected(self, camera: Camera) -> Camera:
        """The camera without the mistake."""
        old = camera.to_world
        if self.inverted:
            old = np.eye(4)
            old[:3, :3] = camera.to_world[:3, :3].T
            old[:3, 3] = -old[:3, :3] @ camera.origin
        pose = np.eye(4)
        pose[:3, :3] = self.turn @ old[:3, :3] @ self.flip
        pose[:3, 3] = self.centre + self.scale * (self.turn @ (old[:3, 3] - self.centre))
        return replace(camera, to_world=pose)


def usual_mistakes(scales: Sequence[float]) -> list[Mistake]:
    """Mistakes with these scales and the common axes: single ones first, the most common first."""
    turns = {"": np.eye(3)} | {f"of a world with {up}": turn for up, turn in _TURNS.items()}
    opencv = next(iter(_FLIPS))
    return _simplest_first(turns, scales, {"": np.eye(3), opencv: OPENCV})


def all_mistakes(centre: np.ndarray | None = None) -> list[Mistake]:
    """All 24 turns of the world with all flips of the camera; usual ones in other units; inverses.

    Those of fewer parts come first.

    Args:
        centre: of the mesh, (3,), about which it may have been turned, too; None: it is the origin.
    """
    turns = {_turn_told(turn): turn for turn in _rotations()}
    flips = {"": np.eye(3)} | _FLIPS
    inverted = [
        Mistake((_INVERTED, *([told] if told else [])), flip=flip, inverted=True)
        for told, flip in list(flips.items())[:2]
    ]
    axes = _simplest_first(turns, (1.0,), flips)
    units = [m for m in usual_mistakes(UNITS) if m.scale != 1]
    turned = [] if centre is None else _turned_meshes(centre)
    every = [*axes, *units, *inverted, *turned]
    return sorted(every, key=lambda mistake: len(mistake.parts))


def _turned_meshes(centre: np.ndarray) -> list[Mistake]:
    """The mesh turned about its own centre (3,), in all ways that take axes to axes."""
    found = []
    for turn in _rotations():
        if np.array_equal(turn, np.eye(3)):
            continue
        back = np.eye(4)
        back[:3, :3], back[:3, 3] = turn.T, centre - turn.T @ centre
        remedy = f"turn it back, about the centre of its box: import {_as_words(back)}"
        told = f"of a mesh that is turned about its centre ({remedy})"
        found.append(Mistake((told,), turn=turn, centre=centre))
    return found


def _as_words(matrix: np.ndarray) -> str:
    """The option of an import that moves the mesh by a matrix (4, 4)."""
    numbers = " ".join(f"{number + 0.0:.7g}" for number in matrix.ravel().tolist())
    return f"--mesh-matrix {numbers}"


def _simplest_first(
    turns: dict[str, np.ndarray], scales: Sequence[float], flips: dict[str, np.ndarray]
) -> list[Mistake]:
    found = []
    for (turned, turn), scale, (flipped, flip) in itertools.product(
        turns.items(), scales, flips.items()
    ):
        units = f"in other units (multiply positions by {scale:g})" if scale != 1 else ""
        parts = tuple(filter(None, (flipped, units, turned)))
        if parts:
            found.append(Mistake(_or_the_mesh(parts, scale, turn), scale, turn, flip))
    return sorted(found, key=lambda mistake: len(mistake.parts))


def _or_the_mesh(parts: tuple[str, ...], scale: float, turn: np.ndarray) -> tuple[str, ...]:
    """The phrases, the last of which also says how to import the mesh for poses as they are."""
    known = zip(_TURNS.values(), _TURNS_OF_MESH, strict=True)
    options = [f"--mesh-scale {1 / scale:g}"] if scale != 1 else []
    if not np.array_equal(turn, np.eye(3)):
        back = np.eye(4)
        back[:3, :3] = turn.T
        short = [told for other, told in known if np.array_equal(turn, other)]
        options += [f"{option}; {else_} {_as_words(back)}" for option, else_ in short]
        options += [] if short else [_as_words(back)]
    if not options:
        return parts
    last = parts[-1].removesuffix(")")
    return (*parts[:-1], f"{last}; or the mesh: import {' '.join(options)})")


def _rotations() -> Iterator[np.ndarray]:
    """The 24 rotations that take axes to axes."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(turn) > 0:
                yield turn


def _turn_told(turn: np.ndarray) -> str:
    """What a turn of the world corrects; nothing for the identity."""
    if np.array_equal(turn, np.eye(3)):
        return ""
    for up, known in _TURNS.items():
        if np.array_equal(turn, known):
            return f"of a world with {up}"
    axes = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.argmax(np.abs(row)))]}" for row in turn]
    return f"of a world with other axes (turn them: take {', '.join(axes)} as x, y, z)"
