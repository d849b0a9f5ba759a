"""Decode navigation messages: GPS and QZSS LNAV and CNAV, Galileo I/NAV and F/NAV, BeiDou D1, D2, B-CNAV1 and
B-CNAV2, and GLONASS.

All messages of one kind are converted together, from bits to arrays of scaled fields. Angles are in radians.

Sources: IS-GPS-200N, 20.3.3 and 30.3.3; IS-QZSS-PNT-005, 4.1.2 and 4.3.2; Galileo OS SIS ICD 2.1, 4.2.3 and 4.3.5;
BDS-SIS-ICD-B1I 3.0, 5.2 and 5.3; BDS-SIS-ICD-B1C 1.0, 6.2 and B2a 1.0, 6.2 and 7 (as read by cssrlib 1.2.1); GLONASS
ICD L1, L2 5.1, 4.4.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Floats, Integers, Masks
from railfix.core.checksums import crc24q
from railfix.io.receiver.framing import BCNAV1_PAGE, Field, Subframes, fields, read_unsigned, unpack_words

_PI: Final = np.pi
Coding = tuple[int, float, str]  #: Number of bits, scale factor and coding ("u", "s", "m") of a field, as in `Field`.
Values = Mapping[str, float]  #: Fields of a message by name.
Place = int | tuple[tuple[int, int], ...]


def layout(codings: Mapping[str, Coding], **places: Place) -> dict[str, Field]:
    """Return the layout of a message. `places` has the first bit, or the pieces, of each field."""
    return {name: (place, *codings[name]) for name, place in places.items()}


def _with_head(head: dict[str, Field], kinds: dict[int, dict[str, Field]]) -> dict[int, dict[str, Field]]:
    """Return the layout of each kind of message, with the common fields `head` added."""
    return {kind: head | fields for kind, fields in kinds.items()}


def _flags(**lengths: int) -> dict[str, Coding]:
    """Return the codings of unsigned integers, whose scale factor is 1."""
    return {name: (length, 1.0, "u") for name, length in lengths.items()}


def _klobuchar(first: int) -> dict[str, Field]:
    """Return the layout of the eight Klobuchar parameters, which have eight bits each and begin at bit `first`."""
    factors = (2.0**-30, 2.0**-27, 2.0**-24, 2.0**-24, 2.0**11, 2.0**14, 2.0**16, 2.0**16)
    return {f"ion{k}": (first + 8 * k, 8, factor, "s") for k, factor in enumerate(factors)}


_ANGLE: Final[Coding] = (32, 2.0**-31 * _PI, "s")
#: Codings of orbit parameters in all messages except CNAV, B-CNAV1 and B-CNAV2.
_ORBIT: Final[dict[str, Coding]] = {
    **dict.fromkeys(("m0", "omega0", "i0", "omega"), _ANGLE),
    "delta_n": (16, 2.0**-43 * _PI, "s"),
    "omega_dot": (24, 2.0**-43 * _PI, "s"),
    "i_dot": (14, 2.0**-43 * _PI, "s"),
    "eccentricity": (32, 2.0**-33, "u"),
    "sqrt_a": (32, 2.0**-19, "u"),
}
_HARMONICS: Final[dict[str, Coding]] = {
    **dict.fromkeys(("cuc", "cus", "cic", "cis"), (16, 2.0**-29, "s")),
    **dict.fromkeys(("crc", "crs"), (16, 2.0**-5, "s")),
}
LNAV_CODINGS: Final[dict[str, Coding]] = {
    **_ORBIT,
    **_HARMONICS,
    **_flags(number=6, subframe=3, week=10, accuracy=4, health=6, iodc=10, codes=2, flag=1, iode=8, fit=1),
    **_flags(data_id=2, page_sv=6),
    "tow_s": (17, 6.0, "u"),
    "group_delay_1_s": (8, 2.0**-31, "s"),
    **dict.fromkeys(("toc_s", "toe_sow_s"), (16, 16.0, "u")),
    "af2": (8, 2.0**-55, "s"),
    "af1": (16, 2.0**-43, "s"),
    "af0_s": (22, 2.0**-31, "s"),
    "leap_seconds": (8, 1.0, "s"),
}
#: Layout of the fields that all LNAV subframes have. Subframes are decoded without parity, as 10 words of 24 bits.
LNAV_HEAD: Final = layout(LNAV_CODINGS, tow_s=24, subframe=43)
LNAV: Final = _with_head(LNAV_HEAD, {
    1: layout(LNAV_CODINGS, week=48, accuracy=60, health=64, iodc=((70, 2), (168, 8)), group_delay_1_s=160, toc_s=176,
              af2=192, af1=200, af0_s=216, codes=58, flag=72),
    2: layout(LNAV_CODINGS, iode=48, crs=56, delta_n=72, m0=88, cuc=120, eccentricity=136, cus=168, sqrt_a=184,
              toe_sow_s=216, fit=232),
    3: layout(LNAV_CODINGS, cic=48, omega0=64, cis=96, i0=112, crc=144, omega=160, omega_dot=192, iode=216, i_dot=224),
    4: layout(LNAV_CODINGS, data_id=48, page_sv=50, leap_seconds=192) | _klobuchar(56),
})  # fmt: skip
GALILEO_CODINGS: Final[dict[str, Coding]] = {
    **_ORBIT,
    **_HARMONICS,
    **_flags(number=6, iod=10, accuracy=8, week=12, tow_s=20),
    **_flags(e5a_health=2, e5b_health=2, e1b_health=2, e5a_invalid=1, e5b_invalid=1, e1b_invalid=1),
    **dict.fromkeys(("toc_s", "toe_sow_s"), (14, 60.0, "u")),
    **dict.fromkeys(("group_delay_1_s", "group_delay_2_s"), (10, 2.0**-32, "s")),
    "af0_s": (31, 2.0**-34, "s"),
    "af1": (21, 2.0**-46, "s"),
    "af2": (6, 2.0**-59, "s"),
}
#: Layout of each type of Galileo I/NAV word (128 bits).
INAV: Final = {
    1: layout(GALILEO_CODINGS, iod=6, toe_sow_s=16, m0=30, eccentricity=62, sqrt_a=94),
    2: layout(GALILEO_CODINGS, iod=6, omega0=16, i0=48, omega=80, i_dot=112),
    3: layout(GALILEO_CODINGS, iod=6, omega_dot=16, delta_n=40, cuc=56, cus=72, crc=88, crs=104, accuracy=120),
    4: layout(GALILEO_CODINGS, iod=6, number=16, cic=22, cis=38, toc_s=54, af0_s=68, af1=99, af2=120),
    5: layout(GALILEO_CODINGS, group_delay_1_s=47, group_delay_2_s=57, e5b_health=67, e1b_health=69, e5b_invalid=71,
              e1b_invalid=72, week=73, tow_s=85),
    6: layout(GALILEO_CODINGS, tow_s=105),
}  # fmt: skip
#: Layout of each type of Galileo F/NAV page (244 bits).
FNAV: Final = {
    1: layout(GALILEO_CODINGS, number=6, iod=12, toc_s=22, af0_s=36, af1=67, af2=88, accuracy=94, group_delay_1_s=143,
              e5a_health=153, week=155, tow_s=167, e5a_invalid=187),
    2: layout(GALILEO_CODINGS, iod=6, m0=16, omega_dot=48, eccentricity=72, sqrt_a=104, omega0=136, i_dot=168),
    3: layout(GALILEO_CODINGS, iod=6, i0=16, omega=48, delta_n=80, cuc=96, cus=112, crc=128, crs=144, toe_sow_s=160),
    4: layout(GALILEO_CODINGS, iod=6, cic=16, cis=32),
}  # fmt: skip
_CNAV_ORBIT: Final[dict[str, Coding]] = {
    **dict.fromkeys(("m0", "omega0", "i0", "omega"), (33, 2.0**-32 * _PI, "s")),
    "eccentricity": (33, 2.0**-34, "u"),
    "delta_a": (26, 2.0**-9, "s"),
    "a_dot": (25, 2.0**-21, "s"),
    **dict.fromkeys(("delta_n", "delta_omega_dot"), (17, 2.0**-44 * _PI, "s")),
    "delta_n_dot": (23, 2.0**-57 * _PI, "s"),
    "omega_dot": (19, 2.0**-44 * _PI, "s"),
    "i_dot": (15, 2.0**-44 * _PI, "s"),
    **dict.fromkeys(("cis", "cic"), (16, 2.0**-30, "s")),
    **dict.fromkeys(("crs", "crc"), (24, 2.0**-8, "s")),
    **dict.fromkeys(("cus", "cuc"), (21, 2.0**-30, "s")),
    **dict.fromkeys(("top", "toe_sow_s", "toc_s"), (11, 300.0, "u")),
}
_CNAV_CODINGS: Final[dict[str, Coding]] = {
    **_CNAV_ORBIT,
    **_flags(number=6, type=6, week=13, health=3, ned_1=3, ned_2=3, week_top=8),
    "tow_s": (17, 6.0, "u"),
    **dict.fromkeys(("accuracy_index", "ned_0"), (5, 1.0, "s")),
    "af0_s": (26, 2.0**-35, "s"),
    "af1": (20, 2.0**-48, "s"),
    "af2": (10, 2.0**-60, "s"),
    **dict.fromkeys(("group_delay_1_s", *(f"inter_signal_{k}" for k in range(4))), (13, 2.0**-35, "s")),
}
#: Layout of the fields that all CNAV messages (300 bits) have.
CNAV_HEAD: Final = layout(_CNAV_CODINGS, number=8, type=14, tow_s=20)
CNAV: Final = _with_head(CNAV_HEAD, {
    10: layout(_CNAV_CODINGS, week=38, health=51, top=54, accuracy_index=65, toe_sow_s=70, delta_a=81, a_dot=107,
               delta_n=132, delta_n_dot=149, m0=172, eccentricity=205, omega=238),
    11: layout(_CNAV_CODINGS, toe_sow_s=38, omega0=49, i0=82, delta_omega_dot=115, i_dot=132, cis=147, cic=163,
               crs=179, crc=203, cus=227, cuc=248),
    30: layout(_CNAV_CODINGS, ned_0=49, ned_1=54, ned_2=57, toc_s=60, af0_s=71, af1=97, af2=117, group_delay_1_s=127,
               inter_signal_0=140, inter_signal_1=153, inter_signal_2=166, inter_signal_3=179, week_top=256)
    | _klobuchar(192),
})  # fmt: skip
CNAV_NO_DELAY_S: Final = -4096 * 2.0**-35  #: Value of an unavailable CNAV group delay (IS-GPS-200N, 30.3.3.3.1.1).
#: Reference semi-major axis of CNAV [m] for each constellation letter (IS-GPS-200N, table 30-I; IS-QZSS-PNT-005).
CNAV_AXIS_M: Final = {"G": 26_559_710.0, "J": 42_164_200.0}
#: Reference rate of right ascension of CNAV [rad/s] (IS-GPS-200N, table 30-I; IS-QZSS-PNT-005).
CNAV_OMEGA_DOT: Final = -2.6e-9 * _PI
_BCNAV2_CODINGS: Final[dict[str, Coding]] = {
    **_CNAV_ORBIT,
    **_flags(number=6, week=13, iode=8, kind=2, health=2, flags=3, sismai=4, iodc=10),
    "tow_s": (18, 3.0, "u"),
    "af0_s": (25, 2.0**-34, "s"),
    "af1": (22, 2.0**-50, "s"),
    "af2": (11, 2.0**-66, "s"),
    **dict.fromkeys(("group_delay_1_s", "group_delay_2_s", "inter_signal_1"), (12, 2.0**-34, "s")),
}
#: Layout of the fields that all B-CNAV2 messages (288 bits, without preamble and parity symbols) have.
BCNAV2_HEAD: Final = layout(_BCNAV2_CODINGS, number=0, tow_s=12)
BCNAV2: Final = _with_head(BCNAV2_HEAD, {
    10: layout(_BCNAV2_CODINGS, week=30, iode=53, toe_sow_s=61, kind=72, delta_a=74, a_dot=100, delta_n=125,
               delta_n_dot=142, m0=165, eccentricity=198, omega=231),
    11: layout(_BCNAV2_CODINGS, health=30, flags=32, sismai=35, omega0=42, i0=75, omega_dot=108, i_dot=127, cis=142,
               cic=158, crs=174, crc=198, cus=222, cuc=243),
    30: layout(_BCNAV2_CODINGS, toc_s=42, af0_s=53, af1=78, af2=100, iodc=111, group_delay_2_s=121, inter_signal_1=133,
               group_delay_1_s=219),
})  # fmt: skip
_BCNAV1_CODINGS: Final[dict[str, Coding]] = {
    **_BCNAV2_CODINGS,
    **_flags(page=6),
    "tow_s": (16, 18.0, "u"),
    "inter_signal_0": (12, 2.0**-34, "s"),
}
BCNAV1_WITH_HEALTH: Final = (1, 2, 3, 4)  #: Page types of B-CNAV1 subframe 3 that begin with the health status.
#: For each of the three pages into which railfix divides a B-CNAV1 frame: the subframe that has the page's data bits,
#: and the first bit and the end of these bits. In a page, the data bits follow PRN, page number and SOW.
BCNAV1_PARTS: Final = ((2, 0, 275), (2, 275, 569), (3, 0, 15))
BCNAV1_HEAD: Final = layout(_BCNAV1_CODINGS, number=0, tow_s=8)
BCNAV1: Final = _with_head(BCNAV1_HEAD, {
    0: layout(_BCNAV1_CODINGS, week=24, iodc=45, iode=55, toe_sow_s=63, kind=74, delta_a=76, a_dot=102, delta_n=127,
              delta_n_dot=144, m0=167, eccentricity=200, omega=233, omega0=266),
    1: layout(_BCNAV1_CODINGS, i0=24, omega_dot=57, i_dot=76, cis=91, cic=107, crs=123, crc=147, cus=171, cuc=192,
              toc_s=213, af0_s=224, af1=249, af2=271, group_delay_2_s=282, inter_signal_0=294, group_delay_1_s=306),
    2: layout(_BCNAV1_CODINGS, page=24, health=30, flags=32, sismai=35),
})  # fmt: skip
#: Reference semi-major axis of B-CNAV1 and B-CNAV2 [m] for each orbit type: 1 GEO, 2 IGSO, 3 MEO.
BCNAV_AXIS_M: Final = {1: 42_162_200.0, 2: 42_162_200.0, 3: 27_906_100.0}
CNAV_CHECKED, FNAV_CHECKED, BCNAV2_CHECKED = 276, 214, 264  #: Number of bits before the CRC of CNAV, F/NAV and B-CNAV2.
BEIDOU_CODINGS: Final[dict[str, Coding]] = {
    **_ORBIT,
    **_flags(number=6, tow_s=20, subframe=3, health=1, aodc=5, aode=5, accuracy=4, week=13, toe_high=2, toe_low=15),
    **dict.fromkeys(("toc_s", "toe_sow_s"), (17, 8.0, "u")),
    **dict.fromkeys(("group_delay_1_s", "group_delay_2_s"), (10, 1e-10, "s")),
    **{name: coding[1:] for name, coding in _klobuchar(0).items()},
    "af2": (11, 2.0**-66, "s"),
    "af1": (22, 2.0**-50, "s"),
    "af0_s": (24, 2.0**-33, "s"),
    **dict.fromkeys(("cuc", "cus", "cic", "cis"), (18, 2.0**-31, "s")),
    **dict.fromkeys(("crc", "crs"), (18, 2.0**-6, "s")),
}
#: Layout of the fields that all BeiDou D1 and D2 subframes (10 words of 30 bits, with parity) have.
BDS_HEAD: Final = layout(BEIDOU_CODINGS, tow_s=((18, 8), (30, 12)), subframe=15)
D1: Final = _with_head(BDS_HEAD, {
    1: layout(BEIDOU_CODINGS, health=42, aodc=43, accuracy=48, week=60, toc_s=((73, 9), (90, 8)), group_delay_1_s=98,
              group_delay_2_s=((108, 4), (120, 6)), ion0=126, ion1=134, ion2=150, ion3=158, ion4=((166, 6), (180, 2)),
              ion5=182, ion6=190, ion7=((198, 4), (210, 4)), af2=214, af0_s=((225, 7), (240, 17)),
              af1=((257, 5), (270, 17)), aode=287),
    2: layout(BEIDOU_CODINGS, delta_n=((42, 10), (60, 6)), cuc=((66, 16), (90, 2)), m0=((92, 20), (120, 12)),
              eccentricity=((132, 10), (150, 22)), cus=180, crc=((198, 4), (210, 14)), crs=((224, 8), (240, 10)),
              sqrt_a=((250, 12), (270, 20)), toe_high=290),
    3: layout(BEIDOU_CODINGS, toe_low=((42, 10), (60, 5)), i0=((65, 17), (90, 15)), cic=((105, 7), (120, 11)),
              omega_dot=((131, 11), (150, 13)), cis=((163, 9), (180, 9)), i_dot=((189, 13), (210, 1)),
              omega0=((211, 21), (240, 11)), omega=((251, 11), (270, 21))),
})  # fmt: skip
#: First bit of each of the ten pages of D2 subframe 1, which are joined to 3000 bits. A field that extends over two
#: pages has a piece in each of them.
_PAGE: Final = {k: 300 * (k - 1) for k in range(1, 11)}
D2: Final = layout(
    BEIDOU_CODINGS,
    health=_PAGE[1] + 46,
    aodc=_PAGE[1] + 47,
    accuracy=_PAGE[1] + 60,
    week=_PAGE[1] + 64,
    toc_s=((_PAGE[1] + 77, 5), (_PAGE[1] + 90, 12)),
    group_delay_1_s=_PAGE[1] + 102,
    group_delay_2_s=_PAGE[1] + 120,
    af0_s=((_PAGE[3] + 100, 12), (_PAGE[3] + 120, 12)),
    af1=((_PAGE[3] + 132, 4), (_PAGE[4] + 46, 6), (_PAGE[4] + 60, 12)),
    af2=((_PAGE[4] + 72, 10), (_PAGE[4] + 90, 1)),
    aode=_PAGE[4] + 91,
    delta_n=_PAGE[4] + 96,
    cuc=((_PAGE[4] + 120, 14), (_PAGE[5] + 46, 4)),
    m0=((_PAGE[5] + 50, 2), (_PAGE[5] + 60, 22), (_PAGE[5] + 90, 8)),
    cus=((_PAGE[5] + 98, 14), (_PAGE[5] + 120, 4)),
    eccentricity=((_PAGE[5] + 124, 10), (_PAGE[6] + 46, 6), (_PAGE[6] + 60, 16)),
    sqrt_a=((_PAGE[6] + 76, 6), (_PAGE[6] + 90, 22), (_PAGE[6] + 120, 4)),
    cic=((_PAGE[6] + 124, 10), (_PAGE[7] + 46, 6), (_PAGE[7] + 60, 2)),
    cis=_PAGE[7] + 62,
    toe_sow_s=((_PAGE[7] + 80, 2), (_PAGE[7] + 90, 15)),
    i0=((_PAGE[7] + 105, 7), (_PAGE[7] + 120, 14), (_PAGE[8] + 46, 6), (_PAGE[8] + 60, 5)),
    crc=((_PAGE[8] + 65, 17), (_PAGE[8] + 90, 1)),
    crs=_PAGE[8] + 91,
    omega_dot=((_PAGE[8] + 109, 3), (_PAGE[8] + 120, 16), (_PAGE[9] + 46, 5)),
    omega0=((_PAGE[9] + 51, 1), (_PAGE[9] + 60, 22), (_PAGE[9] + 90, 9)),
    omega=((_PAGE[9] + 99, 13), (_PAGE[9] + 120, 14), (_PAGE[10] + 46, 5)),
    i_dot=((_PAGE[10] + 51, 1), (_PAGE[10] + 60, 13)),
)
GLONASS_CODINGS: Final[dict[str, Coding]] = {
    **dict.fromkeys("xyz", (27, 2.0**-11, "m")),
    **{f"{axis}_velocity": (24, 2.0**-20, "m") for axis in "xyz"},
    **{f"{axis}_acceleration": (5, 2.0**-30, "m") for axis in "xyz"},
    **_flags(number=6, channel=5, almanac=4, health=3, p=2, p2=1, p3=1, ln=1, age=5, day=11, slot=5),
    "hour": (5, 3600.0, "u"),
    "minute": (6, 60.0, "u"),
    "half_minute": (1, 30.0, "u"),
    "tb_s": (7, 900.0, "u"),
    "relative_frequency": (11, 2.0**-40, "m"),
    "tau_s": (22, 2.0**-30, "m"),
    "dtau": (5, 2.0**-30, "m"),
}
#: Layout of each GLONASS string, by number. Each string has 85 bits; the first is the idle bit.
GLONASS: Final = {
    1: layout(GLONASS_CODINGS, hour=9, minute=14, half_minute=20, x_velocity=21, x_acceleration=45, x=50),
    2: layout(GLONASS_CODINGS, health=5, tb_s=9, y_velocity=21, y_acceleration=45, y=50),
    3: layout(GLONASS_CODINGS, relative_frequency=6, ln=20, z_velocity=21, z_acceleration=45, z=50),
    4: layout(GLONASS_CODINGS, tau_s=5, age=32, day=59, slot=70),
}
#: Nominal user range accuracy [m] for each URA index of GPS, QZSS and BeiDou, as in RINEX (IS-GPS-200N, 20.3.3.3.1.3).
URA_NOMINAL_M: Final = np.array([2, 2.8, 4, 5.7, 8, 11.3, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192])


def inav_words(words: np.ndarray[tuple[int, int], np.dtype[np.uint32]]) -> tuple[Bytes, Masks]:
    """Return the bits of I/NAV words, shape (N, 128), and whether each page pair is valid, shape (N,).

    Rows of `words` are page pairs, even page first. A pair is valid if its CRC is correct and no page is an alert page.
    """
    bits = unpack_words(words[:, :8], drop=0, keep=32)
    even, odd = bits[:, :120], bits[:, 128:248]
    checked = has_crc(np.concatenate([even[:, :114], odd[:, :106]], axis=1), 196)
    valid = (even[:, 0] == 0) & (odd[:, 0] == 1) & (even[:, 1] == 0) & (odd[:, 1] == 0) & checked
    return np.concatenate([even[:, 2:114], odd[:, 2:18]], axis=1), valid


def has_crc(bits: Bytes, checked: int) -> Masks:
    """Return whether the first `checked` bits of each message are followed by their CRC-24Q, shape (N,)."""
    before = np.zeros((len(bits), -checked % 8), dtype=np.uint8)
    data = np.packbits(np.concatenate([before, bits[:, :checked]], axis=1), axis=1)
    start = np.arange(len(data)) * data.shape[1]
    crc = crc24q(data.reshape(-1), start, start + data.shape[1])
    return np.asarray(crc == fields(bits, {"crc": (checked, 24, 1.0, "u")})["crc"])


def sisa_m(index: Floats) -> Floats:
    """Return the Galileo signal-in-space accuracy [m] by index (ICD, table 89); NaN if no prediction is available."""
    return np.asarray(np.interp(index, (0, 50, 75, 100, 125), (0.0, 0.5, 1.0, 2.0, 6.0), right=np.nan))


def glonass_hamming(bits: Bytes) -> Masks:
    """Return whether GLONASS strings of 85 bits pass their Hamming code (ICD, 4.7), shape (N,)."""
    # The ICD numbers the bits from 85, which is sent first, to 1. With these numbers, bits 9 to 85 are data bits; they
    # are at the positions of a Hamming code that are not powers of two. Bits 1 to 7 are check bits. Check bit k covers
    # the data bits in whose position the k-th binary digit is 1.
    value = bits[:, 84::-1].astype(np.int64)
    places = np.array([place for place in range(1, 86) if place & (place - 1)])[:77]
    checks = [(value[:, 8:][:, places >> k & 1 == 1].sum(axis=1) + value[:, k]) & 1 for k in range(7)]
    total = value.sum(axis=1) & 1
    wrong = np.stack(checks, axis=1).any(axis=1)
    return np.asarray(~wrong & (total == 0))


#: Galileo data-source words for I/NAV on E1-B and on E5b-I. The clock and group delay of I/NAV refer to E5b and E1.
E1B_SOURCE, E5B_SOURCE = 1 << 0 | 1 << 9, 1 << 2 | 1 << 9
#: Galileo data-source word for F/NAV, whose clock and group delay refer to E5a and E1.
E5A_SOURCE: Final = 1 << 1 | 1 << 8
_UBX_E5B: Final = (5, 6)
_UBX_E5A: Final = (3, 4)
_CNAV_SIGNALS: Final = {"G": (3, 4, 6, 7), "J": (4, 5, 8, 9)}  #: UBX numbers of the signals with CNAV, L2C and L5.
#: UBX numbers of the BeiDou signals that carry D1 or D2, of B1C (B-CNAV1), and of B2a (B-CNAV2).
_D_SIGNALS, _B1C, _B2A = (0, 1, 2, 3, 4, 10), (5, 6), (7, 8)
#: Offsets added to the numbers of F/NAV pages, of CNAV and B-CNAV2 messages, and of B-CNAV1 pages, so that the page
#: numbers of a satellite are unique.
FNAV_FROM, CNAV_FROM, BCNAV1_FROM = 200, 300, 400
_PREAMBLE: Final = 0x8B
Pages = Iterator[tuple[int, int, Values]]  #: Items: row in `Subframes`, page number and fields of a page.


def decode_pages(subframes: Subframes) -> tuple[list[tuple[int, str, int, Values]], Counter[str]]:
    """Return the decoded pages (row, satellite, page number, fields) in the order of the stream, and counts of skipped
    pages.
    """
    counts = Counter(subframes.skipped)
    pages: list[tuple[int, str, int, Values]] = []
    letters = subframes.satellite.astype("<U1")
    for letter, decode in (("G", _lnav), ("J", _lnav), ("E", _galileo), ("C", _beidou), ("R", _glonass)):
        rows = np.flatnonzero(letters == letter)
        if len(rows):
            for row, number, values in decode(subframes.take(rows), counts):
                pages.append((int(rows[row]), str(subframes.satellite[rows[row]]), number, values))
    pages.sort(key=lambda page: page[0])
    return pages, counts


def _of_kinds(
    bits: Bytes, valid: Masks, kind: Integers, layouts: Mapping[int, Mapping[str, Field]], first: int = 0
) -> Pages:
    """Yield the row, the page number (`first` plus the kind) and the fields of each valid page."""
    for k, layout in layouts.items():
        rows = np.flatnonzero(valid & (kind == k))
        table = fields(bits[rows], layout)
        for i, row in enumerate(rows.tolist()):
            yield row, first + k, {name: float(values[i]) for name, values in table.items()}


def _with_crc(
    part: Subframes, here: Masks, checked: int, counts: Counter[str], fault: str, preamble: int | None = None
) -> tuple[Bytes, Masks]:
    """Return all pages' bits, and whether each page is selected by `here` and valid; count selected invalid pages."""
    bits = unpack_words(part.words, drop=0, keep=32)
    if not here.any():
        return bits, here
    valid = here & has_crc(bits, checked)
    if preamble is not None:
        valid &= read_unsigned(bits, 0, 8) == preamble
    counts[fault] += int(np.count_nonzero(here & ~valid))
    return bits, valid


def _lnav(part: Subframes, counts: Counter[str]) -> Pages:
    """Yield the pages of LNAV and CNAV."""
    letter, civil = str(part.satellite[0][0]), part.signal == 0
    cnav = np.isin(part.signal, _CNAV_SIGNALS[letter])
    counts[f"{letter} pages of other messages"] += int(np.count_nonzero(~cnav & ~civil))
    checked, fault = CNAV_CHECKED, f"{letter} CNAV without valid CRC"
    bits, valid = _with_crc(part, cnav, checked, counts, fault, _PREAMBLE)
    kind = read_unsigned(bits, 14, 6)
    kind = np.where((kind == 61) & (letter == "J"), 30, kind)  # QZSS message type 61 has the layout of type 30
    yield from _of_kinds(bits, valid, kind, CNAV, CNAV_FROM)
    bits = unpack_words(part.words, drop=6, keep=24)
    yield from _of_kinds(bits, civil & (read_unsigned(bits, 0, 8) == _PREAMBLE), read_unsigned(bits, 43, 3), LNAV)


def _galileo(part: Subframes, counts: Counter[str]) -> Pages:
    """Yield the pages of I/NAV and F/NAV."""
    e5b, fnav = np.isin(part.signal, _UBX_E5B), np.isin(part.signal, _UBX_E5A)
    inav, fault = (part.signal == 1) | e5b, "E pages without valid CRC"
    counts["E pages of other messages"] += int(np.count_nonzero(~inav & ~fnav))
    bits, valid = _with_crc(part, fnav, FNAV_CHECKED, counts, fault)
    yield from _of_kinds(bits, valid, read_unsigned(bits, 0, 6), FNAV, FNAV_FROM)
    bits, valid = inav_words(part.words)
    counts[fault] += int(np.count_nonzero(inav & ~valid))
    for row, k, values in _of_kinds(bits, inav & valid, read_unsigned(bits, 0, 6), INAV):
        yield row, k, {**values, "source": float(E5B_SOURCE if e5b[row] else E1B_SOURCE)}


def _beidou(part: Subframes, counts: Counter[str]) -> Pages:
    """Yield the pages of D1, D2, B-CNAV1 and B-CNAV2."""
    legacy, first, b2a = (np.isin(part.signal, signals) for signals in (_D_SIGNALS, _B1C, _B2A))
    frame = part.signal == BCNAV1_PAGE
    counts["C pages of B-CNAV1 in UBX (supported in SBF only)"] += int(np.count_nonzero(first))
    counts["C pages of other messages"] += int(np.count_nonzero(~legacy & ~first & ~b2a & ~frame))
    bits, valid = _with_crc(part, b2a, BCNAV2_CHECKED, counts, "C B-CNAV2 without valid CRC")
    yield from _of_kinds(bits, valid, read_unsigned(bits, 6, 6), BCNAV2, CNAV_FROM)
    yield from _of_kinds(bits, frame, read_unsigned(bits, 6, 2), BCNAV1, BCNAV1_FROM)
    bits = unpack_words(part.words, drop=0, keep=30)
    number = np.array([int(name[1:]) for name in part.satellite.tolist()])
    geo = (number <= 5) | (number >= 59)
    subframe = read_unsigned(bits, 15, 3)
    valid = legacy & (read_unsigned(bits, 0, 11) == 0x712)
    yield from _of_kinds(bits, valid & ~geo, subframe, D1)
    heads = dict.fromkeys(range(1, 11), BDS_HEAD)
    for row, k, head in _of_kinds(bits, valid & geo & (subframe == 1), read_unsigned(bits, 42, 4), heads, 100):
        packed = int("".join(map(str, bits[row].tolist())), 2)
        yield row, k, {**head, "page": packed}  # all bits, because fields extend over several pages


def _glonass(part: Subframes, counts: Counter[str]) -> Pages:
    bits = unpack_words(part.words[:, :3], drop=0, keep=32)[:, :85]
    valid = glonass_hamming(bits)
    counts["R strings without valid code"] += int(np.count_nonzero(~valid))
    for row, k, values in _of_kinds(bits, valid, read_unsigned(bits, 1, 4), GLONASS):
        yield row, k, {**values, "channel": float(part.glonass_channel[row])}
