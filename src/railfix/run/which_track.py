"""Logs of a train at rest to the probability of each track of a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Indices, Strings
from railfix.core.constants import CLOCK_GROUP
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef, range_with_rotation
from railfix.core.settings import Settings, option
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations, concatenate
from railfix.io.logs import read_navigation
from railfix.pipeline.channels import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.locate import AntennaRanges, antenna_ranges, locate
from railfix.pipeline.received import Received, known_from_start
from railfix.positioning.which_track import (
    StandstillErrors,
    StandstillFix,
    TrackPosterior,
    YardTrack,
    standstill_fix,
    track_posterior,
)
from railfix.run.inputs import InputFiles, input_option
from railfix.run.options import LogReading, TrackReading
from railfix.run.sources import Log
from railfix.track.frames import in_map_frame
from railfix.track.network import Network
from railfix.track.network_read import read_network

#: Satellites in fewer than this share of the epochs are left out, so that the mean is over the same ones.
_SHARE: Final = 0.9
#: Tracks within this of the train are hypotheses [m]; their points within the other are used.
_NEAR_M: Final = 60.0
_POINTS_M: Final = 400.0
_MOST_TRACKS: Final = 64
#: Residual standard deviation of satellite and atmosphere errors beside a base station [m]; it is at most 10 km away.
_BESIDE_BASE_M: Final = 0.05
#: Largest difference of mean places of the first and the last third of the log [m].
_AT_REST_M: Final = 8.0


@dataclass(frozen=True, kw_only=True)
class StandstillCodes:
    """Codes of one antenna at rest, minus those computed for an origin: T epochs, K satellites.

    Attributes
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    residual_m : ndarray, shape (T, K)
        Receiver clock of each constellation removed.
    system : ndarray of str, shape (K,)
    azimuth_deg, elevation_deg, common_m : ndarray, shape (K,)
        `common_m`: standard deviation of satellite and atmosphere errors.
    receivers : int
        2 where a base station's codes are subtracted.
    origin_ecef_m : ndarray, shape (3,)
    """

    time: Datetimes
    residual_m: Floats
    system: Strings
    azimuth_deg: Floats
    elevation_deg: Floats
    common_m: Floats
    receivers: int
    origin_ecef_m: Floats

    def fix(self, epochs: slice, errors: StandstillErrors) -> StandstillFix | None:
        """Mean place over some epochs."""
        seconds = float((self.time[epochs][-1] - self.time[epochs][0]) / np.timedelta64(1, "s"))
        return standstill_fix(
            self.azimuth_deg,
            self.elevation_deg,
            self.system,
            np.nanmean(self.residual_m[epochs], axis=0),
            seconds=seconds,
            common_m=self.common_m,
            errors=errors,
            receivers=self.receivers,
        )


@dataclass(frozen=True, kw_only=True)
class BaseStation:
    """Observations of a base station and its place, ECEF [m]."""

    observations: Observations
    ecef_m: Floats


def standstill_codes(
    obs: Observations,
    navigation: Navigation,
    config: Config,
    *,
    base: BaseStation | None = None,
    origin_ecef_m: Floats | None = None,
) -> StandstillCodes:
    """Codes of an antenna at rest about an origin, by default its mean place.

    Raises
    ------
    MismatchError
        The antenna moves, its log has no place, or it shares no epoch or satellite with the base station.
    """
    received, book = known_from_start(config, navigation=navigation), ChannelBook(config)
    seen = antenna_ranges(obs, received, config, book)
    places = locate(obs, received, config, book).ecef_m
    places = places[np.isfinite(places[:, 0])]
    if len(places) < 2:
        raise MismatchError("the log has no positions; are the navigation files of its day?")
    third = max(1, len(places) // 3)
    latitude, longitude, _ = (float(v) for v in geodetic_from_ecef(places[0]))
    change = np.median(places[-third:], axis=0) - np.median(places[:third], axis=0)
    moved = float(np.hypot(*(enu_axes(latitude, longitude)[:2] @ change)))
    if moved > _AT_REST_M:
        raise MismatchError(f"the antenna moves by {moved:.0f} m in the log; give --start and --end of a standstill")
    origin = np.median(places, axis=0) if origin_ecef_m is None else origin_ecef_m
    time, residual, names = obs.time, _residual(seen, origin), seen.channels.satellite
    columns = np.arange(len(names))
    nominal = config.nominal.sigma_m(np.nanmedian(seen.elevation_deg, axis=0))
    if base is not None:
        time, residual, columns = _against_base(obs, residual, seen, base, received, config, book)
        nominal = np.full(len(names), _BESIDE_BASE_M)
    kept = np.isfinite(residual).mean(axis=0) >= _SHARE
    if not kept.any():
        raise MismatchError("no satellite is observed over the whole log")
    system = np.array([CLOCK_GROUP[str(name)[0]] for name in names[columns[kept]]])
    residual = residual[:, kept]
    for letter in np.unique(system):
        rows = system == letter
        residual[:, rows] -= np.nanmean(residual[:, rows], axis=1, keepdims=True)
    elevation, azimuth = seen.elevation_deg[:, columns[kept]], seen.azimuth_deg[:, columns[kept]]
    turn = np.radians(azimuth)
    return StandstillCodes(
        time=time,
        residual_m=residual,
        system=system,
        azimuth_deg=np.degrees(np.arctan2(np.nanmean(np.sin(turn), axis=0), np.nanmean(np.cos(turn), axis=0))),
        elevation_deg=np.nanmean(elevation, axis=0),
        common_m=nominal[columns[kept]],
        receivers=1 if base is None else 2,
        origin_ecef_m=origin,
    )


def _residual(seen: AntennaRanges, origin_ecef_m: Floats) -> Floats:
    """Observed minus computed codes at a place, the Earth's rotation in transit included; NaN where unused."""
    ranges = seen.ranges
    computed, _ = range_with_rotation(ranges.sat_ecef_m, origin_ecef_m)
    return np.where(ranges.weight > 0.0, ranges.code_m - computed, np.nan)


def _against_base(
    obs: Observations,
    residual: Floats,
    seen: AntennaRanges,
    base: BaseStation,
    received: Received,
    config: Config,
    book: ChannelBook,
) -> tuple[Datetimes, Floats, Indices]:
    """Residuals minus those of the base station at its place, for common epochs and the same signals."""
    other = antenna_ranges(base.observations, received, config, book)
    theirs = _residual(other, base.ecef_m)
    step = np.timedelta64(100, "ms")
    stamps = [np.round((t - obs.time[0]) / step).astype(np.int64) for t in (obs.time, base.observations.time)]
    _, mine, its = np.intersect1d(*stamps, return_indices=True)
    names = [list(zip(s.channels.satellite.tolist(), s.channels.signal.tolist(), strict=True)) for s in (seen, other)]
    shared = [name for name in names[0] if name in names[1]]
    if not len(mine) or not shared:
        raise MismatchError("log and base station have no epoch, or no signal of a satellite, in common")
    columns = np.array([names[0].index(name) for name in shared], dtype=np.intp)
    opposite = np.array([names[1].index(name) for name in shared], dtype=np.intp)
    difference = residual[mine][:, columns] - theirs[its][:, opposite]
    return obs.time[mine], np.asarray(difference), columns


def yard_tracks(network: Network, origin_ecef_m: Floats) -> list[YardTrack]:
    """Tracks of a network near a place in its frame, east and north of it.

    Raises
    ------
    MismatchError
        There is no track within 60 m.
    """
    latitude, longitude, _ = (float(v) for v in geodetic_from_ecef(origin_ecef_m))
    near = network.near(np.array([latitude]), np.array([longitude]), within_m=_NEAR_M, most=_MOST_TRACKS)
    numbers = sorted(int(t) for t in near.track[0] if t >= 0)
    if not numbers:
        raise MismatchError(f"no track of the map lies within {_NEAR_M:g} m of the train")
    axes = enu_axes(latitude, longitude)[:2]
    ground = ecef_from_geodetic(latitude, longitude, 0.0)
    radius = float(np.linalg.norm(origin_ecef_m)) / float(np.linalg.norm(ground))
    tracks = []
    for k in numbers:
        rows = slice(network.first_point[k], network.first_point[k + 1])
        points = (network.points_m[rows] - ground) @ axes.T * radius
        close = np.flatnonzero(np.hypot(*points.T) < _POINTS_M)
        first, last = (close[0], close[-1]) if len(close) else (0, len(points) - 1)
        part = points[max(first - 1, 0) : last + 2]
        part = part[np.concatenate([[True], np.linalg.norm(np.diff(part, axis=0), axis=1) > 1e-3])]
        if len(part) > 1:
            tracks.append(YardTrack(name=network.names[k], points_m=part))
    return tracks


@dataclass(frozen=True, kw_only=True)
class TrackDecision:
    """Posterior over time and the decision.

    Attributes
    ----------
    seconds : ndarray, shape (L,)
        Time at rest at each look.
    posteriors : tuple of TrackPosterior
    track : str
        Name, ``"none"``, or ``"undecided"``.
    decided_s : float
        NaN where undecided.
    notes : tuple of str
    """

    seconds: Floats
    posteriors: tuple[TrackPosterior, ...]
    track: str
    decided_s: float
    notes: tuple[str, ...] = ()


def decide_track(
    tracks: Sequence[YardTrack],
    antennas: Sequence[StandstillCodes],
    *,
    arms_m: Sequence[float],
    errors: StandstillErrors,
    risk: float,
    least_s: float = 60.0,
    every_s: float = 10.0,
    prior: Mapping[str, float] | None = None,
) -> TrackDecision:
    """Look at the posterior from time to time and decide when the risk of another track is below a bound.

    Parameters
    ----------
    tracks, antennas, arms_m, errors, prior
        As for `track_posterior`; all antennas about the same origin.
    risk : float
        Bound of the probability that the track is another one.
    least_s, every_s : float [s]
        Time before the first look, and between looks.
    """
    start = max(codes.time[0] for codes in antennas)
    length = float((min(codes.time[-1] for codes in antennas) - start) / np.timedelta64(1, "s"))
    looks = np.arange(least_s, length + 1e-9, every_s) if length >= least_s else np.array([length])
    seconds, posteriors = [], []
    track, decided = "undecided", np.nan
    for look in looks:
        end = start + np.timedelta64(round(look * 1e3), "ms")
        fixes = [codes.fix(slice(0, int(np.searchsorted(codes.time, end, side="right"))), errors) for codes in antennas]
        known = [(fix, arm) for fix, arm in zip(fixes, arms_m, strict=True) if fix is not None]
        if not known:
            continue
        posterior = track_posterior(
            tracks, [f for f, _ in known], arms_m=[a for _, a in known], errors=errors, prior=prior
        )
        seconds.append(float(look))
        posteriors.append(posterior)
        name = posterior.decision(risk=risk) if length >= least_s else ""
        if name and track == "undecided":
            track, decided = name, float(look)
    if not posteriors:
        raise MismatchError("the satellites are too few for a place")
    return TrackDecision(seconds=np.array(seconds), posteriors=tuple(posteriors), track=track, decided_s=decided)


class WhichTrackInputs(InputFiles):
    """Input files of `railfix which-track`.

    Attributes
    ----------
    front, rear, base, nav, map : tuple of Path
    """

    front: tuple[Path, ...] = input_option("Observations of the front, or only, antenna.", metavar="OBS")
    rear: tuple[Path, ...] = input_option("Observations of the rear antenna.", (), metavar="OBS")
    base: tuple[Path, ...] = input_option("Observations of a base station within 10 km.", (), metavar="OBS")
    nav: tuple[Path, ...] = input_option("Navigation files.", metavar="NAV")
    map: tuple[Path, ...] = input_option("Map files with the tracks of the yard or station.", metavar="MAP")


class WhichTrackOptions(Settings):
    """Options of `railfix which-track`.

    Attributes
    ----------
    spacing : float [m]
    base_place : str or None
    risk, least_s : float
    prior : str or None
    start, end : datetime or None
    same_frame : {"no", "yes"}
        Whether the place of the base station, and so the train's, is in the frame of the map.
    reading : TrackReading
    logs : LogReading
    errors : StandstillErrors
    """

    spacing: float = option("Distance from the rear to the front antenna along the train.", 0.0, metavar="M", ge=0)
    base_place: str | None = option("Place of the base station: latitude, longitude, height.", None, metavar="L,L,H")
    risk: float = option("Bound of the probability of a wrong track.", 1e-3, metavar="P", gt=0, lt=0.5)
    least_s: float = option("Time at rest before the first decision.", 60.0, name="--least", metavar="S", ge=0)
    prior: str | None = option(
        "Weights of the tracks that are possible, from the last place or the interlocking: T1=0.9,T2=0.1.",
        None,
        metavar="NAME=P,...",
    )
    start: datetime | None = option("First epoch of the standstill, GPS time.", None, metavar="TIME")
    end: datetime | None = option("Epochs before this time only, GPS time.", None, metavar="TIME")
    same_frame: Literal["no", "yes"] = option(
        "The place of the base station is in the frame of the map, not in that of the satellites.",
        "no",
        name="--same-frame",
    )
    reading: TrackReading = Field(default_factory=TrackReading)
    logs: LogReading = Field(default_factory=LogReading)
    errors: StandstillErrors = Field(default_factory=StandstillErrors)


def which_track_files(inputs: WhichTrackInputs, options: WhichTrackOptions, config: Config) -> TrackDecision:
    """Read logs and map, and decide on which track the train stands.

    Raises
    ------
    InputFileError, SettingsError, MismatchError
    """
    inputs.check_files()
    if (not inputs.base) != (options.base_place is None):
        raise SettingsError("a base station needs both --base and --base-place")
    if inputs.rear and not options.spacing > 0.0:
        raise SettingsError("two antennas need --spacing, the distance from the rear to the front one")
    navigation = read_navigation(inputs.nav, date=options.logs.instant)
    base = None
    if options.base_place is not None:
        base = BaseStation(observations=_observations(inputs.base, options), ecef_m=_place(options.base_place))
    codes: list[StandstillCodes] = []
    for paths in (inputs.front, inputs.rear):
        if paths:
            origin = codes[0].origin_ecef_m if codes else None
            codes.append(
                standstill_codes(_observations(paths, options), navigation, config, base=base, origin_ecef_m=origin)
            )
    reading = options.reading
    network = read_network(
        inputs.map, crs=reading.crs, height_datum=reading.height_datum or "ellipsoidal", geoid=reading.geoid
    )
    origin, notes = codes[0].origin_ecef_m, list(network.notes)
    if options.same_frame == "no":
        place, shift = in_map_frame(
            origin[None], network.frame, codes[0].time[0], epoch=reading.map_epoch, plate=reading.plate,
            named=network.named,
        )  # fmt: skip
        origin, size = place[0], float(np.hypot(shift.east_m, shift.north_m))
        notes += shift.notes
        if size > 0.0:
            notes.append(
                f"map: {shift.frame} moved by {size:.2f} m (east {shift.east_m:+.2f}, north {shift.north_m:+.2f}) to "
                f"{shift.used}, the frame of the train's position"
            )
    half = options.spacing / 2.0
    decision = decide_track(
        yard_tracks(network, origin),
        codes,
        arms_m=(half, -half) if len(codes) == 2 else (0.0,),
        errors=options.errors,
        risk=options.risk,
        least_s=options.least_s,
        prior=_prior(options.prior, network),
    )
    return replace(decision, notes=tuple(notes))


def _observations(paths: tuple[Path, ...], options: WhichTrackOptions) -> Observations:
    log = Log(paths=paths, chunk_epochs=3000, start=options.start, end=options.end, date=options.logs.instant)
    parts = list(log.parts())
    if not parts:
        raise InputFileError(paths[0], "there is no epoch in the time asked for")
    return concatenate(parts)


def _place(text: str) -> Floats:
    try:
        latitude, longitude, height = (float(v) for v in text.split(","))
    except ValueError:
        raise SettingsError(f"--base-place {text!r}: expected LATITUDE,LONGITUDE,HEIGHT (ellipsoidal)") from None
    return ecef_from_geodetic(latitude, longitude, height)


def _prior(text: str | None, network: Network) -> dict[str, float] | None:
    if text is None:
        return None
    prior = {}
    for pair in text.split(","):
        name, equals, value = pair.rpartition("=")
        try:
            prior[network.names[network.index_of(name.strip())]] = float(value)
        except ValueError:
            raise SettingsError(f"--prior {pair!r}: expected NAME=WEIGHT") from None
        if not equals or not float(value) >= 0.0:
            raise SettingsError(f"--prior {pair!r}: expected NAME=WEIGHT, not negative")
    return prior
