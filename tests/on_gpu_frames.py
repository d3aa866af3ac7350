"""Whole frames on a GPU, what goes wrong there, and the bench: see on_gpu.py."""

import math
import sys
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scenes
from busts import NARROW, SMALL, camera_and_cloud, camera_frame, two_busts
from gpu_arrays import (
    METRES,
    RADIANS,
    STAGES,
    cloud_of,
    use_few_turns,
)
from numba import cuda

from headvox import Cloud, Detector, Frame, HeadvoxError, Intrinsics
from headvox.cli import main
from headvox.config import DetectorConfig
from headvox.cuda import (
    compact,
    graph,
    search,
)
from headvox.cuda.device import BATCH, check_device, is_simulated
from headvox.data import Expected
from headvox.fuse import Region
from headvox.lattice import Lattice
from headvox.masks.compile import compile_cascade

# The simulator computes as NumPy's scalars do, which tell of what the hardware does silently.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore:Grid size")


@pytest.fixture(scope="module")
def cascades(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cascades")
    fourth = scenes.STAGES.replace("min_score =", 'candidates = "every fourth"\nmin_score =', 1)
    for name, text in (("stages", scenes.STAGES), ("fourth", fourth), ("votes", scenes.VOTES)):
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    return folder


def detectors(cascades, cascade="stages", **settings):
    """Return the same detector on the CPU and on the GPU."""
    path = str(cascades / f"{cascade}.toml") if cascade in ("stages", "fourth", "votes") else cascade
    config = DetectorConfig(cascade=path, **{**SMALL, **NARROW, **settings})
    return Detector(config, backend="cpu"), Detector(config, backend="cuda")


def same(one, other, verified=False):
    """The same heads, with the same scores; what was fitted to them is within the stated tolerance.

    A score that the fit was ``verified`` by follows it, in steps of 1/1024.
    """
    assert len(one) == len(other)
    np.testing.assert_allclose(one.scores, other.scores, rtol=0.0, atol=1 / 1024 if verified else 0.0)
    assert one.sure.tolist() == other.sure.tolist()
    for name, absolute, relative in (
        ("centres", METRES, 0.0),
        ("radii", METRES, 0.0),
        ("quaternions", RADIANS, 0.0),
        ("centre_covariances", METRES**2, 1e-4),
        ("rotation_covariances", RADIANS, 1e-4),
    ):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), relative, absolute, err_msg=name)


def frames_of_all_kinds():
    return {
        "two cameras": ("stages", camera_frame(2, 2), {"min_score": -2.0}),
        "a camera and a cloud": ("stages", camera_and_cloud(), {"min_score": -2.0}),
        "every fourth voxel": ("fourth", Frame(0, clouds=(Cloud("c", two_busts()),)), {"min_score": -1.0}),
        "votes": ("votes", Frame(0, clouds=(Cloud("c", two_busts()),)), {"min_score": 0.0, "voxel_m": 0.06}),
    }


@pytest.mark.parametrize("kind", frames_of_all_kinds())
def test_whole_frames_are_equal(cascades, kind):
    cascade, frame, settings = frames_of_all_kinds()[kind]
    cpu, gpu = detectors(cascades, cascade, **settings)
    heads = cpu.detect_frame(frame)
    same(gpu.detect_frame(frame), heads)
    assert gpu.candidates == cpu.candidates > 0
    assert gpu.on_device
    assert set(gpu.stage_ms) == {"device", "host"}
    assert len(heads) > 0


def test_whole_frames_have_the_same_poses(cascades, monkeypatch):
    """One head that is expected to look another way; and what it scores is too little, but for that."""
    use_few_turns(monkeypatch)
    T = np.eye(4)
    T[:3, 3] = -1.0, 0.0, 0.05
    points = scenes.bust(np.random.default_rng(0), (-0.2, -0.2, 0.1), 70) - T[:3, 3].astype(np.float32)
    frame = Frame(0, clouds=(Cloud("c", points, T),))
    near = {"centre": (0.0, 0.0, 0.0)}
    everyone = detectors(cascades, min_score=-1e3, refine="none", **near)[0].detect_frame(frame)
    best = {"min_score": float(everyone.scores[0]) + 0.1, "score_slack": 0.11}
    cpu, gpu = detectors(cascades, **best, refine="pose", **near)
    expected = Expected(everyone.centres[:1], np.array([[0.0, 0.7, 0.7, 0.1]]), np.array([0.2]))
    heads = cpu.detect_frame(frame, expected)
    same(gpu.detect_frame(frame, expected), heads)
    assert len(heads) == 1
    assert not heads.sure[0]
    assert np.isfinite(heads.centre_covariances).all()
    assert len(cpu.detect_frame(frame)) == 0


def test_the_default_cascade_finds_the_same_head(cascades):
    rng = np.random.default_rng(12)
    frame = Frame(0, clouds=(Cloud("c", scenes.bust(rng, (0.0, 0.0, 0.05), 250)),))
    cpu, gpu = detectors(cascades, "default", min_score=-1e3, max_range_m=0.3)
    heads = cpu.detect_frame(frame)
    same(gpu.detect_frame(frame), heads, verified=True)
    assert len(heads) > 0


def test_a_batch_is_equal_and_takes_nothing_from_another_frame(cascades):
    """Frames with more and fewer sensors side by side; then one alone, in the memory that they left."""
    cloud = Frame(0, clouds=(Cloud("c", scenes.bust(np.random.default_rng(0), (0.1, 0.1, 0.1), 60)),))
    frames = [camera_frame(1), cloud]
    cpu, gpu = detectors(cascades, max_range_m=0.3, min_score=-2.0)
    wanted = cpu.detect_batch(frames)
    assert len(frames) < BATCH
    for got, one in zip(gpu.detect_batch(frames), wanted, strict=True):
        same(got, one)
    same(gpu.detect_frame(cloud), wanted[1])
    assert all(len(heads) for heads in wanted)


def test_more_candidates_than_there_is_room_for(cascades, monkeypatch):
    monkeypatch.setattr(search, "FIRST_CANDIDATES", 32)
    cpu, gpu = detectors(cascades, max_range_m=0.3)
    same(gpu.detect_frame(camera_frame(1)), cpu.detect_frame(camera_frame(1)))
    assert gpu.candidates == cpu.candidates > 32


def test_nobody_in_range_is_told_as_on_the_cpu(cascades):
    cpu, gpu = detectors(cascades, max_range_m=0.2, min_height_m=-0.1, max_height_m=0.1)
    far = cloud_of([[5.0, 5.0, 5.0]])
    with pytest.raises(HeadvoxError) as on_gpu:
        gpu.detect_frame(far)
    with pytest.raises(HeadvoxError) as on_cpu:
        cpu.detect_frame(far)
    assert str(on_gpu.value) == str(on_cpu.value)
    near = cloud_of([[0.0, 0.0, 0.0]])
    assert len(gpu.detect_frame(near)) == len(cpu.detect_frame(near)) == 0  # as if nothing had happened


def test_nothing_is_allocated_once_all_is_there(cascades, monkeypatch):
    _, gpu = detectors(cascades, max_range_m=0.2, min_height_m=-0.1, max_height_m=0.1)
    frame = cloud_of(np.random.default_rng(0).uniform(-0.1, 0.1, (30, 3)))
    gpu.detect_frame(frame)
    for name in ("device_array", "pinned_array", "to_device"):
        monkeypatch.setattr(cuda, name, lambda *_, **__: pytest.fail("allocated"))
    gpu.detect_frame(frame)


def small_image():
    """Return every other pixel of a camera's image: the simulator takes its time for each."""
    image = camera_frame(1).depths[0]
    c = image.intrinsics
    half = Intrinsics(c.width // 2, c.height // 2, c.fx / 2, c.fy / 2, c.cx / 2, c.cy / 2, c.depth_scale)
    return replace(image, depth=image.depth[::2, ::2].copy(), intrinsics=half)


def test_the_bench_measures_everything(cascades, capsys):
    """Only that it comes to its end: in the simulator its times are made up."""
    from headvox.cuda import bench

    near = {"max_range_m": 0.15, "centre": (0.1, -0.15, 0.1), "min_height_m": 0.0, "max_height_m": 0.2}
    region = Region(near["centre"], near["max_range_m"], near["min_height_m"], near["max_height_m"])
    cpu, _ = detectors(cascades, **near)
    with pytest.MonkeyPatch.context() as patch:
        if is_simulated():
            patch.setattr(bench, "LAUNCHES", 1)
            patch.setattr(bench, "COPY_WORDS", 64)
            patch.setattr(bench, "BATCH_FRAMES", 1)
            patch.setattr(cuda.get_current_device().__class__, "name", "simulator", raising=False)
        result = bench.measure(replace(cpu.config, refine="sphere"), (small_image(),), 1, print)
    assert result["same_candidates_and_peaks_as_cpu"]
    assert result["farthest_from_cpu_m"] <= METRES
    assert result["one_graph"] == (not is_simulated())
    masks, memory, ms = result["mask_evaluations"], result["memory"], result["ms"]
    lattice = Lattice.over(region, STAGES.voxel_m, STAGES.subdivision)
    conditions = len(compile_cascade(STAGES).gate.rank)
    assert masks["count"] == math.prod(lattice.shape) * conditions
    assert masks["a_second"] == pytest.approx(masks["count"] / masks["ms"] * 1e3)
    assert masks["times_the_paper"] == pytest.approx(masks["a_second"] / 9.5e7)
    assert memory["least_bytes"] > 4 * 2 * math.prod(n + 1 for n in lattice.shape)  # sums, written and read
    assert memory["floor_ms"] == pytest.approx(1e3 * memory["least_bytes"] / memory["copy_bytes_a_second"])
    kernels = ms["kernels, without refinement"]["p50"]
    assert memory["floor_over_kernels"] == pytest.approx(memory["floor_ms"] / kernels, rel=0.1)
    assert result["batch"]["frames_a_second"] > 0
    assert {"kernels", "upload", "download", "end to end, without refinement"} <= set(ms)
    assert {name for name, of in result["ms"].items() if of["p50"] > 0} >= {
        "end to end",
        "end to end, on the CPU",
    }
    told = bench.report(result)
    for row in ("mask evaluations", "times the paper's", "floor / kernels", "frames a second", "one by one"):
        assert row in told or (row == "one by one" and result["one_graph"])


@pytest.mark.skipif(not is_simulated(), reason="on a GPU the bench runs: it is the simulator that is refused")
def test_the_bench_refuses_the_simulator(capsys):
    assert main(["bench", "--backend", "cuda"]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert "NUMBA_ENABLE_CUDASIM is set" in said.err


class CudaAPIError(Exception):
    __module__ = "numba.cuda.cudadrv.driver"


def test_a_lost_gpu_is_told_once_and_the_cpu_goes_on(cascades, monkeypatch):
    cpu, _ = detectors(cascades)
    said = []
    gpu = Detector(cpu.config, backend="cuda", note=said.append)
    frame = camera_frame(1)
    wanted = cpu.detect_frame(frame)

    def fail(*_):
        raise CudaAPIError("[719] the device fell off the bus")

    monkeypatch.setattr(search.Search, "launch", fail)
    for _ in range(2):
        same(gpu.detect_frame(frame), wanted)
    same(gpu.detect_batch([frame])[0], wanted)
    assert not gpu.on_device
    assert len(said) == 1
    assert "[719] the device fell off the bus" in said[0]


def test_a_gpu_with_too_little_memory_is_told_once(cascades, monkeypatch):
    cpu, _ = detectors(cascades)
    said = []
    gpu = Detector(cpu.config, backend="cuda", note=said.append)
    frame = camera_frame(1)

    def full(*_):
        raise CudaAPIError("[2] Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY")

    monkeypatch.setattr(cuda, "device_array", full)
    for heads in gpu.detect_batch(9 * [frame]):  # more than go at once
        assert heads.centres.tobytes() == cpu.detect_frame(frame).centres.tobytes()
    assert len(said) == 1
    assert "CUDA_ERROR_OUT_OF_MEMORY" in said[0]
    assert "max_range_m" in said[0]
    assert "\n" not in said[0]


def test_a_graph_is_what_was_started_before(cascades, monkeypatch):
    """Of the first frame all is started one by one; then as one, until a buffer is another."""
    cpu, gpu = detectors(cascades, max_range_m=0.2, min_height_m=-0.1, max_height_m=0.1)
    started = []

    def capture(stream, enqueue):
        search = enqueue.func.__self__
        assert stream is search.stream
        return lambda: (started.append("graph"), enqueue())

    monkeypatch.setattr(search, "FIRST_CANDIDATES", 4096)
    all_of = search.Search.all_of
    monkeypatch.setattr(search, "capture", capture)
    monkeypatch.setattr(search.Search, "all_of", lambda self, *of: (started.append("all"), all_of(self, *of)))
    few, more = (np.random.default_rng(0).uniform(-0.1, 0.1, (n, 3)) for n in (20, 60))
    for points in (few, few, few, more, more):
        same(gpu.detect_frame(cloud_of(points)), cpu.detect_frame(cloud_of(points)))
    assert started == ["all", "graph", "all", "graph", "all", "all", "graph", "all"]


def test_without_graphs_all_is_started_one_by_one(cascades, monkeypatch):
    cpu, gpu = detectors(cascades, max_range_m=0.2, min_height_m=-0.1, max_height_m=0.1)
    monkeypatch.setattr(search, "capture", lambda *_: None)
    frame = cloud_of(np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3)))
    for _ in range(3):
        same(gpu.detect_frame(frame), cpu.detect_frame(frame))
    assert not gpu.device.device.for_frames(1).is_graph


class FakeStream:
    """Stands for cuda.core's stream and its graph builder; it may fail."""

    fails, log = False, []

    @classmethod
    def from_handle(cls, handle):
        cls.log.append(("stream", handle))
        return cls()

    def create_graph_builder(self):
        return self

    def begin_building(self):
        self.log.append("begin")

    def end_building(self):
        self.log.append("end")

    def complete(self):
        if self.fails:
            raise CudaAPIError("graphs are not supported")
        return SimpleNamespace(launch=lambda stream: self.log.append(("launch", stream is self)))


@pytest.mark.parametrize("fails", [False, True])
def test_a_graph_is_captured_as_cuda_core_asks_for_it(monkeypatch, fails):
    monkeypatch.setattr(graph, "SIMULATED", False)
    monkeypatch.setitem(sys.modules, "cuda.core", SimpleNamespace(Stream=FakeStream))
    monkeypatch.setattr(FakeStream, "fails", fails)
    monkeypatch.setattr(FakeStream, "log", [])
    launch = graph.capture(7, lambda: FakeStream.log.append("enqueue"))
    assert FakeStream.log == [("stream", 7), "begin", "enqueue", "end"]
    assert (launch is None) == fails
    if launch is not None:
        launch()
        assert FakeStream.log[4:] == [("launch", True)]


def test_a_fault_of_ours_is_no_lost_gpu(cascades, monkeypatch):
    _, gpu = detectors(cascades)
    monkeypatch.setattr(search.Search, "launch", lambda *_: {}["missing"])
    with pytest.raises(KeyError):
        gpu.detect_frame(camera_frame(1))


def test_without_a_note_it_is_a_warning(cascades, monkeypatch):
    cpu, gpu = detectors(cascades)
    monkeypatch.setattr(search.Search, "launch", lambda *_: (_ for _ in ()).throw(CudaAPIError("gone")))
    with pytest.warns(RuntimeWarning, match="the GPU failed .gone."):
        same(gpu.detect_frame(camera_frame(1)), cpu.detect_frame(camera_frame(1)))


def test_auto_takes_a_gpu_but_no_simulated_one():
    check_device()
    assert Detector(backend="auto").on_device == (not is_simulated())


def test_a_gpu_that_counts_wrongly_is_not_used(monkeypatch):
    monkeypatch.setattr(compact, "count_bits", SimpleNamespace(__getitem__=None))
    with pytest.raises(HeadvoxError, match="cannot run on this GPU"):
        check_device()


def test_the_tests_end_all_their_threads():
    assert threading.active_count() < 20
