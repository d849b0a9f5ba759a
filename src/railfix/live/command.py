"""Implementation of ``railfix live``: a session with its inputs, outputs and result tables."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from collections.abc import Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal

import numpy as np
import polars as pl

from railfix import kernels
from railfix.core.arrays import Floats
from railfix.core.errors import OutputError, SettingsError
from railfix.io.logs import read_navigation
from railfix.live.channels import TwoChannels
from railfix.live.console import Metrics, PlaceWatch, SensorWatch, SessionLog, check_log_file, serve_metrics
from railfix.live.engine import LiveEngine, LiveOutput
from railfix.live.session import Hooks, run_session
from railfix.live.settings import LiveInputs, LiveSettings
from railfix.live.sinks import Outlet, open_sink, parse_file_target
from railfix.live.sources import check_source, is_file
from railfix.live.state import SavedSession, belongs_to, check_state_path, load_state, write_state
from railfix.live.stream import FOREVER, Sensed
from railfix.live.warm_up import prepare_kernels
from railfix.motion.samples import SensorSamples
from railfix.pipeline.balises import balise_notes
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.received import no_navigation
from railfix.run.driver import find_record_time
from railfix.run.output import OutputFolder, Overwrite, check_not_input
from railfix.run.processor_setup import check_base_place, make_processor, parse_position
from railfix.run.sensors import check_filter, load_balises, read_sensors, units_of_ranges
from railfix.run.sources import OpenedLine, open_line
from railfix.run.tally import TABLES, make_tables

_BLOCK = 600  #: Number of results that are collected in memory before they are written to the files.


class ResultTables:
    """Context manager that writes ``positions.*``, ``train.*`` and ``passings.*`` of a session into a folder."""

    def __init__(self, out: Path, *, overwrite: Overwrite, inputs: Sequence[Path], passings: bool) -> None:
        self._folder, self._passings = OutputFolder(out, overwrite=overwrite, inputs=list(inputs)), passings
        self._parts: dict[str, list[pl.DataFrame]] = {name: [] for name in TABLES}

    def __enter__(self) -> ResultTables:
        self._folder.__enter__()
        return self

    def add(self, output: LiveOutput) -> None:
        """Add the rows of one output to the tables; the rows are written in blocks."""
        if output.result is None or output.part == "message":
            return
        for name, table in make_tables(output.result, passings=self._passings).items():
            self._parts[name].append(table)
        if len(self._parts["positions"]) >= _BLOCK:
            self._write()

    def _write(self) -> None:
        for name, tables in self._parts.items():
            if tables:
                self._folder.append_rows(name, pl.concat(tables))
                tables.clear()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._write()
            self._folder.commit({})
        self._folder.__exit__(kind, error, trace)


#: A line that extends further than this from the reference location is rejected, because ETCS position reports cannot
#: express longer distances [m]. The value has a margin for the position uncertainty.
_REACH_OF_REFERENCE_M: Final = 300_000.0


def _files_read(inputs: LiveInputs) -> list[Path]:
    """Return every file that the session reads."""
    sources = [*inputs.sources.values(), *inputs.sensors.values()]
    logs = [Path(source.removeprefix("file:")) for source in sources if is_file(source)]
    parameters = [] if inputs.reading.jgd_parameters is None else [inputs.reading.jgd_parameters]
    return [*inputs.files.values(), *inputs.nav, *logs, *parameters]


def _check_outputs(inputs: LiveInputs) -> None:
    """Raise OutputError if a file is given for an input and an output, or for two outputs, or cannot serve as log or
    state file.
    """
    named = [parse_file_target(text) for text in inputs.send]
    written = [path for path in (*named, inputs.state, inputs.log) if path is not None]
    for k, path in enumerate(written):
        check_not_input(path, _files_read(inputs))
        if path.resolve() in [other.resolve() for other in written[:k]]:
            raise OutputError(f"{path}: is given for two outputs; give another file for one of them")
    if inputs.log is not None:
        check_log_file(inputs.log)
    if inputs.state is not None:
        check_state_path(inputs.state)


async def run_live(inputs: LiveInputs) -> tuple[list[str], bool]:
    """Run a session until its sources end, or until SIGINT or SIGTERM.

    Return the lines of the summary, and whether SIGTERM ended the session. A SIGHUP is only logged and counted. Raise
    RailfixError if a source, sink, file or setting is invalid, or if the two channels disagree.
    """
    for source in (*inputs.sources.values(), *inputs.sensors.values()):
        check_source(source)
    if inputs.live.gga_s > 0.0 and not (inputs.base or "").startswith("ntrip"):
        raise SettingsError("--live gga_s is given without an NTRIP caster as --base; specify a caster, or omit gga_s")
    _check_outputs(inputs)
    check_filter(inputs.config, inputs.sensors)
    live = inputs.live
    tables = read_sensors(
        **{name: Path(path.removeprefix("file:")) for name, path in inputs.sensors.items() if is_file(path)}
    )
    line, processor = _prepare(inputs, tables)
    if any(text.startswith("etcs@") for text in inputs.send):
        _check_reference(line, live)
    listened = {str(name): source for name, source in inputs.sensors.items() if not is_file(source)}
    replay = inputs.speed is None and not listened and all(is_file(source) for source in inputs.sources.values())
    async with contextlib.AsyncExitStack() as held:
        messages_on_terminal = sys.stdout.isatty() and any(text.endswith("@-") for text in inputs.send)
        log = SessionLog(inputs.log, live, status=not messages_on_terminal)
        held.callback(log.close)
        if prepare_kernels():
            log.say("kernels compiled for this processor; later sessions load them")
        kernels.load()
        sinks = []
        for text in inputs.send:
            full = "wait" if replay else "drop"
            sinks.append(await open_sink(text, live, overwrite=inputs.overwrite, full=full))
            held.callback(sinks[-1].close)
        engine = LiveEngine(processor, live, tuple(inputs.sensors))
        if inputs.channels == "2":
            engine = TwoChannels(processor, live, tuple(inputs.sensors))
            held.callback(engine.close)
        for note in engine.frame.notes:
            log.say(note)
        hooks, streams = _hooks(inputs, live, engine, log, held, full="wait" if replay else "drop")
        if inputs.metrics is not None:
            held.callback((await serve_metrics(hooks.metrics, inputs.metrics)).close)
        for name in set(inputs.sensors) - set(listened):
            samples = SensorSamples(**{str(name): getattr(tables, name)})
            table = Sensed(sensor=name, samples=samples, until=FOREVER)
            engine.add_samples(table)
            if hooks.sensed is not None:
                hooks.sensed(table)
        terminated = await _run_until_signal(
            run_session(
                engine, dict(inputs.sources.items()), sinks, speed=inputs.speed, sensors=listened, hooks=hooks,
                date=inputs.logs.instant, streams=streams,
            ),
            hooks.metrics, log,
        )  # fmt: skip
    return hooks.metrics.summary(), terminated


async def _run_until_signal(session: Coroutine[Any, Any, object], metrics: Metrics, log: SessionLog) -> bool:
    """Run a session until it ends or a SIGINT or SIGTERM arrives; return whether SIGTERM ended the session."""
    task, loop, terminated = asyncio.ensure_future(session), asyncio.get_running_loop(), False

    def hung_up() -> None:
        metrics.hangups += 1
        log.say("SIGHUP: nothing is reloaded; to change settings, map or vehicle, restart the program")

    def terminate() -> None:
        nonlocal terminated
        terminated = True
        task.cancel()

    loop.add_signal_handler(signal.SIGINT, task.cancel)
    loop.add_signal_handler(signal.SIGTERM, terminate)
    loop.add_signal_handler(signal.SIGHUP, hung_up)
    with contextlib.suppress(asyncio.CancelledError):
        await task
    return terminated


def _hooks(
    inputs: LiveInputs,
    live: LiveSettings,
    engine: LiveEngine,
    log: SessionLog,
    held: contextlib.AsyncExitStack,
    *,
    full: str,
) -> tuple[Hooks, Mapping[str, Any]]:
    """Return the session's hooks, and the states of the receiver streams as stored in the state file.

    The hooks write the result tables and the state file, show the status line, and check the sensors. The states are
    empty if there is no usable state file.
    """
    observers: list[Callable[[LiveOutput], None]] = [PlaceWatch(log.say).take]

    def say_balises(output: LiveOutput) -> None:
        if output.result is not None and output.part != "message":
            for name, own in output.result.fusion.items():
                for note in balise_notes(name, own.passings):
                    log.say(note)

    if engine.processor.balises is not None:
        observers.append(say_balises)
    sensed, save, streams = None, None, {}
    if inputs.out is not None:
        kept, passings = _files_read(inputs), engine.processor.balises is not None
        tables = held.enter_context(
            ResultTables(inputs.out, overwrite=inputs.overwrite, inputs=kept, passings=passings)
        )
        rows: Outlet[LiveOutput] = Outlet(f"tables {inputs.out}", tables.add, waiting=live.waiting * 10, full=full)
        held.callback(_close, rows, log)
        observers.append(rows.send)
    if inputs.sensors:
        watch = SensorWatch(engine.processor, log.say)
        held.callback(watch.judge)
        watched: Outlet[LiveOutput | Sensed] = Outlet("sensor checks", watch.take, waiting=1000, full=full)
        held.callback(_close, watched, log)
        observers.append(watched.send)
        sensed = watched.send
    if inputs.state is not None:
        settings = {"settings": inputs.config, "track reading": inputs.reading}
        path, under = inputs.state, belongs_to(inputs.files, settings, tuple(inputs.sources), base=inputs.base_place)
        loaded = load_state(path, under)
        log.say(loaded.outcome)
        if loaded.session is not None:
            engine.resume(loaded.session.engine)
            streams = dict(loaded.session.streams)
        states: Outlet[SavedSession] = Outlet(
            f"state file {path}", lambda session: write_state(path, session, under), waiting=1
        )
        held.callback(_close, states, log)
        save = states.send

    def observe(output: LiveOutput) -> None:
        for observer in tuple(observers):
            try:
                observer(output)
            except OutputError as error:  # closing the outlet raises the error again
                observers.remove(observer)
                log.say(f"{error}; this output has ended, but the others continue")

    show = log.show if log.shows_status else None
    return Hooks(observe=observe, sensed=sensed, save=save, show=show), streams


def _close(outlet: Outlet[Any], log: SessionLog) -> None:
    """Close an outlet, and log how many items were dropped and how many the target refused."""
    outlet.close()
    if outlet.dropped or outlet.failed:
        reason = f"; it {outlet.failure}" if outlet.failure else ""
        log.say(f"{outlet.name}: {outlet.dropped} items dropped, {outlet.failed} items not delivered{reason}")


def _prepare(inputs: LiveInputs, tables: SensorSamples) -> tuple[OpenedLine, EpochProcessor]:
    """Read the files that are needed at the start; return the line, and an epoch processor with the files' data."""
    config = inputs.config
    if config.sbas and config.sbas != "stream":
        raise SettingsError(
            "--sbas: a live session does not read recorded SBAS messages; use --sbas stream for the messages in the "
            "receivers' streams, and --set sbas_prn=PRN to select the satellite"
        )
    units = units_of_ranges(tables, inputs.ranging_units, ranging=inputs.sensors.get("ranging"))
    navigation = no_navigation()
    if inputs.nav:
        navigation = read_navigation(list(inputs.nav), **inputs.logs.arguments)
    at = find_record_time(navigation)
    if at is None:
        at = np.datetime64("now", "ns") if inputs.logs.instant is None else inputs.logs.instant
    line = open_line(inputs.track, inputs.vehicle, antennas=inputs.antennas, reading=inputs.reading, at=at)
    balises = load_balises(
        inputs.sensors.get("balises"), inputs.balise_list, inputs.virtual_balises, line.track, config
    )
    base: Floats | Literal["stream"] | None = None
    check_base_place(inputs.base, inputs.base_place)
    if inputs.base is not None:
        base = "stream" if inputs.base_place is None else parse_position(inputs.base_place, "--base-place")
    return line, make_processor(
        config, navigation, line.trajectories, track=line.track, units=units, balises=balises, base_ecef_m=base
    )


def _check_reference(line: OpenedLine, live: LiveSettings) -> None:
    ends = (0.0, float(line.track.chainage_m[-1]))
    if max(abs(end - live.reference_m) for end in ends) > _REACH_OF_REFERENCE_M:
        raise SettingsError(
            f"--live reference_m={live.reference_m:g}: the line extends from 0 to {ends[1]:.0f} m, but position "
            f"reports reach only {_REACH_OF_REFERENCE_M:.0f} m from the reference location; choose one nearer"
        )
