"""Numbers on their way between torch and Dr.Jit, memory that is asked for, and what is told on the way."""

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import torch

from torchtransient.errors import StorageError
from torchtransient.rendering import engine, memory, progress
from torchtransient.rendering.broken_numbers import broken_entries, spread_nan
from torchtransient.rendering.output import RenderOutput, RenderStats
from torchtransient.scene.physics import all_finite
from torchtransient.scene.values import flat_drjit_copy

VARIANT = "llvm_ad_mono"


# ------------------------------------------------------------------------------------------------------------ arrays


@pytest.mark.parametrize("rows", [5, 100])
def test_copies_of_few_and_of_many_numbers(rows):
    """Of memory that the caller has not, whatever he holds: a transposed view, one with a gradient."""
    given = (torch.arange(rows * 3.0).reshape(3, rows) % 7).T.clone().requires_grad_().T.T
    flat, before = flat_drjit_copy(given), given.detach().numpy().ravel().copy()
    with torch.no_grad():
        given *= 3
    assert type(flat) is mi.Float and np.array_equal(np.array(flat), before)
    assert flat_drjit_copy(torch.tensor(3.0, requires_grad=True))[0] == 3


def test_negative_views_are_their_numbers():
    """What torch notes at a view and has not carried out, of few numbers and of many."""
    for count in (3, 100):
        view = torch.view_as_complex(torch.arange(2.0 * count).reshape(count, 2)).conj().imag
        assert view.is_neg()
        expected = -np.arange(1.0, 2 * count, 2)
        assert np.array_equal(np.array(flat_drjit_copy(view)), expected)
        flat, offset, strides = engine._cube_adjoint(view)
        assert np.array_equal(np.array(flat)[offset :: strides[0]][:count], expected)
        assert np.array_equal(np.array(engine._steady_adjoint(view)), expected)


# ---------------------------------------------------------------------------------------------------------- adjoints


@pytest.mark.parametrize("axes", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_an_adjoint_is_read_where_it_is(axes):
    """The numbers between its first and its last one, and the steps of each dimension, however torch has laid it."""
    whole = torch.arange(7.0 * 3 * 5 * 2).reshape(7, 3, 5, 2).requires_grad_()
    g = whole[2:4].permute(3, 0, 1, 2)[1].permute(axes)
    flat, offset, strides = engine._cube_adjoint(g)
    flat = np.array(flat)
    assert offset == 0 and len(flat) == 1 + sum((n - 1) * s for n, s in zip(g.shape, strides, strict=True))
    places = np.einsum("i,i...->...", strides, np.indices(g.shape))
    assert np.array_equal(flat[places], g.detach().numpy())
    assert np.array_equal(np.array(engine._steady_adjoint(g)), g.detach().numpy())


@pytest.mark.parametrize(("step", "whole"), [(2**32 - 2, False), (2**32 - 1, True)])
def test_adjoints_beyond_32_bits_are_laid_as_the_film_is(step, whole):
    two = torch.tensor([3.0, 5.0])
    g = SimpleNamespace(shape=(2, 1), stride=lambda: (step, 7), is_cuda=False, storage_offset=lambda: 0)
    g.detach = g.resolve_neg = lambda: g
    g.contiguous = lambda: two
    g.as_strided = lambda *given: two if given == ((step + 1,), (1,), 0) else None
    found = engine._cube_adjoint(g)
    if whole:
        assert type(found) is mi.TensorXf and np.array_equal(np.array(found), [3, 5])
    else:
        assert np.array_equal(np.array(found[0]), [3, 5]) and found[1:] == (0, (step, 7))


# ------------------------------------------------------------------------------------------------------------ memory


def test_cubes_that_fit(monkeypatch):
    """Up to 4 MiB nobody asks; of several renders one film more than there are renders is held at a time."""
    monkeypatch.setattr(memory, "available_bytes", lambda variant: 10 * 2**20)
    memory.check_fits((2**9, 2**10, 5, 1), 1, VARIANT)
    with pytest.raises(
        StorageError, match=r"take 12\.00 MiB \(H x W x T x C = 512 x 1024 x 6 x 1 float32\), 12\.00 Mi"
    ):
        memory.check_fits((2**9, 2**10, 6, 1), 1, VARIANT)
    memory.check_fits((2**9, 2**8, 5, 1), 3, VARIANT)
    with pytest.raises(
        StorageError, match=r"float32, 5 of them for 4 renders\), 12\.50 MiB in all, and 10\.00 MiB are"
    ):
        memory.check_fits((2**9, 2**8, 5, 1), 4, VARIANT)
    monkeypatch.setattr(memory, "available_bytes", lambda variant: 1536)
    memory.check_fits((2**9, 2**10, 2, 1), 1, VARIANT)
    with pytest.raises(StorageError, match=r"and 1\.5 KiB are available on this cpu"):
        memory.check_fits((2**9, 2**10, 2, 1), 2, VARIANT)
    monkeypatch.setattr(memory, "available_bytes", lambda variant: None)
    memory.check_fits((2**9, 2**30, 2, 1), 2, VARIANT)


def test_memory_of_the_device(monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (5, 9))
    monkeypatch.setattr(memory, "available_memory", lambda: 7)
    assert memory.available_bytes("cuda_ad_rgb") == 5 and memory.available_bytes("llvm_ad_rgb") == 7


@pytest.mark.parametrize(
    ("size", "words"),
    [(1000, "1.0 KiB"), (2**20 - 1, "1024.0 KiB"), (2**20, "1.00 MiB"), (3 * 2**29, "1.50 GiB"), (2**40, "1.00 TiB")],
)
def test_sizes_in_words(size, words):
    assert memory._human(size) == words


# ---------------------------------------------------------------------------------------------------------- progress


def test_a_bar_moves_by_what_is_new(monkeypatch):
    made = []

    class Fake(progress.Bar):
        def __init__(self, name):
            made.append(name)
            self._bar = SimpleNamespace(n=0.0, close=lambda: made.append("closed"), update=self.update)

        def update(self, step):
            self._bar.n += step
            made.append(self._bar.n)

    monkeypatch.setattr(progress, "Bar", Fake)
    assert list(progress.with_bar("abcd", "letters", progress=True)) == list("abcd")
    assert made == ["letters", 0.25, 0.5, 0.75, 1.0, "closed"]
    assert list(progress.with_bar("ab", "letters", progress=False)) == ["a", "b"] and len(made) == 6


# ----------------------------------------------------------------------------------------------------- broken numbers


def test_what_holds_numbers_alone():
    tensor = torch.ones(2, 3).expand(4, 2, 3)
    assert all_finite(tensor) and broken_entries(torch.ones(3, 2), 3) == [False] * 3
    several = torch.tensor([[1.0, 2.0], [np.inf, 0.0], [0.0, np.nan]])
    assert broken_entries(several, 3) == [False, True, True]
    assert not all_finite(several[1:2].expand(5, 2)) and not all_finite(several[:, :1].expand(3, 4))


def test_broken_numbers_go_on_to_what_they_touch():
    """Differences of two broken places touch, too; what is right stays as it is."""
    runs = []

    def derivative(given):
        runs.append(given)
        # As Dr.Jit's sums do, which take NaN for nothing.
        x = given[0].nan_to_num(0.0, 0.0, 0.0)
        return x[:2] * 3, x[2] - x[3], x[0]

    assert [one.tolist() for one in spread_nan(derivative, [torch.tensor([1.0, 2.0, 3.0, 5.0])])] == [[3, 6], -2, 1]
    assert len(runs) == 1
    found = spread_nan(derivative, [torch.tensor([1.0, np.nan, np.inf, np.inf])])
    assert found[0][0] == 3 and torch.isnan(found[0][1]) and torch.isnan(found[1]) and found[2] == 1
    marks = runs[2][0]
    assert marks[0] == 0 and ((marks[1:] >= 1) & (marks[1:] < 2)).all() and len(set(marks.tolist())) == 4


# ---------------------------------------------------------------------------------------------------------- numbers of


def test_statistics_of_a_batch():
    """Paths over time: 10 a second for 2 s and 40 for 6 s are 260 in 8 s."""
    made = {"spp": 4, "variant": VARIANT, "integrator": "i", "temporal_filter": "box"}
    one = RenderStats(
        seconds=2.0,
        samples_per_second=10.0,
        seeds=(1,),
        energy_before=(0.5,),
        energy_after=(3.0,),
        energy_total=(7.0,),
        **made,
    )
    two = RenderStats(
        seconds=6.0,
        samples_per_second=40.0,
        seeds=(2, 3),
        energy_before=(1.0, 2.0),
        energy_after=(4.0, 5.0),
        energy_total=(8.0, 9.0),
        **made,
    )
    both = RenderStats.of_batch([one, two])
    assert (both.seconds, both.samples_per_second, both.seeds) == (8, 32.5, (1, 2, 3))
    assert (both.energy_before, both.energy_after) == ((0.5, 1.0, 2.0), (3.0, 4.0, 5.0))
    assert both.energy_total == (7.0, 8.0, 9.0)
    for variant, polarized in ((VARIANT, False), ("llvm_ad_rgb_polarized", True)):
        out = RenderOutput(None, torch.zeros(1, 2, 3), None, axis=None, stats=replace(one, variant=variant))
        assert out.polarized is polarized


def test_how_a_result_shows_its_statistics():
    """With the share of the light outside of the window, before and after it, in all items."""
    made = {"spp": 4, "variant": VARIANT, "integrator": "path", "temporal_filter": "box", "samples_per_second": 1.0}
    for before, after, seeds, said in (
        ((0.5, 1.0), (3.0, 0.25), (7, 8), "2 seeds, 39.58% of the light outside of the window"),
        ((0.0,), (0.0,), (7,), "seed 7"),
    ):
        total = tuple(12.0 / len(seeds) for _ in seeds)
        stats = RenderStats(
            seconds=2.5, seeds=seeds, energy_before=before, energy_after=after, energy_total=total, **made
        )
        shown = repr(RenderOutput(None, torch.ones(2, 3, 4), None, axis=None, stats=stats))
        assert f"stats=4 spp in 2.5 s, path, {VARIANT}, {said})" in shown




