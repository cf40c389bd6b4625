"""What does not belong together is refused: bins, cycles, periods, units; and counts that a dtype cannot hold."""

from __future__ import annotations

import inspect
from copy import deepcopy

import pytest
import torch

from support.sensing.arguments import CALLS
from support.sweeps import together
from torchtransient import Chirps, TimeAxis, sensing
from torchtransient.errors import ShapeError, StorageError, UnitError
from torchtransient.sensing import ScoreFunction

PS, NS = 1e-12, 1e-9
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, 128)
SHORT = TimeAxis.from_seconds(0.0, 100 * PS, 64)


def budget(cycles=1000, rate_hz=10e6, **given):
    given = {"pulse_energy_j": 1e-9, "wavelength_m": 532e-9, **(given or {"axis": AXIS})}
    return sensing.PhotonBudget(sensing.Optics(f_number=2.0), repetition_rate_hz=rate_hz, cycles=cycles, **given)


# ------------------------------------------------------------------------------------------------------------- bins

# every sensor that can be made with an axis, made with one
ON_AN_AXIS = {
    "ImpulseResponse": lambda axis: sensing.ImpulseResponse(sensing.GaussianResponse(300 * PS), axis),
    "PhotonBudget": lambda axis: budget(axis=axis),
    "SynchronousSPAD": lambda axis: sensing.SynchronousSPAD(100, dead_time_s=1 * NS, axis=axis),
    "FreeRunningSPAD": lambda axis: sensing.FreeRunningSPAD(100, 1 * NS, axis=axis),
    "Afterpulsing": lambda axis: sensing.Afterpulsing(0.01, 1 * NS, 1 * NS, axis=axis),
    "DetectionJitter": lambda axis: sensing.DetectionJitter(sensing.GaussianResponse(300 * PS), axis),
    "PixelSkew": lambda axis: sensing.PixelSkew(50 * PS, axis),
    "DetectionSkew": lambda axis: sensing.DetectionSkew(50 * PS, axis),
    "CoincidencePixel": lambda axis: sensing.CoincidencePixel(
        sensing.SynchronousSPAD(9), 4, coincidence=2, window_s=1 * NS, axis=axis
    ),
    "CoherentReceiver": lambda axis: sensing.CoherentReceiver(Chirps(1e9, 1e-5, 1550e-9), axis),
    "SweepJitter": lambda axis: sensing.SweepJitter(300 * PS, axis),
    "StreakCamera": lambda axis: sensing.StreakCamera(axis, time_fwhm_s=300 * PS, jitter_fwhm_s=300 * PS),
    "GatedIntegration": lambda axis: sensing.GatedIntegration([2 * NS], 1 * NS, axis),
    "ItofCorrelation": lambda axis: sensing.ItofCorrelation(sensing.sine_code(4), 80e6, axis),
}


def sensors_with_an_axis():
    classes = {c for c in vars(sensing).values() if inspect.isclass(c) and issubclass(c, sensing.Sensor)}
    return {c.__name__ for c in classes if "axis" in inspect.signature(c.__init__).parameters}


def test_no_sensor_with_an_axis_is_left_out():
    assert set(ON_AN_AXIS) == sensors_with_an_axis()


@pytest.mark.parametrize("make", ON_AN_AXIS.values(), ids=ON_AN_AXIS)
def test_bins_are_those_of_the_axis(make):
    """64 bins into a stage that was made for 128: of plain tensors too, alone, in a chain, and as a copy."""
    sensor = make(AXIS)
    assert sensor.expected(torch.zeros(1, 128, 2, 2)).isfinite().all()
    for made in (sensor, sensing.Compose([sensor]), sensing.Compose([sensing.Compose([deepcopy(sensor)])])):
        calls = [made.expected, made.forward]
        calls += [made.sample] if hasattr(made, "sample") else []
        for call in calls:
            for bins in (127, 129):
                with pytest.raises(ShapeError, match=rf"expected .*128.* got .*{bins}.*Make "):
                    call(torch.zeros(1, bins, 2, 2))


def response(axis=AXIS, **keywords):
    return sensing.ImpulseResponse(sensing.GaussianResponse(300 * PS), None if keywords else axis, **keywords)


def test_one_axis_in_a_chain():
    """Without a renderer's output to compare with."""
    wide = TimeAxis.from_seconds(0.0, 200 * PS, 128)
    after = sensing.Afterpulsing(0.01, 1 * NS, 1 * NS, axis=AXIS)
    for other in (SHORT, wide):
        spad = sensing.SynchronousSPAD(100, dead_time_s=1 * NS, axis=other)
        for stages in ([response(), spad], [response(), sensing.Compose([spad])], [response(), spad, after]):
            with pytest.raises(UnitError, match=r"expected one time axis .*128 bins of 1e-10 s in stage '0' \(Impulse"):
                sensing.Compose(stages)
    with pytest.raises(UnitError, match=r"bins of 2e-10 s in stage '0'"):
        sensing.Compose([response(bin_width_s=200 * PS), sensing.SynchronousSPAD(100, dead_time_s=1 * NS, axis=AXIS)])
    # a width goes with any number of bins, and what a module of another kind does to the bins is its own affair
    sensing.Compose([response(bin_width_s=100 * PS), sensing.SynchronousSPAD(100, dead_time_s=1 * NS, axis=AXIS)])
    rebinned = sensing.Compose([response(SHORT), torch.nn.AvgPool3d((2, 1, 1)), response(wide)])
    assert len(rebinned.stages) == 3
    # a later start is another axis for codes alone
    later = TimeAxis.from_seconds(5 * NS, 100 * PS, 128)
    sensing.Compose([response(later), sensing.ItofCorrelation(sensing.sine_code(4), 80e6, AXIS)])


# ------------------------------------------------------------------------------------------ cycles, periods, quantities


def test_cycles_of_all_stages_agree():
    """A budget of 1000 cycles in front of a detector of 99."""
    for spad in (sensing.SynchronousSPAD(99), sensing.Compose([response(), sensing.SynchronousSPAD(99)])):
        with pytest.raises(UnitError, match=r"1000 in stage '0' \(PhotonBudget\) and 99 in stage '1.*budget\.cycles"):
            sensing.Compose([budget(1000), spad])
    assert sensing.Compose([budget(1000), sensing.SynchronousSPAD(1000)])(torch.ones(1, 128, 1, 1)).shape[1] == 128
    changed = sensing.device("vl53l8_like").changed("SynchronousSPAD", cycles=1000)
    with pytest.raises(UnitError, match="one number of cycles"):
        changed.sensor()
    assert changed.changed("PhotonBudget", cycles=1000).sensor()


def test_a_free_running_window_is_one_period():
    """12.8 ns of bins, a laser of 10 MHz."""
    free = sensing.FreeRunningSPAD(1000, 20 * NS, axis=AXIS)
    with pytest.raises(UnitError, match=r"one laser period of stage '0' \(PhotonBudget\), 1e-07 s, got 128 bins of"):
        sensing.Compose([budget(rate_hz=10e6), free])
    sensing.Compose([budget(rate_hz=1 / 12.8e-9), free])
    # bins that only the light tells
    width = {"bin_width_s": 100 * PS}
    chain = sensing.Compose([budget(rate_hz=1 / 12.8e-9, **width), sensing.FreeRunningSPAD(1000, 20 * NS, **width)])
    assert chain(torch.zeros(1, 128, 1, 1)).shape == (1, 128, 1, 1)
    for bins in (64, 127):
        for call in (chain.expected, chain.sample, chain):
            with pytest.raises(UnitError, match="one laser period"):
                call(torch.zeros(1, bins, 1, 1))


def afterpulsing(**keywords):
    return sensing.Afterpulsing(0.01, 30 * NS, 20 * NS, axis=AXIS, **keywords)


def test_afterpulses_go_round_the_laser_period():
    spad = sensing.SynchronousSPAD(1000)
    with pytest.raises(UnitError, match=r"one laser period .* period_s="):
        sensing.Compose([budget(rate_hz=10e6), spad, afterpulsing()])
    with pytest.raises(UnitError, match=r"the laser period of stage '0' .*1e-07 s, in stage '2' .*got 1\.28e-08"):
        sensing.Compose([budget(rate_hz=10e6), spad, afterpulsing(period_s=12.8 * NS)])
    sensing.Compose([budget(rate_hz=10e6), spad, afterpulsing(period_s=100 * NS)])
    sensing.Compose([budget(rate_hz=1 / 12.8e-9), sensing.FreeRunningSPAD(1000, 20 * NS, axis=AXIS), afterpulsing()])


def test_a_synchronous_detector_is_armed_when_a_cycle_begins():
    spad = sensing.SynchronousSPAD(1000, dead_time_s=10 * NS, axis=AXIS)
    with pytest.raises(UnitError, match=r"armed again before the next cycle .*2e-08 s later.*FreeRunningSPAD"):
        sensing.Compose([budget(rate_hz=50e6), spad])
    sensing.Compose([budget(rate_hz=40e6), spad])


MIXED = {
    "two detectors": (lambda: [budget(), *(sensing.SynchronousSPAD(1000) for _ in "ab")], "counts that a"),
    "a budget of counts": (lambda: [sensing.SynchronousSPAD(1000), budget()], "PhotonBudget takes what a renderer"),
    "afterpulses of rates": (lambda: [budget(), afterpulsing(period_s=100 * NS)], "Put the detector between"),
    "counts of one cycle": (lambda: [budget(), response(), sensing.ShotNoise()], "one of 1000 cycles.*SynchronousSPAD"),
    "taps of one cycle": (
        lambda: [budget(), sensing.ItofCorrelation(sensing.sine_code(4), 80e6, AXIS), sensing.PixelElectronics()],
        "electrons_per_unit=1000",
    ),
    "shot noise twice": (lambda: [sensing.ShotNoise(), sensing.PixelElectronics()], "shot_noise=False"),
    "shot noise of a detector": (lambda: [sensing.SynchronousSPAD(9), sensing.ShotNoise()], "counted once"),
    "a detector of taps": (
        lambda: [sensing.ItofCorrelation(sensing.sine_code(4), 80e6, AXIS), sensing.SynchronousSPAD(9)],
        "no rates per cycle",
    ),
}


@pytest.mark.parametrize("stages, words", MIXED.values(), ids=MIXED)
def test_quantities_that_do_not_fit(stages, words):
    for made in (stages(), [sensing.Compose(stages()[:1]), *stages()[1:]]):
        with pytest.raises(UnitError, match=rf"Compose: expected .* got .*{words}"):
            sensing.Compose(made)


def test_quantities_that_fit():
    for stages in (
        [budget(1), sensing.ShotNoise()],  # one exposure of all the energy
        [budget(9), sensing.GatedIntegration([1 * NS], 2 * NS, AXIS, electrons_per_unit=9), sensing.BinaryFrames(5)],
        [sensing.ShotNoise(), sensing.PixelElectronics(shot_noise=False, read_noise_e=2.0)],
        [budget(1000), sensing.SynchronousSPAD(1000), sensing.Crosstalk(0.01), sensing.Crosstalk(0.001)],
        [budget(1000), torch.nn.Identity(), sensing.ShotNoise()],  # nobody knows what a module does
    ):
        assert sensing.Compose(stages).expected(torch.ones(1, 128, 2, 2)).isfinite().all()


def test_one_change_of_a_device_reaches_all_stages():
    kind = {"kind": "PhotonBudget", "optics": {"kind": "Optics", "f_number": 2.0}, "axis": "@axis"}
    numbers = {"pulse_energy_j": 1e-9, "wavelength_m": 532e-9, "repetition_rate_hz": 10e6}
    after = {"kind": "Afterpulsing", "probability": 0.01, "tau_s": 30e-9, "dead_time_s": 20e-9}
    stages = (
        {**kind, **numbers, "exposure_s": 1e-3},
        {"kind": "SynchronousSPAD", "cycles": "@cycles"},
        {**after, "axis": "@axis", "period_s": "@period_s", "background": "@background"},
    )
    device = sensing.Device("linked", description="", sources=(), stages=stages, bin_width_s=100e-12, num_bins=128)
    sensor = sensing.Device.from_json(device.to_json()).sensor()
    assert [s.cycles for s in list(sensor.stages)[:2]] == [10_000] * 2
    assert sensor.stages[2].period_s == pytest.approx(100 * NS)
    assert sensor.stages[2].background == 0
    bright = device.changed("PhotonBudget", ambient_rate_hz=1e6, quantum_efficiency=0.5).sensor()
    assert bright.stages[2].background == pytest.approx(0.5e6 * 10_000 * 100 * PS)
    faster = device.changed("PhotonBudget", repetition_rate_hz=20e6).sensor()
    assert faster.stages[1].cycles == 20_000 and faster.stages[2].period_s == pytest.approx(50 * NS)
    for stage in stages[1:]:
        with pytest.raises(StorageError, match="expected a PhotonBudget in the chain"):
            sensing.Device(
                "alone", description="", sources=(), stages=(stage,), bin_width_s=100e-12, num_bins=128
            ).sensor()
    with pytest.raises(StorageError, match="expected '@axis'"):
        sensing.build_stage({"kind": "ShotNoise", "grad": "@policy"})


# --------------------------------------------------------------------------------------------------- seconds and hertz

# formulas that hold in any unit, what others compute, and devices, which say it when they are built
OTHERS = {
    "BudgetReport", "CramerRaoBound", "Device", "Response", "emg_cdf", "heterodyne_speed",
    "emg_survival", "gate_profiles", "resample_counts",
}  # fmt: skip


def seconds_of(name):
    made = getattr(sensing, name)
    names = inspect.signature(made.__init__ if inspect.isclass(made) else made).parameters
    return [n for n in names if n.endswith("_s")]


# one good call of each, with all of its seconds
SECONDS = {n: {**numbers, **rest} for n, (numbers, rest) in CALLS.items() if seconds_of(n) and n not in OTHERS}


def test_nothing_that_takes_seconds_is_left_out():
    public = {n for n, v in vars(sensing).items() if callable(v) and not n.startswith("_")}
    assert {n for n in public if seconds_of(n)} == set(SECONDS) | OTHERS
    for name, given in SECONDS.items():
        assert set(seconds_of(name)) <= set(given), f"{name}: its call in tests/support/sensing/arguments.py lacks some"


@together("unit", [1e12, 1e9])
@together("name, argument", [(name, argument) for name in SECONDS for argument in seconds_of(name)])
def test_seconds_in_another_unit_are_told(name, argument, unit):
    made, given = getattr(sensing, name), SECONDS[name]
    assert made(**given) is not None
    with pytest.raises(UnitError, match=r"expected .* got "):
        made(**{**given, argument: unit * given[argument]})


def test_unusual_devices_are_taken():
    """A flash lidar of 20 Hz, 1 J for the moon, InGaAs with tails of 0.1 ms, far infrared."""
    assert budget(100, 20.0, axis=AXIS).exposure_s == 5.0
    assert budget(100, 20.0, axis=AXIS, pulse_energy_j=1.0, wavelength_m=100e-6).cycles == 100
    assert sensing.Afterpulsing(0.1, 1e-4, 5e-5, axis=AXIS, period_s=0.05).period_s == 0.05
    assert budget(None, 10e6, axis=AXIS, exposure_s=0.01).cycles == 100_000


def jitter():
    return sensing.DetectionJitter(sensing.GaussianResponse(200 * PS), SHORT)


# ------------------------------------------------------------------------------------------------------------- parts

FINE = {"bin_width_s": 50 * PS}
DEAD = {"dead_time_s": 1 * NS}
OF_OTHER_BINS = {
    "coincidence": lambda: sensing.CoincidencePixel(
        sensing.SynchronousSPAD(9, **DEAD, bin_width_s=100 * PS), 4, coincidence=2, window_s=1 * NS, **FINE
    ),
    "afterpulses": lambda: sensing.AfterpulsingSPAD(
        sensing.SynchronousSPAD(9, **DEAD, axis=SHORT), sensing.Afterpulsing(0.3, 5 * NS, 1 * NS, bin_width_s=10 * PS)
    ),
    "groups": lambda: sensing.PixelGroups(
        [sensing.SynchronousSPAD(9, **DEAD, axis=SHORT), sensing.SynchronousSPAD(9, **DEAD, **FINE)],
        torch.tensor([[0, 1]]),
    ),
    "macro-pixel in a chain": lambda: sensing.Compose(
        [sensing.MacroPixel(sensing.SynchronousSPAD(9, **DEAD, **FINE), 3), jitter()]
    ),
}


@pytest.mark.parametrize("make", OF_OTHER_BINS.values(), ids=OF_OTHER_BINS)
def test_parts_of_other_bins_are_refused(make):
    with pytest.raises(UnitError, match="one time axis"):
        make()


# ------------------------------------------------------------------------------------------------------------ delays


@pytest.mark.parametrize("delay_s", [-1e-30, -1e-27, 0.0, 1e-30, -300 * PS - 1e-27])
def test_a_delay_next_to_a_whole_bin_has_a_score(delay_s):
    """1 - 1e-30 is 1: the share that stays was 0, and its logarithm's slope times no count NaN."""
    skew = sensing.DetectionSkew(delay_s, SHORT, learnable=True, grad="score")
    x = torch.full((1, 64, 1, 1), 10.0)
    with ScoreFunction() as score:
        moved = skew(x, torch.Generator().manual_seed(0))
    (gradient,) = torch.autograd.grad(score.surrogate(moved.square().sum()), skew.delays.delay_ps)
    assert bool(torch.isfinite(gradient))
    assert torch.equal(moved, sensing.shift_time(x, delay_s / (100 * PS)))


def module(dead_ns, period_s=100 * NS, **bins):
    return sensing.Afterpulsing(0.01, 30 * NS, dead_ns * NS, period_s=period_s, **(bins or {"axis": AXIS}))


def test_the_dead_time_of_afterpulses_is_the_detectors():
    """A module that is dead for longer than a period misses cycles: a detector of one detection per cycle cannot."""
    spad, again = sensing.SynchronousSPAD(1000), "armed again before the next cycle"
    long = module(88)
    for stages in (
        [budget(), spad, long], [spad, long], [budget(), sensing.AfterpulsingSPAD(spad, long)],
        [budget(), sensing.MacroPixel(spad, 4), long],
    ):  # fmt: skip
        with pytest.raises(UnitError, match=rf"Afterpulsing.*{again}.*FreeRunningSPAD"):
            sensing.Compose(stages)
    # the window of light is not known before there is some
    width = {"bin_width_s": 100 * PS}
    open_window = sensing.Compose([budget(**width), spad, module(88, **width)])
    assert open_window.expected(torch.zeros(1, 120, 1, 1)).isfinite().all()  # 12 and 88 ns are a period
    with pytest.raises(UnitError, match=again):
        open_window.expected(torch.zeros(1, 121, 1, 1))
    assert len(sensing.Compose([budget(), spad, module(87.2)]).stages) == 3
    free = sensing.FreeRunningSPAD(1000, 150 * NS, axis=AXIS)
    sensing.Compose([budget(rate_hz=1 / 12.8e-9), free, module(150, 12.8 * NS)])


@pytest.mark.parametrize("nested", [False, True])
def test_one_detector_has_one_dead_time(nested):
    def wrapped(detector):
        return sensing.MacroPixel(detector, 4) if nested else detector

    synchronous = wrapped(sensing.SynchronousSPAD(1000, dead_time_s=5 * NS, axis=AXIS))
    free = wrapped(sensing.FreeRunningSPAD(1000, 5 * NS, axis=AXIS))
    for detector, rate_hz, period in ((synchronous, 10e6, 100 * NS), (free, 1 / 12.8e-9, 12.8 * NS)):
        for dead_ns in (0, 4.9, 30):
            with pytest.raises(UnitError, match=r"expected the dead time of .*5e-09 s, in stage '2' \(Afterpulsing\)"):
                sensing.Compose([budget(rate_hz=rate_hz), detector, module(dead_ns, period)])
        assert len(sensing.Compose([budget(rate_hz=rate_hz), detector, module(5, period)]).stages) == 3


def test_pixels_with_dead_times_of_their_own():
    dead = torch.tensor([[5.0, 7.0]])

    def spads(d):
        return sensing.SynchronousSPAD(1000, dead_time_s=d * NS, axis=AXIS)

    groups = sensing.PixelGroups.by_value(dead, spads)
    own = sensing.PixelGroups.by_value(dead, lambda d: module(d))
    assert len(sensing.Compose([budget(), groups, own]).stages) == 3
    both = sensing.PixelGroups.by_value(dead, lambda d: sensing.AfterpulsingSPAD(spads(d), module(d)))
    assert len(sensing.Compose([budget(), both]).stages) == 2
    for wrong in (module(5), sensing.PixelGroups.by_value(dead, lambda d: module(d + 1))):
        with pytest.raises(UnitError, match="One detector has one dead time"):
            sensing.Compose([budget(), groups, wrong])
