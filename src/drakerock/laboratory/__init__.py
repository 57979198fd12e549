"""The rock laboratory: virtual tests of the rocks as a material, against what is known of broken rock."""
