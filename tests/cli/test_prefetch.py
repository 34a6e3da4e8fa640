import threading

import pytest

from vojax.cli._prefetch import prefetch


def test_items_come_in_order_and_one_ahead():
    started = [threading.Event() for _ in range(5)]

    def read(k):
        started[k].set()
        return k * k

    seen = []
    for k, item in enumerate(prefetch(read, 5)):
        seen.append(item)
        if k + 1 < 5:
            # The next is being read although nobody has asked for it; the one after is not.
            assert started[k + 1].wait(10)
        if k + 2 < 5:
            assert not started[k + 2].is_set()
    assert seen == [0, 1, 4, 9, 16]
    assert list(prefetch(read, 0)) == []


def test_an_error_waits_for_its_turn():
    def read(k):
        if k == 2:
            raise ValueError("item 2 is damaged")
        return k

    items = prefetch(read, 4)
    assert [next(items), next(items)] == [0, 1]
    with pytest.raises(ValueError, match="item 2"):
        next(items)


def test_closing_ends_the_thread():
    before = threading.active_count()
    items = prefetch(lambda k: k, 10)
    assert next(items) == 0
    items.close()
    assert threading.active_count() == before
