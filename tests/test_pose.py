from importlib.resources import files

import naive_pose
import numpy as np
import pytest
import scenes
from scipy.spatial.transform import Rotation

from headvox import Cloud, DepthImage, Frame, Intrinsics
from headvox.data import Expected
from headvox.machine.threads import Threads
from headvox.pose import align, nearby, residuals, settle, trials
from headvox.pose.fit import FitMemory, Poses, all_turns, expected_turns, fit_poses, upright_turns
from headvox.pose.template import WORDS, load_template
from headvox.pose.trials import Scratch
from headvox.synth.heads import HEADVOX_TO_PAPER, make_shell, sample_identities
from headvox.synth.portraits import portrait
from headvox.synth.spread import spread_points

TEMPLATE = load_template()
SURE_DEG = 15.0  # a yaw that is stated to this counts as known, see bench/refine.py


def camera(distance=1.0, width=48, focal=45.0):
    """A camera that looks along x at the origin."""
    return (
        Intrinsics(width, width, focal, focal, width / 2 - 0.5, width / 2 - 0.5),
        scenes.looking_along_x(-distance, 0, 0),
    )


def bumpy_image(rng, distance=1.0):
    """A wall with a bulge of noise in its middle, some pixels lost."""
    lens, T = camera(distance)
    depth = np.full((48, 48), 2600, np.uint16)
    depth[20:27, 20:28] = rng.normal(1000 * distance, 60, (7, 8)).astype(np.uint16)
    depth[rng.random((48, 48)) < 0.1] = 0
    return DepthImage("bumpy", depth, lens, T)


def gathered(frame, centre):
    samples, rays = (
        np.zeros((nearby.MOST_SAMPLES, nearby.SAMPLE)),
        np.zeros((nearby.MOST_SAMPLES, nearby.RAY)),
    )
    n, m = nearby.gather(nearby.sensors_of(frame), np.asarray(centre, dtype=np.float64), samples, rays)
    return samples[:n], rays[:m]


def fitted(frame, centres, expected=None, threads=1):
    pool = Threads(threads)
    try:
        starts = np.asarray(centres, dtype=np.float64).reshape(-1, 3)
        return fit_poses(frame, starts, FitMemory.new(threads, len(starts)), pool, expected)
    finally:
        pool.close()


@pytest.fixture(scope="module")
def views():
    """People nobody has learnt from, three quarters from the front, each with a start 4 cm off."""
    rng = np.random.default_rng(3)
    made = []
    for k in range(11):
        view = portrait((0x7E57, k), 1.0 + 0.2 * (k % 3), 0.2 * (k % 7 - 3), posture="standing")
        off = rng.normal(size=3)
        made.append((view, view.head.centre + 0.04 * off / np.linalg.norm(off)))
    return made


# -------------------------------------------------------------------------------------------------------- the twins


@pytest.mark.parametrize("seed", range(3))
def test_gathering_equals_the_naive_twin(seed):
    rng = np.random.default_rng(seed)
    cloud = rng.normal(0, 0.3, (300, 3)).astype(np.float32)
    cloud[::7] = np.nan
    T = scenes.pose(rng)
    frame = Frame(
        0, clouds=(Cloud("known", cloud, T), Cloud("unknown", cloud)), depths=(bumpy_image(rng, 0.9),)
    )
    centre = rng.normal(0, 0.05, 3)
    for got, wanted in zip(gathered(frame, centre), naive_pose.gather(frame, centre), strict=True):
        assert len(wanted) > 20
        np.testing.assert_allclose(got, wanted, atol=1e-12)


@pytest.mark.parametrize("distance", [0.1, 3.0, 60.0])
@pytest.mark.parametrize("knows", [True, False])
def test_gathering_misses_nothing_however_far_the_sensor(distance, knows):
    rng = np.random.default_rng(int(distance))
    T = scenes.pose(rng)
    centre = T[:3, 3] + distance * T[:3, 0]
    cloud = np.vstack([rng.normal(0, 0.2, (500, 3)), rng.normal(0, 0.3, (1000, 3))])
    cloud[:500] += [distance, 0, 0]
    cloud[500:] += [distance + 2.0, 0, 0]
    if not knows:
        cloud, T = cloud @ T[:3, :3].T + T[:3, 3], None
    frame = Frame(
        0, clouds=(Cloud("cloud", np.ascontiguousarray(rng.permutation(cloud), dtype=np.float32), T),)
    )
    for got, wanted in zip(gathered(frame, centre), naive_pose.gather(frame, centre), strict=True):
        assert len(wanted) > 100 or not knows
        np.testing.assert_allclose(got, wanted, atol=1e-12)


def random_state(rng):
    state = np.zeros(residuals.STATE)
    state[:3] = rng.normal(0, 0.02, 3)
    state[3:12] = Rotation.from_rotvec(rng.normal(0, 0.7, 3)).as_matrix().reshape(9)
    state[12] = rng.normal(0, 0.05)
    state[13:] = rng.normal(0, 0.7, residuals.MODES)
    return state


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("modes", [trials.COARSE_MODES, residuals.MODES])
def test_normal_equations_equal_the_naive_twin(seed, modes):
    rng = np.random.default_rng(seed)
    samples, rays = gathered(Frame(0, depths=(bumpy_image(rng),)), np.zeros(3))
    state, upright = random_state(rng), seed % 2 == 0
    points = np.ascontiguousarray(samples[naive_pose.even(len(samples), 150)].T)
    passing = np.ascontiguousarray(rays[naive_pose.even(len(rays), 90)].T)
    n, m = points.shape[1], passing.shape[1]
    work, told = Scratch.new(), np.zeros(residuals.TOLD)
    work.J[:], work.words[:] = np.nan, -1  # what an earlier fit may have left
    place = (TEMPLATE, state, work.J, work.words, work.A, told)
    cost = align.linearise(points, n, passing, m, modes, 4.0, upright, True, *place)
    A = work.A.copy()
    wanted = naive_pose.linearise(samples, rays, (150, 90), modes, 4.0, upright, TEMPLATE, state)
    size = 7 + modes
    np.testing.assert_allclose(cost, wanted[0], rtol=1e-9)
    np.testing.assert_allclose(np.triu(A[:size, :size]), np.triu(wanted[1]), rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(A[:size, residuals.RESIDUAL], wanted[2], rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(told[:3], wanted[3], rtol=1e-9)
    assert told[residuals.CROSSED] > 0
    work.A[:] = 0.0
    alone = align.linearise(points, n, passing, m, modes, 4.0, upright, False, *place)
    assert alone == cost
    assert not work.A.any()


@pytest.mark.parametrize("away", [0.0, 0.15, 5.0], ids=["near", "half outside", "outside"])
@pytest.mark.parametrize(("n", "m"), [(20, 0), (32, 1), (33, 31), (240, 120), (400, 400)])
def test_any_number_of_points_and_rays_equals_the_naive_twin(n, m, away):
    rng = np.random.default_rng(n)
    samples, rays = rng.normal(0.0, 0.08, (n, nearby.SAMPLE)), rng.normal(0.0, 0.08, (m, nearby.RAY))
    samples[:, 0] += away
    samples[:, 6:] = rng.uniform(0.001, 0.05, (n, 2))
    for directions in (samples[:, 3:6], rays[:, 3:6]):
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    state, work, told = random_state(rng), Scratch.new(), np.zeros(residuals.TOLD)
    work.J[:], work.words[:] = np.nan, -1
    cost = align.linearise(
        samples.T.copy(), n, rays.T.copy(), m, trials.FINE_MODES, 3.0, True, True, TEMPLATE, state, work.J, work.words,
        work.A, told,
    )  # fmt: skip
    size = 7 + trials.FINE_MODES
    wanted = naive_pose.linearise(samples, rays, (n, m), trials.FINE_MODES, 3.0, True, TEMPLATE, state)
    np.testing.assert_allclose(cost, wanted[0], rtol=1e-9)
    np.testing.assert_allclose(np.triu(work.A[:size, :size]), np.triu(wanted[1]), rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(work.A[:size, residuals.RESIDUAL], wanted[2], rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(told[:3], wanted[3], rtol=1e-9)
    if away == 5.0:
        assert told[residuals.ON_SURFACE] == 0
        assert told[residuals.COST] == 4.5 * n


def test_each_voxel_of_the_template_says_what_the_asset_does():
    with np.load(files("headvox") / "assets/template.npz") as asset:
        mean, sigma = (asset[name] * asset[f"{name}_unit_m"] for name in ("mean", "sigma"))
        modes = asset["modes"] * asset["mode_units_m"][:, None, None, None]
    count = len(TEMPLATE.voxels) - 1
    J, words = np.full((residuals.ROWS, count + 1), np.nan), np.full((WORDS, count + 1), -1)
    J[residuals.VOXEL] = np.arange(count + 1)
    assert residuals.look_up(0, count + 1, residuals.MODES, TEMPLATE, J, words) == 1
    residuals.unpack(0, count + 1, residuals.MODES, TEMPLATE, words, J)
    np.testing.assert_allclose(J[residuals.DISTANCE, :-1], mean.reshape(-1), rtol=1e-12)
    np.testing.assert_allclose(J[residuals.SIGMA, :-1], sigma.reshape(-1), rtol=1e-12)
    gradients = np.array(np.gradient(mean, TEMPLATE.voxel_m)).reshape(3, -1)
    np.testing.assert_allclose(J[:3, :-1], gradients, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        J[7 : 7 + residuals.MODES, :-1], modes.reshape(residuals.MODES, -1), rtol=1e-12
    )
    assert J[residuals.SIGMA, -1] > 0.0  # what lies outside
    assert not J[[0, 1, 2, *range(7, 7 + residuals.MODES), residuals.DISTANCE], -1].any()


def cost_of_a_point_behind(ray_x, sigma):
    """Twice what a point on the back of the mean head costs, seen along ``ray_x`` (1: through the face)."""
    distances = TEMPLATE.voxels[:-1].view("<i2")[:, 0].reshape(TEMPLATE.shape)
    y, z = (int(-TEMPLATE.low[a] / TEMPLATE.voxel_m) for a in (1, 2))
    x = int(np.argmax(distances[:, y, z] < 0))  # the first voxel inside, from behind
    place = TEMPLATE.low + (np.array([x, y, z]) + 0.5) * TEMPLATE.voxel_m
    samples = np.array([[*place, ray_x, 0.0, 0.0, sigma, 0.001]]).T.copy()
    state, work, told = np.zeros(residuals.STATE), Scratch.new(), np.zeros(residuals.TOLD)
    state[[3, 7, 11]] = 1.0
    cost = align.linearise(
        samples, 1, np.zeros((6, 0)), 0, 0, 2.5, False, True, TEMPLATE, state, work.J, work.words, work.A, told,
    )  # fmt: skip
    return 2.0 * cost, told[residuals.COST]


def test_a_point_on_a_surface_that_faces_away_costs_more_the_less_noise_there_is():
    (seen, bare), (near, near_bare), (far, _) = (
        cost_of_a_point_behind(ray_x, sigma) for ray_x, sigma in ((1.0, 0.005), (-1.0, 0.005), (-1.0, 0.05))
    )
    assert seen < 0.5 < far < near
    assert bare == near_bare


def test_one_start_equals_the_naive_twin(views):
    for view, start in views[:2]:
        samples, rays = gathered(view.frame, start)
        turn = Rotation.from_quat(view.head.quaternion).as_matrix().reshape(1, 9)
        scratch = Scratch.new()
        scratch.samples[: len(samples)], scratch.rays[: len(rays)] = samples, rays
        tried = trials.Trials.new(1)
        trials.search(scratch, len(samples), len(rays), turn[0], turn, turn, TEMPLATE, tried, 0)
        state, told = naive_pose.refine_one(samples, rays, turn[0], True, TEMPLATE)
        assert tried.counts[0, trials.TRIED] == tried.counts[0, trials.REFINED] == 1
        np.testing.assert_allclose(tried.states[0, 0], state, atol=1e-6)
        np.testing.assert_allclose(tried.told[0, 0], told, rtol=1e-6)
        trials.polish(scratch, tried, 0, 0, TEMPLATE)
        state, told, covariance = naive_pose.polish_one(samples, rays, state, True, TEMPLATE)
        np.testing.assert_allclose(tried.states[0, 0], state, atol=1e-6)
        np.testing.assert_allclose(tried.told[0, 0, : residuals.EVIDENCE], told, rtol=1e-6)
        np.testing.assert_allclose(tried.covariances[0], covariance, rtol=1e-4, atol=1e-12)


def scattered(rng, count):
    """What a fit may come to: states about one another, what they cost, and covariances."""
    work = settle.Refined(
        np.zeros((trials.MOST_REFINED, residuals.STATE)),
        np.zeros((trials.MOST_REFINED, residuals.TOLD)),
        np.zeros((6, 6)),
    )
    for s in range(count):
        work.states[s] = random_state(rng)
        if s and rng.random() < 0.5:  # half a turn away: where rotation vectors jump
            half = Rotation.from_rotvec(np.pi * np.eye(3)[rng.integers(3)]).as_matrix()
            work.states[s, 3:12] = (work.states[0, 3:12].reshape(3, 3) @ half).reshape(9)
    root = rng.normal(0, 0.02, (6, 6))
    work.covariance[:] = root @ root.T
    work.told[:, residuals.EVIDENCE] = rng.normal(0, 10, len(work.told))
    return work


@pytest.mark.parametrize("seed", range(20))
def test_settling_equals_the_naive_twin(seed):
    rng = np.random.default_rng(seed)
    count = 1 + seed % trials.MOST_REFINED
    work, centre, poses = scattered(rng, count), rng.normal(size=3), Poses.unknown(np.zeros((2, 3)))
    best = int(np.argmin(work.told[:count, residuals.EVIDENCE]))
    if seed % 4 == 3:
        work.told[(best + 1) % count, residuals.EVIDENCE] = (
            np.nan if count > 1 else work.told[best, residuals.EVIDENCE]
        )
    settle.settle(work, count, best, centre, TEMPLATE, poses, 1)
    wanted = naive_pose.settle(work, count, best, centre, TEMPLATE)
    got = (poses.centres[1], poses.radii[1], poses.centre_covariances[1], poses.quaternions[1])
    for one, other in zip((*got, poses.rotation_covariances[1]), wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
    assert np.isnan(poses.radii[0])


@pytest.mark.parametrize("seed", range(4))
def test_the_centre_of_a_shape_equals_the_naive_twin(seed):
    rng = np.random.default_rng(seed)
    template = TEMPLATE._replace(centre_of_shape=rng.normal(0, 0.003, TEMPLATE.centre_of_shape.shape))
    state, start, poses = random_state(rng), rng.normal(size=3), Poses.unknown(np.zeros((2, 3)))
    poses.centres[1] = start
    settle.recentre(state, template, poses, 1)
    np.testing.assert_allclose(poses.centres[1], naive_pose.recentre(start, state, template), rtol=1e-9)
    assert np.linalg.norm(poses.centres[1] - start) > 1e-4
    assert not poses.centres[0].any()


def test_turns_between_states_equal_scipys():
    rng = np.random.default_rng(0)
    turns = [np.zeros(3), 1e-12 * np.ones(3), *rng.normal(0, 2, (40, 3)), *((np.pi - 1e-7) * np.eye(3))]
    for turn in turns:
        one, other = random_state(rng), random_state(rng)
        R = one[3:12].reshape(3, 3)
        other[3:12] = (R @ Rotation.from_rotvec(turn).as_matrix()).reshape(9)
        wanted = Rotation.from_rotvec(turn).as_rotvec()
        np.testing.assert_allclose(settle.turn_between(one, other), wanted, atol=1e-7)
        q = settle.quaternion_of(*other[3:12])
        np.testing.assert_allclose(Rotation.from_quat(q).as_matrix().reshape(9), other[3:12], atol=1e-12)


# -------------------------------------------------------------------------------------------------------- the truth


def test_heads_are_where_it_says_within_what_it_states(views):
    far, turned, covered = [], [], []
    for view, start in views:
        poses = fitted(view.frame, start)
        error = poses.centres[0] - view.head.centre
        far.append(np.linalg.norm(error))
        assert (
            error @ np.linalg.solve(poses.centre_covariances[0], error) < 16.3
        )  # one in a thousand is farther
        assert 0.07 < poses.radii[0] < 0.12
        covered.append(poses.coverages[0])
        if np.isfinite(poses.quaternions).all():
            turn = Rotation.from_quat(poses.quaternions[0]).inv() * Rotation.from_quat(view.head.quaternion)
            d = turn.as_rotvec()
            turned.append(np.degrees(np.linalg.norm(d)))
            assert d @ np.linalg.solve(poses.rotation_covariances[0], d) < 16.3
    assert np.median(far) < 0.012
    assert max(far) < 0.03
    assert np.median(covered) > 0.9
    assert min(covered) > 0.8  # a hand, or hair that falls over the shoulders
    assert len(turned) >= len(views) - 2  # of one in six it is in doubt
    assert np.median(turned) < 8


def test_the_back_of_a_head_knows_its_centre_and_not_its_yaw(views):
    sigmas = []
    for k in range(5):
        view = portrait((0x7E57, 100 + k), 2.0, np.pi + 0.1 * (k - 2), posture="standing")
        off = np.random.default_rng(k).normal(size=3)
        poses = fitted(view.frame, view.head.centre + 0.04 * off / np.linalg.norm(off))
        error = poses.centres[0] - view.head.centre
        assert np.linalg.norm(error) < 0.03
        squared = error @ np.linalg.solve(poses.centre_covariances[0], error)
        assert squared < 16.3  # one in a thousand is farther
        assert np.sqrt(np.trace(poses.centre_covariances[0])) < 0.05
        sigmas.append(np.degrees(np.sqrt(poses.rotation_covariances[0, 2, 2])))
        assert np.isnan(poses.quaternions[0]).all() == np.isnan(sigmas[-1])
        if sigmas[-1] < SURE_DEG:
            turn = Rotation.from_quat(poses.quaternions[0]).inv() * Rotation.from_quat(view.head.quaternion)
            assert np.degrees(turn.magnitude()) < 30
    faces = [
        np.degrees(np.sqrt(fitted(view.frame, start).rotation_covariances[0, 2, 2])) for view, start in views
    ]
    assert np.median(np.nan_to_num(sigmas, nan=90.0)) > SURE_DEG  # the back does not say where the face is
    assert np.median(np.nan_to_num(faces, nan=90.0)) < SURE_DEG  # the face does


def test_a_shell_is_found_however_it_is_turned():
    shell = make_shell(sample_identities(3, 11)[1], False)
    points = spread_points(shell.vertices, shell.faces, 1500, np.random.default_rng(0)) @ HEADVOX_TO_PAPER
    for seed in range(4):
        rng = np.random.default_rng(seed)
        R, centre = Rotation.random(random_state=seed), rng.uniform(-0.5, 0.5, 3)
        cloud = (R.apply(points) + centre).astype(np.float32)
        poses = fitted(Frame(0, clouds=(Cloud("shell", cloud),)), centre + np.array((0.03, -0.02, 0.02)))
        assert np.linalg.norm(poses.centres[0] - centre) < 0.01
        turn = R.inv() * Rotation.from_quat(poses.quaternions[0])
        assert np.degrees(turn.magnitude()) < 8


def test_from_an_expected_orientation(views):
    view, start = views[0]
    turned = Rotation.from_quat(view.head.quaternion) * Rotation.from_euler("z", 12, degrees=True)
    expected = Expected(view.head.centre[None], turned.as_quat()[None], np.array([0.2]))
    poses = fitted(view.frame, start, expected)
    error = Rotation.from_quat(poses.quaternions[0]).inv() * Rotation.from_quat(view.head.quaternion)
    assert np.linalg.norm(poses.centres[0] - view.head.centre) < 0.02
    assert np.degrees(error.magnitude()) < 15


def test_what_is_expected_holds_within_reach_only():
    expected = Expected(
        np.array([[0, 0, 0], [1, 0, 0], [0.1, 0, 0]], dtype=np.float64),
        np.array([[0, 0, 0, 1], [0, 0, 1, 0], [np.nan] * 4]),
        np.array([0.2, 0.1, 0.5]),
    )
    turns = expected_turns(np.array([[0.08, 0, 0], [1.05, 0, 0], [0.7, 0, 0]]), expected)
    np.testing.assert_allclose(turns[0], np.eye(3).reshape(9))
    np.testing.assert_allclose(turns[1], np.diag([-1, -1, 1]).reshape(9), atol=1e-12)
    assert np.isnan(turns[2]).all()


def test_the_starts_are_rotations():
    for turns, count in ((upright_turns(), 12), (all_turns(), 60)):
        R = turns.reshape(-1, 3, 3)
        assert len(R) == count
        np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (count, 1, 1)), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(R), 1)


# ------------------------------------------------------------------------------------------------------ hard inputs


def cloud_of(points):
    return Frame(0, clouds=(Cloud("c", np.ascontiguousarray(points, dtype=np.float32)),))


@pytest.mark.parametrize(
    "points",
    [
        np.full((50, 3), np.nan),
        np.full((50, 3), 9.0),
        np.zeros((1, 3)),
        np.array([[np.inf, 0, 0], [-np.inf, 1, 1], [0, 0, 0]]),
    ],
    ids=["all NaN", "far away", "one", "infinite"],
)
def test_too_little_leaves_the_candidate_as_it_is(points):
    poses = fitted(cloud_of(points), [[0.0, 0.1, 0.0]])
    assert poses.centres.tolist() == [[0.0, 0.1, 0.0]]
    for unknown in (poses.quaternions, poses.radii, poses.centre_covariances, poses.misfits):
        assert np.isnan(unknown).all()


@pytest.mark.parametrize("kind", ["plane", "line", "same point"])
def test_points_that_are_no_head_give_finite_centres(kind):
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (2000, 3))
    points[:, {"plane": [2], "line": [1, 2], "same point": [0, 1, 2]}[kind]] = 0.01
    poses = fitted(cloud_of(points), [[0.0, 0.0, 0.0]])
    assert np.isfinite(poses.centres).all()
    assert np.linalg.norm(poses.centres) < 0.3
    assert np.linalg.eigvalsh(poses.centre_covariances[0]).min() > 0


def test_no_candidate():
    assert fitted(cloud_of(np.zeros((5, 3))), np.empty((0, 3))).centres.shape == (0, 3)


def test_a_huge_image_and_a_dense_cloud_do_not_overrun_the_memory():
    lens, T = camera(0.6, 3000, 3000.0)
    image = DepthImage("huge", np.full((3000, 3000), 600, np.uint16), lens, T)
    dense = np.random.default_rng(0).normal(0, 0.1, (200_000, 3)).astype(np.float32)
    sensors = (Cloud("a", dense), Cloud("b", dense, T))
    samples, _ = gathered(Frame(0, clouds=sensors, depths=(image,)), np.zeros(3))
    assert len(samples) <= nearby.MOST_SAMPLES
    kinds = [np.sum(samples[:, 7] == nearby.UNKNOWN_SIGMA_M), np.sum(samples[:, 7] < 0.0003)]
    assert min(kinds) > 500  # every sensor has its share
    assert np.isfinite(fitted(Frame(0, depths=(image,)), [[0.0, 0.0, 0.0]]).centres).all()


def test_more_sensors_than_room():
    image = bumpy_image(np.random.default_rng(0))
    samples, rays = np.zeros((50, nearby.SAMPLE)), np.zeros((50, nearby.RAY))
    n, m = nearby.gather(nearby.sensors_of(Frame(0, depths=(image,) * 120)), np.zeros(3), samples, rays)
    assert 0 < n <= 50
    assert m <= 50


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_do_not_change_a_byte(views, threads):
    view, start = views[0]
    starts = start + np.random.default_rng(0).normal(0, 0.02, (7, 3))
    one, many = fitted(view.frame, starts), fitted(view.frame, starts, threads=threads)
    for name in ("centres", "quaternions", "radii", "centre_covariances", "rotation_covariances", "misfits"):
        assert getattr(one, name).tobytes() == getattr(many, name).tobytes()
