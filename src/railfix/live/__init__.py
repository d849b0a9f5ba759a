"""Positions from receiver streams as they arrive: sources, pairing of antennas, one message a period, sinks.

`LiveEngine` is the whole of it without files, clocks or sockets: epochs in, messages out. `run_session` adds sources
and sinks, `run_live` all that ``railfix live`` does::

    engine = LiveEngine(processor, LiveSettings(train=7))
    engine.add_navigation(navigation)
    engine.push("front", epoch, now_ns=time.monotonic_ns())
    for output in engine.poll(now_ns=time.monotonic_ns()):
        print(output.message.chainage_cm, output.result)
"""

from railfix.live.channels import TwoChannels
from railfix.live.command import LiveInputs, run_live
from railfix.live.engine import EngineState, LiveEngine, LiveOutput
from railfix.live.metrics import Metrics
from railfix.live.session import Hooks, run_session
from railfix.live.settings import LiveSettings
from railfix.live.sinks import Sink, open_sink
from railfix.live.sources import read_source
from railfix.live.state import SavedSession, load_state, write_state
from railfix.live.stream import Received, ReceiverState, receive_bytes

__all__ = [
    "EngineState",
    "Hooks",
    "LiveEngine",
    "LiveInputs",
    "LiveOutput",
    "LiveSettings",
    "Metrics",
    "Received",
    "ReceiverState",
    "SavedSession",
    "Sink",
    "TwoChannels",
    "load_state",
    "open_sink",
    "read_source",
    "receive_bytes",
    "run_live",
    "run_session",
    "write_state",
]
