"""The process that talks to rerun, given frames: ``python -m headvox.view.log every|newest [NAME.rrd]``."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from headvox.data import F64, DepthImage, Frame, State, Track
from headvox.frames import placed, transform
from headvox.render.colours import of_head
from headvox.render.heads import SIZE_M
from headvox.render.scene import points_of, viewpoint_for
from headvox.view import viewer
from headvox.view.mailbox import letters
from headvox.view.watch import Seen

NOSE_M = 0.25
TRAIL_S = 5.0
EPOCH_NS = 10**17  # stamps above are dates, those below count from the beginning
FLUSH_S = 10.0
AWAY_M = 6.0  # what the eye turns about


class Log:
    """Logs frames. Everything lies in the world frame, metres, z up."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._to = recording
        self._placed: dict[str, DepthImage] = {}
        self._trails: dict[int, deque[tuple[int, F64]]] = {}
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def show(self, seen: Seen) -> None:
        """Log a frame."""
        result = seen.result
        self._to.set_time("frame", sequence=result.frame)
        stamp = np.timedelta64(result.stamp_ns, "ns")
        if result.stamp_ns > EPOCH_NS:
            self._to.set_time("stamp", timestamp=np.datetime64(0, "ns") + stamp)
        else:
            self._to.set_time("stamp", duration=stamp)
        self._sensors(seen.frame)
        self._stages(seen)
        tracks = list(result.rows())
        self._heads(tracks)
        self._trail(result.stamp_ns, tracks)
        self._to.log("latency/all", rr.Scalars(result.latency_ms))
        for stage, ms in seen.stage_ms.items():
            self._to.log(f"latency/{stage}", rr.Scalars(ms))

    def _sensors(self, frame: Frame) -> None:
        for image in frame.depths:
            name = f"world/sensors/{_entity(image.name)}"
            known, lens = self._placed.get(image.name), image.intrinsics
            if (
                known is None
                or known.intrinsics != lens
                or not np.array_equal(known.T_world_camera, image.T_world_camera)
            ):
                T = image.T_world_camera
                self._to.log(name, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
                self._to.log(
                    name,
                    rr.Pinhole(
                        focal_length=(lens.fx, lens.fy), principal_point=(lens.cx + 0.5, lens.cy + 0.5),
                        resolution=(lens.width, lens.height), camera_xyz=rr.ViewCoordinates.RDF,
                        image_plane_distance=0.4,
                    ),
                )  # fmt: skip
                self._placed[image.name] = image
            depth = rr.DepthImage(
                image.depth,
                meter=1.0 / lens.depth_scale,
                point_fill_ratio=0.4,
                colormap="turbo",
                depth_range=(0.0, 6.0 / lens.depth_scale),
            )
            self._to.log(f"{name}/depth", depth)
        for cloud in frame.clouds:
            points = cloud.points[np.isfinite(cloud.points).all(axis=1)]
            if cloud.T_world_sensor is not None:
                points = transform(cloud.T_world_sensor, points.astype(np.float64)).astype(np.float32)
            self._to.log(
                f"world/sensors/{_entity(cloud.name)}",
                rr.Points3D(points, radii=0.006, colors=_by_height(points)),
            )

    def _stages(self, seen: Seen) -> None:
        self._to.log("world/gate", rr.Points3D(seen.candidates, radii=0.008, colors=(150, 155, 165)))
        voted = np.isfinite(seen.votes)
        votes = seen.votes[voted]
        warmth = (votes - votes.min(initial=np.inf)) / max(float(np.ptp(votes)) if len(votes) else 0.0, 1e-9)
        colours = np.stack([np.full(len(votes), 255.0), 220.0 * (1.0 - warmth), np.zeros(len(votes))], axis=1)
        self._to.log(
            "world/votes",
            rr.Points3D(seen.candidates[voted], radii=0.014, colors=colours.astype(np.uint8)),
            rr.AnyValues(score=votes),
        )

    def _heads(self, tracks: Sequence[Track]) -> None:
        turned = [track for track in tracks if np.isfinite(track.quaternion).all()]
        others = [track for track in tracks if not np.isfinite(track.quaternion).all()]
        self._to.log(
            "world/heads/turned",
            rr.Boxes3D(
                centers=_column(turned, "centre", 3), sizes=[SIZE_M] * len(turned), radii=0.006,
                quaternions=_column(turned, "quaternion", 4), colors=[_colour(t) for t in turned],
                labels=[_label(t) for t in turned],
            ),
        )  # fmt: skip
        ahead = [placed(track.centre, track.quaternion)[:3, 0] * NOSE_M for track in turned]
        self._to.log(
            "world/heads/looking",
            rr.Arrows3D(
                vectors=np.array(ahead).reshape(-1, 3), origins=_column(turned, "centre", 3), radii=0.008,
                colors=[_colour(t) for t in turned],
            ),
        )  # fmt: skip
        self._to.log(
            "world/heads/round",
            rr.Ellipsoids3D(
                centers=_column(others, "centre", 3), half_sizes=[[t.radius] * 3 for t in others], line_radii=0.004,
                colors=[_colour(t) for t in others], labels=[_label(t) for t in others],
            ),
        )  # fmt: skip

    def _trail(self, stamp_ns: int, tracks: Sequence[Track]) -> None:
        for track in tracks:
            if track.id:
                self._trails.setdefault(track.id, deque()).append((stamp_ns, np.array(track.centre)))
        for identity, trail in list(self._trails.items()):
            while trail and trail[0][0] < stamp_ns - 1e9 * TRAIL_S:
                trail.popleft()
            if not trail:
                del self._trails[identity]
        strips = [[place for _, place in trail] for trail in self._trails.values()]
        colours = [of_head(identity) for identity in self._trails]
        self._to.log("world/trails", rr.LineStrips3D(strips, radii=0.006, colors=colours))


def _entity(name: str) -> str:
    """Return a sensor's name as one part of a path."""
    return str(rr.escape_entity_path_part(name))


def _column(tracks: Sequence[Track], name: str, width: int) -> F64:
    return np.array([getattr(track, name) for track in tracks], np.float64).reshape(-1, width)


def _colour(track: Track) -> tuple[int, int, int, int]:
    faint = 110 if track.state == State.COASTING else 255
    return (*of_head(track.id), faint) if track.id else (170, 170, 170, faint)


def _label(track: Track) -> str:
    return f"{track.id or '?'}"


def _by_height(points: np.ndarray) -> np.ndarray:
    high = np.clip(points[:, 2] / 2.0, 0.0, 1.0)[:, None]
    return ((1 - high) * (70, 60, 140) + high * (250, 220, 60)).astype(np.uint8)


def blueprint(frame: Frame) -> rrb.Blueprint:
    """Return how the viewer is laid out: the world, beside it the images, below it what each stage takes."""
    images: list[rrb.View] = [
        rrb.Spatial2DView(
            origin=f"world/sensors/{_entity(image.name)}",
            name=image.name,
            contents=["$origin/**", "world/heads/**"],
        )
        for image in frame.depths
    ]
    T = viewpoint_for(frame, points_of(frame), 800, 600).T_world_camera
    eye = rrb.EyeControls3D(position=T[:3, 3], look_target=T[:3, 3] + AWAY_M * T[:3, 2], eye_up=(0, 0, 1))
    world = rrb.Spatial3DView(origin="world", name="world", background=(24, 26, 30), eye_controls=eye)
    plots = rrb.TimeSeriesView(origin="latency", name="milliseconds a frame")
    left = rrb.Vertical(world, plots, row_shares=[4, 1])
    layout = rrb.Horizontal(left, rrb.Vertical(*images), column_shares=[2, 1]) if images else left
    return rrb.Blueprint(layout, collapse_panels=True)


def give_way() -> None:
    """Run on what the loop, and everybody else, leaves of the processor."""
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    elif hasattr(os, "nice"):
        os.nice(19)


def main(pace: str, path: str | None = None) -> None:
    """Log what comes, into ``path`` or to the viewer; with the pace ``newest``, the loop comes first."""
    if pace == "newest":
        give_way()
    os.environ.update(viewer.quiet_environment())
    recording = rr.RecordingStream("headvox", send_properties=False)
    if path is None:
        viewer.start()
        recording.connect_grpc(viewer.url())
    log, first = Log(recording), True
    for seen in letters(sys.stdin.buffer):
        if first:
            if path is not None:  # not before: without a frame, what stood there stays
                recording.save(path)
            recording.send_blueprint(blueprint(seen.frame))
            first = False
        log.show(seen)
        recording.flush(timeout_sec=FLUSH_S)  # what is not taken now must wait in the mailbox, not in memory
    recording.disconnect()


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except Exception as error:
        print(f"headvox: the viewer: {type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(1)
