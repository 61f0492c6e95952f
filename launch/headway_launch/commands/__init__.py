"""One module per command, with `EXAMPLES`, `add_arguments` and `execute`."""
