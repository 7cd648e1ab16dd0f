"""Files of `unbake bench step` as one of the machine: python machine.py FOLDER FILE ..."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path


def main(folder: Path, files: list[Path]) -> None:
    """Write FOLDER/<machine>.json."""
    found = [json.loads(file.read_text(encoding="utf-8")) for file in files]
    machine = found[0]["machine"]
    words = f"{machine['processor']} {machine['cores']} cores {machine['variant'].split('_')[0]}"
    name = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
    steps = [{key: value for key, value in one.items() if key != "machine"} for one in found]
    out = folder / f"{name}.json"
    out.write_text(json.dumps({"machine": machine, "steps": steps}, indent=1) + "\n")
    print(f"wrote {out}")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: python machine.py FOLDER FILE ...")
    main(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
