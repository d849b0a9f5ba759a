"""Convert raw navigation records to the arrays of `railfix.gnss.navigation`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats, Integers, Strings
from railfix.core.nearest_times import nearest_day, nearest_week
from railfix.core.timescale import bdt_to_gpst, seconds, to_week, utc_to_gpst
from railfix.gnss.navigation import GlonassRecords, KeplerRecords

#: Names of the numbers in an LNAV, INAV, FNAV, D1 or D2 record, in file order, beginning with three clock coefficients.
_KEPLER: Final = (
    "af0_s af1 af2 iode crs delta_n m0 cuc eccentricity cus sqrt_a toe_sow_s cic omega0 cis i0 crc omega omega_dot "
    "i_dot data_source week flag accuracy_m health group_delay_1_s group_delay_2_s transmitted fit"
).split()
#: Names of the numbers in a GLONASS record, in file order.
_GLONASS: Final = (
    "clock_bias relative_frequency message_time x x_velocity x_acceleration health "
    "y y_velocity y_acceleration frequency_channel z z_velocity z_acceleration age"
).split()
#: Names of the first numbers in CNAV and CNV1 to CNV3 records. CNAV records do not contain toe, because toe equals toc
#: (IS-GPS-200, 30.3.3.1.1).
_ORBIT_4: Final = (
    "af0_s af1 af2 a_dot crs delta_n m0 cuc eccentricity cus sqrt_a {} cic omega0 cis i0 crc omega omega_dot "
    "i_dot delta_n_dot "
)
_CNAV: Final = _ORBIT_4.format("top") + (
    "ned_0 ned_1 accuracy_index health group_delay_1_s ned_2 "
    "inter_signal_0 inter_signal_1 inter_signal_2 inter_signal_3 "
)
_CNV: Final = _ORBIT_4.format("toe_sow_s") + "kind top sisai_oe sisai_ocb sisai_oc1 sisai_oc2 "
_CNV_END: Final = " group_delay_1_s group_delay_2_s sismai health flags iodc transmitted spare spare iode"
#: Names of the numbers in each message that RINEX 4 introduced (4.02, tables A10, A11, A18 to A20).
_MESSAGES_4: Final[Mapping[str, str]] = {
    **dict.fromkeys(("G CNAV", "J CNAV"), _CNAV + "transmitted week"),
    **dict.fromkeys(("G CNV2", "J CNV2"), _CNAV + "inter_signal_4 inter_signal_5 spare spare transmitted week"),
    "C CNV1": _CNV + "inter_signal_0 spare" + _CNV_END,
    "C CNV2": _CNV + "spare inter_signal_1" + _CNV_END,
    "C CNV3": _CNV + "sismai health flags group_delay_1_s transmitted",
}
#: Names of the numbers in each message that RINEX 4 introduced ("G CNAV"), and in other messages of each constellation.
FIELDS: Final[Mapping[str, Sequence[str]]] = {
    **dict.fromkeys("GJEC", _KEPLER),
    "R": _GLONASS,
    **{message: names.split() for message, names in _MESSAGES_4.items()},
}
#: Numbers needed to compute orbit and clock; a record in which one of these numbers is blank is rejected.
_NEEDED: Final = frozenset(
    "af0_s sqrt_a eccentricity m0 toe_sow_s omega0 i0 omega omega_dot "
    "clock_bias x x_velocity y y_velocity z z_velocity".split()
)
#: Lower and upper limits of plausible numbers; a record with a number beyond them is rejected. The limits of `sqrt_a`
#: correspond to semi-major axes of about 10 000 to 70 000 km.
_BETWEEN: Final[Mapping[str, tuple[float, float]]] = {
    "sqrt_a": (3.1e3, 8.4e3),
    "eccentricity": (0.0, 0.3),
    "toe_sow_s": (0.0, 604_800.0),
    **{
        name: (-limit, limit)
        for names, limit in (
            ("af0_s clock_bias", 1.0),
            ("m0 omega0 i0 omega", 7.0),
            ("delta_n_dot", 1e-10),
            ("a_dot", 10.0),
            ("delta_n omega_dot i_dot af1 af2 relative_frequency", 1e-6),
            ("cuc cus cic cis", 1e-3),
            ("crc crs", 1e5),
            ("x_velocity y_velocity z_velocity", 10.0),
            ("x_acceleration y_acceleration z_acceleration", 1e-6),
        )
        for name in names.split()
    },
}
_OTHERS_BETWEEN: Final = (-1e10, 1e10)  #: Limits of all numbers that are not in `_BETWEEN`.
_BLANK: Final = float("nan")
_UNKNOWN: Final = 0.99e9  #: A magnitude between this and 1.01E9 means an unknown number (0.9999E9 in RINEX).
_TRANSMISSION_S: Final = 2 * 86_400.0  #: A transmission time further than this from toe is read as unknown [s].


@dataclass(frozen=True)
class RawRecord:
    """Navigation record as read from a file or assembled from messages."""

    system: str
    satellite: str
    message: str
    epoch: np.datetime64  #: Clock reference time (toc) in the constellation's time system (UTC for GLONASS).
    numbers: list[float]  #: Numbers of the record in RINEX order (`fields`); NaN where blank.
    version: float

    @property
    def fields(self) -> Sequence[str]:
        """Names of the numbers in file order."""
        return list_fields(self.system, self.message)


def list_fields(system: str, message: str) -> Sequence[str]:
    """Return the names of the numbers in a record, in file order."""
    return FIELDS.get(f"{system} {message}", FIELDS[system])


def number(text: str) -> float:
    """Parse a FORTRAN number. Blank and 0.9999E9 are read as the same NaN object, so that equal records compare equal.

    Raise ValueError if the text is not a finite number.
    """
    text = text.strip()
    if not text:
        return _BLANK
    value = float(text.replace("D", "E").replace("d", "e"))
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not a finite number")
    return _BLANK if _UNKNOWN < abs(value) < 1.01e9 else value


def first_fault(record: RawRecord) -> tuple[int, str] | None:
    """Return the index and a description of the first implausible number, or None for a valid record."""
    for k, (name, value) in enumerate(zip(record.fields, record.numbers, strict=True)):
        if name in _NEEDED and math.isnan(value):
            return k, f"{name} is blank"
        low, high = _BETWEEN.get(name, _OTHERS_BETWEEN)
        if value < low or value > high:
            return k, f"{name} is {value:g}; between {low:g} and {high:g} was expected"
    return None


def kepler_records(raw: Sequence[RawRecord]) -> KeplerRecords:
    """Convert Keplerian records. Blank rates, corrections, health and issues are read as 0, as RINEX specifies."""
    column = _columns(raw)
    satellite = np.array([r.satellite for r in raw], dtype="<U3")
    system = satellite.astype("<U1")
    own = np.array([r.epoch for r in raw], dtype="datetime64[ns]")
    of_clock = np.isnan(column["toe_sow_s"])
    column["toe_sow_s"] = np.where(of_clock, to_week(own)[1], column["toe_sow_s"])
    toe = np.where(of_clock, own, nearest_week(column["toe_sow_s"], own))
    # The week is taken from the clock reference time, because week numbers in converted files may be wrong by 1024.
    sent_sow = column["transmitted"]
    usable = np.abs(np.where(np.isnan(sent_sow), np.inf, sent_sow)) < 2 * 604_800
    sent = nearest_week(np.where(usable, sent_sow, 0.0), toe)
    usable &= np.abs(seconds(sent - toe)) <= _TRANSMISSION_S
    beidou = system == "C"
    gps_like = np.isin(system, ["G", "J"])
    integers = {name: _integers(column[name]) for name in ("iode", "health", "data_source")}
    # GPS and QZSS records have the IODC in the field that is the second group delay in Galileo and BeiDou records.
    # BeiDou records have the AODC in the field of the fit interval.
    cnv = ~np.isnan(column["iodc"])
    iodc = np.select(
        [gps_like, cnv, beidou], [column["group_delay_2_s"], column["iodc"], column["fit"]], column["iode"]
    )
    return KeplerRecords(
        satellite=satellite,
        message=_messages(raw, system, integers["data_source"], satellite),
        toc=np.where(beidou, bdt_to_gpst(own), own),
        toe=np.where(beidou, bdt_to_gpst(toe), toe),
        transmitted=np.where(usable, np.where(beidou, bdt_to_gpst(sent), sent), np.datetime64("NaT", "ns")),
        iode=integers["iode"],
        iodc=_integers(iodc),
        health=integers["health"],
        data_source=np.where(beidou, 0, integers["data_source"]),
        accuracy_m=np.where(np.isnan(column["accuracy_m"]), _ura_m(column["accuracy_index"]), column["accuracy_m"]),
        group_delay_1_s=column["group_delay_1_s"],
        group_delay_2_s=np.where(gps_like, np.nan, column["group_delay_2_s"]),
        inter_signal_s=np.stack([column[f"inter_signal_{i}"] for i in range(6)], axis=-1),
        fit_interval_h=_fit_interval(system, column["fit"]),
        **{
            name: np.nan_to_num(column[name])
            for name in (
                "af0_s af1 af2 sqrt_a eccentricity m0 delta_n omega0 i0 omega omega_dot i_dot a_dot delta_n_dot "
                "cuc cus crc crs cic cis toe_sow_s"
            ).split()
        },
    )


def _columns(raw: Sequence[RawRecord]) -> dict[str, Floats]:
    """Return the numbers of all records by name, shape (n,) each, NaN where a message lacks the number."""
    names = {name for key, own in FIELDS.items() if key != "R" for name in own}
    column = {name: np.full(len(raw), _BLANK) for name in names}
    layouts: dict[tuple[str, ...], list[int]] = {}
    for i, record in enumerate(raw):
        layouts.setdefault(tuple(record.fields), []).append(i)
    for layout, rows in layouts.items():
        table = np.array([raw[i].numbers for i in rows], dtype=np.float64)
        for name, values in zip(layout, table.T, strict=True):
            column[name][rows] = values
    return column


def _ura_m(index: Floats) -> Floats:
    """Return the nominal accuracy [m] of a URA_ED index (IS-GPS-200, 30.3.3.1.1.4); 8192 m means no prediction."""
    metres = 2.0 ** np.where(index <= 6, 1.0 + index / 2.0, index - 2.0)
    return np.where((index == 15) | (index == -16), 8192.0, metres)


def _integers(values: Floats) -> Integers:
    return np.nan_to_num(values).astype(np.int64)


def _messages(raw: Sequence[RawRecord], system: Strings, source: Integers, satellite: Strings) -> Strings:
    """Return the message names; missing names follow from the Galileo data source or the BeiDou satellite number."""
    number = np.array([int(s[1:]) for s in satellite.tolist()], dtype=np.int64)
    geo = (number <= 5) | (number >= 59)
    fnav = ((source & 0b010) != 0) & ((source & 0b101) == 0)
    derived = np.select(
        [system == "E", (system == "C") & geo, system == "C"], [np.where(fnav, "FNAV", "INAV"), "D2", "D1"], "LNAV"
    )
    written = np.array([r.message for r in raw], dtype="<U4")
    return np.where(written != "", written, derived).astype("<U4")


def _fit_interval(system: Strings, fit: Floats) -> Floats:
    """Return the fit interval [h]: GPS (0 means 4 h, 1 means 6 h), QZSS (0 means 2 h, 1 means 4 h), NaN for others."""
    fit = np.nan_to_num(fit)
    gps = np.where(fit == 0, 4.0, np.where(fit == 1, 6.0, fit))
    qzss = np.where(fit == 0, 2.0, np.where(fit == 1, 4.0, fit))
    return np.select([system == "G", system == "J"], [np.clip(gps, 4.0, 26.0), np.clip(qzss, 2.0, 26.0)], np.nan)


def glonass_records(raw: Sequence[RawRecord]) -> GlonassRecords:
    """Convert GLONASS records: times from UTC to GPS time, and lengths from kilometres to metres."""
    table = np.array([r.numbers for r in raw], dtype=np.float64).reshape(len(raw), len(_GLONASS))
    state = table[:, 3:15].reshape(-1, 3, 4)
    utc = np.array([r.epoch for r in raw], dtype="datetime64[ns]")
    toe = utc_to_gpst(utc)
    frame = table[:, 2]
    known = np.isfinite(frame) & (np.abs(frame) < 1e6)
    # The message frame time is in seconds of the UTC day in RINEX 2, and of the UTC week in RINEX 3 and 4.
    old = np.array([r.version < 3.0 for r in raw], dtype=bool)
    frame = np.where(known, frame, 0.0)
    sent = np.where(old, nearest_day(frame % 86_400.0, utc), nearest_week(frame, utc))
    known &= np.abs(seconds(sent - utc)) < 86_400.0
    arrays: dict[str, Any] = {
        "position_ecef_m": state[:, :, 0] * 1e3,
        "velocity_ecef_mps": state[:, :, 1] * 1e3,
        "acceleration_ecef_mps2": np.nan_to_num(state[:, :, 2]) * 1e3,
    }
    return GlonassRecords(
        satellite=np.array([r.satellite for r in raw], dtype="<U3"),
        toe=toe,
        transmitted=np.where(known, utc_to_gpst(sent), np.datetime64("NaT", "ns")),
        clock_bias_s=np.nan_to_num(table[:, 0]),
        relative_frequency=np.nan_to_num(table[:, 1]),
        health=_integers(state[:, 0, 3]),
        frequency_channel=_integers(state[:, 1, 3]),
        age_days=np.nan_to_num(state[:, 2, 3]),
        **arrays,
    )
