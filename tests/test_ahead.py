"""Work ahead: the same results in the same order, errors at their turn, nothing left running."""

import threading
import time

import pytest

from hdmap_tools.ahead import made_ahead, taken_ahead


def slow_square(x):
    time.sleep(0.002 * (x % 3))
    return x * x


@pytest.mark.parametrize("threads", [1, 2, 4])
@pytest.mark.parametrize("number", [1, 3, 50])
def test_results_come_in_order(threads, number):
    found = list(made_ahead(range(20), slow_square, threads=threads, number=number))
    assert found == [x * x for x in range(20)]


@pytest.mark.parametrize("number", [1, 3, 50])
@pytest.mark.parametrize("items", [[], [1], list(range(20)), [None, False, 0]])
def test_items_come_in_order(items, number):
    assert list(taken_ahead((x for x in items), number)) == items


def test_they_really_are_computed_ahead():
    begun = threading.Event()

    def items():
        yield 1
        begun.set()
        yield 2

    taken = taken_ahead(items())
    assert next(taken) == 1
    assert begun.wait(5)
    assert list(taken) == [2]


def test_not_further_ahead_than_asked():
    made = []
    results = made_ahead(range(100), made.append, number=3)
    next(results)
    time.sleep(0.05)
    assert len(made) <= 3
    results.close()


def test_an_error_comes_at_its_turn():
    def fails_at_3(x):
        if x == 3:
            raise ValueError("three")
        return x

    results = made_ahead(range(9), fails_at_3, threads=2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)

    def items():
        yield 1
        raise OSError("gone")

    taken = taken_ahead(items())
    assert next(taken) == 1
    with pytest.raises(OSError, match="gone"):
        next(taken)


def test_whoever_stops_taking_leaves_no_thread():
    before = threading.active_count()
    results = made_ahead(range(1000), slow_square, threads=3)
    taken = taken_ahead(iter(range(1000)))
    assert next(results) == 0
    assert next(taken) == 0
    results.close()
    taken.close()
    assert threading.active_count() == before
