"""With certificates only those on the list are heard, each under its own keys only."""

import datetime
import json
import threading
import time
from pathlib import Path

import pytest
import zenoh
from short_certificates import certify
from waiting import eventually

from ground_station.keys.authority import Authority
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.settings import TelemetrySettings
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import keys, messages
from pi_firmware.wire.clock_offset import ask
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import Session, check_endpoint, open_session, session_config

LIMIT_S = 20.0
PATIENCE_S = 1.5
FREE = "tls/127.0.0.1:0"


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    made = Authority.create(tmp_path_factory.mktemp("authority") / "keys")
    made.add("ground", "main")
    made.add("payload", "blimp-1")
    made.add("payload", "blimp-2")
    return made


def folder(authority: Authority, name: str) -> str:
    return str(authority.of(name))


def heard(listener: TelemetryListener, session: Session, payload_id: str, wait_s: float) -> bool:
    """Whether a battery message under a payload's key arrives; it is said again until then."""
    said = threading.Event()

    def say() -> None:
        body = messages.encode(messages.Battery(time_ns=1, voltage=3.9))
        while not said.wait(0.1):
            session.zenoh.put(keys.key(payload_id, keys.BATTERY), body)

    speaker = threading.Thread(target=say)
    speaker.start()
    state = listener.wait(payload_id, lambda s: s.battery is not None, wait_s)
    said.set()
    speaker.join()
    session.close()
    return state is not None


def test_a_payload_that_boots_in_1970_has_exact_latencies(authority: Authority) -> None:
    booted_ns = time.time_ns() - 30 * 10**9
    with TelemetryListener([FREE], certificates=folder(authority, "ground.main")) as listener:
        settings = TelemetrySettings(
            connect=list(listener.endpoints), certificates=folder(authority, "payload.blimp-1")
        )
        telemetry = Telemetry("blimp-1", settings, lambda: time.time_ns() - booted_ns)
        offset = eventually(lambda: listener.clock("blimp-1"))
        captured_ns = time.time_ns() - booted_ns
        assert abs(offset.offset_ns + booted_ns) <= offset.uncertainty_ns < 2 * 10**9
        assert abs(time.time_ns() - offset.to_ours(captured_ns)) < 10**9
        certificates = folder(authority, "payload.blimp-1")
        session = open_session(connect=listener.endpoints, certificates=certificates)
        time_key = keys.key("blimp-1", keys.TIME)
        served = eventually(lambda: ask(session.zenoh, time_key, lambda: 0))
        assert abs(served.received_ns - time.time_ns()) < 60 * 10**9
        session.close()
        telemetry.close()


def test_another_payloads_keys_are_refused(authority: Authority) -> None:
    with TelemetryListener([FREE], certificates=folder(authority, "ground.main")) as listener:
        certificates = folder(authority, "payload.blimp-1")
        for payload_id, expected, wait_s in (("blimp-1", True, LIMIT_S), ("blimp-2", False, 3.0)):
            session = open_session(connect=listener.endpoints, certificates=certificates)
            assert heard(listener, session, payload_id, wait_s) is expected, payload_id


def test_a_foreign_authority_is_refused(authority: Authority, tmp_path: Path) -> None:
    foreign = Authority.create(tmp_path / "foreign")
    foreign.add("ground", "main")
    foreign.add("payload", "blimp-1")
    # Even one that trusts the right authority, as a stolen bundle would allow.
    bundle = (authority.of("payload.blimp-1") / "ca.pem").read_bytes()
    (foreign.of("payload.blimp-1") / "ca.pem").write_bytes(bundle)
    with TelemetryListener([FREE], certificates=folder(authority, "ground.main")) as listener:
        certificates = folder(foreign, "payload.blimp-1")
        session = open_session(connect=listener.endpoints, certificates=certificates)
        assert not heard(listener, session, "blimp-1", PATIENCE_S)
        assert listener.payloads() == []


def test_a_revoked_payload_is_refused(tmp_path: Path) -> None:
    made = Authority.create(tmp_path / "keys")
    made.add("ground", "main")
    made.add("payload", "blimp-1")
    made.revoke("payload.blimp-1")
    stolen = made.folder / "revoked" / "payload.blimp-1"
    with TelemetryListener([FREE], certificates=folder(made, "ground.main")) as listener:
        session = open_session(connect=listener.endpoints, certificates=stolen)
        eventually(lambda: listener.unlisted() == ["payload.blimp-1"])
        assert not heard(listener, session, "blimp-1", PATIENCE_S)
        assert listener.payloads() == []
        eventually(lambda: not listener.unlisted())


def test_an_expired_certificate_is_refused(authority: Authority, tmp_path: Path) -> None:
    """A payload's is; a ground station's in test_keys_refusal."""
    with TelemetryListener([FREE], certificates=folder(authority, "ground.main")) as listener:
        for days, expected, wait_s in ((-1, False, 2 * PATIENCE_S), (1, True, LIMIT_S)):
            lasts = datetime.timedelta(days=days)
            own = certify(authority, "payload.blimp-1", tmp_path / str(days), lasts)
            session = open_session(connect=listener.endpoints, certificates=own)
            assert heard(listener, session, "blimp-1", wait_s) is expected
            assert bool(listener.payloads()) is expected


def test_a_link_ends_with_its_certificate(authority: Authority, tmp_path: Path) -> None:
    for lasts_s in (3, 10, 30):  # a busy machine may have no link before the certificate has ended
        lasts = datetime.timedelta(seconds=lasts_s)
        ending = certify(authority, "payload.blimp-1", tmp_path / f"ending-{lasts_s}", lasts)
        with TelemetryListener([FREE], certificates=folder(authority, "ground.main")) as listener:
            settings = TelemetrySettings(connect=list(listener.endpoints), certificates=str(ending))
            telemetry = Telemetry("blimp-1", settings)
            linked = listener.wait("blimp-1", lambda s: s.alive, lasts_s)
            ended = linked and listener.wait("blimp-1", lambda s: not s.alive, 2 * LIMIT_S)
            telemetry.close()
        if linked:
            break
    assert linked and ended


@pytest.mark.parametrize("certified", [True, False])
def test_a_client_without_a_certificate_is_refused(authority: Authority, certified: bool) -> None:
    """It trusts the right authority and speaks TLS, and that is not enough."""
    own = authority.of("payload.blimp-1")
    with TelemetryListener([FREE], certificates=folder(authority, "ground.main")) as listener:
        config = session_config([], listener.endpoints)
        tls = {"root_ca_certificate": str(own / "ca.pem"), "verify_name_on_connect": False}
        if certified:
            tls |= {
                "enable_mtls": True,
                "connect_certificate": str(own / "certificate.pem"),
                "connect_private_key": str(own / "key.pem"),
            }
        for name, value in tls.items():
            config.insert_json5(f"transport/link/tls/{name}", json.dumps(value))
        session = Session(zenoh.open(config), ())
        wait_s = LIMIT_S if certified else 2 * PATIENCE_S
        assert heard(listener, session, "blimp-1", wait_s) is certified
        assert bool(listener.payloads()) is certified


def test_a_payload_does_not_take_another_ones_certificate(authority: Authority) -> None:
    settings = TelemetrySettings(connect=[], certificates=folder(authority, "payload.blimp-2"))
    with pytest.raises(TelemetryError, match=r"are payload.blimp-2's, not payload.blimp-1's"):
        Telemetry("blimp-1", settings)


def test_endpoints_and_certificates_must_fit(authority: Authority, tmp_path: Path) -> None:
    assert check_endpoint("tls/10.0.0.1:7447", certified=True) == ("10.0.0.1", 7447)
    for endpoint, certified, reason in (
        ("tls/127.0.0.1:7447", False, "needs a folder of certificates"),
        ("tcp/10.0.0.1:7447", False, "only loopback"),
        ("tcp/127.0.0.1:7447", True, "only tls/HOST:PORT"),
        ("tls/10.0.0.1:7447?x=1", True, "expected tls/HOST:PORT"),
        ("tls/" + "a" * 50_000, True, "expected tls/HOST:PORT"),
    ):
        with pytest.raises(TelemetryError, match=reason) as error:
            check_endpoint(endpoint, certified=certified)
        assert len(str(error.value)) < 300
    with pytest.raises(TelemetryError, match=r"'ca.pem' is missing"):
        open_session(listen=[FREE], certificates=tmp_path)
