"""Documentation: links lead somewhere, the site builds, and examples run."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
GUIDES = sorted((ROOT / "docs" / "guides").glob("*.md"))
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"<!-- (.+?) -->\n```python\n(.*?)```", re.DOTALL)


def test_every_relative_link_leads_to_a_file():
    assert len(PAGES) > 10
    found, broken = 0, []
    for page in PAGES:
        for target in LINK.findall(page.read_text("utf-8")):
            path = target.partition("#")[0]
            if not path or re.match(r"[a-z]+:", path):
                continue
            found += 1
            if not (page.parent / path).exists():
                broken.append(f"{page.relative_to(ROOT)}: {target}")
    assert found > 50 and not broken, "\n".join(broken)


def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    # Material for MkDocs 9.7 and newer prints advertisements of another program without it.
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src"), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    reference = (tmp_path / "reference" / "index.html").read_text("utf-8")
    assert 'id="unbake.training.loop.fit"' in reference
    pages = [*tmp_path.rglob("*.html"), *tmp_path.rglob("*.css")]
    loaded = re.compile(r"(?:<script|<img|<link)[^>]+(?:src|href)=\"?https?:|url\(\"?https?:")
    assert [p.name for p in pages if loaded.search(p.read_text("utf-8"))] == []


def test_every_example_says_whether_it_is_run():
    remarks = []
    for page in GUIDES:
        text = page.read_text("utf-8")
        found = [remark for remark, _ in CODE.findall(text)]
        assert len(found) == text.count("```python"), page.name
        remarks += found
    assert "run by the tests: data" in remarks
    for remark in remarks:
        assert re.fullmatch("run by the tests: data|not run by the tests: .+", remark)


@pytest.mark.parametrize(
    "page",
    [p for p in GUIDES if "run by the tests: data" in p.read_text("utf-8")],
    ids=lambda p: p.stem,
)
def test_the_examples_of_a_page_run(page, cornell, tmp_path):
    examples = CODE.findall(page.read_text("utf-8"))
    code = "".join(text for remark, text in examples if remark == "run by the tests: data")
    code = code.replace("steps = 300\n", "steps = 4\n")
    shutil.copytree(cornell, tmp_path / "data")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        timeout=250,
    )
    assert done.returncode == 0, done.stderr[-4000:]
