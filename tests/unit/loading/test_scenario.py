import pytest

from drakerock.errors import InputError
from drakerock.loading.scenario import load_scenario


def test_rocks_are_not_emitted_inside_the_roof():
    keys = ["pile.emission_reach=1.0", "pile.emission_interval=0.25"]
    assert load_scenario(None, [*keys, "pile.emission_height=3.0"]).pile.emission_reach == 1.0
    # the void behind the brow has no roof
    assert load_scenario(None, ["pile.emission_height=8.0"]).pile.emission_height == 8.0
    with pytest.raises(
        InputError, match=r"emission_reach: .* up to 5\.06 m, above the roof, which is 4\.60 m high"
    ):
        load_scenario(None, [*keys, "pile.emission_height=4.0"])
