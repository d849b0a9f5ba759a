"""Writer of RINEX navigation files (RINEX 3.04, tables A5 to A15; RINEX 4.02, tables A9 to A34)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Masks, Strings, take_rows
from railfix.core.constants import BDT_MINUS_GPST_S
from railfix.core.errors import check_type
from railfix.core.files import FilePath
from railfix.core.timescale import BDT_EPOCH, GPS_EPOCH, SECONDS_PER_WEEK, seconds, timedelta, to_week
from railfix.core.utc import gpst_to_utc
from railfix.gnss.navigation import GlonassRecords, KeplerRecords, Navigation
from railfix.io.rinex.navigation_records import FIELDS
from railfix.io.rinex.write import Packing, RinexVersion, header_line, open_target, program_line

UNKNOWN_S: Final = 0.9999e9  #: Value that is written for unknown numbers.
_IONOSPHERE: Final = {"G": "GPS", "J": "QZS", "C": "BDS"}  #: Constellation name in IONOSPHERIC CORR.
#: For each RINEX version, the messages whose Keplerian records can be written.
_WRITTEN: Final[dict[RinexVersion, tuple[str, ...]]] = {
    "3.04": ("LNAV", "INAV", "FNAV", "D1", "D2"),
    "4.02": ("LNAV", "INAV", "FNAV", "D1", "D2", "CNV1"),
}
_BLANK: Final = " " * 19
#: Last line of a version 4 GLONASS record: unknown flags, group delay and accuracy (not in `GlonassRecords`).
_GLONASS_STATUS: Final = f"    {_BLANK}{'.999999999999E+09':>19}{_BLANK}{_BLANK}".rstrip() + "\n"


def write_navigation(
    navigation: Navigation,
    path: FilePath,
    *,
    packing: Packing | None = None,
    version: RinexVersion = "3.04",
    comments: Sequence[str] = (),
    created: np.datetime64 | None = None,
) -> None:
    """Write a RINEX navigation file; a failed write leaves no file.

    Records are sorted by clock time, then satellite. NaN is written as blank, and the L2 P data flag as 0. Unknown
    transmission times, and CNV1 fields that `Navigation` lacks, become 0.9999E9. The field `precise` is not written.

    Parameters
    ----------
    navigation : Navigation
    path : path-like
    packing : {"plain", "gz"}, optional
        Default: "gz" if the file name ends in ``.gz``, else "plain".
    version : {"3.04", "4.02"}
        Version 4 files name the message of each record, and have the ionospheric coefficients in records, not the
        header.
    comments : sequence of str
        Comment lines of at most 60 ASCII characters.
    created : datetime64, optional
        Date of creation in the header, UTC; blank by default.

    Raises
    ------
    ValueError
        `packing` is Hatanaka, which is for observations only; or a record cannot be written in this version.
    OutputError
        The file cannot be written.
    """
    if packing is not None and packing.startswith("crx"):
        raise ValueError("navigation files have no Hatanaka form; use packing 'plain' or 'gz'")
    check_type(navigation, Navigation, "navigation")
    kepler, glonass = navigation.kepler, navigation.glonass
    letters = sorted({str(s)[0] for s in (*kepler.satellite, *glonass.satellite)})
    kind = letters[0] if len(letters) == 1 else "M"
    head = [
        header_line(f"{version:>9}{'':11}{'N: GNSS NAV DATA':<20}{kind:<20}", "RINEX VERSION / TYPE"),
        program_line(created),
        *(header_line(comment, "COMMENT") for comment in comments),
    ]
    for letter, values in sorted(navigation.klobuchar.items()) if version == "3.04" else ():
        for part, half in (("A", values[:4]), ("B", values[4:])):
            text = f"{_IONOSPHERE[letter]}{part} " + "".join(f"{v:12.4E}" for v in half)
            head.append(header_line(text, "IONOSPHERIC CORR"))
    if navigation.leap_seconds is not None:
        head.append(header_line(f"{navigation.leap_seconds:6d}", "LEAP SECONDS"))
    head.append(header_line("", "END OF HEADER"))
    texts = [np.empty(0, dtype="<U1")]
    check_messages(kepler, version)
    kepler = take_rows(kepler, np.argsort(kepler.message == "CNV1", kind="stable"))
    late = kepler.message == "CNV1"
    for rows, names in ((~late, FIELDS["G"]), (late, FIELDS["C CNV1"])):
        if rows.any():
            own = take_rows(kepler, rows)
            texts.append(_records(own.satellite, *kepler_numbers(own, names)))
    if len(glonass):
        texts.append(_records(glonass.satellite, *glonass_numbers(glonass)))
    body = np.concatenate(texts)
    if version != "3.04":
        titles = [f"> EPH {s} {m}\n" for s, m in zip(kepler.satellite.tolist(), kepler.message.tolist(), strict=True)]
        titles += [f"> EPH {s} FDMA\n" for s in glonass.satellite.tolist()]
        ends = np.where(np.arange(len(body)) < len(kepler), "", _GLONASS_STATUS)
        body = np.char.add(np.char.add(np.array(titles, dtype=np.str_), body), ends) if len(body) else body
    order = np.lexsort(
        (np.concatenate([kepler.satellite, glonass.satellite]), np.concatenate([kepler.toc, glonass.toe]))
    )
    with open_target(path, packing=packing) as target:
        target.write("".join(head).encode("ascii"))
        if version != "3.04":
            target.write(_ionosphere_records(navigation).encode("ascii"))
        target.write("".join(body[order].tolist()).encode("ascii"))


def with_written_messages(navigation: Navigation, version: RinexVersion = "3.04") -> tuple[Navigation, dict[str, int]]:
    """Return the navigation data that can be written, and counts of omitted records by constellation and message."""
    kepler = navigation.kepler
    kept = np.isin(kepler.message, _WRITTEN[version])
    kinds = zip(kepler.satellite[~kept].tolist(), kepler.message[~kept].tolist(), strict=True)
    left_out = Counter(f"{satellite[0]} {message} ephemerides, which are not written" for satellite, message in kinds)
    return replace(navigation, kepler=take_rows(kepler, kept)), dict(left_out)


def check_messages(records: KeplerRecords, version: RinexVersion) -> None:
    """Raise ValueError if a record is of a message that cannot be written in this version."""
    if (other := ~np.isin(records.message, _WRITTEN[version])).any():
        raise ValueError(f"records of {records.message[other][0]} cannot be written; leave them out")


def _ionosphere_records(navigation: Navigation) -> str:
    """Return the Klobuchar coefficients as version 4 records (RINEX 4.02, table A34), dated with the first toc."""
    if not len(navigation.kepler):
        return ""
    first = str(_calendar_text(navigation.kepler.toc[:1].min())).strip()
    text = ""
    for letter, values in sorted(navigation.klobuchar.items()):
        numbers = [f"{value:19.12E}" for value in values.tolist()]
        message = "D1D2" if letter == "C" else "LNAV"
        text += f"> ION {letter}01 {message}\n    {first}{''.join(numbers[:3])}\n"
        text += f"    {''.join(numbers[3:7])}\n    {numbers[7]}{0.0:19.12E}\n"
    return text


def _field(values: Floats) -> Strings:
    """Format values as D19.12, blank for NaN."""
    return np.where(np.isfinite(values), np.char.mod("%19.12E", np.nan_to_num(values)), _BLANK)


def _records(satellite: Strings, time: Datetimes, numbers: Floats) -> Strings:
    """Format records: one line with satellite, time and three clock fields, then lines of four fields."""
    text = np.char.add(satellite, _calendar_text(time))
    for i, values in enumerate(numbers.T):
        if i >= 3 and i % 4 == 3:
            text = np.char.add(np.char.rstrip(text), "\n    ")
        text = np.char.add(text, _field(values))
    return np.char.add(np.char.rstrip(text), "\n")


def _calendar_text(time: Datetimes) -> Strings:
    """Format times as `` yyyy mm dd hh mm ss``."""
    text = np.datetime_as_string(time, unit="s")
    for mark in ("-", ":", "T"):
        text = np.char.replace(text, mark, " ")
    return np.char.add(" ", text)


def kepler_numbers(records: KeplerRecords, names: Sequence[str]) -> tuple[Datetimes, Floats]:
    """Return the toc in the constellation's time, shape (n,), and the numbers `names`, shape (n, numbers).

    Raise ValueError if RINEX has no Keplerian records for a constellation.
    """
    letter = records.satellite.astype("<U1")
    unknown = np.unique(letter[~np.isin(letter, ["G", "J", "E", "C"])])
    if unknown.size:
        raise ValueError(f"Keplerian records of constellation {unknown[0]!r} have no RINEX form")
    beidou, galileo = letter == "C", letter == "E"
    navstar = ~(beidou | galileo)
    shift = timedelta(np.where(beidou, BDT_MINUS_GPST_S, 0.0))
    toc = np.asarray(records.toc + shift, dtype="datetime64[ns]")
    week, sent = _week_and_transmission(records, shift, beidou)
    # A QZSS record has a flag instead of the fit interval: 0 for two hours, 1 for longer.
    fit = np.where(
        letter == "J",
        np.where(np.isnan(records.fit_interval_h), np.nan, records.fit_interval_h > 2.0),
        records.fit_interval_h,
    )
    blank, unknown = np.full((2, len(records)), [[np.nan], [UNKNOWN_S]])
    known = vars(records) | {
        "week": week,
        "flag": np.where(navstar, 0.0, np.nan),
        "group_delay_2_s": np.where(navstar, records.iodc, records.group_delay_2_s),
        "inter_signal_0": records.inter_signal_s[:, 0],
        "transmitted": sent,
        "fit": np.where(navstar, fit, np.where(beidou, records.iodc, blank)),
        "spare": blank,
    }
    return toc, np.stack([np.asarray(known.get(name, unknown), dtype=np.float64) for name in names], axis=1)


def _week_and_transmission(
    records: KeplerRecords, shift: NDArray[np.timedelta64], beidou: Masks
) -> tuple[Floats, Floats]:
    """Return the week number of toe in the constellation's time, and the transmission time in seconds of this week."""
    week, _ = to_week(records.toe + shift)
    origin = np.where(beidou, BDT_EPOCH, GPS_EPOCH)
    # The numbers of GPS and BeiDou weeks differ by a constant, because both begin on a Sunday.
    own = week - np.asarray((origin - GPS_EPOCH) // np.timedelta64(7, "D"), dtype=np.int64)
    start = GPS_EPOCH + (week * SECONDS_PER_WEEK).astype("timedelta64[s]")
    sent = seconds(records.transmitted + shift - start)
    return own.astype(np.float64), np.where(np.isnan(sent), UNKNOWN_S, sent)


def glonass_numbers(records: GlonassRecords) -> tuple[Datetimes, Floats]:
    """Return the toe in UTC, and the numbers in file order, shape (n, numbers). Lengths are in kilometres."""
    toe, sent = gpst_to_utc(records.toe), gpst_to_utc(records.transmitted)
    frame = seconds(sent - GPS_EPOCH)
    position, velocity, acceleration = (
        values / 1e3 for values in (records.position_ecef_m, records.velocity_ecef_mps, records.acceleration_ecef_mps2)
    )
    fields: list[Floats] = [
        records.clock_bias_s,
        records.relative_frequency,
        np.where(np.isnan(frame), UNKNOWN_S, frame % SECONDS_PER_WEEK),
    ]
    last = (records.health, records.frequency_channel, records.age_days)
    for axis, extra in enumerate(last):
        fields += [position[:, axis], velocity[:, axis], acceleration[:, axis], extra.astype(np.float64)]
    return toe, np.stack(fields, axis=1)
