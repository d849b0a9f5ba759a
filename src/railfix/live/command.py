"""A live session from its inputs: what ``railfix live`` does."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from railfix.core.errors import SettingsError
from railfix.core.settings import Settings, read_toml, validated
from railfix.gnss.navigation import Navigation
from railfix.io.logs import read_navigation
from railfix.live.channels import TwoChannels
from railfix.live.engine import LiveEngine
from railfix.live.record import ResultTables
from railfix.live.session import Metrics, run_session, serve_metrics
from railfix.live.settings import LiveSettings
from railfix.live.sinks import open_sink
from railfix.live.sources import check_source
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.received import no_navigation
from railfix.ranges.cn0_curve import read_cn0_curve
from railfix.ranges.error_model import read_error_model
from railfix.run.options import TrackReading
from railfix.run.sources import open_line


class LiveInputs(Settings):
    """Inputs of a live session; see ``railfix live --help``."""

    sources: dict[Literal["front", "rear"], str]
    track: tuple[Path, ...]
    vehicle: Path | None = None
    nav: tuple[Path, ...] = ()
    config: Path | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    live: dict[str, Any] = Field(default_factory=dict)
    send: tuple[str, ...] = ("json@-",)
    speed: float | None = None
    channels: Literal[1, 2] = 1
    metrics: str | None = None
    out: Path | None = None
    overwrite: Literal["refuse", "replace"] = "refuse"


async def run_live(inputs: LiveInputs) -> list[str]:
    """Run a session until its sources end, or SIGINT or SIGTERM; return a summary, a line each.

    Raises
    ------
    RailfixError
        A source, sink, file or setting is not what it should be, or two channels disagree.
    """
    for source in inputs.sources.values():
        check_source(source)
    live = validated(LiveSettings, inputs.live, source="--live")
    processor = _processor(inputs)
    sinks = [await open_sink(text, overwrite=inputs.overwrite) for text in inputs.send]
    engine: LiveEngine | TwoChannels = (
        TwoChannels(processor, live) if inputs.channels == 2 else LiveEngine(processor, live)
    )
    metrics, server = Metrics(), None
    try:
        if inputs.metrics is not None:
            host, _, port = inputs.metrics.rpartition(":")
            if not host or not port.isdigit():
                raise SettingsError(f"--metrics {inputs.metrics!r}: expected HOST:PORT, for example 127.0.0.1:9100")
            server = await serve_metrics(metrics, engine, host, int(port))
        with contextlib.ExitStack() as held:
            tables = None
            if inputs.out is not None:
                files = (*inputs.track, *inputs.nav, *filter(None, (inputs.vehicle, inputs.config)))
                tables = held.enter_context(ResultTables(inputs.out, overwrite=inputs.overwrite, inputs=files))
            session = asyncio.create_task(
                run_session(
                    engine,
                    dict(inputs.sources.items()),
                    sinks,
                    speed=inputs.speed,
                    metrics=metrics,
                    observe=None if tables is None else tables.add,
                )
            )
            loop = asyncio.get_running_loop()
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, session.cancel)
            with contextlib.suppress(asyncio.CancelledError):
                await session
    finally:
        for sink in sinks:
            sink.close()
        if server is not None:
            server.close()
        if isinstance(engine, TwoChannels):
            engine.close()
    return _summary(metrics, engine)


def _summary(metrics: Metrics, engine: LiveEngine | TwoChannels) -> list[str]:
    lines = [f"{sum(metrics.messages.values()):,} messages"]
    lines += [f"  {status.name.lower()}: {number:,}" for status, number in sorted(metrics.messages.items())]
    lines += [f"epochs {fate}: {number:,}" for fate, number in sorted(engine.counts.items())]
    lines += [f"skipped: {number:,} {what}" for what, number in sorted(metrics.skipped.items()) if number]
    if metrics.processing_s:
        p50, p99 = (1e3 * float(np.quantile(metrics.processing_s, q)) for q in (0.5, 0.99))
        lines.append(f"processing of the last {len(metrics.processing_s)} messages: median {p50:.1f}, p99 {p99:.1f} ms")
    return lines


def _processor(inputs: LiveInputs) -> EpochProcessor:
    """The epoch processor with everything known from the start."""
    values = {} if inputs.config is None else read_toml(inputs.config, what="a configuration file")
    config: Config = parse_config(
        _over({"filter": "track", **values}, inputs.settings), source=str(inputs.config or "--set")
    )
    if config.sbas:
        raise SettingsError("sbas names recorded messages; live, SBAS messages come with the receivers' streams")
    navigation: Navigation = read_navigation(list(inputs.nav)) if inputs.nav else no_navigation()
    at = navigation.kepler.toc.max() if len(navigation.kepler) else np.datetime64("now", "ns")
    line = open_line(inputs.track, inputs.vehicle, antennas=tuple(inputs.sources), reading=TrackReading(), at=at)
    return EpochProcessor(
        config,
        line.trajectories,
        navigation=navigation,
        error_model=None if config.error_model is None else read_error_model(config.error_model),
        cn0_curve=None if config.cn0_curve is None else read_cn0_curve(config.cn0_curve),
    )


def _over(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Nested settings with changes put over them."""
    merged = dict(values)
    for name, change in changes.items():
        before = merged.get(name)
        both = isinstance(before, dict) and isinstance(change, dict)
        merged[name] = _over(before, change) if both and isinstance(before, dict) else change
    return merged
