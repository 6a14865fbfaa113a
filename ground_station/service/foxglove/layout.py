"""A layout for Foxglove's app: map and camera above, state, height and battery in time below.

python -m ground_station.service.foxglove.layout demo >layout.json
"""

from __future__ import annotations

import sys

from foxglove import layouts as fl

from ground_station.service.foxglove import conversion
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.keys import check_payload_id


def layout(payload_id: str) -> fl.Layout:
    """Of one payload, whose topics begin with its name; raises `BlimpError` for what is none."""
    root = f"/{check_payload_id(payload_id)}"
    scene = fl.ThreeDeePanel(
        title="Map",
        config=fl.ThreeDeeConfig(
            follow_tf=conversion.MAP,
            fixed_frame=conversion.MAP,
            topics={
                "/map/floorplan": fl.BaseRendererGridTopicSettings(visible=True),
                "/map/landmarks": fl.BaseRendererPointCloudTopicSettings(visible=True),
                f"{root}/scene": fl.BaseRendererSceneUpdateTopicSettings(visible=True),
            },
        ),
    )
    camera = fl.ImagePanel(
        title="Camera",
        config=fl.ImageConfig(
            image_mode=fl.ImageModeConfig(
                image_topic=f"{root}/camera/image",
                calibration_topic=f"{root}/camera/calibration",
                annotations={f"{root}/camera/points": fl.ImageAnnotationSettings(visible=True)},
            )
        ),
    )
    states = fl.StateTransitionsPanel(
        title="State",
        config=fl.StateTransitionsConfig(
            paths=[fl.StateTransitionsSeries(value=f"{root}/estimate.state", label="State")]
        ),
    )
    plots = [
        fl.PlotPanel(title=title, config=fl.PlotConfig(paths=[fl.PlotSeries(value=root + path)]))
        for title, path in (
            ("Height, m", "/estimate.pose.pose.position.z"),
            ("Battery, V", "/battery.voltage"),
        )
    ]
    above, below = (
        [fl.SplitItem(content=one) for one in row] for row in ([scene, camera], [states, *plots])
    )
    rows = [(2.0, fl.SplitContainer(items=above)), (1.0, fl.SplitContainer(items=below))]
    items = [fl.SplitItem(proportion=share, content=row) for share, row in rows]
    return fl.Layout(content=fl.SplitContainer(direction="column", items=items))


def main() -> int:
    """Prints it; status 2 with one line when the name is none."""
    try:
        print(layout(sys.argv[1] if len(sys.argv) == 2 else "").to_json())
    except BlimpError as error:
        print(f"layout: the payload's name is wanted: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
