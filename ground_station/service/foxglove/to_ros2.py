"""Publishes a payload's pose in ROS 2: python3 to_ros2.py /demo/estimate [ws://127.0.0.1:8765]

For a machine where ROS 2 is sourced and `websockets` installed; nothing else of this project is
needed there. `header` and `pose` of the topic are those of PoseWithCovarianceStamped.
"""

import json
import sys

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rosidl_runtime_py import set_message_fields
from websockets.sync.client import connect
from websockets.typing import Subprotocol

_PROTOCOL = Subprotocol("foxglove.sdk.v1")
_HEADER_BYTES = 13  # Foxglove's binary message: 1 kind, 4 subscription, 8 time


def main(topic: str, url: str = "ws://127.0.0.1:8765") -> None:
    """Until the connection ends."""
    rclpy.init()
    publisher = rclpy.create_node("blimp").create_publisher(PoseWithCovarianceStamped, "pose", 10)
    with connect(url, subprotocols=[_PROTOCOL], max_size=None) as socket:
        for data in socket:
            if isinstance(data, str):
                for channel in json.loads(data).get("channels", []):
                    if channel["topic"] == topic:
                        asked = [{"id": 1, "channelId": channel["id"]}]
                        socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
                continue
            said = json.loads(data[_HEADER_BYTES:])
            if said["pose"] and said["pose"]["covariance"]:
                message = PoseWithCovarianceStamped()
                set_message_fields(message, {"header": said["header"], "pose": said["pose"]})
                publisher.publish(message)


if __name__ == "__main__":
    main(*sys.argv[1:])
