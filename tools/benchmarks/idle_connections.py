"""Time of requests to `arview live` while one address holds idle TLS connections.

For each address from which requests come (that of the idle connections, and another one of the loopback network), it
measures requests on new connections, with their TLS handshake, and on one that is kept open.
"""

from __future__ import annotations

import argparse
import http.client
import os
import re
import socket
import ssl
import statistics
import tempfile
import time
from pathlib import Path

from live_server import live_server

ROOT = Path(__file__).resolve().parents[2]
ADDRESS, OTHER_ADDRESS = "127.0.0.1", "127.0.0.2"


def request(line: http.client.HTTPSConnection, cookie: str) -> float:
    """Milliseconds of a request; it must be answered."""
    began_s = time.perf_counter()
    line.request("GET", "/api/status", headers={"Cookie": cookie})
    answer = line.getresponse()
    answer.read()
    if answer.status != 200:
        raise SystemExit(f"refused: HTTP {answer.status}")
    return 1e3 * (time.perf_counter() - began_s)


def connection(port: int, source: str, trusting: ssl.SSLContext) -> http.client.HTTPSConnection:
    return http.client.HTTPSConnection(ADDRESS, port, timeout=20, context=trusting, source_address=(source, 0))


def paired(port: int, token: str, trusting: ssl.SSLContext) -> str:
    """The cookie that a browser gets for the link."""
    line = connection(port, ADDRESS, trusting)
    line.request("GET", f"/?token={token}")
    answer = line.getresponse()
    answer.read()
    line.close()
    return str(answer.headers["Set-Cookie"]).split(";")[0]


def measure(port: int, cookie: str, trusting: ssl.SSLContext, count: int) -> dict[str, list[float]]:
    """Times in ms by kind of request."""
    times_ms: dict[str, list[float]] = {}
    for source, name in ((ADDRESS, "same address"), (OTHER_ADDRESS, "other address")):
        kept = connection(port, source, trusting)
        request(kept, cookie)
        for _ in range(count):
            began_s = time.perf_counter()
            new = connection(port, source, trusting)
            request(new, cookie)
            new_ms = 1e3 * (time.perf_counter() - began_s)
            new.close()
            times_ms.setdefault(f"{name}, new connection", []).append(new_ms)
            times_ms.setdefault(f"{name}, kept connection", []).append(request(kept, cookie))
            time.sleep(0.05)
        kept.close()
    return times_ms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--idle", type=int, default=205, help="idle TLS connections")
    parser.add_argument("--count", type=int, default=40, help="requests of each kind")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ARVIEW_DATA"] = folder
        probe = socket.create_server((ADDRESS, 0))
        port = probe.getsockname()[1]
        probe.close()
        part = ROOT / "samples/bracket_plate/part.toml"
        with live_server(["--part", part, "--host", ADDRESS, "--port", port]) as (_, link):
            token = re.split("token=", link)[1]
            trusting = ssl.create_default_context()
            trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE
            cookie = paired(port, token, trusting)
            time.sleep(15)  # the first run of the tracker
            for idle in (0, options.idle):
                lines = []
                for _ in range(idle):
                    line = socket.create_connection((ADDRESS, port), timeout=20)
                    lines.append(trusting.wrap_socket(line))
                print(f"{idle} idle TLS connections from {ADDRESS}")
                try:
                    for kind, times in measure(port, cookie, trusting, options.count).items():
                        print(f"  {kind}: median {statistics.median(times):.1f} ms, largest {max(times):.1f} ms")
                except (SystemExit, OSError) as error:
                    print(f"  {error}")
                for line in lines:
                    line.close()


if __name__ == "__main__":
    main()
