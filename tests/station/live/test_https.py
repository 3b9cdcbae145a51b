"""HTTPS with a local authority: name constraints, permissions of keys, renewal, trust page."""

from __future__ import annotations

import asyncio
import http.client
import ipaddress
import plistlib
import ssl
import stat
import threading
import urllib.error
import urllib.request
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.x509.oid import ExtendedKeyUsageOID
from cryptography.x509.verification import PolicyBuilder, Store, VerificationError

from arview.errors import InputError, OutputError
from arview.station.live.security import addresses
from arview.station.live.security.addresses import LOOPBACK, Interface, bind, choose_host
from arview.station.live.security.certificates import AUTHORITY_DAYS, SERVER_DAYS, local_certificates, own_certificates
from arview.station.live.security.trust_page import apple_profile, fingerprint
from arview.station.live.server.live_server import LiveServer, open_endpoint
from helpers.live_sample import loader, options

NOW = datetime(2026, 11, 22, 12, 0, tzinfo=UTC)
HERE = ["192.168.7.20", LOOPBACK, "localhost"]


def leaf(folder: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificates((folder / "server.pem").read_bytes())[0]


def test_certificates_are_what_browsers_ask_for(tmp_path: Path) -> None:
    folder = tmp_path / "tls"
    made = local_certificates(HERE, folder, NOW)
    assert made.is_authority_new and made.authority_der is not None
    authority = x509.load_der_x509_certificate(made.authority_der)
    server = leaf(folder)
    store = Store([authority])
    for name in (x509.IPAddress(ipaddress.ip_address("192.168.7.20")), x509.DNSName("localhost")):
        verifier = PolicyBuilder().store(store).time(NOW).build_server_verifier(name)
        assert verifier.verify(server, []) == [server, authority]
    with pytest.raises(VerificationError):
        PolicyBuilder().store(store).time(NOW).build_server_verifier(x509.DNSName("other.local")).verify(server, [])
    usage = server.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(usage) == [ExtendedKeyUsageOID.SERVER_AUTH]
    days = (server.not_valid_after_utc - NOW) / timedelta(days=1)
    assert days == SERVER_DAYS
    assert (authority.not_valid_after_utc - NOW) / timedelta(days=1) == AUTHORITY_DAYS


def test_keys_are_for_this_user_only(tmp_path: Path) -> None:
    folder = tmp_path / "data" / "tls"
    local_certificates(HERE, folder, NOW)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert sorted(path.name for path in folder.iterdir()) == [
        "authority.key",
        "authority.pem",
        "server.key",
        "server.pem",
    ]
    for path in folder.iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    # Permissions that were relaxed are restricted again.
    (folder / "authority.key").chmod(0o644)
    folder.chmod(0o755)
    local_certificates(HERE, folder, NOW)
    assert stat.S_IMODE((folder / "authority.key").stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_the_authority_may_sign_for_local_networks_only(tmp_path: Path) -> None:
    made = local_certificates(HERE, tmp_path, NOW)
    assert made.authority_der is not None
    constraints = x509.load_der_x509_certificate(made.authority_der).extensions.get_extension_for_class(
        x509.NameConstraints
    )
    assert constraints.critical and constraints.value.excluded_subtrees is None
    permitted = {str(one.value) for one in constraints.value.permitted_subtrees or []}
    assert "192.168.0.0/16" in permitted and "local" in permitted and "com" not in permitted
    for public in ("8.8.8.8", "example.com", "172.32.0.1"):
        with pytest.raises(InputError, match="--cert"):
            local_certificates([public], tmp_path, NOW)


def test_leaf_is_renewed_when_it_ends_soon_or_the_address_changes_and_the_authority_stays(tmp_path: Path) -> None:
    first = local_certificates(HERE, tmp_path, NOW)
    serial = leaf(tmp_path).serial_number
    assert local_certificates(HERE[:1], tmp_path, NOW + timedelta(days=50)).is_authority_new is False
    assert leaf(tmp_path).serial_number == serial
    local_certificates(HERE, tmp_path, NOW + timedelta(days=70))
    renewed = leaf(tmp_path)
    assert renewed.serial_number != serial
    assert renewed.not_valid_after_utc == NOW + timedelta(days=70 + SERVER_DAYS)
    moved = local_certificates(["10.0.0.5"], tmp_path, NOW + timedelta(days=71))
    assert leaf(tmp_path).serial_number != renewed.serial_number
    assert moved.authority_der == first.authority_der
    # Years later the authority itself is replaced in time.
    later = local_certificates(["10.0.0.5"], tmp_path, NOW + timedelta(days=AUTHORITY_DAYS - 60))
    assert later.is_authority_new and later.authority_der != first.authority_der


@pytest.mark.parametrize("years", [-10, 10])
def test_what_was_made_by_a_wrong_clock_is_replaced(tmp_path: Path, years: int) -> None:
    wrong = local_certificates(HERE, tmp_path, NOW + timedelta(days=365 * years))
    right = local_certificates(HERE, tmp_path, NOW)
    assert right.is_authority_new and right.authority_der != wrong.authority_der
    assert leaf(tmp_path).not_valid_before_utc <= NOW <= leaf(tmp_path).not_valid_after_utc
    assert not local_certificates(HERE, tmp_path, NOW).is_authority_new


@pytest.mark.parametrize("name", ["authority.pem", "authority.key", "server.pem", "server.key"])
@pytest.mark.parametrize("damage", ["gone", "garbage", "empty"])
def test_damaged_files_are_made_anew(tmp_path: Path, name: str, damage: str) -> None:
    local_certificates(HERE, tmp_path, NOW)
    if damage == "gone":
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_bytes(b"garbage" if damage == "garbage" else b"")
    made = local_certificates(HERE, tmp_path, NOW)
    ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(made.chain, made.key)
    assert made.is_authority_new == name.startswith("authority")


def test_folder_that_cannot_be_written_to(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="certificates"):
        local_certificates(HERE, tmp_path / "file" / "tls", NOW)


def test_a_certificate_of_ones_own(tmp_path: Path) -> None:
    made = local_certificates(HERE, tmp_path, NOW)
    own = own_certificates(made.chain, made.key)
    assert own.authority_der is None
    for wrong in ((tmp_path / "no.pem", made.key), (made.chain, tmp_path / "authority.key"), (made.key, made.key)):
        with pytest.raises(InputError, match="--cert"):
            own_certificates(*wrong)


def test_apple_profile_holds_the_certificate(tmp_path: Path) -> None:
    made = local_certificates(HERE, tmp_path, NOW)
    assert made.authority_der is not None
    profile = plistlib.loads(apple_profile(made.authority_der, made.authority_name))
    (root,) = profile["PayloadContent"]
    assert root["PayloadType"] == "com.apple.security.root" and root["PayloadContent"] == made.authority_der
    assert profile["PayloadUUID"] != root["PayloadUUID"]
    digest = x509.load_der_x509_certificate(made.authority_der).fingerprint(hashes.SHA256())
    assert bytes.fromhex(fingerprint(made.authority_der)) == digest


@pytest.mark.slow
def test_pages_come_by_https_and_the_way_to_trust_them_by_http(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ARVIEW_DATA", str(tmp_path))
    place = open_endpoint(LOOPBACK, 0)
    assert place.certificates is not None and place.certificates.authority_der is not None
    chosen = options(max_age_s=None)
    server = LiveServer(chosen, place)
    ready = threading.Event()
    thread = threading.Thread(
        target=lambda: asyncio.run(server.serve(loader(chosen), lambda hub: ready.set())), daemon=True
    )
    thread.start()
    assert ready.wait(60) and server.link.startswith("https://127.0.0.1:")
    try:
        trusting = ssl.create_default_context(cadata=place.certificates.authority_der)
        line = http.client.HTTPSConnection(LOOPBACK, place.port, timeout=10, context=trusting)
        line.request("GET", f"/watch?token={server.access.token}")
        answer = line.getresponse()
        answer.read()
        cookie = answer.headers["set-cookie"]
        assert "Secure" in cookie
        line.request("GET", "/api/part", headers={"Cookie": cookie.split(";")[0]})
        assert line.getresponse().status == 200
        line.close()
        with pytest.raises(ssl.SSLCertVerificationError):
            http.client.HTTPSConnection(LOOPBACK, place.port, context=ssl.create_default_context()).request("GET", "/")
        assert place.trust_link is not None
        with urllib.request.urlopen(place.trust_link) as page:
            text = page.read().decode()
            assert fingerprint(place.certificates.authority_der) in text and server.access.token not in text
            assert "unsafe" not in page.headers["content-security-policy"]
        with urllib.request.urlopen(f"{place.trust_link}arview.crt") as file:
            assert file.headers["content-type"] == "application/x-x509-ca-cert"
            assert file.read() == place.certificates.authority_der
        with urllib.request.urlopen(f"{place.trust_link}arview.mobileconfig") as file:
            assert file.headers["content-type"] == "application/x-apple-aspen-config"
        for path in ("authority.key", "../authority.key", "api/part", "?x=1/../authority.key"):
            try:
                with urllib.request.urlopen(f"{place.trust_link}{path}") as file:
                    assert b"PRIVATE" not in file.read()
            except urllib.error.HTTPError as error:
                assert error.code == 404
    finally:
        server.stop()
        thread.join(20)
    assert not thread.is_alive()


def test_ports_and_addresses_that_cannot_be_had() -> None:
    taken = bind(LOOPBACK, 0)
    with pytest.raises(InputError, match="--port"):
        bind(LOOPBACK, taken.getsockname()[1])
    taken.close()
    with pytest.raises(InputError, match="192"):
        bind("192.0.2.1", 0)
    with pytest.raises(InputError, match="--host"):
        choose_host("no.such.host.invalid")
    with pytest.raises(InputError, match="--http"):
        open_endpoint("192.0.2.1", 0, is_plain=True)


def test_host_is_chosen_among_the_networks_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(addresses, "lan_interfaces", list)
    with pytest.raises(InputError, match="--http"):
        choose_host(None)
    both = [Interface("wlan0", "192.168.1.9"), Interface("eth0", "10.1.1.1")]
    monkeypatch.setattr(addresses, "lan_interfaces", lambda: both)
    assert choose_host(None) == ("192.168.1.9", ["192.168.1.9"])
    assert choose_host("0.0.0.0") == ("0.0.0.0", ["192.168.1.9", "10.1.1.1", LOOPBACK])
    assert choose_host(LOOPBACK) == (LOOPBACK, [LOOPBACK])
