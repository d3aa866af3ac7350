"""Work spread over processes and over a Dask cluster: the same results, whoever does it, and whoever dies."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

import pytest

from headvox.config import DetectorConfig
from headvox.errors import HeadvoxError
from headvox.evaluate import scenarios as scenario
from headvox.evaluate.match import Rules
from headvox.evaluate.outcome import Outcome, Plan, evaluate_all, pooled
from headvox.parallel import batch, cluster
from headvox.parallel.workers import ALONE, Workers
from headvox.run import Report
from headvox.sources.options import SourceOptions
from headvox.sources.remote import fetched
from headvox.synth import mannequin, presets
from headvox.synth.record import stamps, write_recording


def square(n: int) -> int:
    return n * n


def square_with_a_death(n: int, marker: Path) -> int:
    """The worker that gets 5 first is killed as by the kernel when memory runs out."""
    if n == 5 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return n * n


def deadly(n: int) -> int:
    if n == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return n


def refuse(n: int) -> int:
    if n == 3:
        raise HeadvoxError("Three is too many.", "Take two.")
    return n


@pytest.mark.parametrize("workers", [ALONE, Workers(2), Workers(2, "local")], ids=str)
def test_results_come_in_order_whoever_does_the_work(workers):
    assert list(workers.map(square, range(40))) == [n * n for n in range(40)]
    assert list(workers.map(square, [])) == []


@pytest.mark.parametrize("workers", [ALONE, Workers(2), Workers(2, "local")], ids=str)
def test_what_a_piece_of_work_raises_comes_through(workers):
    with pytest.raises(HeadvoxError, match="Three is too many") as caught:
        list(workers.map(refuse, range(6)))
    assert caught.value.do == "Take two."


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_workers_end_in_the_middle_of_their_work_with_who_has_started_them(tmp_path, number):
    def count(kind: str, least: int) -> int:
        """How many have begun or ended; ``least`` are waited for."""
        end = time.monotonic() + 60.0
        while len(list(tmp_path.glob(f"*.{kind}"))) < least and time.monotonic() < end:
            time.sleep(0.05)
        return len(list(tmp_path.glob(f"*.{kind}")))

    command = [sys.executable, str(Path(__file__).with_name("dozing.py")), str(tmp_path)]
    heeds = partial(
        signal.signal, signal.SIGINT, signal.default_int_handler
    )  # should this be in the background
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, preexec_fn=heeds) as process:
        try:
            assert count("begun", 2) == 2
            process.send_signal(number)
            assert process.wait(30) != 0
        finally:
            process.kill()
    assert count("ended", 2) == 2
    assert count("begun", 0) == 2  # and took nothing else


def test_the_work_of_a_worker_that_is_killed_is_done_by_another(tmp_path):
    marker = tmp_path / "died"
    job = partial(square_with_a_death, marker=marker)
    assert list(Workers(2, "local").map(job, range(20))) == [n * n for n in range(20)]
    assert marker.exists()


def test_a_piece_that_kills_every_worker_is_given_up():
    with pytest.raises(HeadvoxError, match="ended every worker"):
        list(Workers(2, "local").map(deadly, range(4)))


def test_few_pieces_are_out_at_a_time(tmp_path):
    """The first result is given back long before the last piece was begun: memory does not grow with the work."""
    results = Workers(2, "local").map(partial(touch, folder=tmp_path), range(200))
    assert next(results) == 0
    begun = len(list(tmp_path.iterdir()))
    results.close()
    assert begun <= 2 * (cluster.OUT_PER_THREAD + cluster.AHEAD_PER_THREAD)


def touch(n: int, folder: Path) -> int:
    (folder / str(n)).touch()
    return n


def test_nobody_at_an_address_is_told(monkeypatch):
    monkeypatch.setattr(cluster, "ANSWER_S", 0.5)
    with pytest.raises(HeadvoxError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        list(Workers(1, "tcp://127.0.0.1:9").map(square, range(3)))
    with pytest.raises(HeadvoxError, match="no Dask scheduler answers at nonsense"):
        list(Workers(1, "nonsense://x").map(square, range(3)))


def test_a_scheduler_without_workers_and_workers_of_another_headvox_are_told(monkeypatch):
    from distributed import LocalCluster

    monkeypatch.setattr(cluster, "JOIN_S", 0.5)
    with LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address=None) as empty:
        with pytest.raises(HeadvoxError, match="has no workers"):
            list(Workers(1, empty.scheduler_address).map(square, range(3)))
        monkeypatch.setattr(cluster, "JOIN_S", 60.0)
        empty.scale(1)
        assert list(Workers(1, empty.scheduler_address).map(square, range(3))) == [0, 1, 4]
        monkeypatch.setattr(cluster, "__version__", "9.9")
        with pytest.raises(HeadvoxError, match=r"this is headvox 9\.9, and there are workers with"):
            list(Workers(1, empty.scheduler_address).map(square, range(3)))


# ------------------------------------------------------------------------------------------ many recordings


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("recordings")
    made = []
    for seed in range(3):
        scene = presets.two_cameras(seed=seed, people=mannequin, mode="d435i-small", duration_s=1.0)
        made.append(write_recording(folder / f"rig{seed}", scene, stamps(2)))
    return made


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


FAST = DetectorConfig(refine="sphere")


def test_a_batch_gives_the_same_bytes_alone_and_on_a_cluster_and_does_nothing_twice(recordings, tmp_path):
    places = [str(path) for path in recordings]
    told: list[batch.Done] = []
    alone = batch.Settings(tmp_path / "alone", FAST, SourceOptions(), None)
    assert batch.run_batch(places, alone, ALONE, told.append) == told
    assert [(done.name, done.frames, done.bad, done.failure) for done in told] == [
        ("rig0", 2, 0, ""), ("rig1", 2, 0, ""), ("rig2", 2, 0, ""),
    ]  # fmt: skip
    assert sum(done.heads for done in told) > 0
    spread = batch.Settings(tmp_path / "spread", FAST, SourceOptions(), None)
    (tmp_path / "spread").mkdir()
    (tmp_path / "spread" / "rig1.jsonl").write_bytes(bytes_of(tmp_path / "alone")["rig1.jsonl"])
    done = batch.run_batch(places, spread, Workers(2, "local"), lambda one: None)
    assert [one.was_there for one in done] == [False, True, False]
    assert bytes_of(tmp_path / "spread") == bytes_of(tmp_path / "alone")


def test_one_that_cannot_be_used_does_not_stop_the_others(recordings, tmp_path):
    places = [str(recordings[0]), str(tmp_path / "missing"), str(recordings[1])]
    done = batch.run_batch(
        places, batch.Settings(tmp_path / "out", FAST, SourceOptions(), None), ALONE, lambda one: None
    )
    assert [bool(one.failure) for one in done] == [False, True, False]
    assert sorted(bytes_of(tmp_path / "out")) == ["rig0.jsonl", "rig1.jsonl"]
    with pytest.raises(HeadvoxError, match="Two of the sources are called rig0"):
        batch.run_batch(
            [places[0], f"file://{places[0]}"],
            batch.Settings(tmp_path, FAST, SourceOptions(), None),
            ALONE,
            print,
        )


def test_what_was_broken_off_leaves_nothing(recordings, tmp_path, monkeypatch):
    def interrupted(place: str, part: Path, settings: batch.Settings, tell: Callable[[str], None]) -> Report:
        part.write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setattr(batch, "_run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        batch.run_one(str(recordings[0]), batch.Settings(tmp_path, FAST, SourceOptions(), None))
    assert list(tmp_path.iterdir()) == []


def test_the_command_line_of_a_batch(recordings, tmp_path):
    def headvox(*flags: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "headvox", *map(str, flags)]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)

    done = headvox(
        "run", *recordings[:2], tmp_path / "no", "--into", "out", "--no-track", "--refine", "sphere"
    )
    assert done.returncode == 1
    assert "rig0" in done.stdout
    assert "headvox: no: " in done.stderr
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["rig0.jsonl", "rig1.jsonl"]
    assert headvox("run", *recordings[:2]).returncode == 2
    assert headvox("run", recordings[0], "--into", "out", "--json").returncode == 2
    for flags in (("--workers", 2), ("--scheduler", "local")):
        done = headvox("run", recordings[0], *flags)
        assert done.returncode == 2
        assert "go with --into DIR" in done.stderr


def test_a_cluster_makes_the_same_recording(recordings, tmp_path):
    scene = presets.two_cameras(seed=0, people=mannequin, mode="d435i-small", duration_s=1.0)
    made = write_recording(tmp_path / "rig0", scene, stamps(2), Workers(2, "local"))
    first, second = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (recordings[0], made)
    )
    assert first == second
    assert len(first) > 4


def test_an_evaluation_says_the_same_alone_and_on_a_cluster(recordings):
    scenarios = [scenario.recording(path) for path in recordings[:2]]
    scenarios.append(scenario.remote_recording(f"file://{recordings[2]}"))
    plan = Plan((FAST,), None, Rules())
    told: list[int] = []
    alone = list(evaluate_all(scenarios, plan, ALONE, told.append))
    spread = list(evaluate_all(scenarios, plan, Workers(2, "local"), told.append))
    assert told == [1, 2, 3, 1, 2, 3]
    assert [figures(outcome) for _, (outcome,) in alone] == [figures(outcome) for _, (outcome,) in spread]
    outcomes = [outcome for _, (outcome,) in spread]
    every = pooled(outcomes, plan.rules)
    assert every is not None
    assert (every.scenario, every.frames) == ("all 3 recordings", 6)
    assert every.found == sum(outcome.scores[0].found for outcome in outcomes) > 0
    assert pooled(outcomes[:1], plan.rules) is None


def figures(outcome: Outcome) -> list[dict[str, object]]:
    """All that is told but the times, as text: what is not known is no number, and equals itself."""
    return [
        {name: str(value) for name, value in asdict(scores).items() if "latency" not in name}
        for scores in outcome.scores
    ]


def test_recordings_that_lie_elsewhere_are_fetched_and_removed(recordings, tmp_path):
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.put(str(recordings[0]), "/bucket/rig0", recursive=True)
    places = [f"file://{recordings[0]}", "memory://bucket/rig0"]
    results = []
    for place in places:
        into = tmp_path / place.split(":")[0]
        (done,) = batch.run_batch(
            [place], batch.Settings(into, FAST, SourceOptions(), None), ALONE, lambda one: None
        )
        assert done.failure == ""
        results.append(bytes_of(into))
    assert results[0] == results[1]
    with fetched(places[1]) as path:
        assert (path / "recording.json").is_file()
    assert not path.exists()
    for place, words in (("memory://bucket/none", "there is nothing there"), ("nonsense://x/y", "nonsense")):
        with pytest.raises(HeadvoxError, match=words), fetched(place):
            pass
