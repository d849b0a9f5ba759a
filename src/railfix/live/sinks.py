"""Where messages go, and in what form: ``FORM@TARGET``.

Forms: ``json`` (a line a message), ``cbor`` (`railfix.io.train_message`; in files and streams each message is
preceded by its length in two bytes, most significant first), ``nmea`` (GGA, RMC, GST), ``tpv`` (gpsd's report class).
Targets: ``-`` (standard output), a file, ``udp://HOST:PORT`` (a datagram a message), ``tcp-server://HOST:PORT``
(everybody who connects), ``mqtt://HOST:PORT/TOPIC``.
"""

from __future__ import annotations

import asyncio
import json
import math
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final, Protocol
from urllib.parse import urlsplit

import numpy as np

from railfix.core.errors import OutputError, SettingsError
from railfix.core.timescale import GPS_EPOCH, gpst_minus_utc
from railfix.io.train_message import MessageStatus, TrainMessage, encode, to_json
from railfix.live.engine import LiveOutput

#: Bytes that may wait for a slow reader of a TCP sink; more and the reader is disconnected.
_LARGEST_BACKLOG: Final = 1 << 20
_HELP: Final = (
    "expected FORM@TARGET, FORM one of json, cbor, nmea, tpv, TARGET -, a file, udp://, tcp-server:// or mqtt://"
)


class Sink(Protocol):
    """Something that takes encoded messages."""

    def send(self, output: LiveOutput) -> None:
        """Send one message."""

    def close(self) -> None:
        """Release what is held."""


def json_bytes(output: LiveOutput) -> bytes:
    """One line of JSON."""
    return to_json(output.message).encode() + b"\n"


def cbor_bytes(output: LiveOutput) -> bytes:
    """CBOR preceded by its length in two bytes."""
    data = encode(output.message)
    return len(data).to_bytes(2, "big") + data


def nmea_bytes(output: LiveOutput) -> bytes:
    """NMEA 0183 sentences GGA, RMC and GST of the place of the message's antenna; nothing without input."""
    place = _geodetic(output)
    if output.result is None:
        return b""
    utc = _utc(output.message)
    clock = f"{utc[11:13]}{utc[14:16]}{utc[17:19]}.{utc[20:22]}"
    day = f"{utc[8:10]}{utc[5:7]}{utc[2:4]}"
    valid = output.message.status in (MessageStatus.POSITION, MessageStatus.COASTING)
    used = max((int(a.n_used[-1]) for a in output.result.antennas.values()), default=0)
    if place is None:
        sentences = [f"GPGGA,{clock},,,,,0,{used:02d},,,M,,M,,", f"GPRMC,{clock},V,,,,,,,{day},,,N"]
        return b"".join(map(_sentence, sentences))
    latitude, longitude, height, sigma = place
    angles = (
        f"{_angle(latitude, 2)},{'N' if latitude >= 0 else 'S'},{_angle(longitude, 3)},{'E' if longitude >= 0 else 'W'}"
    )
    quality = (6 if output.message.status is MessageStatus.COASTING else 1) if valid else 0
    knots = abs(output.message.speed_cmps or 0) * 0.01 * 3600.0 / 1852.0
    sentences = [
        f"GPGGA,{clock},{angles},{quality},{used:02d},,{height:.2f},M,0.00,M,,",
        f"GPRMC,{clock},{'A' if valid else 'V'},{angles},{knots:.2f},,{day},,,{'A' if valid else 'N'}",
        f"GPGST,{clock},,{sigma:.2f},,,{sigma:.2f},{sigma:.2f},{2 * sigma:.2f}",
    ]
    return b"".join(map(_sentence, sentences))


def tpv_bytes(output: LiveOutput) -> bytes:
    """A report of gpsd's class TPV as a line of JSON; heights are above the ellipsoid (altHAE)."""
    place = _geodetic(output)
    report: dict[str, Any] = {"class": "TPV", "device": "railfix", "mode": 1, "time": _utc(output.message)[:23] + "Z"}
    if place is not None:
        latitude, longitude, height, sigma = place
        report |= {"mode": 3, "lat": round(latitude, 9), "lon": round(longitude, 9), "altHAE": round(height, 3)}
        report["eph"] = round(sigma, 3)
    if output.message.speed_cmps is not None:
        report["speed"] = abs(output.message.speed_cmps) / 100.0
    return json.dumps(report, separators=(",", ":")).encode() + b"\n"


FORMS: Final[dict[str, Callable[[LiveOutput], bytes]]] = {
    "json": json_bytes,
    "cbor": cbor_bytes,
    "nmea": nmea_bytes,
    "tpv": tpv_bytes,
}


def _geodetic(output: LiveOutput) -> tuple[float, float, float, float] | None:
    """Latitude, longitude [deg], ellipsoidal height and along-track sigma [m] of the antenna of the message."""
    if output.result is None:
        return None
    for name, antenna in output.result.antennas.items():
        track = output.result.fusion.get(name)
        if track is not None and len(track) and math.isfinite(float(track.chainage_m[-1])):
            values = (track.latitude_deg[-1], track.longitude_deg[-1], track.height_m[-1], track.tracked.sigma_m[-1])
        else:
            values = (
                antenna.latitude_deg[-1],
                antenna.longitude_deg[-1],
                antenna.height_m[-1],
                antenna.along_sigma_m[-1],
            )
        if all(math.isfinite(float(value)) for value in values):
            return float(values[0]), float(values[1]), float(values[2]), float(values[3])
    return None


def _utc(message: TrainMessage) -> str:
    """UTC of a message, ISO 8601 to the microsecond."""
    gpst = GPS_EPOCH + np.timedelta64(message.time_ns, "ns")
    return str((gpst - gpst_minus_utc(gpst).astype("timedelta64[s]")).astype("datetime64[us]"))


def _angle(value: float, digits: int) -> str:
    """Degrees and minutes as NMEA writes them, ddmm.mmmmmmm."""
    minutes = round(abs(value) * 60.0, 7)
    return f"{int(minutes // 60):0{digits}d}{minutes % 60:010.7f}"


def _sentence(body: str) -> bytes:
    checksum = 0
    for value in body.encode("ascii"):
        checksum ^= value
    return f"${body}*{checksum:02X}\r\n".encode("ascii")


@dataclass
class FileSink:
    """Messages into a file or onto standard output."""

    form: Callable[[LiveOutput], bytes]
    file: IO[bytes]

    def send(self, output: LiveOutput) -> None:
        """Write one message; a reader sees it at once."""
        self.file.write(self.form(output))
        self.file.flush()

    def close(self) -> None:
        """Close the file; standard output stays open."""
        if self.file is not sys.stdout.buffer:
            self.file.close()


@dataclass
class UdpSink:
    """A datagram a message."""

    form: Callable[[LiveOutput], bytes]
    address: tuple[str, int]
    lost: int = 0
    socket: socket.socket = field(default_factory=lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))

    def send(self, output: LiveOutput) -> None:
        """Send one datagram; where the network refuses it, it is lost and counted."""
        data = self.form(output)
        if self.form is cbor_bytes:
            data = data[2:]
        try:
            self.socket.sendto(data, self.address)
        except OSError:
            self.lost += 1

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()


class TcpServerSink:
    """Everybody who connects gets the messages from then on."""

    def __init__(self, form: Callable[[LiveOutput], bytes]) -> None:
        self.form = form
        self.server: asyncio.Server | None = None
        self._readers: set[asyncio.StreamWriter] = set()

    async def start(self, host: str, port: int) -> None:
        """Listen."""
        self.server = await asyncio.start_server(self._connected, host, port)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._readers.add(writer)
        try:
            while await reader.read(1024):
                pass
        except OSError:
            pass
        finally:
            self._readers.discard(writer)
            writer.close()

    def send(self, output: LiveOutput) -> None:
        """Send to everybody; who does not keep up is disconnected."""
        data = self.form(output)
        for writer in list(self._readers):
            if writer.transport.get_write_buffer_size() > _LARGEST_BACKLOG:
                writer.transport.abort()
                self._readers.discard(writer)
            else:
                writer.write(data)

    def close(self) -> None:
        """Stop listening and disconnect."""
        if self.server is not None:
            self.server.close()
        for writer in self._readers:
            writer.close()


class MqttSink:
    """Messages published under a topic of an MQTT broker."""

    def __init__(self, form: Callable[[LiveOutput], bytes], host: str, port: int, topic: str) -> None:
        try:
            from paho.mqtt import client
        except ModuleNotFoundError:
            raise SettingsError("mqtt:// needs paho-mqtt; install railfix[mqtt]") from None
        self.form, self.topic = form, topic
        self._client = client.Client(client.CallbackAPIVersion.VERSION2)
        try:
            self._client.connect(host, port)
        except OSError as error:
            raise OutputError(f"mqtt://{host}:{port}: cannot be connected to ({error})") from None
        self._client.loop_start()

    def send(self, output: LiveOutput) -> None:
        """Publish one message, delivered at most once."""
        data = self.form(output)
        self._client.publish(self.topic, data[2:] if self.form is cbor_bytes else data, qos=0)

    def close(self) -> None:
        """Disconnect."""
        self._client.loop_stop()
        self._client.disconnect()


async def open_sink(text: str, *, overwrite: str = "refuse") -> Sink:
    """Open one sink.

    Raises
    ------
    SettingsError
        The text names no form or target.
    OutputError
        The target cannot be opened, or is a file that exists already.
    """
    name, at, target = text.partition("@")
    form = FORMS.get(name)
    if not at or form is None or not target:
        raise SettingsError(f"--send {text!r}: {_HELP}")
    if target == "-":
        return FileSink(form, sys.stdout.buffer)
    parts = urlsplit(target)
    if parts.scheme in ("udp", "tcp-server", "mqtt"):
        try:
            host, port = parts.hostname, parts.port
        except ValueError:
            host, port = None, None
        if not host or port is None:
            raise SettingsError(f"--send {text!r}: {_HELP}")
        try:
            if parts.scheme == "udp":
                return UdpSink(form, (socket.gethostbyname(host), port))
            if parts.scheme == "mqtt":
                return MqttSink(form, host, port, parts.path.strip("/") or "railfix")
            server = TcpServerSink(form)
            await server.start(host, port)
        except OSError as error:
            raise OutputError(f"{target}: cannot be opened ({error.strerror or error})") from None
        return server
    if Path(target).exists() and overwrite == "refuse":
        raise OutputError(f"{target}: the file exists already; name another one, or give --overwrite")
    try:
        return FileSink(form, Path(target).open("wb"))
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror or error})") from None
