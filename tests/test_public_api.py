"""The names of `import unbake`: what a script or a notebook meets first."""

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import unbake

PACKAGE = Path(unbake.__file__).parent


def fresh(code: str, **environment: str) -> str:
    """What a new interpreter prints that runs this code."""
    run = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": str(PACKAGE.parent), **environment},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


def names_for_type_checkers() -> dict[str, str]:
    """Public name → module, as the `if TYPE_CHECKING` block has it."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text("utf-8"))
    (block,) = (n for n in tree.body if isinstance(n, ast.If) and "TYPE_CHECKING" in ast.dump(n))
    imports = [n for n in [*tree.body, *block.body] if isinstance(n, ast.ImportFrom) and n.level]
    for statement in imports:
        for alias in statement.names:
            assert alias.asname == alias.name, "only `X as X` is public to type checkers"
    return {alias.name: str(n.module) for n in imports for alias in n.names}


def modules() -> list[str]:
    """Every module of the package."""
    found = [m.name for m in pkgutil.walk_packages([str(PACKAGE)], "unbake.")]
    assert len(found) > 50
    return [name for name in found if not name.endswith("__main__")]


def test_type_checkers_see_what_is_public():
    assert names_for_type_checkers() == unbake._HOME
    assert (PACKAGE / "py.typed").is_file()


def test_no_public_name_is_hidden_by_a_module():
    own = {name.partition(".")[2] for name in modules()}
    assert "training" in own
    assert not own & set(unbake.__all__)


def test_public_names_stay_the_same_once_everything_is_imported():
    before = {name: getattr(unbake, name) for name in unbake.__all__}
    for name in modules():
        importlib.import_module(name)
    assert {name for name, value in before.items() if getattr(unbake, name) is not value} == set()
    assert {name for name, value in before.items() if type(value) is type(unbake)} == set()


def test_a_function_can_be_called_again_and_again(tmp_path):
    for _ in range(2):
        with pytest.raises(unbake.UserError):
            unbake.fit(tmp_path / "none", tmp_path / "run", unbake.preset("cpu"))


def test_dir_names_everything_public():
    assert set(unbake.__all__) | {"__version__"} <= set(dir(unbake))
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        _ = unbake.fitt


def test_importing_loads_no_mitsuba():
    pure = [name for name, module in unbake._HOME.items() if module in unbake._PURE]
    code = f"import sys, unbake; [getattr(unbake, n) for n in {pure}]; print(*sys.modules)"
    loaded = set(fresh(code).split())
    assert "unbake.config" in loaded
    assert not {"mitsuba", "drjit", "numpy", "rich", "tyro"} & loaded


def functions_of_paths() -> dict[str, str]:
    """Public functions and methods that take paths: name → how those arguments are annotated."""
    found = {}
    for name in unbake.__all__:
        value = getattr(unbake, name)
        functions = {name: value} if inspect.isfunction(value) else {}
        if inspect.isclass(value):
            functions = {f"{name}.{k}": getattr(value, k) for k in vars(value) if k[0] != "_"}
        for called, function in functions.items():
            if not (inspect.isfunction(function) or inspect.ismethod(function)):
                continue
            notes = [str(p.annotation) for p in inspect.signature(function).parameters.values()]
            notes = [note for note in notes if re.search(r"\bPath\b", note)]
            if notes:
                found[called] = ", ".join(notes)
    return found


def test_paths_may_be_texts(tmp_path):
    found = functions_of_paths()
    assert {name: notes for name, notes in found.items() if "str" not in notes} == {}
    told = inspect.signature(unbake.LightConfig).parameters
    assert all("str" in told[name].annotation for name in ("envmap", "lights"))
    here, none, cpu = str(tmp_path), str(tmp_path / "none"), unbake.preset("cpu")
    light = unbake.LightConfig(envmap=none)
    methods, settings = [unbake.MethodVariant("ours")], unbake.EvaluationSettings()
    refused = {
        "capture": lambda: unbake.capture(f"{none}.xml", none, unbake.CaptureSettings()),
        "import_data": lambda: unbake.import_data(none, f"{none}-data", [f"{none}.ply"]),
        "degrade": lambda: unbake.degrade(none, f"{none}-worse", unbake.DegradeSettings()),
        "fit": lambda: unbake.fit(none, f"{none}-run", cpu),
        "evaluate": lambda: unbake.evaluate(none),
        "render": lambda: unbake.render(none, f"{none}-pictures"),
        "relight": lambda: unbake.relight(none, f"{none}-pictures", light),
        "export": lambda: unbake.export(none, f"{none}-exported"),
        "solve": lambda: unbake.solve(f"{none}.xml", f"{none}-solved"),
        "fine_tune": lambda: unbake.fine_tune(none, f"{none}-tuned"),
        "load_radiance": lambda: unbake.load_radiance(none),
        "compare": lambda: unbake.compare(none, methods, here, cpu, evaluation=settings),
        "write_report": lambda: unbake.write_report([none], f"{none}.html"),
        "load_run": lambda: unbake.load_run(none),
        "make_problem": lambda: unbake.make_problem(f"{none}.xml", "visible", cpu, 1.0, here),
        "read_toml": lambda: unbake.read_toml(none),
        "Dataset.load": lambda: unbake.Dataset.load(none),
    }
    for call in refused.values():
        with pytest.raises(unbake.UserError, match="none"):
            call()
    camera = unbake.Camera.look_at((0, 0, 1), (0, 0, 0), (0, 1, 0), 45, 8, 8)
    view = unbake.View("a", "train", camera, f"{here}/a.exr", {"albedo": f"{here}/b.exr"})
    data = unbake.Dataset(here, f"{here}/scene.xml", "visible", (view,), {}, None)
    data.save(here)
    folder, run = unbake.DataFolder(here), unbake.RunFolder(here)
    assert folder.transforms_file.is_file() and folder.known(str(folder.transforms_file))
    assert folder.relative(f"{here}/a.exr") == "a.exr"
    checkpoint = run.checkpoint(3)
    checkpoint.mkdir(parents=True)
    run.checkpoint(4).mkdir()
    run.tidy_checkpoints(str(checkpoint))
    assert run.written_checkpoints() == [checkpoint]
    tried = {"Dataset.save", "DataFolder.known", "DataFolder.relative"}
    tried |= {"RunFolder.tidy_checkpoints"}
    assert "none" in str(unbake.check_data(none).findings)
    assert unbake.LightConfig.of(none) == light
    tried |= {"check_data", "LightConfig.of"}
    elsewhere = {"Run.export", "Run.relight", "Run.report"}  # in test_run.py
    assert found.keys() == refused.keys() | tried | elsewhere


def test_help_is_complete_and_chooses_a_variant():
    text = fresh("import unbake; help(unbake)")
    shown = re.findall(r"^    (?:class )?(\w+)(?:\(| =|$)", text, flags=re.MULTILINE)
    assert set(unbake.__all__) - set(shown) == set()


def test_without_llvm_the_remedy_is_told_and_help_still_works():
    code = """
import unbake
try:
    unbake.fit
except unbake.UserError as error:
    print(error)
help(unbake)
"""
    nowhere = {"DRJIT_LIBLLVM_PATH": "/nowhere/libLLVM.so", "UNBAKE_VARIANT": "llvm_ad_rgb"}
    text = fresh(code, **nowhere)
    assert text.startswith("DRJIT_LIBLLVM_PATH: there is no file")
    assert "class UserError" in text
    assert [n for n in unbake.__all__ if not re.search(rf"    .*\b{n}\b", text)] == []


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda path: unbake.fit(path, path, "cpu"), "config: must be FitConfig, not str"),
        (lambda path: unbake.fit(path, path, {"steps": 2}), "config: must be FitConfig, not dict"),
        (lambda path: unbake.fit(path, path, None), "config: must be FitConfig, not NoneType"),
        (lambda path: unbake.with_defaults({}, None), "config: must be FitConfig, not dict"),
        (
            lambda path: unbake.compare(path, [], path, "cpu", evaluation=None),
            "config: must be FitConfig, not str",
        ),
        (
            lambda path: unbake.compare(path, [], path, unbake.preset("cpu"), evaluation=None),
            "evaluation: must be EvaluationSettings, not NoneType",
        ),
        (
            lambda path: unbake.evaluate(path, {"spp": 3}),
            "settings: must be EvaluationSettings, not dict",
        ),
        (lambda path: unbake.render(path, path, 64), "settings: must be RenderSettings, not int"),
        (
            lambda path: unbake.relight(path, path, "sky.exr", 64),
            "settings: must be RenderSettings, not int",
        ),
        (lambda path: unbake.relight(path, path, None), "light: must be LightConfig, not NoneType"),
        (lambda path: unbake.solve("cube", path, 9), "settings: must be SolveSettings, not int"),
        (lambda path: unbake.fine_tune(path, path, 9), "settings: must be SolveSettings, not int"),
        (
            lambda path: unbake.capture("cube", path, None),
            "settings: must be CaptureSettings, not NoneType",
        ),
        (
            lambda path: unbake.capture("cube", path, unbake.CaptureSettings(), light=1),
            "light: must be LightConfig, not int",
        ),
        (
            lambda path: unbake.degrade(path, path, "png"),
            "settings: must be DegradeSettings, not str",
        ),
    ],
)
def test_an_argument_of_a_wrong_class_is_told_first(call, message, tmp_path):
    path = tmp_path / "none"
    with pytest.raises(unbake.UserError, match=f"^{message}. Give one, such as unbake\\."):
        call(path)
    assert not path.exists()


def test_the_file_of_an_environment_map_is_a_light():
    for path in ("sky.exr", Path("sky.exr")):
        assert unbake.LightConfig.of(path) == unbake.LightConfig(envmap="sky.exr")
    light = unbake.LightConfig(lights="lamps.xml")
    assert unbake.LightConfig.of(light) is light
