"""Values that are tried in one test: each counts."""

import pytest

from support.sweeps import together


def test_every_value_that_fails_is_said():
    tried = []

    @together("a, b", [(1, 1), (1, 2), (3, 3), (0, 4)])
    def equal(a, b):
        tried.append(a)
        assert 1 / a == 1 / b

    with pytest.raises(AssertionError, match=r"^2 of 4 do not hold:\n\(1, 2\): [^0]*\n(.*\n)*\(0, 4\): Zero"):
        equal()
    assert tried == [1, 1, 3, 0]


def test_an_error_that_does_not_come_is_said():
    @together("value", ["1", "x"])
    def refused(value):
        with pytest.raises(ValueError, match="invalid"):
            int(value)

    with pytest.raises(AssertionError, match="1: Failed: DID NOT RAISE"):
        refused()


@pytest.mark.parametrize("left", [1, 2])
@together("right", [3, 4])
def test_fixtures_and_parameters_reach_the_check(request, left, right):
    assert request.node.callspec.params == {"left": left}
    assert left < right


def test_nothing_to_try_is_an_error():
    with pytest.raises(ValueError, match="got none"):
        together("a", [])
