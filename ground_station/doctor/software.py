"""Checks of what is installed: Python, the locked packages, GStreamer and an encoder that works."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ground_station.doctor import ROOT
from ground_station.doctor.findings import OK, Finding, ok, problem, warning

_OLDEST = (3, 11)
_IMPORT_S = 60.0
# An installed release has no Makefile of its own.
_SETUP = "make setup" if (ROOT / "Makefile").exists() else "make install-service, in a checkout"
# zlib and cv2 come before pycolmap, whose wheel brings zlib symbols of its own.
_FIRST = ("zlib", "cv2")
_TRY = """
import importlib, sys
for name in sys.argv[1:]:
    print("try", name, flush=True)
    try:
        importlib.import_module(name)
    except BaseException as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())
        print(f"bad {name} ({why})", flush=True)
print("done", flush=True)
"""
_ELEMENTS = {
    # What the payload's program needs on this machine, for --demo and replay.
    "appsrc": "gstreamer1.0-plugins-base",
    "videotestsrc": "gstreamer1.0-plugins-base",
    "appsink": "gstreamer1.0-plugins-base",
    "videoconvert": "gstreamer1.0-plugins-base",
    "rtph264pay": "gstreamer1.0-plugins-good",
    "udpsink": "gstreamer1.0-plugins-good",
    "h264parse": "gstreamer1.0-plugins-bad",
    "srtpenc": "gstreamer1.0-plugins-bad",
    "x264enc": "gstreamer1.0-plugins-ugly",
}
_FRAMES, _SIZE = 10, (320, 240)
_ENCODE_NS = 8_000_000_000


def python() -> Finding:
    """The interpreter is one that the lock resolves for."""
    found = f"{sys.version.split()[0]} in {sys.prefix}"
    if sys.version_info < _OLDEST:
        return problem("python", found, f"Python 3.11 or newer is needed; then {_SETUP}")
    return ok("python", found)


def packages(root: Path) -> Finding:
    """What the programs need is installed in the version that `requirements.lock` names."""
    from packaging.utils import canonicalize_name

    from ground_station.doctor import locked

    try:
        lock = locked.versions((root / "requirements.lock").read_text())
        direct = locked.direct((root / "pyproject.toml").read_text())
    except OSError as error:
        said = f"{error.filename}: {error.strerror}"
        return warning("packages", said, f"run the doctor from a checkout, or {_SETUP}")
    installed = {name: _version(name) for name in locked.closure(direct) if name in lock}
    missing = sorted(name for name, version in installed.items() if version is None)
    other = sorted(
        f"{name} {version}, locked {lock[name]}"
        for name, version in installed.items()
        if version is not None and version != lock[name]
    )
    if missing:
        return problem("packages", f"missing: {_some(missing)}", _SETUP)
    names = set(locked.modules(canonicalize_name(need.name) for need in direct))
    # pylab looks for a display.
    if broken := imports([*_FIRST, *sorted(names - {*_FIRST, "pylab"})]):
        return problem("packages", f"cannot be imported: {_some(broken)}", _SETUP)
    if other:
        return warning("packages", f"other than locked: {_some(other)}", _SETUP)
    return ok("packages", f"{len(installed)} as locked, and importable")


def imports(names: Sequence[str]) -> list[str]:
    """Imports modules in a process of their own; those that fail, with why, one line each.

    One that takes the process down (a library for another processor does) is named, too, and the
    ones after it are tried in the next process.
    """
    left, bad = list(names), []
    while left:
        try:
            run = subprocess.run(
                [sys.executable, "-c", _TRY, *left],
                capture_output=True,
                text=True,
                timeout=_IMPORT_S,
            )
            said, died = run.stdout, f"ends the program with status {run.returncode}"
        except subprocess.TimeoutExpired as error:
            said = error.stdout.decode() if isinstance(error.stdout, bytes) else ""
            died = f"takes longer than {_IMPORT_S:g} s"
        lines = said.splitlines()
        bad += [line.removeprefix("bad ") for line in lines if line.startswith("bad ")]
        if lines[-1:] == ["done"]:
            break
        tried = [line.split()[1] for line in lines if line.startswith("try ")]
        if not tried:
            return [*bad, f"{left[0]} ({died})"]
        bad.append(f"{tried[-1]} ({died})")
        left = left[len(tried) :]
    return bad


def video() -> Iterator[Finding]:
    """GStreamer and then its encoder, one after the other: it is not initialised twice at once."""
    found = gstreamer()
    yield found
    if found.level == OK:
        yield encoder()


def gstreamer() -> Finding:
    """The elements that the payload's program uses on this machine for the demo and replays."""
    try:
        gst = _gst()
    except (ImportError, ValueError) as error:
        fix = "sudo apt-get install gir1.2-gstreamer-1.0 gir1.2-gst-plugins-base-1.0"
        return problem("gstreamer", f"cannot be loaded: {error}", fix)
    found = {name: gst.ElementFactory.find(name) is not None for name in _ELEMENTS}
    version = ".".join(map(str, gst.version()[:3]))
    if missing := [name for name, there in found.items() if not there]:
        needed = sorted({_ELEMENTS[name] for name in missing})
        return problem(
            "gstreamer",
            f"{version} lacks {', '.join(missing)}",
            f"sudo apt-get install {' '.join(needed)}",
        )
    return ok("gstreamer", f"{version} with all {len(found)} elements")


def encoder() -> Finding:
    """Ten frames through x264 and the decoder that the service uses, and none is lost."""
    units = _encode()
    pictures = _decode(units)
    if len(pictures) == _FRAMES and all(size == _SIZE for size in pictures):
        kilobytes = sum(map(len, units)) / 1000
        return ok("encoder", f"{_FRAMES} frames encoded by x264 and decoded, {kilobytes:.1f} kB")
    return problem(
        "encoder",
        f"of {_FRAMES} frames {len(units)} left x264 and {len(pictures)} the decoder",
        "sudo apt-get install --reinstall gstreamer1.0-plugins-ugly",
    )


def _encode() -> list[bytes]:
    gst = _gst()
    pipeline = gst.parse_launch(
        f"videotestsrc num-buffers={_FRAMES} ! "
        f"video/x-raw,format=I420,width={_SIZE[0]},height={_SIZE[1]},framerate=30/1 ! "
        "x264enc tune=zerolatency speed-preset=veryfast bframes=0 threads=1 ! "
        "video/x-h264,stream-format=byte-stream,alignment=au ! appsink name=out sync=false"
    )
    out, units = pipeline.get_by_name("out"), []
    try:
        pipeline.set_state(gst.State.PLAYING)
        while (sample := out.emit("try-pull-sample", _ENCODE_NS)) is not None:
            buffer = sample.get_buffer()
            units.append(buffer.extract_dup(0, buffer.get_size()))
    finally:
        pipeline.set_state(gst.State.NULL)
    return units


def _decode(units: Sequence[bytes]) -> list[tuple[int, int]]:
    import av

    codec = av.CodecContext.create("h264", "r")
    assert isinstance(codec, av.VideoCodecContext)
    packets = [*map(av.Packet, units), None]
    return [(p.width, p.height) for packet in packets for p in codec.decode(packet)]


def _gst() -> Any:
    import gi

    gi.require_version("Gst", "1.0")
    from gi.repository import Gst

    if not Gst.is_initialized():
        Gst.init(None)
    return Gst


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _some(names: Sequence[str], most: int = 4) -> str:
    """The first few, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
