"""`--dask`: threads, processes of this machine, or a cluster."""

from __future__ import annotations

import re
from contextlib import AbstractContextManager, nullcontext

from ground_station.errors import InputError
from ground_station.mapping.construction.workers import Threads, Workers
from ground_station.mapping.settings import MappingSettings

_MOST_LOCAL = 256


def parse_cluster(text: str) -> str | int:
    """What `--dask` says: an address `tcp://…` or `tls://…`, or a number of processes here.

    Raises `InputError` with one line.
    """
    if re.fullmatch(r"(tcp|tls)://[^\s/]+:\d{1,5}", text, re.ASCII):
        return text
    if re.fullmatch(r"\d{1,4}", text, re.ASCII) and 1 <= int(text) <= _MOST_LOCAL:
        return int(text)
    raise InputError(
        f"--dask is {text!r:.60}; allowed: tcp://HOST:PORT, tls://HOST:PORT "
        f"or 1 to {_MOST_LOCAL} processes on this machine"
    )


def open_workers(
    dask: str | None, threads: int, settings: MappingSettings
) -> AbstractContextManager[Workers]:
    """The workers that `--dask` asks for, by default so many threads.

    Raises `InputError` for what it cannot be, `MapError` where no cluster answers or one of its
    workers has another version than this machine.
    """
    if dask is None:
        return nullcontext(Threads(threads))
    where = parse_cluster(dask)
    # Imported only when asked for: it takes a second, and most builds need none.
    from ground_station.mapping.construction.cluster import connected

    return connected(where, settings)
