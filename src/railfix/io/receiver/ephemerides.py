"""Assemble ephemerides from the navigation subframes of a stream.

A record needs several subframes of one issue: three for GPS and QZSS, five words (I/NAV) or four pages (F/NAV) for
Galileo, three subframes (D1, B-CNAV1, B-CNAV2) or ten pages (D2) for BeiDou, and four strings for GLONASS. A stream is
decoded in pieces. `assemble_records` combines the subframes of one piece with those of earlier pieces, so a record may
extend over several pieces.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes
from railfix.core.timescale import seconds
from railfix.gnss.navigation import Navigation
from railfix.io.receiver import nav_messages
from railfix.io.receiver.framing import Subframes, fields
from railfix.io.receiver.measurements import (
    Record,
    bcnav_record,
    beidou_record,
    cnav_record,
    frame_time,
    galileo_record,
    glonass_record,
    gps_record,
)
from railfix.io.receiver.nav_messages import (
    BCNAV1_FROM,
    CNAV_FROM,
    E1B_SOURCE,
    E5A_SOURCE,
    E5B_SOURCE,
    FNAV_FROM,
    Values,
    decode_pages,
)
from railfix.io.rinex.navigation_records import RawRecord, first_fault, glonass_records, kepler_records

#: Constellation letter for each number of an RTCM ephemeris message.
_RTCM_SYSTEMS: Final = {1019: "G", 1044: "J", 1042: "C", 1045: "E", 1046: "E", 1020: "R"}
_STRINGS_S: Final = 15.0  #: Epochs before GLONASS strings 2 to 4 may follow the frame start by less than this [s].
#: Epochs before GLONASS strings 2 to 4 may precede the frame start by less than this [s].
_EPOCH_BEFORE_S: Final = 5.0
_FRAME_S: Final = 30.0  #: Duration of a GLONASS frame [s].


@dataclass(frozen=True, kw_only=True)
class Unfinished:
    """State of the ephemeris assembly after a piece of a stream."""

    #: Fields of the latest subframe for each satellite and subframe number.
    latest: Mapping[tuple[str, int], Values] = field(default_factory=dict)
    #: Issue (`measurements.Record`) of each message's last record. A record with the same issue is a repetition.
    issued: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    #: First epoch after the last string of each GLONASS satellite whose four strings are not yet known to be of one
    #: frame; NaT until this epoch is received.
    waiting: Mapping[str, np.datetime64] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Assembled:
    """Records assembled from one piece of a stream, in the order in which they were completed."""

    records: tuple[RawRecord, ...]
    complete_at: Datetimes  #: Time at which each record was complete; NaT if unknown.
    klobuchar: Mapping[str, np.ndarray]
    leap_seconds: int | None
    skipped: Mapping[str, int]
    undated: frozenset[str] = frozenset()  #: Satellites of which a record could not be dated.


def assemble_records(
    subframes: Subframes,
    time: Datetimes,
    state: Unfinished,
    *,
    after: Datetimes,
    first: np.datetime64,
) -> tuple[Assembled, Unfinished]:
    """Return the ephemerides that one piece of a stream completes, and the state for the next piece.

    `time` and `after` are the epochs before and after each subframe, shape (N,), and `first` is the first epoch of the
    piece. Unknown epochs are NaT.
    """
    builder = _EphemerisBuilder(state)
    builder.waiting = {name: first if np.isnat(at) else at for name, at in builder.waiting.items()}
    pages, counts = decode_pages(subframes)
    for row, satellite, number, values in pages:
        builder.settle(time[row])
        builder.add(satellite, number, values, time[row], after[row])
    builder.settle(None)
    return builder.result(counts)


def assemble_rtcm(
    messages: Iterable[tuple[int, int, Mapping[str, float]]], time: Datetimes, state: Unfinished
) -> tuple[Assembled, Unfinished]:
    """Return the ephemerides in RTCM 3 messages, without repetitions, and the state after the messages.

    `messages` are from `rtcm.ephemeris_fields`, and `time` has the time of reception of each message, shape (N,).
    """
    builder = _EphemerisBuilder(state)
    for (_, kind, values), at in zip(messages, time, strict=True):
        satellite = f"{_RTCM_SYSTEMS[kind]}{int(values['number']):02d}"
        if not builder.needs_date(satellite, at):
            builder.issue(_rtcm_record(kind, satellite, values, at), at)
    return builder.result(Counter())


def _rtcm_record(kind: int, satellite: str, values: Values, time: np.datetime64) -> Record | None:
    """Return the record of one RTCM 3 ephemeris message."""
    match kind:
        case 1045:
            return galileo_record(satellite, {**values, "source": float(E5A_SOURCE)}, time)
        case 1046:
            return galileo_record(satellite, {**values, "source": float(E1B_SOURCE | E5B_SOURCE)}, time)
        case 1042:
            return beidou_record(satellite, "", values, time)
        case 1020:
            return glonass_record(satellite, {**values, "channel": values["channel"] - 7}, time)
    return gps_record(satellite, values, time)


def assemble_navigation(parts: Assembled, *, sources: tuple[str, ...] = ()) -> Navigation:
    """Return the navigation data from assembled records."""
    return Navigation(
        kepler=kepler_records([r for r in parts.records if r.system != "R"]),
        glonass=glonass_records([r for r in parts.records if r.system == "R"]),
        klobuchar={letter: value for letter, value in parts.klobuchar.items() if np.any(value)},
        leap_seconds=parts.leap_seconds,
        skipped=dict(parts.skipped),
        sources=sources,
    )


class _EphemerisBuilder:
    """Builder of records from the latest subframes of all satellites."""

    def __init__(self, state: Unfinished) -> None:
        self.latest, self.issued, self.waiting = dict(state.latest), dict(state.issued), dict(state.waiting)
        self.records: list[RawRecord] = []
        self.times: list[np.datetime64] = []
        self.rejected: list[tuple[RawRecord, str]] = []
        self.undated: set[str] = set()
        self.klobuchar: dict[str, np.ndarray] = {}
        self.leap_seconds: int | None = None

    def needs_date(self, satellite: str, time: np.datetime64) -> bool:
        """Return whether a date is missing for a record; if so, add the satellite to `undated`.

        GPS and QZSS send only ten bits of the week, and GLONASS sends only the time of day.
        """
        if satellite[0] in "GJR" and np.isnat(time):
            self.undated.add(satellite)
            return True
        return False

    def result(self, counts: Counter[str]) -> tuple[Assembled, Unfinished]:
        """Return the completed records and the new state. The counts of rejected records are added to `counts`."""
        counts.update(f"{raw.satellite[0]} {why}" for raw, why in self.rejected)
        records = Assembled(
            records=tuple(self.records),
            complete_at=np.array(self.times, dtype="datetime64[ns]"),
            klobuchar=self.klobuchar,
            leap_seconds=self.leap_seconds,
            skipped=dict(+counts),
            undated=frozenset(self.undated),
        )
        return records, Unfinished(latest=self.latest, issued=self.issued, waiting=self.waiting)

    def add(self, satellite: str, number: int, values: Values, time: np.datetime64, after: np.datetime64) -> None:
        """Add a subframe received between the epochs `time` and `after`, and append any record that it completes."""
        letter = satellite[0]
        if letter == "R":
            self.waiting.pop(satellite, None)
            if number == 1:  # earlier strings belong to another frame
                for k in (2, 3, 4):
                    self.latest.pop((satellite, k), None)
        self.latest[satellite, number] = {**values, "received": float(time.astype(np.int64))}
        if letter in "GJ" and number == 4:
            self._ionosphere_gps(letter, values)
            return
        record = self._maker(letter, number)(satellite, time)
        if letter == "R" and record is None and self._parts(satellite, (1, 2, 3, 4)) is not None:
            self.waiting[satellite] = after
        self.issue(record, time)

    def _maker(self, letter: str, number: int) -> Callable[[str, np.datetime64], Record | None]:
        """Return the method that builds a record from the subframes of a message."""
        if number >= BCNAV1_FROM:
            return self._bcnav1
        if number > FNAV_FROM:
            return {"E": self._galileo_f, "C": self._bcnav2}.get(letter, self._cnav_record)
        if letter == "C":
            return self._d2 if number > 100 else self._d1
        return {"G": self._gps, "J": self._gps, "E": self._galileo, "R": self._glonass}[letter]

    def settle(self, until: np.datetime64 | None) -> None:
        """Append the waiting GLONASS records for which the first epoch after their last string is known.

        If `until` is given, only records for which this epoch is at or before `until` are appended.
        """
        for satellite, after in list(self.waiting.items()):
            if not np.isnat(after) and (until is None or after <= until):
                del self.waiting[satellite]
                self.issue(self._glonass(satellite, after, within=_FRAME_S), after)

    def issue(self, record: Record | None, time: np.datetime64) -> None:
        """Append a record, except if it is implausible or repeats the satellite's last record of the same message."""
        if record is None:
            return
        raw, issue = record
        of_message = f"{raw.satellite} {raw.message}".rstrip()
        if self.issued.get(of_message) == issue:
            return
        fault = first_fault(raw)
        if fault is not None:
            self.rejected.append((raw, fault[1].split(" is ")[0]))
            return
        self.issued[of_message] = issue
        self.records.append(raw)
        self.times.append(time)

    def _parts(self, satellite: str, numbers: tuple[int, ...]) -> list[Values] | None:
        parts = [self.latest.get((satellite, k)) for k in numbers]
        return None if any(part is None for part in parts) else [part for part in parts if part is not None]

    def _ionosphere_gps(self, letter: str, values: Values) -> None:
        # GPS page 18 and the QZSS page for the wide area have ID 56; the QZSS page for Japan (ID 61) is not used.
        if values["page_sv"] == 56 and values["data_id"] in (1, 3):
            self.klobuchar[letter] = np.array([values[f"ion{k}"] for k in range(8)])
            self.leap_seconds = int(values["leap_seconds"]) if letter == "G" else self.leap_seconds

    def _gps(self, satellite: str, time: np.datetime64) -> Record | None:
        parts = self._parts(satellite, (1, 2, 3))
        if parts is None or not int(parts[0]["iodc"]) & 255 == parts[1]["iode"] == parts[2]["iode"]:
            return None
        if self.needs_date(satellite, time):
            return None
        return gps_record(satellite, {**parts[1], **parts[2], **parts[0]}, time)

    def _galileo(self, satellite: str, time: np.datetime64) -> Record | None:
        parts = self._parts(satellite, (1, 2, 3, 4, 5))
        if parts is None or len({part["iod"] for part in parts[:4]}) != 1:
            return None
        values: dict[str, float] = {}
        for part in parts:
            values |= part
        return galileo_record(satellite, values, time) if f"E{int(values['number']):02d}" == satellite else None

    def _galileo_f(self, satellite: str, time: np.datetime64) -> Record | None:
        parts = self._parts(satellite, tuple(range(FNAV_FROM + 1, FNAV_FROM + 5)))
        if parts is None or len({part["iod"] for part in parts}) != 1:
            return None
        values = {**parts[3], **parts[2], **parts[1], **parts[0], "source": float(E5A_SOURCE)}
        return galileo_record(satellite, values, time) if f"E{int(values['number']):02d}" == satellite else None

    def _cnav_record(self, satellite: str, _: np.datetime64) -> Record | None:
        """Return the CNAV record if the reference times of the three messages are equal, else None."""
        parts = self._parts(satellite, tuple(CNAV_FROM + k for k in nav_messages.CNAV))
        if parts is None or not parts[0]["toe_sow_s"] == parts[1]["toe_sow_s"] == parts[2]["toc_s"]:
            return None
        letter, number = satellite[0], f"{int(parts[0]['number']):02d}"
        if number != satellite[1:]:
            return None
        self.klobuchar.setdefault(letter, np.array([parts[2][f"ion{k}"] for k in range(8)]))
        return cnav_record(satellite, {**parts[2], **parts[1], **parts[0]})

    def _bcnav2(self, satellite: str, _: np.datetime64) -> Record | None:
        """Return the B-CNAV2 record if message 11 follows message 10 and IODC ends with the bits of IODE, else None."""
        parts = self._parts(satellite, tuple(CNAV_FROM + k for k in nav_messages.BCNAV2))
        if (
            parts is None
            or parts[1]["tow_s"] != parts[0]["tow_s"] + 3
            or int(parts[2]["iodc"]) & 255 != parts[0]["iode"]
        ):
            return None
        return bcnav_record(satellite, "CNV2", {**parts[2], **parts[1], **parts[0]})

    def _bcnav1(self, satellite: str, _: np.datetime64) -> Record | None:
        """Return the B-CNAV1 record if the pages are of one frame and the last page contains the health, else None."""
        parts = self._parts(satellite, tuple(BCNAV1_FROM + k for k in nav_messages.BCNAV1))
        if parts is None or len({part["tow_s"] for part in parts}) != 1:
            return None
        if parts[2]["page"] not in nav_messages.BCNAV1_WITH_HEALTH:
            return None
        return bcnav_record(satellite, "CNV1", {**parts[2], **parts[1], **parts[0]})

    def _d1(self, satellite: str, time: np.datetime64) -> Record | None:
        parts = self._parts(satellite, (1, 2, 3))
        if parts is None or not parts[0]["tow_s"] + 12 == parts[1]["tow_s"] + 6 == parts[2]["tow_s"]:
            return None
        values = {**parts[1], **parts[2], **parts[0]}
        values["toe_sow_s"] = (int(values["toe_high"]) << 15 | int(values["toe_low"])) * 8.0
        self.klobuchar["C"] = np.array([values[f"ion{k}"] for k in range(8)])
        return beidou_record(satellite, "D1", values, time)

    def _d2(self, satellite: str, time: np.datetime64) -> Record | None:
        parts = self._parts(satellite, tuple(range(101, 111)))
        if parts is None or any(part["tow_s"] != parts[0]["tow_s"] + 3 * k for k, part in enumerate(parts)):
            return None
        text = "".join(f"{int(part['page']):0300b}" for part in parts)
        bits = (np.frombuffer(text.encode(), np.uint8) - ord("0"))[None]
        values = {name: float(value[0]) for name, value in fields(bits, nav_messages.D2).items()}
        return beidou_record(satellite, "D2", {**values, "tow_s": parts[0]["tow_s"]}, time)

    def _glonass(self, satellite: str, time: np.datetime64, *, within: float | None = None) -> Record | None:
        parts = self._parts(satellite, (1, 2, 3, 4))
        if parts is None or f"R{int(parts[3]['slot']):02d}" != satellite:
            return None
        if self.needs_date(satellite, time):
            return None
        # All strings must be of one frame, which begins at the time t_k in string 1; one string is sent every 2 s. The
        # time of string 1 is not tested, because it may precede the receiver's first epoch. If the test fails, as it
        # does where epochs are rare, the first epoch after the strings must be less than one frame length after t_k.
        began = frame_time(parts[0], time)
        if within is None:
            received = np.array([part["received"] for part in parts[1:]]).astype(np.int64).astype("datetime64[ns]")
            after_s = seconds(received - began)
            of_one_frame = bool(((after_s > -_EPOCH_BEFORE_S) & (after_s < _STRINGS_S)).all())
        else:
            of_one_frame = 0.0 < float(seconds(time - began)) < within
        if not of_one_frame:
            return None
        values = {**parts[0], **parts[1], **parts[2], **parts[3]}
        return glonass_record(satellite, {**values, "health": float(int(values["health"]) >> 2)}, time)


def merge_records(parts: list[Assembled]) -> Assembled:
    """Join the records of several pieces of one stream. The last Klobuchar coefficients and leap seconds are used."""
    klobuchar: dict[str, np.ndarray] = {}
    leap: int | None = None
    for part in parts:
        klobuchar |= part.klobuchar
        leap = part.leap_seconds if part.leap_seconds is not None else leap
    return Assembled(
        records=tuple(record for part in parts for record in part.records),
        complete_at=np.concatenate([part.complete_at for part in parts]) if parts else np.zeros(0, "datetime64[ns]"),
        klobuchar=klobuchar,
        leap_seconds=leap,
        skipped=dict(sum((Counter(part.skipped) for part in parts), Counter())),
        undated=frozenset().union(*(part.undated for part in parts)),
    )
