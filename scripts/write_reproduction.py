"""Assemble docs/reproduction.md from what `unbake reproduce` wrote.

    python scripts/write_reproduction.py --results reproduction --scenes scenes
    python scripts/write_reproduction.py            the page again, from what was taken over before

Tables, data, pictures and the scenes' licences go to docs/reproduction; the page's own words are in
docs/reproduction.md.jinja.
"""

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import jinja2

from unbake import activate

DOCS = Path(__file__).parents[1] / "docs"
PAGE, KEPT = DOCS / "reproduction.md", DOCS / "reproduction"


def take_over(results: Path, scenes: Path, kept: Path = KEPT) -> None:
    """Copy tables and data, pictures as JPEG, and licences, a folder an experiment."""
    import mitsuba as mi

    from unbake.experiments.scenes import SCENES

    for data in sorted(results.glob("*/data.json")):
        about = json.loads(data.read_text(encoding="utf-8"))
        if about["scale"] != "cpu":
            raise SystemExit(f"{data}: the page is of cpu scale, this is {about['scale']} scale")
        del about["rows"]
        folder = kept / data.parent.name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        (folder / "about.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
        for name in ("data.csv", "table.md"):
            shutil.copy(data.with_name(name), folder / name)
        for picture in data.parent.glob("*.png"):
            bitmap = mi.Bitmap(str(picture))
            rgb = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)
            rgb.write(str(folder / f"{picture.stem}.jpg"), quality=88)
    for scene in SCENES:
        licences = kept / "licences"
        licences.mkdir(parents=True, exist_ok=True)
        shutil.copy(scenes / scene.folder / "LICENSE.txt", licences / f"{scene.folder}.txt")


def page(kept: Path = KEPT) -> str:
    """The page, of what is kept."""
    from unbake.experiments.scenes import SCENES

    def about(name: str) -> dict[str, Any]:
        return json.loads((kept / name / "about.json").read_text(encoding="utf-8"))

    def table(name: str) -> str:
        return (kept / name / "table.md").read_text(encoding="utf-8").strip()

    def cost(name: str) -> str:
        seconds = about(name)["seconds"]
        return f"{seconds / 60:.0f} minutes" if seconds >= 90 else f"{seconds:.0f} seconds"

    def picture(name: str, file: str, words: str) -> str:
        path = kept / name / f"{file}.jpg"
        if not path.is_file():
            raise FileNotFoundError(path)
        return f"![{words}]({kept.name}/{name}/{file}.jpg)"

    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    )
    machines = [
        m for file in kept.glob("*/about.json") for m in about(file.parent.name)["machines"]
    ]
    if any(machine != machines[0] for machine in machines):
        raise SystemExit("the page is of one machine, results are of several")
    template = environment.from_string((DOCS / "reproduction.md.jinja").read_text("utf-8"))
    return template.render(
        machine=machines[0],
        scenes={scene.folder: scene.label for scene in SCENES},
        table=table,
        cost=cost,
        picture=picture,
    )


def main() -> None:
    """Write the page and its figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, help="folder that `unbake reproduce` wrote")
    parser.add_argument("--scenes", type=Path, default=Path("scenes"), help="unpacked scenes")
    args = parser.parse_args()
    activate()
    if args.results is not None:
        take_over(args.results, args.scenes)
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE}")


if __name__ == "__main__":
    main()
