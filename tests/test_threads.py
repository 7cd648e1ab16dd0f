"""Work in several threads: results in order, and no more of them than are taken."""

import threading
import time

import pytest

from unbake.threads import in_order, usable_cores


@pytest.mark.parametrize("at_once", [1, 3, 20])
def test_results_come_in_order(at_once):
    def work(number):
        time.sleep(0.002 * (number % 3))
        return number * number

    arguments = [(number,) for number in range(10)]
    assert list(in_order(work, arguments, at_once)) == [n * n for n in range(10)]
    assert list(in_order(work, [], at_once)) == []


def test_no_more_results_wait_than_calls_may_run():
    begun, lock = [], threading.Lock()

    def work(number):
        with lock:
            begun.append(number)
        return number

    for taken, _ in enumerate(in_order(work, [(n,) for n in range(12)], 3), 1):
        time.sleep(0.01)
        assert len(begun) <= taken + 3


def test_arguments_are_made_by_the_caller_as_they_are_needed():
    made, caller = [], threading.get_ident()

    def arguments():
        for number in range(8):
            assert threading.get_ident() == caller
            made.append(number)
            yield (number,)

    for taken, _ in enumerate(in_order(lambda number: number, arguments(), 2), 1):
        assert len(made) <= taken + 2
    assert made == list(range(8))


def test_an_error_comes_in_its_turn_and_ends_the_rest():
    begun = []

    def work(number):
        begun.append(number)
        if number == 2:
            raise ValueError("two")
        return number

    results = in_order(work, [(n,) for n in range(100)], 2)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(results)
    assert len(begun) < 10


def test_there_is_a_core():
    assert usable_cores() >= 1
