"""How far path tracing is, and how long it will take, where that is long."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import final

from ..progress import Paced, duration

#: Seconds beyond which it is told how all pictures would take less time.
LONG = 600.0
#: Seconds of rendering that tell how long the rest will take.
_TELLING = 5.0


@final
class Forecast:
    """Tells every few seconds how far the rendering of a picture is.

    Args:
        samples: camera samples of all pictures.
        tell: called with lines of progress.
    """

    def __init__(self, samples: float, tell: Callable[[str], None]) -> None:
        self._later, self._tell = samples, tell
        # Of parts of pictures, but for the very first one, for which kernels are compiled.
        self._seconds, self._rendered = 0.0, 0.0
        self._compiled = self._warned = False

    def begin(self, name: str, samples: float) -> Callable[[float], None]:
        """Begin a picture.

        Args:
            name: of the picture.
            samples: its camera samples.

        Returns:
            What to call with the share of the picture that is done, in (0, 1], after each part.
        """
        self._later -= samples
        paced, before, since = Paced(self._tell), 0.0, time.monotonic()

        def done(share: float) -> None:
            nonlocal before, since
            now = time.monotonic()
            if self._compiled:
                self._seconds += now - since
                self._rendered += (share - before) * samples
            self._compiled, before, since = True, share, now
            if share >= 1 or not paced.is_due:
                return
            line = f"{name}: {100 * share:.0f} % rendered"
            if self._seconds < _TELLING:
                paced.now(line)
                return
            each = self._seconds / self._rendered
            paced.now(f"{line}, about {duration(each * (1 - share) * samples)} left")
            self._warn(each * ((1 - share) * samples + self._later))

        return done

    def _warn(self, left: float) -> None:
        """Tell once what would help, where all that is left takes long."""
        if not self._warned and left > LONG:
            self._warned = True
            what = f"all pictures take about {duration(left)} more"
            self._tell(f"{what}: a smaller --spp makes that shorter")
