"""The antennas of a run: each positioned chunk by chunk, in this process or in one of its own."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import re
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.core.errors import RailfixError, SettingsError
from railfix.motion.samples import SensorSamples
from railfix.pipeline.antenna_chunk import AntennaChunk
from railfix.pipeline.compared import PositionVerdict
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.results import State
from railfix.pipeline.smoothing import Replay, smooth
from railfix.pipeline.tables import in_time_order, observations_table, positions_table, rounded
from railfix.pipeline.train_table import smoothed_table, train_table
from railfix.run import sources
from railfix.run.beside import without_beside
from railfix.run.chunks import Pieces
from railfix.run.inputs import Antenna
from railfix.run.output import OutputFolder
from railfix.run.route import RouteOfLog
from railfix.run.sources import Log
from railfix.run.tally import AntennaTally
from railfix.screens import AntennaRanges, FilteredMotion, Screened, Verdict
from railfix.tracking import Line

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True, kw_only=True)
class ResultRows:
    """What a chunk of one antenna gives to the results: tables, None where not wanted, and counts up to its end."""

    positions: pl.DataFrame
    train: pl.DataFrame | None
    observations: pl.DataFrame | None
    tally: AntennaTally
    notes: tuple[str, ...]


def write_rows(rows: Sequence[ResultRows], line: sources.OpenedLine, folder: OutputFolder) -> None:
    """Write the rows of one chunk of all antennas, in order of time, with their tracks on a route of a network."""
    tables = {}
    for table in ("positions", "train", "observations"):
        if parts := [part for of_antenna in rows if (part := getattr(of_antenna, table)) is not None]:
            tables[table] = in_time_order(parts)
    if line.route is not None:
        tables["positions"], tables["tracks"] = line.route.on_tracks(tables["positions"], line.track)
        if "train" in tables:
            tables["train"], _ = line.route.on_tracks(tables["train"], line.track)
    for name, joined in tables.items():
        folder.append_parquet(f"{name}.parquet", joined)
        if name != "observations":
            folder.append_csv(f"{name}.csv", rounded(joined))


class AntennaRun:
    """The run of one antenna in this process: `ChunkSteps` of one chunk after the other.

    `sensors` are of the whole run; `observations`: whether rows of observations are wanted; `smooth`: whether what the
    filter was given is kept, for `smoothed`; `route` is the one through a network, None without.
    """

    def __init__(
        self,
        name: str,
        processor: EpochProcessor,
        log: Log,
        sensors: SensorSamples,
        *,
        observations: bool,
        smooth: bool = False,
        route: RouteOfLog | None = None,
    ) -> None:
        self.name, self.log, self._route = name, log, route
        self._processor, self._sensors, self._observations = processor, sensors, observations
        self._pieces = Pieces(log.parts())
        self._tally = AntennaTally(min_satellites=processor.config.min_satellites)
        self._state = State()
        self._chunk: AntennaChunk | None = None
        self._replays: Replays | None = Replays() if smooth else None

    def more(self) -> Datetimes | None:
        """Read the next piece and return its time tags; None at the end of the log."""
        return self._pieces.more()

    def read_ahead(self) -> None:
        """Read the next piece before it is asked for."""
        self._pieces.read_ahead()

    def begin(self, epochs: int, after: np.datetime64, end: np.datetime64) -> None:
        """Begin the next chunk: so many epochs, and the samples of the sensors after one instant up to another."""
        observations = {self.name: self._pieces.take(epochs)}
        sensors = self._sensors.between(after, end)
        self._chunk = self._processor.chunks(observations, self._state, sensors=sensors)[self.name]

    @property
    def chunk(self) -> AntennaChunk:
        """The chunk that was begun."""
        assert self._chunk is not None, "begin() comes first"
        return self._chunk

    def screened(self) -> AntennaRanges:
        """See `ChunkSteps`."""
        return self.chunk.screened()

    def judge(self, verdicts: Iterable[Verdict]) -> None:
        """See `ChunkSteps`."""
        self.chunk.judge(verdicts)

    def solved(self) -> Floats:
        """See `ChunkSteps`."""
        return self.chunk.solved()

    def check(self, verdicts: Iterable[PositionVerdict]) -> None:
        """See `ChunkSteps`."""
        self.chunk.check(verdicts)

    def filtered(self) -> FilteredMotion:
        """See `ChunkSteps`."""
        return self.chunk.filtered()

    def check_filter(self, spacing: Screened | None) -> None:
        """See `ChunkSteps`."""
        self.chunk.check_filter(spacing)

    def finished(self) -> ResultRows:
        """Return what the chunk gives to the results."""
        result, self._state = self._processor.gathered({self.name: self.chunk}, self._state)
        if self._route is not None:
            result = without_beside(result, self._route, self._processor.config)
        self._tally.add(result.antennas[self.name])
        if self._replays is not None:
            self._replays.keep(result.fusion[self.name].replay)
        return ResultRows(
            positions=positions_table(result),
            train=train_table(result) if result.fusion else None,
            observations=observations_table(result) if self._observations else None,
            tally=self._tally,
            notes=result.notes,
        )

    def smoothed(self) -> pl.DataFrame:
        """Return the smoothed columns of all epochs, after the last chunk."""
        assert self._replays is not None, "nothing was kept to smooth"
        trajectory = self._processor.trajectories[self.name]
        result = smooth(self._replays.backward(), Line.of(trajectory), self._processor.config.tracking)
        return smoothed_table(result, trajectory)


class Replays:
    """What the filter was given, chunk by chunk, in a file that ends with the process."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115  open as long as the run
        self._starts: list[int] = []

    def __del__(self) -> None:
        self._file.close()

    def keep(self, chunk: tuple[Replay, ...]) -> None:
        """Add a chunk."""
        self._starts.append(self._file.tell())
        pickle.dump(chunk, self._file, protocol=pickle.HIGHEST_PROTOCOL)

    def backward(self) -> Iterator[Replay]:
        """Yield what was kept, the last first."""
        for start in reversed(self._starts):
            self._file.seek(start)
            yield from reversed(pickle.load(self._file))


class OtherProcess:
    """The run of one antenna in a process of its own, which does the same at the same time.

    It is forked from this one, so it must be started before threads are (`processes`), and calls `make` there. An error
    there is raised here by the call that asks for its answer. Leaving the context ends it.
    """

    def __init__(self, name: Antenna, make: Callable[[], AntennaRun]) -> None:
        self.name = name
        self._log: Log | None = None
        context = multiprocessing.get_context("fork")
        self._pipe, there = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(there, self._pipe, make), daemon=True, name=f"railfix-{name}"
        )
        self._process.start()
        there.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pipe.close()
        if error is not None:
            self._process.terminate()
        self._process.join()

    def reads(self, log: Log) -> Self:
        """Return the same, which counts in `log` what was read and passed over there."""
        self._log = log
        return self

    @property
    def log(self) -> Log:
        """See `reads`."""
        assert self._log is not None, "reads() comes first"
        return self._log

    def _ask(self, step: str, *arguments: Any) -> None:
        with suppress(BrokenPipeError):  # it has ended; the error it has left is raised by the next answer
            self._pipe.send((step, arguments))

    def _answer(self) -> Any:
        try:
            kind, answer = self._pipe.recv()
        except EOFError:
            self._process.join()
            raise RuntimeError(
                f"the process of the {self.name} antenna ended without an answer, exit code {self._process.exitcode}"
            ) from None
        if kind == "error":
            raise _rebuilt(answer)
        return answer

    def more(self) -> Datetimes | None:
        """Return the time tags of the next piece of the log; None at its end."""
        self._ask("more")
        times, self.log.share, self.log.problems, self.log.skipped = self._answer()
        return None if times is None else np.asarray(times)

    def begin(self, epochs: int, after: np.datetime64, end: np.datetime64) -> None:
        """Begin the next chunk there."""
        self._ask("begin", epochs, after, end)
        self._ask("screened")

    def screened(self) -> AntennaRanges:
        """See `ChunkSteps`."""
        ranges: AntennaRanges = self._answer()
        return ranges

    def judge(self, verdicts: Iterable[Verdict]) -> None:
        """See `ChunkSteps`."""
        self._ask("judge", tuple(verdicts))
        self._ask("solved")

    def solved(self) -> Floats:
        """See `ChunkSteps`."""
        chainage_m: Floats = self._answer()
        return chainage_m

    def check(self, verdicts: Iterable[PositionVerdict]) -> None:
        """See `ChunkSteps`."""
        self._ask("check", tuple(verdicts))
        self._ask("filtered")

    def filtered(self) -> FilteredMotion:
        """See `ChunkSteps`."""
        filtered: FilteredMotion = self._answer()
        return filtered

    def check_filter(self, spacing: Screened | None) -> None:
        """See `ChunkSteps`."""
        self._ask("check_filter", spacing)
        self._ask("finished")

    def finished(self) -> ResultRows:
        """Return what the chunk gives to the results."""
        rows: ResultRows = self._answer()
        return rows

    def smoothed(self) -> pl.DataFrame:
        """See `AntennaRun`."""
        self._ask("smoothed")
        table: pl.DataFrame = self._answer()
        return table


def processes(asked: int) -> int:
    """Return how many processes a run may have, 1 or 2.

    `asked` 0: 2 on Linux with two processors, where this process has no other threads; otherwise 1.

    Raises
    ------
    SettingsError
        2 asked for, and this process cannot be forked.
    """
    obstacle = _obstacle()
    if asked == 2 and obstacle:
        raise SettingsError(f"workers = 2: {obstacle}; give workers = 1")
    if asked == 0:
        return 2 if not obstacle and threading.active_count() == 1 and (os.cpu_count() or 1) > 1 else 1
    return asked


def _obstacle() -> str:
    """Return why this process cannot be forked; empty where it can."""
    if sys.platform != "linux":
        return f"processes for each antenna need Linux, this is {sys.platform}"
    names = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
    # Importing polars starts helpers that wait and hold nothing; the threads that compute come with its first use.
    if any(re.fullmatch(r"polars-\d+", name) for name in names):
        return "polars has computed in this process, and a fork does not copy its threads"
    return ""


def _serve(pipe: Connection, other_end: Connection, make: Callable[[], AntennaRun]) -> None:
    """Do what the other process asks for until it hangs up; an error is the last answer."""
    other_end.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process gets it too and hangs up
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        run = make()
        run.read_ahead()
        while True:
            step, arguments = pipe.recv()
            answer = getattr(run, step)(*arguments)
            if step == "more":
                pipe.send(("more", (answer, run.log.share, run.log.problems, run.log.skipped)))
            elif step == "screened":
                shown = {item.name: getattr(answer, item.name) for item in fields(AntennaRanges)}
                pipe.send((step, AntennaRanges(**shown)))
            elif step in ("solved", "filtered", "finished", "smoothed"):
                pipe.send((step, answer))
                if step == "finished":
                    run.read_ahead()
    except (EOFError, BrokenPipeError):
        return
    except BaseException as error:  # noqa: BLE001  raised again in the process that asks
        with suppress(BrokenPipeError):
            pipe.send(("error", _send(error)))


def _send(error: BaseException) -> tuple[type[BaseException], tuple[Any, ...], dict[str, Any], str]:
    """Return an error as values that can be sent, with where it was raised."""
    where = "".join(traceback.format_exception(error))
    if isinstance(error, RailfixError | MemoryError):
        return type(error), error.args, dict(vars(error)), where
    return RuntimeError, (f"in the process of the other antenna:\n{where}",), {}, where


def _rebuilt(sent: tuple[type[BaseException], tuple[Any, ...], dict[str, Any], str]) -> BaseException:
    """Return the error again."""
    kind, arguments, values, where = sent
    error = kind.__new__(kind)
    error.args = arguments
    vars(error).update(values)
    error.add_note(where)
    return error
