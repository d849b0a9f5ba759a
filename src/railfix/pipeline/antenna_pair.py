"""Two antennas of one vehicle: which epochs belong together, where the antennas are against each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.reasons import Reason
from railfix.pipeline.corrected_ranges import CorrectedRanges
from railfix.screens import (
    AntennaPairLimits,
    Screened,
    antenna_pair_screen,
    on_channels,
    pair_channels,
    pair_epochs,
    spacing_direction,
)
from railfix.track.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Spacing:
    """The two antennas of one vehicle at P instants.

    Attributes
    ----------
    front_ecef_m, rear_ecef_m : ndarray, shape (P, 3) [m]
        NaN where the vehicle's place is unknown or there is no vehicle.
    along_m : ndarray, shape (P,) [m]
        Chainage of the front antenna less that of the rear one: negative where the vehicle's front
        looks to falling chainage.
    """

    front_ecef_m: Floats
    rear_ecef_m: Floats
    along_m: Floats


def spacing_at(front: Trajectory, rear: Trajectory, front_arc_m: Floats) -> Spacing:
    """Both antennas where the front one is at arcs of its path, shape (P,).

    Parameters
    ----------
    front, rear : Trajectory
        Of one vehicle on one track (`vehicle.antenna_trajectory`).
    front_arc_m : ndarray, shape (P,) [m]
        NaN where unknown.

    Returns
    -------
    Spacing
    """
    rear_arc = rear.arc_of_body(front.body_at(front_arc_m))
    return Spacing(
        front_ecef_m=front.at_arc(front_arc_m),
        rear_ecef_m=rear.at_arc(rear_arc),
        along_m=front.chainage_at(front_arc_m) - rear.chainage_at(rear_arc),
    )


@dataclass(frozen=True, kw_only=True)
class AntennaPair:
    """Common epochs of two antennas, P of them.

    Attributes
    ----------
    front_epoch, rear_epoch : ndarray of int, shape (P,)
        Epochs of each antenna that belong together.
    spacing : Spacing
        At the approximate place of the front antenna.
    """

    front_epoch: Indices
    rear_epoch: Indices
    spacing: Spacing


def pair_antennas(
    front: CorrectedRanges,
    rear: CorrectedRanges,
    front_path: Trajectory,
    rear_path: Trajectory,
    *,
    tolerance_s: float,
) -> AntennaPair:
    """Return the epochs of two antennas matched by their time tags.

    Parameters
    ----------
    front, rear : CorrectedRanges
    front_path, rear_path : Trajectory
    tolerance_s : float [s]
        Largest difference of the tags.
    """
    at_front, at_rear = pair_epochs(front.time, rear.time, tolerance_s=tolerance_s)
    arc, _ = front_path.nearest(front.anchor_ecef_m[at_front])
    return AntennaPair(front_epoch=at_front, rear_epoch=at_rear, spacing=spacing_at(front_path, rear_path, arc))


def antenna_pair_screened(
    pair: AntennaPair, ranges: Mapping[str, CorrectedRanges], limits: AntennaPairLimits
) -> dict[str, CorrectedRanges]:
    """Return the ranges of two antennas after the comparison of their codes: misfits weighted down or rejected on both.

    Parameters
    ----------
    pair : AntennaPair
    ranges : mapping of str to CorrectedRanges
        "front" and "rear".
    limits : AntennaPairLimits
    """
    front, rear = ranges["front"], ranges["rear"]
    at_front, at_rear = pair.front_epoch, pair.rear_epoch
    ours, theirs = pair_channels(front.satellite, front.signal, rear.satellite, rear.signal)
    heading, gradient, length = spacing_direction(pair.spacing.front_ecef_m, pair.spacing.rear_ecef_m)
    here = np.ix_(at_front, ours)
    verdict = antenna_pair_screen(
        front.corrected_code_m[here],
        rear.corrected_code_m[np.ix_(at_rear, theirs)],
        front.elevation_deg[here],
        front.azimuth_deg[here],
        satellite=front.satellite[ours],
        heading_deg=heading,
        gradient_permille=gradient,
        spacing_m=length,
        tag_difference=rear.time[at_rear] - front.time[at_front],
        range_rate_mps=-SPEED_OF_LIGHT / front.frequency_hz[ours] * front.doppler_hz[here],
        limits=limits,
    )
    screened = dict(ranges)
    for name, epochs, channels in (("front", at_front, ours), ("rear", at_rear, theirs)):
        antenna = ranges[name]
        metric = np.full(antenna.reason.shape, np.nan)
        metric[np.ix_(epochs, channels)] = verdict.metric
        reject = on_channels(verdict.reject, antenna.reason.shape, epochs, channels)
        result = Screened(metric=metric, reject=reject)
        if limits.verdict == "reject":
            screened[name] = antenna.screened("antenna_pair", result, Reason.ANTENNA_PAIR)
        else:
            screened[name] = antenna.suspected("antenna_pair", result, metric)
    return screened
