"""The positioning of chunks of epochs: the calls in reading order.

`EpochProcessor` holds what does not change during a run (settings, ephemerides, trajectories).
`process` takes a chunk and the state left by the chunk before it, and returns every intermediate
result and the new state. A live epoch is a chunk of length one; any cutting gives the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma
from scipy.stats import chi2

from railfix.antenna import Trajectory
from railfix.atmosphere import klobuchar_delay_m, saastamoinen_delay_m
from railfix.clock_elimination import UNTIED_M, ClockTies, Ranges, clock_groups
from railfix.clock_offsets import OffsetState, tie_clocks
from railfix.config import Config
from railfix.constants import CLOCK_GROUP
from railfix.constrained import Constrained, constrained_position
from railfix.epochs import Observations
from railfix.geodesy import elevation_azimuth, geodetic_from_ecef
from railfix.measurement import PLAUSIBLE_CODE_M, channel_order, code_sigma_m, first_available
from railfix.navigation import Navigation
from railfix.orbits import SatelliteStates, satellite_states
from railfix.reasons import POSITIONED, Reason, Status
from railfix.results import AntennaResult, AntennaState, Bits, Floats, Result, State
from railfix.screens import Screened, elevation_screen
from railfix.section import SearchIndex, Section, search
from railfix.signals import carrier_frequency_hz
from railfix.spp import SinglePoint, single_point

__all__ = ["AntennaResult", "AntennaState", "EpochProcessor", "Result", "State"]

#: Standard deviation given to raw ranges when looking for a place to see the satellites from [m].
ANCHOR_SIGMA_M: Final = 10.0
#: Further from the line than this a raw 3-D position is no train on it, however bad the ranges [m].
BESIDE_THE_LINE_M: Final = 1e5
#: Stands for the satellite of a range without weight [m].
SOMEWHERE_ABOVE_M: Final = (2.6e7, 0.0, 0.0)


class EpochProcessor:
    """Positions along the line from chunks of observations.

    Parameters
    ----------
    config : Config
    navigation : Navigation
    trajectories : mapping of str to Trajectory
        The trajectory of each antenna, one or two ("front", "rear").
    glonass_channel : mapping of str to int, optional
        Frequency channels where the observation header does not tell.
    """

    def __init__(self, config: Config, navigation: Navigation, trajectories: Mapping[str, Trajectory]) -> None:
        if not trajectories:
            raise ValueError("at least one antenna's trajectory is needed")
        self.config = config
        self.navigation = navigation
        plan, height = config.map_plan_sigma_m, config.map_height_sigma_m
        self.trajectories = {
            name: replace(
                trajectory,
                sigma_plan_m=trajectory.sigma_plan_m if plan is None else plan,
                sigma_height_m=trajectory.sigma_height_m if height is None else height,
            )
            for name, trajectory in trajectories.items()
        }
        self._index = {name: SearchIndex(t) for name, t in self.trajectories.items()}
        self._klobuchar, self.notes = self._ionosphere()

    def _ionosphere(self) -> tuple[Floats | None, tuple[str, ...]]:
        """Klobuchar coefficients to use, and what there is to say about them."""
        if self.config.ionosphere == "off":
            return None, ()
        for letter, name in (("G", "GPS"), ("J", "QZSS"), ("C", "BeiDou")):
            if letter in self.navigation.klobuchar:
                note = f"ionosphere: klobuchar asked for, coefficients broadcast by {name} used"
                return self.navigation.klobuchar[letter], (() if letter == "G" else (note,))
        return None, ("ionosphere: klobuchar asked for, no coefficients received, delay left uncorrected",)

    def process(self, observations: Mapping[str, Observations], state: State | None = None) -> tuple[Result, State]:
        """Positions of one chunk.

        Parameters
        ----------
        observations : mapping of str to Observations
            By antenna; each antenna keeps its own epochs.
        state : State, optional
            Left by the chunk before this one; None at the start of a log.

        Returns
        -------
        Result
        State
            To be passed on with the next chunk.

        Raises
        ------
        ValueError
            An antenna has no trajectory.
        """
        unknown = sorted(set(observations) - set(self.trajectories))
        if unknown:
            raise ValueError(f"no trajectory for antenna {', '.join(unknown)}")
        before = state.antennas if state else {}
        results, after = {}, dict(before)
        for name, part in observations.items():
            results[name], after[name] = self._antenna(name, part, before.get(name, AntennaState()))
        return Result(antennas=results, notes=self.notes), State(antennas=after)

    def _antenna(self, name: str, obs: Observations, state: AntennaState) -> tuple[AntennaResult, AntennaState]:
        trajectory, index = self.trajectories[name], self._index[name]
        columns = channel_order(obs.satellite, obs.signal, systems=self.config.systems, signals=self.config.signals)
        satellite, signal = obs.satellite[columns], obs.signal[columns]
        groups = clock_groups(satellite.astype("<U1"))
        code, cn0 = obs.code_m[:, columns], obs.cn0_dbhz[:, columns]

        reason = _refuse_codes(satellite, code)
        states = satellite_states(
            obs.time, satellite, signal, code, self.navigation, max_age_s=self.config.max_ephemeris_age_s
        )
        _refuse_satellites(reason, states)
        anchor = self._anchor(index, groups, states, code, reason)
        elevation, azimuth = elevation_azimuth(states.position_ecef_m, anchor)
        elevation_verdict = elevation_screen(elevation, limits=self.config.elevation)
        reason[elevation_verdict.reject] |= Reason.ELEVATION_MASK
        frequency = carrier_frequency_hz(satellite, signal, obs.header.glonass_channel)
        corrected = self._corrected(obs.time, anchor, elevation, azimuth, frequency, states, code)
        sigma = code_sigma_m(cn0, elevation, noise=self.config.noise)
        reason[(reason == 0) & ~(np.isfinite(corrected) & np.isfinite(sigma))] |= Reason.NO_CORRECTION
        ranges = _ranges(states, corrected, 1.0 / sigma**2, reason, groups)
        point = single_point(ranges, anchor, limits=self.config.single_point)
        section, constrained = self._on_the_line(ranges, index, point)
        ties, offsets = self._ties(obs.time, satellite, ranges, constrained, state)
        if len(groups) > 1:
            ranges = replace(ranges, ties=ties)
            start = np.where(np.isnan(point.ecef_m), anchor, point.ecef_m)
            tied = single_point(ranges, start, limits=self.config.single_point)
            section, constrained = self._on_the_line(ranges, index, tied)
        _refuse_lone(reason, groups, ties)
        status = self._status(code, ranges, trajectory, point, section, constrained)
        scale, state = self._noise_scale(ranges, constrained, state)
        found = _Found(
            columns=columns, states=states, elevation=elevation_verdict, azimuth_deg=azimuth, sigma_m=sigma,
            corrected_code_m=corrected, reason=reason, point=point, section=section, constrained=constrained,
            clocks=_clock_letters(satellite, groups), ties=ties,
        )  # fmt: skip
        return self._result(obs, trajectory, status, scale, found), replace(state, offsets=offsets)

    def _on_the_line(self, ranges: Ranges, index: SearchIndex, point: SinglePoint) -> tuple[Section, Constrained]:
        """Section search and constrained position where there are satellites enough."""
        section = search(ranges, index, point, limits=self.config.section)
        enough = ranges.n_used >= self.config.min_satellites
        vertex = np.where(enough, section.vertex, -1)
        return section, constrained_position(ranges, index.trajectory, vertex, limits=self.config.constrained)

    def _ties(
        self,
        time: NDArray[np.datetime64],
        satellite: NDArray[np.str_],
        ranges: Ranges,
        free: Constrained,
        state: AntennaState,
    ) -> tuple[ClockTies, OffsetState]:
        """What is known of the clocks against that of the first constellation asked for."""
        reference = CLOCK_GROUP[self.config.systems[0]]
        clocks = _clock_letters(satellite, ranges.groups)
        return tie_clocks(time, clocks, reference, ranges, free, state.offsets, limits=self.config.clock_offsets)

    def _anchor(
        self, index: SearchIndex, groups: tuple[slice, ...], states: SatelliteStates, code: Floats, reason: Bits
    ) -> Floats:
        """A place near the antenna to see the satellites from, shape (T, 3): good to some hundred metres.

        The point of the line nearest to a 3-D position from raw ranges of equal weight, started from the
        middle of the line at every epoch so that no epoch depends on another; the 3-D position itself
        where it is nowhere near the line; where there is none, the point of the line that fits best.
        """
        trajectory = index.trajectory
        middle = np.broadcast_to(trajectory.ecef_m.mean(axis=0), (len(code), 3))
        clean = code + states.clock_m - states.group_delay_m
        ranges = _ranges(states, clean, np.full(code.shape, 1.0 / ANCHOR_SIGMA_M**2), reason, groups)
        point = single_point(ranges, middle, limits=self.config.single_point)
        arc, offset = trajectory.nearest(point.ecef_m)
        beside = offset < BESIDE_THE_LINE_M
        anchor = np.where(beside[:, None], trajectory.at_arc(arc), point.ecef_m)
        rest = np.flatnonzero(np.isnan(anchor[:, 0]))
        if len(rest):
            vertex = search(ranges.take(rest), index, point.take(rest), limits=self.config.section).vertex
            anchor[rest] = np.where((vertex >= 0)[:, None], trajectory.ecef_m[vertex], middle[rest])
        return anchor

    def _corrected(
        self,
        time: NDArray[np.datetime64],
        anchor: Floats,
        elevation: Floats,
        azimuth: Floats,
        frequency: Floats,
        states: SatelliteStates,
        code: Floats,
    ) -> Floats:
        """P = code + c dt_sv - c TGD - I - T, shape (T, K)."""
        latitude, longitude, height = geodetic_from_ecef(anchor)
        corrected = code + states.clock_m - states.group_delay_m
        if self._klobuchar is not None:
            corrected -= klobuchar_delay_m(time, latitude, longitude, elevation, azimuth, self._klobuchar, frequency)
        if self.config.troposphere == "saastamoinen":
            corrected -= saastamoinen_delay_m(latitude, height, elevation)
        return corrected

    def _status(
        self,
        code: Floats,
        ranges: Ranges,
        trajectory: Trajectory,
        point: SinglePoint,
        section: Section,
        constrained: Constrained,
    ) -> NDArray[np.int8]:
        """The status of each epoch, shape (T,), decided once, from numbers, the gravest first."""
        config = self.config
        redundancy = ranges.n_used - ranges.n_clocks - 1
        position = trajectory.at_arc(constrained.arc_m)
        away = np.linalg.norm(position - point.ecef_m, axis=1)
        misfit = (constrained.wsse - point.wsse) / np.maximum(1.0, constrained.wsse / np.maximum(redundancy, 1))
        lost = (away > config.off_map_m) & (misfit > chi2.isf(config.off_map_risk, 2))
        beyond = constrained.overshoot_m > np.maximum(4.0 * constrained.sigma_m, trajectory.sigma_plan_m)
        conditions = [
            (~np.isfinite(code).any(axis=1), Status.NO_OBSERVATION),
            ((ranges.n_used < config.min_satellites) | (redundancy < 0), Status.TOO_FEW_SATELLITES),
            (constrained.dilution > config.dilution_limit, Status.UNOBSERVABLE),
            (~np.isfinite(constrained.arc_m), Status.NO_CONVERGENCE),
            (lost | beyond, Status.OFF_MAP),
            ((section.excess <= config.section.threshold) | (redundancy < config.section.redundancy), Status.AMBIGUOUS),
        ]
        return np.select([c for c, _ in conditions], [s.value for _, s in conditions], Status.OK).astype(np.int8)

    def _noise_scale(
        self, ranges: Ranges, constrained: Constrained, state: AntennaState
    ) -> tuple[Floats, AntennaState]:
        """Standard deviation of this receiver's ranges against the weights', from all epochs so far.

        The mean of the logarithm of wsse / degrees of freedom, each weighted by its degrees of
        freedom, less what the logarithm of a chi-square variable is lower by.
        """
        freedom = (ranges.n_used - ranges.n_clocks - 1).astype(np.float64)
        usable = (freedom > 0) & (constrained.wsse > 0)
        safe = np.where(usable, freedom, 1.0)
        level = np.log(np.where(usable, constrained.wsse, 1.0) / safe) - (digamma(safe / 2) - np.log(safe / 2))
        weight = np.where(usable, freedom, 0.0)
        # cumsum from the carried sums: the same additions in the same order however epochs are cut.
        sums = np.cumsum(np.r_[state.log_variance_sum, weight * level])
        weights = np.cumsum(np.r_[state.log_variance_weight, weight])
        scale = np.exp(0.5 * sums[1:] / (weights[1:] + self.config.noise_prior))
        return scale, replace(state, log_variance_sum=float(sums[-1]), log_variance_weight=float(weights[-1]))

    def _result(
        self, obs: Observations, trajectory: Trajectory, status: NDArray[np.int8], scale: Floats, found: _Found
    ) -> AntennaResult:
        """Everything side by side, coordinates only where the status has them."""
        point, constrained = found.point, found.constrained
        has = np.isin(status, [s.value for s in POSITIONED])
        arc = np.where(has, constrained.arc_m, np.nan)
        ecef = trajectory.at_arc(arc)
        latitude, longitude, height = geodetic_from_ecef(ecef)
        nearest, offset = trajectory.nearest(point.ecef_m)
        exact, total = constrained.exact_map_sigma_m**2, constrained.sigma_m**2
        reason = self._whole_reason(obs, found)

        def whole(values: Floats) -> Floats:
            full = np.full(obs.code_m.shape, np.nan)
            full[:, found.columns] = values
            return full

        return AntennaResult(
            time=obs.time,
            satellite=obs.satellite,
            signal=obs.signal,
            status=status,
            chainage_m=trajectory.chainage_at(arc),
            kilometrage_m=trajectory.kilometrage_at(arc),
            arc_m=arc,
            along_sigma_m=np.where(has, np.sqrt(scale**2 * exact + (total - exact)), np.nan),
            noise_scale=scale,
            ecef_m=ecef,
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            n_used=np.count_nonzero(found.reason == 0, axis=1),
            n_rejected=_satellites_refused(obs.satellite, reason),
            conventional_ecef_m=point.ecef_m,
            conventional_arc_m=nearest,
            conventional_chainage_m=trajectory.chainage_at(nearest),
            conventional_offset_m=offset,
            reason=reason,
            elevation_deg=whole(found.elevation.metric),
            azimuth_deg=whole(found.azimuth_deg),
            cn0_dbhz=obs.cn0_dbhz,
            sigma_m=whole(found.sigma_m),
            corrected_code_m=whole(found.corrected_code_m),
            residual_m=whole(np.where(found.reason == 0, constrained.residual_m, np.nan)),
            satellites=found.states,
            columns=found.columns,
            elevation_screen=found.elevation,
            single_point=point,
            section=found.section,
            constrained=constrained,
            clocks=found.clocks,
            clock_offset_m=found.ties.offset_m,
            clock_offset_sigma_m=found.ties.sigma_m,
        )

    def _whole_reason(self, obs: Observations, found: _Found) -> Bits:
        """Reasons of all channels, those that settings leave out included, shape (T, M)."""
        reason = np.where(np.isfinite(obs.code_m), 0, int(Reason.NOT_OBSERVED))
        selected = np.isin(obs.system, self.config.systems)
        reason[:, ~selected] |= Reason.SYSTEM_NOT_SELECTED
        reason[:, np.setdiff1d(np.flatnonzero(selected), found.columns)] |= Reason.OTHER_SIGNAL_TAKEN
        reason[:, found.columns] = found.reason
        return reason


@dataclass(frozen=True, kw_only=True)
class _Found:
    """What the rooms said of the channels that settings allow."""

    columns: NDArray[np.intp]
    states: SatelliteStates
    elevation: Screened
    azimuth_deg: Floats
    sigma_m: Floats
    corrected_code_m: Floats
    reason: Bits
    point: SinglePoint
    section: Section
    constrained: Constrained
    clocks: tuple[str, ...]
    ties: ClockTies


def _refuse_codes(satellite: NDArray[np.str_], code: Floats) -> Bits:
    """Reasons that the codes alone give, shape (T, K)."""
    observed = np.isfinite(code)
    plausible = (code > PLAUSIBLE_CODE_M[0]) & (code < PLAUSIBLE_CODE_M[1])
    taken = first_available(satellite, plausible)
    reason = np.zeros(code.shape, dtype=np.int64)
    reason[~observed] |= Reason.NOT_OBSERVED
    reason[observed & ~plausible] |= Reason.IMPLAUSIBLE_CODE
    reason[plausible & ~taken] |= Reason.OTHER_SIGNAL_TAKEN
    return reason


def _refuse_satellites(reason: Bits, states: SatelliteStates) -> None:
    """Add the reasons of the ephemerides to observed channels."""
    observed = (reason & Reason.NOT_OBSERVED) == 0
    for mask, bit in (
        (states.no_record, Reason.NO_EPHEMERIS),
        (states.too_old, Reason.EPHEMERIS_TOO_OLD),
        (states.unhealthy, Reason.UNHEALTHY),
    ):
        reason[observed & mask] |= bit


def _refuse_lone(reason: Bits, groups: tuple[slice, ...], ties: ClockTies) -> None:
    """Add the reason of a satellite that determines its own clock and nothing else."""
    for g, group in enumerate(groups):
        used = reason[:, group] == 0
        lone = used & (np.count_nonzero(used, axis=1) == 1)[:, None] & (ties.sigma_m[:, g, None] >= UNTIED_M)
        reason[:, group][lone] |= Reason.ALONE_ON_ITS_CLOCK


def _clock_letters(satellite: NDArray[np.str_], groups: tuple[slice, ...]) -> tuple[str, ...]:
    return tuple(CLOCK_GROUP[str(satellite[group.start])[0]] for group in groups)


def _ranges(states: SatelliteStates, code: Floats, weight: Floats, reason: Bits, groups: tuple[slice, ...]) -> Ranges:
    """Ranges to be fitted: what has a reason gets no weight and harmless numbers."""
    used = (reason == 0) & np.isfinite(code) & np.isfinite(weight)
    return Ranges(
        sat_ecef_m=np.where(used[..., None], states.position_ecef_m, SOMEWHERE_ABOVE_M),
        code_m=np.where(used, code, 0.0),
        weight=np.where(used, weight, 0.0),
        groups=groups,
    )


def _satellites_refused(satellite: NDArray[np.str_], reason: Bits) -> NDArray[np.int64]:
    """Satellites with a code of which no signal was used, shape (T,)."""
    names, which = np.unique(satellite, return_inverse=True)
    member = (which[:, None] == np.arange(len(names))).astype(np.int64)
    seen = ((reason & Reason.NOT_OBSERVED) == 0).astype(np.int64) @ member > 0
    used = (reason == 0).astype(np.int64) @ member > 0
    return np.asarray(np.count_nonzero(seen & ~used, axis=1), dtype=np.int64)
