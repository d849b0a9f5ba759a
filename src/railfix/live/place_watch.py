"""Place of the track against the positions of a live session."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from railfix.core.errors import MismatchError
from railfix.live.engine import LiveOutput
from railfix.run.checks import ENOUGH_TO_STOP, check_same_place
from railfix.run.tally import AntennaTally, Tally


class PlaceWatch:
    """Compare 3-D positions with the line until enough were seen, and report once that it lies elsewhere.

    `say` takes the sentence with which `railfix run` ends there.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._tally = Tally(min_satellites=3)
        self._done = False

    def take(self, output: LiveOutput) -> None:
        """Take an output of the engine."""
        if self._done or output.result is None:
            return
        for name, antenna in output.result.antennas.items():
            counts = self._tally.antennas.setdefault(name, AntennaTally())
            offset_m = antenna.conventional_offset_m[-1]
            if np.isfinite(offset_m):
                counts.conventional += 1
                counts.conventional_nearest_m = float(np.fmin(counts.conventional_nearest_m, offset_m))
        if any(counts.conventional >= ENOUGH_TO_STOP for counts in self._tally.antennas.values()):
            self._done = True
            try:
                check_same_place(self._tally)
            except MismatchError as error:
                self._say(str(error))
