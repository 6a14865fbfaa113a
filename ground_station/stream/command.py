"""`blimp command`: asks a payload to do something."""

from __future__ import annotations

import argparse
import math
import re
import time
from collections.abc import Mapping
from pathlib import Path

from pi_firmware.wire import keys, messages
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import LOCAL_ENDPOINT, PORT, Session, open_session
from pi_firmware.wire.text import printable

NAMES = ("record-start", "record-stop", "idr", "bitrate", "exposure", "shutdown", "reboot")
_NAME = re.compile(r"[a-z][a-z0-9-]{0,31}")
_POLL_S = 0.05


def ask(
    session: Session,
    payload_id: str,
    name: str,
    arguments: Mapping[str, float] | None = None,
    timeout_s: float = 5.0,
) -> messages.Answer:
    """Sends one command, once, and waits for its answer, which may be a refusal with its reason.

    It waits up to `timeout_s` for the payload to be there, and as long again for the answer. Raises
    `TelemetryError` with one line when nobody answers, and says whether the command was sent: one
    that was may have been carried out all the same.
    """
    if not _NAME.fullmatch(name):
        raise TelemetryError(f"command {name[:40]!r}: expected a name as {NAMES[2]!r}")
    key = keys.command(payload_id, name)
    command = messages.Command(time_ns=time.time_ns(), arguments=dict(arguments or {}))
    body = messages.encode(command)
    _wait_for_payload(session, payload_id, key, timeout_s)
    asked = f"payload {payload_id!r} was asked for {name!r}"
    sent_s = time.monotonic()
    for reply in session.zenoh.get(key, payload=body, timeout=timeout_s):
        if reply.ok is not None:
            return messages.decode(messages.Answer, reply.ok.payload.to_bytes())
    if time.monotonic() - sent_s >= timeout_s:
        raise TelemetryError(f"{asked} and did not answer within {timeout_s:g} s")
    raise TelemetryError(f"{asked} and gave no answer: it ended, or its link did")


def _wait_for_payload(session: Session, payload_id: str, key: str, timeout_s: float) -> None:
    """Until somebody takes questions at the key; raises `TelemetryError` when nobody does in time.

    A question that reaches nobody would end at once: a session needs a moment to find its peers.
    """
    querier = session.zenoh.declare_querier(key)
    try:
        deadline_s = time.monotonic() + timeout_s
        while not querier.matching_status.matching:
            if time.monotonic() > deadline_s:
                raise TelemetryError(_absent(session, payload_id, timeout_s))
            time.sleep(_POLL_S)
    finally:
        querier.undeclare()


def _absent(session: Session, payload_id: str, timeout_s: float) -> str:
    alive = keys.key(payload_id, keys.ALIVE)
    if any(reply.ok for reply in session.zenoh.liveliness().get(alive, timeout=1.0)):
        return f"payload {payload_id!r} is alive but takes no commands: its program is an older one"
    return (
        f"payload {payload_id!r} was not heard of within {timeout_s:g} s:"
        " it is off, out of reach, or does not list this ground station"
    )


_EPILOG = """\
examples:
  blimp command blimp-1 idr
  blimp command blimp-1 bitrate kbps=800
  blimp command blimp-1 record-start --certificates ~/keys/ground/main --connect tls/10.0.0.1:7447

record-start, record-stop, idr, shutdown and reboot take no numbers; bitrate takes kbps, exposure
takes exposure_s and gain (0: automatic). The payload refuses what is out of its range, and while
its autopilot is armed exposure, shutdown and reboot, unless force=1 is given.

Payloads connect to the ground station. Where none runs, the command listens in its place; where
one does, give its endpoint, or one that the payload listens on, to --connect.

The status is 0 when it was done, 1 when the payload refused, 2 when nobody answered."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = _EPILOG
    parser.set_defaults(next="blimp serve --lan    (its page has these commands as buttons)")
    parser.add_argument("payload", metavar="PAYLOAD", help="its id, as blimp-1")
    parser.add_argument("name", metavar="NAME", choices=NAMES, help=", ".join(NAMES))
    parser.add_argument(
        "arguments", nargs="*", metavar="KEY=VALUE", help="the command's numbers, as kbps=800"
    )
    parser.add_argument(
        "--connect", action="append", default=[], metavar="ENDPOINT",
        help="a running ground station, or the payload: tcp/ or tls/HOST:PORT",
    )  # fmt: skip
    parser.add_argument(
        "--listen", action="append", default=[], metavar="ENDPOINT",
        help="where the payload connects to (tcp/127.0.0.1:7447, with certificates "
        "tls/0.0.0.0:7447; nowhere with --connect)",
    )  # fmt: skip
    parser.add_argument(
        "--certificates", default="", metavar="FOLDER",
        help="what `blimp keys ground` wrote; without, only loopback is spoken to",
    )  # fmt: skip
    parser.add_argument(
        "--discoverable", default="", metavar="INTERFACE",
        help="payloads that look for a ground station on this interface find the command",
    )  # fmt: skip
    parser.add_argument(
        "--timeout-s", type=float, default=10.0, metavar="S",
        help="wait so long for the payload, and again for its answer (10)",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="F", help="write the answer here, too")


def run(args: argparse.Namespace) -> int:
    """Asks and prints the answer; raises `BlimpError` with one line for bad input or none."""
    from ground_station.errors import InputError
    from ground_station.files import write_json

    keys.check_payload_id(args.payload)
    numbers = _numbers(args.arguments)
    if not 0.1 <= args.timeout_s <= 600:
        raise InputError(f"--timeout-s is {args.timeout_s:g}; allowed: 0.1 to 600")
    listen, connects_only = args.listen, bool(args.connect) and not args.listen
    if not listen and not connects_only:
        listen = [f"tls/0.0.0.0:{PORT}" if args.certificates else LOCAL_ENDPOINT]
    try:
        session = open_session(
            listen=listen,
            connect=args.connect,
            certificates=args.certificates,
            discoverable=args.discoverable,
            client_timeout_s=args.timeout_s if connects_only else None,
        )
    except TelemetryError as error:
        hint = "; one that runs already is asked with --connect" if "in use" in str(error) else ""
        raise TelemetryError(f"{error}{hint}") from None
    try:
        answer = ask(session, args.payload, args.name, numbers, args.timeout_s)
    finally:
        session.close()
    said = "done" if answer.done else f"refused: {_said(answer.reason)}"
    values = ", ".join(f"{_said(key)} {value:g}" for key, value in answer.values.items())
    print(f"{args.payload}: {args.name}: {said}" + (f" ({values})" if values else ""))
    if args.json:
        document = {
            "payload": args.payload,
            "command": args.name,
            "arguments": numbers,
            "done": answer.done,
            "reason": answer.reason,
            "values": answer.values,
        }
        write_json(args.json, document)
    return 0 if answer.done else 1


def _numbers(arguments: list[str]) -> dict[str, float]:
    """`KEY=VALUE` texts as numbers; raises `InputError` with one line."""
    from ground_station.errors import InputError

    numbers: dict[str, float] = {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not key or not equals:
            raise InputError(f"{argument!r}: expected KEY=VALUE, as kbps=800")
        if key in numbers:
            raise InputError(f"{key!r} is given twice")
        try:
            numbers[key] = float(text)
        except ValueError:
            raise InputError(f"{argument!r}: {text!r} is not a number") from None
        if not math.isfinite(numbers[key]):
            raise InputError(f"{argument!r}: {text} is not finite")
    return numbers


def _said(text: str) -> str:
    """What a payload says, without what would steer a terminal."""
    return printable(text, 300, " ")
