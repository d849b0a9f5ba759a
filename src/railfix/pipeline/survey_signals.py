"""Ranges of a log and their changes between epochs, for a survey of the line."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.timescale import seconds
from railfix.gnss.observations import Observations
from railfix.pipeline.channels import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.locate import locate_ranges, uncorrected_ranges
from railfix.pipeline.received import Received
from railfix.positioning.carrier import CycleSlipState, corrected_phase_m, find_slips
from railfix.track.survey.runs import RunSignals, SurveyLimits, SurveyRun, thinned_rows

#: Steps longer than so many intervals have no changes: Dopplers at both ends tell too little.
_LONGEST_STEP: Final = 2.5
#: Standard deviation of a change by Dopplers from the curvature of the motion [m/s^2].
_CURVED_MPS2: Final = 0.05


@dataclass(frozen=True, kw_only=True)
class SurveyEpochs:
    """Epochs of a log that a survey uses."""

    time: Datetimes  #: Shape (T,).
    #: 3-D positions, NaN where there is none, and standard deviations east, north, up; shape (T, 3).
    ecef_m: Floats
    sigma_m: Floats
    n_used: Indices  #: Satellites of the position, shape (T,).
    signals: RunSignals  #: Rows are those epochs.


def survey_run(
    parts: Iterable[Observations], received: Received, config: Config, limits: SurveyLimits, *, name: str
) -> SurveyRun:
    """Return the run of a log, read part by part, with its ranges and their changes.

    Between two parts there is no change. ValueError: fewer than three epochs have a position.
    """
    book, slips = ChannelBook(config), None
    epochs: list[SurveyEpochs] = []
    for part in parts:
        if len(part):
            found, slips = survey_epochs(part, received, config, limits, book, slips)
            epochs.append(found)
    if sum(int(np.isfinite(e.ecef_m[:, 0]).sum()) for e in epochs) < 3:
        raise ValueError("fewer than three epochs have a position; are the navigation files of the day of the log?")
    first = np.cumsum([0, *(len(e.time) for e in epochs)])
    columns = {
        item.name: np.concatenate([getattr(e.signals, item.name) for e in epochs]) for item in fields(RunSignals)
    }
    for index in ("row", "step"):
        shifted = [getattr(e.signals, index) + start for e, start in zip(epochs, first, strict=False)]
        columns[index] = np.concatenate(shifted)
    time, ecef, sigma = (np.concatenate([getattr(e, n) for e in epochs]) for n in ("time", "ecef_m", "sigma_m"))
    return SurveyRun(name=name, time=time, ecef_m=ecef, sigma_m=sigma, signals=RunSignals(**columns))


def survey_epochs(
    obs: Observations,
    received: Received,
    config: Config,
    limits: SurveyLimits,
    book: ChannelBook,
    slip_state: CycleSlipState | None,
) -> tuple[SurveyEpochs, CycleSlipState | None]:
    """Return the epochs of some observations, thinned to the interval of the survey, and the state of the slips.

    A range changes by the carrier phase where it goes on without a slip at every epoch between, else by the mean of
    the Dopplers at both ends.
    """
    seen = uncorrected_ranges(obs, received, config, book)
    located = locate_ranges(obs.time, seen, config)
    slips, after = find_slips(obs, slip_state, frequency_hz=seen.channels.every_frequency_hz, limits=config.slips)
    columns = seen.channels.columns
    usable = seen.ranges.weight > 0
    nothing = np.zeros(usable.shape)
    phase = corrected_phase_m(slips.phase_m[:, columns], seen.states.clock_m, nothing, nothing)
    rate = -SPEED_OF_LIGHT / seen.channels.frequency_hz * obs.doppler_hz[:, columns]
    broken = np.cumsum(slips.slip[:, columns] | obs.break_before[:, None], axis=0, dtype=np.intp)
    rows = thinned_rows(obs.time, limits.interval_s)
    time, cn0_dbhz = obs.time[rows], obs.cn0_dbhz[:, columns]
    weak = 10.0 ** ((45.0 - np.where(np.isnan(cn0_dbhz), 45.0, np.minimum(cn0_dbhz, 50.0))) / 10.0)
    used, position, weak = usable[rows], seen.states.position_ecef_m[rows], weak[rows]
    step_s = seconds(np.diff(time))[:, None]
    both = used[1:] & used[:-1] & (step_s <= _LONGEST_STEP * limits.interval_s)
    phase, rate, broken = phase[rows], rate[rows], broken[rows]
    by_phase = np.diff(phase, axis=0)
    by_doppler = 0.5 * (rate[1:] + rate[:-1]) * step_s
    joined = both & np.isfinite(by_phase) & (np.diff(broken, axis=0) == 0)
    doppler = both & np.isfinite(by_doppler) & ~joined
    weak = 0.5 * (weak[1:] + weak[:-1])
    noise = config.tracking
    phase_m = np.sqrt(noise.phase_floor_m**2 + noise.phase_zenith_m**2 * weak)
    doppler_m = np.hypot(
        np.sqrt(noise.doppler_floor_mps**2 + noise.doppler_zenith_mps**2 * weak) * step_s, _CURVED_MPS2 * step_s**2
    )
    clock = np.zeros(used.shape[1], dtype=np.intp)
    for number, group in enumerate(seen.channels.groups):
        clock[group] = number
    row, channel = np.nonzero(used)
    step, of_step = np.nonzero(joined | doppler)
    signals = RunSignals(
        row=row,
        sat_ecef_m=position[row, channel],
        code_m=seen.ranges.code_m[rows][row, channel],
        sigma_m=1.0 / np.sqrt(seen.ranges.weight[rows][row, channel]),
        clock=clock[channel],
        step=step,
        before_ecef_m=position[step, of_step],
        after_ecef_m=position[step + 1, of_step],
        change_m=np.where(joined, by_phase, by_doppler)[step, of_step],
        change_sigma_m=np.where(joined, phase_m, doppler_m)[step, of_step],
    )
    epochs = SurveyEpochs(
        time=time,
        ecef_m=located.ecef_m[rows],
        sigma_m=np.nan_to_num(located.sigma_m[rows][:, [1, 0, 2]], nan=1.0),
        n_used=located.n_used[rows],
        signals=signals,
    )
    return epochs, after
