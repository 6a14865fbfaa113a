"""The live channel for other programs: Foxglove, or a bridge from it to ROS 2.

Frames (REP 105, REP 103), all on topic `/tf`:

    map                          the registered map: metres, x along the floor plan, z up
    <payload>/camera             x forward, y left, z up: what `/<payload>/pose` is of
    <payload>/camera_optical     x right, y down, z forward: what the picture is in

Topics (schema, P: protobuf, J: JSON):

    /tf                          P foxglove.FrameTransform
    /map/floorplan               P foxglove.Grid
    /map/landmarks               P foxglove.PointCloud
    /events                      J blimp.Event
    /log                         P foxglove.Log, the same events for Foxglove's Log panel
    /recording                   J blimp.Recording, the station's own
    /<payload>/camera/image      P foxglove.CompressedImage, JPEG
    /<payload>/camera/points     P foxglove.ImageAnnotations, the tracked landmarks
    /<payload>/camera/calibration  P foxglove.CameraCalibration
    /<payload>/pose              P foxglove.PoseInFrame, solved poses only
    /<payload>/scene             P foxglove.SceneUpdate: marker, 95 % ellipsoid, trail
    /<payload>/estimate          J blimp.Estimate, every frame's; its header and pose are those
                                 of geometry_msgs/PoseWithCovarianceStamped
    /<payload>/battery           J blimp.Battery, the fields of sensor_msgs/BatteryState
    /<payload>/health            J blimp.Health
    /<payload>/status            J blimp.Payload: frames by fate, stream, clock

Stamps are the capture's on this machine's clock; while the payload's clock is not known they are
the picture's arrival and the pose's solution. All payloads share the frame `map`, whichever map
each one flies in. The server takes nothing from its clients but subscriptions.
"""
