"""`ground_station.doctor`: what nft, iptables and the kernel print of this machine."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable

from pieces import Picker, as_json, odd, scratch, stretch

from ground_station.doctor import network, sockets
from ground_station.doctor.findings import Check, Finding, _guarded
from ground_station.service.settings import StationSettings

_PROC = scratch("firewall")
(_PROC / "net").mkdir()
_PORTS = network.ports_of(StationSettings())
_CHAIN = {"family": "inet", "table": "t", "name": "input", "hook": "input", "policy": "drop"}
_MATCH = {
    "match": {"op": "==", "left": {"payload": {"protocol": "udp", "field": "dport"}}, "right": 5600}
}
_SAVED = (
    b"*filter\n:INPUT DROP [0:0]\n-A INPUT -i lo -j ACCEPT\n"
    b"-A INPUT -p udp --dport 5600 -j ACCEPT\n"
)
_TABLE = (
    b"  sl  local_address rem_address   st\n   0: 0100007F:1F90 00000000:0000 0A 0:0 0:0 0 "
    b"1000 0 4242 1\n"
)


def fuzz(data: bytes) -> None:
    """Output that cannot be read is said to be so; it never ends the doctor's round."""
    picker = Picker(data)
    how = picker.number(1) % 4
    if how == 0:
        text = picker.rest().decode(errors="replace")
        _check(lambda: network.judged(_PORTS, {"nft": text}))
    elif how == 1:
        kinds = ("accept", "drop", "jump", "goto", "return", "vmap", "match", "xt", "limit")
        rules = []
        for _ in range(picker.number(1) % 8):
            said = [_MATCH] if picker.number(1) % 2 else []
            said.append({picker.of(kinds): odd(picker)})
            rules.append({"rule": {"family": "inet", "table": "t", "chain": "input", "expr": said}})
        entries = [{"chain": {**_CHAIN, "policy": odd(picker)}}, *rules]
        text = as_json({"nftables": entries}).decode()
        _check(lambda: network.judged(_PORTS, {"nft": text}))
    elif how == 2:
        text = picker.rest().decode(errors="replace")
        _check(lambda: network.judged(_PORTS, {"iptables-save": text}))
    else:
        (_PROC / "net/udp").write_bytes(picker.rest())
        with contextlib.suppress(ValueError):  # the kernel's own table: a check that breaks
            sockets.holders(socket.SOCK_DGRAM, 8080, _PROC)


def _check(do: Callable[[], Finding]) -> None:
    """As the doctor asks: a check that breaks is a finding of its own."""
    for finding in _guarded(Check("firewall", do)):
        assert len(finding.found.splitlines()) == 1


def seeds() -> list[bytes]:
    """A ruleset of each kind, and chains that jump in circles."""
    rules = [{"chain": _CHAIN}]
    rules.append({"rule": {**_CHAIN, "chain": "input", "expr": [_MATCH, {"accept": None}]}})
    circle = b"".join(b"-A c%d -j c%d\n" % (n, (n + k) % 9) for n in range(9) for k in (1, 2, 3))
    return [
        b"\0" + as_json({"nftables": rules}),
        b"\0{}",
        b"\1\3\1\0\7\1\5",
        b"\2" + _SAVED,
        b"\2" + _SAVED + b"-A INPUT -j c0\n" + circle,
        b"\2*filter\n:INPUT\n",
        b"\2*filter\n-A INPUT -p ! -j 'a\n",
        b"\2*filter\n-A\n",
        b"\2*filter\n-A INPUT !\n",
        b"\2*filter\n-A INPUT --dport a:b\n",
        b"\3" + _TABLE,
        b"\3\n1 2 3 4 5 6 7 8 9 10 11\n",
        stretch((1, b"\0"), (5000, b"[")),
    ]
