"""Who is who: which head may be that of which track, how likely, and which lost head has come back.

A head is known by where it should be, how it moved, and its height. The height is a slow mean: of people who stand
close together and are missed in turn, it tells more than any motion.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from headvox.data import F64, I64
from headvox.machine.kernels import kernel
from headvox.tracking.kalman import combine, compare
from headvox.tracking.roster import Roster

# A head is a track's only if it is likelier to be than this (-2 ln of a density [m⁻⁴]), or about where it is expected
# (squared Mahalanobis distance): what is found at the far end of where a missed head may be by now is rather another.
UNLIKELY, AS_EXPECTED = -3.0, 2.0
NOT_A_PAIR = 1e6
SLACK_M = 0.03  # errors that stay for a while (hair, view) are no noise to a filter, but need room in a gate
NEAR_M, WALK_M_S, FARTHEST_M = 0.35, 1.2, 1.2  # a head is never sought farther than this from its prediction
UP_M = 0.15  # nor farther than this above or below, nor from the height it was last seen at
SAME_HEAD_M = 0.18  # two heads are not closer: what is found so near to a head is that head, however it moved
HEIGHT_M = 0.03  # standard deviation of the height of a head about its mean: gait, noise
BENT = 0.02  # share of those who bent down, or stretched: any height within a metre is as good
MOST_SIGHTINGS = 30  # that a mean height is taken over
MOST_STRENGTH = 1.5  # of a sighting: one alone makes no track, however it scores
BACK_M, BACK_M_S, BACK_FARTHEST_M = 0.4, 1.0, 2.0  # a lost head is found no farther than this from its way
BACK_SIGMAS = 3.0  # nor farther than this from its height
VIEW_M = 0.015  # how much a mean height depends on the side that a head is seen from


@kernel
def price(roster, centres, R, sure, gate, now_ns, costs):
    """Write to ``costs`` (N, M) how unlikely each of M heads is to be that of each of N tracks: -2 ln of the density.

    ``NOT_A_PAIR`` where it cannot be: farther than ``gate`` (squared Mahalanobis distance), or than anybody goes, or a
    track that is lost.
    """
    tracks, heads = costs.shape
    mean, cov = np.empty((tracks, 6)), np.empty((tracks, 6, 6))
    for n in range(tracks):
        combine(roster[n], mean[n], cov[n])
    loose = R.copy()
    for m in range(heads):
        for a in range(3):
            loose[m, a, a] += SLACK_M * SLACK_M
    squared = np.empty((tracks, heads))
    compare(roster, mean, cov, centres, loose, squared, costs)
    for n in range(tracks):
        row = roster[n]
        unseen_s = (now_ns - row.seen_ns) * 1e-9
        reach = min(NEAR_M + WALK_M_S * unseen_s, FARTHEST_M)
        for m in range(heads):
            far = 0.0
            for a in range(3):
                far += (centres[m, a] - mean[n, a]) ** 2
            far = np.sqrt(far)
            up = min(abs(centres[m, 2] - mean[n, 2]), abs(centres[m, 2] - row.place[2]))
            fits = squared[n, m] <= gate or far <= SAME_HEAD_M
            may_be = row.id > 0 or sure[m]
            if row.lost or not (fits and may_be and far <= reach and up <= UP_M):
                costs[n, m] = NOT_A_PAIR
                continue
            off = centres[m, 2] - row.height
            variance = HEIGHT_M * HEIGHT_M * (1.0 + 1.0 / row.sightings) + R[m, 2, 2]
            upright = np.exp(-0.5 * off * off / variance) / np.sqrt(2.0 * np.pi * variance)
            costs[n, m] -= 2.0 * np.log((1.0 - BENT) * upright + BENT)
            if costs[n, m] > UNLIKELY and squared[n, m] > AS_EXPECTED and far > SAME_HEAD_M:
                costs[n, m] = NOT_A_PAIR


@kernel
def note_sightings(roster, tracks, found, now_ns, centres, radii, scores, sure, strong):
    """Enter for the ``tracks`` (K,) which of the heads were ``found`` (K,); their filters are corrected already.

    A sighting that scores ``strong`` counts for one, and none for more than ``MOST_STRENGTH``.
    """
    for k in range(tracks.shape[0]):
        row, m = roster[tracks[k]], found[k]
        row.seen_ns = now_ns
        row.radius, row.score = radii[m], scores[m]
        row.hits |= sure[m]
        for a in range(3):
            row.place[a] = row.velocity[a] = 0.0
            for i in range(2):
                row.place[a] += row.weights[i] * row.x[i, a]
                row.velocity[a] += row.weights[i] * row.x[i, 3 + a]
        row.sightings = min(row.sightings + 1, MOST_SIGHTINGS)
        row.height += (centres[m, 2] - row.height) / row.sightings
        row.strength += (min(scores[m] / strong, MOST_STRENGTH) - row.strength) / row.sightings


def pairs(costs: F64) -> tuple[I64, I64]:
    """Return the rows and columns of ``costs`` that belong together, so that all pairs together are the likeliest."""
    rows, columns = linear_sum_assignment(costs)
    paired = costs[rows, columns] < NOT_A_PAIR
    return rows[paired], columns[paired]


def come_back(roster: Roster, new: I64, lost: I64) -> tuple[I64, I64]:
    """Return which rows ``new`` are heads that were known before, and the rows of those, out of ``lost``."""
    unseen_s = (roster["seen_ns"][new][:, None] - roster["seen_ns"][lost]) * 1e-9
    away = roster["place"][new][:, None, :2] - roster["place"][lost][:, :2]
    path = (
        roster["velocity"][lost][:, :2] * unseen_s[:, :, None]
    )  # if it went on, or stopped anywhere on the way
    share = np.clip((away * path).sum(axis=2) / np.maximum((path**2).sum(axis=2), 1e-9), 0.0, 1.0)
    far = np.linalg.norm(away - share[:, :, None] * path, axis=2)
    reach = np.minimum(BACK_M + BACK_M_S * unseen_s, BACK_FARTHEST_M)
    sightings = 1.0 / roster["sightings"][new][:, None] + 1.0 / roster["sightings"][lost]
    spread = np.sqrt(2.0 * VIEW_M**2 + HEIGHT_M**2 * sightings)
    up = np.abs(roster["height"][new][:, None] - roster["height"][lost])
    unlike = (far / reach) ** 2 + (up / (BACK_SIGMAS * spread)) ** 2
    possible = (unlike <= 1.0) & (roster["seen_ns"][lost] < roster["born_ns"][new][:, None])
    found, known = pairs(np.where(possible, unlike, NOT_A_PAIR))
    return new[found], lost[known]
