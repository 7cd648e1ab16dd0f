"""Lines on progress: none where work is short, and some seconds apart where it is long."""

import pytest

from unbake.progress import EVERY, Paced, each_told


@pytest.fixture
def lines():
    return []


def test_lines_are_some_seconds_apart(lines, clock):
    paced = Paced(lines.append, 10.0)
    for second in range(1, 31):
        clock.now = float(second)
        paced(f"{second} s")
    assert lines == ["10 s", "20 s", "30 s"]


def test_a_line_that_must_be_told_puts_off_the_next_one(lines, clock):
    paced = Paced(lines.append, 10.0)
    clock.now = 9.0
    paced.now("now")
    clock.now = 18.0
    paced("too soon")
    clock.now = 19.0
    paced("later")
    assert lines == ["now", "later"]


@pytest.mark.parametrize(
    ("seconds", "told"),
    [(0.1, []), (EVERY, ["1 of 3", "2 of 3"]), (EVERY / 2, ["2 of 3"])],
)
def test_results_are_counted_where_they_take_long_but_for_the_last(lines, clock, seconds, told):
    def made():
        for result in "abc":
            clock.now += seconds
            yield result

    assert list(each_told(made(), 3, lambda number: f"{number} of 3", lines.append)) == list("abc")
    assert lines == told
