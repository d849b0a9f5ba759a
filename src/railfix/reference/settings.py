"""Settings of a reference: limits of the fixes, noise of the sensors."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from railfix.core.settings import Settings, option
from railfix.positioning.doppler_speed import DopplerSpeedLimits


def _positive(default: float) -> Any:
    return Field(default, gt=0.0, allow_inf_nan=False)


def _limit(text: str, default: float | None, metavar: str, name: str) -> Any:
    return option(text, default, name=name, metavar=metavar, panel="Limits", gt=0.0, allow_inf_nan=False)


class ReferenceSettings(Settings):
    """Limits and noise; all of them are recorded in ``reference.json``."""

    #: Least ratio of the ambiguity test of a fix, where the log has one (RTKLIB's own default is 3).
    ratio: float = _limit("Least ratio of the ambiguity test, where the log has one.", 3.0, "RATIO", "--ratio")
    #: Largest difference between the distance of the two antennas' positions and that on the vehicle (P2 3.3: 5 cm).
    spacing_m: float = _limit(
        "Largest difference of the antennas' distance from that on the vehicle.", 0.05, "M", "--spacing"
    )
    #: Whether a fix is rejected if the other antenna has none at that time, where two logs are given.
    unpaired: Literal["reject", "keep"] = "reject"
    #: Largest distance from the antenna's trajectory; about three standard deviations of the map (P1 4.1(3)).
    lateral_m: float = _limit("Largest distance beside the antenna's trajectory.", 1.0, "M", "--lateral")
    height_m: float = _limit("Largest distance above or below it.", 2.0, "M", "--height")
    #: Largest difference between the distance of two fixes and the distance travelled (P2 3.3): constant part, and
    #: share of the distance [m] [-].
    travel_m: float = _positive(0.10)
    travel_share: float = _positive(0.005)
    #: Fixes that disagree with those before and after are rejected up to twice this long; if they disagree for longer,
    #: the distance travelled is taken to be wrong.
    travel_hold_s: float = _positive(10.0)
    #: Largest speed of a train: of several passes of the line at one place only those within reach are considered.
    max_speed_mps: float = _positive(100.0)
    #: Longer gaps between good fixes are not bridged.
    max_gap_s: float = _limit("Longest gap between good fixes that is bridged.", 60.0, "S", "--max-gap")
    #: Bridged instants of larger standard deviation are left out.
    max_sigma_m: float = _limit("Largest standard deviation of a bridged instant.", 1.0, "M", "--max-sigma")
    #: Standard deviation of a fix along the track where the log has none; and the least one that is used.
    fix_sigma_m: float = _positive(0.03)
    fix_floor_m: float = _positive(0.01)
    #: Standard deviation and correlation time of the train's acceleration (R. A. Singer, 1970): trains accelerate and
    #: brake by 0.5 to 1 m/s2 for some seconds [m/s2] [s].
    motion_mps2: float = _positive(0.5)
    motion_s: float = _positive(5.0)

    doppler: DopplerSpeedLimits = Field(default_factory=DopplerSpeedLimits)
    #: Standard deviation and correlation time of the time-correlated error of the Doppler speed. The standard deviation
    #: is estimated from the log's own fixes where there are enough of them; this one is used elsewhere [m/s] [s].
    doppler_bias_mps: float = _positive(0.02)
    doppler_bias_s: float = _positive(10.0)
    #: Distance of one pulse of the tachometer: wheel circumference over pulses per turn. None: from the fixes.
    pulse_m: float | None = _limit(
        "Distance of one tachometer pulse (circumference over pulses per turn); estimated from the fixes without it.",
        None,
        "M",
        "--pulse",
    )
    wheel_scale: float = _positive(0.01)  #: Standard deviation of that distance, relative.
    slip_m: float = _positive(0.005)  #: Random error of the wheel's distance [m per square root of m].
    #: Noise of the accelerometer, and standard deviation of its offset [m/s2 per square root of Hz] [m/s2].
    acceleration_mps2: float = _positive(0.02)
    acceleration_bias_mps2: float = _positive(0.05)
