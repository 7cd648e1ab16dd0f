"""What the fields of some settings can represent of a data set at best."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ..config import FitConfig
from ..dataset.views import Dataset
from ..evaluation.yardsticks import DEFINITIONS, STEPS, measure_ceiling
from ..io import write_json
from ..machine import machine
from ..training.grid_sizes import with_grid_sizes
from ..training.validation import psnr_keys
from ..version import VERSION


def bench_ceiling(
    data: Path,
    config: FitConfig,
    steps: int | None,
    out: Path | None,
    console: Console,
    *,
    allow_outside: bool = False,
) -> dict[str, Any]:
    """Train the fields on the true maps of the training views, and score them on held-out views.

    The ceiling is kept with the data set, and evaluations of runs with these fields show it.

    Args:
        data: folder of a data set with true maps.
        config: says the fields; sizes that it leaves open are those of a fit.
        steps: length of the training; None: that of the ceilings that evaluations show.
        out: JSON file to write.
        console: shows the results.
        allow_outside: read files of the data set and its scene that lie outside of its folder.

    Returns:
        The content of the file.

    Raises:
        UserError: the data set has no true maps, or the settings have no unknown materials.

    Paper: Sec. 5.3.
    """
    dataset = Dataset.load(data, allow_outside=allow_outside)
    config = with_grid_sizes(config, dataset)

    def tell(line: str) -> None:
        console.print(line, markup=False, soft_wrap=True)

    found = measure_ceiling(dataset, config, steps=steps, tell=tell)
    result = {"unbake": VERSION, "machine": machine(), "data": dataset.folder.name}
    result |= {
        "representation": config.representation,
        "fields": {name: asdict(field) for name, field in config.material_settings.items()},
        **found,
        "definitions": DEFINITIONS,
    }
    _print(result, config.quantities, console)
    if steps is not None and steps != STEPS:
        tell(f"evaluations show the ceiling after {STEPS} steps, without --steps")
    if out is not None:
        write_json(out, result, allow_nan=False)
    return result


def _print(result: dict[str, Any], quantities: tuple[str, ...], console: Console) -> None:
    kinds = ("untrained", "constant", "ceiling")
    title = f"{result['heldout_views']} held-out views, PSNR in dB"
    table = Table("quantity", title=title, title_justify="left")
    for kind in kinds:
        table.add_column(kind, justify="right")
    for name, key in zip(quantities, psnr_keys(quantities), strict=True):
        scores = (result["yardsticks"][kind][key] for kind in kinds)
        table.add_row(name, *("—" if score is None else f"{score:.2f}" for score in scores))
    console.print(table)
    console.print(
        f"untrained: the fields before their first step; constant: the mean of the true maps; "
        f"ceiling: the fields ({result['representation']}) after {result['steps']} steps on the "
        f"true maps, {result['seconds']:.0f} s",
        markup=False,
    )
