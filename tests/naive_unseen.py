"""Where a missed head may be, sample by sample and in plain matrix algebra: twin of headvox.tracking.unseen."""

from __future__ import annotations

import naive_kalman as kalman
import numpy as np

from headvox.tracking import unseen
from headvox.visibility import OUT_OF_VIEW, SEEN_EMPTY, SURFACE

STEPS = unseen.STEP * np.arange(-unseen.STEPS, unseen.STEPS + 1)
GRID = np.array([(u, v) for u in STEPS for v in STEPS])
PRIOR = np.exp(-0.5 * (GRID**2).sum(axis=1))
PRIOR /= PRIOR.sum()


def spread(x, P):
    """Return the samples (2 K, 3) of a track's two models, ``x`` (2, 6) and ``P`` (2, 6, 6)."""
    places = []
    for mean, cov in zip(x, P, strict=True):
        along = GRID @ np.linalg.cholesky(cov[:2, :2]).T
        places.append(np.column_stack([mean[:2] + along, np.full(len(GRID), mean[2])]))
    return np.concatenate(places)


def weigh(roster, rows, places, seen, centres):
    """Return the weights (N, 2 K) of all ``places`` (N, 2 K, 3)."""
    weights = np.empty(seen.shape)
    for k, row in enumerate(rows):
        models = roster["weights"][row]
        weights[k] = np.concatenate([models[0] * PRIOR, models[1] * PRIOR])
        for s, place in enumerate(places[k]):
            likely = unseen.LIKELY[seen[k, s]]
            if any(np.linalg.norm(place - centre) < unseen.TAKEN_M for centre in centres):
                likely = min(likely, unseen.TAKEN)
            for other in rows:
                mean, cov = kalman.mixture(roster["weights"][other], roster["x"][other], roster["P"][other])
                known = np.sqrt(np.trace(cov[:2, :2])) < unseen.KNOWN_M
                near = np.linalg.norm(place - mean[:3]) < unseen.TAKEN_M
                if other != row and roster["id"][other] > 0 and known and near:
                    likely *= unseen.DISPUTED
            weights[k, s] *= likely
    return weights


def narrow(x, P, weights):
    """Return mean and covariance of one model after its samples were given ``weights`` (K,)."""
    share = weights / weights.sum()
    m = share @ GRID
    C = (GRID - m).T @ ((GRID - m) * share[:, None]) / (PRIOR @ GRID[:, 0] ** 2)
    L = np.linalg.cholesky(P[:2, :2])
    A = P[:, :2] @ np.linalg.inv(L).T
    return x + A @ m, P - A @ (np.eye(2) - C) @ A.T


def conclude(mean, places, seen, weights):
    """Return what was seen of most that is left, and whether the track is absent."""
    mass = [weights[seen == state].sum() for state in range(OUT_OF_VIEW, SEEN_EMPTY + 1)]
    state = SEEN_EMPTY if sum(mass) < unseen.GONE else int(np.argmax(mass[:SEEN_EMPTY]))
    near = np.linalg.norm(places[:, :2] - mean[:2], axis=1) < unseen.RIGHT_M
    return state, state >= SURFACE and weights[near].sum() < unseen.LEAST_SURE * sum(mass)
