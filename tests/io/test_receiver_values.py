"""Each field of measurements and positions of UBX, RTCM 3 and SBF, worked by hand: scale, sign, marks of absence, lock.

One measurement is plain; each case changes one of its fields, and what changes in what is read is stated.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.timescale import from_week
from railfix.gnss.navigation import Navigation
from railfix.io.receiver import nav_messages, rtcm, sbf, ubx
from railfix.io.receiver.ephemerides import assemble_navigation
from railfix.io.receiver.framing import Frames, find_frames
from railfix.io.receiver.log import StreamState, _sec_siglog, decode
from railfix.io.receiver.measurements import Measurements
from test_receiver_logs import rtcm_message
from test_receiver_rtcm import message, read_here
from test_receiver_sbf import block
from ubx_made import frame

pytestmark = pytest.mark.requirement("A8")

NONE = np.nan
L1 = 1575.42e6
NEAR = np.datetime64("2019-01-20", "ns")


def frames_of(data: bytes) -> Frames:
    return find_frames(np.frombuffer(data, np.uint8))


def check(read: Measurements, plain: dict[str, Any], expected: dict[str, Any]) -> None:
    """The first measurement has the plain values, the second these but for the expected ones."""
    for row, values in enumerate((plain, {**plain, **expected})):
        for name, value in values.items():
            found = getattr(read, name)[row]
            if isinstance(value, str):
                assert found == value, (row, name)
            else:
                np.testing.assert_allclose(float(found), value, rtol=1e-12, err_msg=f"{row} {name}")


# --- UBX (UBX-22008968, 3.17.7) -------------------------------------------------

UBX_PLAIN = {
    "satellite": "G07", "signal": "1C", "code_m": 22e6, "phase_cycles": -115e6, "doppler_hz": -1000.5,
    "cn0_dbhz": 44.0, "lock_s": 64.0, "half_cycle": 0, "polarity": 0,
}  # fmt: skip


def raw(**changes: float) -> bytes:
    """One measurement of RXM-RAWX."""
    sent: dict[str, Any] = {
        "code": 22e6, "phase": -115e6, "doppler": -1000.5, "gnss": 0, "sv": 7, "signal": 0, "channel": 0,
        "lock": 64_000, "cn0": 44, "code_std": 1, "phase_std": 1, "doppler_std": 1, "tracking": 7,
    } | changes  # fmt: skip
    return struct.pack("<ddfBBBBHBBBBBx", *sent.values())


def rawx(*rows: bytes, tow: float = 1000.25, week: int = 2081, status: int = 1, count: int | None = None) -> bytes:
    head = struct.pack("<dHbBBBxx", tow, week, 18, len(rows) if count is None else count, status, 1)
    return frame(0x0215, head + b"".join(rows))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"tracking": 15}, {"polarity": 1}),
        ({"tracking": 3}, {"half_cycle": 1}),
        ({"tracking": 5}, {"phase_cycles": NONE}),
        ({"tracking": 1}, {"phase_cycles": NONE}),
        ({"tracking": 6}, {"code_m": NONE}),
        ({"code": 0.0}, {"code_m": NONE}),
        ({"code": -1.0}, {"code_m": NONE}),
        ({"code": 9.9e9}, {"code_m": 9.9e9}),
        ({"code": 1e300}, {"code_m": NONE}),
        ({"code": np.inf}, {"code_m": NONE}),
        ({"phase": 0.0}, {"phase_cycles": NONE}),
        ({"phase": -0.5}, {"phase_cycles": NONE}),
        ({"phase": 0.5}, {"phase_cycles": 0.5}),
        ({"phase": -1e10}, {"phase_cycles": NONE}),
        ({"phase_std": 5}, {}),
        ({"phase_std": 0x15}, {}),
        ({"phase_std": 6}, {"phase_cycles": NONE}),
        ({"doppler": 0.0}, {"doppler_hz": 0.0}),
        ({"doppler": 1e10}, {"doppler_hz": NONE}),
        ({"cn0": 0}, {"cn0_dbhz": NONE}),
        ({"cn0": 1}, {"cn0_dbhz": 1.0}),
        ({"lock": 0}, {"lock_s": 0.0}),
        ({"lock": 1}, {"lock_s": 0.001}),
        ({"gnss": 1, "sv": 120}, {"satellite": "S20"}),
        ({"gnss": 2, "sv": 36, "signal": 5}, {"satellite": "E36", "signal": "7I"}),
        ({"gnss": 3, "sv": 59, "signal": 7}, {"satellite": "C59", "signal": "5P"}),
        ({"gnss": 5, "sv": 1, "signal": 9}, {"satellite": "J01", "signal": "5Q"}),
        ({"gnss": 6, "sv": 3, "signal": 2, "channel": 0}, {"satellite": "R03", "signal": "2C", "glonass_channel": -7}),
        ({"gnss": 6, "sv": 3, "channel": 13}, {"satellite": "R03", "glonass_channel": 6}),
        ({"gnss": 7, "sv": 5}, {"satellite": "I05", "signal": "5A"}),
        ({"gnss": 6, "sv": 255}, {"satellite": ""}),
        ({"gnss": 4, "sv": 1}, {"satellite": "", "signal": ""}),
        ({"gnss": 9, "sv": 1, "signal": 9}, {"satellite": "", "signal": ""}),
        ({"signal": 15}, {"signal": ""}),
        ({"signal": 200}, {"signal": ""}),
    ],
)
def test_fields_of_a_ubx_measurement(changes: dict[str, float], expected: dict[str, Any]) -> None:
    read = ubx.rawx_measurements(frames_of(rawx(raw(), raw(**changes))))
    check(read, UBX_PLAIN, expected)
    lost = int(any(abs(value) >= 1e10 for name, value in changes.items() if name in ("code", "phase")))
    assert read.skipped == ({"RXM-RAWX measurements with impossible values": 1} if lost else {})
    assert read.time.tolist() == [(np.datetime64("2019-11-24T00:16:40.25", "ns")).item()]


@pytest.mark.parametrize(
    ("head", "skipped"),
    [
        ({"count": 2}, {"broken RXM-RAWX": 1}),
        ({"count": 0}, {"broken RXM-RAWX": 1}),
        ({"week": 0}, {"RXM-RAWX without time": 1}),
        ({"week": 1}, {}),
        ({"week": 5200}, {}),
        ({"week": 5201}, {"RXM-RAWX without time": 1}),
        ({"week": 65_535}, {"RXM-RAWX without time": 1}),
        ({"tow": -0.001}, {"RXM-RAWX without time": 1}),
        ({"tow": 0.0}, {}),
        ({"tow": 604_799.999}, {}),
        ({"tow": 604_800.0}, {"RXM-RAWX without time": 1}),
    ],
)
def test_times_of_ubx_measurements_that_cannot_be_are_left_out(head: dict[str, Any], skipped: dict[str, int]) -> None:
    read = ubx.rawx_measurements(frames_of(rawx(raw(), **head)))
    assert read.skipped == skipped
    assert len(read.time) == len(read.code_m) == 1 - len(skipped)


@pytest.mark.parametrize(("status", "leap"), [(0, None), (1, 18), (2, None), (3, 18)])
def test_leap_seconds_count_where_the_receiver_knows_them(status: int, leap: int | None) -> None:
    assert ubx.rawx_measurements(frames_of(rawx(raw(), status=status))).leap_seconds == leap


DEGREES = (35.1234567, -135.7654321)


def nav_pvt(
    tow_ms: int = 100_000, *, fix: int = 3, flags: int = 1, valid: int = 3, date: tuple[int, int, int] = (2024, 3, 5)
) -> bytes:
    place = [round(value * 1e7) for value in (DEGREES[1], DEGREES[0])]
    head = struct.pack("<IHBB3xB8xBBBB", tow_ms, *date, valid, fix, flags, 0, 9)
    return frame(0x0107, head + struct.pack("<iiiiII", *place, 50_123, 20_000, 5_000, 7_000) + bytes(44))


def hpposllh(tow_ms: int = 100_000, flags: int = 0) -> bytes:
    """35.123456789 degrees, -135.765432198 degrees, 50.1228 m; errors of 0.5 m and 0.7 m."""
    place = [round(value * 1e7) for value in (DEGREES[1], DEGREES[0])]
    head = struct.pack("<BxxBIiiii", 0, flags, tow_ms, *place, 50_123, 20_000)
    return frame(0x0114, head + struct.pack("<bbbbII", -98, 89, -2, 0, 5_000, 7_000))


@pytest.mark.parametrize(
    ("fix", "flags", "quality"),
    [
        (3, 0x01, 5), (2, 0x01, 5), (4, 0x01, 5), (3, 0x03, 4), (3, 0x43, 2), (3, 0x83, 1), (3, 0x81, 1),
        (3, 0x00, None), (3, 0x82, None), (0, 0x01, None), (1, 0x01, None), (5, 0x01, None),
    ],
)  # fmt: skip
def test_quality_of_ubx_positions(fix: int, flags: int, quality: int | None) -> None:
    """RTK fixed 1 and float 2, differential 4, alone 5; none without a valid fix (UBX-22008968, 3.15.13)."""
    pvt = nav_pvt(fix=fix, flags=flags)
    for data, height_m in ((pvt, 50.123), (pvt + hpposllh(), 50.1228)):
        found = ubx.positions(frames_of(data), np.datetime64("2024-03-05", "ns"))
        assert found["quality"].tolist() == ([] if quality is None else [quality])
        fine = height_m == 50.1228
        degrees = (35.123456789, -135.765432198) if fine else DEGREES
        place = ecef_from_geodetic(np.array([degrees[0]]), np.array([degrees[1]]), np.array([height_m]))
        np.testing.assert_allclose(found["ecef_m"], place[: len(found["ecef_m"])], atol=2e-5)
        error = np.array([5.0, 7.0]) * (0.1 if fine else 1.0)
        sigma = [[error[0] / np.sqrt(2.0), error[0] / np.sqrt(2.0), error[1]]] * len(found["quality"])
        np.testing.assert_allclose(found["sigma_m"], np.reshape(sigma, (-1, 3)))
        time = np.datetime64("2024-03-04T00:01:40", "ns") - np.timedelta64(1, "D")
        assert found["time"].tolist() == [time.item()] * len(found["quality"])


def test_high_precision_positions_of_ubx() -> None:
    """Invalid ones are left out; of an instant without NAV-PVT they are of a receiver alone; no week, no position."""
    data = nav_pvt(100_000, flags=0x83) + hpposllh(100_000, flags=1) + hpposllh(101_000) + hpposllh(100_000, flags=2)
    near = np.datetime64("2024-03-05", "ns")
    assert ubx.positions(frames_of(data), near)["quality"].tolist() == [5, 1]
    for log in (data, nav_pvt()):
        assert len(ubx.positions(frames_of(log), np.datetime64("NaT", "ns"))["time"]) == 0


@pytest.mark.parametrize(("valid", "dated"), [(0, False), (1, False), (2, False), (3, True), (0xF7, True)])
def test_the_date_of_a_ubx_log_is_that_of_its_last_valid_position(valid: int, dated: bool) -> None:
    data = nav_pvt(86_400_000, valid=valid, date=(2023, 12, 31)) + nav_pvt(0, valid=0, date=(2001, 1, 1))
    frames = frames_of(data)
    assert str(ubx.find_date(frames))[:10] == ("2023-12-31" if dated else "NaT")
    places, times = ubx.clock_readings(frames)
    assert places.tolist() == [0] * dated
    assert [str(time)[:19] for time in times] == ["2024-01-01T00:00:00"] * dated


# --- RTCM 3 (10403.3, 3.5.16) ----------------------------------------------------

#: Bits of fine code and phase, of lock and C/N0, and whether rates are sent, by kind of message.
MSM = {4: (15, 22, 4, 6, False), 5: (15, 22, 4, 6, True), 6: (20, 24, 10, 10, False), 7: (20, 24, 10, 10, True)}
MS = SPEED_OF_LIGHT * 1e-3


def msm(number: int, *cells: dict[str, int], time: int = 204_236_600) -> bytes:
    """A message of one signal (number 2, or that of the first cell) of satellites 1, 2 and so on."""
    code, phase, lock, cn0, rates = MSM[number % 10]
    plain = {
        "ms": 70, "channel": 8, "rough": 512, "rate": 100, "code": 100, "phase": -200, "lock": 5, "half": 0, "cn0": 40,
        "fine_rate": 5000,
    }  # fmt: skip
    n = len(cells)
    sent = [{**plain, **cell} for cell in cells]
    signal = cells[0].get("signal", 2)
    fields = [(number, 12), (0, 12), (time, 30), (0, 19), (((1 << n) - 1) << 64 - n, 64), (1 << 32 - signal, 32)]
    fields += [((1 << n) - 1, n), *((cell["ms"], 8) for cell in sent)]
    fields += [(cell["channel"], 4) for cell in sent] if rates else []
    fields += [(cell["rough"], 10) for cell in sent]
    fields += [(cell["rate"] % (1 << 14), 14) for cell in sent] if rates else []
    for name, length in (("code", code), ("phase", phase), ("lock", lock), ("half", 1), ("cn0", cn0)):
        fields += [(cell[name] % (1 << length), length) for cell in sent]
    fields += [(cell["fine_rate"] % (1 << 15), 15) for cell in sent] if rates else []
    return rtcm_message(fields)


def read_msm(*messages: bytes) -> Measurements:
    return decode(b"".join(messages), StreamState(time=NEAR), at_end=True)[0].measurements


def msm_plain(kind: int, **changes: int) -> dict[str, Any]:
    """What a cell means, by the definitions of its fields."""
    cell = {"ms": 70, "rough": 512, "rate": 100, "code": 100, "phase": -200, "fine_rate": 5000} | changes
    short = kind < 6
    rough_ms = cell["ms"] + cell["rough"] / 1024
    phase_m = (rough_ms + cell["phase"] * 2.0 ** (-29 if short else -31)) * MS
    rate_mps = cell["rate"] + cell["fine_rate"] / 10_000
    return {
        "code_m": (rough_ms + cell["code"] * 2.0 ** (-24 if short else -29)) * MS,
        "phase_cycles": phase_m * L1 / SPEED_OF_LIGHT,
        "doppler_hz": -rate_mps * L1 / SPEED_OF_LIGHT if MSM[kind][4] else NONE,
        "cn0_dbhz": 40.0 if short else 2.5,
        "lock_s": 0.512 if short else 0.005,
        "half_cycle": 0,
    }


@pytest.mark.parametrize("kind", list(MSM))
def test_fields_of_an_rtcm_measurement(kind: int) -> None:
    code, phase, _, _, rates = MSM[kind]
    no_range = {"code_m": NONE, "phase_cycles": NONE}
    cases: list[tuple[dict[str, int], dict[str, Any]]] = [
        *(({name: value}, msm_plain(kind, **{name: value})) for name, value in
          (("ms", 1), ("ms", 254), ("rough", 1), ("rough", 1023), ("code", -100), ("phase", 123_456))),
        ({"ms": 255}, no_range),
        ({"code": -(1 << code - 1)}, {"code_m": NONE}),
        ({"code": 1 - (1 << code - 1)}, msm_plain(kind, code=1 - (1 << code - 1))),
        ({"phase": -(1 << phase - 1)}, {"phase_cycles": NONE}),
        ({"phase": (1 << phase - 1) - 1}, msm_plain(kind, phase=(1 << phase - 1) - 1)),
        ({"half": 1}, {"half_cycle": 1}),
        ({"cn0": 0}, {"cn0_dbhz": NONE}),
        ({"cn0": 1}, {"cn0_dbhz": 1.0 if kind < 6 else 0.0625}),
    ]  # fmt: skip
    rates_of = [("rate", -100), ("rate", -8191), ("fine_rate", -5000), ("fine_rate", -16_383)]
    cases += [({name: value}, msm_plain(kind, **{name: value})) for name, value in rates_of]
    cases += [({"rate": -8192}, {"doppler_hz": NONE}), ({"fine_rate": -16_384}, {"doppler_hz": NONE})]
    for changes, expected in cases:
        read = read_msm(msm(1070 + kind, {}, changes))
        assert read.satellite.tolist() == ["G01", "G02"]
        none = {"doppler_hz": NONE} if not rates and "doppler_hz" in expected else {}
        check(read, msm_plain(kind), expected | none)


#: Least times of lock [ms] by indicator, from the tables of DF402 and DF407 (10403.3, 3.4).
LOCK_MS = {
    4: {0: 0, 1: 32, 2: 64, 3: 128, 14: 262_144, 15: 524_288},
    7: {0: 0, 1: 1, 63: 63, 64: 64, 65: 66, 95: 126, 96: 128, 97: 132, 127: 252, 128: 256, 159: 504, 160: 512,
        671: 33_030_144, 672: 33_554_432, 703: 66_060_288, 704: 67_108_864},
}  # fmt: skip


@pytest.mark.parametrize(("kind", "indicator"), [(kind, k) for kind, table in LOCK_MS.items() for k in table])
def test_times_of_lock_of_rtcm(kind: int, indicator: int) -> None:
    read = read_msm(msm(1070 + kind, {"lock": indicator}))
    assert read.lock_s.tolist() == [pytest.approx(LOCK_MS[kind][indicator] * 1e-3, rel=1e-12)]


@pytest.mark.parametrize(
    ("tens", "signal", "satellite", "name", "frequency"),
    [
        (107, 2, "G01", "1C", L1), (107, 16, "G01", "2L", 1227.6e6), (107, 24, "G01", "5X", 1176.45e6),
        (109, 14, "E01", "7I", 1207.14e6), (110, 2, "S20", "1C", L1), (111, 9, "J01", "6S", 1278.75e6),
        (112, 2, "C01", "2I", 1561.098e6), (112, 8, "C01", "6I", 1268.52e6), (112, 31, "C01", "1P", L1),
        (107, 5, "G01", "", NONE),
    ],
)  # fmt: skip
def test_satellites_and_signals_of_rtcm(tens: int, signal: int, satellite: str, name: str, frequency: float) -> None:
    """Satellite 1 of each system, and cycles of its own carrier; a signal without a RINEX name has none."""
    read = read_msm(msm(tens * 10 + 7, {"signal": signal}))
    assert (read.satellite.tolist(), read.signal.tolist()) == ([satellite], [name])
    plain = msm_plain(7)
    assert read.phase_cycles[0] == pytest.approx(plain["phase_cycles"] * frequency / L1, rel=1e-12, nan_ok=True)
    assert read.doppler_hz[0] == pytest.approx(plain["doppler_hz"] * frequency / L1, rel=1e-12, nan_ok=True)


@pytest.mark.parametrize(
    ("sent", "channel", "frequency"),
    [(0, -7, 1598.0625e6), (7, 0, 1602e6), (13, 6, 1605.375e6), (14, 99, NONE), (15, 99, NONE)],
)
def test_channels_of_glonass_in_rtcm(sent: int, channel: int, frequency: float) -> None:
    read = read_msm(msm(1087, {"channel": sent}, time=2 << 27 | 42_000_000))
    assert (read.satellite.tolist(), read.glonass_channel.tolist()) == (["R01"], [channel])
    assert read.phase_cycles[0] == pytest.approx(msm_plain(7)["phase_cycles"] * frequency / L1, rel=1e-12, nan_ok=True)


@pytest.mark.parametrize(
    ("number", "sent_ms", "time"),
    [
        (1077, 204_236_600, "2019-01-22T08:43:56.600"),
        (1127, 204_236_600, "2019-01-22T08:44:10.600"),  # BeiDou time is 14 s behind GPS time
        (1087, 2 << 27 | 42_000_500, "2019-01-22T08:40:18.500"),  # 11:40 of Moscow, three hours and leap seconds
        (1077, 0, "2019-01-20T00:00:00.000"),
        (1077, 604_799_999, "2019-01-19T23:59:59.999"),  # the week that is nearest
        (1077, 604_800_000, ""),  # no time of a week
    ],
)
def test_times_of_rtcm(number: int, sent_ms: int, time: str) -> None:
    assert read_msm(msm(number, {}, time=sent_ms)).time.astype("M8[ms]").astype(str).tolist() == time.split()


def test_messages_of_one_instant_are_one_epoch() -> None:
    sent = ((1077, 70, 0), (1097, 71, 0), (1077, 72, 1000), (1097, 73, 1000))
    read = read_msm(*(msm(number, {"ms": ms}, time=204_236_600 + later) for number, ms, later in sent))
    found = zip(read.epoch.tolist(), read.satellite.tolist(), (read.code_m // MS).tolist(), strict=True)
    assert sorted(found) == [(0, "E01", 71), (0, "G01", 70), (1, "E01", 73), (1, "G01", 72)]


@pytest.mark.parametrize(("late_ms", "moved"), [(0, 0), (14_000, 2), (13_400, 0), (14_600, 0)])
def test_beidou_messages_in_gps_time_are_moved_and_counted(late_ms: int, moved: int) -> None:
    """An encoder that sends GPS time for BeiDou time, which is 14 s behind, gives times that are 14 s late."""
    tow_ms = 204_236_000
    data = [
        message
        for k in (0, 1000)
        for message in (msm(1077, {}, time=tow_ms + k), msm(1127, {}, time=tow_ms - 14_000 + late_ms + k))
    ]
    read = read_msm(*data)
    assert read.skipped.get(rtcm.IN_GPS_TIME, 0) == moved
    start = np.datetime64("2019-01-22T08:43:56", "ms")
    times = {start + np.timedelta64(k + shift, "ms") for k in (0, 1000) for shift in (0, 0 if moved else late_ms)}
    assert set(read.time.astype("M8[ms]").tolist()) == {time.item() for time in times}


# --- SBF (mosaic-X5 reference guide, 4.2.1) -----------------------------------------

SBF_PLAIN = {
    "satellite": "G01", "signal": "1C", "code_m": 22_345_678.901, "doppler_hz": -1234.5678, "cn0_dbhz": 47.0,
    "phase_cycles": 22_345_678.901 * L1 / SPEED_OF_LIGHT + 65.786, "lock_s": 9.0, "half_cycle": 0,
}  # fmt: skip


def first(n: int = 0, **changes: int) -> bytes:
    """A sub-block of type 1, with so many of type 2 after it."""
    sent = {
        "channel": 1, "type": 0, "sv": 1, "misc": 5, "code": 870_842_421, "doppler": -12_345_678, "lsb": 250, "msb": 1,
        "cn0": 148, "lock": 9, "info": 0,
    } | changes  # fmt: skip
    return struct.pack("<BBBBIiHbBHBB", *sent.values(), n)


def second(**changes: int) -> bytes:
    """A sub-block of type 2: L2L, 1.5 m and 0.25 Hz from the first signal."""
    sent = {
        "type": 3, "lock": 8, "cn0": 100, "offsets": 0, "msb": -1, "info": 0, "code": 1500, "lsb": 65_286,
        "doppler": 2500,
    } | changes  # fmt: skip
    return struct.pack("<BBBBbBHHH", *sent.values())


def read_sbf(*rows: bytes, n: int, week: int = 2367, tow_ms: int = 1000) -> Measurements:
    head = struct.pack("<IHBBBBBB", tow_ms, week, n, 20, 12, 0, 0, 0)
    return sbf.meas_epoch_measurements(frames_of(block(4027, head + b"".join(rows))))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"misc": 0, "code": 0}, {"code_m": NONE, "phase_cycles": NONE}),
        ({"misc": 0xF5}, {}),
        ({"doppler": -(1 << 31)}, {"doppler_hz": NONE}),
        ({"doppler": 5000}, {"doppler_hz": 0.5}),
        ({"msb": -128, "lsb": 0}, {"phase_cycles": NONE}),
        ({"msb": -128, "lsb": 1}, {"phase_cycles": SBF_PLAIN["phase_cycles"] - 65.786 - 8388.607}),
        ({"msb": 0, "lsb": 0}, {"phase_cycles": SBF_PLAIN["phase_cycles"] - 65.786}),
        ({"cn0": 255}, {"cn0_dbhz": NONE}),
        ({"cn0": 254}, {"cn0_dbhz": 73.5}),
        ({"lock": 65_535}, {"lock_s": 0.0}),
        ({"lock": 65_534}, {"lock_s": 65_534.0}),
        ({"lock": 255}, {"lock_s": 255.0}),
        ({"info": 4}, {"half_cycle": 1}),
        ({"info": 4, "msb": -128, "lsb": 0}, {"phase_cycles": NONE, "half_cycle": 0}),
        ({"info": 0xFB}, {"half_cycle": 0}),
        ({"type": 1}, {"signal": "1W", "cn0_dbhz": 37.0}),
        ({"type": 5}, {"signal": "1L"}),
        ({"type": 17}, {"satellite": "", "signal": ""}),  # a signal of Galileo
        ({"type": 31, "info": 0}, {"satellite": "", "signal": ""}),  # signal 32 is of QZSS
        ({"type": 31, "info": 0, "sv": 181}, {"satellite": "J01", "signal": "1L"}),
        ({"type": 31, "info": 1 << 3, "sv": 187}, {"satellite": "J07", "signal": "1Z"}),
        ({"type": 8, "sv": 38, "info": 1 << 3, "msb": -128, "lsb": 0},
         {"satellite": "R01", "phase_cycles": NONE, "glonass_channel": -7}),
        ({"type": 8, "sv": 61, "info": 14 << 3},
         {"satellite": "R24", "glonass_channel": 6,
          "phase_cycles": SBF_PLAIN["code_m"] * 1605.375e6 / SPEED_OF_LIGHT + 65.786}),
    ],
)  # fmt: skip
def test_fields_of_an_sbf_measurement(changes: dict[str, int], expected: dict[str, Any]) -> None:
    check(read_sbf(first(), first(**changes), n=2), SBF_PLAIN, expected)


L2 = 1227.6e6
SECOND = {
    "satellite": "G01", "signal": "2L", "code_m": SBF_PLAIN["code_m"] + 1.5, "lock_s": 8.0, "half_cycle": 0,
    "doppler_hz": -1234.5678 * L2 / L1 + 0.25, "cn0_dbhz": 35.0,
    "phase_cycles": (SBF_PLAIN["code_m"] + 1.5) * L2 / SPEED_OF_LIGHT - 0.25,
}  # fmt: skip


def further(metres: float) -> dict[str, float]:
    """The second signal with a code that is longer, and its phase with it."""
    cycles = metres * L2 / SPEED_OF_LIGHT
    return {"code_m": SECOND["code_m"] + metres, "phase_cycles": SECOND["phase_cycles"] + cycles}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, {}),
        ({"offsets": 1}, further(65.536)),
        ({"offsets": 7}, further(-65.536)),
        ({"offsets": 4, "code": 0}, {"code_m": NONE, "phase_cycles": NONE}),
        ({"offsets": 4}, further(-262.144)),
        ({"offsets": 0, "code": 0}, further(-1.5)),
        ({"offsets": 1 << 3}, {"doppler_hz": SECOND["doppler_hz"] + 6.5536}),
        ({"offsets": 31 << 3}, {"doppler_hz": SECOND["doppler_hz"] - 6.5536}),
        ({"offsets": 16 << 3, "doppler": 0}, {"doppler_hz": NONE}),
        ({"offsets": 16 << 3}, {"doppler_hz": SECOND["doppler_hz"] - 16 * 6.5536}),
        ({"doppler": 0}, {"doppler_hz": SECOND["doppler_hz"] - 0.25}),
        ({"msb": -128, "lsb": 0}, {"phase_cycles": NONE}),
        ({"cn0": 255}, {"cn0_dbhz": NONE}),
        ({"type": 2}, {"signal": "2W", "cn0_dbhz": 25.0}),
        ({"lock": 255}, {"lock_s": 0.0}),
        ({"lock": 254}, {"lock_s": 254.0}),
        ({"info": 4}, {"half_cycle": 1}),
    ],
)
def test_fields_of_a_further_sbf_signal(changes: dict[str, int], expected: dict[str, Any]) -> None:
    read = read_sbf(first(2), second(), second(**changes), first(), n=2)
    for name in ("satellite", "signal", "code_m"):
        assert getattr(read, name)[0] == getattr(read, name)[3] == SBF_PLAIN[name]
    after = {name: getattr(read, name)[1:] for name in SECOND}
    for name, value in {**SECOND, **expected}.items():
        plain, changed = after[name][0], after[name][1]
        for found, wanted in ((plain, SECOND[name]), (changed, value)):
            assert found == (wanted if isinstance(wanted, str) else pytest.approx(wanted, rel=1e-12, nan_ok=True)), name


@pytest.mark.parametrize(
    ("svid", "satellite", "signal"),
    [
        (37, "G37", 0), (38, "R01", 8), (61, "R24", 8), (62, "", 8), (63, "R25", 8), (68, "R30", 8), (69, "", 8),
        (71, "E01", 17), (106, "E36", 17), (120, "S20", 24), (140, "S40", 24), (141, "C01", 28), (180, "C40", 28),
        (191, "I01", 15), (197, "I07", 15), (198, "S41", 24), (215, "S58", 24), (223, "C41", 28), (245, "C63", 28),
    ],
)  # fmt: skip
def test_numbers_of_satellites_of_sbf(svid: int, satellite: str, signal: int) -> None:
    assert read_sbf(first(sv=svid, type=signal), n=1).satellite.tolist() == [satellite]


@pytest.mark.parametrize(
    ("head", "rows", "skipped"),
    [
        ({"tow_ms": 0xFFFFFFFF}, 1, {"MeasEpoch without time": 1}),
        ({"week": 0xFFFF}, 1, {"MeasEpoch without time": 1}),
        ({"n": 2}, 1, {"broken MeasEpoch": 1}),
    ],
)
def test_sbf_epochs_that_cannot_be_read_are_counted(head: dict[str, int], rows: int, skipped: dict[str, int]) -> None:
    read = read_sbf(*[first()] * rows, **{"n": rows, **head})
    assert (read.skipped, len(read.time), len(read.code_m)) == (skipped, 0, 0)
    assert read_sbf(first(1), n=1).skipped == {"broken MeasEpoch": 1}  # its further signal is missing


# --- navigation messages --------------------------------------------------------------

WEEK = 2367  #: GPS week of the pages.


def lnav(kind: int, *, letter: str = "G", **values: int) -> bytes:
    """GPSRawCA or QZSRawL1CA with a subframe of satellite 7 or J03; values as they are sent."""
    bits = [0] * 240
    orbit = {
        2: {"eccentricity": 1 << 26, "sqrt_a": int(5153.7 * 2**19), "toe_sow_s": 450},
        1: {"toc_s": 450, "week": WEEK % 1024},
    }
    for name, value in {"subframe": kind, "tow_s": 1200, **orbit.get(kind, {}), **values}.items():
        place, length, _, _ = nav_messages.LNAV[kind][name]
        pieces = place if isinstance(place, tuple) else ((place, length),)
        text = f"{value % (1 << length):0{length}b}"
        for start, count in pieces:
            bits[start : start + count] = [int(bit) for bit in text[:count]]
            text = text[count:]
    bits[:8] = [1, 0, 0, 0, 1, 0, 1, 1]
    words = [int("".join(map(str, bits[24 * k : 24 * k + 24])), 2) << 6 for k in range(10)]
    number, sv = (4017, 7) if letter == "G" else (4066, 183)
    return block(number, struct.pack("<IHBBBBBB10I", 7_200_000, WEEK, sv, 1, 0, 0, 0, 0, *words))


def navigation(*data: bytes) -> Navigation:
    return assemble_navigation(decode(b"".join(data), StreamState(time=NEAR), at_end=True)[0].ephemerides)


@pytest.mark.parametrize(
    ("letter", "page_sv", "data_id", "taken"),
    [("G", 56, 1, True), ("G", 57, 1, False), ("G", 56, 0, False), ("J", 56, 3, True), ("J", 61, 3, False)],
)
def test_ionosphere_and_leap_seconds_of_lnav(letter: str, page_sv: int, data_id: int, taken: bool) -> None:
    """Units of IS-GPS-200, table 20-X; leap seconds are taken of GPS alone."""
    sent = {f"ion{k}": value for k, value in enumerate((1, 2, -3, -4, 5, -6, 7, -128))}
    found = navigation(lnav(4, letter=letter, page_sv=page_sv, data_id=data_id, leap_seconds=18, **sent))
    scaled = [2.0**-30, 2.0**-26, -3 * 2.0**-24, -4 * 2.0**-24, 5 * 2.0**11, -6 * 2.0**14, 7 * 2.0**16, -(2.0**23)]
    assert {name: value.tolist() for name, value in found.klobuchar.items()} == ({letter: scaled} if taken else {})
    assert found.leap_seconds == (18 if taken and letter == "G" else None)


@pytest.mark.parametrize(
    ("iodc", "iode_2", "iode_3", "made"),
    [(0x14D, 0x4D, 0x4D, 1), (0x14D, 0x4E, 0x4D, 0), (0x14D, 0x4D, 0x4E, 0), (0x14E, 0x4D, 0x4D, 0)],
)
def test_lnav_subframes_of_two_issues_make_no_record(iodc: int, iode_2: int, iode_3: int, made: int) -> None:
    found = navigation(lnav(1, iodc=iodc), lnav(2, iode=iode_2), lnav(3, iode=iode_3)).kepler
    assert found.iodc.tolist() == [iodc] * made
    assert found.iode.tolist() == [iode_2] * made


@pytest.mark.parametrize(("fit", "hours"), [(0, 4.0), (1, 6.0)])
def test_fields_of_an_lnav_record(fit: int, hours: float) -> None:
    record = navigation(
        lnav(1, accuracy=3, health=33, group_delay_1_s=-5, af0_s=-(1 << 20), af1=-7, af2=3, codes=2),
        lnav(2, fit=fit, crs=-64, cuc=-(1 << 14)),
        lnav(3, i_dot=-16, omega_dot=-1000),
    ).kepler
    assert record.satellite.tolist() == ["G07"]
    expected = {
        "accuracy_m": 5.7, "health": 33, "group_delay_1_s": -5 * 2.0**-31, "af0_s": -(2.0**-11), "af1": -7 * 2.0**-43,
        "af2": 3 * 2.0**-55, "crs": -2.0, "cuc": -(2.0**-15), "i_dot": -16 * 2.0**-43 * np.pi, "data_source": 2,
        "omega_dot": -1000 * 2.0**-43 * np.pi, "toe_sow_s": 7200.0, "fit_interval_h": hours,
    }  # fmt: skip
    for name, value in expected.items():
        assert float(getattr(record, name)[0]) == pytest.approx(value, rel=1e-12), name
    start = from_week(WEEK, 7200.0)
    assert record.toc[0] == record.toe[0] == record.transmitted[0] == start


URA_M = (2, 2.8, 4, 5.7, 8, 11.3, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192)
SISA_M = {0: 0.0, 49: 0.49, 50: 0.5, 74: 0.98, 75: 1.0, 99: 1.96, 100: 2.0, 125: 6.0, 126: NONE, 255: NONE}


@pytest.mark.parametrize(
    ("number", "index", "metres"),
    [*((number, k, value) for number in (1019, 1042) for k, value in enumerate(URA_M)),
     *((number, k, value) for number in (1045, 1046) for k, value in SISA_M.items())],
)  # fmt: skip
def test_accuracy_of_ephemerides_by_index(number: int, index: int, metres: float) -> None:
    """Nominal values of IS-GPS-200 and BDS-SIS-ICD; signal-in-space accuracy of Galileo (OS SIS ICD, table 89)."""
    record = read_here(message(number, 0, {"number": 7, "toc_s": 0, "toe_sow_s": 0, "accuracy": index})).kepler
    assert record.accuracy_m.tolist() == [pytest.approx(metres, rel=1e-12, nan_ok=True)]


@pytest.mark.parametrize(
    ("name", "value", "health"),
    [("e1b_invalid", 1, 1), ("e1b_health", 3, 3 << 1), ("e5b_invalid", 1, 1 << 6), ("e5b_health", 2, 2 << 7)],
)
def test_health_of_galileo_is_packed_as_in_rinex(name: str, value: int, health: int) -> None:
    """E1-B in bits 0 to 2, E5a in 3 to 5, E5b in 6 to 8: validity first, then the two bits of the signal."""
    fields = {"e1b_invalid": 0, "e1b_health": 0, "e5b_invalid": 0, "e5b_health": 0, name: value}
    record = read_here(message(1046, 0, {"number": 7, "toc_s": 0, "toe_sow_s": 0, **fields})).kepler
    assert record.health.tolist() == [health]


@pytest.mark.requirement("A8")
def test_a_message_that_is_broken_counts_unless_it_lies_inside_another() -> None:
    """Bytes that look like a message within the payload of a good one are its content."""
    broken = bytearray(frame(0x0A04, bytes(8)))
    broken[-1] ^= 1
    good = frame(0x0A04, bytes(4) + bytes(broken) + bytes(4))
    for parts, bad in (((good,), 0), ((broken, good), 1), ((good, broken, good), 1), ((broken, good, broken), 2)):
        found = find_frames(np.frombuffer(b"".join(parts), dtype=np.uint8))
        assert (found.bad_checksums, len(found.start)) == (bad, parts.count(good))
        assert found.skipped_bytes == len(broken) * bad


@pytest.mark.parametrize(
    ("data", "protocol", "kind"),
    [(frame(0x0A04, b""), "ubx", 0x0A04), (rtcm_message([(4095, 12)]), "rtcm3", 4095), (block(5914, b""), "sbf", 5914),
     (b"$GPA*56\r\n", "nmea", 0), (b"$G1A*37\r\n", "nmea", 0), (b"$1PA*20\r\n", "", 0), (b"$G-A*2B\r\n", "", 0)],
)  # fmt: skip
def test_the_shortest_message_of_a_protocol_is_found(data: bytes, protocol: str, kind: int) -> None:
    """A sentence begins with a letter, and then a letter or digit."""
    found, expected = frames_of(data), ([protocol], [kind], 0) if protocol else ([], [], len(data))
    assert (found.protocol.tolist(), found.kind.tolist(), found.skipped_bytes) == expected


@pytest.mark.requirement("B8")
def test_a_log_of_signals_without_events_says_that_there_is_none() -> None:
    nothing = np.array([1, 0, 0, 0, 0, 0, 0, 0], dtype=np.uint8)
    found = _sec_siglog(nothing)
    assert found[0] == 0
    assert _sec_siglog(nothing[:7]) is None
    assert _sec_siglog(np.append(nothing, np.zeros(14, np.uint8))) is None
