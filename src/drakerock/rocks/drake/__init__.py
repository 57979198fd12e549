"""Rocks in a Drake Diagram: the systems, the coupling to a plant, and the engine that is the plant itself."""
