"""Reject navigation records with an orbit that is implausible for their constellation.

A record with another satellite's orbit, with exchanged coordinates or with unrelated reference times causes range
errors of hundreds of metres to thousands of kilometres, although the record is marked healthy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Masks, Strings, take_rows
from railfix.core.constants import EARTH_ROTATION_RATE
from railfix.core.timescale import seconds
from railfix.gnss.navigation import GlonassRecords, KeplerRecords, Navigation

#: Lower and upper limits of plausible semi-major axes [m], by constellation and type of orbit; E14 and E18 have axes of
#: 27,978 km. Of 2,104 broadcast records of ten days from 2005 to 2025, one is outside the limits: a QZSS orbit under
#: the number of a GPS satellite (`tests/gnss/test_plausible_records.py`).
_AXES_M: Final[Mapping[str, tuple[tuple[float, float], ...]]] = {
    "G": ((26.2e6, 26.9e6),),
    "E": ((27.7e6, 28.3e6), (29.3e6, 29.9e6)),
    "C": ((27.5e6, 28.3e6), (41.8e6, 42.5e6)),
    "J": ((41.8e6, 42.5e6),),
}
#: Largest plausible eccentricities. The GPS limit is from IS-GPS-200 (20.3.3.4.1). E14 and E18 have 0.17, QZSS 0.075.
_ECCENTRICITIES: Final[Mapping[str, float]] = {"G": 0.05, "E": 0.2, "C": 0.05, "J": 0.12}
#: Lower and upper limit for GLONASS, both of the radius and of the semi-major axis from position and velocity [m]. The
#: GLONASS records among 2,104 broadcast records have values of 25,416 to 25,602 km.
_GLONASS_M: Final = (25.3e6, 25.7e6)
#: Largest plausible difference between toe and toc of a record; toe equals toc in 2,104 broadcast records.
LARGEST_TIME_DIFFERENCE_S: Final = 300.0
_EARTH_GM: Final = 3.986004418e14  #: Geocentric gravitational constant [m^3/s^2].
_NAMES: Final = {"G": "GPS", "E": "Galileo", "C": "BeiDou", "J": "QZSS", "R": "GLONASS"}


def plausible_navigation(navigation: Navigation) -> Navigation:
    """Return the navigation data without implausible records, which are counted and described in notes."""
    kepler, glonass = navigation.kepler, navigation.glonass
    causes = {
        "toe and toc differ by more than 5 min": (kepler, unrelated_times(kepler)),
        "the orbit does not fit this constellation": (kepler, ~plausible_kepler(kepler)),
        "radius or velocity does not fit a GLONASS orbit": (glonass, ~plausible_glonass(glonass)),
    }
    notes, skipped = list(navigation.notes), dict(navigation.skipped)
    wrong = {id(kepler): np.zeros(len(kepler), dtype=np.bool_), id(glonass): np.zeros(len(glonass), dtype=np.bool_)}
    for cause, (table, mask) in causes.items():
        fresh = mask & ~wrong[id(table)]
        wrong[id(table)] = wrong[id(table)] | mask
        notes += _notes(table.satellite[fresh], cause)
        if fresh.any():
            skipped["implausible"] = skipped.get("implausible", 0) + int(fresh.sum())
    if not any(mask.any() for mask in wrong.values()):
        return navigation
    return replace(
        navigation, kepler=take_rows(kepler, ~wrong[id(kepler)]), glonass=take_rows(glonass, ~wrong[id(glonass)]),
        notes=tuple(notes), skipped=skipped,
    )  # fmt: skip


def _notes(satellite: Strings, cause: str) -> list[str]:
    """Return one sentence on the rejected records of each constellation."""
    letters = satellite.astype("<U1")
    found = []
    for letter in np.unique(letters).tolist():
        own = satellite[letters == letter]
        names = ", ".join(np.unique(own).tolist())
        count = f"{len(own)} record{'s' * (len(own) != 1)}"
        found.append(f"navigation: {count} of {_NAMES.get(letter, letter)} rejected ({names}): {cause}")
    return found


def unrelated_times(records: KeplerRecords) -> Masks:
    """Return whether a record's toe and toc differ by more than `LARGEST_TIME_DIFFERENCE_S`, shape (n,)."""
    return np.asarray(np.abs(seconds(records.toe - records.toc)) > LARGEST_TIME_DIFFERENCE_S)


def plausible_kepler(records: KeplerRecords) -> Masks:
    """Return whether a record's semi-major axis and eccentricity fit its constellation, shape (n,)."""
    axis, letter = records.sqrt_a**2, records.satellite.astype("<U1")
    fine = np.zeros(len(records), dtype=np.bool_)
    for name, limits in _AXES_M.items():
        inside = np.logical_or.reduce([(axis >= low) & (axis <= high) for low, high in limits])
        fine |= (letter == name) & inside & (records.eccentricity <= _ECCENTRICITIES[name])
    return fine


def plausible_glonass(records: GlonassRecords) -> Masks:
    """Return whether a record's radius and semi-major axis (by the energy integral) fit a GLONASS orbit, shape (n,)."""
    position = records.position_ecef_m
    turning = EARTH_ROTATION_RATE * np.stack([-position[:, 1], position[:, 0], np.zeros(len(position))], axis=1)
    radius = np.linalg.norm(position, axis=1)
    speed = np.linalg.norm(records.velocity_ecef_mps + turning, axis=1)
    with np.errstate(divide="ignore"):
        axis = 1.0 / (2.0 / radius - speed**2 / _EARTH_GM)
    low, high = _GLONASS_M
    return np.asarray((radius >= low) & (radius <= high) & (axis >= low) & (axis <= high))


def plausible_radius(satellite: Strings, position_ecef_m: Floats) -> Masks:
    """Return whether the radius of each position (..., N, 3) fits the constellation's orbits, shape (..., N).

    Positions of constellations without limits are accepted.
    """
    radius = np.linalg.norm(position_ecef_m, axis=-1)
    fine = np.ones(radius.shape, dtype=np.bool_)
    letter = satellite.astype("<U1")
    for name, limits in _AXES_M.items():
        largest = _ECCENTRICITIES[name]
        own = letter == name
        inside = [(radius >= low * (1.0 - largest)) & (radius <= high * (1.0 + largest)) for low, high in limits]
        fine[..., own] = np.logical_or.reduce(inside)[..., own]
    own = letter == "R"
    fine[..., own] = ((radius >= _GLONASS_M[0]) & (radius <= _GLONASS_M[1]))[..., own]
    return fine
