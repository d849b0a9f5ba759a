"""Keys and certificates of a centre and its trains, signed by an authority of their own."""

from __future__ import annotations

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from railfix.core.errors import InputFileError, OutputError

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
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

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
