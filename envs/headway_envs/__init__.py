"""Headway's environments. They import only `headway.contracts` and work without the rest of `headway`."""
