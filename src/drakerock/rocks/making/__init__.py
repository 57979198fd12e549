"""Making piles: emission from above, settling, balancing, refilling, the cache."""
