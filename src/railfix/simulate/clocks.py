"""Clocks of the simulated receivers: bias, drift, random walks, millisecond steps."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.simulate.errors.processes import ClockWalk
from railfix.simulate.scenario import ANTENNAS, Scenario

#: Stream of random numbers of the walks.
_WALK = 5


class ReceiverClocks:
    """Clocks of all receivers of a scenario over time.

    Parameters
    ----------
    scenario : Scenario
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario

    def _line(self, receiver: str) -> tuple[float, float]:
        """Bias at the start [s] and drift [s/s] of a receiver."""
        settings = self._scenario.receiver
        bias, drift = settings.clock_bias_s, settings.clock_drift
        if receiver not in ANTENNAS:
            return 0.37 * bias, 0.55 * drift
        if receiver == ANTENNAS[0] or settings.clocks == "common":
            return bias, drift
        return -0.61 * bias, 0.83 * drift

    def bias_s(self, receiver: str, tag_s: Floats) -> Floats:
        """Tag minus GPS time at tags counted from the start, shape (T,) [s]."""
        bias, drift = self._line(receiver)
        value = bias + drift * tag_s
        walk = self._walk(receiver)
        if walk is not None:
            value = value + walk.at(np.ravel(tag_s))[:, 0].reshape(np.shape(tag_s)) / SPEED_OF_LIGHT
        steps = self._scenario.receiver.clock_steps == "millisecond"
        return value - np.rint(value * 1e3) * 1e-3 if steps else value

    def drift(self, receiver: str) -> float:
        """Constant drift [s/s]."""
        return self._line(receiver)[1]

    def rate_mps(self, receiver: str, tag_s: Floats) -> Floats:
        """Rate at tags, steps left out, shape (T,) [m/s]."""
        even = np.full(np.shape(tag_s), SPEED_OF_LIGHT * self.drift(receiver))
        walk = self._walk(receiver)
        return even if walk is None else even + walk.rate(tag_s)[:, 0]

    def _walk(self, receiver: str) -> ClockWalk | None:
        """Random walk of a receiver's clock, the same for both antennas where their clock is common."""
        common = self._scenario.receiver.clocks == "common" and receiver in ANTENNAS
        return self._walks[ANTENNAS[0] if common else receiver]

    @cached_property
    def _walks(self) -> dict[str, ClockWalk | None]:
        scenario, walk = self._scenario, self._scenario.errors.clock
        if walk.walk_m_per_sqrt_s == 0.0 and walk.frequency_walk_mps_per_sqrt_s == 0.0:
            return dict.fromkeys(scenario.receivers)
        return {
            name: ClockWalk(
                (scenario.seed, _WALK, number),
                walk=walk.walk_m_per_sqrt_s,
                frequency_walk=walk.frequency_walk_mps_per_sqrt_s,
                interval_s=scenario.interval_s,
                duration_s=scenario.duration_s,
            )
            for number, name in enumerate(scenario.receivers)
        }
