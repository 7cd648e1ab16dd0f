"""The page's section on relighting: pictures that `unbake relight` or `unbake render` made."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unbake.config.light import LightConfig
from unbake.dataset.spread import evenly
from unbake.dataset.views import Dataset, read_photograph
from unbake.errors import UserError
from unbake.evaluation.settings import RENDER_FORMAT
from unbake.formats import check_format
from unbake.imaging import pictures
from unbake.io import read_object
from unbake.report import display
from unbake.report.runs import EvaluatedRun, made_of
from unbake.report.wording import made_after

#: Pictures of a folder that are shown, evenly spaced, and pixels along their longer side.
MOST, LONGEST = 6, 320
#: What settings of a light are told by, where they are not the usual ones.
_WORDS = {
    "envmap_rotate": "turned by {:g}°",
    "envmap_scale": "times {:g}",
    "envmap_up": "its first row at {}",
    "keep_lights": "with the scene's own lights",
}


def relit_sections(
    folders: Sequence[Path], runs: list[EvaluatedRun], allow_outside: bool
) -> list[dict[str, Any]]:
    """A strip of pictures for each light: the truth, if it is there, and each run under it.

    Args:
        folders: of `unbake relight` or `unbake render`.
        runs: those of the page.
        allow_outside: read files of the truth that lie outside of its folder.

    Raises:
        UserError: a folder holds no pictures, or those of another run.
    """
    strips: dict[tuple[Any, ...], dict[str, Any]] = {}
    for folder in folders:
        file = folder / "render.json"
        manifest = read_object(file, "Make one with `unbake relight RUN --out DIR …`")
        check_format(manifest, RENDER_FORMAT, file)
        number = made_of(manifest, file, runs)
        try:
            names = [str(frame["name"]) for frame in manifest["frames"]]
            exposure = float(manifest["settings"]["exposure"])
            told, truth = manifest.get("light"), manifest.get("truth")
            if not names or any(Path(name).name != name for name in names):
                raise ValueError
            light = _light(told)
            key = (light, json.dumps(told, sort_keys=True), truth, exposure, *names)
            if key not in strips:
                strips[key] = _strip(light, truth, exposure, names, allow_outside)
            row = _row(folder, manifest, runs[number], strips[key])
            strips[key]["rows"].append({"run": number} | row)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            raise UserError("cannot be read", file, "Make the pictures again") from None
    return [strip for _, strip in sorted(strips.items(), key=lambda item: item[0][0])]


def _light(told: dict[str, Any] | None) -> str:
    """What a light is called."""
    if told is None:
        return "The scene's own light, as it was recovered"
    file = Path(str(told.get("envmap") or told.get("lights") or "another light")).name
    parts = [f"{'Environment map' if told.get('envmap') else 'Lights'}: {file}"]
    for key, words in _WORDS.items():
        usual = getattr(LightConfig, key)
        if told.get(key, usual) != usual:
            parts.append(words.format(told[key]))
    return ", ".join(parts)


def _strip(
    light: str, truth: str | None, exposure: float, names: list[str], allow_outside: bool
) -> dict[str, Any]:
    shown = evenly(names, MOST)
    true = None
    if truth is not None and Path(truth).is_dir():
        views = {v.name: v for v in Dataset.load(Path(truth), allow_outside=allow_outside).views}
        if all(name in views for name in shown):
            chosen = [views[name] for name in shown]
            images = [read_photograph(v, True)[..., :3] / v.exposure for v in chosen]
            true = [_picture(image, exposure) for image in images]
    return {
        "light": light,
        "exposure": exposure,
        "names": shown,
        "more": len(names) - len(shown),
        "truth": true,
        "rows": [],
    }


def _row(
    folder: Path, manifest: dict[str, Any], run: EvaluatedRun, strip: dict[str, Any]
) -> dict[str, Any]:
    """A run's pictures, and what is told of them; sets the shape of the strip's pictures."""
    frames = {str(frame["name"]): frame for frame in manifest["frames"]}
    cells = []
    for name in strip["names"]:
        image = display.rgb(folder / f"{name}.exr")[0]
        strip["height"], strip["width"] = image.shape[:2]
        psnr = display.number(frames[name].get("render_psnr"))
        number = "" if psnr is None else f"{display.decibels(psnr)} dB"
        cells.append({"picture": _picture(image, strip["exposure"]), "number": number})
    mean = manifest.get("mean") or {}
    psnr = display.number(mean.get("render_psnr"))
    told = [display.similar(mean), made_after(manifest, run)]
    if psnr is not None:
        views = (manifest.get("scored") or {}).get("render_psnr", mean.get("views"))
        told.insert(0, f"{display.decibels(psnr)} dB, mean of {views} views")
    aligned = display.number(mean.get("render_psnr_aligned"))
    if aligned is not None:
        told.insert(1, f"{display.decibels(aligned)} dB once aligned in brightness")
    return {"cells": cells, "told": "; ".join(filter(None, told))}


def _picture(image: np.ndarray, exposure: float) -> str:
    return pictures.png_data_uri(pictures.tonemap(pictures.shrink(image, LONGEST), exposure))
