"""Broadcast records of simulated satellites, and the geometry of signals at a receiver.

Orbits have the semi-major axis, eccentricity and inclination of the real constellations; one QZSS satellite is near the
zenith at the start of the run. All records of a satellite describe the same orbit and clock to within a millimetre.
Signals are computed from the newest transmitted record, as in a receiver.

`links` computes the states at every instant; `SatelliteTable` computes the states of all satellites at nodes, and
interpolates the states between the nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, take_rows
from railfix.core.constants import BDT_MINUS_GPST_S, EARTH_ROTATION_RATE, GM_GPS, SPEED_OF_LIGHT
from railfix.core.errors import MismatchError
from railfix.core.timescale import gpst_minus_utc, seconds, timedelta, to_week
from railfix.gnss.navigation import KeplerRecords, Navigation
from railfix.gnss.orbits.ephemerides import GM, ROTATION, Orbits, kepler_state
from railfix.io.rinex import read_navigation
from railfix.io.rinex.navigation_records import glonass_records
from railfix.simulate.scenario import Scenario

#: Health word that marks a satellite as unhealthy, by constellation: all data bad (GPS, QZSS), E1-B and E5b out of
#: service (Galileo), SatH1 (BeiDou).
_ILL_HEALTH: Final = {"G": 63, "J": 63, "E": 0b001_000_010 | 0b010_000_000, "C": 1}
#: A record is valid up to this time before and after its reference time [s], as in `railfix.gnss.orbits`.
_SERVES_S: Final = {"G": 7200.0, "J": 7200.0, "E": 14_400.0, "C": 21_600.0}
#: Time from transmission to reference time [s], assumed where the transmission time is absent or implausible.
_SENT_BEFORE_S: Final = {"G": 7200.0, "J": 3600.0, "E": 600.0, "C": 3600.0}
_SIGNALS_MESSAGE: Final = {"G": ("LNAV",), "J": ("LNAV",), "E": ("INAV",), "C": ("D1", "D2")}


def navigation_of_file(scenario: Scenario, path: str) -> Navigation:
    """Read the navigation records of the satellites that have a valid record throughout the scenario.

    Raise MismatchError if there is no such satellite, or the file lacks Klobuchar coefficients that the scenario
    requires.
    """
    navigation = read_navigation(path)
    if "G" not in navigation.klobuchar and scenario.sky.ionosphere_scale > 0.0:
        raise MismatchError(
            f"{path}: has no Klobuchar coefficients of GPS, which the simulated ionosphere needs; use another file, "
            "or set sky.ionosphere_scale to 0 and run `railfix run` with `--set ionosphere=off`"
        )
    records = _select_simulated(navigation.kepler, scenario.sky.systems, _messages(scenario))
    first = scenario.start
    last = first + np.timedelta64(round(scenario.duration_s * 1e9), "ns")
    kept = [rows for name in np.unique(records.satellite) if len(rows := _serving(records, str(name), first, last))]
    if not kept:
        span = f"{records.toe.min()} to {records.toe.max()}" if len(records) else "none of these constellations"
        raise MismatchError(
            f"{path}: no satellite of {scenario.sky.systems!r} has records for the whole scenario, {first} to {last} "
            f"(GPS time); reference times in the file: {span}"
        )
    return Navigation(
        kepler=take_rows(records, np.concatenate(kept)),
        glonass=glonass_records([]),
        klobuchar={"G": navigation.klobuchar["G"]} if "G" in navigation.klobuchar else {"G": np.zeros(8)},
        leap_seconds=int(gpst_minus_utc(first)) if navigation.leap_seconds is None else navigation.leap_seconds,
        sources=navigation.sources,
    )


def _messages(scenario: Scenario) -> dict[str, tuple[str, ...]]:
    return {**_SIGNALS_MESSAGE, "C": ("CNV1",)} if scenario.receiver.has_l5 else _SIGNALS_MESSAGE


def _select_simulated(records: KeplerRecords, systems: str, messages: dict[str, tuple[str, ...]]) -> KeplerRecords:
    """Return the records of the simulated signals; implausible transmission times are replaced by assumed times."""
    letter = records.satellite.astype("<U1")
    usable = np.zeros(len(records), dtype=np.bool_)
    delay = np.where(letter == "E", records.group_delay_2_s, records.group_delay_1_s)
    for system in systems:
        usable |= (letter == system) & np.isin(records.message, messages[system]) & np.isfinite(delay)
    records, letter = take_rows(records, usable), letter[usable]
    serves, before = (timedelta([table[str(s)] for s in letter]) for table in (_SERVES_S, _SENT_BEFORE_S))
    early = records.toe - records.transmitted
    plausible = ~np.isnat(records.transmitted) & (np.abs(early) <= serves)
    return replace(records, transmitted=np.where(plausible, records.transmitted, records.toe - before))


def _serving(records: KeplerRecords, satellite: str, first: np.datetime64, last: np.datetime64) -> Indices:
    """Return the indices of the records of a satellite that are successively in force between `first` and `last`.

    The result is empty if, at any time, no record is in force or the record in force is not valid.
    """
    rows = np.flatnonzero(records.satellite == satellite)
    rows = rows[np.lexsort((records.toe[rows], records.transmitted[rows]))]
    # Of records transmitted at the same time, only the record with the latest reference time is kept.
    rows = rows[np.append(np.diff(records.transmitted[rows]) > np.timedelta64(0, "ns"), True)]
    sent = records.transmitted[rows]
    begin, end = (int(np.searchsorted(sent, time, side="right")) for time in (first, last))
    if begin == 0 or not len(rows):
        return np.empty(0, dtype=np.intp)
    rows = rows[begin - 1 : end]
    limit = timedelta(_SERVES_S[satellite[0]])
    from_time = np.maximum(records.transmitted[rows], first)
    to_time = np.append(records.transmitted[rows][1:], last)
    served = (np.abs(from_time - records.toe[rows]) <= limit) & (np.abs(to_time - records.toe[rows]) <= limit)
    return np.asarray(rows[: len(rows) if served.all() else 0])


#: Fictitious Klobuchar coefficients of realistic size, alpha then beta, for the signals of all constellations.
KLOBUCHAR: Final = (1.118e-8, 2.235e-8, -5.960e-8, -1.192e-7, 1.044e5, 1.147e5, -6.554e4, -3.277e5)
#: Interval at which a satellite transmits a new record [s], by constellation (IS-GPS-200: two hours).
_ISSUE_S: Final = {"G": 7200, "J": 3600, "E": 3600, "C": 3600}
_SENT_AFTER_S: Final = 18  #: Time from the full hour to the first transmission of a record [s].
_SYNCHRONOUS_M: Final = (GM_GPS / EARTH_ROTATION_RATE**2) ** (1.0 / 3.0)  #: Radius of a geosynchronous orbit [m].
#: Galileo data source: I/NAV of E1-B and of E5b-I, clock of E5b and E1 (RINEX 3.04, table A8: bits 0, 2 and 9).
_INAV_SOURCE: Final = 517


@dataclass(frozen=True, kw_only=True)
class _Orbit:
    """Orbit of a satellite at the start of the run; angles [rad], node in the Earth-fixed frame at the start."""

    name: str
    semi_major_m: float
    eccentricity: float
    tilt: float
    perigee: float
    node: float
    mean_anomaly: float


def simulate_navigation(scenario: Scenario) -> Navigation:
    """Return the broadcast records for the duration of a run.

    All values are rounded to the digits that `railfix.io.write_navigation` writes, so that file and arrays describe the
    same satellites. If the scenario names a navigation file, the records are read by `navigation_of_file`, which may
    raise exceptions.
    """
    if scenario.sky.nav is not None:
        return navigation_of_file(scenario, scenario.sky.nav)
    rng = np.random.default_rng([scenario.seed, 1])
    rows: list[dict[str, Any]] = []
    for system in scenario.sky.systems:
        for orbit in _orbits(system, scenario, rng):
            rows += _issues(system, orbit, scenario, rng)
    names = list(KeplerRecords.__dataclass_fields__)
    table = {name: np.array([row[name] for row in rows]) for name in names}
    table["satellite"] = table["satellite"].astype("<U3")
    return Navigation(
        kepler=KeplerRecords(**table),
        glonass=glonass_records([]),
        klobuchar={"G": np.array(KLOBUCHAR)},
        leap_seconds=int(gpst_minus_utc(scenario.start)),
        sources=("simulated",),
    )


def _orbits(system: str, scenario: Scenario, rng: np.random.Generator) -> list[_Orbit]:
    walker = {"G": (6, 5, 26_559_800.0, 55.0, 0.012), "E": (3, 8, 29_600_300.0, 56.0, 0.0004),
              "C": (3, 8, 27_906_100.0, 55.0, 0.001)}  # fmt: skip
    orbits = []
    if system in walker:
        planes, slots, size, tilt, shape = walker[system]
        first = rng.uniform(0.0, 2.0 * np.pi, 2)
        for k in range(planes * slots):
            plane, slot = divmod(k, slots)
            phase = 2.0 * np.pi * (slot / slots + plane / (planes * slots)) + rng.normal(0.0, 0.06)
            perigee = rng.uniform(-np.pi, np.pi)
            orbits.append(
                _Orbit(
                    name=_slot_name(system, k),
                    semi_major_m=size + rng.normal(0.0, 500.0),
                    eccentricity=shape * rng.uniform(0.05, 1.0),
                    tilt=np.radians(tilt + rng.normal(0.0, 0.4)),
                    perigee=perigee,
                    node=first[0] + 2.0 * np.pi * plane / planes + rng.normal(0.0, 0.02),
                    mean_anomaly=first[1] + phase - perigee,
                )
            )
    if system == "J":
        orbits = [
            _figure_of_eight(name, scenario.line.longitude_deg, phase)
            for name, phase in (("J01", 0.15), ("J02", 2.3), ("J04", -1.9))
        ]
        over_equator = {"eccentricity": 0.0003, "tilt": np.radians(0.05), "perigee": 0.0, "node": 0.0}
        orbits.append(_Orbit(name="J03", semi_major_m=_SYNCHRONOUS_M, mean_anomaly=np.radians(127.0), **over_equator))
    if system == "C":
        orbits += [
            _figure_of_eight(f"C{38 + k}", 110.0 + 4.0 * k, phase, eccentricity=0.004, tilt_deg=55.0)
            for k, phase in enumerate((0.6, 2.7, -1.6))
        ]
    return orbits


def _slot_name(system: str, k: int) -> str:
    """Return the name of satellite `k` of a constellation.

    BeiDou satellites have numbers of real MEO satellites, because programs read C01 to C05 as GEO satellites.
    """
    if system == "C":
        return f"C{k + 19 if k < 19 else k + 22:02d}"
    return f"{system}{k + 1:02d}"


def _figure_of_eight(
    name: str, longitude_deg: float, phase: float, *, eccentricity: float = 0.075, tilt_deg: float = 41.0
) -> _Orbit:
    """Return an inclined geosynchronous orbit whose satellite passed its northernmost point `phase` radians ago.

    The northernmost point is the apogee, at the given longitude.
    """
    return _Orbit(
        name=name,
        semi_major_m=_SYNCHRONOUS_M,
        eccentricity=eccentricity,
        tilt=np.radians(tilt_deg),
        perigee=-np.pi / 2.0,
        node=np.radians(longitude_deg) - np.pi / 2.0 - phase,
        mean_anomaly=np.pi + phase,
    )


def _issues(system: str, orbit: _Orbit, scenario: Scenario, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return the records of one satellite as rows: the previous, the current and the following records."""
    every, shift = _ISSUE_S[system], BDT_MINUS_GPST_S if system == "C" else 0.0
    mu, rotation = GM[system], ROTATION[system]
    start_sow = float(to_week(scenario.start)[1])
    first = float(np.floor((start_sow - _SENT_AFTER_S) / every) - 1.0) * every
    count = int((start_sow + scenario.duration_s - _SENT_AFTER_S) // every - first // every) + 1
    motion = float(_digits(rng.normal(4.5e-9, 3e-10)))
    drift = float(_digits(-rng.uniform(7.5e-9, 8.3e-9)))
    tilting = float(_digits(rng.normal(0.0, 3e-10)))
    bias, rate = rng.uniform(-3e-4, 3e-4), rng.normal(0.0, 3e-12)
    wobble = dict(zip(("cuc", "cus", "cic", "cis"), rng.normal(0.0, 3e-6, 4) * (1, 1, 0.03, 0.03), strict=True))
    wobble |= {"crc": rng.normal(200.0, 60.0), "crs": rng.normal(0.0, 60.0)}
    delay = rng.normal(-5e-9, 6e-9, 2)
    issue, message = int(rng.integers(1, 25)), _messages(scenario)[system][0]
    sqrt_a = float(_digits(np.sqrt(orbit.semi_major_m)))
    speed = np.sqrt(mu) / sqrt_a**3 + motion
    rows = []
    for k in range(count):
        sent_sow = first + k * every + _SENT_AFTER_S
        dt = first + (k + 1) * every - start_sow - shift
        toe = scenario.start + timedelta(dt)
        _, toe_sow = to_week(toe + timedelta(shift))
        # Longitude of the node at toe, referred to the start of the week as in the records.
        node = orbit.node + (drift - rotation) * dt + rotation * float(toe_sow)
        ill = orbit.name in scenario.sky.unhealthy and sent_sow + every > start_sow
        row: dict[str, Any] = {
            "af0_s": bias + rate * dt, "af1": rate, "af2": 0.0, "sqrt_a": sqrt_a, "eccentricity": orbit.eccentricity,
            "m0": _wrap(orbit.mean_anomaly + speed * dt), "delta_n": motion, "omega0": _wrap(node),
            "i0": orbit.tilt + tilting * dt, "omega": _wrap(orbit.perigee), "omega_dot": drift, "i_dot": tilting,
            **wobble, "a_dot": 0.0, "delta_n_dot": 0.0, "toe_sow_s": float(toe_sow),
            "accuracy_m": np.nan if message == "CNV1" else 3.12 if system == "E" else 2.0,
            "group_delay_1_s": delay[0], "group_delay_2_s": delay[1] if system in "EC" else np.nan,
            "fit_interval_h": {"G": 4.0, "J": 2.0}.get(system, np.nan),
        }  # fmt: skip
        row = {name: float(_digits(value)) for name, value in row.items()}
        rows.append(
            row
            | {
                "satellite": orbit.name, "message": message, "toc": toe, "toe": toe,
                "inter_signal_s": np.full(6, np.nan),
                "transmitted": scenario.start + timedelta(sent_sow - start_sow),
                "health": _ILL_HEALTH[system] if ill else 0,
                "iode": issue + k, "iodc": issue + k, "data_source": _INAV_SOURCE if system == "E" else 0,
            }
        )  # fmt: skip
    return rows


def _wrap(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _digits(value: float) -> str:
    """Return a value as text with the digits of the RINEX format D19.12."""
    return f"{value:.12E}"


_PIECE_S: Final = 60.0  #: Duration of a piece of `SatelliteTable`, in which positions and clocks are interpolated [s].
_NODES: Final = 7  #: Number of interpolation nodes per piece of `SatelliteTable`.
#: Approximate flight time of a signal, with which the iteration of the light-time equation begins [s].
_FLIGHT_S: Final = 0.08


@dataclass(frozen=True, kw_only=True)
class Links:
    """Geometry and satellite clocks of signals received at T instants from one satellite or from S satellites."""

    #: Geometric range, including the effect of Earth rotation; shape (T,) or (T, S).
    range_m: Floats
    #: Satellite position at transmission, in the Earth-fixed frame at reception; shape (T, 3) or (T, S, 3).
    satellite_ecef_m: Floats
    clock_s: Floats  #: Satellite clock with relativistic correction, without group delay; shape (T,) or (T, S).


def record_state(
    records: KeplerRecords, row: Indices, since_toe_s: Floats, since_toc_s: Floats
) -> tuple[Floats, Floats]:
    """Return positions, shape (T, 3) [m], and clocks with relativistic correction, shape (T,) [s].

    `row` is the row of the record for each instant; `since_toe_s` and `since_toc_s` are the times since the record's
    toe and toc.
    """
    position, _, relativity = kepler_state(Orbits.from_records(records).take(row), since_toe_s)
    dt = since_toc_s
    clock = records.af0_s[row] + records.af1[row] * dt + records.af2[row] * dt**2 + relativity
    return np.stack(position, axis=-1), clock


def newest_record(records: KeplerRecords, satellite: str, time: Datetimes) -> Indices:
    """Return, for each time, the row of the satellite's newest transmitted record, or else of its first record."""
    rows = np.flatnonzero(records.satellite == satellite)
    rows = rows[np.argsort(records.transmitted[rows], kind="stable")]
    return np.asarray(rows[np.maximum(np.searchsorted(records.transmitted[rows], time, side="right") - 1, 0)])


def links(records: KeplerRecords, satellite: str, tag: Datetimes, late_s: Floats, receiver_ecef_m: Floats) -> Links:
    """Return the geometry of the signals that are received from a satellite at instants `late_s` before T time tags.

    The light-time equation is solved by iteration.
    """
    row = newest_record(records, satellite, tag)
    since_toe = seconds(tag - records.toe[row]) - late_s
    since_toc = seconds(tag - records.toc[row]) - late_s

    def state(flight_s: Floats) -> Floats:
        return np.column_stack(record_state(records, row, since_toe - flight_s, since_toc - flight_s))

    return _solve_light_time(state, np.full(late_s.shape, _FLIGHT_S), receiver_ecef_m)


def _solve_light_time(state: Callable[[Floats], Floats], flight_s: Floats, receiver_ecef_m: Floats) -> Links:
    """Solve the light-time equation by iteration from an approximate flight time, shape (...).

    `state` returns the satellite's position and clock, shape (..., 4), for flight times, shape (...).
    """
    x, y, z = (receiver_ecef_m[..., axis] for axis in range(3))
    for _ in range(3):
        place = state(flight_s)
        angle = EARTH_ROTATION_RATE * flight_s
        cos, sin = np.cos(angle), np.sin(angle)
        sky = (cos * place[..., 0] + sin * place[..., 1], cos * place[..., 1] - sin * place[..., 0], place[..., 2])
        distance = np.sqrt((sky[0] - x) ** 2 + (sky[1] - y) ** 2 + (sky[2] - z) ** 2)
        flight_s = distance / SPEED_OF_LIGHT
    return Links(range_m=distance, satellite_ecef_m=np.stack(sky, axis=-1), clock_s=place[..., 3])


class SatelliteTable:
    """States of satellites over a time span, from polynomials of degree 6 that are accurate to 1e-6 m."""

    def __init__(
        self, records: KeplerRecords, satellites: Sequence[str], first: np.datetime64, last: np.datetime64
    ) -> None:
        self.satellites = tuple(satellites)
        self._start = first.astype("datetime64[ns]")
        span = float(seconds(last.astype("datetime64[ns]") - self._start))
        sent = records.transmitted[np.isin(records.satellite, self.satellites)]
        changes = seconds(sent[~np.isnat(sent)] - self._start)
        grid = np.arange(0.0, span, _PIECE_S)
        # A piece ends where a satellite begins to transmit another record.
        self._knots = np.unique(np.concatenate([[0.0], grid, changes[(changes > 0.0) & (changes <= span)]]))
        self._end = span
        ends = np.append(self._knots[1:], max(span, self._knots[-1]) + 1e-9)
        self._middle = (self._knots + ends) / 2.0
        self._half = _PIECE_S / 2.0 + 1.0
        tag = self._start + timedelta(self._knots)
        nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
        at = self._middle[:, None] + self._half * nodes
        values = np.empty((len(tag), _NODES, len(self.satellites), 4))
        for k, name in enumerate(self.satellites):
            row = np.repeat(newest_record(records, name, tag), _NODES)
            since_toe = at.ravel() + seconds(self._start - records.toe[row])
            since_toc = at.ravel() + seconds(self._start - records.toc[row])
            place, clock = record_state(records, row, since_toe, since_toc)
            values[:, :, k, :3] = place.reshape(len(tag), _NODES, 3)
            values[:, :, k, 3] = clock.reshape(len(tag), _NODES)
        to_powers = np.linalg.inv(np.vander(nodes, increasing=True))
        # Coefficients of power k for each piece, shape (_NODES, pieces, S, 4).
        self._powers = np.einsum("kn,pnsc->kpsc", to_powers, values)

    def links(self, tag: Datetimes, late_s: Floats, receiver_ecef_m: Floats) -> Links:
        """Return the geometry of the signals of all satellites at a receiver, as `links` does, shapes (T, S).

        Raise ValueError if a tag is outside the span of the table.
        """
        when = seconds(tag - self._start)
        if when.size and (when.min() < 0.0 or when.max() > self._end):
            raise ValueError("tag is outside the time span of the satellite table")
        piece = np.searchsorted(self._knots, when, side="right") - 1
        u = ((when - self._middle[piece] - late_s - _FLIGHT_S) / self._half)[:, None, None]
        # Horner's rule for value, slope and half the second derivative.
        value = self._powers[-1][piece]
        slope, bend = np.zeros_like(value), np.zeros_like(value)
        for k in range(_NODES - 2, -1, -1):
            bend = bend * u + slope
            slope = slope * u + value
            value = value * u + self._powers[k][piece]
        slope /= self._half
        bend /= self._half**2

        def state(flight_s: Floats) -> Floats:
            dt = (_FLIGHT_S - flight_s)[..., None]
            return np.asarray(value + dt * (slope + dt * bend))

        return _solve_light_time(state, np.full(value.shape[:2], _FLIGHT_S), receiver_ecef_m[:, None])
