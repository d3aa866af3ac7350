"""How near people may come to a robot that moves: an example of speed and separation, AND NO SAFETY FUNCTION.

python examples/speed_and_separation.py [SOURCE]      (without SOURCE: the sample that ships with headvox)

The distance of the nearest head is compared with the protective distance as ISO/TS 15066 adds it up,
S = S_human + S_robot + S_stop + C + Z_human + Z_robot. headvox is not safety rated, and misses people: no head is not
nobody. Use this to slow down early, beside a certified function that stops, never in its place.
"""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path

import numpy as np

import headvox

ROBOT = np.array([0.0, 2.6, 1.0])  # where the tool is, m; a real one tells it, and its speed, in each cycle
ROBOT_SPEED, STOP_S, REACT_S = 0.5, 0.3, 0.1  # m/s towards people; until it stands; until it begins to brake
LEAST_SPEED = 1.6  # m/s: a person is taken to come at least as fast (ISO 13855)
REACH = 0.85  # C, m: an arm that is stretched out before the head
ROBOT_SIGMA, SIGMAS = 0.005, 3.0  # Z: how well the places are known


def protective_distance(towards: float, sigma: float) -> float:
    """Return S in metres for a head that comes with ``towards`` m/s and whose place is known to ``sigma`` m."""
    human = max(towards, LEAST_SPEED) * (REACT_S + STOP_S)
    robot = ROBOT_SPEED * (REACT_S + 0.5 * STOP_S)  # it brakes evenly
    return human + robot + REACH + SIGMAS * (sigma + ROBOT_SIGMA)


def main(place: str | Path) -> None:
    """Print what the robot should do, for each frame."""
    detector, tracker = headvox.Detector(), headvox.Tracker()
    with closing(headvox.open_source(place)) as source, closing(detector):
        for frame, _ in headvox.follow(source, detector, tracker, lambda why: print(f"stop: {why}")):
            soon = tracker.predict(frame.stamp_ns + round(1e9 * REACT_S))  # where they are when it brakes
            margins = [np.inf]
            for head, covariance in zip(soon, soon.covariances[:, :3, :3], strict=True):  # without an id, too
                away = head.centre - ROBOT
                gap = float(np.linalg.norm(away))
                towards = -float(np.nan_to_num(head.velocity) @ away) / gap
                sigma = float(np.sqrt(away @ covariance @ away)) / gap  # along the line between them
                margins.append(gap - protective_distance(towards, sigma))
            least = np.min(margins)  # NaN if any is: then it stops
            print(f"{frame.stamp_ns / 1e9:.2f} s  margin {least:+.2f} m: {'go on' if least > 0 else 'stop'}")


if __name__ == "__main__":
    try:
        main(sys.argv[1] if len(sys.argv) > 1 else headvox.sample_folder())
    except headvox.HeadvoxError as error:
        sys.exit(str(error))
