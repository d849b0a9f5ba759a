"""What a reference is made with: limits of the fixes, noises of the sensors."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from railfix.core.errors import SettingsError
from railfix.positioning.doppler_speed import DopplerSpeedLimits


@dataclass(frozen=True, kw_only=True)
class ReferenceSettings:
    """Limits and noises; every one of them is in ``reference.json``.

    Attributes
    ----------
    ratio : float
        Ratio of the ambiguities' test that a fix needs, where the log tells it (RTKLIB's own default is 3).
    spacing_m : float [m]
        Distance of the two antennas' positions against the body's (P2 3.3: 5 cm).
    unpaired : {"refuse", "keep"}
        What becomes of a fix whose other antenna has none at the instant, where two logs are given.
    lateral_m, height_m : float [m]
        Distance to the antenna's trajectory; about three standard deviations of the map (P1 4.1(3)).
    travel_m, travel_share : float [m], [-]
        Distance between two fixes against the distance travelled (P2 3.3): constant part, and share of it.
    travel_hold_s : float [s]
        Fixes that disagree with those before and after are held wrong up to twice this long; longer, the
        distance travelled is.
    max_speed_mps : float [m/s]
        No train runs faster: of several passes of the line at one place only those within reach count.
    max_gap_s : float [s]
        Longer gaps between good fixes are not bridged.
    max_sigma_m : float [m]
        Bridged instants that are less certain are left out.
    fix_sigma_m, fix_floor_m : float [m]
        Standard deviation of a fix along the track where the log has none; and the least that is believed.
    motion_mps2, motion_s : float [m/s2], [s]
        Standard deviation of the train's acceleration, and how long one lasts (R. A. Singer, 1970): trains
        accelerate and brake by 0.5 to 1 m/s2 for some seconds.
    doppler : DopplerSpeedLimits
    doppler_bias_mps, doppler_bias_s : float [m/s], [s]
        Part of the Doppler speed's error that lasts, with its time of correlation. The size is taken from the
        log's own fixes where they are many enough; this one stands where they are not.
    pulse_m : float or None [m]
        Distance of one pulse of the tachometer: circumference of the wheel over pulses a turn. None: from the fixes.
    wheel_scale : float
        Standard deviation of that distance, as a share.
    slip_m : float [m per square root of m]
        Random error of the wheel's distance.
    acceleration_mps2, acceleration_bias_mps2 : float [m/s2 per square root of Hz], [m/s2]
        Noise of the accelerometer, and standard deviation of its offset.
    """

    ratio: float = 3.0
    spacing_m: float = 0.05
    unpaired: Literal["refuse", "keep"] = "refuse"
    lateral_m: float = 1.0
    height_m: float = 2.0
    travel_m: float = 0.10
    travel_share: float = 0.005
    travel_hold_s: float = 10.0
    max_speed_mps: float = 100.0
    max_gap_s: float = 60.0
    max_sigma_m: float = 1.0
    fix_sigma_m: float = 0.03
    fix_floor_m: float = 0.01
    motion_mps2: float = 0.5
    motion_s: float = 5.0
    doppler: DopplerSpeedLimits = field(default_factory=DopplerSpeedLimits)
    doppler_bias_mps: float = 0.02
    doppler_bias_s: float = 10.0
    pulse_m: float | None = None
    wheel_scale: float = 0.01
    slip_m: float = 0.005
    acceleration_mps2: float = 0.02
    acceleration_bias_mps2: float = 0.05

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, float) and not value > 0.0:
                raise SettingsError(f"reference: {item.name} is {value:g}; a positive number was expected")
        if self.unpaired not in ("refuse", "keep"):
            raise SettingsError(f"reference: unpaired is {self.unpaired!r}; 'refuse' or 'keep' was expected")

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)
