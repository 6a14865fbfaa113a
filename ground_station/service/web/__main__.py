"""`python -m ground_station.service.web RUN_FOLDER`: dashboard, API and metrics of one run."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import sys
from pathlib import Path

from ground_station.service.ending import CannotGoOn, RateLimitedLog, status_of

_BEAT_S = 0.5
_EXPOSED = (
    "{host} is reached by others, who need the token; plain HTTP does not hide it from who listens"
    " on that network (a tunnel does: ssh -L)"
)


def serve(run_folder: str) -> int:
    """Serves until it is told to end."""
    gc.disable()  # a sixth of the time until the page is there; modules are no garbage
    asyncio.run(_serve(Path(run_folder)))
    return 0


def _print(_: str, text: str) -> None:
    print(f"web: {text}", file=sys.stderr, flush=True)


async def _serve(folder: Path) -> None:
    from ground_station.service import processes
    from ground_station.service.bus import Bus
    from ground_station.service.settings import load_run
    from ground_station.service.web.access import read_token
    from ground_station.service.web.app import build
    from ground_station.service.web.server import complain, listen, server
    from pi_firmware.wire.telemetry import is_loopback

    run = load_run(folder)
    http = run.station.http
    token = read_token(http)
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    with listen(http.host, http.port) as socket, Bus(folder, processes.WEB) as bus:
        loop.set_exception_handler(complain(RateLimitedLog(_print), socket))
        web = build(run, folder, bus, token)
        serving = server(web.guarded)
        gc.freeze()
        gc.enable()
        task = asyncio.create_task(serving.serve([socket]))
        host, port = socket.getsockname()[:2]
        place = f"[{host}]" if ":" in host else host
        print(f"dashboard: http://{place}:{port}/", flush=True)
        if not is_loopback(http.host):
            print(f"web: {_EXPOSED.format(host=http.host)}", file=sys.stderr, flush=True)
        while not stop.is_set() and not task.done():
            bus.heartbeat()  # from this loop: one that hangs is silent
            try:
                async with asyncio.timeout(_BEAT_S):
                    await stop.wait()
            except TimeoutError:
                pass
        web.live.close()
        serving.should_exit = True
        await task
        if not stop.is_set():
            raise CannotGoOn("the server ended by itself")


if __name__ == "__main__":
    status = status_of("web", serve)
    sys.stdout.flush()
    # Not sys.exit: it waits for threads that may wait for an answer of another process.
    os._exit(status)
