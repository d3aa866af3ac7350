"""More than a running node can work on, bags that begin again, and listeners that sleep."""

from __future__ import annotations

import itertools
import os
import signal

import rclpy
from geometry_msgs.msg import PoseArray
from robot import NS, stamp_of
from visualization_msgs.msg import MarkerArray

QUEUE = 5  # answers that a publisher of the node holds at most


def test_a_bag_that_begins_again(settled, frames, clock):
    robot = settled
    clock.now -= 500 * NS
    jumps = int(robot.wait(robot.status)["clock_jumps"])
    for _ in range(5):
        robot.see_frame(frames[0], stamp := clock.next())
        robot.spin(0.1)
    assert robot.wait(lambda: robot.answers(stamp))
    robot.wait(lambda: int(robot.status()["clock_jumps"]) > jumps)


def test_a_subscriber_that_never_reads_holds_nobody_up(settled, frames, clock):
    robot = settled
    deaf = rclpy.create_node("deaf")
    for topic in ("/head_detector/poses", "/head_detector/markers"):
        kind = PoseArray if topic.endswith("poses") else MarkerArray
        deaf.create_subscription(kind, topic, lambda m: None, 1)  # and nobody spins it
    robot.spin(0.5)
    many = 4 * QUEUE  # more than wait for anybody
    seen = itertools.cycle(frames)
    robot.wait(
        lambda: len(robot.poses()) >= many,
        meanwhile=lambda: robot.see_frame(next(seen), clock.next()),
        every_s=0.05,
    )
    assert robot.wait(lambda: robot.answers(clock.now))
    deaf.destroy_node()


def test_an_overloaded_node_gets_fresher_never_later(settled, frames, clock):
    """Sent far faster than it can work, it leaves frames out, and the answers keep up with the newest."""
    robot = settled

    def left_out() -> int:
        return int(robot.status()["replaced_by_fresher"]) + int(robot.status()["lost"])

    robot.wait(robot.status)
    before = left_out()
    for k in range(300):
        robot.see_frame(frames[k % len(frames)], stamp := clock.next())
        rclpy.spin_once(robot.node, timeout_sec=0.0)
    robot.wait(lambda: robot.answers(stamp))
    stamps = [stamp_of(message) for message in robot.poses()]
    assert stamps == sorted(stamps)
    assert len(stamps) < 300
    robot.wait(lambda: left_out() > before)


def test_messages_that_do_not_get_to_the_node_are_counted(settled, node, frames, clock):
    """More than its queue holds while it stands still."""
    robot = settled
    lost = int(robot.wait(robot.status)["lost"])
    os.kill(node.pid, signal.SIGSTOP)
    try:
        for _ in range(20):
            robot.see_frame(frames[0], clock.next())
            robot.spin(0.02)
    finally:
        os.kill(node.pid, signal.SIGCONT)
    robot.wait(
        lambda: int(robot.status()["lost"]) > lost + 10,
        meanwhile=lambda: robot.see_frame(frames[0], clock.next()),
    )
    assert ": messages do not get here" in robot.status()["last_problem"]
