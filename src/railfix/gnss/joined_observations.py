"""Join the parts of one log, including their signals and problems, and stack the observations of several antennas."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import accumulate, chain, groupby, islice, pairwise
from operator import itemgetter
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Bytes, Floats, Masks, Strings
from railfix.core.epoch_rows import EVERY, join_epochs
from railfix.core.errors import check_type
from railfix.gnss.observations import ObservationHeader, Observations

MAX_PROBLEMS: Final = 50  #: Largest number of messages on individual faults; further faults are only counted.


def channels_with_data(kinds: Iterable[Floats], loss_of_lock: Bytes) -> Masks:
    """Return whether each channel has a value in any array of `kinds`, or a loss-of-lock indicator; shape (M,)."""
    used = np.zeros(loss_of_lock.shape[1], dtype=np.bool_)
    for array in kinds:
        used |= ~np.isnan(array[:1]).all(axis=0)  # for speed; nearly all channels have data in the first epoch
        rest = np.flatnonzero(~used)
        used[rest] = ~np.isnan(array[:, rest]).all(axis=0)
    rest = np.flatnonzero(~used)
    used[rest] = loss_of_lock[:, rest].any(axis=0)
    return used


def concatenate(parts: Sequence[Observations]) -> Observations:
    """Join consecutive parts of one log; channels absent in a part are filled with NaN.

    Parameters
    ----------
    parts : sequence of Observations
        At least one part, in order of time.

    Returns
    -------
    Observations
        Channels sorted by satellite, then signal. The header is taken from the first part, and extended by the signals
        and GLONASS channels of the other parts. Problems are concatenated, and counters are summed.

    Raises
    ------
    ValueError
        A part begins before the end of the preceding part, or there are no parts.
    """
    check_type(parts, Sequence, "parts of a log")
    for part in parts:
        check_type(part, Observations, "part of a log")
    with_epochs = [(k, part.time) for k, part in enumerate(parts) if len(part)]
    for (one, before), (other, time) in pairwise(with_epochs):
        if time[0] <= before[-1]:
            raise ValueError(
                f"part {other} begins at {time[0]}, part {one} before it ends at {before[-1]}; "
                "give the parts of one log in order of time"
            )
    return stack_parts(parts)


def stack_parts(parts: Sequence[Observations]) -> Observations:
    """Join observations of one or several receivers as `concatenate` does, but with the parts in any order of time."""
    if not parts:
        raise ValueError("concatenate needs at least one part")
    of_parts = [list(zip(p.satellite.tolist(), p.signal.tolist(), strict=True)) for p in parts]
    keys = sorted({key for of_part in of_parts for key in of_part})
    column = {key: i for i, key in enumerate(keys)}
    total = sum(len(p) for p in parts)
    shape = (total, len(keys))
    complete = all(len(p.satellite) == len(keys) for p in parts)
    floats = {n: np.empty(shape) for n in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz")}
    lock = np.empty(shape, dtype=np.uint8)
    if not complete:
        lock.fill(0)
        for target in floats.values():
            target.fill(np.nan)
    row = 0
    for part, of_part in zip(parts, of_parts, strict=True):
        columns: Any = [column[key] for key in of_part]
        if columns == list(range(len(keys))):
            columns = slice(None)
        rows = slice(row, row + len(part))
        for name, target in floats.items():
            target[rows, columns] = getattr(part, name)
        lock[rows, columns] = part.loss_of_lock
        row += len(part)
    count, skipped = sum(p.problem_count for p in parts), Counter[str]()
    for part in parts:
        skipped.update(part.skipped)
    return Observations(
        time=np.concatenate([p.time for p in parts]), satellite=np.array([k[0] for k in keys], dtype="<U3"),
        signal=np.array([k[1] for k in keys], dtype="<U2"), loss_of_lock=lock,
        break_before=np.concatenate([p.break_before for p in parts]),
        receiver_alarm=np.concatenate([p.receiver_alarm for p in parts]),
        front_end_gain=np.concatenate([p.front_end_gain for p in parts]),
        header=_join_headers([p.header for p in parts]),
        problems=first_problems(chain.from_iterable(p.problems[:MAX_PROBLEMS] for p in parts), count=count),
        problem_count=count, skipped=dict(skipped), **floats,
    )  # fmt: skip


def _join_headers(headers: Sequence[ObservationHeader]) -> ObservationHeader:
    first = headers[0]
    signals = {system: set(names) for system, names in first.signals.items()}
    channels = dict(first.glonass_channel)
    for header in {id(header): header for header in headers}.values():
        for system, names in header.signals.items():
            signals.setdefault(system, set()).update(names)
        channels = {**header.glonass_channel, **channels}
    joined = {system: tuple(sorted(names)) for system, names in signals.items()}
    return replace(first, signals=joined, glonass_channel=channels)


def stack_observations(observations: Sequence[Observations]) -> tuple[Observations, tuple[slice, ...]]:
    """Stack the epochs of several antennas, with the union of their channels; also return each antenna's rows."""
    first, *others = observations
    if not others:
        return first, (EVERY,)
    ends = [0, *accumulate(map(len, observations))]
    keys = {
        (each.satellite.tobytes(), each.signal.tobytes(), *sorted(each.header.glonass_channel.items()))
        for each in observations
    }
    same = len(keys) == 1  # all antennas have the same channels and GLONASS frequencies
    stacked = join_epochs(observations) if same else stack_parts(observations)
    return stacked, tuple(slice(a, b) for a, b in pairwise(ends))


def signals_by_system(satellite: Strings, signal: Strings) -> dict[str, tuple[str, ...]]:
    """Return the sorted signals of each constellation letter, as in `ObservationHeader.signals`."""
    pairs = sorted(set(zip(satellite.astype("<U1").tolist(), signal.tolist(), strict=True)))
    return {system: tuple(name for _, name in group) for system, group in groupby(pairs, key=itemgetter(0))}


def first_problems(messages: Iterable[str], *, count: int) -> tuple[str, ...]:
    """Return at most `MAX_PROBLEMS` messages, and a message with the number of further faults; `count` includes all."""
    kept = tuple(islice(messages, MAX_PROBLEMS))
    return (*kept, f"and {count - len(kept)} more problems") if count > len(kept) else kept
