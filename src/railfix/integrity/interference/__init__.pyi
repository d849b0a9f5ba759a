# The names of `railfix.integrity.interference`, imported at their first use (lazy-loader).

from .limits import (
    CAUSES,
    HeldState,
    InterferenceLimits,
    PowerSigns,
    PowerState,
    Sign,
    Suspicion,
    cause_text,
    hold_signs,
    power_signs,
    suspicion,
)
from .motion import MotionSigns, MotionSignState, motion_signs
from .wheel import WheelSigns, WheelState, wheel_signs

__all__ = [
    "CAUSES",
    "HeldState",
    "InterferenceLimits",
    "MotionSignState",
    "MotionSigns",
    "PowerSigns",
    "PowerState",
    "Sign",
    "Suspicion",
    "WheelSigns",
    "WheelState",
    "cause_text",
    "hold_signs",
    "motion_signs",
    "power_signs",
    "suspicion",
    "wheel_signs",
]
