"""Collision: from poses to contact points with gaps and normals."""
