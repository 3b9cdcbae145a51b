"""Addresses of this machine at which a phone can reach it."""

from __future__ import annotations

import ipaddress
import socket
from dataclasses import dataclass

from arview.errors import InputError

LOOPBACK = "127.0.0.1"
_VIRTUAL = ("docker", "br-", "veth", "virbr", "vmnet", "vboxnet", "tun", "tap", "zt", "tailscale", "wg")
"""Interfaces of containers, machines inside this one and tunnels: no phone is there."""


@dataclass(frozen=True)
class Interface:
    """One address of this machine."""

    name: str
    address: str


def lan_interfaces() -> list[Interface]:
    """IPv4 addresses of this machine on networks that a phone may be in, private ones first."""
    import ifaddr

    found = []
    for adapter in ifaddr.get_adapters():
        if adapter.nice_name.lower().startswith(_VIRTUAL):
            continue
        for entry in adapter.ips:
            if isinstance(entry.ip, str) and not _is_unfit(entry.ip):
                found.append(Interface(adapter.nice_name, entry.ip))
    return sorted(found, key=lambda one: not ipaddress.ip_address(one.address).is_private)


def choose_host(host: str | None) -> tuple[str, list[str]]:
    """Address to bind to, and the addresses under which the server is reached then.

    Args:
        host: an address of this machine, ``0.0.0.0`` for all, a name of it, or None for the first of the local network.

    Raises:
        InputError: no such address here, or this machine is in no network.
    """
    interfaces = lan_interfaces()
    if host is None:
        if not interfaces:
            raise InputError(
                "this machine is in no network that a phone could be in; connect it, or use --http for its own browser"
            )
        return interfaces[0].address, [interfaces[0].address]
    if host == "0.0.0.0":
        return host, [*(one.address for one in interfaces), LOOPBACK]
    try:
        address = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)[0][4][0]
    except OSError as error:
        raise InputError(f"--host {host}: no such address or name") from error
    return str(address), [str(address)]


def bind(address: str, port: int) -> socket.socket:
    """A listening TCP socket; port 0 takes any free one.

    Raises:
        InputError: the port is taken, forbidden, or the address is not of this machine.
    """
    # Named as TCP, because asyncio switches Nagle's 40 ms off only for sockets that are.
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((address, port))
        listener.listen(128)
    except OverflowError as error:
        listener.close()
        raise InputError(f"port {port}: expected 1 to 65535") from error
    except OSError as error:
        listener.close()
        why = error.strerror or str(error)
        raise InputError(f"port {port} at {address} cannot be used ({why}); choose another with --port") from error
    listener.setblocking(False)
    return listener


def _is_unfit(address: str) -> bool:
    parsed = ipaddress.ip_address(address)
    return parsed.is_loopback or parsed.is_link_local or parsed.is_multicast or parsed.is_unspecified
