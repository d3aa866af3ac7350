import hashlib
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from headvox.errors import HeadvoxError
from headvox.synth.bodies import blend_points, load_basis, make_rest_body, mean_head_scale, mean_height_m
from headvox.synth.people import (
    CLOTH,
    GLASSES,
    HAIR,
    HAT,
    POSTURES,
    SKIN,
    PosedBody,
    pose_person,
    sample_person,
    sample_pose,
    walking_pose,
)
from headvox.synth.poses import Pose, mirror
from headvox.synth.wear import HAIR_STYLES, HATS, NOTHING


def bare(seed: int, child_share: float = 0.15):
    """A bald person without clothes: the vertices are those of the basis."""
    return replace(sample_person(np.random.default_rng(seed), child_share), wear=NOTHING)


def in_head_frame(body: PosedBody) -> np.ndarray:
    T = body.T_world_head
    return (body.vertices - T[:3, 3]) @ T[:3, :3]


def rest_of(age: float, sex: float, changes: tuple[float, ...] = (0.0,) * 28):
    points = blend_points(age, sex, 0.5, 0.5, mean_height_m(age, sex), (1.0, 1.0, 1.0))
    return make_rest_body(points, mean_head_scale(age, 1.0), changes)


# ------------------------------------------------------------------------------------------- the true head


@pytest.mark.parametrize("posture", POSTURES)
def test_true_head_fits_the_posed_mesh(posture):
    basis = load_basis()
    for seed in range(6):
        rng = np.random.default_rng([seed, 1])
        body = pose_person(
            bare(seed), sample_pose(rng, posture), xy=(1.0, -2.0), heading_rad=rng.uniform(0, 6)
        )
        T = body.T_world_head
        assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(T[:3, :3]) > 0
        local = in_head_frame(body)
        skull = local[basis.is_skull]
        crown, back = skull[:, 2].max(), skull[:, 0].min()
        assert crown == pytest.approx(-local[basis.menton, 2], abs=0.003)
        assert -back == pytest.approx(local[basis.nasion, 0], abs=0.003)
        assert skull[:, 1].max() == pytest.approx(-skull[:, 1].min(), abs=0.003)
        ears = local[basis.is_ear]
        left, right = ears[ears[:, 1] > 0].mean(0), ears[ears[:, 1] < 0].mean(0)
        assert left[1] > 0.05
        assert right[1] < -0.05
        assert left[[0, 2]] == pytest.approx(right[[0, 2]], abs=0.004)
        eyes = local[basis.is_eye].mean(0)
        assert eyes[0] > 0.04
        assert eyes[1] == pytest.approx(0.0, abs=0.002)


def test_nose_is_in_front_and_feet_are_below():
    body = pose_person(bare(0, 0.0), Pose("standing"))
    local = in_head_frame(body)
    basis = load_basis()
    nose = local[basis.is_head][np.argmax(local[basis.is_head][:, 0])]
    assert abs(nose[1]) < 0.005
    assert local[basis.is_foot][:, 2].max() < -1.0
    toes = body.vertices[basis.is_foot][:, 0]
    assert np.ptp(toes) > 0.18
    assert body.T_world_head[0, 0] > 0.98  # heading 0 looks along x


@pytest.mark.parametrize(
    ("turn", "entry", "value"), [("roll", (1, 2), -1), ("pitch", (2, 0), -1), ("yaw", (1, 0), 1)]
)
def test_roll_leans_right_pitch_looks_down_yaw_looks_left(turn, entry, value):
    head = tuple(0.4 if name == turn else 0.0 for name in ("roll", "pitch", "yaw"))
    body = pose_person(bare(1), Pose("standing", head=head))
    assert body.T_world_head[entry] == pytest.approx(value * np.sin(0.4), abs=1e-6)


def test_wear_does_not_move_the_true_head():
    person = sample_person(np.random.default_rng(4))
    pose = sample_pose(np.random.default_rng(5), "walking")
    naked = pose_person(replace(person, wear=NOTHING), pose)
    for hat in HATS:
        dressed = pose_person(replace(person, wear=replace(person.wear, hat=hat)), pose)
        assert dressed.T_world_head[:3, :3] == pytest.approx(naked.T_world_head[:3, :3])
        # soles lift a person a little
        assert dressed.T_world_head[:3, 3] == pytest.approx(naked.T_world_head[:3, 3], abs=0.02)


# ------------------------------------------------------------------------------------------- sizes


@pytest.mark.parametrize(("sex", "height"), [(0.0, 1.76), (1.0, 1.63)])
def test_adult_sizes(sex, height):
    rest = rest_of(30.0, sex)
    depth, breadth, tall = rest.head_size
    assert np.ptp(rest.vertices[:, 2]) == pytest.approx(height, abs=0.01)
    assert 0.18 < depth < 0.215
    assert 0.14 < breadth < 0.16
    assert 0.205 < tall < 0.24
    assert rest.vertices[:, 2].max() - rest.head_centre[2] == pytest.approx(0.115, abs=0.012)


def eye_distance(rest) -> float:
    basis = load_basis()
    return float(np.linalg.norm(rest.joints[basis.joint("eye.L")] - rest.joints[basis.joint("eye.R")]))


def test_eyes_are_as_far_apart_as_real_ones():
    assert eye_distance(rest_of(30.0, 0.0)) == pytest.approx(0.0635, abs=0.0015)
    assert eye_distance(rest_of(30.0, 1.0)) == pytest.approx(0.0618, abs=0.0015)
    assert eye_distance(rest_of(4.0, 0.5)) == pytest.approx(0.0545, abs=0.0025)


def test_children_are_smaller_in_every_way():
    adult, child, small = rest_of(30.0, 0.5), rest_of(10.0, 0.5), rest_of(4.0, 0.5)
    for larger, smaller in ((adult, child), (child, small)):
        assert np.ptp(larger.vertices[:, 2]) > np.ptp(smaller.vertices[:, 2]) + 0.2
        assert (larger.head_size > smaller.head_size).all()
    assert small.head_size[1] > 0.13  # the head of a child is nearly as broad as that of an adult


def test_random_people_have_plausible_heads():
    sizes = np.array([rest_size(seed) for seed in range(40)])
    assert (sizes > (0.14, 0.12, 0.16)).all()
    assert (sizes < (0.24, 0.18, 0.28)).all()


def rest_size(seed: int) -> np.ndarray:
    person = sample_person(np.random.default_rng(seed), 0.3)
    points = blend_points(
        person.age_years, person.sex, person.mass, person.muscle, person.height_m, person.ancestry
    )
    return make_rest_body(points, person.head_scale, person.head_changes).head_size


# ------------------------------------------------------------------------------------------- poses


@pytest.mark.parametrize("posture", POSTURES)
def test_lowest_point_is_on_the_floor(posture):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        body = pose_person(sample_person(rng), sample_pose(rng, posture), floor_z=0.25)
        assert body.vertices[:, 2].min() == pytest.approx(0.25, abs=1e-9)
        assert body.posture == posture


def test_head_heights_tell_postures_apart():
    def mean_height(posture: str) -> float:
        bodies = [
            pose_person(bare(s, 0.0), sample_pose(np.random.default_rng(s), posture)) for s in range(12)
        ]
        return float(np.mean([body.T_world_head[2, 3] for body in bodies]))

    heights = {posture: mean_height(posture) for posture in POSTURES}
    assert heights["standing"] > 1.4
    assert heights["standing"] > heights["sitting"] > heights["crouching"] - 0.2
    assert heights["lying"] < 0.4
    assert 0.5 < heights["bending"] < heights["standing"] - 0.15


@pytest.mark.parametrize("posture", POSTURES)
def test_no_limb_is_torn(posture):
    """Edges of the skin may stretch at joints, but not tear."""
    basis = load_basis()
    edges = basis.faces[:, :2]
    person = bare(2, 0.0)
    rest = pose_person(person, Pose("standing")).vertices
    length = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
    for seed in range(8):
        posed = pose_person(person, sample_pose(np.random.default_rng(seed), posture)).vertices
        stretched = np.linalg.norm(posed[edges[:, 0]] - posed[edges[:, 1]], axis=1)
        assert stretched.max() < 0.16
        assert np.quantile(stretched / length, 0.99) < 2.5


def test_walking_repeats_and_mirrors():
    person = bare(3)
    start, again = (pose_person(person, walking_pose(phase)).vertices for phase in (0.3, 0.3 + 2 * np.pi))
    assert np.abs(start - again).max() < 1e-5
    left = pose_person(person, walking_pose(0.3)).T_world_head[:3, 3]
    right = pose_person(person, mirror(walking_pose(0.3 + np.pi))).T_world_head[:3, 3]
    assert left == pytest.approx(right, abs=2e-3)


def test_walking_moves_smoothly():
    person = bare(3)
    heads = [
        pose_person(person, walking_pose(phase)).T_world_head[:3, 3]
        for phase in np.linspace(0, 2 * np.pi, 60)
    ]
    assert np.abs(np.diff(heads, axis=0)).max() < 0.015


def test_heading_turns_and_xy_places_the_pelvis():
    person, pose = bare(6), Pose("standing")
    a = pose_person(person, pose)
    b = pose_person(person, pose, xy=(2.0, 1.0), heading_rad=np.pi / 2)
    turned = np.column_stack([-a.vertices[:, 1] + 2.0, a.vertices[:, 0] + 1.0, a.vertices[:, 2]])
    assert b.vertices == pytest.approx(turned, abs=3e-6)
    assert b.T_world_head[:3, 0] == pytest.approx(
        [-a.T_world_head[1, 0], a.T_world_head[0, 0], a.T_world_head[2, 0]]
    )


def test_unknown_posture_is_refused():
    with pytest.raises(HeadvoxError, match="flying"):
        sample_pose(np.random.default_rng(0), "flying")


def test_share_of_children_is_checked():
    with pytest.raises(HeadvoxError, match="children"):
        sample_person(np.random.default_rng(0), child_share=1.5)


# ------------------------------------------------------------------------------------------- wear


def test_bodies_are_light_and_sound():
    for seed in range(12):
        rng = np.random.default_rng(seed)
        body = pose_person(sample_person(rng), sample_pose(rng))
        assert len(body.vertices) <= 15_000
        assert np.isfinite(body.vertices).all()
        assert body.faces.dtype == np.int32
        assert body.materials.dtype == np.uint8
        assert body.faces.min() >= 0
        assert body.faces.max() < len(body.vertices)
        assert len(body.materials) == len(body.faces)
        assert 0.0 <= body.hair_albedo <= 1.0


@pytest.mark.parametrize("style", HAIR_STYLES[1:])
def test_hair_adds_to_the_head_and_stays_off_the_face(style):
    person = sample_person(np.random.default_rng(7), 0.0)
    wear = replace(NOTHING, hair=style, hair_m=0.02, hair_length_m=0.25, seed=3)
    body = pose_person(replace(person, wear=wear), Pose("standing"))
    local = in_head_frame(body)
    hair = local[np.unique(body.faces[body.materials == HAIR])]
    crown = local[: len(load_basis().skin_weights)][load_basis().is_skull][:, 2].max()
    assert crown + 0.005 < hair[:, 2].max() < crown + 0.06
    face = (hair[:, 0] > 0.085) & (np.abs(hair[:, 1]) < 0.04) & (hair[:, 2] < 0.015)
    assert not face.any()


@pytest.mark.parametrize("hat", HATS[1:])
def test_hats_cover_the_crown(hat):
    person = sample_person(np.random.default_rng(8), 0.0)
    body = pose_person(
        replace(person, wear=replace(NOTHING, hair="bulky", hair_m=0.05, hat=hat, hat_m=0.01)),
        Pose("standing"),
    )
    local = in_head_frame(body)
    top_of = {m: local[np.unique(body.faces[body.materials == m])][:, 2].max() for m in (SKIN, HAIR, HAT)}
    assert top_of[HAT] > top_of[HAIR] > top_of[SKIN]


def test_glasses_masks_and_headphones_lie_outside_the_head():
    person = sample_person(np.random.default_rng(9), 0.0)
    wear = replace(NOTHING, glasses="dark", mask=True, headphones=True)
    body = pose_person(replace(person, wear=wear), Pose("standing"))
    local = in_head_frame(body)
    basis = load_basis()
    glasses = local[np.unique(body.faces[body.materials == GLASSES])]
    assert glasses[:, 0].max() > local[basis.nasion, 0]
    assert np.abs(glasses[:, 1]).max() < 0.1
    phones = local[np.unique(body.faces[body.materials == HAT])]
    assert np.ptp(phones[:, 1]) > 0.15
    mask = local[np.unique(body.faces[body.materials == CLOTH])]
    assert mask[:, 2].min() < -0.08
    assert mask[:, 2].max() < 0.0


def test_thick_clothes_widen_the_trunk_but_not_the_face():
    person = sample_person(np.random.default_rng(10), 0.0)
    thin, thick = (
        pose_person(replace(person, wear=replace(NOTHING, cloth_m=cloth)), Pose("standing"))
        for cloth in (0.005, 0.04)
    )
    basis = load_basis()
    n = len(basis.skin_weights)
    lifted = np.linalg.norm(in_head_frame(thick)[:n] - in_head_frame(thin)[:n], axis=1)
    assert lifted[basis.is_head].max() < 1e-3
    trunk = np.isin(basis.skin_joints[:, 0], [basis.joint("spine02"), basis.joint("spine03")])
    assert np.median(lifted[trunk]) > 0.02


# ------------------------------------------------------------------------------------------- determinism

DIGEST = """
import hashlib
import numpy as np
from headvox.synth.people import pose_person, sample_person, sample_pose
digest = hashlib.sha256()
for seed in range(4):
    rng = np.random.default_rng(seed)
    body = pose_person(sample_person(rng), sample_pose(rng), xy=(0.3, 0.2), heading_rad=1.0)
    for array in (body.vertices, body.faces, body.materials, body.T_world_head):
        digest.update(np.ascontiguousarray(array).tobytes())
print(digest.hexdigest())
"""


def test_same_seed_same_bytes_on_any_number_of_threads():
    def digest(threads: str) -> str:
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        environment = {**os.environ, **dict.fromkeys(names, threads)}
        run = [sys.executable, "-c", DIGEST]
        return subprocess.run(run, env=environment, check=True, capture_output=True, text=True).stdout.strip()

    first = digest("1")
    assert len(first) == len(hashlib.sha256().hexdigest())
    assert first == digest("2")


def test_the_package_needs_no_torch():
    code = (
        "import sys, headvox.synth.people; assert 'torch' not in sys.modules and 'open3d' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
