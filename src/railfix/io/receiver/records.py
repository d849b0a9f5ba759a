"""Navigation records from the fields of broadcast messages, whichever way they were received."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes
from railfix.core.timescale import from_week, gpst_minus_utc, nearest_week, seconds, timedelta, to_week
from railfix.io.receiver import nav_messages
from railfix.io.rinex.navigation_records import RawRecord, fields_of

Values = Mapping[str, float]
#: A record, and what tells it from the satellite's next one.
Record = tuple[RawRecord, tuple[float, ...]]

_GALILEO_WEEK_MINUS_GPS: Final = 1024
_BDS_WEEK_MINUS_GPS: Final = 1356
#: Data source of Galileo: the clock is that of E5a and E1.
_E5A_CLOCK: Final = 1 << 8
_MOSCOW_S: Final = 3 * 3600.0


def gps_record(satellite: str, values: Values, time: np.datetime64) -> Record:
    """Record of GPS or QZSS from the fields of LNAV subframes 1 to 3, or of RTCM 1019 or 1044.

    `time`, when it was received to within some years, resolves the week.
    """
    week, epoch = _week_and_toc(values, _near_week(values["week"], 1024, time), time)
    numbers = {
        **values,
        "data_source": values["codes"],
        "accuracy_m": nav_messages.URA_NOMINAL_M[int(values["accuracy"])],
        "group_delay_2_s": values["iodc"],
        "transmitted": values.get("tow_s", np.nan),
        "fit": (6.0 if values["fit"] else 4.0) if satellite[0] == "G" else values["fit"],
        "week": float(week),
    }
    return _raw(satellite, "LNAV", epoch, numbers), _issue(values, "iodc", "toe_sow_s", "toc_s", "health")


def cnav_record(satellite: str, values: Values) -> Record:
    """Record of GPS or QZSS from the fields of CNAV messages 10, 11 and 30 (13 bits of the week: no date is needed)."""
    sent = from_week(int(values["week"]), values["tow_s"])
    toc = nearest_week(values["toc_s"], sent)
    delays = ("group_delay_1_s", *(f"inter_signal_{k}" for k in range(4)))
    numbers = {
        **values,
        **{name: np.nan if values[name] == nav_messages.CNAV_NO_DELAY_S else values[name] for name in delays},
        "sqrt_a": float(np.sqrt(nav_messages.CNAV_AXIS_M[satellite[0]] + values["delta_a"])),
        "omega_dot": nav_messages.CNAV_OMEGA_DOT + values["delta_omega_dot"],
        "transmitted": values["tow_s"],
        "week": float(int(values["week"]) // 256 * 256 + int(values["week_top"])),
    }
    return _raw(satellite, "CNAV", toc, numbers), _issue(values, "toe_sow_s", "top", "health", "m0", "af0_s")


def galileo_record(satellite: str, values: Values, time: np.datetime64) -> Record:
    """Record of Galileo: I/NAV from the fields of its words 1 to 5 or of RTCM 1046, F/NAV from those of RTCM 1045."""
    week, epoch = _week_and_toc(values, int(values["week"]) + _GALILEO_WEEK_MINUS_GPS, time)
    health = 0
    for signal, bit in (("e5b", 6), ("e5a", 3), ("e1b", 0)):  # as RINEX packs them
        if f"{signal}_health" in values:
            health |= int(values[f"{signal}_health"]) << bit + 1 | int(values[f"{signal}_invalid"]) << bit
    numbers = {
        **values,
        "iode": values["iod"],
        "data_source": values["source"],
        "accuracy_m": float(nav_messages.sisa_m(np.asarray(values["accuracy"]))),
        "health": float(health),
        "transmitted": values.get("tow_s", np.nan),
        "week": float(week),
    }
    message = "FNAV" if int(values["source"]) & _E5A_CLOCK else "INAV"
    return _raw(satellite, message, epoch, numbers), (*_issue(values, "iod", "toe_sow_s", "source"), float(health))


def beidou_record(satellite: str, message: str, values: Values, time: np.datetime64) -> Record | None:
    """Record of BeiDou from the fields of D1, D2 or RTCM 1042; None where the parts are of two issues."""
    if values["toc_s"] != values["toe_sow_s"]:  # one issue has one reference time (ICD, 5.2.4.9)
        return None
    week, epoch = _week_and_toc(values, int(values["week"]) + _BDS_WEEK_MINUS_GPS, time)
    numbers = {
        **values,
        "iode": values["aode"],
        "data_source": 0.0,
        "accuracy_m": nav_messages.URA_NOMINAL_M[int(values["accuracy"])],
        "transmitted": values.get("tow_s", np.nan),
        "fit": values["aodc"],
        "week": float(week - _BDS_WEEK_MINUS_GPS),
    }
    return _raw(satellite, message, epoch, numbers), _issue(values, "aode", "aodc", "toe_sow_s", "health")


def glonass_record(satellite: str, values: Values, time: np.datetime64) -> Record:
    """Record of GLONASS from the fields of its strings 1 to 4, or of RTCM 1020; `time` resolves the day."""
    epoch = _near_day(values["tb_s"] - _MOSCOW_S, _utc(time))
    _, message_time = to_week(_near_day(_frame_s(values), _utc(time)))
    numbers = {
        **values,
        "health": float(bool(values["health"]) or bool(values["ln"])),  # either stops the use (ICD, 4.4, B_n and l_n)
        "clock_bias": -values["tau_s"],
        "message_time": float(message_time),
        "frequency_channel": values["channel"],
    }
    issue = (*_issue(values, "tb_s", "health", "ln"), float(epoch.astype(np.int64)))
    return _raw(satellite, "", epoch, numbers), issue


def frame_time(values: Values, time: np.datetime64) -> Datetimes:
    """When the GLONASS frame of a string 1 began, GPS time."""
    utc = _utc(time)
    return np.asarray(time + (_near_day(_frame_s(values), utc) - utc))


def _frame_s(values: Values) -> float:
    return values["hour"] + values["minute"] + values["half_minute"] - _MOSCOW_S


def _utc(time: np.datetime64) -> Datetimes:
    return np.asarray(time - gpst_minus_utc(time).astype("timedelta64[s]"), dtype="datetime64[ns]")


def _week_and_toc(values: Values, week: int, time: np.datetime64) -> tuple[int, Datetimes]:
    """Week of toe, and toc.

    The week that satellites send is that of the transmission: as it ends, toe is in the next one. RTCM 3 has no time of
    transmission; in its place stands the time of week of `time`, when the message was received.
    """
    sent_s = values.get("tow_s", values["toe_sow_s"] if np.isnat(time) else float(to_week(time)[1]))
    sent = from_week(week, sent_s)
    toe = nearest_week(values["toe_sow_s"], sent)
    return int(to_week(toe)[0]), nearest_week(values["toc_s"], sent)


def _issue(values: Values, *names: str) -> tuple[float, ...]:
    return tuple(values[name] for name in names)


def _raw(satellite: str, message: str, epoch: Datetimes | np.datetime64, numbers: Mapping[str, float]) -> RawRecord:
    """A record in the order of numbers that RINEX has; what the message lacks is NaN."""
    values = [float(numbers.get(name, np.nan)) for name in fields_of(satellite[0], message)]
    return RawRecord(
        satellite[0], satellite, message, np.asarray(epoch, dtype="datetime64[ns]").reshape(1)[0], values, 3.0
    )


def _near_week(broadcast: float, modulus: int, time: np.datetime64) -> int:
    """Full week nearest to a time from a week number that rolls over."""
    week = int(to_week(time)[0])
    return week + (int(broadcast) - week + modulus // 2) % modulus - modulus // 2


def _near_day(second_of_day: float, near: Datetimes) -> np.datetime64:
    """The instant with a second of day that is nearest to another instant."""
    day = near.astype("datetime64[D]").astype("datetime64[ns]") + timedelta(second_of_day)
    return np.datetime64(day + np.rint(seconds(near - day) / 86_400.0).astype(np.int64).astype("timedelta64[D]"), "ns")
