"""Settings of the use of SBAS messages, and the time-outs of RTCA DO-229D that they select."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import Field

from railfix.core.settings import Settings

#: Time-outs after reception [s]: first for precision approach, then for phases from en route to non-precision approach
#: (DO-229D, table A-25). Time-outs of fast corrections are in `FAST_TIMEOUT_S`.
TIMEOUT_S: Final[dict[str, tuple[float, float]]] = {
    "mask": (600.0, 600.0),
    "udrei": (12.0, 18.0),
    "long_term": (240.0, 360.0),
    "fast_degradation": (240.0, 360.0),
    "degradation": (240.0, 360.0),
    "grid_mask": (1200.0, 1200.0),
    "grid_delay": (600.0, 600.0),
    "service": (86_400.0, 86_400.0),
    "covariance": (240.0, 360.0),
}


class SbasLimits(Settings):
    """Settings of the use of SBAS messages."""

    #: Time-outs for precision approach (shorter), or for the phases from en route to non-precision approach.
    mode: Literal["precision", "en_route"] = "precision"
    type0: Literal["stop", "as_type2"] = "stop"  #: Type 0 stops the use of the GEO for 60 s, or is read as type 2.
    range_rate: Literal["mops", "off"] = "mops"  #: "off" omits range rates (DO-229D, A.4.4.3).
    #: Satellites without degradation data are rejected, or used with the shortest time-out and a sigma increased by 8 m
    #: (DO-229D, J.2.2).
    incomplete: Literal["reject", "inflate"] = "reject"
    #: Satellites with a larger UDREI are rejected; None means 11 in mode "precision" and 13 in mode "en_route".
    max_udrei: int | None = Field(default=None, ge=0, le=13)
    #: Time from the first bit of a message to the end of reception.
    message_s: float = Field(default=1.0, ge=0.0, le=2.0)

    def timeout_s(self, kind: str) -> float:
        """Return the time-out of a kind of message in this mode [s]."""
        return TIMEOUT_S[kind][0 if self.mode == "precision" else 1]

    @property
    def largest_udrei(self) -> int:
        """Largest UDREI used."""
        if self.max_udrei is not None:
            return self.max_udrei
        return 11 if self.mode == "precision" else 13
