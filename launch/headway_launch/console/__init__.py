"""Terminal output: tables, progress and errors; rendered videos."""
