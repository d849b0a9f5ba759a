"""Satellites whose codes are wrong for a minute are left out of single epochs, and come back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline_cases import clean_observations, processor
from railfix.core.reasons import Reason
from railfix.gnss.observations import Observations
from railfix.pipeline.processor_state import AntennaState
from railfix.pipeline.results import AntennaResult
from railfix.run.tally import Tally

#: A fault that RAIM with the noise of the log passes, from the first epoch to this one [m].
FAULT_M, ENDS = 8.0, 900


def faulty() -> tuple[Observations, int]:
    """A log of 1800 epochs of a tenth of a second, and the channel in error for its first half."""
    log = clean_observations()["front"][:1800]
    channel = int(np.flatnonzero(log.satellite == "E05")[0])
    code = log.code_m.copy()
    code[:ENDS, channel] += FAULT_M
    return replace(log, code_m=code), channel


def left_out(result: AntennaResult) -> np.ndarray:
    return np.asarray((result.reason & int(Reason.LASTING_ERROR)) != 0)


@pytest.mark.requirement("B4", "B7")
def test_a_satellite_in_error_for_a_minute_is_left_out_and_comes_back() -> None:
    log, channel = faulty()
    limits = {"filter": "off", "screens": ["elevation", "raim"], "raim": {"max_excluded": 0}}
    found = processor(limits).process({"front": log})[0].antennas["front"]
    mask = left_out(found)
    first = int(np.argmax(mask[:, channel]))
    # a mean of 0.62 is reached after at least -60 s log(0.38), 58 s
    assert 575 < first < ENDS
    assert mask[first:ENDS, channel].all()
    assert not mask[-1, channel]
    assert not np.delete(mask, channel, axis=1).any()
    assert np.isnan(found.residual_m[first, channel])
    clean = processor(limits).process({"front": clean_observations()["front"][:1800]})[0].antennas["front"]
    assert not left_out(clean).any()
    shifted = np.abs(found.arc_m - clean.arc_m)
    assert np.median(shifted[first:ENDS]) < 0.25 * np.median(shifted[:first])
    off = processor({**limits, "lasting_errors": {"most_satellites": 0}}).process({"front": log})[0].antennas["front"]
    assert not left_out(off).any()


@pytest.mark.requirement("B4")
@pytest.mark.parametrize("cuts", [[1, 700, 701], [650]])
def test_chunks_with_other_channels_give_what_the_whole_gives(cuts: list[int]) -> None:
    log, channel = faulty()
    whole = left_out(processor({"filter": "off"}).process({"front": log})[0].antennas["front"])
    one, state, parts = processor({"filter": "off"}), None, []
    for k, (begin, end) in enumerate(zip([0, *cuts], [*cuts, 1800], strict=True)):
        part = log[begin:end]
        if k % 2:  # without the last channel
            part = replace(
                part,
                satellite=part.satellite[:-1],
                signal=part.signal[:-1],
                **{
                    n: getattr(part, n)[:, :-1]
                    for n in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")
                },
            )
        result, state = one.process({"front": part}, state)
        parts.append(left_out(result.antennas["front"])[:, channel])
    np.testing.assert_array_equal(np.concatenate(parts), whole[:, channel])
    assert whole[:, channel].any()
    assert isinstance(state.antennas["front"], AntennaState)


@pytest.mark.requirement("B7")
def test_a_run_names_the_satellite() -> None:
    log, channel = faulty()
    result, _ = processor({"filter": "off"}).process({"front": log})
    tally = Tally()
    tally.add(result)
    name = str(log.satellite[channel])
    count, first = tally.antennas["front"].lasting[name]
    assert count == left_out(result.antennas["front"])[:, channel].sum()
    assert first == log.time[np.argmax(left_out(result.antennas["front"])[:, channel])]
