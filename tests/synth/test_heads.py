import hashlib
import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from headvox.errors import HeadvoxError
from headvox.parallel.workers import Workers
from headvox.synth.heads import EYE_DISTANCE_M, RANGES, make_heads, make_shell, ply_bytes, sample_identities


def digest(folder) -> str:
    out = hashlib.sha256()
    for path in sorted(folder.iterdir()):
        out.update(path.name.encode() + path.read_bytes())
    return out.hexdigest()


def read_points(path) -> np.ndarray:
    data = path.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    count = int(head.split(b"element vertex ")[1].split()[0])
    return np.frombuffer(body, "<f4", 3 * count).reshape(-1, 3)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("heads")
    make_heads(folder, count=3, points=600, seed=5)
    return folder


def test_identities_fill_every_stratum():
    identities = sample_identities(44, seed=0)
    for name, (low, high) in RANGES.items():
        strata = [int((getattr(i, name) - low) / (high - low) * 44 * (1 - 1e-9)) for i in identities]
        assert sorted(strata) == list(range(44))
    assert identities == sample_identities(44, seed=0)
    assert identities != sample_identities(44, seed=1)


def test_manifest_is_true(small):
    manifest = json.loads((small / "manifest.json").read_text())
    assert manifest["count"] == len(manifest["heads"]) == 3
    for head in manifest["heads"]:
        points = read_points(small / head["cloud"])
        mesh = read_points(small / head["mesh"])
        assert len(points) == 600
        left, right = np.array(head["eye_left"]), np.array(head["eye_right"])
        assert np.linalg.norm(left - right) == pytest.approx(EYE_DISTANCE_M, abs=1e-5)
        assert left[0] < right[0]  # x is the person's right, and y is forward
        assert left[1] > 0.04
        assert head["centre"] == [0.0, 0.0, 0.0]
        assert np.ptp(mesh, axis=0) == pytest.approx(head["size"], abs=2e-6)
        middle = np.abs(mesh[:, 0]) < 0.03
        assert mesh[middle, 2].max() == pytest.approx(mesh[:, 2].max())
        assert (points.min(0) >= mesh.min(0) - 1e-6).all()
        assert (points.max(0) <= mesh.max(0) + 1e-6).all()
        assert mesh[:, 2].max() == pytest.approx(0.115 * EYE_DISTANCE_M / 0.0625, abs=0.02)


def test_points_are_spread_evenly(small):
    points = read_points(small / "head_00.ply").astype(np.float64)
    nearest = cKDTree(points).query(points, k=2)[0][:, 1]
    assert nearest.min() > 0.85 * np.median(nearest)
    assert np.percentile(nearest, 99) < 1.4 * np.median(nearest)


def test_two_workers_write_the_same_bytes_and_a_stopped_run_goes_on(small, tmp_path):
    make_heads(tmp_path, count=3, points=600, seed=5, workers=Workers(2))
    assert digest(tmp_path) == digest(small)
    (tmp_path / "head_01.ply").unlink()
    (tmp_path / "manifest.json").unlink()
    untouched = (tmp_path / "head_00.ply").stat().st_mtime_ns
    make_heads(tmp_path, count=3, points=600, seed=5)
    assert digest(tmp_path) == digest(small)
    assert (tmp_path / "head_00.ply").stat().st_mtime_ns == untouched


def test_metric_heads_keep_their_size():
    identity = sample_identities(1, seed=0)[0]
    metric, normal = make_shell(identity, metric=True), make_shell(identity, metric=False)
    assert metric.scale == 1.0
    assert np.linalg.norm(normal.eyes[0] - normal.eyes[1]) == pytest.approx(EYE_DISTANCE_M, abs=2e-6)
    assert normal.vertices == pytest.approx(metric.vertices * normal.scale, abs=2e-6)


def test_other_settings_in_the_same_folder_are_refused(small):
    with pytest.raises(HeadvoxError, match="other settings"):
        make_heads(small, count=3, points=600, seed=6)


def test_numbers_below_one_are_refused(tmp_path):
    with pytest.raises(HeadvoxError, match="points"):
        make_heads(tmp_path, points=0)


def test_a_negative_seed_and_a_file_in_the_way_are_refused(tmp_path):
    with pytest.raises(HeadvoxError, match="seed"):
        make_heads(tmp_path, seed=-1)
    (tmp_path / "taken").write_text("")
    with pytest.raises(HeadvoxError, match="folder"):
        make_heads(tmp_path / "taken", count=1, points=100)
    with pytest.raises(HeadvoxError, match="holds other things"):
        make_heads(tmp_path, count=1, points=100)


def test_the_count_of_finished_heads_is_told(tmp_path):
    told = []
    make_heads(tmp_path, count=2, points=50, on_done=told.append)
    assert told == [1, 2]


def test_ply_bytes_have_the_size_they_announce():
    data = ply_bytes(np.zeros((4, 3)), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
    assert len(data.split(b"end_header\n", 1)[1]) == 4 * 12 + 2 * 13
