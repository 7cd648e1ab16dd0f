"""Methods, terms and samplers are tables that can be added to from outside of the package."""

import subprocess
import sys
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from support import (
    TINY_FIT,
    assert_only_replayed,
    built_in_cameras,
    grey_photographs,
    parameters_of,
)

from unbake import config
from unbake.comparison.method_variant import MethodVariant
from unbake.errors import UserError
from unbake.training.problem import make_problem
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.transport import methods, samplers, terms
from unbake.transport.loss import squared_error
from unbake.transport.methods import (
    EXTRA,
    LHS,
    METHODS,
    PHOTOMETRIC,
    PRIOR,
    PRIOR_PAIR,
    Attached,
    Method,
    method_named,
    register_method,
)
from unbake.transport.objective import requirements
from unbake.transport.samplers import BounceSampler, register_sampler
from unbake.transport.terms import TERMS, Term, register_term, term_named

LIGHT = Attached(lhs=True)
SCENE = Attached(scene=True)


@pytest.fixture(autouse=True)
def tables():
    """What a test registers is gone after it."""
    found = [methods._METHODS, terms._TERMS, samplers._SAMPLERS]
    before = [dict(table) for table in found]
    yield
    for table, entries in zip(found, before, strict=True):
        table.clear()
        table.update(entries)


def start(built_in, settings):
    problem = make_problem(built_in("cornell"), "visible", settings, 0.2)
    pixels = grey_photographs(built_in_cameras("cornell", 8, views=2))
    return TrainingStep(problem, pixels, settings), initial_state(problem)


RATES = {"albedo": 2e-3, "roughness": 2e-3, "radiance": 5e-3}


# ----------------------------------------------------------------------------------- the tables


def test_the_table_of_methods_is_read_without_mitsuba():
    script = (
        "import sys\n"
        "import unbake.transport.methods as m\n"
        "assert not {'drjit', 'mitsuba', 'numpy'} & set(sys.modules), 'not pure'\n"
        "print(len(m.METHODS))\n"
    )
    paths = [p for p in sys.path if p]
    result = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {paths!r}\n{script}"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) == len(METHODS)


def test_every_method_of_the_table_has_terms_and_a_sampler_that_exist():
    for method in METHODS.values():
        assert method.sampler in samplers.SAMPLERS
        assert requirements(method.terms).radiance == (
            not method.follows_paths and any(a.lhs or a.rhs for a in method.terms.values())
        )
        assert "\n" not in method.title and method.title


def test_one_bounce_is_ours_without_the_second_residual():
    ours = METHODS["ours"]
    less = ours.without_extra_bounce()
    assert {**less.terms, EXTRA: ours.terms[EXTRA]} == dict(ours.terms)
    assert replace(less, terms=ours.terms) == ours
    settings = config.FitConfig(prior="one-bounce")
    assert settings.chosen_method == less
    assert config.FitConfig().chosen_method == ours


def test_a_table_cannot_be_changed_but_by_registering():
    with pytest.raises(TypeError):
        METHODS["mine"] = METHODS["ours"]
    with pytest.raises(TypeError):
        METHODS["ours"].terms[PRIOR] = SCENE
    register_method(METHODS["ours"])  # the same again is no error
    with pytest.raises(ValueError, match="another method named ours"):
        register_method(replace(METHODS["ours"], title="mine"))
    with pytest.raises(ValueError, match="another term named prior"):
        register_term(replace(TERMS[PRIOR], lhs=(3,)))
    with pytest.raises(ValueError, match="another sampler named bounces"):
        register_sampler("bounces", lambda context: None)


# ------------------------------------------------------------------------------------- mistakes


def test_unknown_names_are_told_with_what_there_is():
    for call, what in ((method_named, "method"), (term_named, "term")):
        with pytest.raises(UserError, match=rf"^no {what} named 'best'. There are .*, ") as error:
            call("best")
        assert "\n" not in str(error.value)
    with pytest.raises(UserError, match=r"must be one of ours, no-prior.* not 'best'"):
        config.FitConfig(method="best")


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({PHOTOMETRIC: SCENE, "smooth": SCENE}, "no term named 'smooth'. There are photometric, "),
        ({PHOTOMETRIC: SCENE, LHS: Attached(rhs=True)}, "the term lhs has no rhs"),
        ({PHOTOMETRIC: Attached(lhs=True)}, "the term photometric has no lhs"),
    ],
)
def test_a_method_is_refused_whose_terms_cannot_be_had(built_in, row, message):
    register_method(Method("wrong", "a mistake", row))
    with pytest.raises(UserError, match=message):
        start(built_in, replace(TINY_FIT, method="wrong"))


def test_a_sampler_must_exist_and_serve_the_terms(built_in):
    register_method(Method("lost", "a mistake", {PHOTOMETRIC: SCENE}, sampler="magic"))
    with pytest.raises(UserError, match=r"no sampler named 'magic'. There are bounces, kept-p"):
        start(built_in, replace(TINY_FIT, method="lost"))
    row = {PHOTOMETRIC: SCENE, PRIOR: SCENE}
    register_method(Method("both", "a mistake", row, sampler="path-replay"))
    with pytest.raises(UserError, match="the method both has other terms than photometric"):
        start(built_in, replace(TINY_FIT, method="both"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"name": "a b"}, "cannot be a method's name"),
        ({"name": "mine:grid"}, "cannot be a method's name"),
        ({"terms": {}}, "has no terms"),
        ({"terms": {PRIOR: Attached()}}, "prior trains nothing"),
        ({"terms": {PRIOR: LIGHT}, "follows_paths": True}, "no L_θ to train"),
    ],
)
def test_a_method_that_makes_no_sense_is_not_made(settings, message):
    with pytest.raises(ValueError, match=message):
        Method(**({"name": "mine", "title": "t", "terms": {PHOTOMETRIC: SCENE}} | settings))


def test_a_term_that_makes_no_sense_is_not_made():
    with pytest.raises(ValueError, match="no vertices of its own"):
        Term("mine", len, lhs=(1,), of_image=True)
    with pytest.raises(ValueError, match="skipped is a number of the log"):
        Term("skipped", len)
    with pytest.raises(ValueError, match="numbered from 1"):
        Term("mine", len, lhs=(0,))


# ------------------------------------------------------------------------- one's own, in a step


def test_a_term_of_ones_own_trains_in_a_method_of_ones_own(built_in):
    """L_θ at x₂ and x₃ is pulled to a constant: read, attached and trained as the term says."""

    def near_one(inputs):
        ones = [dr.mean(dr.mean(dr.square(L - 1))) for L in inputs.lhs[1:3]]
        return ones[0] + ones[1]

    register_term(Term("near_one", near_one, lhs=(2, 3)))
    register_method(Method("mine", "a constant", {PHOTOMETRIC: SCENE, "near_one": LIGHT}))
    settings = replace(TINY_FIT, method="mine")
    step, state = start(built_in, settings)
    before = {k: np.array(v).copy() for k, v in state.theta.items()}
    seen = [float(step(state, i, RATES)["near_one"][0]) for i in range(120)]
    assert step.recordings() <= 3
    assert seen[-1] < 0.5 * seen[0]
    assert any((np.array(v) != before[k]).any() for k, v in state.theta.items())
    assert MethodVariant.of("mine:grid").settings(config.FitConfig()).method == "mine"
    assert "mine" in config.to_toml(settings)
    assert config.from_toml(config.to_toml(settings)) == settings


def test_a_method_of_ones_own_needs_no_photometric_term(built_in):
    """Albedo is as smooth as photographs are left unexplained: here they explain nothing."""
    register_method(Method("blind", "no photographs", {PRIOR: Attached(scene=True, lhs=True)}))
    regularization = config.RegularizationConfig(albedo_smoothness=1.0, roughness_smoothness=1.0)
    step, state = start(built_in, replace(TINY_FIT, method="blind", regularization=regularization))
    terms = step(state, 0, RATES)
    assert set(terms) == {PRIOR, "guide", "roughness_smoothness", "skipped"}
    assert all(np.isfinite(value[0]) for value in terms.values()) and terms["skipped"][0] == 0


@pytest.mark.parametrize("radiance_spp", [0, 2])
def test_a_method_that_attaches_every_edge_is_recorded_and_replayed(built_in, radiance_spp):
    row = {
        PHOTOMETRIC: Attached(scene=True, rhs=True),
        PRIOR: Attached(scene=True, lhs=True, rhs=True),
        PRIOR_PAIR: Attached(scene=True, lhs=True, rhs=True),
        EXTRA: Attached(scene=True, lhs=True, rhs=True),
        LHS: LIGHT,
    }
    register_method(Method("all", "every edge", row, takes_bounces=True, takes_prior=True))
    settings = replace(TINY_FIT, method="all", bounces=2, radiance_spp=radiance_spp)
    step, state = start(built_in, settings)
    before = parameters_of(state)
    assert_only_replayed(step, state, lambda i: RATES)
    after = parameters_of(state)
    assert all((after[k] != before[k]).any() for k in before)


def test_a_sampler_of_ones_own_makes_the_step(built_in):
    """Half of the light: its own image, in the frozen step, with the loss's own weight."""
    made = []

    class Dimmed(BounceSampler):
        def __init__(self, context):
            super().__init__(context)
            made.append(self)

        def terms(self, scene, ray, target, sampler, subset, loss, primal):
            image = 0.5 * self.image(scene, ray, sampler)
            weight = loss.weight(target)
            spp = self._context.spp
            return {PHOTOMETRIC: squared_error(image, target, spp, weight, primal)}

    register_sampler("dimmed", Dimmed)
    register_method(Method("dim", "half of the light", {PHOTOMETRIC: SCENE}, sampler="dimmed"))
    losses = {}
    for method in ("direct", "dim"):
        step, state = start(built_in, replace(TINY_FIT, method=method))
        losses[method] = [float(step(state, i, RATES)[PHOTOMETRIC][0]) for i in range(4)]
        assert all(np.isfinite(losses[method]))
    assert len(made) == 1
    assert losses["dim"] != losses["direct"]
