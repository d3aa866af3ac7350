"""What is handed out of a table of tracks: held equal to plain algebra, row by row."""

from __future__ import annotations

import naive_kalman as naive
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headvox.data import State
from headvox.pose.settle import SURE_YAW_RAD
from headvox.tracking.report import EXPECTED_YAW_RAD, LEAST_REACH_M, MOST_REACH_M, expectations, report
from headvox.tracking.roster import blank

LAST_NS, STAMP_NS = 10_000_000_000, 10_050_000_000


def some_tracks(rng, count):
    roster = blank(count)
    for n in range(count):
        A = rng.normal(size=(2, 6, 6)) * rng.choice([0.005, 0.02, 0.2])
        B = rng.normal(size=(6, 6)) * rng.choice([0.02, 0.06, 0.4])
        roster["P"][n], roster["C"][n] = A @ A.transpose(0, 2, 1), B @ B.T
        roster["weights"][n] = rng.dirichlet((1, 1))
    roster["x"] = rng.normal(size=(count, 1, 6)) + 0.02 * rng.normal(size=(count, 2, 6))
    roster["rate"] = rng.normal(size=(count, 3))
    roster["q"] = Rotation.random(count, rng).as_quat()
    roster["q"][rng.random(count) < 0.3] = np.nan
    roster["radius"], roster["score"] = rng.normal(size=(2, count))
    roster["id"] = rng.permutation(np.maximum(np.arange(count) - count // 3, 0))
    roster["lost"] = rng.random(count) < 0.3
    roster["absent"] = rng.random(count) < 0.2
    roster["born_ns"] = LAST_NS - 3_000_000_000
    roster["seen_ns"] = LAST_NS - rng.integers(0, 2, count) * 400_000_000
    return roster


def yaw_sigma(row):
    return np.sqrt(row["C"][2, 2])


@pytest.mark.parametrize("count", [0, 1, 40])
def test_tracks_are_told_as_they_stand_in_the_table(count):
    roster = some_tracks(np.random.default_rng(count), count)
    tracks = report(roster, LAST_NS, STAMP_NS)
    living = [n for n in range(count) if not roster["lost"][n]]
    there = [n for n in living if not roster["absent"][n]]
    named = sorted((n for n in there if roster["id"][n]), key=lambda n: roster["id"][n])
    nameless = [n for n in there if not roster["id"][n] and roster["seen_ns"][n] == LAST_NS]
    rows = roster[named + nameless]
    np.testing.assert_array_equal(tracks.ids, rows["id"])
    for k, row in enumerate(rows):
        mean, cov = naive.mixture(row["weights"], row["x"], row["P"])
        np.testing.assert_allclose(tracks.centres[k], mean[:3])
        np.testing.assert_allclose(tracks.velocities[k], mean[3:])
        np.testing.assert_allclose(tracks.covariances[k], cov)
        seen = row["seen_ns"] == LAST_NS
        state = (State.CONFIRMED if seen else State.COASTING) if row["id"] else State.TENTATIVE
        assert tracks.states[k] == state
        assert tracks.unseen_s[k] == pytest.approx(0.05 if seen else 0.45)
        unknown = np.isnan(row["q"][3]) or yaw_sigma(row) >= SURE_YAW_RAD
        np.testing.assert_array_equal(tracks.rates[k], np.full(3, np.nan) if unknown else row["rate"])
        np.testing.assert_array_equal(
            tracks.rotation_covariances[k], np.full((3, 3), np.nan) if unknown else row["C"][:3, :3]
        )
        np.testing.assert_array_equal(tracks.quaternions[k], np.full(4, np.nan) if unknown else row["q"])
    for column, name in ((tracks.radii, "radius"), (tracks.scores, "score")):
        np.testing.assert_array_equal(column, rows[name])
    np.testing.assert_allclose(tracks.ages_s, np.full(len(rows), 3.05))
    assert [track.id for track in tracks] == tracks.ids.tolist()
    if count == 40:
        assert np.isnan(tracks.quaternions[:, 3]).sum() > np.isnan(rows["q"][:, 3]).sum()
        assert set(tracks.states.tolist()) == set(State)
        assert tracks[-1].centre.tolist() == tracks.centres[len(tracks) - 1].tolist()
        with pytest.raises(IndexError):
            tracks[len(tracks)]


def test_the_living_that_have_an_id_are_expected():
    roster = some_tracks(np.random.default_rng(5), 40)
    expected = expectations(roster)
    rows = roster[(roster["id"] > 0) & ~roster["lost"]]
    assert len(expected) == len(rows) > 10
    for k, row in enumerate(rows):
        mean, cov = naive.mixture(row["weights"], row["x"], row["P"])
        np.testing.assert_allclose(expected.centres[k], mean[:3])
        reach = 3.0 * np.sqrt(np.trace(cov[:3, :3]))
        assert expected.reaches_m[k] == pytest.approx(np.clip(reach, LEAST_REACH_M, MOST_REACH_M))
    sure = np.array([yaw_sigma(row) < EXPECTED_YAW_RAD for row in rows])
    assert 0 < sure.sum() < len(rows)
    np.testing.assert_array_equal(
        expected.quaternions, np.where(sure[:, None], np.round(rows["q"], 3), np.nan)
    )
    free = (expected.reaches_m > LEAST_REACH_M) & (expected.reaches_m < MOST_REACH_M)
    assert 0 < free.sum() < len(rows)
