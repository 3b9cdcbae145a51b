"""The plain-HTTP page from which phones load the certificate of the local authority, with instructions to trust it."""

from __future__ import annotations

import html
import plistlib
import uuid

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from arview.station.live.security.certificates import Certificates

CERTIFICATE_PATH, PROFILE_PATH = "/arview.crt", "/arview.mobileconfig"
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'sha256-{style}'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_STYLE = """
body{font:18px/1.5 system-ui,sans-serif;max-width:38em;margin:0 auto;padding:1em;background:#10141b;color:#f0f4f8}
h1{font-size:1.4em}h2{font-size:1.15em;margin-top:1.6em}li{margin:.4em 0}
a.button{display:inline-block;padding:.7em 1.1em;margin:.3em 0;border-radius:.5em;background:#46c4ff;color:#10141b;
font-weight:700;text-decoration:none}code{word-break:break-all;color:#b0bac8}
"""
_PAGE = """<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>arview: trust this station</title>
<style>{style}</style></head><body>
<h1>Trust this station, once</h1>
<p>Browsers allow the camera on secure pages only. This station signs its pages with its own certificate,
<b>{name}</b>. That certificate is valid for addresses of local networks only, never for a site on the internet.</p>
<p>The phone shows the SHA-256 fingerprint in the details of the certificate. It must match the one on the station's
terminal:<br><code>{fingerprint}</code></p>
<h2>iPhone, iPad</h2>
<ol><li>In Safari: <a class="button" href="{profile}">Load the profile</a>, then <i>Allow</i>.</li>
<li><i>Settings › Profile Downloaded › Install</i> (or <i>Settings › General › VPN &amp; Device Management</i>).</li>
<li><i>Settings › General › About › Certificate Trust Settings</i>: switch on <b>{name}</b>.</li>
<li>Scan the code at the station again.</li></ol>
<h2>Android</h2>
<ol><li><a class="button" href="{certificate}">Load the certificate</a></li>
<li><i>Settings › Security &amp; privacy › More › Encryption &amp; credentials › Install a certificate ›
CA certificate › Install anyway</i>, and choose <b>arview.crt</b>. (The search in Settings finds “CA certificate”.)</li>
<li>In Chrome, scan the code at the station again.</li></ol>
<h2>Windows, macOS, Linux</h2>
<p><a class="button" href="{certificate}">Load the certificate</a> and import it as a trusted authority: Windows:
double-click, <i>Trusted Root Certification Authorities</i>; macOS: Keychain Access, <i>Always Trust</i>; Chrome on
Linux and Firefox: <i>Settings › Privacy and security › Certificates › Authorities › Import</i>.</p>
<h2>To remove it</h2>
<p>Delete the profile (iPhone), or the certificate under <i>User certificates</i> (Android).</p>
</body></html>"""


def trust_app(certificates: Certificates) -> ASGIApp:
    """The ASGI application: the page, the certificate, and the certificate as an Apple configuration profile.

    Raises:
        ValueError: the certificate is the user's own.
    """
    if certificates.authority_der is None:
        raise ValueError("trust_app: the certificate is the user's own, so there is no authority to trust")
    der, name = certificates.authority_der, certificates.authority_name
    page = _PAGE.format(
        style=_STYLE,
        name=html.escape(name),
        fingerprint=fingerprint(der),
        profile=PROFILE_PATH,
        certificate=CERTIFICATE_PATH,
    )
    headers = {key: value.replace("{style}", _style_hash()) for key, value in _HEADERS.items()}
    profile = apple_profile(der, name)

    async def index(request: Request) -> Response:
        return HTMLResponse(page, headers=headers)

    async def certificate(request: Request) -> Response:
        download = {**headers, "Content-Disposition": 'attachment; filename="arview.crt"'}
        return Response(der, media_type="application/x-x509-ca-cert", headers=download)

    async def mobileconfig(request: Request) -> Response:
        return Response(profile, media_type="application/x-apple-aspen-config", headers=headers)

    async def not_found(request: Request, error: Exception) -> Response:
        return PlainTextResponse("there is no such page; see /", 404, headers)

    routes = [Route("/", index), Route(CERTIFICATE_PATH, certificate), Route(PROFILE_PATH, mobileconfig)]
    return Starlette(routes=routes, exception_handlers={404: not_found, 405: not_found})


def fingerprint(der: bytes) -> str:
    """SHA-256 of a DER certificate in pairs of hexadecimal digits, as phones show it."""
    import hashlib

    digest = hashlib.sha256(der).hexdigest().upper()
    return " ".join(digest[place : place + 2] for place in range(0, len(digest), 2))


def apple_profile(der: bytes, name: str) -> bytes:
    """An Apple configuration profile (.mobileconfig) with one root certificate.

    Payload ``com.apple.security.root``; Apple, Device Management, "CertificateRoot".
    """
    own = uuid.uuid5(uuid.NAMESPACE_OID, fingerprint(der))
    common = {"PayloadVersion": 1, "PayloadOrganization": "arview"}
    root = {
        **common,
        "PayloadType": "com.apple.security.root",
        "PayloadIdentifier": f"arview.station.live.{own}.root",
        "PayloadUUID": str(uuid.uuid5(own, "root")).upper(),
        "PayloadDisplayName": name,
        "PayloadContent": der,
    }
    profile = {
        **common,
        "PayloadType": "Configuration",
        "PayloadIdentifier": f"arview.station.live.{own}",
        "PayloadUUID": str(own).upper(),
        "PayloadDisplayName": name,
        "PayloadDescription": "Lets this phone open the pages of an arview station on the local network.",
        "PayloadContent": [root],
    }
    return plistlib.dumps(profile)


def _style_hash() -> str:
    import base64
    import hashlib

    return base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
