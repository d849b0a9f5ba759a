"""The position message: bytes and back, other versions, damage, views."""

from __future__ import annotations

import json
from contextlib import suppress

import cbor2
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from railfix.core.errors import SettingsError
from railfix.io.train_message import (
    KEYS,
    LONGEST,
    MessageError,
    MessageStatus,
    Source,
    SuspectedInterference,
    TrainMessage,
    decode,
    encode,
    etcs_report,
    from_json,
    to_json,
)

pytestmark = pytest.mark.requirement("A8")

PLACED = TrainMessage(
    train=7, sequence=41, time_ns=1_400_000_000_000_000_000, sent_ns=1_400_000_000_030_000_000, line=3,
    chainage_cm=1_234_567, over_cm=812, under_cm=655, speed_cmps=-2_512, speed_bound_cmps=9, direction=-1, facing=1,
    status=MessageStatus.POSITION, sources=Source.FRONT_RECEIVER | Source.TACHOMETER, protection_level_cm=900,
    track_permille=999, length_cm=4_000, complete=True,
)  # fmt: skip


@pytest.mark.parametrize("name", ["train", "chainage_cm", "direction", "length_cm", "session"])
@pytest.mark.parametrize("value", [True, False])
def test_a_truth_value_is_no_number(name: str, value: bool) -> None:
    with pytest.raises(SettingsError, match=f"{name}: a number was expected"):
        PLACED.replaced(**{name: value})
    line = json.dumps({**json.loads(to_json(PLACED)), name: value})
    with pytest.raises(MessageError, match=f"{name}: a number was expected"):
        from_json(line)


def test_the_bytes_are_canonical() -> None:
    """Keys rise, and each number has its shortest form (RFC 8949, 4.2.1)."""
    data = encode(PLACED)
    assert data == cbor2.dumps(cbor2.loads(data), canonical=True)


unsigned = st.integers(0, (1 << 63) - 1)
signed = st.integers(-(1 << 62), (1 << 62) - 1)
messages = st.builds(
    TrainMessage,
    train=unsigned,
    sequence=unsigned,
    time_ns=unsigned,
    sent_ns=unsigned,
    line=unsigned,
    chainage_cm=signed,
    over_cm=unsigned,
    under_cm=unsigned,
    speed_cmps=st.none() | signed,
    direction=st.integers(-1, 1),
    facing=st.integers(-1, 1),
    standstill=st.booleans(),
    status=st.sampled_from(MessageStatus),
    sources=st.integers(0, 1023).map(Source),
    track_permille=st.none() | st.integers(0, 1000),
    length_cm=unsigned,
    complete=st.booleans(),
)


@given(message=messages)
def test_bytes_and_json_give_the_message_back(message: TrainMessage) -> None:
    data = encode(message)
    assert decode(data) == message
    assert encode(decode(data)) == data
    assert from_json(to_json(message)) == message
    assert len(data) <= LONGEST


def test_size_and_keys_of_a_message() -> None:
    """The keys are part of the interface: none may move."""
    assert len(encode(PLACED)) < 100
    assert KEYS["train"] == 1
    assert KEYS["chainage_cm"] == 6
    assert KEYS["status"] == 14
    assert KEYS["complete"] == 19
    assert KEYS["sigma_cm"] == 20
    assert KEYS["authority"] == 21
    assert KEYS["authority_end_cm"] == 22
    assert KEYS["interference"] == 23
    assert [KEYS[name] for name in ("safe_front_cm", "safe_rear_cm", "unknown")] == [24, 25, 26]
    assert [KEYS[name] for name in ("session", "brake_order")] == [27, 28]
    assert len(KEYS) == 28


@pytest.mark.requirement("B8")
@pytest.mark.parametrize("suspected", [None, *SuspectedInterference])
def test_suspected_interference_comes_back(suspected: SuspectedInterference | None) -> None:
    message = PLACED.model_copy(update={"interference": suspected})
    assert decode(encode(message)) == from_json(to_json(message)) == message


def test_a_key_sent_twice_is_damage() -> None:
    """RFC 8949, 5.6: a map with a key twice is not valid; a reader that takes the last one reads another message."""
    data = encode(PLACED)
    doubled = bytes([data[0] + 1]) + data[1:] + cbor2.dumps(KEYS["over_cm"]) + cbor2.dumps(7)
    with pytest.raises(MessageError, match="a key twice"):
        decode(doubled)
    with pytest.raises(MessageError, match="a key twice"):
        decode(b"\xbf" + data[1:] + b"\xff")
    many = cbor2.dumps({**cbor2.loads(data), **dict.fromkeys(range(100, 120), 0)})
    assert many[0] == 0xB8
    assert decode(many) == PLACED


@given(data=st.binary(max_size=300))
@settings(max_examples=200)
def test_any_bytes_are_a_message_or_an_error(data: bytes) -> None:
    with suppress(MessageError):
        assert isinstance(decode(data), TrainMessage)


@example(place=54, value=2)
@example(place=54, value=32)
@given(place=st.integers(0, 80), value=st.integers(1, 255))
@settings(max_examples=100)
def test_damaged_messages_never_raise_anything_else(place: int, value: int) -> None:
    data = bytearray(encode(PLACED))
    data[place % len(data)] ^= value
    with suppress(MessageError):
        decoded = decode(bytes(data))
        # A key that has become one of a later version is ignored: what it said may be what its absence says.
        unknown = set(cbor2.loads(bytes(data))) - set(KEYS.values())
        assert unknown or encode(decoded) != encode(PLACED)


def test_versions_and_unknown_keys() -> None:
    values = cbor2.loads(encode(PLACED))
    assert decode(cbor2.dumps({**values, 99: "later"})) == PLACED
    with pytest.raises(MessageError, match="version 2"):
        decode(cbor2.dumps({**values, 0: 2}))
    with pytest.raises(MessageError, match="chainage_cm, over_cm"):
        decode(cbor2.dumps({key: value for key, value in values.items() if key != KEYS["over_cm"]}))
    with pytest.raises(MessageError, match="at most"):
        decode(b"\0" * (LONGEST + 1))


def test_position_report_by_hand() -> None:
    """12345.67 m, reference at 12000 m: 346 m ahead (345.67), doubts 8.12 and 6.55 m with 0.33 m of rounding."""
    report = etcs_report(PLACED, reference_cm=1_200_000, reference=77)
    assert report["D_LRBG"] == 346
    assert (report["L_DOUBTOVER"], report["L_DOUBTUNDER"]) == (9, 7)
    assert report["V_TRAIN"] == 18  # 90.4 km/h in steps of 5
    assert (report["Q_DIRLRBG"], report["Q_DLRBG"], report["Q_DIRTRAIN"]) == (1, 1, 0)
    with pytest.raises(ValueError, match="nearer reference"):
        etcs_report(PLACED, reference_cm=100_000_000, reference=77)
    with pytest.raises(ValueError, match="without a position"):
        etcs_report(TrainMessage(train=1, sequence=1, time_ns=1, sent_ns=1, line=1), reference_cm=0, reference=1)
