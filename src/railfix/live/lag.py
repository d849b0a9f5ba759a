"""How far behind its receivers a live session is, and which epochs it skips to come back to the present."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

#: Largest drift of the computer's clock against the receivers' time; the shortest delay is forgotten at this rate.
DRIFT: Final = 1e-4
#: A delay that has not become shorter after skipping for this time is one of the tags, not of the session [s].
ADMITTED_S: Final = 1.0


@dataclass(kw_only=True)
class Lag:
    """Delay of epochs above the shortest one seen, so that the clocks need not agree.

    Attributes
    ----------
    behind_s : float [s]
        With more delay epochs are skipped until it is a quarter of that; infinite: never.
    skipped : int
        Epochs skipped since the session fell behind.
    told : list of str
        What is to be said of it.
    """

    behind_s: float
    skipped: int = 0
    told: list[str] = field(default_factory=list)
    _shortest_ns: float | None = None
    _at_ns: int = 0
    _since_ns: int = 0
    _first_s: float = 0.0

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
            self._since_ns, self._first_s = now_ns, lag_s
        elif lag_s <= 0.25 * self.behind_s:
            self.told.append(f"at the present again, {self.skipped} epochs were skipped")
            self.skipped = 0
            return False
        elif (now_ns - self._since_ns) * 1e-9 > ADMITTED_S and lag_s > 0.9 * self._first_s:
            self.told.append(
                f"the receivers' time is {lag_s:.1f} s later than before; {self.skipped} epochs were skipped"
            )
            self.reset()
            return False
        self.skipped += 1
        return True
