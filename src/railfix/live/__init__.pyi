# The names of `railfix.live`, imported at their first use (lazy-loader).

from .channels import TwoChannels
from .command import run_live
from .console import Metrics
from .engine import EngineState, LiveEngine, LiveOutput
from .session import Hooks, run_session
from .settings import LiveInputs, LiveSettings
from .sinks import Sink, open_sink
from .sources import read_source
from .state import SavedSession, load_state, write_state
from .stream import ReceivedData, ReceiverState, receive_bytes

__all__ = [
    "EngineState",
    "Hooks",
    "LiveEngine",
    "LiveInputs",
    "LiveOutput",
    "LiveSettings",
    "Metrics",
    "ReceivedData",
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
