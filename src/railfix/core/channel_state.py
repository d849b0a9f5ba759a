"""State per channel across chunks, stored by channel key and age, independent of the channels of a chunk.

A chunk has the channels that were observed in it: a live epoch may lack a satellite that the previous and the next
epoch have. A stage with a state per channel operates on the channels of the chunk and of its state.
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
    """Channels of the chunk, then channels of the states that the chunk lacks; U in total."""

    channel: Strings  #: Shape (U,).
    present: int  #: Number of channels of the chunk, which come first.
    #: Index of each channel in each state, -1 where the state does not have it; shape (U,) each.
    places: tuple[Indices, ...]

    def arrange(self, values: NDArray[Value], fill: Any, state: int = 0) -> NDArray[Value]:
        """Return values of a state, channels on the last axis, for all channels: `fill` for channels that it lacks."""
        place = self.places[state]
        known = place >= 0
        out: NDArray[Value] = np.full((*values.shape[:-1], len(place)), fill, dtype=values.dtype)
        out[..., known] = values[..., place[known]]
        return out

    def widen(self, values: NDArray[Value], fill: Any) -> NDArray[Value]:
        """Return values of the chunk, shape (T, K), for all channels, shape (T, U): `fill` where it lacks a channel."""
        if values.shape[1] == len(self.channel):
            return values
        out: NDArray[Value] = np.full((len(values), len(self.channel)), fill, dtype=values.dtype)
        out[:, : self.present] = values
        return out


def join_channels(channel: Strings, states: Sequence[Strings], kept: Sequence[Masks | None] = ()) -> JoinedChannels:
    """Return the channels of a chunk and of states together.

    `kept` marks the channels of each state that are recent enough; None, or nothing, keeps all.
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
