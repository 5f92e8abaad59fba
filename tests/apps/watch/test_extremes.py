"""Levels of stated probability on distributions that are known."""

import numpy as np
import pytest
from scipy.stats import genpareto, norm

from asbuilt.apps.watch import block_maxima, tail_level
from asbuilt.apps.watch.extremes import gumbel_level
from asbuilt.errors import RecordingError


@pytest.mark.parametrize("shape", [-0.2, 0.0, 0.15])
def test_level_of_a_long_record_is_the_quantile(shape: float) -> None:
    x = genpareto.rvs(shape, size=20000, random_state=1)
    level = tail_level(x, 1e-3)
    assert abs(level / genpareto.isf(1e-3, shape) - 1.0) < 0.12


def test_short_records_keep_the_promise_on_average() -> None:
    """Exceedance probabilities of levels from 60 exponential maxima, averaged over records."""
    rng, wanted = np.random.default_rng(0), 1e-3
    found = [np.exp(-tail_level(rng.exponential(size=60), wanted)) for _ in range(120)]
    assert 0.7 * wanted < np.mean(found) < 1.3 * wanted


def test_maxima_of_normal_noise() -> None:
    """Blocks of 200 samples; the level promised for one block in a thousand."""
    rng = np.random.default_rng(3)
    maxima = np.abs(rng.normal(size=(600, 200))).max(axis=1)
    truth = norm.isf((1.0 - 0.999 ** (1 / 200)) / 2.0)
    assert 0.97 * truth < tail_level(maxima, 1e-3) < 1.25 * truth


def test_gumbel_level_ignores_contacts_in_a_third_of_the_blocks() -> None:
    rng = np.random.default_rng(5)
    quiet = -np.log(-np.log(rng.uniform(size=5000)))
    truth = -np.log(-np.log(1.0 - 1e-3))
    assert abs(gumbel_level(quiet, 1e-3) - truth) < 0.6
    touched = quiet.copy()
    touched[: len(quiet) // 3] += 50.0
    assert gumbel_level(touched, 1e-3) < 2.0 * truth


def test_block_maxima_leave_short_blocks_out() -> None:
    t = np.array([0.0, 0.4, 0.8, 1.1, 1.5, 5.0])
    found = block_maxima(t, np.arange(6.0)[:, None], 1.0)
    assert found[:, 0].tolist() == [2.0, 4.0]


@pytest.mark.parametrize("seed", [1, 4, 7])
def test_level_next_to_the_start_of_the_tail_is_found(seed: int) -> None:
    maxima = np.random.default_rng(seed).exponential(size=60)
    for peaks in (12, 14):
        level = tail_level(maxima, np.nextafter((peaks + 1) / 61, 0.0), (peaks / 60,))
        lower, _, upper = np.sort(maxima)[-peaks - 2 : -peaks + 1]
        assert lower < level < upper


def test_few_blocks_are_refused() -> None:
    with pytest.raises(RecordingError, match="too few for the tail"):
        tail_level(np.arange(10.0), 1e-3)
