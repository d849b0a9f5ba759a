"""Satellite orbits and clocks, broadcast and precise, as arrays over (epoch, channel)."""

from railfix.gnss.orbits.states import SatelliteStates, satellite_states

__all__ = ["SatelliteStates", "satellite_states"]
