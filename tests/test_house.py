"""Rules of the house that no linter knows."""

import ast
import re

import pytest

FORBIDDEN = {
    "unfinished work": r"\b(TODO|FIXME|XXX)\b|raise NotImplementedError",
    "a path of one machine": (
        r"[\"'\s(=](/home/|/root/|/Users/|/work/|/tmp/|/mnt/|[A-Z]:\\\\?Users)"
    ),
}

RUN, DATA = "training/run_folder.py", "dataset/data_folder.py"
SOLVED = "training/solved.py"  # has a folder of its own, with a field in it
#: The modules that own them, names of files in any text, and names of folders in paths.
FILE_NAMES = {
    "run": (
        {RUN, SOLVED},
        r"config\.toml|origin\.json|log\.jsonl|metrics\.json|\.safetensors",
        r"checkpoints|previews|evaluation",
    ),
    "data set": (
        {DATA},
        r"transforms\.json|emission\.json|photographs\.npy|foreground\.npy|(^|/)\.cache",
        r"images|truth|scene|\.cache",
    ),
    "environment map": ({RUN, DATA}, r"environment\.exr", r"environment\."),
}


def spelled(tree, files, folders):
    """Lines of a module that spell a file's name outside of docstrings, or a folder's in a path."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = {
        node.body[0].value
        for node in ast.walk(tree)
        if isinstance(node, documented) and node.body and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
            part, pattern = node.right, rf"({folders})(/|$)"
        elif isinstance(node, ast.Constant) and node not in docstrings:
            part, pattern = node, files
        else:
            continue
        parts = part.values if isinstance(part, ast.JoinedStr) else [part]
        for part in parts[:1]:
            if isinstance(part, ast.Constant) and isinstance(part.value, str):
                search = re.match if pattern is not files else re.search
                if search(pattern, part.value):
                    yield part.lineno


def sources(repository):
    """Every text file of the package."""
    kinds = {".py", ".jinja", ".toml", ".js", ".css", ".html"}
    found = [p for p in sorted((repository / "src").rglob("*")) if p.suffix in kinds]
    assert found
    return found


@pytest.mark.parametrize("rule", FORBIDDEN)
def test_source_is_free_of(rule, repository):
    pattern = re.compile(FORBIDDEN[rule])
    hits = [
        f"{path.relative_to(repository)}:{number}: {line.strip()}"
        for path in sources(repository)
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        if pattern.search(line)
    ]
    assert not hits, "\n".join(hits)


@pytest.mark.parametrize(
    ("rule", "line", "hit"),
    [
        ("unfinished work", "# TODO: later", True),
        ("a path of one machine", 'open("/home/me/scene.xml")', True),
        ("a path of one machine", '"/usr/lib/*/libLLVM*.so*"', False),
    ],
)
def test_the_rules_catch_what_they_are_for(rule, line, hit):
    assert bool(re.search(FORBIDDEN[rule], line)) is hit


@pytest.mark.parametrize("what", FILE_NAMES)
def test_one_module_names_the_files_of_a_folder(what, repository):
    owners, *names = FILE_NAMES[what]
    root = repository / "src" / "unbake"
    modules = {path.relative_to(root).as_posix(): path for path in root.rglob("*.py")}
    for folder in ("benchmarks", "scripts"):
        modules |= {f"{folder}/{path.name}": path for path in (repository / folder).glob("*.py")}
    hits = {
        module: lines
        for module, path in modules.items()
        if (lines := list(spelled(ast.parse(path.read_text("utf-8")), *names)))
    }
    assert hits.keys() & owners
    assert not {module: lines for module, lines in hits.items() if module not in owners}


@pytest.mark.parametrize(
    ("line", "hits"),
    [
        ('read(run / "config.toml")', 1),
        ('raise UserError("no checkpoints; remove previews/ and config.toml")', 1),
        ('f"{run}/log.jsonl"', 1),
        ('run / "checkpoints"', 1),
        ('run / "evaluation/heldout"', 1),
        ('run / f"previews/{name}"', 1),
        ('{"evaluation": 1}', 0),
        ('def f():\n    """Reads config.toml."""', 0),
    ],
)
def test_a_file_name_outside_its_module_is_found(line, hits):
    _, *names = FILE_NAMES["run"]
    assert len(list(spelled(ast.parse(line), *names))) == hits


def test_every_file_tells_the_same_version(repository):
    import unbake

    cited = re.search(r"^version: (.+)$", (repository / "CITATION.cff").read_text("utf-8"), re.M)
    newest = re.search(r"^## \[(.+?)\]", (repository / "CHANGELOG.md").read_text("utf-8"), re.M)
    assert cited[1] == newest[1] == unbake.__version__


def test_the_fast_tests_are_there(repository):
    text = (repository / "Makefile").read_text("utf-8").replace("\\\n", " ")
    paths = re.search(r"^FAST := (.*)$", text, flags=re.MULTILINE)[1].split()
    assert len(paths) > 5 and [p for p in paths if not (repository / p).exists()] == []


def test_contributors_read_the_layers_that_are_held(repository):
    text = (repository / "pyproject.toml").read_text("utf-8")
    held = re.search(r"^layers = \[(.*?)^\]", text, re.M | re.S)[1]
    layers = [name for name in re.findall(r"\w+", held) if not name.startswith(("__", "probe"))]
    told = re.search(
        r"```text\n(cli >.*?)```", (repository / "CONTRIBUTING.md").read_text("utf-8"), re.S
    )
    assert re.findall(r"\w+", told[1]) == layers
