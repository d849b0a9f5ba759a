"""Redundant links: defences of EN 50159, response rate and round trip, switching, and QUIC with certificates."""

from __future__ import annotations

import asyncio
import gc
import random
import shutil
import socket
import time
from collections import Counter
from collections.abc import Coroutine
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aioquic.asyncio.server import QuicServer
from cryptography.x509 import Certificate, load_pem_x509_certificate

from attacked_link import AttackedLink, AttackSettings
from railfix.core.errors import OutputError
from railfix.ground import keys as keys_module
from railfix.ground.demo import Relay, RelaySettings
from railfix.ground.frames import Echo, Frame, FrameKind, FrameReceiver, ReceiverLimits, Threat
from railfix.ground.keys import Peer, list_ending, renew_keys, write_keys
from railfix.ground.links import (
    BEARERS,
    CentreLinks,
    LinkChoice,
    LinkLimits,
    LinkMeter,
    TrainLinks,
    coverage,
    create_bearers,
    round_trips,
)
from railfix.ground.quic import (
    HANDSHAKE_S,
    LATE_S,
    MOST_HANDSHAKES,
    MOST_OF_PEER,
    RECEIVE_BYTES,
    TURN,
    Handshakes,
    LinkProtocol,
    configuration,
    connection,
    listen,
)

pytestmark = pytest.mark.requirement("F3")

SECOND = 1_000_000_000


def frame(sequence: int, *, sender: int = 7, at_s: float = 0.0, kind: FrameKind = FrameKind.DATA) -> Frame:
    time_ns = round(at_s * SECOND)
    return Frame(kind=kind, sender=sender, session=1, sequence=sequence, time_ns=time_ns, payload=b"place")


def test_every_flipped_bit_is_rejected_and_counted() -> None:
    data = frame(5).encode()
    for bit in range(8 * len(data)):
        receiver = FrameReceiver(sender=7)
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        assert receiver.receive("A", bytes(flipped), 0) == (None, None)
        assert receiver.threats == {Threat.CORRUPTION: 1}
    for length in range(len(data)):
        assert FrameReceiver(sender=7).receive("A", data[:length], 0) == (None, None)


def test_each_threat_has_its_counter() -> None:
    receiver = FrameReceiver(sender=7, limits=ReceiverLimits(delay_s=2.0, jump=50))
    used = lambda link, f, now_s=0.0: receiver.receive(link, f.encode(), round(now_s * SECOND))[1]  # noqa: E731
    assert used("A", frame(1)) is not None
    assert used("A", frame(1)) is None  # replayed
    assert used("B", frame(1)) is None  # the other link's copy
    assert used("A", frame(4, at_s=1.0), 1.0) is not None  # 2 and 3 skipped
    assert used("A", frame(3, at_s=0.9), 1.1) is None  # overtaken
    assert used("A", frame(5, at_s=2.0), 4.1) is None  # 2.1 s late
    assert used("A", frame(6, sender=8, at_s=5.0), 5.0) is None
    assert used("A", frame(1_000, at_s=6.0), 6.0) is None
    assert receiver.threats == {
        Threat.REPETITION: 1, Threat.DELETION: 2, Threat.RESEQUENCING: 1, Threat.DELAY: 1, Threat.MASQUERADE: 1,
        Threat.INSERTION: 1,
    }  # fmt: skip
    assert used("B", frame(7, at_s=7.0), 7.0) is not None


def test_one_number_far_ahead_locks_nobody_out() -> None:
    """However often it comes; after an outage a number may be as far ahead as a sender counts meanwhile."""
    receiver = FrameReceiver(sender=7, limits=ReceiverLimits(jump=50, rate=100.0, delay_s=1e9))
    numbers = (1, 2, 1 << 60, 3, 9_000, 4, 9_000, 9_001)
    used = [receiver.receive("A", frame(k).encode(), 0)[1] is not None for k in numbers]
    assert used == [True, True, False, True, False, True, False, False]
    assert receiver.threats[Threat.INSERTION] == 4
    assert receiver.receive("A", frame(9_000).encode(), 90 * SECOND)[1] is not None


def test_a_start_of_the_sender_begins_anew_and_what_is_late_of_the_one_before_is_rejected() -> None:
    """Numbers and the clock's origin begin again, by no clock that could be set back."""
    receiver = FrameReceiver(sender=7, limits=ReceiverLimits(delay_s=2.0))

    def is_used(session: int, number: int, at_s: float) -> bool:
        sent = replace(frame(number, at_s=at_s), session=session)
        return receiver.receive("A", sent.encode(), 50 * SECOND)[1] is not None

    assert is_used(1, 700, 40.0)
    assert is_used(2, 1, 1e6)
    assert not is_used(1, 701, 40.0)
    assert receiver.threats == {Threat.RESEQUENCING: 1}
    assert is_used(2, 2, 1e6)
    assert is_used(3, 1, 0.0)
    assert not is_used(2, 3, 1e6)


def test_the_origin_of_the_senders_clock_does_not_matter() -> None:
    for origin in (-1e6, 0.0, 1e9):
        receiver = FrameReceiver(sender=7, limits=ReceiverLimits(delay_s=2.0))
        for k in range(1, 50):
            late = 2.5 if k == 30 else 0.1
            data = frame(k, at_s=origin + k).encode()
            assert (receiver.receive("A", data, round((k + late) * SECOND))[1] is None) == (k == 30)


@pytest.mark.parametrize("count", [30_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_no_message_is_used_twice_and_none_older_after_a_newer(count: int) -> None:
    """Two links with loss, repetition and overtaking; a set of all used numbers is the second account."""
    rng, receiver, used, newest = random.Random(3), FrameReceiver(sender=7), set(), -1
    held: list[tuple[str, bytes]] = []
    for sequence in range(count):
        data = Frame(kind=FrameKind.DATA, sender=7, session=1, sequence=sequence, time_ns=sequence * 1000).encode()
        arriving = [(link, data) for link in ("A", "B") if rng.random() > 0.2]
        if held and rng.random() < 0.3:
            arriving.append(held.pop(rng.randrange(len(held))))
        if arriving and rng.random() < 0.1:
            held.append(arriving[0] if rng.random() < 0.5 else arriving.pop(0))
        for link, bytes_ in arriving:
            _, use = receiver.receive(link, bytes_, sequence * 1000)
            if use is not None:
                assert use.sequence not in used
                assert use.sequence > newest
                newest = use.sequence
                used.add(use.sequence)
    assert len(used) > 0.94 * count
    assert receiver.threats[Threat.REPETITION] > 0
    assert receiver.threats[Threat.DELETION] == newest + 1 - len(used) - min(used)


def test_response_rate_and_round_trip_of_a_lossy_link() -> None:
    """Loss p each way: (1 - p)^2 answered; delay d each way: 2 d, whatever the answer waits at the other end."""
    rng, p, d, waits = random.Random(2), 0.2, 0.15, 0.4
    meter = LinkMeter(limits=LinkLimits(window=4000))
    for k in range(4000):
        now = 1.0 * k
        meter.note_sent(k, now, chainage_m=5.0 * k, direction=1)
        if rng.random() > p and rng.random() > p:
            echo = Echo(sequence=k, sent_ns=round(now * 1e9), received_ns=77 * SECOND,
                        answered_ns=77 * SECOND + round(waits * 1e9))  # fmt: skip
            back = now + 2 * d + waits
            meter.note_answer(k, back, echo.round_trip_s(round(back * 1e9)))
    meter.settle(1e9)
    assert meter.response_rate == pytest.approx((1 - p) ** 2, abs=4 * (0.64 * 0.36 / 4000) ** 0.5)
    assert meter.round_trip_s == pytest.approx(2 * d)
    assert sum(sent for _, sent in meter.coverage.values()) == 4000
    assert meter.coverage[3, 1][1] == 20  # 300 to 400 m, one frame each 5 m


def test_a_frame_without_a_place_counts_in_the_rate_and_not_in_the_coverage() -> None:
    meter = LinkMeter()
    meter.note_sent(1, 0.0, chainage_m=None, direction=1)
    meter.note_sent(2, 0.0, chainage_m=0.0, direction=1)
    meter.note_answer(1, 0.1, 0.1)
    meter.settle(5.0)
    assert meter.response_rate == 0.5
    assert meter.coverage == {(0, 1): (0, 1)}


def test_coverage_adds_the_meters_of_a_bearer_up() -> None:
    first, second = (LinkMeter(coverage={(3, 1): (8, 10), (4, place): (1, 2)}) for place in (1, -1))
    assert coverage([first, second]) == {1: {3: (16, 20), 4: (1, 2)}, -1: {4: (1, 2)}}


def test_round_trips_over_time_and_place_are_those_of_every_frame() -> None:
    """Two trains: answers that grow by 1 ms a frame, every third frame of the second lost (P5, figures 9 and 10)."""
    meters = [LinkMeter(limits=LinkLimits(window=5)) for _ in range(2)]
    for k in range(30):
        for n, meter in enumerate(meters):
            meter.note_sent(k, 50.0 + k + 0.5 * n, chainage_m=20.0 * k, direction=1)
            if n == 0 or k % 3:
                meter.note_answer(k, 50.2 + k + 0.5 * n, 0.1 + 0.001 * k)
    for meter in meters:
        meter.settle(1e3)
    time_s, chainage_m, trip_s = round_trips(meters)
    np.testing.assert_allclose(time_s, 0.5 * np.arange(60))
    np.testing.assert_allclose(chainage_m, 20.0 * np.repeat(np.arange(30), 2))
    lost = np.arange(60) % 6 == 1
    np.testing.assert_array_equal(np.isnan(trip_s), lost)
    np.testing.assert_allclose(trip_s[~lost], (0.1 + 0.001 * np.repeat(np.arange(30), 2))[~lost])
    assert meters[0].round_trip_s == pytest.approx(0.127)  # median of the last five
    assert [len(part) for part in round_trips([LinkMeter()])] == [0, 0, 0]


def test_switching_takes_at_most_three_misses_and_the_answer_time_and_returns() -> None:
    """A is out from 100 s to 160 s; frames each second; the fake clock runs in steps of 50 ms."""
    normal, spare, choice = LinkMeter(), LinkMeter(), LinkChoice()
    history: list[tuple[float, str]] = []
    echoes: list[tuple[float, LinkMeter, int]] = []
    for step in range(20 * 260):
        now = 0.05 * step
        if step % 20 == 0:
            for meter, up in ((normal, not 100.0 <= now < 160.0), (spare, True)):
                meter.note_sent(step, now)
                if up:
                    echoes.append((now + 0.2, meter, step))
        for at, meter, sequence in [item for item in echoes if item[0] <= now]:
            meter.note_answer(sequence, now, 0.2)
            echoes.remove((at, meter, sequence))
        for meter in (normal, spare):
            meter.settle(now)
        after = choice.after(now, normal, spare)
        if after != choice:
            history.append((now, after.active))
        choice = after
    (left, to), (back, normally) = history
    assert (to, normally) == ("B", "A")
    assert left - 100.0 <= 3 * 1.0 + 1.0 + 0.1
    assert back - 160.0 == pytest.approx(9.2, abs=0.2)  # ten answers in a row, the first at 160.2 s


def test_the_normal_link_is_taken_at_once_where_only_the_spare_one_is_out() -> None:
    lost, good = LinkMeter(misses=3), LinkMeter(good=1)
    assert LinkChoice(active="B").after(0.0, good, lost).active == "A"
    assert LinkChoice(active="B").after(0.0, LinkMeter(good=9), LinkMeter()).active == "B"
    assert LinkChoice(active="A").after(0.0, lost, LinkMeter(misses=3)).active == "A"  # both gone: no use in switching


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys") / "own"
    write_keys(folder, [7, 8])
    write_keys(folder.parent / "other", [7])
    return folder


def test_keys_are_readable_by_their_owner_and_never_replaced(keys: Path) -> None:
    assert {path.name for path in keys.iterdir()} == {
        "authority.pem", "authority.key", "centre.pem", "centre.key", "train-7.pem", "train-7.key", "train-8.pem",
        "train-8.key",
    }  # fmt: skip
    assert all((keys / name).stat().st_mode & 0o077 == 0 for name in ("train-7.key", "authority.key"))
    before = {path.name: path.read_bytes() for path in keys.iterdir()}
    with pytest.raises(OutputError, match="all certificates already exist"):
        write_keys(keys, [7])
    assert [path.name for path in write_keys(keys, [7, 9])] == ["train-9.pem", "train-9.key"]
    assert {path.name: path.read_bytes() for path in keys.iterdir()}.items() > before.items()


HOSTS = {"A": "127.0.1.1", "B": "127.0.2.1"}
LOCAL = {"A": "127.0.1.7", "B": "127.0.2.7"}


def run(work: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(work, 20.0))


async def _until(condition: Any, seconds: float) -> float:
    start = time.monotonic()
    while not condition() and time.monotonic() - start < seconds:
        await asyncio.sleep(0.01)
    return time.monotonic() - start


def test_two_lossy_bearers_carry_each_message_once(keys: Path) -> None:
    """Loss 20 %, delay 20 ms, jitter, bit errors 5 %; after an outage of A nothing that B carries is lost."""

    async def work() -> None:
        got: list[bytes] = []
        orders: list[bytes] = []
        centre = CentreLinks(keys, HOSTS, received=lambda _, payload: got.append(payload))
        await centre.start()
        relays = {}
        for k, name in enumerate(BEARERS):
            settings = AttackSettings(
                loss=0.2 if name == "A" else 0.0, delay_s=0.02, jitter_s=0.01, bit_errors=0.05, seed=k
            )
            relays[name] = Relay(centre.addresses[name], settings)
            relays[name].disturbance = AttackedLink(settings)
            await relays[name].open(HOSTS[name])
        train = TrainLinks(
            7, keys, create_bearers({n: r.address for n, r in relays.items()}, LOCAL), received=orders.append
        )
        await train.start()
        await _until(lambda: len(train.protocols) == 2, 8.0)
        assert {p.peer.name for p in train.protocols.values() if p.peer is not None} == {"centre"}
        for k in range(100):
            if k == 50:
                relays["A"].disturbance.up = False
            train.send(b"%d" % k, chainage_m=10.0 * k)
            centre.send(7, b"go %d" % k)
            await asyncio.sleep(0.02)
        await asyncio.sleep(0.2)
        numbers = [int(payload) for payload in got]
        assert numbers == sorted(set(numbers))
        assert len(numbers) > 85
        assert orders
        assert len(orders) == len(set(orders))
        assert train.meters["B"].response_rate > 0.7
        assert 0.04 <= train.meters["B"].round_trip_s < 0.2
        assert relays["B"].disturbance.counts["bit errors"] > 0
        assert centre.threats()[Threat.CORRUPTION] == 0  # QUIC has dropped them before
        await train.stop()
        await centre.stop()
        for relay in relays.values():
            relay.close()

    run(work())


@pytest.mark.skipif(
    int(Path("/proc/sys/net/core/rmem_max").read_text()) < RECEIVE_BYTES, reason="net.core.rmem_max is below 4 MB"
)
def test_a_busy_centre_loses_no_packet_and_reads_a_certificate_once(
    keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While it is busy for a moment a thousand trains send 400 packets; each end of a connection reads the other's."""
    counted: Counter[str] = Counter()

    def read(certificate: Certificate) -> Peer:
        counted["certificates"] += 1
        return of(certificate)

    def datagram(self: QuicServer, data: bytes, addr: Any) -> None:
        counted["packets"] += data.startswith(b"burst")
        if not data.startswith(b"burst"):
            take(self, data, addr)

    of, take = Peer.of, QuicServer.datagram_received
    monkeypatch.setattr(Peer, "of", read)
    monkeypatch.setattr(QuicServer, "datagram_received", datagram)

    async def work() -> None:
        got: list[bytes] = []
        centre = CentreLinks(keys, HOSTS, received=lambda _, payload: got.append(payload))
        await centre.start()
        train = TrainLinks(7, keys, create_bearers(centre.addresses, LOCAL))
        await train.start()
        await _until(lambda: len(train.protocols) == 2, 8.0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as burst:
            for k in range(400):  # nothing else runs meanwhile
                burst.sendto(b"burst" + bytes(1100), centre.addresses["A"])
                if k % 20 == 0:
                    train.send(b"%d" % k)
        await _until(lambda: counted["packets"] == 400 and len(got) == 20, 5.0)
        assert (counted["packets"], len(got)) == (400, 20)
        assert counted["certificates"] == 4
        await train.stop()
        await centre.stop()

    run(work())


#: Trains of the test on the wire, by the threat that both of their bearers are under.
ON_THE_WIRE = {
    1: (Threat.REPETITION, AttackSettings(repeats=0.7, delay_s=0.005, seed=1)),
    2: (Threat.DELETION, AttackSettings(loss=0.4, seed=2)),
    3: (Threat.INSERTION, AttackSettings(insertions=0.7, seed=3)),
    4: (Threat.RESEQUENCING, AttackSettings(jitter_s=0.2, seed=4)),
    5: (Threat.CORRUPTION, AttackSettings(bit_errors=0.4, seed=5)),
    6: (Threat.DELAY, AttackSettings(delay_s=0.01, seed=6)),
}


def test_each_threat_on_the_wire(tmp_path: Path) -> None:
    """Six trains send 80 messages each, 20 ms apart; each one's relays put one threat on both bearers.

    Whatever the wire does, a payload is used once, whole, and never after a newer one. What QUIC does not drop is
    counted by the layer above it. Train 7 shows the certificate of train 8 (masquerade).
    """
    write_keys(tmp_path, [*ON_THE_WIRE, 8])
    for end in ("pem", "key"):
        (tmp_path / f"train-8.{end}").rename(tmp_path / f"train-7.{end}")

    async def work() -> None:
        used: dict[int, list[bytes]] = {number: [] for number in (*ON_THE_WIRE, 7, 8)}
        centre = CentreLinks(
            tmp_path, HOSTS, limits=ReceiverLimits(delay_s=1.0), received=lambda n, payload: used[n].append(payload)
        )
        await centre.start()
        trains, relays = {}, {}
        for number, (_, settings) in {**ON_THE_WIRE, 7: (None, AttackSettings())}.items():
            for k, name in enumerate(BEARERS):
                relay = relays[number, name] = Relay(centre.addresses[name], RelaySettings())
                await relay.open(HOSTS[name])
                relay.disturbance = AttackedLink(settings.replaced(seed=settings.seed + 10 * k))
                relay.disturbance.settings = AttackSettings()  # until it is connected
            local = {"A": f"127.0.1.{40 + number}", "B": f"127.0.2.{40 + number}"}
            given = create_bearers({n: relays[number, n].address for n in BEARERS}, local)
            trains[number] = TrainLinks(number, tmp_path, given)
            await trains[number].start()
        await _until(lambda: all(len(train.protocols) == 2 for train in trains.values()), 10.0)
        for (number, _), relay in relays.items():
            if number in ON_THE_WIRE:
                relay.disturbance.settings = ON_THE_WIRE[number][1]
        for k in range(80):
            if k == 60:  # 1.5 s longer than before, to the end: nothing newer overtakes them
                for name in BEARERS:
                    relays[6, name].disturbance.settings = AttackSettings(delay_s=1.5)
            for number, train in trains.items():
                train.send(b"%d of %d" % (k, number))
            await asyncio.sleep(0.02)
        await asyncio.sleep(2.0)
        for number, (threat, _) in ON_THE_WIRE.items():
            numbers = [int(payload.split(b" of ")[0]) for payload in used[number]]
            assert numbers == sorted(set(numbers)), threat
            assert set(used[number]) <= {b"%d of %d" % (k, number) for k in range(80)}, threat
            assert len(numbers) > 20, threat
        counted = {number: centre.receivers[number].threats for number in ON_THE_WIRE}
        happened = {n: sum((relays[n, name].disturbance.counts for name in BEARERS), Counter()) for n in ON_THE_WIRE}
        gaps = [int(payload.split(b" of ")[0]) for payload in used[2]]
        assert counted[2][Threat.DELETION] == gaps[-1] - gaps[0] + 1 - len(gaps) > 0
        assert counted[4][Threat.RESEQUENCING] > 0
        late = {int(payload.split(b" of ")[0]) for payload in used[6]} & set(range(60, 80))
        assert counted[6][Threat.DELAY] >= 20
        assert late == set()
        # dropped by QUIC before the layer above sees it
        assert happened[1]["repeated"] > 50 < happened[3]["inserted"]
        assert happened[5]["bit errors"] > 50
        assert counted[1][Threat.REPETITION] == counted[3][Threat.INSERTION] == counted[5][Threat.CORRUPTION] == 0
        assert used[7] == used[8] == []
        assert centre.receivers[8].threats[Threat.MASQUERADE] > 0
        for train in trains.values():
            await train.stop()
        await centre.stop()
        for relay in relays.values():
            relay.close()

    run(work())


def test_a_centre_that_does_not_answer_is_one_time_out(keys: Path) -> None:
    """And no error that nobody takes, which asyncio would print with every try."""
    untaken: list[Any] = []

    async def work() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: untaken.append(context))
        settings = configuration(keys, "train-7", is_client=True)
        settings.initial_rtt = 0.01  # closing takes some of them
        with pytest.raises(TimeoutError):
            async with connection(
                ("127.0.0.1", 9), settings, local="127.0.0.1", received=lambda *_: None, timeout_s=0.1
            ):
                pass
        await asyncio.sleep(0.3)
        gc.collect()

    asyncio.run(work())
    assert untaken == []


@pytest.mark.parametrize("kind", ["other authority", "no certificate", "other train"])
def test_a_wrong_certificate_is_rejected(
    keys: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def work() -> None:
        got: list[bytes] = []
        centre = CentreLinks(keys, HOSTS, received=lambda _, payload: got.append(payload))
        await centre.start()
        folder = tmp_path / "keys"
        folder.mkdir()
        source = keys.parent / "other" if kind == "other authority" else keys
        (folder / "authority.pem").write_bytes((keys / "authority.pem").read_bytes())
        name = "train-8" if kind == "other train" else "train-7"
        (folder / "train-7.pem").write_bytes((source / f"{name}.pem").read_bytes())
        (folder / "train-7.key").write_bytes((source / f"{name}.key").read_bytes())
        train = TrainLinks(7, folder, create_bearers(centre.addresses, LOCAL))
        if kind == "no certificate":
            import railfix.ground.links as links

            plain = links.configuration

            def without(path: Path, name: str, **rest: Any) -> Any:
                settings = plain(path, name, **rest)
                if name == "centre":
                    return settings
                settings.certificate = settings.private_key = None
                return settings

            monkeypatch.setattr(links, "configuration", without)
        await train.start()
        for _ in range(40):
            train.send(b"from 7")
            await asyncio.sleep(0.02)
        assert got == []
        assert centre.threats()[Threat.MASQUERADE] > 0
        await train.stop()
        await centre.stop()

    run(work())


@pytest.mark.parametrize("how", ["revoked", "serial number", "expired"])
@pytest.mark.every(2)
def test_a_certificate_ends_while_connected(tmp_path: Path, how: str) -> None:
    write_keys(tmp_path / "keys", [7, 8])
    keys = tmp_path / "keys"

    async def work() -> None:
        got: Counter[int] = Counter()
        centre = CentreLinks(keys, HOSTS, received=lambda train, _: got.update([train]))
        await centre.start()
        trains = {n: TrainLinks(n, keys, create_bearers(centre.addresses, LOCAL)) for n in (7, 8)}
        for train in trains.values():
            await train.start()

        async def carried(numbers: set[int]) -> bool:
            got.clear()
            for train in trains.values():
                train.send(b"place")
            await _until(lambda: set(got) >= numbers, 1.0)
            return set(got) == numbers

        assert await _until(lambda: all(len(t.protocols) == 2 for t in trains.values()), 5.0) < 5.0
        assert await carried({7, 8})
        serial = load_pem_x509_certificate((keys / "train-7.pem").read_bytes()).serial_number
        if how != "expired":
            (keys / "revoked.txt").write_text("train-7\n" if how == "revoked" else f"{serial:#x}\n")
        else:
            for (number, _), protocol in centre._peers.items():
                if number == 7:
                    protocol.peer = protocol.peer._replace(ends=datetime(2020, 1, 1, tzinfo=UTC))
        rejected = centre.masquerades
        assert await _until(lambda: centre.masquerades >= rejected + 2, 5.0) < 5.0
        if how == "revoked":
            for _ in range(3):
                await asyncio.sleep(0.7)  # it connects again, and is rejected again
                assert await carried({8})
            (keys / "revoked.txt").write_bytes(b"\xff\xfe")
            assert await _until(lambda: centre.alarm is not None, 5.0) < 5.0
            assert await carried({8})
        if how == "serial number":  # a new certificate counts, taken over by the next connection
            renew_keys(keys, [7])
            assert load_pem_x509_certificate((keys / "train-7.pem").read_bytes()).serial_number != serial
            end = time.monotonic() + 8.0  # the next connection may have begun with the old certificate
            while not await carried({7, 8}):
                assert time.monotonic() < end
        for train in trains.values():
            await train.stop()
        await centre.stop()

    run(work())


def test_an_authority_that_ends_is_renewed_with_overlap(tmp_path: Path) -> None:
    """Both certificates of the authority are valid: old and new ends of the links trust each other."""
    old, new = tmp_path / "old", tmp_path / "new"
    write_keys(old, [7, 8], valid_days=20)
    assert [text.partition(" expires")[0] for text in list_ending(old, "centre")] == ["the certificate centre.pem"]
    shutil.copytree(old, new)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keys_module, "AUTHORITY_DAYS", 25)
        short = tmp_path / "short"
        write_keys(short, [7, 8], valid_days=20)
        assert len(list_ending(short, "centre")) == 2
    shutil.copytree(short, tmp_path / "renewed")
    renew_keys(tmp_path / "renewed", [7])
    assert list_ending(tmp_path / "renewed", "centre") == []
    both = (tmp_path / "renewed" / "authority.pem").read_bytes()
    assert both.endswith((short / "authority.pem").read_bytes())
    (short / "authority.pem").write_bytes(both)  # handed to every end before the new certificates

    async def work() -> None:
        got: list[int] = []
        for folder, numbers in ((short, (7, 8)), (tmp_path / "renewed", (7, 8))):
            centre = CentreLinks(folder, HOSTS, received=lambda train, _: got.append(train))
            await centre.start()
            for number in numbers:
                of = tmp_path / "renewed" if number == 7 else short
                train = TrainLinks(number, of, create_bearers(centre.addresses, LOCAL))
                await train.start()
                await _until(lambda train=train: len(train.protocols) == 2, 5.0)  # type: ignore[misc]
                train.send(b"place")
                await _until(lambda number=number: number in got, 2.0)  # type: ignore[misc]
                if number == 8:  # looked at once a second
                    await _until(lambda centre=centre: any("train-8" in a for a in centre.alarms()), 4.0)  # type: ignore[misc]
                alarms = centre.alarms()
                await train.stop()
            assert sorted(set(got)) == [7, 8]
            assert any("the certificate of train-8 expires" in text for text in alarms)
            assert not any("train-7" in text for text in alarms)
            got.clear()
            await centre.stop()

    run(work())


@pytest.mark.parametrize("out_s", [0.3, pytest.param(3.0, marks=pytest.mark.slow)])
def test_the_next_report_arrives_at_once_when_both_links_were_gone(keys: Path, out_s: float) -> None:
    """In a tunnel: nothing of the outage is queued, and the first report after it is used."""

    async def work() -> tuple[float, list[int]]:
        got: list[int] = []
        centre = CentreLinks(keys, HOSTS, received=lambda _, payload: got.append(int(payload)), wait_s=0.0)
        await centre.start()
        relays = {name: Relay(centre.addresses[name], RelaySettings(delay_s=0.005)) for name in BEARERS}
        for name in BEARERS:
            await relays[name].open(HOSTS[name])
        limits = LinkLimits(answer_s=0.1)
        train = TrainLinks(7, keys, create_bearers({n: r.address for n, r in relays.items()}, LOCAL), limits=limits)
        await train.start()
        await _until(lambda: len(train.protocols) == 2, 5.0)
        train.send(b"0")
        await _until(lambda: bool(got), 2.0)
        for relay in relays.values():
            relay.disturbance.up = False
        for k in range(1, 11):
            train.send(b"%d" % k)
            await asyncio.sleep(out_s / 10)
        for relay in relays.values():
            relay.disturbance.up = True
        train.send(b"11")
        after_s = await _until(lambda: len(got) > 1, 5.0)
        await train.stop()
        await centre.stop()
        for relay in relays.values():
            relay.close()
        return after_s, got

    after_s, got = asyncio.run(work())
    print(f"both links out for {out_s} s: the next report {after_s:.3f} s after")
    assert got == [0, 11]
    assert after_s < 0.5


def test_spare_mode_switches_and_returns(keys: Path) -> None:
    async def work() -> None:
        got: list[bytes] = []
        centre = CentreLinks(keys, HOSTS, received=lambda _, payload: got.append(payload), wait_s=0.0)
        await centre.start()
        relays = {name: Relay(centre.addresses[name], RelaySettings(delay_s=0.005)) for name in BEARERS}
        for name in BEARERS:
            await relays[name].open(HOSTS[name])
        limits = LinkLimits(answer_s=0.1, misses=3, good=5, good_s=0.3)
        train = TrainLinks(
            7, keys, create_bearers({n: r.address for n, r in relays.items()}, LOCAL), mode="spare", limits=limits
        )
        await train.start()
        await _until(lambda: len(train.protocols) == 2, 5.0)
        for k in range(100):
            relays["A"].disturbance.up = not 20 <= k < 50
            train.send(b"%d" % k)
            await asyncio.sleep(0.02)
        lost = sorted(set(range(100)) - {int(payload) for payload in got})
        assert train.choice.switches == 2
        assert lost
        assert lost[0] >= 20
        assert lost[-1] <= 20 + 3 + 5 + 3  # three misses, five frames of answer time, and room for a slow machine
        await train.stop()
        await centre.stop()
        for relay in relays.values():
            relay.close()

    run(work())


def test_a_frame_and_its_answer_are_a_packet_each(keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers and acknowledgements of QUIC travel with frames: 20 frames are 20 packets a link each way, not 60."""
    packets: Counter[bool] = Counter()
    taken = LinkProtocol.datagram_received

    def counted(self: LinkProtocol, data: bytes, addr: Any) -> None:
        packets[self._quic.configuration.is_client] += self.peer is not None
        taken(self, data, addr)

    async def work() -> None:
        got: list[bytes] = []
        centre = CentreLinks(keys, HOSTS, received=lambda train, _: centre.send(train, b"x"))
        await centre.start()
        train = TrainLinks(7, keys, create_bearers(centre.addresses, LOCAL), received=got.append)
        await train.start()
        assert await _until(lambda: len(train.protocols) == 2, 5.0) < 5.0
        await asyncio.sleep(0.3)
        packets.clear()
        for _ in range(20):
            train.send(b"place")
            await asyncio.sleep(0.05)
        assert await _until(lambda: len(got) >= 20, 5.0) < 5.0
        await asyncio.sleep(0.3)
        assert all(meter.response_rate > 0.99 for meter in train.meters.values())
        await train.stop()
        await centre.stop()

    monkeypatch.setattr(LinkProtocol, "datagram_received", counted)
    run(work())
    assert 40 <= packets[False] <= 48
    assert 40 <= packets[True] <= 88


class Opened:
    """A connection whose handshake is in progress."""

    def __init__(self) -> None:
        self.closed = False

    def close(self) -> None:
        self.closed = True


def test_handshakes_wait_for_room_and_end_where_they_take_too_long() -> None:
    """Of one peer and of all; peers are invited by a Retry as far as there will be room for them."""
    handshakes, now_s = Handshakes(), 100.0
    mine: list[Any] = [Opened() for _ in range(MOST_OF_PEER)]
    for protocol in mine:
        assert handshakes.admits("10.0.0.1", now_s)
        handshakes.begin(protocol, "10.0.0.1", now_s)
    assert not handshakes.admits("10.0.0.1", now_s)
    assert handshakes.admits("10.0.0.2", now_s)
    others: list[Any] = [Opened() for _ in range(MOST_HANDSHAKES - MOST_OF_PEER)]
    room = len(others)
    assert [handshakes.invites(now_s) for _ in range(room + 2)] == [True] * room + [False, False]
    for k, protocol in enumerate(others):
        handshakes.begin(protocol, f"10.0.1.{k}", now_s + 1.0)
    assert not handshakes.admits("10.0.0.3", now_s + 1.0)
    assert not handshakes.invites(now_s + 1.0)
    handshakes.end(mine[0])
    assert handshakes.admits("10.0.0.3", now_s + 1.0)
    handshakes.begin(mine[0], "10.0.0.3", now_s + 1.0)
    assert handshakes.admits("10.0.0.1", now_s + HANDSHAKE_S)  # there is room for the peer, and the oldest of all ends
    assert [protocol.closed for protocol in mine[1:4]] == [True, False, False]
    assert not any(protocol.closed for protocol in others)


def test_handshakes_and_connected_peers_take_turns(keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A queue of reports delays a handshake by a turn only, and the reverse; what has waited too long is dropped."""
    order: list[str] = []

    class Connected:
        def datagram_received(self, data: bytes, _addr: Any) -> None:
            order.append(data.decode())

    monkeypatch.setattr(QuicServer, "datagram_received", lambda _self, data, _addr: order.append(data.decode()))

    async def work() -> None:
        settings = configuration(keys, "centre", is_client=False)
        server, _ = await listen(("127.0.0.1", 0), settings, received=lambda *_: None, rejected=lambda: None)
        now_s, peer = asyncio.get_running_loop().time(), ("127.0.0.1", 1)
        queue: Any = server._connected
        queue.extend((b"late", peer, Connected(), now_s - 1.5 * LATE_S) for _ in range(5))
        queue.extend((b"report", peer, Connected(), now_s) for _ in range(3 * TURN))
        server._opening.extend([(b"handshake", peer, False)] * 2)
        for cid in (b"1", b"2"):
            server._asking[cid] = b"first", peer, now_s
        server._turn()
        await asyncio.sleep(0.1)
        assert (server.late, order.count("late")) == (5, 0)
        server.close()

    run(work())
    turn = ["report"] * TURN
    assert order == ["handshake", *turn, "handshake", *turn, "first", *turn, "first"]


def test_a_silent_link_is_opened_again_although_round_trips_vary(keys: Path) -> None:
    """QUIC alone would wait for three times its probe time-out, here more than a minute."""

    async def work() -> float:
        centre = CentreLinks(keys, HOSTS, received=lambda *_: None)
        await centre.start()
        relays = {name: Relay(centre.addresses[name], RelaySettings()) for name in BEARERS}
        for name in BEARERS:
            await relays[name].open(HOSTS[name])
        bearers = create_bearers({n: r.address for n, r in relays.items()}, LOCAL)
        train = TrainLinks(7, keys, bearers, limits=LinkLimits(idle_s=1.0))
        await train.start()
        await _until(lambda: len(train.protocols) == 2, 5.0)
        for protocol in train.protocols.values():
            protocol._quic._loss._rtt_variance = 5.0
        for relay in relays.values():
            relay.disturbance.up = False
        # again and again, as trains do: a packet that was in transit still answers the first one
        after_s = await _until(lambda: train.send(b"place") or not train.protocols, 10.0)
        for relay in relays.values():
            relay.disturbance.up = True
        assert await _until(lambda: len(train.protocols) == 2, 10.0) < 10.0
        await train.stop()
        await centre.stop()
        for relay in relays.values():
            relay.close()
        return after_s

    assert 0.9 < asyncio.run(work()) < 9.0  # on a slow machine too
