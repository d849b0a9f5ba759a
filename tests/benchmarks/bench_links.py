"""Redundant links beside plain UDP and MQTT over TLS, all over the same relay of IP packets.

Two network namespaces of the kernel, each with a tunnel device, are joined by a relay in this process, which loses and
delays whole IP packets by a seed: UDP, QUIC and TCP (with the kernel's own retransmission) meet the same disturbance.
Nothing leaves the machine. Needs root, `ip` (iproute2) and, for MQTT, `mosquitto` and paho-mqtt::

    python tests/benchmarks/bench_links.py [--seconds 20] [--rate 20]

Prints for each condition and transport the share of the messages delivered, the one-way delay (median, 99th
percentile, largest) and the largest age of the newest message at the receiver; and the throughput without disturbance.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import ctypes
import fcntl
import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from railfix.ground.demo import LinkDisturbance, RelaySettings
from railfix.ground.keys import write_keys
from railfix.ground.links import BEARERS, CentreLinks, TrainLinks, create_bearers

#: Namespaces, and addresses of both bearers in each.
TRAIN, CENTRE = f"rf{os.getpid()}t", f"rf{os.getpid()}c"
HOSTS = {TRAIN[-1]: {"A": "10.99.1.1", "B": "10.99.2.1"}, CENTRE[-1]: {"A": "10.99.1.2", "B": "10.99.2.2"}}
PORTS = {"A": 4433, "B": 4434}
UDP_PORT, MQTT_PORT = 5000, 8883
#: Bytes of a message: about those of a position message.
SIZE = 100
TRANSPORTS = ("udp", "links, spare", "links, both", "mqtt tls qos 0", "mqtt tls qos 1")
CONDITIONS: dict[str, RelaySettings] = {
    "20 ms": RelaySettings(delay_s=0.02),
    "20 to 40 ms, loss 5 %": RelaySettings(delay_s=0.02, jitter_s=0.02, loss=0.05),
    "20 to 40 ms, loss 20 %": RelaySettings(delay_s=0.02, jitter_s=0.02, loss=0.2),
    "20 ms, out for 3 s": RelaySettings(delay_s=0.02),
}
CLEAN = RelaySettings()


def ip(*words: str) -> None:
    """Run iproute2."""
    subprocess.run(["ip", *words], check=True)


def tunnel(namespace: str) -> int:
    """Return the descriptor of a tunnel device in a namespace, opened from this process."""
    libc, made = ctypes.CDLL(None, use_errno=True), []

    def enter() -> None:
        with open(f"/run/netns/{namespace}") as file:  # noqa: PTH123
            if libc.setns(file.fileno(), 0x40000000) != 0:
                raise OSError(ctypes.get_errno(), "setns")
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(device, 0x400454CA, struct.pack("16sH", b"tun0", 0x1001))  # TUNSETIFF: packets without a head
        made.append(device)

    thread = threading.Thread(target=enter)  # a namespace belongs to a thread
    thread.start()
    thread.join()
    ip("-n", namespace, "link", "set", "lo", "up")
    ip("-n", namespace, "link", "set", "tun0", "up", "mtu", "1400", "txqueuelen", "5000")
    for host in HOSTS[namespace[-1]].values():
        ip("-n", namespace, "addr", "add", f"{host}/24", "dev", "tun0")
    return int(made[0])


def relayed(devices: tuple[int, int], settings: RelaySettings) -> dict[int, LinkDisturbance]:
    """Begin to pass packets between two devices; return the disturbance of each direction."""
    loop = asyncio.get_running_loop()
    disturbances = {}
    for k, (here, there) in enumerate((devices, devices[::-1])):
        disturbance = disturbances[here] = LinkDisturbance(settings.replaced(seed=k))

        def write(data: bytes, there: int = there) -> None:
            with contextlib.suppress(BlockingIOError):  # the queue of the device is full: lost, as on a link
                os.write(there, data)

        def read(
            here: int = here, disturbance: LinkDisturbance = disturbance, write: Callable[..., None] = write
        ) -> None:
            for _ in range(64):
                try:
                    data = os.read(here, 2048)
                except BlockingIOError:
                    return
                if data[0] >> 4 == 4:
                    disturbance.packet(data, write)

        loop.add_reader(here, read)
    return disturbances


class Receiver:
    """Numbers and times of the messages that came in; one whose number is -1 ends it."""

    def __init__(self) -> None:
        self.came: list[tuple[int, int]] = []
        self.end = asyncio.Event()

    def take(self, payload: bytes) -> None:
        """Note a message."""
        number = struct.unpack("!q", payload[:8])[0]
        self.came.append((number, time.monotonic_ns()))


async def receive(transport: str, folder: Path, receiver: Receiver) -> Callable[[], Any]:
    """Receive at the centre; return what ends it."""
    host = HOSTS["c"]["A"]
    loop = asyncio.get_running_loop()
    if transport == "udp":

        class Protocol(asyncio.DatagramProtocol):
            def datagram_received(self, data: bytes, addr: Any) -> None:  # noqa: ARG002
                receiver.take(data)

        done, _ = await loop.create_datagram_endpoint(Protocol, local_addr=(host, UDP_PORT))
        return done.close
    if transport.startswith("links"):
        links = CentreLinks(folder, HOSTS["c"], ports=PORTS, received=lambda _, data: receiver.take(data))
        await links.start()
        return links.stop
    from paho.mqtt import client as mqtt
    from paho.mqtt.enums import CallbackAPIVersion

    (folder / "mosquitto.conf").write_text(
        f"listener {MQTT_PORT} {host}\nallow_anonymous true\nmax_queued_messages 100000\n"
        f"cafile {folder}/authority.pem\ncertfile {folder}/centre.pem\nkeyfile {folder}/centre.key\n"
        "require_certificate true\nuser root\n"
    )
    broker = subprocess.Popen(
        [shutil.which("mosquitto") or "mosquitto", "-c", str(folder / "mosquitto.conf")], stderr=subprocess.DEVNULL
    )
    await asyncio.sleep(1.0)
    listener = mqtt_client(mqtt.Client(CallbackAPIVersion.VERSION2), folder, "centre")
    listener.on_message = lambda _client, _data, message: receiver.take(message.payload)
    listener.connect(host, MQTT_PORT)
    listener.subscribe("train", qos=1)
    listener.loop_start()

    def stop() -> None:
        listener.loop_stop()
        listener.disconnect()
        broker.terminate()
        broker.wait()

    return stop


def mqtt_client(client: Any, folder: Path, name: str) -> Any:
    """Give a client of MQTT its certificates."""
    client.tls_set(ca_certs=str(folder / "authority.pem"), certfile=str(folder / f"{name}.pem"),
                   keyfile=str(folder / f"{name}.key"))  # fmt: skip
    client.tls_insecure_set(True)  # the certificate names "centre", not an address
    return client


async def send(transport: str, folder: Path, rate: float, seconds: float) -> list[tuple[int, int]]:
    """Send from the train; return numbers and times. A rate of 0 is as fast as it goes."""
    host, sent = HOSTS["c"]["A"], []
    loop = asyncio.get_running_loop()
    pause: Callable[[], Any] = lambda: asyncio.sleep(0)  # noqa: E731
    if transport == "udp":
        endpoint, _ = await loop.create_datagram_endpoint(asyncio.DatagramProtocol, remote_addr=(host, UDP_PORT))
        put: Callable[[bytes], Any] = endpoint.sendto
        stop: Callable[[], Any] = endpoint.close
    elif transport.startswith("links"):
        links = TrainLinks(
            1,
            folder,
            create_bearers({b: (HOSTS["c"][b], PORTS[b]) for b in BEARERS}, HOSTS["t"]),
            mode=transport.split(", ")[1],
        )  # type: ignore[arg-type]
        await links.start()
        while len(links.protocols) < 2:
            await asyncio.sleep(0.01)
        put, stop = links.send, links.stop
    else:
        from paho.mqtt import client as mqtt
        from paho.mqtt.enums import CallbackAPIVersion

        publisher = mqtt_client(mqtt.Client(CallbackAPIVersion.VERSION2), folder, "train-1")
        publisher.max_inflight_messages_set(1000)
        publisher.connect(host, MQTT_PORT)
        publisher.loop_start()
        qos = int(transport[-1])

        def put(payload: bytes) -> None:
            publisher.publish("train", payload, qos=qos)

        def stop() -> None:
            publisher.disconnect()
            publisher.loop_stop()

        await asyncio.sleep(1.0)
    begun, number = loop.time(), 0
    print("begun", flush=True)
    while loop.time() - begun < seconds:
        sent.append((number, time.monotonic_ns()))
        put(struct.pack("!q", number).ljust(SIZE, b"."))
        number += 1
        if rate > 0:
            await asyncio.sleep(max(0.0, begun + number / rate - loop.time()))
        elif number % 20 == 0:
            await pause()
    await asyncio.sleep(3.0)
    if (result := stop()) is not None:
        await result
    return sent


async def role(name: str, transport: str, folder: Path, rate: float, seconds: float) -> None:
    """Be the train or the centre, in its namespace; print what was sent or came in."""
    if name == "t":
        print(json.dumps(await send(transport, folder, rate, seconds)))
        return
    receiver = Receiver()
    stop = await receive(transport, folder, receiver)
    print("ready", flush=True)
    await asyncio.to_thread(sys.stdin.readline)
    if (result := stop()) is not None:
        await result
    print(json.dumps(receiver.came))


async def trial(
    devices: tuple[int, int], transport: str, settings: RelaySettings, folder: Path, *, rate: float, seconds: float,
    out: bool = False,
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:  # fmt: skip
    """Send over the relay; return what was sent, and what came."""
    disturbances = relayed(devices, CLEAN)

    async def started(namespace: str) -> asyncio.subprocess.Process:
        words = [sys.executable, __file__, "--role", namespace[-1], transport, str(folder), str(rate), str(seconds)]
        return await asyncio.create_subprocess_exec(
            "ip", "netns", "exec", namespace, *words, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
            limit=1 << 28,
        )  # fmt: skip

    centre = await started(CENTRE)
    assert centre.stdin is not None and centre.stdout is not None  # noqa: PT018
    assert (await centre.stdout.readline()).strip() == b"ready"
    train = await started(TRAIN)
    assert train.stdout is not None
    assert (await train.stdout.readline()).strip() == b"begun"
    for disturbance in disturbances.values():
        disturbance.settings = settings
    if out:
        await asyncio.sleep(seconds / 3)
        for up in (False, True):
            for disturbance in disturbances.values():
                disturbance.up = up
            await asyncio.sleep(0.0 if up else 3.0)
    sent = json.loads(await train.stdout.readline())
    centre.stdin.write(b"\n")
    await centre.stdin.drain()
    came = json.loads(await centre.stdout.readline())
    await train.wait()
    await centre.wait()
    for device in devices:
        asyncio.get_running_loop().remove_reader(device)
    return sent, came


def row(sent: list[tuple[int, int]], came: list[tuple[int, int]]) -> str:
    """Delivered share, delays and largest age of the newest message."""
    at = dict(reversed(came))  # the first copy
    times = dict(sent)
    delay = np.array([(at[n] - times[n]) / 1e6 for n in at])
    order = sorted((arrival, n) for n, arrival in at.items())
    newest, ages = -1, []
    for arrival, n in order:
        if newest >= 0:
            ages.append((arrival - times[newest]) / 1e6)
        newest = max(newest, n)
    p50, p99 = np.percentile(delay, [50, 99])
    share = 100.0 * len(at) / len(sent)
    return f"{share:7.1f} % {p50:7.1f} {p99:8.1f} {delay.max():8.1f} {max(ages):10.0f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=20.0, help="messages a second")
    parser.add_argument("--role", nargs=5, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.role:
        name, transport, folder, rate, seconds = arguments.role
        return asyncio.run(role(name, transport, Path(folder), float(rate), float(seconds)))
    if os.geteuid() != 0:
        sys.exit("network namespaces need root")
    transports = [t for t in TRANSPORTS if shutil.which("mosquitto") or not t.startswith("mqtt")]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_keys(folder, [1])
        try:
            for namespace in (TRAIN, CENTRE):
                ip("netns", "add", namespace)
            devices = tunnel(TRAIN), tunnel(CENTRE)
            print(f"{arguments.rate:g} messages of {SIZE} bytes a second, {arguments.seconds:g} s; one way [ms]")
            print(f"{'condition':24}{'transport':16}{'delivered':>9}     p50      p99  largest  oldest")
            for condition, settings in CONDITIONS.items():
                for transport in transports:
                    result = asyncio.run(
                        trial(devices, transport, settings, folder, rate=arguments.rate, seconds=arguments.seconds,
                              out="out" in condition)
                    )  # fmt: skip
                    print(f"{condition:24}{transport:16}{row(*result)}", flush=True)
            print("throughput without disturbance, as fast as one process sends")
            for transport in transports:
                sent, came = asyncio.run(trial(devices, transport, CLEAN, folder, rate=0.0, seconds=3.0))
                arrived = len({n for n, _ in came})
                span = (max(t for _, t in came) - min(t for _, t in came)) / 1e9
                print(
                    f"{'':24}{transport:16}{arrived / span:7.0f} a second, {100 * arrived / len(sent):.1f} % delivered"
                )
        finally:
            for namespace in (TRAIN, CENTRE):
                subprocess.run(["ip", "netns", "del", namespace], check=False)
    return None


if __name__ == "__main__":
    main()
