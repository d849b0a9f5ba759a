"""Prior probabilities of tracks at start-up: the interlocking, and the last place with cold-movement detection.

A train that was on a known track when it was switched off, and has not moved since, is still there: a
cold-movement detector or the odometer tells how far it has moved, and misses a move with a probability.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import networkx as nx
import numpy as np

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import read_json_object, write_whole
from railfix.positioning.which_track import NONE, TrackPosterior
from railfix.track.network import Network

#: A train that has moved less stands on the same track [m]: creep of wheels, slack of couplings.
_SAME_PLACE_M: Final = 1.0
#: What the distance moved may be wrong by: share, and constant part [m].
_ODOMETER_SHARE: Final = 0.05
_ODOMETER_M: Final = 10.0
#: Least probability of a track that the map does not have.
_LEAST_UNMAPPED: Final = 1e-9


@dataclass(frozen=True, kw_only=True)
class TrackPrior:
    """Weights of mapped tracks by name, those not named have none; and probability of one that the map lacks."""

    weights: Mapping[str, float]
    unmapped: float


def write_last_place(posterior: TrackPosterior, time: np.datetime64, path: Path) -> None:
    """Write the probabilities of all tracks, as the prior of the next start-up; OutputError where it cannot."""
    shares = dict(zip(posterior.names, posterior.probability.tolist(), strict=True))
    write_whole(path, json.dumps({"time_gpst": str(time), "probability": shares}, indent=2) + "\n")


def prior_of_last_place(
    path: Path, network: Network, *, moved_m: float, missed_move: float, unmapped: float
) -> TrackPrior:
    """Prior of tracks from the last place (`write_last_place`) and the distance moved since [m].

    `missed_move` is the probability that the train was moved unnoticed, anywhere; `unmapped` the prior of a track that
    the map lacks, for a train that was moved. InputFileError: the file is not a last place on this network.
    """
    record = read_json_object(path, what="the last place of a train")
    stated = record.get("probability")
    stated = stated if isinstance(stated, dict) else {}
    if not stated or not all(isinstance(v, int | float) and 0.0 <= v <= 1.0 for v in stated.values()):
        raise InputFileError(path, "has no probability of each track; railfix which-track --save-last writes it")
    shares = {str(name): float(value) for name, value in stated.items()}
    off_map = shares.pop(NONE, 0.0)
    missing = [name for name in shares if name not in network.names]
    if missing or abs(sum(shares.values()) + off_map - 1.0) > 1e-6:
        fault = f"track {missing[0]!r} is not in the map" if missing else "its probabilities do not add up to 1"
        raise InputFileError(path, f"{fault}; give the last place on the tracks of this map")
    weights = dict.fromkeys(network.names, 0.0)
    for name, share in shares.items():
        if share > 0.0:
            within = 0.0 if moved_m <= _SAME_PLACE_M else moved_m * (1.0 + _ODOMETER_SHARE) + _ODOMETER_M
            reached = [name] if within == 0.0 else _find_reachable(network, network.names.index(name), within)
            for other in reached:
                weights[other] += share / len(reached)
    total, count = sum(weights.values()), len(weights)
    weights = {name: (1.0 - missed_move) * value + missed_move * total / count for name, value in weights.items()}
    off_map = (1.0 - missed_move) * off_map + missed_move * unmapped
    return TrackPrior(weights=weights, unmapped=max(off_map, _LEAST_UNMAPPED))


def _find_reachable(network: Network, track: int, within_m: float) -> list[str]:
    """Tracks that a train from anywhere on a track can stand on after a distance, turns included."""
    ends: nx.Graph[int] = nx.Graph()
    for k, length in enumerate(network.length_m.tolist()):
        ends.add_edge(2 * k, 2 * k + 1, weight=length)
    for link in network.links:
        if link.navigable:
            ends.add_edge(2 * link.first + link.first_end, 2 * link.second + link.second_end, weight=0.0)
    near = nx.multi_source_dijkstra_path_length(ends, {2 * track, 2 * track + 1}, cutoff=within_m)
    return [network.names[k] for k in sorted({node // 2 for node in near})]


def prior_of_interlocking(text: str, network: Network) -> dict[str, float]:
    """Weights of the tracks that the interlocking states, of ``NAME=WEIGHT,...``.

    SettingsError: it is not such a text, or names a track that the map lacks.
    """
    weights = {}
    for pair in text.split(","):
        name, equals, value = pair.rpartition("=")
        number = network.index_of(name.strip()) if equals else -1
        try:
            weight = float(value)
        except ValueError:
            weight = np.nan
        if number < 0 or not 0.0 <= weight < np.inf:
            raise SettingsError(f"--prior {pair!r}: expected NAME=WEIGHT, not negative")
        weights[network.names[number]] = weight
    if not sum(weights.values()) > 0.0:
        raise SettingsError(f"--prior {text!r}: all weights are 0")
    return weights
