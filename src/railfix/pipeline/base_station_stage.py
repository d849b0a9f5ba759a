"""Range errors of a base station, whose observations are corrected in the same way as the train's observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal, NamedTuple

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import SettingsError
from railfix.core.geodesy import ecef_from_geodetic, geodetic_from_ecef, range_with_rotation
from railfix.core.reasons import Reason
from railfix.gnss.observations import Observations
from railfix.motion.samples import GroundUnits, ListedBalises
from railfix.pipeline.carrier_stage import CarrierState, find_antenna_slips, smooth_ranges
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.passed_features import FeatureSearch
from railfix.pipeline.range_stage import correct_ranges
from railfix.pipeline.received import Received, correction_source
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.carrier import corrected_phase_m, number_arcs
from railfix.positioning.receiver_noise import robust_clock
from railfix.positioning.search_index import SearchIndex
from railfix.ranges.base_station import LONGEST_AGE_S, BaseErrors
from railfix.track import Track
from railfix.track.trajectory import Trajectory

#: Half length of an artificial north-south track through the station, needed for the corrections [deg]: about 50 m.
_HALF_LINE_DEG: Final = 0.0005
_NO_EPOCH: Final = "base station: no epoch with a known station position so far, so no errors are subtracted"
#: The state is reset if the station's position changes by more than this [m].
_SAME_PLACE_M: Final = 0.01


class Stations(NamedTuple):
    """Surveyed positions of ground units, base station and balises; also the feature search of each antenna. If the
    base station is "stream", its position is read from the headers of its observations.
    """

    units: GroundUnits | None = None
    base_ecef_m: Floats | Literal["stream"] | None = None
    balises: ListedBalises | None = None
    features: Mapping[str, FeatureSearch] | None = None


@dataclass(frozen=True, kw_only=True)
class BaseState:
    """Range errors of a base station (None before its first epoch), and state of its carrier-phase stages."""

    errors: BaseErrors | None = None
    carrier: CarrierState = field(default_factory=CarrierState)

    @property
    def notes(self) -> tuple[str, ...]:
        """One note until an epoch with a known station position has been received, then none."""
        return () if self.errors is not None else (_NO_EPOCH,)

    def beside(self, received: Received) -> Received:
        """Return the received data with the station's range errors, or with a note if no range errors exist."""
        notes = tuple(note for note in received.notes if note != _NO_EPOCH)
        return replace(received, base=self.errors, notes=(*notes, *self.notes))


class BaseStation:
    """Base station at a known ECEF position, shape (3,) [m], in the reference frame of the satellite orbits.

    The station's pseudoranges are corrected like the train's pseudoranges, and smoothed by any available carrier phase.
    Smoothing reduces the station's noise, but not its multipath. If the position is "stream", it is read from the
    headers of the observations. The state is reset if this position changes by more than a centimetre, for example if
    the virtual station changes.
    """

    def __init__(self, config: Config, ecef_m: Floats | Literal["stream"]) -> None:
        if config.dual_frequency_sbas:
            raise SettingsError(
                "SBAS on L5 corrects dual-frequency codes, but a base station corrects single-frequency codes; "
                "leave out SBAS or the base station, or set sbas_band = L1"
            )
        self._config = config.replaced(frequencies="one")
        self._ecef_m = None if isinstance(ecef_m, str) else np.asarray(ecef_m, dtype=np.float64)
        self._antenna: tuple[Floats, AntennaRows] | None = None
        self._book = ChannelBook(self._config)

    def add_observations(
        self, obs: Observations | None, received: Received, state: BaseState | None, began: np.datetime64
    ) -> BaseState:
        """Add observations of the station to the state; drop range errors too old for use at epochs from `began` on."""
        state = state or BaseState()
        if obs is not None and len(obs):
            place = obs.header.approximate_ecef_m if self._ecef_m is None else self._ecef_m
            if not np.isfinite(place).all():
                return state
            errors = state.errors
            if errors is not None and np.linalg.norm(errors.ecef_m - place) > _SAME_PLACE_M:
                errors, state = None, BaseState()
            new, carrier = self.errors(obs, received, state.carrier, place)
            state = BaseState(errors=new if errors is None else errors.merge(new), carrier=carrier)
        if np.isnat(began) or state.errors is None:
            return state
        kept = np.timedelta64(round(2e9 * LONGEST_AGE_S), "ns")
        return replace(state, errors=state.errors.drop_before(began - kept))

    def _rows(self, ecef_m: Floats) -> AntennaRows:
        """Return the station as an antenna on a short trajectory."""
        if self._antenna is None or np.any(self._antenna[0] != ecef_m):
            latitude, longitude, height = (float(x) for x in geodetic_from_ecef(ecef_m))
            ends = ecef_from_geodetic(latitude + np.array([-1.0, 1.0]) * _HALF_LINE_DEG, longitude, height)
            index = SearchIndex(Trajectory.from_antenna_path(Track.from_ecef(ends)))
            self._antenna = ecef_m, AntennaRows.on(index)
        return self._antenna[1]

    def errors(
        self, obs: Observations, received: Received, carrier: CarrierState, ecef_m: Floats
    ) -> tuple[BaseErrors, CarrierState]:
        """Return the station's range errors at the epochs of `obs`, and the new state of the carrier-phase stages."""
        own = replace(received, base=None)
        channels = self._book.of(obs, received.navigation)
        rows, source = self._rows(ecef_m), correction_source(own, self._config)
        corrected, _ = correct_ranges(obs, channels, self._config, source, rows)
        slips, states = find_antenna_slips(corrected, rows, self._config, [carrier])
        corrected, (carrier,) = smooth_ranges(corrected, None, slips, rows, self._config, states)
        used = corrected.reason == Reason.USED
        distance, _ = range_with_rotation(corrected.satellites.position_ecef_m, ecef_m)
        residual = np.where(used, corrected.corrected_code_m - distance, np.nan)
        clock = robust_clock(residual, corrected.sigma_m, corrected.channels.groups).clock_m
        of_channel = np.repeat(
            np.arange(len(corrected.channels.groups)), [g.stop - g.start for g in corrected.channels.groups]
        )
        phase = corrected_phase_m(
            slips.phase_m[:, corrected.columns], corrected.satellites.clock_m, corrected.ionosphere_m,
            corrected.troposphere_m,
        )  # fmt: skip
        known = np.isfinite(clock)
        common = np.where(known, clock, 0.0)[np.arange(len(clock)), known.argmax(axis=1)] if known.size else 0.0
        phase = np.where(used, phase - distance - np.reshape(common, (-1, 1)), np.nan)
        arc, arcs = number_arcs(
            slips.slip[:, corrected.columns], np.isfinite(phase), corrected.satellite, corrected.signal, carrier.arcs
        )
        errors = BaseErrors(
            ecef_m=ecef_m,
            time=obs.time,
            satellite=corrected.satellite,
            signal=corrected.signal,
            code_m=residual - clock[:, of_channel],
            phase_m=phase,
            arc=arc,
        )
        return errors, replace(carrier, arcs=arcs)


def check_base(config: Config, base: BaseStation | None) -> None:
    """Raise SettingsError if a required base station is missing, or if the settings do not allow the base station."""
    if config.carrier == "fixed" and base is None:
        raise SettingsError("carrier = fixed requires a base station (--base); without one, set carrier = float")
    if config.sbas and base is not None:
        raise SettingsError("both SBAS and a base station correct the ranges; use only one of the two")
