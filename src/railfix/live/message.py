"""Position messages computed from the results of single epochs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, TypeGuard

import numpy as np

from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.reasons import Status
from railfix.core.timescale import GPS_EPOCH
from railfix.integrity.protection import LevelStatus
from railfix.io.train_message import MessageStatus, Source, SuspectedInterference, TrainMessage, Unknown
from railfix.live.settings import LiveSettings
from railfix.live.train_ends import TrainFrame
from railfix.pipeline.filter_result import AlongTrack
from railfix.pipeline.results import AntennaResult, Result
from railfix.pipeline.sensed_motion import CARRIED
from railfix.tracking import Kind, TrackStatus

#: Speed bound in sigmas. Speed errors exceed the bound with a probability of 1e-7 (two-sided, as in P1 2.4).
_SPEED_K = 5.33
#: Amount that is added to bounds, because chainages are rounded to centimetres [m].
_ROUNDING_M: Final = 0.01
_SOURCE_OF_KIND = {
    Kind.PHASE: Source.CARRIER_PHASE, Kind.DOPPLER: Source.DOPPLER, Kind.WHEEL: Source.TACHOMETER,
    Kind.RADAR: Source.RADAR, Kind.FORCE: Source.INERTIAL, Kind.PLACE: Source.FEATURES, Kind.RANGE: Source.RANGING,
    Kind.BALISE: Source.BALISES, Kind.NEXT_BALISE: Source.BALISES,
}  # fmt: skip
_SOURCE_OF_ANTENNA = {"front": Source.FRONT_RECEIVER, "rear": Source.REAR_RECEIVER}


def no_input_message(settings: LiveSettings, frame: TrainFrame, running: int, time_ns: int) -> TrainMessage:
    """Return the message of a period without input; `time_ns` is the last epoch's time tag. The sequence number is set
    later.
    """
    return TrainMessage(
        train=settings.train,
        sequence=0,
        time_ns=time_ns,
        sent_ns=time_ns,
        line=settings.line,
        status=MessageStatus.NO_INPUT,
        **_describe_train(frame, running),
    )


@dataclass(frozen=True, kw_only=True)
class TrainPlace:
    """Position of the train's reference point at the last epoch of a result."""

    antenna: str  #: Antenna from which the position is computed.
    chainage_m: float  #: Chainage of the reference point [m]; NaN without a position.
    sigma_m: float  #: Along-track standard deviation of the position [m]; NaN if unknown.
    bound_m: float  #: Bound of the error of `chainage_m` [m]; infinite if there is none.
    level_m: float  #: Protection level from which `bound_m` is computed [m]; infinite if there is none.
    status: MessageStatus
    moving: int  #: Direction of motion: 1 toward rising chainage, -1 toward falling, 0 if unknown or too slow.
    #: Latitude, longitude [deg] and ellipsoidal height [m] of the first antenna; None without a position.
    geodetic: tuple[float, float, float] | None


def locate_train(result: Result, frame: TrainFrame) -> TrainPlace:
    """Return the position of the train's reference point, from the antenna with the lowest protection level.

    The filter's along-track position is used if there is one, otherwise the single-epoch position. If the filter has a
    protection level (`tracking.level`), the bound is the filter's over- and under-reading amount. Otherwise, the bound
    is the single-epoch protection level plus the distance between the filter's position and the single-epoch position.
    """
    places = [_locate_antenna(name, result, frame) for name in result.antennas]
    return min(places, key=lambda place: (math.isnan(place.chainage_m), place.level_m))


def _locate_antenna(name: str, result: Result, frame: TrainFrame) -> TrainPlace:
    """Return the position of the train's reference point, computed from one antenna."""
    antenna, track = result.antennas[name], result.fusion.get(name)
    place, status = _place_and_status(antenna, track)
    arc, sigma = float(antenna.arc_m[-1]), float(antenna.along_sigma_m[-1])
    level, single, amount = _level_m(antenna), float(antenna.chainage_m[-1]), math.nan
    if _has_place(track):
        arc, sigma = float(track.tracked.arc_m[-1]), float(track.tracked.sigma_m[-1])
        amount = float(track.tracked.amount_m[-1])
    bound = level + abs(place - single) + _ROUNDING_M if math.isfinite(single) else math.inf
    if math.isfinite(amount) and track is not None:  # the filter has its own protection level
        bound, level = amount + _ROUNDING_M, float(track.tracked.level_m[-1])
    chainage, geodetic = math.nan, None
    if math.isfinite(place):
        chainage = frame.reference_m(name, arc)
        geodetic = _geodetic(name, result, frame, arc)
        if not math.isfinite(chainage):
            status = MessageStatus.NO_POSITION
    bounded = math.isfinite(bound)
    if status is MessageStatus.POSITION and not bounded:
        status = MessageStatus.DOUBTFUL
    # If the epoch failed a check, its single-epoch bound does not apply to the dead-reckoned position.
    if status is MessageStatus.COASTING and not (bounded and (math.isfinite(amount) or _has_passed(antenna))):
        status = MessageStatus.DOUBTFUL
    if status not in (MessageStatus.POSITION, MessageStatus.COASTING):  # positions with other statuses have no bound
        bound = math.inf
    moving = int(track.direction[-1]) if track is not None and len(track) else 0
    return TrainPlace(
        antenna=name, chainage_m=chainage, sigma_m=sigma, bound_m=bound, level_m=level, status=status, moving=moving,
        geodetic=geodetic,
    )  # fmt: skip


def _geodetic(name: str, result: Result, frame: TrainFrame, arc_m: float) -> tuple[float, float, float] | None:
    """Return latitude, longitude [deg] and ellipsoidal height [m] of the first antenna; None if unknown."""
    source = result.fusion[name] if _has_place(result.fusion.get(name)) else result.antennas[name]
    values = np.array([source.latitude_deg[-1], source.longitude_deg[-1], source.height_m[-1]])
    if name != frame.first:
        values = np.array(geodetic_from_ecef(frame.first_antenna_ecef_m(name, arc_m)[None])).ravel()
    return None if not np.isfinite(values).all() else (float(values[0]), float(values[1]), float(values[2]))


def create_message(
    result: Result, place: TrainPlace, settings: LiveSettings, frame: TrainFrame, running: int
) -> TrainMessage:
    """Return the message of one processed epoch; the sequence number and the time of sending are set later.

    `running` is the direction of the train's leading end. The message contains the chainage and bounds of the front
    end. The bounds are wider if it is unknown which end of the train is ahead. If the position of the front end is
    unknown, the message contains the chainage and bounds of the reference point. A doubtful position has no bounds.
    """
    antenna, track = result.antennas[place.antenna], result.fusion.get(place.antenna)
    sources = Source(0)
    for used, other in result.antennas.items():
        if other.n_used[-1] > 0:
            sources |= _SOURCE_OF_ANTENNA.get(used, Source(0))
    values = _describe_place(place, frame, running)
    if track is not None and len(track):
        speed, sigma = float(track.tracked.speed_mps[-1]), float(track.tracked.speed_sigma_mps[-1])
        if math.isfinite(speed):
            values["speed_cmps"], values["speed_bound_cmps"] = round(speed * 100.0), _up_cm(_SPEED_K * sigma)
        values["direction"], values["standstill"] = place.moving, bool(track.standstill[-1])
        sources |= _name_sources(track)
        probability = float(track.tracked.probability[-1])
        if math.isfinite(probability):
            values["track_permille"] = int(min(max(probability, 0.0), 1.0) * 1000.0)
    return TrainMessage(
        train=settings.train,
        sequence=0,
        time_ns=int((antenna.time[-1] - GPS_EPOCH).astype(np.int64)),
        sent_ns=0,
        line=settings.line,
        status=place.status,
        sources=sources,
        interference=_find_suspicion(result),
        **_describe_train(frame, running),
        **values,
    )


def _describe_train(frame: TrainFrame, running: int) -> dict[str, Any]:
    """Return the message's fields for the train's direction and length, and the flags for unknown properties of the
    train.
    """
    length, front = frame.length_m, frame.ends(running).front_m
    unknown = Unknown(0)
    for what, known in (
        (Unknown.FACING, running), (Unknown.FRONT_END, math.isfinite(front)), (Unknown.LENGTH, math.isfinite(length)),
    ):  # fmt: skip
        unknown |= Unknown(0) if known else what
    return {"facing": running, "length_cm": _up_cm(length) if math.isfinite(length) else 0, "unknown": unknown}


def _describe_place(place: TrainPlace, frame: TrainFrame, running: int) -> dict[str, Any]:
    """Return the message's fields for chainage, bounds and safe ends; rounding never makes the bounds narrower."""
    values: dict[str, Any] = {}
    if not math.isfinite(place.chainage_m):
        return values
    ends, front = frame.ends(running), place.chainage_m
    spread = 0.0
    if math.isfinite(ends.front_m):
        front, spread = front + running * ends.front_m, ends.spread_m
    values["chainage_cm"] = round(front * 100.0)
    if math.isfinite(place.sigma_m):
        values["sigma_cm"] = _up_cm(place.sigma_m)
    if math.isfinite(place.bound_m):
        values["over_cm"] = values["under_cm"] = _up_cm(place.bound_m + spread)
        values["protection_level_cm"] = _up_cm(place.level_m)
        for name, end_m in (("safe_front_cm", ends.foremost_m), ("safe_rear_cm", -ends.rearmost_m)):
            if running and math.isfinite(end_m):
                side = running if name == "safe_front_cm" else -running
                safe_m = side * (place.chainage_m + running * end_m) + place.bound_m
                values[name] = side * math.ceil(safe_m * 100.0)
    return values


_INTERFERENCE: Final = frozenset(SuspectedInterference)


def _find_suspicion(result: Result) -> SuspectedInterference | None:
    """Return the most severe suspicion of interference at any antenna at the last epoch; None if the check is off."""
    found = [int(a.interference.suspicion[-1]) for a in result.antennas.values() if a.interference is not None]
    return SuspectedInterference(max((k for k in found if k in _INTERFERENCE), default=0)) if found else None


def _name_sources(track: AlongTrack) -> Source:
    """Return the kinds of measurement other than codes that the filter used at the last epoch."""
    sources = Source(0)
    for kind in np.flatnonzero(track.tracked.used[-1]).tolist():
        sources |= _SOURCE_OF_KIND.get(Kind(kind), Source(0))
    if track.sensed.state[-1] in CARRIED and Source.TACHOMETER in sources:
        sources = sources & ~Source.TACHOMETER | Source.INERTIAL
    return sources


def _has_place(track: AlongTrack | None) -> TypeGuard[AlongTrack]:
    """Return whether the filter along the track has a position."""
    return track is not None and len(track) > 0 and math.isfinite(float(track.chainage_m[-1]))


def _place_and_status(antenna: AntennaResult, track: AlongTrack | None) -> tuple[float, MessageStatus]:
    """Return the chainage of an antenna [m], NaN without a position, and the status of the message."""
    place = float(antenna.chainage_m[-1])
    if not _has_place(track):
        if not math.isfinite(place):
            return place, MessageStatus.NO_POSITION
        on_map = track is None or not len(track) or track.tracked.status[-1] != TrackStatus.OFF_MAP
        good = _has_passed(antenna) and on_map
        return place, MessageStatus.POSITION if good else MessageStatus.DOUBTFUL
    filtered = float(track.chainage_m[-1])
    status = TrackStatus(int(track.tracked.status[-1]))
    if status is TrackStatus.COASTING or (status is TrackStatus.TRACKING and not math.isfinite(place)):
        return filtered, MessageStatus.COASTING
    good = status is TrackStatus.TRACKING and _has_passed(antenna)
    return filtered, MessageStatus.POSITION if good else MessageStatus.DOUBTFUL


def _has_passed(antenna: AntennaResult) -> bool:
    """Return whether the last epoch passed every check of the single-epoch solution, and raised no alarm."""
    alarm = antenna.protection is not None and antenna.protection.status[-1] == LevelStatus.ALARM
    return int(antenna.status[-1]) in (Status.OK, Status.JAMMING_SUSPECTED) and not alarm


def _level_m(antenna: AntennaResult) -> float:
    """Return the single-epoch protection level of the last epoch [m], infinite if there is none."""
    if antenna.protection is None:
        return math.inf
    level = float(antenna.protection.level.level_m[-1])
    return level if math.isfinite(level) else math.inf


def _up_cm(value_m: float) -> int:
    """Return metres as centimetres, rounded up, at least 0."""
    return max(0, math.ceil(value_m * 100.0 - 1e-9))
