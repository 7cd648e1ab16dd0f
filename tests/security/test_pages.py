"""Names from data, runs and scenes are text on a page, never markup: parsed, and in a browser."""

import json
import re
import shutil
import subprocess
from functools import cache
from html.parser import HTMLParser

import numpy as np
import pytest
from support import BROWSERS, found_browser

from unbake.imaging import pictures
from unbake.report.page import write_report

#: Each would change the title of a page in which it counts as markup; none has a slash, which no
#: name of a file can have. An unclosed script ends at the next one of the page.
NAMES = [
    "<script>document.title='changed'<",
    "<img src=x onerror=\"document.title='changed'\">",
    "'\"><svg onload=document.title='changed'>",
    "<b onmouseover=alert(1)>javascript:document.title='changed'",
    "{{ 7 * 7 }}{% for x in y %}&lt;script&gt;",
    "]]><!--<style>*{display:none}",
]
#: The same with an end, in texts that may have one.
SCRIPT = "</title></script></style></svg><script>document.title='changed'</script>"


@pytest.fixture(scope="module")
def page(repository, tmp_path_factory):
    """Write the page of two runs, with a name in every place that shows names; once for each."""
    first = repository / "tests" / "data" / "version-0.1"

    @cache
    def write(name):
        tmp_path = tmp_path_factory.mktemp("page")
        text = f"{name} {SCRIPT}"
        data = shutil.copytree(first / "data", tmp_path / name)
        transforms = json.loads((data / "transforms.json").read_text())
        for frame in transforms["frames"]:
            old = frame["file_path"].removeprefix("images/").removesuffix(".exr")
            for file in data.rglob(f"{old}.exr"):
                file.rename(file.with_name(f"{old} {name}.exr"))
            frame["file_path"] = f"images/{old} {name}.exr"
        transforms["render"] |= {"integrator": text, text: text}
        (data / "transforms.json").write_text(json.dumps(transforms))
        runs = []
        for number in range(2):
            run = shutil.copytree(first / "run", tmp_path / "runs" / f"{name} {number}")
            for file in run.rglob("*_*_*.exr"):
                view, _, quantity = file.stem.rpartition("_")
                file.rename(file.with_name(f"{view} {name}_{quantity}.exr"))
            metrics = json.loads((run / "evaluation" / "metrics.json").read_text())
            for row in metrics["per_view"]:
                row["name"] += f" {name}"
            metrics["data"] = f"../../{name}"
            for key in ("method", "prior", "representation", "radiance", "estimator"):
                metrics[key] = f"{key} {text}"
            metrics["definitions"] = dict.fromkeys([*metrics["definitions"], text], text)
            metrics["render"] |= {"spp": text, text: text}
            light = {"strength": [1, 2, 3], "truth": [1, 2, 3], "emission_error": 0.1}
            metrics["unknown"] = "emission" if number else "materials"
            metrics["emission"] = [{"name": text, **light}] if number else None
            (run / "evaluation" / "metrics.json").write_text(json.dumps(metrics))
            settings = run / "config.toml"
            told = f"preset = {json.dumps(f'{number} {text}')}"
            settings.write_text(settings.read_text().replace('preset = "cpu"', told))
            log = [{"step": step, "seconds": 1.0 * step, text: 1 / step} for step in (1, 2)]
            log.append(log[-1] | {"validation": {"split": text, "albedo_psnr": 20.0}})
            (run / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in log))
            runs.append(run)
        sheets, relit = exported(tmp_path / "exported", runs[0], text), tmp_path / "relit"
        shutil.copytree(sheets / "textures", relit)
        frame = {"name": f"a{name}", "render_psnr": 1.0}
        made = {"frames": [frame], "light": {"envmap": name}, "settings": {"exposure": 0}}
        made["run"] = {"folder": str(runs[0].resolve())}
        made["mean"] = {"views": text, "render_psnr": 1}
        (relit / "a_albedo.exr").rename(relit / f"a{name}.exr")
        (relit / "render.json").write_text(json.dumps(made))
        shown = {"exported": [sheets], "relit": [relit]}
        return write_report(runs, tmp_path / "page.html", failed={text: text}, **shown)

    return write


def exported(folder, run, name):
    """An export with one texture, of a material of this name."""
    pictures.write_exr(folder / "textures" / "a_albedo.exr", np.ones((4, 4, 3), np.float32))
    row = {"name": name, "textures": ["a_albedo.exr"], "resolution": 4}
    row |= {"unobserved_share": 0.5, "area": 1.0}
    made = {"formats": ["textures"], "materials": [row], "run": {"folder": str(run.resolve())}}
    (folder / "export.json").write_text(json.dumps(made))
    return folder


class Markup(HTMLParser):
    """What a page has besides text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.comments, self.title = [], [], [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_comment(self, data):
        self.comments.append(data)

    def handle_data(self, data):
        if self.tags and self.tags[-1] == "title" and "svg" not in self.tags:
            self.title += data


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_text_on_a_page(page, name):
    text = page(name).read_text(encoding="utf-8")
    found = Markup(text)
    assert found.tags.count("script") == 1 and found.tags.count("title") >= 1
    assert not {tag for tag in found.tags if tag in ("iframe", "object", "embed", "base", "link")}
    assert not [key for key, _ in found.attributes if key.startswith("on")]
    sources = [v for k, v in found.attributes if k in ("src", "href", "xlink:href", "action")]
    assert all(v is None or v.startswith(("data:image/png;", "#")) for v in sources)
    assert "<b onmouseover" not in text and "<svg onload" not in text and SCRIPT not in text
    assert text.count("</script>") == 1
    # The name is there, so that the test has shown something.
    assert text.count("&lt;") > 10


@pytest.fixture(scope="session")
def title_in_browser(tmp_path_factory):
    """Open a page in a headless browser, and return its title after all of its scripts."""
    browser = found_browser()
    if browser is None:
        pytest.skip(f"none of the browsers {', '.join(BROWSERS)} is installed")

    def look(page):
        flags = [
            "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            f"--user-data-dir={tmp_path_factory.mktemp('browser')}",
            "--virtual-time-budget=3000", "--dump-dom", page.as_uri(),
        ]  # fmt: skip
        done = subprocess.run([browser, *flags], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr[-2000:]
        title = re.search(r"<title>(.*?)</title>", done.stdout, re.S)
        assert title, done.stdout[:2000]
        return title[1]

    return look


def test_a_script_of_a_page_is_noticed(title_in_browser, tmp_path):
    page = tmp_path / "page.html"
    page.write_text(f"<html><head><title>as it was</title></head><body>{NAMES[1]}</body></html>")
    assert title_in_browser(page) == "changed"


@pytest.mark.parametrize("name", NAMES)
def test_no_script_in_a_name_runs_in_a_browser(page, title_in_browser, name):
    file = page(name)
    title = title_in_browser(file)
    assert title != "changed" and "recovered" in title
