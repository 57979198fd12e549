import re
from dataclasses import replace

import numpy as np
import pytest

from drakerock.errors import InputError
from drakerock.rocks.config import SiteConfig
from drakerock.viewing.pile_figures import write_pile_picture
from drakerock.viewing.pile_page import write_pile_page
from drakerock.viewing.scene import calc_rock_colors


def test_page_is_one_file_that_needs_no_network(heap, shapes, tmp_path):
    pile = replace(heap, fixed=np.arange(12) < 2)
    write_pile_page(pile, shapes, SiteConfig(), tmp_path / "pile.html")
    text = (tmp_path / "pile.html").read_text(encoding="utf-8")
    assert not re.search(r"""<(script|link)[^>]+(src|href)=["']https?:""", text)
    assert len(text) > 1_000_000  # the viewer itself is in it


def test_pictures_of_a_pile_of_one_size_and_of_none(heap, shapes, tmp_path):
    for name, pile in (("some", heap), ("none", heap.select(np.zeros(12, bool)))):
        write_pile_picture(pile, shapes, SiteConfig(), tmp_path / f"{name}.png")
        write_pile_page(pile, shapes, SiteConfig(), tmp_path / f"{name}.html")
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def test_larger_rocks_are_lighter():
    colors = calc_rock_colors(np.array([0.8, 0.3, 0.4, 0.3]))
    assert sorted(colors) == [0.3, 0.4, 0.8]
    assert colors[0.3].sum() < colors[0.4].sum() < colors[0.8].sum() <= 3.0


def test_a_page_that_cannot_be_written_is_a_user_error(heap, shapes, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_pile_page(heap, shapes, SiteConfig(), tmp_path / "missing" / "pile.html")
