"""Navigation records and corrections received so far."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, Protocol, Self, TypeVar

import numpy as np

from railfix.core.arrays import Floats, Strings, join_rows, take_rows
from railfix.core.errors import SettingsError
from railfix.core.timescale import timedelta
from railfix.gnss.navigation import GlonassRecords, KeplerRecords, Navigation
from railfix.gnss.orbits.prepared_records import VALIDITY_S, validity_s
from railfix.gnss.plausible_records import plausible_navigation
from railfix.pipeline.config import Config
from railfix.ranges.base_station import BaseErrors, BaseStationSource
from railfix.ranges.sources import BroadcastSource, CorrectionSource, choose_ionosphere

Records = TypeVar("Records", KeplerRecords, GlonassRecords)

#: Element types of the fields of record tables; keys are names of array types (`railfix.core.arrays`).
_ELEMENTS: Final[dict[str, Any]] = {
    "Strings": "<U3",
    "Datetimes": "datetime64[ns]",
    "Floats": np.float64,
    "Integers": np.int64,
}
#: Shapes of two-dimensional fields in a record table without rows.
_EMPTY: Final[dict[str, tuple[int, ...]]] = {
    **dict.fromkeys(("position_ecef_m", "velocity_ecef_mps", "acceleration_ecef_mps2"), (0, 3)),
    "inter_signal_s": (0, 6),
}
#: Fields by which Keplerian records are compared to find repeated ones.
_KEPLER_KEY: Final = ("satellite", "message", "toe", "toc", "iode", "iodc", "health")
_GLONASS_KEY: Final = ("satellite", "toe", "health")


def _no_records(kind: type[Records]) -> Records:
    """Return a record table without rows; vectors of GLONASS have shape (0, 3), inter-signal corrections (0, 6)."""
    arrays = {
        item.name: np.empty(_EMPTY.get(item.name, (0,)), dtype=_ELEMENTS[str(item.type)]) for item in fields(kind)
    }
    return kind(**arrays)


def no_navigation() -> Navigation:
    """Return navigation data without records: the state before the first message."""
    return Navigation(kepler=_no_records(KeplerRecords), glonass=_no_records(GlonassRecords))


class MessageCorrections(Protocol):
    """Immutable corrections from messages received during a run, such as SBAS messages.

    `railfix.ranges.sbas.SbasState` implements this interface for SBAS.
    """

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the corrections and on the messages of a recorded log, one sentence each."""

    @property
    def dual_frequency(self) -> bool:
        """Whether the corrections are for ionosphere-free codes, instead of codes on one frequency."""

    @property
    def span(self) -> tuple[np.datetime64, np.datetime64]:
        """Reception times of the first and the last message; NaT without messages."""

    def add_messages(self, messages: Any) -> Self:
        """Return the corrections with further messages; raise TypeError or SettingsError for other message types."""

    def drop_before(self, time: np.datetime64) -> Self:
        """Return the corrections without the messages that no epoch from `time` on can use."""

    def source(self, models: BroadcastSource) -> CorrectionSource:
        """Return the source of corrections from the messages and from the navigation records of `models`."""


@dataclass(frozen=True, kw_only=True)
class Received:
    """Data received in addition to the observations, up to the current epoch."""

    navigation: Navigation = field(default_factory=no_navigation)
    corrections: MessageCorrections | None = None  #: Corrections from SBAS messages; None without SBAS.
    #: Ionospheric coefficients in use, shape (8,); None if the ionosphere is uncorrected, or corrected by SBAS.
    klobuchar: Floats | None = None
    #: Standard deviation of the vertical ionospheric delay if typical coefficients replace broadcast ones, otherwise 0.
    ionosphere_sigma_m: float = 0.0
    notes: tuple[str, ...] = ()  #: Notes, one for each kind of requested data that was replaced.
    base: BaseErrors | None = None  #: Range errors measured by a base station; None without one.


def broadcast_source(received: Received, config: Config) -> BroadcastSource:
    """Return the source of corrections from navigation records and delay models alone."""
    return BroadcastSource(
        navigation=received.navigation, klobuchar=received.klobuchar, ionosphere_sigma_m=received.ionosphere_sigma_m,
        troposphere=config.troposphere, nominal=config.nominal,
    )  # fmt: skip


def correction_source(received: Received, config: Config) -> CorrectionSource:
    """Return the source of corrections from the received data."""
    models = broadcast_source(received, config)
    source = models if received.corrections is None else received.corrections.source(models)
    return with_base_station(source, received, config)


def with_base_station(source: CorrectionSource, received: Received, config: Config) -> CorrectionSource:
    """Return the source with the errors measured by a base station; without a station, return the source unchanged."""
    if received.base is None:
        return source
    return BaseStationSource(
        other=source, errors=received.base, limits=config.base, floor_sigma_m=config.noise.floor_sigma_m
    )


def known_from_start(
    config: Config, *, navigation: Navigation | None = None, corrections: MessageCorrections | None = None
) -> Received:
    """Return the data known before the first epoch: all data in post-processing, none in real time on the train.

    Raise SettingsError if SBAS is combined with precise ephemerides.
    """
    return _with_notes(Received(navigation=navigation or no_navigation(), corrections=corrections), config)


def check_corrections(config: Config, corrections: MessageCorrections | None) -> None:
    """Raise SettingsError if only SBAS settings or only corrections are given, or if their frequencies differ."""
    if bool(config.sbas) != (corrections is not None):
        given, state = "not given" if corrections is None else "given", "on" if config.sbas else "off"
        raise SettingsError(
            f"SBAS is {state} in the settings (sbas), but SBAS corrections were {given}; give both: "
            "Config(sbas='stream', sbas_prn=137), EpochProcessor(..., corrections=SbasState(prn=137))"
        )
    if corrections is not None and corrections.dual_frequency != config.dual_frequency_sbas:
        used = "L5" if corrections.dual_frequency else "L1"
        raise SettingsError(f"sbas_band = {config.sbas_band}, but the corrections are for SBAS on {used}; use one band")


def receive(
    before: Received,
    config: Config,
    time: np.datetime64,
    *,
    navigation: Navigation | None = None,
    messages: Any = None,
) -> Received:
    """Add new navigation records and messages to the received data; return `before` itself if nothing is new.

    `time` is the time of the next epoch, NaT if unknown. Messages that no epoch from `time` on can use are dropped.
    Repeated and expired records are dropped as well, except for a satellite's newest record. Newer ionospheric
    coefficients and precise ephemerides replace older ones. With SBAS, every satellite is rejected until its
    corrections are complete. Raise SettingsError if SBAS is combined with precise ephemerides, if the messages do not
    match the corrections, or if messages are given without corrections.
    """
    if navigation is None and messages is None:
        return before
    after = before
    if navigation is not None:
        merged = merge_navigation(before.navigation, plausible_navigation(navigation))
        after = replace(before, navigation=_current(merged, time))
    if messages is not None:
        if before.corrections is None:
            raise SettingsError(
                "messages were given, but SBAS is off; turn it on: Config(sbas='stream', sbas_prn=137), "
                "EpochProcessor(..., corrections=SbasState(prn=137))"
            )
        corrections = before.corrections.add_messages(messages)
        after = replace(after, corrections=corrections if np.isnat(time) else corrections.drop_before(time))
    return _with_notes(after, config)


def _with_notes(received: Received, config: Config) -> Received:
    """Return the data with the ionospheric coefficients in use and notes on replacements of requested data."""
    corrections = received.corrections
    if corrections is not None and received.navigation.precise is not None:
        raise SettingsError("SBAS corrects broadcast records, not precise orbits; use either --sbas or --sp3")
    received = _with_ionosphere(received, config)
    return received if corrections is None else replace(received, notes=(*received.notes, *corrections.notes))


def _current(navigation: Navigation, time: np.datetime64) -> Navigation:
    """Return navigation data without records that no epoch from `time` on can use."""
    if np.isnat(time):
        return navigation
    kepler, glonass = navigation.kepler, navigation.glonass
    return replace(
        navigation,
        kepler=_drop_expired(kepler, np.char.add(kepler.satellite, kepler.message), validity_s(kepler), time),
        glonass=_drop_expired(glonass, glonass.satellite, np.full(len(glonass), VALIDITY_S["R"]), time),
    )


def _drop_expired(table: Records, label: Strings, validity: Floats, time: np.datetime64) -> Records:
    """Return the rows of a table that are valid at `time` or later, and the newest row of each label."""
    kept = table.toe + timedelta(validity) >= time
    if kept.all():
        return table
    order = np.argsort(table.toe, kind="stable")
    kept[order[len(order) - 1 - np.unique(label[order][::-1], return_index=True)[1]]] = True
    return take_rows(table, kept)


def merge_navigation(old: Navigation, new: Navigation) -> Navigation:
    """Return the union of old and new navigation data."""
    return Navigation(
        kepler=_unite(old.kepler, new.kepler, _KEPLER_KEY),
        glonass=_unite(old.glonass, new.glonass, _GLONASS_KEY),
        klobuchar={**old.klobuchar, **new.klobuchar},
        leap_seconds=old.leap_seconds if new.leap_seconds is None else new.leap_seconds,
        skipped={kind: old.skipped.get(kind, 0) + new.skipped.get(kind, 0) for kind in {**old.skipped, **new.skipped}},
        notes=tuple(dict.fromkeys((*old.notes, *new.notes))),
        precise=old.precise if new.precise is None else new.precise,
        sources=tuple(dict.fromkeys((*old.sources, *new.sources))),
    )


def _unite(old: Records, new: Records, key: tuple[str, ...]) -> Records:
    """Return the rows of both tables; rows of `new` that duplicate a row of `old` are left out."""
    known = set(zip(*(getattr(old, name).tolist() for name in key), strict=True))
    rows = zip(*(getattr(new, name).tolist() for name in key), strict=True)
    fresh = np.array([row not in known for row in rows], dtype=bool)
    return join_rows([old, take_rows(new, fresh)]) if fresh.any() else old


def _with_ionosphere(received: Received, config: Config) -> Received:
    """Return the data with the Klobuchar coefficients in use, and notes if other models were requested."""
    if received.corrections is not None and received.corrections.dual_frequency:
        # the screens still use the Klobuchar model; its delays cancel in the ionosphere-free combination
        modelled = _with_ionosphere(replace(received, corrections=None), config)
        note = (
            f"ionosphere: {config.ionosphere}, frequencies: {config.frequencies} requested, ionosphere-free codes used "
            f"instead; troposphere: {config.troposphere} requested, SBAS model used instead"
        )
        return replace(modelled, corrections=received.corrections, notes=(note,))
    if received.corrections is not None:
        asked = f"ionosphere: {config.ionosphere}, troposphere: {config.troposphere}"
        note = f"{asked} requested, SBAS models used instead"
        return replace(received, klobuchar=None, ionosphere_sigma_m=0.0, notes=(note,))
    coefficients, sigma, notes = choose_ionosphere(received.navigation, config.ionosphere, config.nominal)
    return replace(received, klobuchar=coefficients, ionosphere_sigma_m=sigma, notes=notes)
