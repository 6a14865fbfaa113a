"""`python -m hw`."""

import argparse
import sys
from collections.abc import Callable, Sequence

from hw.command import parser
from pi_firmware.wire.errors import BlimpError, until_closed


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; 0, 1 (a margin or a current misses its bound) or 2 (bad input)."""
    args = parser().parse_args(arguments)
    from hw import answering

    run: dict[str, Callable[[argparse.Namespace], int]] = {
        "buoyancy": answering.buoyancy, "endurance": answering.endurance,
        "budget": answering.budget, "wiring": answering.wiring,
    }  # fmt: skip
    try:
        return run[args.command](args)
    except BlimpError as error:
        print(f"python -m hw {args.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"python -m hw {args.command}: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(until_closed(main))
