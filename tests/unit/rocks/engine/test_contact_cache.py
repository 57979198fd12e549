"""The cache of separating axes, and how deep contacts are."""

import numpy as np

from drakerock.rocks.engine.contact_cache import find_axis, make_axis_cache, store_axis
from drakerock.rocks.engine.solve.rows import find_deepest, find_depths, make_contact_rows


def _find_rivals(cache, n):
    """Return `n` keys of pairs that share their two places."""
    place, _ = find_axis(7, cache)
    keys = [7]
    key = 8
    while len(keys) < n:
        if find_axis(key, cache)[0] // 2 == place // 2:
            keys.append(key)
        key += 1
    return keys


def _get_axis(key, cache):
    place, known = find_axis(key, cache)
    return cache.axes[place].tolist() if known else None


def test_an_empty_cache_knows_no_axis():
    cache = make_axis_cache(1000)
    assert len(cache.keys) == 1024
    assert not any(find_axis(key, cache)[1] for key in range(5000))


def test_two_pairs_share_their_places_and_a_third_takes_that_of_the_earlier():
    cache = make_axis_cache(64)
    first, second, third = _find_rivals(cache, 3)
    store_axis(first, (1.0, 2.0, 3.0), cache)
    store_axis(second, (4.0, 5.0, 6.0), cache)
    assert _get_axis(first, cache) == [1.0, 2.0, 3.0]
    assert _get_axis(second, cache) == [4.0, 5.0, 6.0]
    store_axis(first, (-1.0, 0.0, 0.5), cache)
    assert _get_axis(first, cache) == [-1.0, 0.0, 0.5]
    assert _get_axis(second, cache) == [4.0, 5.0, 6.0]
    store_axis(third, (7.0, 8.0, 9.0), cache)
    assert _get_axis(third, cache) == [7.0, 8.0, 9.0]
    assert _get_axis(first, cache) is None
    assert _get_axis(second, cache) == [4.0, 5.0, 6.0]


def test_a_cache_with_room_for_all_keeps_most():
    cache = make_axis_cache(4000)
    rng = np.random.default_rng(1)
    keys = rng.choice(1 << 40, 1000, replace=False)
    for key in keys:
        store_axis(key, (float(key % 101), 1.0, 2.0), cache)
    kept = [key for key in keys if find_axis(key, cache)[1]]
    assert len(kept) > 950
    assert all(_get_axis(key, cache) == [key % 101, 1.0, 2.0] for key in kept)


def test_depths_are_of_loaded_points_only():
    rows = make_contact_rows(6)
    rows.values["gap"] = [-0.001, -0.004, 0.002, -0.003, 0.001, -0.009]
    rows.values["impulse"][:, 0] = [1.0, 0.0, 2.0, 3.0, 0.0, 5.0]
    depths = np.full(6, np.nan)
    assert find_depths(5, rows, depths) == 3
    assert depths[:3].tolist() == [0.001, -0.002, 0.003]
    assert find_deepest(5, rows) == 0.004
    assert find_deepest(0, rows) == 0.0
