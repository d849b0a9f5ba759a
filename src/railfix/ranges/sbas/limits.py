"""What may be chosen about SBAS, and the time-outs of DO-229D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

#: Seconds since reception for which a message may be used, (precision approach, en route to
#: non-precision approach) (DO-229D, table A-25). Fast corrections have `FAST_TIMEOUT_S`.
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
#: The same for fast corrections by degradation indicator ai (DO-229D, table A-8).
FAST_TIMEOUT_S: Final[dict[str, tuple[float, ...]]] = {
    "precision": (120, 120, 102, 90, 90, 78, 66, 54, 42, 30, 30, 18, 18, 18, 12, 12),
    "en_route": (180, 180, 153, 135, 135, 117, 99, 81, 63, 45, 45, 27, 27, 27, 18, 18),
}
#: Acceleration of the error of a fast correction by ai [m/s^2] (DO-229D, table A-8).
FAST_DEGRADATION_MPS2: Final = (
    0.0, 0.00005, 0.00009, 0.00012, 0.00015, 0.00020, 0.00030, 0.00045,
    0.00060, 0.00090, 0.00150, 0.00210, 0.00270, 0.00330, 0.00460, 0.00580,
)  # fmt: skip
#: Variance of fast and long-term corrections by UDREI [m^2]; 14 and 15 have none (DO-229D, table A-6).
UDRE_VARIANCE_M2: Final = (
    0.0520, 0.0924, 0.1444, 0.2830, 0.4678, 0.8315, 1.2992, 1.8709,
    2.5465, 3.3260, 5.1968, 20.7870, 230.9661, 2078.695,
)  # fmt: skip
#: Variance of a grid point's delay by GIVEI [m^2]; 15 has none (DO-229D, table A-17).
GIVE_VARIANCE_M2: Final = (
    0.0084, 0.0333, 0.0749, 0.1331, 0.2079, 0.2994, 0.4075, 0.5322,
    0.6735, 0.8315, 1.1974, 1.8709, 3.3260, 20.7870, 187.0826,
)  # fmt: skip
#: Factor on sigma UDRE by indicator of message type 27 (DO-229D, table A-20).
SERVICE_FACTOR: Final = (1.0, 1.1, 1.25, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 20.0, 30.0, 40.0, 50.0, 100.0)
#: UDREI from which a satellite is not monitored, and must not be used.
NOT_MONITORED: Final = 14
DO_NOT_USE: Final = 15
#: A message of type 0 stops the use of its sender for so long [s] (DO-229D, A.4.4.1).
STOP_S: Final = 60.0
#: Added to sigma UDRE where degradation data are missing [m] (DO-229D, J.2.2).
INFLATION_M: Final = 8.0


@dataclass(frozen=True, kw_only=True)
class SbasLimits:
    """How SBAS messages are used.

    Attributes
    ----------
    mode : {"precision", "en_route"}
        Whose time-outs hold: precision approach (shorter, the default), or en route to
        non-precision approach.
    type0 : {"stop", "as_type2"}
        Message type 0 throws away what its sender has said and stops its use for 60 s (default),
        or, as systems under test send it, holds fast corrections of type 2 unless it is empty.
    range_rate : {"mops", "off"}
        Fast corrections grow with the rate that two of them give (default; DO-229D, A.4.4.3), or
        stay as sent.
    incomplete : {"refuse", "inflate"}
        A satellite whose degradation data (types 7, 10, and 28 where it is sent) are missing gets
        no sigma and is refused (default: precision approach), or has sigma UDRE plus 8 m
        (DO-229D, J.2.2), and the shortest time-out of fast corrections.
    max_udrei : int or None
        Largest UDREI used; None is 11 for precision approach and 13 en route.
    message_s : float
        From the first bit of a message, to which its corrections refer, to its reception [s].
    """

    mode: Literal["precision", "en_route"] = "precision"
    type0: Literal["stop", "as_type2"] = "stop"
    range_rate: Literal["mops", "off"] = "mops"
    incomplete: Literal["refuse", "inflate"] = "refuse"
    max_udrei: int | None = None
    message_s: float = 1.0

    def __post_init__(self) -> None:
        words = {
            "mode": ("precision", "en_route"),
            "type0": ("stop", "as_type2"),
            "range_rate": ("mops", "off"),
            "incomplete": ("refuse", "inflate"),
        }
        for name, allowed in words.items():
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} is {getattr(self, name)!r}, one of {', '.join(allowed)} was expected")
        if self.max_udrei is not None and not 0 <= self.max_udrei <= 13:
            raise ValueError(f"max_udrei is {self.max_udrei}, 0 to 13 was expected")
        if not 0.0 <= self.message_s <= 2.0:
            raise ValueError(f"message_s is {self.message_s}, 0 to 2 s was expected")

    def timeout_s(self, what: str) -> float:
        """Time-out of a kind of message in this mode [s]."""
        return TIMEOUT_S[what][0 if self.mode == "precision" else 1]

    @property
    def largest_udrei(self) -> int:
        """Largest UDREI used."""
        if self.max_udrei is not None:
            return self.max_udrei
        return 11 if self.mode == "precision" else 13
