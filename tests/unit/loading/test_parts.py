"""Parts of one's own: what `load_function` finds, and the one message where it does not."""

from __future__ import annotations

import pytest

from drakerock.errors import InputError
from drakerock.loading.parts import load_function


def test_a_file_with_dataclasses_and_postponed_annotations_is_loaded(tmp_path):
    """They look their module up by its name, which a file loaded by its path does not have by itself."""
    path = tmp_path / "part.py"
    path.write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\n\n\n"
        "@dataclass\nclass Gains:\n    force: float = 2.0\n\n\n"
        "def make(view, force: float = 1.0):\n    return Gains(force)\n"
    )
    assert load_function(f"{path}:make", "loading.parts.controller.system")(None, force=3.0).force == 3.0


@pytest.mark.parametrize(
    "name", ["nowhere.py:make", "drakerock.nothing:make", "drakerock.loading.parts:nothing"]
)
def test_what_is_not_there_is_one_message_that_names_the_key(name):
    with pytest.raises(InputError, match=r"loading\.parts\.planner\.system: .*"):
        load_function(name, "loading.parts.planner.system")
