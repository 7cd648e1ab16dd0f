"""Pages with measured numbers are made from committed results, and hold no other number."""

import csv
import json
import re
import runpy
import shutil
from dataclasses import dataclass
from pathlib import Path

import jinja2
import pytest

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
SETTINGS = Path(__file__).with_name("allowed_numbers.toml")
REMEDY = (
    "A measured number comes from a committed result: {{ db('rivals-demo', 'ours', 'albedo') }}, "
    "see scripts/facts.py. A setting, a published or a defined value goes to "
    "tests/allowed_numbers.toml, with the reason."
)


@pytest.fixture(scope="module")
def writer():
    """The script that writes pages."""
    return runpy.run_path(str(ROOT / "scripts" / "write_docs.py"))


@pytest.fixture(scope="module")
def written(writer):
    return writer["pages"]()


# ------------------------------------------------------------------------- Pages are what is made


def test_every_page_is_the_one_that_its_results_make(written):
    stale = [
        str(page.relative_to(ROOT))
        for page, text in written.items()
        if not page.is_file() or page.read_text(encoding="utf-8") != text
    ]
    assert not stale, f"{', '.join(stale)}: edit the template, then run scripts/write_docs.py"
    assert len(written) >= 5


def test_another_result_makes_another_page(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    file = results / "rivals-demo.json"
    content = json.loads(file.read_text())
    content["methods"]["ours"]["albedo_psnr"] = 77.7
    file.write_text(json.dumps(content))
    text = writer["page"]("docs/comparison.md", results=results)
    assert "77.7" in text


def test_efficiencies_and_models_of_several_processes_have_their_place(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)

    def changed(name, change):
        content = json.loads((results / name).read_text())
        change(content)
        (results / name).write_text(json.dumps(content))

    keys = ("albedo_psnr", "roughness_psnr", "render_psnr", "ms_per_step", "efficiency", "loss")
    case = {"ranks": 2, "sync_every": 10, "seeds": 3, "loss_sd": 0.0025} | dict.fromkeys(keys, 0.75)
    changed("ranks.json", lambda found: found.update(cases=[case]))
    efficient = {"efficiency": 0.625, "modelled": 44.4}
    changed("hosts.json", lambda found: [row.update(efficient) for row in found["steps"]["rows"]])

    def paying(found):
        for preset in found["presets"]:
            rows = [{"network": n, "sync_every": e} for n in found["networks"] for e in (1, 20)]
            preset.update(paying=[row | {"ranks": 321} for row in rows], largest_residual=0.07)

    changed("scaling.json", paying)
    text = writer["page"]("docs/machines.md", results=results)
    assert "| 2 | 10 | 3 | 0.8 | 0.8 | 0.8 | 0.7500 ± 0.0025 | 0.8 | 0.75 |\n" in text
    row = json.loads((results / "hosts.json").read_text())["steps"]["rows"][3]
    measured = f"{row['ms_per_step']:.0f} | 44 | {row['times_one']:.2f}"
    assert f"| two hosts, 1 Gbit/s | {measured} | 0.62 |\n" in text
    assert text.count(" | 321 |\n") == 24 and "within 7 % (`cpu`)" in text
    tables = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    assert all(len({line.count("|") for line in table.splitlines()}) == 1 for table in tables)


def test_results_that_are_not_measured_yet_have_their_place(writer, tmp_path):
    """Of several seeds, with the true materials, and of views that see what training did not."""
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    content = json.loads((results / "rivals-demo.json").read_text())
    content["seeds"] = [0, 1]
    for row in content["methods"].values():
        row |= {f"{k}_psnr_sd": 0.1 for k in ("albedo", "roughness", "render")}
        row |= {"true_render_psnr": 24.75}
        unseen = {f"{k}_psnr_unseen": 33.25 for k in ("albedo", "render")}
        seen = {f"{k}_psnr_seen": row[f"{k}_psnr"] for k in ("albedo", "roughness", "render")}
        row |= unseen | seen
    content["untrained"] = dict(content["methods"]["ours"])
    content["methods"]["no-prior"] |= {"render_psnr_unseen": 11.0}
    few = {k: v for k, v in content["methods"].items() if k in ("ours", "no-prior")}
    two = {k: v for k, v in content["methods"].items() if k in ("ours", "direct")}
    made = {"rivals-demo": content, "demo": content | {"methods": two}}
    for case in ("demo", "few", "three", "half", "annex"):
        made[f"prior-{case}"] = content | {"methods": few}
    best = {"factors": {"albedo": 2.5}, "estimator": "two-pass"}
    first = {"score": 22.1, "estimator": "two-pass", "per_seed": [{}, {}]}
    search = {"method": "prb", "kind": "room", "data": "box", "unknown": "materials"}
    search |= {"follows_paths": True, "trials": [first]}
    search |= {"untrained": {"score": 13.5}, "best": best | {"score": 24.2}}
    search |= {"seeds": [0, 1], "settings": {"steps": 2400, "seconds": 30.0}}
    equal = {k: v for k, v in content["methods"].items() if k in ("ours", "prb")}
    made["equal-demo"] = content | {"methods": equal}
    made["rates"] = {"machine": content["machine"], "searches": [search]}
    for name, result in made.items():
        (results / f"{name}.json").write_text(json.dumps(result))
    written = writer["pages"](results=results)
    readme, page = written[ROOT / "README.md"], written[ROOT / "docs" / "comparison.md"]
    assert "| the true materials, rendered alike |  |  |  | 24.8 |" in readme
    assert "+22.2 dB in a room behind a door. [Where" in " ".join(readme.split())
    assert "`prior-half`" in page and "+22.2 dB" in page
    found = "| `prb` | rooms | materials | box | albedo x 2.5 |  |  | two pass | 13.5 | 22.1 |"
    assert found in page
    words = " ".join(page.split())
    assert "over 2 seeds; fits of `prb` take 30 s." in words
    assert "| two passes, as in Mitsuba | no |" in words
    assert "as many camera samples as `prb` traces in" in words
    assert "rows of each scene are no methods" in words and "Behind the door" not in words
    assert "`rivals-demo.json`" not in page


def test_grey_fields_that_nobody_beats_are_told(written):
    """Renderings of both rooms of the annex, where cameras saw one."""
    annex = json.loads((ROOT / "benchmarks" / "results" / "prior-annex.json").read_text())
    grey = annex["untrained"]["render_psnr"]
    assert all(grey > row["render_psnr"] for row in annex["methods"].values())
    readme, page = (
        " ".join(written[ROOT / p].split()) for p in ("README.md", "docs/comparison.md")
    )
    assert f"untrained grey fields score higher ({grey:.1f} dB over" in readme
    assert f"renderings of the untrained fields have {grey:.1f} dB" in page


def test_a_search_that_finds_split_halves_better_is_told(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    content = json.loads((results / "rates.json").read_text())
    content["searches"][0]["best"]["estimator"] = "split-halves"
    (results / "rates.json").write_text(json.dumps(content))
    page = writer["page"]("docs/comparison.md", results=results)
    assert "| two passes, as in Mitsuba; split halves for rooms | no |" in page


def test_where_a_rival_is_ahead_is_told_beyond_the_spread_alone(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    content = json.loads((results / "rooms.json").read_text())
    for row in content["rows"]:
        ahead = row["method"] == "prb" and row["data"] == "kitchen"
        row |= {"albedo_psnr": 30.0 if ahead else 20.0, "albedo_psnr_sd": 1.0}
        row |= {"roughness_psnr": 21.0 if ahead else 20.0, "roughness_psnr_sd": 1.0}
        row |= {"render_psnr": 20.0, "render_psnr_sd": 1.0}
    (results / "rooms.json").write_text(json.dumps(content))
    readme = " ".join(writer["page"]("README.md", results=results).split())
    told = readme.partition("beyond the spread of seeds: ")[2].partition(" - **")[0]
    assert "albedo of `kitchen` (−10.0 dB)" in told and "roughness of `kitchen`" not in told
    assert "| 30.0 ± 1.0 |" in readme


def test_constants_and_ceilings_stand_beside_methods(writer, tmp_path):
    """Ceilings of other views are left out."""
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    lego = json.loads((results / "lego-plant.json").read_text())
    ours = next(r for r in lego["rows"] if (r["data"], r["method"]) == ("plant", "ours"))
    both = {"ceiling_albedo_psnr": ours["albedo_psnr"] + 0.25, "ceiling_roughness_psnr": 41.5}
    views = {"plant": (25, 6), "kitchen": (3, 6), "box": (16, 3)}
    rows = [
        {"data": name, "train_views": train, "heldout_views": heldout} | both
        for name, (train, heldout) in views.items()
    ]
    (results / "ceilings.json").write_text(json.dumps({"rows": rows}))
    page, readme = (writer["page"](n, results=results) for n in ("docs/comparison.md", "README.md"))
    ceiling = f"{both['ceiling_albedo_psnr']:.1f} dB"
    assert f"| `plant` | ceiling |  |  | {ceiling} | 41.5 dB |  |\n" in page
    assert "| `kitchen` | ceiling" not in page and "| `kitchen` | constant |" in page
    assert "| `dragon` | constant |  |  | no error | no error |  |\n" in page
    words = " ".join(page.split())
    assert f"its ceiling of albedo is {ceiling}, and `ours` is within 0.2 dB of it" in words
    assert "Three rows of each scene" in words and "as [above]" in words
    assert f" | {ceiling} | 17.3 dB |" in next(x for x in page.split("\n") if "| `box`" in x)
    tables = re.findall(r"(?:^\|.*\n)+", page + readme, re.MULTILINE)
    assert all(len({line.count("|") for line in table.splitlines()}) == 1 for table in tables)
    assert "`dragon`, `lego`, `plant` have a single true roughness" in words
    told = "a material. What the same fields can reach at best is [measured]"
    assert told in (words := " ".join(readme.split())) and f"too: {ceiling} of albedo for" in words


def test_scores_below_a_constant_are_told(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    content = json.loads((results / "rooms.json").read_text())
    for row in content["rows"]:
        row |= {"albedo_psnr": 10.0, "constant_albedo_psnr": 9.0, "roughness_psnr": 20.0}
        row["constant_roughness_psnr"] = 21.0 if row["data"] == "staircase" else 19.0
    (results / "rooms.json").write_text(json.dumps(content))
    found = writer["Facts"](results, ROOT / "docs" / "reproduction").below("prb", "constant")
    assert "roughness of `staircase`" in found and not any("kitchen" in told for told in found)
    assert not any("`dragon`" in told for told in found)


def test_fits_below_the_untrained_fields_are_told(writer, tmp_path):
    results, kept = tmp_path / "results", tmp_path / "reproduction"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    shutil.copytree(ROOT / "docs" / "reproduction", kept)
    content = json.loads((results / "rooms.json").read_text())
    for row in content["rows"]:
        row |= {"albedo_psnr": 20.0, "untrained_albedo_psnr": 10.0}
        row |= {"roughness_psnr": 20.0, "untrained_roughness_psnr": 10.0}
        if row["data"] == "kitchen" and row["method"] == "prb":
            row["albedo_psnr"] = 9.0 if row["settings"] == "defaults" else 11.0
    (results / "rooms.json").write_text(json.dumps(content))
    facts = writer["Facts"](results, kept)
    assert facts.below("prb", "untrained") == []
    assert facts.below("prb", "untrained", "defaults") == ["albedo of `kitchen`"]
    readme = " ".join(writer["page"]("README.md", results=results).split())
    told = "Training makes `prb` worse than the untrained fields in nothing; with its defaults in"
    assert f"{told} albedo of `kitchen`." in readme
    page = " ".join(writer["page"]("docs/comparison.md", results=results).split())
    low = "better of its settings: nothing; with its defaults: albedo of `kitchen`; of `ours`: no"
    assert low in page
    file = kept / "fig6" / "data.csv"
    rows = list(csv.DictReader(file.read_text().splitlines()))
    for row in rows:
        least = {"untrained": 10.0, "PRB": 9.0 if row["scene"] == "LEGO" else 11.0}
        row["render_psnr"] = least.get(row["method"], 12.0)
        row["albedo_psnr"] = row["roughness_psnr"] = 10.0
    with open(file, "w", newline="") as out:
        table = csv.DictWriter(out, rows[0])
        table.writeheader()
        table.writerows(rows)
    page = " ".join(writer["page"]("docs/reproduction.md", results=results, kept=kept).split())
    assert "PRB in rendering of LEGO (9.0 dB against 10.0 dB); AD-PT in nothing; ours in no" in page


def test_samples_stand_beside_steps_and_the_limit_of_renderings_is_told(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    content = json.loads((results / "rooms.json").read_text())
    content["rows"][0] |= {"samples": 98_765_432, "steps": 4321}
    (results / "rooms.json").write_text(json.dumps(content))
    content = json.loads((results / "demo.json").read_text())
    content["methods"]["ours"]["true_render_psnr"] = 28.25
    (results / "demo.json").write_text(json.dumps(content))
    page = writer["page"]("docs/comparison.md", results=results)
    assert "| `kitchen` | `ours` | 4,321 | 98.8 | " in page
    assert "the true materials, rendered alike, have 28.2 dB" in " ".join(page.split())


def test_roughness_of_path_replay_that_is_less_after_more_time_is_told(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    content = json.loads((results / "rivals-demo.json").read_text())
    curve = [{"seconds": s, "roughness_psnr": 11.0 + s} for s in (0.0, 2.5, 10.0)]
    for run in content["methods"]["prb"]["per_seed"]:
        run["score"] = [row | {"albedo_psnr": 20.0} for row in curve]
    for roughness, less in ((19.0, True), (12.0, False)):
        content["methods"]["prb"]["roughness_psnr"] = roughness
        (results / "rivals-demo.json").write_text(json.dumps(content))
        page = " ".join(writer["page"]("docs/comparison.md", results=results).split())
        assert ("The scores of the longer fits are lower" in page) == less
        assert ("goes from 16.0 dB halfway to 21.0 dB at the end" in page) == less


def test_losses_at_equal_samples_stand_where_gains_do(writer, tmp_path):
    results, kept = tmp_path / "results", tmp_path / "reproduction"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    shutil.copytree(ROOT / "docs" / "reproduction", kept)
    content = json.loads((results / "equal-demo.json").read_text())
    content["seeds"] = [0, 1, 2, 3]
    content["methods"]["ours"] |= {"samples": 7.7e6, "steps": 1234, "albedo_psnr_sd": 2.25}
    (results / "equal-demo.json").write_text(json.dumps(content))
    file = kept / "fig6" / "data.csv"
    rows = list(csv.DictReader(file.read_text().splitlines()))
    for row in rows:
        worse = row["method"] == "ours" and row["scene"] == "LEGO"
        row["albedo_psnr_at_equal_samples"] = 17.75 if worse else 20.0
    with open(file, "w", newline="") as out:
        table = csv.DictWriter(out, rows[0])
        table.writeheader()
        table.writerows(rows)
    for page in ("README.md", "docs/comparison.md"):
        words = " ".join(writer["page"](page, results=results, kept=kept).split())
        assert "in the albedo of LEGO (−2.2 dB), the roughness of DRAGON" in words, page
    readme = " ".join(writer["page"]("README.md", results=results, kept=kept).split())
    assert "(7.7 M, which are 1,234 steps of ours and" in readme and "; 4 seeds," in readme
    assert "± 2.2 dB against" in readme


def test_scenes_written_by_hand_tell_where_path_replay_is_ahead_or_below_what_it_started_from(
    writer, tmp_path
):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    content = json.loads((results / "hand-made.json").read_text())
    for row in content["rows"]:
        prb = row["method"] == "prb"
        row["render_psnr"] = 77.71 if prb and row["data"] == "attic" else 66.6
        row |= {"albedo_psnr": 30.0 + prb * (row["data"] == "box"), "untrained_albedo_psnr": 10.0}
        row |= {"roughness_psnr": 20.04, "untrained_roughness_psnr": 10.0}
        if prb and row["data"] == "bulb":
            row |= {"untrained_roughness_psnr": 20.5, "roughness_psnr": 20.0}
    (results / "hand-made.json").write_text(json.dumps(content))
    page = writer["page"]("docs/comparison.md", results=results)
    part = page.split("### Scenes written by hand")[1].split("## How each method")[0]
    rows = {line.split("`")[1]: line for line in part.splitlines() if line.startswith("| `")}
    assert rows["attic"].endswith("| 77.7 dB | 66.6 dB |") and "66.6 dB | 66.6" in rows["bulb"]
    words = " ".join(part.split())
    ahead = "ahead of `ours` in 1 of 15 scenes: "
    assert f"In rendering, `prb` is {ahead}`attic` (77.7 dB against 66.6 dB)." in words
    assert f"In albedo, `prb` is {ahead}`box` (31.0 dB against 30.0 dB)." in words
    assert "In roughness, `prb`" not in words
    assert "untrained fields are, of `prb`: roughness of `bulb`; of `ours`: nothing." in words


def test_the_squared_prior_is_named_as_its_figure_names_it(writer, tmp_path):
    kept = tmp_path / "reproduction"
    shutil.copytree(ROOT / "docs" / "reproduction", kept)
    file = kept / "fig7" / "about.json"
    about = json.loads(file.read_text())
    assert "made_with" in about and "PRB" not in about["made_with"]
    newer = {key: value for key, value in about.items() if key != "made_with"}
    for told in (about, newer):
        file.write_text(json.dumps(told))
        page = " ".join(writer["page"]("docs/reproduction.md", kept=kept).split())
        assert ("the fits of Figure 6 where it has them" in page) == ("made_with" not in told)
        assert "The squared prior is the row *+ prior*, which [Figure 8]" in page


def reproduced(writer, tmp_path, figure):
    """The rows of a figure's data, and what makes the page of these or of others."""
    kept = tmp_path / "reproduction"
    shutil.copytree(ROOT / "docs" / "reproduction", kept)
    file = kept / figure / "data.csv"

    def page(rows):
        with open(file, "w", encoding="utf-8", newline="") as text:
            table = csv.DictWriter(text, rows[0])
            table.writeheader()
            table.writerows(rows)
        return " ".join(writer["page"]("docs/reproduction.md", kept=kept).split())

    with open(file, encoding="utf-8", newline="") as text:
        return list(csv.DictReader(text)), page


def test_a_prior_that_loses_to_direct_light_is_told(writer, tmp_path):
    rows, page_of = reproduced(writer, tmp_path, "fig8")
    for error in (0.5, 0.001):
        for row in rows:
            if row["method"] == "with-prior":
                row["sh_error"] = str(error)
        page = page_of(rows)
        assert f"low frequencies are {100 * error:.1f} % off" in page
        assert ("does not beat direct illumination by itself" in page) == (error > 0.1)


def test_what_a_campaign_did_not_have_yet_is_told(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    facts = writer["Facts"](results, ROOT / "docs" / "reproduction")
    signals, fuzz = (json.loads((results / f"{n}.json").read_text()) for n in ("signals", "fuzz"))
    now = [*signals["ends"], *(name.strip("`") for name in facts.untried_commands())]
    formats = [*fuzz["formats"], *facts.untried_formats()]
    assert "data" in now and len(formats) >= 29
    for lacking in (True, False):
        ends = {name: {} for name in now if name != "solve" or not lacking}
        kept = [name for name in formats if name != "lights" or not lacking]
        told = signals | {"ends": ends, "sent": 36 * len(ends)}
        (results / "signals.json").write_text(json.dumps(told))
        (results / "fuzz.json").write_text(json.dumps(fuzz | {"formats": dict.fromkeys(kept)}))
        page = " ".join(writer["page"]("docs/reliability.md", results=results).split())
        assert ("which now has `solve` as well" in page) == lacking
        assert ("which now has 1 format more (lights)" in page) == lacking
        assert "signals.py --each 12`" in page and f"of {len(kept)} formats" in page


def test_a_step_that_differs_from_that_of_the_table_of_steps_is_told(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    facts = writer["Facts"](results, ROOT / "docs" / "reproduction")
    name, side = facts.machine_file(), facts.step("methods-demo", "ours")["milliseconds_per_step"]
    content = json.loads((results / f"{name}.json").read_text()) | {"made": "2001-02-03"}
    for times in (1.1, 1.6):
        for step in content["steps"]:
            step["milliseconds_per_step"] = times * side
            step["phases"] = {"all": {"milliseconds": times * side * 1.13}}
        (results / f"{name}.json").write_text(json.dumps(content))
        page = " ".join(writer["page"]("docs/performance.md", results=results).split())
        assert ("are of other states of the code or of the machine" in page) == (times > 1.5)
        assert "from 113 % to 113 % of the whole step" in page and "on 2001-02-03" in page


def test_what_has_changed_since_a_result_is_told_with_its_scenes(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    for name in ("rooms", "demo-in-time"):
        content = json.loads((results / f"{name}.json").read_text())
        content.pop("note", None)
        if name == "rooms":
            content["note"], processor = "with something else", content["machine"]["processor"]
        (results / f"{name}.json").write_text(json.dumps(content))
    readme, page = (
        " ".join(writer["page"](name, results=results).split())
        for name in ("README.md", "docs/comparison.md")
    )
    assert re.search("`staircase`, `veach-ajar`: on an [^.:]*, with something else.", readme)
    assert "`demo`, `kitchen`" not in readme
    assert page.count(f"on an {processor}, with something else. Photographs") == 1


def test_older_results_do_not_carry_a_conclusion_that_they_do_not_show(writer, tmp_path):
    """Signs of gradients were counted with the exact light in the place of a network."""
    sentence = "Ours with k = 1 has the right sign"
    kept = tmp_path / "reproduction"
    shutil.copytree(ROOT / "docs" / "reproduction", kept)
    file = kept / "fig4" / "about.json"
    about = json.loads(file.read_text())
    about.pop("made_with", None)
    for older in ({}, {"made_with": "Made with the exact light."}):
        file.write_text(json.dumps(about | older))
        page = writer["page"]("docs/reproduction.md", kept=kept)
        assert (sentence in page) != bool(older)


def test_a_figure_of_some_scenes_keeps_what_there_is_of_others(writer, tmp_path):
    kept, join = tmp_path / "reproduction", writer["with_other_scenes"]
    shutil.copytree(ROOT / "docs" / "reproduction" / "fig6", kept / "fig6")
    facts = runpy.run_path(str(ROOT / "scripts" / "facts.py"))["Facts"](RESULTS, kept)
    about, scenes = facts.about("fig6"), facts.by_scene("fig6")
    again = [row | {"albedo_psnr": 77.7} for row in facts.rows("fig6") if row["scene"] == "KITCHEN"]
    assert join(kept / "fig6", about, facts.rows("fig6")) is None
    run = {"machines": [{"processor": "a new one"}], "seconds": 7.0}
    run["seconds_by_scene"] = {"kitchen": 7.0}
    joined, texts = join(kept / "fig6", about | run, again)
    assert joined["machines"] == [*about["machines"], {"processor": "a new one"}]
    others = sum(v for k, v in about["seconds_by_scene"].items() if k != "kitchen")
    assert joined["seconds"] == pytest.approx(others + 7.0)
    for name, text in texts.items():
        (kept / "fig6" / name).write_text(text)
    after = type(facts)(RESULTS, kept)
    assert after.by_scene("fig6") == scenes and len(scenes) > 4
    for row in facts.rows("fig6"):
        same = {key: row[key] for key in ("scene", "method", "views", "seed")}
        found = after.where("fig6", **same)["albedo_psnr"]
        assert found == (77.7 if row["scene"] == "KITCHEN" else row["albedo_psnr"])
    table = after.experiment_table("fig6")
    lines = facts.experiment_table("fig6").splitlines()
    other = [line for line in lines if line.startswith("| STAIRCASE |")]
    assert other and set(other) <= set(table.splitlines()) and "77.7" in table


def test_results_without_some_scenes_do_not_replace_those_of_all(writer, tmp_path):
    """Nothing is taken over then, also of other experiments."""
    kept, results = tmp_path / "kept", tmp_path / "reproduction"
    for name in ("fig3", "table2"):
        shutil.copytree(ROOT / "docs" / "reproduction" / name, kept / name)
        shutil.copytree(ROOT / "docs" / "reproduction" / name, results / name)
        about = json.loads((kept / name / "about.json").read_text())
        rows = [{"scene": "STAIRCASE"}] if name == "fig3" else [{"albedo": 0.3}]
        (results / name / "data.json").write_text(json.dumps(about | {"rows": rows}))
    (results / "table2" / "table.md").write_text("another")

    def contents():
        return {file: file.read_bytes() for file in kept.rglob("*") if file.is_file()}

    before = contents()
    with pytest.raises(SystemExit, match=r"KITCHEN.*fig3 would be lost.*without --only"):
        writer["take_over"](results, tmp_path, kept)
    assert contents() == before and len(before) > 5


def test_methods_whose_steps_are_as_fast_as_ours_are_told(writer, tmp_path):
    rows, page_of = reproduced(writer, tmp_path, "fig3")
    for quick in (["DRAGON"], []):
        for row in rows:
            if row["method"].startswith(("PRB", "AD-PT")):
                rival = row["method"] == "PRB, split halves" and row["scene"] in quick
                row["times_ours"] = "0.875" if rival else "1.27"
        page = page_of(rows)
        told = "no longer than ours with PRB, split halves on DRAGON (0.88 times)."
        assert (told in page) == bool(quick) == ("no longer than ours" in page)
        assert "authors' ratios of PRB are smaller in 2 of 7 scenes" in page


def test_step_times_of_version_0_1_are_marked(writer, tmp_path):
    """They have no depth of paths; those that tell a version are as this page says."""
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    facts = runpy.run_path(str(ROOT / "scripts" / "facts.py"))["Facts"]
    file = results / "methods-demo.json"
    methods = json.loads(file.read_text())
    methods.pop("unbake", None)
    for row in methods["rows"]:
        row.pop("path_depth", None)
    file.write_text(json.dumps(methods))
    machine = facts(results, tmp_path).machine_file()
    content = json.loads((results / f"{machine}.json").read_text())
    for step in content["steps"]:
        step.pop("unbake", None)
        step["parts"] = step.pop("phases", None) or step.get("parts")
    (results / f"{machine}.json").write_text(json.dumps(content))
    names = ("methods-demo", machine)
    told = facts(results, tmp_path).older(*names)
    assert all(f"`{name}.json`" in told for name in names) and "step times of version 0.1" in told
    written = writer["pages"](results=results)
    for page, name in (("comparison.md", "methods-demo"), ("performance.md", machine)):
        assert f"`{name}.json`" in " ".join(written[ROOT / "docs" / page].split())
    assert "`methods-demo.json`" in " ".join(written[ROOT / "README.md"].split())

    content["steps"] = [step | {"unbake": "0.2.0"} for step in content["steps"]]
    (results / f"{machine}.json").write_text(json.dumps(content))
    depths = {"prb": 15, "ad-pt": 15}
    with_depth = [row | {"path_depth": depths.get(row["method"])} for row in methods["rows"]]
    for newer in (methods | {"rows": with_depth}, methods | {"unbake": "0.2.0"}):
        file.write_text(json.dumps(newer))
        assert facts(results, tmp_path).older(*names) == ""


def test_a_result_that_is_missing_is_named_with_the_command_that_makes_it(writer, tmp_path):
    results = tmp_path / "results"
    ignored = shutil.ignore_patterns("rivals-demo.json")
    shutil.copytree(ROOT / "benchmarks" / "results", results, ignore=ignored)
    message = r"md\.jinja, line \d+: .*rivals-demo\.json is missing.*benchmarks/run\.py rivals"
    with pytest.raises(writer["Unfounded"], match=message):
        writer["pages"](results=results)
    made_by = runpy.run_path(str(ROOT / "scripts" / "facts.py"))["made_by"]
    assert made_by("torch-field") == "python benchmarks/torch_field.py"
    assert made_by("rates") == "python benchmarks/run.py rates"
    kept = tmp_path / "reproduction"
    shutil.copytree(ROOT / "docs" / "reproduction", kept, ignore=shutil.ignore_patterns("fig5"))
    with pytest.raises(writer["Unfounded"], match=r"fig5.*is missing.*unbake reproduce fig5"):
        writer["pages"](kept=kept)


def test_a_page_does_not_mix_machines(writer, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(ROOT / "benchmarks" / "results", results)
    file = results / "rivals-demo.json"
    content = json.loads(file.read_text())
    content["machine"]["cores"] = 64
    file.write_text(json.dumps(content))
    with pytest.raises(writer["Unfounded"], match="mixes machines"):
        writer["pages"](results=results)


# -------------------------------------------------------------------- No number without a source

NUMBER = r"(?<![\w.,/^-])[+−-]?\d[\d,]*(?:\.\d+)?(?:\s?(?:to|and|or|–|±|/)\s?\d[\d,]*(?:\.\d+)?)*"
WORDS = (
    r"(?:one|two|three|four|five|six|seven|eight|nine|ten|eleven|twelve|fifteen|twenty|thirty|"
    r"forty|fifty|sixty|ninety|hundred)"
)
UNITS = (
    r"\s?(?:dB|µs|ms|s|min|minutes?|seconds?|hours?|%|per ?cent|[kMG]B|[KMG]iB|times|fold|×|"
    r"x(?!\s?[\d⟦])|(?:k|M|G)?\s?(?:samples/s|samples|steps|launches|levels|triangles|seeds)|[kM])"
    r"(?!\w)"
)
FRACTIONS = (
    r"\b(?:twice|thrice|half|(?:an?|one|two|three) (?:thirds?|quarters?|fifths?|sixths?|eighths?|"
    r"tenths?))(?= (?:as|the|more|less|longer|shorter|faster|slower|sooner|of the time))"
)
#: What counts as a measured number, unless it is in the list of settings.
SUSPECTS = re.compile(
    "|".join(
        [
            NUMBER + UNITS,
            rf"\b{WORDS} (?:dB|minutes?|seconds?|hours?|times|per ?cent)\b",
            r"(?<![\w.,/^-])[+−-]?\d[\d,]*\.\d+(?:e-?\d+)?(?![\w.])",
            r"(?<=\| )[+−-]?[\d,.]+(?: ± [\d.]+)?(?: \([^|)]*\))?(?= \|)",
            FRACTIONS,
            r"\b(?:more|less|better|worse|nearer|fewer) (?:than|by) \d[\d,.]*",
        ]
    )
)
#: Parts of a page that are no claims: code, comments, targets of links, front matter of references.
#: Code on a line that has a number with a unit is no code: see `blank`.
EXEMPT = re.compile(
    r"```.*?```|`[^`\n]*`|<!--.*?-->|\]\([^)]*\)|<https?:[^>]*>|"
    r"\b(?:Eqs?|Secs?|Figs?|Figures?|Tables?)\.? \d[\d.]*(?:(?:, | and | to |–)\d[\d.]*)*",
    re.DOTALL,
)
JINJA = re.compile(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}", re.DOTALL)


@dataclass(frozen=True)
class Allowed:
    pages: list[str]
    pattern: str
    reason: str


def allowed() -> list[Allowed]:
    entries = tomllib.loads(SETTINGS.read_text(encoding="utf-8"))["allow"]
    return [Allowed(**entry) for entry in entries]


def sources() -> list[Path]:
    """Where the text of pages is written: a template if there is one, else the page."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    own = [page for page in pages if page.name != "table.md"]
    beside = [(page, page.with_name(f"{page.name}.jinja")) for page in own]
    return [template if template.is_file() else page for page, template in beside]


def blank(match: re.Match) -> str:
    """Something that is no number and has as many lines."""
    if re.fullmatch("`[^`]+`", match[0]) and re.search(NUMBER + UNITS, match[0]):
        # Whoever writes a measured number as code claims it all the same.
        return match[0]
    return "⟦⟧" + "\n" * match[0].count("\n")


def literals(source: str, page: str, entries: list[Allowed]) -> tuple[list[str], set[Allowed]]:
    """Numbers of a page's source that have no source of their own, and the entries in use."""
    text = EXEMPT.sub(blank, JINJA.sub(blank, source))
    used = set()
    for entry in entries:
        if any(Path(page).match(name) for name in entry.pages):
            # A line may end wherever there is a space.
            text, count = re.subn(entry.pattern.replace(" ", r"\s+"), blank, text)
            used |= {entry.pattern} if count else set()
    found = [
        f"{page}:{number}: {match[0].strip()!r} in: {line.strip()[:100]}"
        for number, line in enumerate(text.splitlines(), 1)
        for match in SUSPECTS.finditer(line)
    ]
    return found, used


def test_no_page_holds_a_measured_number_that_it_does_not_read_from_a_result():
    found, used, entries = [], set(), allowed()
    for source in sources():
        page = str(source.relative_to(ROOT)).removesuffix(".jinja")
        here, there = literals(source.read_text(encoding="utf-8"), page, entries)
        found, used = found + here, used | there
    assert not found, "\n".join([f"{len(found)} numbers without a source. {REMEDY}", *found])
    stale = [entry.pattern for entry in entries if entry.pattern not in used]
    assert not stale, f"{SETTINGS.name}: these entries are not needed any more: {stale}"
    assert all(len(entry.reason) > 10 for entry in entries)


@pytest.mark.parametrize(
    "sentence",
    [
        "It reaches 29.3 dB.", "A step takes 12 ms.", "It is 21 times sooner.", "Python takes 1 %.",
        "It needs one minute for it.", "A step takes twice as long.", "774 k samples/s",
        "in a third more samples", "| ours | 29.3 | 4 |", "| ours | 29.3 ± 0.1 |", "within 0.5",
        "below 20 launches", "1.4 GB", "a step of {{ ms(x) }} and 12 ms", "22 or 23 times",
        "3.6x faster", "A launch costs 20 µs.", "more than 40 of them",
        "`29.3 dB`", "`ours` has `29.3 dB`, `prb` less", "a step (`12 ms`)",
    ],
)  # fmt: skip
def test_a_measured_number_is_found(sentence):
    found, _ = literals(sentence, "page.md", [])
    assert found, sentence


@pytest.mark.parametrize(
    "sentence",
    [
        "{{ db('a', 'ours', 'albedo') }} and {{ 100 * x | number(1) }} dB", "Figures 1 and 6",
        "`--seconds 120`", "```sh\nfit --seconds 120\n```", "<!-- 12 dB -->", "Sec. 5.2, Eq. 12",
        "`0.62`, `fig8` and `[0, 0.62, 1]`",
        "[the paper](https://a.b/3.14)", "x₁ and L_θ lie in [0,1]", "a map of 64 x 64 texels",
        "{% if 2.5 > x %}nearer{% endif %}",
    ],
)  # fmt: skip
def test_what_is_no_measurement_is_not(sentence):
    found, _ = literals(sentence, "page.md", [])
    assert not found


def test_templates_compute_what_they_print():
    """A number that is written into an expression is as bare as one beside it."""
    environment = jinja2.Environment()
    templates = [source for source in sources() if source.suffix == ".jinja"]
    assert len(templates) >= 5
    for template in templates:
        tree = environment.parse(template.read_text(encoding="utf-8"))
        for output in tree.find_all(jinja2.nodes.Output):
            for node in output.nodes:
                if isinstance(node, jinja2.nodes.TemplateData):
                    continue
                known = isinstance(node, jinja2.nodes.Name) or any(
                    node.find_all((jinja2.nodes.Call, jinja2.nodes.Name))
                )
                text = [c.value for c in node.find_all(jinja2.nodes.Const)]
                bare = [t for t in text if isinstance(t, str) and re.search(r"\d\.\d|\d dB", t)]
                assert known and not bare, f"{template.name}:{node.lineno}: a bare number {bare}"


def test_paragraphs_are_filled_and_nothing_else_is(writer):
    long = "word " * 40
    text = f"# Title\n\nIt is\n6. {long}\n\n- one\n  {long}\n- two\n\n1. a\n2. b\n\n> a\n> {long}\n"
    text += f"\n| a | b |\n|---|---|\n| {long} | 1 |\n\n```sh\n{long}\n\n{long}\n```\n"
    filled = writer["filled"](text)
    assert filled.count("word") == text.count("word")
    blocks = filled.split("\n\n")
    assert blocks[1].startswith("It is 6. word word") and len(blocks[1].split("\n")) == 2
    assert blocks[2].startswith("- one word") and blocks[2].endswith("\n- two")
    assert blocks[3] == "1. a\n2. b"
    assert all(line.startswith("> ") for line in blocks[4].split("\n"))
    assert f"| {long} | 1 |" in filled and f"```sh\n{long}\n\n{long}\n```\n" in filled
    own = [line for block in blocks[:4] for line in block.split("\n")]
    assert max(map(len, own)) <= 120
