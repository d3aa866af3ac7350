"""The figures of one detector on one scenario."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np
import numpy.typing as npt

from headvox.errors import HeadvoxError
from headvox.evaluate.match import Rules, match
from headvox.evaluate.metrics import (
    FLIP_DEG,
    Group,
    Sample,
    average_precision,
    counted,
    gather,
    group_rows,
    match_frames,
    mean,
    percentile,
    precision_recall,
    scatter,
    successive_change,
)
from headvox.evaluate.tracking import score_tracks

# Where less is better; elsewhere more is, and the rest is neither.
LESS = (
    "false", "false_per_frame", "duplicates", "centre_mean_m", "centre_median_m", "centre_p90_m", "centre_scatter_m",
    "flips", "yaw_mean_deg", "pitch_mean_deg", "roll_mean_deg", "turn_mean_deg", "turn_median_deg", "turn_p90_deg",
    "switches", "fragmentations", "latency_p50_ms", "latency_p95_ms", "latency_p99_ms", "latency_jitter_ms",
)  # fmt: skip
MORE = (
    "recall", "found", "precision", "average_precision", "truncated_found", "oriented", "mota", "idf1", "hota",
    "detection_accuracy", "association_accuracy", "bridged", "coasted",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Scores:
    """How one detector did on one scenario. What does not apply, or is not known, is None.

    Errors are those of the heads found. Lengths in metres, angles in degrees, shares 0..1.
    """

    scenario: str
    detector: str
    tuned: str
    """"no", "yes" or "partly": whether the detector was tuned on these frames; "" where nobody tells."""
    radius_m: float
    """How near a detection has to be to a head."""
    clear_m: float
    """How far a detection that is left over has to be from any true head to be false."""
    frames: int
    """Frames with labels; only those count."""
    heads: int
    found: int
    recall: float | None
    false: int
    false_per_frame: float | None
    precision: float | None
    duplicates: int
    """Those of the false heads that are within the radius of a head that was found already."""
    truncated: int | None
    """Heads cut by the image's border; they count neither way unless that was asked for."""
    truncated_found: int | None
    average_precision: float | None
    centre_mean_m: float | None
    centre_median_m: float | None
    centre_p90_m: float | None
    centre_bias_m: tuple[float, ...] | None
    """The mean error vector, found minus true, world axes."""
    centre_scatter_m: float | None
    """Root mean square of the error vectors about that mean: the jitter of a head that only turns."""
    oriented: int
    """Found heads of which true and stated orientation are known."""
    flips: int
    """Those more than 90 degrees off; the errors below are without them."""
    yaw_mean_deg: float | None
    pitch_mean_deg: float | None
    roll_mean_deg: float | None
    turn_mean_deg: float | None
    """Of the whole angle between true and stated orientation."""
    turn_median_deg: float | None
    turn_p90_deg: float | None
    latency_p50_ms: float | None
    latency_p95_ms: float | None
    latency_p99_ms: float | None
    latency_jitter_ms: float | None
    """Mean absolute change from one frame to the next."""
    mota: float | None = None
    idf1: float | None = None
    hota: float | None = None
    detection_accuracy: float | None = None
    association_accuracy: float | None = None
    switches: int | None = None
    fragmentations: int | None = None
    gaps: int | None = None
    bridged: int | None = None
    coasted: float | None = None
    curve: tuple[tuple[float, float, float, float], ...] = ()
    """(score threshold, recall, precision, false heads a frame), highest threshold first."""
    groups: dict[str, list[Group]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Scenario and detector."""
        return f"{self.scenario}, {self.detector}"


def score(
    scenario: str, detector: str, samples: Sequence[Sample], rules: Rules, tuned: str = "", warm: int = 3
) -> Scores:
    """Return the figures of ``samples``; the latency of the first ``warm`` frames does not count if there are more.

    Raises:
        HeadvoxError: no frame has labels; or ids to score, and motmetrics is not installed.
    """
    matches = match_frames(samples, rules)
    pairings = [
        (s, s.true, m) for s, m in zip(samples, matches, strict=True) if s.true is not None and m is not None
    ]
    if not pairings:
        raise HeadvoxError(f"{scenario}: no frame has labels.", "Is the heads.jsonl that of this recording?")
    rows = gather(samples, matches, rules)
    errors, found = rows.errors[rows.found], int(rows.found.sum())
    false = sum(len(m.false) for _, _, m in pairings)
    away = np.linalg.norm(errors, axis=1)
    oriented = rows.turns_deg[np.isfinite(rows.turns_deg[:, 3])]
    turns = np.abs(oriented[oriented[:, 3] <= FLIP_DEG])
    latency = np.array([s.found.latency_ms for s in samples])
    latency = latency[warm:] if len(latency) > 4 * warm else latency
    latency = latency[np.isfinite(latency)]
    truncated = sum(int((true.truncated & ~true.ignored).sum()) for _, true, _ in pairings)
    tracks = score_tracks(samples, rules)
    curve = precision_recall(samples, rules)
    return Scores(
        scenario=scenario,
        detector=detector,
        tuned=tuned,
        radius_m=rules.radius_m,
        clear_m=rules.clear_m,
        frames=len(pairings),
        heads=len(rows.frames),
        found=found,
        recall=found / len(rows.frames) if len(rows.frames) else None,
        false=false,
        false_per_frame=false / len(pairings),
        precision=found / (found + false) if found + false else None,
        duplicates=sum(_duplicates(s, m.false, m.pairs[:, 1], rules) for s, _, m in pairings),
        truncated=truncated,
        truncated_found=sum(_truncated_found(s, rules) for s, _, _ in pairings),
        average_precision=average_precision(curve),
        centre_mean_m=mean(away),
        centre_median_m=percentile(away, 50),
        centre_p90_m=percentile(away, 90),
        centre_bias_m=tuple(errors.mean(axis=0).tolist()) if found else None,
        centre_scatter_m=scatter(errors),
        oriented=len(oriented),
        flips=len(oriented) - len(turns),
        yaw_mean_deg=mean(turns[:, 0]),
        pitch_mean_deg=mean(turns[:, 1]),
        roll_mean_deg=mean(turns[:, 2]),
        turn_mean_deg=mean(turns[:, 3]),
        turn_median_deg=percentile(turns[:, 3], 50),
        turn_p90_deg=percentile(turns[:, 3], 90),
        latency_p50_ms=percentile(latency, 50),
        latency_p95_ms=percentile(latency, 95),
        latency_p99_ms=percentile(latency, 99),
        latency_jitter_ms=successive_change(latency),
        curve=tuple(curve),
        groups=group_rows(rows),
        **({} if tracks is None else asdict(tracks)),
    )


def _duplicates(
    sample: Sample, false: npt.NDArray[np.int64], found_true: npt.NDArray[np.int64], rules: Rules
) -> int:
    assert sample.true is not None
    away = np.linalg.norm(
        sample.found.centres[false][:, None] - sample.true.centres[found_true][None], axis=2
    )
    return int((away.min(axis=1, initial=np.inf) <= rules.radius_m).sum())


def _truncated_found(sample: Sample, rules: Rules) -> int:
    """Count the truncated heads that would be found if they counted."""
    assert sample.true is not None
    true, loose = sample.true, Rules(rules.radius_m, rules.clear_m, count_truncated=True)
    pairs = match(sample.found.centres, true.centres, counted(true, loose), loose).pairs
    return int(true.truncated[pairs[:, 1]].sum())
