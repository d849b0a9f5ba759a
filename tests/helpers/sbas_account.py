"""Counts of all SBAS messages of a log, by type and name."""

from __future__ import annotations

from collections import Counter
from typing import Final

from railfix.ranges.sbas import SbasMessages
from railfix.ranges.sbas.standard import system_name

#: Types decoded into corrections or into records.
DECODED: Final = {
    "L1": (0, 1, 2, 3, 4, 5, 6, 7, 10, 12, 18, 24, 25, 26, 27, 28),
    "L5": (0, 31, 32, 34, 35, 36, 37, 39, 40, 47),
}

#: Message types of L1 (DO-229D, table A-3).
TYPE_NAMES: Final = {
    0: "do not use for safety", 1: "PRN mask", 2: "fast corrections", 3: "fast corrections", 4: "fast corrections",
    5: "fast corrections", 6: "integrity", 7: "fast correction degradation", 9: "GEO navigation",
    10: "degradation parameters", 12: "network time", 17: "GEO almanacs", 18: "ionospheric grid mask",
    24: "mixed fast and long-term corrections", 25: "long-term corrections", 26: "ionospheric delays",
    27: "service region", 28: "clock-ephemeris covariance", 62: "internal test", 63: "null",
}  # fmt: skip
#: Message types of L5 (ICAO Annex 10, 8th edition, appendix B, 3.5.14).
L5_TYPE_NAMES: Final = {
    0: "do not use for safety",
    31: "satellite mask",
    32: "orbit, clock and covariance",
    34: "integrity, changes",
    35: "integrity, first 53 satellites",
    36: "integrity, the others",
    37: "degradation and scale",
    39: "orbit of the SBAS satellite",
    40: "orbit of the SBAS satellite, second part",
    42: "network time, whose layout is not public",
    47: "SBAS almanacs",
    62: "internal test",
    63: "null",
}
#: Types that QZSS sends beside those of SBAS: L1-SAIF (IS-QZSS), and L1S, which took its place
#: (IS-QZSS-L1S, IS-QZSS-DCR).
QZSS_TYPE_NAMES: Final = {
    43: "L1S disaster report of the Japan Meteorological Agency",
    44: "L1S disaster report of other organisations",
    47: "L1S monitoring stations",
    48: "L1S PRN mask",
    49: "L1S data issue number",
    50: "L1S code corrections",
    51: "L1S satellite health",
    52: "L1-SAIF tropospheric grid mask",
    53: "L1-SAIF tropospheric delays",
    56: "L1-SAIF inter-signal biases",
    58: "L1-SAIF QZS ephemeris",
}


def type_name(number: int, prn: int, band: str = "L1") -> str:
    """Name of a message type as sent by a PRN; "reserved" for a number without meaning."""
    if band == "L5":
        return L5_TYPE_NAMES.get(number, "reserved")
    if prn >= 183 and number in QZSS_TYPE_NAMES:
        return QZSS_TYPE_NAMES[number]
    return TYPE_NAMES.get(number, "reserved")


def account(log: SbasMessages) -> dict[str, int]:
    """Counts of all messages: decoded by type, not decoded by type and name, or rejected by reason.

    "MSAS 137 type 2 fast corrections": 600, "MSAS 137 type 63 null, not decoded": 569, "rejected: parity": 0 ... The
    values sum to the messages of the files.
    """
    counts = Counter(zip(log.prn.tolist(), log.type.tolist(), strict=True))
    rows = {
        f"{system_name(prn)} {prn} type {kind} {type_name(kind, prn, log.band)}"
        + ("" if kind in DECODED[log.band] else ", not decoded"): number
        for (prn, kind), number in sorted(counts.items())
    }
    return rows | {f"rejected: {reason}": number for reason, number in sorted(log.rejected.items())}
