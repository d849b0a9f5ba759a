"""Position messages from results of single epochs."""

from __future__ import annotations

import math
from typing import TypeGuard

import numpy as np

from railfix.core.reasons import Status
from railfix.core.timescale import GPS_EPOCH
from railfix.integrity.protection import LevelStatus
from railfix.io.train_message import MessageStatus, Source, SuspectedInterference, TrainMessage
from railfix.live.settings import LiveSettings
from railfix.pipeline.filter_result import AlongTrack
from railfix.pipeline.results import AntennaResult, Result
from railfix.pipeline.sensed_motion import CARRIED
from railfix.tracking import Kind, TrackStatus

#: Sigmas that the speed's bound stands for: 1e-7 two-sided, as the protection level's starting point (P1 2.4).
_SPEED_K = 5.33
_BOUNDS = ("over_cm", "under_cm", "protection_level_cm")
_SOURCE_OF_KIND = {
    Kind.PHASE: Source.CARRIER_PHASE, Kind.DOPPLER: Source.DOPPLER, Kind.WHEEL: Source.TACHOMETER,
    Kind.RADAR: Source.RADAR, Kind.FORCE: Source.INERTIAL, Kind.PLACE: Source.FEATURES, Kind.RANGE: Source.RANGING,
    Kind.BALISE: Source.BALISES, Kind.NEXT_BALISE: Source.BALISES,
}  # fmt: skip
_SOURCE_OF_ANTENNA = {"front": Source.FRONT_RECEIVER, "rear": Source.REAR_RECEIVER}


def no_input_message(settings: LiveSettings, time_ns: int) -> TrainMessage:
    """Return the message of a period in which nothing was received; the sender numbers it."""
    return TrainMessage(
        train=settings.train,
        sequence=0,
        time_ns=time_ns,
        sent_ns=time_ns,
        line=settings.line,
        facing=settings.facing,
        length_cm=_up_cm(settings.length_m),
        status=MessageStatus.NO_INPUT,
    )


def create_message(result: Result, settings: LiveSettings) -> TrainMessage:
    """Return the message of one processed epoch; the sender numbers it.

    The place is that of the filter along the track where it runs, else that of the single epoch, of the antenna that
    `choose_antenna` names. The bounds are the filter's over- and under-reading amounts where it has a level
    (`tracking.level`); else the protection level of the single epoch, widened by the distance of the filter's place
    from it, so that they hold for both. A doubtful place has none.
    """
    name = choose_antenna(result)
    antenna = result.antennas[name]
    track = result.fusion.get(name)
    sources = Source(0)
    for used, other in result.antennas.items():
        if other.n_used[-1] > 0:
            sources |= _SOURCE_OF_ANTENNA.get(used, Source(0))
    place, status = _place_and_status(antenna, track)
    sigma_m = float(antenna.along_sigma_m[-1] if not _has_place(track) else track.tracked.sigma_m[-1])
    values: dict[str, object] = {}
    level = _level_m(antenna)
    single = float(antenna.chainage_m[-1])
    amount = math.nan if track is None or not len(track) else float(track.tracked.amount_m[-1])
    if math.isfinite(place):
        front = place + settings.facing * settings.front_offset_m
        values["chainage_cm"] = round(front * 100.0)
        if math.isfinite(sigma_m):
            values["sigma_cm"] = _up_cm(sigma_m)
        bound = level + abs(place - single) + 0.01 if math.isfinite(single) else math.inf
        if math.isfinite(amount):  # the filter has a level of its own
            bound, level = amount + 0.01, float(track.tracked.level_m[-1]) if track is not None else level
        if math.isfinite(bound):
            values["over_cm"] = values["under_cm"] = _up_cm(bound)
            values["protection_level_cm"] = _up_cm(level)
        elif status is MessageStatus.POSITION:
            status = MessageStatus.DOUBTFUL
    # The bound of a position that failed a check is none for the place that the sensors carry.
    if status is MessageStatus.COASTING and not (
        "over_cm" in values and (math.isfinite(amount) or _has_passed(antenna))
    ):
        status = MessageStatus.DOUBTFUL
    if status is MessageStatus.DOUBTFUL:  # no bound is promised, so none is sent
        values = {key: value for key, value in values.items() if key not in _BOUNDS}
    if track is not None and len(track):
        speed, sigma = float(track.tracked.speed_mps[-1]), float(track.tracked.speed_sigma_mps[-1])
        if math.isfinite(speed):
            values["speed_cmps"], values["speed_bound_cmps"] = round(speed * 100.0), _up_cm(_SPEED_K * sigma)
        values["direction"], values["standstill"] = int(track.direction[-1]), bool(track.standstill[-1])
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
        facing=settings.facing,
        length_cm=_up_cm(settings.length_m),
        status=status,
        sources=sources,
        interference=_find_suspicion(result),
        **values,  # type: ignore[arg-type]
    )


def _find_suspicion(result: Result) -> SuspectedInterference | None:
    """Return the worst interference of the antennas at the last epoch; None where it is not looked for."""
    found = [int(a.interference.suspicion[-1]) for a in result.antennas.values() if a.interference is not None]
    return SuspectedInterference(max(found)) if found else None


def _name_sources(track: AlongTrack) -> Source:
    """Return what the filter measured the last epoch with, beside codes."""
    sources = Source(0)
    for kind in np.flatnonzero(track.tracked.used[-1]).tolist():
        sources |= _SOURCE_OF_KIND.get(Kind(kind), Source(0))
    if track.sensed.state[-1] in CARRIED and Source.TACHOMETER in sources:
        sources = sources & ~Source.TACHOMETER | Source.INERTIAL
    return sources


def choose_antenna(result: Result) -> str:
    """Return the antenna to report: one that has a place, of two the one with the smaller protection level."""

    def worth(name: str) -> tuple[bool, float]:
        antenna, track = result.antennas[name], result.fusion.get(name)
        if not _has_place(track):
            return not math.isfinite(float(antenna.chainage_m[-1])), _level_m(antenna)
        level = float(track.tracked.level_m[-1])
        return False, level if math.isfinite(level) else _level_m(antenna)

    return min(result.antennas, key=worth)


def _has_place(track: AlongTrack | None) -> TypeGuard[AlongTrack]:
    """Return whether the filter along the track has a place."""
    return track is not None and len(track) > 0 and math.isfinite(float(track.chainage_m[-1]))


def _place_and_status(antenna: AntennaResult, track: AlongTrack | None) -> tuple[float, MessageStatus]:
    """Place [m], NaN without one, and what it is worth."""
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
    """Return whether the last single epoch passed every check and raises no alarm."""
    alarm = antenna.protection is not None and antenna.protection.status[-1] == LevelStatus.ALARM
    return int(antenna.status[-1]) in (Status.OK, Status.JAMMING_SUSPECTED) and not alarm


def _level_m(antenna: AntennaResult) -> float:
    """Return the protection level of the last epoch; infinite where there is none."""
    if antenna.protection is None:
        return math.inf
    level = float(antenna.protection.level.level_m[-1])
    return level if math.isfinite(level) else math.inf


def _up_cm(value_m: float) -> int:
    """Return metres as centimetres, rounded up."""
    return max(0, math.ceil(value_m * 100.0 - 1e-9))
