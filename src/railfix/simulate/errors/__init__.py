"""Errors that broadcast models do not correct: satellites, atmosphere, receiver clocks, noise."""

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
