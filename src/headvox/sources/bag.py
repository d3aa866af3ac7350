"""A bag of ROS 1 or ROS 2 as a source of frames, placed by its own transforms."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from headvox.data import F64, BadFrame, Cloud, DepthImage, Frame
from headvox.errors import HeadvoxError
from headvox.ros.bagfile import Bag
from headvox.ros.messages import cloud_points, depth_image, stamp_ns
from headvox.ros.synchronise import NS, Reading, Synchroniser
from headvox.ros.transforms import NoTransform, set_from
from headvox.sources.bagsensors import (
    Sensor,
    check_apart,
    find_sensors,
    known_transforms,
    place,
    transform_topics,
    world_from,
)
from headvox.sources.options import SourceOptions

TOLERANCE_NS = 20_000_000  # readings whose stamps differ by no more belong to one frame
_WAIT_S = 0.5  # of recording time: a reading for those of other sensors, and for its transform
_TIMEOUT_S = 2.0  # a sensor that is silent for so long is not waited for
_MOST_WAITING = 50  # sets of readings: what is held is bounded, whatever the stamps are


@dataclass(frozen=True, slots=True)
class _Message:
    """A message that may be damaged: why is told when its turn comes."""

    content: Any
    error: HeadvoxError | None = None


_LATE = _Message(None, HeadvoxError("Its stamp is not after that of the frame before."))


class BagSource:
    """The depth images and clouds of a bag, those of one moment together, in the world frame.

    Readings of several sensors are one frame when their stamps differ by 20 ms at most. A frame with a message that
    is damaged, late, or that no transform places is a :class:`~headvox.data.BadFrame`.
    """

    length: int | None

    def __init__(self, bag: Bag, options: SourceOptions, say: Callable[[str], None]) -> None:
        """Decide what of an open bag is read, and in which frame; ``say`` is told what is assumed.

        Raises:
            HeadvoxError: the bag cannot be read; :class:`~headvox.errors.Undecided` where the user has to choose.
        """
        if options.extrinsics is not None:
            raise HeadvoxError(
                f"{bag.name}: --extrinsics is for cameras, a bag has transforms.", "Use --mount."
            )
        self.bag = bag
        self.name = self.bag.name
        try:
            self.sensors = find_sensors(self.bag, options)
            self._transforms, known = known_transforms(self.bag, say)
            if not options.topics:
                check_apart(self.name, self.sensors, known, self._first_stamps())
            self.placing = place(self.name, self.sensors, known, options)
        except BaseException:
            self.bag.close()
            raise
        for note in (*(sensor.note for sensor in self.sensors), self.placing.note):
            if note:
                say(note)
        self.length = self.bag.topics[self.sensors[0].topic].count if len(self.sensors) == 1 else None
        self._by_topic = {sensor.topic: sensor for sensor in self.sensors}
        self._moving = transform_topics(self.bag)
        self._damage: HeadvoxError | None = None
        self._open = True

    @property
    def frame(self) -> str:
        """What ROS calls the world that the heads are in."""
        placing = self.placing
        if placing.T_world_frame is not None or placing.T_world_sensor is not None:
            return "world"  # that of --mount, which the bag has no name for
        return placing.frame or self.sensors[0].frame

    @property
    def most_readings(self) -> int:
        """How many the sensor with the most has: about as many frames as there are."""
        return max(self.bag.topics[sensor.topic].count for sensor in self.sensors)

    def _first_stamps(self) -> dict[str, int]:
        return {s.topic: stamp_ns(self.bag.first(s.topic).header.stamp) for s in self.sensors}

    def __iter__(self) -> Iterator[Frame | BadFrame]:
        """Yield the frames in time order, until closed; at the end the file is closed.

        Raises:
            HeadvoxError: it is closed already.
        """
        if not self._open:
            raise HeadvoxError(f"{self.name}: a bag is read once, and is closed then.", "Open it again.")
        synchroniser = Synchroniser(
            TOLERANCE_NS, _WAIT_S, _TIMEOUT_S, frozenset(self._by_topic), most_open=_MOST_WAITING
        )
        waiting: deque[list[Reading]] = deque()
        last_ns = 0
        try:
            for topic, logged_ns, data in self._messages():
                if topic in self._moving:
                    self._hear(topic, data)
                    continue
                reading = self._reading(topic, logged_ns, data)
                last_ns, late, jumps = reading.stamp_ns, synchroniser.late, synchroniser.jumps
                waiting += synchroniser.add(reading)
                if synchroniser.jumps > jumps:
                    self._transforms.forget_moving()
                if synchroniser.late > late:
                    waiting.append([replace(reading, message=_LATE)])
                yield from self._ready(waiting, reading.arrived_s)
            waiting += synchroniser.ready(math.inf)
            yield from self._ready(waiting, math.inf)
            if self._damage is not None:
                yield BadFrame(last_ns, str(self._damage))
        finally:
            self.close()

    def _messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Yield the messages that matter until closed; where the bag is damaged they end."""
        try:
            for message in self.bag.messages(self._moving | self._by_topic.keys()):
                if not self._open:
                    return
                yield message
        except HeadvoxError as error:
            if self._open:  # else it is only closed
                self._damage = error

    def close(self) -> None:
        """End the iteration and close the file."""
        self._open = False
        self.bag.close()

    def _hear(self, topic: str, data: bytes) -> None:
        try:
            set_from(self._transforms, self.bag.decode(topic, data), "static" in topic)
        except HeadvoxError:
            self._transforms.refused += 1

    def _reading(self, topic: str, logged_ns: int, data: bytes) -> Reading:
        stamp = logged_ns
        try:
            message = _Message(self.bag.decode(topic, data))
            if self._by_topic[topic].has_stamps:
                stamp = stamp_ns(message.content.header.stamp)
        except HeadvoxError as error:
            message = _Message(None, error)
        return Reading(topic, stamp, logged_ns / NS, message)

    def _ready(self, waiting: deque[list[Reading]], now_s: float) -> Iterator[Frame | BadFrame]:
        """Yield those that wait for no transform, or have waited long enough."""
        while waiting and self._open:
            readings = waiting[0]
            is_overdue = now_s - max(reading.arrived_s for reading in readings) > _WAIT_S
            try:
                places = [self._place(reading) for reading in readings]
            except NoTransform as error:
                if not is_overdue and len(waiting) <= _MOST_WAITING:  # it may stand later in the bag
                    return
                waiting.popleft()
                yield BadFrame(readings[0].stamp_ns, str(error))
                continue
            waiting.popleft()
            yield _frame(readings, [self._by_topic[reading.sensor] for reading in readings], places)

    def _place(self, reading: Reading) -> F64 | None:
        message: _Message = reading.message
        if message.error is not None:
            return None
        frame = message.content.header.frame_id.lstrip("/")
        return world_from(self.placing, self._transforms, frame, reading.stamp_ns)


def _frame(
    readings: Sequence[Reading], sensors: Sequence[Sensor], places: Sequence[F64 | None]
) -> Frame | BadFrame:
    stamp = max(reading.stamp_ns for reading in readings)
    clouds, depths = [], []
    for reading, sensor, T_world_sensor in zip(readings, sensors, places, strict=True):
        message: _Message = reading.message
        try:
            if message.error is not None:
                raise message.error
            if sensor.camera is None:
                clouds.append(Cloud(sensor.topic, cloud_points(message.content), T_world_sensor))
            else:
                depths.append(_depth(sensor, message.content, T_world_sensor))
        except HeadvoxError as error:
            return BadFrame(stamp, f"{sensor.topic}: {error}")
    return Frame(stamp, tuple(clouds), tuple(depths))


def _depth(sensor: Sensor, message: Any, T_world_camera: F64 | None) -> DepthImage:
    assert sensor.camera is not None
    if T_world_camera is None:
        raise HeadvoxError("A depth image cannot be in the world frame.", "Choose another --frame.")
    depth = depth_image(message)
    if depth.shape != (sensor.camera.height, sensor.camera.width):
        raise HeadvoxError(
            f"The image is {depth.shape[1]} x {depth.shape[0]}, "
            f"its camera_info {sensor.camera.width} x {sensor.camera.height}.",
            "Does the camera_info belong to this image?",
        )
    return DepthImage(sensor.topic, depth, sensor.camera, T_world_camera)
