"""Decoders of SBAS messages by tables of bit fields (RTCA DO-229D, A.4.4); decoded values are in SI units.

Every decoder returns arrays by name, all with n rows; the array `row` has the index of the message from which each row
was decoded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Bytes, Datetimes, Floats, Integers, Masks
from railfix.core.timescale import SECONDS_PER_DAY, seconds, timedelta
from railfix.ranges.sbas.messages import SbasMessages

Decoded = dict[str, NDArray[Any]]  #: Decoded arrays by field name.
SLOTS: Final = 51  #: Largest number of satellites in a PRN mask; corrections refer to the slots 0 to 50 of the mask.
BLOCK: Final = 13  #: Number of slots with corrections in one message of types 2 to 5.
#: Largest number of regions in one message of type 27.
_REGIONS: Final = 5
_DO_NOT_USE_DELAY_M: Final = 0x1FF * 0.125
#: Rows and columns of the elements above the diagonal of a covariance factor, in the order of the message.
_UPPER: Final = ([0, 0, 0, 1, 1, 2], [1, 2, 3, 2, 3, 3])


class BitField(NamedTuple):
    """Bit field of a message: one number, or `number` numbers that begin `step` (by default `length`) bits apart."""

    first: int
    length: int
    #: Value of the least significant bit; with None, the number is read as an integer.
    scale: float | None = None
    signed: bool = False
    number: int | None = None
    step: int | None = None
    least: float = 0.0  #: Value added to the number after scaling.


def _read_signed(first: int, length: int, scale: float | None = None, number: int | None = None) -> BitField:
    return BitField(first, length, scale, True, number)


#: Fields of a message or of a part of a message; a sequence of bit fields becomes one array with a column per field.
Layout = Mapping[str, BitField | Sequence[BitField]]

#: Layouts of complete messages, by type, and of parts of messages. The bits of a part are counted from the beginning of
#: the part.
LAYOUTS: Final[dict[str, Layout]] = {
    "type 1": {"member": BitField(14, 1, number=210), "iodp": BitField(224, 2)},
    "type 2": {
        "iodf": BitField(14, 2),
        "iodp": BitField(16, 2),
        "prc_m": _read_signed(18, 12, 0.125, BLOCK),
        "udrei": BitField(174, 4, number=BLOCK),
    },
    "type 6": {"iodf": BitField(14, 2, number=4), "udrei": BitField(22, 4, number=SLOTS)},
    "type 7": {"latency_s": BitField(14, 4, 1.0), "iodp": BitField(18, 2), "indicator": BitField(22, 4, number=SLOTS)},
    # degradation of corrections (table A-9)
    "type 10": {
        "range_rate_m": BitField(14, 10, 0.002),
        "long_term_step_m": BitField(24, 10, 0.002),
        "long_term_rate_mps": BitField(34, 10, 0.00005),
        "long_term_interval_s": BitField(44, 9, 1.0),
        "still_step_m": BitField(53, 10, 0.002),
        "still_interval_s": BitField(63, 9, 1.0),
        "geo_step_m": BitField(72, 10, 0.0005),
        "geo_rate_mps": BitField(82, 10, 0.00005),
        "geo_interval_s": BitField(92, 9, 1.0),
        "en_route_m": BitField(101, 6, 0.5),
        "iono_step_m": BitField(107, 10, 0.001),
        "iono_interval_s": BitField(117, 9, 1.0),
        "iono_rate_mps": BitField(126, 10, 0.000005),
        "rss_udre": BitField(136, 1),
        "rss_iono": BitField(137, 1),
        "covariance": BitField(138, 7, 0.1),
    },
    "type 12": {
        "drift": _read_signed(14, 24, 2.0**-50),
        "offset_s": _read_signed(38, 32, 2.0**-30),
        "reference_s": BitField(70, 8, 4096.0),
        "reference_week": BitField(78, 8),
        "leap_s": _read_signed(86, 8),
        "leap_week": BitField(94, 8),
        "leap_day": BitField(102, 8),
        "next_leap_s": _read_signed(110, 8),
        "utc_standard": BitField(118, 3),
        "time_of_week_s": BitField(121, 20, 1.0),
        "week": BitField(141, 10),
    },
    "type 18": {
        "bands": BitField(14, 4),
        "band": BitField(18, 4),
        "iodi": BitField(22, 2),
        "mask": BitField(24, 1, number=201),
    },
    "type 24": {
        "prc_m": _read_signed(14, 12, 0.125, 6),
        "udrei": BitField(86, 4, number=6),
        "iodp": BitField(110, 2),
        "block": BitField(112, 2),
        "iodf": BitField(114, 2),
    },
    "type 26": {
        "band": BitField(14, 4),
        "block": BitField(18, 4),
        "delay_m": BitField(22, 9, 0.125, number=15, step=13),
        "givei": BitField(31, 4, number=15, step=13),
        "iodi": BitField(217, 2),
    },
    "type 27": {
        "issue": BitField(14, 3),
        "messages": BitField(17, 3),
        "message": BitField(20, 3),
        "regions": BitField(23, 3),
        "priority": BitField(26, 2),
        "inside": BitField(28, 4),
        "outside": BitField(32, 4),
        "latitude_1_deg": BitField(36, 8, 1.0, True, _REGIONS, 35),
        "longitude_1_deg": BitField(44, 9, 1.0, True, _REGIONS, 35),
        "latitude_2_deg": BitField(53, 8, 1.0, True, _REGIONS, 35),
        "longitude_2_deg": BitField(61, 9, 1.0, True, _REGIONS, 35),
        "square": BitField(70, 1, number=_REGIONS, step=35),
    },
    "type 28": {"iodp": BitField(14, 2)},
    # Half of a message of type 25 with velocity code 0: two satellites, then the issue of the PRN mask.
    "half of type 25": {"velocity_code": BitField(0, 1), "iodp": BitField(103, 2)},
    "satellite of type 25": {
        "slot": BitField(0, 6),
        "iode": BitField(6, 8),
        "position_m": _read_signed(14, 9, 0.125, 3),
        "clock_s": _read_signed(41, 10, 2.0**-31),
    },
    # Half of a message of type 25 with velocity code 1: one satellite, with velocity.
    "satellite with velocity of type 25": {
        "slot": BitField(1, 6),
        "iode": BitField(7, 8),
        "position_m": _read_signed(15, 11, 0.125, 3),
        "clock_s": _read_signed(48, 11, 2.0**-31),
        "velocity_mps": _read_signed(59, 8, 2.0**-11, 3),
        "clock_rate": _read_signed(83, 8, 2.0**-39),
        "time_of_day_s": BitField(91, 13, 16.0),
        "iodp": BitField(104, 2),
    },
    "satellite of type 28": {
        "slot": BitField(0, 6),
        "exponent": BitField(6, 3, 1.0),
        "diagonal": BitField(9, 9, number=4),
        "upper": _read_signed(45, 10, number=6),
    },
}


def read_fields(bits: Bytes, layout: Layout, offset: int = 0) -> Decoded:
    """Decode the fields of a layout that begins at the bit `offset`, from message bytes of shape (n, 32).

    Arrays have shape (n,) or (n, number) and type int64, or float64 where the field has a scale.
    """
    unpacked = np.unpackbits(np.ascontiguousarray(bits), axis=1)

    def read(field: BitField | Sequence[BitField]) -> NDArray[Any]:
        if not isinstance(field, BitField):
            return np.stack([read(part) for part in field], axis=1)
        step = field.length if field.step is None else field.step
        begins = offset + field.first + step * np.arange(1 if field.number is None else field.number)
        at = begins[:, None] + np.arange(field.length)
        value = unpacked[:, at].astype(np.int64) @ (np.int64(1) << np.arange(field.length - 1, -1, -1, dtype=np.int64))
        if field.signed:
            value = np.where(value >> (field.length - 1), value - (np.int64(1) << field.length), value)
        if field.number is None:
            value = value[:, 0]
        return value if field.scale is None else np.asarray(value * field.scale + field.least, dtype=np.float64)

    return {name: read(field) for name, field in layout.items()}


def find_rows(messages: SbasMessages, *types: int) -> Integers:
    """Return the rows of the messages of the given types."""
    return np.flatnonzero(np.isin(messages.type, types)).astype(np.int64)


def decode(messages: SbasMessages, kind: int) -> Decoded:
    """Return the fields of all messages of one type, decoded with the layout of this type."""
    row = find_rows(messages, kind)
    return {"row": row, **read_fields(messages.bits[row], LAYOUTS[f"type {kind}"])}


def time_near(time_of_day_s: Floats, near: Datetimes) -> Datetimes:
    """Return the instants nearest to `near` that have the given times of day; NaT where the time of day is NaN."""
    midnight = near.astype("datetime64[D]").astype("datetime64[ns]")
    offset = time_of_day_s - seconds(near - midnight)
    return np.asarray(near + timedelta(offset - SECONDS_PER_DAY * np.rint(offset / SECONDS_PER_DAY)), "datetime64[ns]")


def prn_masks(messages: SbasMessages) -> Decoded:
    """Return the masks of type 1: `iodp` (n,), and `number` (n, 51), the mask number of each slot (0: empty slot)."""
    decoded = decode(messages, 1)
    message, bit = np.nonzero(decoded.pop("member"))
    slot = np.arange(len(message)) - np.searchsorted(message, message)
    number = np.zeros((len(decoded["row"]), SLOTS), dtype=np.int64)
    kept = slot < SLOTS
    number[message[kept], slot[kept]] = bit[kept] + 1
    return {**decoded, "number": number}


def fast_corrections(messages: SbasMessages, *, type0: Literal["stop", "as_type2"]) -> Decoded:
    """Return the fast corrections of types 2 to 5 and 24, and of type 0 read as type 2, one row per slot.

    The arrays are `slot`, `prc_m`, `udrei`, `iodf` and `iodp`, shape (n,).
    """
    row = find_rows(messages, 2, 3, 4, 5)
    if type0 == "as_type2":
        zero = find_rows(messages, 0)
        row = np.concatenate([row, zero[has_data(messages.bits[zero])]])
    parts = [
        _by_slot(row, BLOCK * np.maximum(messages.type[row] - 2, 0), read_fields(messages.bits[row], LAYOUTS["type 2"]))
    ]
    mixed = decode(messages, 24)
    parts.append(_by_slot(mixed.pop("row"), BLOCK * mixed.pop("block"), mixed))
    return _join(parts)


def has_data(bits: Bytes) -> Masks:
    """Return True for messages with any data bit set, shape (n,)."""
    return np.asarray(np.unpackbits(np.ascontiguousarray(bits), axis=1)[:, 14:226].any(axis=1))


def _by_slot(row: Integers, first: Integers, fields: Decoded) -> Decoded:
    """Return fast corrections with one row per slot; `first` is the first slot of each message."""
    slot = first[:, None] + np.arange(fields["prc_m"].shape[1])
    message, column = np.nonzero(slot < SLOTS)
    return {
        "row": row[message],
        "slot": slot[message, column],
        **{name: values[message, column] if values.ndim == 2 else values[message] for name, values in fields.items()},
    }


def _join(parts: Sequence[Decoded]) -> Decoded:
    """Return the rows of all `parts` in the order of the messages, without invalid slots."""
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    kept = np.flatnonzero((joined["slot"] >= 0) & (joined["slot"] < SLOTS))
    order = kept[np.argsort(joined["row"][kept], kind="stable")]
    return {name: values[order] for name, values in joined.items()}


def long_term(messages: SbasMessages) -> Decoded:
    """Return long-term corrections of types 25 and 24, one row per satellite; `reference` is NaT if not sent."""
    parts: list[Decoded] = []
    for kind, start in ((25, 14), (25, 120), (24, 120)):
        row = find_rows(messages, kind)
        half = read_fields(messages.bits[row], LAYOUTS["half of type 25"], start)
        moves = half["velocity_code"] == 1
        still, moving = row[~moves], row[moves]
        for first in (1, 52):
            part = read_fields(messages.bits[still], LAYOUTS["satellite of type 25"], start + first)
            parts.append(
                {
                    "row": still,
                    **part,
                    "slot": part["slot"] - 1,
                    "iodp": half["iodp"][~moves],
                    "velocity_code": np.zeros(len(still), dtype=np.int64),
                    "velocity_mps": np.zeros((len(still), 3)),
                    "clock_rate": np.zeros(len(still)),
                    "reference": np.full(len(still), np.datetime64("NaT", "ns"), dtype="datetime64[ns]"),
                }
            )
        part = read_fields(messages.bits[moving], LAYOUTS["satellite with velocity of type 25"], start)
        reference = time_near(part.pop("time_of_day_s"), messages.time[moving])
        code = np.ones(len(moving), dtype=np.int64)
        parts.append({"row": moving, **part, "slot": part["slot"] - 1, "velocity_code": code, "reference": reference})
    return _join(parts)


def grid_delays(messages: SbasMessages) -> Decoded:
    """Return fields of type 26: `band`, `block` and `iodi`, shape (n,); `givei` and `delay_m`, shape (n, 15).

    A delay is NaN where the message states "do not use".
    """
    decoded = decode(messages, 26)
    delay = decoded["delay_m"]
    return {**decoded, "delay_m": np.where(delay == _DO_NOT_USE_DELAY_M, np.nan, delay)}


def covariance_factor(sent: Decoded) -> Floats:
    """Return the upper triangular factors of covariances, shape (n, 4, 4)."""
    factor = np.zeros((len(sent["exponent"]), 4, 4))
    factor[:, range(4), range(4)], factor[:, _UPPER[0], _UPPER[1]] = sent["diagonal"], sent["upper"]
    return np.asarray(factor * np.exp2(sent["exponent"] - 5.0)[:, None, None])


def covariance(messages: SbasMessages) -> Decoded:
    """Return fields of type 28 by satellite: `slot`, `iodp`, `scale` (n,), upper triangular `factor` (n, 4, 4)."""
    decoded = decode(messages, 28)
    row, parts = decoded["row"], []
    for start in (16, 121):
        part = read_fields(messages.bits[row], LAYOUTS["satellite of type 28"], start)
        slot, scale = part["slot"] - 1, np.exp2(part["exponent"] - 5.0)
        parts.append({**decoded, "slot": slot, "scale": scale, "factor": covariance_factor(part)})
    return _join(parts)


def service(messages: SbasMessages) -> Decoded:
    """Return the fields of type 27; messages of a set are numbered from 1, and corners of regions have shape (n, 5)."""
    decoded = decode(messages, 27)
    return {
        **decoded,
        "messages": decoded["messages"] + 1,
        "message": decoded["message"] + 1,
        "regions": np.minimum(decoded["regions"], _REGIONS),
    }
