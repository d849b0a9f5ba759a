"""Probability of each track of a network from logs of a train at rest.

A train that was switched off on a known track and has not moved since is still on that track. A cold-movement detector
or the odometer measures the distance moved. A movement remains unnoticed with a specified probability.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Final, Literal

import networkx as nx
import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.files import read_json_object
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.core.staged_files import write_whole
from railfix.gnss.joined_observations import concatenate
from railfix.gnss.observations import Observations
from railfix.io.logs import read_navigation
from railfix.pipeline.config import Config
from railfix.positioning.track_choice import NONE, StandstillErrors, TrackPosterior, YardTrack, track_posterior
from railfix.run.inputs import NAVIGATION, InputFiles, LogReading, TrackReading, input_option
from railfix.run.processor_setup import parse_position
from railfix.run.sources import Log
from railfix.run.standstill import StandstillCodes, standstill_codes
from railfix.track.frames import in_map_frame
from railfix.track.network import Network
from railfix.track.network_read import read_network

#: A train is assumed not to have moved if its measured distance is at most this (wheel creep, coupler slack) [m].
_SAME_PLACE_M: Final = 1.0
#: Proportional part of the assumed odometer error bound, as a fraction of the distance moved.
_ODOMETER_SHARE: Final = 0.05
#: Constant part of the assumed odometer error bound [m].
_ODOMETER_M: Final = 10.0
#: A note is issued if the code position is farther from the most likely track than this [standard deviations].
_NOTED_MISFIT: Final = 2.5
#: A smaller probability of an unmapped track is raised to this value.
_LEAST_UNMAPPED: Final = 1e-9


#: Weights of mapped tracks by name, and probability of an unmapped track.
TrackPrior = tuple[dict[str, float], float]


def write_last_place(posterior: TrackPosterior, time: np.datetime64, path: Path) -> None:
    """Write the probabilities of all tracks as JSON, for the prior at the next start-up (`prior_of_last_place`).

    Raise OutputError if the file cannot be written.
    """
    shares = dict(zip(posterior.names, posterior.probability.tolist(), strict=True))
    write_whole(path, json.dumps({"time_gpst": str(time), "probability": shares}, indent=2) + "\n")


def prior_of_last_place(
    path: Path, network: Network, *, moved_m: float, missed_move: float, unmapped: float
) -> TrackPrior:
    """Return the track prior, given the file written by `write_last_place` and the distance moved since then [m].

    `missed_move` is the probability that the train was moved unnoticed, to any track. `unmapped` is the prior of an
    unmapped track after such a move. Raise InputFileError if the file has no track probabilities for this network.
    """
    record = read_json_object(path, what="the last position of a train")
    stated = record.get("probability")
    stated = stated if isinstance(stated, dict) else {}
    if not stated or not all(isinstance(v, int | float) and 0.0 <= v <= 1.0 for v in stated.values()):
        raise InputFileError(path, "has no probability of each track; railfix which-track --save-last writes it")
    shares = {str(name): float(value) for name, value in stated.items()}
    off_map = shares.pop(NONE, 0.0)
    missing = [name for name in shares if name not in network.names]
    if missing or abs(sum(shares.values()) + off_map - 1.0) > 1e-6:
        fault = f"track {missing[0]!r} is not in the map" if missing else "its probabilities do not add up to 1"
        raise InputFileError(path, f"{fault}; give the last position on the tracks of this map")
    weights = dict.fromkeys(network.names, 0.0)
    for name, share in shares.items():
        if share > 0.0:
            within = 0.0 if moved_m <= _SAME_PLACE_M else moved_m * (1.0 + _ODOMETER_SHARE) + _ODOMETER_M
            reached = [name] if within == 0.0 else _find_reachable(network, network.names.index(name), within)
            for other in reached:
                weights[other] += share / len(reached)
    total, count = sum(weights.values()), len(weights)
    weights = {name: (1.0 - missed_move) * value + missed_move * total / count for name, value in weights.items()}
    off_map = (1.0 - missed_move) * off_map + missed_move * unmapped
    return weights, max(off_map, _LEAST_UNMAPPED)


def _find_reachable(network: Network, track: int, within_m: float) -> list[str]:
    """Return the names of the tracks that a train on `track` can reach within a distance, reversals included."""
    near = nx.multi_source_dijkstra_path_length(
        network.graph.to_undirected(as_view=True), {4 * track + k for k in range(4)}, cutoff=within_m
    )
    return [network.names[k] for k in sorted({node // 4 for node in near})]


def prior_of_interlocking(text: str, network: Network) -> dict[str, float]:
    """Parse the interlocking's track weights ``NAME=WEIGHT,...``. The result has only the named tracks.

    Raise SettingsError if the text has another form or names a track that is not in the map, or if all weights are 0.
    """
    weights = {}
    for pair in text.split(","):
        name, equals, value = pair.rpartition("=")
        number = network.find_index(name.strip()) if equals else -1
        try:
            weight = float(value)
        except ValueError:
            weight = np.nan
        if number < 0 or not 0.0 <= weight < np.inf:
            raise SettingsError(f"--prior {pair!r}: expected NAME=WEIGHT, with a weight of at least 0")
        weights[network.names[number]] = weight
    if not sum(weights.values()) > 0.0:
        raise SettingsError(f"--prior {text!r}: all weights are 0")
    return weights


#: Tracks within this distance of the train are hypotheses [m].
_NEAR_M: Final = 60.0
#: Track points within this distance of the train are used [m].
_POINTS_M: Final = 400.0
#: Maximum number of tracks that are hypotheses.
_MOST_TRACKS: Final = 64


def yard_tracks(network: Network, origin_ecef_m: Floats) -> list[YardTrack]:
    """Return the tracks of a network near a position, with their points relative to the position.

    The position `origin_ecef_m` is in the frame of the network. Tracks within 60 m of it are returned, with their
    points within 400 m of it. Raise MismatchError if no track is within 60 m.
    """
    latitude, longitude, height = (float(v) for v in geodetic_from_ecef(origin_ecef_m))
    near = network.near(np.array([latitude]), np.array([longitude]), within_m=_NEAR_M, most=_MOST_TRACKS)
    numbers = sorted(int(t) for t in near.track[0] if t >= 0)
    if not numbers:
        raise MismatchError(f"no track of the map lies within {_NEAR_M:g} m of the train")
    axes = enu_axes(latitude, longitude)[:2]
    ground = ecef_from_geodetic(latitude, longitude, 0.0)
    radius = float(np.linalg.norm(origin_ecef_m)) / float(np.linalg.norm(ground))
    tracks = []
    at = {int(t): near.chainage_m[0, [j]] for j, t in enumerate(near.track[0]) if t >= 0}
    for k in numbers:
        _, _, above = network.course_on(np.array([k]), at[k])
        rows = slice(network.first_point[k], network.first_point[k + 1])
        points = (network.points_m[rows] - ground) @ axes.T * radius
        close = np.flatnonzero(np.hypot(*points.T) < _POINTS_M)
        first, last = (close[0], close[-1]) if len(close) else (0, len(points) - 1)
        part = points[max(first - 1, 0) : last + 2]
        part = part[np.concatenate([[True], np.linalg.norm(np.diff(part, axis=0), axis=1) > 1e-3])]
        if len(part) > 1:
            up = float(above[0]) - height
            tracks.append(YardTrack(name=network.names[k], points_m=part, up_m=up, sigma_up_m=network.sigma_height_m))
    return tracks


@dataclass(frozen=True, kw_only=True)
class TrackDecision:
    """Decision on the track of a train at rest, with the posterior probabilities at each of L evaluations.

    `seconds` is the time at rest at each evaluation, shape (L,) [s]. `track` is the name of a track, ``"none"`` for an
    unmapped track, or ``"undecided"``. `decided_s` is the time at rest at the decision [s], NaN if undecided. `end` is
    the last epoch.
    """

    seconds: Floats
    posteriors: tuple[TrackPosterior, ...]
    track: str
    decided_s: float
    end: np.datetime64
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
    """Evaluate the posterior repeatedly, and decide for a track when the other tracks' probability is below `risk`.

    `tracks`, `arms_m`, `errors` and `prior` are as in `track_posterior`. All `antennas` must have the same origin. The
    first evaluation is after `least_s` [s]; further evaluations follow every `every_s` [s]. A log shorter than
    `least_s` is evaluated once, without a decision. Raise MismatchError if there is no position.
    """
    start = max(codes.time[0] for codes in antennas)
    length = float((min(codes.time[-1] for codes in antennas) - start) / np.timedelta64(1, "s"))
    looks = np.arange(least_s, length + 1e-9, every_s) if length >= least_s else np.array([length])
    seconds, posteriors = [], []
    track, decided = "undecided", np.nan
    for look in looks:
        end = start + np.timedelta64(round(look * 1e3), "ms")
        parts = [slice(0, int(np.searchsorted(codes.time, end, side="right"))) for codes in antennas]
        fixes = [codes.fix(part, errors) for codes, part in zip(antennas, parts, strict=True)]
        known = [item for item in zip(antennas, fixes, arms_m, parts, strict=True) if item[1] is not None]
        if not known:
            continue
        phases = [codes.phases.mean(part, errors) for codes, _, _, part in known if codes.phases is not None]
        posterior = track_posterior(
            tracks,
            [fix for _, fix, _, _ in known if fix is not None],
            arms_m=[arm for _, _, arm, _ in known],
            errors=errors,
            prior=prior,
            phases=phases if any(len(phase.wavelength_m) for phase in phases) else (),
        )
        seconds.append(float(look))
        posteriors.append(posterior)
        name = posterior.decision(risk=risk) if length >= least_s else ""
        if name and track == "undecided":
            track, decided = name, float(look)
    if not posteriors:
        raise MismatchError("too few satellites for a position")
    end = min(codes.time[-1] for codes in antennas)
    return TrackDecision(
        seconds=np.array(seconds), posteriors=tuple(posteriors), track=track, decided_s=decided, end=end
    )


class WhichTrackInputs(InputFiles):
    """Input files of `railfix which-track`."""

    own_navigation = ("front", "rear")
    front: tuple[Path, ...] = input_option("Observations of the front, or only, antenna.", metavar="OBS")
    rear: tuple[Path, ...] = input_option("Observations of the rear antenna.", (), metavar="OBS")
    base: tuple[Path, ...] = input_option("Observations of a base station within 10 km.", (), metavar="OBS")
    nav: tuple[Path, ...] = input_option(NAVIGATION, (), metavar="NAV")
    map: tuple[Path, ...] = input_option("Map files with the tracks of the yard or station.", metavar="MAP")
    last: Path | None = input_option(
        "File written by --save-last, with the probabilities of the tracks at the end of the last standstill.", None
    )


class WhichTrackOptions(Settings):
    """Options of `railfix which-track`.

    With `same_frame`, the base station's position is in the frame of the map. The train's position, which is computed
    relative to the base station, is then also in the frame of the map.
    """

    spacing: float = option("Distance from the rear to the front antenna along the train.", 0.0, metavar="M", ge=0)
    base_place: str | None = option("Position of the base station: latitude, longitude, height.", None, metavar="L,L,H")
    risk: float = option("Upper bound of the probability of a wrong track.", 1e-3, metavar="P", gt=0, lt=0.5)
    least_s: float = option("Time at rest before the first decision.", 60.0, name="--least", metavar="S", ge=0)
    prior: str | None = option(
        "Weights of the tracks that the interlocking considers possible: T1=0.9,T2=0.1.", None, metavar="NAME=P,..."
    )
    moved: float | None = option(
        "Distance moved since --last was written, from the odometer, or 0 if cold-movement detection reports no move.",
        None,
        metavar="M",
        ge=0,
    )
    missed_move: float = option(
        "Probability that the train was moved unnoticed since --last was written.", 1e-3, metavar="P", gt=0, lt=1
    )
    start: datetime | None = option("GPS time from which epochs are processed.", None, metavar="TIME")
    end: datetime | None = option("GPS time before which epochs are processed.", None, metavar="TIME")
    same_frame: Literal["no", "yes"] = option(
        "The position of the base station is in the frame of the map, not in the frame of the satellites.",
        "no",
        name="--same-frame",
    )
    reading: TrackReading = Field(default_factory=TrackReading)
    logs: LogReading = Field(default_factory=LogReading)
    errors: StandstillErrors = Field(default_factory=StandstillErrors)


def which_track_files(inputs: WhichTrackInputs, options: WhichTrackOptions, config: Config) -> TrackDecision:
    """Determine the track on which a train stands, from its logs and a map.

    Raise a RailfixError (`railfix.core.errors`) if an option or a file is unusable, or if the train moves.
    """
    inputs.check_files()
    if (not inputs.base) != (options.base_place is None):
        raise SettingsError("a base station needs both --base and --base-place")
    if any(base.samefile(log) for base in inputs.base for log in (*inputs.front, *inputs.rear)):
        raise SettingsError(f"--base {inputs.base[0]}: is the log of the train; give the log of the base station")
    if options.spacing > 0.0 and not inputs.rear:
        raise SettingsError("--spacing is given without --rear; give the log of the rear antenna, too")
    if inputs.rear and not options.spacing > 0.0:
        raise SettingsError("two antennas need --spacing, the distance from the rear to the front antenna")
    if (inputs.last is None) != (options.moved is None):
        raise SettingsError("--last and --moved (distance since --last was written, 0 if none) must be given together")
    navigation = read_navigation(inputs.nav, **options.logs.arguments)
    base = None
    if options.base_place is not None:
        base = _observations(inputs.base, options), parse_position(options.base_place, "--base-place")
    codes: list[StandstillCodes] = []
    notes = [*navigation.notes]
    for paths in (inputs.front, inputs.rear):
        if paths:
            observations = _observations(paths, options)
            notes += observations.problems
            origin = codes[0].origin_ecef_m if codes else None
            codes.append(standstill_codes(observations, navigation, config, base=base, origin_ecef_m=origin))
    reading = options.reading
    network = read_network(inputs.map, replace(reading.of_map, height_datum=reading.height_datum or "ellipsoidal"))
    origin = codes[0].origin_ecef_m
    notes += network.notes
    if options.same_frame == "no":
        place, shift = in_map_frame(
            origin[None], network.frame, codes[0].time[0], **reading.motion,
            named=network.named,
        )  # fmt: skip
        origin = place[0]
        notes += shift.sentences
    tracks = yard_tracks(network, origin)
    prior, unmapped = _prior(inputs, options, network)
    if not any(prior[track.name] > 0.0 for track in tracks):
        raise MismatchError("according to --prior and --last, none of the tracks near the train is possible")
    decision = decide_track(
        tracks,
        codes,
        arms_m=(options.spacing / 2.0, -options.spacing / 2.0) if len(codes) == 2 else (0.0,),
        errors=options.errors.replaced(unmapped_prior=unmapped),
        risk=options.risk,
        least_s=options.least_s,
        prior=prior,
    )
    last = decision.posteriors[-1]
    best = int(np.argmax(last.probability))
    if last.misfit_sigmas[best] > _NOTED_MISFIT:
        notes.append(
            f"the code position lies {last.misfit_sigmas[best]:.1f} standard deviations from {last.names[best]}, the "
            "most likely track; beyond 4, no decision is made. Check whether the map is displaced or lacks a track"
        )
    return replace(decision, notes=tuple(notes))


def _observations(paths: tuple[Path, ...], options: WhichTrackOptions) -> Observations:
    log = Log(paths=paths, chunk_epochs=3000, start=options.start, end=options.end, reading=options.logs)
    parts = list(log.parts())
    if not parts:
        raise InputFileError(paths[0], "there is no epoch in the requested time")
    return concatenate(parts)


def _prior(inputs: WhichTrackInputs, options: WhichTrackOptions, network: Network) -> TrackPrior:
    """Return the weight of each track (product of `--last` and `--prior`), and the prior of an unmapped track."""
    weights, unmapped = dict.fromkeys(network.names, 1.0), options.errors.unmapped_prior
    if inputs.last is not None and options.moved is not None:
        weights, unmapped = prior_of_last_place(
            inputs.last, network, moved_m=options.moved, missed_move=options.missed_move, unmapped=unmapped
        )
    if options.prior is not None:
        stated = prior_of_interlocking(options.prior, network)
        weights = {name: weight * stated.get(name, 0.0) for name, weight in weights.items()}
    return weights, unmapped
