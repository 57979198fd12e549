"""Makes default_pile.npz beside this file, the default scenario's pile (three minutes).

With ``--stamp`` the pile that is there is said to be that of the default scenario, its arrays as they are: after a
change of the default scenario, its files or the results revision that alters no pile.
"""

import sys
from dataclasses import replace
from pathlib import Path

from drakerock.identity import RESULTS_REVISION, calc_config_hash
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.rocks.making.make import make_pile
from drakerock.rocks.state import PileState, load_pile, save_pile

PATH = Path(__file__).with_name("default_pile.npz")


def stamp_pile(pile: PileState) -> PileState:
    """Return the pile with the default recipe's hash and the results revision in its provenance."""
    versions = pile.provenance["versions"] | {"results": str(RESULTS_REVISION)}
    recipe = calc_config_hash(make_recipe(Scenario()))
    return replace(pile, provenance=pile.provenance | {"recipe": recipe, "versions": versions})


if __name__ == "__main__":
    if sys.argv[1:] == ["--stamp"]:
        pile = stamp_pile(load_pile(PATH))
    else:
        pile = make_pile(
            make_recipe(Scenario()), lambda stage, share: print(f"{stage:<16} {share:5.0%}", end="\r")
        )
    save_pile(pile, PATH)
    print(f"{PATH.name}: {(~pile.fixed).sum()} moving rocks, {PATH.stat().st_size / 1e6:.2f} MB")
