"""How far behind its receivers a live session is, and which epochs it skips to come back to the present."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

#: Largest drift of the computer's clock against the receivers' time; the shortest delay is forgotten at this rate.
DRIFT: Final = 1e-4
#: A delay that stays the same, to within `STEADY_S`, for this time and number of skipped epochs is one of the tags, not
#: of the session: that of a session becomes shorter, and longer where the computer is too busy even to skip [s].
ADMITTED_S: Final = 2.0
STEADY_S: Final = 0.2
STEADY_EPOCHS: Final = 5


@dataclass(kw_only=True)
class Lag:
    """Delay of epochs above the shortest one seen, so that the clocks need not agree."""

    behind_s: float  #: With more delay epochs are skipped until it is a quarter of that; infinite: never.
    skipped: int = 0  #: Epochs skipped since the session fell behind.
    told: list[str] = field(default_factory=list)  #: What is to be said of it.
    _shortest_ns: float | None = None
    _at_ns: int = 0
    _since_ns: int = 0
    _steady_s: float = 0.0
    _steady: int = 0

    def reset(self) -> None:
        """Forget the shortest delay: the tags have another origin."""
        self._shortest_ns, self.skipped = None, 0

    def skips(self, tag_ns: int, now_ns: int) -> bool:
        """Whether an epoch that is taken now is too old to be processed."""
        delay_ns = now_ns - tag_ns
        shortest = float(delay_ns) if self._shortest_ns is None else self._shortest_ns
        shortest = min(float(delay_ns), shortest + DRIFT * (now_ns - self._at_ns))
        self._shortest_ns, self._at_ns = shortest, now_ns
        lag_s = (delay_ns - shortest) * 1e-9
        if self.skipped == 0:
            if lag_s <= self.behind_s:
                return False
            self.told.append(f"{lag_s:.1f} s behind the receivers: epochs are skipped up to the present")
            self._steady = 0
        elif lag_s <= 0.25 * self.behind_s:
            self.told.append(f"at the present again, {self.skipped} epochs were skipped")
            self.skipped = 0
            return False
        if self._steady == 0 or abs(lag_s - self._steady_s) > STEADY_S:
            self._since_ns, self._steady_s, self._steady = now_ns, lag_s, 0
        elif self._steady >= STEADY_EPOCHS and (now_ns - self._since_ns) * 1e-9 > ADMITTED_S:
            self.told.append(
                f"the receivers' time is {lag_s:.1f} s later than before; {self.skipped} epochs were skipped"
            )
            self.reset()
            return False
        self._steady += 1
        self.skipped += 1
        return True
