from dataclasses import replace
from importlib import resources

import naive_relief
import numpy as np
import pytest
import scenes

from headvox.config import DetectorConfig
from headvox.data import Cloud, DepthImage, Expected, Frame, Intrinsics
from headvox.errors import HeadvoxError
from headvox.evolve.write import relief_lines
from headvox.frames import unproject
from headvox.machine.threads import Threads
from headvox.masks.cascade import Relief, Spot
from headvox.masks.compile import CompiledRelief, compile_cascade
from headvox.masks.describe import describe_cascade
from headvox.masks.read import load_cascade, parse_cascade
from headvox.pipeline import Detector
from headvox.relief import gains_of, look_again, relief_about
from headvox.sample import sample_folder
from headvox.sources import open_source

SPOTS = np.array([(0.03 * side, 0.03 * up) for side in range(5) for up in range(-6, 7)])
RADIUS = np.array([0.1])
ALONE = Threads(1)
DEFAULT = (resources.files("headvox") / "cascades" / "default.toml").read_text("utf-8")
BEFORE = DEFAULT[: DEFAULT.index("[relief]")]


def compiled(relief: Relief) -> CompiledRelief:
    made = compile_cascade(replace(load_cascade("default"), relief=relief)).relief
    assert made is not None
    return made


def turned_images(count):
    rng = np.random.default_rng(count)
    camera = Intrinsics(60, 50, 52.0, 50.0, 29.7, 24.1, 0.0005)
    noisy = [rng.normal(2000, 700, (50, 60)).clip(0, 6000).astype(np.uint16) for _ in range(count)]
    for depth in noisy:
        depth[rng.random(depth.shape) < 0.4] = 0
    return tuple(DepthImage(f"c{k}", depth, camera, scenes.pose(rng)) for k, depth in enumerate(noisy))


@pytest.mark.parametrize("count", [1, 3])
def test_equals_the_naive_twin(count):
    images = turned_images(count)
    rng = np.random.default_rng(7)
    depths = (0.6003, 1.2003)  # not halfway between two mm, where the last bit of a pose decides
    before = [(image.T_world_camera @ [*rng.normal(0, 0.3, 2), d, 1])[:3] for image in images for d in depths]
    there = [image.T_world_camera[:3, 3] + 0.01 for image in images]  # where a camera stands, and all about
    centres = np.array([*before, *there, *rng.uniform(-1.5, 1.5, (12, 3))])
    radii = rng.uniform(0.05, 0.15, len(centres))
    relief, best = relief_about(images, centres, radii, SPOTS)
    np.testing.assert_array_equal(relief, naive_relief.relief_about(images, centres, radii, SPOTS))
    assert (best > 0).sum() > 2 * count
    assert (best == 0).any()
    assert len(np.unique(relief)) > 100


def test_above_and_below_a_camera_equals_the_naive_twin():
    image = turned_images(1)[0]
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    image = replace(image, T_world_camera=down)
    centres = np.array([[0.0, 0, -1.0], [1e-5, 1e-5, -1.1], [0.0, 0.1, -1.0], [0, 0, 1.0]])
    relief, best = relief_about((image,), centres, np.full(4, 0.1), SPOTS)
    np.testing.assert_array_equal(
        relief, naive_relief.relief_about((image,), centres, np.full(4, 0.1), SPOTS)
    )
    assert (best > 0).tolist() == [True, True, True, False]


def sphere_before_a_wall(T, radius=0.1):
    return scenes.image_of_spheres(np.random.default_rng(0), T, [(0.0, 0.0, 0.0, radius)], wall_m=1.8)


def test_a_sphere_before_a_wall_is_what_geometry_says_from_every_side():
    for T in (
        scenes.looking_along_x(-1.2, 0.0, 0.0),
        np.diag([-1.0, -1, 1, 1]) @ scenes.looking_along_x(-1.2, 0.0, 0.0),
    ):
        spots = np.array([[0.0, 0.0], [0.03, 0.06], [0.2, 0.0]])
        relief, _ = relief_about((sphere_before_a_wall(T),), np.zeros((1, 3)), np.array([0.1]), spots)
        near, far, measures = relief[0, :6:2], relief[0, 1:6:2], relief[0, 6:]
        assert near[0] == pytest.approx(-100, abs=15)  # the face of it
        assert near[1] == pytest.approx(-1000 * np.sqrt(0.1**2 - 0.03**2 - 0.06**2), abs=20)
        assert near[2] >= 550  # the wall
        assert np.abs(near - far).max() <= 30  # both sides are alike
        assert measures.tolist() == [1200, 0, 0, 100]


def test_measures_say_where_a_candidate_is():
    T = scenes.looking_along_x(-1.2, 0.0, 0.0)
    T[2, 3] = 0.5  # half a metre above the candidate, which is at 1.2 m from where it stands
    image, centre = sphere_before_a_wall(T), np.array([[0.0, 0.0, 0.0]])
    seen, _ = relief_about((image,), centre, np.array([0.093]), SPOTS)
    assert seen[0, -4:].tolist() == [1300, round(-1000 * 0.5 / 1.3), 0, 93]
    far, _ = relief_about((image,), np.array([[0.0, 0.0, 99.0]]), np.array([np.inf]), SPOTS)
    assert far[0].tolist() == [0] * (2 * len(SPOTS) + 2) + [32_000, 32_000]  # no camera sees it


def test_what_is_not_known_is_neither_free_nor_in_front():
    T = scenes.looking_along_x(-1.2, 0.0, 0.0)
    image = sphere_before_a_wall(T)
    spots, centre = np.array([[0.2, 0.0], [0.0, 0.0]]), np.zeros((1, 3))
    half = image.depth.copy()
    half[:, : image.intrinsics.width // 2 - 3] = 0
    radii = np.array([0.1])
    whole, _ = relief_about((image,), centre, radii, spots)
    one, _ = relief_about((replace(image, depth=half),), centre, radii, spots)
    assert one[0, 0] == one[0, 1]
    assert one[0, 0] in whole[0, :2]
    half[:, image.intrinsics.width // 2 + 3 :] = 0
    none, _ = relief_about((replace(image, depth=half),), centre, radii, spots)
    assert none[0, :2].tolist() == [0, 0]
    assert none[0, 2] == whole[0, 2]


def test_the_trees_of_the_default_add_up_as_the_naive_twin_says():
    source = load_cascade("default").relief
    assert source is not None
    source = replace(source, first=40, reach=0.4)
    rng = np.random.default_rng(3)
    images = turned_images(2)
    centres = np.array(
        [(image.T_world_camera @ [*rng.normal(0, 0.2, 2), 1.0, 1])[:3] for image in images for _ in range(20)]
    )
    relief = compiled(source)
    radii = rng.uniform(0.05, 0.15, len(centres))
    seen, best = relief_about(images, centres, radii, relief.spots)
    never = np.full(len(centres), -9000)
    said = []
    for lacking in (never, rng.integers(-3000, 9000, len(centres))):
        rows = zip(seen, best, lacking.tolist(), strict=True)
        wanted = [naive_relief.gain(row, source, lacks) if there else 0 for row, there, lacks in rows]
        for threads in (ALONE, Threads(3)):
            assert gains_of(images, centres, radii, lacking, relief, threads).tolist() == wanted
        assert len(set(wanted)) > 10
        said.append(wanted)
    assert said[0] != said[1]


@pytest.mark.parametrize(("lacking", "gained"), [(1023, 0.75), (1024, 0.75), (1025, 0.5)])
def test_what_lacks_too_much_after_the_first_trees_is_given_up(lacking, gained):
    image = sphere_before_a_wall(scenes.looking_along_x(-1.2, 0.0, 0.0))
    relief = compiled(Relief(2.0, (Spot("s", 0.0, 0.0),), (0.5, 0.25), first=1, reach=0.5))
    lacks = np.array([lacking])
    assert gains_of((image,), np.zeros((1, 3)), RADIUS, lacks, relief, ALONE).tolist() == [1024 * gained]


def test_no_tree_is_given_up_unless_the_file_says_so():
    read = parse_cascade(BEFORE + "[relief]\nmost = 1\ntrees = [0.5]\nspots = { a = [0, 0] }", "x")
    assert read.relief is not None
    assert (read.relief.first, read.relief.reach) == (0, np.inf)
    image = sphere_before_a_wall(scenes.looking_along_x(-1.2, 0.0, 0.0))
    lacks = np.array([1024])  # all that the trees may change
    assert gains_of((image,), np.zeros((1, 3)), RADIUS, lacks, compiled(read.relief), ALONE).tolist() == [512]


@pytest.mark.parametrize(("leaf", "gained"), [(0.5, 0.5), (9.0, 1.0), (-9.0, -1.0)])
def test_the_score_changes_by_no_more_than_the_cascade_allows(leaf, gained):
    image = sphere_before_a_wall(scenes.looking_along_x(-1.2, 0.0, 0.0))
    relief = compiled(Relief(1.0, (Spot("s", 0.0, 0.0),), (leaf,)))
    lacks = np.zeros(1, np.int64)
    assert gains_of((image,), np.zeros((1, 3)), RADIUS, lacks, relief, ALONE).tolist() == [1024 * gained]
    assert gains_of((image,), np.full((1, 3), 9.0), RADIUS, lacks, relief, ALONE).tolist() == [
        0
    ]  # out of view
    assert gains_of((), np.zeros((1, 3)), RADIUS, lacks, relief, ALONE).tolist() == [0]


@pytest.fixture(scope="module")
def sample():
    return next(iter(open_source(str(sample_folder()))))


def with_relief(tmp_path, leaf, least):
    path = tmp_path / f"{leaf}.toml"
    trees = f"[relief]\nmost = 2\ntrees = [{leaf}]\n[relief.spots]\nmiddle = [0, 0]\n"
    path.write_text(BEFORE + trees)
    return Detector(DetectorConfig(cascade=str(path), min_score=least, refine="sphere"), backend="cpu")


def test_the_last_look_keeps_and_drops(tmp_path, sample):
    plain = tmp_path / "plain.toml"
    plain.write_text(BEFORE)
    without = Detector(DetectorConfig(cascade=str(plain), min_score=0.0, refine="sphere"), backend="cpu")
    before = without.detect_frame(sample)
    assert len(before) >= 3
    least = float(np.floor(before.scores[2] * 1024) / 1024)
    more = with_relief(tmp_path, 1.5, least + 1.5).detect_frame(sample)
    np.testing.assert_array_equal(more.scores, before.scores[before.scores >= least] + 1.5)
    np.testing.assert_array_equal(more.centres, before.centres[before.scores >= least])
    assert more.sure.all()
    assert len(with_relief(tmp_path, -1.5, before.scores[0] - 1.0).detect_frame(sample)) == 0
    points = tuple(
        Cloud(i.name, unproject(i.depth, i.intrinsics, i.T_world_camera).astype(np.float32))
        for i in sample.depths
    )
    blind = [d.detect_frame(Frame(0, clouds=points)) for d in (without, with_relief(tmp_path, 1.5, 0.0))]
    np.testing.assert_array_equal(blind[0].scores, blind[1].scores)


def test_where_a_head_is_expected_less_is_enough(tmp_path, sample):
    heads = with_relief(tmp_path, 0.0, 0.0).detect_frame(sample)
    relief = compiled(Relief(2.0, (Spot("s", 0.0, 0.0),), (0.0,)))
    steps = np.rint(heads.scores * 1024).astype(int)
    expected = Expected(heads.centres[-1:], np.full((1, 4), np.nan), np.array([0.05]))
    common = (sample.depths, relief, int(steps[-1]) + 100)
    peaks = (heads.centres, heads.radii, steps)
    which, scores = look_again(*peaks, *common, 200, expected, 0.05, ALONE)
    assert which.tolist() == [*np.flatnonzero(steps >= steps[-1] + 100), len(heads) - 1]
    assert scores.tolist() == steps[which].tolist()
    without, _ = look_again(*peaks, *common, 200, None, 0.05, ALONE)
    assert len(heads) - 1 not in without
    again = with_relief(tmp_path, 0.0, float(steps[-1] + 100) / 1024).detect_frame(sample, expected)
    np.testing.assert_array_equal(again.scores, heads.scores[which])
    assert again.sure.tolist() == [True] * (len(which) - 1) + [False]


@pytest.mark.parametrize(
    ("relief", "said"),
    [
        ("relief = 3", "relief: expected a table"),
        ("[relief]\nmost = 1\ntrees = []", "relief.spots: expected a table of 1 to 256 spots"),
        ("[relief]\nmost = 1\ntrees = []\nspots = { a = [0] }", "relief.spots.a: expected two numbers"),
        (
            "[relief]\nmost = 1\ntrees = []\nspots = { a = [0, 9] }",
            "relief.spots.a: expected a number from -2 to 2",
        ),
        (
            "[relief]\nmost = -1\ntrees = []\nspots = { a = [0, 0] }",
            "relief.most: expected a number from 0 to 1000",
        ),
        (
            "[relief]\nmost = 1\nfirst = 2\ntrees = [1]\nspots = { a = [0, 0] }",
            "relief.first: expected a whole number from 0 to 1, got 2",
        ),
        (
            "[relief]\nmost = 1\nreach = -1\ntrees = [1]\nspots = { a = [0, 0] }",
            "relief.reach: expected a number from 0 to inf",
        ),
        (
            "[relief]\nmost = 1\ntrees = [['b.near', 0, 1, 2]]\nspots = { a = [0, 0] }",
            "relief.trees: expected",
        ),
        *(
            (
                f"[relief]\nmost = 1\ntrees = ['{words}']\nspots = {{ a = [0, 0] }}",
                f"relief.trees: expected {said}",
            )
            for words, said in (
                ("", "a leaf, or a feature"),
                ("b.near 0 1 2", "a leaf, or a feature"),
                ("a.near 0 1", "a leaf, or a feature"),
                ("a.near a.far 1 2", "a number from -1e\\+09"),
                ("a.near nan 1 2", "a number from -1e\\+09"),
                ("a.near 0 1 2000", "a number from -1000"),
                ("a.near 0 1 2 3", "one tree in a text"),
                ("a.near 0 " * 40 + "1 " * 41, "a leaf, or a feature of this file, 30 deep"),
            )
        ),
        ("[relief]\nmost = 1\ntrees = 4\nspots = { a = [0, 0] }", "relief.trees: expected a list"),
        ("[relief]\nmost = 1\ntrees = []\nspots = { a = [0, 0] }\nelse = 1", "relief: expected only"),
    ],
)
def test_a_relief_that_is_none_is_told_in_one_line(relief, said):
    text = relief + "\n" + BEFORE if relief.startswith("relief =") else BEFORE + relief
    with pytest.raises(HeadvoxError, match=said):
        parse_cascade(text, "x")


def test_a_tree_in_words_is_the_same_tree():
    spots = "spots = { a = [0, 0] }"
    lists = BEFORE + f"[relief]\nmost = 1\ntrees = [['a.near', 0.5, -1, ['range', 2, 0.25, 3]], 0.5]\n{spots}"
    words = BEFORE + f"[relief]\nmost = 1\ntrees = ['a.near 0.5 -1 range 2 0.25 3', '0.5']\n{spots}"
    read = parse_cascade(lists, "x")
    assert parse_cascade(words, "x") == read
    written = "\n".join(relief_lines(read.relief))
    assert "first = 0\nreach = inf\n" in written
    assert "'a.near 0.5 -1 range 2 0.25 3'" in written
    assert parse_cascade(BEFORE + written, "x") == read


def test_the_last_look_is_described():
    told = describe_cascade(load_cascade("default"))
    assert "The last look, in depth images: 800 trees over 110 pairs of spots" in told
