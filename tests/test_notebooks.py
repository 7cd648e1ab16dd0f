"""The notebooks run from their first to their last cell, at a size that takes seconds."""

import json

import pytest

#: Values that a test puts in the place of those of the cell with the tag `parameters`.
SMALL = {
    "quick_start": "work, mesh = 'quick-start', 'left'\n"
    "scene, resolution, views, steps, spp = 'cornell', 16, 2, 4, 2\n",
    "custom_training_loop": "data, steps = {cornell!r}, 4\n",
}


@pytest.fixture
def notebook(repository, monkeypatch, tmp_path):
    """Run a notebook in a folder of its own; returns it with its outputs."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    monkeypatch.setenv("PYTHONPATH", str(repository / "src"))
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")

    def run(name, **values):
        made = nbformat.read(repository / "examples" / f"{name}.ipynb", as_version=4)
        (cell,) = (c for c in made.cells if "parameters" in c.metadata.get("tags", ()))
        cell.source = SMALL[name].format(**values)
        resources = {"metadata": {"path": str(tmp_path)}}
        nbclient.NotebookClient(made, timeout=1000, resources=resources).execute()
        return made

    return run


def texts(notebook):
    """What the cells printed, and what they showed as text."""
    outputs = [o for c in notebook.cells if c.cell_type == "code" for o in c.outputs]
    return "".join(o.get("text", "") or o.get("data", {}).get("text/html", "") for o in outputs)


def test_notebooks_are_kept_without_outputs(repository):
    files = sorted((repository / "examples").glob("*.ipynb"))
    assert {file.stem for file in files} == SMALL.keys()
    for file in files:
        cells = [c for c in json.loads(file.read_text("utf-8"))["cells"] if "outputs" in c]
        assert cells and all(not c["outputs"] and c["execution_count"] is None for c in cells)


@pytest.mark.filterwarnings("ignore")  # those of Jupyter
def test_the_loop_of_ones_own_runs(notebook, cornell):
    made = notebook("custom_training_loop", cornell=str(cornell))
    assert "mean loss" in texts(made) and "2 views, 512 pixels" in texts(made)
    shown = [o for c in made.cells if c.cell_type == "code" for o in c.outputs if "data" in o]
    assert any("image/png" in o.data for o in shown)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_quick_start_runs(notebook, tmp_path):
    told = texts(notebook("quick_start"))
    assert "<td>held-out views</td>" in told and "on the mesh" in told
    assert "open quick-start/report.html" in told
    page = (tmp_path / "quick-start" / "report.html").read_text("utf-8")
    assert 'id="relit"' in page and 'id="textures"' in page
