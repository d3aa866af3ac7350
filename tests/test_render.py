"""Pictures: what is in them, that a file is whole or not there, and the command."""

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import headvox
from headvox.cli import main
from headvox.data import Cloud, DepthImage, Frame, Heads, Intrinsics
from headvox.errors import HeadvoxError
from headvox.frames import inverse, transform, unproject
from headvox.render import film as film_module
from headvox.render.colours import GROUND, HEADS, HEIGHT, INK
from headvox.render.film import open_film
from headvox.render.scene import draw_scene, points_of, viewpoint_for
from headvox.render.sheet import Sheets, draw_depth, layout
from headvox.sinks import Result

SAMPLE = Path(headvox.__file__).parent / "assets" / "sample"
LIGHT = ["--refine", "sphere"]


@pytest.fixture(scope="module")
def frame() -> Frame:
    return next(iter(headvox.open_source(SAMPLE)))


def heads_at(*centres: tuple[float, float, float], quaternion: tuple[float, ...] = (np.nan,) * 4) -> Heads:
    count = len(centres)
    return Heads(np.array(centres), np.tile(quaternion, (count, 1)), np.full(count, 0.1), np.ones(count))


def tracks_of(heads: Heads, identity: int = 0) -> list:
    return [replace(track, id=identity) for track in Result(0, 0, 1.0, heads).rows()]


def near(picture: Image.Image, colour: tuple[int, int, int], within: int = 12) -> np.ndarray:
    """Return where a picture has about that colour."""
    return (np.abs(np.asarray(picture).astype(int) - colour) <= within).all(axis=2)


# ------------------------------------------------------------------------------------------------ what is drawn


@pytest.mark.parametrize("quaternion", [(np.nan,) * 4, (0.0, 0.0, 0.0, 1.0)])
def test_a_head_is_drawn_where_the_camera_sees_it(quaternion: tuple[float, ...]) -> None:
    camera = Intrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
    T = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # looks along x
    image = DepthImage("cam", np.full((240, 320), 2500, np.uint16), camera, T)
    centre = (2.0, 0.4, 1.7)
    x, y, z = transform(inverse(T), np.array([centre]))[0]
    u, v = 2 * (300 * x / z + 159.5), 2 * (300 * y / z + 119.5)
    without = draw_depth(image, [], (640, 480))
    drawn = draw_depth(image, tracks_of(heads_at(centre, quaternion=quaternion), 2), (640, 480))
    assert drawn.size == (640, 480)
    assert not near(without, HEADS[1]).any()
    rows, columns = np.nonzero((np.asarray(drawn) != np.asarray(without)).any(axis=2))
    half = 2 * 300 * 0.15 / z
    assert abs(0.5 * (columns.min() + columns.max()) - u) < 6
    assert half * 0.6 < columns.max() - u < half * 1.8
    assert rows.max() - v == pytest.approx(half, rel=0.4)
    assert near(drawn, HEADS[1]).sum() > 100


def test_a_head_behind_the_camera_is_not_drawn() -> None:
    T = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    image = DepthImage("cam", np.full((48, 64), 2500, np.uint16), Intrinsics(64, 48, 60, 60, 31.5, 23.5), T)
    behind = draw_depth(image, tracks_of(heads_at((-1.0, 0.0, 1.5))), (640, 480))
    assert np.array_equal(np.asarray(behind), np.asarray(draw_depth(image, [], (640, 480))))


def test_everything_on_the_stage_and_the_cameras_fit_into_the_scene(frame: Frame) -> None:
    points = points_of(frame)
    view = viewpoint_for(frame, points, 640, 480)
    places = points.places[np.abs(points.places[:, :2]).max(axis=1) < 1.5]
    places = np.concatenate([places[places[:, 2] < 1.8], [i.T_world_camera[:3, 3] for i in frame.depths]])
    x, y, z = transform(inverse(view.T_world_camera), places).T
    u, v = view.camera.fx * x / z + view.camera.cx, view.camera.fy * y / z + view.camera.cy
    inside = (z > 0) & (u > 0) & (u < 640) & (v > 0) & (v < 480)
    assert inside.mean() > 0.99
    assert inside[-len(frame.depths) :].all()
    assert np.linalg.det(view.T_world_camera[:3, :3]) == pytest.approx(1.0)
    assert view.T_world_camera[2, 3] > 2.0  # from above


def test_a_cloud_is_coloured_by_height_the_nearest_in_front() -> None:
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-1, 1, 80)), -1).reshape(-1, 2)
    floor, table = np.c_[grid, np.full(len(grid), 0.5)], np.c_[grid, np.full(len(grid), 1.9)]
    frame = Frame(0, clouds=(Cloud("c", np.concatenate([table, floor]).astype(np.float32)),))
    points = points_of(frame)
    view = viewpoint_for(frame, points, 400, 300)
    drawn = draw_scene(frame, points, view)
    high, low = tuple(HEIGHT[int(1.9 / 2.0 * len(HEIGHT))]), tuple(HEIGHT[int(0.5 / 2.0 * len(HEIGHT))])
    x, y, z = transform(inverse(view.T_world_camera), np.array([[0.0, 0.0, 1.9]]))[0]
    u, v = view.camera.fx * x / z + view.camera.cx, view.camera.fy * y / z + view.camera.cy
    assert near(drawn, high)[round(v) - 5 : round(v) + 5, round(u) - 5 : round(u) + 5].mean() > 0.9
    assert near(drawn, low).any()
    assert near(drawn, GROUND, 0).mean() > 0.05


def test_a_wall_seen_from_behind_does_not_hide_the_room(frame: Frame) -> None:
    points = points_of(frame)
    sensors = {image.name: image.T_world_camera[:3, 3] for image in frame.depths}
    for image in frame.depths:
        own = points_of(Frame(0, depths=(image,)))
        towards = ((sensors[image.name] - own.places) * own.normals).sum(axis=1)
        assert (towards > 0).mean() > 0.99  # a surface faces the sensor that saw it
    assert len(points.places) <= sum(
        len(unproject(i.depth, i.intrinsics, i.T_world_camera)) for i in frame.depths
    )


@pytest.mark.parametrize("count", range(7))
def test_any_number_of_images_fits_on_a_sheet(frame: Frame, count: int) -> None:
    where = layout(frame.depths[:1] * count, 1200)
    width, height = where.size
    assert width == 1200
    assert height % 2 == 0
    assert 300 < height < 800
    left, top, wide, tall = where.scene
    assert (left + wide, top + tall) == (width, height)
    assert wide >= 0.45 * width
    if count:
        rows = -(-count // where.columns)
        assert where.columns * where.cell[0] <= left
        assert rows * where.cell[1] <= height


def test_an_empty_scene_is_drawn_too() -> None:
    far = Frame(0, clouds=(Cloud("c", np.full((10, 3), 1e4, np.float32)),))
    picture = Sheets(640).draw(far, Result(0, 0, 1.0, Heads()))
    assert picture.size[0] == 640
    nothing = DepthImage("cam", np.zeros((24, 32), np.uint16), Intrinsics(32, 24, 30, 30, 16, 12), np.eye(4))
    assert near(Sheets(640).draw(Frame(0, depths=(nothing,)), Result(0, 0, 1.0, Heads())), INK, 40).any()


# -------------------------------------------------------------------------------------------------------- films


def flat(shade: int) -> Image.Image:
    return Image.new("RGB", (64, 48), (shade, shade, shade))


@pytest.mark.parametrize("suffix", [".png", ".gif", ".mp4"])
def test_after_an_error_the_older_file_is_still_there(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"film{suffix}"
    path.write_bytes(b"old")

    def film_and_fail() -> None:
        with open_film(path) as film:
            for n in range(12):
                film.add(flat(n), 100_000_000 * n)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        film_and_fail()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_film_without_pictures_is_no_file(tmp_path: Path) -> None:
    for suffix in (".png", ".gif", ".mp4"):
        with open_film(tmp_path / f"film{suffix}"):
            pass
    assert list(tmp_path.iterdir()) == []


def test_a_gif_takes_as_long_as_the_stamps_say(tmp_path: Path) -> None:
    stamps_ms = [0, 100, 200, 700, 705]
    with open_film(tmp_path / "film.gif") as film:
        for n, stamp in enumerate(stamps_ms):
            film.add(Image.new("RGB", (64, 48), HEADS[n]), stamp * 1_000_000)
    shown = []
    with Image.open(tmp_path / "film.gif") as gif:
        for n in range(gif.n_frames):
            gif.seek(n)
            shown.append((gif.info["duration"], gif.convert("RGB").getpixel((5, 5))))
    assert [ms for ms, _ in shown] == [100, 100, 500, 20, 100]
    assert [colour for _, colour in shown] == list(HEADS[:5])


@pytest.mark.parametrize("count", [1, 3, 12])
def test_an_mp4_plays(tmp_path: Path, count: int) -> None:
    path = tmp_path / "film.mp4"
    with open_film(path) as film:
        for n in range(count):
            film.add(flat(20 * n), 200_000_000 * n)
    told = subprocess.run(
        [film_module._ffmpeg(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "gray", "-"],
        capture_output=True,
    )
    assert told.returncode == 0
    shades = np.frombuffer(told.stdout, np.uint8).reshape(-1, 48, 64)
    assert len(shades) == count
    assert np.abs(shades.mean(axis=(1, 2)) - 20 * np.arange(count)).max() < 4
    assert b"h264" in told.stderr
    if count > 1:
        assert b"5 fps" in told.stderr


def test_an_encoder_that_gives_up_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = tmp_path / "ffmpeg"
    fake.write_text("#!/bin/sh\necho no space >&2\nexit 3\n")
    fake.chmod(0o755)
    monkeypatch.setattr(film_module, "_ffmpeg", lambda: str(fake))
    with pytest.raises(HeadvoxError, match="no space"), open_film(tmp_path / "film.mp4") as film:
        film.add(flat(1), 0)
    assert list(tmp_path.iterdir()) == [fake]


def test_an_mp4_without_its_library_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(HeadvoxError, match=r"headvox\[view\]"):
        open_film(tmp_path / "film.mp4")
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    with pytest.raises(HeadvoxError, match="No such file"):
        open_film(tmp_path / "nowhere" / "film.gif")


# -------------------------------------------------------------------------------------------------- the command


def test_the_command_draws_every_frame_and_twice_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.gif", "b.gif"):
        assert (
            main(
                ["render", str(SAMPLE), "-o", str(tmp_path / name), "--limit", "4", "--width", "600", *LIGHT]
            )
            == 0
        )
    out = capsys.readouterr()
    assert out.out == f"{tmp_path / 'a.gif'}\n{tmp_path / 'b.gif'}\n"
    assert "\r" not in out.err
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()
    with Image.open(tmp_path / "a.gif") as gif:
        assert (gif.n_frames, gif.size[0]) == (4, 600)
        gif.seek(3)
        last = gif.convert("RGB")
    for colour in HEADS[:3]:  # three people, with their ids since the third frame
        assert near(last, colour, 6).sum() > 50
    assert len(np.unique(np.asarray(last).reshape(-1, 3), axis=0)) > 60


def test_a_png_is_one_frame(tmp_path: Path) -> None:
    whole, short = tmp_path / "whole.png", tmp_path / "short.png"
    assert main(["render", str(SAMPLE), "-o", str(short), "--limit", "3", "--width", "600", *LIGHT]) == 0
    assert main(["render", str(SAMPLE), "-o", str(whole), "--at", "2", "--width", "600", *LIGHT]) == 0
    assert whole.read_bytes() == short.read_bytes()


def test_a_frame_that_is_not_there_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", str(SAMPLE), "-o", str(tmp_path / "a.png"), "--at", "99", *LIGHT]) == 1
    assert "Frame 99 cannot be drawn: the source has 24 frames, 0 bad." in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_leaves_what_was_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw, drawn = Sheets.draw, []

    def stop_at_third(self: Sheets, frame: Frame, result: Result) -> Image.Image:
        if len(drawn) == 2:
            raise KeyboardInterrupt
        drawn.append(result.frame)
        return draw(self, frame, result)

    monkeypatch.setattr(Sheets, "draw", stop_at_third)
    path = tmp_path / "a.gif"
    assert main(["render", str(SAMPLE), "-o", str(path), "--width", "400", *LIGHT]) == 130
    with Image.open(path) as gif:
        assert gif.n_frames == 2
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["-o", "a.gif", "--at", "1"], "--at goes with -o NAME.png only"),
        (["-o", "a.png", "--at", "1", "--limit", "2"], "--at and --limit"),
        (["-o", "a.jpg"], "expected a name that ends with .gif, .mp4 or .png"),
        (["-o", "a.png", "--width", "10"], "expected 320 to 4096 pixels"),
        ([], "required: -o"),
    ],
)
def test_wrong_usage(arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", *arguments]) == 2
    assert told in capsys.readouterr().err


def test_nothing_is_written_into_the_source(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", str(SAMPLE), "-o", str(SAMPLE / "a.png")]) == 1
    assert "would be written into the input" in capsys.readouterr().err
    assert not (SAMPLE / "a.png").exists()
