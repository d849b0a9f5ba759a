"""Dual-frequency SBAS on L5 (ICAO Annex 10, 8th edition, appendix B, 3.5.14; ED-259A): corrections of satellites.

Messages have 250 bits and preambles of four bits. Types 31 (mask), 32 (orbit and clock with covariance), 34 to 36
(integrity) and 37 (degradation and the scale of the integrity indicator) are decoded. The corrections are for
ionosphere-free ranges. For L1 C/A and L5, and for E1 and E5a, the clock correction includes biases between the signals;
from ranges of B1C and B2a, the group delays of B-CNAV1 must be subtracted. GLONASS has slots in the mask, but its
corrections are for the signals L1OC and L3OC, which are not read.

The text of these standards was not available. Message layouts are taken from cssrlib (sbas.py), the degradation and the
least values of sigma from MAAST (L5_decodeMT37.m, L5_decode_satcorr.m, after ED-259A), and the slots of the mask from
cssrlib, MAAST and Wireshark (packet-sbas_l5.c). An hour of messages of SouthPAN and BDSBAS (`test_sbas_dfmc.py`) shows
that the slot number has 8 bits and `rate_share` 4 bits, as in cssrlib, and that the issue of data for BeiDou is the
IODE of B-CNAV1. BDSBAS corrects the clocks of BeiDou-3 by decimetres. Group delays differ by metres; these corrections
can therefore not include group delays.

The orbits of SBAS satellites (ephemerides in types 39 and 40, almanacs in type 47) are used only for a note of the run.
Layouts and scales of these messages are the same in cssrlib and MAAST (L5_decodeMT39.m, 40, 47). SouthPAN messages of
three days (`test_sbas_orbits.py`) determine two other conventions: the semi-major axis is counted from 6370 km, and the
node from the meridian of Greenwich at midnight of GPS time. It is not known whether a step of the inclination rate is
(7 pi / 6) 2^-21 1e-6 rad/s or 7 pi 2^-21 1e-6 rad/s; SouthPAN sends 0, and no position is computed for an orbit whose
rate is not 0. Orbits of BDSBAS have a different layout and are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, Strings
from railfix.core.constants import EARTH_ROTATION_RATE
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.timescale import seconds
from railfix.gnss.navigation import Navigation
from railfix.gnss.orbits.ephemerides import GM, Orbits, kepler_state
from railfix.gnss.orbits.issues import issue_records
from railfix.ranges.sbas.decode import BitField, Decoded, Layout, covariance_factor, read_fields, time_near
from railfix.ranges.sbas.messages import SbasMessages
from railfix.ranges.sbas.standard import first_that_holds, system_name

AUGMENTED: Final = 92  #: Largest number of satellites in a mask.
FIRST: Final = 53  #: Number of satellites with indicators in type 35; type 36 has the rest.
DO_NOT_USE: Final = 15  #: Indicator for "do not use"; unmonitored satellites are absent from type 32.
#: Sigma [m] for each indicator from 0 to 14 if the scale of type 37 is 0.
SIGMA_LEAST_M: Final = (0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0, 10.0)
#: For each indicator from 0 to 14, this step [m], multiplied by the scale of type 37, is added to `SIGMA_LEAST_M`.
SIGMA_STEP_M: Final = (0.0625, 0.125, 0.125, 0.125, 0.125, 0.25, 0.25, 0.25, 0.25, 0.25, 0.5, 0.5, 1.0, 3.0, 6.0)
_ONE_MORE: Final = -2  #: Placeholder for an indicator that a message of type 34 increases by one.
_DEGRADED: Final = ("G", "R", "E", "C", "S", "")  #: Constellations in the order of type 37.
#: Time-outs of a mask (`MASK_S`) and of an indicator (`INDICATOR_S`) [s]; after a message of type 0, the SBAS satellite
#: is not used for `STOP_S` [s].
MASK_S, INDICATOR_S, STOP_S = 600.0, 12.0, 60.0

#: Time, covariance and indicator; each field has the same bit position in types 32 and 40.
_COVARIANCE: Final[Layout] = {
    "time_of_day_s": BitField(106, 13, 16.0),
    "exponent": BitField(119, 3, 1.0),
    "diagonal": BitField(122, 9, 1.0, False, 4),
    "upper": BitField(158, 10, 1.0, True, 6),
    "dfrei": BitField(218, 4),
    "rate_share": BitField(222, 4),
}
LAYOUTS: Final[dict[int, Layout]] = {
    31: {"member": BitField(10, 1, number=214), "iodm": BitField(224, 2)},
    32: {
        "slot": BitField(10, 8),
        "iodn": BitField(18, 10),
        "position_m": BitField(28, 11, 0.0625, True, 3),
        "clock_m": BitField(61, 12, 0.03125, True),
        "velocity_mps": BitField(73, 8, 2.0**-11, True, 3),
        "drift_mps": BitField(97, 9, 2.0**-12, True),
        **_COVARIANCE,
    },
    34: {"change": BitField(10, 2, number=AUGMENTED), "dfrei": BitField(194, 4, number=7), "iodm": BitField(224, 2)},
    35: {"dfrei": BitField(10, 4, number=FIRST), "iodm": BitField(224, 2)},
    36: {"dfrei": BitField(10, 4, number=AUGMENTED - FIRST), "iodm": BitField(224, 2)},
    37: {
        "valid_32_s": BitField(10, 6, 6.0, least=30.0),
        "valid_40_s": BitField(16, 6, 6.0, least=30.0),
        "en_route_m": BitField(22, 6, 0.5),
        "covariance": BitField(28, 7, 0.1),
        "interval_s": BitField(35, 5, 6.0, False, 6, 21, 30.0),
        "step_m": BitField(40, 8, 0.01, False, 6, 21),
        "rate_mps": BitField(48, 8, 0.0002, False, 6, 21),
        "scale": BitField(161, 4, None, False, 15),
        "time": BitField(221, 3),
    },
}


class DfmcState(IntEnum):
    """State of a satellite's correction: in force (OK), or the reason why no correction is in force."""

    OK = 0
    STOPPED = 1  #: Type 0 was received within the last 60 s.
    NO_MASK = 2
    NOT_IN_MASK = 3
    NO_CORRECTION = 4
    TIMED_OUT = 5
    DO_NOT_USE = 6  #: Indicator 15.
    NO_DEGRADATION = 7  #: Type 37 is missing: neither scale nor time-outs are known.
    NO_RECORD = 8  #: No navigation record has the correction's issue of data.


@dataclass(frozen=True, kw_only=True)
class DfmcCorrections:
    """Corrections by SBAS on L5 for T epochs by K satellites."""

    state: Integers  #: `DfmcState`, shape (T, K).
    #: Issue of data of the navigation record to which the correction refers; -1 without a correction; shape (T, K).
    issue: Integers
    record: Integers  #: Row of `navigation.kepler` with this issue, -1 without such a record; shape (T, K).
    position_m: Floats  #: Correction to be added to the broadcast position, shape (T, K, 3).
    clock_m: Floats  #: Correction to be added to c times the broadcast clock; excludes group delays; shape (T, K).
    sigma_m: Floats  #: Sigma from indicator and scale; covariance and degradation not yet applied; shape (T, K).
    factor: Floats  #: Upper triangular factor of the covariance, shape (T, K, 4, 4).
    growth_m: Floats  #: Degradation of the correction since its reception, shape (T, K).
    #: Constant to be added to the factor on sigma that is computed from the covariance, shape (T, K).
    constant: Floats

    def sigma_along_m(self, line_of_sight: Floats) -> Floats:
        """Return the standard deviation of corrected ranges along unit vectors to the satellites, shape (T, K) [m]."""
        sight = np.concatenate([line_of_sight, np.ones((*self.state.shape, 1))], axis=-1)
        projected = np.einsum("tkij,tkj->tki", self.factor, sight)
        ratio = np.sqrt(np.einsum("tki,tki->tk", projected, projected)) + self.constant
        # sigma and degradation are added; the sum is never less than the root of the sum of squares
        return np.asarray(self.sigma_m * ratio + self.growth_m)


def slot_satellite(slot: int) -> str:
    """Return the satellite of a slot of the mask; empty for a reserved slot."""
    for letter, first, last, number in (("G", 1, 32, 1), ("R", 38, 69, 1), ("E", 75, 110, 1), ("S", 120, 158, 20)):
        if first <= slot <= last:
            return f"{letter}{slot - first + number:02d}"
    return f"C{slot - 158:02d}" if 159 <= slot <= 195 else ""


#: Slot of each satellite in the mask.
SLOT_OF: Final = {slot_satellite(slot): slot for slot in range(1, 215) if slot_satellite(slot)}


def residual_ionosphere_m(elevation_deg: Floats) -> Floats:
    """Return the residual ionospheric standard deviation of ionosphere-free ranges [m] (ED-259A)."""
    return np.asarray(40.0 / (261.0 + elevation_deg**2) + 0.018)


def _newest(sent: Datetimes, time: Datetimes) -> tuple[Integers, Floats]:
    """Return row and age [s] of the newest message at each epoch; without a message, row -1 and an infinite age."""
    row = np.searchsorted(sent, time, side="right") - 1
    ages = seconds(time - np.append(sent, np.datetime64("NaT", "ns"))[row])
    return row, np.where(row >= 0, ages, np.inf)


class DfmcService:
    """Corrections for any epochs from the L5 messages of one SBAS satellite; a message is used from its reception on.

    Messages of other PRNs are left out. The attribute `notes` begins with the notes given as argument.
    """

    def __init__(self, messages: SbasMessages, *, prn: int, notes: tuple[str, ...] = ()) -> None:
        own, never = messages.of(prn), np.datetime64("NaT", "ns")
        self.prn = prn
        #: Reception times of the first and the last message; NaT without messages.
        self.span: tuple[np.datetime64, np.datetime64] = (own.time[0], own.time[-1]) if len(own) else (never, never)
        self.notes = (
            *notes,
            f"SBAS on L5 requested: corrections of {system_name(prn)} PRN {prn} used, for ionosphere-free "
            "codes of GPS "
            "(L1 C/A, L5), Galileo (E1, E5a) and BeiDou (B1C, B2a); other satellites and signals are rejected",
        )
        self._time = {kind: own.time[own.type == kind] for kind in (0, *LAYOUTS)}
        self._read = {kind: read_fields(own.bits[own.type == kind], layout) for kind, layout in LAYOUTS.items()}
        self._indicators = self._all_indicators()
        valid_s = self._read[37]["valid_40_s"][-1:]
        self.notes += ephemerides(own, float(valid_s.sum())).notes() or almanacs(own).notes()

    @classmethod
    def from_log(cls, messages: SbasMessages, *, prn: int | Literal["best"] = "best") -> DfmcService:
        """Return the corrections from messages of the requested PRN, or of the PRN with the most messages of type 32.

        Raises ValueError if the log has no message of the requested PRN.
        """
        if prn == "best":
            numbers, count = np.unique(messages.prn[messages.type == 32], return_counts=True)
            prn = int(numbers[np.argmax(count)]) if len(numbers) else messages.prns[0]
            choice = f"SBAS PRN with most corrections on L5: {prn} (of {', '.join(map(str, messages.prns))})"
        else:
            choice = messages.describe_choice(prn)
        notes = (*messages.notes, choice)
        if zeros := int(np.sum(messages.of(prn).type == 0)):
            notes += (f"PRN {prn} sent {zeros} messages of type 0 (do not use for safety): unused for 60 s after each",)
        return cls(messages, prn=prn, notes=notes)

    def satellites(self, time: Datetimes, satellite: Strings, navigation: Navigation | None = None) -> DfmcCorrections:
        """Return the corrections of K satellites at T epochs.

        A correction is used only if a navigation record has the same issue of data, or if `navigation` is None.
        """
        shape = (len(time), len(satellite))
        names = np.array([slot_satellite(int(slot)) for slot in self._read[32]["slot"]], dtype="<U3")
        stop = self._newest(0, time, STOP_S) >= 0
        since = _newest(self._time[0], time)[1]
        mask, ten = self._newest(31, time, MASK_S), self._newest(37, time, np.inf)
        result = {
            "state": np.zeros(shape, dtype=np.int8), "issue": np.full(shape, -1), "position_m": np.zeros((*shape, 3)),
            "clock_m": np.zeros(shape), "sigma_m": np.full(shape, np.nan), "factor": np.zeros((*shape, 4, 4)),
            "growth_m": np.zeros(shape), "constant": np.zeros(shape),
        }  # fmt: skip
        for k, name in enumerate(satellite.tolist()):
            own = {key: values[:, k] for key, values in result.items()}
            slots, rank = self._slots(name, mask)
            rows = np.flatnonzero(names == name)
            newest, age = _newest(self._time[32][rows], time)
            row, has = np.append(rows, 0)[newest], (newest >= 0) & (age < since)
            age = np.where(has, age, np.inf)
            valid = np.append(self._read[37]["valid_32_s"], 0.0)[ten]
            dfrei = self._indicator(time, mask, rank, (row, age))
            own["state"][:] = first_that_holds(
                [
                    (stop, DfmcState.STOPPED),
                    (mask < 0, DfmcState.NO_MASK),
                    (~slots, DfmcState.NOT_IN_MASK),
                    (ten < 0, DfmcState.NO_DEGRADATION),
                    (~has, DfmcState.NO_CORRECTION),
                    ((age > valid) | (dfrei < 0), DfmcState.TIMED_OUT),
                    (dfrei >= DO_NOT_USE, DfmcState.DO_NOT_USE),
                ],
                DfmcState.OK,
            )
            good = np.flatnonzero(own["state"] == DfmcState.OK)
            if len(good):
                self._correct(own, good, (time, row, ten, dfrei), name)
        record = np.full(shape, -1)
        if navigation is not None:
            record = issue_records(navigation, satellite, time, result["issue"])
            lost = (result["state"] == DfmcState.OK) & (record < 0)
            result["state"][lost] = DfmcState.NO_RECORD
        return DfmcCorrections(**result, record=record)

    def _correct(
        self, own: dict[str, Floats], good: Integers, at: tuple[Datetimes, Integers, Integers, Integers], name: str
    ) -> None:
        """Write the corrections of one satellite into `own` at the epochs `good`."""
        time, (row, ten, dfrei) = at[0][good], (values[good] for values in at[1:])
        sent, scale = {key: values[row] for key, values in self._read[32].items()}, self._read[37]
        moved_s = seconds(time - time_near(sent["time_of_day_s"], self._time[32][row]))
        own["issue"][good] = sent["iodn"]
        own["position_m"][good] = sent["position_m"] + sent["velocity_mps"] * moved_s[:, None]
        own["clock_m"][good] = sent["clock_m"] + sent["drift_mps"] * moved_s
        code = scale["scale"][ten, dfrei]
        own["sigma_m"][good] = np.array(SIGMA_LEAST_M)[dfrei] + code * np.array(SIGMA_STEP_M)[dfrei]
        own["factor"][good] = covariance_factor(sent)
        own["constant"][good] = scale["covariance"][ten] * np.exp2(sent["exponent"] - 5.0)
        kind = _DEGRADED.index(name[0])
        age = seconds(time - self._time[32][row])
        interval = scale["interval_s"][ten, kind]
        rate = scale["rate_mps"][ten, kind] * np.where(age > interval, 1.0, (sent["rate_share"] + 1.0) / 16.0)
        own["growth_m"][good] = np.floor(age / interval) * scale["step_m"][ten, kind] + rate * age

    def _newest(self, kind: int, time: Datetimes, longest_s: float) -> Integers:
        """Return the row of the newest message of a type; -1 if none was received in the last `longest_s`."""
        row, age = _newest(self._time[kind], time)
        return np.where(age <= longest_s, row, -1)

    def _slots(self, name: str, mask: Integers) -> tuple[Masks, Integers]:
        """Return whether a satellite is in the mask in force, and the rank of the satellite among the satellites of the
        mask.
        """
        slot = SLOT_OF.get(name, 0)
        if not slot or not len(self._time[31]):
            return np.zeros(len(mask), dtype=np.bool_), np.zeros(len(mask), dtype=np.int64)
        member = self._read[31]["member"][mask]
        return (mask >= 0) & (member[:, slot - 1] == 1), member[:, : slot - 1].sum(axis=1)

    def _all_indicators(self) -> tuple[Datetimes, Integers, Integers]:
        """Return times, mask issues and indicators of all satellites from types 34 to 36; an indicator not sent is -1.

        Codes of type 34: 0 unchanged, 1 new indicator, 2 indicator increased by one (`_ONE_MORE`), 3 do not use.
        """
        times, issues, values = [], [], []
        for kind in (34, 35, 36):
            fields = self._read[kind]
            table = np.full((len(self._time[kind]), AUGMENTED), -1, dtype=np.int64)
            if kind == 34:
                change = fields["change"]
                rank = np.cumsum(change == 1, axis=1) - 1
                given = np.take_along_axis(fields["dfrei"], np.clip(rank, 0, 6), axis=1)
                table = np.select(
                    [(change == 1) & (rank < 7), change == 2, change == 3], [given, _ONE_MORE, DO_NOT_USE], -1
                )
            else:
                table[:, slice(FIRST) if kind == 35 else slice(FIRST, None)] = fields["dfrei"]
            times.append(self._time[kind])
            issues.append(fields["iodm"])
            values.append(table)
        time = np.concatenate(times)
        order = np.argsort(time, kind="stable")
        return time[order], np.concatenate(issues)[order], np.concatenate(values)[order]

    def _indicator(self, time: Datetimes, mask: Integers, rank: Integers, sent: tuple[Integers, Floats]) -> Integers:
        """Return the indicator in force, from type 32 or a later message of types 34 to 36; -1 where it is too old."""
        row, age = sent
        received, issue, values = self._indicators
        result = np.full(len(time), -1, dtype=np.int64)
        known = np.flatnonzero((mask >= 0) & np.isfinite(age))
        last = np.searchsorted(received, time[known], side="right")
        # epochs between two messages have the same indicator
        cases, case = np.unique(np.stack([mask[known], row[known], rank[known], last]), axis=1, return_inverse=True)
        renewed = np.empty(cases.shape[1], dtype="datetime64[ns]")
        current = np.empty(cases.shape[1], dtype=np.int64)
        for i, (m, r, of_mask, end) in enumerate(cases.T.tolist()):
            first = np.searchsorted(received, self._time[32][r], side="right")
            chosen = first + np.flatnonzero(issue[first:end] == self._read[31]["iodm"][m])
            renewed[i] = received[chosen[-1]] if len(chosen) else self._time[32][r]
            grade = int(self._read[32]["dfrei"][r])
            for value in values[chosen, of_mask].tolist():
                if value == _ONE_MORE:
                    grade = min(grade + 1, DO_NOT_USE - 1) if grade < DO_NOT_USE else grade
                elif value >= 0:
                    grade = value
            current[i] = grade
        fresh = seconds(time[known] - renewed[case]) <= INDICATOR_S
        result[known] = np.where(fresh, current[case], -1)
        return result


_BDSBAS: Final = 5  #: Number of the SBAS provider BDSBAS.
_ANGLE: Final = np.pi * 2.0**-33
_AXIS_M: Final = 6_370_000.0
_BEFORE_FIRST_PRN: Final = 119

_ORBIT_LAYOUTS: Final[Mapping[int, Layout]] = {
    39: {
        "number": BitField(10, 6),
        "issue": BitField(16, 2),
        "provider": BitField(18, 5),
        "cuc": BitField(23, 19, np.pi * 2.0**-19 * 1e-4, True),
        "cus": BitField(42, 19, np.pi * 2.0**-19 * 1e-4, True),
        "rate": BitField(61, 22, None, True),
        "omega": BitField(83, 34, _ANGLE, True),
        "node": BitField(117, 34, _ANGLE, True),
        "m0": BitField(151, 34, _ANGLE, True),
    },
    40: {
        "issue": BitField(10, 2),
        "i0": BitField(12, 33, _ANGLE),
        "eccentricity": BitField(45, 30, 2.0**-30),
        "a": BitField(75, 31, 0.02, least=_AXIS_M),
        "time_of_day_s": _COVARIANCE["time_of_day_s"],
    },
    47: {
        "number": BitField(0, 6),
        "provider": BitField(6, 5),
        "a": BitField(12, 16, 650.0, least=_AXIS_M),
        "eccentricity": BitField(28, 8, 2.0**-8),
        "i0": BitField(36, 13, np.pi * 2.0**-13),
        "omega": BitField(49, 14, np.pi * 2.0**-13, True),
        "node": BitField(63, 14, np.pi * 2.0**-13, True),
        "node_rate": BitField(77, 8, 1e-9, True),
        "m0": BitField(85, 15, np.pi * 2.0**-14, True),
        "time_of_day_s": BitField(100, 6, 1800.0),
    },
}
_ALMANACS_AT: Final = (10, 116)  #: First bit of each of the two satellites in a message of type 47.


@dataclass(frozen=True, kw_only=True)
class SbasOrbits:
    """Orbits of SBAS satellites, n rows."""

    row: Integers  #: Row of the last message of each orbit, shape (n,).
    prn: Integers  #: PRN of the satellite, shape (n,).
    provider: Integers  #: Number of the SBAS provider, 8 for SouthPAN; shape (n,).
    reference: Datetimes  #: Reference time of each orbit, shape (n,).
    orbits: Orbits
    usable: Masks  #: True where the inclination rate is 0, so that a position can be computed, shape (n,).

    def position_ecef_m(self, time: Datetimes) -> Floats:
        """Compute the satellites' positions at the times `time`, shape (n,), as an array (n, 3) [m]; NaN where not
        `usable`.
        """
        position = np.stack(kepler_state(self.orbits, seconds(time - self.reference))[0], axis=1)
        return np.where(self.usable[:, None], position, np.nan)

    def notes(self) -> tuple[str, ...]:
        """Return a note on the last orbit that has a position; an empty tuple if there is none."""
        last = zip(self.prn[self.usable][-1:], self.position_ecef_m(self.reference)[self.usable][-1:], strict=True)
        return tuple(
            f"according to its own messages, PRN {prn} is at {float(geodetic_from_ecef(place)[1]):.1f} degrees east, "
            f"{np.linalg.norm(place) / 1e3:,.0f} km from the centre of the Earth; its ranges are not used"
            for prn, place in last
        )


def ephemerides(messages: SbasMessages, valid_s: float) -> SbasOrbits:
    """Return a satellite's ephemerides, each from types 39 and 40 with equal issue, at most `valid_s` apart."""
    rows = {kind: np.flatnonzero(messages.type == kind) for kind in (39, 40)}
    sent = {kind: read_fields(messages.bits[at], _ORBIT_LAYOUTS[kind]) for kind, at in rows.items()}
    newest: dict[tuple[int, int], int] = {}
    pairs = []
    for row, kind, k in sorted((int(row), kind, k) for kind, at in rows.items() for k, row in enumerate(at)):
        issue = int(sent[kind]["issue"][k])
        newest[kind, issue] = k
        other = newest.get((79 - kind, issue))
        if other is not None and seconds(messages.time[row] - messages.time[rows[79 - kind][other]]) <= valid_s:
            pairs.append((row, *((k, other) if kind == 39 else (other, k))))
    last, first, second = np.array(pairs, dtype=np.int64).reshape(-1, 3).T
    part = {name: values[first] for name, values in sent[39].items()}
    part |= {name: values[second] for name, values in sent[40].items()}
    return _orbits(messages, last, part)


def almanacs(messages: SbasMessages) -> SbasOrbits:
    """Return the almanacs in messages (type 47)."""
    row = np.flatnonzero(messages.type == 47)
    halves = [read_fields(messages.bits[row], _ORBIT_LAYOUTS[47], first) for first in _ALMANACS_AT]
    part = {name: np.concatenate([half[name] for half in halves]) for name in _ORBIT_LAYOUTS[47]}
    return _orbits(messages, np.concatenate([row, row]), part)


def _orbits(messages: SbasMessages, row: Integers, sent: Decoded) -> SbasOrbits:
    """Return decoded orbits in the order of their messages, without empty orbits and without BDSBAS."""
    order = np.argsort(row, kind="stable")
    order = order[(sent["number"][order] > 0) & (sent["provider"][order] != _BDSBAS)]
    row, sent = row[order], {name: values[order] for name, values in sent.items()}
    none, axis = np.zeros(len(row)), sent["a"]
    motion, root = np.sqrt(GM["G"] / axis**3), np.sqrt(1.0 - sent["eccentricity"] ** 2)
    orbits = Orbits(
        a=axis, motion=motion, eccentricity=sent["eccentricity"], root=root, m0=sent["m0"],
        cos_omega=np.cos(sent["omega"]), sin_omega=np.sin(sent["omega"]),
        cos_i0=np.cos(sent["i0"]), sin_i0=np.sin(sent["i0"]), i_dot=none,
        node=sent["node"] - EARTH_ROTATION_RATE * sent["time_of_day_s"],
        node_rate=sent.get("node_rate", none) - EARTH_ROTATION_RATE, tilted_rate=none,
        cuc=sent.get("cuc", none), cus=sent.get("cus", none), crc=none, crs=none, cic=none, cis=none,
        relativity=none, a_dot=none, delta_n_dot=none,
    )  # fmt: skip
    return SbasOrbits(
        row=row,
        prn=sent["number"] + _BEFORE_FIRST_PRN,
        provider=sent["provider"],
        reference=time_near(sent["time_of_day_s"], messages.time[row]),
        orbits=orbits,
        usable=sent.get("rate", none) == 0,
    )
