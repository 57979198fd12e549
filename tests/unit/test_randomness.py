import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drakerock.randomness import derive_seed, make_generator


@given(seed=st.integers(0, 2**40), name=st.text(max_size=8), index=st.integers(0, 1000))
def test_same_names_same_numbers(seed, name, index):
    a, b = (make_generator(seed, name, index).random(4) for _ in range(2))
    assert np.array_equal(a, b)


def test_children_differ_by_seed_name_and_index():
    seeds = [derive_seed(s, n, k) for s in range(4) for n in ("pile", "loading") for k in range(50)]
    assert len(set(seeds)) == len(seeds)
