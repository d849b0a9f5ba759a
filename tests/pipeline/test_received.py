"""Navigation records and SBAS messages as they are received, and stages that change nothing that they are given."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline_cases import (
    ANTENNAS,
    clean_navigation,
    clean_observations,
    clean_trajectories,
    cut,
    demo_observations,
    flat,
    in_pieces,
    processor,
    same,
)
from railfix.core.errors import SettingsError
from railfix.core.reasons import Reason
from railfix.core.timescale import timedelta
from railfix.gnss.navigation import GlonassRecords, Navigation
from railfix.gnss.orbits.prepared_records import validity_s
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.received import known_from_start, receive
from railfix.pipeline.results import AntennaResult
from railfix.ranges.atmosphere import TYPICAL_KLOBUCHAR, thin_shell_obliquity
from railfix.ranges.sbas import SbasState, read_sbas
from railfix.run.processor_setup import make_processor
from recordings_score import straight_line


def rows(navigation: Navigation, mask: np.ndarray) -> Navigation:
    """Some of the Keplerian records, and everything else."""
    kepler = navigation.kepler
    return replace(navigation, kepler=type(kepler)(**{f.name: getattr(kepler, f.name)[mask] for f in fields(kepler)}))


@pytest.mark.requirement("A8")
def test_records_given_as_they_are_received_give_the_same() -> None:
    """Each constellation's records come with a chunk of their own; before that its satellites have no ephemeris."""
    navigation, parts = clean_navigation(), {name: log[:120] for name, log in clean_observations().items()}
    whole, _ = processor({}).process(parts)
    letter = navigation.kepler.satellite.astype("<U1")
    first = rows(navigation, letter == "G")
    later = rows(navigation, letter != "G")
    empty = EpochProcessor(parse_config({"filter": "off"}), clean_trajectories())
    alone = processor({}, navigation=first)
    state, arrived = None, []
    for k, piece in enumerate(cut(parts, [40, 80])):
        given = (first, None, later)[k]
        result, state = empty.process(piece, state, navigation=given)
        arrived.append(result.antennas["front"])
    reference, _ = alone.process({name: part[:80] for name, part in parts.items()})
    same(flat(arrived[0]), flat(alone.process({n: p[:40] for n, p in parts.items()})[0].antennas["front"]), atol=1e-6)
    np.testing.assert_array_equal(arrived[1].reason, reference.antennas["front"].reason[40:80])
    others = ~np.char.startswith(arrived[2].satellite, "G")
    np.testing.assert_array_equal(arrived[2].elevation_deg, whole.antennas["front"].elevation_deg[80:])
    assert (arrived[2].reason[:, others] == 0).any()
    seen = (arrived[1].reason[:, others] & Reason.NOT_OBSERVED) == 0
    assert (arrived[1].reason[:, others][seen] & (Reason.NO_EPHEMERIS | Reason.OTHER_SIGNAL_TAKEN)).all()


@pytest.mark.requirement("A8")
def test_all_records_one_chunk_before_their_use_equal_all_at_the_start() -> None:
    navigation, parts = clean_navigation(), {name: log[:90] for name, log in clean_observations().items()}
    expected, _ = in_pieces(processor({}), parts, [30, 60])
    empty, state = EpochProcessor(parse_config({"filter": "off"}), clean_trajectories()), None
    found: dict[str, list[dict[str, np.ndarray]]] = {name: [] for name in ANTENNAS}
    half = np.arange(len(navigation.kepler)) % 2 == 0
    nothing = {name: part[:0] for name, part in parts.items()}
    # The records arrive in two messages before the first epoch, then once more, as satellites repeat them.
    _, state = empty.process(nothing, state, navigation=rows(navigation, half))
    _, state = empty.process(nothing, state, navigation=rows(navigation, ~half))
    for piece in cut(parts, [30, 60]):
        result, state = empty.process(piece, state, navigation=navigation)
        for name, antenna in result.antennas.items():
            found[name].append(flat(antenna))
    assert len(state.received.navigation.kepler) == len(navigation.kepler)
    for name, pieces in found.items():
        joined = {k: np.concatenate([p[k] for p in pieces]) for k in pieces[0]}
        ignored = {"corrected.satellites.record"}  # rows of a table in another order
        same(
            {k: v for k, v in joined.items() if k not in ignored},
            {k: v for k, v in expected[name].items() if k not in ignored},
            atol=1e-6,
        )


@pytest.mark.requirement("C1")
def test_sbas_messages_given_as_they_are_received_equal_all_at_the_start(recordings: Path) -> None:
    folder = recordings / "sbas" / "msas_20080526_crescent"
    navigation = read_navigation([folder / "cres_20080526.bin.nav"])
    messages = read_sbas(folder / "cres_20080526.bin.sbs")
    log = read_observations(folder / "cres_20080526.bin.obs")[:360]
    config = parse_config({"filter": "off", "sbas": "stream", "sbas_prn": 137, "elevation": {"mask_deg": 10.0}})
    line = {"front": straight_line(log.header.approximate_ecef_m, 45.0)}
    first = EpochProcessor(config, line, navigation=navigation, corrections=SbasState.from_log(messages, prn=137))
    whole, _ = first.process({"front": log})
    live, state, statuses, reasons, taken = make_processor(config, navigation, line), None, [], [], 0
    for first in range(0, len(log), 60):
        piece = log[first : first + 60]
        until = int(np.searchsorted(messages.time, piece.time[-1], side="right"))
        new = messages.take(np.arange(taken, until))
        taken = until
        result, state = live.process({"front": piece}, state, messages=new)
        statuses.append(result.antennas["front"].chainage_m)
        reasons.append(result.antennas["front"].reason)
    expected = whole.antennas["front"]
    np.testing.assert_array_equal(np.concatenate(reasons), expected.reason)
    np.testing.assert_allclose(np.concatenate(statuses), expected.chainage_m, rtol=0, atol=1e-6)
    assert np.isfinite(expected.chainage_m).any()
    with pytest.raises(SettingsError, match="messages were given, but SBAS is off"):
        EpochProcessor(Config(filter="off"), line, navigation=navigation).process({"front": log[:1]}, messages=messages)
    with pytest.raises(SettingsError, match=r"SBAS is on in the settings .* were not given; give both"):
        EpochProcessor(config, line, navigation=navigation)
    with pytest.raises(SettingsError, match="sbas_band = L1, but the corrections are for SBAS on L5"):
        EpochProcessor(config, line, navigation=navigation, corrections=SbasState(prn=137, band="L5"))


def test_nothing_new_is_the_same_value() -> None:
    config, time = parse_config({"filter": "off"}), np.datetime64("2024-03-05T03:10:00", "ns")
    start = known_from_start(config, navigation=clean_navigation())
    assert receive(start, config, time) is start
    again = receive(start, config, time, navigation=clean_navigation())
    assert again.navigation.kepler is start.navigation.kepler


def test_skipped_records_of_all_receptions_are_counted() -> None:
    config, time = parse_config({"filter": "off"}), np.datetime64("2024-03-05T03:10:00", "ns")
    start = known_from_start(config, navigation=replace(clean_navigation(), skipped={"SBAS": 2, "IRNSS": 4}))
    after = receive(start, config, time, navigation=replace(clean_navigation(), skipped={"SBAS": 1, "CNAV": 3}))
    assert after.navigation.skipped == {"SBAS": 3, "IRNSS": 4, "CNAV": 3}


@pytest.mark.requirement("A8")
def test_the_newest_coefficients_are_used_and_of_expired_records_the_newest_of_each_kind_is_kept() -> None:
    """Galileo broadcasts two kinds of records: one does not take the place of the other."""
    config, whole = parse_config({"filter": "off"}), clean_navigation()
    kepler = rows(whole, np.char.startswith(whole.kepler.satellite, "E")).kepler
    both = [rows(replace(whole, kepler=kepler), np.arange(len(kepler)) == 0).kepler for _ in range(4)]
    for k, (hours, kind) in enumerate(((0, "INAV"), (1, "INAV"), (0, "FNAV"), (-1, "FNAV"))):
        both[k] = replace(both[k], toe=both[k].toe + np.timedelta64(hours, "h"), message=np.array([kind]))
    table = type(kepler)(**{f.name: np.concatenate([getattr(b, f.name) for b in both]) for f in fields(kepler)})
    old, new = (whole.klobuchar["G"] * factor for factor in (1.0, 2.0))
    start = known_from_start(config, navigation=replace(whole, klobuchar={"G": old}))
    later = replace(whole, kepler=table, klobuchar={"G": new})
    after = receive(start, config, table.toe.max() + np.timedelta64(2, "D"), navigation=later)
    np.testing.assert_array_equal(after.klobuchar, new)
    mine = after.navigation.kepler.satellite == table.satellite[0]
    kept = sorted(zip(after.navigation.kepler.message[mine].tolist(), after.navigation.kepler.toe[mine], strict=True))
    assert [kind for kind, _ in kept] == ["FNAV", "INAV"]
    assert kept[0][1] == table.toe[2]
    assert kept[1][1] >= table.toe[1]


def lock(value: Any) -> None:
    """Make every array in a value read-only, however deep; frozen dataclasses keep the array itself."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
    elif isinstance(value, dict):
        for inner in value.values():
            lock(inner)
    elif is_dataclass(value) and not isinstance(value, type):
        for item in fields(value):
            lock(getattr(value, item.name))


@pytest.mark.parametrize("carrier", ["off", "smoothed", "float"])
def test_stages_take_read_only_values(monkeypatch: pytest.MonkeyPatch, carrier: str) -> None:
    """Ranges, solutions and states are locked between the stages; the results are those without the locks."""
    from railfix.pipeline import processor as processing

    parts = {name: log[250:310] for name, log in demo_observations().items()}
    make = processor({"carrier": carrier, "raim": {"false_alarm": 0.2}, "raim_protection": "on"})
    expected, _ = make.process(parts)

    def locking(function: Any) -> Any:
        def locked(*arguments: Any, **options: Any) -> Any:
            for value in (*arguments, *options.values()):
                lock(value)
            result = function(*arguments, **options)
            for value in result if isinstance(result, tuple) else (result,):
                lock(value)
            return result

        return locked

    stages = ("correct_ranges", "pair_antennas", "screen_antennas", "position_stage", "antenna_results", "along_track")
    for name in stages:
        monkeypatch.setattr(processing, name, locking(getattr(processing, name)))
    found, state = make.process({n: p[:30] for n, p in parts.items()})
    lock(state)
    more, _ = make.process({n: p[30:] for n, p in parts.items()}, state)
    for name in ANTENNAS:
        excluded = more.antennas[name].raim.excluded.any() or found.antennas[name].raim.excluded.any()
        assert excluded or carrier == "smoothed"
        both = np.concatenate([found.antennas[name].reason, more.antennas[name].reason])
        np.testing.assert_array_equal(both, expected.antennas[name].reason)


@pytest.mark.requirement("A8")
def test_expired_records_are_dropped_but_for_the_newest(recordings: Path) -> None:
    """A day of records, hour by hour: what is kept is what is valid, and the last one of every satellite."""
    day = read_navigation(recordings / "static" / "ESBC_2020177" / "ESBC00DNK_R_20201770000_01D_MN.rnx.gz")
    config, kept = parse_config({"filter": "off"}), known_from_start(parse_config({"filter": "off"}))
    start = np.datetime64("2020-06-25T00:00:00", "ns")
    sizes = []
    for hour in range(24):
        now = start + np.timedelta64(hour, "h")
        sent = (day.kepler.transmitted > now - np.timedelta64(1, "h")) & (day.kepler.transmitted <= now)
        sent_glonass = (day.glonass.toe > now - np.timedelta64(1, "h")) & (day.glonass.toe <= now)
        new = replace(rows(day, sent), glonass=glonass_rows(day, sent_glonass))
        kept = receive(kept, config, now, navigation=new)
        known = kept.navigation.kepler
        sizes.append(len(known) + len(kept.navigation.glonass))
        heard = (day.kepler.transmitted > start - np.timedelta64(1, "h")) & (day.kepler.transmitted <= now)
        valid = heard & (day.kepler.toe + timedelta(validity_s(day.kepler)) >= now)
        assert set(zip(known.satellite, known.toe, strict=True)) >= set(
            zip(day.kepler.satellite[valid], day.kepler.toe[valid], strict=True)
        )
        assert set(known.satellite) == set(day.kepler.satellite[heard])
    assert max(sizes[6:]) < 1.3 * sizes[6]
    assert sizes[-1] < 0.5 * (len(day.kepler) + len(day.glonass))


def glonass_rows(navigation: Navigation, chosen: np.ndarray) -> GlonassRecords:
    names = navigation.glonass.__dataclass_fields__
    return GlonassRecords(**{name: getattr(navigation.glonass, name)[chosen] for name in names})


@pytest.mark.requirement("B4")
@pytest.mark.requirement("C2")
def test_coefficients_that_were_not_received_are_named_and_bounded() -> None:
    """Typical coefficients, a note, and wider positions and levels, until coefficients arrive or the model is off."""
    navigation, parts = clean_navigation(), {name: log[:40] for name, log in clean_observations().items()}
    bare = replace(navigation, klobuchar={})
    sigma = {"screens": ["elevation"], "nominal": {"typical_ionosphere_sigma_m": 3.0}}
    without = known_from_start(parse_config(sigma), navigation=bare)
    np.testing.assert_array_equal(without.klobuchar, TYPICAL_KLOBUCHAR)
    assert without.ionosphere_sigma_m == 3.0
    assert "no coefficients of GPS or QZSS were received" in without.notes[0]
    assert "3 m added" in without.notes[0]
    off = known_from_start(parse_config({"filter": "off", "ionosphere": "off"} | sigma), navigation=bare)
    assert (off.klobuchar, off.ionosphere_sigma_m, off.notes) == (None, 0.0, ())
    own = known_from_start(parse_config(sigma), navigation=replace(bare, klobuchar={"C": navigation.klobuchar["G"]}))
    assert own.ionosphere_sigma_m == 3.0  # BeiDou's are for a model of its own
    japan = known_from_start(parse_config(sigma), navigation=replace(bare, klobuchar={"J": navigation.klobuchar["G"]}))
    assert japan.ionosphere_sigma_m == 0.0
    assert japan.notes == ("ionosphere: klobuchar requested; QZSS coefficients are used",)
    later = receive(without, parse_config(sigma), parts["front"].time[0], navigation=navigation)
    np.testing.assert_array_equal(later.klobuchar, navigation.klobuchar["G"])
    assert (later.ionosphere_sigma_m, later.notes) == (0.0, ())

    def solved(known: Navigation) -> AntennaResult:
        return (
            EpochProcessor(parse_config(sigma), clean_trajectories(), navigation=known)
            .process(parts)[0]
            .antennas["front"]
        )

    typical = {"G": np.asarray(TYPICAL_KLOBUCHAR)}
    stated, assumed = solved(replace(navigation, klobuchar=typical)), solved(bare)
    used = (stated.reason == 0) & (assumed.reason == 0)
    added = thin_shell_obliquity(stated.elevation_deg[used]) * 3.0  # all signals of the log are near L1
    np.testing.assert_allclose(assumed.sigma_m[used] ** 2, stated.sigma_m[used] ** 2 + added**2, rtol=1e-3)
    # the residuals show how little of it there is, and the learnt noise scale follows
    assert assumed.along_sigma_m[0] > 1.3 * stated.along_sigma_m[0]
    assert (assumed.protection.level.level_m > 1.3 * stated.protection.level.level_m).all()


@pytest.mark.requirement("B4")
@pytest.mark.requirement("C2")
def test_an_accuracy_worse_than_usual_is_believed() -> None:
    """Of one satellite's records the stated accuracy becomes 4.85 m, 6.85 m, 64 m: usual, added to sigma, unusable."""
    navigation, parts = clean_navigation(), {name: log[:40] for name, log in clean_observations().items()}
    of_g = np.char.startswith(navigation.kepler.satellite, "G")
    name = str(navigation.kepler.satellite[of_g][0])

    def solved(accuracy_m: float) -> AntennaResult:
        kepler = navigation.kepler
        accuracy = np.where(kepler.satellite == name, accuracy_m, kepler.accuracy_m)
        config = parse_config({"filter": "off", "screens": ["elevation"]})
        known = replace(navigation, kepler=replace(kepler, accuracy_m=accuracy))
        return EpochProcessor(config, clean_trajectories(), navigation=known).process(parts)[0].antennas["front"]

    usual, worse, none = (solved(accuracy) for accuracy in (4.85, 6.85, 64.0))
    here = usual.satellite == name
    used = (usual.reason == 0) & here
    assert used.any(axis=1).all()
    np.testing.assert_allclose(worse.sigma_m[used], np.hypot(usual.sigma_m[used], 6.85), rtol=1e-6)
    np.testing.assert_allclose(worse.sigma_m[:, ~here], usual.sigma_m[:, ~here], rtol=1e-6)
    assert (none.reason[used] == Reason.UNHEALTHY).all()
    assert (worse.protection.level.level_m > usual.protection.level.level_m).all()


@pytest.mark.requirement("C3")
def test_what_widens_the_ranges_is_counted_once_in_the_position() -> None:
    """All records state 40 m, or the noise of every range has 40 m more: the same positions and sigmas."""
    navigation, parts = clean_navigation(), {name: log[:40] for name, log in clean_observations().items()}
    stated = replace(navigation, kepler=replace(navigation.kepler, accuracy_m=np.full(len(navigation.kepler), 40.0)))

    def solved(known: Navigation, floor_m: float) -> AntennaResult:
        config = {"systems": ["G"], "screens": ["elevation"], "noise": {"floor_sigma_m": floor_m}}
        processor = EpochProcessor(parse_config(config), clean_trajectories(), navigation=known)
        return processor.process(parts)[0].antennas["front"]

    by_records, by_noise = solved(stated, 1.0), solved(navigation, float(np.hypot(1.0, 40.0)))
    np.testing.assert_allclose(by_records.sigma_m, by_noise.sigma_m, rtol=1e-9)
    np.testing.assert_allclose(by_records.along_sigma_m, by_noise.along_sigma_m, rtol=1e-6)
