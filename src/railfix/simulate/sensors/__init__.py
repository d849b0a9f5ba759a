"""Vehicle sensors besides the satellite receivers: tachometer, inertial sensor, radar, ranging, balises."""

from railfix.simulate.sensors.settings import (
    Balise,
    BaliseSettings,
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
    "Balise",
    "BaliseSettings",
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
