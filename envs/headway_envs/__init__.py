"""Headway's environments. They import only the contracts and work without the engine."""
