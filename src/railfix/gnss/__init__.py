"""Observations, navigation records, signals and satellite orbits."""
