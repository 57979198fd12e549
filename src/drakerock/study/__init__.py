"""The campaign: studies, their store and their runner."""
