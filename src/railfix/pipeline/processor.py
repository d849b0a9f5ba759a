"""The positioning of chunks of epochs: the calls in reading order.

`EpochProcessor` holds what does not change during a run (settings, ephemerides, trajectories).
`process` takes a chunk and the state left by the chunk before it, and returns every intermediate
result and the new state. A live epoch is a chunk of length one; any cutting gives the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from railfix.core.arrays import Codes, Floats
from railfix.core.constants import CLOCK_GROUP
from railfix.core.errors import SettingsError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.reasons import CHECK_FAILED, POSITIONED, Reason, Status
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.integrity.raim import Outcome
from railfix.pipeline.antenna_pair import AntennaPair, pair_antennas, screen_antenna_pair
from railfix.pipeline.carrier_phase import CarrierState, carried, slips_of, smoothed
from railfix.pipeline.channels import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import Prepared, prepare
from railfix.pipeline.fault_exclusion import fault_free, protected
from railfix.pipeline.protection_levels import judged, protect
from railfix.pipeline.reason_table import alone_on_their_clocks, satellites_refused, whole_reason
from railfix.pipeline.results import AntennaResult, AntennaState, Protection, Raim, Result, State
from railfix.pipeline.solve import Place, place_on_line, redundancy_of
from railfix.positioning.carrier import PhasePositions
from railfix.positioning.intersystem_bias import OffsetState, tie_clocks
from railfix.positioning.noise_scale import noise_scale, own_sigma_m
from railfix.positioning.normal_equations import ClockTies, Ranges
from railfix.positioning.section_search import SearchIndex
from railfix.positioning.single_point import SinglePoint, single_point
from railfix.ranges.cn0_curve import read_cn0_curve
from railfix.ranges.error_model import read_error_model
from railfix.ranges.sbas import SbasCorrections, read_sbas
from railfix.screens import Screened, antenna_spacing_screen, cn0_screen, doppler_screen, elevation_screen
from railfix.track.trajectory import Trajectory

__all__ = ["AntennaResult", "AntennaState", "EpochProcessor", "Result", "State"]


class EpochProcessor:
    """Positions along the line from chunks of observations.

    Parameters
    ----------
    config : Config
    navigation : Navigation
    trajectories : mapping of str to Trajectory
        The trajectory of each antenna, one or two ("front", "rear").
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
        self._channels = ChannelBook(config, navigation)
        self._index = {name: SearchIndex(t) for name, t in self.trajectories.items()}
        self._error_model = None if config.error_model is None else read_error_model(config.error_model)
        if config.sbas and navigation.precise is not None:
            raise SettingsError("SBAS corrects broadcast records, not precise orbits; give --sbas or --sp3")
        self.sbas = None if not config.sbas else _opened_sbas(config)
        self._cn0_curve = None if config.cn0_curve is None else read_cn0_curve(config.cn0_curve)
        self.klobuchar, notes = self._ionosphere()
        said = () if self.sbas is None else self.sbas.notes
        self.notes = (*notes, *said, *self._what_screens_lack())
        dropped = CHECK_FAILED if config.failed_checks == "drop" else ()
        #: By status: whether coordinates come with it.
        self._has_coordinates = np.array([status in POSITIONED and status not in dropped for status in sorted(Status)])
        self._off_map_excess = float(chi2.isf(config.off_map_risk, 2))

    def _ionosphere(self) -> tuple[Floats | None, tuple[str, ...]]:
        """Klobuchar coefficients to use, and what there is to say about them."""
        if self.config.sbas:
            asked = f"ionosphere: {self.config.ionosphere}, troposphere: {self.config.troposphere}"
            return None, (f"{asked} asked for, those of SBAS used in their place",)
        if self.config.ionosphere == "off":
            return None, ()
        for letter, name in (("G", "GPS"), ("J", "QZSS"), ("C", "BeiDou")):
            if letter in self.navigation.klobuchar:
                note = f"ionosphere: klobuchar asked for, coefficients broadcast by {name} used"
                return self.navigation.klobuchar[letter], (() if letter == "G" else (note,))
        return None, ("ionosphere: klobuchar asked for, no coefficients received, delay left uncorrected",)

    def _what_screens_lack(self) -> tuple[str, ...]:
        """Screens that were asked for and cannot judge, one sentence each."""
        screens, lacking = self.config.screens, []
        if "cn0" in screens and self._cn0_curve is None:
            floor = self.config.cn0.floor_dbhz
            rest = "nothing is judged" if floor is None else f"the floor of {floor:g} dB-Hz alone judges"
            lacking.append(f"screen cn0: asked for without a curve over elevation (cn0_curve), {rest}")
        two = len(self.trajectories) > 1
        bodies = all(t.body_chainage_m is not None for t in self.trajectories.values())
        for name in ("antenna_pair", "antenna_spacing"):
            if name in screens and two and not bodies:
                lacking.append(
                    f"screen {name}: asked for, but without a vehicle file the spacing is unknown; not judged"
                )
        made = "" if self._error_model is None else self._error_model.source.conditions
        if made and made != conditions_of(config := self.config):
            lacking.append(
                f"error model: made under other conditions ({made}) than this run's ({conditions_of(config)})"
            )
        if self.config.protection == "on" and self.config.carrier == "float":
            lacking.append("protection level: asked for, but there is none for positions from code and phase together")
        return tuple(lacking)

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
        after = dict(state.antennas) if state else {}
        prepared: dict[str, Prepared] = {}
        for name, part in observations.items():
            prepared[name], after[name] = self._screened(name, part, after.get(name, AntennaState()))
        pair = self._pair(prepared)
        if pair is not None and "antenna_pair" in self.config.screens:
            screen_antenna_pair(pair, self.config.antenna_pair)
        found: dict[str, _Found] = {}
        for name, one in prepared.items():
            found[name], after[name] = self._positioned(one, self._index[name], after[name])
        if pair is not None and "antenna_spacing" in self.config.screens:
            self._screen_spacing(pair, found)
        results = {name: self._result(one, self.trajectories[name], found[name]) for name, one in prepared.items()}
        return Result(antennas=results, notes=self.notes), State(antennas=after)

    def _screened(self, name: str, obs: Observations, state: AntennaState) -> tuple[Prepared, AntennaState]:
        """Corrected ranges of one antenna, and what the screens of one antenna refuse."""
        channels = self._channels.of(obs)
        one = prepare(
            obs,
            channels,
            self.config,
            self.navigation,
            self._index[name],
            self.klobuchar,
            error_model=self._error_model,
            sbas=self.sbas,
        )
        if "elevation" in self.config.screens:
            verdict = elevation_screen(one.elevation_deg, limits=self.config.elevation)
            one.screened("elevation", verdict, Reason.ELEVATION_MASK)
        if "cn0" in self.config.screens:
            signals = cn0_screen(
                one.cn0_dbhz,
                one.elevation_deg,
                satellite=one.satellite,
                signal=one.signal,
                limits=self.config.cn0,
                curve=self._cn0_curve,
            )
            one.screened("cn0_floor", signals.floor, Reason.CN0_FLOOR)
            one.screened("cn0_curve", signals.curve, Reason.CN0_CURVE)
        if "doppler" in self.config.screens:
            changes, doppler = doppler_screen(
                obs.time,
                np.where((one.reason & Reason.IMPLAUSIBLE_CODE) == 0, one.code_m, np.nan),
                one.doppler_hz,
                satellite=one.satellite,
                signal=one.signal,
                frequency_hz=one.frequency_hz,
                break_before=obs.break_before,
                code_sigma_m=one.sigma_m,
                limits=self.config.doppler,
                state=state.doppler,
            )
            one.screened("doppler", changes, Reason.DOPPLER)
            state = replace(state, doppler=doppler)
        if self.config.carrier != "off":
            slips, carrier = slips_of(one, self.navigation, self.config, state.carrier or CarrierState())
            if self.config.carrier == "smoothed":
                one, carrier = smoothed(one, slips, self.config, carrier)
            one, state = replace(one, slips=slips), replace(state, carrier=carrier)
        return one, state

    def _pair(self, prepared: Mapping[str, Prepared]) -> AntennaPair | None:
        """Epochs that two antennas of one vehicle have in common, None where there are no such antennas."""
        if len(prepared) < 2 or any(self.trajectories[name].body_chainage_m is None for name in prepared):
            return None
        tolerance = self.config.antenna_pair.tag_tolerance_s
        return pair_antennas(
            prepared["front"],
            prepared["rear"],
            self.trajectories["front"],
            self.trajectories["rear"],
            tolerance_s=tolerance,
        )

    def _screen_spacing(self, pair: AntennaPair, found: dict[str, _Found]) -> None:
        """Compare the positions of the two antennas; both get the status where they do not fit."""
        arcs = {name: found[name].place.constrained.arc_m for name in ("front", "rear")}
        chainage = {name: self.trajectories[name].chainage_at(arcs[name]) for name in arcs}
        front, rear = chainage["front"][pair.front_epoch], chainage["rear"][pair.rear_epoch]
        along = np.nan_to_num(pair.spacing.along_m)
        verdict = antenna_spacing_screen(
            front, rear, np.abs(along), facing=np.sign(along).astype(int), limits=self.config.antenna_spacing
        )
        for name, epochs in (("front", pair.front_epoch), ("rear", pair.rear_epoch)):
            one, metric = found[name], np.full(len(found[name].status), np.nan)
            metric[epochs] = verdict.metric
            reject = np.zeros(len(metric), dtype=bool)
            reject[epochs] = verdict.reject
            doubtful = reject & self._has_coordinates[one.status]
            status = np.where(doubtful, Status.ANTENNAS_DISAGREE, one.status).astype(np.int8)
            pair.prepared[name].screens["antenna_spacing"] = Screened(metric=metric, reject=reject)
            found[name] = replace(one, status=status)

    def _positioned(self, one: Prepared, index: SearchIndex, state: AntennaState) -> tuple[_Found, AntennaState]:
        """Conventional and constrained position, exclusion, status and noise scale of one antenna."""
        ranges = one.ranges()
        point = single_point(ranges, one.anchor_ecef_m, limits=self.config.single_point)
        ties, offsets = self._ties(one, ranges, point, state)
        tied = point
        if len(one.groups) > 1:
            ranges = replace(ranges, ties=ties)
            start = np.where(np.isnan(point.ecef_m), one.anchor_ecef_m, point.ecef_m)
            tied = single_point(ranges, start, limits=self.config.single_point)
        place = place_on_line(ranges, index, tied, self.config)
        one.refuse(alone_on_their_clocks(one, ties), Reason.ALONE_ON_ITS_CLOCK)
        sums = (state.log_variance_sum, state.log_variance_weight)
        wsse = place.constrained.wsse
        scale, sums = noise_scale(redundancy_of(ranges), wsse, sums, prior=self.config.noise_prior)
        ranges, place, raim = fault_free(ranges, index, place, scale, self.config)
        if "raim" in self.config.screens and self.config.raim_protection == "on":
            raim = protected(ranges, index.trajectory, place.constrained, raim, scale, self.config)
        one.refuse(raim.excluded, Reason.FAULT_EXCLUDED)
        one_map = place.constrained
        level = None
        if self.config.protection == "on" and self.config.carrier != "float":
            level = protect(one, ranges, index.trajectory, one_map, raim, scale, self.config)
        own_sigma = own_sigma_m(redundancy_of(ranges), one_map.wsse, one_map.exact_map_sigma_m, scale)
        status = self._status(one.code_m, ranges, index.trajectory, place, raim, own_sigma)
        arc = one_map.arc_m
        exact, total = one_map.exact_map_sigma_m, one_map.sigma_m
        phase = None
        if self.config.carrier == "float" and one.slips is not None:
            before = state.carrier or CarrierState()
            phase, after = carried(one, one.slips, ranges, index.trajectory, arc, self.config, before)
            arc, exact, total = phase.arc_m, phase.noise_sigma_m, phase.sigma_m
            state = replace(state, carrier=after)
        found = _Found(
            point=point,
            place=place,
            ties=ties,
            raim=raim,
            status=status,
            noise_scale=scale,
            own_sigma_m=own_sigma,
            arc_m=arc,
            along_sigma_m=np.sqrt((scale * exact) ** 2 + (total**2 - exact**2)),
            phase=phase,
            protection=level,
        )
        return found, replace(state, offsets=offsets, log_variance_sum=sums[0], log_variance_weight=sums[1])

    def _ties(
        self, one: Prepared, ranges: Ranges, free: SinglePoint, state: AntennaState
    ) -> tuple[ClockTies, OffsetState]:
        """What is known of the clocks against that of the first constellation asked for."""
        reference = CLOCK_GROUP[self.config.systems[0]]
        time = one.observations.time
        return tie_clocks(time, one.clocks, reference, ranges, free, state.offsets, limits=self.config.clock_offsets)

    def _status(
        self, code: Floats, ranges: Ranges, trajectory: Trajectory, place: Place, raim: Raim, own_sigma: Floats
    ) -> Codes:
        """The status of each epoch, shape (T,), decided once, from numbers, the gravest first."""
        config, redundancy = self.config, redundancy_of(ranges)
        point, section, constrained = place.point, place.section, place.constrained
        position = trajectory.at_arc(constrained.arc_m)
        away = np.linalg.norm(position - point.ecef_m, axis=1)
        misfit = (constrained.wsse - point.wsse) / np.maximum(1.0, constrained.wsse / np.maximum(redundancy, 1))
        lost = (away > config.off_map_m) & (misfit > self._off_map_excess)
        beyond = constrained.overshoot_m > np.maximum(4.0 * constrained.sigma_m, trajectory.sigma_plan_m)
        conditions = [
            (~np.isfinite(code).any(axis=1), Status.NO_OBSERVATION),
            ((ranges.n_used < config.min_satellites) | (redundancy < 0), Status.TOO_FEW_SATELLITES),
            (constrained.dilution > config.dilution_limit, Status.UNOBSERVABLE),
            (~np.isfinite(constrained.arc_m), Status.NO_CONVERGENCE),
            (lost | beyond, Status.OFF_MAP),
            ((raim.outcome == Outcome.UNRESOLVED) | (raim.outcome == Outcome.INSEPARABLE), Status.INCONSISTENT),
            (own_sigma > config.largest_sigma_m, Status.UNCERTAIN),
            ((section.excess <= config.section.threshold) | (redundancy < config.section.redundancy), Status.AMBIGUOUS),
        ]
        return np.select([c for c, _ in conditions], [s.value for _, s in conditions], Status.OK).astype(np.int8)

    def _result(self, one: Prepared, trajectory: Trajectory, found: _Found) -> AntennaResult:
        """Everything side by side, coordinates only where the status has them."""
        obs, point, constrained, scale = one.observations, found.point, found.place.constrained, found.noise_scale
        has = self._has_coordinates[found.status]
        arc = np.where(has, found.arc_m, np.nan)
        ecef = trajectory.at_arc(arc)
        latitude, longitude, height = geodetic_from_ecef(ecef)
        nearest, offset = trajectory.nearest(point.ecef_m)
        reason = whole_reason(one)

        def whole(values: Floats) -> Floats:
            full = np.full(obs.code_m.shape, np.nan)
            full[:, one.columns] = values
            return full

        return AntennaResult(
            time=obs.time,
            satellite=obs.satellite,
            signal=obs.signal,
            status=found.status,
            chainage_m=trajectory.chainage_at(arc),
            kilometrage_m=trajectory.kilometrage_at(arc),
            arc_m=arc,
            along_sigma_m=np.where(has, found.along_sigma_m, np.nan),
            own_sigma_m=found.own_sigma_m,
            noise_scale=scale,
            ecef_m=ecef,
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            n_used=np.count_nonzero(one.reason == 0, axis=1),
            n_rejected=satellites_refused(one.channels.member, reason),
            conventional_ecef_m=point.ecef_m,
            conventional_arc_m=nearest,
            conventional_chainage_m=trajectory.chainage_at(nearest),
            conventional_offset_m=offset,
            reason=reason,
            elevation_deg=whole(one.elevation_deg),
            azimuth_deg=whole(one.azimuth_deg),
            cn0_dbhz=obs.cn0_dbhz,
            sigma_m=whole(one.sigma_m),
            corrected_code_m=whole(one.corrected_code_m),
            residual_m=whole(np.where(one.reason == 0, constrained.residual_m, np.nan)),
            satellites=one.satellites,
            columns=one.columns,
            screens=one.screens,
            single_point=point,
            section=found.place.section,
            constrained=constrained,
            phase=found.phase,
            raim=replace(found.raim, protection_level_m=np.where(has, found.raim.protection_level_m, np.nan)),
            protection=None if found.protection is None else judged(found.protection, found.status, has, self.config),
            clocks=one.clocks,
            clock_offset_m=found.ties.offset_m,
            clock_offset_sigma_m=found.ties.sigma_m,
        )


def conditions_of(config: Config) -> str:
    """Screens and corrections that the errors of the ranges depend on, in words: what an error model holds for."""
    screens = ", ".join(config.screens) or "none"
    corrections = "sbas" if config.sbas else f"ionosphere {config.ionosphere}, troposphere {config.troposphere}"
    carrier = "codes smoothed" if config.carrier == "smoothed" else "codes as they are"
    return f"screens {screens}; mask {config.elevation.mask_deg:g} deg; {corrections}; {carrier}"


def _opened_sbas(config: Config) -> SbasCorrections:
    """The corrections that the settings ask for."""
    log = read_sbas(list(config.sbas))
    try:
        return SbasCorrections.from_log(log, prn=config.sbas_prn, limits=config.sbas_limits)
    except ValueError as error:
        raise SettingsError(f"sbas_prn = {config.sbas_prn}: {error}") from None


@dataclass(frozen=True, kw_only=True)
class _Found:
    """Where one antenna is: conventionally, and on the line, with what was decided on the way."""

    point: SinglePoint
    place: Place
    ties: ClockTies
    raim: Raim
    status: Codes
    noise_scale: Floats
    own_sigma_m: Floats
    arc_m: Floats
    along_sigma_m: Floats
    phase: PhasePositions | None
    protection: Protection | None
