"""QUIC connections with datagrams, and the keys and certificates of both ends.

aioquic asks a client for its certificate, and lets acknowledgements wait, only by attributes that it names as its own
(`_request_client_certificate`, `_peer_certificate`, `_ack_delay`, `_spaces`, `_loss`, `_datagrams_pending`); they are
used in this module alone.
"""

from __future__ import annotations

import asyncio
import errno
import os
import ssl
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final, cast

from aioquic.asyncio.protocol import QuicConnectionProtocol
from aioquic.asyncio.server import QuicServer, serve
from aioquic.quic.configuration import QuicConfiguration
from aioquic.quic.connection import QuicConnection
from aioquic.quic.events import ConnectionTerminated, DatagramFrameReceived, HandshakeCompleted, QuicEvent
from aioquic.tls import Alert, Epoch, verify_certificate
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from railfix.core.errors import InputFileError, OutputError

#: Name of the protocol in the handshake.
PROTOCOL: Final = "railfix-link/1"
#: A connection without any packet ends after this time [s], or earlier where the train wants so (`LinkLimits.idle_s`).
IDLE_S: Final = 10.0
#: A centre lets answers to frames wait so long for an authority that they can go with [s].
WAIT_S: Final = 0.2
#: Acknowledgements of QUIC wait so long for a frame that they can go with [s].
ACKNOWLEDGE_S: Final = 1.5
_REJECTED: Final = 0x101


def configuration(folder: Path, name: str, *, is_client: bool, idle_s: float = IDLE_S) -> QuicConfiguration:
    """Return the settings of an end from the files that `railfix.ground.quic.write_keys` wrote."""
    settings = QuicConfiguration(
        is_client=is_client,
        alpn_protocols=[PROTOCOL],
        max_datagram_frame_size=65_536,
        idle_timeout=idle_s,
        verify_mode=ssl.CERT_REQUIRED,
        cadata=(folder / "authority.pem").read_bytes(),
        server_name="centre" if is_client else None,
    )
    settings.load_cert_chain(folder / f"{name}.pem", folder / f"{name}.key")
    return settings


class LinkProtocol(QuicConnectionProtocol):
    """One end of a connection that carries datagrams.

    `peer` is the common name of the other end's certificate, None before it was verified; `ends`, when that ends to be
    valid.
    """

    def __init__(
        self,
        quic: QuicConnection,
        stream_handler: Any = None,
        *,
        received: Callable[[LinkProtocol, bytes], None],
        rejected: Callable[[], None] = lambda: None,
        wait_s: float = 0.0,
    ) -> None:
        super().__init__(quic, stream_handler)
        self.peer: str | None = None
        self.ends: datetime | None = None
        self.ended = False
        self._received = received
        self._rejected = rejected
        self._wait_s = wait_s
        self._answers: list[Callable[[], bytes]] = []
        self._waiting: asyncio.TimerHandle | None = None
        if not quic.configuration.is_client:
            initialize = quic._initialize

            def with_request(peer_cid: bytes) -> None:
                initialize(peer_cid)
                quic.tls._request_client_certificate = True

            quic._initialize = with_request  # type: ignore[method-assign]

    def quic_event_received(self, event: QuicEvent) -> None:
        """Verify the peer at the end of the handshake; pass datagrams of a verified peer on."""
        if isinstance(event, HandshakeCompleted):
            self._verify()
        elif isinstance(event, DatagramFrameReceived) and self.peer is not None:
            self._received(self, event.data)
        elif isinstance(event, ConnectionTerminated):
            self.ended = True

    def _verify(self) -> None:
        certificate = self._quic.tls._peer_certificate
        try:
            if certificate is None:
                raise ValueError("no certificate")
            verify_certificate(certificate, cadata=self._quic.configuration.cadata)
            names = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
            self.peer, self.ends = str(names[0].value), certificate.not_valid_after_utc
            self._quic._ack_delay = ACKNOWLEDGE_S
            self._quic._loss.max_ack_delay = 2.0 * ACKNOWLEDGE_S
        except (Alert, ValueError, IndexError):
            self.reject()

    def reject(self) -> None:
        """End the connection because of its certificate."""
        self.peer = None
        self._rejected()
        self.close(error_code=_REJECTED, reason_phrase="certificate")

    @property
    def has_expired(self) -> bool:
        """Whether the other end's certificate was valid and is so no more."""
        return self.ends is not None and datetime.now(UTC) > self.ends

    def datagram_received(self, data: bytes | str, addr: Any) -> None:
        """Take a packet; what a verified peer is owed for it waits, where it may: half the packets, half the work."""
        if self._wait_s == 0.0 or self.peer is None or self.ended:
            super().datagram_received(data, addr)
            return
        self._quic.receive_datagram(cast(bytes, data), addr, now=self._loop.time())
        self._process_events()
        if self._waiting is None:
            self._waiting = self._loop.call_later(self._wait_s, self.transmit)

    def answer(self, made: Callable[[], bytes]) -> None:
        """Send what `made` returns with the next packet."""
        self._answers.append(made)

    def transmit(self) -> None:
        """Send what is due with the answers that wait."""
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None
        answers, self._answers = self._answers, []
        if not self.ended:
            for made in answers:
                self._quic.send_datagram_frame(made())
            if self.peer is not None and self._quic._datagrams_pending:
                space = self._quic._spaces[Epoch.ONE_RTT]
                space.ack_at = None if space.ack_at is None else 0.0
        super().transmit()

    def send(self, data: bytes) -> None:
        """Send a datagram; without a connection it is dropped."""
        if self.ended or self.peer is None:
            return
        self._quic.send_datagram_frame(data)
        self.transmit()


@contextmanager
def address_errors(host: str, port: int) -> Iterator[None]:
    """Name the address in an OSError of listening there, and what to do."""
    try:
        yield
    except OSError as error:
        todo = {
            errno.EADDRINUSE: "end the program that does, or choose another port",
            errno.EACCES: "choose a port above 1023",
        }.get(error.errno or 0, "choose an address of this computer")
        raise OSError(error.errno, f"cannot listen at {host}:{port} ({error.strerror}); {todo}") from None


async def listen(
    address: tuple[str, int],
    settings: QuicConfiguration,
    *,
    received: Callable[[LinkProtocol, bytes], None],
    rejected: Callable[[], None],
    wait_s: float = WAIT_S,
) -> tuple[QuicServer, tuple[str, int]]:
    """Listen for connections at an address; port 0 takes a free one. Return the server and its address.

    What is owed to a verified peer, answers and acknowledgements, waits up to `wait_s` to go with what is sent.
    """
    with address_errors(*address):
        server = await serve(
            *address,
            configuration=settings,
            create_protocol=lambda quic, stream_handler=None: LinkProtocol(
                quic, stream_handler, received=received, rejected=rejected, wait_s=wait_s
            ),
        )
    transport: Any = server._transport
    return server, transport.get_extra_info("sockname")[:2]


@asynccontextmanager
async def connection(
    address: tuple[str, int],
    settings: QuicConfiguration,
    *,
    local: str,
    received: Callable[[LinkProtocol, bytes], None],
    timeout_s: float = 5.0,
) -> AsyncIterator[LinkProtocol]:
    """Connect from a local address, that of the bearer's interface.

    ConnectionError, TimeoutError: when the other end rejects the certificate, is another one, or does not answer.
    """
    loop = asyncio.get_running_loop()
    transport, protocol = await loop.create_datagram_endpoint(
        lambda: LinkProtocol(QuicConnection(configuration=settings), received=received), local_addr=(local, 0)
    )
    try:
        protocol.connect(address)
        # `wait_for` would leave the error of a connection that ends as it gives up to nobody.
        async with asyncio.timeout(timeout_s):
            await protocol.wait_connected()
        yield protocol
    finally:
        protocol._connected_waiter = None  # after a time-out nobody takes the error that closing gives it
        protocol.close()
        await asyncio.sleep(0)
        transport.close()


#: Validity of the certificates [days].
VALID_DAYS: Final = 365


def check_keys(folder: Path, name: str) -> None:
    """Raise InputFileError where a file that an end of the links needs is not there."""
    for file in ("authority.pem", f"{name}.pem", f"{name}.key"):
        if not (folder / file).is_file():
            raise InputFileError(folder / file, "is not there; railfix ground keys writes it")


def read_revoked(folder: Path) -> frozenset[str]:
    """Return the names whose certificates do not count any more: the lines of ``revoked.txt``, such as ``train-7``.

    InputFileError: when the file is there and cannot be read.
    """
    path = folder / "revoked.txt"
    try:
        return frozenset(path.read_text(encoding="utf-8").split())
    except FileNotFoundError:
        return frozenset()
    except (OSError, UnicodeDecodeError) as error:
        raise InputFileError(path, f"cannot be read ({error})") from None


def write_keys(folder: Path, trains: list[int], *, valid_days: int = VALID_DAYS) -> list[Path]:
    """Write ``authority.pem``, and certificate and key of ``centre`` and of each ``train-N``; return the files.

    The key of the authority is not kept: for another train write a new set. Keys can be read by their owner alone.
    OutputError: when a file is there already, or cannot be written.
    """
    now = datetime.now(UTC)

    def certificate(name: str, public: ec.EllipticCurvePublicKey, *, authority: str) -> x509.Certificate:
        builder = (
            x509.CertificateBuilder()
            .subject_name(x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)]))
            .issuer_name(x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, authority)]))
            .public_key(public)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - timedelta(hours=1))
            .not_valid_after(now + timedelta(days=valid_days))
            .add_extension(x509.BasicConstraints(ca=name == authority, path_length=None), critical=True)
            .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
        )
        return builder.sign(signing, hashes.SHA256())

    pem = serialization.Encoding.PEM
    signing = ec.generate_private_key(ec.SECP256R1())
    issuer = "railfix authority"
    parts: dict[str, bytes] = {
        "authority.pem": certificate(issuer, signing.public_key(), authority=issuer).public_bytes(pem)
    }
    for name in ("centre", *(f"train-{number}" for number in trains)):
        key = ec.generate_private_key(ec.SECP256R1())
        parts[f"{name}.pem"] = certificate(name, key.public_key(), authority=issuer).public_bytes(pem)
        parts[f"{name}.key"] = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in parts.items():
            mode = 0o600 if name.endswith(".key") else 0o644
            with os.fdopen(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
                file.write(data)
            written.append(folder / name)
    except FileExistsError as error:
        raise OutputError(f"{error.filename}: is there already; name an empty folder") from None
    except OSError as error:
        raise OutputError(f"{folder}: keys cannot be written ({error.strerror})") from None
    return written
