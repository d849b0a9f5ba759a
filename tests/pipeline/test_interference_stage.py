"""Jamming and spoofing of a simulated train: statuses of single epochs, of the filter, and of the live message."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import pipeline_cases
import signal_attacks
from live_outputs import output_of
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.reasons import Reason, Status
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.integrity.interference import Sign, Suspicion
from railfix.integrity.protection import LevelStatus
from railfix.pipeline.interference_stage import Interference
from railfix.pipeline.results import Result, add_wheel_sign
from railfix.pipeline.solution import Solution
from railfix.run.tally import AntennaTally
from railfix.tracking import TrackStatus
from railfix.tracking.result import is_bounded
from signal_attacks import Scene

#: Epoch of the attacks, at 1 Hz: the train runs.
AT = 60


@cache
def scene() -> Scene:
    log = pipeline_cases.clean_observations()["front"][::10]
    truth = pipeline_cases.clean_truth().filter(antenna="front")[::10]
    return Scene.of(log, pipeline_cases.clean_navigation(), truth.select("x_m", "y_m", "z_m").to_numpy())


def result_of(log: Observations, **settings: object) -> Result:
    return pipeline_cases.processor({"filter": "off", **settings}).process({"front": log})[0]


@pytest.mark.requirement("B8")
def test_a_train_without_interference_has_none() -> None:
    found = result_of(scene().observations)["front"]
    assert (found.interference.suspicion == Suspicion.NONE).all()
    assert (found.status == Status.OK).any()


@pytest.mark.requirement("B8")
def test_a_jammer_passed_at_50_m_is_suspected_from_5_db_on_and_released_after_it() -> None:
    rng = np.random.default_rng(1)
    found = result_of(signal_attacks.jammed(scene(), AT, -15.0, rng))["front"]
    fall = signal_attacks.fall_db(scene(), AT, -15.0)
    jammed = np.flatnonzero(found.interference.suspicion == Suspicion.JAMMING_SUSPECTED)
    first = int(np.argmax(fall >= 5.0))
    assert first <= jammed[0] <= first + 8
    assert fall[: jammed[0] + 1].max() < 12.0, "before the fall is deep"
    assert jammed[-1] <= np.flatnonzero(fall >= 4.0)[-1] + 12
    assert (found.status[jammed] == Status.JAMMING_SUSPECTED).any()
    assert not (found.interference.suspicion == Suspicion.SPOOFING_SUSPECTED).any()


@pytest.mark.requirement("B8")
def test_walls_that_weaken_half_of_the_satellites_are_no_jammer() -> None:
    log = scene().observations
    side = np.arange(len(log.satellite)) % 2 == 0
    behind = (np.arange(len(log)) >= AT)[:, None] & side
    found = result_of(pipeline_cases.replace(log, cn0_dbhz=log.cn0_dbhz - 12.0 * behind))["front"]
    assert not found.interference.suspicion.any()


@pytest.mark.requirement("B8")
def test_repeated_signals_are_suspected_at_their_first_epoch_and_no_level_is_promised() -> None:
    log = signal_attacks.repeated(scene(), AT, (120.0, -90.0), 200.0)
    found = result_of(log)["front"]
    spoofed = np.flatnonzero(found.interference.suspicion == Suspicion.SPOOFING_SUSPECTED)
    assert spoofed[0] == AT + 2, "the first epoch after two seconds without lock"
    assert spoofed[-1] == len(log) - 1
    assert set(found.status[AT + 2 :].tolist()) <= {
        int(Status.SPOOFING_SUSPECTED),
        int(Status.TOO_FEW_SATELLITES),
        5,
        6,
    }
    assert found.interference.causes[AT + 2] & (Sign.POSITION_JUMP | Sign.CLOCK_JUMP)
    positioned = found.status == Status.SPOOFING_SUSPECTED
    assert (found.protection.status[positioned] == LevelStatus.ALARM).all()
    dropped = result_of(log, failed_checks="drop")["front"]
    assert np.isnan(dropped.chainage_m[positioned]).all()


@pytest.mark.requirement("B8")
def test_a_pull_by_one_transmitter_is_suspected_and_one_constellation_parts() -> None:
    rng = np.random.default_rng(2)
    pulled = result_of(signal_attacks.pulled(scene(), AT, 0.5, power="equal", rng=rng))["front"]
    first = int(np.argmax(pulled.interference.suspicion > 0))
    assert AT + 2 <= first <= AT + 15
    parted = result_of(signal_attacks.pulled(scene(), AT, 2.0, systems="E", rng=rng))["front"]
    first = int(np.argmax(parted.interference.suspicion > 0))
    assert AT + 10 <= first <= AT + 60
    assert parted.interference.causes[first] == Sign.CONSTELLATIONS_PART


@pytest.mark.requirement("B8")
def test_the_receivers_own_alarm_counts_and_all_can_be_turned_off() -> None:
    log = scene().observations
    alarm = np.zeros(len(log), dtype=np.uint8)
    alarm[AT : AT + 3], alarm[100:] = 1, 2
    log = pipeline_cases.replace(log, receiver_alarm=alarm)
    found = result_of(log)["front"].interference.suspicion
    assert (found[AT : AT + 12] == Suspicion.JAMMING_SUSPECTED).all()
    assert (found[:AT] == 0).all()
    assert (found[AT + 13 : 100] == 0).all()
    assert (found[100:] == Suspicion.SPOOFING_SUSPECTED).all()
    assert result_of(log, interference={"use": "off"})["front"].interference is None


@pytest.mark.slow
@pytest.mark.requirement("B8")
def test_the_filter_gives_no_bound_and_the_message_says_why() -> None:
    log = signal_attacks.repeated(scene(), AT, (120.0, -90.0), 200.0)[: AT + 20]
    whole, _ = pipeline_cases.processor({"filter": "track"}).process({"front": log})
    tracked = whole.fusion["front"].tracked
    spoofed = whole["front"].interference.suspicion == Suspicion.SPOOFING_SUSPECTED
    assert spoofed.sum() > 15
    assert not is_bounded(tracked.status[spoofed]).any()
    # the filter's own monitors have the place in doubt before, or with, the suspicion
    assert np.isin(tracked.status[spoofed][:5], (TrackStatus.DOUBTFUL, TrackStatus.SPOOFING_SUSPECTED)).all()
    assert not np.isfinite(tracked.level_m[spoofed]).any()
    message = output_of(whole).message
    assert message.interference == Suspicion.SPOOFING_SUSPECTED
    assert message.over_cm is None


@pytest.mark.requirement("B8")
def test_at_10_hz_it_is_looked_for_once_a_second_whatever_the_chunks() -> None:
    log = pipeline_cases.clean_observations()["front"][:45]
    alarm = np.zeros(len(log), dtype=np.uint8)
    alarm[13], alarm[25] = 1, 2
    log = replace(log, receiver_alarm=alarm)
    processor = pipeline_cases.processor({"filter": "off"})
    whole = processor.process({"front": log})[0]["front"].interference
    jamming = (whole.causes & int(Sign.RECEIVER_JAMMING)) != 0
    spoofing = (whole.causes & int(Sign.RECEIVER_SPOOFING)) != 0
    tenths = np.round((log.time - log.time[0]) / np.timedelta64(100, "ms")).astype(int)
    assert tenths[np.argmax(jamming)] == 20
    assert tenths[np.argmax(spoofing)] == 30
    state, parts = None, []
    for part in np.split(np.arange(len(log)), (1, 14, 20, 21, 26)):
        result, state = processor.process({"front": log[part[0] : part[-1] + 1]}, state)
        parts.append(result["front"].interference)
    np.testing.assert_array_equal(np.concatenate([part.causes for part in parts]), whole.causes)
    np.testing.assert_allclose(np.concatenate([part.power.fall_db for part in parts]), whole.power.fall_db)


@pytest.mark.requirement("B8")
@pytest.mark.parametrize("broken", [False, True])
def test_a_clock_that_steps_after_a_break_between_two_looks_is_no_sign_whatever_the_chunks(broken: bool) -> None:
    log = pipeline_cases.clean_observations()["front"][:45]
    step = np.where(np.arange(len(log)) >= 18, 2000.0, 0.0)
    begins = broken & (np.arange(len(log)) == 18)
    log = replace(log, code_m=log.code_m + step[:, None], break_before=log.break_before | begins)
    processor = pipeline_cases.processor({"filter": "off"})
    for cuts in ((), (19,), (18, 20)):
        state, parts = None, []
        for part in np.split(np.arange(len(log)), cuts):
            result, state = processor.process({"front": log[part[0] : part[-1] + 1]}, state)
            parts.append(result["front"].interference.causes)
        jumped = (np.concatenate(parts) & int(Sign.CLOCK_JUMP)) != 0
        assert np.flatnonzero(jumped).tolist() == ([] if broken else list(range(20, 45)))


@pytest.mark.requirement("B8")
@pytest.mark.parametrize(("late_s", "from_epoch"), [(1.0, 5), (18.0, 5), (-18.0, 5), (0.01, 40)])
def test_wrong_time_tags_are_named_with_their_size_and_give_no_level(late_s: float, from_epoch: int) -> None:
    log = scene().observations
    since = np.arange(len(log)) if abs(late_s) < 0.1 else np.ones(len(log))
    shifted = replace(log, time=log.time + (late_s * since * 1e9).astype("timedelta64[ns]"))
    found = result_of(shifted)["front"]
    named = found.interference.suspicion == Suspicion.TIME_TAGS
    assert named[from_epoch:].all()
    median = found.interference.motion.tag_error_s
    assert np.abs(median - late_s * since)[named].max() < 0.1
    assert not np.isin(found.status[named], (Status.OK, Status.AMBIGUOUS, Status.SPOOFING_SUSPECTED)).any()
    assert not (found.protection.status[named] == LevelStatus.AVAILABLE).any()
    tally = AntennaTally()
    tally.add(found)
    assert tally.map_offset is None or tally.map_offset.statistic < 9.2, "the map is not blamed"


@pytest.mark.requirement("B8")
@pytest.mark.parametrize(
    ("kind", "letters", "factor", "words"),
    [
        ("doppler_hz", "E", -1.0, ["the Dopplers of Galileo have the wrong sign; they are not used"]),
        ("doppler_hz", "GEJC", -1.0, ["the Dopplers of Galileo have", "the Dopplers of GPS have"]),
        ("doppler_hz", "G", 0.19, ["the Dopplers of GPS are in metres a second, not in Hz"]),
        ("doppler_hz", "G", 3.0, ["the Dopplers of GPS are 3 times", "their unit is not Hz"]),
        ("phase_cycles", "GEJC", 0.19, ["the phases of GPS are in metres, not in cycles"]),
        ("phase_cycles", "G", -1.0, ["the phases of GPS have the wrong sign"]),
    ],
)
def test_signs_and_units_of_observables_are_named_and_nothing_else_changes(
    kind: str, letters: str, factor: float, words: list[str]
) -> None:
    log = scene().observations
    own = np.isin(log.satellite.astype("<U1"), list(letters))
    wrong = replace(log, **{kind: np.where(own, factor, 1.0) * getattr(log, kind)})
    result, clean = result_of(wrong), result_of(log)
    notes = [note for note in result.notes if "not used" in note]
    assert all(any(word in note for note in notes) for word in words)
    assert not any("not used" in note for note in clean.notes)
    found = result["front"]
    assert (found.interference.suspicion == Suspicion.NONE).all()
    assert np.nanmax(np.abs(found.chainage_m - clean["front"].chainage_m)) < 5.0
    assert (found.status == Status.OK).mean() > (clean["front"].status == Status.OK).mean() - 0.05


@pytest.mark.requirement("C6")
@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"G10": 60.0}, Reason.FAULT_EXCLUDED | Reason.LASTING_ERROR),
        ({"G10": 20.0}, Reason.LASTING_ERROR),
        ({"G10": 1e3}, Reason.GROSS_ERROR),
        ({"E05": -3e5}, Reason.GROSS_ERROR),
        ({"E05": 500.0, "G01": -2e3}, Reason.GROSS_ERROR),
        ({"E11": 400.0, "G15": 9e3, "G01": -3e5}, Reason.GROSS_ERROR),
    ],
)
def test_satellites_named_as_wrong_are_in_no_monitor(wrong: dict[str, float], reason: Reason) -> None:
    """Wrong codes are no interference, no error of the map or of the time tags, and no place off the map."""
    log = scene().observations
    added = sum(size * (log.satellite == name) for name, size in wrong.items())
    processor = pipeline_cases.processor({"filter": "track"})
    result, _ = processor.process({"front": replace(log, code_m=log.code_m + added)})
    clean, _ = processor.process({"front": log})
    found, tracked, best = result["front"], result.fusion["front"].tracked, clean.fusion["front"].tracked
    named = (found.reason[:, np.isin(log.satellite, list(wrong))] & int(reason)) != 0
    assert named.mean() > 0.3
    assert not found.interference.causes.any()
    assert not np.isin(found.status, (Status.OFF_MAP, Status.MAP_OFFSET, Status.SPOOFING_SUSPECTED)).any()
    assert np.nanmax(found.map_offset.statistic) < 9.2, "from where on a run has a note"
    assert np.nanmax(np.abs(found.interference.motion.clock_jump_m)) < 10.0
    assert (tracked.status == TrackStatus.TRACKING).sum() >= (best.status == TrackStatus.TRACKING).sum() - 3


@pytest.mark.requirement("C6")
def test_dopplers_and_clocks_of_one_bad_satellite_are_no_jump() -> None:
    """A satellite's Doppler is off by 30 m/s, or its clock drifts by 5 m/s with code, phase and Doppler."""
    log = scene().observations
    own = log.satellite == "G10"
    wavelength = SPEED_OF_LIGHT / carrier_frequency_hz(log.satellite, log.signal)
    later = np.maximum(np.arange(len(log)) - AT, 0)[:, None]
    beaten = replace(log, doppler_hz=log.doppler_hz - 30.0 / wavelength * (own & (later > 0)))
    drifting = replace(
        log, code_m=log.code_m + 5.0 * later * own, phase_cycles=log.phase_cycles + 5.0 * later * own / wavelength,
        doppler_hz=log.doppler_hz - 5.0 / wavelength * (own & (later > 0)),
    )  # fmt: skip
    for wrong in (beaten, drifting):
        found = result_of(wrong)["front"]
        assert not found.interference.suspicion.any()
        assert not np.isin(found.status, (Status.OFF_MAP, Status.MAP_OFFSET)).any()


@pytest.mark.requirement("C6")
def test_while_all_positions_of_a_minute_fail_a_check_the_filter_is_not_tracking() -> None:
    settings = {"filter": "track", "raim": {"mode": "fixed", "fixed_limit_m2": 1e-9}}
    result, _ = pipeline_cases.processor(settings).process({"front": scene().observations})
    found, tracked = result["front"], result.fusion["front"].tracked
    assert (found.status == Status.INCONSISTENT).all()
    contradicted = found.interference.suspicion == Suspicion.CONTRADICTED
    since = (found.time - found.time[0]) / np.timedelta64(1, "s")
    assert np.array_equal(contradicted, since >= 60.0)
    assert (tracked.status[contradicted] == TrackStatus.DOUBTFUL).all()
    assert not np.isfinite(tracked.level_m[contradicted]).any()
    assert (tracked.status[10:50] == TrackStatus.TRACKING).all()


@pytest.mark.requirement("C6")
def test_positions_that_are_only_imprecise_leave_the_filter_tracking() -> None:
    settings = {"filter": "track", "largest_sigma_m": 0.01}
    result, _ = pipeline_cases.processor(settings).process({"front": scene().observations})
    assert (result["front"].status == Status.UNCERTAIN).all()
    assert not result["front"].interference.suspicion.any()
    assert (result.fusion["front"].tracked.status[10:] == TrackStatus.TRACKING).mean() > 0.95


@pytest.mark.requirement("B8")
def test_the_sign_of_the_wheel_changes_the_status_of_its_own_epochs_alone() -> None:
    """An epoch that another sign suspects keeps the status that a later check has given it."""
    nothing: Any = None
    causes = np.array([0, int(Sign.RECEIVER_SPOOFING), 0], dtype=np.int64)
    statuses = np.array([Status.OK, Status.ANTENNAS_DISAGREE, Status.OK], dtype=np.int8)
    solution = object.__new__(Solution)  # the other outputs are not looked at
    vars(solution)["status"] = statuses
    wheel: Any = SimpleNamespace(parted=np.array([False, False, True]))
    found, interference = add_wheel_sign(solution, Interference(causes=causes, power=nothing, motion=nothing), wheel)
    assert found.status.tolist() == [Status.OK, Status.ANTENNAS_DISAGREE, Status.SPOOFING_SUSPECTED]
    assert interference.causes.tolist() == [0, int(Sign.RECEIVER_SPOOFING), int(Sign.WHEEL_PARTS)]
