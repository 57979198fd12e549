"""The dynamics (method section 4): plant assembly and the rock engines behind one interface."""
