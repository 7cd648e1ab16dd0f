"""docs/equations.md tells the truth: what it names is defined there, and cites what it is of."""

import ast
import re
import typing
from dataclasses import dataclass

import pytest

from unbake.config.fit import PresetName

ROW = re.compile(r"^\| ((?:Eq|Sec|Table|Fig)\.? ?[^|]+) \| ([^|]+) \| ([^|]+) \|$", re.M)
#: The paper numbers so many equations.
EQUATIONS = range(1, 15)
_PART = re.compile(r"(Eq|Sec|Fig|Table)s?\.? ([\d.]+(?:(?:, |–| and )[\d.]+)*)")


@dataclass(frozen=True)
class Row:
    paper: str
    where: str

    @property
    def cited(self) -> set[tuple[str, str]]:
        """What the row is of: `("Eq", "12")`."""
        return parts(self.paper)

    @property
    def places(self):
        """File, names in it, and whether they are names of presets."""
        for part in self.where.split(";"):
            if found := re.findall(r"`([^`]+)`", part):
                yield found[0], found[1:], "preset `" in part


def parts(text: str) -> set[tuple[str, str]]:
    """Equations, sections, figures and tables that a text names."""
    return {
        (kind, number)
        for kind, numbers in _PART.findall(text)
        for number in re.split(r", |–| and ", numbers.rstrip("."))
    }


def of_page(text: str) -> list[Row]:
    return [Row(paper, where) for paper, _, where in ROW.findall(text)]


def definitions(source: str) -> dict[str, str | None]:
    """What a module defines, with docstrings: functions, classes, `Class.method`; None: a value."""
    found: dict[str, str | None] = {}

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            match node:
                case ast.FunctionDef() | ast.ClassDef():
                    found[prefix + node.name] = ast.get_docstring(node) or ""
                    if isinstance(node, ast.ClassDef):
                        visit(node.body, f"{prefix}{node.name}.")
                case (
                    ast.Assign(targets=[ast.Name(id=name)])
                    | ast.AnnAssign(target=ast.Name(id=name))
                ):
                    found[prefix + name] = None

    visit(ast.parse(source).body, "")
    return found


@pytest.fixture(scope="module")
def rows(repository):
    return of_page((repository / "docs" / "equations.md").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def source(repository):
    return lambda file: (repository / "src" / "unbake" / file).read_text(encoding="utf-8")


def undefined(rows, source) -> list[str]:
    """Names of the table that their file does not define."""
    wrong = []
    for row in rows:
        for file, names, of_presets in row.places:
            known = typing.get_args(PresetName) if of_presets else definitions(source(file))
            wrong += [f"{row.paper}: {file} has no {name}" for name in names if name not in known]
            wrong += [] if names else [f"{row.paper}: no name in {file}"]
    return wrong


def uncited(rows, source) -> list[str]:
    """Functions and classes of the table whose docstring does not name the row's equation."""
    wrong = []
    for row in rows:
        equations = {part for part in row.cited if part[0] == "Eq"}
        for file, names, _ in row.places:
            known = definitions(source(file))
            for name in names:
                docstring = known.get(name)
                if docstring is not None and equations - parts(docstring):
                    wrong.append(f"{row.paper}: the docstring of {file}: {name} does not cite it")
    return wrong


def test_the_file_that_a_row_names_defines_what_it_names(rows, source):
    assert len(rows) > 25
    wrong = undefined(rows, source)
    assert not wrong, "\n".join(wrong)


def test_every_equation_of_the_paper_is_in_one_row(rows):
    listed = [number for row in rows for kind, number in row.cited if kind == "Eq"]
    assert sorted(map(int, listed)) == list(EQUATIONS)
    nowhere = [row.paper for row in rows if not list(row.places)]
    assert nowhere == ["Eq. 6, 7, 9"]


def test_what_an_equation_became_cites_it(rows, source):
    wrong = uncited(rows, source)
    assert not wrong, "\n".join(wrong)


def test_a_section_is_cited_in_one_of_the_modules_that_its_row_names(rows, source):
    wrong = []
    for row in rows:
        files = [file for file, *_ in row.places]
        if files and not any(row.cited & parts(source(file)) for file in files):
            wrong.append(f"{row.paper}: cited in none of {files}")
    assert not wrong, "\n".join(wrong)


def test_these_tests_can_fail():
    """A word in a comment is no definition, and a docstring of another equation is none of this."""
    module = '"""Of `lhs`."""\n# lhs\nX = 1\nclass A:\n    def lhs(self):\n        """Eq. 1."""\n'
    known = definitions(module)
    assert known == {"X": None, "A": "", "A.lhs": "Eq. 1."}
    page = "| Eq. 13 | LHS | `a.py`: `lhs` |\n| Eq. 1 | L | `a.py`: `A.lhs`, `X` |\n"
    rows = of_page(page)
    assert undefined(rows, lambda file: module) == ["Eq. 13: a.py has no lhs"]
    assert uncited(rows, lambda file: module) == []
    (wrong,) = uncited(of_page("| Eq. 2 | L | `a.py`: `A.lhs` |"), lambda file: module)
    assert "A.lhs does not cite it" in wrong
    assert parts("Paper: Eq. 5, Eq. 11, Sec. 4.1.") == {("Eq", "5"), ("Eq", "11"), ("Sec", "4.1")}
    assert parts("(Eq. 3, 10)") == {("Eq", "3"), ("Eq", "10")}
