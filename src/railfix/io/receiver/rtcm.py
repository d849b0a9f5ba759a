"""Decode RTCM 3 messages: multiple signal messages (MSM4 to MSM7) and ephemerides.

Source: RTCM 10403.3, sections 3.5.11 (1019, 1020, 1042, 1044 to 1046) and 3.5.16 (MSM).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from railfix.core.arrays import Bytes, Datetimes, Floats, Indices, Integers, Masks, Strings
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.nearest_times import nearest_week
from railfix.core.timescale import bdt_to_gpst, from_week, utc_to_gpst
from railfix.core.utc import gpst_to_utc
from railfix.gnss.observations import frequency_by_name_hz
from railfix.io.receiver import nav_messages
from railfix.io.receiver.framing import Field, Frames, fields, read_signed, read_unsigned
from railfix.io.receiver.measurements import Measurements, join_measurements, no_measurements
from railfix.io.receiver.nav_messages import Coding, layout

#: Constellation letter for the first three digits of an MSM number.
SYSTEMS: Final = {107: "G", 108: "R", 109: "E", 110: "S", 111: "J", 112: "C"}
#: RINEX signal for each constellation and number in the MSM signal mask.
SIGNALS: Final[Mapping[str, Mapping[int, str]]] = {
    "G": dict(zip((2, 3, 4, 8, 9, 10, 15, 16, 17, 22, 23, 24, 30, 31, 32),
                  "1C 1P 1W 2C 2P 2W 2S 2L 2X 5I 5Q 5X 1S 1L 1X".split(), strict=True)),
    "R": {2: "1C", 3: "1P", 8: "2C", 9: "2P"},
    "E": dict(zip((2, 3, 4, 5, 6, 8, 9, 10, 11, 12, 14, 15, 16, 18, 19, 20, 22, 23, 24),
                  "1C 1A 1B 1X 1Z 6C 6A 6B 6X 6Z 7I 7Q 7X 8I 8Q 8X 5I 5Q 5X".split(), strict=True)),
    "S": {2: "1C", 22: "5I", 23: "5Q", 24: "5X"},
    "J": dict(zip((2, 9, 10, 11, 15, 16, 17, 22, 23, 24, 30, 31, 32),
                  "1C 6S 6L 6X 2S 2L 2X 5I 5Q 5X 1S 1L 1X".split(), strict=True)),
    "C": dict(zip((2, 3, 4, 8, 9, 10, 14, 15, 16, 22, 23, 24, 25, 30, 31, 32),
                  "2I 2Q 2X 6I 6Q 6X 7I 7Q 7X 5D 5P 5X 7D 1D 1P 1X".split(), strict=True)),
}  # fmt: skip
_MS: Final = SPEED_OF_LIGHT * 1e-3
_HEADER_BITS: Final = 169
#: Layout of each MSM type: fine code (bits, resolution [ms]), fine phase (bits, resolution [ms]), lock time (bits),
#: C/N0 (bits, resolution [dB-Hz]), and whether the message has range rates.
_LAYOUT: Final = {
    4: (15, 2.0**-24, 22, 2.0**-29, 4, 6, 1.0, False),
    5: (15, 2.0**-24, 22, 2.0**-29, 4, 6, 1.0, True),
    6: (20, 2.0**-29, 24, 2.0**-31, 10, 10, 0.0625, False),
    7: (20, 2.0**-29, 24, 2.0**-31, 10, 10, 0.0625, True),
}
MSM_NUMBERS: Final = tuple(tens * 10 + kind for tens in SYSTEMS for kind in _LAYOUT)
#: Name of the count of MSM that are not decoded because their week is unknown.
UNDATED: Final = "RTCM 3 observations without a date"
IN_GPS_TIME: Final = "BeiDou messages with times in GPS time, read as GPS time"
#: GPS time minus BeiDou time [s]; BeiDou times sent in GPS time are read this much too late.
_BEIDOU_LATE_S: Final = 14
_MOSCOW_S: Final = 10_800.0
_GLONASS_RANGE: Final = range(-7, 7)


def _lock_table(bits: int) -> Floats:
    """Return the minimum lock time [s] for each lock time indicator, DF402 (4 bits) or DF407 (10 bits)."""
    if bits == 4:
        return np.array([0.0] + [2.0 ** (k + 4) for k in range(1, 16)]) * 1e-3
    steps = np.concatenate([np.ones(64), np.repeat(2.0 ** np.arange(1, 21), 32)])
    values = np.concatenate([[0.0], np.cumsum(steps)])[:705]
    return np.concatenate([values, np.full(1024 - 705, values[-1])]) * 1e-3


class ChannelNews(NamedTuple):
    """GLONASS frequency channels in order of reception, N rows."""

    place: Indices  #: Offset of the message in the stream, shape (N,); -1 for channels known from an earlier piece.
    number: Integers  #: GLONASS slot number, shape (N,).
    channel: Integers  #: Frequency channel of the satellite, shape (N,).

    def latest(self) -> dict[int, int]:
        """Return the last known channel of each satellite number."""
        return dict(zip(self.number.tolist(), self.channel.tolist(), strict=True))

    def at(self, place: Indices, numbers: Integers) -> Integers:
        """Return the channels known at the offsets `place`, shape (offsets, satellites); -99 where unknown."""
        found = np.full((len(place), len(numbers)), -99)
        for k, number in enumerate(numbers.tolist()):
            mine = self.number == number
            latest = np.searchsorted(self.place[mine], place) - 1
            found[:, k] = np.where(latest < 0, -99, np.append(self.channel[mine], -99)[latest])
        return found


def glonass_channels(frames: Frames, before: Mapping[int, int]) -> ChannelNews:
    """Return the channels in the mapping `before` and in messages 1020, for MSM4 and MSM6, which have no channels."""
    chosen = frames.of("rtcm3", 1020)
    bits = take_bits(frames, chosen, 23)
    known = (np.full(len(before), -1), *np.array([*before.items()], dtype=np.int64).reshape(-1, 2).T)
    new = (frames.frame_start[chosen], read_unsigned(bits, 12, 6), read_unsigned(bits, 18, 5) - 7)
    return ChannelNews(*(np.concatenate(parts) for parts in zip(known, new, strict=True)))


def msm_measurements(frames: Frames, near: np.datetime64, channels: ChannelNews) -> tuple[Measurements, Integers]:
    """Decode all MSM4 to MSM7 messages; return the measurements and the offset of each epoch in the stream.

    `near` must be within half a week of the first message. If `near` is NaT, messages are only counted.
    """
    messages = frames.of("rtcm3", *MSM_NUMBERS)
    parts = [
        (order, rows, np.full(len(order), SYSTEMS[number // 10]))
        for number in (() if np.isnat(near) else MSM_NUMBERS)
        for order, rows in _of_number(frames, number, near, channels)
    ]
    if not parts:
        undated = {UNDATED: len(messages)} if len(messages) else {}
        skipped = undated if np.isnat(near) else _count_unused(frames, messages, 0)
        return replace(no_measurements("RTCM 3"), skipped=skipped), np.zeros(0, dtype=np.int64)
    order = np.concatenate([order for order, _, _ in parts])
    rows = join_measurements([rows for _, rows, _ in parts])
    # Consecutive messages with the same time form one epoch; epochs stay in the order of the stream.
    by_stream = np.argsort(order, kind="stable")
    letter = np.concatenate([letters for _, _, letters in parts])[by_stream]
    glonass = letter == "R"
    time, shifted = _beidou_time(rows.time[by_stream], letter)
    time = _glonass_days(_in_rising_weeks(time, glonass), glonass)
    starts = np.concatenate([[True], time[1:] != time[:-1]])
    epoch_of = np.empty(len(order), dtype=np.intp)
    epoch_of[by_stream] = np.cumsum(starts) - 1
    measurements = replace(
        rows,
        time=time[starts],
        epoch=epoch_of[rows.epoch],
        receiver="RTCM 3",
        skipped={**_count_unused(frames, messages, len(order)), **({IN_GPS_TIME: shifted} if shifted else {})},
    )
    return measurements, order[by_stream][starts]


def _count_unused(frames: Frames, messages: Indices, used: int) -> dict[str, int]:
    """Count the MSM that have no satellites, and the other unused MSM (inconsistent masks or length)."""
    if len(messages) == used:
        return {}
    empty = int(np.count_nonzero(~take_bits(frames, messages, 137)[:, 73:137].any(axis=1)))
    counts = {"MSM without satellites": empty, "broken MSM": len(messages) - used - empty}
    return {what: number for what, number in counts.items() if number}


def _beidou_time(time: Datetimes, letter: Strings) -> tuple[Datetimes, int]:
    """Correct BeiDou times that an encoder sent in GPS time. Return all times and the number of corrections."""
    beidou, others = np.flatnonzero(letter == "C"), np.flatnonzero(np.isin(letter, list("GEJ")))
    if not len(beidou) or not len(others):
        return time, 0
    at = others[np.maximum(np.searchsorted(others, beidou) - 1, 0)]
    late_s = (time[beidou] - time[at]) / np.timedelta64(1, "s")
    if not abs(float(np.median(late_s)) - _BEIDOU_LATE_S) < 0.5:
        return time, 0
    moved = time.copy()
    moved[beidou] -= np.timedelta64(_BEIDOU_LATE_S, "s")
    return moved, len(beidou)


def _in_rising_weeks(time: Datetimes, glonass: Masks) -> Datetimes:
    """Shift times by weeks to within half a week of the previous time; GLONASS times only if all are GLONASS times."""
    counted = np.flatnonzero(~glonass) if not glonass.all() else np.arange(len(time))
    week = np.timedelta64(7, "D").astype("timedelta64[ns]")
    moved = time.copy()
    steps = np.rint(np.diff(time[counted]) / week).astype(np.int64)
    moved[counted[1:]] -= np.cumsum(steps) * week
    return moved


def _glonass_days(time: Datetimes, glonass: Masks) -> Datetimes:
    """Shift GLONASS times to the day of other systems, because some encoders always send day 0 (DF416)."""
    others = np.flatnonzero(~glonass)
    if not len(others) or not glonass.any():
        return time
    at = others[np.maximum(np.searchsorted(others, np.arange(len(time)), side="right") - 1, 0)]
    day = np.timedelta64(1, "D").astype("timedelta64[ns]")
    return np.asarray(time + np.rint((time[at] - time) / day).astype(np.int64) * day)


def take_bits(frames: Frames, chosen: Indices, length: int) -> Bytes:
    """Return at least the first `length` bits of each payload, in whole bytes; bits beyond the payload are 0."""
    octets = np.arange((length + 7) // 8)
    place = frames.start[chosen][:, None] + octets
    inside = octets < (frames.end - frames.start)[chosen][:, None]
    data = frames.data[np.minimum(place, len(frames.data) - 1)] if len(frames.data) else np.zeros(place.shape, np.uint8)
    return np.unpackbits(np.where(inside, data, 0).astype(np.uint8), axis=1)


def station_ecef_m(frames: Frames) -> tuple[float, float, float] | None:
    """Return the antenna reference point in the last message 1005 or 1006, ECEF [m], or None without such a message."""
    chosen = frames.of("rtcm3", 1005, 1006)
    if not len(chosen):
        return None
    bits = take_bits(frames, chosen[-1:], 152)
    x, y, z = (float(read_signed(bits, first, 38)[0]) * 1e-4 for first in (34, 74, 114))
    return x, y, z


def completes_epoch(frames: Frames, chosen: Indices) -> Masks:
    """Return whether each MSM is the last message of its epoch (DF393 is 0), shape (len(chosen),)."""
    return np.asarray(take_bits(frames, chosen, 56)[:, 54] == 0)


def find_unfinished_epoch(frames: Frames) -> int | None:
    """Return the offset of the last epoch's first message if the epoch is incomplete (DF393), else None."""
    chosen = frames.of("rtcm3", *MSM_NUMBERS)
    if not len(chosen):
        return None
    after = np.flatnonzero(completes_epoch(frames, chosen))
    tail = chosen[after[-1] + 1 :] if len(after) else chosen
    times = read_unsigned(take_bits(frames, tail, 56), 24, 30).tolist()
    first, seen = None, dict[int, int]()
    for index, time in zip(tail[::-1].tolist(), times[::-1], strict=True):
        if seen.setdefault(int(frames.kind[index]), time) != time:
            break
        first = int(frames.frame_start[index])
    return first


def _of_number(
    frames: Frames, number: int, near: np.datetime64, channels: ChannelNews
) -> Iterator[tuple[Integers, Measurements]]:
    """Yield the offsets and measurements of the messages with one number, in groups of messages with equal masks."""
    chosen = frames.of("rtcm3", number)
    if not len(chosen):
        return
    head = take_bits(frames, chosen, _HEADER_BITS + 64)
    n_satellites = head[:, 73:137].sum(axis=1).astype(np.int64)
    n_signals = head[:, 137:169].sum(axis=1).astype(np.int64)
    cells = n_satellites * n_signals
    plausible = (cells > 0) & (cells <= 64)
    if SYSTEMS[number // 10] != "R":  # one encoder writes 2^30 - 14 000 ms for BeiDou at the beginning of a week
        plausible &= read_unsigned(head, 24, 30) < 604_800_000
    used = np.where(np.arange(64) < cells[:, None], head[:, 169:233], 0)
    keys = np.packbits(np.concatenate([head[:, 73:169], used], axis=1), axis=1)
    length = (frames.end - frames.start)[chosen] * 8
    code, _, phase, _, lock, cn0, _, with_rate = _LAYOUT[number % 10]
    needed = _HEADER_BITS + cells + n_satellites * (36 if with_rate else 18)
    needed += used.sum(axis=1).astype(np.int64) * (code + phase + lock + 1 + cn0 + (15 if with_rate else 0))
    plausible &= needed <= length
    rows = np.flatnonzero(plausible)
    _, group, inverse = np.unique(keys[rows], axis=0, return_index=True, return_inverse=True)
    for k in range(len(group)):
        members = rows[inverse.reshape(-1) == k]
        bits = take_bits(frames, chosen[members], int(needed[members[0]]))
        satellites = np.flatnonzero(head[members[0], 73:137]) + 1
        signals = np.flatnonzero(head[members[0], 137:169]) + 1
        mask = used[members[0], : len(satellites) * len(signals)].reshape(len(satellites), len(signals)) == 1
        place = frames.frame_start[chosen[members]]
        known = channels.at(place, satellites)
        yield place, _decode(number, bits, satellites, signals, mask, near, known)


def _decode(
    number: int,
    bits: Bytes,
    satellites: Integers,
    signals: Integers,
    mask: np.ndarray,
    near: np.datetime64,
    known: Integers,
) -> Measurements:
    """Decode messages with equal masks. `known` has the GLONASS channels, for messages that do not contain channels."""
    system = SYSTEMS[number // 10]
    code_bits, code_step, phase_bits, phase_step, lock_bits, cn0_bits, cn0_step, with_rate = _LAYOUT[number % 10]
    n_satellites, n_cells = len(satellites), int(mask.sum())
    cursor = _HEADER_BITS + mask.size

    def block(count: int, length: int, *, two_complement: bool = False) -> Integers:
        nonlocal cursor
        part = bits[:, cursor : cursor + count * length].reshape(-1, length)
        cursor += count * length
        read = read_signed if two_complement else read_unsigned
        return read(part, 0, length).reshape(len(bits), count)

    whole_ms = block(n_satellites, 8)
    channel = block(n_satellites, 4) - 7 if with_rate else known
    rough_ms = np.where(whole_ms == 255, np.nan, whole_ms + block(n_satellites, 10) / 1024.0)
    rough_rate = block(n_satellites, 14, two_complement=True) if with_rate else np.full(rough_ms.shape, -8192)
    fine_code = block(n_cells, code_bits, two_complement=True)
    fine_phase = block(n_cells, phase_bits, two_complement=True)
    lock = _lock_table(lock_bits)[block(n_cells, lock_bits)]
    half = block(n_cells, 1) == 1
    cn0 = block(n_cells, cn0_bits) * cn0_step
    fine_rate = block(n_cells, 15, two_complement=True) if with_rate else np.full(fine_code.shape, -16384)
    of_satellite, of_signal = np.nonzero(mask)
    range_ms = rough_ms[:, of_satellite]
    code = np.where(fine_code == -(1 << code_bits - 1), np.nan, range_ms + fine_code * code_step) * _MS
    phase_m = np.where(fine_phase == -(1 << phase_bits - 1), np.nan, range_ms + fine_phase * phase_step) * _MS
    rate = rough_rate[:, of_satellite] + fine_rate * 1e-4
    rate = np.where((rough_rate[:, of_satellite] == -8192) | (fine_rate == -16384), np.nan, rate)
    names = np.array([f"{system}{k + 19 if system == 'S' else k:02d}" for k in satellites.tolist()])[of_satellite]
    codes = np.array([SIGNALS[system].get(k, "") for k in signals.tolist()])[of_signal]
    channel = channel[:, of_satellite]
    known_channel = np.isin(channel, list(_GLONASS_RANGE))
    frequency = frequency_by_name_hz(np.char.add(system, codes), np.where(known_channel, channel, np.nan))
    shape = (len(bits), n_cells)
    return Measurements(
        time=_times(system, bits, near),
        epoch=np.repeat(np.arange(len(bits)), n_cells),
        satellite=np.broadcast_to(names, shape).reshape(-1),
        signal=np.broadcast_to(codes, shape).reshape(-1),
        code_m=code.reshape(-1),
        phase_cycles=(phase_m * frequency / SPEED_OF_LIGHT).reshape(-1),
        doppler_hz=(-rate * frequency / SPEED_OF_LIGHT).reshape(-1),
        cn0_dbhz=np.where(cn0 > 0, cn0, np.nan).reshape(-1),
        lock_s=lock.reshape(-1),
        half_cycle=half.reshape(-1),
        polarity=np.zeros(shape[0] * shape[1], dtype=np.int64),
        glonass_channel=np.where(known_channel, channel, 99).reshape(-1),
    )


def _times(system: str, bits: Bytes, near: np.datetime64) -> Datetimes:
    """Return the GPS time of each message's epoch."""
    if system == "R":
        day, of_day = read_unsigned(bits, 24, 3), read_unsigned(bits, 27, 27) * 1e-3
        utc_s = day * 86_400.0 + of_day - _MOSCOW_S
        return utc_to_gpst(nearest_week(utc_s, np.full(len(bits), gpst_to_utc(near))))
    of_week = read_unsigned(bits, 24, 30) * 1e-3
    time = nearest_week(of_week, np.full(len(bits), near))
    return bdt_to_gpst(time) if system == "C" else time


def _sequence(codings: Mapping[str, Coding], names: str) -> dict[str, Field]:
    """Return the layout of consecutive fields after the message number."""
    lengths = [codings[name][0] for name in names.split()]
    places = np.cumsum([12, *lengths[:-1]]).tolist()
    return layout(codings, **dict(zip(names.split(), places, strict=True)))


_ORBIT: Final = "crs delta_n m0 cuc eccentricity cus sqrt_a toe_sow_s cic omega0 cis i0 crc omega omega_dot"
_GALILEO: Final = f"number week iod accuracy i_dot toc_s af2 af1 af0_s {_ORBIT} group_delay_1_s"
#: Layout of each ephemeris message, by message number; fields are in the order of transmission.
EPHEMERIDES: Final[dict[int, dict[str, Field]]] = {
    1019: _sequence(
        nav_messages.LNAV_CODINGS,
        f"number week accuracy codes i_dot iode toc_s af2 af1 af0_s iodc {_ORBIT} group_delay_1_s health flag fit",
    ),
    1044: _sequence(
        {**nav_messages.LNAV_CODINGS, "number": (4, 1, "u")},
        f"number toc_s af2 af1 af0_s iode {_ORBIT} i_dot codes week accuracy health group_delay_1_s iodc fit",
    ),
    1042: _sequence(
        nav_messages.BEIDOU_CODINGS,
        f"number week accuracy i_dot aode toc_s af2 af1 af0_s aodc {_ORBIT} group_delay_1_s group_delay_2_s health",
    ),
    1045: _sequence(nav_messages.GALILEO_CODINGS, f"{_GALILEO} e5a_health e5a_invalid"),
    1046: _sequence(
        nav_messages.GALILEO_CODINGS, f"{_GALILEO} group_delay_2_s e5b_health e5b_invalid e1b_health e1b_invalid"
    ),
    1020: _sequence(
        {**nav_messages.GLONASS_CODINGS, "health": (1, 1, "u")},
        "number channel almanac hour minute half_minute health p2 tb_s x_velocity x x_acceleration y_velocity y "
        "y_acceleration z_velocity z z_acceleration p3 relative_frequency p ln tau_s dtau age",
    ),
}


def ephemeris_fields(frames: Frames) -> Iterator[tuple[int, int, dict[str, float]]]:
    """Yield the offset in the stream, the message number and the fields of every ephemeris message."""
    for number, sent in EPHEMERIDES.items():
        chosen = frames.of("rtcm3", number)
        needed = max(first + length for first, length, _, _ in sent.values() if isinstance(first, int))
        chosen = chosen[(frames.end - frames.start)[chosen] * 8 >= needed]
        if not len(chosen):
            continue
        table = fields(take_bits(frames, chosen, needed), sent)
        for k, place in enumerate(frames.frame_start[chosen].tolist()):
            yield place, number, {name: float(values[k]) for name, values in table.items()}


#: For the week field of each ephemeris message, the GPS week in which the field was first 0, and its cycle [weeks].
_WEEKS: Final = {1045: (1024, 4096), 1046: (1024, 4096), 1042: (1356, 8192), 1019: (0, 1024), 1044: (0, 1024)}


#: GPS week in which MSM were introduced (July 2011, RTCM 10403.1 amendment 5). No log with MSM is older.
_FIRST_MSM_WEEK: Final = 1642


def ephemeris_date(frames: Frames, near: np.datetime64 | None) -> np.datetime64:
    """Return the median time of a log's ephemerides, to resolve the week of the observations; NaT without ephemerides.

    Only Galileo ephemerides are used. If there are none, only BeiDou ephemerides are used, and otherwise GPS and QZSS
    ephemerides. GPS and QZSS weeks are ambiguous (modulo 1024): the week nearest to `near` is used or, if `near` is
    None, the only possible week from July 2011, when MSM were introduced, to February 2031. The computer's clock is not
    used.
    """
    cycle_begin = _FIRST_MSM_WEEK
    if near is not None:
        cycle_begin = int((near - np.datetime64("1980-01-06", "D")) / np.timedelta64(7, "D")) - 512
    found: dict[int, list[np.datetime64]] = {}
    for _, number, values in ephemeris_fields(frames):
        if number in _WEEKS:
            origin, cycle = _WEEKS[number]
            week = int(values["week"]) + origin
            if cycle == 1024:
                week += -((week - cycle_begin) // cycle) * cycle
            found.setdefault(cycle, []).append(from_week([week], [values["toe_sow_s"]])[0])
    times = found.get(4096) or found.get(8192) or found.get(1024)
    return np.datetime64("NaT", "ns") if not times else np.sort(np.array(times))[len(times) // 2]
