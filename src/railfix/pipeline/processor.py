"""Process chunks of epochs, from observations to filter results.

`EpochProcessor` contains the constant data of a run (settings, trajectories, error model). Its method `process` takes a
chunk of observations, all other data received since the previous chunk, and the previous state. It returns every
intermediate result and the new state. The results do not depend on the division into chunks; a live epoch is a chunk of
length one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from railfix.core.arrays import Datetimes, Floats, copy_with
from railfix.core.epoch_rows import take_epochs
from railfix.core.errors import SettingsError, check_type, warn_of
from railfix.gnss.joined_observations import stack_observations
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import ObservationHeader, Observations
from railfix.motion.samples import SensorSamples
from railfix.pipeline.along_track import (
    along_track,
    apply_spacing_verdict,
    compute_tilt_scale,
    single_epochs,
    with_passings,
)
from railfix.pipeline.base_station_stage import BaseStation, Stations, check_base
from railfix.pipeline.channel_book import ChannelBook, missing_notes
from railfix.pipeline.chunk import Chunk
from railfix.pipeline.config import SCREEN_NAMES, Config
from railfix.pipeline.filter_result import AlongTrack, FilterState, Replay
from railfix.pipeline.interference_stage import judge_interference, with_statuses
from railfix.pipeline.level_stage import compute_araim
from railfix.pipeline.position_stage import position_stage
from railfix.pipeline.processor_state import AntennaState, State
from railfix.pipeline.range_stage import Models, correct_ranges, error_model_notes
from railfix.pipeline.received import (
    MessageCorrections,
    check_corrections,
    correction_source,
    known_from_start,
    receive,
)
from railfix.pipeline.results import Result, antenna_results
from railfix.pipeline.screen_stage import screen_antennas, screen_filtered, screen_pairs, screen_positions
from railfix.pipeline.sensor_epochs import LineReferences, waiting_samples
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.search_index import SearchIndex
from railfix.screens import (
    SCREENS,
    ObservationScreen,
    PairedEpochs,
    PairScreen,
    PositionScreen,
    Screen,
    ScreenSetup,
    in_order,
)
from railfix.screens.pairs import pair_antennas
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line


class EpochProcessor:
    """Processor that computes positions on the line from chunks of observations.

    Parameters
    ----------
    config : Config
        The files named in the configuration are not read; pass their contents, as
        `railfix.run.processor_setup.make_processor` does.
    trajectories : mapping of str to Trajectory
        Trajectories by name of the antenna: "front", "rear" or both.
    navigation : Navigation, optional
        Navigation records known from the start; further records can be passed with each chunk. If None, records must be
        passed with the first chunk, otherwise `process` raises `SettingsError`.
    corrections : MessageCorrections, optional
        SBAS corrections (`railfix.ranges.sbas.SbasState`) from the messages known from the start. They are required if
        ``config.sbas`` requests SBAS, and rejected otherwise. Further messages can be passed with each chunk.
    models : Models, optional
    stations : Stations, optional
    screens : sequence of Screen, optional
        User-defined screens, which are used with their own limits in addition to the screens of `config`. Their
        verdicts are in `AntennaResult.screens`, but not in the columns of the tables.

    Attributes
    ----------
    received : Received
        Navigation records and SBAS corrections known from the start.
    units, balises : GroundUnits or None, ListedBalises or None
    indices : dict of str to SearchIndex
        Search indices of the trajectories.
    screens : tuple
        Active screens with their limits.
    setup : ScreenSetup
    notes : tuple of str
        Differences between what was requested and what is used, one sentence each.

    Raises
    ------
    SettingsError
        SBAS is combined with precise ephemerides; only one of `config.sbas` and `corrections` is given; their
        frequencies differ; or an argument has a wrong type.
    ValueError
        The trajectories have different map sigmas, or a user-defined screen has the name of a built-in screen.
    """

    def __init__(
        self,
        config: Config,
        trajectories: Mapping[str, Trajectory],
        *,
        navigation: Navigation | None = None,
        corrections: MessageCorrections | None = None,
        models: Models | None = None,
        stations: Stations | None = None,
        screens: Sequence[Screen[Any]] = (),
    ) -> None:
        if not (isinstance(trajectories, Mapping) and trajectories):
            raise SettingsError("trajectories: pass one or more by name of the antenna: {'front': trajectory}")
        if unknown := sorted(set(trajectories) - {"front", "rear"}, key=str):
            raise SettingsError(f"trajectories: unknown antenna {unknown[0]!r}; the antennas are front and rear")
        models, stations = models or Models(), stations or Stations()
        check_type(config, Config, "config")
        for name, trajectory in trajectories.items():
            check_type(trajectory, Trajectory, f"trajectory of antenna {name}")
        check_type(models, Models, "models")
        check_type(stations, Stations, "stations")
        for screen in screens:
            check_type(screen, Screen, "screens")
        if navigation is not None:
            check_type(navigation, Navigation, "navigation")
        check_corrections(config, corrections)
        if len({(t.sigma_plan_m, t.sigma_height_m) for t in trajectories.values()}) > 1:
            raise ValueError("the antennas' trajectories have different map sigmas; they must be of one map")
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
        self.received = known_from_start(config, navigation=navigation, corrections=corrections)
        self._navigation_given = navigation is not None
        self._channels = ChannelBook(config)
        self.indices = {name: SearchIndex(t) for name, t in self.trajectories.items()}
        self._error_model, self._support = models.error_model, models.support
        self._base = None if stations.base_ecef_m is None else BaseStation(config, stations.base_ecef_m)
        if taken := [s.name for s in screens if s.name in SCREEN_NAMES]:
            raise ValueError(f"a screen named {taken[0]} exists already; give the additional screen another name")
        chosen = (*(s for s in SCREENS if s.name in config.screens), *screens)
        self.screens = tuple((s, getattr(config, s.name, s.limits)) for s in in_order(chosen))
        kinds = ObservationScreen, PairScreen, PositionScreen
        by_kind: list[list[Any]] = [[each for each in self.screens if isinstance(each[0], kind)] for kind in kinds]
        self._of_observations, self._of_pairs, self._of_positions = by_kind
        self.setup = ScreenSetup(
            antennas=len(self.trajectories),
            spacing_known=all(t.body_chainage_m is not None for t in self.trajectories.values()),
            cn0_curve=models.cn0_curve,
        )
        self.units, self.balises, self._features = stations.units, stations.balises, stations.features or {}
        self._unasked: list[str] = []
        self._lacking = self._inactive_notes()

    def __repr__(self) -> str:
        screens = ", ".join(screen.name for screen, _ in self.screens) or "none"
        return f"<EpochProcessor: {' and '.join(self.trajectories)}, filter {self.config.filter}; screens {screens}>"

    @cached_property
    def _threads(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(len(self.trajectories))

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes to pickle: all except the threads, which each process creates itself."""
        return {name: value for name, value in self.__dict__.items() if name != "_threads"}

    @cached_property
    def lines(self) -> dict[str, Line]:
        """Trajectory of each antenna in the form that the along-track filter uses."""
        return {name: Line(trajectory) for name, trajectory in self.trajectories.items()}

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the initial data, and on settings that cannot be satisfied, such as screens without input."""
        return (*self.received.notes, *self._lacking)

    def _inactive_notes(self) -> tuple[str, ...]:
        """Return one sentence for each setting that cannot be satisfied."""
        asked = self.config.model_fields_set
        notes = []
        for screen, limits in self.screens:
            inactive = list(screen.notes(limits, self.setup))
            notes += inactive
            if "screens" not in asked and screen.name not in asked:
                self._unasked += inactive
        check_base(self.config, self._base)
        notes += error_model_notes(self._error_model, self.config)
        if self.config.protection == "on" and self.config.carrier in ("float", "fixed"):
            notes.append("protection level: requested, but not available for positions from both code and phase")
        return tuple(notes)

    def process(
        self,
        observations: Mapping[str, Observations],
        state: State | None = None,
        *,
        navigation: Navigation | None = None,
        messages: Any = None,
        sensors: SensorSamples | None = None,
        base: Observations | None = None,
    ) -> tuple[Result, State]:
        """Return the positions of one chunk, and the state for the next chunk.

        Notes and doubts in the result are also issued as `RailfixWarning`, except notes on default screens without
        input.

        Parameters
        ----------
        observations : mapping of str to Observations
            Observations by antenna; the antennas may have different epochs.
        state : State, optional
            State after the previous chunk; None at the start of a log.
        navigation : Navigation, optional
            Records received since the previous chunk. If each record is given before the first epoch that uses it, the
            results are the same as if all records were given at the start.
        messages : SbasMessages, optional
            SBAS messages received since the previous chunk, for processors with `corrections`.
        sensors : SensorSamples, optional
            On-board sensor samples since the previous chunk, for the filter along the track. For an antenna without
            observations in this chunk, the samples are kept for its next epochs.
        base : Observations, optional
            Observations of the base station since the previous chunk, up to the last epoch of this chunk.

        Raises
        ------
        ValueError
            The epochs of an antenna are not in ascending order, or do not begin after the last epoch of `state`.
        SettingsError
            A SettingsError of the class applies, an antenna has no trajectory, or there are no navigation records.
        """
        if navigation is None and state is None and not self._navigation_given:
            raise SettingsError("no navigation records: EpochProcessor(..., navigation=read_navigation(file))")
        chunk, state = self.screen(
            observations, state, navigation=navigation, messages=messages, sensors=sensors, base=base
        )
        result, after = self.along_track(*self.position(chunk, state))
        notes = (note for trajectory in self.trajectories.values() for note in trajectory.notes)
        warn_of((*notes, *(note for note in result.notes if note not in self._unasked), *result.doubts()))
        return result, after

    def screen(
        self,
        observations: Mapping[str, Observations],
        state: State | None = None,
        *,
        navigation: Navigation | None = None,
        messages: Any = None,
        sensors: SensorSamples | None = None,
        base: Observations | None = None,
    ) -> tuple[Chunk, State]:
        """Apply the screens to the ranges of one chunk: the first part of `process`, with the same parameters.

        The three parts of `process` use and replace different members of the state. Different parts can therefore
        process successive chunks at the same time, if each part keeps a state of its own.
        """
        if not (isinstance(observations, Mapping) and observations):
            raise SettingsError("observations: pass one log for each antenna, and at least one: {'front': log}")
        if unknown := sorted(set(observations) - set(self.trajectories)):
            raise SettingsError(f"no trajectory for antenna {', '.join(unknown)}")
        state = State() if state is None else state
        check_type(state, State, "state")
        for value, expected, what in (
            (navigation, Navigation, "navigation"), (sensors, SensorSamples, "sensors"), (base, Observations, "base"),
        ):  # fmt: skip
            if value is not None:
                check_type(value, expected, what)
        for name, part in observations.items():
            check_type(part, Observations, f"observations of antenna {name}")
            _check_rising(name, part.time, state.antennas.get(name))
        began = min((part.time[0] for part in observations.values() if len(part)), default=np.datetime64("NaT", "ns"))
        received = receive(
            state.received or self.received, self.config, began, navigation=navigation, messages=messages
        )
        base_state = None
        if self._base is not None:
            base_state = self._base.add_observations(base, received, state.base, began)
            received = base_state.beside(received)
        names, (obs, parts) = tuple(observations), stack_observations(list(observations.values()))
        antennas = AntennaRows(tuple(self.indices[name] for name in names), parts)
        channels, source = self._channels.of(obs, received.navigation), correction_source(received, self.config)
        corrected, near = correct_ranges(obs, channels, self.config, source, antennas, error_model=self._error_model)
        chunk = Chunk(
            names=names, antennas=antennas, corrected=corrected, sensors=sensors, klobuchar=received.klobuchar,
            pair=self._pair(obs.time, near.arc_m, dict(zip(names, parts, strict=True))),
            notes=(
                *missing_notes(received, self.config, corrected.second), *received.notes, *self._lacking,
                *self._curve_notes({name: part.header for name, part in observations.items()}),
                *(self._support.notes(obs.time) if self._support is not None else ()),
            ),
        )  # fmt: skip
        own_states = [state.antennas.get(name) or AntennaState() for name in names]
        chunk, own_states = screen_antennas(
            chunk, self._of_observations, self.setup, self.config, received.ionosphere_sigma_m, own_states
        )
        chunk = screen_pairs(chunk, self._of_pairs)
        after = dict(state.antennas)
        for name, part, own in zip(names, observations.values(), own_states, strict=True):
            after[name] = copy_with(own, ended=part.time[-1] if len(part) else own.ended)
        return chunk, copy_with(state, received=received, antennas=after, base=base_state)

    def position(self, chunk: Chunk, state: State) -> tuple[Chunk, State]:
        """Add the positions of single epochs to the chunk: the second part of `process`."""
        antennas, own_states = chunk.antennas, [state.antennas.get(name) or AntennaState() for name in chunk.names]
        corrected, solution, own_states = position_stage(
            chunk.corrected, chunk.slips, antennas, self.config, own_states
        )
        interference, signs = judge_interference(
            corrected, solution, antennas, [own.interference for own in own_states], self.config.interference
        )
        status = with_statuses(solution.status, [own.suspicion for own in interference if own is not None])
        if self._support is not None:
            araim = compute_araim(corrected, solution, antennas, self._support, self.config)
            solution = copy_with(solution, araim=araim)
        solution = copy_with(solution, status=status)
        status, judged = screen_positions(chunk.pair, chunk.rows, antennas, solution, self._of_positions, self.config)
        chunk = copy_with(
            chunk, corrected=corrected, solution=copy_with(solution, status=status), interference=interference,
            judged=judged,
        )  # fmt: skip
        after = dict(state.antennas)
        for name, own, sign in zip(chunk.names, own_states, signs, strict=True):
            after[name] = copy_with(own, interference=sign)
        return chunk, copy_with(state, antennas=after)

    def along_track(self, chunk: Chunk, state: State) -> tuple[Result, State]:
        """Apply the filter, and return all results of one chunk: the third part of `process`.

        Parameters
        ----------
        state : State
            State after the previous chunk; only the filter's part is used and replaced.
        """
        fusion, filter_states, sensors = {}, dict(state.fusion), chunk.sensors
        replays: dict[str, tuple[Replay, ...]] = {}
        if sensors:
            for name, own in state.fusion.items():
                if name not in chunk.names:
                    filter_states[name] = replace(own, sensors=waiting_samples(own.sensors, sensors))
        if self.config.filter == "track":
            found = self._filter_antennas(chunk, state)
            motions = {name: tracked.motion for name, (tracked, _, _) in found.items()}
            spacing = screen_filtered(self._of_positions, chunk.pair, motions)
            held_s, limits = self.config.antenna_spacing.filter_held_s, self.config.sensors.balise
            for name, (tracked, given, own) in found.items():
                replays[name] = given
                tracked, own = apply_spacing_verdict(tracked, spacing.get(name), own, held_s)
                path = self.trajectories[name]
                fusion[name], filter_states[name] = with_passings(tracked, own, self.balises, path, sensors, limits)
        results = antenna_results(chunk, fusion, self.config)
        result = Result(antennas=results, notes=chunk.notes, fusion=fusion, replays=replays)
        return result, copy_with(state, fusion=filter_states)

    def _filter_antennas(
        self, chunk: Chunk, state: State
    ) -> dict[str, tuple[AlongTrack, tuple[Replay, ...], FilterState]]:
        """Return, for each antenna, the filtered positions, the filter's input, and the filter's new state.

        Two antennas are filtered in two threads.
        """
        solution, interference = chunk.solution, dict(zip(chunk.names, chunk.interference, strict=True))
        assert solution is not None, "the filter needs the single-epoch positions of the chunk"

        def one_antenna(name: str) -> tuple[AlongTrack, tuple[Replay, ...], FilterState]:
            rows, sensors, line = chunk.rows[name], chunk.sensors, self.lines[name]
            corrected = take_epochs(chunk.corrected, rows)
            scale = compute_tilt_scale(corrected, line, chunk.klobuchar, self.config)
            single = single_epochs(take_epochs(solution, rows), interference[name], self.config)
            return along_track(
                corrected, take_epochs(chunk.slips, rows), copy_with(single, tilt_scale=scale), line,
                self.config, state.fusion.get(name) or FilterState(), samples=sensors,
                references=self._line_references(name),
            )  # fmt: skip

        over_antennas = self._threads.map if len(chunk.names) > 1 else map
        return dict(zip(chunk.names, over_antennas(one_antenna, chunk.names), strict=True))

    def _curve_notes(self, headers: Mapping[str, ObservationHeader]) -> Iterator[str]:
        """Yield a note for each log whose antenna or receiver is not the one for which the C/N0 curve is valid."""
        if (curve := self.setup.cn0_curve) is not None and "cn0" in self.config.screens:
            for name, header in headers.items():
                yield from (f"{name}: {note}" for note in curve.notes_for(header))

    def _line_references(self, name: str) -> LineReferences:
        """Return the ground units, the balises and, if the filter uses features, the line features."""
        features = self._features.get(name) if "feature" in self.config.filter_sources else None
        return LineReferences(features=features, units=self.units, balises=self.balises)

    def _pair(self, time: Datetimes, near_arc_m: Floats, rows: Mapping[str, slice]) -> PairedEpochs | None:
        """Return the common epochs of two antennas of one vehicle; None if there are no two such antennas."""
        if len(rows) < 2 or not self.setup.spacing_known:
            return None
        front, rear = rows["front"], rows["rear"]
        return pair_antennas(
            time[front], time[rear], near_arc_m[front], self.trajectories["front"], self.trajectories["rear"],
            tolerance_s=self.config.antenna_pair.tag_tolerance_s,
        )  # fmt: skip


def _check_rising(name: str, time: Datetimes, before: AntennaState | None) -> None:
    """Raise ValueError unless the epochs increase and begin after the last epoch of the state `before`."""
    if (back := (time[1:] <= time[:-1]).nonzero()[0]).size:
        earlier, later = time[back[0] : back[0] + 2]
        raise ValueError(f"{name}: epoch {back[0] + 1} ({later}) is not after {earlier}; pass epochs in order of time")
    if before is not None and len(time) and time[0] <= before.ended:
        raise ValueError(
            f"{name}: the chunk begins at {time[0]}, not after {before.ended}, the last epoch of the given state"
        )
