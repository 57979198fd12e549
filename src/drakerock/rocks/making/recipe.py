"""What a pile is made by."""

from __future__ import annotations

from drakerock.config import Config
from drakerock.rocks.config import PileConfig, RocksConfig, SiteConfig
from drakerock.rocks.engine.config import DynamicsConfig


class PileRecipe(Config):
    """All that a made pile depends on; its hash names the pile in the cache."""

    seed: int
    site: SiteConfig
    rocks: RocksConfig
    pile: PileConfig
    dynamics: DynamicsConfig
