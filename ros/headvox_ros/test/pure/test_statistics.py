import pytest

from headvox_ros.statistics import MOST, WINDOW_S, Statistics


def test_rate_and_latency_are_those_of_the_last_seconds():
    statistics = Statistics()
    for k in range(1000):
        statistics.frame(0.1 * k, 0.5 if k < 900 else 0.001 * (k % 10))
    assert statistics.counts["frames"] == 1000
    assert statistics.rate_hz(99.9) == pytest.approx(10.0, abs=0.3)
    p50, p99 = statistics.latency_ms(99.9)
    assert p50 == pytest.approx(4.5, abs=0.5)
    assert 8.0 <= p99 <= 9.001


def test_without_frames_there_is_no_latency():
    statistics = Statistics()
    assert statistics.latency_ms(0.0) is None
    statistics.frame(0.0, 0.01)
    assert statistics.latency_ms(WINDOW_S + 0.1) is None
    assert statistics.rate_hz(WINDOW_S + 0.1) == 0.0


def test_a_flood_of_frames_is_bounded():
    statistics = Statistics()
    for _ in range(3 * MOST):
        statistics.frame(0.0, 0.01)
    assert len(statistics._frames) == MOST
