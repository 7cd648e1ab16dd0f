"""docs/equations.md tells the truth: what it names is there, and says which equation it is."""

import re

import pytest

ROW = re.compile(r"^\| ((?:Eq|Sec|Table|Fig)\.? ?[^|]+) \| ([^|]+) \| ([^|]+) \|$", re.M)


@pytest.fixture(scope="module")
def rows(repository):
    text = (repository / "docs" / "equations.md").read_text(encoding="utf-8")
    return [match.groups() for match in ROW.finditer(text)]


def places(where):
    """(file, names) of a cell such as "`a/b.py`: `f`, `g`; `c.py`: `h`"."""
    for part in where.split(";"):
        file, *names = re.findall(r"`([^`]+)`", part)
        yield file, names


def test_every_file_and_name_in_the_table_exists(repository, rows):
    assert len(rows) > 25
    for paper, _, where in rows:
        for file, names in places(where) if "`" in where else ():
            source = (repository / "src" / "unbake" / file).read_text(encoding="utf-8")
            for name in names:
                assert re.search(rf"\b{name}\b", source), f"{paper}: no {name} in {file}"


@pytest.mark.parametrize("equation", [1, 2, 3, 4, 5, 8, 10, 11, 12, 13, 14])
def test_an_equation_is_cited_where_the_table_sends_its_reader(repository, rows, equation):
    cells = [
        w
        for paper, _, w in rows
        if equation in map(int, re.findall(r"\d+", paper)) and paper.startswith("Eq")
    ]
    assert cells, f"Eq. {equation} is not in the table"
    files = {file for cell in cells for file, _ in places(cell)}
    sources = [(repository / "src" / "unbake" / f).read_text(encoding="utf-8") for f in files]
    cited = re.compile(rf"Eq\. (?:\d+, (?:Eq\. )?)*{equation}\b")
    assert any(cited.search(source) for source in sources), f"Eq. {equation}: nowhere in {files}"
