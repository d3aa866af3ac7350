"""Frames with known heads: the paper's three scenarios, and recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from headvox.data import F64, BadFrame, Cloud, Frame
from headvox.errors import HeadvoxError
from headvox.evaluate.match import Rules
from headvox.evaluate.truth import FILE, NO_ID, TrueHeads, read_truth
from headvox.parallel.workers import ALONE, Workers

if TYPE_CHECKING:
    from headvox.synth.scene import TrueHead

Labelled = tuple[Frame | BadFrame, TrueHeads | None]

SHELL_POINTS = 9000
TURN_RAD_S = float(np.radians(12.0))  # the paper's pace
CLOUD_RATE_HZ = 30.0
RIG_RATE_HZ = 10.0
RIG_FRAMES = 60  # of one walker
AT_ONCE = 100  # frames in memory


@dataclass(frozen=True, slots=True)
class Scenario:
    """Frames with their true heads: ``frames()`` gives them in time order, and again for another detector."""

    name: str
    length: int
    frames: Callable[[], Iterator[Labelled]]
    synthetic: bool
    """Made by :mod:`headvox.synth`, as the training scenes of a cascade may be."""
    recording: str = ""
    """The name that a cascade's ``tuned_on`` knows these frames by."""
    moving: bool = True
    """Whether a frame follows on the one before."""
    rules: Rules | None = None
    """What counts here, where that is part of the scenario."""
    identified: bool = False
    """Whether it is told who is who, in every frame: how well identities are kept can be scored."""


def static(identities: int = 44, turns: int = 100, seed: int = 0) -> Scenario:
    """The paper's scenario I: the shell of each identity, 9,000 points, under random rotations about its centre."""
    return Scenario(
        "static", identities * turns, partial(_static, identities, turns, seed), synthetic=True, moving=False
    )


def _static(identities: int, turns: int, seed: int) -> Iterator[Labelled]:
    for number in range(identities):
        shell = shell_in_head_frame(identities, number, seed)
        rotations = Rotation.random(turns, random_state=np.random.default_rng([seed, number, 0x57A7]))
        for k, turn in enumerate(rotations):
            yield _turned(shell, turn, number * turns + k, None)


def rotation(every: int = 1, revolutions: float = 1.0, seed: int = 0) -> Scenario:
    """The paper's scenario II: a shell that turns by 12 degrees a second, seen 30 times a second.

    ``every`` fifth cloud is what the paper processes.
    """
    count = round(revolutions * 2.0 * np.pi / TURN_RAD_S * CLOUD_RATE_HZ / every)
    name = "rotation" if every == 1 else f"rotation, every {every}th"
    return Scenario(name, count, partial(_rotation, every, count, seed), synthetic=True, identified=True)


def _rotation(every: int, count: int, seed: int) -> Iterator[Labelled]:
    shell = shell_in_head_frame(1, 0, seed)
    for k in range(count):
        yaw = TURN_RAD_S * k * every / CLOUD_RATE_HZ
        yield _turned(shell, Rotation.from_euler("z", yaw), round(k * every * 1e9 / CLOUD_RATE_HZ), 0)


@lru_cache(maxsize=64)
def shell_in_head_frame(identities: int, number: int, seed: int) -> F64:
    """Return the 9,000 points of a head of the paper's data set, as ``headvox synth heads`` makes it."""
    from headvox.synth.heads import HEADVOX_TO_PAPER, make_shell, sample_identities
    from headvox.synth.spread import spread_points

    shell = make_shell(sample_identities(identities, seed)[number], metric=False)
    points = spread_points(shell.vertices, shell.faces, SHELL_POINTS, np.random.default_rng([seed, number]))
    return np.asarray(points @ HEADVOX_TO_PAPER)


def _turned(shell: F64, turn: Rotation, stamp_ns: int, person: int | None) -> Labelled:
    points = np.ascontiguousarray(turn.apply(shell), dtype=np.float32)
    head = {"id": person, "centre": [0.0, 0.0, 0.0], "quaternion": turn.as_quat().tolist()}
    return Frame(stamp_ns, clouds=(Cloud("shell", points),)), TrueHeads.of(stamp_ns, [head])


def two_cameras(
    walkers: int = 4, frames: int = RIG_FRAMES, people: int = 1, seed: int = 100, workers: Workers = ALONE
) -> Scenario:
    """The paper's scenario III: an avatar walks between two D435i 4 m apart; several avatars, one after another.

    ``people`` of them are there at a time; ``frames`` at 10 Hz of each of ``walkers`` scenes, one in a room of its own.
    """
    make = partial(_two_cameras, walkers, frames, people, seed, workers)
    return Scenario("two-cameras", walkers * frames, make, synthetic=True, identified=True)


def _two_cameras(walkers: int, frames: int, people: int, seed: int, workers: Workers) -> Iterator[Labelled]:
    from headvox.synth.presets import two_cameras as stage
    from headvox.synth.record import stamps

    doing = (("walking", "walk"), ("sitting", "stay"), ("standing", "turn"))
    postures, acts = zip(*(doing[k % len(doing)] for k in range(people)), strict=True)
    for walker in range(walkers):
        scene = stage(seed + walker, duration_s=frames / RIG_RATE_HZ, postures=postures, acts=acts)
        later = round(walker * (frames / RIG_RATE_HZ + 10.0) * 1e9)  # nobody is there in between
        every = stamps(frames, RIG_RATE_HZ)
        for first in range(0, frames, AT_ONCE):
            # All of them before the first is looked at: whoever times a detector is not to compete with this.
            made = list(workers.map(scene.frame, every[first : first + AT_ONCE]))
            for frame, heads in made:
                stamp_ns = frame.stamp_ns + later
                true = TrueHeads.of(stamp_ns, [_row(head, 10_000 * walker) for head in heads])
                yield Frame(stamp_ns, frame.clouds, frame.depths), true


def _row(head: TrueHead, ids_from: int) -> dict[str, object]:
    """Return the entry of heads.jsonl that tells of a head of a scene."""
    return {
        "id": ids_from + head.id,
        "centre": head.centre.tolist(),
        "quaternion": head.quaternion.tolist(),
        "ignore": head.ignore,
        "truncated": head.truncated,
        "visible": head.visible,
        "posture": head.posture,
        "hair": head.hair,
    }


def recording(path: Path, say: Callable[[str], None] | None = None) -> Scenario:
    """Whatever :func:`headvox.open_source` reads, with ``heads.jsonl`` in its folder; it has ``say``, too.

    Raises:
        HeadvoxError: nothing to read, no heads.jsonl, or none of its stamps is one of the recording.
    """
    from headvox.sources import open_source

    ids = [who for true in _truth_of(path).values() for who in true.ids.tolist()]
    source = open_source(path, say=say)
    source.close()
    return Scenario(
        source.name,
        source.length or 0,
        partial(_recorded, path.absolute(), _unsaid),
        synthetic=False,
        recording=source.name,
        identified=len(ids) > 0 and NO_ID not in ids,
    )


def _truth_of(path: Path) -> dict[int, TrueHeads]:
    if not path.exists():
        raise HeadvoxError(
            f"{path}: there is no such file or folder.",
            "Check the path; the scenarios are static, rotation, two-cameras, peers, sample and all.",
        )
    folder = path if path.is_dir() else path.parent
    if not (folder / FILE).is_file():
        raise HeadvoxError(
            f"{path}: there is no {FILE} beside it, so nobody knows where the heads are.",
            "docs/conventions.md describes the file.",
        )
    return read_truth(folder / FILE)


def _unsaid(text: str) -> None:
    """Say nothing: it was said when the recording was opened first."""


def _recorded(path: Path, say: Callable[[str], None] | None = None) -> Iterator[Labelled]:
    from headvox.sources import open_source

    truth = _truth_of(path)
    with closing(open_source(path, say=say)) as reading:
        for frame in reading:
            yield frame, truth.get(frame.stamp_ns)


def remote_recording(address: str) -> Scenario:
    """Return a recording that lies elsewhere (:mod:`headvox.sources.remote`), fetched when its frames are asked for."""
    name = address.rstrip("/").rsplit("/", 1)[-1]
    return Scenario(name, 0, partial(_fetched, address), synthetic=False, recording=name)


def _fetched(address: str) -> Iterator[Labelled]:
    from headvox.sources.remote import fetched

    with fetched(address) as path:
        yield from _recorded(path)
