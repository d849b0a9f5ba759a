"""QUIC connections with datagrams, and the keys and certificates of both ends.

aioquic requests a client's certificate, and delays acknowledgements, only by private attributes
(`_request_client_certificate`, `_peer_certificate`, `_ack_delay`, `_spaces`, `_loss`, `_datagrams_pending`); they are
used in this module alone.
"""

from __future__ import annotations

import asyncio
import errno
import socket
import ssl
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, Final, cast

from railfix.core.errors import needs_extra
from railfix.ground.keys import Peer

with needs_extra():
    from aioquic.asyncio.protocol import QuicConnectionProtocol
    from aioquic.asyncio.server import QuicServer, serve
    from aioquic.quic.configuration import QuicConfiguration
    from aioquic.quic.connection import QuicConnection
    from aioquic.quic.events import ConnectionTerminated, DatagramFrameReceived, HandshakeCompleted, QuicEvent
    from aioquic.tls import Alert, Epoch, verify_certificate

#: Name of the protocol in the handshake.
PROTOCOL: Final = "railfix-link/1"
#: A connection without any packet ends after this time [s], or earlier at the train's request (`LinkLimits.idle_s`).
IDLE_S: Final = 10.0
#: Longest delay of a centre's answers to frames, to be sent with an authority [s].
WAIT_S: Final = 0.2
#: Longest delay of QUIC acknowledgements, to be sent with a frame [s].
ACKNOWLEDGE_S: Final = 1.5
#: Largest number of handshakes of one peer in progress.
MOST_HANDSHAKES: Final = 64
#: Receive buffer for packets that arrive while the centre is busy; the default buffer overflows with a thousand trains
#: after 0.1 s. The system may allow less (Linux: net.core.rmem_max).
RECEIVE_BYTES: Final = 1 << 22
_REJECTED: Final = 0x101


def configuration(folder: Path, name: str, *, is_client: bool, idle_s: float = IDLE_S) -> QuicConfiguration:
    """Return the settings of an end from the files that `railfix.ground.keys.write_keys` wrote."""
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


class Handshakes:
    """Handshakes in progress, at most `MOST_HANDSHAKES` per peer: a further one ends the oldest."""

    def __init__(self) -> None:
        self._open: dict[str, dict[LinkProtocol, None]] = {}

    def begin(self, protocol: LinkProtocol, peer: str) -> None:
        """Note the first packet of a connection."""
        mine = self._open.setdefault(peer, {})
        mine[protocol] = None
        if len(mine) > MOST_HANDSHAKES:
            oldest = next(iter(mine))
            del mine[oldest]
            oldest.close()

    def end(self, protocol: LinkProtocol) -> None:
        """Note that a handshake is done, or its connection has ended."""
        for peer, mine in list(self._open.items()):
            mine.pop(protocol, None)
            if not mine:
                del self._open[peer]


class LinkProtocol(QuicConnectionProtocol):
    """One end of a connection that carries datagrams.

    `peer` has the certificate of the other end, None before it was verified.
    """

    def __init__(
        self,
        quic: QuicConnection,
        stream_handler: Any = None,
        *,
        received: Callable[[LinkProtocol, bytes], None],
        rejected: Callable[[], None] = lambda: None,
        wait_s: float = 0.0,
        handshakes: Handshakes | None = None,
    ) -> None:
        super().__init__(quic, stream_handler)
        self._handshakes, self._begun = handshakes, False
        self.peer: Peer | None = None
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
            if self._handshakes is not None:
                self._handshakes.end(self)

    def _verify(self) -> None:
        certificate = self._quic.tls._peer_certificate
        try:
            if certificate is None:
                raise ValueError("no certificate")
            verify_certificate(certificate, cadata=self._quic.configuration.cadata)
            self.peer = Peer.of(certificate)
            if self._handshakes is not None:
                self._handshakes.end(self)
            self._quic._ack_delay = ACKNOWLEDGE_S
            self._quic._loss.max_ack_delay = 2.0 * ACKNOWLEDGE_S
        except (Alert, ValueError):
            self.reject()

    def reject(self) -> None:
        """End the connection because of its certificate."""
        self.peer = None
        self._rejected()
        self.close(error_code=_REJECTED, reason_phrase="certificate")

    def datagram_received(self, data: bytes | str, addr: Any) -> None:
        """Process a packet; delayed acknowledgements to a verified peer halve packets and work."""
        if self._handshakes is not None and not self._begun:
            self._begun = True
            self._handshakes.begin(self, str(addr[0]))
        if self._wait_s == 0.0 or self.peer is None or self.ended:
            super().datagram_received(data, addr)
            return
        self._quic.receive_datagram(cast(bytes, data), addr, now=self._loop.time())
        self._process_events()
        if self._waiting is None:
            self._waiting = self._loop.call_later(self._wait_s, self.transmit)

    def answer(self, made: Callable[[], bytes]) -> None:
        """Send the result of `made` with the next packet."""
        self._answers.append(made)

    def transmit(self) -> None:
        """Send due messages with the delayed answers."""
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
    """Add the address and the remedy to an OSError from listening at an address."""
    try:
        yield
    except OSError as error:
        todo = {
            errno.EADDRINUSE: "end the program that listens there, or choose another port",
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
    """Listen for connections at an address; port 0 takes a free port. Return the server and its address.

    Answers and acknowledgements to a verified peer are delayed up to `wait_s`, to be sent with a message. A peer must
    prove its address before any of its data are stored (Retry, RFC 9000, 8.1.2).
    """
    handshakes = Handshakes()
    with address_errors(*address):
        server = await serve(
            *address,
            configuration=settings,
            create_protocol=lambda quic, stream_handler=None: LinkProtocol(
                quic, stream_handler, received=received, rejected=rejected, wait_s=wait_s, handshakes=handshakes
            ),
            retry=True,
        )
    transport: Any = server._transport
    transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
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
    """Connect from the local address of the bearer's interface.

    ConnectionError, TimeoutError: the other end rejects the certificate, has another name, or does not answer.
    """
    loop = asyncio.get_running_loop()
    transport, protocol = await loop.create_datagram_endpoint(
        lambda: LinkProtocol(QuicConnection(configuration=settings), received=received), local_addr=(local, 0)
    )
    try:
        protocol.connect(address)
        # `wait_for` would not retrieve the error of a connection that ends as it gives up.
        async with asyncio.timeout(timeout_s):
            await protocol.wait_connected()
        yield protocol
    finally:
        protocol._connected_waiter = None  # after a time-out nothing retrieves the error set by closing
        protocol.close()
        await asyncio.sleep(0)
        transport.close()
