"""Broadcast and precise ephemerides as read-only arrays.

Each row of a record table is one navigation message of one satellite. All times are GPS time. Units are SI units and
radians. Absent values are NaN, or NaT for times.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from railfix.core.arrays import Datetimes, Floats, FrozenArrays, Integers, Strings, freeze_arrays, freeze_rows
from railfix.core.notebook import NotebookTable, plural, time_span_text


def _records_text(satellite: Strings, toe: Datetimes) -> str:
    """Return a text for `repr`: number of records, satellites, constellations and time span."""
    satellites = np.unique(satellite)
    systems = "".join(np.unique(satellites.astype("<U1")).tolist())
    text = f"{plural(satellite, 'record')} of {plural(satellites, 'satellite')}"
    return f"{text} ({systems}), {time_span_text(np.sort(toe))}" if satellites.size else text


class _NavigationRecords(FrozenArrays, NotebookTable):
    """Base class of record tables; it defines the length and `repr`, and makes the arrays read-only."""

    satellite: Strings
    toe: Datetimes

    def __post_init__(self) -> None:
        freeze_rows(self, "records", "satellite")  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self.satellite)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {_records_text(self.satellite, self.toe)}>"


@dataclass(frozen=True, kw_only=True, repr=False)
class KeplerRecords(_NavigationRecords):
    """Keplerian records of GPS, QZSS, Galileo and BeiDou, n rows."""

    satellite: Strings  #: Name of the satellite, such as "G01"; shape (n,).
    #: Name of the message: "LNAV", "CNAV", "CNV2" (GPS, QZSS), "INAV", "FNAV" (Galileo), "D1", "D2", "CNV1" to "CNV3"
    #: (BeiDou); shape (n,).
    message: Strings
    #: Reference times of clock (toc) and ephemeris (toe), GPS time. The week of toe is resolved from toc; shape (n,).
    toc: Datetimes
    toe: Datetimes
    #: Transmission time of the message; NaT where the file has none or an implausible time; shape (n,).
    transmitted: Datetimes
    #: Coefficients of the satellite clock polynomial [s, s/s, s/s^2]; shape (n,).
    af0_s: Floats
    af1: Floats
    af2: Floats
    #: Orbit elements at toe, shape (n,); units in this order: m^0.5, -, rad, rad/s, rad, rad, rad, rad/s, rad/s.
    sqrt_a: Floats
    eccentricity: Floats
    m0: Floats
    delta_n: Floats
    omega0: Floats
    i0: Floats
    omega: Floats
    omega_dot: Floats
    i_dot: Floats
    #: Rates of the semi-major axis and of delta_n; 0 in messages without rates; shape (n,) [m/s, rad/s^2].
    a_dot: Floats
    delta_n_dot: Floats
    #: Amplitudes of the harmonic corrections [rad, rad, m, m, rad, rad]; shape (n,).
    cuc: Floats
    cus: Floats
    crc: Floats
    crs: Floats
    cic: Floats
    cis: Floats
    #: Toe in seconds of the constellation's week (BDT for BeiDou), used for the longitude of the node; shape (n,).
    toe_sow_s: Floats
    #: GPS, QZSS: SV health (CNAV: bits of L1, L2, L5). Galileo: 9 bits. BeiDou: SatH1 (CNV: HS). Shape (n,).
    health: Integers
    #: URA or SISA as in the file; nominal value of the URA_ED index for CNAV, NaN for CNV1 to CNV3; shape (n,).
    accuracy_m: Floats
    #: Issues of data of the ephemeris (iode) and the clock (iodc), shape (n,). Both are IODnav for Galileo; for BeiDou
    #: D1 and D2, they are AODE and AODC.
    iode: Integers
    iodc: Integers
    data_source: Integers  #: Data source flags (Galileo) or codes on L2 (GPS, QZSS); 0 for BeiDou; shape (n,).
    #: First and second group delay, shape (n,). GPS and QZSS: TGD and NaN. Galileo: BGD E5a/E1 and BGD E5b/E1. BeiDou
    #: D1 and D2: TGD1 and TGD2. CNV1 and CNV2: TGD_B1Cp and TGD_B2ap. CNV3: TGD_B2bI and NaN.
    group_delay_1_s: Floats
    group_delay_2_s: Floats
    #: Inter-signal corrections, shape (n, 6). Columns of GPS and QZSS: L1 C/A, L2C, L5I5, L5Q5, L1C_D, L1C_P. Columns
    #: of BeiDou: B1C_D and B2a_D. Other values are NaN.
    inter_signal_s: Floats
    #: Fit interval [h] of GPS (flag 0 means 4 h, 1 means 6 h) and QZSS (0 means 2 h, 1 means 4 h), else NaN; (n,).
    fit_interval_h: Floats


@dataclass(frozen=True, kw_only=True, repr=False)
class GlonassRecords(_NavigationRecords):
    """State-vector records of GLONASS, n rows."""

    satellite: Strings  #: Name of the satellite, such as "R01"; shape (n,).
    toe: Datetimes  #: Reference time, converted from UTC to GPS time; shape (n,).
    transmitted: Datetimes  #: Message frame time in GPS time, NaT if absent; shape (n,).
    clock_bias_s: Floats  #: Satellite clock offset -tau_n, as in RINEX; shape (n,).
    relative_frequency: Floats  #: Relative frequency offset +gamma_n of the satellite clock, shape (n,).
    #: Position, velocity and luni-solar acceleration at toe in PZ-90; shape (n, 3).
    position_ecef_m: Floats
    velocity_ecef_mps: Floats
    acceleration_ecef_mps2: Floats
    health: Integers  #: Broadcast health, 0 if healthy; shape (n,).
    frequency_channel: Integers  #: Number of the frequency channel, -7 to 6; shape (n,).
    age_days: Floats  #: Age of the immediate data (E_n), shape (n,).


@dataclass(frozen=True, kw_only=True)
class PreciseEphemeris(NotebookTable):
    """Positions and clocks from SP3, E epochs by N satellites."""

    time: Datetimes  #: Epochs, converted to GPS time if necessary; shape (E,).
    satellite: Strings  #: Names of the satellites, shape (N,).
    position_ecef_m: Floats  #: Satellite position; NaN where the file has none (0.000000), shape (E, N, 3).
    clock_s: Floats  #: Satellite clock offset; NaN where the file has none (999999.999999), shape (E, N).
    source: str = ""  #: Names of the files.
    notes: tuple[str, ...] = ()  #: Notes on omitted records, with the reasons.

    def __post_init__(self) -> None:
        expected = (len(self.time), len(self.satellite))
        if self.clock_s.shape != expected or self.position_ecef_m.shape != (*expected, 3):
            raise ValueError(
                f"position_ecef_m {self.position_ecef_m.shape} and clock_s {self.clock_s.shape} "
                f"do not match (epochs, satellites) = {expected}"
            )
        freeze_arrays(self)

    def __repr__(self) -> str:
        span = time_span_text(self.time)
        return f"<PreciseEphemeris: {plural(self.time, 'epoch')} of {plural(self.satellite, 'satellite')}, {span}>"


@dataclass(frozen=True, kw_only=True, eq=False)
class Navigation(NotebookTable):
    """Content of navigation files; compared and hashed by identity, so that derived tables can be cached."""

    kepler: KeplerRecords
    glonass: GlonassRecords
    #: Klobuchar alpha 0-3 and beta 0-3 by constellation letter ("G", "C", "J"), as received, shape (8,). Coefficients
    #: that are all zero count as not received, and are omitted with a note.
    klobuchar: Mapping[str, Floats] = field(default_factory=dict)
    leap_seconds: int | None = None  #: GPST - UTC [s] from the header.
    #: Number of skipped records by kind: constellation ("S", "I"), message ("G CNAV") or "duplicate".
    skipped: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  #: Remarks for the user, such as on rejected records.
    precise: PreciseEphemeris | None = None  #: Ephemeris that replaces the broadcast orbits and clocks, if any.
    sources: tuple[str, ...] = ()  #: Names of the files.

    def __repr__(self) -> str:
        satellite = np.concatenate([self.kepler.satellite, self.glonass.satellite])
        toe = np.concatenate([self.kepler.toe, self.glonass.toe])
        klobuchar = f"Klobuchar {''.join(sorted(self.klobuchar)) or 'none'}"
        precise = ", precise ephemeris" if self.precise is not None else ""
        return f"<Navigation: {_records_text(satellite, toe)}, {klobuchar}{precise}>"


@lru_cache(maxsize=8)
def glonass_channels(navigation: Navigation) -> dict[str, int]:
    """Return the GLONASS frequency channel by satellite, for logs whose header lacks GLONASS SLOT / FRQ #."""
    records = navigation.glonass
    return dict(zip(records.satellite.tolist(), records.frequency_channel.tolist(), strict=True))
