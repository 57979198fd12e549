"""Names of the files in a loading's folder that others than their writers need to know."""

OUTCOME = "outcome.json"  # written last: a folder with it is complete
PLAN = "plan.json"
HEIGHT_FIELDS = "height_fields.npz"
COST = "cost.json"
NEXT_PILE = "pile_next.npz"
REPLAY = "replay.html"
