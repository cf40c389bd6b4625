"""The bins of a sensor that is made of others: those of its parts, which have to be the same."""

from __future__ import annotations

from collections.abc import Iterable

from torchtransient.axes import TimeAxis
from torchtransient.errors import UnitError
from torchtransient.sensing.base.sensor import Sensor

Bins = tuple[float | None, int | None]  # width in seconds and number, None where any will do

# Two axes are the same when their bins agree to a millionth of a bin over the whole length.
SAME_BIN = 1e-6


def bins_of(sensor: Sensor) -> Bins:
    """What light has to have, as far as the sensor, or the first stage of a chain that says so, was told."""
    for part in sensor.modules():
        if not isinstance(part, Sensor):
            continue
        axis, width = getattr(part, "axis", None), getattr(part, "bin_width_s", None)
        if isinstance(axis, TimeAxis):
            return axis.bin_width_s, axis.num_bins
        if isinstance(width, float) or part.num_bins is not None:
            return (width if isinstance(width, float) else None), part.num_bins
    return None, None


def common_bins(sensors: Iterable[Sensor], where: str, own: Bins = (None, None)) -> Bins:
    """The bins of all of them and of `own`. UnitError for sensors that were made for different ones."""
    width, number = own
    owner = where
    for sensor in sensors:
        name, (its_width, its_number) = type(sensor).__name__, bins_of(sensor)
        most = max(number or 1, its_number or 1)
        other_width = width and its_width and abs(width - its_width) * most > SAME_BIN * width
        if other_width or (number and its_number and number != its_number):
            raise UnitError(
                f"{where}: expected one time axis for all parts, got {_shown(width, number)} in {owner} and "
                f"{_shown(its_width, its_number)} in {name}. Make them with the axis of the light."
            )
        if (width is None and its_width) or (number is None and its_number):
            owner = name
        width, number = width or its_width, number or its_number
    return width, number


def _shown(width: float | None, number: int | None) -> str:
    many = "bins" if number is None else f"{number} bins"
    return many if width is None else f"{many} of {width:g} s"
