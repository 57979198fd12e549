"""The exploration (method section 6): sampling, surrogate, Pareto front, strategy. Never imports pydrake."""
