"""`unbake.Run`: what a notebook does with a run."""

import re
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import randomised, tiny_fields

import unbake
from unbake.evaluation.settings import EvaluationSettings, RenderSettings
from unbake.imaging.pictures import read_exr, write_exr
from unbake.training.loop import fit

SILENT = {"tell": lambda line: None}


@pytest.fixture(scope="module")
def folder(cornell, tmp_path_factory):
    """A run of a few steps."""
    path = tmp_path_factory.mktemp("runs") / "run"
    config = replace(tiny_fields("grid"), method="direct", steps=2, score_seconds=0.0)
    fit(cornell, path, config)
    return path


@pytest.fixture(scope="module")
def run(folder):
    """That run with large random parameters, so that its materials differ from place to place."""
    run = unbake.Run(str(folder))
    materials = run.recovered.problem.materials
    for number, field in enumerate(materials.values()):
        dr.disable_grad(randomised(field, number))
    materials.stand_alone()
    return run


def test_nothing_is_loaded_before_it_is_needed(folder):
    run = unbake.Run(folder)
    assert run.settings.method == "direct" and run.log[-1]["step"] == 2
    assert repr(run) == f"Run({str(folder)!r})"
    assert "not evaluated yet" in run._repr_html_()
    assert not {"recovered", "dataset"} & vars(run).keys()
    assert len(run.cameras("train")) == 2 and len(run.cameras("heldout")) == 1
    assert len(run.cameras()) == 3 and "recovered" not in vars(run)
    with pytest.raises(unbake.UserError, match="unknown split 'test'"):
        run.cameras("test")


def test_what_was_recovered_prints_as_one_line(run):
    found = run.recovered
    assert isinstance(found, unbake.Recovered)
    told = f"'materials' by 'direct', 2 steps, {str(run.dataset.folder)!r}"
    assert repr(found) == f"Recovered({told})"


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(unbake.UserError, match="no run in this folder"):
        unbake.Run(str(tmp_path))


def test_a_picture_of_a_camera_a_view_or_a_name(run):
    view = run.dataset.heldout[0]
    found = [run.render(x, spp=4) for x in (view.camera, view, view.name)]
    assert found[0].shape == (16, 16, 3) and found[0].dtype == np.float32
    assert found[0].mean() > 0.01 and run.scene is run.recovered.problem.scene_view.scene
    for other in found[1:]:
        np.testing.assert_array_equal(found[0], other)
    assert run.render(view, spp=1, width=8).shape == (8, 8, 3)
    with pytest.raises(unbake.UserError, match="no view named 'nothing'"):
        run.render("nothing")
    with pytest.raises(unbake.UserError, match="spp"):
        run.render(view, spp=0)
    with pytest.raises(unbake.UserError, match="spp: must be int, not float"):
        run.render(view, spp=2.5)
    with pytest.raises(unbake.UserError, match="width: must be int, not float"):
        run.render(view, width=33.5)
    assert run.render(view, spp=np.int64(1), width=np.int32(8)).shape == (8, 8, 3)


def test_materials_are_those_of_the_surfaces_that_rays_meet(run):
    camera = run.cameras("train")[0]
    x, y = (axis.ravel() + 0.5 for axis in np.meshgrid(np.arange(16), np.arange(16)))
    origins, directions = camera.rays(x, y)
    found = run.material_along(origins, 3 * directions)
    problem = run.recovered.problem
    ray = mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(directions.T))
    si = run.scene.ray_intersect(ray)
    expected = problem.materials.evaluate(si, si.is_valid())
    seen = np.array(si.is_valid() & problem.scene_view.is_optimized(si.shape))
    np.testing.assert_array_equal(found["seen"], seen)
    assert found.keys() == {"albedo", "roughness", "seen"} and seen.mean() > 0.5
    albedo, roughness = np.array(expected["albedo"]).T, np.array(expected["roughness"])
    assert albedo[seen].std() > 0.02
    np.testing.assert_allclose(found["albedo"][seen], albedo[seen], atol=1e-4)
    np.testing.assert_allclose(found["roughness"][seen], roughness[seen], atol=1e-4)
    assert (found["albedo"][~seen] == 0).all()
    one = run.material_along(origins[0], directions[0])
    np.testing.assert_allclose(one["albedo"], found["albedo"][:1], atol=1e-5)


@pytest.mark.parametrize(
    ("origins", "directions", "what"),
    [
        ([[0, 0, 0]], [[0, 0, 0]], "its direction is zero"),
        ([[0, 0, np.nan]], [[0, 0, 1]], "not finite"),
        ([[0, 0]], [[0, 1]], "have shape"),
        ([[0, 0, 0]] * 2, [[0, 0, 1]] * 3, "2 origins and 3 directions"),
        ([[0, 0, 0]] * 2, [[0, 0, 1]], "2 origins and 1 directions"),
        ([[0, 0, 0]] * 2, [0, 1], "like shapes"),
        (["a"], ["b"], "like shapes"),
        (np.zeros((0, 3)), np.zeros((0, 3)), "^no rays are given. Give origins and directions of"),
        (None, [0, 0, 1], "^no rays are given"),
    ],
)
def test_bad_rays_are_refused(run, origins, directions, what):
    with pytest.raises(unbake.UserError, match=what):
        run.material_along(origins, directions)


def test_materials_are_those_of_texture_coordinates(run):
    (file,) = run.dataset.scene.parent.rglob("left.ply")
    mesh = mi.load_dict({"type": "ply", "filename": str(file)})
    uv = np.random.default_rng(2).uniform(-0.1, 1.1, (300, 2)).astype(np.float32)
    found = run.material("left", uv)
    si = mesh.eval_parameterization(mi.Point2f(uv.T.copy()))
    valid = np.array(si.is_valid())
    assert found.keys() == {"albedo", "roughness", "on_mesh", "observed"}
    np.testing.assert_array_equal(found["on_mesh"], valid)
    assert 0.3 < valid.mean() < 1
    expected = run.recovered.problem.materials.evaluate(si, si.is_valid())
    albedo, roughness = np.array(expected["albedo"]).T, np.array(expected["roughness"])
    assert albedo[valid].std() > 0.02 and found["albedo"].dtype == np.float32
    np.testing.assert_allclose(found["albedo"][valid], albedo[valid], atol=1e-4)
    np.testing.assert_allclose(found["roughness"][valid], roughness[valid], atol=1e-4)
    assert (found["albedo"][~valid] == 0).all()
    assert 0 < found["observed"].sum() <= valid.sum()
    one = run.material("left", uv[0])
    np.testing.assert_allclose(one["albedo"], found["albedo"][:1], atol=1e-5)


@pytest.mark.parametrize(
    ("mesh", "uv", "what"),
    [
        ("nothing", [[0, 0]], "no mesh named 'nothing'.*There are room, left"),
        ("light", [[0, 0]], "'light' was known"),
        ("left", [[0, 0, 0]], "have shape"),
        ("left", [["a", "b"]], "no array of numbers"),
        ("left", [[0, np.inf]], "not finite"),
        ("left", np.zeros((0, 2)), "^no texture coordinates are given. Give texture coord"),
        ("left", [], "^no texture coordinates are given"),
        ("left", None, "^no texture coordinates are given"),
    ],
)
def test_texture_coordinates_that_cannot_be_asked_are_refused(run, mesh, uv, what):
    with pytest.raises(unbake.UserError, match=what):
        run.material(mesh, uv)


def test_a_mesh_without_texture_coordinates_is_refused(run, monkeypatch):
    part = run._parts["left"]
    bare = replace(part, triangles=replace(part.triangles, uv=None))
    monkeypatch.setitem(run._parts, "left", bare)
    with pytest.raises(unbake.UserError, match=r"no texture coordinates.*material_along"):
        run.material("left", [[0, 0]])


@pytest.mark.slow
def test_the_commands(folder, tmp_path):
    run = unbake.Run(folder)
    settings = EvaluationSettings(spp=1, train_views=1, material_spp=1)
    made = run.evaluate(settings, **SILENT)
    assert made == run.metrics
    table = run._repr_html_()
    assert re.search(r"<td>held-out views</td><td>\d+\.\d</td>", table)
    assert "<th>render</th><th>albedo</th>" in table and "<td>untrained fields</td>" in table
    assert run.report(f"{tmp_path}/report.html").is_file()
    write_exr(tmp_path / "sky.exr", np.ones((4, 8, 3), np.float32))
    lit = run.relight(
        f"{tmp_path}/relit", f"{tmp_path}/sky.exr", RenderSettings(spp=1, width=8), **SILENT
    )
    assert lit["light"]["envmap"] == f"{tmp_path}/sky.exr" and len(lit["frames"]) == 1
    assert read_exr(tmp_path / "relit" / "heldout_000.exr").shape[:2] == (8, 8)
    written = run.export(f"{tmp_path}/exported", "textures", texels=4.0, **SILENT)
    assert written["formats"] == ["textures"] and written["files"]
