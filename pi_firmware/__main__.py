"""The payload's program: `python -m pi_firmware --config payload.toml`."""

from __future__ import annotations

import argparse
import gc
import signal
import sys
import threading
from pathlib import Path

from pi_firmware.wire.errors import BlimpError

_EXAMPLE = """example:
  python -m pi_firmware --config pi_firmware/payload.toml \\
      --set 'camera.uri=replay:maps/atrium/flight.mcap?rate_hz=5' --set link.port=5600
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m pi_firmware",
        description="The payload: camera, gate, H.264 over RTP, telemetry.",
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML file (default: defaults)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="overrides one key, as camera.rate_hz=5; can be given again",
    )
    parser.add_argument("--check", action="store_true", help="checks the configuration and exits")
    return parser


def _run(arguments: argparse.Namespace, stop: threading.Event) -> None:
    from pi_firmware import autopilot, battery, link, settings, sources

    loaded = settings.load(arguments.config, arguments.set)
    if arguments.check:
        sources.check(loaded.camera.uri)
        battery.open_gauge(loaded.battery.uri, loaded.battery)
        autopilot.open_autopilot(loaded.autopilot)
        link.load_key(loaded.telemetry.certificates if loaded.link.encrypted else "")
        print("configuration is good")
        return
    from pi_firmware.payload import Payload

    payload = Payload(loaded)
    try:
        to = loaded.link
        print(
            f"payload {loaded.payload_id}: {loaded.camera.uri} -> {to.host}:{to.port},"
            f" ssrc {payload.ssrc}",
            *(f"telemetry on {endpoint}" for endpoint in payload.listening),
            sep="\n",
            flush=True,
        )
        # What is loaded and open now stays: later collections leave it out, and become short.
        gc.collect()
        gc.freeze()
        payload.run(stop)
        if payload.cut_reason:
            notice = (
                f"{loaded.camera.uri} is cut and was played up to the cut: {payload.cut_reason}"
            )
            print(f"pi_firmware: {notice}", file=sys.stderr)
        print(f"frames: {payload.counters}", flush=True)
    finally:
        payload.close()


def main() -> int:
    """Runs the payload.

    Status 0 at the end of the stream or on a signal, 2 on what a person can fix, 3 when the
    process must be restarted.
    """
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):  # first of all: it may come while modules load
        signal.signal(number, lambda *_: stop.set())
    arguments = _parser().parse_args()
    try:
        _run(arguments, stop)
    except BlimpError as error:
        print(f"pi_firmware: {error}", file=sys.stderr)
        return 3 if error.restart else 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
