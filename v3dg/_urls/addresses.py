"""Classifies network addresses. A server on the internet must not redirect to an
address of a local network."""

import ipaddress
from enum import IntEnum
from typing import TypeAlias

_Address: TypeAlias = ipaddress.IPv4Address | ipaddress.IPv6Address


class Reach(IntEnum):
    """How far the network reaches that an address belongs to. A redirect must not lead
    to an address with a smaller reach."""

    HOST = 0
    """This machine or its link, and addresses that do not belong to a single host."""
    PRIVATE = 1
    """A network that is not part of the internet."""
    PUBLIC = 2
    """The internet."""


# Networks of reach HOST: RFC 6890, RFC 1122, RFC 3927, RFC 4291, RFC 5771. Python's own
# lists are not used, because they differ between versions.
_HOST = [
    ipaddress.ip_network(text)
    for text in (
        "0.0.0.0/8",
        "127.0.0.0/8",
        "169.254.0.0/16",
        "224.0.0.0/4",
        "240.0.0.0/4",
        "::/127",
        "fe80::/10",
        "ff00::/8",
    )
]
# Networks of reach PRIVATE: RFC 1918, RFC 6598, RFC 6890, RFC 2544, RFC 5737.
_PRIVATE = [
    ipaddress.ip_network(text)
    for text in (
        "10.0.0.0/8",
        "100.64.0.0/10",
        "172.16.0.0/12",
        "192.0.0.0/24",
        "192.0.2.0/24",
        "192.168.0.0/16",
        "198.18.0.0/15",
        "198.51.100.0/24",
        "203.0.113.0/24",
    )
]
# The IPv6 addresses of the internet, except for the ranges below, which are reserved
# for documentation and protocols.
_PUBLIC_IPV6 = ipaddress.ip_network("2000::/3")
_PRIVATE_IPV6 = [ipaddress.ip_network(text) for text in ("2001::/23", "2001:db8::/32", "3fff::/20")]
# In these networks, the last 32 bits are an IPv4 address (RFC 6052 and RFC 4291).
_WITH_IPV4 = [ipaddress.ip_network(text) for text in ("64:ff9b::/96", "::/96")]


def reach_of(address: str) -> Reach:
    """Return the reach of an IP address. Raise ValueError for any other text."""
    parsed = ipaddress.ip_address(address.partition("%")[0])
    return min(map(_reach_of, _inner(parsed)))


def is_address(host: str) -> bool:
    """Return whether a host is an IP address and not a name."""
    try:
        ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return True


def _inner(address: _Address) -> list[_Address]:
    """Return the IPv4 addresses to which a gateway translates an IPv6 address. If it is
    not translated, return the address itself."""
    if isinstance(address, ipaddress.IPv4Address) or any(address in network for network in _HOST):
        return [address]
    if address.ipv4_mapped is not None:
        return [address.ipv4_mapped]
    if address.sixtofour is not None:
        return [address.sixtofour]
    if address.teredo is not None:
        return list(address.teredo)
    if any(address in network for network in _WITH_IPV4):
        return [ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)]
    return [address]


def _reach_of(address: _Address) -> Reach:
    if any(address in network for network in _HOST):
        return Reach.HOST
    is_private = any(address in network for network in (*_PRIVATE, *_PRIVATE_IPV6))
    if isinstance(address, ipaddress.IPv6Address):
        is_private |= address not in _PUBLIC_IPV6
    if is_private:
        return Reach.PRIVATE
    return Reach.PUBLIC
