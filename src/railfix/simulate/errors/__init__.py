"""Errors that a receiver cannot correct: satellites, atmosphere, clocks; the same for every receiver nearby."""

from railfix.simulate.errors.settings import (
    ClockWalkSettings,
    ErrorSettings,
    InterSystemSettings,
    IonosphereErrorSettings,
    SatelliteErrorSettings,
    SatelliteFault,
    TroposphereErrorSettings,
)

__all__ = [
    "ClockWalkSettings",
    "ErrorSettings",
    "InterSystemSettings",
    "IonosphereErrorSettings",
    "SatelliteErrorSettings",
    "SatelliteFault",
    "TroposphereErrorSettings",
]
