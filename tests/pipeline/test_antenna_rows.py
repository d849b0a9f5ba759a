"""Epochs of two antennas are rows of the same arrays: the same results as of each antenna alone."""

from __future__ import annotations

import gc
import weakref
from dataclasses import is_dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline_cases import NO_EPOCHS, members
from railfix.core.epoch_rows import EVERY, join_epochs, take_epochs
from railfix.gnss.joined_observations import stack_observations
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
from railfix.pipeline import processor as processing
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.processor_state import State
from railfix.pipeline.range_stage import Models, correct_ranges
from railfix.pipeline.results import AntennaResult
from railfix.pipeline.screen_stage import screen_filtered, screen_positions
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.search_index import SearchIndex
from railfix.ranges.error_model import ErrorModel
from railfix.run.processor_setup import make_processor
from railfix.screens import FilteredMotion, PairedEpochs, Screened
from railfix.simulate.demonstration import demo_inputs
from railfix.track import read_track
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from test_pipeline_couplings import error_model

#: Results are held to this, in metres and in sigmas; sums over channels in another order differ by less.
_SAME = 1e-7
SETTINGS: dict[str, dict[str, Any]] = {
    "all": {"filter": "off"},
    "filter": {"filter": "track"},
    "error model": {"filter": "off", "protection": "on"},
    "few satellites": {"filter": "off", "systems": ["G"], "elevation": {"mask_deg": 35.0}},
}


@cache
def _inputs() -> tuple[dict[str, Observations], Navigation, dict[str, Trajectory]]:
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    track, vehicle = read_track(inputs.track), read_vehicle(inputs.vehicle)
    logs = {name: read_observations(getattr(inputs, name))[600:719] for name in ("front", "rear")}
    return logs, read_navigation(inputs.nav), {name: antenna_trajectory(track, vehicle, name) for name in logs}


def _without(obs: Observations, satellites: tuple[str, ...]) -> Observations:
    """The log of a receiver that does not have these satellites."""
    kept = ~np.isin(obs.satellite, satellites)
    arrays = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")
    return replace(
        obs,
        satellite=obs.satellite[kept],
        signal=obs.signal[kept],
        **{name: np.ascontiguousarray(getattr(obs, name)[:, kept]) for name in arrays},
    )


def _faulty(obs: Observations, satellite: str, epochs: slice) -> Observations:
    code = obs.code_m.copy()
    code[epochs] += np.where(obs.satellite == satellite, 60.0, 0.0)
    return replace(obs, code_m=code)


def _logs(case: str) -> dict[str, Observations]:
    logs = dict(_inputs()[0])
    if case == "signals of its own":
        rear = logs["rear"]
        logs["rear"] = replace(rear, signal=np.where(rear.satellite == rear.satellite[0], "1W", rear.signal))
    if case == "channels of its own":
        logs["front"] = _without(logs["front"], tuple(s for s in logs["front"].satellite.tolist() if s[0] == "E")[:2])
        other = tuple(s for s in logs["rear"].satellite.tolist() if s[0] in "JR")
        logs["rear"] = _without(logs["rear"], (*other, str(logs["rear"].satellite[0])))
    strong = str(logs["rear"].satellite[np.nan_to_num(logs["rear"].cn0_dbhz[0]).argmax()])
    faulty = {"front": slice(50, 80), "rear": slice(30, 60)}
    return {name: _faulty(log, strong, faulty[name]) for name, log in logs.items()}


def _missing(obs: Observations, every: int) -> Observations:
    """The log without every so manieth epoch."""
    kept = np.arange(len(obs)) % every != every - 1
    arrays = (
        "time", "code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock", "break_before", "receiver_alarm",
        "front_end_gain",
    )  # fmt: skip
    return replace(obs, **{name: getattr(obs, name)[kept] for name in arrays})


def _run(
    config: Config, logs: dict[str, Observations], ends: np.ndarray, model: ErrorModel | None
) -> dict[str, list[AntennaResult]]:
    """Process the logs in chunks that end before some times."""
    navigation, paths = _inputs()[1:]
    processor, state = EpochProcessor(config, paths, navigation=navigation, models=Models(error_model=model)), State()
    found: dict[str, list[AntennaResult]] = {name: [] for name in logs}
    cuts = {name: [0, *np.searchsorted(log.time, ends).tolist()] for name, log in logs.items()}
    for k in range(len(ends)):
        parts = {name: log[cuts[name][k] : cuts[name][k + 1]] for name, log in logs.items()}
        result, state = processor.process({name: part for name, part in parts.items() if len(part)}, state)
        for name, of_antenna in result.antennas.items():
            found[name].append(of_antenna)
    return found


def _values(result: AntennaResult, name: str, channels: list[tuple[str, str]]) -> np.ndarray:
    """A member of a result, its channels in a given order; those that the result does not have are NaN, or 0."""
    values = getattr(result, name)
    if values.ndim < 2 or values.shape[1] != len(result.satellite) or name in ("ecef_m", "conventional_ecef_m"):
        return np.asarray(values)
    own = {key: i for i, key in enumerate(zip(result.satellite.tolist(), result.signal.tolist(), strict=True))}
    return np.asarray(values[:, [own[key] for key in channels]])


def _assert_same(parts: list[AntennaResult], expected: AntennaResult) -> None:
    """Results epoch by epoch are those of a whole log."""
    keys = list(zip(expected.satellite.tolist(), expected.signal.tolist(), strict=True))
    for name, values in members(expected).items():
        if name in NO_EPOCHS or not isinstance(values, np.ndarray):
            continue
        got = np.concatenate([_values(part, name, keys) for part in parts])
        if values.dtype == np.float64:
            np.testing.assert_allclose(got, values, rtol=1e-9, atol=_SAME, err_msg=name)
        else:
            np.testing.assert_array_equal(got, values, err_msg=name)
    level = np.concatenate([part.protection.level.level_m for part in parts if part.protection is not None])
    np.testing.assert_allclose(level, expected.protection.level.level_m, rtol=1e-7)
    assert sum(int(part.raim.excluded.sum()) for part in parts) == int(expected.raim.excluded.sum())


@pytest.mark.requirement("A8")
@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("channels", ["same channels", "signals of its own", "channels of its own"])
@pytest.mark.every(8)
def test_rows_of_two_antennas_give_the_results_of_each_alone(settings: str, channels: str) -> None:
    config, logs = parse_config(SETTINGS[settings]), _logs(channels)
    alone = tuple(name for name in config.screens if name not in ("antenna_pair", "antenna_spacing"))
    config = config.model_copy(update={"screens": alone})
    time = logs["front"].time
    logs["rear"] = _missing(logs["rear"], every=11)
    after, model = np.timedelta64(50, "ms"), error_model(0.3) if settings == "error model" else None
    whole = {name: _run(config, {name: log}, time[-1:] + after, model)[name] for name, log in logs.items()}
    # One epoch, three, one, two; now and then the rear antenna has one less, or none.
    cut = _run(config, logs, time[np.cumsum([1, 3, 1, 2] * (len(time) // 7)) - 1] + after, model)
    for name, (expected,) in whole.items():
        _assert_same(cut[name], expected)


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("carrier", ["smoothed", "float"])
def test_carrier_phases_of_two_antennas_give_the_results_of_each_alone(carrier: str) -> None:
    logs, navigation, paths = _inputs()
    logs = {"front": _without(logs["front"], ("G05",)), "rear": _missing(logs["rear"], every=11)}
    config = parse_config({"carrier": carrier, "filter": "off", "screens": ["elevation", "doppler", "raim"]})
    both, state = EpochProcessor(config, paths, navigation=navigation), State()
    parts: dict[str, list[AntennaResult]] = {name: [] for name in logs}
    for cut in (slice(0, 40), slice(40, 119)):
        result, state = both.process({name: log[cut] for name, log in logs.items()}, state)
        for name, own in result.antennas.items():
            parts[name].append(own)
    for name, log in logs.items():
        expected = both.process({name: log})[0].antennas[name]
        for column in ("arc_m", "along_sigma_m", "status"):
            got = np.concatenate([getattr(part, column) for part in parts[name]])
            np.testing.assert_allclose(got, getattr(expected, column), rtol=1e-9, atol=_SAME, err_msg=column)


def test_antennas_on_maps_of_other_sigmas_are_refused() -> None:
    _, navigation, paths = _inputs()
    other = paths | {"rear": replace(paths["rear"], sigma_plan_m=2.0 * paths["rear"].sigma_plan_m)}
    with pytest.raises(ValueError, match="different map sigmas"):
        make_processor(parse_config({}), navigation, other)


def test_joined_rows_are_taken_apart_again() -> None:
    logs = _inputs()[0]
    front, rear = logs["front"][:3], logs["rear"][:2]
    both = join_epochs([front, rear])
    assert both.time.tolist() == [*front.time.tolist(), *rear.time.tolist()]
    for part, rows in ((front, slice(0, 3)), (rear, slice(3, 5))):
        again = take_epochs(both, rows)
        assert is_dataclass(again)
        np.testing.assert_array_equal(again.code_m, part.code_m)
        np.testing.assert_array_equal(again.satellite, part.satellite)
    assert take_epochs(both, EVERY) is both
    assert join_epochs([both]) is both


def test_rows_are_split_by_antenna() -> None:
    paths = _inputs()[2]
    front, rear = SearchIndex(paths["front"]), SearchIndex(paths["rear"])
    both = AntennaRows((front, rear), (slice(0, 2), slice(2, 5)))
    split = [(index is front, rows.tolist()) for index, rows in both.split(np.array([1, 2, 4]))]
    assert split == [(True, [1]), (False, [2, 4])]
    assert [rows.tolist() for _, rows in both.split(np.array([3]))] == [[3]]
    alone = AntennaRows.on(rear)
    assert [rows.tolist() for _, rows in alone.split(np.array([3]))] == [[3]]
    assert not list(alone.split(np.array([], dtype=np.intp)))
    arc = np.array([10.0, np.nan, 20.0, 30.0, 40.0])
    np.testing.assert_array_equal(both.at_arc(arc)[2:], paths["rear"].at_arc(arc[2:]))


def test_chunks_are_freed_as_soon_as_they_are_done(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a search for garbage: the arrays of a chunk would wait for it, and memory grow."""
    made: list[weakref.ref[Any]] = []

    def noted(*arguments: Any, **options: Any) -> Any:
        ranges, near = correct_ranges(*arguments, **options)
        made.append(weakref.ref(ranges))
        return ranges, near

    monkeypatch.setattr(processing, "correct_ranges", noted)
    logs, navigation, paths = _inputs()
    processor = make_processor(parse_config({"filter": "track"}), navigation, paths)
    gc.disable()
    try:
        processor.process({name: log[:40] for name, log in logs.items()})
        assert [ranges() for ranges in made] == [None]
    finally:
        gc.enable()


@pytest.mark.requirement("A7")
def test_frequencies_of_glonass_that_one_log_alone_states_count_for_both() -> None:
    """Two logs with the same channels, of which the second names the frequencies: they are not taken for the same."""
    front = _inputs()[0]["front"][:2]
    stated = replace(front, header=replace(front.header, glonass_channel={"R05": 1, "R06": -4}))
    silent = replace(front, header=replace(front.header, glonass_channel={}))
    for logs in ((silent, stated), (stated, silent)):
        rows, parts = stack_observations(logs)
        assert [part.stop for part in parts] == [2, 4]
        assert rows.header.glonass_channel == {"R05": 1, "R06": -4}


@pytest.mark.requirement("B3")
def test_verdicts_on_pairs_go_to_the_epochs_of_each_antenna() -> None:
    """The rear log has an epoch more before, and one between: pairs are of other rows of the two."""

    def judge(front: np.ndarray, rear: np.ndarray, *_: object) -> Screened:
        return Screened(metric=front - rear, reject=front - rear > 25.0)

    def judge_filtered(front: FilteredMotion, rear: FilteredMotion, *_: object) -> Screened:
        return judge(front.chainage_m, rear.chainage_m)

    screen = SimpleNamespace(name="spacing", status=9, judge=judge, judge_filtered=judge_filtered)
    chainage = {"front": np.array([100.0, 110.0, 120.0, 130.0]), "rear": np.array([70.0, 75.0, 90.0, 95.0, 110.0])}
    nowhere, along = np.zeros((3, 3)), np.full(3, 20.0)
    pair = PairedEpochs(
        front_epoch=np.array([1, 2, 3]), rear_epoch=np.array([0, 2, 4]), front_ecef_m=nowhere, rear_ecef_m=nowhere,
        along_m=along,
    )  # fmt: skip
    rows = slice(0, 4), slice(4, 9)
    antennas = SimpleNamespace(parts=rows, chainage_at=lambda arc_m: arc_m)
    by_name = dict(zip(chainage, rows, strict=True))
    solution = SimpleNamespace(status=np.zeros(9, dtype=np.int8), arc_m=np.concatenate([*chainage.values()]))
    status, published = screen_positions(pair, by_name, antennas, solution, [(screen, None)], parse_config({}))  # type: ignore[arg-type]
    motions = {name: FilteredMotion(values, values, values, values) for name, values in chainage.items()}
    filtered = screen_filtered([(screen, None)], pair, motions)
    for name, refused in (("front", [1, 2]), ("rear", [0, 2])):
        assert np.flatnonzero(status[by_name[name]] == 9).tolist() == refused
        for screened in (published[name]["spacing"], filtered[name]):
            assert np.flatnonzero(screened.reject).tolist() == refused
            known = np.isfinite(screened.metric)
            assert np.flatnonzero(known).tolist() == {"front": [1, 2, 3], "rear": [0, 2, 4]}[name]
            assert screened.metric[known].tolist() == [40.0, 30.0, 20.0]
