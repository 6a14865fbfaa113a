"""Who may speak to the station over HTTP, as rules on headers: no sockets, no framework.

On loopback everybody on this machine may. Elsewhere it takes a token, as `Authorization: Bearer` or
through the login form, which gives a session cookie. Two things hold everywhere: the Host must be
one of the station's own names, so that no page of another site becomes "the same origin" by DNS
rebinding (Jackson et al., "Protecting browsers from DNS rebinding attacks", 2007), and what
changes something must not come from another site's page.

Browsers send an Origin with every POST and every WebSocket, programs mostly send none. So an absent
Origin is accepted from those that no browser speaks for unasked: with a Bearer token, or where no
token is asked for and no Sec-Fetch-Site tells of another site. A session cookie always needs it.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import secrets
import stat
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from http.cookies import CookieError, SimpleCookie
from pathlib import Path

from ground_station.errors import GroundStationError
from ground_station.service.settings import HttpSettings
from pi_firmware.wire.telemetry import is_loopback

COOKIE = "blimp_session"
SESSION_S = 12 * 3600
TOKEN_CHARACTERS = 20
_TOKEN_BYTES = 4096
_SESSIONS, _ADDRESSES = 64, 1024
_LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})

Clock = Callable[[], float]
Headers = Mapping[str, str]


class AccessError(GroundStationError):
    """Settings under which the station would be open to others."""


class Refused(Exception):
    """A request that is not let in, with its HTTP status."""

    def __init__(self, status: int, detail: str, retry_s: int | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.retry_s = status, detail, retry_s


def read_token(settings: HttpSettings) -> str | None:
    """The token that is asked for; None on loopback without one.

    Raises `AccessError` with one line for an address beyond loopback without a token, and for a
    token file that is missing, too short or readable by others.
    """
    if not settings.token_file:
        if is_loopback(settings.host):
            return None
        raise AccessError(
            f"http.host is {settings.host!r}, which others reach: it needs http.token_file"
            f" (a file of mode 0600 with at least {TOKEN_CHARACTERS} characters)"
        )
    path = Path(settings.token_file)
    try:
        with path.open("rb") as file:
            found = os.fstat(file.fileno())
            data = file.read(_TOKEN_BYTES + 1) if stat.S_ISREG(found.st_mode) else b""
    except OSError as error:
        raise AccessError(f"http.token_file {path}: {error.strerror or error}") from None
    if not stat.S_ISREG(found.st_mode):
        raise AccessError(f"http.token_file {path}: not a regular file")
    if found.st_mode & 0o077:
        mode = stat.S_IMODE(found.st_mode)
        raise AccessError(f"http.token_file {path}: its mode is {mode:04o}, it must be 0600")
    try:
        token = data.decode().strip()
    except UnicodeDecodeError:
        raise AccessError(f"http.token_file {path}: not text") from None
    if not TOKEN_CHARACTERS <= len(token) <= _TOKEN_BYTES or not token.isprintable():
        raise AccessError(
            f"http.token_file {path}: {len(token)} characters; a token has one line of"
            f" {TOKEN_CHARACTERS} to {_TOKEN_BYTES}"
        )
    return token


class Buckets:
    """How often each address may: `rate_hz` in the long run, `burst` at once. Bounded memory."""

    def __init__(self, rate_hz: float, burst: int, clock: Clock = time.monotonic) -> None:
        self._rate_hz, self._burst, self._clock = rate_hz, burst, clock
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, address: str) -> float:
        """Takes one; 0, or the seconds until there is one again."""
        left, now_s = self._now(address)
        if left < 1.0:
            return (1.0 - left) / self._rate_hz
        self._put(address, left - 1.0, now_s)
        return 0.0

    def empty_s(self, address: str) -> float:
        """Seconds until there is one again, 0 when there is; takes none."""
        left, _ = self._now(address)
        return 0.0 if left >= 1.0 else (1.0 - left) / self._rate_hz

    def _now(self, address: str) -> tuple[float, float]:
        now_s = self._clock()
        left, at_s = self._left.get(address, (float(self._burst), now_s))
        return min(float(self._burst), left + (now_s - at_s) * self._rate_hz), now_s

    def _put(self, address: str, left: float, now_s: float) -> None:
        self._left[address] = (left, now_s)
        self._left.move_to_end(address)
        if len(self._left) > _ADDRESSES:
            self._left.popitem(last=False)


class Sessions:
    """Who logged in: random ids, kept here by their digests until they expire.

    Only this process has them, so a restart ends all sessions.
    """

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._until_s: OrderedDict[bytes, float] = OrderedDict()

    def begin(self) -> str:
        """A new session's cookie value; the oldest session ends when there are too many."""
        cookie = secrets.token_urlsafe(32)
        self._until_s[_digest(cookie)] = self._clock() + SESSION_S
        while len(self._until_s) > _SESSIONS:
            self._until_s.popitem(last=False)
        return cookie

    def holds(self, cookie: str) -> bool:
        """Whether a cookie value is of a session that has not ended."""
        return self._until_s.get(_digest(cookie), -1.0) > self._clock()

    def end(self, cookie: str) -> None:
        """Ends a session."""
        self._until_s.pop(_digest(cookie), None)


class Access:
    """The rules of one station; raises `Refused`.

    `token` is None where none is asked for. `posts` bounds requests that change something,
    `failures` wrong tokens, both by address.
    """

    def __init__(
        self, settings: HttpSettings, token: str | None, clock: Clock = time.monotonic
    ) -> None:
        self._digest = None if token is None else _digest(token)
        self._names = _LOOPBACK_NAMES | {name.lower() for name in (settings.host, *settings.names)}
        self.sessions = Sessions(clock)
        self.posts = Buckets(10.0, 30, clock)
        self.failures = Buckets(1 / 12, 5, clock)

    @property
    def needs_token(self) -> bool:
        """Whether one is asked for."""
        return self._digest is not None

    def check_host(self, headers: Headers, server: str) -> None:
        """The Host must be a name of the station or the address that was reached."""
        host = headers.get("host", "")
        name = _host_name(host)
        if not name or name not in self._names | {server.lower()}:
            raise Refused(403, f"host {host[:80]!r} is none of this station's (http.names)")

    def check_token(self, address: str, given: str) -> None:
        """A token as it was given, in constant time; who fails too often must wait.

        On loopback only with wrong ones: whoever comes through a tunnel has that address, too.
        """
        address = _network(address)
        right = self._digest is not None and hmac.compare_digest(self._digest, _digest(given))
        wait_s = self.failures.empty_s(address)
        if wait_s > 0 and not (right and is_loopback(address)):
            raise Refused(429, "too many wrong tokens; wait", round(wait_s + 0.5))
        if not right:
            self.failures.take(address)
            raise Refused(401, "wrong token")

    def authenticate(self, headers: Headers, address: str) -> str:
        """By what a request is let in: "open", "bearer" or "cookie"."""
        if self._digest is None:
            return "open"
        scheme, _, given = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            self.check_token(address, given.strip())
            return "bearer"
        if self.sessions.holds(cookie_of(headers)):
            return "cookie"
        raise Refused(401, "a token is needed: Authorization: Bearer, or log in at /login")

    def check_origin(self, headers: Headers, by: str) -> None:
        """A request that changes something, or a WebSocket, must not be another site's."""
        origin = headers.get("origin")
        if origin is None:
            if by == "cookie":
                raise Refused(403, "no Origin: a session needs one")
            self.check_site(headers)
            return
        scheme, _, place = origin.partition("://")
        if scheme not in ("http", "https") or place.lower() != headers.get("host", "").lower():
            raise Refused(403, f"origin {origin[:80]!r} is another site")

    def check_site(self, headers: Headers) -> None:
        """A browser must not ask on behalf of another site, where it tells."""
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            raise Refused(403, "asked for by another site")

    def check_rate(self, address: str) -> None:
        """Requests that change something may come only so often."""
        if (wait_s := self.posts.take(_network(address))) > 0:
            raise Refused(429, "too many requests; wait", round(wait_s + 0.5))


def cookie_of(headers: Headers) -> str:
    """The session cookie's value; "" without one."""
    try:
        morsel = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return morsel.value if morsel else ""


def _host_name(host: str) -> str:
    """The name in a Host header, without the port; "" where it is none."""
    host = host.strip().lower()
    if host.startswith("["):
        name, bracket, port = host[1:].partition("]")
        port = port.removeprefix(":") if port[:1] in ("", ":") else "x"
        if not bracket:
            return ""
    else:
        name, _, port = host.partition(":")
    return name.rstrip(".") if port == "" or port.isdecimal() else ""


def _network(address: str) -> str:
    """An address's own bucket: one of IPv6 owns a whole /64."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address[:64]
    if isinstance(found, ipaddress.IPv6Address):
        if found.ipv4_mapped:
            return str(found.ipv4_mapped)
        return str(ipaddress.ip_network((found, 64), strict=False))
    return str(found)


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()
