"""The paper's tables and figures, one module each. The rest of the library does not use them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from .experiment import Experiment

Name = Literal["table1", "table2", "fig3", "fig4", "fig5", "fig6", "fig7", "fig8"]

Scale = Literal["smoke", "cpu", "paper"]


def load(name: Name) -> Experiment:
    """The experiment of this name; a backend must be active."""
    from . import fig3, fig4, fig5, fig6, fig7, fig8, table1, table2

    modules = (table1, table2, fig3, fig4, fig5, fig6, fig7, fig8)
    known = {module.EXPERIMENT.name: module.EXPERIMENT for module in modules}
    return known[name]
