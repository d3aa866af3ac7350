"""Bake the head that the pose fit aligns into ``src/headvox/assets/template.npz``.

The heads are those of ``headvox.synth``: haired and dressed people in every posture, with their necks and shoulders.
Each is brought into its own head frame and to the size of the mean head; depth cameras all around it say what can be
seen of its surface and what of the space about it is free, which gives a signed distance on a grid of 10 mm voxels:
above zero where it is free. Every person counts twice, once mirrored. What is kept:

- the mean signed distance;
- its principal modes near the surface, hair and clothes weighing less than a face; the rest by regression;
- the standard deviation of what the modes leave unexplained: small on a face, large on hair and shoulders;
- where the centre of a head of some shape is, from fits of shells and of people who are seen all around;
- how much surer a fit believes itself to be than it is, from fits of other simulated people in rooms.

Identities are drawn from seeds of their own (``TRAINING``), which nothing that measures accuracy uses.

    python tools/bake_template.py --people 400 --workers 2
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial
from importlib.resources import files
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from headvox.data import Cloud, Frame, Intrinsics
from headvox.errors import HeadvoxError
from headvox.frames import inverse, transform
from headvox.machine.kernels import kernel
from headvox.machine.threads import Threads
from headvox.parallel.workers import Workers
from headvox.pose.align import SCALE_SIGMA
from headvox.pose.fit import FitMemory, fit_poses
from headvox.pose.residuals import EVIDENCE
from headvox.pose.trials import STANDS, TRIED
from headvox.synth.heads import HEADVOX_TO_PAPER, make_shell, sample_identities
from headvox.synth.people import Person, PosedBody, pose_person, sample_person, sample_pose
from headvox.synth.people import _rest as rest
from headvox.synth.portraits import portrait
from headvox.synth.rays import Mesh, look
from headvox.synth.spread import spread_points

ASSET = Path(str(files("headvox").joinpath("assets/template.npz")))  # what the fits below read
TRAINING = 0x7E3A1
POSTURES = ("standing", "walking", "sitting", "bending", "crouching", "lying")
POSTURE_SHARES = (0.35, 0.25, 0.25, 0.05, 0.05, 0.05)
VOXEL_M = 0.01
LOW = np.array((-0.26, -0.28, -0.30))  # of the grid, head frame, metres
SHAPE = (52, 56, 51)
DIRECTIONS = 60
LOWEST_DIRECTION = -0.35  # sine of the elevation: from below one would look through the bodies
AWAY_M = 1.6
LENS = Intrinsics(200, 200, 375.0, 375.0, 99.5, 99.5)
FARTHEST_M = 0.08  # distances are cut off here
BAND_M = 0.025  # how far from the surface a mode matters
MEAN_UNIT_M, SIGMA_UNIT_M = 5e-5, 2e-4
SHELLS, SHELL_POINTS = 360, 9000  # heads that are seen all around
FIRST_VIEW = 100_000  # of those that the calibration is learnt from
RIDGE = 10.0
SURELY = 0.98  # a point more than is promised: so far apart are the people of two seeds
FLOOR_M = 0.0025  # of a sigma: what the template's voxels cost


def voxel_centres() -> np.ndarray:
    """Return the centres (N, 3) of the grid's voxels in the head frame, z fastest."""
    axes = [low + VOXEL_M * (np.arange(n) + 0.5) for low, n in zip(LOW, SHAPE, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def camera_poses() -> np.ndarray:
    """Return T_head_camera (C, 4, 4) of cameras all around, each looking at the head's centre."""
    k = np.arange(2 * DIRECTIONS) + 0.5
    height = 1.0 - k / DIRECTIONS
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - height**2)
    places = np.column_stack([flat * np.cos(angle), flat * np.sin(angle), height])
    poses = []
    for place in places[height > LOWEST_DIRECTION]:
        right = np.cross(-place, (0.0, 0.0, 1.0))
        right /= max(np.linalg.norm(right), 1e-9)
        T = np.eye(4)
        T[:3, :3] = np.column_stack([right, np.cross(-place, right), -place])
        T[:3, 3] = AWAY_M * place
        poses.append(T)
    return np.array(poses)


def signed_distance(body: PosedBody, scale: float) -> np.ndarray:
    """Return the signed distance (N,) of the voxels to the visible surface, of the head scaled to the mean size."""
    voxels = voxel_centres()
    seen = np.zeros(len(voxels), np.int64)
    surface = []
    for T_head_camera, distance, points in look_around(body, scale):
        surface.append(points)
        count_sights(voxels, inverse(T_head_camera), LENS.fx, LENS.cx, distance, seen)
    points = np.concatenate(surface)
    points = points[(np.abs(points) < 0.4).all(1)]
    key = np.floor(points / 0.003).astype(np.int64) @ (1, 1000, 1000_000)
    tree = cKDTree(points[np.unique(key, return_index=True)[1]])
    distance = np.minimum(tree.query(voxels, distance_upper_bound=FARTHEST_M)[0], FARTHEST_M)
    return np.where(seen > 1, distance, -distance).astype(np.float16)


def look_around(body: PosedBody, scale: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield T_head_camera, the depth image and its points (N, 3), head frame, of cameras around a scaled head."""
    vertices = transform(inverse(body.T_world_head), body.vertices) / scale
    ones = np.ones(len(body.faces), np.float32)
    mesh = Mesh(vertices, body.faces, ones, np.zeros(len(ones), np.int32))
    for T_head_camera in camera_poses():
        distance = look(mesh, LENS, T_head_camera).distance_m
        v, u = np.nonzero(distance < AWAY_M + 0.5)
        z = distance[v, u].astype(np.float64)
        rays = np.column_stack([(u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy, np.ones(len(u))])
        yield T_head_camera, distance, transform(T_head_camera, rays * z[:, None])


@kernel
def count_sights(voxels, T_camera_head, f, c, distance, seen):
    """Add one to ``seen`` (N,) for each of ``voxels`` (N, 3) that lies before the surface in a square image."""
    T = T_camera_head
    for i in range(len(voxels)):
        x, y, z = voxels[i]
        depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        column = int(np.rint(f * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth + c))
        row = int(np.rint(f * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth + c))
        if 0 <= column < distance.shape[1] and 0 <= row < distance.shape[0] and depth < distance[row, column]:
            seen[i] += 1


def training_person(number: int) -> tuple[Person, PosedBody]:
    """Return the training person ``number``, and their body in some posture."""
    rng = np.random.default_rng([TRAINING, number])
    person = sample_person(rng)
    return person, pose_person(person, sample_pose(rng, str(rng.choice(POSTURES, p=POSTURE_SHARES))))


def head_of(number: int, size_m: float) -> tuple[np.ndarray, float]:
    """Return the signed distance of the training person ``number`` and their log scale."""
    person, body = training_person(number)
    size = rest(person)[0].head_size
    scale = float(np.exp(np.log(size).mean()) / size_m)
    return signed_distance(body, scale), float(np.log(scale))


def mean_size_m(people: int) -> float:
    """Return the geometric mean over depth, breadth and height of the training people's bald heads."""
    persons = [sample_person(np.random.default_rng([TRAINING, number])) for number in range(people)]
    return float(np.exp(np.mean([np.log(rest(person)[0].head_size).mean() for person in persons])))


def learn(distances: np.ndarray, modes: int) -> dict[str, np.ndarray]:
    """Return mean, modes and sigma of ``distances`` (people, voxels), which are mirrored here."""
    people, distances = len(distances), distances.astype(np.float32)
    mirrored = distances.reshape(people, *SHAPE)[:, :, ::-1].reshape(people, -1)
    both = np.concatenate([distances, mirrored])
    mean = both.mean(0)
    both -= mean
    spread = both.std(0)
    weight = np.exp(-((mean / BAND_M) ** 2)) / (spread**2 + 0.008**2)
    near = weight > 1e-3 * weight.max()
    values, vectors = np.linalg.eigh((both[:, near] * weight[near]) @ both[:, near].T)
    print("share explained", np.round(values[::-1][:12] / values.sum(), 3).tolist())
    scores = vectors[:, ::-1][:, :modes] * np.sqrt(2 * people)  # unit variance
    shapes = scores.T @ both / (2 * people)
    left = both - scores @ shapes
    sigma = np.sqrt((left**2).mean(0))
    smooth = gaussian_filter(sigma.reshape(SHAPE), 0.7).reshape(-1)
    surface = np.abs(mean) < 0.01
    print(
        "sigma near the surface, median before and after the modes, mm",
        1e3 * np.median(spread[surface]),
        1e3 * np.median(sigma[surface]),
    )
    return {"mean": mean, "modes": shapes, "sigma": np.hypot(smooth, FLOOR_M)}


def quantised(learnt: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of the asset, in whole numbers of a unit each."""
    greatest = np.abs(learnt["modes"]).max(1)
    return {
        "mean": np.rint(learnt["mean"] / MEAN_UNIT_M).astype(np.int16).reshape(SHAPE),
        "mean_unit_m": np.array(MEAN_UNIT_M),
        "modes": np.rint(learnt["modes"] / greatest[:, None] * 127).astype(np.int8).reshape(-1, *SHAPE),
        "mode_units_m": greatest / 127,
        "sigma": np.clip(np.rint(learnt["sigma"] / SIGMA_UNIT_M), 1, 255).astype(np.uint8).reshape(SHAPE),
        "sigma_unit_m": np.array(SIGMA_UNIT_M),
        "low_m": LOW,
        "voxel_m": np.array(VOXEL_M),
    }


def all_around(number: int) -> np.ndarray:
    """Return a cloud (N, 3), head frame, of a head that is seen all around: of two in three a bald shell."""
    rng = np.random.default_rng([TRAINING, 3, number])
    if number % 3 < 2:
        shell = make_shell(sample_identities(SHELLS, TRAINING)[number], metric=False)
        return spread_points(shell.vertices, shell.faces, SHELL_POINTS, rng) @ HEADVOX_TO_PAPER
    points = np.concatenate([points for _, _, points in look_around(training_person(number)[1], 1.0)])
    return rng.permutation(points[np.linalg.norm(points, axis=1) < 0.3])[:SHELL_POINTS]


def shape_and_shift(number: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Fit the head ``number`` that is seen all around, and return 1, log scale and modes (2 + MODES,), and where its
    centre is from the fitted one (3,), at the size of the mean head; None where the fit is wrong."""
    rng = np.random.default_rng([TRAINING, 4, number])
    turn, off = Rotation.from_quat(rng.normal(size=4)), rng.normal(0.0, 0.02, 3)
    cloud = np.ascontiguousarray(turn.apply(all_around(number)), dtype=np.float32)
    memory = FitMemory.new(1, 1)
    fit_poses(Frame(0, clouds=(Cloud("head", cloud),)), off[None], memory, Threads(1))
    trials = memory.trials
    state = trials.states[0, np.argmin(trials.told[0, : trials.counts[0, TRIED], EVIDENCE])]
    R = state[3:12].reshape(3, 3)
    wrong = (turn.inv() * Rotation.from_matrix(R)).magnitude()
    if trials.counts[0, STANDS] or wrong > np.radians(20.0):
        return None
    return np.array([1.0, *state[12:]]), -(R.T @ (off + state[:3])) / np.exp(state[12])


def centre_of_shape(fits: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return the linear function (3, 2 + MODES) of what :func:`shape_and_shift` returns, by ridge regression."""
    X, Y = (np.array(part) for part in zip(*fits, strict=True))
    penalty = RIDGE * np.eye(X.shape[1])
    penalty[0, 0] = 0.0
    penalty[1, 1] *= SCALE_SIGMA**2  # of the log scale, as of the modes: by its own spread
    B = np.linalg.solve(X.T @ X + penalty, X.T @ Y)
    for name, off in (("before", Y), ("after", Y - X @ B)):
        far = 1e3 * np.linalg.norm(off, axis=1)
        print(f"centre seen all around, {name}: {np.median(far):.1f} / {np.percentile(far, 90):.1f} mm")
    return np.asarray(B.T)


def odds_and_errors(number: int) -> tuple[np.ndarray, ...] | None:
    """Fit the training view ``number``: evidence (S,) and yaw (S,) of its starts, from the best; the best one's yaw
    variance, yaw error and squared error of the centre in its own covariance."""
    rng = np.random.default_rng([TRAINING, 1, number])
    distance, bearing, cameras = rng.uniform(0.85, 3.3), rng.uniform(-np.pi, np.pi), 1 + (rng.random() < 0.15)
    try:
        view = portrait((TRAINING, 2, number), float(distance), float(bearing), int(cameras))
    except HeadvoxError:  # no room had space for it
        return None
    off = rng.normal(size=3)
    start = view.head.centre + rng.uniform(0.03, 0.05) * off / np.linalg.norm(off)
    memory = FitMemory.new(1, 1)
    poses, trials = fit_poses(view.frame, start[None], memory, Threads(1)), memory.trials
    count = trials.counts[0, TRIED]
    if count == 0:
        return None
    evidence = trials.told[0, :count, EVIDENCE]
    best = int(np.argmin(evidence))
    R = trials.states[0, :count, 3:12].reshape(-1, 3, 3)
    turns = Rotation.from_matrix(R[best].T @ R).as_rotvec()
    true = Rotation.from_quat(view.head.quaternion).as_matrix()
    error = Rotation.from_matrix(R[best].T @ true).as_rotvec()[2]
    shift = R[best].T @ (poses.centres[0] - view.head.centre)
    covariance = trials.covariances[0]
    squared = shift @ np.linalg.solve(covariance[:3, :3], shift)
    return evidence - evidence[best], turns[:, 2], covariance[5, 5], error, squared


def calibration(fits: list[tuple[np.ndarray, ...]]) -> np.ndarray:
    """Return temperature, shift factor and turn factor (3,) that make what is stated true of ``fits``.

    The factors bring the median of squared errors over variances to that of chi-squared; the temperature is the least
    at which ``SURELY`` of the yaws that are stated to 15 degrees are right to 30.
    """
    variance = np.array([fit[2] for fit in fits])
    error = np.abs([fit[3] for fit in fits])
    right = error < np.radians(30.0)
    turn = float(np.median(error[right] ** 2 / variance[right]) / 0.455)
    shift = float(np.median([fit[4] for fit in fits]) / 2.366)
    for temperature in np.arange(1.0, 24.1, 0.25):
        odds = [np.exp(-fit[0] / temperature) for fit in fits]
        others = [float(share @ fit[1] ** 2 / share.sum()) for share, fit in zip(odds, fits, strict=True)]
        sure = np.sqrt(turn * variance + others) < np.radians(15.0)
        if right[sure].mean() >= SURELY:
            break
    print(
        f"of {len(fits)} yaws {sure.mean():.0%} stated to 15 degrees, {right[sure].mean():.1%} of these right"
    )
    return np.array([temperature, max(shift, 1.0), max(turn, 1.0)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--people", type=int, default=400)
    parser.add_argument("--modes", type=int, default=16)
    parser.add_argument("--views", type=int, default=1400, help="fits that the calibration is learnt from")
    parser.add_argument("--calibrate-only", action="store_true", help="keep the shapes that are there")
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    if args.calibrate_only:
        with np.load(ASSET, allow_pickle=False) as known:
            asset = {name: known[name] for name in known.files}
    else:
        size_m = mean_size_m(args.people)
        made = list(Workers(args.workers).map(partial(head_of, size_m=size_m), range(args.people)))
        print(f"mean size {size_m:.4f} m, log scale sigma {np.std([scale for _, scale in made]):.3f}")
        asset = quantised(learn(np.array([distance for distance, _ in made]), args.modes))
        untaught = {"calibration": np.ones(3), "centre_of_shape": np.zeros((3, 2 + args.modes))}
        asset |= {"size_m": np.array(size_m)} | untaught
        np.savez_compressed(ASSET, **asset)
    known = Workers(args.workers).map(shape_and_shift, range(SHELLS))
    asset["centre_of_shape"] = centre_of_shape([fit for fit in known if fit is not None])
    np.savez_compressed(ASSET, **asset)
    fits = list(Workers(args.workers).map(odds_and_errors, range(FIRST_VIEW, FIRST_VIEW + args.views)))
    asset["calibration"] = calibration([fit for fit in fits if fit is not None])
    print("temperature, shift factor, turn factor:", asset["calibration"].round(2).tolist())
    np.savez_compressed(ASSET, **asset)
    print(f"{ASSET.name}: {ASSET.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
