"""QUIC connections with datagrams, in which both ends are authenticated by certificates.

Only this module uses private attributes of aioquic (`_request_client_certificate`, `_peer_certificate`, `_ack_delay`,
`_spaces`, `_loss`, `_datagrams_pending`). They are required to request a client certificate, and to delay
acknowledgements.
"""

from __future__ import annotations

import asyncio
import errno
import socket
import ssl
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any, Final, cast

from railfix.core.extras import needs_extra
from railfix.ground.keys import Peer

with needs_extra():
    from aioquic.asyncio.protocol import QuicConnectionProtocol
    from aioquic.asyncio.server import QuicServer
    from aioquic.buffer import Buffer  # type: ignore[attr-defined]
    from aioquic.quic.configuration import QuicConfiguration
    from aioquic.quic.connection import QuicConnection
    from aioquic.quic.events import ConnectionTerminated, DatagramFrameReceived, HandshakeCompleted, QuicEvent
    from aioquic.quic.packet import QuicPacketType, pull_quic_header
    from aioquic.tls import Alert, Epoch, verify_certificate

#: Name of the protocol in the handshake.
PROTOCOL: Final = "railfix-link/1"
#: A connection without any packet ends after this time [s], or earlier at the train's request (`LinkLimits.idle_s`).
IDLE_S: Final = 10.0
#: Longest time for which a centre delays its answer to a frame, in order to send the answer with an authority [s].
WAIT_S: Final = 0.2
#: Longest time for which a QUIC acknowledgement is delayed, in order to be sent with a frame [s].
ACKNOWLEDGE_S: Final = 1.5
#: Largest number of concurrent handshakes with one peer; further handshakes wait.
MOST_OF_PEER: Final = 16
#: Largest number of concurrent handshakes with all peers together; further handshakes wait.
MOST_HANDSHAKES: Final = 64
#: Time after which a handshake in progress is ended if another handshake waits [s]; by then, the peer has given up.
HANDSHAKE_S: Final = 5.0
#: After a Retry, room for the peer's handshake is reserved for this time [s].
INVITED_S: Final = 0.25
#: Interval at which waiting first packets are checked [s].
ASKING_S: Final = 0.01
#: Size of the receive buffer for packets that arrive while the centre is busy. With a thousand trains, the default
#: buffer overflows after 0.1 s. The system may allow less (Linux: net.core.rmem_max).
RECEIVE_BYTES: Final = 1 << 22
#: Largest number of packets of connected peers that are processed per packet of a handshake.
TURN: Final = 16
#: Time after which a waiting packet of a connected peer is dropped, because the peer has sent a newer message [s].
LATE_S: Final = 1.0
#: Largest number of waiting handshake packets; also the largest number of packets read at a time.
MOST_WAITING: Final = 1024
_REJECTED: Final = 0x101


def configuration(folder: Path, name: str, *, is_client: bool, idle_s: float = IDLE_S) -> QuicConfiguration:
    """Return the QUIC configuration of one end, from the files that `railfix.ground.keys.write_keys` writes."""
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
    """Handshakes in progress, limited in number so that each is completed before its peer gives up."""

    def __init__(self) -> None:
        self._open: dict[LinkProtocol, tuple[str, float]] = {}  #: Peer's address and time of its first packet [s].
        self._invited, self._since_s = 0, float("-inf")

    def invites(self, now_s: float) -> bool:
        """Return whether a peer may be invited to prove its address: there must be room for its handshake."""
        if now_s - self._since_s > INVITED_S:
            self._invited, self._since_s = 0, now_s
        room = MOST_HANDSHAKES - self._invited
        if room <= 0 or not self._has_room(list(self._open), room, now_s):
            return False
        self._invited += 1
        return True

    def admits(self, peer: str, now_s: float) -> bool:
        """Return whether a peer that has proved its address may begin a handshake."""
        mine = [protocol for protocol, (of, _) in self._open.items() if of == peer]
        return self._has_room(mine, MOST_OF_PEER, now_s) and self._has_room(list(self._open), MOST_HANDSHAKES, now_s)

    def _has_room(self, handshakes: list[LinkProtocol], most: int, now_s: float) -> bool:
        """Return whether there is room for another handshake.

        If necessary, the oldest handshake is ended, once it has lasted `HANDSHAKE_S`.
        """
        if len(handshakes) < most:
            return True
        oldest = handshakes[0]
        if now_s - self._open[oldest][1] < HANDSHAKE_S:
            return False
        self.end(oldest)
        oldest.close()
        return True

    def begin(self, protocol: LinkProtocol, peer: str, now_s: float) -> None:
        """Record the first packet of a connection."""
        self._open[protocol] = peer, now_s

    def end(self, protocol: LinkProtocol) -> None:
        """Record that a handshake is complete, or that its connection has ended."""
        self._open.pop(protocol, None)


class LinkProtocol(QuicConnectionProtocol):
    """One end of a connection that carries datagrams.

    `peer` is the verified certificate of the other end, None before the verification.
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
        #: Function called once, when the first packet from the other end arrives.
        self.patience: Callable[[], None] | None = None
        self.unanswered_s: float | None = None  #: Time of the first message sent since the last received packet [s].
        self._answers: list[Callable[[], bytes]] = []
        self._waiting: asyncio.TimerHandle | None = None
        if not quic.configuration.is_client:
            initialize = quic._initialize

            def with_request(peer_cid: bytes) -> None:
                initialize(peer_cid)
                quic.tls._request_client_certificate = True

            quic._initialize = with_request  # type: ignore[method-assign]

    def quic_event_received(self, event: QuicEvent) -> None:
        """Verify the peer at the end of the handshake, and pass on datagrams of a verified peer."""
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
        """End the connection because of the peer's certificate."""
        self.peer = None
        self._rejected()
        self.close(error_code=_REJECTED, reason_phrase="certificate")

    def datagram_received(self, data: bytes | str, addr: Any) -> None:
        """Process a packet; acknowledgements to a verified peer are delayed, which halves the number of packets."""
        self.unanswered_s = None
        if self.patience is not None:
            self.patience()
            self.patience = None
        if self._handshakes is not None and not self._begun:
            self._begun = True
            self._handshakes.begin(self, str(addr[0]), self._loop.time())
        if self._wait_s == 0.0 or self.peer is None or self.ended:
            super().datagram_received(data, addr)
            return
        self._quic.receive_datagram(cast(bytes, data), addr, now=self._loop.time())
        self._process_events()
        if self._waiting is None:
            self._waiting = self._loop.call_later(self._wait_s, self.transmit)

    def answer(self, made: Callable[[], bytes]) -> None:
        """Send the result of `made` with the next packet; `made` is called when that packet is sent."""
        self._answers.append(made)

    def transmit(self) -> None:
        """Send due messages together with the delayed answers."""
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
        if self.unanswered_s is None:
            self.unanswered_s = self._loop.time()
        self.transmit()

    async def wait_silent(self, idle_s: float) -> None:
        """Wait until the connection is closed, or no packet has arrived within `idle_s` after a message was sent.

        The idle time-out of QUIC would be too long: it is at least three times the probe time-out, which grows with the
        variation of round trips.
        """
        while not self.ended:
            now_s = self._loop.time()
            left_s = idle_s + (now_s if self.unanswered_s is None else self.unanswered_s) - now_s
            if left_s <= 0.0:
                return
            with suppress(TimeoutError):
                async with asyncio.timeout(left_s):
                    await self.wait_closed()


@contextmanager
def address_errors(host: str, port: int) -> Iterator[None]:
    """Context manager that adds the address and a remedy to the OSError of a failed attempt to listen."""
    try:
        yield
    except OSError as error:
        todo = {
            errno.EADDRINUSE: "end the program that listens there, or choose another port",
            errno.EACCES: "choose a port above 1023",
        }.get(error.errno or 0, "choose an address of this computer")
        raise OSError(error.errno, f"cannot listen at {host}:{port} ({error.strerror}); {todo}") from None


class _Socket:
    """Sending end of a server; a packet that the system does not accept is lost."""

    def __init__(self, bound: socket.socket) -> None:
        self._bound = bound

    def sendto(self, data: bytes, addr: Any) -> None:
        with suppress(OSError):
            self._bound.sendto(data, addr)

    def close(self) -> None:
        self._bound.close()


class LinkServer(QuicServer):
    """Server that reads all arrived packets, and processes handshakes and connected peers in turns.

    In a turn, one packet of a handshake and up to `TURN` packets of connected peers are processed. Handshakes in
    progress precede new handshakes. `late` is the number of packets that were dropped because they had waited longer
    than `LATE_S`.
    """

    def __init__(self, bound: socket.socket, handshakes: Handshakes, **settings: Any) -> None:
        super().__init__(**settings)
        self.late = 0
        self._bound, self._handshakes = bound, handshakes
        self._connected: deque[tuple[bytes, Any, LinkProtocol, float]] = deque()
        self._opening: deque[tuple[bytes, Any, bool]] = deque(maxlen=MOST_WAITING)
        self._asking: dict[bytes, tuple[bytes, Any, float]] = {}  #: Waiting first packets, by connection identifier.
        self._next: asyncio.Handle | None = None
        self.connection_made(_Socket(bound))  # type: ignore[arg-type]
        self._loop.add_reader(bound, self._read)

    def close(self) -> None:
        """End all connections, and close the server."""
        self._loop.remove_reader(self._bound)
        if self._next is not None:
            self._next.cancel()
        super().close()

    def _read(self) -> None:
        """Read the packets that have arrived."""
        now_s, length = self._loop.time(), self._configuration.connection_id_length
        with suppress(OSError):  # raised if no packet is left, or if a peer has refused a packet
            for _ in range(MOST_WAITING):
                data, addr = self._bound.recvfrom(65_536)
                protocol = None if data[:1] >= b"\x80" else self._protocols.get(data[1 : 1 + length])
                if isinstance(protocol, LinkProtocol) and protocol.peer is not None:
                    self._connected.append((data, addr, protocol, now_s))
                else:
                    self._sort(data, addr, now_s)
        if self._next is not None:
            self._next.cancel()
        self._turn()

    def _sort(self, data: bytes, addr: Any, now_s: float) -> None:
        """Queue a packet of a peer that is not connected; data that are not QUIC packets are dropped."""
        with suppress(ValueError):  # the bytes are not a QUIC packet
            header = pull_quic_header(Buffer(data=data), host_cid_length=self._configuration.connection_id_length)
            first = header.packet_type == QuicPacketType.INITIAL and header.destination_cid not in self._protocols
            if not first or header.token:
                self._opening.append((data, addr, first))
            elif len(self._asking) < MOST_WAITING or header.destination_cid in self._asking:
                self._asking[header.destination_cid] = data, addr, now_s

    def _turn(self) -> None:
        """Process the packets of one turn, and schedule the next turn."""
        now_s, self._next = self._loop.time(), None
        if self._opening:
            data, addr, first = self._opening.popleft()
            if not first or self._handshakes.admits(str(addr[0]), now_s):
                self.datagram_received(data, addr)
        elif self._asking and self._handshakes.invites(now_s):
            data, addr, _ = self._asking.pop(next(iter(self._asking)))
            self.datagram_received(data, addr)
        while self._connected and now_s - self._connected[0][3] > LATE_S:
            self._connected.popleft()
            self.late += 1
        for _ in range(min(TURN, len(self._connected))):
            data, addr, protocol, _ = self._connected.popleft()
            protocol.datagram_received(data, addr)
        if self._opening or self._connected:
            self._next = self._loop.call_soon(self._turn)
        elif self._asking:
            for cid in [cid for cid, (_, _, at_s) in self._asking.items() if now_s - at_s > HANDSHAKE_S]:
                del self._asking[cid]
            self._next = self._loop.call_later(ASKING_S, self._turn)


async def listen(
    address: tuple[str, int],
    settings: QuicConfiguration,
    *,
    received: Callable[[LinkProtocol, bytes], None],
    rejected: Callable[[], None],
    wait_s: float = WAIT_S,
) -> tuple[LinkServer, tuple[str, int]]:
    """Open a server at an address, where port 0 selects a free port; return the server and the address.

    Answers and acknowledgements to a verified peer are delayed by up to `wait_s`, to be sent with a message. Until a
    peer has proved its address (Retry, RFC 9000, 8.1.2), only its first packet is stored.
    """
    handshakes = Handshakes()
    with address_errors(*address):
        found = await asyncio.get_running_loop().getaddrinfo(*address, type=socket.SOCK_DGRAM)
        bound = socket.socket(found[0][0], socket.SOCK_DGRAM)
        try:
            bound.setblocking(False)
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
            bound.bind(found[0][4])
        except OSError:
            bound.close()
            raise
    server = LinkServer(
        bound,
        handshakes,
        configuration=settings,
        create_protocol=lambda quic, stream_handler=None: LinkProtocol(
            quic, stream_handler, received=received, rejected=rejected, wait_s=wait_s, handshakes=handshakes
        ),
        retry=True,
    )
    return server, bound.getsockname()[:2]


@asynccontextmanager
async def connection(
    address: tuple[str, int],
    settings: QuicConfiguration,
    *,
    local: str,
    received: Callable[[LinkProtocol, bytes], None],
    timeout_s: float = 5.0,
) -> AsyncIterator[LinkProtocol]:
    """Connect to a server from the local address of a bearer; a first packet must arrive within `timeout_s`.

    The connection must then be established within three times `timeout_s`. Raise ConnectionError or TimeoutError if the
    other end rejects the certificate, does not have the expected name, or does not answer.
    """
    loop = asyncio.get_running_loop()
    transport, protocol = await loop.create_datagram_endpoint(
        lambda: LinkProtocol(QuicConnection(configuration=settings), received=received), local_addr=(local, 0)
    )
    try:
        protocol.connect(address)
        # `wait_for` would not retrieve the error of a connection that ends at the same moment as the time-out.
        async with asyncio.timeout(timeout_s) as limit:
            protocol.patience = lambda: None if limit.expired() else limit.reschedule(loop.time() + 3.0 * timeout_s)
            await protocol.wait_connected()
        yield protocol
    finally:
        protocol.patience = None
        protocol._connected_waiter = None  # after a time-out, `close` would set an error that nothing retrieves
        protocol.close()
        await asyncio.sleep(0)
        transport.close()
