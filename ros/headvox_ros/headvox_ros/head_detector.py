"""The node ``head_detector``: depth images and clouds in, heads out."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import PoseArray
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from headvox.config import DetectorConfig, TrackerConfig
from headvox.data import Frame
from headvox.errors import HeadvoxError
from headvox.masks.read import load_cascade
from headvox.pipeline import Detector
from headvox.ros import outputs
from headvox.tracking.tracker import Tracker
from headvox.warmup import warm_up
from headvox_ros.as_message import as_message
from headvox_ros.node import SensorNode, run
from headvox_ros.parameters import Parameter, config_from, parameters_of

PARAMETERS = [
    *parameters_of(DetectorConfig, "detector"),
    Parameter("tracking", True, "Follow heads from frame to frame: ids, velocities, smooth places.", None),
    *parameters_of(TrackerConfig, "track"),
    Parameter(
        "publish_tf", False, "Broadcast a frame head_ID for each head whose orientation is known.", None
    ),
    Parameter("marker_lifetime_s", 0.5, "How long a marker is shown when nothing new comes.", (0.0, 60.0)),
]


vision: Any = None
with contextlib.suppress(ImportError):  # a ROS without vision_msgs: the topic is left out
    vision = importlib.import_module("vision_msgs.msg")


class HeadDetector(SensorNode):
    """Finds heads in what depth cameras and LiDARs see, in process: no cloud leaves it."""

    def __init__(self) -> None:
        self._detector: Detector | None = None
        self._tracker: Tracker | None = None
        super().__init__("head_detector", PARAMETERS)
        qos = QoSProfile(depth=5)
        self._poses = self.create_lifecycle_publisher(PoseArray, "~/poses", qos)
        self._markers = self.create_lifecycle_publisher(MarkerArray, "~/markers", qos)
        self._tracks = self.create_lifecycle_publisher(Odometry, "~/tracks", QoSProfile(depth=50))
        self._heads = None
        if vision is not None:
            self._heads = self.create_lifecycle_publisher(vision.Detection3DArray, "~/heads", qos)
        self._tf = self.create_lifecycle_publisher(TFMessage, "/tf", QoSProfile(depth=100))

    def check(self, values: Mapping[str, Any]) -> None:
        """Refuse settings that the detector refuses."""
        load_cascade(config_from(DetectorConfig, "detector", values).cascade)
        config_from(TrackerConfig, "track", values)
        if not any(topic for name in ("clouds", "depths") for topic in values[name]):
            raise HeadvoxError(
                "There is no topic to listen to.",
                "Set depths or clouds: -p depths:=\"['/camera/depth/image_rect_raw']\"",
            )

    def prepare(self) -> None:
        """Make the detector, and compile its loops."""
        values = self.values
        config = config_from(DetectorConfig, "detector", values)
        warm_up(config)
        self._detector = self._new_detector(config)
        self._tracker = Tracker(config_from(TrackerConfig, "track", values)) if values["tracking"] else None
        self._board = outputs.MarkerBoard(self.get_parameter("marker_lifetime_s").value)

    def process(self, frame: Frame) -> None:
        """Find the heads of a frame, and publish them with the frame's stamp on the topics that somebody listens to."""
        self._heed_parameters()
        heads = self._look(frame)
        seen = [head for head in heads if head.is_seen]
        header = outputs.header_of(frame.stamp_ns, self.get_parameter("target_frame").value)
        if self._poses.get_subscription_count():
            self._poses.publish(as_message(PoseArray, outputs.poses(header, seen)))
        if self._heads is not None and self._heads.get_subscription_count():
            self._heads.publish(as_message(vision.Detection3DArray, outputs.detections(header, seen)))
        if self._tracks.get_subscription_count():
            for track in outputs.tracks(header, heads):
                self._tracks.publish(as_message(Odometry, track))
        if self._markers.get_subscription_count():
            self._markers.publish(as_message(MarkerArray, self._board.show(header, heads)))
        if self.get_parameter("publish_tf").value:
            self._tf.publish(as_message(TFMessage, outputs.frames(header, heads)))

    def _look(self, frame: Frame) -> list[outputs.HeadNow]:
        assert self._detector is not None
        if self._tracker is None:
            return outputs.of_detections(self._detector.detect_frame(frame))
        expected = self._tracker.expected(frame.stamp_ns)
        heads = self._detector.detect_frame(frame, expected)
        return outputs.of_tracks(self._tracker.update(heads, frame))

    def _heed_parameters(self) -> None:
        """Make another detector, and tell the tracker, when their parameters were changed."""
        assert self._detector is not None
        values = self.values
        config = config_from(DetectorConfig, "detector", values)
        if config != self._detector.config:
            self._detector.close()
            self._detector = self._new_detector(config)
        if self._tracker is not None:
            settings = config_from(TrackerConfig, "track", values)
            if settings != self._tracker.config:
                self._tracker.config = settings

    def _new_detector(self, config: DetectorConfig) -> Detector:
        return Detector(config, note=lambda text: self.get_logger().warning(text))

    def release(self) -> None:
        """End the detector's threads."""
        if self._detector is not None:
            self._detector.close()
            self._detector = None


def main(arguments: list[str] | None = None) -> int:
    """Run the node; return its exit code."""
    return run(HeadDetector, arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv))
