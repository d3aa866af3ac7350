import numpy as np
import pytest
from cloud_writers import POINTS, SQUARE, camera, npy, pcd, ply, png, recording, write_json

from headvox.errors import HeadvoxError
from headvox.sources.describe import describe

# 2.35 m up, looking along world y, 30 degrees down
SINE, COSINE = 0.5, 3**0.5 / 2
TILTED = [[1, 0, 0, 0], [0, -SINE, COSINE, 0], [0, -COSINE, -SINE, 2.35], [0, 0, 0, 1]]


def test_a_surface(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply(SQUARE, faces=[(0, 1, 2, 3)]))
    rows = dict(describe(tmp_path / "a.ply"))
    assert rows["name"] == "a.ply"
    assert rows["kind"] == "ply, binary little endian"
    assert rows["frames"] == "1"
    samples = int(rows["points"]) - 5
    assert samples > 100
    assert rows["faces"] == f"1: 5 vertices and {samples} samples of the surface"
    assert rows["finite"] == "100.0%"
    assert rows["box"] == "x 0.00 to 0.10 m, y 0.00 to 0.20 m, z 0.00 to 0.00 m"
    assert rows["other fields"] == "red, weights, tag, quality"


def test_a_cloud_with_holes_and_a_sensor(tmp_path):
    points = np.vstack([POINTS, np.full((4, 3), np.nan)]).astype(np.float32)
    (tmp_path / "a.pcd").write_bytes(pcd(points, viewpoint="0 0 2 1 0 0 0"))
    rows = dict(describe(tmp_path / "a.pcd"))
    assert rows["finite"] == "50.0%"
    assert rows["box"] == "x -1.00 to 1.00 m, y -0.50 to 2.00 m, z 2.12 to 3.75 m, world frame"
    assert rows["sensor"] == "2.00 m above the floor at x 0.00 y 0.00 m by its VIEWPOINT"
    assert "faces" not in rows


def test_a_folder_is_described_by_its_first_good_file(tmp_path):
    for name, data in (("1.npy", b"broken"), ("2.npy", npy()), ("10.npy", npy(POINTS * 2))):
        (tmp_path / name).write_bytes(data)
    rows = dict(describe(tmp_path))
    assert rows["frames"] == "3 files"
    assert rows["duration"].startswith("0.07 s")
    assert rows["described file"] == "2.npy"
    assert rows["points"] == "4"


def test_a_folder_without_a_good_file_is_refused(tmp_path):
    (tmp_path / "1.npy").write_bytes(b"broken")
    with pytest.raises(HeadvoxError, match=r"1\.npy: expected"):
        describe(tmp_path)


def test_a_recording(tmp_path):
    content = recording(
        tmp_path, frames=4, cameras={"left": camera(T_world_camera=TILTED), "right": camera()}
    )
    content["frames"][2]["T_world_camera"] = {"right": TILTED}
    write_json(tmp_path, content)
    for i in range(4):
        depth = np.zeros((6, 8), np.uint16)
        depth[:3] = 2000
        (tmp_path / "left" / f"{i:06d}.png").write_bytes(png(depth))
    (tmp_path / "left" / "000003.png").write_bytes(b"broken")
    rows = dict(describe(tmp_path))
    assert rows["kind"] == "depth recording"
    assert rows["frames"] == "4"
    assert rows["duration"] == "0.30 s"
    assert rows["camera left"] == (
        "8x6, 4 images, 10.0 fps, 2.35 m above the floor at x 0.00 y 0.00 m, tilted 30.0° down"
    )
    assert rows["camera right"].startswith("8x6, 3 images, 6.7 fps, 0.00 m above the floor")
    assert rows["camera right"].endswith(", tilted 90.0° up, moving")
    assert rows["looked at"] == "4 of 4 frames, 1 of them cannot be read"
    assert rows["points"] == f"{5 * 48} pixels in them"


def test_a_recording_whose_images_show_nothing(tmp_path):
    recording(tmp_path, frames=1)
    for side in ("left", "right"):
        (tmp_path / side / "000000.png").write_bytes(png(np.zeros((6, 8), np.uint16)))
    rows = dict(describe(tmp_path))
    assert rows["finite"] == "0.0% of the pixels have a return"
    assert rows["box"] == "no points"
    assert "one moment" in rows["camera left"]


def test_nothing_in_it_steers_a_terminal(tmp_path):
    data = ply().replace(b"uchar red", b"uchar r\x1b[d")
    (tmp_path / "a.ply").write_bytes(data)
    rows = dict(describe(tmp_path / "a.ply"))
    assert rows["other fields"].startswith("r?[d, weights")
