"""`blimp models list|import|quantize|info`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ground_station.errors import check_options
from ground_station.files import write_json

if TYPE_CHECKING:
    from ground_station.feature_models.quantize import Comparison
    from ground_station.features.model_info import Model

_SIZE_PX = (640, 480)

_LIST_EXAMPLE = """\
example:
  blimp models list --json out/models.json"""
_IMPORT_EXAMPLE = """\
examples:
  blimp models import superpoint_v1.pth
  blimp models import alike-n.safetensors --name alike
  blimp map build flight.mcap --features superpoint --out maps/atrium

Known are SuperPoint (Magic Leap's file and the layout of its PyTorch port) and ALIKE, in files of
torch.save and safetensors. Nothing in a file is executed. Models lie in $BLIMP_MODELS, else in
~/.local/share/blimp/models."""
_QUANTIZE_EXAMPLE = """\
examples:
  blimp models quantize superpoint --calibrate flight.mcap
  blimp models quantize superpoint --calibrate frames/ --name superpoint-small

Of the frames every second calibrates; with the others and warps of them the accuracy is measured:
the share of mutual nearest matches within 3 px. The new model is another one by name and sha256,
and so needs maps of its own."""
_INFO_EXAMPLE = """\
example:
  blimp models info superpoint"""


def add_arguments(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the sub-commands to those of `blimp models`."""

    def add(name: str, text: str, epilog: str, after: str) -> argparse.ArgumentParser:
        made = commands.add_parser(
            name,
            help=text[0].lower() + text[1:].rstrip("."),
            description=text,
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        made.set_defaults(next=after)
        made.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON, too")
        return made

    add("list", "Lists the models that there are.", _LIST_EXAMPLE, "blimp models info NAME")
    bring = add("import", "Turns weights into a model.", _IMPORT_EXAMPLE, "blimp models list")
    bring.add_argument("weights", metavar="FILE", help=".pth of torch.save, or .safetensors")
    bring.add_argument("--name", help="of the model (default: the network's)")
    bring.add_argument("--licence", help="of the weights (default: the one of those published)")
    small = add(
        "quantize", "Makes a model smaller and faster: int8.", _QUANTIZE_EXAMPLE,
        "blimp bench features",
    )  # fmt: skip
    small.add_argument("model", metavar="NAME", help="an fp32 model, see `blimp models list`")
    small.add_argument(
        "--calibrate", required=True, metavar="INPUT", help="recording, video or folder of images"
    )
    small.add_argument("--name", help="of the new model (default: NAME-int8)")
    small.add_argument("--range", metavar="A:B[:S]", help="frames A up to B, every S-th")
    small.add_argument("--rate-hz", type=float, help="of a folder (default 30)")
    small.add_argument("--frames", type=int, default=32, help="taken, evenly over it (default 32)")
    small.add_argument("--threads", type=int, default=1, help="for the time (default 1)")
    small.add_argument("--seed", type=int, default=1, help="of the warps (default 1)")
    info = add(
        "info",
        "Tells what a model is.",
        _INFO_EXAMPLE,
        "blimp map build INPUT --features {model} --out maps/NAME",
    )
    info.add_argument("model", metavar="NAME", help="see `blimp models list`")


def run(args: argparse.Namespace) -> int:
    """Runs one of them; returns the exit status."""
    document = {
        "list": _list,
        "import": _import,
        "quantize": _quantize,
        "info": _info,
    }[args.models_command](args)
    if args.json:
        write_json(args.json, document)
    return 0


def _list(_: argparse.Namespace) -> dict[str, Any]:
    from ground_station.features import catalogue, extractors
    from ground_station.features.extractor import FeatureError
    from ground_station.presentation.text import columns

    models, broken = [], {}
    for name in catalogue.names():
        try:
            models.append(_described(catalogue.find(name)))
        except FeatureError as error:
            broken[name] = str(error)
    rows = [["name", "layout", "dim", "MB", "GMAC", "sha256", "where"]]
    for each in models:
        where = "shipped" if each["shipped"] else each["file"]
        size, cost = f"{each['bytes'] / 1e6:.2f}", f"{each['gmac_640x480']:.2f}"
        dimension, sha256 = str(each["dimension"]), each["sha256"][:12]
        rows.append([each["name"], each["layout"], dimension, size, cost, sha256, where])
    print("\n".join([*columns(rows), *(f"{name}: {why}" for name, why in broken.items())]))
    methods = sorted(set(extractors.names()) - set(catalogue.names()))
    print(f"methods without a model: {', '.join(methods)}")
    return {"models": models, "unreadable": broken, "methods": methods}


def _info(args: argparse.Namespace) -> dict[str, Any]:
    from ground_station.features import catalogue

    described = _described(catalogue.find(args.model))
    for key, value in described.items():
        print(f"{key:<14}{'-' if value is None else value}")
    return described


def _import(args: argparse.Namespace) -> dict[str, Any]:
    from ground_station.feature_models.importer import import_weights

    described = _described(import_weights(args.weights, args.name, args.licence))
    print(f"{described['name']}: {described['source']}")
    print(f"licence: {described['licence']}")
    print(f"written: {described['file']}")
    return described


def _quantize(args: argparse.Namespace) -> dict[str, Any]:
    import hashlib

    from ground_station.feature_models import importer, quantize
    from ground_station.features import catalogue, extractors
    from ground_station.features.extractor import FeatureError
    from ground_station.features.model_info import Model
    from ground_station.recording.open import open_input, parse_range

    check_options(args, frames=(4, 512), threads=(1, 64), seed=(0, 2**32 - 1))
    name = args.name or f"{args.model}-int8"
    extractors.check_free(name)
    if name in catalogue.names():
        raise FeatureError(f"there is a model '{name}' already; choose another --name")
    reference = catalogue.find(args.model)
    quantize.check(reference)
    wanted = parse_range(args.range) if args.range else None
    images = quantize.evenly(open_input(args.calibrate, args.rate_hz, wanted), args.frames)
    if len(images) < 2:
        raise FeatureError(f"{args.calibrate}: {len(images)} frames; at least 2 are needed")
    data, info = quantize.int8(reference, images[::2], name)
    made = Model(catalogue.path_for(name), info, data, hashlib.sha256(data).hexdigest())
    result = quantize.compare(reference, made, images[1::2], args.threads, args.seed)
    described = _described(importer.add(data, info))
    _print_comparison(reference, made, result, args.threads)
    return {"model": described, "reference": args.model, **_document(result, args)}


def _print_comparison(reference: Model, made: Model, result: Comparison, threads: int) -> None:
    from ground_station.presentation.text import columns

    gain = 100 * (result.variant.accuracy - result.reference.accuracy)
    height, width = result.shape
    rows = [["", "accuracy at 3 px", "correct", "matches", "ms", "MB"]]
    for model, found, ms in (
        (reference, result.reference, result.reference_ms),
        (made, result.variant, result.variant_ms),
    ):
        size = f"{len(model.data) / 1e6:.2f}"
        counts = str(found.correct), str(found.matches)
        rows.append([model.info.name, f"{found.accuracy:.3f}", *counts, f"{ms:.1f}", size])
    print(
        *columns(rows),
        f"matching accuracy {gain:+.1f} points over {result.pairs} pairs; "
        f"time of the network: {result.time_ratio:.2f} at {width}x{height}, threads: {threads}",
        f"written: {made.path}",
        sep="\n",
    )


def _document(result: Comparison, args: argparse.Namespace) -> dict[str, Any]:
    document: dict[str, Any] = {
        "pairs": result.pairs,
        "seed": args.seed,
        "threads": args.threads,
        "image_px": list(result.shape[::-1]),
        "time_ratio": result.time_ratio,
    }
    rows = (("fp32", result.reference, result.reference_ms),
            ("int8", result.variant, result.variant_ms))  # fmt: skip
    for key, matching, ms in rows:
        document[key] = {
            "accuracy_3px": matching.accuracy,
            "correct": matching.correct,
            "matches": matching.matches,
            "network_ms": ms,
        }
    return document


def _described(model: Model) -> dict[str, Any]:
    from ground_station.features import catalogue, inspection

    info = model.info
    return {
        "name": info.name,
        "sha256": model.sha256,
        "layout": info.layout,
        "dimension": info.dimension,
        "multiple": info.multiple,
        "nms_px": info.nms_px,
        "threshold": info.threshold,
        "subpixel_px": info.subpixel_px,
        "distance_scale": info.distance_scale,
        "bytes": len(model.data),
        "gmac_640x480": inspection.macs(model.data, info, *_SIZE_PX) / 1e9,
        "licence": info.licence,
        "source": info.source,
        "file": str(model.path),
        "shipped": model.path.parent == catalogue.SHIPPED,
    }
