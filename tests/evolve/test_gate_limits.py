"""The limits of the gate."""

from __future__ import annotations

import numpy as np

from headvox.evolve import bank, gates, samples, search


def made_up_sums() -> samples.GateSums:
    """Heads about one place in the space of the gate's sums, everything else all over it."""
    rng = np.random.default_rng(2)
    count = len(bank.GATE.groups)
    heads = rng.normal(60, 10, (2000, count)).round().astype(np.int32)
    others = rng.integers(2, 300, (4000, count)).astype(np.int32)
    return samples.GateSums(
        np.concatenate([heads, others]), np.concatenate([np.arange(2000) // 2, np.full(4000, -1)])
    )


def test_the_gate_keeps_the_heads_and_little_else(monkeypatch):
    monkeypatch.setattr(gates, "GENERATIONS", 60)
    sums = made_up_sums()
    limits = gates.find_limits(sums, 0.01, seed=0)
    heads, others = gates.report(limits, sums)
    assert heads >= 0.985
    assert others < 0.05
    assert (limits == gates.find_limits(sums, 0.01, seed=0)).all()


def test_conditions_pass_just_what_the_limits_pass():
    sums = made_up_sums()
    limits = np.array([[10, 200]] * len(bank.GATE.groups))
    gate = search._compile_gate(gates.as_conditions(limits, sums))
    assert len(gate.low) == len(bank.GATE.groups)
    order = [bank.GATE.groups.index(c.group) for c in gates.as_conditions(limits, sums)]
    assert order[0] == 0  # the crown bounds where a candidate can be
    assert gate.low.tolist()[0] == 10
    others = sums.sums[sums.bag < 0]
    passed = ((others[:, order] >= gate.low) & (others[:, order] <= gate.high)).all(axis=1)
    assert passed.sum() == ((others >= 10) & (others <= 200)).all(axis=1).sum()
