"""What flows through headvox, as it shows itself."""

from __future__ import annotations

import numpy as np

from headvox.data import Heads


def test_heads_show_where_they_are_in_a_line() -> None:
    assert repr(Heads()) == "Heads(0)"
    centres, scores = np.array([[0.5, -2.0, 1.625], [1.0, 0.0, 1.2]]), np.array([7.25, 3.0])
    shown = repr(Heads(centres, np.full((2, 4), np.nan), np.full(2, 0.1), scores))
    assert shown == "Heads(2: (0.50, -2.00, 1.62) m scores 7.2; (1.00, 0.00, 1.20) m scores 3.0)"
