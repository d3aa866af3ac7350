"""Hundreds of frames through the node: it answers each, and keeps nothing of them."""

from __future__ import annotations

import re

from robot import START_S

FRAMES = 400
FRAME_MB = 2 * 424 * 240 * 2e-6  # of the sample


def test_memory_does_not_grow(start, sample):
    """If one frame in ten stayed, it would be 8 MB."""
    code, said = start("endurance", words=[str(sample), "--frames", str(FRAMES)]).wait(START_S)
    print(f"\n{said}")
    assert code == 0, said
    rows = [line.split() for line in said.splitlines() if re.match(r" *\d", line)]
    assert [int(row[0]) for row in rows] == [100, 200, 300, 400]
    settled, last = rows[1], rows[-1]
    assert float(last[2]) - float(settled[2]) < 0.1 * (FRAMES - 200) * FRAME_MB
    assert last[3:] == settled[3:]  # threads, files


def test_a_recording_that_is_none_is_refused(start, tmp_path):
    code, said = start("endurance", words=[str(tmp_path)]).wait()
    assert code == 1
    assert "Traceback" not in said
    assert said.splitlines()[-1].startswith("endurance: ")
