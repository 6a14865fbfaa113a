"""What each of the ground's commands does to this payload."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

from pi_firmware.capture import Capture
from pi_firmware.commands import FORCED, Action, Refusal, Values
from pi_firmware.recording import Recorder
from pi_firmware.settings import CameraSettings, EncoderSettings, Settings
from pi_firmware.wire.config import range_of

_EXPOSURE_LIMIT_S = 10.0


def table(
    settings: Settings,
    capture: Capture,
    recorder: Recorder,
    end: Callable[[list[str]], object],
    armed: Callable[[], bool],
) -> dict[str, Action]:
    """The commands by name; `end` ends the flight and then runs the words it is given.

    Those that interrupt the video are refused while the autopilot is `armed`, unless `force` is 1.
    """

    def set_bitrate(kbps: float) -> Values:
        return {"kbps": capture.set_bitrate(round(kbps))}

    def expose(exposure_s: float | None = None, gain: float | None = None) -> Values:
        now = capture.camera
        camera = dataclasses.replace(
            now,
            exposure_s=now.exposure_s if exposure_s is None else exposure_s,
            gain=now.gain if gain is None else gain,
        )
        if not capture.live:
            raise Refusal("a recording is exposed already")
        try:
            capture.ask_for(camera).result(_EXPOSURE_LIMIT_S)
        except TimeoutError:
            raise Refusal(f"the camera did not answer within {_EXPOSURE_LIMIT_S:g} s") from None
        return {"exposure_s": camera.exposure_s, "gain": camera.gain}

    def record() -> None:
        recorder.start()

    def end_recording() -> None:
        if not recorder.stop():
            raise Refusal("nothing was recorded")

    def end_with(key: str, command: list[str]) -> Callable[[], None]:
        def run() -> None:
            if not command:
                raise Refusal(f"'{key}' is empty: this payload does not know how")
            end(command)

        return run

    def disarmed(
        run: Callable[..., Values | None], numbers: Mapping[str, tuple[float, float]] = {}
    ) -> Action:
        def guarded(force: float = 0, **given: float) -> Values:
            if armed() and not force:
                raise Refusal("the autopilot is armed: disarm it, or say force=1")
            values = run(**given) or {}
            return {**values, FORCED: 1} if force else values

        return Action(guarded, {**numbers, "force": (0, 1)})

    slowest, _ = range_of(EncoderSettings, "min_bitrate_kbps")
    _, fastest = range_of(EncoderSettings, "bitrate_kbps")
    exposures = {name: range_of(CameraSettings, name) for name in ("exposure_s", "gain")}
    off = end_with("battery.shutdown_command", settings.battery.shutdown_command)
    anew = end_with("supervision.reboot_command", settings.supervision.reboot_command)
    return {
        "idr": Action(capture.force_idr),
        "bitrate": Action(set_bitrate, {"kbps": (slowest, fastest)}, frozenset({"kbps"})),
        "exposure": disarmed(expose, exposures),
        "record-start": Action(record),
        "record-stop": Action(end_recording),
        "shutdown": disarmed(off),
        "reboot": disarmed(anew),
    }
