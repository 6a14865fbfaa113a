"""Who may say what: a machine's certificate folder, and Zenoh's access rules made from it.

A certificate's common name is `payload.ID` or `ground.NAME`; no id has a dot, so that neither can
pass for the other. A machine talks only to the names that its folder lists: that list, not the
signature alone, is what a revocation takes away.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pi_firmware.wire import keys
from pi_firmware.wire.errors import TelemetryError

PAYLOAD, GROUND = "payload", "ground"
AUTHORITIES, CERTIFICATE, KEY, ACCESS = "ca.pem", "certificate.pem", "key.pem", "access.json"
SCHEMA = "blimp.access/1"

# Rules say which messages of a key expression may pass on one link, seen from this machine.
IN, OUT = ("ingress",), ("egress",)
_HEAR = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"]
_SAY = ["put", "delete", "liveliness_token"]
SERVE = ["declare_queryable", "reply"]


@dataclass(frozen=True)
class Credentials:
    """A certificate folder: this machine's common name and those it talks to.

    `stations` are the other ground stations that a ground station works side by side with.
    """

    folder: Path
    name: str
    peers: tuple[str, ...]
    stations: tuple[str, ...] = ()

    @property
    def role(self) -> str:
        """`payload` or `ground`."""
        return self.name.partition(".")[0]

    @property
    def member(self) -> str:
        """The payload's id or the ground station's name."""
        return self.name.partition(".")[2]


def check_name(name: object) -> str:
    """Returns a common name; raises `TelemetryError` when it is none of ours."""
    role, _, member = name.partition(".") if isinstance(name, str) else ("", "", "")
    if role not in (PAYLOAD, GROUND):
        raise TelemetryError(f"{str(name)[:60]!r} is neither payload.ID nor ground.NAME")
    return f"{role}.{keys.check_payload_id(member)}"


def load(folder: str | Path) -> Credentials:
    """Reads a folder that `blimp keys` wrote; raises `TelemetryError` with one line."""
    folder = Path(folder)
    for name in (AUTHORITIES, CERTIFICATE, KEY):
        if not (folder / name).is_file():
            raise TelemetryError(
                f"certificates in {folder}: '{name}' is missing; blimp keys writes such a folder"
            )
    try:
        document = json.loads((folder / ACCESS).read_bytes())
    except OSError as error:
        raise TelemetryError(f"{folder / ACCESS}: {error.strerror or error}") from None
    except (ValueError, RecursionError):
        raise TelemetryError(f"{folder / ACCESS}: not JSON text") from None
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise TelemetryError(f"{folder / ACCESS}: not of schema {SCHEMA}")
    peers = document.get("peers")
    if not isinstance(peers, list):
        raise TelemetryError(f"{folder / ACCESS}: 'peers' must be a list")
    own = check_name(document.get("name"))
    other = GROUND if own.startswith(PAYLOAD) else PAYLOAD
    names = tuple(check_name(peer) for peer in peers)
    if wrong := [name for name in names if not name.startswith(other + ".")]:
        raise TelemetryError(f"{folder / ACCESS}: {own} talks to a {other} only, not to {wrong[0]}")
    stations = document.get("stations", [])  # an older authority's list has none
    if not isinstance(stations, list):
        raise TelemetryError(f"{folder / ACCESS}: 'stations' must be a list")
    side = tuple(check_name(station) for station in stations)
    if wrong := [name for name in side if not name.startswith(GROUND + ".")]:
        raise TelemetryError(f"{folder / ACCESS}: {wrong[0]} is no ground station")
    return Credentials(folder.resolve(), own, names, side)


def tls_settings(
    credentials: Credentials, rules: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Zenoh's settings: TLS on every link, both sides with a certificate, all else denied.

    `rules` say who may say what; without, a payload and its ground stations speak as they do.

    Names in certificates are ours, not the network's, so the host's name is not what is verified:
    the access rules take the common name instead, on both ends.
    """
    folder = credentials.folder
    tls: dict[str, Any] = {
        "root_ca_certificate": str(folder / AUTHORITIES),
        "enable_mtls": True,
        "verify_name_on_connect": False,
        "close_link_on_expiration": True,
    }
    for direction in ("listen", "connect"):
        tls[f"{direction}_certificate"] = str(folder / CERTIFICATE)
        tls[f"{direction}_private_key"] = str(folder / KEY)
    settings = {f"transport/link/tls/{name}": value for name, value in tls.items()}
    settings["transport/link/protocols"] = ["tls"]
    settings["access_control"] = access_rules(credentials) if rules is None else rules
    return settings


class Rules:
    """Zenoh's `access_control` as it is put together; all that no rule names is denied."""

    def __init__(self) -> None:
        self._rules: list[dict[str, Any]] = []
        self._policies: list[dict[str, Any]] = []
        self._subjects: list[dict[str, Any]] = []

    def allow(
        self, peer: str, table: Iterable[tuple[str, Sequence[str], list[str], list[str]]]
    ) -> None:
        """What may pass to or from a common name: rows of name, flows, messages and keys."""
        names = []
        for name, flows, kinds, on in table:
            names.append(f"{name}-{peer}")
            self._rules.append(
                {
                    "id": names[-1],
                    "permission": "allow",
                    "flows": list(flows),
                    "messages": kinds,
                    "key_exprs": on,
                }
            )
        self._subjects.append({"id": peer, "cert_common_names": [peer]})
        self._policies.append({"rules": names, "subjects": [peer]})

    def document(self) -> dict[str, Any]:
        """Zenoh's setting."""
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": self._rules,
            "subjects": self._subjects,
            "policies": self._policies,
        }


def access_rules(credentials: Credentials) -> dict[str, Any]:
    """Zenoh's `access_control`: a payload speaks under its own keys, the ground commands it."""
    rules = Rules()
    ground = credentials.role == GROUND
    # From the payload's side the ground is where things go out, and the other way round.
    to_payload, to_ground = (OUT, IN) if ground else (IN, OUT)
    for peer in credentials.peers:
        payload = peer.partition(".")[2] if ground else credentials.member
        own = keys.key(payload, "**")
        to_it = (f"{keys.COMMAND}/**", keys.POSE, keys.LINK)
        given = [keys.key(payload, kind) for kind in to_it]
        time, clock = keys.key(payload, keys.TIME), keys.key(payload, keys.CLOCK)
        command = given[0]
        table = [
            ("said", to_ground, _SAY, [own]),
            ("heard", to_payload, _HEAR, [f"{keys.ROOT}/**"]),
            ("given", to_payload, ["put"], given),
            ("taken", to_ground, ["declare_subscriber"], given),
            ("asked", to_payload, ["query"], [command, clock]),
            ("answered", to_ground, SERVE, [command, clock]),
            ("time-asked", to_ground, ["query"], [time]),
            ("time-served", to_payload, SERVE, [time]),
        ]
        rules.allow(peer, table)
    if ground:
        # A second program with this very certificate, as `blimp command`, asks through the first.
        commands = keys.every_payload(f"{keys.COMMAND}/**")
        asked = [commands, keys.every_payload(keys.ALIVE)]
        kinds = ["query", *SERVE, "liveliness_query", "liveliness_token"]
        rules.allow(credentials.name, [("own", OUT + IN, kinds, asked)])
    return rules.document()
