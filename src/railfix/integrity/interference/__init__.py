"""Jamming and spoofing suspected from observations, positions and the receiver's own indicators."""

from railfix.integrity.interference.limits import (
    CAUSES,
    HeldState,
    InterferenceLimits,
    PowerSigns,
    PowerState,
    Sign,
    Suspicion,
    cause_text,
    held,
    power_signs,
    suspicion,
)
from railfix.integrity.interference.motion import MotionSigns, MotionSignState, motion_signs
from railfix.integrity.interference.wheel import WheelSigns, WheelState, wheel_signs

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
    "held",
    "motion_signs",
    "power_signs",
    "suspicion",
    "wheel_signs",
]
