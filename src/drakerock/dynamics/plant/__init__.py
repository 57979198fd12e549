"""The `plant` engine: every rock a free body of the MultibodyPlant. The reference, for small piles."""
