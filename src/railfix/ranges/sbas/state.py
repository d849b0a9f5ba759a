"""SBAS messages received so far, and the corrections and the correction source that follow from these messages."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from railfix.core.errors import check_type
from railfix.core.timescale import seconds
from railfix.ranges.sbas.corrections import SbasCorrections
from railfix.ranges.sbas.dfmc import MASK_S, DfmcService
from railfix.ranges.sbas.limits import SbasLimits
from railfix.ranges.sbas.messages import Band, SbasMessages
from railfix.ranges.sbas.sbas_sources import DfmcSource, SbasSource
from railfix.ranges.sbas.standard import LEANT_ON, OLDEST_S
from railfix.ranges.sources import BroadcastSource, CorrectionSource


@dataclass(frozen=True, kw_only=True)
class SbasState:
    """Messages of one GEO received so far; `add_messages` returns a new state with further messages.

    The corrections at an epoch are the same as from the complete log, however the messages are divided into parts: a
    message is used from its reception on, and `drop_before` drops only messages that no later epoch can use.

    ::

        state = SbasState(prn=137)
        state = state.add_messages(messages)  # whenever some arrive
        fixes = state.corrections.satellites(time, satellite, navigation)
        state = state.drop_before(time[-1])  # what later epochs need
    """

    prn: int  #: PRN of the GEO, set in advance, because the best PRN is known only at the end of a log.
    limits: SbasLimits = field(default_factory=SbasLimits)
    #: Messages of this PRN, in the order of reception.
    messages: SbasMessages = field(default_factory=SbasMessages.none)
    band: Band = "L1"  #: Frequency band on which the messages are sent.
    #: Notes on the messages and corrections of a recorded log; None for live messages.
    log_notes: tuple[str, ...] | None = None

    @classmethod
    def from_log(
        cls,
        messages: SbasMessages,
        *,
        prn: int | Literal["best"] = "best",
        limits: SbasLimits | None = None,
        band: Band = "L1",
    ) -> SbasState:
        """Return the state after the messages of a recorded log; ValueError without messages of the requested PRN."""
        limits = limits or SbasLimits()
        of_log: SbasCorrections | DfmcService = (
            DfmcService.from_log(messages, prn=prn)
            if band == "L5"
            else SbasCorrections.from_log(messages, prn=prn, limits=limits)
        )
        state = cls(prn=of_log.prn, limits=limits, band=band).add_messages(messages)
        return replace(state, log_notes=of_log.notes)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the corrections, and on the messages of a recorded log."""
        return self.corrections.notes if self.log_notes is None else self.log_notes

    def add_messages(self, messages: SbasMessages) -> SbasState:
        """Return the state after more messages.

        Messages of other PRNs, and repetitions of a message by a second receiver, are left out.

        Raise SettingsError if `messages` are not `SbasMessages`.
        """
        check_type(messages, SbasMessages, "messages")
        joined = self.messages.merge(messages.of(self.prn))
        return replace(self, messages=joined.take(~joined.repeated()), log_notes=None)

    @property
    def dual_frequency(self) -> bool:
        """Whether the corrections are for ionosphere-free codes, which is the case for SBAS on L5."""
        return self.band == "L5"

    @property
    def span(self) -> tuple[np.datetime64, np.datetime64]:
        """Times of reception of the first and the last message, NaT if there are no messages."""
        return self.corrections.span

    def source(self, models: BroadcastSource) -> CorrectionSource:
        """Return the source of corrections from the messages received so far, for the navigation records of `models`.

        With SBAS on L5, the screens use the ionospheric delays of `models`; these delays cancel in the positions.
        """
        if isinstance(self.corrections, DfmcService):
            return DfmcSource(models=models, service=self.corrections)
        return SbasSource(navigation=models.navigation, corrections=self.corrections)

    @cached_property
    def corrections(self) -> SbasCorrections | DfmcService:
        """Corrections from the messages received so far."""
        if self.band == "L5":
            return DfmcService(self.messages, prn=self.prn)
        return SbasCorrections(self.messages, prn=self.prn, limits=self.limits)

    def drop_before(self, time: np.datetime64) -> SbasState:
        """Return the state without the messages that no epoch from `time` on can use."""
        kind, age = self.messages.type, seconds(time - self.messages.time)
        if self.band == "L5":  # keep the newest message of each type, and all messages of the last `MASK_S`
            newest = len(kind) - 1 - np.unique(kind[::-1], return_index=True)[1]
            kept = (age <= MASK_S) | np.isin(np.arange(len(kind)), newest)
            return self if kept.all() else replace(self, messages=self.messages.take(kept))
        oldest = np.where(kind == 27, self.limits.timeout_s("service"), OLDEST_S + 1.0)
        kept = age <= np.where(np.isin(kind, (*LEANT_ON, 27)), 2.0 * oldest, oldest)
        return self if kept.all() else replace(self, messages=self.messages.take(kept))
