"""Balises read, as places of the filter: from the list along the line to arc lengths of an antenna's path."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.motion.samples import BaliseReadings, ListedBalises
from railfix.track.trajectory import Trajectory
from railfix.tracking import BaliseEpochs

#: An identity read again within this time is the same passing [s]: a second balise of a group, or a train that stands.
AGAIN_S: Final = 60.0


class BaliseLimits(Settings):
    """Reader of balises on the vehicle."""

    ahead_m: float = 0.0  #: Place of the reader ahead of the vehicle's middle, without a vehicle file of the antenna.
    #: Least standard deviation of a reading along the line: SUBSET-036 has 1 m for the vital use of a balise's place.
    sigma_m: float = Field(default=1.0, gt=0)
    contradiction_sigmas: float = Field(default=5.0, gt=0)  #: A balise further than this from the filter is wrong.


@dataclass(frozen=True, kw_only=True)
class BaliseState:
    """Last balise read before a chunk."""

    balise: str = ""  #: Identity; blank before the first.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    turn: int = 1  #: Column of `railfix.tracking.BaliseEpochs` that it was in.


def arcs_of_balises(listed: ListedBalises, trajectory: Trajectory, limits: BaliseLimits) -> Floats:
    """Return arc lengths of the antenna at which the reader is over each balise, shape (M,) [m]; NaN off the path."""
    reader = listed.chainage_m - trajectory.front_sign * limits.ahead_m
    along = trajectory.chainage_m if trajectory.body_chainage_m is None else trajectory.body_chainage_m
    return np.interp(reader, along, trajectory.arc_m, left=np.nan, right=np.nan)


def balise_epochs(
    readings: BaliseReadings,
    edges: Datetimes,
    listed: ListedBalises,
    trajectory: Trajectory,
    state: BaliseState,
    limits: BaliseLimits,
) -> tuple[BaliseEpochs, BaliseState]:
    """Return the balises at the epoch after each reading, and the state to pass on.

    Balises that are not listed are left out, and so is an identity read again within `AGAIN_S`. Balises take turns in
    two columns: a sub-filter of the level without one of them is right whichever single balise is wrong.

    Parameters
    ----------
    edges : ndarray of datetime64[ns], shape (T + 1,)
        Epoch before the chunk, and its epochs.
    trajectory : Trajectory
        Of the antenna.
    """
    found = BaliseEpochs.none(len(edges) - 1)
    index, arc = listed.index_of(readings.balise), arcs_of_balises(listed, trajectory, limits)
    epoch = np.searchsorted(edges, readings.time, side="left") - 1
    known = (index >= 0) & (epoch >= 0) & (epoch < len(edges) - 1)
    known[known] = np.isfinite(arc[index[known]])
    for k in np.flatnonzero(known):  # a few balises
        balise, time = str(readings.balise[k]), readings.time[k]
        if balise == state.balise and seconds(time - state.time) < AGAIN_S:
            continue
        state = BaliseState(balise=balise, time=time, turn=1 - state.turn)
        at = (epoch[k], state.turn)
        own = max(float(np.nan_to_num(readings.sigma_m[k])), limits.sigma_m)
        found.time[at], found.place_m[at] = time, arc[index[k]]
        found.sigma_m[at] = np.hypot(own, listed.sigma_m[index[k]])
    return found, state
