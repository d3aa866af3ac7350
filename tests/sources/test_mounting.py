"""Clouds in files are placed by --mount, whatever their axes; who forgets it is told."""

import numpy as np
import pytest

from headvox import DepthImage, Detector, HeadvoxError, Intrinsics, open_source, sample_folder
from headvox.frames import OPTICAL, inverse, transform, unproject
from headvox.pixelgrid import AXES
from headvox.remarks import Remarks
from headvox.sources.describe import describe
from headvox.sources.mounting import BODY, WORDS, axes_of
from headvox.sources.options import SourceOptions, mount

PLACE = mount(1.0, -2.0, 1.4, 0.0, 12.0, 90.0)
NAMES = ["optical", "body", "opengl"]


def seen_in(image: DepthImage, T_sensor_optical) -> np.ndarray:
    return unproject(image.depth, image.intrinsics, T_sensor_optical).astype(np.float32)


def wall() -> DepthImage:
    depth = (1500 + 3 * np.arange(160)[None] + 2 * np.arange(90)[:, None]).astype(np.uint16)
    return DepthImage("wall", depth, Intrinsics(160, 90, 81.0, 81.0, 79.5, 44.5), PLACE @ OPTICAL)


def opened(path, T_world_mount=PLACE):
    notes: list[str] = []
    return open_source(path, SourceOptions(T_world_mount=T_world_mount), notes.append), notes


@pytest.mark.parametrize("T", AXES, ids=NAMES)
def test_a_depth_camera_s_cloud_is_placed_as_its_image_would_be(tmp_path, T):
    image = wall()
    np.save(tmp_path / "wall.npy", seen_in(image, T))
    source, notes = opened(tmp_path / "wall.npy")
    cloud = next(iter(source)).clouds[0]
    wanted = unproject(image.depth, image.intrinsics, image.T_world_camera)
    np.testing.assert_allclose(transform(cloud.T_world_sensor, cloud.points.astype(float)), wanted, atol=1e-5)
    axes = next(k for k, axes in enumerate(AXES) if axes is T)
    assert notes == [f"wall.npy: its points are taken to have {WORDS[axes]}"]


def test_heads_are_found_in_a_file_as_in_its_image(tmp_path):
    image = next(iter(open_source(sample_folder()))).depths[0]
    body = image.T_world_camera @ inverse(OPTICAL)
    np.save(tmp_path / "one.npy", seen_in(image, np.eye(4)))
    source, _ = opened(tmp_path / "one.npy", body)
    detector = Detector()
    heads, wanted = detector.detect_frame(next(iter(source))), detector.detect_depth(image)
    np.testing.assert_array_equal(heads.scores, wanted.scores)
    assert len(heads) >= 2


def cone(axis, count=5000):
    """Points ahead of a sensor, on no camera's pixels."""
    rng = np.random.default_rng(2)
    ahead = rng.normal(size=(count, 3)) * 0.3 + np.eye(3)[axis] * 2.0
    return ahead.astype(np.float32)


@pytest.mark.parametrize(
    ("points", "axes"),
    [(cone(2), 0), (cone(0), BODY), (-cone(2), 2), (np.concatenate([cone(0), -cone(0)]), BODY), (cone(1), BODY),
     (np.full((5, 3), 2.0, np.float32), BODY), (np.full((5, 3), np.nan, np.float32), BODY)],
)  # fmt: skip
def test_without_pixels_the_axis_along_which_all_lie_is_the_camera_s(points, axes):
    assert axes_of(points) == axes


def test_the_first_file_of_a_folder_tells_the_axes_of_all(tmp_path):
    np.save(tmp_path / "0.npy", cone(2))
    np.save(tmp_path / "1.npy", cone(0))
    source, notes = opened(tmp_path)
    places = [frame.clouds[0].T_world_sensor for frame in source]
    np.testing.assert_array_equal(places[0], places[1])
    np.testing.assert_allclose(places[0], PLACE @ OPTICAL)
    assert len(notes) == 1


def test_what_the_file_says_is_moved_with_the_mount(tmp_path):
    header = (
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0.5 1 0 0 0\nPOINTS 2\nDATA ascii\n"
    )
    (tmp_path / "a.pcd").write_text(header + "1 0 0\n2 0 0\n")
    source, notes = opened(tmp_path / "a.pcd", mount(0, 0, 1, 0, 0, 0))
    np.testing.assert_allclose(next(iter(source)).clouds[0].T_world_sensor[:3, 3], [0.0, 0.0, 1.5])
    assert notes == []
    rows = dict(describe(tmp_path / "a.pcd", SourceOptions(T_world_mount=mount(0, 0, 1, 0, 0, 0))))
    assert rows["sensor"] == "1.50 m above the floor at x 0.00 y 0.00 m by its VIEWPOINT and --mount"
    assert rows["box"] == "x 1.00 to 2.00 m, y 0.00 to 0.00 m, z 1.50 to 1.50 m, world frame"


@pytest.mark.parametrize("T", AXES, ids=NAMES)
def test_who_forgets_the_mount_of_a_camera_whose_z_is_not_up_is_told_once(tmp_path, T):
    for k in range(2):
        np.save(tmp_path / f"{k}.npy", seen_in(wall(), T))
    source, notes = opened(tmp_path, None)
    assert [frame.clouds[0].T_world_sensor for frame in source] == [None, None]
    if T is AXES[BODY]:
        assert notes == []
    else:
        (note,) = notes
        assert note.startswith("0.npy: its points are a depth camera's, z ")
        assert note.endswith("say where it stands with --mount X Y Z ROLL PITCH YAW")


def test_a_recording_takes_no_mount():
    with pytest.raises(HeadvoxError, match="--mount for these and for files of clouds"):
        opened(sample_folder())


def test_a_mount_that_is_plainly_wrong_is_told(tmp_path):
    image = next(iter(open_source(sample_folder()))).depths[0]
    np.save(tmp_path / "one.npy", seen_in(image, np.eye(4)))
    body = image.T_world_camera @ inverse(OPTICAL)
    for height, told in ((0.0, 0), (0.6, 1)):
        place = body.copy()
        place[2, 3] += height
        source, _ = opened(tmp_path / "one.npy", place)
        notes: list[str] = []
        Remarks(notes.append).used(next(iter(source)))
        assert len(notes) == told
        assert all("one.npy: what looks like the floor" in note and "z = 0.6" in note for note in notes)
