"""With certificates: telemetry over mutual TLS, and the video of known payloads only."""

from __future__ import annotations

import socket
from pathlib import Path

from intake_stand import Stand, encoded, eventually, free_udp_port, packets, stamped

from ground_station.keys.authority import Authority


def test_two_payloads_with_their_keys_and_nobody_else(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "keys")
    ground = authority.add("ground", "main")
    folders = {name: authority.add("payload", name) for name in ("blimp-1", "blimp-2")}
    stranger = packets([stamped(unit, k) for k, unit in enumerate(encoded(30))], ssrc=4711)
    endpoint = f"tls/127.0.0.1:{free_udp_port()}"
    with Stand(tmp_path, telemetry={"listen": [endpoint], "certificates": str(ground)}) as stand:
        stand.endpoint = endpoint
        flying = {
            name: stand.payload(name, f"telemetry.certificates={folder}")
            for name, folder in folders.items()
        }
        stand.heard.more(20, *flying)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as forger:
            for datagram in stranger:
                forger.sendto(datagram, ("127.0.0.1", stand.port))
        newer = authority.add("payload", "blimp-3")  # the station has read its list before
        stand.payload("blimp-3", f"telemetry.certificates={newer}")
        eventually(lambda: "unlisted" in stand.heard.event_names("-"))
        stand.heard.more(20, *flying)
        for name, payload in flying.items():
            note = stand.settled(name, payload.end().counts)
            assert note.encrypted and note.clock is not None and note.battery is not None
            assert note.frames["received"] == note.frames["sent"] and note.frames["lost"] == 0
        assert set(stand.heard.payloads) == {"blimp-1", "blimp-2"}
        assert {note.ssrc for _, note, _ in stand.heard.frames}.isdisjoint({4711})
