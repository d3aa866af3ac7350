"""Which topics of a bag are sensors, and which frame is the world: found where that is plain, asked where it is not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations, islice
from typing import Any

import numpy as np

from headvox.data import F64, Intrinsics
from headvox.errors import HeadvoxError, Undecided
from headvox.ros.bagfile import CAMERA_INFO, CLOUD, IMAGE, TRANSFORMS, Bag
from headvox.ros.messages import DEPTH_TYPES, distortion_remark, info_topic, intrinsics
from headvox.ros.transforms import NoTransform, TransformBuffer, set_from
from headvox.sources.options import ASSUMED, SourceOptions, assumed_mount, listed, mounted

# REP 105, and what simulations and calibrations call it: frames whose z is up, the first the farthest from the robot.
# Not its "earth": that one's z points to the pole.
WORLDS = ("map", "world", "odom", "base_footprint", "base_link")
SAME_PLACE_M, SAME_TURN = 0.06, 0.996  # two streams of one device; the cosine of 5 degrees
_LOOKED_AT = 2000  # messages of /tf that the tree of frames is learnt from


@dataclass(frozen=True, slots=True)
class Sensor:
    """A topic that is read: ``camera`` is None for clouds; ``frame`` is the frame_id of its first message.

    ``note`` is what the user is told of it, empty where there is nothing to tell.
    """

    topic: str
    frame: str
    camera: Intrinsics | None
    words: str
    has_stamps: bool
    note: str = ""


@dataclass(frozen=True, slots=True)
class Placing:
    """How readings get into the world: through the bag's transforms to ``frame``, which is at ``T_world_frame``.

    ``T_world_sensor`` instead where there is one sensor and no transform; both None where points are in the world.
    """

    frame: str | None
    T_world_frame: F64 | None
    T_world_sensor: F64 | None
    note: str = ""

    @property
    def words(self) -> str:
        """What the world is, for people."""
        if self.frame is None:
            return (
                "the frame of the points" if self.T_world_sensor is None else "a world below the one sensor"
            )
        return (
            f"frame {self.frame!r}"
            if self.T_world_frame is None
            else f"a world that {self.frame!r} stands in"
        )


def find_sensors(bag: Bag, options: SourceOptions) -> list[Sensor]:
    """Return the sensors to read, by topic.

    Raises:
        Undecided: there is none, a topic that was asked for is none, or two topics are of one camera.
    """
    known = {topic.name for topic in bag.topics.values() if topic.type in (IMAGE, CLOUD)}
    for name in options.topics:
        if name not in known:
            raise Undecided(
                f"{bag.name}: there is no topic {name} with images or clouds in it.",
                "Choose with --topic:",
                _choices(bag),
            )
    wanted = sorted(set(options.topics)) or sorted(known)
    sensors = []
    for name in wanted:
        sensor = _sensor(bag, name, asked=bool(options.topics))
        if isinstance(sensor, Sensor):
            sensors.append(sensor)
        elif options.topics:
            raise HeadvoxError(f"{bag.name}: {name}: {sensor}", "Choose another topic with --topic.")
    if not sensors:
        raise Undecided(
            f"{bag.name}: no topic has depth images with a CameraInfo, or point clouds.",
            "What is in it:",
            _choices(bag) or tuple(f"{t.name}  {t.type}" for t in bag.topics.values()),
        )
    return sensors


def _choices(bag: Bag) -> tuple[str, ...]:
    return tuple(
        f"--topic {topic.name}  {topic.type}, {topic.count} messages"
        for topic in bag.topics.values()
        if topic.type in (IMAGE, CLOUD)
    )


def _sensor(bag: Bag, name: str, asked: bool) -> Sensor | str:
    """Return the sensor that a topic is, or why it is none."""
    first = bag.first(name)
    if first is None:
        return "it has no message, or a damaged one first"
    frame = first.header.frame_id.lstrip("/")
    has_stamps = bool(first.header.stamp.sec or first.header.stamp.nanosec)
    if bag.topics[name].type == CLOUD:
        return Sensor(name, frame, None, f"cloud, {first.height * first.width} points", has_stamps)
    is_depth = first.encoding in DEPTH_TYPES and (asked or first.encoding != "mono16" or "depth" in name)
    if not is_depth:
        return f"its encoding is {first.encoding[:40]!r}, expected a depth image: {' or '.join(DEPTH_TYPES)}"
    info = _info_of(bag, name, frame, (first.width, first.height))
    if info is None:
        return "there is no CameraInfo of its frame and size"
    words = f"depth, {first.width}x{first.height}, {first.encoding}"
    return Sensor(name, frame, intrinsics(info), words, has_stamps, distortion_remark(info, name))


def _info_of(bag: Bag, topic: str, frame: str, size: tuple[int, int]) -> Any | None:
    """Return the CameraInfo of a depth image: the one beside it, else one of its frame and size."""
    infos = [other.name for other in bag.topics.values() if other.type == CAMERA_INFO]
    beside = [info_topic(topic)] if info_topic(topic) in infos else []
    for name in (*beside, *infos):
        info = bag.first(name)
        if info is None or (info.width, info.height) != size:
            continue
        if name in beside or info.header.frame_id.lstrip("/") == frame:
            return info
    return None


# ------------------------------------------------------------------------------------------------------- frames


def known_transforms(bag: Bag, say: Callable[[str], None]) -> tuple[TransformBuffer, TransformBuffer]:
    """Return the static transforms, and those with what /tf begins with: enough to know which frames there are.

    Where the bag is damaged they end: ``say`` is told.
    """
    static, begun = TransformBuffer(), TransformBuffer(keep_s=1e6)
    topics = transform_topics(bag)
    told: set[str] = set()
    for is_static in (True, False):
        chosen = {name for name in topics if ("static" in name) == is_static}
        try:
            for message in islice(_readable(bag, chosen), _LOOKED_AT):
                for buffer in (static, begun) if is_static else (begun,):
                    set_from(buffer, message, is_static)
        except HeadvoxError as error:
            told.add(f"{error.what} What stands before that is read. {error.do}")
    for text in sorted(told):
        say(text)
    return static, begun


def _readable(bag: Bag, topics: set[str]) -> Iterator[Any]:
    """Yield the messages of these topics, but those that are damaged.

    Raises:
        HeadvoxError: the bag is damaged from here on.
    """
    for topic, _, data in bag.messages(topics):
        with suppress(HeadvoxError):
            yield bag.decode(topic, data)


def transform_topics(bag: Bag) -> set[str]:
    """Return the topics that tell where frames are."""
    return {topic.name for topic in bag.topics.values() if topic.type in TRANSFORMS}


def place(
    bag_name: str, sensors: Sequence[Sensor], known: TransformBuffer, options: SourceOptions
) -> Placing:
    """Decide which frame is the world.

    Raises:
        Undecided: sensors are not connected, or no frame is plainly one whose z is up.
    """
    above = {sensor.topic: known.above(sensor.frame) for sensor in sensors}
    common = [frame for frame in above[sensors[0].topic] if all(frame in chain for chain in above.values())]
    if options.frame is not None:
        return _placed_in(options.frame.lstrip("/"), bag_name, sensors, known, options)
    worlds = [name for frame in WORLDS for name in common if name.rpartition("/")[2] == frame]
    if worlds and options.T_world_mount is None:
        others = listed(sorted(set(common) - {worlds[0]}))
        note = f"heads are in the frame {worlds[0]!r}; also there, for --frame: {others}"
        return _world(worlds[0], sensors, note if len(worlds) > 1 else "")
    if common and len(common) > 1 and options.T_world_mount is not None:
        return Placing(common[-1], options.T_world_mount, None, f"--mount is that of {common[-1]!r}")
    if len(sensors) == 1:
        return _alone(sensors[0], common, options)
    chains = tuple(f"{sensor.topic}: {' in '.join(above[sensor.topic])}" for sensor in sensors)
    if not common:
        raise Undecided(
            f"{bag_name}: the transforms do not connect the {len(sensors)} sensors.",
            "Choose one with --topic, and say where it stands with --mount. Their frames:",
            chains,
        )
    raise Undecided(
        f"{bag_name}: none of the frames is plainly the world, with z up.",
        "Choose with --frame, and say how it stands with --mount if its z is not up. The frames:",
        chains,
    )


def _placed_in(
    frame: str, bag_name: str, sensors: Sequence[Sensor], known: TransformBuffer, options: SourceOptions
) -> Placing:
    for sensor in sensors:
        below, above = known.above(sensor.frame), known.above(frame)
        if not set(below) & set(above):
            raise Undecided(
                f"{bag_name}: {sensor.topic} is in {sensor.frame!r}, which is not connected with {frame!r}.",
                "Choose another --frame, of these:",
                tuple(below),
            )
    return Placing(frame, options.T_world_mount, None)


def _world(frame: str, sensors: Sequence[Sensor], note: str) -> Placing:
    """A frame that is the world; points that are in it already have no sensor that anybody knows."""
    if all(sensor.frame == frame and sensor.camera is None for sensor in sensors):
        return Placing(None, None, None, note)
    return Placing(frame, None, None, note)


def _alone(sensor: Sensor, common: Sequence[str], options: SourceOptions) -> Placing:
    """One sensor, and no frame above it that is plainly the world."""
    T_world_mount = assumed_mount() if options.T_world_mount is None else options.T_world_mount
    assumed = "" if options.T_world_mount is not None else f" {ASSUMED}"
    root = common[-1]
    if len(common) > 1:
        if options.T_world_mount is None and not root.endswith("link"):
            raise Undecided(
                f"{sensor.topic}: none of the frames is plainly the world, with z up.",
                "Choose with --frame, and say how it stands with --mount if its z is not up. The frames:",
                tuple(common),
            )
        note = f"{sensor.topic}: no transform leads to the world; the frame {root!r}{assumed}"
        return Placing(root, T_world_mount, None, note if assumed else "")
    note = f"{sensor.topic}: the bag has no transform of it; the sensor{assumed}"
    return Placing(None, None, mounted(T_world_mount, is_optical(sensor)), note if assumed else "")


def check_apart(
    bag_name: str, sensors: Sequence[Sensor], known: TransformBuffer, stamps: Mapping[str, int]
) -> None:
    """Refuse two topics of one camera: what it sees is to be counted once.

    Raises:
        Undecided: two sensors have one frame, or stand at one place and look the same way.
    """
    for a, b in combinations(sensors, 2):
        if a.frame == b.frame or _together(a, b, known, stamps[a.topic]):
            raise Undecided(
                f"{bag_name}: {a.topic} and {b.topic} are of one sensor.",
                "Choose with --topic (several times for several sensors; a depth image tells more than its cloud):",
                tuple(f"--topic {sensor.topic}  {sensor.words}" for sensor in sensors),
            )


def _together(a: Sensor, b: Sensor, known: TransformBuffer, stamp_ns: int) -> bool:
    try:
        T_a_b = known.lookup(a.frame, b.frame, stamp_ns)
    except NoTransform:
        return False
    turn = float(_ahead(a) @ T_a_b[:3, :3] @ _ahead(b))
    return bool(np.linalg.norm(T_a_b[:3, 3]) < SAME_PLACE_M and turn > SAME_TURN)


def _ahead(sensor: Sensor) -> F64:
    """Return where a sensor looks, (3,), in its own frame."""
    return np.array([0.0, 0.0, 1.0] if is_optical(sensor) else [1.0, 0.0, 0.0])


def is_optical(sensor: Sensor) -> bool:
    """Tell whether a frame has z forward: that of every image, and by its name that of some clouds."""
    return sensor.camera is not None or "optical" in sensor.frame


def world_from(placing: Placing, transforms: TransformBuffer, frame: str, stamp_ns: int) -> F64 | None:
    """Return T_world_sensor (4, 4) of a frame at a time, None where its points are world coordinates.

    Raises:
        NoTransform: it is not known.
    """
    if placing.frame is None:
        return placing.T_world_sensor
    if placing.T_world_frame is None:
        return None if frame == placing.frame else transforms.lookup(placing.frame, frame, stamp_ns)
    return placing.T_world_frame @ transforms.lookup(placing.frame, frame, stamp_ns)
