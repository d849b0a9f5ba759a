"""Keep the state of each channel from chunk to chunk, also through chunks in which the channel is absent.

A chunk (consecutive epochs that are processed together) has only the channels that were observed in it. A live epoch,
for example, may lack a satellite that the previous and the next epoch have. A processing stage that keeps a state per
channel therefore processes the channels of both the chunk and the state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Indices, Masks, Strings

Value = TypeVar("Value", bound=np.generic)


@dataclass(frozen=True, kw_only=True)
class JoinedChannels:
    """Channels of a chunk, followed by the channels that occur only in states; U in total."""

    channel: Strings  #: Names of the channels, shape (U,).
    present: int  #: Number of channels of the chunk; they come first in `channel`.
    #: For each state, the index of each channel in that state, shape (U,); -1 if the state lacks the channel.
    places: tuple[Indices, ...]

    def arrange(self, values: NDArray[Value], fill: Any, state: int = 0) -> NDArray[Value]:
        """Arrange a state's values (channels on the last axis) for all U channels; `fill` where the state has none."""
        place = self.places[state]
        known = place >= 0
        out: NDArray[Value] = np.full((*values.shape[:-1], len(place)), fill, dtype=values.dtype)
        out[..., known] = values[..., place[known]]
        return out

    def widen(self, values: NDArray[Value], fill: Any) -> NDArray[Value]:
        """Extend values of the chunk, shape (T, K), to all channels, shape (T, U), with `fill` in the added columns."""
        if values.shape[1] == len(self.channel):
            return values
        out: NDArray[Value] = np.full((len(values), len(self.channel)), fill, dtype=values.dtype)
        out[:, : self.present] = values
        return out


def join_channels(channel: Strings, states: Sequence[Strings], kept: Sequence[Masks | None] = ()) -> JoinedChannels:
    """Return the union of the channels of a chunk and of states.

    `kept` has, for each state, a mask of the channels that are recent enough. A state whose mask is None or not given
    keeps all channels.
    """
    names = channel.tolist()
    place = {name: k for k, name in enumerate(names)}
    places: list[list[int]] = []
    for k, state in enumerate(states):
        mask = kept[k] if k < len(kept) else None
        young = None if mask is None else mask.tolist()
        own = [-1] * len(place)
        for row, name in enumerate(state.tolist()):
            if young is not None and not young[row]:
                continue
            at = place.setdefault(name, len(place))
            if at == len(own):
                own.append(row)
            else:
                own[at] = row
        places.append(own)
    everything = channel if len(place) == len(names) else np.array(list(place), dtype=np.str_)
    rows = tuple(np.array(own + [-1] * (len(place) - len(own)), dtype=np.intp) for own in places)
    return JoinedChannels(channel=everything, present=len(names), places=rows)
