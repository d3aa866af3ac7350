from headvox.ros.losses import MOST_PUBLISHERS, Losses


def told(number, publisher=b"a"):
    """What rclpy tells of a message."""
    return {"publication_sequence_number": number, "publisher_gid": {"data": publisher}}


def test_a_gap_in_the_numbers_of_a_publisher_is_what_was_lost():
    losses = Losses()
    assert [losses.before(told(number)) for number in (7, 8, 11, 12)] == [0, 0, 2, 0]


def test_each_publisher_has_numbers_of_its_own():
    losses = Losses()
    assert [losses.before(told(n, p)) for n, p in ((5, b"a"), (1, b"b"), (6, b"a"), (3, b"b"))] == [
        0,
        0,
        0,
        1,
    ]


def test_what_comes_twice_or_late_is_no_loss():
    losses = Losses()
    assert [losses.before(told(number)) for number in (4, 4, 3, 4)] == [0, 0, 0, 0]


def test_a_middleware_that_tells_nothing_loses_nothing():
    losses = Losses()
    silent = ({}, {"publication_sequence_number": None}, {"publication_sequence_number": 9}, told(9, None))
    assert [losses.before(info) for info in silent] == [0, 0, 0, 0]


def test_publishers_without_end_are_forgotten_one_by_one():
    losses = Losses()
    for k in range(10 * MOST_PUBLISHERS):
        losses.before(told(1, b"%d" % k))
        losses.before(told(k + 1, b"steady"))
    assert len(losses._last) == MOST_PUBLISHERS
    assert losses.before(told(10 * MOST_PUBLISHERS + 3, b"steady")) == 2
