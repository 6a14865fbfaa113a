"""The autopilot, chosen by URI: poses go to it, its state comes back."""

from __future__ import annotations

from collections.abc import Callable

from pi_firmware import uri
from pi_firmware.settings import AutopilotSettings
from pi_firmware.wire.messages import Autopilot as State
from pi_firmware.wire.messages import Pose

WHAT = "autopilot.uri"
_SERIAL = ("baud", "system", "component")


class Autopilot:
    """What takes poses; no method waits for a device. This one is `off:`, they go nowhere.

    `armed`: it said so last, though it may be silent since.
    """

    armed = False

    def start(self) -> None:
        """Begins to talk to it."""

    def stop(self) -> None:
        """Ends the talk."""

    def on_pose(self, message: Pose) -> None:
        """A pose from the ground station; from any thread."""


def open_autopilot(
    settings: AutopilotSettings, publish: Callable[[State], None] = lambda state: None
) -> Autopilot:
    """The autopilot that the settings name; raises `SourceError` with one line.

    `publish` gets its state every `period_s`. A line that is not there is no error: it may come.
    """
    parsed = uri.parse(settings.uri, WHAT)
    if parsed.scheme == "off":
        parsed.only()
        if parsed.path:
            raise parsed.fail(f"takes no path, not {parsed.path!r}")
        return Autopilot()
    if parsed.scheme != "serial":
        raise parsed.fail("unknown scheme (available: serial:, off:)")
    parsed.only(*_SERIAL)
    if not parsed.path.startswith("/"):
        raise parsed.fail("expected serial:/dev/TTY?baud=RATE as serial:/dev/serial0?baud=921600")
    numbers = (
        int(parsed.number("baud", 921_600, 1200, 4_000_000)),
        int(parsed.number("system", 1, 1, 255)),
        int(parsed.number("component", 197, 1, 255)),
    )
    try:
        # Only now: boards without an autopilot need neither package, nor the time to import them.
        from pi_firmware.autopilot.line import SerialAutopilot
    except ImportError as error:
        raise parsed.fail(f"needs the Python package {error.name}, which is missing") from None
    return SerialAutopilot(settings, parsed.path, *numbers, publish=publish)
