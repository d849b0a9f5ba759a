"""NTRIP over TLS, and the positions that a caster is sent for a virtual base station."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import ipaddress
import ssl
from collections.abc import Callable, Coroutine
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.errors import InputFileError, SettingsError
from railfix.live.settings import LiveSettings
from railfix.live.sources import read_source
from railfix.simulate.demonstration import demo_files

pytestmark = pytest.mark.requirement("A8")
SETTINGS = LiveSettings(reconnect="off", silence_s=2.0)
GGA = b"$GPGGA,101500.00,3520.5234830,N,13931.3191928,E,1,09,,47.58,M,0.00,M,,*00\r\n"


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A self-signed certificate of 127.0.0.1 with its key, one file."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "caster")])
    now = datetime.datetime.now(datetime.UTC)
    names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(names, critical=False)
        .sign(key, hashes.SHA256())
    )
    path = tmp_path_factory.mktemp("caster") / "caster.pem"
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    path.write_bytes(made.public_bytes(serialization.Encoding.PEM) + secret)
    return path


class Caster:
    """A caster that answers with some bytes once it has been told where the train is, as often as it wants to hear."""

    def __init__(self, *, wants: int) -> None:
        self.wants, self.request, self.lines = wants, b"", list[bytes]()

    async def __call__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, OSError), contextlib.closing(writer):
            self.request = await reader.readuntil(b"\r\n\r\n")
            writer.write(b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\n\r\n")
            for _ in range(self.wants):
                self.lines.append(await reader.readline())
            writer.write(b"corrections")
            await writer.drain()


def received(
    caster: Callable[..., Coroutine[None, None, None]],
    certificate: Path | None,
    settings: LiveSettings,
    *,
    scheme: str = "ntrips",
    place: bytes = b"",
) -> bytes:
    async def run() -> bytes:
        context = None
        if certificate is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(certificate)
        server = await asyncio.start_server(caster, "127.0.0.1", 0, ssl=context)
        port = server.sockets[0].getsockname()[1]
        source = f"{scheme}://train:secret@127.0.0.1:{port}/VRS"
        try:
            parts = [part async for part in read_source(source, settings, lambda: place)]
        finally:
            server.close()
            await asyncio.sleep(0.05)  # the server's own end of what failed
        return b"".join(part for part in parts if isinstance(part, bytes))

    return asyncio.run(run())


def test_a_caster_over_tls_with_a_certificate_of_its_own(certificate: Path) -> None:
    caster = Caster(wants=0)
    assert received(caster, certificate, SETTINGS.replaced(ntrip_certificates=certificate)) == b"corrections"
    assert b"Ntrip-GGA" not in caster.request  # gga_s is 0: the caster is not told the place


def test_a_caster_hears_the_place_in_the_request_and_then_every_interval(certificate: Path) -> None:
    caster = Caster(wants=3)
    settings = SETTINGS.replaced(ntrip_certificates=certificate, gga_s=0.02)
    assert received(caster, certificate, settings, place=GGA) == b"corrections"
    assert b"\r\nNtrip-GGA: " + GGA.strip() + b"\r\n" in caster.request
    assert caster.lines == [GGA] * 3


@pytest.mark.parametrize("base", [[], ["--base", "tcp://127.0.0.1:1"]])
def test_positions_for_a_caster_that_is_not_there_are_one_sentence(tmp_path: Path, base: list[str]) -> None:
    words = ["live", "--front", "tcp://127.0.0.1:1", "--track", str(demo_files()["track"]), "--live", "gga_s=10", *base]
    done = CliRunner().invoke(app, [*words, "--send", f"json@{tmp_path / 'messages'}"])
    assert done.exit_code == 4
    assert "--live gga_s is given without an NTRIP caster" in " ".join(done.output.split())


@pytest.mark.parametrize(
    ("trusted", "scheme", "says"),
    [
        (False, "ntrips", "the server's certificate is not accepted .*self.signed.*ntrip_certificates"),
        (True, "ntrip", r"it may expect TLS \(ntrips://\)"),
    ],
)
def test_a_certificate_that_nobody_has_signed_is_one_sentence(
    certificate: Path, trusted: bool, scheme: str, says: str
) -> None:
    settings = SETTINGS.replaced(ntrip_certificates=certificate) if trusted else SETTINGS
    with pytest.raises(InputFileError, match=says) as error:
        received(Caster(wants=0), certificate, settings, scheme=scheme)
    assert "secret" not in str(error.value)
    assert "\n" not in str(error.value)


def test_a_caster_without_tls_is_said_to_be_one(certificate: Path) -> None:
    async def plain(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.closing(writer):
            writer.write(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            await writer.drain()

    with pytest.raises(InputFileError, match=r"does not use TLS on this port .*give ntrip://"):
        received(plain, None, SETTINGS.replaced(ntrip_certificates=certificate))


def test_a_file_without_certificates_is_named(tmp_path: Path) -> None:
    (tmp_path / "none.pem").write_text("nothing")
    for path, says in ((tmp_path / "none.pem", "no PEM certificate"), (tmp_path / "absent.pem", "No such file")):
        with pytest.raises(SettingsError, match=says):
            received(Caster(wants=0), None, SETTINGS.replaced(ntrip_certificates=path))
