"""`blimp map register`: arguments and what it prints. Heavy modules are imported when it runs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ground_station.errors import MapError
from ground_station.files import write_json
from ground_station.map.table import print_table

if TYPE_CHECKING:
    from ground_station.mapping.registration.registration import Registration

HELP = "Takes a map to world coordinates."

EXAMPLE = """\
examples:
  blimp map register maps/hall --page --plan floorplan.png   # click places in a browser
  blimp map register maps/hall --picks maps/hall/PICKS.toml  # the same picks again
  blimp map register maps/atrium --pairs maps/atrium/PAIRS.csv
  blimp map register maps/hall --tags TAGS.toml --frames walk.mcap
  blimp map register maps/kitchen --trajectory truth.txt
  blimp map register maps/hall --pairs PAIRS.csv --distances DISTANCES.csv

PAIRS.csv: point,image,u_px,v_px,x_m,y_m,z_m; one line for each observation of a known point, at
least two images a point and three points that are not on one line.
TAGS.toml: family = "36h11", size_m = 0.16 (side of the black square) and for each tag [[tag]],
id = 7 and centre_m = [x, y, z]; for an upright tag on a wall also facing_deg, the heading into
which it looks; or instead corners_m, four of them, from the top left, clockwise.
DISTANCES.csv: distance,end,image,u_px,v_px,length_m[,sigma_m]; end is a or b, at least two
images an end. They give the scale and no more: alone, the map is in metres and in no world."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `blimp map register`."""
    parser.set_defaults(next="blimp serve --lan --map {map}")
    parser.add_argument("map", metavar="MAP", help="folder of the map")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--page", action="store_true", help="pick places in a browser")
    source.add_argument("--picks", metavar="TOML", help="picks that were made on the page")
    source.add_argument("--pairs", metavar="CSV", help="observations of known points")
    source.add_argument("--tags", metavar="TOML", help="AprilTags of known place; needs --frames")
    source.add_argument("--trajectory", metavar="TUM", help="true poses at the keyframes' times")
    parser.add_argument("--distances", metavar="CSV", help="known distances: the scale, or more")
    parser.add_argument(
        "--frames", metavar="INPUT", nargs="+", help="what the map was built from, for --tags"
    )
    parser.add_argument("--plan", metavar="FILE", help="floor plan (default: the map's own)")
    parser.add_argument("--plan-resolution-m", type=float, help="of a pixel of a plan's picture")
    parser.add_argument("--port", type=int, default=0, help="of the page (default: a free one)")
    parser.add_argument("--no-browser", action="store_true", help="only print the page's address")
    parser.add_argument("--seed", type=int, default=0, help="of the robust fit (default 0)")
    parser.add_argument("--json", metavar="FILE", help="write what was measured, too")


def run(args: argparse.Namespace) -> int:
    """Registers; raises `BlimpError` for what a person can fix."""
    if args.seed < 0:
        raise MapError(f"--seed is {args.seed}; allowed: 0 or more")
    _check(args)
    if args.page:
        from ground_station.mapping.registration.page.serve import serve

        found = serve(
            Path(args.map),
            plan=args.plan,
            resolution_m=args.plan_resolution_m,
            distances=_distances(args),
            port=args.port,
            browser=not args.no_browser,
            seed=args.seed,
        )
        if found is None:
            print("nothing was saved")
            args.next = ""
            return 0
    else:
        found = _register(args)
    for note in found.notes:
        print(f"note: {note}", file=sys.stderr)
    _print(found.report)
    if args.json:
        write_json(args.json, found.report)
    return 0


def _check(args: argparse.Namespace) -> None:
    sources = ("page", "picks", "pairs", "tags", "trajectory", "distances")
    if not any(getattr(args, name) for name in sources):
        raise MapError(f"one of {', '.join('--' + name for name in sources)} is needed")
    for name, of in (("frames", "tags"), ("plan", "page"), ("plan_resolution_m", "page")):
        if getattr(args, name) is not None and not getattr(args, of):
            raise MapError(f"--{name.replace('_', '-')} goes with --{of}")
    if args.tags and not args.frames:
        raise MapError("--tags needs --frames: what the map was built from")
    if not 0 <= args.port <= 65535:
        raise MapError(f"--port is {args.port}; allowed: 0 to 65535")


def _distances(args: argparse.Namespace) -> Any:
    from ground_station.mapping.registration.distances import read_distances

    return read_distances(args.distances) if args.distances else None


def _register(args: argparse.Namespace) -> Registration:
    from ground_station.geometry.trajectory import read_tum
    from ground_station.mapping.registration.observations import read_pairs
    from ground_station.mapping.registration.picks import read_picks
    from ground_station.mapping.registration.register import register_map

    given: dict[str, Any] = {"distances": _distances(args)}
    notes: list[str] = []
    if args.pairs:
        given["observations"] = read_pairs(args.pairs)
    elif args.trajectory:
        given["trajectory"] = read_tum(args.trajectory)
    elif args.picks:
        given["picks"] = read_picks(args.picks)
    elif args.tags:
        seen = _seen_tags(args)
        given["observations"], notes = seen.observations, seen.notes
    files = (args.pairs, args.trajectory, args.picks, args.tags, args.distances)
    source = ", ".join(Path(file).name for file in files if file)
    _, found = register_map(args.map, source=source, seed=args.seed, **given)
    found.notes[:0] = notes
    return found


def _seen_tags(args: argparse.Namespace) -> Any:
    from ground_station.map import store
    from ground_station.mapping.registration.tags import find_tags, read_tags
    from ground_station.progress import Progress
    from ground_station.recording.open import open_input

    tags, map_ = read_tags(args.tags), store.load(args.map)
    given = map_.info.built.get("rate_hz")
    rate_hz = None if given is None else float(given)
    sources = [open_input(path, rate_hz) for path in args.frames]
    counts = [source.count() for source in sources]
    total = None if None in counts else sum(count or 0 for count in counts)
    many = len(sources) > 1

    with Progress("look for tags, frames", total) as progress:

        def frames() -> Any:
            import dataclasses

            for path, source in zip(args.frames, sources, strict=True):
                stem = Path(path).resolve().stem
                for frame in source:
                    progress.step()
                    # Of several inputs, images are called by the input's name, too.
                    yield dataclasses.replace(frame, name=f"{stem}/{frame.name}") if many else frame

        return find_tags(map_, tags, frames(), [Path(path).resolve().stem for path in args.frames])


_LONG = ("rotation", "translation_m", "point_names", "centre_m", "corner_m")


def _print(report: dict[str, Any]) -> None:
    print_table(
        {
            name: value
            for name, value in report.items()
            if name not in _LONG
            and not name.startswith("covariance")
            and (not name.startswith("point_") or name == "point_sigma_m")
        }
    )
    if "centre_sigma_m" in report:
        print()
        for name, words in (("centre", "the middle of the map"), ("corner", "its worst corner")):
            print(
                f"expected error at {words}: {100 * report[f'{name}_sigma_m']:.1f} cm (one sigma), "
                f"within {100 * report[f'{name}_90_percent_m']:.1f} cm in 90 %"
            )
    if report.get("point_names"):
        held = report.get("point_held_out_m", [])
        print(f"\n{'point':<24} {'residual_m':>10}" + (f" {'held out_m':>10}" if held else ""))
        for k, (name, residual) in enumerate(
            zip(report["point_names"], report["point_residual_m"], strict=True)
        ):
            most = "  disagrees most" if name == report.get("disagrees_most") else ""
            print(f"{name:<24} {residual:>10.4f}" + (f" {held[k]:>10.4f}{most}" if held else ""))
