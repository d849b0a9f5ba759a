"""Ephemeris messages of RTCM 3 with random contents, decoded here and by RTKLIB (pyrtklib5)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import railfix
from railfix.core.errors import InputFileError
from railfix.gnss.navigation import Navigation
from railfix.io.receiver.ephemerides import assemble_navigation
from railfix.io.receiver.log import StreamState, decode
from railfix.io.receiver.rtcm import EPHEMERIDES
from test_receiver_logs import msm4, rtcm_message

pytestmark = pytest.mark.requirement("A8")

TIME = np.datetime64("2023-08-17T02:00", "ns")
GPS_WEEK = 2275
WEEK = np.datetime64("2023-08-13", "ns")
#: Names of RTKLIB's ephemeris by the fields of records.
NAMES = {
    "af0_s": "f0", "af1": "f1", "af2": "f2", "eccentricity": "e", "m0": "M0", "delta_n": "deln", "omega0": "OMG0",
    "i0": "i0", "omega": "omg", "omega_dot": "OMGd", "i_dot": "idot", "cuc": "cuc", "cus": "cus", "crc": "crc",
    "crs": "crs", "cic": "cic", "cis": "cis", "toe_sow_s": "toes", "health": "svh", "iode": "iode",
}  # fmt: skip
#: Letter and name of the system, and message of the records, by the number of the message.
KINDS = {
    1019: ("G", "SYS_GPS", "LNAV"),
    1044: ("J", "SYS_QZS", "LNAV"),
    1042: ("C", "SYS_CMP", "D1"),
    1045: ("E", "SYS_GAL", "FNAV"),
    1046: ("E", "SYS_GAL", "INAV"),
}
WEEKS = {k: GPS_WEEK - {"G": 2048, "J": 2048, "C": 1356, "E": 1024}[letter] for k, (letter, _, _) in KINDS.items()}
#: Bits of a message with fields behind those that are read.
LENGTHS = {1020: 360}
#: Units of toc and toe.
UNIT_S = {1019: 16, 1044: 16, 1042: 8, 1045: 60, 1046: 60}


def message(kind: int, seed: int, chosen: dict[str, int]) -> bytes:
    """A message of random fields but for those that are chosen, and those that an orbit limits."""
    rng = np.random.default_rng([kind, seed])
    drift = int(rng.integers(-(2**21), 2**21)) % 2**24  # of the node: RINEX files have no faster one
    chosen = {"eccentricity": 2**26 + seed, "sqrt_a": 5400 * 2**19 + seed, "omega_dot": drift, **chosen}
    fields = [(kind, 12)]
    for name, (_, length, _, _) in EPHEMERIDES[kind].items():
        fields.append((chosen.get(name, int(rng.integers(0, 1 << length))), length))
    missing = LENGTHS.get(kind, 0) - sum(length for _, length in fields)
    return rtcm_message([*fields, (0, max(missing, 0))])


def read_here(*messages: bytes, time: np.datetime64 = TIME) -> Navigation:
    piece, _ = decode(b"".join(messages), StreamState(time=time), at_end=True)
    return assemble_navigation(piece.ephemerides)


def rtklib(time: np.datetime64 = TIME) -> tuple[Any, Any]:
    rtk = pytest.importorskip("pyrtklib5", reason="the independent decoder is not installed")
    rtcm = rtk.rtcm_t()
    rtk.init_rtcm(rtcm)
    rtcm.time = rtk.gpst2time(GPS_WEEK, float((time - WEEK) / np.timedelta64(1, "s")))
    return rtk, rtcm


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("number", list(KINDS))
def test_ephemeris(number: int, seed: int) -> None:
    letter, system, kind = KINDS[number]
    slot = 7
    tow = 4 * 86_400 // UNIT_S[number]
    sent = message(number, seed, {"number": slot, "week": WEEKS[number], "toc_s": tow, "toe_sow_s": tow})
    rtk, rtcm = rtklib()
    results = [rtk.input_rtcm3(rtcm, octet) for octet in sent]
    assert results[-1] == 2
    prn = slot + 192 if letter == "J" else slot
    satellite = rtk.satno(getattr(rtk, system), prn)
    theirs = rtcm.nav.eph[satellite - 1 + (rtk.MAXSAT if kind == "FNAV" else 0)]
    assert theirs.sat == satellite
    records = read_here(sent).kepler
    assert records.satellite.tolist() == [f"{letter}{slot:02d}"]
    assert records.message.tolist() == [kind]
    for name, other in NAMES.items():
        assert float(getattr(records, name)[0]) == pytest.approx(float(getattr(theirs, other)), rel=1e-14, abs=0.0), (
            name
        )
    assert records.sqrt_a[0] ** 2 == pytest.approx(theirs.A, rel=1e-14, abs=0.0)
    assert records.group_delay_1_s[0] == pytest.approx(theirs.tgd[0], rel=1e-14, abs=0.0)
    if number in (1042, 1046):
        assert records.group_delay_2_s[0] == pytest.approx(theirs.tgd[1], rel=1e-14, abs=0.0)
    elif letter in "GJ":
        assert records.iodc[0] == theirs.iodc
    else:
        assert np.isnan(records.group_delay_2_s[0])
    for name in ("toe", "toc"):
        seconds = rtk.timediff(getattr(theirs, name), rtk.gpst2time(GPS_WEEK, 0.0))
        since = (getattr(records, name)[0] - WEEK) / np.timedelta64(1, "s")
        assert since == seconds == 4 * 86_400 + (14 if letter == "C" else 0), name


@pytest.mark.parametrize("number", list(KINDS))
@pytest.mark.parametrize(("received_s", "week", "toe_s"), [(604_200, 0, 0), (604_200, 0, 603_600), (900, 1, 603_600)])
def test_ephemeris_at_the_end_of_a_week(number: int, received_s: int, week: int, toe_s: int) -> None:
    """Messages name the week of their transmission, which is not that of toe: by hand, and by RTKLIB."""
    time = WEEK + np.timedelta64(received_s + 604_800 * week, "s")
    toe = toe_s // UNIT_S[number]
    sent = message(number, 0, {"number": 7, "week": WEEKS[number] + week, "toc_s": toe, "toe_sow_s": toe})
    letter, system, kind = KINDS[number]
    expected = toe * UNIT_S[number] + (604_800 if toe_s == 0 else 0) + (14 if letter == "C" else 0)
    records = read_here(sent, time=time).kepler
    assert [(records.toe[0] - WEEK) / np.timedelta64(1, "s"), (records.toc[0] - WEEK) / np.timedelta64(1, "s")] == (
        [expected] * 2
    )
    rtk, rtcm = rtklib(time)
    assert [rtk.input_rtcm3(rtcm, octet) for octet in sent][-1] == 2
    satellite = rtk.satno(getattr(rtk, system), 7 + (192 if letter == "J" else 0))
    theirs = rtcm.nav.eph[satellite - 1 + (rtk.MAXSAT if kind == "FNAV" else 0)]
    assert rtk.timediff(theirs.toe, rtk.gpst2time(GPS_WEEK, 0.0)) == expected


def test_satellites_without_a_date_are_named(tmp_path: Path) -> None:
    """GLONASS carries no date; Galileo has the full week, GPS that modulo 1024, and they date a log."""
    chosen = {"number": 7, "toc_s": 5400, "toe_sow_s": 5400, "eccentricity": 2**23}
    gps = message(1019, 0, {**chosen, "week": WEEKS[1019], "sqrt_a": int(5153.7 * 2**19)})
    galileo = message(1046, 0, {**chosen, "week": WEEKS[1046], "sqrt_a": int(5440.6 * 2**19)})
    path = tmp_path / "caster.rtcm3"
    path.write_bytes(gps + galileo)
    navigation = railfix.read_navigation(path)
    dated = railfix.read_navigation(path, date="2023-08-17")
    for found in (navigation, dated):
        assert found.kepler.satellite.tolist() == ["G07", "E07"]
        assert not found.notes
        assert ((found.kepler.toe - WEEK) / np.timedelta64(1, "s")).tolist() == [5400 * UNIT_S[k] for k in (1019, 1046)]
    path.write_bytes(gps)  # the first week of its number since MSM were defined, whatever the clock says
    assert railfix.read_navigation(path).kepler.toe.tolist() == navigation.kepler.toe[:1].tolist()
    later = np.datetime64("2023-08-17") + np.timedelta64(1024 * 7, "D")
    of_later = railfix.read_navigation(path, date=later).kepler.toe[0]
    assert (of_later - navigation.kepler.toe[0]) / np.timedelta64(7, "D") == 1024
    place = {name: km * 2**11 for name, km in (("x", 15_000), ("y", 12_000), ("z", 17_000))}
    path.write_bytes(
        message(1020, 0, {"number": 5, "channel": 4, "p": 0, "hour": 4, "minute": 15, "tb_s": 18, **place})
    )
    with pytest.raises(InputFileError, match=r"the ephemerides of R05 have no full date; give a date \(--date\)"):
        railfix.read_navigation(path)


def test_galileo_sends_both_messages_in_turn() -> None:
    """F/NAV and I/NAV of one satellite are two records, each taken once."""
    chosen = {"number": 7, "week": WEEKS[1045], "toc_s": 5760, "toe_sow_s": 5760}
    both = [message(kind, 0, chosen) for kind in (1045, 1046)]
    navigation = read_here(*both, *both, *both)
    assert navigation.kepler.satellite.tolist() == ["E07", "E07"]
    assert sorted(navigation.kepler.message.tolist()) == ["FNAV", "INAV"]
    assert not navigation.skipped


@pytest.mark.parametrize("seed", range(10))
def test_glonass_ephemeris(seed: int) -> None:
    place = {name: km * 2**11 + seed for name, km in (("x", 15_000), ("y", 12_000), ("z", 17_000))}
    of_day = {"hour": 4, "minute": 15, "half_minute": 0, "tb_s": 18}
    sent = message(1020, seed, {"number": 5, "channel": 4, "p": 0, **place, **of_day})
    rtk, rtcm = rtklib()
    assert [rtk.input_rtcm3(rtcm, octet) for octet in sent][-1] == 2
    theirs = rtcm.nav.geph[4]
    records = read_here(sent).glonass
    assert records.satellite.tolist() == ["R05"]
    for k in range(3):
        assert records.position_ecef_m[0, k] == pytest.approx(theirs.pos[k], rel=1e-14, abs=0.0)
        assert records.velocity_ecef_mps[0, k] == pytest.approx(theirs.vel[k], rel=1e-14, abs=0.0)
        assert records.acceleration_ecef_mps2[0, k] == pytest.approx(theirs.acc[k], rel=1e-14, abs=1e-20)
    assert records.clock_bias_s[0] == pytest.approx(-theirs.taun, rel=1e-14, abs=0.0)  # tau of a slow clock > 0
    assert records.relative_frequency[0] == pytest.approx(theirs.gamn, rel=1e-14, abs=0.0)
    assert records.frequency_channel[0] == theirs.frq == -3
    assert records.health[0] == bool(theirs.svh & 0b1001)  # B_n and l_n; the others are of the almanac
    seconds = rtk.timediff(theirs.toe, rtk.gpst2time(GPS_WEEK, 0.0))
    assert (records.toe[0] - WEEK) / np.timedelta64(1, "s") == pytest.approx(seconds)


def test_ten_days_in_one_piece() -> None:
    """An epoch an hour over two ends of weeks, with a GLONASS ephemeris each day, of 1:15 UTC."""
    hours = 4 * 24 + 2 + np.arange(240)  # TIME is 2:00 on a Thursday
    parts, days = [], []
    for hour in hours.tolist():
        tow_ms = hour * 3_600_000
        glonass = (hour // 24 % 7) << 27 | (tow_ms + 18_000_000 - 18_000 - 7_200_000) % 86_400_000
        parts += [msm4(1074, tow_ms % 604_800_000), msm4(1084, glonass), msm4(1124, (tow_ms - 14_000) % 604_800_000)]
        if hour % 24 == 1:
            place = {"x": 15_000 * 2**11, "y": 12_000 * 2**11, "z": 17_000 * 2**11, "number": 5, "channel": 4}
            parts.append(message(1020, 0, {**place, "hour": 4, "minute": 13, "half_minute": 0, "tb_s": 17}))
            days.append(WEEK + np.timedelta64(hour // 24, "D"))
    piece, _ = decode(b"".join(parts), StreamState(time=TIME), at_end=True)
    assert piece.measurements.time.tolist() == (WEEK + hours * np.timedelta64(3600, "s")).astype("M8[ns]").tolist()
    assert not piece.measurements.skipped
    toe = assemble_navigation(piece.ephemerides).glonass.toe
    assert toe.tolist() == (np.array(days) + np.timedelta64(75 * 60 + 18, "s")).astype("M8[ns]").tolist()


@pytest.mark.requirement("A12")
@pytest.mark.parametrize("kind", [1005, 1006])
def test_the_position_of_a_base_station_is_that_of_its_last_message(kind: int) -> None:
    """The example of message 1005 of RTCM 10403.3 (section 4.2), and the same as 1006."""
    x, y, z = 1114104.5999, -4850729.7108, 3975521.4643
    data = bytes.fromhex("d300133ed7d30202980edeef34b4bd62ac0941986f33360b98")
    if kind == 1006:
        fields = [(round(value * 1e4) & (1 << 38) - 1, 38) for value in (x, y, z)]
        gap = (0, 2)
        data = rtcm_message([(1006, 12), (2003, 12), (8, 10), fields[0], gap, fields[1], gap, fields[2], (15000, 16)])
    piece, state = decode(data, StreamState(), at_end=True)
    assert piece.station == pytest.approx((x, y, z), abs=1e-4)
    assert decode(b"", state)[0].station == piece.station
