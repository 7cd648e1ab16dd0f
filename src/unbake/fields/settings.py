"""Sizes and learning rates of the representations that come with the package.

They are read and written as tables of the settings file, and need neither Mitsuba nor Dr.Jit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, runtime_checkable

from ..errors import POSITIVE, UserError, require, require_ranges

#: log2 of the most cells along an axis.
FINEST = 24
_FINEST = f"base_resolution * growth^(levels - 1) is 2^{FINEST} or less"
#: Adam moves a parameter by about its rate in a step, and parameters are of the order of one.
RATES = (POSITIVE, 10.0)
#: Sizes up to which the kernels of a step are compiled in a minute or two: 32 levels of three
#: fields took 96 s on two cores, 64 layers 9 s and 512 neurons 12 s, 64 levels more than 200 s.
_LEVELS = (0, 32)
_PERCEPTRON = {"width": (1, 1024), "hidden": (1, 32), "leak": (0, 0.99)}
#: Slope of activations below zero that keeps L_θ learning everywhere: with rectified ones all
#: neurons of a layer came to lie below zero in the brightest or darkest part of some rooms (1 to
#: 26 % of what cameras saw), where the output then was a constant that no gradient moved.
LEAK = 0.01
#: Lattices of a piece by place, each with twice the cells of the one before; log2 of the numbers
#: that all of them have together.
PLACE_LEVELS, PLACES_LOG2 = 3, 19


class FieldSettings(Protocol):
    """Settings of any representation: a frozen dataclass, with a learning rate at least."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def learning_rate(self) -> float:
        """Adam's rate for the field's parameters."""
        ...


@runtime_checkable
class SizedSettings(Protocol):
    """Settings that tell how large a field they make, so that it can be refused before."""

    def numbers(self, outputs: int, extra: int = 0, materials: int = 1) -> int:
        """How many numbers are learned: those of all parameters, or slightly more.

        Args:
            outputs, extra: as in `FieldSpec`.
            materials: number of the scene's materials.
        """
        ...


@dataclass(frozen=True)
class GridConfig:
    """A multiresolution hash grid over the unit cube (Sec. 5.3; Müller et al. 2022).

    Where levels and tables are left open, 0, a fit chooses them from scene and photographs
    (`grid_sizes.py`; ours); a run that was started has numbers.
    """

    levels: int = 0  #: number of resolutions
    features: int = 2  #: features of each level
    table_log2: int = 0  #: log2 of the largest number of entries of a level
    base_resolution: int = 4  #: cells along an axis of the coarsest level
    growth: float = 2.0  #: ratio of resolutions of neighbouring levels
    footprints: float = 1.0  #: finest cells of levels left open, in footprints of a pixel

    def __post_init__(self) -> None:
        sizes = {"levels": _LEVELS, "base_resolution": (1, 1 << 24)}
        sizes |= {"table_log2": (4, 28)} if self.table_log2 else {}
        require_ranges(self, sizes | {"growth": (1, 1 << 24), "footprints": (1e-3, 1e3)})
        require(self.features in (2, 4, 8), "features", "2, 4 or 8", self.features)
        # Cells of a finer level than that are smaller than single precision tells positions apart.
        finest = math.log2(self.base_resolution) + (self.levels - 1) * math.log2(self.growth)
        require(finest <= FINEST, "levels", f"such that {_FINEST}", self.levels)

    def numbers(self) -> int:
        """How many numbers the tables hold, or slightly more."""
        cells = [self.base_resolution * self.growth**level for level in range(self.levels)]
        corners = [(math.ceil(n) + 2) ** 3 for n in cells]
        return self.features * sum(min(1 << self.table_log2, count) for count in corners)


@dataclass(frozen=True)
class PieceConfig:
    """Values that pieces of surface share, beside a network (ours).

    See `pieces.py` and `piece_values.py`.
    """

    most: int = 0  #: pieces with values of their own; smaller ones share them. 0: there are none
    #: Of the albedo, from black to white, in each of which a piece has its own number
    brightnesses: int = 8
    gain: float = 7.0  #: how much faster a large piece learns than the network would alone
    network: float = 0.2  #: how much slower the network learns beside pieces
    #: Cells along each channel of a table by colour of the albedo, which all pieces share; 0: none
    colours: int = 0
    own_colours: int = 0  #: the same of a table that each piece has by itself; 0: none
    #: Cells along the scene's cube of the coarsest lattice of a piece, for what differs from place
    #: to place; 0: none
    places: int = 0
    #: Whether each piece has a factor of what it has from the network and from colours, which
    #: searches find
    variation: bool = False
    learned: bool = True  #: whether steps change numbers of pieces; False: searches alone do
    #: Whether what meets at a sliver, a triangle whose corners lie on a line, meets as at an edge
    across_slivers: bool = True

    def __post_init__(self) -> None:
        sizes = {"most": (0, 1 << 20), "brightnesses": (1, 64)}
        sizes |= {"colours": (0, 64), "own_colours": (0, 12)}
        sizes |= {"places": (0, 16)}
        require_ranges(self, sizes | {"gain": (POSITIVE, 1e4), "network": (POSITIVE, 1.0)})

    def numbers(self, outputs: int) -> int:
        """How many numbers there are."""
        if not self.most:
            return 0
        grid = features_of(outputs) * (self.colours + 1) ** 3 if self.colours else 0
        factors = self.most if self.variation else 0
        places = (outputs << PLACES_LOG2) + self.most if self.places else 0
        own = outputs * (self.brightnesses + self.own_corners) * self.most
        return own + grid + factors + places

    @property
    def own_corners(self) -> int:
        """Of the table by colour that each piece has by itself."""
        return (self.own_colours + 1) ** 3 if self.own_colours else 0


@dataclass(frozen=True)
class NetworkConfig:
    """A multilayer perceptron on top of a hash grid (Sec. 5.3)."""

    grid: GridConfig = field(default_factory=GridConfig)
    width: int = 32  #: neurons of a hidden layer
    hidden: int = 2  #: number of hidden layers
    learning_rate: float = 0.01  #: Adam (Sec. 5.4: 5e-4)
    pieces: PieceConfig = field(default_factory=PieceConfig)
    leak: float = 0.0  #: slope of activations below zero (ours)

    def __post_init__(self) -> None:
        require_ranges(self, _PERCEPTRON | {"learning_rate": RATES})

    def numbers(self, outputs: int, extra: int = 0, materials: int = 1) -> int:
        """How many numbers are learned; see `SizedSettings`."""
        inputs = self.grid.levels * self.grid.features + extra
        layers = _of_layers(inputs, self.width, self.hidden, outputs)
        return self.grid.numbers() + layers + self.pieces.numbers(outputs)


def require_no_pieces(settings: object, key: str) -> None:
    """Refuse values of pieces in the settings of L_θ, which is asked at points without their piece.

    Args:
        settings: of any representation.
        key: their dotted key.

    Raises:
        UserError: there are such values.
    """
    if isinstance(settings, NetworkConfig) and settings.pieces.most:
        what = "must be 0: pieces of surface are of materials alone"
        raise UserError(what, f"{key}.pieces.most")


@dataclass(frozen=True)
class GuideConfig:
    """Where bounces look for light, beside where the BSDF scatters (ours); see `guide.py`."""

    cells: int = 8  #: along an edge of the grid's cube; 0: directions come from the BSDF alone
    bands: int = 8  #: of a distribution of directions, from below to above
    sectors: int = 16  #: of each band, around the z axis

    def __post_init__(self) -> None:
        require_ranges(self, {"cells": (0, 64), "bands": (1, 64), "sectors": (1, 128)})

    def numbers(self) -> int:
        """How many numbers are learned."""
        return 6 * self.cells**3 * (self.bands * self.sectors + 1)


@dataclass(frozen=True)
class DenseGridConfig:
    """A dense 3D grid with trilinear interpolation over the scene's cube (Fig. 5)."""

    cells: int = 32  #: along an axis
    learning_rate: float = 0.05  #: Adam

    def __post_init__(self) -> None:
        require_ranges(self, {"cells": (1, 512), "learning_rate": RATES})

    def numbers(self, outputs: int, extra: int = 0, materials: int = 1) -> int:
        """How many numbers are learned; see `SizedSettings`."""
        return features_of(outputs) * (self.cells + 1) ** 3


@dataclass(frozen=True)
class TriPlaneConfig:
    """A multilayer perceptron on top of three feature planes (Chan et al. 2022).

    Resolutions double from level to level.
    """

    levels: int = 3  #: number of resolutions
    features: int = 4  #: features of each level
    base_resolution: int = 32  #: corners along an edge of the coarsest level
    width: int = 32  #: neurons of a hidden layer
    hidden: int = 1  #: number of hidden layers
    learning_rate: float = 0.03  #: Adam
    leak: float = 0.0  #: slope of activations below zero

    def __post_init__(self) -> None:
        sizes = {"levels": (1, 13), "base_resolution": (2, 8192)}
        require_ranges(self, sizes | _PERCEPTRON | {"learning_rate": RATES})
        require(self.features in (2, 4, 8), "features", "2, 4 or 8", self.features)
        bound = "such that base_resolution * 2^(levels - 1) is 8192 or less"
        require(self.finest <= 8192, "levels", bound, self.levels)

    @property
    def finest(self) -> int:
        """Corners along an edge of the finest level."""
        return self.base_resolution * 2 ** (self.levels - 1)

    def numbers(self, outputs: int, extra: int = 0, materials: int = 1) -> int:
        """How many numbers are learned; see `SizedSettings`."""
        corners = [(self.base_resolution * 2**level + 1) ** 2 for level in range(self.levels)]
        inputs = self.levels * self.features + extra
        layers = _of_layers(inputs, self.width, self.hidden, outputs)
        return 3 * self.features * sum(corners) + layers


@dataclass(frozen=True)
class BitmapConfig:
    """A square bitmap in the UV coordinates of each material (Sec. 8)."""

    resolution: int = 64  #: pixels along an edge
    learning_rate: float = 0.05  #: Adam

    def __post_init__(self) -> None:
        require_ranges(self, {"resolution": (1, 8192), "learning_rate": RATES})

    def numbers(self, outputs: int, extra: int = 0, materials: int = 1) -> int:
        """How many numbers are learned; see `SizedSettings`."""
        return materials * self.resolution**2 * outputs


def features_of(outputs: int) -> int:
    """Features of a dense grid with so many outputs: a hash grid has a power of two, at least 2."""
    return max(2, 1 << (outputs - 1).bit_length())


def _of_layers(inputs: int, width: int, hidden: int, outputs: int) -> int:
    """Weights and biases of a perceptron."""
    return (inputs + 1) * width + (hidden - 1) * (width + 1) * width + (width + 1) * outputs
