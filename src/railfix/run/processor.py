"""Epoch processor of a run: the settings' files are read here, the processor opens none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from railfix.core.arrays import Floats
from railfix.core.errors import SettingsError
from railfix.gnss.navigation import Navigation
from railfix.integrity.protection.araim import read_integrity_support
from railfix.motion.samples import GroundUnits, ListedBalises
from railfix.pipeline.base_station import Stations
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import Models
from railfix.pipeline.processor import EpochProcessor
from railfix.ranges.cn0_curve import read_cn0_curve
from railfix.ranges.error_model import read_error_model
from railfix.track import Track
from railfix.track.trajectory import Trajectory


def with_measured_priors(config: Config) -> Config:
    """Return settings with the priors of faults, and the stretches without a level, of the error model that they name.

    Those that the settings give themselves stay, and all do where the model does not bound its priors.
    """
    given = config.risk.model_fields_set & {"local_prior", "side_prior", "priors"}
    if config.error_model is None or given:
        return config
    rate = read_error_model(config.error_model).faults
    if rate is None or not rate.bounds_priors:
        return config
    risk = config.risk.replaced(local_prior=rate.upper, side_prior=rate.side_upper, priors="measured")
    return config.replaced(risk=risk, no_level_m=config.no_level_m or rate.no_level_m)


def processor_of(
    config: Config,
    navigation: Navigation,
    trajectories: Mapping[str, Trajectory],
    *,
    track: Track | None = None,
    units: GroundUnits | None = None,
    balises: ListedBalises | None = None,
    base_ecef_m: Floats | Literal["stream"] | None = None,
) -> EpochProcessor:
    """Return a processor with all navigation records and the contents of the files that the settings name.

    `track` is the line itself, for places by its features; `units` are the surveyed stations of two-way ranges,
    `balises` the places of those that the train reads.
    `base_ecef_m`: position of a base station; "stream": that of the headers of its observations.

    Raises
    ------
    InputFileError
        A file that the settings name is missing or not what it should be.
    SettingsError
        SBAS and precise ephemerides together, or no SBAS message of the GEO asked for.
    """
    if config.sbas and navigation.precise is not None:
        raise SettingsError("SBAS corrects broadcast records, not precise orbits; give --sbas or --sp3")
    messages = None
    if config.sbas and config.sbas != "stream":
        from railfix.ranges.sbas import read_sbas

        messages = read_sbas(list(config.sbas))
    return EpochProcessor(
        config,
        trajectories,
        navigation=navigation,
        messages=messages,
        models=Models(
            error_model=None if config.error_model is None else read_error_model(config.error_model),
            cn0_curve=None if config.cn0_curve is None else read_cn0_curve(config.cn0_curve),
            support=None if config.integrity_support is None else read_integrity_support(config.integrity_support),
        ),
        track=track,
        stations=Stations(units, base_ecef_m, balises),
    )
