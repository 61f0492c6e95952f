"""What the terminal shows: tables, progress, errors, videos."""
