"""Messages: one line of a terminal, whatever names and texts are in them."""

import pytest

from unbake.errors import UserError, printable


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("view 1", "view 1"),
        ("Küche, Ansicht №3 – 日本", "Küche, Ansicht №3 – 日本"),
        ("\x1b[31mred\x07", "\\x1b[31mred\\x07"),
        ("a\nb\tc\rd", "a\\nb\\tc\\rd"),
        ("\x9b2J", "\\x9b2J"),
        ("gpj.\u202eexe", "gpj.\\u202eexe"),
        ("a\u2028b", "a\\u2028b"),
        ("d\udcffta \ud800", "d\\xffta \\ud800"),
    ],
)
def test_a_name_has_no_control_characters(name, shown):
    assert printable(name) == shown
    assert printable(name).encode()


def test_a_long_name_loses_its_middle():
    assert printable("x" * 80) == "x" * 80
    shown = printable("begin" + "x" * 10**7 + "\x1b end")
    assert len(shown) == 80 and shown.startswith("beginxxx") and shown.endswith("xxx\\x1b end")
    assert shown.count("…") == 1


def test_an_error_is_one_line_without_escape_sequences():
    error = UserError("no\nview \x1b]0;title\x07", "data/\x1b[2J\nx.json", "Rename\r\n  it")
    assert str(error) == "data/\\x1b[2J x.json: no view \\x1b]0;title\\x07. Rename it"


def test_names_in_an_error_are_shortened_each_and_paths_stay_whole():
    path = "/" + "/".join(["folder" * 10] * 6)
    error = UserError(f"two frames are named {'x' * 5000!r}", path, "Known: " + "name, " * 5000)
    assert error.where == path and str(error).startswith(path + ": two frames are named 'xxx")
    assert len(str(error)) < 1600 and str(error).count("…") == 2
