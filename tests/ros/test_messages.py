import struct
from types import SimpleNamespace

import numpy as np
import pytest

from headvox import HeadvoxError
from headvox.ros.messages import (
    FIELD_TYPES,
    cloud_points,
    depth_image,
    distortion_remark,
    intrinsics,
    stamp_ns,
)

SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 8: 8}
CODES = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}


def field(name, offset, datatype=7, count=1):
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def cloud(**changes):
    """A good cloud of 3 x 2 points, padded after every point and every row."""
    rng = np.random.default_rng(0)
    message = SimpleNamespace(
        height=2,
        width=3,
        fields=[field("x", 0), field("y", 4), field("z", 8), field("intensity", 12)],
        is_bigendian=False,
        point_step=20,
        row_step=64,
        data=rng.bytes(128),
        is_dense=False,
    )
    message.__dict__.update(changes)
    return message


def points_one_by_one(message):
    """The slow twin: every coordinate of every point, unpacked by itself."""
    order = ">" if message.is_bigendian else "<"
    fields = {f.name: f for f in message.fields}
    points = []
    for row in range(message.height):
        for column in range(message.width):
            start = row * (message.row_step if message.height > 1 else 0) + column * message.point_step
            point = []
            for axis in "xyz":
                f = fields[axis]
                (value,) = struct.unpack_from(order + CODES[f.datatype], message.data, start + f.offset)
                point.append(value)
            points.append(point)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array(points, dtype=np.float64).astype(np.float32)


@pytest.mark.parametrize("seed", range(60))
def test_any_layout_equals_the_slow_twin(seed):
    rng = np.random.default_rng(seed)
    fields, end = [], 0
    for name in rng.permutation(["x", "y", "z", "rgb", "ring"]):
        datatype = int(rng.integers(1, 9))
        end += int(rng.integers(0, 5))  # a gap, and so no alignment
        fields.append(field(str(name), end, datatype, count=int(rng.integers(0, 2))))
        end += SIZES[datatype]
    point_step = end + int(rng.integers(0, 9))
    height, width = (
        (1, int(rng.integers(1, 40))) if seed % 3 == 0 else (int(rng.integers(2, 7)), int(rng.integers(1, 9)))
    )
    row_step = width * point_step + int(rng.integers(0, 17)) * (height > 1)
    data = rng.bytes(height * row_step + int(rng.integers(0, 30)))
    message = cloud(
        height=height, width=width, fields=fields, point_step=point_step, row_step=row_step, data=data,
        is_bigendian=bool(rng.integers(2)),
    )  # fmt: skip
    points = cloud_points(message)
    assert points.dtype == np.float32
    assert points.flags.c_contiguous
    np.testing.assert_array_equal(points, points_one_by_one(message))


def test_the_field_types_are_those_of_ros():
    assert {code: np.dtype(name).itemsize for code, name in FIELD_TYPES.items()} == SIZES


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(
    ("point_step", "offset", "padding"), [(12, 0, 0), (16, 4, 0), (13, 1, 3), (12, 0, 8)]
)
def test_the_usual_layouts_equal_the_slow_twin(point_step, offset, padding, big):
    row_step = 5 * point_step + padding
    fields = [field(name, offset + 4 * k) for k, name in enumerate("xyz")]
    message = cloud(
        height=4, width=5, fields=fields, point_step=point_step, row_step=row_step, is_bigendian=big,
        data=np.random.default_rng(0).bytes(4 * row_step),
    )  # fmt: skip
    points = cloud_points(message)
    np.testing.assert_array_equal(points, points_one_by_one(message))
    assert points.flags.c_contiguous
    assert points.flags.aligned
    plain = (point_step, padding, big) == (12, 0, False)
    assert np.shares_memory(points, np.frombuffer(message.data, np.uint8)) == plain


def test_what_float32_cannot_hold_is_no_point():
    data = struct.pack("<ddd", 1e300, float("nan"), 1.0)
    fields = [field("x", 0, 8), field("y", 8, 8), field("z", 16, 8)]
    points = cloud_points(cloud(height=1, width=1, fields=fields, point_step=24, row_step=24, data=data))
    np.testing.assert_array_equal(points, [[np.inf, np.nan, 1.0]])


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"width": 0}, "0 x 2 points"),
        ({"height": 0, "data": b""}, "3 x 0 points"),
        ({"data": b""}, "0 bytes of data"),
        ({"data": bytes(123)}, "123 bytes of data, its header says 124"),
        ({"point_step": 0}, "ends at byte 4 of a point of 0 bytes"),
        ({"row_step": 59}, "row_step is 59"),
        ({"row_step": 0}, "row_step is 0"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "row_step"),
        ({"width": 2**32 - 1, "height": 1}, "bytes of data, its header says"),
        ({"height": 2**32 - 1}, "bytes of data, its header says"),
        ({"row_step": 2**32 - 1}, "bytes of data, its header says"),
        ({"point_step": 2**32 - 1, "height": 1}, "bytes of data, its header says"),
        ({"fields": []}, "no field 'x', its fields are: none"),
        ({"fields": [field("x", 0), field("z", 8)]}, "no field 'y'"),
        ({"fields": [field("x", 0), field("y", 4), field("z", 17)]}, "'z' ends at byte 21 of a point of 20"),
        ({"fields": [field("x", 0), field("y", 2**32 - 1), field("z", 8)]}, "'y' ends at byte"),
        ({"fields": [field("x", 0, 9), field("y", 4), field("z", 8)]}, "datatype 9"),
        ({"fields": [field("x", 0, 0), field("y", 4), field("z", 8)]}, "datatype 0"),
        ({"fields": [field("x", 0, 7, 3), field("y", 4), field("z", 8)]}, "3 values a point"),
    ],
)
def test_a_cloud_that_lies_is_refused(changes, what):
    with pytest.raises(HeadvoxError) as refused:
        cloud_points(cloud(**changes))
    assert what in refused.value.what
    assert "\n" not in str(refused.value)


def test_a_megabyte_of_garbage_is_points_or_a_refusal():
    rng = np.random.default_rng(3)
    garbage = rng.bytes(1_000_000)
    points = cloud_points(cloud(height=1, width=50_000, data=garbage))
    np.testing.assert_array_equal(
        points[::977], points_one_by_one(cloud(height=1, width=50_000, data=garbage))[::977]
    )
    for _ in range(300):  # and garbage in the header
        numbers = {
            name: int(rng.integers(0, 2**32)) >> int(rng.integers(0, 32)) for name in ("height", "width")
        }
        steps = {
            name: int(rng.integers(0, 2**32)) >> int(rng.integers(0, 32))
            for name in ("point_step", "row_step")
        }
        fields = [
            field(axis, int(rng.integers(0, 2**32)) >> int(rng.integers(0, 32)), int(rng.integers(0, 256)))
            for axis in "xyz"
        ]
        message = cloud(**numbers, **steps, fields=fields, data=garbage)
        try:
            points = cloud_points(message)
        except HeadvoxError:
            continue
        assert len(points) == message.height * message.width <= len(garbage)


def image(**changes):
    message = SimpleNamespace(
        height=3, width=4, encoding="16UC1", is_bigendian=0, step=8, data=np.arange(12, dtype="<u2").tobytes()
    )
    message.__dict__.update(changes)
    return message


@pytest.mark.parametrize("padding", [0, 3, 10])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "32FC1"])
def test_depth_in_any_layout_is_the_same(padding, order, encoding):
    millimetres = np.random.default_rng(1).integers(0, 60_000, (5, 7))
    values = (
        millimetres.astype(order + "u2") if encoding != "32FC1" else (millimetres / 1000).astype(order + "f4")
    )
    rows = [row.tobytes() + b"\xff" * padding for row in values]
    step = len(rows[0])
    message = image(
        height=5, width=7, encoding=encoding, is_bigendian=int(order == ">"), step=step, data=b"".join(rows)
    )
    depth = depth_image(message)
    assert depth.dtype == np.uint16
    assert depth.dtype.isnative
    assert depth.flags.c_contiguous
    np.testing.assert_array_equal(depth, millimetres)


def test_metres_that_are_no_depth_are_no_return():
    metres = np.array([[np.nan, np.inf, -np.inf, -1.0, 0.0, 0.0004, 65.6, 1e38, 65.535, 1.2344]], "<f4")
    depth = depth_image(image(height=1, width=10, encoding="32FC1", step=40, data=metres.tobytes()))
    assert depth.tolist() == [[0, 0, 0, 0, 0, 0, 0, 0, 65535, 1234]]


def test_an_image_as_it_should_be_is_not_copied():
    data = np.arange(12, dtype="<u2").tobytes()
    assert np.shares_memory(depth_image(image(data=data)), np.frombuffer(data, np.uint8))


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"encoding": "rgb8"}, "encoding is 'rgb8'"),
        ({"encoding": "x" * 10_000}, "expected 16UC1 or 32FC1"),
        ({"encoding": "32FC1"}, "step is 8, expected 16"),
        ({"width": 0}, "0 x 3 pixels"),
        ({"height": 0}, "4 x 0 pixels"),
        ({"step": 7}, "step is 7"),
        ({"data": b"\x00" * 23}, "23 bytes of data, its header says 24"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "step"),
        ({"height": 2**32 - 1}, "bytes of data"),
        ({"height": 1, "width": 2**32 - 1}, "bytes of data"),
    ],
)
def test_an_image_that_lies_is_refused(changes, what):
    with pytest.raises(HeadvoxError) as refused:
        depth_image(image(**changes))
    assert what in refused.value.what
    assert len(str(refused.value)) < 200


def info(**changes):
    message = SimpleNamespace(
        width=640,
        height=480,
        k=[525.0, 0.0, 319.5, 0.0, 526.0, 239.5, 0.0, 0.0, 1.0],
        p=[500.0, 0.0, 310.0, 0.0, 0.0, 501.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        binning_x=0,
        binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0),
    )
    message.__dict__.update(changes)
    return message


def test_the_lens_is_that_of_the_rectified_image():
    lens = intrinsics(info())
    assert (lens.width, lens.height, lens.depth_scale) == (640, 480, 0.001)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (500.0, 501.0, 310.0, 230.0)
    lens = intrinsics(info(p=[0.0] * 12))
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (525.0, 526.0, 319.5, 239.5)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"k": [0.0] * 9, "p": [0.0] * 12}, "fx = 0"),
        ({"p": [float("nan"), *[1.0] * 11]}, "fx = nan"),
        ({"width": 0, "height": 0}, "0 x 0 pixels"),
        ({"k": [-1.0, 0, 0, 0, 1, 0, 0, 0, 1], "p": [0.0] * 12}, "fx = -1"),
        ({"p": [500.0, 0.0, 1e9, 0.0, 0.0, 501.0, 230.0, 0, 0, 0, 1, 0]}, "principal point"),
        ({"p": [500.0, 0.0, float("nan"), 0.0, 0.0, 501.0, 230.0, 0, 0, 0, 1, 0]}, "principal point"),
        ({"binning_x": 2}, "binning"),
        ({"roi": SimpleNamespace(x_offset=10, y_offset=0, width=10, height=10)}, "region of interest"),
    ],
)
def test_a_camera_info_without_a_calibration_is_refused(changes, what):
    with pytest.raises(HeadvoxError) as refused:
        intrinsics(info(**changes))
    assert what in refused.value.what


@pytest.mark.parametrize(
    ("d", "topic", "is_told"),
    [
        ([-0.3, 0.1, 0.0, 0.0, 0.0], "/left/depth/image_raw", True),
        ([-0.3, 0.1, 0.0, 0.0, 0.0], "/direct/unrectified/image", True),
        ([-0.3, 0.1, 0.0, 0.0, 0.0], "/left/depth/image_rect_raw", False),
        ([-0.3, 0.1, 0.0, 0.0, 0.0], "/left/rectified/depth", False),
        ([0.0] * 5, "/left/depth/image_raw", False),
        ([], "/left/depth/image_raw", False),
        (np.zeros(8), "/left/depth/image_raw", False),
        (np.array([0, 0, 0, 0, 1e-3, 0, 0, 0]), "/left/depth/image_raw", True),
    ],
)
def test_distortion_is_told_of_what_may_not_be_rectified(d, topic, is_told):
    remark = distortion_remark(info(d=d, distortion_model="plumb_bob"), topic)
    assert bool(remark) == is_told
    if is_told:
        assert remark.startswith(f"{topic}: its camera_info has distortion ('plumb_bob')")
        assert "rectify it" in remark


def test_stamps_keep_every_nanosecond():
    assert stamp_ns(SimpleNamespace(sec=1_795_331_293, nanosec=728_705_848)) == 1_795_331_293_728_705_848
