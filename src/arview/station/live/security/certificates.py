"""HTTPS on a local network: a certificate authority of this user, and the server certificate that it signs.

Browsers allow the camera on HTTPS pages only, and public authorities do not sign certificates for addresses of a local
network. The authority is created in the first run, and each phone has to trust it once. It can only sign for private
addresses and local names (name constraints, RFC 5280 4.2.1.10), so that a stolen key cannot be used on the internet.
"""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from arview.errors import InputError, OutputError

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

PRIVATE_NETWORKS = ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "169.254.0.0/16", "127.0.0.0/8", "100.64.0.0/10")
LOCAL_NAMES = ("local", "lan", "localhost", "internal", "home.arpa")
_AUTHORITY, _AUTHORITY_KEY = "authority.pem", "authority.key"
_LEAF, _LEAF_KEY = "server.pem", "server.key"


AUTHORITY_DAYS = 3650
"""Days for which the authority is valid."""
AUTHORITY_RENEWAL_DAYS = 120
"""The authority is replaced when fewer days are left."""
SERVER_DAYS = 90
"""Days for which the server certificate is valid; Apple refuses more than 825."""
SERVER_RENEWAL_DAYS = 30
"""The server certificate is renewed when fewer days are left."""


@dataclass(frozen=True)
class Certificates:
    """The files that HTTPS needs.

    Attributes:
        chain, key: files of the server certificate with its chain, and of its private key.
        authority_der: certificate of the authority, DER, for phones to trust; None when the user gave a certificate.
        authority_name: name of the authority as phones show it.
        is_authority_new: whether the authority was created in this run, so that phones have to trust it.
    """

    chain: Path
    key: Path
    authority_der: bytes | None = None
    authority_name: str = ""
    is_authority_new: bool = False


def data_folder() -> Path:
    """The folder ``$ARVIEW_DATA``, else ``arview`` in ``$XDG_DATA_HOME`` or ``~/.local/share``."""
    own = os.environ.get("ARVIEW_DATA")
    if own:
        return Path(own)
    shared = os.environ.get("XDG_DATA_HOME")
    return (Path(shared) if shared else Path.home() / ".local" / "share") / "arview"


def own_certificates(chain: Path, key: Path) -> Certificates:
    """A certificate that the user provides.

    Raises:
        InputError: the files cannot be read or do not belong together.
    """
    import ssl

    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(chain, key, password=_no_password)
    except (OSError, ValueError) as error:
        raise InputError(f"--cert {chain} --key {key}: these files cannot be used ({error})") from error
    return Certificates(chain, key)


def local_certificates(
    addresses: Collection[str],
    folder: Path | None = None,
    now: datetime | None = None,
) -> Certificates:
    """Certificates for a server at these addresses, created or renewed where needed.

    Args:
        addresses: IP addresses and names at which the server is reached.
        folder: where they are stored, readable by this user only; default `data_folder` / ``tls``.
        now: time at which their age is computed; default: the present.

    Raises:
        OutputError: the folder is not writable.
        InputError: an address does not belong to a private network.
    """
    folder = folder or data_folder() / "tls"
    now = now or datetime.now(UTC)
    public = sorted(address for address in addresses if not _is_permitted(address))
    if public:
        raise InputError(
            f"{', '.join(public)}: arview's own authority can only sign for private networks; "
            "give a certificate with --cert and --key"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.chmod(0o700)
        authority = _load(folder / _AUTHORITY, folder / _AUTHORITY_KEY)
        is_new = authority is None or not _is_valid(authority[0], now, AUTHORITY_RENEWAL_DAYS)
        if authority is None or is_new:
            authority = _make_authority(now, AUTHORITY_DAYS)
            _save(folder / _AUTHORITY, folder / _AUTHORITY_KEY, [authority[0]], authority[1])
        leaf = _load(folder / _LEAF, folder / _LEAF_KEY)
        is_good = leaf is not None and _is_good(leaf[0], authority[0], addresses, now, SERVER_RENEWAL_DAYS)
        if leaf is None or not is_good:
            leaf = _make_leaf(authority, addresses, now, SERVER_DAYS)
            _save(folder / _LEAF, folder / _LEAF_KEY, [leaf[0], authority[0]], leaf[1])
    except OSError as error:
        raise OutputError(f"{folder}: cannot store the certificates there ({error.strerror or error})") from error
    from cryptography.hazmat.primitives.serialization import Encoding

    return Certificates(
        folder / _LEAF, folder / _LEAF_KEY, authority[0].public_bytes(Encoding.DER), _common_name(authority[0]), is_new
    )


_Pair = tuple["x509.Certificate", "EllipticCurvePrivateKey"]


def _is_permitted(address: str) -> bool:
    """Whether the authority can sign for an address or name."""
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address.lower().rsplit(".", 1)[-1] in LOCAL_NAMES or address.lower().endswith(".home.arpa")
    return any(parsed in ipaddress.ip_network(network) for network in PRIVATE_NETWORKS)


def _is_valid(certificate: x509.Certificate, now: datetime, days: float) -> bool:
    """Whether a certificate is valid now, also where the clock was put back, and for some days to come."""
    return certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc - timedelta(days=days)


def _common_name(certificate: x509.Certificate) -> str:
    from cryptography.x509.oid import NameOID

    return str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)


def _make_authority(now: datetime, days: int) -> _Pair:
    """A new authority: its self-signed certificate and its key."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, "arview"),
            x509.NameAttribute(NameOID.COMMON_NAME, f"arview on {socket.gethostname()[:40]} {now:%Y-%m-%d}"),
        ]
    )
    permitted: list[x509.GeneralName] = [x509.IPAddress(ipaddress.ip_network(network)) for network in PRIVATE_NETWORKS]
    permitted += [x509.DNSName(local) for local in LOCAL_NAMES]
    usage = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.NameConstraints(permitted, None), critical=True)
        .sign(key, hashes.SHA256())
    )
    return certificate, key


def _make_leaf(authority: _Pair, addresses: Collection[str], now: datetime, days: int) -> _Pair:
    """A new server certificate, signed by the authority, and its key."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    issuer, issuer_key = authority
    key = ec.generate_private_key(ec.SECP256R1())
    usage = x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=False,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )
    certificate = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "arview live")]))
        .issuer_name(issuer.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(min(now + timedelta(days=days), issuer.not_valid_after_utc))
        .add_extension(x509.SubjectAlternativeName([_general_name(a) for a in sorted(addresses)]), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key()), critical=False)
        .sign(issuer_key, hashes.SHA256())
    )
    return certificate, key


def _general_name(address: str) -> x509.GeneralName:
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        return x509.DNSName(address)


def _is_good(
    leaf: x509.Certificate, authority: x509.Certificate, addresses: Collection[str], now: datetime, min_days: int
) -> bool:
    """Whether a server certificate is signed by this authority, covers the addresses, and is valid for long enough."""
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature

    try:
        leaf.verify_directly_issued_by(authority)
        names = leaf.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (InvalidSignature, ValueError, TypeError, x509.ExtensionNotFound):
        return False
    covered = all(_general_name(address) in list(names) for address in addresses)
    return covered and _is_valid(leaf, now, min_days)


def _load(certificate_path: Path, key_path: Path) -> _Pair | None:
    """A certificate and its key; None when they are missing, damaged or do not belong together."""
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    try:
        certificate = x509.load_pem_x509_certificates(certificate_path.read_bytes())[0]
        key_path.chmod(0o600)
        key = serialization.load_pem_private_key(key_path.read_bytes(), None)
    except (FileNotFoundError, ValueError, TypeError, IndexError):
        return None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        return None
    return certificate, key


def _save(certificate_path: Path, key_path: Path, chain: list[x509.Certificate], key: EllipticCurvePrivateKey) -> None:
    """Write both files, readable by this user only, each of them atomically."""
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    write_private(key_path, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    write_private(certificate_path, b"".join(one.public_bytes(Encoding.PEM) for one in chain))


def write_private(path: Path, content: bytes) -> None:
    """Write a file atomically that only this user can read."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    with suppress(FileNotFoundError):
        part.unlink()
    try:
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _no_password() -> str:
    raise InputError("the key is protected by a password; give a key without one")
