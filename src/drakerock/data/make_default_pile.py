"""Makes default_pile.npz beside this file, the default scenario's pile (three minutes)."""

from pathlib import Path

from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.rocks.making.settling import make_pile
from drakerock.rocks.state import save_pile

if __name__ == "__main__":
    pile = make_pile(
        make_recipe(Scenario()), lambda stage, share: print(f"{stage:<16} {share:5.0%}", end="\r")
    )
    path = Path(__file__).with_name("default_pile.npz")
    save_pile(pile, path)
    print(f"{path.name}: {(~pile.fixed).sum()} moving rocks, {path.stat().st_size / 1e6:.2f} MB")
