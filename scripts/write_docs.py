"""Write every page that has measured numbers, from its template and committed results.

    python scripts/write_docs.py                      all pages again
    python scripts/write_docs.py --check              tell which are not what their results make
    python scripts/write_docs.py --results reproduction --scenes scenes

The last one first takes over what `unbake reproduce` wrote: tables, data, pictures and the scenes'
licences go to docs/reproduction. The template of a page lies beside it, as `PAGE.jinja`;
`docs/macros.jinja` has what several of them tell alike, `scripts/facts.py` what they call.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
import textwrap
from pathlib import Path
from typing import Any

import jinja2

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "scripts")]

from facts import FILTERS, Facts, Unfounded, context  # noqa: E402

from unbake import activate  # noqa: E402

RESULTS, KEPT = ROOT / "benchmarks" / "results", ROOT / "docs" / "reproduction"
WIDTH = 120
#: Headings, tables, pictures, comments and what is set in stay as they are.
_KEPT = re.compile(r"^(\||#|!\[|<!--|\[//\]|\s{4,})", re.MULTILINE)
Row = dict[str, Any]
#: A comment of Markdown.
NOTE = "[//]: # (Made by scripts/write_docs.py from {}: edit that.)\n\n"


def templates() -> list[Path]:
    """The template of every page."""
    return [*sorted(ROOT.glob("*.md.jinja")), *sorted((ROOT / "docs").rglob("*.md.jinja"))]


def render(template: Path, facts: Facts) -> str:
    """The text of a page.

    Raises:
        Unfounded: a number of the page is in no committed result.
    """
    from unbake.experiments.scenes import SCENES

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(ROOT / "docs"),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
    )
    environment.filters |= FILTERS
    scenes = {scene.folder: scene.label for scene in SCENES}
    power = next(scene.albedo_power for scene in SCENES if scene.label == "STAIRCASE")
    try:
        page = environment.from_string(template.read_text(encoding="utf-8"))
        text = page.render(**context(facts), scenes=scenes, staircase_power=power)
    except (Unfounded, jinja2.TemplateError) as error:
        line = _line(error)
        raise Unfounded(f"{template.relative_to(ROOT)}{line}: {error}") from None
    return NOTE.format(template.name) + filled(text)


def filled(text: str) -> str:
    """Refill the paragraphs and list items of a page, whose lines numbers have made uneven."""
    lines: list[str] = []
    for i, block in enumerate(text.split("```")):
        # Blocks of code, every second one, stay as they are.
        lines.append(block if i % 2 else "\n\n".join(map(_filled, re.split(r"\n{2,}", block))))
    return "```".join(lines)


def _filled(paragraph: str) -> str:
    text = paragraph.strip("\n")
    if not text.strip() or _KEPT.search(paragraph):
        return paragraph
    head, tail = paragraph.split(text, 1)
    # A line in the middle of a paragraph may begin with a number and a full stop.
    mark = r"\d+\. " if re.match(r"\d+\. ", text) else r"[-*] "
    items = [text] if text.startswith("> ") else re.split(rf"\n(?={mark})", text)
    return head + "\n".join(map(_filled_item, items)) + tail


def _filled_item(item: str) -> str:
    found = re.match(r"[-*>] |\d+\. ", item)
    mark = "" if found is None else found[0]
    inner = "> " if mark == "> " else " " * len(mark)
    words = " ".join(line.removeprefix(">").strip() for line in item.removeprefix(mark).split("\n"))
    return textwrap.fill(
        words, WIDTH, initial_indent=mark, subsequent_indent=inner,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip


def _line(error: BaseException) -> str:
    """The line of the template that an error is from."""
    if isinstance(error, jinja2.TemplateSyntaxError):
        return f", line {error.lineno}"
    trace, line = error.__traceback__, ""
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == "<template>":
            line = f", line {trace.tb_lineno}"
        trace = trace.tb_next
    return line


def pages(results: Path = RESULTS, kept: Path = KEPT) -> dict[Path, str]:
    """The text of every page with measured numbers, by its file."""
    activate()
    facts = Facts(results, kept)
    return {template.with_suffix(""): render(template, facts) for template in templates()}


def page(name: str, results: Path = RESULTS, kept: Path = KEPT) -> str:
    """The text of one page, by its name from the repository's folder."""
    activate()
    return render(ROOT / f"{name}.jinja", Facts(results, kept))


def take_over(results: Path, scenes: Path, kept: Path = KEPT) -> None:
    """Copy tables and data, pictures as JPEG, and licences, a folder an experiment.

    Raises:
        SystemExit: an experiment has another scale, or lacks scenes that are kept of it. Nothing
            is copied then.
    """
    import mitsuba as mi

    from unbake.experiments.scenes import SCENES

    taken = {data: _taken(data, kept) for data in sorted(results.glob("*/data.json"))}
    for data, (about, texts, whole) in taken.items():
        folder = kept / data.parent.name
        if whole:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        texts["about.json"] = json.dumps(about, indent=1) + "\n"
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        for picture in data.parent.glob("*.png"):
            bitmap = mi.Bitmap(str(picture))
            rgb = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)
            rgb.write(str(folder / f"{picture.stem}.jpg"), quality=88)
    for scene in SCENES:
        licences = kept / "licences"
        licences.mkdir(parents=True, exist_ok=True)
        shutil.copy(scenes / scene.folder / "LICENSE.txt", licences / f"{scene.folder}.txt")


def _taken(data: Path, kept: Path) -> tuple[Row, dict[str, str], bool]:
    """What is taken over of an experiment: about it, its texts, and whether it replaces all."""
    about = json.loads(data.read_text(encoding="utf-8"))
    if about["scale"] != "cpu":
        raise SystemExit(f"{data}: the page is of cpu scale, this is {about['scale']} scale")
    rows, folder = about.pop("rows"), kept / data.parent.name
    if joined := with_other_scenes(folder, about, rows):
        return *joined, False
    if missing := _lacks(folder, rows):
        scenes = ", ".join(missing)
        raise SystemExit(f"{data}: {scenes} of {folder} would be lost. Make it without --only")
    names = ("data.csv", "table.md")
    texts = {name: data.with_name(name).read_text(encoding="utf-8") for name in names}
    return about, texts, True


def _lacks(folder: Path, rows: list[Row]) -> list[str]:
    """The scenes that are kept of an experiment of this version, and that new rows lack."""
    if not (folder / "about.json").is_file():
        return []
    facts, name = Facts(RESULTS, folder.parent), folder.name
    if "made_with" in facts.about(name):
        return []
    before = (row["scene"] for row in facts.rows(name) if "scene" in row)
    new = {row.get("scene") for row in rows}
    return [scene for scene in dict.fromkeys(before) if scene not in new]


def with_other_scenes(
    folder: Path, about: Row, rows: list[Row]
) -> tuple[Row, dict[str, str]] | None:
    """Results of Figure 6 with those that are kept of scenes that they lack.

    `unbake reproduce fig6 --only SCENES` makes it a part at a time. Each scene counts the time of
    the run that its rows are of.

    Returns:
        What is known of the run, and the texts of files; None if there is nothing to keep.
    """
    from unbake.experiments import fig6
    from unbake.experiments.scenes import SCENES
    from unbake.experiments.tables import csv_text

    if about["experiment"] != "fig6" or not (folder / "about.json").is_file():
        return None
    facts = Facts(RESULTS, folder.parent)
    before, new = facts.about("fig6"), {row["scene"] for row in rows}
    others = [row for row in facts.rows("fig6") if row["scene"] not in new]
    if "made_with" in before or not others:
        return None
    order = [scene.label for scene in SCENES]
    every = [{k: v for k, v in row.items() if v is not None} for row in [*rows, *others]]
    every.sort(key=lambda row: order.index(row["scene"]))
    machines = [*before["machines"], *about["machines"]]
    if "seconds_by_scene" not in about:
        again = "run `unbake reproduce fig6` with the same options again, which keeps its fits"
        raise SystemExit(f"{folder.name}: times of scenes are missing; {again}")
    spent = before["seconds_by_scene"] | about["seconds_by_scene"]
    joined = (
        before
        | about
        | {
            "machines": list({json.dumps(machine): machine for machine in machines}.values()),
            "seconds": round(sum(spent.values()), 1),
            "seconds_by_scene": spent,
        }
    )
    return joined, {"data.csv": csv_text(every), "table.md": fig6.tables(every) + "\n"}


def main() -> None:
    """Write the pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, help="folder that `unbake reproduce` wrote")
    parser.add_argument("--scenes", type=Path, default=Path("scenes"), help="unpacked scenes")
    parser.add_argument("--check", action="store_true", help="write nothing")
    args = parser.parse_args()
    activate()
    if args.results is not None:
        take_over(args.results, args.scenes)
    try:
        found = pages()
    except Unfounded as error:
        raise SystemExit(f"error: {error}") from None
    stale = [page for page, text in found.items() if _text(page) != text]
    for page in stale:
        if not args.check:
            page.write_text(found[page], encoding="utf-8")
        print(f"{'stale' if args.check else 'wrote'}: {page.relative_to(ROOT)}")
    if args.check and stale:
        raise SystemExit(1)


def _text(page: Path) -> str | None:
    return page.read_text(encoding="utf-8") if page.is_file() else None


if __name__ == "__main__":
    main()
