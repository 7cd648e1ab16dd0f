"""The frame that the cameras of a source are in."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

import numpy as np

from ..errors import UserError
from ..io import array, number, read_object, require_file

#: Bytes of a file that a matrix may have.
_MOST = 1 << 16


@final
@dataclass(frozen=True, eq=False)
class World:
    """The frame that cameras of nerfstudio are in.

    Args:
        applied: what its reader takes for done to the world before cameras were written, (4, 4).
        scale: that it takes positions to have been multiplied by after that.
        undone: what took cameras from the frame of the file to theirs, (4, 4) a similarity.
        put_back: whether that is more than nothing.
        notes: what the user should know of it.
    """

    applied: np.ndarray = field(default_factory=lambda: np.eye(4))
    scale: float = 1.0
    undone: np.ndarray = field(default_factory=lambda: np.eye(4))
    put_back: bool = False
    notes: tuple[str, ...] = ()

    def camera(self, pose: np.ndarray) -> np.ndarray:
        """A pose (4, 4) of the file, in the frame of cameras."""
        if not self.put_back:
            return pose
        found = self.undone @ pose
        found[:3, :3] *= self.scale
        return found

    def exported(self, file: Path) -> np.ndarray:
        """What takes a mesh of `ns-export` to the frame of cameras, (4, 4) float64.

        It was trained where a camera at x of the file is at s (R x + t). The reader notes s a, and
        R A for R, where A is `applied` and a is `scale`, and does not divide t by a.

        Args:
            file: the `dataparser_transforms.json` of the run: `transform` (3, 4) and `scale`.

        Raises:
            UserError: the file is of another kind.
        """
        top = read_object(file)
        forwards = np.eye(4)
        forwards[:3] = array(top, "transform", (3, 4), str(file))
        scale = number(top, "scale", str(file))
        if not is_rotation(forwards[:3, :3]):
            raise UserError("'transform' is no rotation with a translation", file)
        if not scale > 0:
            raise UserError("'scale' is not positive", file)
        trained = forwards @ np.linalg.inv(self.applied)  # by R, t
        trained[:3] *= scale / self.scale
        return self.undone @ np.linalg.inv(trained)


def is_rotation(matrix: np.ndarray) -> bool:
    """Whether a matrix (3, 3) turns and does nothing else."""
    far = np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-4
    return not far and bool(np.linalg.det(matrix) > 0)


def read_matrix(given: str | Path | Sequence[float | str]) -> np.ndarray:
    """A similarity, (4, 4) float64: of a file, or of 16 numbers row by row.

    Args:
        given: a file of text or JSON with 16 numbers, or 12 without the last row; or these numbers.

    Raises:
        UserError: they are no rotation with a scale and a translation.
    """
    where = "--mesh-matrix"
    if isinstance(given, str | Path):
        where, given = str(given), _words(Path(given))
    elif len(given) == 1:
        where, given = str(given[0]), _words(Path(str(given[0])))
    try:
        numbers = [float(word) for word in given]
    except ValueError:
        raise UserError("the matrix has words that are no numbers", where) from None
    if len(numbers) not in (12, 16):
        what = f"the matrix has {len(numbers)} numbers, and not 16 (or 12, without its last row)"
        raise UserError(what, where)
    matrix = np.eye(4)
    matrix.ravel()[: len(numbers)] = numbers
    linear = matrix[:3, :3]
    with np.errstate(all="ignore"):  # numbers that are too large or none
        size = np.cbrt(np.linalg.det(linear)) if np.isfinite(matrix).all() else 0.0
        right = size > 0 and is_rotation(linear / size) and matrix[3].tolist() == [0, 0, 0, 1]
    if not right:
        what = "the matrix is no rotation with one scale and a translation"
        raise UserError(what, where, "Give it row by row; its last row is 0 0 0 1")
    return matrix


def _words(file: Path) -> list[str]:
    """What stands in a file between spaces, commas and brackets."""
    require_file(file, "matrix")
    with file.open("rb") as opened:
        text = opened.read(_MOST).decode("utf-8", "replace")
    return re.split(r"[\s,;\[\]()]+", text.strip(" \t\r\n[]();,\ufeff"))
