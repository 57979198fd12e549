import matplotlib.pyplot as plt
import numpy as np
import pytest

from drakerock.viewing.force_network import draw_force_network
from rock_helpers import make_box, make_engine, make_pile, run


def test_force_network_shows_each_loaded_pair_once():
    pile = make_pile([[0, 0, 0.25 + 0.5 * k] for k in range(4)])
    engine = make_engine(pile, [make_box(0.8, 0.8, 0.5)])
    arrays, _ = run(engine, engine.make_arrays(pile), 1.0)
    _, ax = plt.subplots()
    draw_force_network(ax, engine.make_pile(arrays), 0.01)
    lines = ax.collections[1]
    assert len(lines.get_segments()) == 3
    widths = np.array(lines.get_linewidths())
    assert widths.max() == pytest.approx(4.2)
    # the load grows downwards in proportion: 1, 2, 3 blocks above
    np.testing.assert_allclose((widths - 0.2) / 4.0, [1 / 3, 2 / 3, 1.0], rtol=0.05)
    plt.close()
    with pytest.raises(ValueError, match="no contacts"):
        draw_force_network(ax, pile, 0.01)
