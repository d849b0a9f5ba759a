"""Two-channel operation: two processes compute each message, and the messages are compared byte by byte (P1 2.1).

Both channels receive the same epochs, records and clock readings. The second channel sends the first channel its
messages and a digest of the results of each processing stage. At the first difference, the output stops, and the error
message names the first stage with different results.
"""

from __future__ import annotations

import hashlib
import multiprocessing
from collections.abc import Callable, Sequence
from functools import wraps
from multiprocessing.connection import Connection
from typing import Any, Concatenate, Final, ParamSpec

import numpy as np

from railfix import kernels
from railfix.core.errors import ChannelsDisagreeError
from railfix.io.train_message import encode
from railfix.live.engine import LiveEngine, LiveOutput
from railfix.live.settings import LiveSettings
from railfix.pipeline.processor import EpochProcessor

P = ParamSpec("P")

_READY: Final = "ready"  #: First object that the second channel sends; it means that the channel is ready for calls.
#: For each processing stage, the arrays of `AntennaResult` that are compared; the stages are in the order of
#: processing.
STAGES: Final[dict[str, tuple[str, ...]]] = {
    "corrected ranges": ("corrected_code_m", "sigma_m", "elevation_deg"),
    "screens and exclusion": ("reason",),
    "position": ("status", "chainage_m", "along_sigma_m", "residual_m"),
}


def digests(outputs: list[LiveOutput]) -> list[dict[str, str]]:
    """Return, for each output, the encoded message and the SHA-256 digest of each stage's results, in hexadecimal."""
    return [
        {
            **{
                stage: _digest(
                    [getattr(a, name) for a in output.result.antennas.values() for name in names]
                    if output.result is not None
                    else []
                )
                for stage, names in STAGES.items()
            },
            "filter": _digest([] if output.result is None else [t.chainage_m for t in output.result.fusion.values()]),
            "message": encode(output.message).hex(),
        }
        for output in outputs
    ]


def _digest(arrays: list[Any]) -> str:
    text = hashlib.sha256()
    for array in arrays:
        values = np.ascontiguousarray(array)
        text.update(str((values.dtype, values.shape)).encode())
        text.update(values.tobytes())
    return text.hexdigest()


def _second_channel(
    connection: Connection, processor: EpochProcessor, settings: LiveSettings, sensors: Sequence[str]
) -> None:
    """Execute the lists of calls that the first channel sends, until the connection closes."""
    engine = LiveEngine(processor, settings, sensors)
    kernels.load()
    connection.send(_READY)
    while True:
        try:
            calls = connection.recv()
        except EOFError:
            return
        for name, arguments, keywords in calls:
            if name == "poll":
                connection.send(digests(engine.poll(**keywords)))
            else:
                getattr(engine, name)(*arguments, **keywords)


def _in_both(method: Callable[Concatenate[TwoChannels, P], None]) -> Callable[Concatenate[TwoChannels, P], None]:
    """Wrap a method of the engine, so that each call is also recorded, to be repeated by the second channel."""

    @wraps(method)
    def in_both(self: TwoChannels, /, *arguments: P.args, **keywords: P.kwargs) -> None:
        method(self, *arguments, **keywords)
        self._calls.append((method.__name__, arguments, keywords))

    return in_both


class TwoChannels(LiveEngine):
    """`LiveEngine` whose calls are repeated by a second engine in another process.

    Raise ChannelsDisagreeError if the second process does not start.
    """

    def __init__(self, processor: EpochProcessor, settings: LiveSettings, sensors: Sequence[str] = ()) -> None:
        super().__init__(processor, settings, sensors)
        # calls that the next `poll` sends to the second channel
        self._calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=_second_channel, args=(other, processor, settings, sensors), daemon=True)
        self._process.start()
        other.close()
        # Wait here, before any data arrive; a later wait would delay the data and the reaction to SIGINT and SIGTERM.
        if self._recv() != _READY:
            raise ChannelsDisagreeError("the second channel does not start; no message is sent")

    start = _in_both(LiveEngine.start)
    resume = _in_both(LiveEngine.resume)
    add_navigation = _in_both(LiveEngine.add_navigation)
    add_sbas = _in_both(LiveEngine.add_sbas)
    add_base = _in_both(LiveEngine.add_base)
    add_samples = _in_both(LiveEngine.add_samples)
    push = _in_both(LiveEngine.push)

    def poll(self, *, now_ns: int, sent_ns: int | None = None) -> list[LiveOutput]:
        """Return the outputs of `LiveEngine.poll`, if both channels agree.

        Raise ChannelsDisagreeError if a message or the results of a stage differ, or if the second channel has ended.
        """
        self._calls.append(("poll", (), {"now_ns": now_ns, "sent_ns": sent_ns}))
        try:
            self._connection.send(self._calls)
        except OSError:
            raise ChannelsDisagreeError("the second channel has ended; no message is sent") from None
        self._calls.clear()
        outputs = super().poll(now_ns=now_ns, sent_ns=sent_ns)
        compare(digests(outputs), self._recv())
        return outputs

    def _recv(self) -> Any:
        try:
            return self._connection.recv()
        except (EOFError, OSError):
            raise ChannelsDisagreeError("the second channel has ended; no message is sent") from None

    def close(self) -> None:
        """Kill the second process; nothing is lost, because it stores no data."""
        self._connection.close()
        self._process.kill()
        self._process.join(timeout=5.0)


def compare(ours: list[dict[str, str]], theirs: list[dict[str, str]]) -> None:
    """Raise ChannelsDisagreeError if the digests of the two channels differ."""
    if len(ours) != len(theirs):
        raise ChannelsDisagreeError(
            f"the channels disagree: {len(ours)} messages in the first, {len(theirs)} in the second"
        )
    for one, other in zip(ours, theirs, strict=True):
        for stage, digest in one.items():
            if other.get(stage) != digest:
                raise ChannelsDisagreeError(f"the channels disagree, first in the stage: {stage}; no message is sent")
