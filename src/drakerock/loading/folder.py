"""Names of the files in a loading's folder."""

OUTCOME = "outcome.json"  # written last: a folder with it is complete
SCENARIO = "scenario.json"
PLAN = "plan.json"
SIGNALS = "signals.parquet"
RECORDING = "recording.npz"
PILE_BEFORE = "pile_before.npz"
PILE_AFTER = "pile_after.npz"
HEIGHT_FIELDS = "height_fields.npz"
COST = "cost.json"
NEXT_PILE = "pile_next.npz"
REPLAY = "replay.html"

CYCLE_FILES = (PILE_BEFORE, PILE_AFTER, SIGNALS, RECORDING, PLAN, HEIGHT_FIELDS, SCENARIO, OUTCOME)
"""What a loading cycle itself leaves, in the order in which it is told."""
