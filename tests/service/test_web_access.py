"""Who gets in: rules for Host, Origin, tokens and sessions, by themselves and over HTTP."""

from __future__ import annotations

import contextlib
import os

import pytest
import web_station as station
from starlette.websockets import WebSocketDisconnect

from ground_station.service.settings import HttpSettings
from ground_station.service.web import access
from ground_station.service.web.access import Access, AccessError, Buckets, Refused, read_token
from ground_station.service.web.guard import BODY_BYTES

HERE = station.HERE
LIVE = "ws://127.0.0.1:8080/api/live"
BEARER = {"authorization": f"Bearer {station.TOKEN}"}
OWN = {"origin": HERE}


@pytest.fixture(scope="module")
def opened_once(tmp_path_factory):
    with station.application(tmp_path_factory.mktemp("opened")) as parts:
        yield parts


@pytest.fixture(scope="module")
def closed_once(tmp_path_factory):
    with station.application(tmp_path_factory.mktemp("closed"), station.TOKEN) as parts:
        yield parts


def fresh(parts):
    """As at its start: nobody is logged in, nobody has asked."""
    client, _, web = parts
    client.cookies.clear()
    web.access.sessions._until_s.clear()
    web.access.posts, web.access.failures = Buckets(10.0, 30), Buckets(1 / 12, 5)
    return client, web


@pytest.fixture
def opened(opened_once):
    """On loopback, without a token."""
    return fresh(opened_once)


@pytest.fixture
def closed(closed_once):
    """With a token."""
    return fresh(closed_once)


# Settings


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost", "127.8.9.1"])
def test_loopback_needs_no_token(host):
    assert read_token(HttpSettings(host=host)) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "station.local", ""])
def test_any_other_address_does(host):
    with pytest.raises(AccessError, match=r"needs http.token_file"):
        read_token(HttpSettings(host=host))


@pytest.mark.parametrize(
    ("text", "mode", "reason"),
    [
        (station.TOKEN, 0o640, "0640, it must be 0600"),
        (station.TOKEN, 0o604, "0604, it must be 0600"),
        ("short", 0o600, "5 characters"),
        ("  \n", 0o600, "0 characters"),
        ("x" * 5000, 0o600, "5000|4097 characters"),
        ("line one is long enough\nline two", 0o600, "one line"),
    ],
)
def test_a_token_file_that_is_not_good(tmp_path, text, mode, reason):
    path = station.write_token(tmp_path, text, mode)
    for host in ("0.0.0.0", "127.0.0.1"):
        with pytest.raises(AccessError, match=reason) as error:
            read_token(HttpSettings(host=host, token_file=str(path)))
        assert "\n" not in str(error.value) and station.TOKEN not in str(error.value)


def test_a_token_file_that_is_missing_or_none(tmp_path):
    with pytest.raises(AccessError, match="No such file"):
        read_token(HttpSettings(token_file=str(tmp_path / "none")))
    with pytest.raises(AccessError, match=r"directory|regular"):
        read_token(HttpSettings(token_file=str(tmp_path)))


def test_a_good_token_file_holds_on_loopback_too(tmp_path):
    path = station.write_token(tmp_path, station.TOKEN + "\n")
    assert read_token(HttpSettings(host="0.0.0.0", token_file=str(path))) == station.TOKEN
    assert read_token(HttpSettings(token_file=str(path))) == station.TOKEN
    path.chmod(0o400)
    assert read_token(HttpSettings(token_file=str(path))) == station.TOKEN


# Rules


def outcome(good):
    """Either nothing happens or it is forbidden."""
    forbidden = pytest.raises(Refused, check=lambda refused: refused.status == 403)
    return contextlib.nullcontext() if good else forbidden


@pytest.mark.parametrize(
    ("host", "good"),
    [
        ("127.0.0.1:8080", True), ("127.0.0.1", True), ("localhost:9000", True),
        ("LOCALHOST:8080", True), ("localhost.:8080", True), ("[::1]:8080", True),
        ("10.0.0.5:8080", True), ("station.local", True), ("lab.example:80", True),
        ("evil.example:8080", False), ("127.0.0.1.evil.example", False), ("", False),
        ("localhost:80x", False), ("[::1", False), ("[::1]x", False), ("10.0.0.6:8080", False),
        ("localhost@evil.example", False), ("evil.example#localhost", False),
    ],
)  # fmt: skip
def test_hosts(host, good):
    rules = Access(HttpSettings(host="station.local", names=["Lab.example"]), None)
    with outcome(good):
        rules.check_host({"host": host}, "10.0.0.5")


@pytest.mark.parametrize(
    ("headers", "by", "good"),
    [
        ({"origin": "http://a:1"}, "open", True),
        ({"origin": "https://a:1"}, "cookie", True),
        ({"origin": "http://a:2"}, "open", False),
        ({"origin": "http://a"}, "bearer", False),
        ({"origin": "http://evil.example"}, "bearer", False),
        ({"origin": "null"}, "open", False),
        ({"origin": ""}, "open", False),
        ({"origin": "file://a:1"}, "open", False),
        ({}, "open", True),
        ({}, "bearer", True),
        ({}, "cookie", False),
        ({"sec-fetch-site": "cross-site"}, "open", False),
        ({"sec-fetch-site": "same-site"}, "open", False),
        ({"sec-fetch-site": "same-origin"}, "open", True),
    ],
)
def test_origins(headers, by, good):
    rules = Access(HttpSettings(), None)
    with outcome(good):
        rules.check_origin({"host": "a:1", **headers}, by)


def test_tokens_are_compared_in_constant_time(monkeypatch):
    compared = []

    def compare(a, b):
        compared.append((len(a), len(b)))
        return a == b

    monkeypatch.setattr(access.hmac, "compare_digest", compare)
    rules = Access(HttpSettings(), station.TOKEN)
    for given in ("", "x", station.TOKEN[:-1], station.TOKEN + "x", "\udce4ü"):
        with pytest.raises(Refused):
            rules.check_token(f"10.0.0.{len(compared)}", given)
    rules.check_token("10.0.0.9", station.TOKEN)
    assert compared == [(32, 32)] * 6  # of digests: not even the length shows


def tries(rules, addresses):
    """The statuses of wrong tokens from these addresses."""
    statuses = []
    for address in addresses:
        with pytest.raises(Refused) as refused:
            rules.check_token(address, "wrong")
        statuses.append(refused.value.status)
    return statuses


def test_wrong_tokens_cost_time_but_only_who_gives_them():
    now_s = [0.0]
    rules = Access(HttpSettings(), station.TOKEN, clock=lambda: now_s[0])
    assert tries(rules, ["10.0.0.1"] * 5) == [401] * 5
    for given in ("wrong", station.TOKEN):
        with pytest.raises(Refused) as refused:
            rules.check_token("10.0.0.1", given)
        assert refused.value.status == 429 and refused.value.retry_s
    rules.check_token("10.0.0.2", station.TOKEN)
    now_s[0] += 13.0
    rules.check_token("10.0.0.1", station.TOKEN)


def test_nobody_locks_out_who_comes_through_a_tunnel():
    rules = Access(HttpSettings(), station.TOKEN)
    assert tries(rules, ["127.0.0.1"] * 8) == [401] * 5 + [429] * 3
    rules.check_token("127.0.0.1", station.TOKEN)


def test_an_address_of_ipv6_cannot_try_from_its_whole_network():
    rules = Access(HttpSettings(), station.TOKEN)
    assert tries(rules, [f"2001:db8::{k:x}" for k in range(8)]) == [401] * 5 + [429] * 3


def test_buckets_are_bounded():
    buckets = Buckets(1.0, 2)
    for number in range(10_000):
        buckets.take(str(number))
    assert len(buckets._left) <= 1024


def test_sessions_end_by_time_number_and_word():
    now_s = [0.0]
    sessions = access.Sessions(lambda: now_s[0])
    first = sessions.begin()
    assert sessions.holds(first)
    for forged in ("", ".", first[:-1], first + "x", first[:10], "a.b", "ü.ü"):
        assert not sessions.holds(forged)
    other = access.Sessions().begin()
    assert not sessions.holds(other)
    sessions.end(first)
    assert not sessions.holds(first)
    second = sessions.begin()
    now_s[0] += access.SESSION_S + 1
    assert not sessions.holds(second)
    kept = [sessions.begin() for _ in range(200)]
    assert sum(map(sessions.holds, kept)) == 64 and sessions.holds(kept[-1])


# Over HTTP


@pytest.mark.parametrize("path", ["/", "/api/state", "/metrics", "/healthz", "/static/x", "/nope"])
def test_no_name_of_another_is_answered_anywhere(opened, path):
    """What DNS rebinding looks like from here: another site's name on our address."""
    answer = opened[0].get(path, headers={"host": "evil.example:8080"})
    assert answer.status_code == 403
    assert "evil.example" in answer.json()["detail"]


POSTS = [
    ("/api/payloads/blimp-1/command", {"name": "idr"}),
    ("/api/payloads/blimp-1/relocalize", {}),
    ("/api/payloads/blimp-1/map", {"name": "atrium"}),
    ("/api/recording", {"active": True}),
]


@pytest.mark.parametrize(("path", "body"), POSTS)
def test_posts_of_other_sites_are_refused(opened, path, body):
    client, _ = opened
    for origin in ("http://evil.example", "null", "http://127.0.0.1:3000", "http://localhost:8080"):
        assert client.post(path, json=body, headers={"origin": origin}).status_code == 403
    assert client.post(path, json=body, headers=OWN).status_code == 200
    assert client.post(path, json=body).status_code == 200


def test_a_form_of_another_site_cannot_be_json(opened):
    """A cross-site form sends text/plain without asking first."""
    answer = opened[0].post(
        "/api/recording", content='{"active": true}', headers={"content-type": "text/plain"}
    )
    assert answer.status_code == 422


def test_reading_is_not_done_on_behalf_of_another_site(opened):
    client, _ = opened
    for site, status in (("cross-site", 403), ("same-site", 403), ("same-origin", 200)):
        assert client.get("/api/state", headers={"sec-fetch-site": site}).status_code == status
    assert client.get("/healthz", headers={"sec-fetch-site": "cross-site"}).status_code == 200
    assert "access-control-allow-origin" not in client.get("/api/state", headers=OWN).headers


@pytest.mark.parametrize(
    "path", ["/", "/api/state", "/nope", "/page.css", "/api/docs", "/metrics", "/static/nope.js"]
)
def test_every_answer_carries_the_headers(opened, path):
    client, _ = opened
    for answer in (client.get(path), client.get(path, headers={"host": "evil.example"})):
        policy = answer.headers["content-security-policy"]
        for part in (
            "default-src 'self'", "img-src 'self' blob: data:", "connect-src 'self'",
            "frame-ancestors 'none'", "base-uri 'none'", "form-action 'self'",
        ):  # fmt: skip
            assert part in policy
        assert "unsafe" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["cross-origin-opener-policy"] == "same-origin"
        assert "server" not in answer.headers


def test_pages_load_nothing_from_elsewhere_and_have_no_script(opened, closed):
    for page in (opened[0].get("/api/docs").text, closed[0].get("/login").text):
        assert "<script" not in page and "style=" not in page and "<style" not in page
        assert "https://" not in page and "http://" not in page


def test_without_a_token_nothing_is_told(closed):
    client, _ = closed
    for path in ("/api/state", "/metrics", "/api/docs", "/api/openapi.json", "/api/maps", "/x"):
        answer = client.get(path)
        assert answer.status_code == 401
        assert answer.headers["www-authenticate"] == "Bearer"
    for path, body in POSTS:
        assert client.post(path, json=body, headers=OWN).status_code == 401
    assert client.get("/").headers["location"] == "/login"
    assert client.get("/healthz").json() == {"status": "ok"}
    assert client.get("/login").status_code == client.get("/page.css").status_code == 200


def test_with_a_bearer_token(closed):
    client, _ = closed
    assert client.get("/api/state", headers=BEARER).status_code == 200
    assert client.post("/api/recording", json={"active": True}, headers=BEARER).status_code == 200
    evil = {**BEARER, "origin": "http://evil.example"}
    assert client.post("/api/recording", json={"active": True}, headers=evil).status_code == 403
    for header in ("Bearer", "Bearer x", f"Basic {station.TOKEN}", station.TOKEN):
        answer = client.get("/api/state", headers={"authorization": header})
        assert answer.status_code == 401


def log_in(client, token=station.TOKEN, headers=OWN):
    return client.post("/login", data={"token": token}, headers=headers)


def test_a_session_from_login_to_logout(closed):
    client, _ = closed
    answer = log_in(client)
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=strict" in cookie and "max-age=43200" in cookie
    assert station.TOKEN not in cookie
    assert client.get("/api/state").status_code == 200
    assert client.post("/api/recording", json={"active": True}, headers=OWN).status_code == 200
    # A browser sends an Origin with each POST: without one it is no page of ours that asks.
    assert client.post("/api/recording", json={"active": True}).status_code == 403
    kept = client.cookies[access.COOKIE]
    assert client.post("/logout", headers=OWN).status_code == 303
    client.cookies.clear()
    client.cookies.set(access.COOKIE, kept)
    assert client.get("/api/state").status_code == 401


def test_failed_logins_must_wait(closed):
    client, _ = closed
    statuses = [log_in(client, "wrong").status_code for _ in range(7)]
    assert statuses == [401] * 5 + [429] * 2
    assert int(log_in(client).headers["retry-after"]) >= 1
    assert "alert" in log_in(client).text


def test_failed_bearer_tokens_count_as_well(closed):
    client, _ = closed
    for _ in range(5):
        client.get("/api/state", headers={"authorization": "Bearer wrong"})
    assert client.get("/api/state", headers=BEARER).status_code == 429


@pytest.mark.parametrize("body", ["", "token=", "x=1", "token=%ff%fe", "&" * 50, "token=a&" * 20])
def test_a_login_that_is_no_form(closed, body):
    headers = {**OWN, "content-type": "application/x-www-form-urlencoded"}
    assert closed[0].post("/login", content=body, headers=headers).status_code in (401, 422)


def test_the_form_is_sent_with_its_origin(closed):
    """Under no-referrer a browser sends a form's Origin as null, which is another site's."""
    client, _ = closed
    for answer in (client.get("/login"), log_in(client, "wrong")):
        assert answer.headers["referrer-policy"] == "same-origin"
    assert log_in(client, headers={"origin": "null"}).status_code == 403


def test_a_login_of_another_site(closed):
    answer = log_in(closed[0], headers={"origin": "http://evil.example"})
    assert answer.status_code == 403 and "set-cookie" not in answer.headers


@pytest.mark.parametrize(
    ("headers", "good"),
    [
        ({}, False),
        (BEARER, True),
        ({"authorization": "Bearer wrong"}, False),
        ({**BEARER, "origin": "http://evil.example"}, False),
        ({**BEARER, "host": "evil.example"}, False),
        ({"cookie": f"{access.COOKIE}=made.up"}, False),
    ],
)
def test_the_live_channel_asks_the_same(closed, headers, good):
    client, _ = closed
    if good:
        with client.websocket_connect(LIVE, headers=headers) as live:
            assert live.receive_json()["type"] == "hello"
    else:
        with pytest.raises(WebSocketDisconnect):  # refused before it is accepted
            client.websocket_connect(LIVE, headers=headers).__enter__()


def test_the_live_channel_of_another_site_is_refused(opened):
    client, _ = opened
    for origin in ("http://evil.example", "null", "http://127.0.0.1:3000"):
        with pytest.raises(WebSocketDisconnect):
            client.websocket_connect(LIVE, headers={"origin": origin}).__enter__()
    with client.websocket_connect(LIVE, headers=OWN) as live:
        assert live.receive_json()["type"] == "hello"


def test_a_live_channel_ends_with_its_session(closed):
    client, _ = closed
    log_in(client)
    with client.websocket_connect(LIVE, headers=OWN) as live:
        live.receive_json()
        client.post("/logout", headers=OWN)
        with pytest.raises(WebSocketDisconnect) as ended:
            for _ in range(100):
                live.receive_json()
        assert ended.value.code == 4401


def test_bodies_are_bounded(opened):
    client, _ = opened
    headers = {"content-type": "application/json"}
    large = b'{"active": true' + b" " * BODY_BYTES + b"}"
    assert client.post("/api/recording", content=large, headers=headers).status_code == 413

    def pieces():
        for _ in range(100):
            yield b" " * 4096

    assert client.post("/api/recording", content=pieces(), headers=headers).status_code == 413
    deep = b"[" * 30_000
    assert client.post("/api/recording", content=deep, headers=headers).status_code == 400
    assert client.post("/nope", content=large).status_code == 413


def test_a_flood_of_posts_is_refused_and_others_are_not(opened):
    client, web = opened
    answers = [client.post("/api/recording", json={}) for _ in range(200)]
    refused = [answer for answer in answers if answer.status_code == 429]
    assert 50 < len(refused) < 200
    # Not the next one's: on a slow machine one more may be allowed by then.
    assert all(answer.headers["retry-after"] for answer in refused)
    assert client.get("/api/state").status_code == 200
    web.access.check_rate("10.9.9.9")  # another address


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can read what has mode 0000")
def test_a_token_file_without_any_mode_is_read_by_root_only(tmp_path):
    path = station.write_token(tmp_path, mode=0)
    assert read_token(HttpSettings(token_file=str(path))) == station.TOKEN
