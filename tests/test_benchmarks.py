"""The benchmarks run to their end at smoke scale, continue, and become tables."""

import json
import os
import runpy
import subprocess
import sys
import time
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest


def call(repository, script, *words, staircase=""):
    done = subprocess.run(
        [sys.executable, str(repository / "benchmarks" / script), *map(str, words)],
        env={**os.environ, "STAIRCASE": str(staircase), "MINUTES": ""},
        capture_output=True,
        text=True,
        timeout=280,
    )
    return done


def read(file):
    return json.loads(file.read_text())


@pytest.mark.slow
def test_jobs_of_every_kind_run_to_their_end_and_once(repository, cornell, tmp_path):
    words = ("machine", "steps", "emission", "--scale", "smoke", "--out", tmp_path)
    done = call(repository, "run.py", *words, staircase=cornell)
    assert done.returncode == 0, done.stderr[-3000:]
    results = tmp_path / "smoke" / "results"
    names = {file.stem for file in results.iterdir()}
    (machine,) = names - {"methods-demo", "emission"}
    assert len(names) == 3
    steps = read(results / f"{machine}.json")
    assert [step["data"] for step in steps["steps"]] == ["demo", "cornell"]
    assert steps["machine"]["cores"] >= 1 and "machine" not in steps["steps"][0]
    rows = read(results / "methods-demo.json")["rows"]
    assert [row["method"] for row in rows] == ["ours", "direct"]
    assert all(row["milliseconds_per_step"] > 0 for row in rows)
    emission = read(results / "emission.json")
    assert emission["unknown"] == "emission" and emission["seeds"] == [0]
    assert emission["methods"]["ours"]["steps"] == 4
    assert emission["methods"]["ours"]["emission_error"] > 0

    tables = call(repository, "tables.py", results).stdout
    assert "Emission" in tables and "Time of a step" in tables and "gradients" in tables

    record = tmp_path / "smoke" / "jobs" / "step-demo-ours.json"
    record.unlink()
    before = {file: file.stat().st_mtime_ns for file in record.parent.iterdir()}
    again = call(repository, "run.py", *words, staircase=cornell)
    assert again.returncode == 0 and "4 of 5 jobs are done" in again.stdout, again.stdout
    assert record.is_file()
    assert before == {file: file.stat().st_mtime_ns for file in before}


@pytest.mark.slow
def test_quick_methods_get_the_samples_of_the_slow_one(repository, tmp_path):
    done = call(repository, "run.py", "equal", "--scale", "smoke", "--out", tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    result = read(tmp_path / "smoke" / "results" / "equal-demo.json")
    rows = result["methods"]
    assert result["seeds"] == [0, 1] and rows.keys() == {"ours", "prb"}
    assert result["untrained"]["albedo_psnr"] > 0
    assert rows["prb"]["steps"] == 4 and "albedo_psnr_sd" in rows["ours"]
    passes = {"all-pairs": 1, "split-halves": 1, "two-pass": 2}[rows["prb"]["estimator"]]
    assert rows["ours"]["steps"] == 4 * passes
    assert rows["ours"]["samples"] == rows["prb"]["samples"] == 4 * passes * 256
    config = (tmp_path / "smoke" / "runs" / "equal-demo-1" / "ours" / "config.toml").read_text()
    assert f"steps = {4 * passes}\n" in config and "seed = 1\n" in config
    again = call(repository, "run.py", "equal", "--scale", "smoke", "--out", tmp_path)
    assert again.returncode == 0 and "all 5 jobs are done" in again.stdout, again.stdout


@pytest.mark.slow
def test_searches_of_rates_share_a_record_that_goes_on(repository, tmp_path):
    words = ("rates", "--scale", "smoke", "--out", tmp_path)
    done = call(repository, "run.py", *words)
    assert done.returncode == 0, done.stderr[-3000:]
    result = tmp_path / "smoke" / "results" / "rates.json"
    said = [
        (search["method"], search["data"], search["kind"]) for search in read(result)["searches"]
    ]
    assert said == [
        (method, *data)
        for method in ("ours", "no-prior", "direct")
        for data in (("cornell", "room"), ("small-still", "object"))
    ]
    assert all(search["best"] and search["seeds"] == [0] for search in read(result)["searches"])
    fitted = [search["trials"] for search in read(result)["searches"]]
    # A job that was stopped repeats no fit.
    (tmp_path / "smoke" / "jobs" / "rates-direct.json").unlink()
    result.unlink()
    again = call(repository, "run.py", *words)
    assert again.returncode == 0 and "4 of 5 jobs are done" in again.stdout, again.stdout
    assert [search["trials"] for search in read(result)["searches"]] == fitted


def test_searches_of_rates_have_a_job_a_method(repository, benchmarks, tmp_path):
    done = call(repository, "run.py", "rates", "--plan", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "0 of 6 jobs are done, the others take about" in done.stdout
    jobs = done.stdout.splitlines()[1:]
    searches = [f"  rates-{method}" for method in ("prb", "ours", "no-prior", "direct")]
    assert jobs == ["  data-cornell", "  data-small-still", *searches]
    run, facts = benchmarks("run"), read(repository / "benchmarks" / "results" / "rates.json")
    # The numbers of the search that is committed.
    data, search = run["DATA"]["cornell"], facts["searches"][0]
    assert (data.views, data.held_out) == (search["views"], search["heldout"])
    assert [data.resolution] * 2 == search["resolution"]
    assert run["BENCHMARKS"]["rates"].seconds["prb"] == search["settings"]["seconds"]


@pytest.mark.slow
def test_a_solved_scene_is_measured(repository, tmp_path):
    small = ("--steps", 3, "--views", 1, "--resolution", 8, "--final-spp", 4, "--reference-spp", 4)
    out = tmp_path / "out.json"
    words = ("--scene", "furnace", "--work", tmp_path / "solved", "--out", out)
    done = call(repository, "solve_demo.py", *words, *small)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "rhs: relMSE" in done.stdout and "cores busy" in done.stdout
    last = read(out)["measurements"][-1]
    assert (last["step"], last["spp"]) == (3, 4) and last["cpu_seconds"] > 0


def test_a_plan_tells_what_is_left_and_what_is_left_out(repository, tmp_path):
    done = call(repository, "run.py", "long", "staircase", "machine", "--plan", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "0 of 8 jobs are done, the others take about" in done.stdout
    for job in ("data-demo", "compiled-long-demo", "long-demo-0"):
        assert f"\n  {job}\n" in done.stdout
    assert "STAIRCASE is not set: staircase is left out" in done.stdout
    assert "STAIRCASE is not set: its ours is left out" in done.stdout
    assert not list(tmp_path.iterdir())


def test_a_job_that_does_not_exist_is_named(repository, tmp_path):
    done = call(repository, "run.py", "ladder", "--out", tmp_path)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "no job named 'ladder'. There are machine, steps, demo, rivals" in done.stderr


@pytest.fixture
def benchmarks(repository, monkeypatch):
    """Functions of a script of `benchmarks`: `benchmarks("summary")["summary"]`."""
    monkeypatch.syspath_prepend(str(repository / "benchmarks"))
    return lambda name: runpy.run_path(str(repository / "benchmarks" / f"{name}.py"))


def comparison(folder, seed, psnr, error=None):
    """What `unbake compare` writes, reduced to what is read of it."""
    length = {
        "steps": 5 + seed,
        "samples": 10 * (5 + seed),
        "seconds": 1.0,
        "milliseconds_per_step": 2.0,
    }
    fields = {"representation": "neural", "radiance": "neural"}
    heldout = {"views": 4, "albedo_psnr": psnr, "roughness_psnr": None}
    row = length | fields | {"heldout": heldout, "score": [{"step": 0}]}
    row |= {"environment": {"sh_error": 0.5}, "emission": [{"emission_error": psnr / 10}]}
    methods = {"ours": row, "prb": row if error is None else {"error": error}}
    settings = {"unknown": "materials", "seed": seed}
    content = {"machine": {}, "settings": settings, "methods": methods, "time_to_quality": []}
    content["untrained"] = {"heldout": heldout | {"albedo_psnr": 8.0}}
    folder.mkdir()
    (folder / "compare.json").write_text(json.dumps(content))
    return folder


def test_seeds_become_mean_and_spread(benchmarks, tmp_path):
    summary = benchmarks("summary")["summary"]
    folders = [comparison(tmp_path / f"{seed}", seed, 20.0 + seed) for seed in (0, 2)]
    both = summary(folders)
    assert both["seeds"] == [0, 2] and both["views"] == 4
    ours = both["methods"]["ours"]
    assert ours["steps"] == 6 and ours["steps_sd"] == pytest.approx(2**0.5)
    assert ours["albedo_psnr"] == 21.0 and ours["albedo_psnr_sd"] == pytest.approx(2**0.5)
    assert ours["sh_error"] == 0.5 and ours["emission_error"] == pytest.approx(2.1)
    assert "roughness_psnr" not in ours
    assert [fit["seed"] for fit in ours["per_seed"]] == [0, 2]
    assert [fit["albedo_psnr"] for fit in ours["per_seed"]] == [20.0, 22.0]
    one = summary(folders[:1])["methods"]["ours"]
    assert one["albedo_psnr"] == 20.0 and "albedo_psnr_sd" not in one
    scores = benchmarks("summary")["scores"]
    assert scores(ours) == 2 * [[{"step": 0}]] and scores(one) == [[{"step": 0}]]
    assert scores({"steps": 5}) == []
    assert both["untrained"]["albedo_psnr"] == 8.0 and both["untrained"]["albedo_psnr_sd"] == 0.0
    failed = summary([*folders, comparison(tmp_path / "3", 3, 1.0, error="no memory")])
    assert failed["methods"]["prb"] == {"error": "no memory"}


def test_both_passes_of_the_slow_method_set_the_length_at_equal_samples(benchmarks):
    run = benchmarks("run")
    equal = run["BENCHMARKS"]["equal-demo"]
    rows = {"prb": {"steps": 7, "samples": 7 * 2 * 512}}
    settings = "pixels = 64\nspp = 8"
    assert run["steps_of_equal_samples"]({"methods": rows}, equal, settings) == 14
    mixed = replace(equal, methods=("ours", "prb"))
    with pytest.raises(ValueError, match="cannot have the same length"):
        run["steps_of_equal_samples"]({"methods": rows}, mixed, settings)
    rows["prb"] = {"error": "no memory"}
    with pytest.raises(Exception, match="rivals-demo: prb failed: no memory"):
        run["steps_of_equal_samples"]({"methods": rows}, equal, settings)


def test_a_response_is_compared_after_a_scale_of_all_channels(benchmarks):
    cameras = benchmarks("cameras")
    linear = np.linspace(0, 1, 257)
    truth = {"response": {"linear": linear.tolist(), "read": linear.tolist()}}
    curve = np.linspace(0, 1, 17) * 0.5 ** (1 / cameras["GAMMA"])
    found = cameras["errors"](
        {"response": dict.fromkeys(("red", "green", "blue"), curve.tolist())}, truth
    )
    assert found["response_scale"] == pytest.approx(2)
    assert found["response_scaled_error_most"] < 1e-3 < found["response_error_rms"]


def test_of_refined_poses_alone_a_camera_has_no_errors(benchmarks):
    camera = {"images": [{"name": "a", "split": "train", "transform_matrix": np.eye(4).tolist()}]}
    truth = {"views": {"a": {}}, "settings": {"exposure": 0.0}}
    assert benchmarks("cameras")["errors"](camera, truth) == {}


def test_all_faults_of_cameras_are_measured_together(benchmarks):
    """With the poses, exposures told and untold, and with the true mesh as well."""
    faults = benchmarks("cameras")["FAULTS"]
    every = {key for fault in ("exposure", "poses", "jpeg", "response", "vignetting", "mesh",
                               "white balance") for key in faults[fault].settings}  # fmt: skip
    told = {"tell_exposures"}
    assert faults["all"].settings.keys() == every
    assert faults["all, exposures told"].settings.keys() == every | told
    assert faults["all but mesh"].settings.keys() == every - {"decimate"}
    assert faults["all but mesh, exposures told"].settings.keys() == every - {"decimate"} | told
    for name in ("all", "all but mesh, exposures told"):
        words = " ".join(faults[name].words)
        assert "--poses refined" in words
        assert ("--exposures per-image" in words) == (name == "all")


def test_tables_have_the_untrained_fields_first_and_tell_of_how_many_seeds(benchmarks, tmp_path):
    folders = [comparison(tmp_path / f"{seed}", seed, 20.0 + seed) for seed in (0, 2)]
    result = benchmarks("summary")["summary"](folders)
    tables = benchmarks("tables")
    quality = tables["quality"](result).splitlines()
    assert quality[2] == "| `untrained` | 0 | 0.0 |  | 8.0 ± 0.0 |  |  |"
    assert quality[3] == "| `ours` | 6 | 0.0 | 2 ± 0 | 21.0 ± 1.4 |  |  |"
    assert quality[-1] == "Mean ± standard deviation over 2 seeds."
    for _, names, table in tables["TABLES"]:
        if table.__name__ == "table" and len(names) == 1:  # made by `spreads`
            lines = table(result).splitlines()
            assert lines[2].startswith("| `untrained` |") and lines[-1] == quality[-1]
    columns = tables["spreads"](*tables["LIGHT"])(result).splitlines()[0]
    assert "SH error, aligned" in columns and "relighting, aligned" in columns


def test_faults_of_cameras_are_marked_where_an_earlier_version_fitted_them(benchmarks):
    row = {"albedo_psnr": 30.0, "roughness_psnr": 24.0}
    rows = [{"fault": "none", "cameras": "known", "made": "2026-11-29"} | row]
    rows += [{"fault": "poses", "cameras": cameras} | row for cameras in ("known", "fitted")]
    rows[-1]["made"] = "2026-11-29"
    lines = benchmarks("tables")["cameras"]({"rows": rows}).splitlines()[2:]
    assert lines == ["| none | 30.0 / 24.0 |  |  |", "| poses | 30.0 / 24.0 † | 30.0 / 24.0 |  |"]


def test_untrained_fields_of_several_files_are_told_once_if_they_are_the_same(benchmarks):
    def result(albedo, start=None):
        known = {} if start is None else {"untrained": {"albedo_psnr": start}}
        return known | {"seeds": [0], "methods": {"ours": {"albedo_psnr": albedo}}}

    table = benchmarks("tables")["variants"](["a", "b"], ("albedo", "albedo_psnr", 1, 1))

    def rows(*results):
        return [line for line in table(*results).splitlines()[2:] if line.startswith("|")]

    assert rows(result(20.0), result(21.0)) == ["| a | 20.0 |", "| b | 21.0 |"]
    same = rows(result(20.0, 8.0), result(21.0, 8.0))
    assert same == ["| untrained | 8.0 |", "| a | 20.0 |", "| b | 21.0 |"]
    other = rows(result(20.0, 8.0), result(21.0, 9.0))
    assert other[0] == "| a, untrained | 8.0 |" and other[2] == "| b, untrained | 9.0 |"


def test_the_time_to_a_quality_is_told_of_all_seeds(benchmarks):
    def fits(*ends):
        curves = [
            [{"seconds": 0.0, "albedo_psnr": 0.0}, {"seconds": 60.0, "albedo_psnr": end}]
            for end in ends
        ]
        return {"per_seed": [{"seed": i, "score": curve} for i, curve in enumerate(curves)]}

    time_to_quality = benchmarks("tables")["time_to_quality"]
    slow = {"untrained": {"per_seed": [{"seed": 0}]}, "methods": {"prb": fits(10.0)}}
    rows = time_to_quality(slow, {"methods": {"ours": fits(20.0, 30.0)}}).splitlines()[2:]
    assert rows[0] == "| albedo | at its end | 10.0 dB | 60 s | 25 ± 7 s | 2.5 ± 0.7 |"
    assert rows[1].startswith("| albedo | 1 dB below | 9.0 dB | 54 s |")
    rows = time_to_quality(slow, {"methods": {"ours": fits(20.0, 9.0)}}).splitlines()[2:]
    assert "not in 1 of 2 runs" in rows[0] and "not in" not in rows[1]


def test_equal_schedules_tell_what_untrained_fields_have_as_well(benchmarks):
    def fits(start, *ends):
        curves = [
            [{"seconds": 0.0, "albedo_psnr": start}, {"seconds": 60.0, "albedo_psnr": end}]
            for end in ends
        ]
        per_seed = [{"seed": i, "score": curve} for i, curve in enumerate(curves)]
        return {"per_seed": per_seed, "seconds": 60.0}

    methods = {"ours": fits(8.0, 20.0, 32.0), "prb": fits(8.0, 14.0, 14.0)}
    methods |= {"direct": fits(8.0, 9.0, 7.0), "no-prior": fits(8.0, 21.0, 10.0)}
    methods["ad-pt"] = {"error": "no memory"}
    result = {"seeds": [0, 1], "methods": methods}
    rows = benchmarks("tables")["equal_schedules"](result).splitlines()
    assert (
        rows[2] == "| albedo | `prb` | 14.0 ± 0.0 dB | 60.0 ± 0.0 s | 22.5 ± 10.6 s | 3.0 ± 1.4 |"
    )
    assert "untrained fields have it in 1 of 2 runs" in rows[3] and "`direct`" in rows[3]
    assert "not in 1 of 2 runs" in rows[4] and "`no-prior`" in rows[4] and len(rows) == 7


def test_a_rival_that_is_early_at_its_end_is_timed_by_that_and_not_by_its_whole_fit(benchmarks):
    def fit(*curve):
        points = [{"seconds": t, "albedo_psnr": psnr} for t, psnr in curve]
        return {"per_seed": [{"seed": 0, "score": points}], "seconds": 60.0}

    methods = {"ours": fit((0.0, 8.0), (60.0, 20.0))}
    methods["prb"] = fit((0.0, 8.0), (15.0, 14.0), (60.0, 14.0))
    rows = benchmarks("tables")["equal_schedules"]({"seeds": [0], "methods": methods}).splitlines()
    assert rows[2] == "| albedo | `prb` | 14.0 dB | 15.0 s | 30.0 s | 0.5 |"


def test_groups_of_held_out_views_are_scored_apart(benchmarks, tmp_path):
    """They take turns; views without a score, and those learned from, do not count."""
    folders = [comparison(tmp_path / f"{seed}", seed, 20.0) for seed in (0, 1)]
    for seed, folder in enumerate(folders):
        values = [("train", 90.0), *(("heldout", v) for v in (30 + seed, 10.0, 32 + seed, None))]
        views = [{"split": split, "albedo_psnr": value} for split, value in values]
        for method in ("untrained", "ours", "prb"):
            (folder / method / "evaluation").mkdir(parents=True)
            metrics = {"format": 1, "per_view": views}
            (folder / method / "evaluation" / "metrics.json").write_text(json.dumps(metrics))
    result = benchmarks("summary")["summary"](folders, ("seen", "unseen"))
    ours = result["methods"]["ours"]
    assert ours["albedo_psnr"] == 20.0
    assert ours["albedo_psnr_seen"] == 31.5 and ours["albedo_psnr_unseen"] == 10.0
    assert ours["albedo_psnr_seen_sd"] == pytest.approx(0.5**0.5)
    assert "render_psnr_seen" not in ours
    assert ours["per_seed"][1]["albedo_psnr_seen"] == 32.0
    assert result["untrained"]["albedo_psnr_seen"] == 31.5

    apart = benchmarks("tables")["prior"](*[result] * 5)
    assert apart.count("| 31.5 ± 0.7 |") == 15 and apart.count("| 10.0 ± 0.0 |") == 15
    whole = benchmarks("tables")["prior"](*[benchmarks("summary")["summary"](folders)] * 5)
    assert whole.count("| 20.0 ± 0.0 |") == 10 and "31.5" not in whole


def test_cameras_of_half_a_room_never_see_the_other_half(repository, built_in):
    """Nor does the mirror of the demo show it; half of the held-out views are of that half."""
    from unbake.dataset.camera_files import read_cameras
    from unbake.dataset.pixels import CameraRays

    cameras = read_cameras(repository / "benchmarks" / "prior" / "half.json", 24, 24)
    scene = mi.load_file(str(built_in("demo")))
    nearest = {}
    for split, group in (("train", slice(None)), ("heldout", slice(0, None, 2))):
        chosen = [camera for name, camera in cameras if name == split][group]
        rays = CameraRays.of(chosen)
        pixel = dr.arange(mi.UInt32, rays.pixels)
        si = scene.ray_intersect(rays.through(pixel, mi.Point2f(0.5)))
        assert dr.all(si.is_valid()) and dr.all(dr.dot(si.n, si.to_world(si.wi)) > 0)
        nearest[split] = dr.min(si.p.x)[0]
    assert min(nearest.values()) > 2.0
    others = [camera for name, camera in cameras if name == "heldout"][1::2]
    rays = CameraRays.of(others)
    si = scene.ray_intersect(rays.through(dr.arange(mi.UInt32, rays.pixels), mi.Point2f(0.5)))
    assert dr.max(si.p.x)[0] < 2.0
    assert len(cameras) == 12 + 8 and len(others) == 4


def test_files_of_steps_become_one_of_the_machine(benchmarks, tmp_path):
    machine = {"processor": "Some (TM) CPU", "cores": 2, "variant": "llvm_ad_rgb"}
    files = [tmp_path / name for name in ("a.json", "b.json")]
    steps = [{"data": "a"}, {"data": "b"}]
    for days, made in (((), {}), (("2026-12-01", "2026-11-30"), {"made": "2026-12-01"})):
        told = [{"made": day} for day in days] or [{}, {}]
        for file, step, more in zip(files, steps, told, strict=True):
            file.write_text(json.dumps({"machine": machine, **more, **step}))
        name, result = benchmarks("summary")["machine_results"](files)
        assert name == "some-tm-cpu-2-cores-llvm"
        assert result == {"machine": machine, **made, "steps": steps}


#: Results that are not committed yet.
UNMEASURED: set[str] = set()


def test_committed_results_of_every_benchmark_are_read(repository, benchmarks):
    """Those of older versions too, whose steps have other keys."""
    tables = call(repository, "tables.py").stdout
    assert tables.count("| ---") >= 19 and "| gradients |" in tables and "| roofline |" in tables
    names = {file.stem for file in (repository / "benchmarks" / "results").glob("*.json")}
    jobs = benchmarks("run")["BENCHMARKS"].keys()
    assert jobs >= UNMEASURED
    # The file of `machine` is named after the machine.
    assert jobs - names - UNMEASURED == {"machine"}
    assert not names & UNMEASURED, "they are measured now: delete them from UNMEASURED"


def test_roulette_is_measured_by_time_and_noise(repository, cornell, tmp_path):
    settings, out = tmp_path / "grid.toml", tmp_path / "rr-depth.json"
    settings.write_text('representation = "grid"\npixels = 16\nspp = 4\n[path]\nmax_depth = 9\n')
    done = call(
        repository, "rr_depth.py", "--data", cornell, "--settings", settings, "--methods", "prb",
        "--depths", 1, 5, "never", "--steps", 2, "--calls", 8, "--out", out,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    result = read(out)
    assert result["path_depth"] == 9 and "never" in done.stdout
    rows = {row["rr_depth"]: row for row in result["rows"]}
    assert rows.keys() == {1, 5, None}
    for row in rows.values():
        for unknown in ("albedo", "roughness"):
            variance, efficiency = row["variance"][unknown], row["efficiency"][unknown]
            assert variance > 0 and row["milliseconds"] > 0
            assert efficiency == pytest.approx(1e3 / (variance * row["milliseconds"]))
            relative = row["relative_efficiency"][unknown]
            assert relative == pytest.approx(efficiency / rows[5]["efficiency"][unknown])
    # Paths that end early at random are noisier than paths that do not.
    assert rows[1]["variance"]["albedo"] > rows[None]["variance"]["albedo"]


# ------------------------------------------------------------------------------------------- soak


@pytest.fixture(scope="module")
def soak(repository):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(repository / "benchmarks"))
        return runpy.run_path(str(repository / "benchmarks" / "soak.py"))


def watched(soak, count=60, memory=lambda i: 400.0, files=lambda i: 9, variables=lambda i: 300):
    """What a soak finds in samples every 500 steps."""
    samples = [
        soak["Sample"](500 * i, 30.0 * i, memory(i), files(i), 5, variables(i))
        for i in range(count)
    ]
    found = soak["growth"](samples)
    return found, soak["problems"](found)


def test_a_soak_that_stays_flat_has_no_problem(soak):
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.5, 60)
    # The warm-up may grow, and what comes and goes is none.
    found, problems = watched(
        soak,
        memory=lambda i: 400 - 6 / (1 + i) ** 2 + noise[i],
        files=lambda i: 9 + i % 3,
        variables=lambda i: 300 + 40 * (i % 7 == 0),
    )
    assert problems == []
    low, high = found["slope_range"]
    assert low < 0 < high and high - low < 0.2


@pytest.mark.parametrize(
    ("grows", "said"),
    [
        ({"memory": lambda i: 400 + 0.6 * i}, "memory rises by 1.20 MB in 1,000 steps"),
        ({"files": lambda i: 9 + i // 10}, "files rise from"),
        ({"variables": lambda i: 300 + i}, "variables rise from"),
        ({"count": 3}, "too few samples"),
    ],
)
def test_a_soak_tells_what_grows(soak, grows, said):
    _, problems = watched(soak, **grows)
    assert len(problems) == 1 and said in problems[0]


def test_neighbouring_samples_that_resemble_each_other_count_as_fewer(soak):
    rng = np.random.default_rng(1)
    steps, alone = rng.normal(0, 1, 400), rng.normal(0, 1, 400)
    alike = np.convolve(steps, np.ones(10) / 10**0.5, "same")
    widths = []
    for noise in (alone / alone.std(), alike / alike.std()):
        low, high = watched(soak, 400, lambda i, n=noise: 400 + n[i])[0]["slope_range"]
        widths.append(high - low)
    assert widths[1] > 2 * widths[0]


@pytest.mark.slow
@pytest.mark.parametrize("ended", [False, True])
def test_a_soak_writes_what_it_has_seen(repository, ended, tmp_path):
    out = tmp_path / "soak.json"
    words = ["--steps", 100_000 if ended else 120, "--every", 20, "--resolution", 16, "--out", out]
    process = subprocess.Popen(
        [sys.executable, str(repository / "benchmarks" / "soak.py"), *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    while ended and not (out.exists() and len(read(out)["samples"]) >= 8):
        assert process.poll() is None
        time.sleep(0.2)
    if ended:
        process.terminate()
    printed, _ = process.communicate(timeout=200)
    result = read(out)
    assert result["complete"] is not ended, printed
    assert result["taken_steps"] >= 120 and len(result["samples"]) >= 6
    assert result["files"]["after"] > 0 and result["variables"]["after"] > 0
    assert process.returncode == (1 if result["problems"] else 0)


@pytest.mark.slow
def test_exports_are_compared_with_the_fields(repository, cornell, tmp_path):
    run, out = tmp_path / "run", tmp_path / "trip.json"
    fit = ["fit", cornell, "--out", run, "--steps", 2, "--method", "direct", "--batch", 64]
    command = [sys.executable, "-m", "unbake", *map(str, fit)]
    assert subprocess.run(command, capture_output=True, timeout=280).returncode == 0
    words = ["--runs", f"box={run}", "--work", tmp_path / "work", "--out", out]
    small = ["--points", 2000, "--views", 1, "--resolution", 8, "--spp", 16]
    done = call(repository, "round_trip.py", *words, *small)
    assert done.returncode == 0, done.stderr[-3000:]
    row = read(out)["runs"]["box"]
    assert row["steps"] == 2 and row["points"] > 500 and row["megatexels"] > 0
    for found in (row["mitsuba"], row["gltf"]):
        assert found["albedo"] > 0.95 and found["roughness"] > 0.95
    (view,) = row["renderings"]
    assert view["psnr"] > view["same_fields_psnr"] - 6
    assert "errors" in row["validator"] or "not_run" in row["validator"]


@pytest.mark.slow
def test_the_export_of_a_large_room_is_measured(repository, tmp_path):
    words = ["--meshes", 7, "--triangles", 2000, "--resolution", 16, "--steps", 2]
    out = tmp_path / "large.json"
    done = call(repository, "large_export.py", *words, "--work", tmp_path / "work", "--out", out)
    assert done.returncode == 0, done.stderr[-3000:]
    found = read(out)
    assert found["parts"] == 7 + 2 and 1500 < found["triangles"] < 2500
    assert found["own_coordinates"] >= 4 and found["cost"]["peak_mb"] > 50


def test_variants_go_on_where_they_ended_and_are_not_mixed_with_others(
    benchmarks, cornell, tiny, tmp_path, monkeypatch
):
    main, made, out = benchmarks("variants")["main"], [], tmp_path / "out.json"

    def fit(data, settings, method, seed, stop):
        if len(made) == 3 and "--go-on" not in sys.argv:
            raise KeyboardInterrupt
        made.append((method, seed))
        score = 20.0 + seed + (method == "prb")
        scores = dict.fromkeys(("albedo_psnr", "roughness_psnr", "render_psnr"), score)
        return scores | {"steps": stop[1], "samples": 1, "seconds": 1.0}

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["variants.py", *map(str, words)])
        main()

    monkeypatch.setitem(main.__globals__, "fit", fit)
    settings = tmp_path / "settings.toml"
    settings.write_text(tiny.read_text())
    words = ["--data", cornell, "--settings", settings, "--methods", "ours", "prb"]
    words += ["--seeds", 0, 1, "--steps", 5, "--out", out]
    with pytest.raises(KeyboardInterrupt):
        run(*words)
    assert read(out)["seeds"] == [0] and [len(row["runs"]) for row in read(out)["rows"]] == [2, 1]
    run(*words, "--go-on")
    assert made == [("ours", 0), ("prb", 0), ("ours", 1), ("prb", 1)]
    ours, prb = read(out)["rows"]
    assert read(out)["seeds"] == ours["seeds"] == prb["seeds"] == [0, 1]
    assert (ours["albedo_psnr"], prb["albedo_psnr"]) == (20.5, 21.5)
    assert ours["albedo_psnr_sd"] == pytest.approx(0.5**0.5)
    settings.write_text(settings.read_text() + "\n# others\n")
    with pytest.raises(SystemExit, match="settings"):
        run(*words, "--go-on")


def test_variants_give_one_method_settings_that_others_do_not_have(
    benchmarks, cornell, tiny, tmp_path, monkeypatch
):
    main, made, out = benchmarks("variants")["main"], [], tmp_path / "out.json"

    def fit(data, settings, method, seed, stop):
        made.append((seed, method, settings.stem))
        return dict.fromkeys(("albedo_psnr", "roughness_psnr", "render_psnr"), 20.0)

    files = [tmp_path / name for name in ("usual.toml", "own.toml")]
    for file in files:
        file.write_text(tiny.read_text())
    words = ["--data", cornell, "--settings", files[0], "--methods", "ours", "prb"]
    words += ["--also", "prb", files[1], "--seeds", 0, 1, "--steps", 5, "--out", out]
    monkeypatch.setitem(main.__globals__, "fit", fit)
    monkeypatch.setattr(sys, "argv", ["variants.py", *map(str, words)])
    main()
    turn = [("ours", "usual"), ("prb", "usual"), ("prb", "own")]
    assert made == [(seed, *fit) for seed in (0, 1) for fit in turn]
    assert [(row["method"], row["settings"]) for row in read(out)["rows"]] == turn
    assert read(out)["settings"].keys() == {"usual", "own"}


@pytest.mark.slow
def test_other_scenes_are_compared_under_other_light(repository, cornell, tmp_path):
    words = ["--steps", 2, "--spp", 2, "--true-spp", 4, "--resolution", 8, "--batch", 64]
    words += ["--methods", "direct", "--scenes", "--data", f"box={cornell}", "--seeds", 0, 1]
    out = tmp_path / "relit.json"
    done = call(repository, "relight_demo.py", *words, "--work", tmp_path, "--out", out)
    assert done.returncode == 0, done.stderr[-3000:]
    (scene,) = read(out)["scenes"].values()
    assert scene["methods"].keys() == {"direct", "untrained"}
    assert read(out)["seeds"] == [0, 1] and "albedo_psnr_sd" in scene["methods"]["direct"]
    assert all(np.isfinite(row["relit_render_psnr"]) for row in scene["methods"].values())


@pytest.mark.slow
def test_materials_are_compared_under_other_light(repository, tmp_path):
    words = ["--steps", 2, "--spp", 2, "--true-spp", 4, "--resolution", 8, "--methods", "direct"]
    work = tmp_path / "work"
    call_words = [*words, "--work", work, "--out", tmp_path / "relit.json"]
    call_words += ["--picture", tmp_path / "relit.png"]
    done = call(repository, "relight_demo.py", *call_words)
    assert done.returncode == 0, done.stderr[-3000:]
    result = read(tmp_path / "relit.json")
    assert result["steps"] == 2 and result["scenes"].keys() == {"demo", "still"}
    for scene in result["scenes"].values():
        assert scene["methods"].keys() == {"direct", "untrained"}
        assert all(np.isfinite(row["relit_render_psnr"]) for row in scene["methods"].values())
        size = {"views": 4, "width": 8, "height": 8, "true_spp": 4}
        assert scene["data"].items() >= size.items()
        assert scene["data"]["train"] > 8 and scene["data"]["spp"] >= 16
    assert len(list((work / "still-direct-0-relit").glob("*.png"))) == 4
    from unbake.imaging.pictures import read_png

    # Two rows of the truth, direct and untrained, with two pixels between and around them.
    assert read_png(tmp_path / "relit.png").shape == (2 * (8 + 2) + 2, 3 * (8 + 2) + 2, 3)


# -------------------------------------------------------------------- several processes, modelled


def test_lines_neither_begin_nor_fall_below_zero(benchmarks):
    line = benchmarks("scaling")["line"]
    assert line([1, 2, 3], [12, 14, 16]) == pytest.approx((10, 2))
    # An intercept below 0 is 0, and the slope is the best one through there.
    intercept, slope = line([1, 2, 4], [1, 4, 10])
    assert intercept == 0 and slope == pytest.approx((1 + 8 + 40) / (1 + 4 + 16))
    assert line([1, 2, 3], [3, 2, 1]) == pytest.approx((2, 0))


def test_the_most_processes_that_pay_are_half_as_efficient_as_one(benchmarks):
    module = benchmarks("scaling")
    found = {"fixed_seconds": 1.0, "seconds_a_pixel": 0.01, "batch": 900, "gradient_bytes": 0}
    found |= {"state_bytes": 0, "seconds_a_byte_copied": 0.0}
    # 1 + 9 / N over (10 / N) is a half where N is 11; latencies hardly count.
    assert {row["ranks"] for row in module["paying"](found, 0.0)} == {10}
    found["fixed_seconds"] = 0.0
    rows = module["paying"](found, 0.0)
    assert all(row["ranks"] == 1024 for row in rows if row["network"].startswith("NVLink"))
    rows = module["modelled"](found | {"gradient_bytes": 125e6}, 0.0)
    (two,) = (row for row in rows if row["network"] == "1 Gbit/s" and row["sync_every"] == 1
              and row["ranks"] == 2)  # fmt: skip
    assert two["seconds"] == pytest.approx(4.5 + 1, abs=1e-3)


def test_ranks_are_told_by_seed_and_as_means_with_their_efficiency(benchmarks):
    module = benchmarks("ranks")
    rows = []
    for seed, one, two in ((0, 90.0, 60.0), (1, 80.0, 50.0)):
        for ranks, every, each in ((1, 1, one), (2, 1, two), (2, 10, 40.0)):
            scores = dict.fromkeys(module["SCORES"], 20.0 + seed)
            row = {"ranks": ranks, "sync_every": every, "seed": seed, "ms_per_step": each}
            rows.append(row | scores | {"loss": 0.1 * ranks})
            rows[-1] |= module["efficiency"](rows, rows[-1])
    assert [row["efficiency"] for row in rows[:3]] == pytest.approx([1, 0.75, 90 / 80])
    one, two, ten = module["cases_of"](rows)
    assert (one["ranks"], two["sync_every"], ten["sync_every"]) == (1, 1, 10)
    assert two["efficiency"] == pytest.approx((0.75 + 0.8) / 2) and two["seeds"] == 2
    assert two["loss"] == pytest.approx(0.2) and two["albedo_psnr_sd"] == pytest.approx(0.5**0.5)
    assert module["efficiency"](rows[1:2], rows[1]) == {}


def test_one_process_computes_with_a_thread_a_core_when_all_is_read(benchmarks, monkeypatch):
    from unbake.training import loop

    agreed, shared = [], []
    monkeypatch.setattr(loop, "agree", lambda *begun: agreed.append(begun))
    module = benchmarks("one_process")
    monkeypatch.setattr(
        module["backend"], "share_cores", lambda *words, **more: shared.append((words, more))
    )
    module["compute_with_a_thread_a_core"]()
    loop.agree("begun", "ranks")
    assert agreed == [("begun", "ranks")] and shared == [((1,), {"least": 1})]
