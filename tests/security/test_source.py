"""The package's code: nothing in it runs what stands in a file, or goes to the network."""

import ast
import os
import subprocess
import sys

import pytest

#: Modules that run code from data, or load it, whatever they are asked.
LOADERS = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve",
           "code", "codeop", "pty", "imp", "runpy"}  # fmt: skip
NETWORK = {"socket", "ssl", "http", "urllib", "urllib3", "ftplib", "smtplib", "poplib", "imaplib",
           "telnetlib", "socketserver", "xmlrpc", "requests", "httpx", "aiohttp", "asyncio",
           "webbrowser", "huggingface_hub"}  # fmt: skip
#: Functions that run what they are given, by their full name.
RUNNERS = {"eval", "exec", "compile", "__import__", "builtins.eval", "builtins.exec", "os.system",
           "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput", "yaml.load",
           "yaml.full_load", "yaml.unsafe_load", "yaml.load_all", "torch.hub.load",
           "torch.jit.load", "sys.modules.__getitem__"}  # fmt: skip
#: Keywords that must be False wherever they stand.
UNSAFE = {"shell", "allow_pickle"}
#: Functions that are safe only with a keyword.
NEEDED = {"torch.load": ("weights_only", True)}
#: Where a module's name is computed, from a table of the package.
COMPUTED_IMPORTS = {"__init__.py", "experiments/__init__.py", "fields/registry.py"}
#: Where a shared library is loaded: LLVM and CUDA, which the user's machine or environment names.
LIBRARIES = {"backend.py", "training/memory.py", "machine.py"}


def full_name(node: ast.expr, aliases: dict[str, str]) -> str:
    """The dotted name of what is called, with what its first word was imported as."""
    words = []
    while isinstance(node, ast.Attribute):
        words.append(node.attr)
        node = node.value
    if not isinstance(node, ast.Name):
        return ""
    words.append(aliases.get(node.id, node.id))
    return ".".join(reversed(words))


def dangers(source: str, module: str = "module.py"):
    """What a module may not do, with its lines."""
    tree, aliases = ast.parse(source), {}
    for node in ast.walk(tree):
        for name, full in imported(node):
            aliases[name] = full
            if full.split(".")[0] in LOADERS | NETWORK:
                yield node.lineno, f"imports {full}"
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = full_name(node.func, aliases).replace("numpy.", "np.", 1)
            for what in dangers_of_call(name, node, module):
                yield node.lineno, f"{name} {what}"


def imported(node: ast.AST):
    """Names that a statement imports from outside the package, each with its full name."""
    if isinstance(node, ast.Import):
        for name in node.names:
            first = name.name.split(".")[0]
            yield (name.asname, name.name) if name.asname else (first, first)
    elif isinstance(node, ast.ImportFrom) and not node.level:
        for name in node.names:
            yield name.asname or name.name, f"{node.module}.{name.name}"


def dangers_of_call(name: str, node: ast.Call, module: str):
    """What is wrong with a call of a function of this name."""
    keywords = {k.arg: k.value for k in node.keywords}
    if name in RUNNERS:
        yield "runs what it is given"
    for word in UNSAFE & keywords.keys():
        if not is_constant(keywords[word], False):
            yield f"with {word}"
    if name in NEEDED:
        word, safe = NEEDED[name]
        if not is_constant(keywords.get(word), safe):
            yield f"without {word}={safe}"
    if name == "np.load" and len(node.args) > 2:
        yield "with allow_pickle"
    computed = node.args and not isinstance(node.args[0], ast.Constant)
    if name == "importlib.import_module" and computed and module not in COMPUTED_IMPORTS:
        yield "with a computed name"
    if name in ("ctypes.CDLL", "ctypes.cdll.LoadLibrary") and module not in LIBRARIES:
        yield "loads a shared library"


def is_constant(node: ast.expr | None, value: object) -> bool:
    return isinstance(node, ast.Constant) and node.value is value


def test_nothing_in_the_package_runs_code_from_data_or_goes_to_the_network(repository):
    root = repository / "src" / "unbake"
    modules = sorted(root.rglob("*.py"))
    assert len(modules) > 80
    found = [
        f"{path.relative_to(root)}:{line}: {what}"
        for path in modules
        for line, what in dangers(path.read_text("utf-8"), path.relative_to(root).as_posix())
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from pickle import loads",
        "import marshal as m",
        "import shelve",
        "eval(text)",
        "exec(text)",
        "exec(compile(text, 'a', 'exec'))",
        "__import__(name)",
        "import importlib\nimportlib.import_module(name)",
        "from importlib import import_module as load\nload(name)",
        "import os\nos.system(text)",
        "from os import system as run\nrun(text)",
        "import subprocess\nsubprocess.run(text, shell=True)",
        "import subprocess as s\ns.Popen(text, shell=chosen)",
        "import subprocess\nsubprocess.getoutput(text)",
        "import numpy as np\nnp.load(path, allow_pickle=True)",
        "import numpy\nnumpy.load(path, None, True)",
        "import yaml\nyaml.load(text, yaml.Loader)",
        "import torch\ntorch.load(path)",
        "import torch\ntorch.load(path, weights_only=False)",
        "import socket",
        "import urllib.request",
        "from http import client",
        "import ctypes\nctypes.CDLL(path)",
        "from builtins import eval as e\ne(text)",
    ],
)
def test_a_danger_is_found(line):
    assert list(dangers(line))


@pytest.mark.parametrize(
    "line",
    [
        "import re\nre.compile(text)",
        "import drjit as dr\ndr.eval(value)",
        "bsdf.eval(context)",
        "import subprocess\nsubprocess.run(words, shell=False)",
        "import numpy as np\nnp.load(path, mmap_mode='r')",
        "import torch\ntorch.load(path, weights_only=True)",
        "import json\njson.load(file)",
        "from .. import http",
    ],
)
def test_what_is_no_danger_is_let_through(line):
    assert not list(dangers(line))


# ------------------------------------------------------------------------------------- what runs

#: Ends the process when Python opens a socket, or unpickles an object of a class.
WATCHED = """
import os, sys
def watch(event, arguments):
    if event == "pickle.find_class" or event.startswith("socket.__new__"):
        os.write(2, f"{event} {arguments}".encode())
        os._exit(77)
sys.addaudithook(watch)
"""


def run_watched(script, *words, **options):
    return subprocess.run(
        [sys.executable, "-c", WATCHED + script, *map(str, words)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
        capture_output=True,
        text=True,
        timeout=250,
        **options,
    )


@pytest.mark.parametrize("script", ["import socket; socket.socket()", "import pickle, decimal\n"
                                    "pickle.loads(pickle.dumps(decimal.Decimal))"])  # fmt: skip
def test_the_watch_sees(script):
    assert run_watched(script).returncode == 77


def test_importing_all_of_the_package_opens_no_socket_and_writes_no_file(tmp_path):
    script = """
import importlib, pkgutil
from unbake import backend
backend.activate()
import unbake
for module in pkgutil.walk_packages(unbake.__path__, "unbake."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
print("done")
"""
    done = run_watched(script, cwd=tmp_path)
    assert done.returncode == 0 and done.stdout.split()[-1] == "done", done.stderr[-2000:]
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_commands_open_no_socket_and_unpickle_nothing(tiny, tmp_path):
    script = """
import sys
from unbake import cli
cli.main()
"""
    for words in (
        ("capture", "cube", "--out", "data", "--views", 2, "--held-out", 1, "--resolution", 12),
        ("fit", "data", "--out", "run", "--settings", tiny, "--steps", 4),
        ("evaluate", "run", "--spp", 2),
        ("report", "run", "--out", "report.html"),
    ):
        done = run_watched(script, *words, cwd=tmp_path)
        assert done.returncode == 0, (words, done.stdout[-500:], done.stderr[-2000:])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "report.html", "run"]
