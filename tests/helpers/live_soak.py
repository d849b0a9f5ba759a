"""A day of a live session as fast as it goes: memory, messages, what is kept of ephemerides and SBAS messages.

Two antennas of a simulated train that runs to and fro on a line of 36 km, with the filter along the track; ephemerides
come when they are sent, messages go into a file, the state is encoded every 360 epochs. Prints memory hour by hour.
"""

from __future__ import annotations

import asyncio
import resource
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import railfix
from railfix.gnss.navigation import Navigation
from railfix.io.train_message import from_json
from railfix.live import session
from railfix.live.channels import TwoChannels
from railfix.live.engine import LiveEngine, LiveOutput
from railfix.live.session import Hooks, run_session
from railfix.live.settings import LiveSettings
from railfix.live.sinks import open_sink
from railfix.live.state import SavedSession
from railfix.live.state_values import encode
from railfix.live.stream import ReceivedData, ReceiverState, single_epochs
from railfix.ranges.sbas import SbasMessages, SbasState, read_sbas
from railfix.simulate import LineSettings, RunSettings, Scenario, write_run

HOUR = np.timedelta64(3600, "s")


def resident_mb() -> float:
    """Memory of this process now [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def sent_by(navigation: Navigation, after: np.datetime64, until: np.datetime64) -> Navigation | None:
    """Records transmitted in a span of time."""
    kepler = navigation.kepler
    rows = (kepler.transmitted > after) & (kepler.transmitted <= until)
    if not rows.any():
        return None
    names = kepler.__dataclass_fields__
    part = replace(kepler, **{name: getattr(kepler, name)[rows] for name in names})
    return replace(navigation, kepler=part)


def soak(folder: Path, *, hours: float, rate_hz: float, sbas: bool = False, channels: int = 1) -> dict[str, Any]:
    """Run a session over a simulated day; return what it left. Two channels that differ end it."""
    files = simulated(folder, hours, rate_hz, sbas=sbas)
    track, vehicle = railfix.read_track([files["track"]]), railfix.read_vehicle(files["vehicle"])
    navigation = railfix.read_navigation(files["nav"])
    start = railfix.read_observations(files["front"])[:1].time[0]
    messages = read_sbas(files["sbas"]) if sbas else None
    config = railfix.Config(filter="track", **({"sbas": "stream", "sbas_prn": 137} if sbas else {}))
    processor = railfix.EpochProcessor(
        config,
        {name: railfix.antenna_trajectory(track, vehicle, name) for name in ("front", "rear")},
        navigation=sent_by(navigation, np.datetime64("1980-01-06", "ns"), start),
        corrections=SbasState(prn=137) if sbas else None,
    )
    settings = LiveSettings(period_s=min(1.0 / rate_hz, 60.0), no_input="skip")
    engine = (TwoChannels if channels == 2 else LiveEngine)(processor, settings)
    memory: list[float] = []
    counts = {"outputs": 0, "saved": 0}

    def observe(_: LiveOutput) -> None:
        counts["outputs"] += 1
        if counts["outputs"] % 360 == 0:
            saved = engine.export_state()
            counts["saved"] = len(encode(SavedSession(engine=saved, streams={})))
        if counts["outputs"] % max(1, round(3600 * rate_hz)) == 0:
            memory.append(resident_mb())
            print(f"{len(memory):3d} h  {memory[-1]:7.1f} MB  state {counts['saved'] / 1e3:.0f} kB", flush=True)

    async def arrivals(source: str, state: ReceiverState, *_: object) -> AsyncIterator[ReceivedData]:
        last, front = start, source == str(files["front"])
        for piece in railfix.scan_observations(source, epochs=100):
            for epoch in single_epochs(piece):
                now, heard = epoch.time[0], None
                new = sent_by(navigation, last, now) if front else None
                if messages is not None and front:
                    heard = between(messages, last, now)
                last = now
                if heard is not None:
                    engine.add_sbas(heard)
                yield ReceivedData(epochs=(epoch,), navigation=new, after=state)
                await asyncio.sleep(0)

    async def run() -> None:
        sink = await open_sink(f"json@{folder / 'messages.jsonl'}", full="wait", overwrite="replace")
        with patch.object(session, "arrivals", arrivals):
            sources = {name: str(files[name]) for name in ("front", "rear")}
            await run_session(engine, sources, [sink], speed=None, hooks=Hooks(observe=observe))
        sink.close()

    try:
        asyncio.run(run())
    finally:
        if isinstance(engine, TwoChannels):
            engine.close()
    numbers = [from_json(line).sequence for line in (folder / "messages.jsonl").read_text().splitlines()]
    saved = engine.export_state()
    assert saved is not None
    assert saved.state.received is not None
    return {
        "memory_mb": memory,
        "sequence": numbers,
        "epochs": round(hours * 3600 * rate_hz),
        "records": len(saved.state.received.navigation.kepler),
        "records_of_the_day": len(navigation.kepler),
        "sbas_messages": 0 if (held := saved.state.received.corrections) is None else len(held.messages),
        "state_bytes": counts["saved"],
        "counts": dict(engine.counts),
        "tracking": float(np.mean([m.chainage_cm is not None for m in _messages(folder)])),
    }


def _messages(folder: Path) -> list[Any]:
    return [from_json(line) for line in (folder / "messages.jsonl").read_text().splitlines()]


def between(messages: SbasMessages, after: np.datetime64, until: np.datetime64) -> SbasMessages | None:
    rows = np.flatnonzero((messages.time > after) & (messages.time <= until))
    return messages.take(rows) if len(rows) else None


def simulated(folder: Path, hours: float, rate_hz: float, *, sbas: bool) -> dict[str, Path]:
    """Files of the run."""
    values: dict[str, Any] = {"sbas": {"prn": 137}} if sbas else {}
    line, run = LineSettings(length_m=36_000.0), RunSettings(cruise_mps=25.0)
    scenario = Scenario(duration_s=hours * 3600.0, rate_hz=rate_hz, line=line, run=run, **values)
    return write_run(scenario, folder / "run", packing="plain")
