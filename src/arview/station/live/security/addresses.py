"""Network addresses of this machine at which phones can reach it."""

from __future__ import annotations

import ipaddress
import socket
from dataclasses import dataclass

from arview.errors import InputError

LOOPBACK = "127.0.0.1"
_VIRTUAL = ("docker", "br-", "veth", "virbr", "vmnet", "vboxnet", "tun", "tap", "zt", "tailscale", "wg")
"""Prefixes of the interfaces of containers, virtual machines and tunnels, which phones cannot reach."""


@dataclass(frozen=True)
class Interface:
    """A network interface of this machine and its IPv4 address."""

    name: str
    address: str


def lan_interfaces() -> list[Interface]:
    """Interfaces of this machine on networks that a phone can be in, private addresses first."""
    import ifaddr

    found: list[Interface] = []
    for adapter in ifaddr.get_adapters():
        if adapter.nice_name.lower().startswith(_VIRTUAL):
            continue
        for entry in adapter.ips:
            if isinstance(entry.ip, str) and not _is_unreachable(entry.ip):
                found.append(Interface(adapter.nice_name, entry.ip))
    return sorted(found, key=lambda one: not ipaddress.ip_address(one.address).is_private)


def choose_host(host: str | None) -> tuple[str, list[str]]:
    """The address to bind to, and the addresses at which the server is then reached.

    Args:
        host: an address or name of this machine, ``0.0.0.0`` for all addresses, or None for the first one of the local
            network.

    Raises:
        InputError: the address does not exist, or this machine is not connected to a network.
    """
    interfaces = lan_interfaces()
    if host is None:
        if not interfaces:
            raise InputError(
                "this machine is not connected to a network; connect it, or use --http for a browser on this machine"
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
    """A listening TCP socket; port 0 stands for any free port.

    Raises:
        InputError: the port is in use or forbidden, or the address is not one of this machine.
    """
    # The protocol is given because asyncio disables Nagle's algorithm, which delays by 40 ms, only for TCP sockets.
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


def _is_unreachable(address: str) -> bool:
    parsed = ipaddress.ip_address(address)
    return parsed.is_loopback or parsed.is_link_local or parsed.is_multicast or parsed.is_unspecified
