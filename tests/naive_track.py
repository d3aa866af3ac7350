"""What a tracker does with each track, one after another: twin of headvox.tracking.identity, noise and lifetime."""

from __future__ import annotations

import naive_kalman as kalman
import numpy as np

from headvox.tracking import identity, noise
from headvox.tracking.lifetime import MOST_DRAIN, WEAK
from headvox.visibility import BEHIND, OUT_OF_VIEW


def price(roster, centres, R, sure, gate, now_ns):
    """Return the cost of each pair (N, M)."""
    costs = np.empty((len(roster), len(centres)))
    for n in range(len(roster)):
        x, P, weight = roster["x"][n], roster["P"][n], roster["weights"][n]
        mean, cov = kalman.mixture(weight, x, P)
        unseen_s = (now_ns - roster["seen_ns"][n]) * 1e-9
        for m, centre in enumerate(centres):
            loose = R[m] + identity.SLACK_M**2 * np.eye(3)
            d = centre - mean[:3]
            far = np.linalg.norm(d)
            squared = d @ np.linalg.solve(cov[:3, :3] + loose, d)
            up = min(abs(d[2]), abs(centre[2] - roster["place"][n, 2]))
            near = far <= identity.SAME_HEAD_M
            reach = min(identity.NEAR_M + identity.WALK_M_S * unseen_s, identity.FARTHEST_M)
            variance = identity.HEIGHT_M**2 * (1 + 1 / roster["sightings"][n]) + R[m, 2, 2]
            off = centre[2] - roster["height"][n]
            upright = np.exp(-0.5 * off**2 / variance) / np.sqrt(2 * np.pi * variance)
            cost = kalman.surprise(x, P, weight, centre, loose)
            cost -= 2 * np.log((1 - identity.BENT) * upright + identity.BENT)
            may_be = (squared <= gate or near) and far <= reach and up <= identity.UP_M
            may_be = (
                may_be
                and (roster["id"][n] > 0 or sure[m])
                and (cost <= identity.UNLIKELY or squared <= identity.AS_EXPECTED or near)
            )
            costs[n, m] = cost if may_be else identity.NOT_A_PAIR
    costs[roster["lost"]] = identity.NOT_A_PAIR
    return costs


def scatter_of(stamps_ns, centres):
    """Return what is known of the noise of one head (3, 3) after it was seen at these times and places."""
    scatter = np.zeros((3, 3))
    for k in range(2, len(stamps_ns)):
        before, step = np.diff(stamps_ns[k - 2 : k + 1]) * 1e-9
        if max(before, step) < noise.RUN_S:
            r = step / before
            e = centres[k] - (centres[k - 1] + r * (centres[k - 1] - centres[k - 2]))
            scatter += noise.SHARE * (np.outer(e, e) / (1 + (1 + r) ** 2 + r**2) - scatter)
    return scatter


def age(life, trust, strength, seen, sure, state, dt, lasts_s, present_s, weak_s):
    """Return life and trust of one living track after a frame."""
    if seen and sure:
        return 1.0, min(trust + strength * dt / present_s, 1.0)
    if seen:
        life_s, trust_s = weak_s, WEAK * present_s
    else:
        life_s = lasts_s[state]
        trust_s = np.inf if state in (OUT_OF_VIEW, BEHIND) else present_s
    return life - min(dt / life_s, MOST_DRAIN), trust - min(dt / trust_s, MOST_DRAIN)
