"""What the viewer needs beside the other packages; needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

import importlib.util

from ..errors import UserError


def require_viser() -> None:
    """Check that viser is installed.

    Raises:
        UserError: it is not.
    """
    try:
        found = importlib.util.find_spec("viser")
    except ValueError:  # a stand-in without a specification
        found = None
    if found is None:
        raise UserError("the viewer needs viser", remedy="pip install 'unbake[view]'")
