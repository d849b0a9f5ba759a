"""Assignment of RINEX observation types to signals and kinds of observable.

RINEX 3 and 4 name the signal themselves ("C1C" is the code of "1C"). RINEX 2 names it by band, and
the phase of a band may have come with either of two codes; the signals used are (RINEX 2.11,
table A1; RINEX 3.05, tables 4 to 11):

======= ===== ===== ===== ===== ===== ===== ===== ===== =====
type    GPS   GLO   GAL   BDS   QZSS  SBAS  IRNSS
======= ===== ===== ===== ===== ===== ===== ===== ===== =====
C1      1C    1C    1X    2I    1C    1C    --
P1      1W    1P    --    2I    --    --    --
C2      2X    2C    --    2I    2X    --    --
P2      2W    2P    --    2I    --    --    --
C5      5X    --    5X    5X    5X    5X    5A
C6      --    --    6X    6I    6X    --    --
C7      --    --    7X    7I    --    --    --
C8      --    --    8X    8X    --    --    --
C9      --    --    --    --    --    --    9A
CA CB   1C 1X 1C -- -- --  -- --  1C 1X 1C -- -- --           (RINEX 2.12)
CC CD   2X -- -- 2C -- --  -- --  2X --  -- -- -- --          (RINEX 2.12)
======= ===== ===== ===== ===== ===== ===== ===== ===== =====

L1, D1 and S1 belong to C1's signal where C1 is declared, else to P1's; L2, D2 and S2 to P2's
where P2 is declared (the carrier then comes from the P code or is codeless), else to C2's; where
no code of the band is declared, to those of C1 and P2. BeiDou of RINEX 3.02 calls B1I band 1 ("C1I"):
it is read as "2I", as are 1I and 1Q of any version, which have no other meaning.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

#: Constellation letters of RINEX.
SYSTEMS: Final = "CEGIJRS"
#: Types of observable, in the order of the arrays: code, phase, Doppler, carrier-to-noise density.
KINDS: Final = "CLDS"

#: Signal of a RINEX 2 code by constellation.
_CODES_2: Final[dict[str, dict[str, str]]] = {
    "G": {"C1": "1C", "P1": "1W", "C2": "2X", "P2": "2W", "C5": "5X", "CA": "1C", "CB": "1X", "CC": "2X"},
    "R": {"C1": "1C", "P1": "1P", "C2": "2C", "P2": "2P", "CA": "1C", "CD": "2C"},
    "E": {"C1": "1X", "C5": "5X", "C6": "6X", "C7": "7X", "C8": "8X"},
    "C": {"C1": "2I", "P1": "2I", "C2": "2I", "P2": "2I", "C5": "5X", "C6": "6I", "C7": "7I", "C8": "8X"},
    "J": {"C1": "1C", "C2": "2X", "C5": "5X", "C6": "6X", "CA": "1C", "CB": "1X", "CC": "2X"},
    "S": {"C1": "1C", "C5": "5X", "CA": "1C"},
    "I": {"C5": "5A", "C9": "9A"},
}
#: Codes that a RINEX 2 phase, Doppler or C/N0 may belong to; the first declared one is used.
_OWNERS_2: Final[dict[str, tuple[str, ...]]] = {"1": ("C1", "P1"), "2": ("P2", "C2")}


@dataclass(frozen=True)
class SignalColumn:
    """Column of an observation type in the satellite lines of a constellation.

    Position among the declared types, type as declared ("C1C" or "P2"), position in `KINDS`, signal ("1C"), and divisor
    of the written value.
    """

    index: int
    name: str
    kind: int
    signal: str
    divisor: float


def signal_of(name: str, *, system: str, version: float, declared: Sequence[str]) -> str | None:
    """Return the signal of an observation type; None for types of no signal (X1, T1, I1).

    The type is "C1C" (RINEX 3, 4) or "P2" (RINEX 2); `declared` are all types of the header for the constellation.
    """
    if version >= 3.0:
        if name[0] not in KINDS:
            return None
        signal = name[1:].strip()
        if system == "C" and (signal in ("1I", "1Q") or (signal == "1X" and round(version, 2) == 3.02)):
            return "2" + signal[1:]
        return signal
    kind, band = name[0], name[1]
    codes = _CODES_2.get(system, {})
    if kind in "CP":
        return codes.get(name)
    if kind not in KINDS:
        return None
    for owner in _OWNERS_2.get(band, ()):
        if owner in declared and owner in codes:
            return codes[owner]
    return codes.get(_OWNERS_2.get(band, ("C" + band,))[0])


def columns_of(
    declared: Sequence[str], *, system: str, version: float, scale: Mapping[tuple[str, str], float]
) -> tuple[SignalColumn, ...]:
    """Return the columns of a constellation; of two types with the same meaning the first."""
    columns: dict[tuple[int, str], SignalColumn] = {}
    for index, name in enumerate(declared):
        signal = signal_of(name, system=system, version=version, declared=declared)
        if signal is None:
            continue
        kind = KINDS.index("C" if version < 3.0 and name[0] == "P" else name[0])
        divisor = scale.get((system, name), 1.0)
        columns.setdefault((kind, signal), SignalColumn(index, name, kind, signal, divisor))
    return tuple(columns.values())
