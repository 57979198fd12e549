"""Measured surfaces: point clouds read, aligned and cleaned, height fields, and files for site software."""
