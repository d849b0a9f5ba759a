"""Messages that correct satellites and the ionosphere, decoded (DO-229D, A.4.4).

Every table holds `row`, the row of the log that its own rows come from. Numbers are those of the
message in SI units; nothing is applied here and no message is held against another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks
from railfix.ranges.sbas.fields import Fields, day_time
from railfix.ranges.sbas.log import SbasLog

#: Satellites that a PRN mask may name; corrections are sent for its slots 0 to 50.
SLOTS: Final = 51
#: Slots of one message of type 2 to 5, and of one of type 24.
BLOCK: Final = 13
HALF_BLOCK: Final = 6
_PRC_M: Final = 0.125
_DELAY_M: Final = 0.125
_DO_NOT_USE_DELAY: Final = 0x1FF


@dataclass(frozen=True, kw_only=True)
class PrnMasks:
    """Type 1: `number` (n, 51) of the PRN mask by slot, 0 where there is none; `iodp` (n,)."""

    row: Integers
    iodp: Integers
    number: Integers


@dataclass(frozen=True, kw_only=True)
class FastCorrections:
    """Types 2 to 5, 24 and (asked for) 0, one row a slot: `prc_m`, `udrei`, `iodf`, `iodp`, all (n,)."""

    row: Integers
    slot: Integers
    prc_m: Floats
    udrei: Integers
    iodf: Integers
    iodp: Integers


@dataclass(frozen=True, kw_only=True)
class Integrity:
    """Type 6: `iodf` (n, 4) of the blocks, `udrei` (n, 51)."""

    row: Integers
    iodf: Integers
    udrei: Integers


@dataclass(frozen=True, kw_only=True)
class FastDegradation:
    """Type 7: `latency_s` and `iodp` (n,), `indicator` (n, 51)."""

    row: Integers
    latency_s: Floats
    iodp: Integers
    indicator: Integers


@dataclass(frozen=True, kw_only=True)
class LongTerm:
    """Types 24 and 25, one row a satellite.

    `slot`, `iode`, `iodp`, `velocity_code` (n,); `position_m`, `velocity_mps` (n, 3), `clock_s`,
    `clock_rate` (n,), and `reference` (n,), the instant they hold for, NaT without velocity.
    """

    row: Integers
    slot: Integers
    iode: Integers
    iodp: Integers
    velocity_code: Integers
    position_m: Floats
    velocity_mps: Floats
    clock_s: Floats
    clock_rate: Floats
    reference: Datetimes


@dataclass(frozen=True, kw_only=True)
class GridMasks:
    """Type 18: `band`, `iodi`, `bands` (n,), `mask` (n, 201)."""

    row: Integers
    band: Integers
    iodi: Integers
    bands: Integers
    mask: Masks


@dataclass(frozen=True, kw_only=True)
class GridDelays:
    """Type 26: `band`, `block`, `iodi` (n,), `delay_m` (n, 15), NaN for do not use, `givei` (n, 15)."""

    row: Integers
    band: Integers
    block: Integers
    iodi: Integers
    delay_m: Floats
    givei: Integers


def of_types(log: SbasLog, *types: int) -> tuple[Integers, Fields]:
    """Rows of some message types, and their bits."""
    row = np.flatnonzero(np.isin(log.type, types)).astype(np.int64)
    return row, Fields(log.bits[row])


def prn_masks(log: SbasLog) -> PrnMasks:
    """Decode type 1."""
    row, field = of_types(log, 1)
    message, bit = np.nonzero(field.flags(14, 210))
    slot = np.arange(len(message)) - np.searchsorted(message, message)
    number = np.zeros((len(row), SLOTS), dtype=np.int64)
    kept = slot < SLOTS
    number[message[kept], slot[kept]] = bit[kept] + 1
    return PrnMasks(row=row, iodp=field.unsigned(224, 2), number=number)


def fast_corrections(log: SbasLog, *, type0: Literal["stop", "as_type2"]) -> FastCorrections:
    """Decode types 2 to 5, 24, and 0 where it stands for 2 and is not empty."""
    parts = [_fast_block(log, *of_types(log, 2, 3, 4, 5))]
    if type0 == "as_type2":
        row, field = of_types(log, 0)
        filled = field.flags(14, 212).any(axis=1)
        parts.append(_fast_block(log, row[filled], Fields(log.bits[row[filled]])))
    row, field = of_types(log, 24)
    parts.append(
        _fast_rows(
            row,
            BLOCK * field.unsigned(112, 2),
            field.signed_row(14, 12, HALF_BLOCK),
            field.unsigned_row(86, 4, HALF_BLOCK),
            field.unsigned(114, 2),
            field.unsigned(110, 2),
        )
    )
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}
    order = np.argsort(joined["row"], kind="stable")
    return FastCorrections(**{name: values[order] for name, values in joined.items()})


def _fast_block(log: SbasLog, row: Integers, field: Fields) -> FastCorrections:
    return _fast_rows(
        row,
        BLOCK * np.maximum(log.type[row] - 2, 0),
        field.signed_row(18, 12, BLOCK),
        field.unsigned_row(174, 4, BLOCK),
        field.unsigned(14, 2),
        field.unsigned(16, 2),
    )


def _fast_rows(
    row: Integers, first: Integers, prc: Integers, udrei: Integers, iodf: Integers, iodp: Integers
) -> FastCorrections:
    count = prc.shape[1]
    slot = first[:, None] + np.arange(count)
    message, column = np.nonzero(slot < SLOTS)
    return FastCorrections(
        row=row[message],
        slot=slot[message, column],
        prc_m=np.asarray(prc[message, column] * _PRC_M, dtype=np.float64),
        udrei=udrei[message, column],
        iodf=iodf[message],
        iodp=iodp[message],
    )


def integrity(log: SbasLog) -> Integrity:
    """Decode type 6."""
    row, field = of_types(log, 6)
    return Integrity(row=row, iodf=field.unsigned_row(14, 2, 4), udrei=field.unsigned_row(22, 4, SLOTS))


def fast_degradation(log: SbasLog) -> FastDegradation:
    """Decode type 7."""
    row, field = of_types(log, 7)
    return FastDegradation(
        row=row,
        latency_s=field.unsigned(14, 4).astype(np.float64),
        iodp=field.unsigned(18, 2),
        indicator=field.unsigned_row(22, 4, SLOTS),
    )


def long_term(log: SbasLog) -> LongTerm:
    """Decode the halves of type 25 and the one of type 24."""
    row, field = of_types(log, 25)
    parts = _half(log, row, field, 14) + _half(log, row, field, 120)
    row, field = of_types(log, 24)
    parts += _half(log, row, field, 120)
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}
    keep = np.flatnonzero((joined["slot"] >= 0) & (joined["slot"] < SLOTS))
    order = keep[np.argsort(joined["row"][keep], kind="stable")]
    return LongTerm(**{name: values[order] for name, values in joined.items()})


def _half(log: SbasLog, row: Integers, field: Fields, start: int) -> list[LongTerm]:
    """One half message: two satellites without velocity, or one with it."""
    moving = field.unsigned(start, 1) == 1
    still, with_velocity = Fields(log.bits[row[~moving]]), Fields(log.bits[row[moving]])
    return [
        _still(row[~moving], still, start + 1, start + 103),
        _still(row[~moving], still, start + 52, start + 103),
        _moving(log, row[moving], with_velocity, start + 1),
    ]


def _still(row: Integers, field: Fields, start: int, iodp: int) -> LongTerm:
    zero = np.zeros(len(row), dtype=np.int64)
    return LongTerm(
        row=row,
        slot=field.unsigned(start, 6) - 1,
        iode=field.unsigned(start + 6, 8),
        iodp=field.unsigned(iodp, 2),
        velocity_code=zero,
        position_m=field.real_row(start + 14, 9, 3, 0.125),
        velocity_mps=np.zeros((len(row), 3)),
        clock_s=field.real(start + 41, 10, 2.0**-31),
        clock_rate=np.zeros(len(row)),
        reference=np.full(len(row), np.datetime64("NaT"), dtype="datetime64[ns]"),
    )


def _moving(log: SbasLog, row: Integers, field: Fields, start: int) -> LongTerm:
    return LongTerm(
        row=row,
        slot=field.unsigned(start, 6) - 1,
        iode=field.unsigned(start + 6, 8),
        iodp=field.unsigned(start + 103, 2),
        velocity_code=np.ones(len(row), dtype=np.int64),
        position_m=field.real_row(start + 14, 11, 3, 0.125),
        velocity_mps=field.real_row(start + 58, 8, 3, 2.0**-11),
        clock_s=field.real(start + 47, 11, 2.0**-31),
        clock_rate=field.real(start + 82, 8, 2.0**-39),
        reference=day_time(field.positive(start + 90, 13, 16.0), log.time[row]),
    )


def grid_masks(log: SbasLog) -> GridMasks:
    """Decode type 18."""
    row, field = of_types(log, 18)
    return GridMasks(
        row=row,
        bands=field.unsigned(14, 4),
        band=field.unsigned(18, 4),
        iodi=field.unsigned(22, 2),
        mask=field.flags(24, 201),
    )


def grid_delays(log: SbasLog) -> GridDelays:
    """Decode type 26."""
    row, field = of_types(log, 26)
    delay = field.unsigned_row(22, 9, 15, 13)
    return GridDelays(
        row=row,
        band=field.unsigned(14, 4),
        block=field.unsigned(18, 4),
        iodi=field.unsigned(217, 2),
        delay_m=np.where(delay == _DO_NOT_USE_DELAY, np.nan, delay * _DELAY_M),
        givei=field.unsigned_row(31, 4, 15, 13),
    )
