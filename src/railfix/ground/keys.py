"""Keys and certificates of the links: creation, renewal, revocation, and warning before expiry.

One certificate authority signs the certificates of the centre and of the trains. The authority's key stays in the
folder in which it was created, and is not distributed.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple

from railfix.core.errors import InputFileError, OutputError
from railfix.core.extras import needs_extra

with needs_extra():
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

VALID_DAYS: Final = 365  #: Validity of the certificates of the centre and of trains [days].
AUTHORITY_DAYS: Final = 3650  #: Validity of the authority's certificate [days].
WARNING_DAYS: Final = 30  #: An alarm is raised if a certificate expires within this time [days].
_ISSUER: Final = "railfix authority"
_PEM: Final = serialization.Encoding.PEM


def check_keys(folder: Path, name: str) -> None:
    """Raise InputFileError if a key or certificate file of `name` (``centre`` or ``train-N``) is missing."""
    for file in ("authority.pem", f"{name}.pem", f"{name}.key"):
        if not (folder / file).is_file():
            raise InputFileError(folder / file, "does not exist; create it with railfix ground keys")


class Peer(NamedTuple):
    """Verified certificate of the other end of a connection: common name, serial number and end of validity."""

    name: str
    serial: int
    ends: datetime

    @classmethod
    def of(cls, certificate: x509.Certificate) -> Peer:
        """Return the values of a certificate; raise ValueError if the certificate has no common name.

        The values are stored because reading them from a certificate is slow.
        """
        names = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
        if not names:
            raise ValueError("no name")
        return cls(str(names[0].value), certificate.serial_number, certificate.not_valid_after_utc)

    @property
    def valid_s(self) -> float:
        """Time until the certificate expires [s], negative afterwards."""
        return (self.ends - datetime.now(UTC)).total_seconds()


class Revoked(NamedTuple):
    """Names (such as ``train-7``) and serial numbers of revoked certificates."""

    names: frozenset[str] = frozenset()
    serials: frozenset[int] = frozenset()

    def has(self, peer: Peer) -> bool:
        """Return whether a peer's certificate is revoked."""
        return peer.name in self.names or peer.serial in self.serials


def read_revoked(folder: Path) -> Revoked:
    """Return the revoked certificates listed in ``revoked.txt`` (separated by blanks); none if the file is absent.

    A name (``train-7``) revokes all certificates of that name, including later certificates. A serial number
    (``0x5a1f...``, as printed by `railfix ground keys`) revokes one certificate, so that a train whose key was lost can
    receive a new certificate. Raise InputFileError if the file exists and cannot be read.
    """
    path = folder / "revoked.txt"
    try:
        words = path.read_text(encoding="utf-8").split()
        serials = {word for word in words if word.startswith("0x")}
        return Revoked(frozenset(words) - serials, frozenset(int(word, 16) for word in serials))
    except FileNotFoundError:
        return Revoked()
    except (OSError, ValueError) as error:
        raise InputFileError(path, f"cannot be read ({error})") from None


def ending_sentence(name: str, ends: datetime) -> str:
    """Return a sentence that states when a certificate expires, and how to renew it."""
    return f"the certificate {name} expires on {ends.date().isoformat()}; renew it (railfix ground keys --renew)"


def list_ending(folder: Path, name: str, *, now: datetime | None = None) -> list[str]:
    """Return a sentence for each certificate (of `name` or of the authority) that expires within `WARNING_DAYS`."""
    limit = (now or datetime.now(UTC)) + timedelta(days=WARNING_DAYS)
    found = []
    for file in (f"{name}.pem", "authority.pem"):
        # a renewed authority has several certificates, of which the newest is checked
        newest = max(x509.load_pem_x509_certificates((folder / file).read_bytes()), key=lambda c: c.not_valid_after_utc)
        if newest.not_valid_after_utc <= limit:
            found.append(ending_sentence(file, newest.not_valid_after_utc))
    return found


def write_keys(folder: Path, trains: Iterable[int], *, valid_days: int = VALID_DAYS) -> list[Path]:
    """Write keys and certificates of an authority, of ``centre`` and of each ``train-N``; return the paths.

    If the folder already has an authority, only missing files are written, so that trains can be added.
    ``authority.key`` must stay in this folder; it is never given to a train or a centre. Key files can be read only by
    their owner. Raise OutputError if there is nothing to write, or a file cannot be written. Raise InputFileError if a
    file of the authority cannot be read.
    """
    names = ["centre", *(f"train-{number}" for number in trains)]
    if (folder / "authority.key").exists():
        signing, issuer = _read_authority(folder)
        names = [name for name in names if not (folder / f"{name}.pem").exists()]
        if not names:
            raise OutputError(f"{folder}: all certificates already exist; --renew makes new certificates")
        parts: dict[str, bytes] = {}
    else:
        signing = ec.generate_private_key(ec.SECP256R1())
        issuer = _signed(_ISSUER, signing.public_key(), signing, days=max(AUTHORITY_DAYS, valid_days))
        parts = {"authority.pem": issuer.public_bytes(_PEM), "authority.key": _private(signing)}
    days = _within(issuer, valid_days)
    for name in names:
        parts |= _pair(name, signing, days=days)
    return _write(folder, parts, replace=False)


def renew_keys(folder: Path, trains: Iterable[int], *, valid_days: int = VALID_DAYS) -> list[Path]:
    """Replace the keys and certificates of the centre and of trains; return the new files.

    The previous certificates stay valid until they expire, so that each end can change to the new files when it next
    starts or connects. The authority is renewed as well if its certificate would expire before the new certificates. In
    this case, ``authority.pem`` contains the old and the new certificate, and must be given to every end before the new
    files. Raise InputFileError or OutputError as `write_keys` does.
    """
    signing, issuer = _read_authority(folder)
    parts: dict[str, bytes] = {}
    if _within(issuer, valid_days) < valid_days:
        old = (folder / "authority.pem").read_bytes()
        signing = ec.generate_private_key(ec.SECP256R1())
        issuer = _signed(_ISSUER, signing.public_key(), signing, days=max(AUTHORITY_DAYS, valid_days))
        parts = {"authority.pem": issuer.public_bytes(_PEM) + old, "authority.key": _private(signing)}
    for name in ("centre", *(f"train-{number}" for number in trains)):
        parts |= _pair(name, signing, days=valid_days)
    return _write(folder, parts, replace=True)


def _read_authority(folder: Path) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
    """Return the key and the newest certificate of the authority."""
    path = folder / "authority.key"
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), password=None)
        certificates = x509.load_pem_x509_certificates((folder / "authority.pem").read_bytes())
    except (OSError, ValueError, TypeError) as error:
        raise InputFileError(
            path, f"and authority.pem cannot be read ({error}); a folder written by railfix ground keys was expected"
        ) from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificates[0].public_key():
        raise InputFileError(path, "is not the key of authority.pem")
    return key, certificates[0]


def _within(issuer: x509.Certificate, days: int) -> int:
    """Return `days`, or the remaining validity of the authority's certificate if that is shorter [days]."""
    return min(days, (issuer.not_valid_after_utc - datetime.now(UTC)).days)


def _private(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(_PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())


def _pair(name: str, signing: ec.EllipticCurvePrivateKey, *, days: int) -> dict[str, bytes]:
    """Return the contents of a new certificate file and of its key file, by file name."""
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = _signed(name, key.public_key(), signing, days=days)
    return {f"{name}.pem": certificate.public_bytes(_PEM), f"{name}.key": _private(key)}


def _signed(
    name: str, public: ec.EllipticCurvePublicKey, signing: ec.EllipticCurvePrivateKey, *, days: int
) -> x509.Certificate:
    """Return a certificate for a name, signed by the authority."""
    now = datetime.now(UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)]))
        .issuer_name(x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, _ISSUER)]))
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=name == _ISSUER, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signing.public_key()), critical=False
        )
    )  # fmt: skip
    return builder.sign(signing, hashes.SHA256())


def _write(folder: Path, parts: dict[str, bytes], *, replace: bool) -> list[Path]:
    """Write each file and return the paths; key files can be read only by their owner.

    With `replace`, existing files are replaced once all new files are complete. Raise OutputError if a file cannot be
    written or, without `replace`, exists already.
    """
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in parts.items():
            mode = 0o600 if name.endswith(".key") else 0o644
            path = folder / (f"{name}.new" if replace else name)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
                file.write(data)
            written.append(folder / name)
        for name in parts if replace else ():
            (folder / f"{name}.new").replace(folder / name)
    except FileExistsError as error:
        raise OutputError(f"{error.filename}: exists already; remove it, or give another folder") from None
    except OSError as error:
        raise OutputError(f"{folder}: keys cannot be written ({error.strerror})") from None
    return written
