"""Positioning of chunks of epochs: the calls in reading order.

`EpochProcessor` holds what does not change during a run (settings, trajectories, error model). `process` takes a chunk
of observations with the navigation records, SBAS messages and sensor samples received since the chunk before, and the
state after that chunk; it returns every intermediate result and the new state. A live epoch is a chunk of length one;
any cutting gives the same results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.motion.samples import GroundUnits, SensorSamples
from railfix.pipeline.antenna_chunk import AntennaChunk, SolvedTogether, is_short, one_after_the_other
from railfix.pipeline.antenna_order import AntennaOrder
from railfix.pipeline.channels import ChannelBook
from railfix.pipeline.compared import (
    ChunkSteps,
    filter_verdicts,
    pair_verdicts,
    position_verdicts,
)
from railfix.pipeline.config import SCREEN_NAMES, Config
from railfix.pipeline.corrected_ranges import correct_ranges
from railfix.pipeline.feature_stage import LineFeatures
from railfix.pipeline.filter_result import FilterState
from railfix.pipeline.received import Received, known_from_start, receive
from railfix.pipeline.results import AntennaResult, AntennaState, Result, State
from railfix.pipeline.sensor_epochs import LineReferences, waiting_samples
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.section_search import SearchIndex
from railfix.ranges.cn0_curve import Cn0Curve
from railfix.ranges.error_model import Conditions, ErrorModel, condition_differences
from railfix.ranges.sbas import SbasMessages
from railfix.screens import (
    SCREENS,
    AntennaRanges,
    PairedEpochs,
    Screen,
    ScreenSetup,
    in_order,
)
from railfix.screens.pairs import pair_antennas
from railfix.track import Track
from railfix.track.trajectory import Trajectory

__all__ = ["AntennaResult", "AntennaState", "EpochProcessor", "Result", "State"]


class EpochProcessor:
    """Positions along the line from chunks of observations.

    Parameters
    ----------
    config : Config
        The files that it names are not read here; pass their contents (`railfix.run.processor_of` does).
    trajectories : mapping of str to Trajectory
        The trajectory of each antenna, one or two ("front", "rear").
    navigation : Navigation, optional
        Navigation records known from the start; others may come with each chunk.
    messages : SbasMessages, optional
        SBAS messages known from the start. SBAS corrections are used once messages are given, here or with a chunk.
    error_model : ErrorModel, optional
        Gives the weights of the ranges in place of ``config.noise``.
    cn0_curve : Cn0Curve, optional
        Mean C/N0 over elevation, for the screen "cn0".
    track : Track, optional
        The line itself, for places by its changes of gradient and curvature in the filter along the track.
    units : GroundUnits, optional
        Surveyed stations of two-way ranges, for the filter along the track.
    screens : sequence of Screen, optional
        Screens of one's own, used with their limits beside those of `config`; their verdicts are in
        `AntennaResult.screens`, without columns of the tables (those of installed packages have them).

    Attributes
    ----------
    received : Received
        Navigation records and SBAS corrections known from the start.
    units : GroundUnits or None
    indices : dict of str to SearchIndex
        Of the trajectories.
    screens : tuple
        Screens that are on, with their limits.
    setup : ScreenSetup
    notes : tuple of str
        Differences between what was asked for and what is used, one sentence each.

    Raises
    ------
    SettingsError
        SBAS and precise ephemerides together, or no SBAS message of the GEO asked for.
    """

    def __init__(
        self,
        config: Config,
        trajectories: Mapping[str, Trajectory],
        *,
        navigation: Navigation | None = None,
        messages: SbasMessages | None = None,
        error_model: ErrorModel | None = None,
        cn0_curve: Cn0Curve | None = None,
        track: Track | None = None,
        units: GroundUnits | None = None,
        screens: Sequence[Screen[Any]] = (),
    ) -> None:
        if not trajectories:
            raise ValueError("at least one antenna's trajectory is needed")
        self.config = config
        plan, height = config.map_plan_sigma_m, config.map_height_sigma_m
        self.trajectories = {
            name: replace(
                trajectory,
                sigma_plan_m=trajectory.sigma_plan_m if plan is None else plan,
                sigma_height_m=trajectory.sigma_height_m if height is None else height,
            )
            for name, trajectory in trajectories.items()
        }
        self.received = known_from_start(config, navigation=navigation, messages=messages)
        self._channels = ChannelBook(config)
        self.indices = {name: SearchIndex(t) for name, t in self.trajectories.items()}
        self._error_model = error_model
        if taken := [s.name for s in screens if s.name in SCREEN_NAMES]:
            raise ValueError(f"there is a screen {taken[0]} already; give it another name")
        chosen = (*(s for s in SCREENS if s.name in config.screens), *screens)
        self.screens = tuple((s, getattr(config, s.name, s.limits)) for s in in_order(chosen))
        self.setup = ScreenSetup(
            antennas=len(self.trajectories),
            spacing_known=all(t.body_chainage_m is not None for t in self.trajectories.values()),
            cn0_curve=cn0_curve,
        )
        self._track, self.units = track, units
        self._features: dict[str, LineFeatures] = {}
        self._before_filter = FilterState()
        self._lacking = self._inactive_notes()

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the data known from the start, and on screens that cannot judge."""
        return (*self.received.notes, *self._lacking)

    def _inactive_notes(self) -> tuple[str, ...]:
        """Return one sentence for each part of the settings that cannot work as asked."""
        notes = [note for screen, limits in self.screens for note in screen.notes(limits, self.setup)]
        conditions = None if self._error_model is None else self._error_model.conditions
        if conditions and (differences := condition_differences(conditions, conditions_of(self.config))):
            notes.append(f"error model: made under other conditions than this run's: {'; '.join(differences)}")
        faults = None if self._error_model is None else self._error_model.faults
        if faults is not None and "side_upper" not in faults.model_fields_set:
            notes.append(
                "error model: it does not state how often low satellites of one side are faulty together "
                "(faults.side_upper), as one of an earlier version; railfix error-model measures it"
            )
        if self.config.protection == "on" and self.config.carrier == "float":
            notes.append("protection level: asked for, but there is none for positions from code and phase together")
        return tuple(notes)

    def antenna_order(self) -> AntennaOrder | None:
        """Return a test, without positions as yet, of the order of two antennas; None without two of one vehicle."""
        if len(self.trajectories) < 2 or not self.setup.spacing_known:
            return None
        tolerance = self.config.antenna_pair.tag_tolerance_s
        return AntennaOrder(self.trajectories["front"], self.trajectories["rear"], tolerance_s=tolerance)

    def process(
        self,
        observations: Mapping[str, Observations],
        state: State | None = None,
        *,
        navigation: Navigation | None = None,
        messages: SbasMessages | None = None,
        sensors: SensorSamples | None = None,
    ) -> tuple[Result, State]:
        """Return the positions of one chunk, and the state to pass on with the next one.

        Parameters
        ----------
        observations : mapping of str to Observations
            By antenna; each antenna keeps its own epochs.
        state : State, optional
            State after the chunk before this one; None at the start of a log.
        navigation : Navigation, optional
            Records received since the chunk before. Results equal those with all records given at the start,
            where each record is given before the first epoch that uses it.
        messages : SbasMessages, optional
            SBAS messages received since the chunk before.
        sensors : SensorSamples, optional
            Samples of the sensors on board since the chunk before, for the filter along the track. An antenna without
            observations in this chunk has them with its next one.

        Raises
        ------
        ValueError
            An antenna has no trajectory, or its epochs do not rise in time.
        SettingsError
            As the class.
        """
        unknown = sorted(set(observations) - set(self.trajectories))
        if unknown:
            raise ValueError(f"no trajectory for antenna {', '.join(unknown)}")
        for name, part in observations.items():
            _check_rising(name, part)
        state = state or State()
        received = receive(
            state.received or self.received,
            self.config,
            min((part.time[0] for part in observations.values() if len(part)), default=np.datetime64("NaT", "ns")),
            navigation=navigation,
            messages=messages,
        )
        state = replace(state, received=received)
        if sensors:
            waiting = {
                name: replace(own, sensors=waiting_samples(own.sensors, sensors))
                for name, own in state.fusion.items()
                if name not in observations
            }
            state = replace(state, fusion={**state.fusion, **waiting})
        chunks = self.chunks(observations, state, sensors=sensors)
        self.compare(chunks)
        return self.gathered(chunks, state)

    def chunks(
        self, observations: Mapping[str, Observations], state: State, *, sensors: SensorSamples | None = None
    ) -> dict[str, AntennaChunk]:
        """Return a chunk of each antenna, to be taken through their steps by `compare` and `gathered`.

        Few epochs of several antennas are rows of the same arrays.

        Parameters
        ----------
        observations : mapping of str to Observations
            By antenna.
        state : State
            After the chunk before this one.
        sensors : SensorSamples, optional
        """
        received = state.received or self.received
        if self._joinable(observations):
            together = dict.fromkeys(observations, self._correct(observations, received))
        else:
            together = {name: self._correct({name: own}, received) for name, own in observations.items()}
        return {
            name: AntennaChunk(
                self,
                name,
                own,
                together[name],
                state.antennas.get(name) or AntennaState(),
                state.fusion.get(name) or self._before_filter,
                sensors,
            )
            for name, own in observations.items()
        }

    def _joinable(self, observations: Mapping[str, Observations]) -> bool:
        """Whether the epochs of all antennas are rows of the same arrays."""
        sigmas = {(t.sigma_plan_m, t.sigma_height_m) for t in (self.trajectories[name] for name in observations)}
        return self.config.carrier == "off" and len(sigmas) == 1 and is_short(list(observations.values()))

    def _correct(self, observations: Mapping[str, Observations], received: Received) -> SolvedTogether:
        """Return the corrected ranges of one antenna, or of the rows of several."""
        indices = tuple(self.indices[name] for name in observations)
        obs, parts = one_after_the_other(list(observations.values()))
        antennas, channels = AntennaRows(indices, parts), self._channels.of(obs, received.navigation)
        model = self._error_model
        return SolvedTogether(
            correct_ranges(obs, channels, self.config, received, antennas, error_model=model), antennas, self.config
        )

    def gathered(self, chunks: Mapping[str, AntennaChunk], state: State) -> tuple[Result, State]:
        """Return the results of compared chunks, and the state after them.

        Parameters
        ----------
        chunks : mapping of str to AntennaChunk
            By antenna.
        state : State
            Before them.
        """
        results = {name: chunk.finished() for name, chunk in chunks.items()}
        tracks = {name: chunk.tracked for name, chunk in chunks.items() if chunk.tracked is not None}
        of_chunks = [note for chunk in chunks.values() for note in chunk.notes]
        notes = (*(state.received or self.received).notes, *self._lacking, *of_chunks)
        after = replace(
            state,
            antennas={**state.antennas, **{name: chunk.state for name, chunk in chunks.items()}},
            fusion={**state.fusion, **{name: chunks[name].filter_state for name in tracks}},
        )
        return Result(antennas=results, notes=notes, fusion=tracks), after

    def line_references(self, name: str, sensors: SensorSamples | None) -> LineReferences:
        """Ground units, and the features of the line: made when there is an inertial unit."""
        wanted = "feature" in self.config.filter_sources and sensors is not None and len(sensors.inertial) > 0
        if wanted and self._track is not None and name not in self._features:
            limits = self.config.sensors.feature
            self._features[name] = LineFeatures.of(self._track, self.trajectories[name], limits)
        return LineReferences(features=self._features.get(name), units=self.units)

    def compare(self, chunks: Mapping[str, ChunkSteps]) -> None:
        """Take the same chunk of all antennas through the screens that compare them, up to their last step.

        Parameters
        ----------
        chunks : mapping of str to ChunkSteps
            By antenna. Those of other processes come last: they work while this one does.
        """
        ranges = {name: chunk.screened() for name, chunk in chunks.items()}
        pair = self._pair(ranges)
        verdicts = pair_verdicts(self.screens, pair, ranges)
        for name, chunk in chunks.items():
            chunk.judge(verdicts.get(name, ()))
        published = {name: chunk.solved() for name, chunk in chunks.items()}
        checks = position_verdicts(self.screens, pair, published)
        for name, chunk in chunks.items():
            chunk.check(checks.get(name, ()))
        spacing = filter_verdicts(self.screens, pair, {name: chunk.filtered() for name, chunk in chunks.items()})
        for name, chunk in chunks.items():
            chunk.check_filter(spacing.get(name))

    def _pair(self, ranges: Mapping[str, AntennaRanges]) -> PairedEpochs | None:
        """Return the common epochs of two antennas of one vehicle; None where there are no such antennas."""
        if len(ranges) < 2 or not self.setup.spacing_known:
            return None
        front, rear = ranges["front"], ranges["rear"]
        return pair_antennas(
            front,
            rear,
            front.anchor_ecef_m,
            self.trajectories["front"],
            self.trajectories["rear"],
            tolerance_s=self.config.antenna_pair.tag_tolerance_s,
        )


def conditions_of(config: Config) -> Conditions:
    """Settings that the errors of the ranges depend on: the conditions of an error model made from such a run."""
    return Conditions(
        systems=config.systems,
        signals={letter: config.signals.get(letter, ()) for letter in config.systems},
        screens=config.screens,
        elevation_mask_deg=config.elevation.mask_deg,
        codes="smoothed" if config.carrier == "smoothed" else "raw",
        ionosphere="sbas" if config.sbas else config.ionosphere,
        troposphere="sbas" if config.sbas else config.troposphere,
    )


def _check_rising(name: str, observations: Observations) -> None:
    """Raise ValueError where an epoch is not after the one before it."""
    time = observations.time
    if (back := np.flatnonzero(time[1:] <= time[:-1])).size:
        earlier, later = time[back[0] : back[0] + 2]
        raise ValueError(f"{name}: epoch {back[0] + 1} ({later}) is not after {earlier}; give epochs in order of time")
