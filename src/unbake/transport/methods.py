"""Methods: the table of which term of the objective trains what (Sec. 4.1).

Pure Python, so that settings and the command line can read it without Mitsuba. A method of your own
is a `Method` given to `register_method`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from ..errors import require_name


@dataclass(frozen=True)
class Attached:
    """Which inputs of a term pass gradients."""

    scene: bool = False  #: materials at the vertices where light scatters, and lights, to φ
    lhs: bool = False  #: L_θ on the left-hand side, to θ
    rhs: bool = False  #: L_θ on the right-hand side, to θ


#: Names of the terms that `terms.py` defines.
PHOTOMETRIC, PRIOR, EXTRA, LHS = "photometric", "prior", "prior_extra", "lhs"
PRIOR_PAIR = "prior_pair"
#: Names of the samplers that `samplers.py` defines.
BOUNCES, KEPT_PATHS, PATH_REPLAY = "bounces", "kept-paths", "path-replay"


@dataclass(frozen=True)
class Method:
    """The terms of an objective, what each trains, and how light is followed.

    Args:
        name: of settings, the command line and folders: letters, digits, `-`, `_` and `.`.
        title: one line for help texts and reports.
        terms: what each term trains, by the term's name; a term that is absent is not part of the
            method.
        sampler: name of the path sampler (`samplers.py`).
        follows_paths: whether paths are followed to their end, `path.max_depth`. All light is then
            in the image, and there is no radiance field.
        takes_bounces: whether the setting `bounces` changes it.
        takes_prior: whether the setting `prior` does.
    """

    name: str
    title: str
    terms: Mapping[str, Attached]
    sampler: str = BOUNCES
    follows_paths: bool = False
    takes_bounces: bool = False
    takes_prior: bool = False

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\w[\w.-]*", self.name):
            raise ValueError(f"{self.name!r} cannot be a method's name")
        if not self.terms:
            raise ValueError(f"the method {self.name} has no terms")
        for term, attached in self.terms.items():
            if attached == Attached():
                raise ValueError(f"{term} trains nothing in the method {self.name}")
            if self.follows_paths and (attached.lhs or attached.rhs):
                raise ValueError(f"{self.name} follows paths to their end: it has no L_θ to train")
        object.__setattr__(self, "terms", MappingProxyType(dict(self.terms)))

    def without_extra_bounce(self) -> Method:
        """The same method with the residual at x₁ alone.

        Paper: Sec. 4.2.
        """
        return replace(self, terms={t: a for t, a in self.terms.items() if t != EXTRA})


_METHODS: dict[str, Method] = {}
#: All methods by name.
METHODS: Mapping[str, Method] = MappingProxyType(_METHODS)


def register_method(method: Method) -> Method:
    """Add a method to the table; settings and commands know its name from then on.

    Its terms and sampler need not be registered yet: they are looked up when a fit begins.

    Raises:
        ValueError: there is another method of this name.
    """
    if METHODS.get(method.name, method) != method:
        raise ValueError(f"there is another method named {method.name}")
    _METHODS[method.name] = method
    return method


def method_named(name: str) -> Method:
    """The method of this name.

    Raises:
        UserError: there is none.
    """
    require_name(name, METHODS, "method")
    return METHODS[name]


_SCENE, _LHS = Attached(scene=True), Attached(lhs=True)

# Photometric: Eq. 5 with Eq. 12. Prior, pair: Eq. 10. Extra: the same at x₂. LHS: Eq. 14.
for _method in (
    Method(
        "ours",
        "radiometric prior at two vertices and LHS loss",
        {PHOTOMETRIC: _SCENE, PRIOR: _LHS, EXTRA: _LHS, LHS: _LHS},
        takes_bounces=True,
        takes_prior=True,
    ),
    Method(
        "no-prior",
        "ours, the radiance field learned from photographs alone",
        {PHOTOMETRIC: _SCENE, LHS: _LHS},
        takes_bounces=True,
    ),
    Method("direct", "direct illumination only", {PHOTOMETRIC: _SCENE}),
    Method(
        "ad-pt",
        "path tracing, differentiated with all paths in memory",
        {PHOTOMETRIC: _SCENE},
        sampler=KEPT_PATHS,
        follows_paths=True,
    ),
    Method(
        "prb",
        "path replay backpropagation, Mitsuba's",
        {PHOTOMETRIC: _SCENE},
        sampler=PATH_REPLAY,
        follows_paths=True,
    ),
    # The ablation of Fig. 7 and 8, from `direct` to `ours`: each has one term more. The authors'
    # row "+ prior" is `with-biased-prior`: their residuals are squared sample by sample, with one
    # sample of T(L_θ) each. `with-prior` is the same idea without that bias. The rows after these
    # take the square: with the scene detached its gradient has no bias.
    Method(
        "with-prior",
        "direct, and a prior that trains the materials too, free of bias",
        {PHOTOMETRIC: _SCENE, PRIOR_PAIR: Attached(scene=True, lhs=True)},
    ),
    Method(
        "with-biased-prior",
        "with-prior as the authors have it, biased by the noise of its samples",
        {PHOTOMETRIC: _SCENE, PRIOR: Attached(scene=True, lhs=True)},
    ),
    Method(
        "with-stop-gradient",
        "direct, and a prior that trains the radiance field alone",
        {PHOTOMETRIC: _SCENE, PRIOR: _LHS},
    ),
    Method(
        "with-second-bounce",
        "with-stop-gradient, with the residual at x2 as well",
        {PHOTOMETRIC: _SCENE, PRIOR: _LHS, EXTRA: _LHS},
    ),
):
    register_method(_method)
