"""Pages of CNAV and F/NAV written field after field, in the order in which they are sent, and messages around them."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

from ubx_made import frame

PI = np.pi
Piece = tuple[float, int]
#: Time of week at which the first page is sent [s], and the week.
TOW_S, WEEK = 576_012, 2353


def put(pieces: Sequence[Piece]) -> str:
    """Integers as bits after each other; negative ones in two's complement."""
    text = ""
    for value, bits in pieces:
        whole = round(float(value))
        assert -(1 << bits - 1) <= whole < 1 << bits, (value, bits)
        text += f"{whole & (1 << bits) - 1:0{bits}b}"
    return text


def crc24q(text: str) -> int:
    """CRC-24Q bit by bit."""
    value = 0
    for bit in text:
        value ^= int(bit) << 23
        value = (value << 1 ^ 0x1864CFB if value & 0x800000 else value << 1) & 0xFFFFFF
    return value


def with_crc(text: str, tail: int = 0) -> np.ndarray:
    bits = text + f"{crc24q(text):024b}" + "0" * tail
    return np.array([int(bit) for bit in bits], dtype=np.uint8)


def cnav_pages(values: Mapping[str, float], number: int, *, system: str = "G") -> list[np.ndarray]:
    """Messages 10, 11 and 30 of a record as RINEX has it."""
    v, axis = values, {"G": 26_559_710.0, "J": 42_164_200.0}[system]

    def head(kind: int, tow_s: int) -> list[Piece]:
        return [(0x8B, 8), (number, 6), (kind, 6), (tow_s // 6, 17), (0, 1)]

    ten = put(
        [
            *head(10, TOW_S), (WEEK, 13), (v["health"], 3), (v["top"] / 300, 11), (v["accuracy_index"], 5),
            (v["toe_sow_s"] / 300, 11), ((v["sqrt_a"] ** 2 - axis) * 2.0**9, 26), (v["a_dot"] * 2.0**21, 25),
            (v["delta_n"] / PI * 2.0**44, 17), (v["delta_n_dot"] / PI * 2.0**57, 23), (v["m0"] / PI * 2.0**32, 33),
            (v["eccentricity"] * 2.0**34, 33), (v["omega"] / PI * 2.0**32, 33), (0, 5),
        ]
    )  # fmt: skip
    eleven = put(
        [
            *head(11, TOW_S + 12), (v["toe_sow_s"] / 300, 11), (v["omega0"] / PI * 2.0**32, 33),
            (v["i0"] / PI * 2.0**32, 33), ((v["omega_dot"] / PI + 2.6e-9) * 2.0**44, 17),
            (v["i_dot"] / PI * 2.0**44, 15),
            (v["cis"] * 2.0**30, 16), (v["cic"] * 2.0**30, 16), (v["crs"] * 2.0**8, 24), (v["crc"] * 2.0**8, 24),
            (v["cus"] * 2.0**30, 21), (v["cuc"] * 2.0**30, 21), (0, 7),
        ]
    )  # fmt: skip
    delays = [v["group_delay_1_s"], *(v[f"inter_signal_{k}"] for k in range(4))]
    thirty = put(
        [
            *head(30, TOW_S + 24), (v["top"] / 300, 11), (v["ned_0"], 5), (v["ned_1"], 3), (v["ned_2"], 3),
            (v["toe_sow_s"] / 300, 11), (v["af0_s"] * 2.0**35, 26), (v["af1"] * 2.0**48, 20), (v["af2"] * 2.0**60, 10),
            *((delay * 2.0**35, 13) for delay in delays), *((k - 3, 8) for k in range(8)), (WEEK % 256, 8), (0, 12),
        ]
    )  # fmt: skip
    assert {len(text) for text in (ten, eleven, thirty)} == {276}
    return [with_crc(text) for text in (ten, eleven, thirty)]


def fnav_pages(values: Mapping[str, float], number: int) -> list[np.ndarray]:
    """Pages 1 to 4 of a record; `sisa`, `e5a_health` and `e5a_invalid` as sent."""
    v = values
    semi = {name: v[name] / PI for name in ("m0", "omega_dot", "omega0", "i_dot", "i0", "omega", "delta_n")}
    week = WEEK - 1024
    one = put(
        [
            (1, 6), (number, 6), (v["iod"], 10), (v["toe_sow_s"] / 60, 14), (v["af0_s"] * 2.0**34, 31),
            (v["af1"] * 2.0**46, 21), (v["af2"] * 2.0**59, 6), (v["sisa"], 8), (80, 11), (-40, 11), (7, 14), (0, 5),
            (v["group_delay_1_s"] * 2.0**32, 10), (v["e5a_health"], 2), (week, 12), (TOW_S, 20), (v["e5a_invalid"], 1),
            (0, 26),
        ]
    )  # fmt: skip
    two = put(
        [
            (2, 6), (v["iod"], 10), (semi["m0"] * 2.0**31, 32), (semi["omega_dot"] * 2.0**43, 24),
            (v["eccentricity"] * 2.0**33, 32), (v["sqrt_a"] * 2.0**19, 32), (semi["omega0"] * 2.0**31, 32),
            (semi["i_dot"] * 2.0**43, 14), (week, 12), (TOW_S + 10, 20),
        ]
    )  # fmt: skip
    three = put(
        [
            (3, 6), (v["iod"], 10), (semi["i0"] * 2.0**31, 32), (semi["omega"] * 2.0**31, 32),
            (semi["delta_n"] * 2.0**43, 16), (v["cuc"] * 2.0**29, 16), (v["cus"] * 2.0**29, 16), (v["crc"] * 32, 16),
            (v["crs"] * 32, 16), (v["toe_sow_s"] / 60, 14), (week, 12), (TOW_S + 20, 20), (0, 8),
        ]
    )  # fmt: skip
    four = put([(4, 6), (v["iod"], 10), (v["cic"] * 2.0**29, 16), (v["cis"] * 2.0**29, 16), *[(0, 20)] * 8, (0, 6)])
    assert {len(text) for text in (one, two, three, four)} == {214}
    return [with_crc(text, tail=6) for text in (one, two, three, four)]


def bcnav2_messages(values: Mapping[str, float], number: int) -> list[np.ndarray]:
    """Messages 10, 11, 30 and 40 of a record as RINEX has it (BDS-SIS-ICD-B2a 1.0, 6.2.3), without parity symbols."""
    v, axis = values, 27_906_100.0 if values["kind"] == 3 else 42_162_200.0
    flags: list[Piece] = [(v["flags"], 3), (v["sismai"], 4), (0, 3)]

    def head(kind: int, k: int) -> list[Piece]:
        return [(number, 6), (kind, 6), (TOW_S // 3 + k, 18)]

    ten = put(
        [
            *head(10, 0), (WEEK - 1356, 13), *flags, (v["iode"], 8), (v["toe_sow_s"] / 300, 11), (v["kind"], 2),
            ((v["sqrt_a"] ** 2 - axis) * 2.0**9, 26), (v["a_dot"] * 2.0**21, 25), (v["delta_n"] / PI * 2.0**44, 17),
            (v["delta_n_dot"] / PI * 2.0**57, 23), (v["m0"] / PI * 2.0**32, 33), (v["eccentricity"] * 2.0**34, 33),
            (v["omega"] / PI * 2.0**32, 33),
        ]
    )  # fmt: skip
    eleven = put(
        [
            *head(11, 1), (v["health"], 2), *flags, (v["omega0"] / PI * 2.0**32, 33), (v["i0"] / PI * 2.0**32, 33),
            (v["omega_dot"] / PI * 2.0**44, 19), (v["i_dot"] / PI * 2.0**44, 15), (v["cis"] * 2.0**30, 16),
            (v["cic"] * 2.0**30, 16), (v["crs"] * 2.0**8, 24), (v["crc"] * 2.0**8, 24), (v["cus"] * 2.0**30, 21),
            (v["cuc"] * 2.0**30, 21),
        ]
    )  # fmt: skip
    thirty = put(
        [
            *head(30, 2), (v["health"], 2), *flags, (v["toc_s"] / 300, 11), (v["af0_s"] * 2.0**34, 25),
            (v["af1"] * 2.0**50, 22), (v["af2"] * 2.0**66, 11), (v["iodc"], 10), (v["group_delay_2_s"] * 2.0**34, 12),
            (v["inter_signal_1"] * 2.0**34, 12), (0, 74), (v["group_delay_1_s"] * 2.0**34, 12), (0, 33),
        ]
    )  # fmt: skip
    forty = put([*head(40, 3), (v["health"], 2), *flags, *[(0, 37)] * 6])
    assert {len(text) for text in (ten, eleven, thirty, forty)} == {264}
    return [with_crc(text) for text in (ten, eleven, thirty, forty)]


def bcnav1_frame(values: Mapping[str, float], number: int, page: int = 1) -> np.ndarray:
    """1800 symbols of a record as RINEX has it (BDS-SIS-ICD-B1C 1.0, 6.2.2); those that correct others are ones."""
    v, (ten, eleven, thirty, _) = values, ("".join(map(str, page)) for page in bcnav2_messages(values, number))
    # orbit and clock have the fields and the order of B-CNAV2
    second = put([(WEEK - 1356, 13), (TOW_S // 3600, 8), (v["iodc"], 10), (v["iode"], 8)])
    second += ten[61:264] + eleven[42:264] + thirty[42:111]
    delays = [v["group_delay_2_s"], v["inter_signal_0"], v["group_delay_1_s"]]
    second += put([*((delay * 2.0**34, 12) for delay in delays), (0, 7)])
    third = put([(page, 6), (v["health"], 2), (v["flags"], 3), (v["sismai"], 4), *[(0, 25)] * 9])
    first = f"{number:06b}" + "1" * 15 + f"{(TOW_S + 60) % 3600 // 18:08b}" + "1" * 43
    parts = first, with_crc(second), np.ones(600), with_crc(third), np.ones(264)
    return np.concatenate([np.array([int(bit) for bit in part], dtype=np.uint8) for part in parts])


def words_of(page: np.ndarray) -> bytes:
    """Bits as big-endian words of 32 bits, the last one filled with zeros."""
    return np.packbits(np.concatenate([page, np.zeros(-len(page) % 32, np.uint8)])).tobytes()


def ubx_page(page: np.ndarray, system: str, number: int) -> bytes:
    """RXM-SFRBX of a page."""
    gnss, signal = {"G": (0, 4), "J": (5, 5), "E": (2, 3), "C": (3, 8)}[system]
    words = np.frombuffer(words_of(page), ">u4")
    head = struct.pack("<BBBBBBBB", gnss, number, signal, 0, len(words), 0, 2, 0)
    return frame(0x0213, head + words.astype("<u4").tobytes())


def sbf_page(page: np.ndarray, system: str, number: int) -> bytes:
    """GPSRawL5, QZSRawL5, GALRawFNAV, or BDSRawB2a with parity symbols, of a page."""
    kind, shift, source = {"G": (4019, 0, 4), "J": (4068, 180, 26), "E": (4022, 70, 20), "C": (4219, 140, 14)}[system]
    page = np.concatenate([page, np.ones(288, np.uint8)]) if system == "C" else page
    return sbf_block(kind, page, number + shift, (1, 0, source))


def sbf_block(kind: int, page: np.ndarray, sv: int, flags: tuple[int, int, int]) -> bytes:
    """Block with the bits of a page, as BDSRawB1C has them; `flags`: two of the checks, and the signal."""
    words = np.frombuffer(words_of(page), ">u4").astype("<u4").tobytes()
    body = struct.pack("<IHBBBBBB", TOW_S * 1000, WEEK, sv, *flags, 0, 1) + words
    rest = struct.pack("<HH", kind, 8 + len(body)) + body
    value = 0
    for byte in rest:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    return b"$@" + struct.pack("<H", value) + rest
