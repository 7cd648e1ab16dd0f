"""How roughness is searched for. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import POSITIVE, require_ranges


@dataclass(frozen=True)
class RoughnessSearchConfig:
    """How roughness is searched for, beside the steps of a fit (ours).

    Of methods with L_θ; see `training/roughness_search.py`.
    """

    times: int = 3  #: searches, evenly from `first` to `last`; 0: none
    first: float = 0.4  #: fraction of the steps, or of their time, after which the first one comes
    last: float = 0.9  #: and the last one; the rest is left for albedo to follow
    share: float = 0.27  #: camera samples of each one, of those that all steps of the fit take
    pixels: int = 1 << 19  #: that are sampled, at most, and no more than photographs have
    #: Camera samples of each pixel; up to four times as many where photographs have fewer pixels
    #: than are wanted
    spp: int = 64
    cells: int = 4  #: along an edge of the scene's cube, in each of which albedo has its own factor
    colours: int = 6  #: along each channel of albedo, the same
    steps: int = 300  #: of Adam, on what was sampled
    rate: float = 1.25  #: of these, as a multiple of the field's own
    #: Expected standard deviations, before bounds: of what a piece has of its own, between its
    #: neighbouring brightnesses, between neighbouring colours of what all pieces share, and of what
    #: a piece has of its own for a colour
    piece_spread: float = 1.5
    brightness_spread: float = 0.25
    colour_spread: float = 1.0
    own_colour_spread: float = 0.3
    #: Pixels of a piece that tell as much of its level as one would by itself, as their errors have
    #: a part in common; 0: pieces stay at what is most probable
    pixels_as_one: float = 3.0
    #: A piece tells as much as so many independent pixels at most: errors of L_θ do not average
    #: out; 0: there is no such number
    pixels_at_most: int = 8000
    #: How near colours are whose pieces have like levels, as square roots of linear RGB
    like_colours: float = 0.1
    #: How probable it is, before photographs are seen, that a piece has one roughness
    one_roughness: float = 0.7
    #: The same of albedo, which keeps an eighth of what was found at least, to be learned on
    one_albedo: float = 0.7
    #: How probable it is that roughness does not differ from place to place beyond that; and cells
    #: along an edge of the scene's cube, in each of which albedo has its own factor then
    no_places: float = 0.999
    place_cells: int = 8
    #: Of the fit's steps before the first search, and after it, as multiples of the field's own
    rate_before: float = 0.25
    rate_between: float = 0.0

    def __post_init__(self) -> None:
        ranges = {"times": (0, 1000), "first": (POSITIVE, 1), "last": (POSITIVE, 1)}
        ranges |= {"share": (POSITIVE, 1000), "pixels": (1, 1 << 24), "spp": (2, 1 << 14)}
        ranges |= {"cells": (1, 1024), "colours": (1, 64), "steps": (0, 10**6)}
        ranges |= {"rate": (POSITIVE, 1e4), "rate_before": (0, 1e4), "rate_between": (0, 1e4)}
        ranges |= {"pixels_as_one": (0, 1e6), "pixels_at_most": (0, 1 << 30)}
        ranges |= {"like_colours": (1e-3, 1e3), "one_roughness": (0, 1), "one_albedo": (0, 1)}
        ranges |= {"no_places": (0, 1), "place_cells": (1, 1024)}
        spreads = ("piece_spread", "brightness_spread", "colour_spread", "own_colour_spread")
        require_ranges(self, ranges | dict.fromkeys(spreads, (POSITIVE, 1e6)))
