"""The ROS 2 package, with stand-ins for ROS: what it publishes, and what it is made of."""

from __future__ import annotations

import ast
import configparser
import importlib
import sys
import threading
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from foxglove_stand import Station, estimate, server
from process_stand import ROOT
from station_notes import PAYLOAD
from waiting import eventually

from pi_firmware import __version__

PACKAGE = ROOT / "deploy/ground_station/blimp_ros"


class Ros:
    """`rclpy` and its node: parameters, one publisher, warnings."""

    def __init__(self, **parameters: str) -> None:
        self.parameters, self.published = parameters, []
        self.warnings: list[str] = []
        self.running = True

    def modules(self) -> dict[str, ModuleType]:
        def made(name: str, **content: Any) -> ModuleType:
            module = ModuleType(name)
            module.__dict__.update(content)
            return module

        node = SimpleNamespace(
            declare_parameter=lambda name, default: SimpleNamespace(
                value=self.parameters.get(name, default)
            ),
            create_publisher=lambda kind, topic, depth: SimpleNamespace(
                publish=lambda message: self.published.append((topic, message))
            ),
            get_logger=lambda: SimpleNamespace(warning=self.warnings.append),
        )
        return {
            "rclpy": made("rclpy", init=lambda: None, create_node=lambda name: node,
                          ok=lambda: self.running),
            "geometry_msgs": made("geometry_msgs"),
            "geometry_msgs.msg": made(
                "geometry_msgs.msg", PoseWithCovarianceStamped=SimpleNamespace
            ),
            "rosidl_runtime_py": made(
                "rosidl_runtime_py",
                set_message_fields=lambda message, fields: message.__dict__.update(fields),
            ),
        }  # fmt: skip


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    with Station(tmp_path) as said, server(tmp_path) as (said.process, said.port):
        yield said


def test_it_publishes_poses_with_their_covariance_and_waits_for_a_station_that_is_gone(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"ws://127.0.0.1:{station.port}"
    ros = Ros(topic=f"/{PAYLOAD}/estimate", url=url)
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(PACKAGE)
    bridge = importlib.import_module("blimp_ros.bridge")
    monkeypatch.setattr(bridge, "_PAUSE_S", 0.05)
    thread = threading.Thread(target=bridge.main, daemon=True)
    thread.start()
    eventually(lambda: ros.published, step=lambda: station.say(estimate()))
    topic, message = ros.published[0]
    assert topic == "pose" and message.header["frame_id"] == "map"
    assert message.pose["pose"]["position"] == {"x": 3.0, "y": 4.0, "z": 2.5}
    assert len(message.pose["covariance"]) == 36
    for _ in range(3):
        station.say(estimate(position_m=None, quaternion_xyzw=None, covariance=None))

    def there() -> bool:
        return ros.published[-1][1].pose["pose"]["position"]["x"] == 9.0

    eventually(there, step=lambda: station.say(estimate(position_m=[9.0, 4.0, 2.5])))
    assert all(len(message.pose["covariance"]) == 36 for _, message in ros.published)
    station.process.terminate()
    eventually(lambda: len(ros.warnings) >= 2)
    assert all(line.startswith(url) and "trying again" in line for line in ros.warnings)
    assert thread.is_alive()
    ros.running = False
    thread.join(10)
    assert not thread.is_alive()


def test_its_parts_name_each_other() -> None:
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    told = {child.tag: child.text for child in manifest}
    assert (told["name"], told["version"]) == ("blimp_ros", __version__)
    assert manifest.find("export/build_type").text == "ament_python"  # type: ignore[union-attr]
    setup = (PACKAGE / "setup.py").read_text()
    assert f'version="{__version__}"' in setup and "bridge = {NAME}.bridge:main" in setup
    for line in ast.walk(ast.parse(setup)):
        if isinstance(line, ast.Constant) and str(line.value).endswith(".xml"):
            assert (PACKAGE / line.value).is_file()
    assert (PACKAGE / "resource/blimp_ros").is_file()
    places = configparser.ConfigParser(interpolation=None)
    places.read(PACKAGE / "setup.cfg")
    assert places["install"]["install_scripts"] == "$base/lib/blimp_ros"  # where ros2 run looks
    launched = ElementTree.parse(PACKAGE / "launch/bridge.launch.xml").getroot()
    node = launched.find("node")
    assert node is not None and (node.get("pkg"), node.get("exec")) == ("blimp_ros", "bridge")
    given = {argument.get("name") for argument in launched.findall("arg")}
    assert given == {parameter.get("name") for parameter in node.findall("param")}
    bridge = (PACKAGE / "blimp_ros/bridge.py").read_text()
    assert all(f'declare_parameter("{name}"' in bridge for name in given)
