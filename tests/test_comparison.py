import math
from dataclasses import replace

import numpy as np
import pytest
from builders import result

from ballbot_train.evaluation.comparison import compare
from ballbot_train.evaluation.statistics import Interval

EXPERT, POLICY = "lqr", "apg"


def results(regrets, controller=EXPERT, failures=()):
    """One episode for each regret; their optima differ, as real ones do."""
    return [
        result(
            controller=controller,
            episode=i,
            cost=1000.0 if i in failures else (1 + regret) * (10 + i),
            optimum=10.0 + i,
            success=i not in failures,
            failure=i in failures,
        )
        for i, regret in enumerate(regrets)
    ]


def only(a, b, about_a=None, about_b=None, **options):
    (comparison,) = compare((about_a or {}, a), (about_b or {}, b), **options)
    return comparison


@pytest.fixture
def regrets(rng):
    return rng.gamma(2.0, 0.05, 200)


def test_the_interval_covers_the_true_mean_as_often_as_it_says(rng):
    covered = 0
    for _ in range(100):
        low, high = Interval.of_mean(rng.exponential(size=50))
        covered += low <= 1.0 <= high
    assert covered >= 86  # 95 % less three standard deviations, and what skewed data cost


@pytest.mark.parametrize("draw", ["exponential", "normal", "random"])
def test_the_intervals_are_those_of_scipy(rng, draw):
    stats = pytest.importorskip("scipy.stats")
    values = getattr(rng, draw)(size=60)
    options = {"confidence_level": 0.95, "n_resamples": 9999, "method": "BCa", "rng": np.random.default_rng(0)}
    expected = stats.bootstrap((values,), np.mean, **options).confidence_interval
    assert Interval.of_mean(values) == pytest.approx((expected.low, expected.high), rel=1e-12)
    for count, total in ((0, 10), (3, 10), (10, 10), (9987, 10000)):
        wilson = stats.binomtest(count, total).proportion_ci(0.95, method="wilson")
        assert Interval.of_share(count, total) == pytest.approx((wilson.low, wilson.high), rel=1e-12)


def test_the_interval_of_degenerate_data_exists_or_is_nan_without_a_warning(recwarn):
    assert Interval.of_mean([0.3] * 10) == (0.3, 0.3)
    assert all(math.isnan(end) for end in Interval.of_mean([0.3]))
    assert all(math.isnan(end) for end in Interval.of_mean([]))
    low, high = Interval.of_mean([0.0] * 199 + [1.0])
    assert 0 <= low <= high < 0.1
    assert len(recwarn) == 0


def test_a_run_cannot_be_told_from_itself(regrets):
    comparison = only(results(regrets), results(regrets))
    assert (comparison.verdict, comparison.regret, comparison.episodes) == ("cannot tell", 0.0, 200)


def test_a_small_difference_in_every_episode_is_seen_though_episodes_differ_far_more(regrets):
    assert np.std(regrets) > 10 * 0.004
    better = only(results(regrets), results(regrets - 0.004))
    worse = only(results(regrets - 0.004), results(regrets))
    assert (better.verdict, worse.verdict) == ("better", "worse")
    assert better.regret == pytest.approx(-0.004)


def test_two_trainings_of_one_method_cannot_be_told_apart(regrets, rng):
    seeds = [regrets + shift + rng.normal(0, 0.005, 200) for shift in (0.0, 0.008)]
    runs = [({"policies": {f"stabilize/{POLICY}": str(i)}}, results(r, POLICY)) for i, r in enumerate(seeds)]
    (comparison,) = compare(*runs)
    assert comparison.verdict == "cannot tell"
    same_weights = [({"policies": {f"stabilize/{POLICY}": "0"}}, run[1]) for run in runs]
    (comparison,) = compare(*same_weights)
    assert comparison.verdict == "worse"  # then it is no luck of training


def test_policies_of_different_names_are_compared_where_there_is_but_one_each(regrets):
    comparison = only(results(regrets, "seed0.json"), results(regrets + 0.5, "seed1.json"))
    assert (comparison.controller, comparison.verdict) == ("seed0.json → seed1.json", "worse")


def test_falling_is_worse_however_good_the_other_episodes_are(regrets):
    comparison = only(results(regrets), results(regrets - 0.05, failures=range(0, 200, 10)))
    assert comparison.verdict == "worse"
    assert comparison.success == pytest.approx(-0.1)


def test_a_few_episodes_decide_nothing():
    assert only(results([0.5] * 5), results([0.1] * 5)).verdict == "cannot tell"


def test_episodes_that_are_not_the_same_are_not_compared(regrets):
    a = results(regrets)
    others = [replace(result, optimum=1.1 * result.optimum) for result in a]
    bullet = [replace(result, physics="bullet") for result in a]
    later = [replace(result, episode=result.episode + 1000) for result in a]
    for b, why in ((others, "other episodes"), (bullet, "different physics"), (later, "no episode was run by both")):
        comparison = only(a, b)
        assert comparison.verdict == "not comparable"
        assert why in comparison.why


def test_what_cannot_be_compared_is_an_error_that_says_why(regrets):
    a = results(regrets)
    with pytest.raises(ValueError, match="A has lqr on stabilize, nmpc on stabilize, B has trajopt on stabilize"):
        only(a + results(regrets, "nmpc"), results(regrets, "trajopt"))
    with pytest.raises(ValueError, match="episode 0 of lqr on stabilize occurs twice"):
        only(a + a[:1], a)
    for margin in (-0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match=r"^training_margin must be a number from 0"):
            only(a, a, training_margin=margin)
