"""Observations, navigation records, signals and satellite orbits."""

from railfix.gnss.joined_observations import concatenate
from railfix.gnss.navigation import GlonassRecords, KeplerRecords, Navigation, PreciseEphemeris
from railfix.gnss.observations import ObservationHeader, Observations, carrier_frequency_hz

__all__ = [
    "GlonassRecords",
    "KeplerRecords",
    "Navigation",
    "ObservationHeader",
    "Observations",
    "PreciseEphemeris",
    "carrier_frequency_hz",
    "concatenate",
]
