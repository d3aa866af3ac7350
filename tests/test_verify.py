import math
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
from scipy.special import expit

from headvox.config import DetectorConfig
from headvox.data import Expected, Heads, unknown
from headvox.errors import HeadvoxError
from headvox.evolve import verify as fitting
from headvox.evolve.views import Heads as TrueHeads
from headvox.evolve.views import View
from headvox.evolve.write import verification_lines
from headvox.masks.cascade import Verification
from headvox.masks.describe import describe_cascade
from headvox.masks.read import load_cascade, parse_cascade
from headvox.pipeline import Detector
from headvox.pose.fit import Poses
from headvox.sample import sample_folder
from headvox.sources import open_source
from headvox.verify import losses_of, verify

RULE = Verification(most=2.0, sure_m=0.03, free=1.0, misfit=2.0, radius=100.0, radius_m=0.09)
DEFAULT = (resources.files("headvox") / "cascades" / "default.toml").read_text("utf-8")
BEFORE = DEFAULT[: DEFAULT.index("[verification]")]


def poses_of(misfits, radii, sigmas):
    poses = Poses.unknown(np.zeros((len(misfits), 3)))
    poses.misfits[:], poses.radii[:] = misfits, radii
    poses.centre_covariances[:] = np.eye(3) * np.array(sigmas)[:, None, None] ** 2 / 3.0
    return poses


def naive_loss(misfit, radius, sigma, rule):
    if not sigma < rule.sure_m:
        return 0
    loss = rule.misfit * misfit + rule.radius * abs(radius - rule.radius_m) - rule.free
    return round(1024 * min(max(loss, 0.0), rule.most))


def test_losses_are_what_the_naive_twin_says():
    rng = np.random.default_rng(0)
    misfits, radii, sigmas = (
        rng.uniform(0, 1.2, 300),
        rng.uniform(0.08, 0.1, 300),
        rng.uniform(0.005, 0.05, 300),
    )
    radii[:5] = misfits[5:10] = np.nan
    sigmas[:10] = np.nan  # too few points for a fit
    losses = losses_of(poses_of(misfits, radii, sigmas), RULE)
    assert losses.tolist() == [
        naive_loss(m, r, s, RULE) for m, r, s in zip(misfits, radii, sigmas, strict=True)
    ]
    assert losses.min() == 0
    assert losses.max() == 2048
    assert (losses[:10] == 0).all()
    assert len(np.unique(losses)) > 50


def four_heads():
    centres = np.array([[0.0, 0, 1], [1, 0, 1], [2, 0, 1], [3, 0, 1]])
    return Heads(
        centres, unknown(4, 4), np.full(4, 0.1), np.array([3.0, 2.5, 2.0, 1.5]), sure=np.ones(4, bool)
    )


def test_a_score_may_only_fall_and_poses_stay_with_their_heads():
    """The first fits, the second does not, the third is not sure, and the last has no pose."""
    heads, poses = four_heads(), poses_of([0.1, 1.0, 3.0], [0.09, 0.095, 0.09], [0.01, 0.01, 0.2])
    kept, told = verify(heads, poses, RULE, 1024, 0, None, 0.05)
    np.testing.assert_allclose(kept.scores, [3.0, 1.0, 2.0, 1.5], atol=1 / 1024)
    np.testing.assert_array_equal(told.misfits, [0.1, 1.0, 3.0, np.nan])
    kept, told = verify(heads, poses, RULE, 1300, 0, None, 0.05)
    np.testing.assert_array_equal(kept.centres, heads.centres[[0, 2, 3]])
    np.testing.assert_array_equal(told.misfits, [0.1, 3.0, np.nan])
    assert kept.sure.all()


def test_where_a_head_is_expected_the_fit_has_no_say():
    heads, poses = four_heads(), poses_of([0.1, 1.0, 1.0], [0.09] * 3, [0.01] * 3)
    expected = Expected(heads.centres[[1, 3]], unknown(2, 4), np.array([0.1, 0.1]))
    kept, _ = verify(heads, poses, RULE, 1700, 200, expected, 0.05)
    np.testing.assert_array_equal(kept.scores, [3.0, 2.5, 1.5])
    assert kept.sure.tolist() == [True, True, False]


@pytest.fixture(scope="module")
def sample():
    return next(iter(open_source(str(sample_folder()))))


def detector(tmp_path, rule, refine="pose", least=0.0):
    path = tmp_path / "c.toml"
    path.write_text(BEFORE + "\n".join(verification_lines(rule)), "utf-8")
    return Detector(DetectorConfig(cascade=str(path), min_score=least, refine=refine), backend="cpu")


def test_the_detector_asks_the_fit_where_poses_are_fitted(tmp_path, sample):
    strict = replace(RULE, misfit=0.0, radius=0.0, radius_m=0.0, free=0.0, sure_m=1.0)
    plain = detector(tmp_path, None).detect_frame(sample)
    assert len(plain) >= 3
    lower = detector(tmp_path, replace(strict, radius=10.0)).detect_frame(sample)  # a point for 10 cm
    np.testing.assert_allclose(lower.scores, plain.scores - 10.0 * plain.radii, atol=1 / 1024)
    np.testing.assert_array_equal(lower.centres, plain.centres)
    least = float(plain.scores[2]) - 1.0
    fewer = detector(tmp_path, replace(strict, radius=1e6, most=2.0), least=least).detect_frame(sample)
    np.testing.assert_array_equal(fewer.centres, plain.centres[plain.scores - 2.0 >= least])
    assert 0 < len(fewer) < 3
    spheres = [detector(tmp_path, rule, "sphere").detect_frame(sample) for rule in (None, strict)]
    np.testing.assert_array_equal(spheres[0].scores, spheres[1].scores)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("verification = 3", "verification: expected a table"),
        ("[verification]\nmost = 2", "verification.sure_m: expected a number from 0"),
        ("[verification]\nmost = -2", "verification.most: expected a number from 0"),
        ("[verification]\nmore = 2", "verification: expected only"),
    ],
)
def test_a_verification_that_is_none_is_told_in_one_line(text, said):
    whole = text + "\n" + BEFORE if text.startswith("verification =") else BEFORE + text
    with pytest.raises(HeadvoxError, match=said):
        parse_cascade(whole, "x")


def test_it_is_written_read_and_described():
    assert load_cascade("default").verification is not None
    cascade = parse_cascade(BEFORE + "\n".join(verification_lines(RULE)), "x")
    assert cascade.verification == RULE
    assert (
        "lowers the score by 2 x misfit + 100 x (metres that the radius is off 0.09) - 1"
        in describe_cascade(cascade)
    )
    assert parse_cascade(BEFORE + "\n".join(verification_lines(None)), "x").verification is None


def test_the_costs_that_made_the_labels_are_found_again():
    rng = np.random.default_rng(1)
    score, misfit = rng.normal(0, 1, 40_000), rng.uniform(0.05, 1.0, 40_000)
    off = rng.normal(0, 0.006, 40_000)
    chance = expit(score + 1.0 - 2.0 * misfit - 100.0 * np.abs(off))
    fits = fitting.Fits((rng.random(40_000) < chance).astype(np.int8), score, misfit, 0.09 + off)
    rule = fitting.fit_verification(fits)
    assert rule is not None
    assert rule.free == pytest.approx(1.0, abs=0.1)
    assert rule.misfit == pytest.approx(2.0, abs=0.15)
    assert rule.radius == pytest.approx(100.0, abs=8.0)
    assert rule.radius_m == 0.09
    none = np.zeros(9)
    assert fitting.fit_verification(fitting.Fits(np.ones(9, np.int8), none, none, none)) is None
    worse = replace(fits, label=1 - fits.label, score=-score)  # heads fit worse than the others
    assert fitting.fit_verification(worse) is None


def test_what_is_fitted_to_the_sample_is_learnt_from(tmp_path, sample):
    path = tmp_path / "c.toml"
    path.write_text(BEFORE, "utf-8")
    heads = Detector(DetectorConfig(cascade=str(path), refine="sphere"), backend="cpu").detect_frame(sample)
    count = len(heads)
    truth = TrueHeads(heads.centres, np.ones(count), np.ones(count, bool), np.zeros(count, np.int64))
    fits = fitting.fits_in(View(0, sample, truth), path)
    assert fits is not None
    assert fits.label.sum() == 3
    assert (fits.misfit[fits.label == 1] < 0.6).all()
    assert all(math.isclose(radius, 0.092, abs_tol=0.015) for radius in fits.radius[fits.label == 1])
    assert fitting.spoilt_fits(View(180, sample, truth), path) is None  # kept aside
    assert len(fitting.Fits.join([fits, fits]).label) == 2 * len(fits.label)
