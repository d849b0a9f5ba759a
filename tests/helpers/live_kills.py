"""``railfix live --state`` killed again and again.

A receiver at a TCP port sends the demonstration's epochs, whether a session reads them or not. SIGKILL ends the session
at a random instant, also before its first message; it is started again at once with its state file. Counted as lost:
messages whose number was sent before, lines that are no message, state files that are not used, and messages whose
bounds do not contain the true front end.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import socketserver
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np
import polars as pl

from railfix import read_observations
from railfix.__main__ import main as main_of_railfix
from railfix.core.timescale import GPS_EPOCH
from railfix.io.train_message import MessageError, TrainMessage, from_json
from railfix.simulate.demonstration import demo_files
from ubx_made import log_of

#: Time between two epochs of 0.1 s: slower than recorded, so that the recording outlasts the kills [s].
EPOCH_S = 0.25
#: Front end of the demonstration's train ahead of its middle [m].
HALF_M = 11.6


class Receiver(socketserver.ThreadingTCPServer):
    """A receiver that has sent an epoch every `EPOCH_S` since it was made."""

    daemon_threads = allow_reuse_address = True

    def __init__(self, epochs: list[bytes]) -> None:
        super().__init__(("127.0.0.1", 0), _Connection)
        self.epochs, self.begin = epochs, time.monotonic()
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def epoch(self) -> int:
        """Number of the next epoch."""
        return int((time.monotonic() - self.begin) / EPOCH_S)


class _Connection(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        receiver = self.server
        assert isinstance(receiver, Receiver)
        with suppress(OSError):
            for number in range(receiver.epoch, len(receiver.epochs)):
                time.sleep(max(receiver.begin + EPOCH_S * number - time.monotonic(), 0.0))
                self.request.sendall(receiver.epochs[number])


def run_railfix(words: list[str], errors: Path) -> None:
    """Run ``railfix`` in this process, until it is killed."""
    with errors.open("w") as file:
        os.dup2(file.fileno(), 2)
    sys.argv[1:] = words
    main_of_railfix()


def whole_lines(path: Path) -> list[str]:
    """Lines of a file that are written to their end; none where it does not exist."""
    text = path.read_text() if path.exists() else ""
    return text[: text.rfind("\n") + 1].splitlines()


def true_middle_m() -> dict[int, float]:
    """True chainage of the train's middle by time tag."""
    truth = pl.read_csv(demo_files()["truth"]).with_columns(
        pl.col("time_gpst").str.to_datetime(time_unit="ns", strict=False)
    )
    middle = truth.group_by("time_gpst").agg(pl.col("chainage_m").mean()).sort("time_gpst")
    tags = (middle["time_gpst"].to_numpy() - GPS_EPOCH).astype("timedelta64[ns]").astype(np.int64)
    return dict(zip(tags.tolist(), middle["chainage_m"].to_list(), strict=True))


def is_outside(message: TrainMessage, middle_m: dict[int, float]) -> bool:
    """Return whether the true front end, of the end that runs ahead, is outside a message's bounds."""
    place, over, under = message.chainage_cm, message.over_cm, message.under_cm
    if place is None or over is None or under is None:
        return False
    true_m = middle_m[round(message.time_ns / 1e8) * 100_000_000] + message.facing * HALF_M
    return not -over <= message.facing * (100.0 * true_m - place) <= under


def count_sessions(sessions: Iterable[tuple[Path, Path]]) -> tuple[Counter[str], Counter[str], list[int]]:
    """Return what was counted, what was lost, and the first message with a position of each session."""
    middle_m, newest, counted, first = true_middle_m(), 0, Counter[str](), list[int]()
    lost = Counter(dict.fromkeys(("numbers sent twice", "lines", "states", "bounds"), 0))
    for messages, errors in sessions:
        logged = " ".join(errors.read_text().split()) if errors.exists() else ""  # killed before its start
        counted["continued"] += "positioning continues" in logged
        lost["states"] += "not used" in logged
        placed = 0
        for number, line in enumerate(whole_lines(messages), start=1):
            try:
                message = from_json(line)
            except MessageError:
                lost["lines"] += 1
                continue
            lost["numbers sent twice"] += message.sequence <= newest
            lost["bounds"] += is_outside(message, middle_m)
            newest = max(newest, message.sequence)
            counted["messages"] += 1
            placed = placed or number * (message.chainage_cm is not None)
        first += [placed] if placed else []
    return counted, lost, first


def kill_sessions(folder: Path, kills: int, *, seed: int = 1) -> list[tuple[Path, Path]]:
    """Start and kill sessions; return their messages and what they logged."""
    rng, files = random.Random(seed), demo_files()
    log = read_observations(files["front"])
    receiver = Receiver([log_of(log[k : k + 1]) for k in range(len(log))])
    source = f"tcp://127.0.0.1:{receiver.server_address[1]}"
    words = ["live", "--front", source, "--state", str(folder / "state")]
    words += [word for name in ("track", "vehicle", "nav") for word in (f"--{name}", str(files[name]))]
    words += ["--live", "state_every_s=1", "--live", "no_input=skip", "--live", "behind_s=3600"]
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["railfix.cli", "railfix.live.command"])
    sessions = []
    for kill in range(kills):
        messages, errors = folder / f"messages {kill}", folder / f"errors {kill}"
        arguments = ([*words, "--send", f"json@{messages}"], errors)
        process = context.Process(target=run_railfix, args=arguments, daemon=True)
        process.start()
        least, until = rng.choice((0, 1, 4, 8)), time.monotonic() + 120.0
        while len(whole_lines(messages)) < least:
            assert process.is_alive(), errors.read_text()
            assert time.monotonic() < until, "no message"
            time.sleep(0.02)
        time.sleep(rng.uniform(0.0, 1.5))
        process.kill()
        process.join()
        sessions.append((messages, errors))
        if receiver.epoch > len(receiver.epochs) - 40:
            break  # the recording has ended
    receiver.shutdown()
    receiver.server_close()
    return sessions
