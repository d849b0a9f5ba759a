"""Decode u-blox UBX messages: raw measurements, navigation subframes and receiver positions.

Source: u-blox F9 HPG 1.32 interface description (UBX-22008968), sections 3.15 (NAV) and 3.17 (RXM).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Integers, Masks, Strings, places_in_groups
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.nearest_times import nearest_week
from railfix.core.timescale import from_week
from railfix.io.receiver.framing import Frames, Subframes, gather_structures
from railfix.io.receiver.measurements import Measurements

RXM_RAWX: Final = 0x0215
#: Raw measurements of receivers up to the u-blox 7; these messages are counted but not read.
RXM_RAW: Final = 0x0210
RXM_SFRBX: Final = 0x0213
NAV_PVT: Final = 0x0107
NAV_HPPOSLLH: Final = 0x0114

SYSTEMS: Final = {0: "G", 1: "S", 2: "E", 3: "C", 5: "J", 6: "R", 7: "I"}  #: Constellation letter for each gnssId.
#: RINEX signal for each gnssId and sigId (section 1.5.4 of the interface description, "Signal identifiers").
SIGNALS: Final[Mapping[int, Mapping[int, str]]] = {
    0: {0: "1C", 3: "2L", 4: "2S", 6: "5I", 7: "5Q"},
    1: {0: "1C"},
    2: {0: "1C", 1: "1B", 3: "5I", 4: "5Q", 5: "7I", 6: "7Q", 8: "6B", 9: "6C", 10: "6A"},
    3: {0: "2I", 1: "2I", 2: "7I", 3: "7I", 4: "6I", 5: "1P", 6: "1D", 7: "5P", 8: "5D", 10: "6I"},
    5: {0: "1C", 1: "1Z", 4: "2S", 5: "2L", 8: "5I", 9: "5Q"},
    6: {0: "1C", 2: "2C"},
    7: {0: "5A"},
}
#: For each parity bit D25 to D30 of an LNAV word, the mask of the data bits in its parity equation.
_LNAV_PARITY: Final = (0xEC7CD2, 0x763E69, 0xBB1F34, 0x5D8F9A, 0xAEC7CD, 0x2DEA27)
_LNAV_WITH_D29: Final = (0, 2, 5)  #: Indices in `_LNAV_PARITY` of the equations that contain D29 of the previous word.
#: Epochs after this GPS week (in 2079) are skipped, because a wrong later date would put all other epochs out of order.
_LAST_WEEK: Final = 5200
#: Codes [m], phases [cycles] and Dopplers [Hz] of this size or more are rejected: they do not fit into RINEX fields.
_LARGEST: Final = 1e10
#: Fields of one measurement in RXM-RAWX.
_MEASUREMENT: Final = np.dtype(
    [
        ("code", "<f8"), ("phase", "<f8"), ("doppler", "<f4"), ("gnss", "u1"), ("sv", "u1"), ("signal", "u1"),
        ("channel", "u1"), ("lock", "<u2"), ("cn0", "u1"), ("code_std", "u1"), ("phase_std", "u1"),
        ("doppler_std", "u1"), ("tracking", "u1"), ("reserved", "u1"),
    ]
)  # fmt: skip
_SFRBX_HEADER: Final = np.dtype([*((name, "u1") for name in ("gnss", "sv", "signal", "channel", "count")), ("_", "V3")])
_WORDS: Final = np.dtype([("words", "<u4", 10)])  #: Subframe words in RXM-SFRBX; more than ten are ignored.
_RAWX_HEADER: Final = np.dtype(
    [("tow", "<f8"), ("week", "<u2"), ("leap", "i1"), ("count", "u1"), ("status", "u1"), ("version", "u1"), ("_", "V2")]
)
_PVT: Final = np.dtype(
    [
        ("tow_ms", "<u4"), ("year", "<u2"), ("month", "u1"), ("day", "u1"), ("clock", "V3"), ("valid", "u1"),
        ("_", "V8"), ("fix", "u1"), ("flags", "u1"), ("flags2", "u1"), ("satellites", "u1"), ("longitude", "<i4"),
        ("latitude", "<i4"), ("height_mm", "<i4"), ("sea_level_mm", "<i4"), ("horizontal_mm", "<u4"),
        ("vertical_mm", "<u4"),
    ]
)  # fmt: skip
_HPPOSLLH: Final = np.dtype(
    [
        ("version", "u1"), ("_", "V2"), ("flags", "u1"), ("tow_ms", "<u4"), ("longitude", "<i4"), ("latitude", "<i4"),
        ("height_mm", "<i4"), ("sea_level_mm", "<i4"), ("longitude_fine", "i1"), ("latitude_fine", "i1"),
        ("height_fine", "i1"), ("sea_level_fine", "i1"), ("horizontal", "<u4"), ("vertical", "<u4"),
    ]
)  # fmt: skip
_PHASE_VALID, _HALF_CYCLE_KNOWN, _HALF_CYCLE_REMOVED, _CODE_VALID = 2, 4, 8, 1
#: Phases with a larger standard deviation are rejected, as in RTKLIB 2.4.3; in units of 0.004 cycle.
_LARGEST_PHASE_STD: Final = 5


def _name_table() -> Strings:
    """Return the satellite names by gnssId and svId, blank where unknown. SBAS PRN 120 is S20."""
    table = np.full((256, 256), "", dtype="<U3")
    for system, letter in SYSTEMS.items():
        shift = 100 if letter == "S" else 0
        for number in range(1, 100):
            table[system, number + shift] = f"{letter}{number:02d}"
    return table


_NAMES: Final = _name_table()


def rawx_measurements(frames: Frames) -> Measurements:
    """Return the measurements in all RXM-RAWX messages. Malformed messages are skipped and counted."""
    chosen, header = frames.structures("ubx", [RXM_RAWX], _RAWX_HEADER)
    whole = frames.end[chosen] - frames.start[chosen] == 16 + 32 * header["count"].astype(np.int64)
    plausible = whole & (header["week"] > 0) & (header["week"] <= _LAST_WEEK)
    plausible &= (header["tow"] >= 0) & (header["tow"] < 604_800)
    undated = whole & ~plausible
    skipped = {"broken RXM-RAWX": int((~whole).sum()), "RXM-RAWX without time": int(undated.sum())}
    chosen, header = chosen[plausible], header[plausible]
    count = header["count"].astype(np.int64)
    epoch, within = places_in_groups(count)
    rows = gather_structures(frames.data, frames.start[chosen][epoch] + 16 + 32 * within, _MEASUREMENT)
    system, tracking = rows["gnss"].astype(np.int64), rows["tracking"].astype(np.int64)
    names = np.array([[SIGNALS.get(g, {}).get(s, "") for s in range(16)] for g in range(8)], dtype="<U2")
    signal = names[np.minimum(system, 7), np.minimum(rows["signal"], 15)]
    phase_valid = (tracking & _PHASE_VALID != 0) & (rows["phase"] != 0) & (rows["phase"] != -0.5)
    phase_valid &= rows["phase_std"] & 15 <= _LARGEST_PHASE_STD
    code_valid = (tracking & _CODE_VALID != 0) & (rows["code"] > 0)
    code, phase, doppler = (
        np.where(np.abs(rows[name]) < _LARGEST, rows[name], np.nan) for name in ("code", "phase", "doppler")
    )
    lost = (np.isnan(code) & code_valid) | (np.isnan(phase) & phase_valid)
    skipped["RXM-RAWX measurements with impossible values"] = int(np.count_nonzero(lost))
    leap = header["leap"][header["status"] & 1 == 1]
    return Measurements(
        time=from_week(header["week"].astype(np.int64), header["tow"]),
        epoch=epoch,
        satellite=_NAMES[system, rows["sv"]],
        signal=signal,
        code_m=np.where(code_valid, code, np.nan),
        phase_cycles=np.where(phase_valid, phase, np.nan),
        doppler_hz=doppler.astype(np.float64),
        cn0_dbhz=np.where(rows["cn0"] > 0, rows["cn0"].astype(np.float64), np.nan),
        lock_s=rows["lock"] * 1e-3,
        half_cycle=phase_valid & (tracking & _HALF_CYCLE_KNOWN == 0),
        polarity=(tracking & _HALF_CYCLE_REMOVED != 0).astype(np.int64),
        glonass_channel=rows["channel"].astype(np.int64) - 7,
        leap_seconds=int(leap[-1]) if len(leap) else None,
        receiver="u-blox",
        skipped={k: v for k, v in skipped.items() if v},
    )


def sfrbx_subframes(frames: Frames) -> Subframes:
    """Return the subframes in all RXM-SFRBX messages. L1 C/A subframes with wrong parity are skipped and counted."""
    chosen, header = frames.structures("ubx", [RXM_SFRBX], _SFRBX_HEADER)
    whole = frames.end[chosen] - frames.start[chosen] == 8 + 4 * header["count"].astype(np.int64)
    chosen, header = chosen[whole], header[whole]
    data = np.concatenate([frames.data, np.zeros(_WORDS.itemsize, np.uint8)])
    sent = gather_structures(data, frames.start[chosen] + 8, _WORDS)["words"]
    words = np.where(np.arange(10) < header["count"][:, None], sent, 0).astype(np.uint32)
    system, signal, channel = (header[name].astype(np.int64) for name in ("gnss", "signal", "channel"))
    wrong = np.isin(system, (0, 5)) & (signal == 0) & ~has_lnav_parity(words)
    counts = {f"{SYSTEMS[k]} subframes with wrong parity": int(np.sum(wrong & (system == k))) for k in (0, 5)}
    subframes = Subframes(
        satellite=_NAMES[system, header["sv"]],
        signal=signal,
        glonass_channel=channel - 7,
        words=words,
        order=frames.frame_start[chosen],
        skipped={what: number for what, number in counts.items() if number},
    )
    return subframes.take(np.flatnonzero(~wrong))


def has_lnav_parity(words: np.ndarray[tuple[int, int], np.dtype[np.uint32]]) -> Masks:
    """Return whether the parity of all ten words of LNAV subframes is correct, shape (N,) (IS-GPS-200, table 20-XIV).

    u-blox inverts each word that follows a word with D30 = 1. In the parity equations, D30 of the previous word
    therefore cancels, and D29 is replaced by the exclusive or of D29 and D30.
    """
    data, parity = words >> np.uint32(6) & np.uint32(0xFFFFFF), words & np.uint32(63)
    before = np.zeros_like(parity)
    before[:, 1:] = (parity[:, :-1] >> np.uint32(1) ^ parity[:, :-1]) & np.uint32(1)
    right = np.ones(words.shape, dtype=np.bool_)
    for place, mask in enumerate(_LNAV_PARITY):
        bits = np.unpackbits((data & np.uint32(mask)).astype(">u4").view(np.uint8).reshape(*words.shape, 4), axis=2)
        odd = np.bitwise_xor.reduce(bits, axis=2).astype(np.uint32)
        expected = odd ^ before if place in _LNAV_WITH_D29 else odd
        right &= (parity >> np.uint32(5 - place) & np.uint32(1)) == expected
    return np.asarray(right.all(axis=1))


def positions(frames: Frames, near: np.datetime64) -> dict[str, np.ndarray]:
    """Return the receiver's positions as columns of `PositionLog`. `near` must be within half a week of the positions.

    If `near` is NaT, no positions are returned.
    """
    _, pvt = frames.structures("ubx", [NAV_PVT], _PVT)
    fixed = (pvt["flags"] & 1 == 1) & np.isin(pvt["fix"], [2, 3, 4])
    carrier = pvt["flags"] >> 6
    quality = np.where(carrier > 0, 3 - carrier.astype(np.int64), np.where(pvt["flags"] & 2 != 0, 4, 5))
    fine = frames.of("ubx", NAV_HPPOSLLH)
    fine = fine[frames.end[fine] - frames.start[fine] == _HPPOSLLH.itemsize]
    if len(fine):
        rows = gather_structures(frames.data, frames.start[fine], _HPPOSLLH)
        kept = rows["flags"] & 1 == 0
        latitude = rows["latitude"] * 1e-7 + rows["latitude_fine"] * 1e-9
        longitude = rows["longitude"] * 1e-7 + rows["longitude_fine"] * 1e-9
        height = rows["height_mm"] * 1e-3 + rows["height_fine"] * 1e-4
        horizontal, vertical = rows["horizontal"] * 1e-4, rows["vertical"] * 1e-4
        by_tow = dict(zip(pvt["tow_ms"].tolist(), np.where(fixed, quality, -1).tolist(), strict=True))
        quality = np.array([by_tow.get(tow, 5) for tow in rows["tow_ms"].tolist()], dtype=np.int64)
        kept &= quality > 0  # drop the positions before the first fix; NAV-PVT marks them as invalid
    else:
        rows, kept = pvt, fixed
        latitude, longitude = rows["latitude"] * 1e-7, rows["longitude"] * 1e-7
        height = rows["height_mm"] * 1e-3
        horizontal, vertical = rows["horizontal_mm"] * 1e-3, rows["vertical_mm"] * 1e-3
    if np.isnat(near):
        kept = np.zeros(len(rows), dtype=bool)
    # u-blox reports one horizontal standard deviation, which combines north and east.
    sigma = np.stack([horizontal / np.sqrt(2.0), horizontal / np.sqrt(2.0), vertical], axis=-1)
    time = np.full(len(rows), np.datetime64("NaT", "ns"))
    if kept.any():
        time[kept] = nearest_week(rows["tow_ms"][kept] * 1e-3, np.full(int(kept.sum()), near))
    return {
        "time": time[kept],
        "ecef_m": ecef_from_geodetic(latitude, longitude, height)[kept],
        "quality": quality[kept],
        "sigma_m": sigma[kept],
    }


def find_date(frames: Frames) -> np.datetime64:
    """Return the UTC day of the last NAV-PVT message that has a valid date, or NaT if there is none."""
    days, _, _ = _date(frames)
    return days[-1] if len(days) else np.datetime64("NaT", "ns")


def clock_readings(frames: Frames) -> tuple[Integers, Datetimes]:
    """Return the offset in the stream and the time of each NAV-PVT message with a valid date."""
    days, rows, places = _date(frames)
    return places, nearest_week(rows["tow_ms"] * 1e-3, days)


def _date(frames: Frames) -> tuple[Datetimes, np.ndarray, Integers]:
    """Return the days (UTC), rows and offsets of NAV-PVT messages with a valid date."""
    chosen, rows = frames.structures("ubx", [NAV_PVT], _PVT)
    valid = rows["valid"] & 3 == 3
    rows = rows[valid]
    year, month, day = (rows[name].astype(np.int64) for name in ("year", "month", "day"))
    months = (12 * (year - 1970) + month - 1).astype("datetime64[M]")
    return (
        (months.astype("datetime64[D]") + (day - 1)).astype("datetime64[ns]"),
        rows,
        frames.frame_start[chosen[valid]],
    )
