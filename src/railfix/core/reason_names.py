"""Names of rejection reasons, and registration of the reasons of user-defined screens."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Integers
from railfix.core.reasons import Reason

_ADDED: dict[str, Reason] = {}  #: Reasons of user-defined screens, by lower-case name.

#: Lowest bit that no reason of `Reason` uses.
_FIRST_FREE_BIT: Final = 23
#: Highest bit that the column of reasons (32-bit integers) can store.
_LAST_BIT: Final = 30


def screen_reason(name: str) -> Reason:
    """Return the rejection reason of a screen, given the lower-case name of the reason.

    A name that `Reason` lacks is assigned the next free bit; raise ValueError if no bit is left.
    """
    if name.upper() in Reason.__members__:
        return Reason[name.upper()]
    if name not in _ADDED:
        bit = _FIRST_FREE_BIT + len(_ADDED)
        if bit > _LAST_BIT:
            raise ValueError(f"no bit is left for the reason {name}: all {_LAST_BIT - _FIRST_FREE_BIT + 1} are in use")
        _ADDED[name] = Reason(1 << bit)
    return _ADDED[name]


def reason_names() -> dict[int, str]:
    """Return the lower-case names of all reasons by bit, in ascending order of the bits, without `USED`."""
    members = {int(bit): name.lower() for name, bit in Reason.__members__.items() if bit}
    return members | {int(bit): name for name, bit in _ADDED.items()}


def reason_text(reason: int) -> str:
    """Return the names of the bits of a reason, joined by ``+``; ``used`` for 0.

    >>> reason_text(Reason.UNHEALTHY | Reason.ELEVATION_MASK)
    'unhealthy+elevation_mask'
    """
    if reason == 0:
        return "used"
    return "+".join(name for bit, name in reason_names().items() if bit & reason)


def first_reason(reasons: ArrayLike) -> Integers:
    """Return the lowest set bit of each reason, which is the first reason for rejection; 0 for a used observation."""
    value = np.asarray(reasons, dtype=np.int64)
    return value & -value
