"""Who may write which place of a ring of samples, which of them may be read, and who has to wait. No processes here."""

from __future__ import annotations

import math
import random
from collections import deque
from dataclasses import dataclass

# Samples that one producer is told of ahead, at most: it renders them while nobody looks.
MOST_AHEAD = 64


@dataclass
class Order:
    """A sample that a producer was asked for: its number in the recipe and the place it goes to."""

    index: int
    slot: int
    producer: int


class Schedule:
    """Every place of the ring is free, ordered (a producer may write there and nobody reads) or readable: so nobody
    reads a sample that is being written.

    ``made`` samples were finished, ``drawn`` times one was drawn, and ``replaced`` had to make room. A reader waits
    where one more would be ``drawn > uses * made``: that bounds the mean number of times that a sample is used. A
    producer waits before it replaces one as long as a reader could use those that would then be gone once more,
    ``drawn + 1 <= uses * (replaced + 1)``. The two never wait for each other, since ``made`` is more than ``replaced``
    as long as a sample is readable. The oldest goes first.
    """

    def __init__(self, capacity: int, producers: int, uses: float, warm: int, first: int, seed: int) -> None:
        self.uses, self.warm = uses, warm
        self.made = self.drawn = self.replaced = 0
        self.ahead = max(1, min(MOST_AHEAD, capacity // (4 * producers)))
        self.orders: dict[int, Order] = {}
        self._next = first
        # Of producers that have ended.
        self._again: deque[int] = deque()
        self._free: deque[int] = deque(range(capacity))
        self._readable: deque[int] = deque()
        self._random = random.Random(seed)

    @property
    def next_index(self) -> int:
        """The number after those that were ordered."""
        return self._next

    def order(self, producer: int) -> Order | None:
        """The next sample for a producer, None where it has enough or has to wait."""
        if sum(order.producer == producer for order in self.orders.values()) >= self.ahead:
            return None
        if self._free:
            slot = self._free.popleft()
        elif len(self._readable) > 1 and self._has_served():
            slot = self._readable.popleft()
            self.replaced += 1
        else:
            return None
        if self._again:
            index = self._again.popleft()
        else:
            index, self._next = self._next, self._next + 1
        order = self.orders[index] = Order(index, slot, producer)
        return order

    def _has_served(self) -> bool:
        return math.isinf(self.uses) or self.drawn + 1 > self.uses * (self.replaced + 1)

    def finished(self, index: int) -> int:
        """A sample is in its place, which it returns."""
        slot = self.orders.pop(index).slot
        self._readable.append(slot)
        self.made += 1
        return slot

    def failed(self, index: int) -> None:
        """A sample cannot be made: its place is for another one."""
        self._free.append(self.orders.pop(index).slot)

    def lost(self, producer: int) -> list[int]:
        """A producer has ended: its samples are ordered anew, of others."""
        orders = sorted((o for o in self.orders.values() if o.producer == producer), key=lambda order: order.index)
        for order in orders:
            del self.orders[order.index]
            self._free.append(order.slot)
        found = [order.index for order in orders]
        self._again.extendleft(reversed(found))
        return found

    def can_draw(self) -> bool:
        """Whether a reader need not wait."""
        return bool(self._readable) and self.made >= self.warm and self.drawn + 1 <= self.uses * self.made

    def draw(self) -> int:
        """A place at random, out of those that are readable."""
        self.drawn += 1
        return self._readable[self._random.randrange(len(self._readable))]
