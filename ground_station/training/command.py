"""`blimp models train`: the whole recipe, from nothing to the model's file."""

from __future__ import annotations

import argparse
import os
from dataclasses import fields, replace
from pathlib import Path

from ground_station.errors import check_options
from ground_station.training.errors import TrainingError

_EXAMPLE = """\
Example: blimp models train
         blimp models train --resume
         blimp models train --out out/training/final --decay-from \\
             out/training/lark/checkpoints/step-0002000.safetensors

         blimp models train --device cpu --batch 8 --rate 0.0015 --fresh 1

All pictures are made by code; there is no teacher. A killed run goes on with --resume where its
last checkpoint stands. Torch is needed: .venv/bin/pip install torch."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of the command; imports nothing heavy."""
    parser.epilog = _EXAMPLE
    parser.set_defaults(next="blimp models list")
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--out", type=Path, help="folder of the run (out/training/lark)")
    parser.add_argument("--resume", action="store_true", help="go on where this folder stands")
    parser.add_argument(
        "--decay-from", type=Path, metavar="CHECKPOINT", help="end another run from here"
    )
    parser.add_argument("--corpus", type=Path, help="folder of the pictures (out/training/corpus)")
    parser.add_argument("--seed", type=int, help="of pictures, weights and pairs (1)")
    for name, text in (
        ("textures", "pictures without a room that there are at one time"),
        ("fresh", "new ones a step"),
        ("rooms", "rooms in the corpus"),
        ("batch", "pairs a step"),
        ("steps", "length of the run"),
        ("decay", "last steps, over which the rate goes to nought"),
    ):
        parser.add_argument(f"--{name}", type=int, help=f"{text} (the recipe's)")
    parser.add_argument("--rate", type=float, help="step size (the recipe's)")
    parser.add_argument("--device", default="auto", help="auto (default), cpu or cuda")
    parser.add_argument(
        "--precision", default="auto",
        help="auto (default: bfloat16 on a GPU), float32 or bfloat16, which some CPUs have",
    )  # fmt: skip
    parser.add_argument("--threads", type=int, default=0, help="of torch on a CPU (all cores)")
    parser.add_argument("--jobs", type=int, default=0, help="processes that make data (all cores)")
    parser.add_argument("--checkpoint-every", type=int, default=250, metavar="STEPS")
    parser.add_argument("--validate-every", type=int, default=1000, metavar="STEPS")
    parser.add_argument("--json", type=Path, help="write the final figures")


def run(args: argparse.Namespace) -> int:
    """Trains; 0 when done or stopped by Ctrl-C with a checkpoint written."""
    # Threads that wait for each other in a loop take the cores of those that make the data; torch
    # reads this once, when it is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        import torch  # noqa: F401
    except ImportError:
        raise TrainingError(
            "training needs torch, which is not installed: .venv/bin/pip install torch"
        ) from None
    from ground_station import files
    from ground_station.training.corpus import CorpusSettings
    from ground_station.training.loop import Machine, train
    from ground_station.training.recipe import Recipe

    check_options(
        args, threads=(0, 256), jobs=(0, 256), checkpoint_every=(1, 10**6),
        validate_every=(1, 10**6),
    )  # fmt: skip
    given = {f.name: getattr(args, f.name) for f in fields(Recipe)
             if getattr(args, f.name, None) is not None and f.name != "corpus"}  # fmt: skip
    if args.steps is not None:  # a short run has a short end
        given.setdefault("decay", min(Recipe.decay, args.steps // 4))
        given["warm_up"] = min(Recipe.warm_up, args.steps // 4)
    numbers = {k: getattr(args, k) for k in ("rooms", "seed")}
    corpus = replace(CorpusSettings(), **{k: v for k, v in numbers.items() if v is not None})
    out = args.out or Path("out/training") / Recipe.size
    machine = Machine(
        device=args.device,
        precision=args.precision,
        threads=args.threads or len(os.sched_getaffinity(0)),
        jobs=args.jobs or len(os.sched_getaffinity(0)),
        checkpoint_every=args.checkpoint_every,
        validate_every=args.validate_every,
    )
    result = train(
        Recipe(**given, corpus=corpus),
        out=out,
        corpus_folder=args.corpus or Path("out/training/corpus"),
        machine=machine,
        resume=args.resume,
        decay_from=args.decay_from,
    )
    if args.json is not None:
        files.write_json(args.json, result)
    print(f"{result['model']}: step {result['step']} of {result['steps']}, "
          f"{100 * result['accuracy']:.1f} % of held-out matches within 3 px")  # fmt: skip
    return 0
