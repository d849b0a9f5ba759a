"""Receiver logs told from other files, without the decoders."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.files import FilePath, open_stream
from railfix.io.receiver.framing import find_frames

#: Bytes in which a log must show a frame with a valid checksum to be taken for one.
_HEAD_BYTES: Final = 1 << 16


def is_receiver_log(head: bytes) -> bool:
    """Whether bytes from the beginning of a file hold a UBX, RTCM 3 or SBF frame with a valid checksum."""
    frames = find_frames(np.frombuffer(head, dtype=np.uint8))
    return bool(np.isin(frames.protocol, ["ubx", "rtcm3", "sbf"]).any())


def head_of(path: FilePath) -> bytes:
    """First bytes of a file, unpacked."""
    with open_stream(path, content="bytes") as stream:
        return stream.read(_HEAD_BYTES)
