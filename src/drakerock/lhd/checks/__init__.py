"""The machine's bench, its checks and their page: what `drakerock machine` does, and nothing that a Diagram needs."""
