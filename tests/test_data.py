"""What flows through headvox, as it shows itself, and as it compares."""

from __future__ import annotations

from dataclasses import fields, is_dataclass

import numpy as np
import pytest

from headvox import data
from headvox.data import BadFrame, Heads, Intrinsics
from headvox.errors import HeadvoxError

ROWS = {
    "centres": (3,), "quaternions": (4,), "centre_covariances": (3, 3), "rotation_covariances": (3, 3),
}  # fmt: skip
CLASSES = [one for one in vars(data).values() if is_dataclass(one)]


def test_heads_show_where_they_are_in_a_line() -> None:
    assert repr(Heads()) == "Heads(0)"
    centres, scores = np.array([[0.5, -2.0, 1.625], [1.0, 0.0, 1.2]]), np.array([7.25, 3.0])
    shown = repr(Heads(centres, np.full((2, 4), np.nan), np.full(2, 0.1), scores))
    assert shown == "Heads(2: (0.50, -2.00, 1.62) m scores 7.2; (1.00, 0.00, 1.20) m scores 3.0)"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("centres", np.zeros((1, 3))),
        ("centres", np.zeros((2, 2))),
        ("quaternions", np.zeros((2, 3))),
        ("radii", np.zeros(3)),
        ("radii", [0.1, 0.1]),
        ("centre_covariances", np.zeros((1, 3, 3))),
        ("rotation_covariances", np.zeros((2, 9))),
        ("sure", np.array([False])),
    ],
)
def test_heads_of_another_length_or_shape_are_refused_by_name(name, value) -> None:
    given = {"centres": np.zeros((2, 3)), "quaternions": np.zeros((2, 4)), "radii": np.ones(2)}
    with pytest.raises(
        HeadvoxError, match=rf"Heads: {name}: expected an array of shape \(2,.*, got "
    ) as error:
        Heads(**{**given, "scores": np.ones(2), name: value})
    assert error.value.do


def test_what_is_not_given_of_heads_is_not_known() -> None:
    heads = Heads(np.zeros((2, 3)), np.zeros((2, 4)), np.ones(2), np.ones(2))
    assert heads.sure.tolist() == [True, True]
    for covariances in (heads.centre_covariances, heads.rotation_covariances):
        assert covariances.shape == (2, 3, 3)
        assert np.isnan(covariances).all()


@pytest.mark.parametrize("kind", [one for one in CLASSES if one not in (BadFrame, Intrinsics)])
def test_what_holds_arrays_is_equal_to_itself_only(kind) -> None:
    shapes = ROWS if kind is Heads else {}
    one, other = (
        kind(**{field.name: np.zeros((2, *shapes.get(field.name, ()))) for field in fields(kind)})
        for _ in range(2)
    )
    assert one == one
    assert one != other
    assert len({one, other, one}) == 2
    assert [other, one].index(one) == 1


def test_what_holds_numbers_is_equal_to_its_like() -> None:
    assert BadFrame(3, "torn") == BadFrame(3, "torn")
    assert Intrinsics(4, 3, 2.0, 2.0, 1.0, 1.0) == Intrinsics(4, 3, 2.0, 2.0, 1.0, 1.0)
