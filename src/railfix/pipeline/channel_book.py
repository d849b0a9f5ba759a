"""Selection of the channels of a log that the settings allow.

The selection is computed once for each set of observed channels, because most epochs have the same set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from railfix.gnss.navigation import Navigation, glonass_channels
from railfix.gnss.observations import Observations
from railfix.pipeline.config import Config
from railfix.pipeline.received import Received
from railfix.ranges.channels import DFMC_SIGNALS, SECOND_SIGNALS, Channels, select_channels
from railfix.ranges.corrected import SecondCodes


def missing_notes(received: Received, config: Config, second: SecondCodes | None) -> tuple[str, ...]:
    """Return notes if navigation records are missing, or if one frequency is used although two are requested."""
    known, notes = received.navigation, []
    if known.precise is None and not len(known.kepler) and not len(known.glonass):
        notes.append("no navigation record is known; pass navigation to EpochProcessor or to process")
    if config.frequencies == "two" and (second is None or (second.column.size and (second.column < 0).all())):
        why = "SBAS on L1 corrects a single frequency" if config.sbas else "no satellite has a second code"
        why = why if received.base is None else "a base station corrects a single frequency"
        notes.append(f"frequencies: two requested, one used: {why}")
    return tuple(notes)


#: Largest number of sets of observed channels whose selection is cached.
_REMEMBERED: Final = 64


class ChannelBook:
    """Observed channels that a configuration selects; the selection is cached for each set of observed channels."""

    def __init__(self, config: Config) -> None:
        signals: Mapping[str, Sequence[str]] = config.signals
        second: Mapping[str, Sequence[str]] = SECOND_SIGNALS if config.frequencies == "two" else {}
        if config.dual_frequency_sbas:
            signals = {name: (*DFMC_SIGNALS.get(name, ((),))[0], *own) for name, own in signals.items()}
            second = {letter: second for letter, (_, second) in DFMC_SIGNALS.items()}
        self._choice: dict[str, Any] = {
            "systems": config.systems, "signals": signals, "exclude": config.exclude, "second_signals": second,
        }  # fmt: skip
        self._known: dict[tuple[object, ...], Channels] = {}

    def of(self, obs: Observations, navigation: Navigation) -> Channels:
        """Return the selected channels. GLONASS frequencies are taken from the log, else from navigation records."""
        glonass = {**glonass_channels(navigation), **obs.header.glonass_channel}
        key = (
            obs.satellite.tobytes(),
            obs.signal.tobytes(),
            obs.satellite.dtype.str,
            obs.signal.dtype.str,
            tuple(glonass.items()),
        )
        channels = self._known.get(key)
        if channels is None:
            while len(self._known) >= _REMEMBERED:
                self._known.pop(next(iter(self._known)))
            channels = self._known[key] = select_channels(
                obs.satellite, obs.signal, glonass_channel=glonass, **self._choice
            )
        return channels
