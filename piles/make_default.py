"""Makes default.npz beside this file, the default scenario's pile: `python piles/make_default.py` (three minutes)."""

from pathlib import Path

from drakerock.dynamics.settling import make_pile
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.pile.state import save_pile

if __name__ == "__main__":
    pile = make_pile(
        make_recipe(Scenario()), lambda stage, share: print(f"{stage:<16} {share:5.0%}", end="\r")
    )
    path = Path(__file__).with_name("default.npz")
    save_pile(pile, path)
    print(f"{path.name}: {(~pile.fixed).sum()} moving rocks, {path.stat().st_size / 1e6:.2f} MB")
