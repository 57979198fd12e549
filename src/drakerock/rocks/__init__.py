"""The pile (method section 3): rock shapes and gradation, site, state, filling."""
