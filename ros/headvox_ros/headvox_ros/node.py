"""What the nodes share: sensors in, a worker thread, a life cycle, diagnostics, and a clean end."""

from __future__ import annotations

import signal
import sys
import threading
import time
import traceback
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from headvox.data import Frame
from headvox.errors import HeadvoxError
from headvox.machine.interrupts import heeded
from headvox.ros.messages import info_topic
from headvox.ros.synchronise import Reading, Synchroniser
from headvox_ros.parameters import Parameter
from headvox_ros.sensors import RELIABILITIES, Sensors, seconds_to_ns
from headvox_ros.statistics import Statistics

DIAGNOSTICS_EVERY_S = 1.0
SENSOR_PARAMETERS = [
    Parameter("clouds", [""], "Topics of sensor_msgs/PointCloud2.", None),
    Parameter("depths", [""], "Topics of depth images, sensor_msgs/Image of 16UC1 or 32FC1.", None),
    Parameter(
        "camera_infos",
        [""],
        "Topics of their CameraInfo; by default camera_info beside each depth image.",
        None,
    ),
    Parameter("target_frame", "base_link", "Frame that the results are in; its z has to point up.", None),
    Parameter("reliability", "best_effort", "Of the sensors' topics: best_effort or reliable.", None),
    Parameter(
        "sync_tolerance_s", 0.02, "Readings whose stamps differ by no more belong to one frame.", (0.0, 1.0)
    ),
    Parameter("sync_wait_s", 0.05, "How long a reading waits for those of other sensors.", (0.0, 1.0)),
    Parameter(
        "sensor_timeout_s", 1.0, "A sensor that is silent for so long is not waited for.", (0.05, 60.0)
    ),
    Parameter("tf_wait_s", 0.1, "How long a reading waits for its transform.", (0.0, 1.0)),
    Parameter("autostart", True, "Configure and activate at once, without a lifecycle manager.", None),
]
CHANGEABLE = {"tf_wait_s"}
PROBLEMS = ("frames_without_answer", "without_transform", "bad_messages", "lost")
WORRYING = (*PROBLEMS, "late", "clock_jumps", "refused_transforms")


class SensorNode(LifecycleNode):
    """A lifecycle node that makes something of each set of sensor readings, in a thread of its own."""

    def __init__(self, name: str, parameters: Sequence[Parameter]) -> None:
        super().__init__(name)
        self.statistics = Statistics()
        self.failed = False
        """Whether the worker met something that it did not expect; the node ends then."""
        self._sensors: Sensors | None = None
        self._worker: threading.Thread | None = None
        self._stopping = threading.Event()
        self._names = [parameter.name for parameter in (*SENSOR_PARAMETERS, *parameters)]
        for parameter in (*SENSOR_PARAMETERS, *parameters):
            self._declare(parameter)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._told: dict[str, int] = {}
        # Not in the clock of a simulation: that it stands still is to be told, too.
        self.create_timer(DIAGNOSTICS_EVERY_S, self._tell, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # -------------------------------------------------------------------------------------------- for each kind of node

    @abstractmethod
    def check(self, values: dict[str, Any]) -> None:
        """Refuse the values of the parameters with a HeadvoxError, or take note of them."""

    @abstractmethod
    def prepare(self) -> None:
        """Make what :meth:`process` needs; raises HeadvoxError."""

    @abstractmethod
    def process(self, frame: Frame) -> None:
        """Make something of a frame, and publish it; raises HeadvoxError. In the worker's thread."""

    @abstractmethod
    def release(self) -> None:
        """Let go of what :meth:`prepare` made."""

    # ------------------------------------------------------------------------------------------------------- parameters

    @property
    def values(self) -> dict[str, Any]:
        """What all parameters are now."""
        return {name: self.get_parameter(name).value for name in self._names}

    def _declare(self, parameter: Parameter) -> None:
        descriptor = ParameterDescriptor(
            description=parameter.description, dynamic_typing=parameter.default is None
        )
        if parameter.limits is not None:
            low, high = parameter.limits
            if isinstance(parameter.default, int):
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
            else:
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
                ]
        self.declare_parameter(parameter.name, parameter.default, descriptor)

    def _on_set_parameters(self, changes: list[Any]) -> SetParametersResult:
        ours = {change.name: change.value for change in changes if change.name in self._names}
        fixed = sorted(
            name for name in ours if "." not in name and name not in CHANGEABLE and self._sensors is not None
        )
        if fixed:
            reason = f"{fixed[0]} is fixed while the node is active: deactivate it first"
            return SetParametersResult(successful=False, reason=reason)
        try:
            self._check({**self.values, **ours})
        except HeadvoxError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _check(self, values: dict[str, Any]) -> None:
        if values["reliability"] not in RELIABILITIES:
            got = values["reliability"]
            raise HeadvoxError(f"reliability: expected {' or '.join(RELIABILITIES)}, got {got!r}.", "")
        if not values["target_frame"]:
            raise HeadvoxError("target_frame: expected the name of a frame, got nothing.", "")
        infos, depths = _topics(values["camera_infos"]), _topics(values["depths"])
        if infos and len(infos) != len(depths):
            raise HeadvoxError(
                f"camera_infos: expected one for each of the {len(depths)} depths, got {len(infos)}.", ""
            )
        self.check(values)

    # ------------------------------------------------------------------------------------------------------- life cycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make everything that is needed, and compile what has to be compiled."""
        try:
            self._check(self.values)
            self.prepare()
        except HeadvoxError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to listen and to work."""
        values = self.values
        depths = _topics(values["depths"])
        self._sensors = Sensors(
            self,
            clouds=_topics(values["clouds"]),
            depths=depths,
            camera_infos=_topics(values["camera_infos"]) or [info_topic(depth) for depth in depths],
            reliability=values["reliability"],
            synchroniser=Synchroniser(
                seconds_to_ns(values["sync_tolerance_s"]), values["sync_wait_s"], values["sensor_timeout_s"]
            ),
            statistics=self.statistics,
        )
        self._stopping.clear()
        self._worker = threading.Thread(target=self._work, args=(self._sensors,), name="worker")
        self._worker.start()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop; the frame that is being worked on is finished first."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of everything."""
        self.release()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of everything, whatever the state."""
        self.close()
        return super().on_shutdown(state)

    def close(self) -> None:
        """Stop, and let go of everything: also in the middle of a transition."""
        self._stop()
        self.release()

    def _stop(self) -> None:
        self._stopping.set()
        if self._sensors is not None and self._worker is not None:
            self._sensors.close()
            self._worker.join()
        self._sensors = self._worker = None

    # ---------------------------------------------------------------------------------------------- the worker's thread

    def _work(self, sensors: Sensors) -> None:
        try:
            while not self._stopping.is_set():
                readings = sensors.take(timeout_s=0.1)
                if readings is not None:
                    self._work_on(sensors, readings)
        except Exception:  # the last word of a thread: without it the node would live on, silent
            self.get_logger().fatal(f"internal error:\n{traceback.format_exc()}")
            self.failed = True

    def _work_on(self, sensors: Sensors, readings: Sequence[Reading]) -> None:
        arrived_s = max(reading.arrived_s for reading in readings)
        wait_s = self.get_parameter("tf_wait_s").value
        target = self.get_parameter("target_frame").value
        try:
            self.process(sensors.read(readings, target, wait_s))
        except HeadvoxError as error:
            if not self._stopping.is_set():
                self.statistics.problem("frames_without_answer", str(error))
                self.get_logger().warning(str(error), throttle_duration_sec=5.0)
        else:
            now = time.monotonic()
            self.statistics.frame(now, now - arrived_s)

    # ------------------------------------------------------------------------------------------------------ diagnostics

    def _tell(self) -> None:
        if self._sensors is not None:
            status = self._status(self._sensors)
            message = DiagnosticArray(status=[status])
            message.header.stamp = self.get_clock().now().to_msg()
            self._diagnostics.publish(message)

    def _status(self, sensors: Sensors) -> DiagnosticStatus:
        now, statistics = time.monotonic(), self.statistics
        alive = sensors.alive()
        silent = [name for name in sensors.names if name not in alive]
        counts = {**{kind: statistics.counts[kind] for kind in PROBLEMS}, **sensors.counts()}
        grown = [
            kind for kind, count in counts.items() if kind in WORRYING and count > self._told.get(kind, 0)
        ]
        self._told = counts
        rate, latency = statistics.rate_hz(now), statistics.latency_ms(now)
        if len(silent) == len(sensors.names):
            level, text = DiagnosticStatus.ERROR, "no sensor sends anything"
        elif rate == 0.0:
            level, text = (
                DiagnosticStatus.ERROR,
                statistics.reasons.get("frames_without_answer", "no frame yet"),
            )
        elif silent:
            level, text = DiagnosticStatus.WARN, f"silent: {', '.join(silent)}"
        elif grown:
            level, text = DiagnosticStatus.WARN, statistics.reasons.get(grown[0], grown[0].replace("_", " "))
        else:
            level, text = DiagnosticStatus.OK, f"{rate:.1f} Hz"
        rows = {
            "rate_hz": f"{rate:.2f}",
            "latency_p50_ms": f"{latency[0]:.2f}" if latency else "",
            "latency_p99_ms": f"{latency[1]:.2f}" if latency else "",
            "frames": str(statistics.counts["frames"]),
            **{kind: str(count) for kind, count in counts.items()},
            "sensors_alive": ", ".join(sorted(alive)),
            "sensors_silent": ", ".join(silent),
            "last_problem": statistics.last_problem,
        }
        return DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name().lstrip("/"),
            message=text,
            hardware_id="headvox",
            values=[KeyValue(key=key, value=value) for key, value in rows.items()],
        )


def _topics(names: Sequence[str]) -> list[str]:
    """Return ``names`` without empty ones: a list parameter cannot be empty in ROS."""
    return [name for name in names if name]


def run(make: Callable[[], SensorNode], arguments: Sequence[str] | None = None) -> int:
    """Run a node until SIGINT or SIGTERM, and return the exit code: 0, or 1 if it could not start or broke down."""
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    end = threading.Event()
    code = 0
    try:
        node = make()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        try:
            with heeded():  # it may compile for a minute
                if node.get_parameter("autostart").value and not _start(node):
                    return 1
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_: end.set())
            while not end.is_set() and not node.failed:
                executor.spin_once(timeout_sec=0.1)
            code = int(node.failed)
        finally:
            node.close()
            executor.shutdown()
            node.destroy_node()
    except KeyboardInterrupt:  # while it was still starting
        code = 0
    except HeadvoxError as error:
        print(f"headvox_ros: {error}", file=sys.stderr)
        code = 1
    finally:
        rclpy.try_shutdown()
    return code


def _start(node: SensorNode) -> bool:
    good = TransitionCallbackReturn.SUCCESS
    return all(transition() == good for transition in (node.trigger_configure, node.trigger_activate))
