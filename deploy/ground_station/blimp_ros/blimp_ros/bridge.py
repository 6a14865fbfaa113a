"""Publishes a payload's pose in ROS 2.

    ros2 run blimp_ros bridge --ros-args -p topic:=/demo/estimate

Nothing else of this project is needed where it runs. `header` and `pose` of the station's topic are
those of PoseWithCovarianceStamped; a frame without a pose is not published.
"""

import json
import time
from collections.abc import Iterator
from typing import Any

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rosidl_runtime_py import set_message_fields
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

_PROTOCOL = Subprotocol("foxglove.sdk.v1")
_HEADER_BYTES = 13  # Foxglove's binary message: 1 kind, 4 subscription, 8 time
_PAUSE_S = 1.0


def main() -> None:
    """Until ROS is shut down: a station that is gone is waited for."""
    rclpy.init()
    node = rclpy.create_node("blimp")
    topic = node.declare_parameter("topic", "/blimp-1/estimate").value
    url = node.declare_parameter("url", "ws://127.0.0.1:8765").value
    publisher = node.create_publisher(PoseWithCovarianceStamped, "pose", 10)
    while rclpy.ok():
        try:
            with connect(url, subprotocols=[_PROTOCOL], max_size=None) as socket:
                for header, pose in _poses(socket, topic):
                    message = PoseWithCovarianceStamped()
                    set_message_fields(message, {"header": header, "pose": pose})
                    publisher.publish(message)
            reason = "it ended the connection"
        except (OSError, WebSocketException) as error:
            reason = str(error)
        node.get_logger().warning(f"{url}: {reason}; trying again")
        time.sleep(_PAUSE_S)


def _poses(socket: ClientConnection, topic: str) -> Iterator[tuple[Any, Any]]:
    """Header and pose with covariance of each message of a topic that has both."""
    for data in socket:
        if isinstance(data, str):
            for channel in json.loads(data).get("channels", []):
                if channel["topic"] == topic:
                    asked = [{"id": 1, "channelId": channel["id"]}]
                    socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
            continue
        said = json.loads(data[_HEADER_BYTES:])
        if said["pose"] and said["pose"]["covariance"]:
            yield said["header"], said["pose"]


if __name__ == "__main__":
    main()
