"""Checks of the network: ports, the receive buffer, the firewall, discovery, who may look."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import shutil
import socket
import struct
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ground_station.doctor.findings import Finding, ok, problem, warning
from ground_station.service.asking import ask
from ground_station.service.settings import HttpSettings, StationSettings
from ground_station.service.web import access
from ground_station.stream.udp import BUFFER_BYTES
from pi_firmware.wire import scouting
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import check_endpoint, is_loopback

_RMEM_MAX = Path("/proc/sys/net/core/rmem_max")
_SCOUTING_GROUP, _SCOUTING_PORT = "224.0.0.224", 7446
_COMMAND_S = 3.0
_HOLDER = re.compile(r'\("([^"]*)",pid=(\d+)')
"""How `ss` names a process that has a socket open."""
_REFUSES = re.compile(r"\b(drop|reject)\b", re.IGNORECASE)
"""What a firewall that lets not everything pass says somewhere, be it nft's or iptables'."""
_SERVICE = Path("/etc/blimp")
"""The configuration of the installed service, whose user is blimp."""
TO_THE_NETWORK = "payloads on a network need blimp serve --lan"
_TOKEN = "python3 -c 'import secrets; print(secrets.token_urlsafe(32))'"


@dataclass(frozen=True)
class Port:
    """A port that the service listens on; `setting` is the key that names it."""

    setting: str
    kind: int
    host: str
    number: int

    @property
    def protocol(self) -> str:
        """`tcp` or `udp`."""
        return "tcp" if self.kind == socket.SOCK_STREAM else "udp"

    def __str__(self) -> str:
        return f"{self.protocol} {self.host}:{self.number}"


def ports_of(settings: StationSettings) -> list[Port]:
    """Every fixed port of a configuration; 0 stands for any free one and cannot be taken."""
    http, foxglove = settings.http, settings.foxglove
    found = [Port("video.port", socket.SOCK_DGRAM, settings.video.host, settings.video.port)]
    for endpoint in settings.telemetry.listen:
        certified = bool(settings.telemetry.certificates)
        host, number = check_endpoint(endpoint, certified=certified)
        found.append(Port("telemetry.listen", socket.SOCK_STREAM, host.strip("[]"), number))
    found.append(Port("http.port", socket.SOCK_STREAM, http.host, http.port))
    if foxglove.enabled:
        found.append(Port("foxglove.port", socket.SOCK_STREAM, foxglove.host, foxglove.port))
    return [port for port in found if port.number]


def reach(settings: StationSettings) -> Finding:
    """Whether payloads on other machines reach this station at all."""
    hosts = [settings.video.host] + [
        port.host for port in ports_of(settings) if port.setting == "telemetry.listen"
    ]
    if all(map(is_loopback, hosts)):
        return ok("reach", f"this computer only (loopback); {TO_THE_NETWORK}")
    if any(map(is_loopback, hosts)):
        found = "video and telemetry are not both heard beyond loopback"
        return warning(
            "reach", found, f"set video.host and telemetry.listen alike; {TO_THE_NETWORK}"
        )
    return ok("reach", f"the network: {', '.join(dict.fromkeys(hosts))}")


def ports(settings: StationSettings) -> Iterator[Finding]:
    """Each port is free, or the service's own."""
    serves = functools.cache(lambda: _serves(settings.http))  # asked once, where any is held
    for port in ports_of(settings):
        yield _port(port, serves)


def _port(port: Port, serves: Callable[[], bool]) -> Finding:
    name = f"port {port.number}/{port.protocol}"
    error = refusal(port)
    if error is None:
        return ok(name, f"free at {port.host} ({port.setting})")
    if error.errno == errno.EADDRINUSE:
        if serves():  # one that lacks a port ends, or its page says so
            return ok(name, f"held by the service itself ({port.setting})")
        held = holders(port)
        who = " and ".join(f"process {pid} ({program})" for pid, program in held.items())
        end = f"end it (kill {' '.join(held)})" if held else "look again as root, and end it"
        who = who or "a process that cannot be seen"
        return problem(name, f"held by {who}", f"{end}, or set {port.setting} to another")
    reason = error.strerror or str(error)
    addresses = "ip -brief address shows this machine's"
    fix = f"set {port.setting.partition('.')[0]}.host to an address of this machine; {addresses}"
    if isinstance(error, PermissionError):
        fix = f"ports below 1024 are root's: set {port.setting} to a higher one"
    return problem(name, f"{port.host} cannot be listened on: {reason}", fix)


def refusal(port: Port) -> OSError | None:
    """Why the port cannot be bound now; None when it can. It is given back at once."""
    try:
        family, *_, address = socket.getaddrinfo(port.host, port.number, type=port.kind)[0]
        with socket.socket(family, port.kind) as probe:
            if port.kind == socket.SOCK_STREAM:  # connections that have just ended do not count
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            if port.kind == socket.SOCK_STREAM:
                probe.listen(1)
    except OSError as error:
        return error
    return None


def _serves(http: HttpSettings) -> bool:
    """Whether a station answers at the page's port."""
    with contextlib.suppress(OSError, ValueError):
        return bool(ask(http, "/healthz") == {"status": "ok"})
    return False


def holders(port: Port) -> dict[str, str]:
    """The programs that listen on a port, by process id, as far as this user may see."""
    words = ["ss", "--listening", "--processes", f"--{port.protocol}", f"sport = :{port.number}"]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        return {pid: program for program, pid in _HOLDER.findall(_output(words))}
    return {}


def receive_buffer(limit: Path = _RMEM_MAX) -> Finding:
    """A burst of video fits the socket while the receiver is not scheduled."""
    allowed = int(limit.read_text())
    found = f"net.core.rmem_max is {allowed / 2**20:.1f} MiB, {BUFFER_BYTES >> 20} are asked for"
    if allowed >= BUFFER_BYTES:
        return ok("receive buffer", found)
    line = f"net.core.rmem_max={BUFFER_BYTES}"
    fix = f"echo {line} | sudo tee /etc/sysctl.d/60-blimp.conf && sudo sysctl -w {line}"
    return warning("receive buffer", f"{found}: bursts are lost when the machine is busy", fix)


def firewall_rules(settings: StationSettings) -> Finding:
    """Whether a firewall may drop what comes from outside."""
    outside = [port for port in ports_of(settings) if not is_loopback(port.host)]
    interface = settings.telemetry.discoverable
    if interface and interface != scouting.LOOPBACK_INTERFACE:
        group = Port("discoverable", socket.SOCK_DGRAM, _SCOUTING_GROUP, _SCOUTING_PORT)
        outside.append(group)
    if not outside:
        return ok("firewall", "all ports are on loopback, which none needs to pass")
    readers = {"nft": ["nft", "-j", "list", "ruleset"], "iptables": ["iptables-save"]}
    there = {name: command for name, command in readers.items() if shutil.which(command[0])}
    if not there:
        return ok("firewall", "neither nft nor iptables is installed")
    if os.geteuid() != 0:
        tools = " and ".join(there)
        return warning(
            "firewall",
            f"its rules ({tools}) cannot be seen without root",
            "sudo blimp doctor, with the same --config",
        )
    return judged(outside, {name: _output(command) for name, command in there.items()})


def judged(outside: list[Port], rules: dict[str, str]) -> Finding:
    """Whether the rules, by the tool that printed them, drop anything at all.

    What they do with a packet depends on who sends it and where it comes in: a payload's own tell.
    """
    tools = [tool for tool, said in rules.items() if _REFUSES.search(said)]
    if not tools:
        return ok("firewall", "its rules drop nothing")
    names = ", ".join(map(str, outside))
    found = f"there is one ({' and '.join(tools)}), which must let {names} pass"
    return warning("firewall", found, f"if nothing comes: {_opening(outside)}")


def _opening(ports: list[Port]) -> str:
    pairs = [(port.number, port.protocol) for port in ports]
    if shutil.which("ufw"):
        return " && ".join(f"sudo ufw allow {number}/{protocol}" for number, protocol in pairs)
    if shutil.which("firewall-cmd"):
        added = " ".join(f"--add-port={number}/{protocol}" for number, protocol in pairs)
        return f"sudo firewall-cmd {added}, and again with --permanent"
    if shutil.which("iptables"):
        rule = "sudo iptables -I INPUT -p {1} --dport {0} -j ACCEPT"
        return " && ".join(rule.format(*pair) for pair in pairs)
    rules = ", ".join(f"{protocol} dport {number} accept" for number, protocol in pairs)
    return f"add to the input chain of /etc/nftables.conf: {rules}"


def discovery(settings: StationSettings) -> Finding:
    """The interface on which payloads find this station is there and takes part in multicast."""
    telemetry = settings.telemetry
    interface = telemetry.discoverable
    if not interface:
        return ok("discovery", "off: payloads are told this station's address")
    known = ", ".join(name for _, name in socket.if_nameindex())
    choose = f"set telemetry.discoverable to one of: {known}"
    try:
        certified = bool(telemetry.certificates)
        scouting.check("", interface, telemetry.listen, certified=certified)
    except TelemetryError as error:
        return problem("discovery", str(error), "blimp keys ground, then telemetry.certificates")
    if interface not in known.split(", "):
        return problem("discovery", f"there is no interface '{interface}'", choose)
    address = scouting.interface_address(interface)
    if address is None:
        fix = f"sudo ip link set {interface} up, and give it one (nmcli device connect)"
        return problem("discovery", f"'{interface}' has no IPv4 address", fix)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        member = struct.pack("4s4s", *map(socket.inet_aton, (_SCOUTING_GROUP, address)))
        try:
            probe.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        except OSError as error:
            found = f"'{interface}' takes no part in multicast: {error.strerror}"
            return problem("discovery", found, f"sudo ip link set {interface} multicast on")
    return ok("discovery", f"'{interface}' with {address} takes part in {_SCOUTING_GROUP}")


def token(http: HttpSettings) -> Finding:
    """The dashboard's token is there where it must be, and nobody else's to read."""
    path = Path(http.token_file or (_SERVICE / "token" if _SERVICE.is_dir() else "token"))
    make = f"(umask 077; {_TOKEN} >{path})"
    if path.parent == _SERVICE:
        make += f" && chown blimp {path}"
    if path.exists() and not os.access(path, os.R_OK):
        found = f"{path}: not this user's to read"
        return warning("token", found, f"sudo -u '#{path.stat().st_uid}' blimp doctor reads it")
    try:
        found_token = access.read_token(http)
    except access.AccessError as error:
        more = "" if http.token_file else ", then set http.token_file to it"
        return problem("token", str(error), f"rm -f {path}; {make}{more}")
    if found_token is None:
        return ok("token", "none: the dashboard is on loopback only")
    return ok("token", f"{path}, {len(found_token)} characters, its owner's only")


def _output(command: list[str]) -> str:
    run = subprocess.run(command, capture_output=True, text=True, timeout=_COMMAND_S)
    if run.returncode:
        raise OSError(f"{' '.join(command)}: {run.stderr.strip()[:200]}")
    return run.stdout
