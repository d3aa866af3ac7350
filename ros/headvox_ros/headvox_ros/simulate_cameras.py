"""The node ``simulate_cameras``: two D435i 4 m apart and somebody who walks, rendered by MuJoCo as it runs.

It is the paper's rig, and publishes as :mod:`headvox_ros.cameras` says. The images are without a sensor's noise. Needs
``headvox[sim]``.
"""

from __future__ import annotations

import sys
import time

from geometry_msgs.msg import Point, Pose, Quaternion
from rclpy.node import Node
from scipy.spatial.transform import Rotation

from headvox.errors import HeadvoxError
from headvox.ros.synchronise import NS
from headvox.synth.camera import IDEAL
from headvox.synth.presets import two_cameras
from headvox.synth.scene import Scene
from headvox.synth.simulator import Simulator
from headvox_ros import processes
from headvox_ros.cameras import Cameras, fixed


class Simulation(Node):
    """Renders frame after frame in real time, as far as the machine keeps up; the walk begins again when it is over."""

    def __init__(self) -> None:
        super().__init__("simulate_cameras")
        seed = fixed(self, "seed", 0, "Another one is another person, room and way.")
        mode = fixed(self, "mode", "d435i", "d435i, 848 x 480, or d435i-small, half of that.")
        self.walk_s = fixed(self, "walk_s", 60.0, "How long the walk is.")
        self.rate_hz = fixed(self, "rate_hz", 10.0, "Frames a second.")
        self.frames = fixed(self, "frames", 0, "How many; 0 for ever.")
        depths = fixed(self, "depths", True, "Publish depth images.")
        clouds = fixed(self, "clouds", False, "Publish point clouds.")
        self.clock = fixed(self, "clock", False, "Publish /clock, and stamp in simulated time.")
        reliability = fixed(self, "reliability", "reliable", "best_effort or reliable; drivers offer this.")
        if not (self.walk_s > 0.0 and self.rate_hz > 0.0):
            raise HeadvoxError("walk_s and rate_hz: expected more than 0.", "")
        if seed < 0:
            raise HeadvoxError(f"seed: expected 0 or more, got {seed}.", "")
        self.scene = two_cameras(seed, duration_s=self.walk_s, mode=mode, sensor=IDEAL)
        self.simulator = Simulator(self.scene)
        images = self.simulator.frame(0).depths
        self._cameras = Cameras(self, images, depths, clouds, self.clock, reliability)

    def run(self) -> None:
        """Publish frames; one that is due when the next one is too is left out."""
        step, walk = int(NS / self.rate_hz), int(self.walk_s * NS)
        start_s, start_ns = time.monotonic(), 0 if self.clock else time.time_ns()
        k = 0
        while self.frames <= 0 or k < self.frames:
            time.sleep(max(start_s + 1e-9 * k * step - time.monotonic(), 0.0))
            frame, heads = self.simulator.frame(k * step % walk), true_heads(self.scene, k * step % walk)
            self._cameras.publish(frame, start_ns + k * step, heads=heads)
            k = max(k + 1, int(1e9 * (time.monotonic() - start_s)) // step)


def true_heads(scene: Scene, stamp_ns: int) -> list[Pose]:
    """Return where the heads of a scene's people are at a time."""
    poses = []
    for actor in scene.actors:
        T = actor.body(scene.people, stamp_ns).T_world_head
        (x, y, z), (qx, qy, qz, qw) = T[:3, 3].tolist(), Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        poses.append(Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw)))
    return poses


def main(arguments: list[str] | None = None) -> int:
    """Run the node; return its exit code."""
    return processes.run("simulate_cameras", lambda: Simulation().run(), arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv))
