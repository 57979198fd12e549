"""Collision: from poses to contact points with gaps and normals. `detection` puts its parts in order."""
