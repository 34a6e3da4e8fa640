"""Read one item ahead in a thread."""

import concurrent.futures
from collections.abc import Callable, Generator
from typing import TypeVar

Item = TypeVar("Item")


def prefetch(read: Callable[[int], Item], count: int) -> Generator[Item, None, None]:
    """Yield `read(0)`, …, `read(count - 1)` while the next one is being read.

    Args:
        read: Called in one thread of its own, in order.
        count: How many.

    Yields:
        The items in order. What `read` raises for an item comes when that item's turn has come, after all before it.
    """
    with concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="vojax-prefetch") as executor:
        following = executor.submit(read, 0) if count else None
        for index in range(count):
            assert following is not None
            item = following.result()
            following = executor.submit(read, index + 1) if index + 1 < count else None
            yield item
