"""A made run with noise alone and the demonstration, pieces of them, and results laid out flat for comparison."""

from __future__ import annotations

import atexit
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import polars as pl

from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.processor_state import State
from railfix.pipeline.results import AntennaResult
from railfix.simulate import Scenario, write_run
from railfix.simulate.demonstration import demo_files
from railfix.track import read_track
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle

ANTENNAS = ("front", "rear")


@cache
def clean_files() -> dict[str, Path]:
    """The default scenario as files: the demonstration's line, train and sky, and no error but white noise."""
    folder = mkdtemp(prefix="railfix-clean-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return write_run(Scenario(), folder)


@cache
def clean_observations() -> dict[str, Observations]:
    return {name: read_observations(clean_files()[name]) for name in ANTENNAS}


@cache
def demo_observations() -> dict[str, Observations]:
    return {name: read_observations(demo_files()[name]) for name in ANTENNAS}


@cache
def clean_navigation() -> Navigation:
    return read_navigation(clean_files()["nav"])


@cache
def clean_trajectories() -> dict[str, Trajectory]:
    track, vehicle = read_track(clean_files()["track"]), read_vehicle(clean_files()["vehicle"])
    return {name: antenna_trajectory(track, vehicle, name) for name in ANTENNAS}


@cache
def clean_truth() -> pl.DataFrame:
    return pl.read_csv(clean_files()["truth"], schema_overrides={"time_gpst": pl.Datetime("ns")})


def true_chainage(antenna: str) -> np.ndarray:
    return clean_truth().filter(pl.col("antenna") == antenna)["chainage_m"].to_numpy()


def processor(
    settings: Mapping[str, Any] | None = None,
    *,
    navigation: Navigation | None = None,
    trajectories: Mapping[str, Trajectory] | None = None,
) -> EpochProcessor:
    """Single epochs, which most tests are about; the filter along the track where they ask for it."""
    config: Config = parse_config({"filter": "off", **(settings or {})})
    return EpochProcessor(config, trajectories or clean_trajectories(), navigation=navigation or clean_navigation())


def front_alone(observations: Observations, settings: Mapping[str, Any] | None = None, **kwargs: Any) -> AntennaResult:
    result, _ = processor(settings, **kwargs).process({"front": observations})
    return result.antennas["front"]


def channel(observations: Observations, satellite: str, signal: str | None = None) -> int:
    found = observations.satellite == satellite
    return int(np.flatnonzero(found if signal is None else found & (observations.signal == signal))[0])


def with_code(observations: Observations, change: np.ndarray) -> Observations:
    """Codes with something added, shape that broadcasts to (T, M); NaN takes an observation away."""
    return replace(observations, code_m=observations.code_m + change)


def only(observations: Observations, satellites: list[str]) -> Observations:
    return with_code(observations, np.where(np.isin(observations.satellite, satellites), 0.0, np.nan))


def cut(parts: Mapping[str, Observations], edges: list[int]) -> Iterator[dict[str, Observations]]:
    length = max(len(p) for p in parts.values())
    for a, b in zip([0, *edges], [*edges, length], strict=True):
        yield {name: part[a:b] for name, part in parts.items()}


def in_pieces(
    one: EpochProcessor, parts: Mapping[str, Observations], edges: list[int]
) -> tuple[dict[str, dict[str, np.ndarray]], State]:
    """Flat results of a log cut at `edges`, put together again."""
    state: State | None = None
    found: dict[str, list[dict[str, np.ndarray]]] = {name: [] for name in parts}
    for piece in cut(parts, edges):
        result, state = one.process(piece, state)
        for name, antenna in result.antennas.items():
            found[name].append(flat(antenna))
    assert state is not None
    return {
        name: {k: np.concatenate([p[k] for p in pieces]) for k in pieces[0]} for name, pieces in found.items()
    }, state


#: What belongs to the channels of a log, the line or the settings, not to its epochs.
NO_EPOCHS = {
    "satellite", "signal", "columns", "kind", "basis", "channels", "frequency_hz", "observations", "trajectory",
    "geodetic",
}  # fmt: skip


def members(value: Any) -> dict[str, Any]:
    """Fields of a dataclass; of a result also what tables show of it."""
    names = [item.name for item in fields(value)]
    if isinstance(value, AntennaResult):
        shown = [(n, v) for kind in type(value).__mro__ for n, v in vars(kind).items() if not n.startswith("_")]
        names += [name for name, item in shown if isinstance(item, property | cached_property)]
    return {name: getattr(value, name) for name in names}


def flat(value: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Every array of a result that has epochs on its first axis, by its dotted name."""
    found: dict[str, np.ndarray] = {}
    items = (value if isinstance(value, Mapping) else members(value)).items()
    for name, inner in items:
        if name in NO_EPOCHS or inner is None or isinstance(inner, float):
            continue
        if isinstance(inner, np.ndarray):
            found[prefix + name] = inner
        elif is_dataclass(inner) or isinstance(inner, Mapping):
            found |= flat(inner, f"{prefix}{name}.")
        else:
            raise TypeError(f"{prefix}{name} of {type(inner)} is neither an array nor made of arrays")
    return found


def same(one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray], *, atol: float) -> None:
    """Equal bit for bit, or numbers that differ by no more than `atol` (metres) or one in 1e10."""
    assert one.keys() == other.keys()
    for name in one:
        a, b = one[name], other[name]
        assert a.shape == b.shape, name
        if a.dtype.kind == "f":
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=atol, equal_nan=True, err_msg=name)
        else:
            np.testing.assert_array_equal(a, b, err_msg=name)
