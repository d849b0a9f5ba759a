"""What SBAS numbers mean: systems, message types, satellites of the PRN mask."""

from __future__ import annotations

from typing import Final

#: Types decoded into corrections or into records.
DECODED: Final = (0, 1, 2, 3, 4, 5, 6, 7, 9, 10, 12, 17, 18, 24, 25, 26, 27, 28)

#: Message types of L1 (DO-229D, table A-3).
TYPE_NAMES: Final = {
    0: "do not use for safety",
    1: "PRN mask",
    2: "fast corrections",
    3: "fast corrections",
    4: "fast corrections",
    5: "fast corrections",
    6: "integrity",
    7: "fast correction degradation",
    9: "GEO navigation",
    10: "degradation parameters",
    12: "network time",
    17: "GEO almanacs",
    18: "ionospheric grid mask",
    24: "mixed fast and long-term corrections",
    25: "long-term corrections",
    26: "ionospheric delays",
    27: "service region",
    28: "clock-ephemeris covariance",
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
#: Systems by PRN, as assigned (WAAS gave 134 to KASS, 122 to SouthPAN).
_SYSTEMS: Final = {
    "EGNOS": (120, 121, 123, 124, 126, 136),
    "WAAS": (131, 133, 135, 138),
    "MSAS": (129, 137),
    "GAGAN": (127, 128, 132),
    "SDCM": (125, 140, 141),
    "BDSBAS": (130, 143, 144),
    "KASS": (134,),
    "SouthPAN": (122,),
    "ASECNA": (147,),
    "QZSS L1S": tuple(range(183, 192)),
}
_SYSTEM_OF: Final = {prn: name for name, prns in _SYSTEMS.items() for prn in prns}

#: PRNs that can send these messages: SBAS, and QZSS L1-SAIF or L1S.
GEO_PRNS: Final = (*range(120, 159), *range(183, 203))


def system_name(prn: int) -> str:
    """Name of the system that a PRN belongs to ("MSAS"); "SBAS" where it is not assigned."""
    return _SYSTEM_OF.get(prn, "SBAS")


def type_name(number: int, prn: int) -> str:
    """Name of a message type as sent by a PRN; "reserved" for a number without meaning."""
    if prn >= 183 and number in QZSS_TYPE_NAMES:
        return QZSS_TYPE_NAMES[number]
    return TYPE_NAMES.get(number, "reserved")


def mask_satellite(number: int) -> str:
    """Satellite of a number of the PRN mask (DO-229D, table A-1); empty for numbers without one.

    183 to 202 are QZSS as in IS-QZSS for L1-SAIF; DO-229D leaves them to the future.
    """
    if 1 <= number <= 37:
        return f"G{number:02d}"
    if 38 <= number <= 61:
        return f"R{number - 37:02d}"
    if 120 <= number <= 138:
        return f"S{number - 100:02d}"
    if 193 <= number <= 202:
        return f"J{number - 192:02d}"
    return ""
