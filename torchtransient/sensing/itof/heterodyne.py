"""Speed from the beat of a heterodyne (Doppler) time-of-flight camera, whose light and sensor are hertz apart."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.sensing.checks import check_broadcast, check_count, check_number, complex_tensor
from torchtransient.sensing.itof.correlation import Frequencies, check_frequencies
from torchtransient.units import SPEED_OF_LIGHT


def heterodyne_speed(
    beat: Tensor, plain: Tensor, frequencies_hz: Frequencies, *, duration_s: float, beats: int = 1
) -> Tensor:
    """Find the speed of approach by an exposure with a beat and one without.

    If all light goes there and back at one speed v, the phase turns by ``e = 2 v f T / c`` turns in an exposure of T
    seconds. A beat of m turns leaves ``sinc(m + e)`` of the light, no beat ``sinc(e)``, whose ratio
    ``(-1)^m e / (m + e)`` is solved for v. Brightness that changes evenly is in the imaginary part of the ratio,
    which is left out. Detours of light over other things that move are not told apart: fit those with `tt.over_time`.

    Args:
        beat: complex phasors (..., F, H, W) of ``tt.Exposure(duration_s, beat_hz=beats / duration_s)``, or of its taps
            (`tap_phasor`).
        plain: those of ``tt.Exposure(duration_s)`` around the same middle, of a shape that broadcasts.
        frequencies_hz: modulation frequency of the F phasors, hertz.
        duration_s: exposure T, seconds.
        beats: whole turns m of the beat in an exposure, one and more.

    Returns:
        m/s, (..., F, H, W), positive for what comes nearer, with gradients; NaN without light. Unique for speeds above
        ``- m c / (2 f T)``, at which the light follows the sensor and does not beat: -500 m/s at 60 MHz and 5 ms.

    Raises:
        UnitError: for numbers out of range, and real tensors.
        ShapeError: for shapes that do not go together.

    Source: Heide et al., "Doppler time-of-flight imaging" (ACM TOG 34, 2015).
    """
    me = "heterodyne_speed"
    beat, plain = complex_tensor(me, beat=beat), complex_tensor(me, plain=plain)
    check_broadcast(me, beat=beat, plain=plain)
    values, turns = check_frequencies(frequencies_hz, me), check_count(beats, "beats", me)
    seconds = check_number(duration_s, "duration_s", me, open_low=True)
    dark = plain == 0
    # Masked before the division, so that dark pixels have no gradient in place of NaN.
    real = torch.where(dark, torch.nan, (beat / torch.where(dark, 1, plain)).real)
    ratio = -real if turns % 2 else real
    hertz = torch.tensor(values, dtype=ratio.dtype, device=ratio.device)
    if len(values) > 1:
        hertz = hertz[:, None, None]
        check_broadcast(me, beat=beat, frequencies_hz=hertz)
    return turns * ratio / (1 - ratio) * (SPEED_OF_LIGHT / (2 * seconds)) / hertz
