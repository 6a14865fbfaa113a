"""The payload's program whose first encoders stop giving frames, as a hung driver's does.

    python stalling_encoder.py FRAMES ENCODERS [the program's own arguments]

Each of the first ENCODERS encoders of the process gives FRAMES frames and holds the next for ever.
Nothing else is changed.
"""

import sys
import threading
from typing import Any

from pi_firmware import __main__ as program
from pi_firmware.media import Media


def main() -> int:
    frames, encoders = int(sys.argv[1]), int(sys.argv[2])
    del sys.argv[1:3]
    build = Media._build
    built = [0]
    released = threading.Event()

    def stalling(media: Media) -> Any:
        pipeline = build(media)
        built[0] += 1
        if built[0] > encoders:
            return pipeline
        given = [0]
        kinds = media._gst.PadProbeType
        result = media._gst.PadProbeReturn

        def hold(pad: Any, probe: Any) -> Any:
            given[0] += 1
            if given[0] > frames:
                # Until the pad is deactivated, as a driver's call returns when its file is closed.
                while pad.is_active() and not released.wait(0.02):
                    pass
                return result.DROP
            return result.OK

        pad = pipeline.get_by_name("encoder").get_static_pad("src")
        pad.add_probe(kinds.BUFFER, hold)
        return pipeline

    Media._build = stalling  # type: ignore[method-assign]
    return program.main()


if __name__ == "__main__":
    sys.exit(main())
