"""The search for rates: it finds the best ones, tries both sides of them, and ignores noise."""

import pytest

from unbake.comparison.rate_search import LEAST, MARGIN, Trial, beats, best_trial

NAMES = ["roughness", "albedo"]


def search(score, estimators=("split-halves",), names=NAMES):
    """The best trial, and the trials that were made, each once."""
    made: dict[Trial, float] = {}

    def scored(trial):
        if trial not in made:
            made[trial] = score(trial)
        return made[trial]

    return best_trial(names, estimators, scored), made


@pytest.mark.parametrize("top", [(0, 0), (1, -1), (3, 0), (-2, 4)])
def test_the_best_rates_are_found_and_lie_between_others(top):
    def score(trial):
        return 20 - sum((n - best) ** 2 for n, best in zip(trial.powers, top, strict=True))

    best, made = search(score)
    assert best.powers == top
    for name in NAMES:
        for step in (-1, 1):
            assert best.moved(name, step) in made
    for number in range(2):
        assert len({trial.powers[number] for trial in made}) >= 3


def test_rates_that_depend_on_each_other_are_searched_twice():
    """Roughness gains from a higher rate only where that of albedo is higher as well."""

    def score(trial):
        roughness, albedo = trial.powers
        return -3 * (albedo - 1) ** 2 - (roughness - (albedo > 0)) ** 2

    best, _ = search(score)
    assert best.powers == (1, 1)


def test_small_differences_do_not_count():
    best, made = search(lambda trial: 20 + 0.99 * MARGIN * (trial.powers[0] == 1))
    assert best.powers == (0, 0) and len(made) == 5
    best, _ = search(lambda trial: 20 + 1.01 * MARGIN * (trial.powers[0] == 1))
    assert best.powers == (1, 0)


def test_a_trial_that_fails_is_never_the_best():
    best, _ = search(lambda trial: LEAST if trial.powers[0] else 10.0)
    assert best.powers == (0, 0)
    best, _ = search(lambda trial: 10.0 if trial.powers[0] == 1 else LEAST)
    assert best.powers == (1, 0)
    assert search(lambda trial: LEAST)[0].powers == (0, 0)


def test_the_first_estimator_is_taken_unless_the_other_is_better():
    both = ("two-pass", "split-halves")
    best, made = search(lambda trial: 20.0, both)
    assert best.estimator == "two-pass" and len(made) == 6
    best, _ = search(lambda trial: 20.0 + (trial.estimator == "split-halves"), both)
    assert best.estimator == "split-halves"


def test_what_is_better_is_so_by_more_than_the_seeds_differ():
    assert beats([21.0, 21.2], [20.0, 20.2])
    assert not beats([20.0, 20.2], [21.0, 21.2])
    assert beats([21.0, 25.0], [20.0, 24.0]), "it is better with each seed"
    assert not beats([21.0, 25.0], [22.0, 20.0]), "the gains differ by more"
    assert not beats([20.1, 20.1], [20.0, 20.0]), "less than the margin"
    assert beats([21.0], [20.0]) and not beats([20.0], [20.0])


def test_factors_are_powers_of_the_step():
    trial = Trial(("roughness", "albedo"), (-2, 3), "two-pass")
    assert trial.factors == {"roughness": 0.16, "albedo": 15.625}
