"""What is fitted on a GPU: spheres, points near heads and poses, as on the CPU within a tolerance; see on_gpu.py."""

from types import SimpleNamespace

import numba
import numpy as np
import pytest
import scenes
from busts import camera_frame
from gpu_arrays import (
    METRES,
    REGION,
    counts_with,
    places_of,
    random_parts,
    to_device,
    use_few_turns,
    volume_of,
    words_for,
)
from numba import cuda

from headvox import Cloud, Frame, assemble
from headvox.cuda import fits as fits_module
from headvox.cuda import (
    nearby,
    pose,
    readings,
    refine,
    suppress,
)
from headvox.cuda.device import is_simulated
from headvox.cuda.fits import Fits
from headvox.data import Expected
from headvox.lattice import Lattice
from headvox.machine.cholesky import half_log_determinant
from headvox.machine.threads import Threads
from headvox.pose import align, residuals, trials
from headvox.pose import fit as pose_on_cpu
from headvox.pose import nearby as nearby_on_cpu
from headvox.pose.fit import Poses
from headvox.pose.nearby import gather_points, sensors_of
from headvox.refine import COUNT, HAIR_M, MOST_PARTS, RADIUS, ROWS, fit_spheres
from headvox.suppress import suppress_overlaps
from headvox.voxelize import Rays

# The simulator computes as NumPy's scalars do, which tell of what the hardware does silently.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore:Grid size")


@pytest.mark.parametrize("counting", [False, True])
def test_the_same_spheres(counting):
    """Also of peaks at the edges and of one in empty space, with and without hair."""
    rng = np.random.default_rng(13)
    shape = (9, 8, 9)
    grid = random_parts(rng, shape, 0.3)
    if counting:
        grid = rng.integers(0, 3, shape).astype(np.uint32)
    grid[:3] = 0
    cells = np.array([[4, 4, 4], [0, 0, 0], [8, 7, 2], [5, 0, 8]], np.int32)
    fits = Fits(1, len(cells), "sphere", 0.06, 1 if counting else 2, counting)
    lattice = Lattice((1.2, -0.6, 0.3), 0.06, shape, fits.subdivision, REGION)
    wanted = np.empty((len(cells), 6))
    room = np.empty((ROWS, MOST_PARTS))
    fit_spheres(grid.reshape(1, -1), shape, cells, 0.06, fits.subdivision, counting, room, wanted)
    assert wanted[:, COUNT].min() == 0
    assert wanted[:, COUNT].max() > 40
    for haired in (False, True):
        frame = Frame(0, clouds=(Cloud("c", np.zeros((1, 3), np.float32), np.eye(4) if haired else None),))
        uploaded = upload(readings.Asked(frame, lattice, False, 0))
        fits.kept.copy_to_device(np.arange(len(cells), dtype=np.int32)[::-1].copy()[None])
        refine.fit_spheres[(2, 1), fits_module.SPHERE_THREADS](
            volume_of(np.zeros(shape, np.uint8)), uploaded.whole, uploaded.wide, *to_device(grid.reshape(1, -1)),
            counts_with(suppress.KEPT, len(cells)), *to_device(places_of(cells, shape)), fits.kept, fits.reach, 0.06,
            fits.subdivision, counting, True, fits.spheres,
        )  # fmt: skip
        got = fits.spheres.copy_to_host()[0, ::-1]
        centres = lattice.centres(cells) + wanted[:, :3]
        np.testing.assert_allclose(got[:, :3], centres - [0, 0, HAIR_M * haired], atol=METRES)
        np.testing.assert_allclose(got[:, RADIUS], wanted[:, RADIUS], atol=METRES)


@pytest.mark.parametrize("count", [0, 1, 12])
def test_the_same_of_heads_that_overlap(count):
    rng = np.random.default_rng(count)
    centres, scores = rng.uniform(0, 0.4, (count, 3)), rng.integers(0, 4, count)
    room = max(count, 1)
    fits = Fits(1, room, "none", 0.05, 2, False)
    kept = rng.permutation(count).astype(np.int32)
    fits.kept.copy_to_device(np.resize(kept, (1, room)).astype(np.int32))
    spheres, of_peaks = np.zeros((1, room, 4)), np.zeros((1, room), np.int64)
    spheres[0, :count, :3], of_peaks[0, kept] = centres, scores
    counts = counts_with(suppress.KEPT, count)
    refine.suppress_overlaps[(1, 1), 2](
        counts,
        *to_device(of_peaks),
        fits.kept,
        *to_device(spheres),
        assemble.SAME_HEAD_M,
        fits.order,
        fits.heads,
    )
    wanted = suppress_overlaps(centres, scores, assemble.SAME_HEAD_M)
    assert fits.heads.copy_to_host()[0, : len(wanted)].tolist() == wanted.tolist()
    assert counts.copy_to_host()[0, suppress.HEADS] == len(wanted)
    assert count < 12 or len(wanted) < count


@pytest.mark.skipif(not is_simulated(), reason="only the simulator lets the host call a device function")
@pytest.mark.parametrize("room", [2, 3, 7, 8])
def test_a_full_list_is_thinned_as_on_the_cpu(room):
    for there in (0, 1, room - 1, room, room + 1, 3 * room, 41, 64):
        points = np.zeros((there, 3), np.float32)
        points[:, 0] = np.arange(there) / 1000
        samples, rays = np.empty((room, 8)), np.empty((room, 6))
        n, _ = gather_points(points, np.eye(4)[:3], False, 1.0, 0, 0, room, room, samples, rays)
        wanted = np.round(samples[:n, 0] * 1000).astype(int).tolist()
        places = {nearby.place_of(k + 1, there, room): k for k in range(there)}
        places.pop(-1, None)
        assert [places[k] for k in range(len(places))] == wanted
        assert nearby.length_of(there, room) == n


def upload(asked):
    """Return what a search has of a frame that is uploaded."""
    words = words_for([asked])
    rows = np.zeros((1, words), np.int32)
    readings.pack(asked, lambda image, lattice: Rays.of(image, lattice), rows[0])
    whole = cuda.to_device(rows)
    wide, real = whole.view(np.float64), whole.view(np.float32)
    return SimpleNamespace(
        whole=whole, wide=wide, real=real, half=whole.view(np.uint16), stream=0,
        octets=wide.reshape(1, words // readings.OCTET, 8),
    )  # fmt: skip


def fitted_on_device(frame, centres, expected=None):
    """Return the poses near ``centres``, and what they were fitted with."""
    lattice = Lattice.over(REGION, 0.05, 2)
    uploaded = upload(readings.Asked(frame, lattice, False, 0, expected=expected))
    uploaded.counts = counts_with(suppress.HEADS, len(centres))
    fits = Fits(1, len(centres) + 1, "pose", 0.05, 2, False)
    spheres, heads = np.zeros((1, len(centres) + 1, 4)), np.zeros((1, len(centres) + 1), np.int32)
    spheres[0, 1:, :3], heads[0, : len(centres)] = centres, np.arange(1, len(centres) + 1)
    fits.spheres.copy_to_device(spheres)
    fits.heads.copy_to_device(heads)
    fits.launch_poses(uploaded, 1)
    poses = Poses(*(array.copy_to_host()[: len(centres)] for array in fits.poses))
    return poses, fits


def head_and_wall(rng, count=34, behind=12):
    """Return points on a head at 1 m along x, on its side that faces the origin, and on a wall behind it."""
    bust = scenes.bust(rng, (0.0, 0.0, 0.0), 40 * count)
    skull = bust[(bust[:, 0] < -0.01) & (np.linalg.norm(bust, axis=1) < 0.2)]
    wall = np.column_stack([np.full(behind, 1.0), rng.uniform(-0.35, 0.35, (behind, 2))])
    points = np.concatenate([rng.choice(skull, count, replace=False), wall])
    points[:, 0] += 1.0
    return rng.permutation(points).astype(np.float32)


def scenes_to_gather():
    rng = np.random.default_rng(14)
    T = np.eye(4)
    T[:3, 3] = 0.1, -0.2, 0.05
    points = head_and_wall(rng)
    images = camera_frame(1, 2).depths
    large = np.concatenate([points, np.full((4003, 3), np.nan, np.float32)])
    return {
        "a cloud": Frame(0, clouds=(Cloud("c", points, T),)),
        "points in the world": Frame(0, clouds=(Cloud("c", points + np.float32(T[:3, 3])),)),
        "images": Frame(0, depths=images),
        "all": Frame(0, clouds=(Cloud("c", points, T), Cloud("d", points)), depths=images[:1]),
        "a large cloud": Frame(0, clouds=(Cloud("c", np.resize(large, ((1 << 17) + 5, 3)), T),)),
        "nothing near": Frame(0, clouds=(Cloud("c", points + np.float32(9), T),)),
    }


@pytest.mark.parametrize("kind", scenes_to_gather())
@pytest.mark.parametrize("few", [False, True])
def test_the_same_is_gathered(kind, few):
    """Also where there is not room for all."""
    if few and not is_simulated():
        pytest.skip("on a GPU the room is compiled in: only the simulator can have less")
    room = 30 if few else nearby.MOST_SAMPLES
    frame = scenes_to_gather()[kind]
    centre = np.array([1.1, -0.2, 0.05]) if kind != "images" else np.zeros(3)
    samples, rays = np.zeros((room, 8)), np.zeros((room, 6))
    n, m = nearby_on_cpu.gather(sensors_of(frame), centre, samples, rays)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fits_module, "MOST_SAMPLES", room)
        patch.setattr(nearby, "MOST_SAMPLES", room)
        patch.setattr(pose, "fit_starts", Nothing())
        patch.setattr(pose, "settle_heads", Nothing())
        _, fits = fitted_on_device(frame, centre[None])
    near = fits.near.copy_to_host()[0, 0]
    assert near[:2].tolist() == [n, m]
    np.testing.assert_allclose(fits.samples.copy_to_host()[0, :n], samples[:n], atol=1e-12)
    np.testing.assert_allclose(fits.rays.copy_to_host()[0, :m], rays[:m], atol=1e-12)
    assert (n > 20 or few) if kind != "nothing near" else n == 0
    points, used = np.zeros((8, trials.FINE_SAMPLES)), min(n, trials.FINE_SAMPLES)
    assert choose_on_cpu(samples, n, points, trials.FINE_SAMPLES) == used
    np.testing.assert_allclose(fits.points.copy_to_host()[0, :, :used], points[:, :used], atol=1e-12)
    assert near[nearby.ROUND] == trials.is_round(samples, n)


class Nothing:
    """Stands for a kernel that is not to run."""

    def __getitem__(self, launch):
        return lambda *_: None


@numba.njit
def choose_on_cpu(source, there, target, most):
    return trials.choose(source, there, target, most)


@cuda.jit
def factor_and_solve(A, size, x, told):
    thread, threads = cuda.threadIdx.x, cuda.blockDim.x
    pose.factor(A, size, thread, threads)
    if thread == 0:
        told[0] = pose.solve_back(A, size, x)


@pytest.mark.parametrize("size", [residuals.PARAMETERS, 10])
def test_the_same_step_is_taken(size):
    rng = np.random.default_rng(size)
    B = rng.normal(size=(size, 40))
    A = np.zeros((residuals.PARAMETERS, pose.SYSTEM))
    A[:size, :size] = np.triu(B @ B.T)
    A[:size, residuals.RESIDUAL] = rng.normal(size=size)
    x, wanted = np.zeros(residuals.PARAMETERS), np.zeros(residuals.PARAMETERS)
    on_device, x, told = to_device(A, x, np.zeros(1))
    factor_and_solve[1, 3](on_device, size, x, told)
    system = A.copy()
    align.solve(system, wanted, size)
    np.testing.assert_allclose(x.copy_to_host(), wanted, rtol=1e-9)
    np.testing.assert_allclose(told.copy_to_host()[0], half_log_determinant(system, size), rtol=1e-12)
    np.testing.assert_allclose(
        np.triu(on_device.copy_to_host()[:size, :size]), np.triu(system[:size, :size]), rtol=1e-9
    )


def cases_to_fit():
    rng = np.random.default_rng(15)
    T = np.eye(4)
    points = head_and_wall(rng)
    seen = Frame(0, clouds=(Cloud("c", points, T),))
    shell = rng.normal(size=(30, 3))
    shell *= 0.1 / np.linalg.norm(shell, axis=1)[:, None]
    front = np.array([1.0, 0.0, 0.0])
    right = Expected(front[None], np.array([[0.0, 0.0, 1.0, 0.05]]), np.array([0.3]))
    wrong = Expected(front[None], np.array([[0.7, 0.7, 0.0, 0.1]]), np.array([0.3]))
    return {
        "from everywhere": (seen, [front], None),
        "as expected": (seen, [front], right),
        "not as expected": (seen, [np.array([1.0, 0.08, 0.0])], wrong),
        "a shell": (Frame(0, clouds=(Cloud("c", (shell + front).astype(np.float32)),)), [front], None),
        "too few points": (Frame(0, clouds=(Cloud("c", points[:18], T),)), [front, front + 9], None),
    }


@pytest.mark.parametrize("case", cases_to_fit())
def test_the_same_poses(case, monkeypatch):
    use_few_turns(monkeypatch)
    frame, centres, expected = cases_to_fit()[case]
    centres = np.array(centres)
    wanted = pose_on_cpu.fit_poses(frame, centres, pose_on_cpu.FitMemory.new(1, 2), Threads(1), expected)
    got, _ = fitted_on_device(frame, centres, expected)
    assert np.isfinite(wanted.radii).tolist() == [case != "too few points"] * len(centres)
    for name, one, other in zip(Poses._fields, got, wanted, strict=True):
        relative = 1e-4 if "covariances" in name else 0.0
        np.testing.assert_allclose(one, other, relative, METRES, err_msg=name)
