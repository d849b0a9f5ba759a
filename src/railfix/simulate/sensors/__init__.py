"""Vehicle sensors besides the satellite receivers: tachometer, inertial sensor, radar, ranging."""

from railfix.simulate.sensors.settings import (
    DrawnSlips,
    Dropout,
    GroundUnit,
    InertialSettings,
    RadarSettings,
    RangingSettings,
    SensorSettings,
    SlipInterval,
    TachometerSettings,
)

__all__ = [
    "DrawnSlips",
    "Dropout",
    "GroundUnit",
    "InertialSettings",
    "RadarSettings",
    "RangingSettings",
    "SensorSettings",
    "SlipInterval",
    "TachometerSettings",
]
