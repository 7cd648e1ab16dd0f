"""What runs are called on the page, and what is told of them in a few words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from unbake.errors import quoted
from unbake.fields.registry import representation, representations
from unbake.quantities import QUANTITIES
from unbake.report import display
from unbake.report.runs import EvaluatedRun
from unbake.training.verdicts import WORDS, in_units_of_noise

#: How notes of fits that learned nothing begin.
_LEARNED_NOTHING = ("nothing was learned", "nothing useful was learned")
#: Names of the quantities that have pictures.
NAMES = {"render": "Rendering"} | {name: row.title for name, row in QUANTITIES.items()}
#: What runs optimized, by their setting, as the title says it.
OPTIMIZED = {
    "materials": "Materials",
    "lighting": "Lighting",
    "emission": "Lights",
    "materials+lighting": "Materials and lighting",
    "materials+emission": "Materials and lights",
    "lighting+emission": "Lighting and lights",
    "materials+lighting+emission": "Materials, lighting and lights",
}


def nothing_learned(run: EvaluatedRun) -> str | None:
    """Why a run is no result, in a few words; None if it is one.

    Its fit noted that nothing was learned, or each material of held-out views, albedo once aligned
    where it has been, scores below that of the untrained fields.
    """
    if run.untrained:
        return None
    if any(str(line.get("note", "")).startswith(_LEARNED_NOTHING) for line in run.log):
        return "nothing learned"
    before = (run.metrics.get("yardsticks") or {}).get("untrained") or {}
    found = run.metrics.get("heldout") or {}
    keys = [f"{name}_psnr" for name in QUANTITIES]
    scores = {key: display.number(found.get(key)) for key in keys}
    # Photographs may tell albedo and lighting but for a common scale.
    aligned = display.number(found.get("albedo_psnr_aligned"))
    if aligned is not None:
        scores["albedo_psnr"] = aligned
        # Untrained albedo is a constant: once aligned, the best one.
        constant = (run.metrics.get("yardsticks") or {}).get("constant") or {}
        before = before | {"albedo_psnr": constant.get("albedo_psnr", before.get("albedo_psnr"))}
    pairs = [(scores[key], display.number(before.get(key))) for key in keys]
    known = [(score, first) for score, first in pairs if score is not None and first is not None]
    below = known and all(score < first for score, first in known)
    return "worse than untrained" if below else None


def details(run: EvaluatedRun) -> list[tuple[str, str, str]]:
    """What is to be known of a run, in a few words each: text, symbol and subscript."""
    more = [*_outdated(run), *_trend(run), *_warnings(run)]
    return [*_described(run), *((text, "", "") for text in more)]


def made_after(manifest: Mapping[str, Any], run: EvaluatedRun) -> str:
    """After how many steps of a run something was made; empty where those were evaluated, too.

    Args:
        manifest: of an export or of pictures; see `made_of`.
        run: that it was made of.
    """
    steps, evaluated = display.number(manifest["run"].get("steps")), run.metrics.get("steps")
    if steps is None or evaluated is None or steps == evaluated:
        return ""
    return f"made after {display.count(steps)} steps"


def _outdated(run: EvaluatedRun) -> list[str]:
    """That the fit went on after it was evaluated, and what to do where that was saved."""
    steps = run.metrics.get("steps")
    if steps is None or run.taken <= steps:
        return []
    told = f"evaluated after {display.count(steps)} of {display.count(run.taken)} steps"
    written = run.folder.written_checkpoints()
    if not written or written[0] == run.folder.checkpoint(int(steps)):
        return [told]
    return [f"{told}; run `unbake evaluate {quoted(run.folder.path)}` again"]


def _trend(run: EvaluatedRun) -> list[str]:
    """Whether the fit was still improving, by the error on pixels that it did not learn from."""
    found = run.metrics.get("convergence") or {}
    keys = ("change", "share", "noise")
    change, share, noise = (display.number(found.get(key)) for key in keys)
    word = WORDS.get(str(found.get("trend")))
    if change is None or share is None or word is None:
        return []
    spread = "" if noise is None else f" ± {100 * noise:.1f}"
    moved = f"{'rose' if change > 0 else 'fell'} by {100 * abs(change):.1f}{spread} %"
    if noise is not None:
        moved = in_units_of_noise(change, noise) or moved
    told = f"the error on held-aside pixels {moved} over the last {100 * share:.0f} % of the fit"
    return [f"{word} ({told})"]


def _warnings(run: EvaluatedRun) -> list[str]:
    """Steps that were skipped, what a fit's watchdog noted, and pixels that were left out."""
    skipped = sum(line.get("skipped", 0) for line in run.log)
    steps = max(run.taken, run.metrics.get("steps") or 0)
    told = [f"{display.count(skipped)} of {display.count(steps)} steps skipped"]
    lost = sum(int(display.number(row.get("not_finite")) or 0) for row in run.metrics["per_view"])
    pixels = [f"{display.count(lost)} pixels of renderings are not finite and left out"]
    notes = [line["note"] for line in run.log if "note" in line]
    return [*(told if skipped else []), *notes, *(pixels if lost else [])]


def _described(run: EvaluatedRun) -> list[tuple[str, str, str]]:
    """Representations, unknown and estimator of a run as text, symbol and subscript."""
    metrics = run.metrics
    if "estimator" not in metrics:
        return []
    estimator = str(metrics["estimator"])
    told = [(form, "φ", "")] if (form := _form(metrics.get("representation"))) else []
    if differing := metrics.get("data_changed"):
        told.append((f"evaluated on other {listed(differing)}", "", ""))
    if run.untrained:
        return [*told, ("initial values, the same for all methods", "", "")]
    told.append((_form(metrics.get("radiance")) or "no", "L", "θ"))
    if metrics.get("warm_start"):
        told.append(("solved before the fit", "L", "θ"))
    if _unknown(metrics) != "materials":
        told.append((f"{OPTIMIZED.get(_unknown(metrics), 'something').lower()} optimized", "", ""))
    if metrics.get("bounces", 1) != 1:
        told.append((f"{metrics['bounces']} bounces", "", ""))
    if metrics.get("prior", "extra-bounce") != "extra-bounce":
        told.append((f"{metrics['prior']} prior".replace("-", " "), "", ""))
    passes = {"all-pairs": "all pairs", "split-halves": "split halves", "two-pass": "two passes"}
    return [*told, (passes.get(estimator, estimator), "", "")]


def _form(name: object) -> str | None:
    """What a representation is called on the page; the name of one that is not registered."""
    if not isinstance(name, str):
        return None
    return representation(name).title if name in representations() else name


def optimized(runs: list[EvaluatedRun]) -> str:
    """What the runs optimized, for the title."""
    kinds = {_unknown(run.metrics) for run in runs}
    if len(kinds) == 1:
        return OPTIMIZED.get(kinds.pop(), "Scene")
    return "Materials and lighting" if any("materials" in k for k in kinds) else "Lighting"


def _unknown(metrics: dict[str, Any]) -> str:
    return str(metrics.get("unknown", "materials"))


def materials(runs: list[EvaluatedRun]) -> list[str]:
    """Quantities of materials that some run optimized."""
    return [name for name in QUANTITIES if any(run.optimizes(name) for run in runs)]


def words(names: Sequence[str], displayed: str | None = None) -> list[str]:
    """Quantities in a sentence: all, or those that are displayed so."""
    rows = [QUANTITIES[name] for name in names]
    return [row.title.lower() for row in rows if displayed in (None, row.display)]


def listed(names: Sequence[str]) -> str:
    """Words as a sentence lists them."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))
