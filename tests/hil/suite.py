"""Flies recorded streams through payload, link and ground station, and judges: `make hil`.

Each case of `cases/` (TOML) names a recording, a map, a link, a truth and bounds. Results go to
OUT: a folder a case, `junit.xml`, `suite.json` and the page `index.html`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HIL = Path(__file__).resolve().parent
CHECKOUT = HIL.parents[1]
CASES = HIL / "cases"
_EPILOG = """\
examples:
  python tests/hil/suite.py                                the firmware on this machine
  python tests/hil/suite.py outage --against out/hil-before
  python tests/hil/suite.py --payload image                the card image in the emulator
  python tests/hil/suite.py --payload ssh:pilot@blimp-1    a real board

The exit status is 1 when a bound is missed or a case could not be flown, 2 for bad input."""


def parser() -> argparse.ArgumentParser:
    """The program's arguments."""
    made = argparse.ArgumentParser(
        prog="python tests/hil/suite.py",
        description="Flies the replay tests and judges them.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument(
        "cases", nargs="*", metavar="CASE", help="names in cases/, or files (default: all)"
    )
    made.add_argument(
        "--payload", default="process", metavar="KIND",
        help="process, image, or ssh:user@host[:port] (default: process)",
    )  # fmt: skip
    made.add_argument("--out", type=Path, default=Path("out/hil"), metavar="DIR")
    made.add_argument(
        "--against", type=Path, metavar="DIR", help="an earlier OUT, shown beside on the page"
    )
    made.add_argument("--list", action="store_true", help="shows the cases and flies none")
    image = made.add_argument_group("image")
    image.add_argument("--image", type=Path, metavar="FILE", help="default: out/image")
    ssh = made.add_argument_group("ssh")
    ssh.add_argument("--identity", type=Path, metavar="FILE", help="your SSH key (default: SSH's)")
    ssh.add_argument(
        "--known-hosts", type=Path, metavar="FILE", help="host keys (default: SSH's own files)"
    )
    ssh.add_argument("--ssh-config", type=Path, metavar="FILE", help="default: SSH's own")
    ssh.add_argument(
        "--keys", type=Path, metavar="DIR", help="the folder of `blimp keys` (default: its own)"
    )
    ssh.add_argument("--ground", default="main", metavar="NAME", help="whose keys there are ours")
    ssh.add_argument("--ground-host", metavar="HOST", help="our address as the board sees it")
    ssh.add_argument("--video-port", type=int, default=5600, metavar="PORT")
    ssh.add_argument("--telemetry-port", type=int, default=7447, metavar="PORT")
    ssh.add_argument(
        "--folder", default="blimp", metavar="DIR",
        help="where pi_firmware is on a machine that is no card",
    )  # fmt: skip
    ssh.add_argument("--python", default="python3", metavar="PROGRAM", help="the same one's Python")
    return made


def run(args: argparse.Namespace) -> int:
    """Flies what is asked for; 0 when all bounds hold, 1 when not. Raises `BlimpError`."""
    from ground_station.errors import InputError

    cases = chosen(args.cases)
    if args.list:
        for case in cases:
            print(f"{case.name:24} {case.link.kind:10} {case.title}")
        return 0
    against = args.against
    if against is not None and against.resolve() == args.out.resolve():
        raise InputError(f"--against {against}: is --out, too; give another one")
    from datetime import UTC, datetime

    began = datetime.now(UTC).isoformat(timespec="seconds")
    done: list[Any] = []
    stopped = False
    with contextlib.ExitStack() as stack:
        try:
            payload = stack.enter_context(make(args))
            print(payload.describe(), flush=True)
            for case in cases:
                done.append(_flown(case, payload, args.out))
        except KeyboardInterrupt:
            stopped = True
        finally:
            # What was flown is written before a board is taken down, which may take long.
            if done:
                _write(args, done, began, payload.describe())
    if stopped:
        print(f"hil: stopped; {len(done)} of {len(cases)} cases were flown", file=sys.stderr)
        return 1
    return 0 if all(case.passed for case in done) else 1


def chosen(names: Sequence[str]) -> list[Any]:
    """The cases by name or file, loaded, all of them before any is flown. Raises `BlimpError`."""
    from ground_station.errors import InputError
    from ground_station.replay.cases.case import load_case

    paths = [_case_file(name) for name in names] or sorted(CASES.glob("*.toml"))
    cases = [load_case(path) for path in paths]
    seen: set[str] = set()
    for case in cases:
        if case.name in seen:
            raise InputError(f"{case.path}: a second case '{case.name}'; results would overwrite")
        seen.add(case.name)
    return cases


def _case_file(name: str) -> Path:
    from ground_station.errors import InputError

    if name.endswith(".toml"):
        return Path(name)
    path = CASES / f"{name}.toml"
    if "/" in name or not path.is_file():
        known = ", ".join(sorted(path.stem for path in CASES.glob("*.toml")))
        raise InputError(f"{name[:60]!r}: no such case; there are {known}")
    return path


def make(args: argparse.Namespace) -> Any:
    """The payload that is asked for. Raises `BlimpError` with one line."""
    from ground_station.errors import InputError

    kind, colon, rest = args.payload.partition(":")
    if args.payload == "process":
        from payloads.process import ProcessPayload

        return ProcessPayload()
    if args.payload == "image":
        from payloads import image

        return image.ImagePayload(args.image or image.IMAGE)
    if kind != "ssh" or not colon:
        raise InputError(
            f"--payload is {args.payload[:60]!r}; allowed: process, image, ssh:user@host[:port]"
        )
    from payloads.ssh import Plain, SshPayload
    from payloads.target import Target

    for option in ("video_port", "telemetry_port"):
        port = getattr(args, option)
        if not 0 <= port < 65536:
            raise InputError(f"--{option.replace('_', '-')} is {port}; allowed: 0 to 65535")
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share"
    return SshPayload(
        Target.parse(
            rest, identity=args.identity, known_hosts=args.known_hosts, ssh_config=args.ssh_config
        ),
        keys=args.keys or Path(data) / "blimp" / "keys",
        ground=args.ground,
        plain=Plain(args.folder, args.python),
        ground_host=args.ground_host,
        video_port=args.video_port,
        telemetry_port=args.telemetry_port,
    )


def _flown(case: Any, payload: Any, out: Path) -> Any:
    from flown import fly

    print(f"{case.name}: {case.title}", flush=True)
    done = fly(case, payload, out / case.name)
    for note in done.notes[1:]:
        print(f"  {note}")
    if done.outcome is not None and done.outcome.run.link_counts:
        counts = done.outcome.run.link_counts
        print("  packets: " + ", ".join(f"{n} {name}" for name, n in counts.items()))
    for row in done.missed:
        from junit import told

        print(f"  MISSED {told(row)}")
    print(f"  {_state(done)}", flush=True)
    return done


def _state(done: Any) -> str:
    if done.skipped:
        return f"skipped: {done.skipped}"
    if done.error:
        return f"ERROR: {done.error}"
    asked = sum(row.holds is not None for row in done.rows)
    held = asked - len(done.missed)
    return f"{'ok' if done.passed else 'FAILED'}: {held} of {asked} hold, {done.seconds:.0f} s"


def _write(args: argparse.Namespace, done: list[Any], began: str, payload: str) -> None:
    """JUnit, JSON, the page and the table; runs of `--against` are shown beside."""
    import junit

    from ground_station.replay.cases import page
    from ground_station.replay.cases.compare import compare
    from ground_station.replay.cases.outcome import read_outcome
    from pi_firmware.wire.errors import BlimpError

    out = args.out
    out.mkdir(parents=True, exist_ok=True)
    comparisons = {}
    for case in done:
        earlier = args.against / case.name if args.against is not None else None
        if earlier is not None and case.outcome is not None and earlier.is_dir():
            try:
                comparisons[case.name] = compare(read_outcome(earlier), case.outcome)
            except BlimpError as error:
                print(f"hil: {case.name} is not compared: {error}", file=sys.stderr)
    junit.write_junit(out / "junit.xml", "hil", done, began=began)
    host = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the end"
    junit.write_suite_json(out / "suite.json", "hil", done, began=began, payload=payload, host=host)
    page.write_suite(
        out / "index.html", f"Replay tests: {payload}", done, began=began, comparisons=comparisons
    )
    print(table(done))
    print(f"\n{out / 'index.html'}", flush=True)


def table(done: Sequence[Any]) -> str:
    """One line a case, with the figures that a pilot looks at."""
    from ground_station.presentation.text import columns

    head = ("case", "result", "coverage", "TRACKING", "position", "lost", "p50", "recovery", "took")
    names = ("coverage", "tracking", "position_rmse_m", "lost", "latency_p50_ms", "recovery_s")
    lines = [head]
    for case in done:
        figures = {row.name: row.measured for row in case.rows if row.value is not None}
        found = [_figure(figures, name) for name in names]
        result = "skipped" if case.skipped else "ok" if case.passed else "FAILED"
        lines.append((case.name, result, *found, f"{case.seconds:.0f} s"))
    return "\n".join(columns(lines))


def _figure(figures: dict[str, str], name: str) -> str:
    """A figure's text, judged or not: a bound's row has its name with a suffix."""
    for candidate in (name, f"{name}_max", f"{name}_min"):
        if candidate in figures:
            return figures[candidate].removesuffix(" share")
    return "—"


def main(arguments: Sequence[str] | None = None) -> int:
    """Status 0, 1 or 2 as the help says."""
    args = parser().parse_args(arguments)
    for folder in (CHECKOUT, HIL):
        if str(folder) not in sys.path:
            sys.path.insert(0, str(folder))
    from deploy.errors import DeployError
    from pi_firmware.wire.errors import BlimpError

    # As Ctrl-C: a board must be left as it was found.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return run(args)
    except (BlimpError, DeployError, OSError) as error:
        print(f"hil: {str(error).strip().splitlines()[0]}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("hil: stopped", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
