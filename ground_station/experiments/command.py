"""`blimp experiments`: the thesis's experiments and further ones, with exact truth."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLE = """\
examples:
  blimp experiments                       all of them; stopped and started again it goes on
  blimp experiments illumination motion   some of them
  blimp experiments --quick               one seed, the ends of each table: to see that all works
  blimp experiments illumination redkitchen --features wren mine    your features beside ours
  blimp experiments --list

What is flown stands in experiments.toml beside this command's module; --file takes another. Flights
are simulated once and kept in the folder of --out, as are maps and runs, under what they depend on:
after a change only what it touches is made again."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EXAMPLE
    parser.set_defaults(next="blimp experiments --list    (what else there is)")
    add = parser.add_argument
    add("names", nargs="*", metavar="NAME", help="experiments (default: all)")
    add("--list", action="store_true", help="say which there are, and nothing else")
    add("--file", type=Path, metavar="TOML", help="experiments (default: the shipped)")
    add("--quick", action="store_true", help="one seed, the ends of each table, short flights")
    add("--features", nargs="+", metavar="NAME",
        help="extractors or models for the maps (default: as each row says)")  # fmt: skip
    add("--jobs", type=int, default=0, metavar="N", help="side by side (0: one a core)")
    add("--dask", metavar="ADDRESS",
        help="tcp://HOST:PORT, tls://HOST:PORT: by a cluster whose workers share --out and --data"
    )  # fmt: skip
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR",
        help="folder of real video, redkitchen/ (../shared/data)")  # fmt: skip
    add("--sample", type=Path, default=Path("maps/atrium"), metavar="DIR",
        help="the sample map, for its settings and floor plan (maps/atrium)")  # fmt: skip
    add("--out", type=Path, default=Path("out/experiments"), metavar="DIR",
        help="for the report and all that is kept (out/experiments)")  # fmt: skip
    add("--accept", type=Path, metavar="README.md",
        help="put the table of this run between that file's markers")  # fmt: skip
    add("--json", type=Path, metavar="F", help="write results.json there, too")


def run(args: argparse.Namespace) -> int:
    """Flies, maps, localizes, reports; 1 where the default is worse, or a claim not kept.

    Raises `BlimpError` for what a person can fix. Real video that is not there is left out with
    a line, unless it was asked for by name.
    """
    import sys
    from dataclasses import replace

    from ground_station.bench.machine import machine
    from ground_station.errors import InputError, check_options
    from ground_station.experiments import (
        declaration,
        plan,
        report,
        schedule,
        summary,
        tables,
    )
    from ground_station.experiments.store import Store
    from ground_station.files import write_json
    from ground_station.mapping.construction.dask_option import parse_cluster
    from ground_station.mapping.settings import load_settings

    check_options(args, jobs=(0, 256))
    declared = declaration.load(args.file or declaration.SHIPPED, args.names or None)
    if args.features:
        if args.accept:
            raise InputError("--accept is for the rows as they are declared, without --features")
        declared = declaration.with_features(declared, args.features)
    if args.list:
        for experiment in declared.experiments:
            print(f"{experiment.name:16} {experiment.title} ({len(experiment.cases)} rows)")
        return 0
    if not args.names:
        declared, missing = declaration.without_missing(declared, args.data)
        for line in missing:
            print(f"blimp experiments: left out: {line}", file=sys.stderr, flush=True)
    if args.quick:
        declared = declaration.shortened(declared)
    toml = args.sample / "mapping.toml"
    mapping = load_settings(toml if toml.is_file() else None)
    # The order of sums over several threads is left to chance, and maps of few or doubtful matches
    # come out otherwise then; the cores are busy with other jobs anyway.
    mapping = replace(mapping, threads=1)
    store = Store(args.out)
    jobs = parse_cluster(args.dask) if args.dask else args.jobs or machine()["cores"]
    planned = plan.make(declared, mapping, args.data)
    schedule.carry_out(planned, store, args.data, jobs)
    about = {"machine": machine(), "jobs": jobs, "quick": args.quick}
    document = summary.summarise(declared, planned, store, about)
    floorplan = args.sample / "floorplan.yaml"
    report.write(document, args.out, floorplan if floorplan.is_file() else None)
    if args.json:
        write_json(args.json, document)
    if args.accept:
        report.accept(document, args.accept, declaration.SHIPPED.with_name(report.ACCEPTED))
    for experiment in document["experiments"]:
        print(tables.text(experiment), end="\n\n")
    print(document["conditions"])
    print(tables.verdict(document))
    for line in document["worse"]:
        print(f"  {line}")
    for claim in document["claims"]:
        if claim["kept"] is not False:  # the others stand in the verdict
            print(summary.claim_line(claim))
    print(f"{args.out / 'report.html'}\n{args.out / 'results.json'}\n{args.out / 'results.md'}")
    return 0 if report.good(document) else 1
