"""Receiver formats against the parsers of their users: pyubx2, pyrtcm and pysbf2, message by message."""

from __future__ import annotations

import gzip
import io
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from railfix.core.timescale import from_week
from railfix.gnss.observations import Observations
from railfix.io.receiver import rtcm, sbf, ubx
from railfix.io.receiver.framing import Frames, find_frames
from test_receiver_logs import COLD_START, RTCM, TWO_BANDS
from test_receiver_sbf import logged, written

__all__ = ["logged"]
pytestmark = pytest.mark.requirement("A8")

#: Letters of the systems as UBX numbers them.
LETTERS = {0: "G", 1: "S", 2: "E", 3: "C", 5: "J", 6: "R"}
ANGLES = ("m0", "omega0", "i0", "omega", "delta_n", "omega_dot", "i_dot")
#: Phases of a larger standard deviation [0.004 cycle] are not used (docs/formats.md).
LARGEST_PHASE_STD = 5


def frames_of(data: bytes) -> Frames:
    return find_frames(np.frombuffer(data, np.uint8))


@pytest.mark.parametrize(
    "name", [pytest.param(COLD_START, marks=pytest.mark.slow), pytest.param(TWO_BANDS, marks=pytest.mark.slow)]
)
def test_ubx_measurements(recordings: Path, name: str) -> None:
    """Every RXM-RAWX: time, satellites, and the values of each measurement as they were sent."""
    pyubx2 = pytest.importorskip("pyubx2")
    data = gzip.decompress((recordings / "live" / name).read_bytes())
    ours = ubx.rawx_measurements(frames_of(data))
    reader = pyubx2.UBXReader(io.BytesIO(data), protfilter=pyubx2.UBX_PROTOCOL, quitonerror=pyubx2.ERR_IGNORE)
    sent = [message for _, message in reader if message is not None and message.identity == "RXM-RAWX"]
    assert ours.skipped.get("RXM-RAWX without time", 0) == sum(message.week == 0 for message in sent)
    sent = [message for message in sent if message.week > 0]
    times = [from_week(message.week, message.rcvTow) for message in sent]
    assert np.abs((ours.time - np.array(times)).astype(np.int64)).max() <= 1
    compared = 0
    for epoch, message in enumerate(sent):
        theirs = Counter[tuple[object, ...]]()
        for k in range(1, message.numMeas + 1):
            of = {item: getattr(message, f"{item}_{k:02d}") for item in ("gnssId", "svId", "prMes", "doMes", "cno")}
            number = of["svId"] - (100 if of["gnssId"] == 1 else 0)
            sure = getattr(message, f"cpValid_{k:02d}") and getattr(message, f"cpStd_{k:02d}") <= LARGEST_PHASE_STD
            phase = getattr(message, f"cpMes_{k:02d}") if sure else None
            code = of["prMes"] if getattr(message, f"prValid_{k:02d}") else None
            theirs[f"{LETTERS[of['gnssId']]}{number:02d}", code, phase, np.float32(of["doMes"]), of["cno"]] += 1
        here = np.flatnonzero(ours.epoch == epoch)
        values = zip(
            ours.satellite[here].tolist(),
            *([None if np.isnan(v) else v for v in a[here].tolist()] for a in (ours.code_m, ours.phase_cycles)),
            ours.doppler_hz[here].astype(np.float32).tolist(),
            ours.cn0_dbhz[here].tolist(),
            strict=True,
        )
        assert Counter(values) == theirs
        compared += len(here)
    assert compared > 6_000


@pytest.mark.slow
def test_rtcm_ephemerides(recordings: Path) -> None:
    """Every field of the messages 1019 and 1046 of a caster; angles are semicircles there and radians here."""
    pyrtcm = pytest.importorskip("pyrtcm")
    data = gzip.decompress((recordings / "live" / RTCM).read_bytes())
    reader = pyrtcm.RTCMReader(io.BytesIO(data), quitonerror=pyrtcm.ERR_IGNORE)
    theirs = [message for _, message in reader if message is not None and message.identity in ("1019", "1046")]
    ours = sorted(rtcm.ephemeris_fields(frames_of(data)))
    assert len(ours) == len(theirs) > 500
    for (_, number, fields), message in zip(ours, theirs, strict=True):
        assert str(number) == message.identity
        sent = [float(value) for name, value in vars(message).items() if name.startswith("DF")][1:]
        for (name, value), expected in zip(fields.items(), sent, strict=False):
            unit = np.pi if name in ANGLES else 1.0
            assert value == pytest.approx(expected * unit, rel=1e-14, abs=0.0), (number, name)


def test_sbf_measurements(logged: Observations, tmp_path: Path) -> None:
    """Code and Doppler of the first signal of every satellite of every MeasEpoch, logs that the tests write."""
    pysbf2 = pytest.importorskip("pysbf2")
    data = written(logged, tmp_path).read_bytes()
    ours = sbf.meas_epoch_measurements(frames_of(data))
    reader = pysbf2.SBFReader(io.BytesIO(data), quitonerror=pysbf2.ERR_IGNORE)
    compared = 0
    for epoch, (_, message) in enumerate(reader):
        assert message.identity == "MeasEpoch"
        codes = ours.code_m[ours.epoch == epoch]
        dopplers = ours.doppler_hz[ours.epoch == epoch]
        for k in range(1, message.N1 + 1):
            code = getattr(message, f"CodeMSB_{k:02d}") + getattr(message, f"CodeLSB_{k:02d}")
            at = int(np.argmin(np.abs(codes - code)))
            assert codes[at] == pytest.approx(code, abs=1e-6)
            assert dopplers[at] == pytest.approx(getattr(message, f"Doppler_{k:02d}"), abs=1e-9)
            compared += 1
    assert compared > 800
