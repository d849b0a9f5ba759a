"""Messages about the GEO itself, about time, and about how corrections grow old, decoded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers
from railfix.ranges.sbas.decode import of_types
from railfix.ranges.sbas.fields import day_time
from railfix.ranges.sbas.log import SbasLog

#: Regions of one message of type 27, bits of one.
_REGIONS: Final = 5
_REGION_BITS: Final = 35


@dataclass(frozen=True, kw_only=True)
class Degradation:
    """Type 10, all (n,): how errors grow (DO-229D, table A-9)."""

    row: Integers
    range_rate_m: Floats
    long_term_step_m: Floats
    long_term_rate_mps: Floats
    long_term_interval_s: Floats
    still_step_m: Floats
    still_interval_s: Floats
    geo_step_m: Floats
    geo_rate_mps: Floats
    geo_interval_s: Floats
    en_route_m: Floats
    iono_step_m: Floats
    iono_interval_s: Floats
    iono_rate_mps: Floats
    rss_udre: Integers
    rss_iono: Integers
    covariance: Floats


@dataclass(frozen=True, kw_only=True)
class Covariance:
    """Type 28, one row a satellite: `slot`, `iodp`, `scale` (n,), `factor` (n, 4, 4), upper triangular, scaled."""

    row: Integers
    slot: Integers
    iodp: Integers
    scale: Floats
    factor: Floats


@dataclass(frozen=True, kw_only=True)
class Service:
    """Type 27: `issue`, `messages`, `message`, `regions`, `priority`, `inside`, `outside` (n,); corners (n, 5)."""

    row: Integers
    issue: Integers
    messages: Integers
    message: Integers
    regions: Integers
    priority: Integers
    inside: Integers
    outside: Integers
    latitude_1_deg: Floats
    longitude_1_deg: Floats
    latitude_2_deg: Floats
    longitude_2_deg: Floats
    square: Integers


@dataclass(frozen=True, kw_only=True)
class GeoNavigation:
    """Type 9: motion (n, 3) and clock (n,) of the sender at `reference`; `accuracy` is the URA index, 15 unusable."""

    row: Integers
    prn: Integers
    reference: Datetimes
    accuracy: Integers
    position_ecef_m: Floats
    velocity_ecef_mps: Floats
    acceleration_ecef_mps2: Floats
    clock_s: Floats
    clock_rate: Floats

    def state(self, row: Integers, time: Datetimes) -> tuple[Floats, Floats]:
        """Position (..., 3) [m] and clock (...) [s] of messages `row` at instants (DO-229D, A.4.4.11)."""
        since = ((time - self.reference[row]) / np.timedelta64(1, "ns")) * 1e-9
        position = (
            self.position_ecef_m[row]
            + self.velocity_ecef_mps[row] * since[..., None]
            + 0.5 * self.acceleration_ecef_mps2[row] * since[..., None] ** 2
        )
        return position, self.clock_s[row] + self.clock_rate[row] * since


@dataclass(frozen=True, kw_only=True)
class GeoAlmanacs:
    """Type 17, one row a satellite: `prn`, `health`, `reference` (n,), position and velocity (n, 3)."""

    row: Integers
    prn: Integers
    health: Integers
    reference: Datetimes
    position_ecef_m: Floats
    velocity_ecef_mps: Floats


@dataclass(frozen=True, kw_only=True)
class NetworkTime:
    """Type 12, all (n,): offset of network time to UTC, and its own time of week."""

    row: Integers
    offset_s: Floats
    drift: Floats
    reference_s: Floats
    reference_week: Integers
    leap_s: Integers
    leap_week: Integers
    leap_day: Integers
    next_leap_s: Integers
    utc_standard: Integers
    time_of_week_s: Floats
    week: Integers


def degradation(log: SbasLog) -> Degradation:
    """Decode type 10."""
    row, field = of_types(log, 10)
    return Degradation(
        row=row,
        range_rate_m=field.positive(14, 10, 0.002),
        long_term_step_m=field.positive(24, 10, 0.002),
        long_term_rate_mps=field.positive(34, 10, 0.00005),
        long_term_interval_s=field.positive(44, 9, 1.0),
        still_step_m=field.positive(53, 10, 0.002),
        still_interval_s=field.positive(63, 9, 1.0),
        geo_step_m=field.positive(72, 10, 0.0005),
        geo_rate_mps=field.positive(82, 10, 0.00005),
        geo_interval_s=field.positive(92, 9, 1.0),
        en_route_m=field.positive(101, 6, 0.5),
        iono_step_m=field.positive(107, 10, 0.001),
        iono_interval_s=field.positive(117, 9, 1.0),
        iono_rate_mps=field.positive(126, 10, 0.000005),
        rss_udre=field.unsigned(136, 1),
        rss_iono=field.unsigned(137, 1),
        covariance=field.positive(138, 7, 0.1),
    )


def covariance(log: SbasLog) -> Covariance:
    """Decode both halves of type 28."""
    row, field = of_types(log, 28)
    iodp = field.unsigned(14, 2)
    parts = []
    for start in (16, 121):
        scale = np.exp2(field.positive(start + 6, 3, 1.0) - 5.0)
        factor = np.zeros((len(row), 4, 4))
        factor[:, range(4), range(4)] = field.unsigned_row(start + 9, 9, 4)
        upper = field.signed_row(start + 45, 10, 6)
        factor[:, [0, 0, 0, 1, 1, 2], [1, 2, 3, 2, 3, 3]] = upper
        parts.append((row, field.unsigned(start, 6) - 1, iodp, scale, factor * scale[:, None, None]))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    keep = np.flatnonzero((columns[1] >= 0) & (columns[1] < 51))
    order = keep[np.argsort(columns[0][keep], kind="stable")]
    names = ("row", "slot", "iodp", "scale", "factor")
    return Covariance(**{name: column[order] for name, column in zip(names, columns, strict=True)})


def service(log: SbasLog) -> Service:
    """Decode type 27."""
    row, field = of_types(log, 27)

    def corners(start: int, length: int) -> Floats:
        values = [field.signed(36 + start + i * _REGION_BITS, length) for i in range(_REGIONS)]
        return np.stack(values, axis=1).astype(np.float64)

    return Service(
        row=row,
        issue=field.unsigned(14, 3),
        messages=field.unsigned(17, 3) + 1,
        message=field.unsigned(20, 3) + 1,
        regions=np.minimum(field.unsigned(23, 3), _REGIONS),
        priority=field.unsigned(26, 2),
        inside=field.unsigned(28, 4),
        outside=field.unsigned(32, 4),
        latitude_1_deg=corners(0, 8),
        longitude_1_deg=corners(8, 9),
        latitude_2_deg=corners(17, 8),
        longitude_2_deg=corners(25, 9),
        square=field.unsigned_row(36 + 34, 1, _REGIONS, _REGION_BITS),
    )


def geo_navigation(log: SbasLog) -> GeoNavigation:
    """Decode type 9."""
    row, field = of_types(log, 9)

    def vector(
        starts: tuple[int, int, int], lengths: tuple[int, int, int], units: tuple[float, float, float]
    ) -> Floats:
        return np.stack([field.real(s, n, u) for s, n, u in zip(starts, lengths, units, strict=True)], axis=1)

    return GeoNavigation(
        row=row,
        prn=log.prn[row],
        reference=day_time(field.positive(22, 13, 16.0), log.time[row]),
        accuracy=field.unsigned(35, 4),
        position_ecef_m=vector((39, 69, 99), (30, 30, 25), (0.08, 0.08, 0.4)),
        velocity_ecef_mps=vector((124, 141, 158), (17, 17, 18), (0.000625, 0.000625, 0.004)),
        acceleration_ecef_mps2=vector((176, 186, 196), (10, 10, 10), (0.0000125, 0.0000125, 0.0000625)),
        clock_s=field.real(206, 12, 2.0**-31),
        clock_rate=field.real(218, 8, 2.0**-40),
    )


def geo_almanacs(log: SbasLog) -> GeoAlmanacs:
    """Decode type 17; entries of PRN 0 are empty."""
    row, field = of_types(log, 17)
    reference = day_time(field.positive(215, 11, 64.0), log.time[row])
    parts = []
    for start in (14, 81, 148):
        position = np.stack(
            [
                field.real(start + 18, 15, 2600.0),
                field.real(start + 33, 15, 2600.0),
                field.real(start + 48, 9, 26_000.0),
            ],
            axis=1,
        )
        velocity = np.stack(
            [
                field.real(start + 57, 3, 10.0),
                field.real(start + 60, 3, 10.0),
                field.real(start + 63, 4, 60.0),
            ],
            axis=1,
        )
        parts.append((row, field.unsigned(start + 2, 8), field.unsigned(start + 10, 8), reference, position, velocity))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    keep = np.flatnonzero(columns[1] != 0)
    order = keep[np.argsort(columns[0][keep], kind="stable")]
    names = ("row", "prn", "health", "reference", "position_ecef_m", "velocity_ecef_mps")
    return GeoAlmanacs(**{name: column[order] for name, column in zip(names, columns, strict=True)})


def network_time(log: SbasLog) -> NetworkTime:
    """Decode type 12."""
    row, field = of_types(log, 12)
    return NetworkTime(
        row=row,
        drift=field.real(14, 24, 2.0**-50),
        offset_s=field.real(38, 32, 2.0**-30),
        reference_s=field.positive(70, 8, 4096.0),
        reference_week=field.unsigned(78, 8),
        leap_s=field.signed(86, 8),
        leap_week=field.unsigned(94, 8),
        leap_day=field.unsigned(102, 8),
        next_leap_s=field.signed(110, 8),
        utc_standard=field.unsigned(118, 3),
        time_of_week_s=field.positive(121, 20, 1.0),
        week=field.unsigned(141, 10),
    )
