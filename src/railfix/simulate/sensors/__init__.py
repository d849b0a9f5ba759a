"""Vehicle sensors besides the satellite receivers: tachometer, inertial sensor, radar."""

from railfix.simulate.sensors.settings import (
    DrawnSlips,
    Dropout,
    InertialSettings,
    RadarSettings,
    SensorSettings,
    SlipInterval,
    TachometerSettings,
)

__all__ = [
    "DrawnSlips",
    "Dropout",
    "InertialSettings",
    "RadarSettings",
    "SensorSettings",
    "SlipInterval",
    "TachometerSettings",
]
